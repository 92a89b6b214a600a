"""The scripted press without a screen."""

import json
from pathlib import Path

import click
from PIL import Image
from tqdm import tqdm

from render.pictures import PICTURES_A_SECOND, empty_folder, save_animation, side_by_side, smaller
from render.viewer import Viewer
from render.window import NoVulkan
from studies.rehearsal import Rehearsal
from studies.rehearse.view import open_viewer, settings_of, take_view
from studies.report import Record, summary


def run_headless(rehearsal: Rehearsal, arch: str, seconds: float | None, out: Path, build_s: float) -> None:
    """The scripted press without a screen: frames, slices, an animated picture and report.json."""
    try:
        viewer: Viewer | None = open_viewer(rehearsal, visible=False)
    except NoVulkan as reason:
        click.echo(f"{reason}; writing the pictures and the report without 3D frames.")
        viewer = None
    settings = settings_of(rehearsal)
    record = Record(build_s)
    length_s = seconds or rehearsal.script_length_s()
    dt = rehearsal.settings.time_step_s
    steps = max(1, round(length_s / dt))
    every = max(1, round(1 / (PICTURES_A_SECOND * dt)))
    frames, slices = empty_folder(out / "frames"), empty_folder(out / "slices")
    animation: list[Image.Image] = []
    for step in tqdm(range(1, steps + 1), desc="press", unit="step"):
        goal = rehearsal.scripted_pose(rehearsal.script_length_s() * step / steps)
        view = take_view(rehearsal, settings, rehearsal.pose_towards(goal), record)
        record.watch(rehearsal)
        if step % every == 0 or step == steps:
            picture = side_by_side(view)
            picture.save(slices / f"{step:05d}.png")
            if viewer is not None:
                viewer.draw(view)
                picture = Image.fromarray(viewer.picture())
                picture.save(frames / f"{step:05d}.png")
            animation.append(smaller(picture))
    save_animation(animation, out / "press.gif")
    report = record.report(rehearsal, arch)
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n", "utf-8")
    click.echo(summary(report))
    click.echo(f"Wrote {len(animation)} pictures, press.gif and report.json to {out}")
