"""The barrier between contact points: an edge does not get deep between them, its forces are in equilibrium,
and presses that do not reach it stay as they are.
"""

from itertools import pairwise, product

import numpy as np
import pytest
import trimesh
from lattice_tissue import DENSITY, YOUNG_KPA, G, position, settings_of, tissue_of
from scipy.spatial.transform import Rotation

from sim.fields import array_of
from sim.lattice import surface_points
from sim.penetration_barrier import (
    BARRIER_SPACING_MM,
    BLOCK,
    INSET_CELLS,
    NEAR_MM,
    RADIUS_MM,
    STIFFNESS_RATIO,
    STRETCH,
)
from sim.shapes import ConvexTool, Plane
from sim.skinning import Skin
from sim.surface_contact import PENALTY_DEPTH_MM

SIZE_MM, EDGE_MM, FRICTION = np.array([14.0, 6.0, 10.0]), 1.0, 0.35
CELL_MM, FLOOR_MM, TOP_MM = 5.0, -10.0, 10.0
TURN = Rotation.from_euler("xyz", [35, 12, 8], degrees=True).as_matrix()
DOWN = (0.0, 0.0, -G)
STEPS, REST_STEPS, PRESSED_MM = 60, 120, 10.0
# Of a sharp edge, several times the modulus of the tissue; more than any point of the barrier bears here.
TOUCHED_KPA = 300.0


@pytest.fixture
def tissue() -> trimesh.Trimesh:
    return trimesh.creation.box([30.0, 30.0, TOP_MM - FLOOR_MM])


def pose_at(depth_mm: float, turn: np.ndarray = TURN) -> np.ndarray:
    """The tool, turned, so that its lowest point is at a depth [mm] below the top."""
    core = np.array(list(product([-1, 1], repeat=3))).T * (SIZE_MM / 2 - EDGE_MM)[:, None]
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[2, 3] = TOP_MM - depth_mm + EDGE_MM - (turn @ core)[2].min()
    return pose


def pressed(
    mesh: trimesh.Trimesh, depth_mm: float, barrier: bool, turn: np.ndarray = TURN, is_fixed: bool = True
):
    """A solver with the tool pressed in by a depth [mm], at rest; its lowest nodes ``is_fixed`` or lie."""
    tool = ConvexTool.cuboid(SIZE_MM, EDGE_MM)
    shapes = [Plane(np.array([0.0, 0.0, 1.0]), FLOOR_MM), tool]
    low = (lambda x: x[:, 2] < FLOOR_MM + CELL_MM) if is_fixed else None
    solver = tissue_of(mesh, CELL_MM, shapes, FRICTION, fixed=low, barrier=barrier)
    settings, depths = settings_of(8, gravity=DOWN), np.linspace(-0.5, depth_mm, STEPS + 1)
    for before, now in pairwise(depths):
        solver.step(settings, np.stack([pose_at(before, turn), pose_at(now, turn)]))
    for _ in range(REST_STEPS):
        solver.step(settings)
    return solver


def depth_in_tool(
    points: np.ndarray, pose: np.ndarray, inset_mm: float = 0.0, edge_mm: float = EDGE_MM
) -> np.ndarray:
    """Depth [mm] of points (n, 3) in the rounded cuboid, negative outside: its closed form."""
    q = np.abs((points - pose[:3, 3]) @ pose[:3, :3]) - (SIZE_MM / 2 - inset_mm - edge_mm)
    return edge_mm - np.linalg.norm(np.maximum(q, 0.0), axis=1) - np.minimum(q.max(axis=1), 0.0)


def deepest(solver, pose: np.ndarray) -> float:
    """Depth [mm] in the tool of the deepest of many points of the top, which move with the tissue."""
    x, y = np.meshgrid(*[np.linspace(-12, 12, 97)] * 2)
    skin = Skin(solver.model.carrier, np.column_stack([x.ravel(), y.ravel(), np.full(x.size, TOP_MM)]))
    return depth_in_tool(array_of(skin.vertices).astype(float), pose).max()


def mass_of(solver) -> np.ndarray:
    lattice = solver.model.lattice
    return lattice.node_mass(np.full(len(lattice.cells), DENSITY))


def test_an_edge_does_not_get_deep_between_the_contact_points(kept, tissue):
    """Not deeper than the smaller tool's edge, the penalty's depth, and half of the points' spacing."""
    pose, edge = pose_at(PRESSED_MM), (np.sqrt(3) - 1) * (RADIUS_MM - EDGE_MM)
    solver = pressed(tissue, PRESSED_MM, True)
    pressed_in_mm = TOUCHED_KPA / (STIFFNESS_RATIO * solver.contacts.stiffness)
    bound = INSET_CELLS * CELL_MM + edge + pressed_in_mm + BARRIER_SPACING_MM / 2 * np.sin(np.pi / 4)
    assert 0.5 < deepest(solver, pose) < bound < deepest(pressed(tissue, PRESSED_MM, False), pose)
    speed = np.linalg.norm(array_of(solver.body.velocity), axis=1).max()
    # Settled: a direction that jumps at an edge moves the tissue by 10 mm/s and more.
    assert speed < 0.05


