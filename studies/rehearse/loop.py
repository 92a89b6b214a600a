"""The interactive loop: input -> transducer -> step -> surfaces and pictures -> window."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter

import click
import numpy as np
from PIL import Image

from render.pictures import in_proportion
from render.viewer import Controls, View, Viewer
from render.window import NoVulkan
from studies.commands import Fault
from studies.rehearsal import Rehearsal
from studies.rehearse.cine import Calliper, Cine, Frame
from studies.rehearse.view import open_viewer, take_view
from studies.report import Notices, Record
from studies.trade.ladder import Ladder
from ultrasound.array import Probe
from ultrasound.dicom_image import save_dicom
from ultrasound.scanner import ECHO


def run_window(rehearsal: Rehearsal, out: Path, budget_ms: float | None) -> None:
    """The interactive loop: input -> transducer -> step -> surfaces and slice -> picture.

    A step that takes longer than its budget, or else than the time that it simulates, makes iterations give way.
    """
    try:
        viewer = open_viewer(rehearsal, visible=True)
    except NoVulkan as reason:
        raise Fault(f"{reason}; install a Vulkan driver, or run with --headless") from None
    record = Record(0.0)
    ladder = Ladder(budget_ms or 1000 * rehearsal.settings.time_step_s)
    notices = Notices(click.echo)
    click.echo("The window is open; H shows the keys, Esc quits.")
    Loop(rehearsal, viewer, out, record, ladder, notices).run()
    viewer.close()


@dataclass
class Loop:
    """The frames of one session in a window."""

    rehearsal: Rehearsal
    viewer: Viewer
    out: Path
    record: Record
    ladder: Ladder
    notices: Notices
    cine: Cine = field(default_factory=Cine)
    calliper: Calliper = field(default_factory=Calliper)
    frozen: bool = False
    rate: float = 0.0

    def run(self) -> None:
        """Go on until the window is closed."""
        before = perf_counter()
        take_view(self.rehearsal, self.viewer.settings, self.rehearsal.pose, self.record)
        while self.viewer.running:
            controls = self.viewer.read_controls()
            view = self.frame(controls)
            now = perf_counter()
            self.rate = 0.9 * self.rate + 0.1 / max(now - before, 1e-6)
            before = now
            self.viewer.draw(view)
            if controls.screenshot:
                save_screenshot(self.viewer.picture(), self.out)
            if controls.export:
                save_pictures(view, self.rehearsal.probe, self.out)

    def frame(self, controls: Controls) -> View:
        """One frame: what the user did, a step unless frozen, and what is to be seen."""
        if controls.freeze:
            self.frozen = not self.frozen
        pose = None if self.frozen else steer(self.rehearsal, controls, self.ladder)
        shown = self._looked_back(controls) or self._taken(controls, pose)
        if controls.reset:
            self.calliper.points = ()
        self.calliper.point(controls.pointed_mm)
        speed = self.rate * self.rehearsal.settings.time_step_s
        figures = {"frames": f"{self.rate:.0f} /s", "time": f"{speed:.1f} x real"}
        figures |= self.calliper.readouts(shown)
        view = shown.view
        return replace(view, calliper_mm=self.calliper.points, readouts=view.readouts | figures)

    def _looked_back(self, controls: Controls) -> Frame | None:
        """A frame of the last seconds, where the user is looking at one."""
        if self.frozen:
            self.cine.go(controls.cine)
        if not self.frozen or self.cine.back == 0:
            return None
        frame = self.cine.shown
        return replace(frame, view=replace(frame.view, status=f"FROZEN   {self.cine.age_s:.1f} s"))

    def _taken(self, controls: Controls, pose: np.ndarray | None) -> Frame:
        """A new frame. A frozen one shows the same tissue with the scanner set anew, and is not kept."""
        asked = controls.settings.iterations
        status = "FROZEN" if self.frozen else self.notices.shown or self.ladder.says(asked)
        view = take_view(self.rehearsal, controls.settings, pose, self.record, status)
        frame = Frame(perf_counter(), view, self.rehearsal.rest_grid())
        if pose is not None:
            self.cine.keep(frame)
            self._tell(asked, status)
        return frame

    def _tell(self, asked: int, status: str) -> None:
        self.notices.tell(self.rehearsal.notice)
        if self.ladder.watch(self.record.step_ms[-1]) and self.ladder.says(asked) != status:
            click.echo(self.ladder.says(asked) or f"Back to all {asked} iterations.")


def steer(rehearsal: Rehearsal, controls: Controls, ladder: Ladder) -> np.ndarray:
    """Hand the user's input to the hand that holds the transducer and to the solver; the pose to go to then."""
    step, hand, asked = rehearsal.settings, rehearsal.hand, controls.settings
    step.iterations, step.substeps = ladder.iterations(asked.iterations), asked.substeps
    if asked.stiffness is not None:
        step.stiffness = asked.stiffness
    if asked.young_kpa is not None:
        rehearsal.set_young(asked.young_kpa)
    rehearsal.set_gravity(asked.gravity_m_s2)
    if controls.reset:
        rehearsal.reset()
    elif controls.ray is not None:
        hand.point(*controls.ray)
    hand.hold(controls.press, step.time_step_s)
    hand.push(controls.push_mm)
    hand.turn(controls.fan_deg, controls.tilt_deg, controls.roll_deg)
    return rehearsal.pose_towards(hand.pose())


def save_screenshot(picture: np.ndarray, out: Path) -> None:
    """Save a picture under the next free number, and say where."""
    number = 1 + max([int(path.stem[-3:]) for path in out.glob("screenshot-[0-9][0-9][0-9].png")], default=0)
    path = out / f"screenshot-{number:03d}.png"
    Image.fromarray(picture).save(path)
    click.echo(f"Saved {path}")


def save_pictures(view: View, probe: Probe, out: Path) -> None:
    """Save what the scanner shows as PNG, an echo as DICOM too, under the next free number, and say where."""
    number = 1 + max([int(path.stem[:3]) for path in out.glob("[0-9][0-9][0-9]-*.png")], default=0)
    for name, picture in view.pictures.items():
        path = out / f"{number:03d}-{name.lower()}.png"
        image = in_proportion(picture, view.width_mm, view.depth_mm)
        image.save(path)
        spacing = view.depth_mm / image.height, view.width_mm / image.width
        if name == ECHO:
            save_dicom(path.with_suffix(".dcm"), np.asarray(image), spacing, probe)
        click.echo(f"Saved {path}{' and .dcm' if name == ECHO else ''}")
