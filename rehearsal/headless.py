"""A rehearsal without a screen: the scripted press, or a recorded session."""

from pathlib import Path
from typing import Any

import click
from PIL import Image

from rehearsal.frame import Frames
from rehearsal.image_and_surface_files import save_image_file, save_surfaces
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.run_report import summary
from rehearsal.notices import Notices
from rehearsal.open_window import geometry_of, open_viewer, probe_with_settings
from rehearsal.rehearsal import Rehearsal
from rehearsal.result_files import write_json
from render.animation import ANIMATION_FPS, empty_folder, save_animation, scaled_down, side_by_side
from render.viewer import Controls, Settings, View
from render.window import NoVulkan, Window
from scenes.atomic_files import atomic_write
from scenes.terminal import bar

# An animation is held in memory: a long session has fewer images in it.
MOST_SHOWN = 240
ANIMATION = "press.webp"


class Pictures:
    """The images of a run: frames, slices and an animation in a folder."""

    def __init__(self, rehearsal: Rehearsal, steps: int, out: Path) -> None:
        self.steps, self.out = steps, out
        self._rehearsal, self._shown_version = rehearsal, rehearsal.geometry_version
        self.viewer: Window | None = None
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

    def draw(self, step: int, view: View, settings: Settings, measurements: LiveMeasurements) -> None:
        """Draw a step, if its images are due."""
        if step % self._every and step < self.steps:
            return
        picture = side_by_side(view)
        save_image_file(picture, self._slices / f"{step:05d}.png")
        if self.viewer is not None:
            if self._rehearsal.geometry_version != self._shown_version:
                self._shown_version = self._rehearsal.geometry_version
                self.viewer.change_geometry(geometry_of(self._rehearsal))
            self.viewer.draw(measurements.onto(view, settings))
            picture = Image.fromarray(self.viewer.picture())
            save_image_file(picture, self._frames / f"{step:05d}.png")
        if step % self._shown_every == 0 or step == self.steps:
            self._animation.append(scaled_down(picture))

    def save(self) -> str:
        """Write the animation; return what was written."""
        with atomic_write(self.out / ANIMATION) as partial:
            save_animation(self._animation, partial)
        return f"{-(-self.steps // self._every)} pictures, {ANIMATION}"


def run_headless(
    frames: Frames,
    notices: Notices,
    steps: int,
    settings: Settings,
    arch: str,
    out: Path,
    draws: bool = True,
    about: dict[str, Any] | None = None,
) -> None:
    """Compute so many frames; write surfaces and report.json, and where it ``draws``, images too, also for the link.

    ``about`` is what else the report says, of the patient.
    """
    rehearsal, tally = frames.rehearsal, frames.tally
    pictures = Pictures(rehearsal, steps, out) if draws else None
    for step in bar(range(1, steps + 1), "press"):
        pose = frames.input(Controls(settings))
        frames.step(pose)
        probe = probe_with_settings(rehearsal.probe, settings)
        if pictures is None:
            rehearsal.find_plane(probe)
        else:
            view = frames.image(probe, settings)
        if pose is not None:
            # After a rollback the tissue is restored, but the tool only with the next step.
            tally.watch(rehearsal)
        frames.observe(probe, pose)
        if pictures is not None:
            frames.send(view, probe)
            pictures.draw(step, view, settings, frames.measurements)
        notices.present()
    save_surfaces(rehearsal, out)
    drawn = [pictures.save()] if pictures is not None else []
    report = tally.report(rehearsal, arch) | (about or {}) | dict(reading=frames.measurements.figures())
    if rehearsal.judgement is not None:
        from rehearsal.resection.resection_page import report_of

        report |= dict(resection=report_of(rehearsal, frames.resection_plan))
    write_json(report, out / "report.json")
    click.echo(summary(report))
    click.echo(f"Wrote {' and '.join([*drawn, 'report.json'])} to {out}")
    if drawn:
        click.echo(f"Open first: {out / ANIMATION}, a film of the run (a web browser shows it)")