def test_each_point_bears_its_depth_in_the_smaller_tool(kept, tissue):
    solver = pressed(tissue, PRESSED_MM, True)
    barrier = solver.contacts.barrier
    points, area = surface_points(tissue, BARRIER_SPACING_MM)
    at = array_of(Skin(solver.model.carrier, points).vertices).astype(float)
    depth = np.maximum(depth_in_tool(at, pose_at(PRESSED_MM), INSET_CELLS * CELL_MM, RADIUS_MM), 0.0)
    borne = 1e-3 * STIFFNESS_RATIO * YOUNG_KPA / PENALTY_DEPTH_MM * (area * depth).sum()
    # At rest up to the 0.01 mm/s of the last step.
    assert barrier.load(solver.tool)[6] == pytest.approx(borne, rel=0.01)


def test_all_points_that_are_near_are_found(kept, tissue):
    """Also those at the border of a block whose middle is not near."""
    solver = pressed(tissue, PRESSED_MM, True)
    barrier = solver.contacts.barrier
    at = array_of(Skin(solver.model.carrier, barrier.whole[0]).vertices).astype(float)
    outside = -depth_in_tool(at, pose_at(PRESSED_MM), INSET_CELLS * CELL_MM, RADIUS_MM)
    near = array_of(barrier.near) > 0
    # At rest they are where they were when they were looked for, up to the last step's motion.
    still_mm = 0.01
    assert near[(outside > still_mm - RADIUS_MM) & (outside < NEAR_MM - still_mm)].all()
    assert not near[outside > NEAR_MM + still_mm].any() and near.sum() > BLOCK


def test_points_that_a_tool_leaves_bear_nothing(kept, tissue):
    solver = pressed(tissue, PRESSED_MM, True)
    barrier = solver.contacts.barrier
    assert array_of(barrier.near).any() and array_of(barrier.block_is_near).any()
    solver.step(settings_of(8, gravity=DOWN), np.stack([pose_at(-1.0), pose_at(-60.0)]))
    assert not array_of(barrier.near).any() and not array_of(barrier.block_load).any()


def test_points_put_elsewhere_are_in_blocks_again(kept, tissue):
    """In another order they bear the same: each block has neighbours alone."""
    solver = pressed(tissue, PRESSED_MM, True)
    barrier = solver.contacts.barrier
    before = barrier.load(solver.tool)
    points, area = barrier.whole
    order = np.random.default_rng(1).permutation(len(points))
    barrier.set_points(solver.model.lattice, points[order], area[order])
    assert array_of(barrier.reach).max() < STRETCH * BARRIER_SPACING_MM * BLOCK
    for _ in range(10):
        solver.step(settings_of(8, gravity=DOWN))
    assert barrier.load(solver.tool) == pytest.approx(before, rel=0.01, abs=0.05)


def test_the_forces_of_the_barrier_are_in_equilibrium(kept, tissue):
    """Tool and floor together carry the weight, without a torque; most of it the barrier."""
    solver = pressed(tissue, PRESSED_MM, True, is_fixed=False)
    floor, tool = solver.contacts.shapes
    on_barrier = solver.contacts.barrier.load(tool)[6]
    assert on_barrier > 0.3
    for about in (np.zeros(3), np.array([5.0, -3.0, 8.0])):
        wrench = sum(solver.contacts.load(shape, about).wrench for shape in (floor, tool))
        weight = 1e-6 * mass_of(solver)[:, None] * np.array(DOWN)
        torque = np.cross(position(solver) - about, weight).sum(axis=0)
        assert wrench[:3] == pytest.approx(weight.sum(axis=0), abs=0.01 * on_barrier)
        assert wrench[3:] == pytest.approx(torque, abs=0.01 * on_barrier * TOP_MM)


def test_a_restored_load_is_the_same(kept, tissue):
    solver = pressed(tissue, PRESSED_MM, True)
    before, state = solver.contacts.load(solver.tool, np.zeros(3)), solver.snapshot()
    solver.restart()
    assert not solver.contacts.load(solver.tool, np.zeros(3)).wrench.any()
    solver.restore(state)
    assert (solver.contacts.load(solver.tool, np.zeros(3)).wrench == before.wrench).all()


def test_a_press_that_does_not_reach_the_barrier_stays_as_it_is(kept, tissue):
    without, solver = (pressed(tissue, 2.0, barrier, np.eye(3)) for barrier in (False, True))
    assert solver.contacts.load(solver.tool, np.zeros(3)).wrench[2] > 0.1
    assert solver.contacts.barrier.load(solver.tool)[6] == 0.0
    # Two kernels round differently, and friction keeps what rounding did.
    assert position(solver) == pytest.approx(position(without), abs=1e-3)
