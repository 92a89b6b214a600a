"""A rehearsal without a screen: the scripted press, or a recorded session."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import click
from PIL import Image

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.drawn_geometry import drawn_geometry, open_viewer
from rehearsal.image_and_surface_files import save_image_file, save_surfaces
from rehearsal.imaging import image_view
from rehearsal.live_settings import LiveSettings, with_recorded
from rehearsal.loop.command import SetValues
from rehearsal.loop.protocols import Observer, Source
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.run_report import Tally, summary
from rehearsal.notices import Notices
from rehearsal.page.session_images import SessionImages
from rehearsal.rehearsal import Rehearsal
from rehearsal.resection.resection_plan import ResectionPlan
from rehearsal.resection.resection_view import ResectionView, cut_settings
from rehearsal.result_files import write_json
from rehearsal.tracking.openigtlink_server import OpenIGTLinkServer, send_live
from render.animation import ANIMATION_FPS, empty_folder, save_animation, scaled_down, side_by_side
from render.viewer import Controls, View, ViewSettings
from render.window import NoVulkan, Window
from scenes.atomic_files import atomic_write
from scenes.terminal import bar
from ultrasound.persistence import Persistence

# An animation is held in memory: a long session has fewer images in it.
MOST_SHOWN = 240
ANIMATION = "press.webp"


class Pictures:
    """The images of a run: frames, slices and an animation in a folder."""

    def __init__(self, anatomy: DeformedAnatomy, steps: int, out: Path) -> None:
        self.steps, self.out = steps, out
        self._anatomy, self._version = anatomy, anatomy.geometry.version
        self.viewer: Window | None = None
        try:
            self.viewer = open_viewer(anatomy, visible=False)
        except NoVulkan as reason:
            click.echo(f"{reason}; writing the pictures and the report without 3D frames.")
        self._every = max(1, round(1 / (ANIMATION_FPS * anatomy.case.scene.solver.time_step_s)))
        self._shown_every = self._every * (1 + steps // self._every // MOST_SHOWN)
        folders = out / "frames", out / "slices"
        if any(next(folder.glob("*.png"), None) for folder in folders):
            click.echo(f"Replacing the pictures of an earlier run in {out}.")
        self._frames, self._slices = map(empty_folder, folders)
        self._animation: list[Image.Image] = []

    def draw(self, step: int, view: View, shown: ViewSettings, measurements: LiveMeasurements) -> None:
        """Draw a step, if its images are due."""
        if step % self._every and step < self.steps:
            return
        picture = side_by_side(view)
        save_image_file(picture, self._slices / f"{step:05d}.png")
        if self.viewer is not None:
            if self._anatomy.geometry.version != self._version:
                self._version = self._anatomy.geometry.version
                self.viewer.change_geometry(drawn_geometry(self._anatomy))
            self.viewer.draw(measurements.onto(view, shown))
            picture = Image.fromarray(self.viewer.picture())
            save_image_file(picture, self._frames / f"{step:05d}.png")
        if step % self._shown_every == 0 or step == self.steps:
            self._animation.append(scaled_down(picture))

    def save(self) -> str:
        """Write the animation; return what was written."""
        with atomic_write(self.out / ANIMATION) as partial:
            save_animation(self._animation, partial)
        return f"{-(-self.steps // self._every)} pictures, {ANIMATION}"


@dataclass
class HeadlessLoop:
    """A rehearsal without a window: each time around one step, and where it ``draws``, an image of it,
    also for the link.
    """

    rehearsal: Rehearsal
    source: Source
    measurements: LiveMeasurements
    observers: list[Observer]
    settings: LiveSettings
    tally: Tally
    notices: Notices
    resection: ResectionView
    link: OpenIGTLinkServer | None = None
    warnings: tuple[str, ...] = ()
    """Of the import, which nobody has acknowledged."""
    images: SessionImages = field(default_factory=SessionImages)
    _persistence: Persistence = field(default_factory=Persistence, init=False)

    def run(self, steps: int, out: Path, draws: bool) -> list[str]:
        """Make so many steps; return what was written of images."""
        anatomy = self.rehearsal.anatomy
        pictures = Pictures(anatomy, steps, out) if draws else None
        step_s = anatomy.case.scene.solver.time_step_s
        for step in bar(range(1, steps + 1), "press"):
            for command in self.source.commands(self.rehearsal.frame, Controls(self.settings), step_s):
                if isinstance(command, SetValues):
                    self.settings = with_recorded(self.settings, command.values)
                self.rehearsal.timeline.submit(command)
            frame = self.rehearsal.do()
            probe = self.settings.probe
            view = self._view() if draws else None
            if not draws:
                anatomy.find_plane(probe)
            self.tally.add(self.rehearsal, frame)
            for observer in self.observers:
                observer.observe(frame, probe)
            if pictures is not None and view is not None:
                send_live(self.link, anatomy, view, probe)
                # What was cut is judged.
                phase = "Inspect" if anatomy.cut is not None else self.settings.view.phase
                shown = self.settings.view.model_copy(update=dict(phase=phase))
                self.images.observe(self.measurements.onto(view, shown), anatomy)
                pictures.draw(step, view, shown, self.measurements)
            self.notices.present()
        return [pictures.save()] if pictures is not None else []

    def _view(self) -> View:
        """The images of the present frame, with the score and the coming cut."""
        view = image_view(self.rehearsal.anatomy, self.settings, self.tally.slice_ms, None, self._persistence)
        view = replace(view, warnings=tuple(f"Import: {text}" for text in self.warnings))
        planned = cut_settings(self.settings)
        self.resection.update(planned, lambda points: self.measurements.coverage.is_seen(points))
        score = self.resection.score(planned.margin_mm)
        return view if score is None else replace(view, score=score, resection_mm=self.resection.section())


def run_headless(
    loop: HeadlessLoop,
    steps: int,
    arch: str,
    out: Path,
    draws: bool = True,
    plan: ResectionPlan | None = None,
    about: dict[str, Any] | None = None,
    attempts: Callable[[], list[dict[str, Any]]] = list,
) -> None:
    """Compute so many steps; write surfaces and report.json, and where it ``draws``, images too.

    ``about`` is what else the report says, of the patient; ``attempts`` gives the figures of the cuts.
    """
    rehearsal = loop.rehearsal
    drawn = loop.run(steps, out, draws)
    save_surfaces(rehearsal.anatomy, out)
    report = loop.tally.report(rehearsal, arch) | (about or {}) | dict(reading=loop.measurements.figures())
    if rehearsal.anatomy.judgement is not None:
        from rehearsal.resection.resection_page import report_of

        report |= dict(resection=report_of(rehearsal.anatomy, plan))
    if figures := attempts():
        report |= dict(attempts=figures)
    write_json(report, out / "report.json")
    click.echo(summary(report))
    click.echo(f"Wrote {' and '.join([*drawn, 'report.json'])} to {out}")
    if drawn:
        click.echo(f"Open first: {out / ANIMATION}, a film of the run (a web browser shows it)")
