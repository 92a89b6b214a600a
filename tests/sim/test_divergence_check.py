"""A divergence_check sees what no tissue is, waits for what heals, and puts back the rest; fast bodies do not pass through shapes."""

from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti
import trimesh
from lattice_tissue import G, position, settings_of
from lattice_tissue import tissue_of as lattice_tissue
from particle_tissue import tissue_of as particle_tissue

from sim.body import BodyState
from sim.divergence_check import (
    CRUSHED_MM,
    KEEP_STEPS,
    PATIENCE_S,
    PATIENCE_STEPS,
    TORN,
    DivergenceCheck,
    tetrahedra_among,
)
from sim.fields import array_of, fill
from sim.shapes import (
    GRID_MM,
    IMPACT_DEPTH_MM,
    OUTSIDE_GRID_CELLS,
    ConvexTool,
    Plane,
    SignedDistanceField,
    TimeOfImpact,
)
from sim.solver import Solver, StepSettings

DOWN = (0.0, 0.0, -G)
DT = 1 / 60
MODELS = ["neo-hookean", "shape-matching"]


def floor() -> Plane:
    return Plane(np.array([0.0, 0.0, 1.0]), -12.0)


def tool() -> ConvexTool:
    return ConvexTool.cuboid(np.array([10.0, 6.0, 10.0]))


def away(solver: Solver) -> None:
    """The tool far from the body."""
    far = np.eye(4)
    far[2, 3] = 200.0
    solver.tool.move(far, far)


def thick() -> SignedDistanceField:
    """A floor that is a block 30 mm thick."""
    block = trimesh.creation.box(bounds=[[-40, -40, -42.0], [40, 40, -12.0]])
    return SignedDistanceField.of_surface(block.vertices, block.faces, 6.0)


def solver_of(model: str, mesh: trimesh.Trimesh, *shapes: Callable) -> Solver:
    made = [shape() for shape in shapes]
    if model == "neo-hookean":
        return lattice_tissue(mesh, 4.0, made, friction=0.35)
    moving = next((shape for shape in made if shape.moves), None)
    return Solver(particle_tissue(mesh, shapes=made), tool=moving)


def settings(model: str) -> StepSettings:
    return settings_of(8, DOWN) if model == "neo-hookean" else StepSettings(gravity=DOWN)


def put(solver: Solver, x: np.ndarray, velocity=(0.0, 0.0, 0.0)) -> None:
    speeds = np.tile(np.float32(velocity), (len(x), 1))
    solver.body.restore(BodyState(x.astype(np.float32), speeds))
    solver.contacts.reset()


def test_tetrahedra_are_small_and_none_is_flat():
    assert len(tetrahedra_among(np.zeros((3, 3)))) == 0
    plane = np.random.default_rng(0).uniform(size=(50, 3)) * [1, 1, 0]
    assert len(tetrahedra_among(plane)) == 0
    grid = np.indices((12, 12, 12)).reshape(3, -1).T.astype(float)
    corners = tetrahedra_among(grid)
    edges = grid[corners[:, 1:]] - grid[corners[:, :1]]
    # The best of neighbours on a cubic grid are three edges of a cell.
    assert np.abs(np.linalg.det(edges)) == pytest.approx(np.ones(len(corners)))
    assert np.linalg.norm(edges, axis=2).max() == 1.0


