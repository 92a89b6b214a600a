"""Cost of each feature of a scene: the same press with it and without it, in turn."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti
import trimesh
from taichi.profiler.kernel_profiler import get_default_kernel_profiler

from rehearsal.build_solver import build_solver, embedding_cell_mm, model_of, step_settings
from rehearsal.configuration import probe_of
from rehearsal.frame_view import image_view, initial_settings, probe_with_settings
from rehearsal.measurements.run_report import Tally
from rehearsal.rehearsal import SURROUNDINGS_MM, Rehearsal, scanned_anatomy
from rehearsal.stopwatch import timed
from render.background_image import BackgroundImage
from render.window_layout import WindowLayout
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Contact, Scene, SolverSection, with_options
from scenes.surfaces import translated
from scenes.tissue import TISSUES, ShapeMatchingTissue, TissueSection
from sim.device import start
from sim.embedding import Embedding
from sim.shape_matching import fill_organ
from sim.shapes import GRID_MM, ConvexTool, SignedDistanceField
from sim.signed_distance import distance_grid
from sim.solver import Solver
from studies.performance.step_timing import memory_mb
from ultrasound.probe import DetailLevel, Mode
from ultrasound.probe_manipulator import advanced, image_plane, pose_at, poses_between, touching
from ultrasound.scanner import ScannedAnatomy, Scanner

# Depth and steps of the press, and the steps before it in which the body settles.
PRESS_MM, PRESS_STEPS, SETTLE_STEPS = 8.0, 60, 30
CALLS = 40
NOT_COUNTED: dict[str, Any] = dict(kernels=None, launches=None)


@dataclass(frozen=True)
class Options:
    """The features of a scene that a step computes; the defaults are those of the embedded patient."""

    support: bool = True
    transducer: bool = True
    shape_friction: float = 0.35
    particles: bool = False
    particle_friction: float = 0.0
    mass_scaling_per_mm: float = 0.0


@dataclass(frozen=True)
class Feature:
    """One feature: the options of a step ``having`` it, and of the same step ``without``."""

    name: str
    having: Options
    without: Options


BASE = Options()
EVERYWHERE = (
    Feature("contact with the support", Options(transducer=False), Options(transducer=False, support=False)),
    Feature("the transducer", BASE, Options(transducer=False)),
    Feature("friction on shapes", BASE, Options(shape_friction=0.0)),
)
OF_PARTICLES = (
    Feature("contacts of particles", Options(particles=True), BASE),
    Feature(
        "friction of particles", Options(particles=True, particle_friction=0.25), Options(particles=True)
    ),
    Feature("scaled masses", Options(mass_scaling_per_mm=0.02), BASE),
)
FEATURES = {
    model: (*EVERYWHERE, *OF_PARTICLES) if section.CAN_TOUCH_ITSELF else EVERYWHERE
    for model, section in TISSUES.items()
}


class FeatureBody:
    """A scene's organ and support, for solvers with different features; positions relative to the organ's middle [mm]."""

    def __init__(self, scene: Scene, anatomy: LoadedAnatomy, tissue: TissueSection) -> None:
        self.tissue = tissue
        self.settings = step_settings(tissue, scene.solver)
        middle = anatomy.organ.bounds.mean(axis=0)
        self.organ = translated(anatomy.organ, -middle)
        reach_mm = model_of(tissue).reach_mm(tissue)
        self.supports = [
            distance_grid(shape.vertices - middle, shape.faces, GRID_MM, reach_mm)
            for shape in anatomy.shapes
            if isinstance(shape, trimesh.Trimesh)
        ]
        self.filled = (
            fill_organ(self.organ, tissue) if isinstance(tissue, ShapeMatchingTissue) else self.organ
        )
        down = np.array(scene.gravity.direction) / np.linalg.norm(scene.gravity.direction)
        x, y, z = (1e3 * scene.gravity.acceleration_m_s2 * down).tolist()
        self.settings.gravity = (x, y, z)
        self.size_mm = np.array(probe_of(scene).housing_mm)
        side = np.eye(3)[np.abs(down).argmin()]
        pose = pose_at(np.zeros(3), down, side, self.size_mm[2])
        self.home = touching(pose, self.size_mm, self.organ.vertices)

    def solver(self, options: Options, serial: bool | None = None) -> Solver:
        """A solver with some features."""
        tool = ConvexTool.cuboid(self.size_mm) if options.transducer else None
        shapes: list = []
        if options.support:
            shapes = [SignedDistanceField(*grid, np.full(3, GRID_MM)) for grid in self.supports]
        contact = Contact(
            shape_friction=options.shape_friction,
            particles=options.particles,
            particle_friction=options.particle_friction,
        )
        section = SolverSection(mass_scaling_per_mm=options.mass_scaling_per_mm)
        return build_solver(
            self.filled,
            self.tissue,
            [*shapes, tool] if tool else shapes,
            tool,
            contact,
            section,
            serial=serial,
        )

    def poses(self, solver: Solver, step: int) -> np.ndarray | None:
        """Poses of the transducer in a step of the press; None without a transducer."""
        if not solver.has_tool:
            return None
        depth = PRESS_MM * np.clip((step + np.array([0, 1]) - SETTLE_STEPS) / PRESS_STEPS, 0, 1)
        return poses_between(
            advanced(self.home, depth[0]), advanced(self.home, depth[1]), self.settings.substeps
        )


def body_of(scene: Scene, anatomy: LoadedAnatomy, model: str, size_mm: float) -> FeatureBody:
    """The scene's organ in a tissue model, of cells or particles of a size [mm]."""
    options: dict[str, str | float | None] = {"tissue.model": model, f"tissue.{TISSUES[model].SIZE}": size_mm}
    tissue = with_options(scene, options).tissue
    return FeatureBody(scene, anatomy, tissue)


