"""The same bits after another start of Taichi, with any number of threads."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
import taichi as ti
from test_rehearsal import LOOK, phantom
from test_solver import position, solver_of

from rehearsal.rehearsal import Rehearsal
from scenes.anatomy import Grid, load_anatomy
from sim.device import start
from sim.fields import array_of
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
    return position(solver).tobytes() + array_of(solver.body.velocity).tobytes()


@pytest.mark.parametrize("serial", [True, False])
def test_self_contact_gives_the_same_bits_for_any_number_of_threads(ball, serial):
    assert pressed(ball, 1, serial) == pressed(ball, 2, serial)
    ti.reset()


def thinned(grid: Grid) -> Grid:
    """Every other voxel each way."""
    half = np.diag([0.5, 0.5, 0.5, 1.0])
    return Grid(np.ascontiguousarray(grid.voxels[::2, ::2, ::2]), half @ grid.index_from_mm)


def test_two_runs_of_a_scene_give_the_same_bits():
    scene, folder = phantom()
    scene = scene.model_copy(update={"press": scene.press.model_copy(update={"warm_up_steps": 20})})
    whole = load_anatomy(scene, folder)
    anatomy = replace(whole, ct=thinned(whole.ct), labels=thinned(whole.labels))
    digests = []
    for _ in range(2):
        start("cpu")
        rehearsal = Rehearsal(scene, anatomy)
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
