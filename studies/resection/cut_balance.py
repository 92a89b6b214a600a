"""Balance after a cut: beads in what remains of the embedded patient's kidney, beside finite elements that
solve the remnant alone.

Nephron has the lattice of the whole organ, of which ``remove_tissue`` takes the specimen, as
``PressedOrgan.apply_cut`` does.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from rehearsal.configuration import PRESETS, Setup
from rehearsal.resection.cut import CutSettings, cut_organ, faces_of
from scenes.anatomy import load_anatomy
from scenes.scene import EMBEDDED, PAPER, load_scene
from scenes.surfaces import translated
from sim.neo_hookean import NeoHookean
from sim.removed_tissue import RemovedTissue
from sim.solver import StepSettings
from sim.stored_arrays import stored
from studies.accuracy.bead_case import BeadCase, load_case
from studies.accuracy.bead_errors import bead_errors, null_errors
from studies.accuracy.bead_experiment import BeadExperiment
from studies.resection.planned_cuts import line_over
from ultrasound.probe_manipulator import poses_between

UNCUT = Path(__file__).parents[1] / "reference" / "embedded"
SETTINGS = CutSettings("enucleoresection", 3.0)
# Edges of the finite elements at the crater and by the transducer; the coarser mesh shows their own error.
EDGE_MM, COARSER_MM = 5.6, 7.8
STAGES = 3
BALANCE_BAR_MM = 0.15


@dataclass(frozen=True)
class CutCase:
    """A bead case of a remnant, of which ``case.organ`` is the whole organ, and what is removed from it."""

    case: BeadCase
    tissue: RemovedTissue


class CutBeadExperiment(BeadExperiment):
    """A bead experiment on an organ from which tissue is removed, before or after the whole has settled."""

    def __init__(self, cut: CutCase, setup: Setup, settles_first: bool) -> None:
        super().__init__(cut.case, setup)
        self.settles_first = settles_first
        tissue = cut.tissue
        self._organ, removed, remaining = (
            translated(surface, -self.origin)
            for surface in (cut.case.organ, tissue.removed, tissue.remaining)
        )
        self._tissue = RemovedTissue(removed, remaining, tissue.is_new)

    def prepare(self, setup: Setup) -> StepSettings:
        """Warm up, remove the tissue and warm up what remains; or the latter alone."""
        if not self.settles_first:
            self._remove()
            return super().prepare(setup)
        step, pose = super().prepare(setup), self._away()
        self._remove()
        for _ in range(setup.warm_up_steps):
            self.solver.step(step, poses_between(pose, pose, step.substeps))
        return step

    def _remove(self) -> None:
        assert isinstance(self.model, NeoHookean)
        self.model.remove_tissue(self._organ, self._tissue, [])
        self.beads.attach_again()


@dataclass(frozen=True)
class BalanceRow:
    """Errors of the beads (stages, n) [mm] in a case."""

    organ: str
    setup: Setup
    case: BeadCase
    errors: np.ndarray

    @property
    def is_within(self) -> bool:
        """Whether the mean error is within 0.15 mm at each stage."""
        return bool(self.errors.mean(axis=1).max() <= BALANCE_BAR_MM)

    def described(self) -> dict[str, object]:
        """Values for the table and the files: mean and largest error at each stage, and how far the beads
        moved since the first one in the mean.
        """
        return dict(
            organ=self.organ,
            beads=len(self.case.beads),
            depths=joined(self.case.indentation_mm),
            mean_mm=joined(self.errors.mean(axis=1)),
            max_mm=joined(self.errors.max(axis=1)),
            moved_mm=joined(null_errors(self.case).mean(axis=1)),
            within="yes" if self.is_within else "no",
        )


def joined(values: np.ndarray) -> str:
    """Values (stages,) in words."""
    return " / ".join(f"{value:.2f}" for value in values)


def balance_rows() -> tuple[list[BalanceRow], np.ndarray]:
    """The errors of the uncut kidney and of the remnant, and the distances (stages, n) [mm] of the remnant's
    beads from those of the coarser mesh.

    Taichi must be started. Raises MeshError, NotConvergedError.
    """
    setup = PRESETS["neo-hookean"]["balanced"]
    whole = load_case(UNCUT)
    arrays = ("measured", "poses", "indentation_mm", "probe_force_n")
    uncut = replace(whole, **{name: getattr(whole, name)[:STAGES] for name in arrays})
    cut, to_coarser = cut_case(uncut)
    experiments = {
        "whole": BeadExperiment(uncut, setup),
        "cut, then settled": CutBeadExperiment(cut, setup, settles_first=False),
        "settled, then cut": CutBeadExperiment(cut, setup, settles_first=True),
    }
    rows = [
        BalanceRow(name, setup, tried.case, bead_errors(tried.case, tried.run(setup).beads))
        for name, tried in experiments.items()
    ]
    return rows, to_coarser


def cut_case(uncut: BeadCase) -> tuple[CutCase, np.ndarray]:
    """The case of the embedded patient's remnant, pressed as the uncut kidney is, and the distances
    (stages, n) [mm] of its beads from those of the coarser mesh.

    Raises MeshError, NotConvergedError, ResectionError.
    """
    from studies.reference.make_reference import blue_noise, in_case_frame, pressed_beads

    anatomy, paper = load_anatomy(load_scene(EMBEDDED), EMBEDDED.parent), load_scene(PAPER)
    assert anatomy.tumour is not None
    line = line_over(anatomy.organ, anatomy.tumour, SETTINGS.margin_mm)
    cut = cut_organ(anatomy.organ, line, SETTINGS, np.asarray(anatomy.tumour.vertices))
    support_lps = load_anatomy(paper, PAPER.parent).shapes[0]
    assert isinstance(support_lps, trimesh.Trimesh)
    organ, specimen, remnant, support = (
        in_case_frame(surface, np.array(paper.gravity.direction), anatomy.organ)
        for surface in (anatomy.organ, cut.specimen, cut.remnant, support_lps)
    )
    beads, bed = blue_noise(remnant), faces_of(remnant, cut.on_remnant)
    (coarse, *_), (measured, at, force) = (
        stored(pressed_beads, remnant, bed, support, beads, edge_mm, uncut.indentation_mm)
        for edge_mm in (COARSER_MM, EDGE_MM)
    )
    poses = uncut.poses.copy()
    poses[:, :3, 3] = at
    case = replace(
        uncut, organ=organ, beads=beads, measured=measured, poses=poses, probe_force_n=-force, name="remnant"
    )
    tissue = RemovedTissue(specimen, remnant, cut.on_remnant)
    return CutCase(case, tissue), np.linalg.norm(measured - coarse, axis=2)
