"""A rehearsal without a screen: the scripted press, or a session that was recorded."""

import json
from pathlib import Path

import click
from PIL import Image
from tqdm import tqdm

from render.pictures import PICTURES_A_SECOND, empty_folder, save_animation, side_by_side, smaller
from render.viewer import Controls, Settings, Viewer
from render.window import NoVulkan
from scenes.whole_files import whole
from studies.link.live import send_live
from studies.link.server import Server
from studies.pictures import save_picture
from studies.rehearsal import Rehearsal
from studies.rehearse.drivers import Driver
from studies.rehearse.instruments import Instruments
from studies.rehearse.saving import save_surfaces
from studies.rehearse.view import open_viewer, probe_as_set, take_view
from studies.report import Tally, summary

# An animation is in memory before it is written: of a long session it has fewer pictures.
MOST_SHOWN = 240


def run_headless(
    rehearsal: Rehearsal,
    driver: Driver,
    steps: int,
    settings: Settings,
    instruments: Instruments,
    arch: str,
    out: Path,
    build_s: float,
    link: Server | None = None,
) -> None:
    """So many moments that a driver leads: frames, slices, an animated picture and report.json."""
    try:
        viewer: Viewer | None = open_viewer(rehearsal, visible=False)
    except NoVulkan as reason:
        click.echo(f"{reason}; writing the pictures and the report without 3D frames.")
        viewer = None
    tally = Tally(build_s)
    every = max(1, round(1 / (PICTURES_A_SECOND * rehearsal.settings.time_step_s)))
    frames, slices = empty_folder(out / "frames"), empty_folder(out / "slices")
    animation: list[Image.Image] = []
    shown_every = every * (1 + steps // every // MOST_SHOWN)
    for step in tqdm(range(1, steps + 1), desc="press", unit="step"):
        pose = driver.move(Controls(settings))
        view = take_view(rehearsal, settings, pose, tally)
        if pose is not None:
            _tell(driver.stepped(tally.step_ms[-1]))
        probe = probe_as_set(rehearsal.probe, settings)
        instruments.watch(driver.session, probe, pose)
        send_live(link, rehearsal, view, probe, driver.session.time_s)
        _tell(driver.watch())
        tally.watch(rehearsal)
        if step % every == 0 or step == steps:
            picture = side_by_side(view)
            save_picture(picture, slices / f"{step:05d}.png")
            if viewer is not None:
                viewer.draw(instruments.onto(view, settings))
                picture = Image.fromarray(viewer.picture())
                save_picture(picture, frames / f"{step:05d}.png")
            if step % shown_every == 0 or step == steps:
                animation.append(smaller(picture))
    with whole(out / "press.webp") as partial:
        save_animation(animation, partial)
    save_surfaces(rehearsal, out)
    report = tally.report(rehearsal, arch) | dict(reading=instruments.figures())
    with whole(out / "report.json") as partial:
        partial.write_text(json.dumps(report, indent=2) + "\n", "utf-8")
    click.echo(summary(report))
    click.echo(f"Wrote {-(-steps // every)} pictures, press.webp and report.json to {out}")


def _tell(news: str) -> None:
    if news:
        click.echo(news)