def of_steps(
    body: FeatureBody, features: tuple[Feature, ...], arch: str, quick: bool, done: Callable[[], Any]
) -> list[dict[str, Any]]:
    """Each feature's rows of features.json: median times, memory and parallel kernels, with it and without it.

    Solvers with and without are stepped in turn; ``quick`` steps each of them once and counts no kernels.
    """
    counted: dict[Options, dict[str, Any]] = {}
    alone: dict[Options, dict[str, float]] = {}
    rows = []
    for feature in features:
        variants = {"on": feature.having, "off": feature.without}
        for options in variants.values():
            if quick and options not in alone:
                alone[options] = _stepped(body, [options], arch)[0]
            if options not in counted:
                counted[options] = NOT_COUNTED if quick else kernels_of(body, options, arch)
        both = list(variants.values())
        stepped = [alone[options] for options in both] if quick else _stepped(body, both, arch)
        row: dict[str, Any] = dict(feature=feature.name)
        for (state, options), figures in zip(variants.items(), stepped, strict=True):
            row |= {f"{name}_{state}": value for name, value in (figures | counted[options]).items()}
        rows.append(row)
        done()
    return rows


def _stepped(body: FeatureBody, variants: list[Options], arch: str) -> list[dict[str, Any]]:
    """Median time of a step [ms] in a press, and memory [MB], of solvers that are stepped in turn."""
    start(arch)
    solvers = [body.solver(options) for options in variants]
    ms: list[list[float]] = [[] for _ in solvers]
    for step in range(SETTLE_STEPS + PRESS_STEPS):
        for solver, into in zip(solvers, ms, strict=True):
            timed(lambda: solver.step(body.settings, body.poses(solver, step)), into)
    return [
        dict(ms=round(float(np.median(into[SETTLE_STEPS:])), 4), mb=round(memory_mb(solver), 4))
        for solver, into in zip(solvers, ms, strict=True)
    ]


def kernels_of(body: FeatureBody, options: Options, arch: str) -> dict[str, int]:
    """Number of kernels of a step in parallel, as on a GPU, and number of their launches."""
    start(arch, kernel_profiler=True)
    solver = body.solver(options, serial=False)
    for _ in range(2):
        ti.sync()
        ti.profiler.clear_kernel_profiler_info()
        solver.step(body.settings, body.poses(solver, 0))
    ti.sync()
    profiler = get_default_kernel_profiler()
    profiler._update_records()
    names = [record.name for record in profiler._traced_records]
    return dict(kernels=len(set(names)), launches=len(names))


