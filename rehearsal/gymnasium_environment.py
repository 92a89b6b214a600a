"""A Gymnasium environment: a probe on a patient's deformable kidney. What it sees and presses is scored as a
planned sweep is.

Needs the package gymnasium. Each environment has a process of its own, as Gymnasium's ``AsyncVectorEnv``
gives it: Taichi serves one rehearsal in a process.
"""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from scipy.spatial.transform import Rotation

from rehearsal.configuration import probe_of, with_quality
from rehearsal.planning.sweep_score import score
from rehearsal.planning.sweep_trial import PlanningProblem, Trial
from scenes.anatomy import load_anatomy
from scenes.scene import EMBEDDED, load_scene, scene_file
from sim.device import start
from ultrasound.probe_manipulator import ManipulatorState, advanced, array_face_centre
from ultrasound.target import Target

# The greatest motion of an action along and about each axis of the transducer, and its speed.
MOST_MM, MOST_DEG, SPEED_MM_S = 3.0, 10.0, 20.0
# An episode begins at a place that is this far from the middle, along both axes of the array face.
BEGINS_WITHIN_MM = 12.0

Observation = dict[str, np.ndarray]


class ProbeEnvironment(gymnasium.Env[Observation, np.ndarray]):
    """An action (6,), -1 to 1, moves the transducer along its axes x, y, z and turns it about them, around
    the middle of the array face.

    An observation has ``image`` (pixels, pixels) uint8, the B-mode image; ``pose`` (12,), rows of the probe's
    pose in the patient (mm, LPS, in PLUS's axes); and ``force`` (3,) [N] of the tissue on the probe. The
    reward is the change of the planner's score (``rehearsal.planning.sweep_score``), so that an episode's
    rewards sum to the score of its path. An episode has so many ``actions``. The same seed and actions give
    the same bits. Raises UserError.
    """

    def __init__(
        self,
        scene: Path | str = EMBEDDED,
        quality: str = "fast",
        target: Target = "tumour",
        actions: int = 60,
        pixels: int = 64,
    ) -> None:
        path = scene_file(Path(scene))
        loaded = with_quality(load_scene(path), quality)
        anatomy = load_anatomy(loaded, path.parent)
        start("cpu")
        self.problem = PlanningProblem(loaded, anatomy, probe_of(loaded), target, 5.0, loaded.trocar)
        self.trial = Trial(self.problem)
        self._rehearsal, self._actions, self._shape = self.trial.rehearsal, actions, (pixels, pixels)
        self.action_space = Box(-1.0, 1.0, (6,), np.float32)
        self.observation_space: Any = Dict(
            image=Box(0, 255, self._shape, np.uint8),
            pose=Box(-np.inf, np.inf, (12,), np.float32),
            force=Box(-np.inf, np.inf, (3,), np.float32),
        )
        self._poses: list[np.ndarray] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode, just touching the organ at a random place."""
        super().reset(seed=seed)
        trial, manipulator = self.trial, self.trial.manipulator
        trial.begin(SPEED_MM_S)
        manipulator.state = ManipulatorState()
        manipulator.slide(*self.np_random.uniform(-BEGINS_WITHIN_MM, BEGINS_WITHIN_MM, 2))
        self._rehearsal.organ.place(manipulator.pose())
        self._poses, self._score = [], 0.0
        trial.move(manipulator.pose(), manipulator.pose())
        self._measured()
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move the transducer, no deeper than the manipulator allows; see ``gymnasium.Env.step``."""
        pose = self._rehearsal.organ.pose
        self.trial.move(pose, self._goal(pose, np.clip(np.asarray(action, float), -1.0, 1.0)))
        before, terms = self._score, self._measured()
        is_over = len(self._poses) > self._actions
        return self._observation(), self._score - before, False, is_over, {"seen": terms.seen}

    def action_towards(self, goal: np.ndarray) -> np.ndarray:
        """The action (6,) that moves the transducer to a pose (4, 4), or as far towards it as one can."""
        pose, length_mm = self._rehearsal.organ.pose, self._rehearsal.case.size_mm[2]
        away_mm = array_face_centre(goal, length_mm) - array_face_centre(pose, length_mm)
        turn = Rotation.from_matrix(pose[:3, :3].T @ goal[:3, :3]).as_rotvec(degrees=True)
        action = np.concatenate([pose[:3, :3].T @ away_mm / MOST_MM, turn / MOST_DEG])
        return action / max(np.abs(action).max(), 1.0)

    def _goal(self, pose: np.ndarray, action: np.ndarray) -> np.ndarray:
        length_mm, manipulator = self._rehearsal.case.size_mm[2], self.trial.manipulator
        turn = Rotation.from_rotvec(MOST_DEG * action[3:], degrees=True).as_matrix()
        goal = pose.copy()
        goal[:3, :3] = pose[:3, :3] @ turn
        face = array_face_centre(pose, length_mm) + pose[:3, :3] @ (MOST_MM * action[:3])
        goal[:3, 3] = face + length_mm / 2 * goal[:3, 2]
        return advanced(goal, -max(manipulator.indentation_mm(goal) - manipulator.max_mm, 0.0))

    def _measured(self) -> Any:
        """The terms of the path so far, with the present pose."""
        self.trial.measure()
        self._poses.append(self._rehearsal.organ.pose)
        terms = self.trial.so_far([np.stack(self._poses)])
        self._score = score(terms)
        return terms

    def _observation(self) -> Observation:
        pose = self._rehearsal.anatomy.probe_in_patient()[:3].ravel().astype(np.float32)
        force = np.zeros(3) if (wrench := self._rehearsal.frame.wrench) is None else wrench[:3]
        image = self._rehearsal.images("b-mode", shape=self._shape)["B-mode"]
        return dict(image=image, pose=pose, force=force.astype(np.float32))
