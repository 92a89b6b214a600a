"""Make the reference: the embedded patient's kidney on its support, solved on two meshes; and the same of a
kidney with a crater, solved once.
"""

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import igl
import numpy as np
import trimesh
from skfem import MeshTet2

from scenes.surfaces import signed_distance_from
from studies.reference.fem_press import FemExperiment, FemPress
from studies.reference.fem_solid import FemMaterial
from studies.reference.reference_case import ReferenceCase
from studies.reference.smooth_obstacles import RoundedBox
from studies.reference.tetrahedral_mesh import tetrahedra

BEADS, BEAD_DEPTH_MM, BEAD_SEED, CANDIDATES_A_BEAD = 45, 3.0, 20160705, 10
# Edges far from the transducer are longer; Mmg makes them shorter where the surface is round.
GROWTH, BULK_OF_NEAR = 1.0, 5.0
COARSER = 1.4


def size_around(
    kidney: trimesh.Trimesh, press: FemPress, near_mm: float
) -> Callable[[np.ndarray], np.ndarray]:
    """The length (n,) of edges [mm] at points (n, 3): ``near_mm`` where the transducer touches the kidney,
    and longer away from it.
    """
    box = RoundedBox(np.array(press.size_mm), press.edge_mm)
    beside = np.abs(kidney.vertices[:, :2] - press.over_mm) - np.array(press.size_mm[:2]) / 2
    top = kidney.vertices[(beside <= 0).all(axis=1), 2].max()
    touching = np.array([*press.over_mm, top + press.size_mm[2] / 2])

    def wanted(points: np.ndarray) -> np.ndarray:
        away = np.maximum(box.gap(points - touching) - near_mm, 0.0)
        return np.minimum(near_mm + GROWTH * away, BULK_OF_NEAR * near_mm)

    return wanted


def make_reference(
    organ: trimesh.Trimesh,
    mould: trimesh.Trimesh,
    gravity: np.ndarray,
    near_mm: float,
    report: Callable[[str], None],
) -> ReferenceCase:
    """The case of the embedded patient, solved on a mesh and, for the discretisation error, on a coarser one.

    Args:
        organ: its surface in LPS [mm].
        mould: the support's surface in LPS [mm].
        gravity: its direction in LPS, shape (3,).
        near_mm: edges by the transducer of the mesh that the case is made of.
        report: called with each line of progress.

    Raises:
        MeshError: no mesh fills the organ.
        NotConvergedError: no equilibrium was found.
    """
    kidney, support = in_case_frame(organ, gravity, organ), in_case_frame(mould, gravity, organ)
    beads = blue_noise(kidney)
    coarse = solved(kidney, support, beads, COARSER * near_mm, report)
    case = solved(kidney, support, beads, near_mm, report)
    return replace(case, to_coarser_mm=np.linalg.norm(case.moved_beads - coarse.moved_beads, axis=2))


def solved(
    kidney: trimesh.Trimesh,
    support: trimesh.Trimesh,
    beads: np.ndarray,
    near_mm: float,
    report: Callable[[str], None],
) -> ReferenceCase:
    """The experiment on one mesh; surfaces and beads (n, 3) in the frame of the files [mm]."""
    start = perf_counter()
    press = FemPress()
    mesh = tetrahedra(kidney, size_around(kidney, press, near_mm))
    report(f"{mesh.nelements} tetrahedra, {mesh.doflocs.shape[1]} nodes")
    experiment = FemExperiment(mesh, support, FemMaterial(), press, report)
    stages = list(experiment.stages())
    figures = {
        "edge_bulk_mm": BULK_OF_NEAR * near_mm,
        "edge_near_probe_mm": near_mm,
        "newton_residual_max": experiment.worst_residual,
        "time_s": round(perf_counter() - start, 1),
    }
    same = np.zeros((len(stages), len(beads)))
    return ReferenceCase(kidney, support, beads, experiment.solid, press, stages, figures, same)


def in_case_frame(surface: trimesh.Trimesh, gravity: np.ndarray, organ: trimesh.Trimesh) -> trimesh.Trimesh:
    """A surface in the files' frame: z against gravity, x along the organ, the organ's centre of mass 0."""
    up = -np.asarray(gravity, float) / np.linalg.norm(gravity)
    length = np.linalg.svd(organ.vertices - organ.vertices.mean(axis=0), full_matrices=False)[2][0]
    x = length - (length @ up) * up
    x *= np.sign(x[np.argmax(np.abs(x))]) / np.linalg.norm(x)
    axes = np.array([x, np.cross(up, x), up])
    return trimesh.Trimesh((surface.vertices - organ.center_mass) @ axes.T, surface.faces, process=False)


def blue_noise(surface: trimesh.Trimesh, count: int = BEADS, depth_mm: float = BEAD_DEPTH_MM) -> np.ndarray:
    """Points inside a surface, far from each other, shape (count, 3) [mm].

    Mitchell's best candidate (*Spectrally optimal sampling for distribution ray tracing*, SIGGRAPH 1991): of
    ever more random points, the one that is farthest from those chosen. The seed is fixed.
    """
    rng = np.random.default_rng(BEAD_SEED)
    chosen = np.empty((0, 3))
    while len(chosen) < count:
        low, high = surface.bounds
        points = rng.uniform(low, high, size=(CANDIDATES_A_BEAD * (len(chosen) + 1), 3))
        points = points[signed_distance_from(surface, points) <= -depth_mm]
        if len(points):
            apart = np.linalg.norm(points[:, None] - chosen[None], axis=2).min(axis=1, initial=np.inf)
            chosen = np.vstack([chosen, points[apart.argmax()]])
    return chosen


def pressed_beads(
    organ: trimesh.Trimesh,
    bed: trimesh.Trimesh,
    support: trimesh.Trimesh,
    beads: np.ndarray,
    near_mm: float,
    indentations_mm: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Beads in an organ with a crater; it takes half an hour for edges of 4 mm: store the result.

    Args:
        organ: its closed surface, in the frame of ``in_case_frame`` [mm].
        bed: the faces of the crater, which have edges of ``near_mm`` as the tissue by the transducer has.
        support: closed surface [mm].
        beads: places at rest [mm], shape (n, 3).
        near_mm: length of the edges there.
        indentations_mm: of each stage, the first 0, shape (stages,).

    Returns:
        Beads at each stage [mm], shape (stages, n, 3); the transducer's centre [mm] and its force on the
        tissue [N], shape (stages, 3).

    Raises:
        MeshError: no mesh fills the organ.
        NotConvergedError: no equilibrium was found.
    """
    press = FemPress(indentations_mm=tuple(indentations_mm.tolist()))
    experiment = FemExperiment(_mesh(organ, bed, press, near_mm), support, FemMaterial(), press)
    stages = list(experiment.stages())
    at_beads = experiment.solid.basis.probes(beads.T)
    return (
        np.stack([beads + at_beads @ stage.displacement_mm for stage in stages]),
        np.stack([stage.position_mm for stage in stages]),
        np.stack([stage.probe_force_n for stage in stages]),
    )


def _mesh(organ: trimesh.Trimesh, bed: trimesh.Trimesh, press: FemPress, near_mm: float) -> MeshTet2:
    by_press = size_around(organ, press, near_mm)
    vertices, faces = np.asarray(bed.vertices, float), np.asarray(bed.faces, np.int64)

    def wanted(points: np.ndarray) -> np.ndarray:
        from_bed = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0])
        return np.minimum(by_press(points), np.maximum(from_bed, near_mm))

    return tetrahedra(organ, wanted)
