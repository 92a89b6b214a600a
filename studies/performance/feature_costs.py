"""The command ``study features``: the cost of each feature of a scene: the same press with and without."""

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import taichi as ti
import trimesh
from matplotlib.figure import Figure

from rehearsal.build_solver import build_solver, embedding_cell_mm, static_shape
from rehearsal.case import case_of
from rehearsal.configuration import PRESETS, Setup, scene_of
from rehearsal.deformed_anatomy import SURROUNDINGS_MM
from rehearsal.imaging import image_view
from rehearsal.live_settings import initial_settings
from rehearsal.loop.command import Move
from rehearsal.pressed_organ import PressedOrgan, material_of
from rehearsal.rehearsal import Rehearsal
from rehearsal.stopwatch import timed
from render.background_image import BackgroundImage
from render.window_layout import WindowLayout
from scenes.anatomy import LoadedAnatomy
from scenes.mechanical_tissues import mechanical_properties
from scenes.scene import PAPER, Contact, Image, Scene, SolverSection
from scenes.surfaces import translated
from scenes.tissue import TISSUES, USUAL, PartMaterial, Prony, ShapeMatchingTissue, TissueSection
from settings import with_values
from sim.attachment import Pedicle, Tether
from sim.device import start
from sim.embedding import Embedding
from sim.material import Part
from sim.shape_matching import fill_organ
from sim.shapes import ConvexTool
from sim.skinning import Skin
from sim.solver import Solver
from sim.taichi_internals import launched_kernels
from studies.harness import memory_mb, rehearsal_of
from studies.study import CHOSEN, Results, Study, quick_option, study_command
from studies.tables_and_panels import draw_panel, table_of
from ultrasound.persistence import Persistence
from ultrasound.probe import DetailLevel, DopplerMode, Mode, Probe
from ultrasound.probe_manipulator import ImagePlane, advanced, pose_at, poses_between, touching
from ultrasound.scanned_anatomy import ScannedAnatomy
from ultrasound.scanner import PlaneImages, Scanner, shows_ct

# Depth and steps of the press, and the steps before it in which the body settles.
PRESS_MM, PRESS_STEPS, SETTLE_STEPS = 8.0, 60, 30
CALLS = 40
NOT_COUNTED: dict[str, Any] = dict(kernels=None, launches=None)
MEASURED = ("ms", "mb", "kernels", "launches")
NAMES = ("model", "feature", *(f"{name}_{state}" for name in MEASURED for state in ("on", "off")))
COLUMNS = {
    "model": "{model}",
    "feature": "{feature}",
    "ms with": "{ms_on:.3f}",
    "without": "{ms_off:.3f}",
    "adds": "{ms:+.3f}",
    "MB": "{mb:+.2f}",
    "kernels": "{kernels:+g}",
    "launches": "{launches:+g}",
}
FRAME = "frame"
UNITS = {"ms": "time (ms)", "mb": "memory: fields on the device (MB)"}


class Options(NamedTuple):
    """The features of a scene that a step computes; the defaults are those of the embedded patient."""

    support: bool = True
    transducer: bool = True
    shape_friction: float = 0.35
    particles: bool = False
    particle_friction: float = 0.0
    mass_scaling_per_mm: float = 0.0
    stiff_part: bool = False
    capsule: bool = False
    relaxation: bool = False
    pedicle: bool = False


# A feature: the options of a step with it, and of the same step without.
Feature = tuple[Options, Options]
BASE = Options()
EVERYWHERE: dict[str, Feature] = {
    "contact with the support": (Options(transducer=False), Options(transducer=False, support=False)),
    "the transducer": (BASE, Options(transducer=False)),
    "friction on shapes": (BASE, Options(shape_friction=0.0)),
}
OF_PARTICLES: dict[str, Feature] = {
    "contacts of particles": (Options(particles=True), BASE),
    "friction of particles": (Options(particles=True, particle_friction=0.25), Options(particles=True)),
    "scaled masses": (Options(mass_scaling_per_mm=0.02), BASE),
}
OF_ELEMENTS: dict[str, Feature] = {
    "a part with its own material": (Options(stiff_part=True), BASE),
    "capsule": (Options(capsule=True), BASE),
    "relaxation, one term": (Options(relaxation=True), BASE),
    "pedicle": (Options(pedicle=True), BASE),
}
FEATURES = {
    model: EVERYWHERE
    | (OF_PARTICLES if section.supports_self_contact else {})
    | (OF_ELEMENTS if model == USUAL else {})
    for model, section in TISSUES.items()
}
# Radius of a ball in the organ's middle, a tumour [mm]; a term of relaxation: its share and its time [s].
PART_MM, TERM = 10.0, (0.5, 1.0)


