"""Convergence study: the beads of a case with one numerical setting changed at a time."""

from collections.abc import Iterator

import numpy as np

from rehearsal.configuration import Setup, SetupError, option_of
from rehearsal.result_files import rounded
from studies.accuracy.bead_experiment import BeadExperiment

# Sizes that can be changed by a third.
LEAST_MM, MOST_MM = 0.75, 15.0
MOST_ITERATIONS = 500
HEAD = "Convergence study: displacement of the beads by a change, mean at each stage, mm"


def changes_of(setup: Setup) -> dict[str, Setup]:
    """The changed setups by name; in a converged solution none of them moves the beads.

    With half the time step the press has the same duration. Raises SetupError where a changed value is out of
    range.
    """
    pieces = setup.tissue.piece_name
    if not LEAST_MM <= setup.size_mm <= MOST_MM:
        raise SetupError(
            f"--check: {pieces} a third larger and smaller need {option_of(setup.tissue.size_key)} from "
            f"{LEAST_MM:g} to {MOST_MM:g}"
        )
    if setup.iterations > MOST_ITERATIONS:
        raise SetupError(f"--check: twice the iterations needs --iterations of {MOST_ITERATIONS} at most")
    halved = setup.but(
        time_step_s=setup.solver.time_step_s / 2,
        warm_up_steps=2 * setup.warm_up_steps,
        stage_steps=2 * setup.stage_steps,
    )
    sizes = {
        f"{pieces} a third {word}": setup.sized(round(share * setup.size_mm, 3))
        for word, share in (("larger", 4 / 3), ("smaller", 2 / 3))
    }
    return {
        "half the time step": halved,
        "twice the iterations": setup.but(iterations=2 * setup.iterations),
        **sizes,
    }


def moved(experiment: BeadExperiment, setup: Setup, beads: np.ndarray) -> Iterator[dict]:
    """Displacements of the beads by each change, a row of ``validate --json`` each.

    ``experiment`` is built with ``setup``, which gave ``beads`` (stages, n, 3) [mm].
    """
    for name, changed in changes_of(setup).items():
        same = changed.size_mm == setup.size_mm
        other = experiment if same else BeadExperiment(experiment.case, changed)
        apart = np.linalg.norm(other.run(changed).beads - beads, axis=2)
        yield dict(
            change=name,
            moved_mean_mm=[rounded(mean) for mean in apart.mean(axis=1)],
            moved_max_mm=rounded(apart.max()),
        )


def line(row: dict) -> str:
    """One change as a line."""
    means = " / ".join("-" if mean is None else f"{mean:.3f}" for mean in row["moved_mean_mm"])
    most = row["moved_max_mm"]
    return f"  {row['change']:26s}  {means}, at most {'-' if most is None else f'{most:.2f}'}"
