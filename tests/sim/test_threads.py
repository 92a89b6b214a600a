"""The same bits after another start of Taichi, with any number of threads."""

import hashlib

import numpy as np
import taichi as ti
from coarse_patient import coarse_patient
from test_rehearsal import LOOK
from test_solver import position, solver_of

from sim.device import start
from sim.fields import array_of
from sim.shapes import ConvexTool, Plane
from sim.solver import StepSettings


def pressed(mesh, threads: int) -> bytes:
    start("cpu", cpu_max_num_threads=threads)
    tool = ConvexTool.cuboid(np.array([10.0, 6.0, 10.0]))
    floor = Plane(np.array([0.0, 0.0, 1.0]), -12.0)
    solver = solver_of(mesh, [floor, tool], tool=tool, pairs=True, serial=False)
    poses = np.tile(np.eye(4), (4, 1, 1))
    for step in range(20):
        poses[:, 2, 3] = 17.0 - 0.3 * (step + np.arange(4) / 3)
        solver.step(StepSettings(), poses)
    return position(solver).tobytes() + array_of(solver.body.velocity).tobytes()


def test_self_contact_gives_the_same_bits_for_any_number_of_threads(ball):
    assert pressed(ball, 1) == pressed(ball, 2)
    ti.reset()


def test_two_runs_of_a_scene_give_the_same_bits():
    digests = []
    for _ in range(2):
        start("cpu")
        rehearsal = coarse_patient()[0]
        for step in range(20):
            rehearsal.advance(rehearsal.scripted_pose(step / 20 * rehearsal.script_length_s()))
        state = rehearsal.body.snapshot()
        pictures = rehearsal.scanner.images(rehearsal.image_plane(), rehearsal.probe, *LOOK)
        digests.append(
            hashlib.sha256(
                state.position.tobytes()
                + state.velocity.tobytes()
                + b"".join(p.tobytes() for p in pictures.values())
            ).hexdigest()
        )
    assert digests[0] == digests[1]
    ti.reset()
