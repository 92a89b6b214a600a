"""The divergence check restores states that tissue cannot have; fast bodies do not pass through shapes."""

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
from sim.fields import array_of, field_of, zeros
from sim.kernels import kernel
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


def on_floor(kept, model: str, mesh: trimesh.Trimesh) -> Solver:
    """A body on a floor, with nothing else near it."""
    solver = kept(solver_of, model, mesh, floor, tool)
    away(solver)
    return solver


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
    # The best-shaped tetrahedron of neighbours on a cubic grid has three edges of a cell.
    assert np.abs(np.linalg.det(edges)) == pytest.approx(np.ones(len(corners)))
    assert np.linalg.norm(edges, axis=2).max() == 1.0


@pytest.mark.parametrize("model", MODELS)
def test_pressed_tissue_passes_the_check_and_a_diverged_state_is_restored(kept, ball, model):
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
    # NaN: the last good state is restored at once, with zero velocity.
    put(solver, np.full(good.position.shape, np.nan))
    assert "not finite" in divergence_check.check(DT)
    assert (array_of(solver.body.position) == good.position).all()
    assert (array_of(solver.body.velocity) == 0).all()
    # Out of the scene: the last good state was already restored, so the initial state is.
    put(solver, good.position + [0, 0, 600.0])
    assert "left the scene" in divergence_check.check(DT)
    assert (array_of(solver.body.position) == divergence_check.initial.body.position).all()
    assert divergence_check.restorations == 2


@pytest.mark.parametrize("model", MODELS)
def test_a_tangled_state_is_restored_after_a_delay(kept, ball, model):
    solver = on_floor(kept, model, ball)
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
def test_tissue_is_torn_at_a_multiple_of_an_edges_rest_length(kept, ball, model):
    solver = on_floor(kept, model, ball)
    divergence_check = DivergenceCheck(solver)
    for share, tangled in ((0.99, 0.0), (1.01, 1.0)):
        put(solver, share * TORN * solver.body.rest_points)
        assert divergence_check.health().tangled == tangled


def test_the_delay_starts_again_after_a_tangle_is_resolved(kept, ball):
    solver = on_floor(kept, "neo-hookean", ball)
    divergence_check = DivergenceCheck(solver)
    rest = solver.body.rest_points
    # Resolved too early for a good state to be stored, which would restart the delay as well.
    for count in (KEEP_STEPS - 10, PATIENCE_STEPS):
        put(solver, rest * [1, 1, -1])
        assert [divergence_check.check(DT) for _ in range(count)] == [""] * count
        put(solver, rest)
        assert divergence_check.check(DT) == ""
    # The delay in steps is longer for short steps.
    put(solver, rest * [1, 1, -1])
    count = round(PATIENCE_S / (DT / 3))
    assert count > PATIENCE_STEPS and [divergence_check.check(DT / 3) for _ in range(count)] == [""] * count
    assert "inside out" in divergence_check.check(DT / 3)


def test_tissue_near_the_tool_is_not_counted_as_tangled(kept, ball):
    solver = kept(solver_of, "neo-hookean", ball, floor, tool)
    divergence_check = DivergenceCheck(solver)
    put(solver, solver.body.rest_points * [1, 1, -1])
    at = np.eye(4)
    solver.tool.move(at, at)
    # Everything is inverted: counted is what is more than 10 mm from the tool's faces, or from the ball
    # around its corners.
    half = np.array([5.0, 3.0, 5.0])
    at = solver.body.rest_points[array_of(divergence_check.corner)[:, 0]] * [1, 1, -1]
    beyond = (np.abs(at) - half > CRUSHED_MM).any(axis=1)
    beyond |= np.linalg.norm(at, axis=1) > np.linalg.norm(half) + CRUSHED_MM
    assert 0 < beyond.mean() < 0.2
    assert divergence_check.health().tangled == pytest.approx(beyond.mean(), abs=1e-6)


