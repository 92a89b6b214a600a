"""What the studies share: a rehearsal built with a setup, blocks without a scene, and what is measured of
them.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import psutil
import trimesh
from scipy.spatial.transform import Rotation

from rehearsal.case import case_of
from rehearsal.configuration import Setup, scene_of
from rehearsal.rehearsal import Rehearsal
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from sim.body import Body, ParticleBody
from sim.device import start
from sim.fields import Field, array_of
from sim.lattice import fill_block, surface_points
from sim.neo_hookean import NeoHookean
from sim.particle_contact import ShapeContacts
from sim.sampling import RestBody, group_into_patches
from sim.shape_matching import ShapeMatching
from sim.shapes import ConvexTool
from sim.solver import Solver
from sim.surface_contact import SurfaceContacts
from ultrasound.probe import Probe


def rehearsal_of(scene: Scene, anatomy: LoadedAnatomy) -> Rehearsal:
    """A scene's rehearsal at rest. Taichi must be initialised."""
    return Rehearsal(case_of(scene, anatomy), anatomy)


def build(scene: Scene, anatomy: LoadedAnatomy, setup: Setup, arch: str) -> Rehearsal:
    """A scene's rehearsal at rest with a setup, on a freshly started device; without images."""
    start(arch)
    return rehearsal_of(scene_of(scene, setup), without_images(anatomy))


def step_of(setup: Setup) -> dict[str, Any]:
    """The settings of a step, under the names of a report."""
    names = dict(substeps=setup.substeps, iterations=setup.iterations)
    return names | dict(time_step_s=setup.solver.time_step_s)


def without_images(anatomy: LoadedAnatomy) -> LoadedAnatomy:
    """The same without its CT, which only images need."""
    return replace(anatomy, ct=None)


def all_scanlines(probe: Probe) -> np.ndarray:
    """That each scanline of a probe touches the organ (n,), where its contact is not measured."""
    return np.ones(probe.number_of_scanlines, bool)


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
    if isinstance(owner, Field):
        return 4 * math.prod((*owner.shape, *owner.element))
    if isinstance(owner, dict):
        return sum(_bytes_in(part, seen) for part in owner.values())
    if isinstance(owner, list | tuple):
        return sum(_bytes_in(part, seen) for part in owner)
    if type(owner).__module__.startswith(("sim.", "ultrasound.", "rehearsal.")):
        return sum(_bytes_in(part, seen) for part in vars(owner).values())
    return 0


def positions_of(solver: Solver) -> np.ndarray:
    """Present positions (n, 3) [mm], in double precision."""
    return array_of(solver.body.position).astype(float)


def distances_after_fit(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Distances (n,) [mm] of points (n, 3) from reference points after a rigid least-squares fit (Kabsch)."""
    points, reference = points - points.mean(axis=0), reference - reference.mean(axis=0)
    if len(reference) > 1:
        points = Rotation.align_vectors(reference, points)[0].apply(points)
    return np.linalg.norm(points - reference, axis=1)


# The paper's friction, and width of a cluster in radii.
FRICTION, CLUSTER_SPACING = 0.35, 3.33


def block_of_cells(side: int, cell_mm: float, shapes: list, tool: ConvexTool | None = None) -> Solver:
    """A cube from the origin on, ``side`` cells along each edge, in contact with shapes, perhaps a tool."""
    lattice = fill_block((side, side, side), cell_mm)
    body = Body(lattice.nodes)
    cube = trimesh.creation.box(bounds=[[0.0] * 3, [side * cell_mm] * 3])
    contacts = SurfaceContacts(body, lattice, *surface_points(cube, cell_mm / 2), shapes, FRICTION)
    return Solver(NeoHookean(body, lattice, contacts), tool=tool)


def block_of_particles(
    points_mm: np.ndarray, radius_mm: float, shapes: list, tool: ConvexTool | None = None
) -> Solver:
    """Particles at points (n, 3) [mm], a radius apart, in contact with shapes, of which one may be a tool."""
    rest = RestBody(points_mm, radius_mm, np.full(len(points_mm), radius_mm / 2))
    arranged, patches = group_into_patches(rest, CLUSTER_SPACING)
    body = ParticleBody(arranged)
    contacts = ShapeContacts(body, shapes, FRICTION)
    return Solver(ShapeMatching(body, patches, contacts), tool=tool)
