"""What the studies share: a rehearsal built with a setup, driven by an input step by step, and watched."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import psutil
import taichi as ti
from scipy.spatial.transform import Rotation

from rehearsal.configuration import Setup, scene_of
from rehearsal.rehearsal import Rehearsal
from rehearsal.stopwatch import timed
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from sim.device import start
from sim.fields import array_of
from sim.solver import Solver

Input = TypeVar("Input")


def build(
    scene: Scene, anatomy: LoadedAnatomy, setup: Setup, arch: str, with_image: bool = False
) -> Rehearsal:
    """A scene's rehearsal at rest, on a freshly started device."""
    start(arch)
    return Rehearsal(scene_of(scene, setup), anatomy if with_image else replace(anatomy, ct=None))


def restart(solver: Solver) -> None:
    """The stress-free shape, without velocities and contacts."""
    solver.body.restore(solver.body.rest_state())
    solver.contacts.reset()
    solver.model.update_frames()


@dataclass
class Watch:
    """The duration of each step [ms], and the messages of the divergence check where it restored the state."""

    step_ms: list[float] = field(default_factory=list)
    restored: list[str] = field(default_factory=list)

    def drive(self, advance: Callable[[Input], str], inputs: Iterable[Input]) -> Iterator[str]:
        """Take a step for each input, and yield its message; an input may depend on the state that it finds."""
        for each in inputs:
            notice = timed(lambda: advance(each), self.step_ms)
            if notice:
                self.restored.append(notice)
            yield notice

    def rehearse(self, rehearsal: Rehearsal, poses: Iterable[np.ndarray]) -> None:
        """Advance a rehearsal over poses (4, 4)."""

        def advance(pose: np.ndarray) -> str:
            rehearsal.advance(pose)
            return rehearsal.notice

        for _ in self.drive(advance, poses):
            pass


def memory_of_process_mb() -> float:
    """Memory of this process [MB]."""
    return psutil.Process().memory_info().rss / 1e6


def memory_mb(owner: Any, apart: Any = None) -> float:
    """Memory of the fields [MB] on the device that an object refers to, without those of ``apart``."""
    seen: set[int] = set()
    _bytes_in(apart, seen)
    return _bytes_in(owner, seen) / 1e6


def _bytes_in(owner: Any, seen: set[int]) -> int:
    if id(owner) in seen:
        return 0
    seen.add(id(owner))
    if isinstance(owner, ti.Field):
        return int(np.prod(owner.shape, dtype=np.int64)) * 4 * _entries(owner)
    if isinstance(owner, list | tuple):
        return sum(_bytes_in(part, seen) for part in owner)
    if type(owner).__module__.startswith(("sim.", "ultrasound.")):
        return sum(_bytes_in(part, seen) for part in vars(owner).values())
    return 0


def _entries(field: ti.Field) -> int:
    if isinstance(field, ti.StructField):
        return sum(_entries(field.get_member_field(name)) for name in field.keys)
    return getattr(field, "n", 1) * getattr(field, "m", 1)


def positions_of(solver: Solver) -> np.ndarray:
    """Present positions (n, 3) [mm], in double precision."""
    return array_of(solver.body.position).astype(float)


def distances_after_fit(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Distances (n,) [mm] of points (n, 3) from reference points after a rigid least-squares fit (Kabsch)."""
    points, reference = points - points.mean(axis=0), reference - reference.mean(axis=0)
    if len(reference) > 1:
        points = Rotation.align_vectors(reference, points)[0].apply(points)
    return np.linalg.norm(points - reference, axis=1)
