"""Fixed boundary: tissue at the hilum does not move, the rest deforms; otherwise no node is fixed."""

import numpy as np
import pytest
import trimesh

from rehearsal.case import case_of
from rehearsal.pressed_organ import PressedOrgan
from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.patients.patient_scene import hilum
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import PAPER, AnatomyFiles, Attachment, PlaneShape, Scene, load_scene, with_options
from sim.attachment import PerirenalFat
from sim.fields import array_of
from sim.lattice import fill_with_cells
from sim.sampling import SamplingError

AT = (-15.0, 0.0, 0.0)


def ball_held_by(cell_mm: float = 4.0, shapes: tuple = (), **attachment) -> PressedOrgan:
    """A ball among shapes: without these and an attachment it falls."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=15.0)
    scene = Scene(
        anatomy=AnatomyFiles(),
        attachment=Attachment(**attachment),
        press={"warm_up_steps": 0, "direction": (0, 0, 1), "target_mm": (0, 0, 0)},
    )
    scene = with_options(scene, {"tissue.cell_mm": cell_mm})
    return PressedOrgan(case_of(scene, LoadedAnatomy(ball, None, None, shapes)))


def moved_mm(organ: PressedOrgan, steps: int = 30) -> np.ndarray:
    for _ in range(steps):
        organ.advance(organ.pose)
    return array_of(organ.body.position) - organ.body.rest_points


def test_fixed_nodes_do_not_move_and_the_rest_hangs_from_them(device):
    organ = ball_held_by(at_mm=AT, radius_mm=6.0)
    moved = moved_mm(organ)
    held = np.linalg.norm(organ.body.rest_points - AT, axis=1) <= 6.0
    assert 0 < held.sum() < len(held) / 4
    assert np.abs(moved[held]).max() < 1e-5  # float32 rest positions
    far = organ.body.rest_points[:, 0] > 8
    drop = moved[far] @ organ.case.gravity_direction
    # Free fall for 0.5 s would be a metre.
    assert 0.01 < drop.mean() < 20 and organ.divergence_check.restorations == 0


def test_without_radius_and_stiffness_nothing_holds_it(device):
    organ = ball_held_by(at_mm=AT)
    assert not organ.model.has_fixed and not organ.model.has_tether
    assert moved_mm(organ, 12).min(axis=0)[1] > 100  # it falls: 12 steps of 1/60 s are 196 mm without damping


def test_a_region_with_no_or_all_nodes_is_refused(device):
    with pytest.raises(SamplingError, match="holds none of the organ"):
        ball_held_by(at_mm=(100.0, 0.0, 0.0), radius_mm=1.0)
    with pytest.raises(SamplingError, match="holds all of the organ"):
        ball_held_by(at_mm=AT, radius_mm=100.0)
    with pytest.raises(ValueError, match=r"give attachment\.at_mm"):
        Attachment(radius_mm=5.0)
    with pytest.raises(ValueError, match=r"give attachment\.radius_mm"):
        Attachment(stiffness_n_mm=5.0)


def test_a_model_that_cannot_be_attached_starts_without_an_attachment():
    attached = Attachment(at_mm=AT, radius_mm=5.0, fat_kpa_mm=0.3)
    scene = load_scene(PAPER).model_copy(update={"attachment": attached})
    assert with_options(scene, {"tissue.cell_mm": 4.0}).attachment == attached
    assert not with_options(scene, {"tissue.model": "shape-matching"}).attachment.holds
    with pytest.raises(ValueError, match=r"set tissue\.model to neo-hookean"):
        Scene.model_validate(scene.model_dump() | {"tissue": {"model": "shape-matching"}})


def drop_mm(organ: PressedOrgan) -> tuple[float, float]:
    """How far the centre of mass sinks until it rests, by its springs alone, and the weight [N]."""
    model = organ.model
    organ.settings.damping = 60.0
    for _ in range(400):
        organ.advance(organ.pose)
    mass = array_of(model.mass)
    moved = array_of(organ.body.position) - organ.body.rest_points
    assert np.abs(array_of(organ.body.velocity)).max() < 0.05
    return float(mass @ moved @ organ.case.gravity_direction / mass.sum()), 9.81e-3 * float(mass.sum())


def test_a_pedicles_tether_stretches_by_the_weight_over_its_stiffness(device):
    # It reaches all but the farthest tissue, so that the ball neither turns nor deforms by more than a
    # hundredth of the sag.
    sag, weight_n = drop_mm(ball_held_by(3.0, at_mm=(0.0, 0.0, 0.0), radius_mm=15.0, stiffness_n_mm=0.05))
    assert sag == pytest.approx(weight_n / 0.05, rel=0.02) and sag > 2


def test_fat_is_a_foundation_on_the_covered_half_of_the_surface(device):
    # On half a ball of radius R and stiffness k per area: 2 pi R^2 k in all. Its springs are in the covered
    # half, which turns the ball a little; the centre of mass sinks by the weight over that stiffness.
    organ = ball_held_by(3.0, fat_kpa_mm=0.05)
    # Springs across the normal have a third of it: of the trace, 5/3 of those along it.
    stiffness = np.trace(array_of(organ.model.tether), axis1=1, axis2=2) / 1e6
    assert stiffness.sum() == pytest.approx(5 / 3 * 2 * np.pi * 15.0**2 * 0.05e-3, rel=0.03)
    # The transducer comes along +z, so that the fat is on that side of the ball which faces +z.
    outside = organ.body.rest_points[stiffness > 0]
    assert outside[:, 2].min() > -3.0 and outside[:, 2].max() > 14.0
    assert drop_mm(organ)[0] > 0.5


def test_a_foundation_resists_by_the_integral_of_its_stiffness_times_the_displacement():
    """A block of 24 x 18 x 12 mm whose faces have foundations of their own, moved rigidly: each face of area
    A and stiffness k adds k A along its normal, a third of it across.
    """
    size, k = np.array([24.0, 18.0, 12.0]), np.array([0.2, 0.5, 0.9, 0.0, 0.3, 0.7])
    block = trimesh.creation.box(extents=size).subdivide()
    side = np.argmax(block.face_normals @ SIDES.T, axis=1)
    lattice = fill_with_cells(block, 3.0)
    springs = PerirenalFat(k[side]).stiffness(lattice, block)
    area_mm2 = np.tile(size[[1, 2, 0]] * size[[2, 0, 1]], 2)
    along = SIDES[:, :, None] * SIDES[:, None, :]
    each_n_mm = 1e-3 * k * area_mm2
    whole = (each_n_mm[:, None, None] * (along + (np.eye(3) - along) / 3)).sum(axis=0)
    np.testing.assert_allclose(springs.sum(axis=0), whole, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(springs, springs.transpose(0, 2, 1))
    # Turned by a small angle about its middle: on every face the force is linear over it, as are the shape
    # functions that share it among the nodes, so that the torque is that of the integral over the faces.
    turn = np.array([0.02, -0.03, 0.01])
    force = np.einsum("nij,nj->ni", springs, np.cross(turn, lattice.nodes))
    torque = np.cross(lattice.nodes, force).sum(axis=0)
    wanted = torque_on_faces(turn, size, 1e-3 * k)
    # A spring is at a node, up to a cell from the surface that it stands for.
    np.testing.assert_allclose(torque, wanted, rtol=0.15)


SIDES = np.concatenate([np.eye(3), -np.eye(3)])


def torque_on_faces(turn: np.ndarray, size: np.ndarray, n_mm3: np.ndarray) -> np.ndarray:
    """Torque of foundations on a block's faces, by quadrature of k (P + (1 - P) / 3) (turn x r)."""
    torque = np.zeros(3)
    ticks = (np.arange(40) + 0.5) / 40 - 0.5
    for normal, k in zip(SIDES, n_mm3, strict=True):
        axis = int(np.argmax(np.abs(normal)))
        across = [a for a in range(3) if a != axis]
        places = np.zeros((1600, 3))
        places[:, across] = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2) * size[across]
        places[:, axis] = normal[axis] * size[axis] / 2
        moved = np.cross(turn, places)
        normal_part = np.outer(moved @ normal, normal)
        force = k * (normal_part + (moved - normal_part) / 3) * np.prod(size[across]) / 1600
        torque += np.cross(places, force).sum(axis=0)
    return torque


