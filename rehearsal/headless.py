"""A rehearsal without a screen: the scripted press, or a session that was recorded."""

import json
from pathlib import Path

import click
from PIL import Image
from tqdm import tqdm

from rehearsal.frame_view import open_viewer, probe_as_set, take_step, take_view
from rehearsal.image_files import save_picture
from rehearsal.inputs.input_source import InputSource
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.run_report import Tally, summary
from rehearsal.rehearsal import Rehearsal
from rehearsal.saving import save_surfaces
from rehearsal.tracking.openigtlink_image import send_live
from rehearsal.tracking.openigtlink_server import Server
from render.animation import ANIMATION_FPS, empty_folder, save_animation, scaled_down, side_by_side
from render.viewer import Controls, Settings, View, Viewer
from render.window import NoVulkan
from scenes.atomic_files import whole

# An animation is in memory before it is written: of a long session it has fewer pictures.
MOST_SHOWN = 240


class Pictures:
    """What is drawn of so many steps: frames, slices, and an animation in a folder."""

    def __init__(self, rehearsal: Rehearsal, steps: int, out: Path) -> None:
        self.steps, self.out = steps, out
        self.viewer: Viewer | None = None
        try:
            self.viewer = open_viewer(rehearsal, visible=False)
        except NoVulkan as reason:
            click.echo(f"{reason}; writing the pictures and the report without 3D frames.")
        self._every = max(1, round(1 / (ANIMATION_FPS * rehearsal.settings.time_step_s)))
        self._shown_every = self._every * (1 + steps // self._every // MOST_SHOWN)
        folders = out / "frames", out / "slices"
        if any(next(folder.glob("*.png"), None) for folder in folders):
            click.echo(f"Replacing the pictures of an earlier run in {out}.")
        self._frames, self._slices = map(empty_folder, folders)
        self._animation: list[Image.Image] = []

    def draw(self, step: int, view: View, settings: Settings, instruments: LiveMeasurements) -> None:
        """A step's, where they are due."""
        if step % self._every and step < self.steps:
            return
        picture = side_by_side(view)
        save_picture(picture, self._slices / f"{step:05d}.png")
        if self.viewer is not None:
            self.viewer.draw(instruments.onto(view, settings))
            picture = Image.fromarray(self.viewer.picture())
            save_picture(picture, self._frames / f"{step:05d}.png")
        if step % self._shown_every == 0 or step == self.steps:
            self._animation.append(scaled_down(picture))

    def save(self) -> str:
        """Write the animation; what there is now."""
        with whole(self.out / "press.webp") as partial:
            save_animation(self._animation, partial)
        return f"{-(-self.steps // self._every)} pictures, press.webp"


def run_headless(
    rehearsal: Rehearsal,
    driver: InputSource,
    steps: int,
    settings: Settings,
    instruments: LiveMeasurements,
    arch: str,
    out: Path,
    build_s: float,
    draws: bool = True,
    link: Server | None = None,
) -> None:
    """So many moments that a driver leads: surfaces and report.json; where it ``draws``, pictures too, also for the link."""
    pictures = Pictures(rehearsal, steps, out) if draws else None
    tally = Tally(build_s)
    for step in tqdm(range(1, steps + 1), desc="press", unit="step"):
        pose = driver.move(Controls(settings))
        probe = probe_as_set(rehearsal.probe, settings)
        view = None if pictures is None else take_view(rehearsal, settings, pose, tally)
        if view is None:
            take_step(rehearsal, pose, tally)
            rehearsal.find_plane(probe)
        if pose is not None:
            _tell(driver.stepped(tally.step_ms[-1]))
            # After a way back the tissue is where it was, but the tool only with the next step.
            tally.watch(rehearsal)
        instruments.watch(driver.session, probe, pose)
        _tell(driver.watch())
        if pictures is not None and view is not None:
            send_live(link, rehearsal, view, probe, driver.session.time_s)
            pictures.draw(step, view, settings, instruments)
    save_surfaces(rehearsal, out)
    drawn = [pictures.save()] if pictures is not None else []
    report = tally.report(rehearsal, arch) | dict(reading=instruments.figures())
    with whole(out / "report.json") as partial:
        partial.write_text(json.dumps(report, indent=2) + "\n", "utf-8")
    click.echo(summary(report))
    click.echo(f"Wrote {' and '.join([*drawn, 'report.json'])} to {out}")


def _tell(news: str) -> None:
    if news:
        click.echo(news)
