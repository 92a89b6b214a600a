"""Samples of the parameters, and what the outcomes say: bands, and which parameter matters most (Sobol's
indices by SALib).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from SALib.analyze import sobol as sobol_indices
from SALib.sample import sobol as sobol_sample

from studies.uncertainty.press_outcomes import QUANTITIES
from studies.uncertainty.unknowns import Unknown

SEED = 20161130
BAND = (5.0, 50.0, 95.0)
POSITION = "tumour_position_mm"
# Quantities whose 90 % band is narrower than this, in mm or N, depend on nothing that matters.
LEAST_BAND = 0.05


def samples_of(unknowns: Sequence[Unknown], base: int) -> list[dict[str, float]]:
    """Quasi-random values (Saltelli's scheme on Sobol's sequence): ``base`` times the number of parameters
    and two.
    """
    shares = sobol_sample.sample(_problem(unknowns), base, calc_second_order=False, seed=SEED)
    return [
        {each.name: float(each.value(share)) for each, share in zip(unknowns, row, strict=True)}
        for row in shares
    ]


def count_of(unknowns: Sequence[Unknown], base: int) -> int:
    """The number of samples."""
    return base * (len(unknowns) + 2)


def bands_of(outcomes: np.ndarray) -> list[dict[str, Any]]:
    """At each depth the band of each quantity: 5th, 50th and 95th percentile, from outcomes (samples,
    depths, 9).
    """
    rows = []
    for depth in range(outcomes.shape[1]):
        values = outcomes[:, depth]
        known = {name: values[:, n] for n, name in enumerate(QUANTITIES) if np.isfinite(values[:, n]).all()}
        centroid = values[:, len(QUANTITIES) :]
        if np.isfinite(centroid).all():
            known[POSITION] = np.linalg.norm(centroid - np.median(centroid, axis=0), axis=1)
        rows.append({name: _band(column) for name, column in known.items()})
    return rows


def _band(values: np.ndarray) -> dict[str, float]:
    low, median, high = np.percentile(values, BAND)
    return dict(low=round(low, 4), median=round(median, 4), high=round(high, 4))


def indices_of(unknowns: Sequence[Unknown], outcomes: np.ndarray) -> dict[str, dict[str, dict[str, float]]]:
    """Total Sobol indices of each quantity at the greatest depth, by parameter, with their 95 %
    confidence.
    """
    found = {}
    for n, name in enumerate(QUANTITIES):
        values = outcomes[:, -1, n]
        if not np.isfinite(values).all() or np.ptp(np.percentile(values, BAND)) < LEAST_BAND:
            continue
        result = sobol_indices.analyze(
            _problem(unknowns), values, calc_second_order=False, print_to_console=False, seed=SEED
        )
        found[name] = {
            each.name: dict(total=round(float(total), 4), confidence=round(float(confidence), 4))
            for each, total, confidence in zip(unknowns, result["ST"], result["ST_conf"], strict=True)
        }
    return found


def _problem(unknowns: Sequence[Unknown]) -> dict[str, Any]:
    return dict(
        num_vars=len(unknowns),
        names=[each.name for each in unknowns],
        bounds=[[0.0, 1.0]] * len(unknowns),
    )
