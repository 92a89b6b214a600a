"""A time step of Algorithm 1 against closed forms, and its determinism."""

import numpy as np
import pytest
from lattice_tissue import position
from particle_tissue import tissue_of

from sim.body import ParticleBody
from sim.fields import array_of
from sim.sampling import fill_body
from sim.self_contact import SelfContacts
from sim.shapes import ConvexTool, Plane, SignedDistanceField
from sim.solver import Solver, StepSettings

G = 9810.0


def solver_of(
    mesh,
    shapes=(),
    friction=0.35,
    radius=2.0,
    relaxation="local",
    pairs=False,
    scaling=0.0,
    tool=None,
    serial=None,
):
    model = tissue_of(mesh, radius, shapes, friction, relaxation, scaling, serial=serial)
    particle_contacts = SelfContacts(model, 0.25) if pairs else None
    return Solver(model, particle_contacts, tool)


def test_more_shapes_than_contacts_have_bits_for_are_refused(one_device, ball):
    floor = Plane(np.array([0.0, 0.0, 1.0]), -12.0)
    assert solver_of(ball, [floor] * 31).contacts is not None
    with pytest.raises(ValueError, match="32 shapes: expected at most 31"):
        solver_of(ball, [floor] * 32)


def on_floor(mesh, height_mm: float, friction: float = 0.35) -> Solver:
    """A body over a plane."""
    return solver_of(mesh, [Plane(np.array([0.0, 0.0, 1.0]), height_mm)], friction)


def in_bowl(mesh) -> Solver:
    """A body in ``bowl``, which it slides in without friction."""
    return solver_of(mesh, [bowl()], friction=0.0)


@pytest.mark.parametrize("damping", [0.0, 12.0])
def test_free_fall_matches_the_integrator(kept, block, damping):
    solver = kept(solver_of, block)
    settings = StepSettings(damping=damping, stiffness=0.9)
    start_at = position(solver)
    steps = 30
    for _ in range(steps):
        solver.step(settings)
    h = settings.time_step_s / settings.substeps
    velocity = fallen = 0.0
    for _ in range(steps * settings.substeps):
        velocity = velocity * np.exp(-damping * h) - G * h
        fallen += h * velocity
    moved = position(solver) - start_at
    assert fallen < -200
    # Each of n substeps rounds positions of up to 1300 mm (6e-5 mm) 9 times, at random; what is left over is
    # a velocity that goes on, so the errors add up twice: to sqrt(n^3 / 3) of one.
    n = steps * settings.substeps
    assert np.abs(moved - [0, 0, fallen]).max() < 6e-5 * 9**0.5 * (n**3 / 3) ** 0.5


def slide(kept, block, slope_deg: float, friction: float = 0.35) -> tuple[float, float]:
    """Acceleration down a slope over 0.2 s, relative to g, and the final speed [mm/s]; it starts from
    rest.
    """
    angle = np.radians(slope_deg)
    solver = kept(on_floor, block, -8.0, friction)
    settings = StepSettings(
        gravity=(G * np.sin(angle), 0.0, -G * np.cos(angle)), damping=0.0, stiffness=1.0, iterations=30
    )
    speeds = []
    for steps in (8, 12):
        for _ in range(steps):
            solver.step(settings)
        speeds.append(array_of(solver.body.velocity).astype(float)[:, 0].mean())
    return (speeds[1] - speeds[0]) / 0.2 / G, speeds[1]


FRICTION = 0.35
CRITICAL_DEG = np.degrees(np.arctan(FRICTION))


@pytest.mark.parametrize(
    ("slope_deg", "speeds"), [(CRITICAL_DEG - 0.5, (-5.0, 5.0)), (CRITICAL_DEG + 0.5, (10, 1000))]
)
def test_sliding_starts_at_the_friction_angle(kept, block, slope_deg, speeds):
    # Without friction either slope would give it more than 1000 mm/s by then.
    assert speeds[0] < slide(kept, block, slope_deg)[1] < speeds[1]