def of_frame(scene: Scene, anatomy: LoadedAnatomy, arch: str) -> Iterator[dict[str, Any]]:
    """The other parts of a frame, each by itself: divergence check, surfaces and image."""
    start(arch)
    rehearsal = Rehearsal(scene, anatomy)
    dt = rehearsal.settings.time_step_s
    yield _alone(
        "divergence check",
        lambda: rehearsal.divergence_check.check(dt),
        [rehearsal.divergence_check],
        rehearsal.solver,
    )
    yield _alone("organ's surface", rehearsal.organ_skin.update, [rehearsal.organ_skin], rehearsal.model)
    if (tumour := rehearsal.tumour_skin) is not None:
        yield _alone("tumour's surface", tumour.update, [tumour], rehearsal.model)
    if anatomy.ct is None:
        return
    yield from _images(rehearsal, scanned_anatomy(rehearsal.organ, anatomy.ct, anatomy, rehearsal.origin))
    yield _whole_frame(rehearsal)


def _images(rehearsal: Rehearsal, scanned: ScannedAnatomy) -> Iterator[dict[str, Any]]:
    """The image at each detail level, each with all that it needs."""
    image, probe = rehearsal.scene.image, rehearsal.probe
    plane = image_plane(rehearsal.pose_at_depth(1.0), probe.housing_mm[2], *probe.extent_mm)
    levels: tuple[tuple[str, float, str, Mode, DetailLevel], ...] = (
        ("CT, organ alone", 0.0, "gel", "ct", "speckle"),
        ("CT", SURROUNDINGS_MM, "background", "ct", "speckle"),
        ("B-mode: reflection, attenuation", SURROUNDINGS_MM, "background", "b-mode", "reflection"),
        ("B-mode: and speckle", SURROUNDINGS_MM, "background", "b-mode", "speckle"),
        ("B-mode: and elevation", SURROUNDINGS_MM, "background", "b-mode", "elevation"),
        ("B-mode and CT", SURROUNDINGS_MM, "background", "both", "speckle"),
    )
    for name, margin, outside, mode, detail_level in levels:
        cell = embedding_cell_mm(rehearsal.scene.tissue)
        embedding = Embedding(rehearsal.model, rehearsal.organ, cell, margin)
        scanner = Scanner(scanned, embedding, probe, image.pixels, outside)

        def draw() -> None:
            scanner.images(plane, probe, mode, detail_level, image.window_hu, image.level_hu)

        yield _alone(f"image, {name}", draw, [embedding, scanner], rehearsal.model)


def _whole_frame(rehearsal: Rehearsal) -> dict[str, Any]:
    """A whole frame but the 3D view: a step in a press, surfaces, B-mode and the composed window."""
    rehearsal.reset()
    settings, tally, page = initial_settings(rehearsal), Tally(0.0), BackgroundImage(WindowLayout(1280, 720))
    settings.mode = "b-mode"
    poses = [
        rehearsal.pose_at_depth(depth)
        for depth in np.linspace(0.0, rehearsal.press.indentations_mm[0], CALLS + 1)
    ]

    whole = [rehearsal.solver, rehearsal.divergence_check, rehearsal.organ_skin, rehearsal.tumour_skin]
    whole += [rehearsal.embedding, rehearsal.scanner]

    def compute_frame() -> None:
        rehearsal.advance(poses.pop(0))
        rehearsal.update_surfaces()
        probe = probe_with_settings(rehearsal.probe, settings)
        page.compose(image_view(rehearsal, probe, settings, tally), np.eye(3), slow_figures=True)

    return _alone("whole frame, with B-mode", compute_frame, whole, None)


def _alone(name: str, work: Callable[[], Any], owners: list, apart: Any) -> dict[str, Any]:
    """A part of a frame; where it is off, it takes no time and no memory."""
    work()
    ms: list[float] = []
    for _ in range(CALLS):
        timed(work, ms)
    mb = round(memory_mb(owners, apart), 4)
    nothing = dict(ms_off=0.0, mb_off=0.0, kernels_on=None, kernels_off=0, launches_on=None, launches_off=0)
    return dict(feature=name, ms_on=round(float(np.median(ms)), 4), mb_on=mb, **nothing)
