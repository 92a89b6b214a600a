"""How much of a case's result is its settings': the beads once more, with one setting changed at a time."""

from collections.abc import Iterator

import numpy as np

from rehearsal.configuration import Setup, SetupError, option_of
from rehearsal.result_files import rounded
from studies.accuracy.bead_experiment import BeadExperiment

# Sizes of which a third more and less can be built.
LEAST_MM, MOST_MM = 0.75, 15.0
MOST_ITERATIONS = 500
HEAD = "What the settings change: how far the beads move, mean at each stage, mm"


def changes_of(setup: Setup) -> dict[str, Setup]:
    """One setup for each setting that is changed, by name; where only the material counts, none moves the beads.

    The press takes as long with half the time step. Raises SetupError where a changed value would be out of range.
    """
    things = setup.tissue.PIECES
    if not LEAST_MM <= setup.size_mm <= MOST_MM:
        raise SetupError(
            f"--check: {things} a third larger and smaller need {option_of(setup.tissue.SIZE)} from {LEAST_MM:g} to {MOST_MM:g}"
        )
    if setup.iterations > MOST_ITERATIONS:
        raise SetupError(f"--check: twice the iterations needs --iterations of {MOST_ITERATIONS} at most")
    halved = setup.but(
        time_step_s=setup.solver.time_step_s / 2,
        warm_up_steps=2 * setup.warm_up_steps,
        stage_steps=2 * setup.stage_steps,
    )
    sizes = {
        f"{things} a third {word}": setup.sized(round(share * setup.size_mm, 3))
        for word, share in (("larger", 4 / 3), ("smaller", 2 / 3))
    }
    return {
        "half the time step": halved,
        "twice the iterations": setup.but(iterations=2 * setup.iterations),
        **sizes,
    }


def moved(experiment: BeadExperiment, setup: Setup, beads: np.ndarray) -> Iterator[dict]:
    """What each change moves, as ``validate --json`` has it.

    Args:
        experiment: built with ``setup``.
        setup: that ``beads`` were found with.
        beads: their places, shape (stages, n, 3) [mm].

    Yields:
        ``change``, its name; ``moved_mean_mm``, a number a stage; ``moved_max_mm``.
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
    """One change for the terminal."""
    means = " / ".join("-" if mean is None else f"{mean:.3f}" for mean in row["moved_mean_mm"])
    most = row["moved_max_mm"]
    return f"  {row['change']:26s}  {means}, at most {'-' if most is None else f'{most:.2f}'}"
