"""The proxy of a tool: it follows its goal in free space, stops and slides at the tissue, never passes it.

Depths are checked beside the closed form of a rounded cuboid's distance in NumPy.
"""

import numpy as np
import pytest
import taichi as ti
import taichi.math as tm
from lattice_tissue import lifted
from scipy.spatial.transform import Rotation

from sim.fields import field_of
from sim.proxy import TOLERANCE_MM, Proxy
from sim.shapes import ConvexTool

SIZE_MM, EDGE_MM = np.array([36.0, 10.0, 8.0]), 1.0
SPACING_MM = 1.5
MOST_MM = 0.5
# Of positions of 50 mm in float32, in the order of their sums.
ROUNDING_MM = 1e-4


class Points:
    """Contact points that do not move, each a ball of a radius."""

    block = 1

    def __init__(self, points: np.ndarray, radius_mm: float = 0.0) -> None:
        self.count = len(points)
        self.point = field_of(points, within=1)
        self.radius_mm = radius_mm

    @ti.func
    def surface_ball(self, q):
        return tm.vec4(self.point[q], self.radius_mm)

    @ti.func
    def block_ball(self, q):
        return self.surface_ball(q)


def floor() -> np.ndarray:
    """Points of the plane z = 0."""
    x, y = np.meshgrid(*[np.arange(-60.0, 60.0, SPACING_MM)] * 2)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def sphere(radius_mm: float) -> np.ndarray:
    """Points about SPACING_MM apart on a sphere (Fibonacci)."""
    count = int(4 * np.pi * radius_mm**2 / SPACING_MM**2)
    n = np.arange(count) + 0.5
    z, turn = 1 - 2 * n / count, np.pi * (1 + 5**0.5) * n
    r = np.sqrt(1 - z**2)
    return radius_mm * np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def tool() -> ConvexTool:
    return ConvexTool.cuboid(SIZE_MM, EDGE_MM)


def depth_of(pose: np.ndarray, points: np.ndarray, radius_mm: float = 0.0) -> float:
    """Depth [mm] of the deepest ball in the rounded cuboid at a pose; negative outside."""
    q = np.abs((points - pose[:3, 3]) @ pose[:3, :3]) - (SIZE_MM / 2 - EDGE_MM)
    distance = np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0) - EDGE_MM
    return float((radius_mm - distance).max())


def at_height(z_mm: float, x_mm: float = 0.0) -> np.ndarray:
    """The tool's face at a height over the floor."""
    pose = lifted(z_mm + SIZE_MM[2] / 2)
    pose[0, 3] = x_mm
    return pose


def test_it_is_the_goal_itself_where_the_path_is_free(one_device):
    proxy = Proxy(Points(floor()), tool())
    far, over, turned = at_height(200.0), at_height(0.1, 20.0), at_height(60.0)
    turned[:3, :3] = Rotation.from_euler("xyz", [20, 30, 170], degrees=True).as_matrix()
    for start, goal in ((far, over), (over, far), (far, turned), (turned, far), (far, far)):
        assert proxy.pose_towards(start, goal, 0.0) is goal
    # As deep as it may be, and no deeper.
    pressed = at_height(-MOST_MM + 0.01)
    assert proxy.pose_towards(over, pressed, MOST_MM) is pressed


@pytest.mark.parametrize("radius_mm", [0.0, 2.0])
@pytest.mark.parametrize("from_mm", [0.0, 30.0, 200.0])
def test_it_stops_at_the_tissue_however_far_the_hand_goes(one_device, from_mm, radius_mm):
    """Along its own axis, as it is held: also from afar, and also where the goal is beyond the tissue."""
    proxy = Proxy(Points(floor(), radius_mm), tool())
    for goal_mm in (-2.0, -6.0, -80.0):
        pose = at_height(from_mm + radius_mm)
        for _ in range(10):
            pose = proxy.pose_towards(pose, at_height(goal_mm), MOST_MM)
        assert pose[:2, 3] == pytest.approx([0.0, 0.0], abs=ROUNDING_MM)
        assert depth_of(pose, floor(), radius_mm) == pytest.approx(MOST_MM, abs=TOLERANCE_MM)


def test_it_slides_along_the_tissue_to_where_the_hand_is_beside(one_device):
    proxy, goal = Proxy(Points(floor()), tool()), at_height(-7.0, 25.0)
    pose = at_height(0.0)
    for _ in range(20):
        pose = proxy.pose_towards(pose, goal, MOST_MM)
        assert depth_of(pose, floor()) <= MOST_MM + TOLERANCE_MM
    assert pose[0, 3] == pytest.approx(25.0, abs=0.01)
    # A goal above it is reached.
    assert proxy.pose_towards(pose, at_height(3.0, 20.0), MOST_MM)[2, 3] == at_height(3.0)[2, 3]