@pytest.mark.parametrize("model", MODELS)
def test_a_guard_lets_tissue_be_pressed_and_puts_back_what_is_none(kept, ball, model):
    solver = kept(solver_of, model, ball, floor, tool)
    divergence_check = DivergenceCheck(solver)
    poses = np.tile(np.eye(4), (settings(model).substeps + 1, 1, 1))
    for step in range(90):
        poses[:, 2, 3] = 17.0 - 4.0 * min(step / 60, 1.0)
        solver.step(settings(model), poses)
        assert divergence_check.check(DT) == ""
    assert divergence_check.health().finite and divergence_check.health().tangled == 0.0
    good = divergence_check.state.good.body
    assert np.abs(good.position - solver.body.rest_state().position).max() > 0.5
    # Not a number: back at once, at rest.
    put(solver, np.full(good.position.shape, np.nan))
    assert "not finite" in divergence_check.check(DT)
    assert (array_of(solver.body.position) == good.position).all()
    assert (array_of(solver.body.velocity) == 0).all()
    # Gone: the same state has failed before, so it is the first one now.
    put(solver, good.position + [0, 0, 600.0])
    assert "left the scene" in divergence_check.check(DT)
    assert (array_of(solver.body.position) == divergence_check.initial.body.position).all()
    assert divergence_check.restorations == 2


@pytest.mark.parametrize("model", MODELS)
def test_a_tangle_is_given_time_and_then_put_back(kept, ball, model):
    solver = kept(solver_of, model, ball, floor, tool)
    away(solver)
    divergence_check = DivergenceCheck(solver)
    mirrored = solver.body.rest_points * [1, 1, -1]
    flat = solver.body.rest_points * [1, 1, 1e-3]
    for state in (mirrored, flat, 5.0 * solver.body.rest_points):
        put(solver, state)
        assert divergence_check.health().tangled > 0.99
        said = [divergence_check.check(DT) for _ in range(PATIENCE_STEPS + 1)]
        assert said[:-1] == [""] * PATIENCE_STEPS
        assert "torn, flat or inside out" in said[-1]
        assert divergence_check.health().tangled == 0.0


@pytest.mark.parametrize("model", MODELS)
def test_tissue_is_torn_where_an_edge_is_as_many_times_its_own_length_as_that_takes(kept, ball, model):
    solver = kept(solver_of, model, ball, floor)
    divergence_check = DivergenceCheck(solver)
    for share, tangled in ((0.99, 0.0), (1.01, 1.0)):
        put(solver, share * TORN * solver.body.rest_points)
        assert divergence_check.health().tangled == tangled


def test_a_tangle_that_was_undone_is_given_its_time_again(kept, ball):
    solver = kept(solver_of, "neo-hookean", ball, floor)
    divergence_check = DivergenceCheck(solver)
    rest = solver.body.rest_points
    # Undone too early for a good state to be kept, which would begin anew as well.
    for count in (KEEP_STEPS - 10, PATIENCE_STEPS):
        put(solver, rest * [1, 1, -1])
        assert [divergence_check.check(DT) for _ in range(count)] == [""] * count
        put(solver, rest)
        assert divergence_check.check(DT) == ""
    # Of short steps there are more in the time that it is given.
    put(solver, rest * [1, 1, -1])
    count = round(PATIENCE_S / (DT / 3))
    assert count > PATIENCE_STEPS and [divergence_check.check(DT / 3) for _ in range(count)] == [""] * count
    assert "inside out" in divergence_check.check(DT / 3)


