"""The same bits after another start of Taichi, with any number of threads."""

import hashlib

import numpy as np
import taichi as ti
from coarse_patient import coarse_patient
from lattice_tissue import position
from test_rehearsal import LOOK
from test_solver import solver_of

from rehearsal.rehearsal import script_length_s
from sim import embedding, neo_hookean
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


def rehearsed(threads: int) -> str:
    """Hash of a pressed patient: positions, velocities, force, both images and colour Doppler."""
    ti.reset()
    start("cpu", cpu_max_num_threads=threads)
    rehearsal = coarse_patient()[0]
    case, organ, anatomy = rehearsal.case, rehearsal.organ, rehearsal.anatomy
    assert not organ.model.serial
    for step in range(20):
        rehearsal.advance(rehearsal.scripted_pose(step / 20 * script_length_s(case)))
    rehearsal.show()
    pictures = anatomy.scanner.images(anatomy.image_plane(), case.probe, *LOOK)
    colour = anatomy.scanner.doppler(pictures, "colour")
    state = organ.body.snapshot()
    arrays = state.position, state.velocity, organ.wrench(), *pictures.by_name.values(), colour
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def test_a_rehearsal_gives_the_same_bits_after_another_start_with_more_threads(arrays_stored, monkeypatch):
    for module in (neo_hookean, embedding):
        monkeypatch.setattr(module, "is_too_small", lambda *counts: False)
    assert rehearsed(2) == rehearsed(4)
    ti.reset()
