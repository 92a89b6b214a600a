"""The scripted press with given values of what is not known, in a worker: what the surgeon sees and feels."""

from dataclasses import dataclass

import numpy as np

from rehearsal.measurements.tumour_measurements import measure
from rehearsal.rehearsal import Rehearsal
from rehearsal.worker_processes import built_once
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from studies.harness import all_scanlines, rehearsal_of
from studies.uncertainty.unknowns import set_values

# Measured at each depth; those of the tumour only where there is one. Its centroid follows.
QUANTITIES = ("tumour_shift_mm", "to_tumour_mm", "tumour_depth_mm", "margin_mm", "force_n", "compression_mm")


@dataclass(frozen=True)
class PressProblem:
    """A scene and its anatomy, whose press is computed; ``digest`` tells problems apart."""

    scene: Scene
    anatomy: LoadedAnatomy
    digest: str


def press_outcome(problem: PressProblem, values: dict[str, float]) -> np.ndarray:
    """The quantities and the tumour's centroid (depths, 9) [mm, N] of a press with these values.

    NaN for what there is not.
    """
    return _press(built_once(problem.digest, lambda: rehearsal_of(problem.scene, problem.anatomy)), values)


def _press(rehearsal: Rehearsal, values: dict[str, float]) -> np.ndarray:
    """Settle from the stress-free shape, then press by stages, to the same poses for all values."""
    set_values(rehearsal, values)
    case, organ, anatomy = rehearsal.case, rehearsal.organ, rehearsal.anatomy
    press, touches = case.press, all_scanlines(case.probe)
    organ.solver.restart()
    organ.divergence_check.set_initial_state()
    organ.pose = rehearsal.pose_at_depth(-200.0)
    organ.come_to_rest()
    organ.pose = rehearsal.pose_at_depth(0.0)
    step_s = organ.settings.time_step_s
    outcomes = []
    for stage in range(len(press.indentations_mm)):
        for step in range(press.stage_steps):
            rehearsal.advance(rehearsal.scripted_pose((stage * press.stage_steps + step + 1) * step_s))
        rehearsal.show()
        found = measure(anatomy, case.probe, touches)
        quantities = [getattr(found, name) for name in QUANTITIES]
        tumour = anatomy.tumour_vertices
        centroid = tumour.mean(axis=0) if len(tumour) else np.full(3, np.nan)
        outcomes.append([*(np.nan if q is None else q for q in quantities), *centroid])
    return np.array(outcomes, float)
