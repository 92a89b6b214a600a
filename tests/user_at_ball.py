"""A user with a transducer over a ball, and a timeline of a fake organ behind: no Taichi."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import trimesh
from fake_organ import fake_timeline
from settings_at_start import settings_with

from rehearsal.live_settings import LiveSettings
from rehearsal.loop.command import Command, NewSession, SetValues
from rehearsal.loop.frame import Frame
from rehearsal.notices import Notices
from rehearsal.sources.tracker import Tracker
from rehearsal.sources.user import UserSource
from render.viewer import Controls
from ultrasound.probe_manipulator import (
    ImagePlane,
    ProbeManipulator,
    image_plane,
    pose_at,
    pose_of_image_plane,
)

SIZE = np.array([6.0, 4.0, 6.0])
START = settings_with()
ORIGIN = np.array([40.0, -7.0, 300.0])
DOWN = np.array([0.0, 0.0, -1.0])


class BallCase(SimpleNamespace):
    """What a tracker needs of a case: where the ball is in the patient."""

    origin = ORIGIN
    tumour = None

    def transducer_at(self, probe: np.ndarray) -> np.ndarray:
        moved = probe.copy()
        moved[:3, 3] -= ORIGIN
        return pose_of_image_plane(moved, SIZE[2])

    def image_plane(self, pose: np.ndarray) -> ImagePlane:
        return image_plane(pose, SIZE[2], 10.0, 10.0)


def ball_manipulator() -> ProbeManipulator:
    """Over a ball of 12 mm, just touching its top."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=12.0)
    faces, normals = np.array(ball.faces, np.int64), np.array(ball.vertex_normals)
    home = pose_at(np.array([0.0, 0.0, 12.0]), DOWN, np.array([1.0, 0.0, 0.0]), SIZE[2])
    return ProbeManipulator(np.array(ball.vertices), faces, normals, SIZE, home, np.array([1.0, 0.0, 0.0]))


class UserAtBall:
    """Applies the commands of a ``UserSource`` in this process, as a headless run does."""

    def __init__(self, tracked: Any = None, **given: Any) -> None:
        self.stepper, self.notices = fake_timeline(), Notices()
        self.manipulator = ball_manipulator()
        self.stepper.submit(NewSession(pose=self.manipulator.pose()))
        self.case = BallCase()
        self.anatomy = SimpleNamespace(pose=self.manipulator.pose(), case=self.case, scanner=None)
        tracker = None if tracked is None else Tracker(tracked, self.case)
        self.source = UserSource(self.anatomy, self.manipulator, self.notices, tracker, **given)
        self.frame = self.stepper.newest()
        self.commands: list[Command] = []

    def step(self, settings: LiveSettings | None = None, **did: Any) -> np.ndarray:
        """A frame in which the user did something; the transducer's pose after it."""
        controls = Controls(settings or START, **did)
        self.commands = list(
            self.source.commands(self.frame, controls, self.timeline.organ.settings.time_step_s)
        )
        for command in self.commands:
            self.stepper.submit(command)
        self.frame: Frame = self.stepper.newest()
        self.anatomy.pose = self.frame.pose
        return self.frame.pose

    @property
    def timeline(self):
        return self.stepper

    @property
    def kinds(self) -> list[str]:
        """The kinds of the commands of the last frame."""
        return [command.kind for command in self.commands]

    @property
    def set(self) -> dict[str, Any]:
        """What the last frame has set."""
        return {
            k: v
            for command in self.commands
            if isinstance(command, SetValues)
            for k, v in command.values.items()
        }

    def said(self) -> str:
        """The notices since the last call."""
        return "".join(self.notices.present())


def ray(x_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """The mouse over a place of the ball."""
    return np.array([x_mm, 0.0, 60.0]), DOWN