@study_command(
    "features",
    quick_option("Neo-Hookean alone, coarse, no kernels counted: in less than a minute."),
    scene=PAPER,
    arch=CHOSEN,
)
def features(study: Study, quick: bool) -> Results:
    """Measure what each feature of SCENE costs.

    In time, memory and kernels: the same press with it and without, in turn.
    """
    models = [USUAL] if quick else list(FEATURES)
    total = sum(len(FEATURES[model]) for model in models) + 1
    measured = study.progress(total, "feature", _measured(study, models, quick))
    rows = [{name: row[name] for name in NAMES} for part in measured for row in part]
    return Results(dict(arch=study.backend, features=rows), table(rows), rows, figure_of(rows))


def _measured(study: Study, models: list[str], quick: bool) -> Iterator[list[dict[str, Any]]]:
    """The row of each feature, then those of a frame."""
    for model in models:
        body = FeatureBody(*study.scene, PRESETS[model]["fast" if quick else "balanced"], study.backend)
        for row in of_steps(body, FEATURES[model], study.backend, quick):
            yield [dict(model=model) | row]
    yield [dict(model=FRAME) | row for row in of_frame(*study.scene, study.backend)]


class FeatureBody:
    """A scene's organ and support for solvers with other features, relative to the organ's middle [mm]."""

    def __init__(self, scene: Scene, anatomy: LoadedAnatomy, setup: Setup, arch: str) -> None:
        start(arch)
        case = case_of(scene_of(scene, setup), anatomy)
        self.tissue, self.settings = case.scene.tissue, PressedOrgan(case).settings
        self.size_mm, down = case.size_mm, case.gravity_direction
        side = np.eye(3)[np.abs(down).argmin()]
        pose = pose_at(np.zeros(3), down, side, self.size_mm[2])
        self.home = touching(pose, self.size_mm, case.organ.vertices)
        meshes = [shape for shape in case.shapes if isinstance(shape, trimesh.Trimesh)]
        self.supports = [translated(mesh, -case.origin) for mesh in meshes]
        is_filled = isinstance(self.tissue, ShapeMatchingTissue)
        self.filled = fill_organ(case.organ, self.tissue) if is_filled else case.organ

    def solver(self, options: Options, serial: bool | None = None) -> Solver:
        """A solver with some features."""
        tool = ConvexTool.cuboid(self.size_mm) if options.transducer else None
        supports = self.supports if options.support else []
        shapes: list = [static_shape(mesh, self.tissue) for mesh in supports]
        contact = Contact(
            shape_friction=options.shape_friction,
            particles=options.particles,
            particle_friction=options.particle_friction,
        )
        section = SolverSection(mass_scaling_per_mm=options.mass_scaling_per_mm)
        if tool:
            shapes.append(tool)
        tissue, tethers, parts = self._tissue(options)
        return build_solver(
            self.filled, tissue, shapes, tool, contact, section, serial, tethers=tethers, parts=parts
        )

    def _tissue(self, options: Options) -> tuple[TissueSection, list[Tether], list[Part]]:
        """The tissue with some features, what holds it, and its parts, with typical properties."""
        table, changes = mechanical_properties(), dict[str, Any]()
        tethers: list[Tether] = []
        parts: list[Part] = []
        if options.capsule:
            changes["capsule_n_mm"] = table.capsule_n_mm[1]
        if options.relaxation:
            changes["prony"] = (Prony(modulus_ratio=TERM[0], time_s=TERM[1]),)
        if options.pedicle:
            tethers.append(Pedicle(np.zeros(3), PART_MM, table.pedicle_n_mm[1]))
        if options.stiff_part:
            ball = trimesh.creation.icosphere(subdivisions=3, radius=PART_MM)
            parts.append(Part("tumour", ball, material_of("tumour", PartMaterial())))
        return self.tissue.model_copy(update=changes), tethers, parts

    def poses(self, step: int) -> np.ndarray:
        """Poses of the transducer in a step of the press."""
        depth = PRESS_MM * np.clip((step + np.array([0, 1]) - SETTLE_STEPS) / PRESS_STEPS, 0, 1)
        first, last = (advanced(self.home, mm) for mm in depth)
        return poses_between(first, last, self.settings.substeps)


