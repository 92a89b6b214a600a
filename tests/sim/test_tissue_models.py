"""Tests of every registered tissue model."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import igl
import numpy as np
import pytest
import taichi as ti
import trimesh
from conftest import rotation_about
from lattice_tissue import lifted

from rehearsal.build_solver import build_solver, embedding_cell_mm, static_shape, step_settings
from rehearsal.configuration import PRESETS
from scenes.scene import SolverSection
from scenes.tissue import QUALITIES, TISSUES, TissueSection
from sim.body import BodyState
from sim.device import start
from sim.divergence_check import DivergenceCheck
from sim.embedding import Embedding
from sim.fields import array_of
from sim.shapes import ConvexTool, Plane
from sim.skinning import Skin
from sim.solver import Solver, SolverState, StepSettings

G, RADIUS_MM = 9810.0, 12.0
# Float32 keeps places up to 16 mm from the origin so well.
ROUNDING_MM = 1e-6
# Where the tool's middle is when it is away; its face is 5 mm under it.
AWAY_MM, FACE_MM = 60.0, 5.0


@dataclass
class Subject:
    """A ball of a model's tissue, with its skin and its initial state."""

    model: str
    mesh: trimesh.Trimesh
    solver: Solver
    skin: Skin
    built: SolverState

    @property
    def tissue(self) -> TissueSection:
        return tissue_of(self.model)

    def settings(self, gravity: float = 0.0, **changed) -> StepSettings:
        """The model's own settings, without damping."""
        settings = step_settings(self.tissue, SolverSection(damping_per_s=0.0))
        return replace(settings, gravity=(0.0, 0.0, -gravity), **changed)

    def put(self, at: np.ndarray, velocity: np.ndarray | float = 0.0) -> None:
        """Set the body's positions (n, 3) and velocities (n, 3)."""
        moving = np.broadcast_to(np.asarray(velocity, np.float32), at.shape).copy()
        self.solver.body.restore(BodyState(at.astype(np.float32), moving))
        if self.solver.contacts is not None:
            self.solver.contacts.reset()
        self.solver.model.update_frames()

    def press(self, settings: StepSettings, first_mm: float, last_mm: float, steps: int) -> None:
        """Move the tool's centre evenly from one height to another."""
        way = np.linspace(first_mm, last_mm, steps * settings.substeps + 1)
        for n in range(0, len(way) - 1, settings.substeps):
            self.solver.step(settings, np.stack([lifted(z) for z in way[n : n + settings.substeps + 1]]))

    def position(self) -> np.ndarray:
        return array_of(self.solver.body.position).astype(float)

    def surface(self) -> np.ndarray:
        """Current positions (n, 3) of the surface points."""
        self.skin.update()
        return array_of(self.skin.vertices).astype(float)

    def bits(self) -> bytes:
        state = self.solver.body.snapshot()
        return state.position.tobytes() + state.velocity.tobytes()


def tissue_of(model: str, **values) -> TissueSection:
    return TISSUES[model].model_validate({"model": model, **values})


