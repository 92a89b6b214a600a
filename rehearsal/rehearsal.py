"""A case rehearsed in this process: its solver, its stepper, and its anatomy as the newest frame deforms it.

The window has the same parts in two processes (``real_time/``).
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from pydantic import ValidationError

from errors import UserError, explained
from rehearsal.case import Case, case_of
from rehearsal.configuration import with_quality
from rehearsal.deformed_anatomy import DeformedAnatomy, scanned_ct
from rehearsal.loop.command import Command, Load, Move, NewSession
from rehearsal.loop.frame import Frame, Refused
from rehearsal.loop.protocols import Stepper
from rehearsal.loop.timeline import Timeline
from rehearsal.pressed_organ import PressedOrgan
from rehearsal.start_progress import AT_REST, SURFACES, TISSUE
from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.scene import EMBEDDED, Scene, load_scene, scene_file, with_options
from scenes.terminal import ReportProgress, no_progress
from sim.device import start
from ultrasound.probe import DETAIL_LEVELS, DetailLevel, Mode
from ultrasound.probe_manipulator import ProbeManipulator, advanced
from ultrasound.scanner import IMAGES_OF_MODE, Scanner


class Rehearsal:
    """A case at rest with the transducer just touching; ``do`` applies a command and shows the frame after
    it.

    ``organ`` is the solver's side, ``anatomy`` what a frame shows of it, ``manipulator`` moves the transducer
    over the settled surface. ``needs_b_mode`` prepares the B-mode image while the model is built. Taichi must
    be initialised. Raises UserError.
    """

    def __init__(
        self,
        case: Case,
        loaded: LoadedAnatomy,
        progress: ReportProgress = no_progress,
        needs_b_mode: bool = False,
        serial: bool | None = None,
    ) -> None:
        scanned = scanned_ct(case, loaded, needs_b_mode)
        progress(TISSUE)
        self.case = case
        self.organ = PressedOrgan(case, serial)
        progress(SURFACES)
        self.anatomy = DeformedAnatomy(case, loaded, self.organ.model.carrier.interpolation, scanned)
        progress(AT_REST)
        self.organ.settle()
        self.timeline = Timeline(self.organ)
        self.manipulator = begin(case, self.anatomy, self.timeline)
        self._settled = self.timeline.whole_state()

    @property
    def frame(self) -> Frame:
        """The frame that was shown last."""
        return self.anatomy.frame

    @property
    def scene(self) -> Scene:
        """The scene with the settings of tissue, solver and gravity that are in force."""
        return self.timeline.scene

    def do(self, *commands: Command) -> Frame:
        """Apply commands, and show the frame after them. Raises UserError where one was refused."""
        for command in commands:
            if not isinstance(command, Command):
                raise UserError(f"{command!r} is no command; expected one such as Undo() or Move(pose=...)")
            self.timeline.submit(command)
        frame = self.timeline.newest()
        self.anatomy.show(frame)
        for event in frame.events:
            if isinstance(event, Refused) and any(event.command is command for command in commands):
                raise UserError(f"{event.command.kind}: {event.reason}")
        return frame

    def move(self, pose: np.ndarray) -> Frame:
        """Make a step to a pose (4, 4) of the transducer, and show the frame after it. Raises UserError."""
        try:
            return self.do(Move(pose=pose))
        except ValidationError as error:
            raise UserError(explained(error)) from None

    def images(
        self,
        mode: Mode = "both",
        detail_level: DetailLevel = "speckle",
        shape: tuple[int, int] | None = None,
    ) -> dict[str, np.ndarray]:
        """What the probe sees now: images uint8 of a shape (rows, columns), the scene's by default, by name.

        Raises UserError without a CT, and for a mode, level or shape that there is not.
        """
        image = self.case.scene.image
        if mode not in IMAGES_OF_MODE or detail_level not in DETAIL_LEVELS or min(shape or (1,)) < 1:
            raise UserError(
                f"mode = {mode!r}, detail_level = {detail_level!r}, shape = {shape}: expected one of "
                f"{', '.join(IMAGES_OF_MODE)}; one of {', '.join(DETAIL_LEVELS)}; at least one row and column"
            )
        shown = self.anatomy.image_plane(), self.case.probe, mode, detail_level
        return self._scanner.images(*shown, image.window_hu, image.level_hu, shape).by_name

    def labels(self) -> np.ndarray:
        """Ground truth of the last images (rows, columns) uint8: see ``ultrasound.ground_truth_labels``.

        Those of another pose need ``images`` first. Raises UserError without a CT.
        """
        return self._scanner.ground_truth.render()

    @property
    def _scanner(self) -> Scanner:
        if self.anatomy.scanner is None:
            raise UserError("this scene has no CT, and so no images; add one to it")
        return self.anatomy.scanner

    def advance(self, pose: np.ndarray) -> None:
        """Make a step to a pose (4, 4) for a study, without a frame of it: faster; ``show`` makes one."""
        self.organ.advance(pose)

    def show(self) -> None:
        """Show the present state."""
        self.do()

    def reset(self) -> None:
        """Begin a session at the start: tissue settled, transducer just touching."""
        self.do(Load(state=self._settled))

    def pose_at_depth(self, depth_mm: float) -> np.ndarray:
        """The transducer's pose (4, 4) at a depth of the scripted press."""
        return advanced(self.manipulator.home, depth_mm)

    def scripted_pose(self, time_s: float) -> np.ndarray:
        """The transducer's pose at a time of the scripted press: touching at first, then deeper stage by
        stage.
        """
        return scripted_pose(self.case, self.manipulator, time_s)

    def indentation_mm(self) -> float:
        """Depth of the transducer below the settled surface [mm]; negative above it."""
        return self.manipulator.indentation_mm(self.organ.pose)


def begin(case: Case, anatomy: DeformedAnatomy, stepper: Stepper) -> ProbeManipulator:
    """Begin a session with the tissue as it has settled and the transducer just touching; return what
    moves the transducer.
    """
    anatomy.show(stepper.newest())
    manipulator = case.manipulator(anatomy.vertices)
    stepper.submit(NewSession(pose=manipulator.pose()))
    stepper.wait()
    anatomy.show(stepper.newest())
    return manipulator


def scripted_pose(case: Case, manipulator: ProbeManipulator, time_s: float) -> np.ndarray:
    """The transducer's pose (4, 4) at a time [s] of a case's scripted press."""
    depths = [0.0, *case.press.indentations_mm]
    stage = time_s / case.scene.solver.time_step_s / case.press.stage_steps
    return advanced(manipulator.home, float(np.interp(stage, np.arange(len(depths)), depths)))


def script_length_s(case: Case) -> float:
    """Duration [s] of a case's scripted press."""
    return len(case.press.indentations_mm) * case.press.stage_steps * case.scene.solver.time_step_s


def open_rehearsal(
    scene: Path | str = EMBEDDED,
    quality: str | None = None,
    changes: Mapping[str, Any] = MappingProxyType({}),
    arch: str = "cpu",
) -> Rehearsal:
    """A rehearsal of a scene file or a patient's folder, for a Python program: with a preset, and values of
    the scene changed by key.

    Taichi starts anew, which frees what a rehearsal before had: one is open at a time in a process. Raises
    UserError, NoDevice.
    """
    path = scene_file(Path(scene))
    loaded = with_quality(with_options(load_scene(path), changes), quality)
    anatomy = load_anatomy(loaded, path.parent)
    start(arch)
    return Rehearsal(case_of(loaded, anatomy), anatomy)
