"""How the whole body moves as if it were rigid: found whole, in every direction, from any state."""

import numpy as np
import pytest
import taichi as ti
import trimesh
from conftest import rotation_about

from sim.body import Body, BodyState
from sim.fields import array_of, field_of, fill
from sim.kernels import kernel
from sim.lattice import fill_with_cells
from sim.neo_hookean import NeoHookean
from sim.rigid_correction import RigidCorrection

DT = 1 / 60


@kernel
def begin(model: ti.template(), dt: float):
    model.begin(dt)


def lopsided(serial: bool) -> NeoHookean:
    """A block whose node nearest to its middle is not its centre of mass, and which lies along no axis."""
    block = trimesh.creation.box(bounds=[[-10.0, -6.0, -4.0], [14.0, 9.0, 7.0]])
    block.apply_transform(trimesh.transformations.rotation_matrix(np.radians(40), [1, 2, 3]))
    lattice = fill_with_cells(block, 5.0)
    return NeoHookean(Body(lattice.nodes), lattice, serial=serial)


@pytest.mark.parametrize("serial", [True, False])
@pytest.mark.parametrize("spin", [(0.0, 0.0, 0.0), (0.2, -0.1, 0.25)])
def test_any_rigid_way_is_found_whole(kept, serial, spin):
    model = kept(lopsided, serial)
    x = rotation_about([3, 1, 2], 100) @ model.body.rest_points.T
    x = x.T + [4.0, -7.0, 9.0]
    centre = x.mean(axis=0)
    wanted = (x - centre) @ rotation_about([2, -1, 1], 25).T + centre + [1.5, -0.8, 2.0]
    velocity = np.cross(spin, x - centre) / DT
    model.body.restore(BodyState(x.astype(np.float32), velocity.astype(np.float32)))
    fill((model.body.predicted, wanted))
    begin(model, DT)
    # However it moved before. Places of up to 25 mm carry 2e-6 mm in float32, and a turn of as many digits
    # has them for its lever.
    assert np.abs(array_of(model.body.predicted) - wanted).max() < 1.2e-5


@kernel
def move(rigid: ti.template(), dt: float):
    rigid.move(dt)


def nearest_rigid_motion(x: np.ndarray, wanted: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Where a rigid motion of places (n, 3) brings them nearest to others, by weighted squares (Kabsch
    1976).
    """
    middles = [weight @ places / weight.sum() for places in (x, wanted)]
    u, _, vt = np.linalg.svd((weight[:, None] * (x - middles[0])).T @ (wanted - middles[1]))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return (x - middles[0]) @ turn + middles[1]


@pytest.mark.parametrize("serial", [True, False])
def test_nodes_are_held_by_their_inertia_and_by_tethers(one_device, serial):
    random = np.random.default_rng(4)
    x, mass, tether = (
        random.normal(0, 15, (200, 3)),
        random.uniform(0.5, 2, 200),
        random.uniform(0, 4000, 200),
    )
    body = Body(x + random.normal(0, 1.0, x.shape))
    inertia = mass / DT**2
    target = x + random.normal(0, 1.0, x.shape)
    springs = field_of(tether[:, None, None] * np.eye(3), 2)
    rigid = RigidCorrection(body, field_of(mass), field_of(target, 1), None, serial, springs)
    body.restore(BodyState(x.astype(np.float32), np.zeros((200, 3), np.float32)))
    move(rigid, DT)
    held = inertia[:, None] * target + tether[:, None] * body.rest_points
    wanted = nearest_rigid_motion(x, held / (inertia + tether)[:, None], inertia + tether)
    # Without the tethers, or with those alone, it would be elsewhere.
    assert np.abs(wanted - nearest_rigid_motion(x, target, inertia)).max() > 0.02
    # As above; sums over 200 nodes at 15 mm add some digits.
    assert np.abs(array_of(body.predicted) - wanted).max() < 3e-5


@pytest.mark.parametrize("serial", [True, False])
def test_tethers_of_any_direction_in_equilibrium_move_nothing(one_device, serial):
    """Nodes moved from their places by a rigid motion, and inertial targets whose pull is against that of the
    springs, node by node: neither force nor torque is left.
    """
    random = np.random.default_rng(5)
    rest = random.normal(0, 15, (200, 3))
    root = random.normal(0, 30, (200, 3, 3))
    springs = root @ root.transpose(0, 2, 1)
    mass = random.uniform(0.5, 2, 200)
    body = Body(rest)
    x = (rest + random.normal(0, 1.0, rest.shape)).astype(np.float32)
    target = x - np.einsum("nij,nj->ni", springs, body.rest_points - x) * (DT**2 / mass)[:, None]
    held = field_of(mass), field_of(target, 1), None, serial, field_of(springs, 2)
    rigid = RigidCorrection(body, *held)
    body.restore(BodyState(x, np.zeros((200, 3), np.float32)))
    move(rigid, DT)
    # The digits of places in float32, as above; a correction that took only the mean stiffness would move it.
    assert np.abs(array_of(body.predicted) - x).max() < 3e-5
