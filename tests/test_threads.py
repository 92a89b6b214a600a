"""Of particles that touch each other, too, no bit depends on how many threads there are."""

import numpy as np
import pytest
import taichi as ti
from test_solver import position, solver_of

from sim.device import start
from sim.shapes import ConvexTool, Plane
from sim.solver import StepSettings


def pressed(mesh, threads: int, serial: bool) -> bytes:
    start("cpu", cpu_max_num_threads=threads)
    tool = ConvexTool.cuboid(np.array([10.0, 6.0, 10.0]))
    floor = Plane(np.array([0.0, 0.0, 1.0]), -12.0)
    solver = solver_of(mesh, [floor, tool], tool=tool, pairs=True, serial=serial)
    poses = np.tile(np.eye(4), (4, 1, 1))
    for step in range(20):
        poses[:, 2, 3] = 17.0 - 0.3 * (step + np.arange(4) / 3)
        solver.step(StepSettings(), poses)
    return position(solver).tobytes() + solver.body.velocity.to_numpy().tobytes()


@pytest.mark.parametrize("serial", [True, False])
def test_pairs_give_the_same_bits_whatever_the_threads(ball, serial):
    assert pressed(ball, 1, serial) == pressed(ball, 2, serial)
    ti.reset()