def test_what_the_tool_crushes_is_no_tangle(kept, ball):
    solver = kept(solver_of, "neo-hookean", ball, floor, tool)
    divergence_check = DivergenceCheck(solver)
    put(solver, solver.body.rest_points * [1, 1, -1])
    at = np.eye(4)
    solver.tool.move(at, at)
    # Everything is inside out: what counts is more than 10 mm from the tool's faces, or from the ball about its corners.
    half = np.array([5.0, 3.0, 5.0])
    at = solver.body.rest_points[array_of(divergence_check.corner)[:, 0]] * [1, 1, -1]
    beyond = (np.abs(at) - half > CRUSHED_MM).any(axis=1)
    beyond |= np.linalg.norm(at, axis=1) > np.linalg.norm(half) + CRUSHED_MM
    assert 0 < beyond.mean() < 0.2
    assert divergence_check.health().tangled == pytest.approx(beyond.mean(), abs=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_a_torn_point_ends_no_step_as_no_number(kept, ball, model):
    solver = kept(solver_of, model, ball, floor)
    for mm in (100.0, 1000.0):
        put(solver, solver.body.rest_points + np.random.default_rng(0).normal(0, mm, (solver.body.count, 3)))
        for _ in range(5):
            solver.step(settings(model))
        assert np.isfinite(position(solver)).all(), mm


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("velocity", [(0, 0, -1e4), (1e3, 0, -1e6)])
def test_nothing_fast_goes_through_a_floor(kept, ball, model, velocity):
    # Of a block 30 mm thick and of the half-space alike, from 100 mm above.
    for shape in (floor, thick):
        solver = kept(solver_of, model, ball, shape)
        put(solver, solver.body.rest_points + [0, 0, 100.0], velocity)
        for _ in range(20):
            solver.step(settings(model))
        # It meets the floor within 1 mm and sinks in by what a step of contact leaves.
        assert position(solver)[:, 2].min() > -12.0 - 6.0, shape


@ti.kernel
def fractions(
    impact: ti.template(), start: ti.template(), path: ti.template(), free: float, out: ti.template()
):
    for i in start:
        out[i] = impact.fraction(start[i], path[i], free)


@ti.kernel
def clearances(shape: ti.template(), at: ti.template(), out: ti.template()):
    for i in at:
        out[i] = shape.clearance(at[i])


def field_of(values) -> ti.Field:
    values = np.atleast_2d(np.asarray(values, np.float32))
    field = ti.Vector.field(3, ti.f32, len(values))
    fill((field, values))
    return field


def share_of(shapes: list, start, way, free: float) -> float:
    out = ti.field(ti.f32, 1)
    fractions(TimeOfImpact(shapes), field_of(start), field_of(way), free, out)
    return float(out[0])


def test_a_way_ends_where_it_meets_a_shape(one_device):
    shapes = [floor(), ConvexTool.cuboid(np.array([10.0, 6.0, 10.0]))]
    # From 52 mm above the floor, 200 mm down: 52 mm and the depth at which it may be felt.
    assert share_of(shapes, [0, 0, 40.0], [0, 0, -200.0], 3.0) == pytest.approx(
        (52 + IMPACT_DEPTH_MM) / 200, abs=1e-3
    )
    assert share_of(shapes, [0, 0, 40.0], [0, 0, 200.0], 3.0) == 1.0
    assert share_of(shapes, [0, 0, -12.0], [20.0, 0, 0], 3.0) == 1.0
    assert share_of(shapes, [0, 0, -20.0], [0, 0, -2.9], 3.0) == 1.0
    # What is deep inside already goes no farther than what is free.
    assert share_of(shapes, [0, 0, -20.0], [0, 0, -30.0], 3.0) == pytest.approx(0.1)
    # The tool moves: it is met by what it does, not by where the point goes.
    assert share_of(shapes[1:], [0, 0, 40.0], [0, 0, -200.0], 3.0) == 1.0


def test_of_several_shapes_the_first_on_the_way_ends_it(one_device):
    wall = Plane(np.array([-1.0, 0.0, 0.0]), -30.0)
    for shapes in ([floor(), wall], [wall, floor()]):
        assert share_of(shapes, [0, 0, 40.0], [0, 0, -200.0], 3.0) == pytest.approx(
            (52 + IMPACT_DEPTH_MM) / 200, abs=1e-3
        )
        assert share_of(shapes, [0, 0, 40.0], [200.0, 0, 0], 3.0) == pytest.approx(
            (30 + IMPACT_DEPTH_MM) / 200, abs=1e-3
        )


def test_room_is_no_more_than_the_distance(one_device, ball):
    shape = SignedDistanceField.of_surface(ball.vertices, ball.faces, 4.0)
    points = np.random.default_rng(1).uniform(-40, 40, (2000, 3))
    out = ti.field(ti.f32, len(points))
    clearances(shape, field_of(points), out)
    true = np.linalg.norm(points, axis=1) - 12.0
    # Linear between points of a grid: off by less than half its diagonal; beyond the grid by half a cell at most.
    assert (array_of(out) <= true + np.sqrt(3) / 2 * GRID_MM).all()
    near = np.abs(true) < 3.0
    assert array_of(out)[near] == pytest.approx(true[near], abs=0.1)


def test_room_beyond_a_grid_is_the_way_to_it_whatever_its_spacing(one_device):
    spacing = np.array([0.5, 1.0, 2.0])
    grid = np.moveaxis(np.indices((65, 33, 17)), 0, -1) * spacing - 16.0
    shape = SignedDistanceField(np.linalg.norm(grid, axis=-1) - 12.0, np.full(3, -16.0), spacing)
    points = np.random.default_rng(2).uniform(-40, 40, (2000, 3))
    points = points[(np.abs(points) > 16.0).any(axis=1)]
    out = ti.field(ti.f32, len(points))
    clearances(shape, field_of(points), out)
    way = np.linalg.norm(points - np.clip(points, -16.0, 16.0), axis=1)
    # And a hair into it, so that ways end in the grid.
    assert array_of(out) == pytest.approx(way + OUTSIDE_GRID_CELLS * 0.5, abs=1e-4)


def test_a_body_on_few_points_stands_still(one_device):
    egg = trimesh.creation.icosphere(subdivisions=4).apply_scale((30.0, 18.0, 15.0))
    solver = lattice_tissue(egg, 5.0, [Plane(np.array([0.0, 0.0, 1.0]), -15.0)], friction=0.35)
    for _ in range(150):
        solver.step(settings("neo-hookean"))
    last = position(solver)
    for _ in range(20):
        solver.step(settings("neo-hookean"))
        # Positions of 30 mm have 2e-6 mm in float32, which a step of 1/60 s makes 1e-4 mm/s; it shook with 4 mm/s once.
        assert np.abs(array_of(solver.body.velocity)).max() < 0.05
    assert np.abs(position(solver) - last).max() < 0.01


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        (dict(time_step_s=0.0), "time_step_s is 0.0"),
        (dict(time_step_s=float("nan")), "time_step_s is nan"),
        (dict(iterations=0), "iterations is 0"),
        (dict(substeps=101), "substeps is 101: expected 1 to 100"),
        (dict(relaxation_factor=2.1), "relaxation_factor is 2.1"),
        (dict(stiffness=-0.1), "stiffness is -0.1: expected 0 to 1"),
        (dict(gravity=(0.0, float("inf"), 0.0)), "gravity is"),
    ],
)
def test_settings_of_no_step_are_named(kept, ball, changed, named):
    solver = kept(solver_of, "shape-matching", ball, floor)
    before = position(solver)
    with pytest.raises(ValueError, match=named.replace("(", r"\(")):
        solver.step(StepSettings(**changed))
    assert (position(solver) == before).all()


def test_a_pose_that_is_no_number_is_refused(kept, ball):
    solver = kept(solver_of, "shape-matching", ball, floor, tool)
    poses = np.tile(np.eye(4), (settings("shape-matching").substeps + 1, 1, 1))
    poses[-1, 0, 3] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        solver.step(settings("shape-matching"), poses)


def test_tissue_is_kept_for_good_when_asked_for_but_not_what_is_none(kept, ball):
    solver = kept(solver_of, "neo-hookean", ball, floor)
    divergence_check = DivergenceCheck(solver)
    for _ in range(5):
        solver.step(settings("neo-hookean"))
        divergence_check.check(DT)
    divergence_check.store_if_healthy()
    good = position(solver)
    assert (
        np.array_equal(divergence_check.state.good.body.position, good)
        and divergence_check.state.steps_since_good == 0
    )
    put(solver, np.zeros_like(good))
    divergence_check.store_if_healthy()
    assert np.array_equal(divergence_check.state.good.body.position, good)