def ball_of(model: str, on_table: bool, serial: bool | None = None) -> Subject:
    """A free ball, or one on a table, with the tool far away."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS_MM)
    tool = ConvexTool.cuboid(np.array([10.0, 6.0, 2 * FACE_MM]))
    tool.move(lifted(AWAY_MM), lifted(AWAY_MM))
    floor = Plane(np.array([0.0, 0.0, 1.0]), -RADIUS_MM)
    shapes, led = ([floor, tool], tool) if on_table else ([], None)
    solver = build_solver(mesh, tissue_of(model), shapes, led, serial=serial)
    return Subject(model, mesh, solver, Skin(solver.model.carrier, mesh.vertices), solver.snapshot())


@pytest.fixture(scope="module", params=TISSUES)
def both(request) -> Iterator[tuple[Subject, Subject]]:
    """A free ball and one on a table, built once: that takes longer than the tests."""
    start("cpu")
    yield ball_of(request.param, False), ball_of(request.param, True)
    ti.reset()


@pytest.fixture
def free(both) -> Subject:
    both[0].solver.restore(both[0].built)
    return both[0]


@pytest.fixture
def laid(both) -> Subject:
    both[1].solver.restore(both[1].built)
    return both[1]


def test_a_model_has_presets_from_coarse_to_fine():
    for model in TISSUES:
        presets = [PRESETS[model][quality] for quality in QUALITIES]
        assert {setup.model for setup in presets} == {model}
        assert np.diff([setup.size_mm for setup in presets]).max() < 0
        assert PRESETS[model]["balanced"].tissue == tissue_of(model)


def test_it_reports_its_size(free):
    first, count = next(iter(free.solver.model.counts().items()))
    counts = free.solver.model.counts()
    assert (
        first in ("particles", "nodes")
        and count == free.solver.body.count
        and free.tissue.piece_name in counts
    )
    assert str(count) in free.tissue.report_line.format(**free.tissue.model_dump(), **counts)
    finer = tissue_of(free.model, **{free.tissue.size_key: 0.8 * free.tissue.size_mm})
    assert embedding_cell_mm(finer) == pytest.approx(0.8 * embedding_cell_mm(free.tissue))
    # Its distances are known beyond the 24 mm of the ball.
    assert min(static_shape(free.mesh, free.tissue).shape) > 26


def test_without_forces_it_does_not_move(free):
    settings = free.settings()
    for _ in range(20):
        free.solver.step(settings)
    n = 20 * settings.substeps
    # Each of n substeps rounds some ten operations an iteration, at random; what that moves the body by goes
    # on as a velocity, so that the errors add up twice: to sqrt(n^3 / 3) of one.
    rounding = ROUNDING_MM * (10 * settings.iterations) ** 0.5 * (n**3 / 3) ** 0.5
    assert np.abs(free.position() - free.solver.body.rest_points).max() < 3 * rounding


def test_it_falls_freely(free):
    settings, before, drift = free.settings(G), free.surface(), np.array([50.0, -20.0, 10.0])
    free.put(free.solver.body.rest_points, drift)
    for _ in range(10):
        free.solver.step(settings)
    n, h = 10 * settings.substeps, settings.time_step_s / settings.substeps
    # Symplectic Euler: substep k adds g h^2 k. At 160 mm float32 is off by 1e-5 mm, which goes on as
    # velocity.
    wanted = n * h * drift - [0.0, 0.0, G * h**2 * n * (n + 1) / 2]
    assert free.surface() - before == pytest.approx(np.tile(wanted, (len(before), 1)), abs=1e-5 * n**2)


def test_rotation_continues(free):
    spin, settings, rest, before = 5.0, free.settings(), free.solver.body.rest_points, free.surface()
    free.put(rest, np.cross([0.0, 0.0, spin], rest))
    for _ in range(10):
        free.solver.step(settings)
    time_s, h = 10 * settings.time_step_s, settings.time_step_s / settings.substeps
    a, b = before[:, :2], free.surface()[:, :2]
    turned = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    # What goes straight ahead by a turn of w h is taken back onto the body, and loses a share (w h)^2 of its
    # spin: in all h w^2 t, and half of that of its way.
    assert 1 - h * spin**2 * time_s < turned / (spin * time_s) < 1.0


def test_a_restored_state_continues_with_the_same_bits(laid):
    settings = laid.settings(G)
    laid.press(settings, 18.0, 14.0, 10)
    state, seen, ends = laid.solver.snapshot(), laid.surface(), []
    for _ in range(2):
        laid.press(settings, 14.0, 12.0, 6)
        ends.append(laid.bits())
        laid.solver.restore(state)
        assert np.array_equal(laid.surface(), seen)
    assert ends[0] == ends[1] != laid.bits()


def test_attached_points_move_with_the_body(free):
    rest = free.solver.body.rest_points
    assert np.abs(free.surface() - free.mesh.vertices).max() < 10 * ROUNDING_MM
    turn, way = rotation_about([1, 2, 3], 70), np.array([20.0, -30.0, 40.0])
    free.put(rest @ turn.T + way)
    # At 60 mm float32 is off by 4e-6 mm, over some ten operations.
    assert np.abs(free.surface() - (free.mesh.vertices @ turn.T + way)).max() < 1e-4
    # So is what carries the image plane; elements move what is beside them as the nearest point of the
    # surface, without turning it.
    embedding = Embedding(free.solver.model.carrier, free.mesh, embedding_cell_mm(free.tissue))
    embedding.update()
    rest, at = array_of(embedding.skin.rest), embedding.skin.at
    surface = free.mesh.vertices.view(np.ndarray), free.mesh.faces.view(np.ndarray)
    on_surface = igl.point_mesh_squared_distance(rest.astype(float), *surface)[2]
    beside = np.linalg.norm(rest - at, axis=1) > 1e-4
    assert beside.sum() > 100 and np.abs(at - on_surface)[beside].max() < 1e-4
    turned = rest if free.model == "shape-matching" else at
    assert np.abs(array_of(embedding.skin.vertices) - (turned @ turn.T + way + rest - turned)).max() < 1e-4


def test_a_press_does_not_fold_the_surroundings(laid):
    embedding = Embedding(
        laid.solver.model.carrier, laid.mesh, embedding_cell_mm(laid.tissue), margin_mm=25.0
    )
    laid.press(laid.settings(G), 18.0, 13.0, 12)
    embedding.update()
    first, *others = array_of(embedding.skin.vertices)[array_of(embedding.tetrahedron)].transpose(1, 0, 2)
    volumes = np.linalg.det(np.stack([corner - first for corner in others], axis=1))
    assert (volumes > 0).all(), (volumes <= 0).sum()


def test_pressed_it_deforms_and_recovers(laid):
    settings = laid.settings(G, damping=12.0)
    laid.press(settings, AWAY_MM, AWAY_MM, 60)
    height = laid.surface()[:, 2].max()
    laid.press(settings, height + FACE_MM, height - 6.0 + FACE_MM, 30)
    under = laid.surface()
    under = under[(np.abs(under[:, :2]) < [4.0, 2.0]).all(axis=1), 2].max()
    # A coarse skin bulges between what touches, by less than half of the press.
    assert under < height - 3.0
    # Penetration is 0.05 mm at a pressure of Young's modulus; at a tool's edge the pressure is up to four
    # times that.
    assert laid.solver.contacts.measure_penetration() < 0.2
    laid.press(settings, AWAY_MM, AWAY_MM, 120)
    assert laid.surface()[:, 2].max() == pytest.approx(height, abs=0.3)


ABUSES = {
    "a point": lambda rest: 0.0 * rest,
    "a plane": lambda rest: rest * [1, 1, 0],
    "inside out": lambda rest: rest * [1, 1, -1],
    "blown up": lambda rest: 50.0 * rest,
    "scrambled": lambda rest: np.random.default_rng(1).permutation(rest),
    "torn": lambda rest: rest + np.random.default_rng(0).normal(0, 1000.0, rest.shape),
}


@pytest.mark.parametrize("abuse", ABUSES)
def test_it_stays_finite_under_extreme_states(laid, abuse):
    divergence_check, rest = DivergenceCheck(laid.solver), laid.solver.body.rest_points
    extremes = (
        laid.settings(G),
        laid.settings(10 * G, time_step_s=0.1, iterations=1),
        laid.settings(G, time_step_s=1e-4, iterations=50, relaxation_factor=1.9),
    )
    for settings, speed in product(extremes, (0.0, 1e4)):
        laid.put(ABUSES[abuse](rest), speed * np.sin(rest))
        for _ in range(10):
            laid.solver.step(settings)
        assert divergence_check.health().finite, (settings, speed)
    laid.solver.restore(divergence_check.initial)
    assert divergence_check.health().fault == ""


def test_a_stiffer_material_deforms_less(laid):
    if "young_kpa" not in TISSUES[laid.model].model_fields:
        pytest.skip("a model without a Young's modulus")
    settings, heights = laid.settings(G, damping=12.0), []
    for young_kpa in (3.0, 30.0, laid.tissue.young_kpa):
        laid.solver.restore(laid.built)
        laid.solver.model.set_material(young_kpa)
        laid.press(settings, AWAY_MM, AWAY_MM, 60)
        heights.append(np.ptp(laid.surface()[:, 2]))
    assert heights[0] < heights[2] < heights[1]
    # A ball on a table yields by the power of -2/3 of its modulus (Hertz).
    sags = 2 * RADIUS_MM - np.array(heights)
    assert sags[0] / sags[1] == pytest.approx(10 ** (2 / 3), rel=0.15)
