"""The tissue's force on the probe: in each step, for a haptic device, and in the session's file."""

import json
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_bead_case import briefly, small_anatomy

from rehearsal.case import case_of
from rehearsal.loop.command import Move
from rehearsal.loop.frame import Step
from rehearsal.measurements.tumour_measurements import penetration_of
from rehearsal.notices import Notices
from rehearsal.pressed_organ import COUPLING_N_MM, MOST_PENETRATION_MM, PressedOrgan, within_force
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.packed_arrays import unpack_wrenches
from rehearsal.sessions.recorder import SessionRecorder, header_of
from scenes.scene import with_options
from sim.body import BodyState
from ultrasound.probe_manipulator import array_face_centre

pytestmark = pytest.mark.usefixtures("arrays_stored")


@pytest.fixture(scope="module")
def built(one_device) -> Rehearsal:
    anatomy = small_anatomy()
    return Rehearsal(case_of(with_options(briefly(60), {"tissue.cell_mm": 4.0}), anatomy), anatomy)


@pytest.fixture
def rehearsal(built) -> Iterator[Rehearsal]:
    built.reset()
    yield built
    built.organ.on_wrench = None


def pressed(rehearsal: Rehearsal, depth_mm: float, steps: int = 40) -> list[Step]:
    """The steps in which the probe moves to a depth."""
    depths = depth_mm * np.arange(1, steps + 1) / steps
    return rehearsal.do(*(Move(pose=rehearsal.pose_at_depth(depth)) for depth in depths)).steps


def test_the_tissue_pushes_the_probe_back_along_its_axis(rehearsal):
    steps = pressed(rehearsal, 3.0)
    force = np.array([step.wrench[:3] for step in steps])
    pose, height = rehearsal.frame.pose, rehearsal.case.size_mm[2]
    out = pose[:3, 2]
    assert force[-1] @ out > 0.1 and (np.diff(force[15::6] @ out) > 0).all()
    assert np.linalg.norm(force[-1] - (force[-1] @ out) * out) < 0.3 * force[-1] @ out
    assert (rehearsal.frame.wrench == steps[-1].wrench).all()
    # About the centre of the array face: the press is central, so that the lever is short.
    assert np.linalg.norm(steps[-1].wrench[3:]) < 3.0 * np.linalg.norm(force[-1])
    assert np.linalg.norm(array_face_centre(pose, height) - pose[:3, 3]) == pytest.approx(height / 2)


def test_without_contact_there_is_no_force(rehearsal):
    (step,) = pressed(rehearsal, -20.0, 1)
    assert (step.wrench == 0).all()


def test_a_haptic_device_is_called_after_each_step(rehearsal):
    called: list[tuple[np.ndarray, np.ndarray]] = []
    rehearsal.organ.on_wrench = lambda pose, wrench: called.append((pose, wrench))
    steps = pressed(rehearsal, 2.0, 10)
    assert len(called) == 10
    for (pose, wrench), step in zip(called, steps, strict=True):
        assert pose is step.pose and wrench is step.wrench


def test_a_model_whose_contacts_have_no_forces_has_no_wrench(one_device):
    scene = with_options(briefly(5), {"tissue.radius_mm": 3.3})
    organ = PressedOrgan(case_of(scene, small_anatomy()))
    organ.on_wrench = lambda *_: pytest.fail("called without a force")
    assert organ.timed_step(organ.pose)[1] is None


def test_the_sessions_file_has_the_force_of_every_step(rehearsal, tmp_path):
    header = header_of(rehearsal.case, small_anatomy(), "cpu", True, 1 / 60, None)
    recorder = SessionRecorder(tmp_path / "session", header, Notices())
    steps = pressed(rehearsal, 3.0, 90)
    recorder.observe(rehearsal.frame)
    recorder.close({})
    lines = [json.loads(line) for line in recorder.path.read_text("utf-8").splitlines()]
    found = np.concatenate([unpack_wrenches(line["wrenches"]) for line in lines if "wrenches" in line])
    assert (found == np.array([step.wrench for step in steps], np.float32)).all()