@pytest.mark.parametrize("value", [np.nan, -np.nan, np.inf, -np.inf, 2e12])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_number_of_one_point_is_found(kept, ball, value, axis):
    solver = on_floor(kept, "neo-hookean", ball)
    divergence_check, good = DivergenceCheck(solver), solver.snapshot().body.position
    wrong = good.copy()
    wrong[len(good) // 2, axis] = value
    put(solver, wrong)
    assert not divergence_check.health().finite
    wrong[len(good) // 2, axis] = 0.5e12
    put(solver, wrong)
    assert divergence_check.health().finite and divergence_check.health().is_lost


def test_how_long_ago_a_restored_state_was_is_the_sum_of_the_steps_whatever_their_length(kept, ball):
    solver = on_floor(kept, "neo-hookean", ball)
    divergence_check = DivergenceCheck(solver)
    for length_s in (1 / 60, 1 / 15, 1 / 20, 1 / 15):
        assert divergence_check.check(length_s) == ""
    put(solver, np.full(solver.snapshot().body.position.shape, np.nan))
    # Four steps of 0.2 s in all, and the one that diverged.
    assert "as it was 0.3 s before" in divergence_check.check(0.1)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("velocity", [(0, 0, -1e4), (1e3, 0, -1e6)])
def test_fast_bodies_do_not_pass_through_a_floor(kept, ball, model, velocity):
    # For a block 30 mm thick and for a half-space, from 100 mm above.
    for solver in (on_floor(kept, model, ball), kept(solver_of, model, ball, thick)):
        put(solver, solver.body.rest_points + [0, 0, 100.0], velocity)
        for _ in range(20):
            solver.step(settings(model))
        # The impact is found within 1 mm, and a step of contact leaves some penetration.
        assert position(solver)[:, 2].min() > -12.0 - 6.0


@kernel
def fractions(
    impact: ti.template(), start: ti.template(), path: ti.template(), free: float, out: ti.template()
):
    for i in range(start.shape[0]):
        out[i] = impact.fraction(start[i], path[i], free)


@kernel
def clearances(shape: ti.template(), at: ti.template(), out: ti.template()):
    for i in range(at.shape[0]):
        out[i] = shape.clearance(at[i])


def wall() -> Plane:
    return Plane(np.array([-1.0, 0.0, 0.0]), -30.0)


def stopped_after(mm: float):
    """Share of a path of 200 mm: so many, and the impact depth."""
    return pytest.approx((mm + IMPACT_DEPTH_MM) / 200, abs=1e-3)


@pytest.mark.parametrize(
    ("shapes", "start", "way", "share"),
    [
        # From 52 mm above the floor, 200 mm down.
        ([floor, tool], [0, 0, 40.0], [0, 0, -200.0], stopped_after(52)),
        ([floor, tool], [0, 0, 40.0], [0, 0, 200.0], 1.0),
        ([floor, tool], [0, 0, -12.0], [20.0, 0, 0], 1.0),
        ([floor, tool], [0, 0, -20.0], [0, 0, -2.9], 1.0),
        # A point deep inside moves no farther than the free length.
        ([floor, tool], [0, 0, -20.0], [0, 0, -30.0], pytest.approx(0.1)),
        # Moving shapes are ignored.
        ([tool], [0, 0, 40.0], [0, 0, -200.0], 1.0),
        ([floor, wall], [0, 0, 40.0], [0, 0, -200.0], stopped_after(52)),
        ([wall, floor], [0, 0, 40.0], [0, 0, -200.0], stopped_after(52)),
        ([floor, wall], [0, 0, 40.0], [200.0, 0, 0], stopped_after(30)),
        ([wall, floor], [0, 0, 40.0], [200.0, 0, 0], stopped_after(30)),
    ],
)
def test_a_path_ends_at_the_time_of_impact_with_the_first_shape(one_device, shapes, start, way, share):
    out = zeros(1)
    fractions(TimeOfImpact([shape() for shape in shapes]), field_of([start], 1), field_of([way], 1), 3.0, out)
    assert array_of(out)[0] == share


def test_clearance_is_not_more_than_the_distance(one_device, ball):
    shape = SignedDistanceField.of_surface(ball.vertices, ball.faces, 4.0)
    points = np.random.default_rng(1).uniform(-40, 40, (2000, 3))
    out = zeros(len(points))
    clearances(shape, field_of(points, 1), out)
    true = np.linalg.norm(points, axis=1) - 12.0
    # Linear interpolation: an error of less than half the diagonal of a cell; outside the grid of half a cell
    # at most.
    assert (array_of(out) <= true + np.sqrt(3) / 2 * GRID_MM).all()
    near = np.abs(true) < 3.0
    assert array_of(out)[near] == pytest.approx(true[near], abs=0.1)


def test_clearance_outside_a_grid_is_the_distance_to_it(one_device):
    spacing = np.array([0.5, 1.0, 2.0])
    grid = np.moveaxis(np.indices((65, 33, 17)), 0, -1) * spacing - 16.0
    shape = SignedDistanceField(np.linalg.norm(grid, axis=-1) - 12.0, np.full(3, -16.0), spacing)
    points = np.random.default_rng(2).uniform(-40, 40, (2000, 3))
    points = points[(np.abs(points) > 16.0).any(axis=1)]
    out = zeros(len(points))
    clearances(shape, field_of(points, 1), out)
    way = np.linalg.norm(points - np.clip(points, -16.0, 16.0), axis=1)
    # And a little more, so that paths end in the grid.
    assert array_of(out) == pytest.approx(way + OUTSIDE_GRID_CELLS * 0.5, abs=1e-4)


def test_a_body_on_few_contact_points_is_at_rest(one_device):
    egg = trimesh.creation.icosphere(subdivisions=4).apply_scale((30.0, 18.0, 15.0))
    solver = lattice_tissue(egg, 5.0, [Plane(np.array([0.0, 0.0, 1.0]), -15.0)], friction=0.35)
    for _ in range(150):
        solver.step(settings("neo-hookean"))
    last = position(solver)
    for _ in range(20):
        solver.step(settings("neo-hookean"))
        # Positions of 30 mm have 2e-6 mm in float32, which a step of 1/60 s makes 1e-4 mm/s; it shook with 4
        # mm/s once.
        assert np.abs(array_of(solver.body.velocity)).max() < 0.05
    assert np.abs(position(solver) - last).max() < 0.01


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        (dict(time_step_s=0.0), "time_step_s.*greater than or equal"),
        (dict(time_step_s=float("nan")), "time_step_s.*finite"),
        (dict(iterations=0), "iterations.*greater"),
        (dict(substeps=101), "substeps.*less than or equal to 100"),
        (dict(relaxation_factor=2.1), "relaxation_factor.*less"),
        (dict(stiffness=-0.1), "stiffness.*greater than or equal to 0"),
        (dict(gravity=(0.0, float("inf"), 0.0)), "gravity.*finite"),
    ],
)
def test_settings_out_of_range_are_named(kept, ball, changed, named):
    solver = on_floor(kept, "shape-matching", ball)
    before = position(solver)
    with pytest.raises(ValueError, match=f"(?s){named}"):
        solver.step(StepSettings(**changed))
    assert (position(solver) == before).all()


def test_a_pose_that_is_not_finite_is_refused(kept, ball):
    solver = kept(solver_of, "shape-matching", ball, floor, tool)
    poses = np.tile(np.eye(4), (settings("shape-matching").substeps + 1, 1, 1))
    poses[-1, 0, 3] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        solver.step(settings("shape-matching"), poses)


def test_only_a_healthy_state_is_stored_as_good(kept, ball):
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