def of_steps(
    body: FeatureBody, features: dict[str, Feature], arch: str, quick: bool
) -> Iterator[dict[str, Any]]:
    """Each feature's row of features.json: median times, memory and parallel kernels, with it and without it.

    Solvers with and without are stepped in turn; ``quick`` counts no kernels.
    """
    counted = cache(lambda options: NOT_COUNTED if quick else kernels_of(body, options, arch))
    for name, both in features.items():
        row: dict[str, Any] = dict(feature=name)
        for state, options, figures in zip(("on", "off"), both, _stepped(body, both, arch), strict=True):
            row |= {f"{figure}_{state}": value for figure, value in (figures | counted(options)).items()}
        yield row


def _stepped(body: FeatureBody, variants: Feature, arch: str) -> list[dict[str, Any]]:
    """Median time of a step [ms] in a press, and memory [MB], of solvers that are stepped in turn."""
    start(arch)
    solvers = [body.solver(options) for options in variants]
    ms: list[list[float]] = [[] for _ in solvers]
    for step in range(SETTLE_STEPS + PRESS_STEPS):
        for solver, into in zip(solvers, ms, strict=True):
            timed(lambda: solver.step(body.settings, body.poses(step)), into)
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
        solver.step(body.settings, body.poses(0))
    ti.sync()
    names = launched_kernels()
    return dict(kernels=len(set(names)), launches=len(names))


def of_frame(scene: Scene, anatomy: LoadedAnatomy, arch: str) -> Iterator[dict[str, Any]]:
    """The other parts of a frame, each by itself: divergence check, surfaces and image."""
    start(arch)
    rehearsal = rehearsal_of(scene, anatomy)
    case, organ = rehearsal.case, rehearsal.organ
    check, dt = organ.divergence_check, organ.settings.time_step_s
    yield _alone("divergence check", lambda: check.check(dt), [check], organ.solver)
    for name, surface in (("organ", case.organ), ("tumour", case.tumour)):
        if surface is not None:
            skin = Skin(organ.model.carrier, surface.vertices)
            yield _alone(f"{name}'s surface", skin.update, [skin], organ.model)
    scanner = rehearsal.anatomy.scanner
    if scanner is not None:
        yield from _images(rehearsal, scanner.volumes.anatomy)
        yield _whole_frame(rehearsal)


def _images(rehearsal: Rehearsal, scanned: ScannedAnatomy) -> Iterator[dict[str, Any]]:
    """The image at each detail level, each with all that it needs."""
    case, model = rehearsal.case, rehearsal.organ.model
    image, probe = case.scene.image, case.probe
    plane = case.image_plane(rehearsal.pose_at_depth(1.0))
    levels: tuple[tuple[str, str, Mode, DetailLevel], ...] = (
        ("CT, organ alone", "gel", "ct", "speckle"),
        ("CT", "background", "ct", "speckle"),
        ("B-mode: reflection, attenuation", "background", "b-mode", "reflection"),
        ("B-mode: and speckle", "background", "b-mode", "speckle"),
        ("B-mode: and elevation", "background", "b-mode", "elevation"),
        ("B-mode: through fluid", "fluid", "b-mode", "speckle"),
        ("B-mode and CT", "background", "both", "speckle"),
    )
    cell = embedding_cell_mm(case.scene.tissue)
    for name, outside, mode, detail_level in levels:
        margin = SURROUNDINGS_MM if shows_ct(outside) else 0.0
        embedding = Embedding(model.carrier, case.organ, cell, margin)
        scanner = Scanner(scanned, embedding, probe, image.pixels, outside)

        def draw() -> None:
            scanner.images(plane, probe, mode, detail_level, image.window_hu, image.level_hu)

        yield _alone(f"image, {name}", draw, [embedding, scanner], model)
        if name == "B-mode: and elevation":
            yield from _switches(scanner, plane, probe, image, model)