def test_the_probe_presses_with_no_more_than_the_limit_however_deep_the_hand_goes(one_device):
    anatomy, limit_n = small_anatomy(), 1.0
    scene = with_options(briefly(60), {"tissue.cell_mm": 4.0, "transducer.force_limit_n": limit_n})
    rehearsal = Rehearsal(case_of(scene, anatomy), anatomy)
    steps = pressed(rehearsal, 8.0, 60)
    held = rehearsal.do(*[Move(pose=rehearsal.pose_at_depth(8.0))] * 60).steps
    force_n = [float(np.linalg.norm(step.wrench[:3])) for step in steps + held]
    # A step moves on by at most a fifth of a millimetre for each newton that is left.
    assert max(force_n) < 1.1 * limit_n and force_n[-1] == pytest.approx(limit_n, rel=0.02)
    assert rehearsal.frame.lag_mm > 1.0
    # With the hand it comes out again.
    out = pressed(rehearsal, -2.0, 30)[-1]
    assert (out.wrench == 0).all() and (out.pose == out.hand).all()


def test_a_goal_is_moved_by_what_the_force_has_left():
    pose, goal = np.eye(4), np.eye(4)
    goal[:3, 3] = 0.5, 0.0, -3.0
    free = within_force(pose, goal, np.zeros(3), 10.0)
    assert free is goal and within_force(pose, goal, np.array([0, 0, 0.1]), 100.0) is goal
    # 2 N are left of 10 N: 0.4 mm against the force; the rest of the motion stays.
    near = within_force(pose, goal, np.array([0, 0, 8.0]), 10.0)
    assert near[:3, 3] == pytest.approx([0.5, 0.0, -2 / COUPLING_N_MM])
    # Beyond the limit it retreats, at most by what a step may move in.
    over = within_force(pose, pose, np.array([0, 0, 11.0]), 10.0)
    assert over[:3, 3] == pytest.approx([0, 0, 1 / COUPLING_N_MM])
    far = within_force(pose, pose, np.array([0, 0, 99.0]), 10.0)
    assert far[:3, 3] == pytest.approx([0, 0, MOST_PENETRATION_MM])
    assert (pose == np.eye(4)).all()


def test_tissue_that_is_restored_under_the_probe_has_the_probe_outside(rehearsal):
    """The state at rest comes back where the probe is 6 mm inside it."""
    pressed(rehearsal, 6.0)
    organ, hand = rehearsal.organ, rehearsal.pose_at_depth(6.0)
    state = organ.body.snapshot()
    organ.body.restore(BodyState(np.full_like(state.position, np.nan), state.velocity))
    (step,) = rehearsal.do(Move(pose=hand)).steps
    rehearsal.show()
    assert "restored" in organ.notice and (step.hand == hand).all()
    assert penetration_of(rehearsal.anatomy) < 0.1
    way = organ.pose[:3, 3] - hand[:3, 3]
    assert 5.5 < way @ hand[:3, 2] < 6.5 and way == pytest.approx((way @ hand[:3, 2]) * hand[:3, 2], abs=0.1)
    # It presses again as it did.
    after = pressed(rehearsal, 6.0)[-1]
    assert after.wrench[:3] @ hand[:3, 2] > 0.5 and (after.pose == after.hand).all()


def test_a_hand_that_only_touches_presses_nothing(rehearsal):
    rest = rehearsal.anatomy.vertices
    for _ in range(20):
        frame = rehearsal.do(Move(pose=rehearsal.pose_at_depth(8.0), presses=False))
    assert np.linalg.norm(frame.wrench[:3]) < 0.2
    assert np.abs(rehearsal.anatomy.vertices - rest).max() < 0.3


@pytest.mark.parametrize(
    ("shift_mm", "turn_deg", "is_free", "is_straight"),
    [
        (20, 0, True, True),
        (20, 1, True, True),
        (20, 20, True, False),
        (5, 0, False, False),
        (2, 1, False, True),
    ],
)
def test_a_path_is_straight_for_the_tissue_unless_the_probe_turns_or_slides_far(
    rehearsal, shift_mm, turn_deg, is_free, is_straight
):
    """A point beside a probe that turns by 20 degrees on 20 mm is a millimetre off the chord of its path."""
    organ, pose = rehearsal.organ, rehearsal.organ.pose.copy()
    pose[:3, :3] = Rotation.from_euler("x", turn_deg, degrees=True).as_matrix() @ pose[:3, :3]
    pose[0, 3] += shift_mm
    start = organ._start_of_path(pose, is_free)
    assert start is (organ.pose if is_straight else pose)