# It rocks and settles while it slides with friction: 5 %.
@pytest.mark.parametrize(
    ("slope_deg", "friction", "off"), [(25.0, 0.35, 0.05), (35.0, 0.35, 0.05), (10.0, 0.0, 0.02)]
)
def test_beyond_it_the_block_accelerates_by_coulombs_law(kept, block, slope_deg, friction, off):
    angle = np.radians(slope_deg)
    wanted = np.sin(angle) - friction * np.cos(angle)
    assert slide(kept, block, slope_deg, friction)[0] == pytest.approx(wanted, rel=off)


@pytest.mark.parametrize("serial", [True, False])
def test_the_tool_follows_its_poses_and_stays_at_the_last(kept, block, serial):
    tool = ConvexTool.cuboid(np.array([4.0, 4.0, 4.0]))
    solver = solver_of(block, [tool], tool=tool, serial=serial)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = 30.0 + np.array([[0.0], [0.5], [1.5], [3.5]]) * [1.0, -2.0, 3.0]
    for way, motion in ((poses, [2.0, -4.0, 6.0]), (None, [0.0] * 3)):
        solver.step(StepSettings(substeps=3, iterations=1), way)
        assert np.array_equal(array_of(tool.pose), poses[-1].astype(np.float32))
        # Back to where it was a substep before.
        assert array_of(tool.step_back)[:3, 3] == pytest.approx(-np.array(motion), abs=1e-5)


def test_sliding_over_a_curved_surface_does_not_sink_in(kept, ball):
    solver = kept(in_bowl, ball)
    radius = array_of(solver.body.contact_radius).astype(float)
    deepest, first = 0.0, position(solver)
    for step in range(30):
        angle = 0.1 * step
        solver.step(StepSettings(gravity=(G * np.sin(angle), 0.0, -G * np.cos(angle)), damping=0.0))
        deepest = max(deepest, (np.linalg.norm(position(solver), axis=1) + radius - 13.0).max())
    assert np.linalg.norm(position(solver) - first, axis=1).max() > 1.5
    # The grid's own distances are off by spacing^2 / 8 times the two curvatures 1 / r, r > 10 mm, towards the
    # inside.
    assert deepest < 1 / 8 * 2 / 10 + 1e-3


def bowl() -> SignedDistanceField:
    """Distances to the inside of a ball of 13 mm, in which one of 12 mm rolls."""
    x, y, z = np.meshgrid(*[np.arange(-20.0, 21.0)] * 3, indexing="ij")
    distance = 13.0 - np.sqrt(x**2 + y**2 + z**2)
    return SignedDistanceField(distance, np.full(3, -20.0), np.ones(3))


@pytest.mark.parametrize("iterations", [1, 2, 10])
@pytest.mark.parametrize("factor", [1.5, 2.0])
def test_over_relaxation_is_stable(kept, ball, iterations, factor):
    solver = kept(on_floor, ball, -12.0)
    settings = StepSettings(stiffness=1.0, iterations=iterations, relaxation_factor=factor, damping=0.0)
    for _ in range(40):
        solver.step(settings)
    assert np.abs(position(solver)).max() < 40
    assert np.abs(array_of(solver.body.velocity)).max() < 2000


def test_over_relaxation_converges_faster(kept, ball):
    sag = []
    for factor in (1.0, 1.8):
        solver = kept(on_floor, ball, -12.0)
        for _ in range(60):
            solver.step(StepSettings(stiffness=1.0, relaxation_factor=factor, iterations=5))
        sag.append(24.0 - np.ptp(position(solver)[:, 2]))
    assert sag[1] < 0.8 * sag[0]


def test_features_switched_off_take_no_memory(kept, block):
    solver = kept(solver_of, block)
    assert not hasattr(solver.body, "mass_scale") and solver.contacts is None and solver.self_contacts is None
    assert hasattr(ParticleBody(fill_body(block, 2.0), 0.1), "mass_scale")
    assert not hasattr(kept(on_floor, block, -8.0, 0.0).contacts, "push")