@pytest.mark.parametrize("most_mm", [0.0, MOST_MM])
def test_a_wild_hand_brings_it_neither_into_the_tissue_nor_through_it(one_device, most_mm):
    """Jumps of 50 mm and turns of up to 90 degrees about a ball of 25 mm."""
    ball, rng = sphere(25.0), np.random.default_rng(1)
    proxy, pose = Proxy(Points(ball), tool()), lifted(60.0)
    touched = 0
    for _ in range(300):
        goal = pose.copy()
        goal[:3, 3] = np.clip(pose[:3, 3] + rng.uniform(-50, 50, 3), -45, 45)
        turn = Rotation.from_rotvec(np.radians(rng.uniform(-52, 52, 3)))
        goal[:3, :3] = turn.as_matrix() @ pose[:3, :3]
        pose = proxy.pose_towards(pose, goal, most_mm)
        depth = depth_of(pose, ball)
        assert depth <= most_mm + TOLERANCE_MM + ROUNDING_MM
        touched += depth > most_mm - 0.1
        # Between points that are 1.5 mm apart nothing passes: all of it stays outside.
        corners = np.array(np.meshgrid(*[[-1, 0, 1]] * 3)).reshape(3, -1).T * (SIZE_MM / 2 - EDGE_MM)
        assert np.linalg.norm(corners @ pose[:3, :3].T + pose[:3, 3], axis=1).min() > 23.0
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert touched > 30


@pytest.mark.parametrize("up", [0.95, 0.8, 0.5])
def test_at_an_edge_it_retreats_no_further_than_to_where_that_touches(one_device, up):
    """A point on the rounded edge beside the face, whose normal has this share along the axis."""
    across = np.sqrt(1 - up**2)
    place = SIZE_MM / 2 - EDGE_MM + EDGE_MM * np.array([0.0, across, up])
    point = np.array([[0.0, place[1], -place[2]]])
    proxy = Proxy(Points(point), tool())
    goal = np.eye(4)
    goal[2, 3] = -0.3
    pose = proxy.pose_towards(at_height(30.0), goal, 0.0)
    # It touches at the pose in which the point is on its edge; above or below, it does not.
    assert pose[:2, 3] == pytest.approx([0.0, 0.0], abs=ROUNDING_MM)
    assert pose[2, 3] == pytest.approx(0.0, abs=0.02)


def test_tissue_that_has_moved_into_it_moves_it_out(one_device):
    proxy = Proxy(Points(floor()), tool())
    pose = proxy.pose_towards(at_height(-2.0), at_height(-2.0), MOST_MM)
    assert depth_of(pose, floor()) == pytest.approx(MOST_MM, abs=TOLERANCE_MM)
    # Between two floors there is no such place: it stays, and is not thrown out.
    both = np.concatenate([floor(), floor() + [0, 0, SIZE_MM[2] - 2.0]])
    proxy, start = Proxy(Points(both), tool()), at_height(-1.0)
    held = proxy.pose_towards(start, at_height(-3.0), 0.0)
    assert np.abs(held - start).max() < 0.1


def test_the_same_goals_give_the_same_bits(one_device):
    ball, goals = sphere(25.0), []
    for _ in range(2):
        rng, pose, proxy = np.random.default_rng(2), lifted(60.0), Proxy(Points(ball), tool())
        for _ in range(30):
            goal = lifted(0.0)
            goal[:3, 3] = rng.uniform(-40, 40, 3)
            pose = proxy.pose_towards(pose, goal, MOST_MM)
        goals.append(pose.tobytes())
    assert goals[0] == goals[1]


def test_what_presses_is_a_smaller_tool_and_what_touches_the_whole(one_device):
    """The floor is as deep as the smaller tool's face is inside, and the depth that it may have."""
    points, above, goal = floor(), lifted(SIZE_MM[2] / 2 + 1.0), lifted(SIZE_MM[2] / 2 - 1.5)
    proxy = Proxy(Points(points), tool(), inset_mm=0.3, radius_mm=1.5)
    pressed, touching = (proxy.pose_towards(above, goal, *how) for how in ((MOST_MM, True), (0.0, False)))
    for pose, depth_mm in ((pressed, 0.3 + MOST_MM), (touching, 0.0)):
        # It retreats no further than it must.
        assert depth_of(pose, points) == pytest.approx(depth_mm, abs=2 * TOLERANCE_MM)
