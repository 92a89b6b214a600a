"""Blocks without a scene come to rest on a floor at the height of their size."""

from dataclasses import replace

import numpy as np
import pytest

from sim.fields import array_of
from sim.neo_hookean import LATTICE_SETTINGS
from sim.shapes import Plane
from sim.solver import StepSettings
from studies.harness import block_of_cells, block_of_particles

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), -1.0)


def lowest_mm(solver, settings: StepSettings) -> float:
    """Where the lowest point is after a second under gravity."""
    settings.gravity = (0.0, 0.0, -9810.0)
    for _ in range(60):
        solver.step(settings)
    return float(array_of(solver.body.position)[:, 2].min())


def test_a_particle_of_a_block_is_half_a_radius_thick_to_either_side(one_device):
    points = 2.0 * np.indices((3, 3, 3)).reshape(3, -1).T + [0.0, 0.0, 1.0]
    # A hundredth of a diameter: what contacts leave.
    assert lowest_mm(block_of_particles(points, 2.0, [FLOOR]), StepSettings()) == pytest.approx(0.0, abs=0.02)


def test_a_block_of_cells_rests_on_its_nodes(one_device):
    solver = block_of_cells(2, 4.0, [FLOOR])
    assert np.ptp(solver.body.rest_points, axis=0) == pytest.approx([8.0] * 3)
    assert lowest_mm(solver, replace(LATTICE_SETTINGS)) == pytest.approx(-1.0, abs=0.02)