def test_the_force_in_a_step_is_that_of_the_springs(device):
    """A ball in a foundation whose stiffness differs by direction comes to rest where its weight is carried:
    by 5/9 of the integral of k.
    """
    organ = ball_held_by(3.0, fat_kpa_mm=0.05, freed_deg=0.0)
    sag, weight_n = drop_mm(organ)
    # Over a ball the mean of n n^T is 1/3, so that k (1/3 + 2/3 1/3) acts in each direction.
    stiffness_n_mm = 4 * np.pi * 15.0**2 * 0.05e-3 * 5 / 9
    assert sag == pytest.approx(weight_n / stiffness_n_mm, rel=0.03) and sag > 0.5


def test_an_organ_in_fat_returns_to_its_place_on_a_support(device):
    """Pushed along the floor and left alone, it comes back; friction on the floor would hold it."""
    floor = PlaneShape(kind="plane", normal=(0.0, -1.0, 0.0), offset_mm=-15.0)
    organ = ball_held_by(4.0, (floor,), fat_kpa_mm=0.01, freed_deg=0.0)
    moved_mm(organ, 120)
    settled = array_of(organ.body.position)
    down = organ.settings.gravity
    organ.settings.gravity = (3000.0, *down[1:])
    pushed = moved_mm(organ, 30) + organ.body.rest_points - settled
    assert pushed[:, 0].mean() > 0.5
    organ.settings.gravity = down
    back = moved_mm(organ, 240) + organ.body.rest_points - settled
    assert np.abs(back).max() < 0.01
    assert [*organ.contacts.is_rough] == [False, True]


def test_a_deeper_hollow_of_the_other_side_is_no_hilum():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=30.0)
    dented = ball.vertices.copy()
    for at, reach in (([-38.0, 4.0, 6.0], 18), ([38.0, 0.0, 0.0], 26)):
        away = np.linalg.norm(ball.vertices - at, axis=1)
        dented[away < reach, 0] -= np.sign(at[0]) * (reach - away[away < reach])
    mesh = trimesh.Trimesh(dented, ball.faces, process=False)
    assert hilum(mesh, "left") == pytest.approx((-20.0, 4.0, 6.0), abs=5.0)
    assert hilum(mesh, "right") == pytest.approx((12.0, 0.0, 0.0), abs=5.0)


def test_the_embedded_kidneys_hilum():
    """Where its vessels leave it: scenes/phantom/kidney.py puts its sinus 7 mm to the midline."""
    anatomy = load_anatomy(load_scene(PAPER), phantom_folder())
    vessels = anatomy.parts["vessel"]
    leaving = vessels.vertices[vessels.vertices[:, 0] < vessels.bounds[0, 0] + 3].mean(axis=0)
    assert np.linalg.norm(np.array(hilum(anatomy.organ, "left")) - leaving) < 15