def _switches(
    scanner: Scanner, plane: ImagePlane, probe: Probe, image: Image, apart: Any
) -> Iterator[dict[str, Any]]:
    """The B-mode image with harmonics, compounding, persistence and Doppler, each with all detail."""

    persistence = Persistence()

    def b_mode(settings: dict[str, Any]) -> PlaneImages:
        changed, window = probe.model_copy(update=settings), (image.window_hu, image.level_hu)
        return scanner.images(plane, changed, "b-mode", "elevation", *window)

    def with_doppler(mode: DopplerMode) -> None:
        scanner.doppler(b_mode({}), mode)

    switches: dict[str, Callable[[], Any]] = {
        "harmonics": partial(b_mode, {"harmonics": True}),
        "compounding of 3 angles": partial(b_mode, {"compound_angles": 3}),
        "persistence": lambda: persistence.mixed(b_mode({}), 0.5),
        "colour Doppler": partial(with_doppler, "colour"),
        "power Doppler": partial(with_doppler, "power"),
    }
    for name, draw in switches.items():
        yield _alone(f"image, B-mode with {name}", draw, [scanner], apart)


def _whole_frame(rehearsal: Rehearsal) -> dict[str, Any]:
    """A whole frame but the 3D view: a step in a press, surfaces, B-mode and the composed window."""
    rehearsal.reset()
    case, page = rehearsal.case, BackgroundImage(WindowLayout(1280, 720))
    settings = with_values(initial_settings(case), {"image.mode": "b-mode"})
    depths = iter(np.linspace(0.0, case.press.indentations_mm[0], CALLS + 1))

    def compute_frame() -> None:
        rehearsal.do(Move(pose=rehearsal.pose_at_depth(next(depths))))
        page.compose(image_view(rehearsal.anatomy, settings), np.eye(3), slow_figures=True)

    whole = [rehearsal.organ, rehearsal.anatomy]
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


def _added(row: dict[str, Any], name: str) -> float | None:
    on = row[f"{name}_on"]
    return None if on is None else on - row[f"{name}_off"]


def table(rows: list[dict[str, Any]]) -> str:
    """What each feature adds: time of a step or part of a frame, memory, parallel kernels and launches."""
    return table_of(COLUMNS, [row | {name: _added(row, name) for name in MEASURED} for row in rows])


def figure_of(rows: list[dict[str, Any]]) -> Figure:
    """What features add to a step, and below it what the parts of a frame take."""
    parts = {
        "A time step: with each feature, less without it": [row for row in rows if row["model"] != FRAME],
        "A frame: each part, and all that it needs, by itself": [
            row for row in rows if row["model"] == FRAME
        ],
    }
    figure = Figure(figsize=(12, 0.34 * len(rows) + 3), layout="constrained")
    heights = [len(part) + 3 for part in parts.values()]
    halves = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
    for half, (title, part) in zip(halves, parts.items(), strict=True):
        half.suptitle(title)
        _bars(half.subplots(1, 2, sharey=True), part)
    return figure


def _bars(panels: Any, rows: list[dict[str, Any]]) -> None:
    names = [
        row["feature"] if row["model"] == FRAME else f"{row['feature']}  ({row['model']})" for row in rows
    ]
    models = list(dict.fromkeys(row["model"] for row in rows))
    colours = ["C2" if row["model"] == FRAME else f"C{models.index(row['model'])}" for row in rows]
    for axes, (name, unit) in zip(panels, UNITS.items(), strict=True):
        added = [_added(row, name) or 0.0 for row in rows]
        axes.barh(range(len(rows)), added, color=colours)
        for y, value in enumerate(added):
            axes.annotate(f" {value:.2f}", (max(value, 0.0), y), va="center", fontsize=8)
        axes.axvline(0.0, color="0.4", linewidth=0.8)
        axes.margins(x=0.12)
        draw_panel(axes, grid="x", xlabel=unit)
    panels[0].set_yticks(range(len(rows)), names)
    panels[0].invert_yaxis()
