"""Fixed boundary: tissue near the hilum does not move, the rest deforms; without attachment no node is fixed."""

import numpy as np
import pytest
import trimesh

from rehearsal.rehearsal import Rehearsal
from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.patients.patient_scene import hilum
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import PAPER, AnatomyFiles, Attachment, Scene, SceneError, load_scene, with_options
from sim.fields import array_of
from sim.sampling import SamplingError

AT = (-15.0, 0.0, 0.0)


def hanging(radius_mm: float, at=AT) -> Rehearsal:
    """A ball without support: without an attachment it falls."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=15.0)
    scene = Scene(
        anatomy=AnatomyFiles(),
        attachment=Attachment(at_mm=at, radius_mm=radius_mm),
        press={"warm_up_steps": 0},
    )
    scene = with_options(scene, {"tissue.cell_mm": 4.0})
    return Rehearsal(scene, LoadedAnatomy(ball, None, None, ()))


def moved_mm(rehearsal: Rehearsal, steps: int = 30) -> np.ndarray:
    for _ in range(steps):
        rehearsal.advance(rehearsal.pose)
    return array_of(rehearsal.body.position) - rehearsal.body.rest_points


def test_fixed_nodes_do_not_move_and_the_rest_hangs_from_them(device):
    rehearsal = hanging(6.0)
    moved = moved_mm(rehearsal)
    held = np.linalg.norm(rehearsal.body.rest_points - AT, axis=1) <= 6.0
    assert 0 < held.sum() < len(held) / 4
    assert np.abs(moved[held]).max() < 1e-5  # float32 rest positions
    far = rehearsal.body.rest_points[:, 0] > 8
    drop = moved[far] @ rehearsal.gravity_direction
    # Free fall for 0.5 s would be a metre.
    assert 0.01 < drop.mean() < 20 and rehearsal.divergence_check.restorations == 0


def test_without_a_radius_no_node_is_fixed(device):
    rehearsal = hanging(0.0)
    assert not rehearsal.model.has_fixed
    assert (
        moved_mm(rehearsal, 12).min(axis=0)[1] > 100
    )  # it falls: 12 steps of 1/60 s are 196 mm without damping


def test_a_region_with_no_or_all_nodes_is_refused(device):
    with pytest.raises(SamplingError, match="holds none of the organ"):
        hanging(1.0, at=(100.0, 0.0, 0.0))
    with pytest.raises(SamplingError, match="holds all of the organ"):
        hanging(100.0)
    with pytest.raises(ValueError, match=r"give attachment\.at_mm"):
        Attachment(radius_mm=5.0)
    scene = load_scene(PAPER).model_copy(update={"attachment": Attachment(at_mm=AT, radius_mm=5.0)})
    with pytest.raises(SceneError, match="set --model to neo-hookean"):
        with_options(scene, {"tissue.model": "shape-matching"})


def test_the_hilum_is_the_hollow_of_the_medial_side():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=30.0)
    for side, medial in (("left", -1.0), ("right", 1.0)):
        away = ball.vertices - [medial * 38.0, 4.0, 6.0]
        hollow = ball.vertices.copy()
        near = np.linalg.norm(away, axis=1) < 18
        hollow[near] -= np.array([medial, 0, 0]) * (18 - np.linalg.norm(away[near], axis=1))[:, None]
        dented = trimesh.Trimesh(hollow, ball.faces, process=False)
        assert hilum(dented, side) == pytest.approx((medial * 20.0, 4.0, 6.0), abs=5.0)


def test_a_deeper_hollow_of_the_other_side_is_no_hilum():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=30.0)
    dented = ball.vertices.copy()
    for at, reach in (([-38.0, 4.0, 6.0], 18), ([38.0, 0.0, 0.0], 26)):
        away = np.linalg.norm(ball.vertices - at, axis=1)
        dented[away < reach, 0] -= np.sign(at[0]) * (reach - away[away < reach])
    mesh = trimesh.Trimesh(dented, ball.faces, process=False)
    assert hilum(mesh, "left") == pytest.approx((-20.0, 4.0, 6.0), abs=5.0)
    assert hilum(mesh, "right") == pytest.approx((12.0, 0.0, 0.0), abs=5.0)


def test_the_embedded_kidneys_hilum(phantom_hilum):
    """Where its vessels leave it: scenes/phantom/kidney.py puts its sinus 7 mm to the midline of the kidney's middle."""
    organ, found = phantom_hilum
    vessels = organ.parts["vessel"]
    leaving = vessels.vertices[vessels.vertices[:, 0] < vessels.bounds[0, 0] + 3].mean(axis=0)
    assert np.linalg.norm(np.array(found) - leaving) < 15


@pytest.fixture
def phantom_hilum():
    anatomy = load_anatomy(load_scene(PAPER), phantom_folder())
    return anatomy, hilum(anatomy.organ, "left")
