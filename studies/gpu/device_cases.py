"""What is measured on each backend: presses with known beads, pictures, frames, blocks of ever more nodes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, partial
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from rehearsal.commands.command_line import load_patient
from rehearsal.configuration import PRESETS, Setup
from rehearsal.result_files import spread
from rehearsal.stopwatch import timed
from scenes.scene import EMBEDDED
from studies.accuracy.bead_case import load_case
from studies.harness import step_of
from studies.performance.step_timing import COUNTS, PAPERS, STEPS, blocks
from studies.performance.tradeoff import EMBEDDED_CASE

if TYPE_CHECKING:
    from rehearsal.deformed_anatomy import DeformedAnatomy
    from ultrasound.scanner import PlaneImages

# A press of the embedded patient's beads, shorter than the paper's: one device is compared with another.
WARM_UP_STEPS, STAGE_STEPS = 60, 30
PICTURES, FRAMES = 20, 10
# A processor needs minutes for larger blocks.
MOST_ON_CPU = 64_000
# The bend of the tissue in the pictures: amplitude and length of a wave [mm].
BEND_MM, WAVE_MM = 2.0, 40.0
# Longest median [ms] that is asked of a graphics card, by case.
MOST_MS = {"balanced": 1.0, "accurate": 4.0, "shape matching 2.2 mm": 1.0, "B-mode": 1.0}
PRESSES: dict[str, Setup] = {
    **PRESETS["neo-hookean"],
    f"shape matching {PAPERS.size_mm:g} mm": PAPERS,
}
BLOCKS = "blocks at rest"


@dataclass(frozen=True)
class CaseFigures:
    """One case on one backend: ``ms`` are mean, spread and median of what is measured.

    ``first_s`` is the time before it, with building and compilation; ``arrays`` are what is compared.
    """

    case: str
    first_s: float
    ms: dict[str, float]
    figures: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


# Measures a case, or several.
Case = Callable[[], Iterator[CaseFigures]]


def cases(arch: str) -> dict[str, Case]:
    """What is measured on a backend, by name; what a rehearsal needs comes first, as time may run out."""
    presses: dict[str, Case] = {name: partial(press, name, setup) for name, setup in PRESSES.items()}
    rehearsal: dict[str, Case] = {
        "balanced": presses["balanced"],
        "B-mode": pictures,
        "frame": frames,
        "Doppler": doppler,
    }
    return rehearsal | presses | {BLOCKS: partial(sizes, arch)}


def press(name: str, setup: Setup) -> Iterator[CaseFigures]:
    """The embedded patient's kidney pressed in stages: its beads, and the force on the probe."""
    from studies.accuracy.bead_experiment import BeadExperiment

    start_s = perf_counter()
    short = setup.but(warm_up_steps=WARM_UP_STEPS, stage_steps=STAGE_STEPS)
    experiment = BeadExperiment(load_case(EMBEDDED_CASE), short)
    run = experiment.run(short)
    first_s = perf_counter() - start_s - sum(run.step_ms) / 1000
    nodes = experiment.model.counts()["particles"]
    arrays = dict(beads_mm=run.beads, force_n=run.force_n)
    known = {kind: values for kind, values in arrays.items() if np.isfinite(values).all()}
    figures = dict(nodes=nodes, size_mm=setup.size_mm) | step_of(setup)
    yield CaseFigures(name, first_s, spread(run.step_ms), figures, known)


def pictures() -> Iterator[CaseFigures]:
    """The B-mode image of the embedded patient's bent tissue."""
    start_s = perf_counter()
    anatomy = _bent()

    def image() -> np.ndarray:
        return _images(anatomy).by_name["B-mode"]

    yield _repeated("B-mode", start_s, image, PICTURES, rows_columns=list(image().shape))


def doppler() -> Iterator[CaseFigures]:
    """Colour Doppler over the same image."""
    start_s = perf_counter()
    anatomy = _bent()
    images = _images(anatomy)
    image = partial(anatomy.scanner.doppler, images, "colour")  # type: ignore[union-attr]
    yield _repeated("Doppler", start_s, image, PICTURES, rows_columns=list(images.by_name["B-mode"].shape))


def frames() -> Iterator[CaseFigures]:
    """A frame of the window with its picture, off-screen, drawn by the Vulkan driver."""
    from rehearsal.drawn_geometry import drawn_geometry
    from rehearsal.live_settings import initial_settings
    from rehearsal.opening import compile_picture
    from render.window import Window

    start_s = perf_counter()
    anatomy = _bent()
    view, settings = replace(compile_picture(anatomy), readouts={}), initial_settings(anatomy.case)
    window = Window(drawn_geometry(anatomy), settings, visible=False, by_processor=False)

    def frame() -> np.ndarray:
        window.draw(view)
        return window.picture()

    try:
        size = [window.layout.width, window.layout.height]
        yield _repeated("frame", start_s, frame, FRAMES, width_height=size)
    finally:
        window.close()


def _repeated(
    case: str, start_s: float, image: Callable[[], np.ndarray], times: int, **figures: Any
) -> CaseFigures:
    """An image made again and again; the first is not timed."""
    made = image()
    first_s, ms = perf_counter() - start_s, list[float]()
    for _ in range(times):
        timed(image, ms)
    return CaseFigures(case, first_s, spread(ms), figures, dict(grey=made))


@cache
def _bent() -> "DeformedAnatomy":
    """The embedded patient, touched by the transducer, with its tissue bent by waves.

    They are the same on each backend, so that pictures differ by their own computation alone.
    """
    from rehearsal.case import case_of
    from rehearsal.deformed_anatomy import DeformedAnatomy, scanned_ct
    from rehearsal.loop.timeline import Timeline
    from rehearsal.pressed_organ import PressedOrgan
    from rehearsal.rehearsal import begin

    scene, loaded = load_patient(EMBEDDED, quality="balanced")
    case = case_of(scene, loaded)
    organ = PressedOrgan(case)
    anatomy = DeformedAnatomy(case, loaded, organ.model.carrier.interpolation, scanned_ct(case, loaded))
    state = organ.snapshot()
    body = state.solver.body
    waves = np.sin(2 * np.pi / WAVE_MM * body.position[:, [1, 2, 0]])
    bent = replace(body, position=body.position + np.float32(BEND_MM) * waves.astype(np.float32))
    organ.restore(replace(state, solver=replace(state.solver, body=bent)))
    begin(case, anatomy, Timeline(organ))
    return anatomy


def _images(anatomy: "DeformedAnatomy") -> "PlaneImages":
    image, scanner = anatomy.case.scene.image, anatomy.scanner
    assert scanner is not None
    shown = image.detail_level, image.window_hu, image.level_hu
    return scanner.images(anatomy.image_plane(), anatomy.case.probe, "b-mode", *shown)


def sizes(arch: str) -> Iterator[CaseFigures]:
    """Blocks of cells and of particles at rest on a plane."""
    counts = [count for count in COUNTS if arch != "cpu" or count <= MOST_ON_CPU]
    start_s = perf_counter()
    for block in blocks(counts, arch, STEPS):
        ms = block.pop("ms")
        name = f"{block['model']}, {block['particles']:,} nodes"
        yield CaseFigures(name, perf_counter() - start_s - STEPS * ms["mean"] / 1000, ms, block)
        start_s = perf_counter()
