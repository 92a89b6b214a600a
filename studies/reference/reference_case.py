"""The reference as a case folder, which `validate` reads.

The format is version 1 of what studies/accuracy/bead_case.py reads: case.toml, kidney.stl, support.stl,
beads.csv, and the solution in result.npz; lengths mm, forces N, z up, the kidney's centre of mass at the
origin.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import tomli_w
import trimesh

from scenes.patients.organ_support import least_gap
from studies.reference.fem_press import FRICTION, GRAVITY_M_S2, FemPress, FemStage
from studies.reference.fem_solid import FemSolid

# scikit-fem has the middles of edges 01 12 02 03 13 23, the case folder 01 02 03 12 13 23.
FILE_ORDER = [0, 1, 2, 3, 4, 6, 7, 5, 8, 9]
DIGITS = 6


@dataclass(frozen=True)
class ReferenceCase:
    """A solved experiment and its inputs; lengths mm, in the frame of the files."""

    kidney: trimesh.Trimesh
    support: trimesh.Trimesh
    beads: np.ndarray  # stress-free, shape (beads, 3)
    solid: FemSolid
    press: FemPress
    stages: list[FemStage]
    mesh: dict  # for case.toml's [fem]
    to_coarser_mm: np.ndarray  # distance of the beads from those of a coarser mesh, shape (stages, beads)

    @cached_property
    def moved_beads(self) -> np.ndarray:
        """Positions of the beads at each stage [mm], shape (stages, beads, 3)."""
        at_beads = self.solid.basis.probes(self.beads.T)
        return np.stack([self.beads + at_beads @ stage.displacement_mm for stage in self.stages])

    def write(self, folder: Path) -> None:
        """Write the five files into an existing folder. Raises OSError."""
        self.kidney.export(folder / "kidney.stl")
        self.support.export(folder / "support.stl")
        self._write_beads(folder / "beads.csv")
        self._write_result(folder / "result.npz")
        (folder / "case.toml").write_text(tomli_w.dumps(self.description()), "utf-8")

    def summary(self) -> str:
        """The solution and its discretisation error."""
        lines = [
            f"mesh      {self.solid.mesh.nelements} tetrahedra of 10 nodes, {len(self.solid.rest)} nodes; "
            f"{self.mesh['time_s']:.0f} s"
        ]
        for stage, beads, apart in zip(self.stages, self.moved_beads, self.to_coarser_mm, strict=True):
            moved = np.linalg.norm(beads - self.moved_beads[0], axis=1).mean()
            lines.append(
                f"{stage.indentation_mm:5.2f} mm  beads moved {moved:.2f} mm in the mean, press "
                f"{abs(stage.probe_force_n[2]):.2f} N; difference to a coarser mesh {apart.mean():.3f} mm, "
                f"{apart.max():.3f} at most"
            )
        return "\n".join(lines)

    def description(self) -> dict:
        """Contents of case.toml."""
        material, moved = self.solid.material, self.moved_beads
        weight = np.linalg.norm(self.solid.weight(np.array([0, 0, -GRAVITY_M_S2])).sum(axis=0))
        sag = np.linalg.norm(moved[0] - self.beads, axis=1)
        return {
            "name": "phantom",
            "note": "embedded patient of this project, straight central press",
            "format_version": 1,
            "units": {
                "length": "mm",
                "force": "N",
                "pressure": "kPa",
                "density": "kg/m^3",
                "acceleration": "m/s^2",
            },
            "gravity": {"g": GRAVITY_M_S2, "direction": [0.0, 0.0, -1.0]},
            "material": {
                "model": "compressible neo-Hookean, W = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2",
                "young_kPa": material.young_kpa,
                "poisson": material.poisson,
                "density": material.density_kg_m3,
                "weight_N": _rounded(weight / 1000),
            },
            "contact": {
                "friction_coefficient": FRICTION,
                "friction_on_support": True,
                "friction_on_probe": True,
                "law": "Coulomb, penalty-regularised",
                "support": "rigid, fixed, frame of kidney.stl",
                "support_min_clearance_at_rest_mm": _rounded(least_gap(self.support, self.kidney)),
            },
            "files": {
                "kidney": "kidney.stl",
                "support": "support.stl",
                "beads": "beads.csv",
                "fem": "result.npz",
            },
            "probe": {
                "shape": "cuboid",
                "size_mm": list(self.press.size_mm),
                "edge_radius_mm": self.press.edge_mm,
                "press_direction": [0.0, 0.0, -1.0],
                "rotation": np.eye(3).tolist(),
                "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0],
                "convention": "position is the centre of the cuboid; world = position + rotation * local; "
                "size_mm are the full local x, y, z lengths",
            },
            "stage": [self._stage(index, moved[index] - moved[0]) for index in range(len(self.stages))],
            "stress_free": {
                "meaning": "kidney.stl and beads x,y,z: no load, before gravity; stage 0: gravity "
                "equilibrium "
                "in the support, probe just touching",
                "bead_sag_mean_mm": _rounded(sag.mean()),
                "bead_sag_max_mm": _rounded(sag.max()),
            },
            "fem": {
                "element": "10-node tetrahedra",
                "tets": self.solid.mesh.nelements,
                "nodes": len(self.solid.rest),
                "newton_residual_at_stages_max": max(stage.residual for stage in self.stages),
                "min_det_F": _rounded(
                    min(self.solid.least_volume_ratio(s.displacement_mm) for s in self.stages)
                ),
                "stage_volume_ratio": [
                    _rounded(self.solid.volume_ratio(s.displacement_mm)) for s in self.stages
                ],
                **self.mesh,
                "bead_difference_to_coarser_mesh_mean_mm": _rounded(self.to_coarser_mm.mean(axis=1)),
                "bead_difference_to_coarser_mesh_max_mm": _rounded(self.to_coarser_mm.max(axis=1)),
            },
            "provenance": {
                "kind": "analytic",
                "formula": "scenes/phantom/kidney.py of Nephron, surface and support as its import makes "
                "them",
                "licence": "no third-party data",
            },
        }

    def _stage(self, index: int, from_first: np.ndarray) -> dict:
        stage, lengths = self.stages[index], np.linalg.norm(from_first, axis=1)
        return {
            "index": index,
            "indentation_mm": stage.indentation_mm,
            "position": _rounded(stage.position_mm),
            "probe_force_N": _rounded(stage.probe_force_n),
            "support_force_N": _rounded(stage.support_force_n),
            "bead_displacement_from_stage0_mean_mm": _rounded(lengths.mean()),
            "bead_displacement_from_stage0_max_mm": _rounded(lengths.max()),
        }

    def _write_beads(self, path: Path) -> None:
        names = [f"{axis}{stage}" for stage in ("", *range(len(self.stages))) for axis in "xyz"]
        places = (
            np.concatenate([self.beads[None], self.moved_beads]).swapaxes(0, 1).reshape(len(self.beads), -1)
        )
        rows = np.column_stack([np.arange(len(places)), places])
        formats = ["%d", *["%.4f"] * len(names)]
        np.savetxt(path, rows, formats, ",", header=",".join(["id", *names]), comments="", encoding="utf-8")

    def _write_result(self, path: Path) -> None:
        mesh = self.solid.mesh
        faces = mesh.boundary_facets()
        surface = trimesh.Trimesh(mesh.p.T, mesh.facets[:, faces].T, process=False)
        trimesh.repair.fix_normals(surface)
        np.savez_compressed(
            path,
            nodes=self.solid.rest,
            tets10=self.solid.basis.element_dofs.T[:, FILE_ORDER].astype(np.int32),
            displacement=np.stack([stage.displacement_mm for stage in self.stages]),
            surface_faces=np.asarray(surface.faces, np.int32),
            surface_nodes=np.unique(self.solid.basis.get_dofs(faces).all()).astype(np.int32),
            stage_indentation=np.array([stage.indentation_mm for stage in self.stages]),
        )


def _rounded(value):
    """A number or an array for TOML, to a nanometre or a micronewton."""
    return np.round(np.asarray(value, float), DIGITS).tolist()
