"""Shapes against closed forms; contacts leave no particle inside a shape."""

import numpy as np
import pytest
import taichi as ti
import taichi.math as tm
import trimesh
from conftest import rotation_about
from lattice_tissue import position
from test_solver import on_floor, solver_of

from sim.fields import array_of, fill, zeros
from sim.kernels import kernel
from sim.shapes import FAR, ConvexTool, Plane, SignedDistanceField
from sim.solver import Solver, StepSettings


@kernel
def ask(
    shape: ti.template(), points: ti.types.ndarray(ti.f32, ndim=2), answers: ti.types.ndarray(ti.f32, ndim=2)
):
    for i in range(points.shape[0]):
        answer = shape.surface(tm.vec3(points[i, 0], points[i, 1], points[i, 2]))
        for k in ti.static(range(4)):
            answers[i, k] = answer[k]


def measured(shape, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (n, 3) and signed distances (n,) of a shape."""
    answers = np.zeros((len(points), 4), np.float32)
    ask(shape, np.ascontiguousarray(points, np.float32), answers)
    return answers[:, :3].astype(np.float64), answers[:, 3].astype(np.float64)


def scattered(count: int = 4000, reach: float = 16.0) -> np.ndarray:
    return np.random.default_rng(4).uniform(-reach, reach, (count, 3))


def begin(solver: Solver, gravity: list[float], dt: float = 0.0, stabilisations: int = 0) -> None:
    solver.start_substep(0, dt, *gravity, 0.0, stabilisations)


def test_plane(one_device):
    normal = np.array([1.0, 2.0, 2.0])
    points = scattered()
    normals, distance = measured(Plane(normal, 6.0), points)
    assert np.abs(distance - (points @ normal - 6.0) / 3).max() < 1e-5
    assert np.abs(normals - normal / 3).max() < 1e-6


@pytest.mark.parametrize("edge_radius", [0.0, 1.0, 3.0])
def test_cuboid_in_any_pose(one_device, edge_radius):
    half = np.array([6.0, 3.0, 4.0])
    tool = ConvexTool.cuboid(2 * half, edge_radius)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_about([1, 1, 0], 40), [2.0, -1.0, 3.0]
    tool.move(pose, pose)
    points = scattered()
    normals, distance = measured(tool, points)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    beyond = np.abs(local) - (half - edge_radius)
    wanted = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0) - edge_radius
    assert np.abs(distance - wanted).max() < 2e-5
    # A step along the normal changes the distance by its length, which is what makes it the normal.
    away = np.abs(wanted) > 0.1
    ahead = measured(tool, points + 0.05 * normals)[1]
    assert np.abs(ahead - distance - 0.05)[away & (beyond.max(axis=1) > 0)].max() < 1e-4


def test_the_nearest_point_outside_a_rounded_cuboid_is_just_outside_its_face(one_device):
    tool = ConvexTool.cuboid(np.array([12.0, 6.0, 8.0]), 1.0)
    out = zeros(6, 3, within=1)

    @kernel
    def ask(tool: ti.template(), out: ti.template(), x: float, y: float, z: float):
        for k in range(6):
            out[k] = tool.outside(ti.Vector([x, y, z]), k)

    away = np.eye(4)
    away[:3, :3], away[:3, 3] = rotation_about([1, 2, 3], 70), [20.0, -10.0, 5.0]
    for pose in (np.eye(4), away):
        tool.move(pose, pose)
        ask(tool, out, *(pose @ [1.0, 0.5, -0.5, 1.0])[:3])
        for point, k in zip(array_of(out), range(6), strict=True):
            expected = np.array([1.0, 0.5, -0.5, 1.0])
            expected[k % 3] = (1 if k < 3 else -1) * ([6.0, 3.0, 4.0][k % 3] + 1e-3)
            # Places of up to 25 mm, in float32.
            assert point == pytest.approx((pose @ expected)[:3], abs=1e-5)


@pytest.mark.parametrize("edge_radius", [-0.1, 3.1])
def test_an_edge_radius_too_large_is_refused(one_device, edge_radius):
    with pytest.raises(ValueError, match="expected 0 to 3 mm"):
        ConvexTool.cuboid(np.array([12.0, 6.0, 8.0]), edge_radius)


def test_the_motion_of_a_tools_material_is_that_of_its_poses(one_device):
    tool = ConvexTool.cuboid(np.array([4.0, 4.0, 4.0]))
    before, now = np.eye(4), np.eye(4)
    now[:3, :3], now[:3, 3] = rotation_about([0, 0, 1], 3), [0.5, 0.0, -0.2]
    tool.move(before, now)
    moved = zeros(3, within=1)

    @kernel
    def ask(tool: ti.template(), moved: ti.template(), x: float, y: float, z: float):
        moved[None] = tool.motion(ti.Vector([x, y, z]))

    material = np.array([1.0, 2.0, -2.0, 1.0])
    ask(tool, moved, *(now @ material)[:3])
    assert np.abs(array_of(moved) - (now @ material - material)[:3]).max() < 1e-6


def test_too_many_poses_are_refused(one_device):
    tool = ConvexTool.cuboid(np.array([4.0, 4.0, 4.0]))
    tool.follow(np.tile(np.eye(4), (101, 1, 1)))
    for poses in (1, 102):
        with pytest.raises(ValueError, match=f"{poses - 1} substeps: expected 1 to 100"):
            tool.follow(np.tile(np.eye(4), (poses, 1, 1)))


@pytest.mark.parametrize("spacing", [(0.5, 0.5, 0.5), (0.5, 0.4, 0.8)])
def test_signed_distance_field_of_a_sphere(one_device, spacing):
    axes = [np.arange(-16, 16.1, step) for step in spacing]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = SignedDistanceField(np.linalg.norm(grid, axis=-1) - 9, np.full(3, -16.0), np.array(spacing))
    points = scattered(reach=11.0)
    points = points[np.linalg.norm(points, axis=1) > 4]
    normals, distance = measured(field, points)
    # Linear interpolation is off by spacing^2 / 8 times the sum of the two curvatures 1 / r, here at r > 4.
    assert np.abs(distance - (np.linalg.norm(points, axis=1) - 9)).max() < max(spacing) ** 2 / 8 * 2 / 4
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    # A gradient is one of half a voxel off at most, over r.
    assert (normals * outward).sum(axis=1).min() > np.cos(max(spacing) * np.sqrt(3) / 2 / 4)
    # It is known up to its last points, and not beyond.
    for axis in np.eye(3):
        for sign in (-1, 1):
            assert measured(field, sign * 15.9 * axis[None])[1][0] == pytest.approx(6.9, abs=0.02)
            assert measured(field, sign * 16.1 * axis[None])[1][0] == FAR


@pytest.mark.parametrize("edge_radius", [0.0, 1.0])
@pytest.mark.parametrize("offsets", [(6.0, 3.0, 4.0, 6.0, 3.0, 4.0), (2.0, 3.0, 1.5, 9.0, 5.0, 4.0)])
def test_the_quick_distance_test_of_a_tool_has_no_false_positives(one_device, edge_radius, offsets):
    tool = ConvexTool(np.concatenate([np.eye(3), -np.eye(3)]), np.array(offsets), edge_radius)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_about([1, 2, 0], 50), [1.0, -2.0, 3.0]
    tool.move(pose, pose)
    points = scattered()
    _, distance = measured(tool, points)
    place, beyond = zeros(len(points), 3, within=1), zeros(len(points), kind=ti.i32)
    fill((place, points))

    @kernel
    def ask(tool: ti.template(), place: ti.template(), beyond: ti.template()):
        for i in range(place.shape[0]):
            beyond[i] = ti.cast(tool.is_beyond(place[i], 2.0), ti.i32)

    ask(tool, place, beyond)
    is_far = array_of(beyond) > 0
    assert (distance[is_far] > 2.0).all()
    # It sees most of what is beyond, all but what is near to an edge's or corner's corner.
    assert is_far.sum() > 0.9 * (distance > 2.0).sum()


def under_a_tool(mesh) -> Solver:
    """A body on a slab 30 mm thick, its top 12.5 mm under the body's middle, and a tool."""
    tool = ConvexTool.cuboid(np.array([30.0, 8.0, 20.0]))
    slab = trimesh.creation.box([80, 80, 30]).apply_translation([0, 0, -27.5])
    return solver_of(mesh, [SignedDistanceField.of_surface(slab.vertices, slab.faces, 4.0), tool], tool=tool)


@pytest.mark.parametrize("speed_mm_s", [20.0, 400.0, 5000.0])
def test_no_particle_ends_a_step_inside_tool_or_floor(kept, ball, speed_mm_s):
    solver = kept(under_a_tool, ball)
    height, deepest = 25.0, 0.0
    while height > 8.0:
        poses = np.tile(np.eye(4), (4, 1, 1))
        poses[:, 2, 3] = np.linspace(height, max(height - speed_mm_s / 60, 8.0), 4)
        poses[:, 0, 3] = 2.0
        height = poses[-1, 2, 3]
        solver.step(StepSettings(stiffness=0.6), poses)
        x = position(solver)
        assert np.isfinite(x).all()
        in_tool = (10.0 - np.abs(x[:, 2] - height)).clip(None, 4.0 - np.abs(x[:, 1]))
        in_tool = np.minimum(in_tool, 15.0 - np.abs(x[:, 0] - 2.0))
        deepest = max(deepest, in_tool.max(), (-12.5 - x[:, 2]).max())
        assert solver.contacts.measure_penetration() <= 1e-3
    # The tool's face has passed the middle of the ball: it lies 10.5 mm above the floor.
    assert deepest < 1e-3


def test_no_particle_is_left_inside_overlapping_tool_and_floor(kept, ball):
    solver = kept(under_a_tool, ball)
    poses = np.tile(np.eye(4), (4, 1, 1))
    for step in range(60):
        poses[:, 2, 3] = 23.0 - 0.7 * (step + np.arange(4) / 3)
        solver.step(StepSettings(), poses)
        assert solver.contacts.measure_penetration() <= 1e-3
    # The face is 16 mm under the floor's top.
    assert poses[-1, 2, 3] - 10.0 < -28.5
    assert np.isfinite(position(solver)).all()


def oracle_of_pushes(solver: Solver, x: np.ndarray, motion: np.ndarray, iterations: int, factor: float):
    """Where particles (n, 3) go in iterations of pushes with Coulomb's friction in float64; how many of
    those slid, and had two shapes.
    """
    contacts, start = solver.contacts, position(solver)
    plane, touched = array_of(contacts.plane).astype(float), array_of(contacts.touched)
    x, slid, several = x.copy(), 0, 0
    for i in range(len(x)):
        shapes = [s for s in range(len(contacts.shapes)) if touched[i] >> s & 1]
        pushed, rubbed = dict.fromkeys(shapes, 0.0), {s: np.zeros(3) for s in shapes}
        for _ in range(iterations):
            depth = {s: max(plane[i, s, 3] - plane[i, s, :3] @ x[i], 0.0) for s in shapes}
            active = sum(depth[s] > 0 or (contacts.friction > 0 and pushed[s] > 0) for s in shapes)
            share, change = min(factor / max(active, 1), 1.0), np.zeros(3)
            several += active > 1
            for s in shapes:
                normal = plane[i, s, :3]
                pushed[s] += share * depth[s]
                change += share * depth[s] * normal
                if pushed[s] > 0:
                    slip = (np.eye(3) - np.outer(normal, normal)) @ (x[i] - start[i] - motion[s])
                    wanted = rubbed[s] - share * slip
                    most = contacts.friction * pushed[s]
                    slid += np.linalg.norm(wanted) > most
                    wanted *= min(1.0, most / max(np.linalg.norm(wanted), 1e-12))
                    change += wanted - rubbed[s]
                    rubbed[s] = wanted
            x[i] += change
    return x, slid, several


def in_a_corner(mesh) -> Solver:
    """A body over a floor, at a wall and under a tool."""
    floor, wall = Plane(np.array([0.1, 0.0, 1.0]), -6.5), Plane(np.array([-1.0, 0.2, 0.0]), -10.0)
    tool = ConvexTool.cuboid(np.array([14.0, 12.0, 8.0]))
    return solver_of(mesh, [floor, wall, tool], tool=tool)


@pytest.mark.parametrize("factor", [1.0, 1.6])
def test_pushes_and_friction_are_the_oracles(kept, block, factor):
    solver = kept(in_a_corner, block)
    before, now = np.eye(4), np.eye(4)
    before[2, 3], now[:3, 3] = 11.6, [0.3, -0.2, 11.3]
    solver.tool.follow(np.stack([before, now]))
    body, contacts = solver.body, solver.contacts
    fill((body.velocity, np.random.default_rng(8).normal(0, 20, (body.count, 3))))

    @kernel
    def push(body: ti.template(), contacts: ti.template()):
        for i in range(body.count):
            body.predicted[i] += contacts.pushed(i, body.predicted[i], factor)

    # The second time nothing is left of the first.
    for _ in range(2):
        begin(solver, [0.0, 0.0, -1e-3], 0.01)
        motion = np.array([[0.0] * 3, [0.0] * 3, [0.3, -0.2, -0.3]])
        wanted, slid, several = oracle_of_pushes(
            solver, array_of(body.predicted).astype(float), motion, 3, factor
        )
        assert slid > 30 and several > 10
        for _ in range(3):
            push(body, contacts)
        # Float32 positions of 12 mm carry 1e-6 mm, and the same of each plane's offset, in each of three
        # iterations.
        assert np.abs(array_of(body.predicted) - wanted).max() < 2e-5


def test_stabilisation_gets_out_and_moves_position_and_estimate_alike(kept, ball):
    """So that it adds no velocity."""
    solver = kept(on_floor, ball, -10.0, 0.0)
    ends = []
    for iterations in (0, 4):
        begin(solver, [0.0, 0.0, -9810.0], 1 / 180, iterations)
        ends.append((position(solver), array_of(solver.body.predicted)))
    depth = array_of(solver.body.contact_radius) - 10.0 - ends[0][0][:, 2]
    assert depth.max() > 1.0
    for before, after in zip(*ends, strict=True):
        out = np.outer(np.maximum(depth, 0.0), [0.0, 0.0, 1.0])
        assert after - before == pytest.approx(out, abs=1e-5)
