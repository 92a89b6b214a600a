"""Beads in an organ that has a crater, at rest in its support and pressed: solved by finite elements,
once.
"""

import igl
import numpy as np
import trimesh
from skfem import MeshTet2

from sim.stored_arrays import stored
from studies.reference.fem_press import FemExperiment, FemPress
from studies.reference.fem_solid import FemMaterial
from studies.reference.make_reference import size_around
from studies.reference.tetrahedral_mesh import tetrahedra


def pressed_beads(
    organ: trimesh.Trimesh,
    bed: trimesh.Trimesh,
    support: trimesh.Trimesh,
    beads: np.ndarray,
    near_mm: float,
    indentations_mm: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve, or read what was solved before: it takes half an hour for edges of 4 mm.

    Args:
        organ: its closed surface, in the frame of ``make_reference.in_case_frame`` [mm].
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
    moved, at, force = stored(_solved, organ, bed, support, beads, near_mm, np.asarray(indentations_mm))
    return moved, at, force


def _solved(
    organ: trimesh.Trimesh,
    bed: trimesh.Trimesh,
    support: trimesh.Trimesh,
    beads: np.ndarray,
    near_mm: float,
    indentations_mm: np.ndarray,
) -> tuple[np.ndarray, ...]:
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
