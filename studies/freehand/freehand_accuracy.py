"""The command ``study freehand``: accuracy of volumes reconstructed from tracked sweeps.

At rest, with a tracker's errors, and under compression.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rehearsal.commands.command_line import CommandError, load_patient
from rehearsal.configuration import PRESETS, Setup, scene_of
from rehearsal.reconstruction.compression_correction import CompressionCorrection
from rehearsal.reconstruction.patient_comparison import compare_with_surfaces, surfaces_of
from rehearsal.reconstruction.sweep_volumes import Places, image_poses_of, reconstruct_volumes
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED, Scene, with_options
from sim.device import start
from studies.freehand.freehand_sweeps import GroundTruthSweep, pressed, resting, sweep_of
from studies.harness import rehearsal_of
from studies.study import CHOSEN, Results, Study, paths_argument, quick_option, study_command
from studies.tables_and_panels import draw_panel, table_of
from ultrasound.probe import load_probe
from ultrasound.reconstruction import METHODS
from ultrasound.tracking_errors import TrackingErrors, with_tracking_errors

REFERENCE, SEED = "Reference", 20161130
PROBE = "curvilinear"
SPACING_MM, REACH_MM, PIXELS = 1.0, 2.0, 192
# The curves are of every third image of the resting sweep.
EVERY = 3
# Radius of the fixed nodes around the hilum; without them a sliding probe would roll the organ away.
FIXED_MM = 15.0
DEPTHS_MM = (0.5, 2.0, 4.0, 6.0, 8.0)
# One error at a time.
VARIED: dict[str, tuple[float, ...]] = {
    "noise_mm": (0.25, 0.5, 1.0, 2.0),
    "noise_deg": (0.25, 0.5, 1.0, 2.0),
    "calibration_mm": (0.5, 1.0, 2.0, 4.0),
    "calibration_deg": (0.5, 1.0, 2.0, 4.0),
    "latency_s": (0.05, 0.1, 0.2, 0.4),
    "lost": (0.1, 0.25, 0.5, 0.75),
}
COLUMNS = {
    "sweep": "{name}",
    "region": "{region}",
    "scanned, %": "{scanned_percent:.0f}",
    "Dice": "{dice:.3f}",
    "HD95, mm": "{hd95_mm:.2f}",
    "volume, %": "{volume_percent:+.1f}",
    "centroid, mm": "{centroid_mm:.2f}",
    "landmarks, mm": "{landmarks_mm:.2f}",
}
TRACKING_ERRORS = {
    "noise_mm": "noise of the position, mm",
    "noise_deg": "noise of the angle, degrees",
    "calibration_mm": "translation error of the calibration, mm",
    "calibration_deg": "rotation error of the calibration, degrees",
    "latency_s": "latency, s (at 10 mm/s)",
    "lost": "share of images without a pose",
}
COMPRESSION_ERRORS = {
    "centroid_mm": "error of the tumour's centroid, mm",
    "dice": "tumour's Dice",
    "landmarks": "error of landmarks, mm",
}
CORRECTED = "^:"


@study_command(
    "freehand",
    paths_argument("scenes"),
    quick_option("One size of each error and two depths."),
    arch=CHOSEN,
)
def freehand(study: Study, scenes: tuple[Path, ...], quick: bool) -> Results:
    """Compare volumes of tracked sweeps with the ground truth.

    Of SCENES [the embedded patient]: at rest, with a tracker's errors, pressed.
    """
    loaded = [_with_ct(scene) for scene in scenes or (EMBEDDED,)]
    setup = PRESETS["neo-hookean"]["balanced"]
    runs = []
    with study.progress(sum(count_of(anatomy, quick) for _, anatomy in loaded), "volume") as bar:
        for number, (scene, anatomy) in enumerate(loaded, 1):
            figures = measure(scene, anatomy, setup, study.backend, quick, bar.update)
            runs.append(dict(patient=scene.title or f"patient {number}") | figures)
    rows = [row for run in runs for row in rows_of(run)]
    report = dict(arch=study.backend, runs=runs)
    return Results(report, "\n\n".join(map(table, runs)), rows, figure_of(runs))


def _with_ct(path: Path) -> tuple[Scene, LoadedAnatomy]:
    scene, anatomy = load_patient(path)
    if anatomy.ct is None:
        raise CommandError(f"{path}: has no CT: expected anatomy.ct, which a sweep shows")
    return scene, anatomy


def measure(
    scene: Scene, anatomy: LoadedAnatomy, setup: Setup, arch: str, quick: bool, done: Callable[[], Any]
) -> dict[str, Any]:
    """All figures of one patient; starts Taichi anew."""
    start(arch)
    truth = resting(anatomy, load_probe(PROBE), np.array(scene.gravity.direction), PIXELS, scene.image.atlas)
    surfaces = surfaces_of(anatomy)
    parts = dict(
        resting=at_rest(truth, surfaces),
        noise=noise_curves(truth, surfaces, quick),
        compression=[] if anatomy.tumour is None else compression(scene, anatomy, setup, arch, quick),
    )
    rows: dict[str, list[dict[str, Any]]] = {kind: [] for kind in parts}
    for kind, of_kind in parts.items():
        for of_volume in of_kind:
            rows[kind] += of_volume
            done()
    apart_mm = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1).mean()
    return dict(
        probe=PROBE,
        spacing_mm=SPACING_MM,
        reach_mm=REACH_MM,
        frames=len(truth.poses),
        apart_mm=round(float(apart_mm), 4),
        **rows,
    )


def at_rest(truth: GroundTruthSweep, surfaces: dict[str, trimesh.Trimesh]) -> Iterator[list[dict[str, Any]]]:
    """Figures of the resting sweep by each method."""
    for method in METHODS:
        yield [dict(method=method) | _row(truth, truth.poses, surfaces, method=method)]


def count_of(anatomy: LoadedAnatomy, quick: bool) -> int:
    """How often ``measure`` calls ``done``."""
    depths = 0 if anatomy.tumour is None else len(_depths(quick))
    return len(METHODS) + 1 + sum(len(_sizes(values, quick)) for values in VARIED.values()) + depths


def _sizes(values: tuple[float, ...], quick: bool) -> tuple[float, ...]:
    return values[2:3] if quick else values


def _depths(quick: bool) -> tuple[float, ...]:
    return DEPTHS_MM[1:4:2] if quick else DEPTHS_MM


def noise_curves(
    truth: GroundTruthSweep, surfaces: dict[str, trimesh.Trimesh], quick: bool
) -> Iterator[list[dict[str, Any]]]:
    """Figures of the resting sweep for trackers with one error each."""
    poses, times = truth.poses[::EVERY], truth.sweep.times_s[::EVERY]
    few = replace(
        truth, sweep=sweep_of(truth.sweep.images[::EVERY], poses, times, truth.on_probe), poses=poses
    )
    sizes = [(name, size) for name, values in VARIED.items() for size in _sizes(values, quick)]
    for errors in [TrackingErrors(), *(TrackingErrors(**{name: size}) for name, size in sizes)]:
        tracked = with_tracking_errors(poses, times, errors, SEED)
        yield [asdict(errors) | _row(few, tracked, surfaces)]


def compression(
    scene: Scene, anatomy: LoadedAnatomy, setup: Setup, arch: str, quick: bool
) -> Iterator[list[dict[str, Any]]]:
    """Figures of sweeps pressed over the tumour at some depths, without and with compression correction."""
    start(arch)
    small = with_options(scene_of(scene, setup), {"image.pixels": PIXELS})
    radius_mm = FIXED_MM if scene.attachment.at_mm else 0.0
    fixed = scene.attachment.model_copy(update={"radius_mm": radius_mm, "stiffness_n_mm": 0.0})
    rehearsal = rehearsal_of(small.model_copy(update={"attachment": fixed}), anatomy)
    surfaces = surfaces_of(anatomy)
    for depth in _depths(quick):
        truth = pressed(rehearsal, depth)
        rehearsal.reset()
        track = image_poses_of(truth.sweep, REFERENCE)
        correction = CompressionCorrection(rehearsal, truth.sweep, track, REFERENCE)
        press = dict(depth_mm=depth, compression_mm=round(truth.compression_mm, 4))
        yield [
            press | dict(undone=undone) | _row(truth, truth.poses, surfaces, places)
            for undone, places in ((False, None), (True, correction))
        ]


def _row(
    truth: GroundTruthSweep,
    poses: list[np.ndarray | None] | np.ndarray,
    surfaces: dict[str, trimesh.Trimesh],
    places: Places | None = None,
    method: str = "smooth",
) -> dict[str, Any]:
    sweep = sweep_of(truth.sweep.images, poses, truth.sweep.times_s, truth.on_probe)
    track = image_poses_of(sweep, REFERENCE)
    rebuilt = reconstruct_volumes(
        sweep, track, truth.mask, SPACING_MM, method, REACH_MM, sweep, places=places, with_grey=False
    )
    return compare_with_surfaces(rebuilt, surfaces, truth.beads_mm)


def rows_of(run: dict[str, Any]) -> list[dict[str, Any]]:
    """A row a volume and region, of the part of it that was scanned."""
    rows = []
    for kind in ("resting", "noise", "compression"):
        for row in run[kind]:
            settings = {name: value for name, value in row.items() if not isinstance(value, dict)}
            for region in ("organ", "tumour"):
                if part := row.get(region, {}).get("scanned_part"):
                    place = dict(patient=run["patient"], sweep=kind, region=region)
                    figures = dict(scanned=row[region]["scanned"]) | part
                    rows.append(place | figures | dict(landmarks_mm=row["landmarks"]["mean_mm"]) | settings)
    return rows


def table(run: dict[str, Any]) -> str:
    """The figures of one patient."""
    head = (
        f"{run['patient']}: {run['probe']} probe, {run['frames']} images {run['apart_mm']:.2f} mm apart, "
        f"voxels of {run['spacing_mm']:g} mm"
    )
    rows = [row | dict(name=_named(row), scanned_percent=100 * row["scanned"]) for row in rows_of(run)]
    return f"{head}\n{table_of(COLUMNS, rows)}"


def _named(row: dict[str, Any]) -> str:
    if row["sweep"] == "resting":
        return f"at rest, {row['method']}"
    if row["sweep"] == "compression":
        corrected = ", corrected" if row["undone"] else ""
        return f"pressed {row['depth_mm']:g} mm, compressed {row['compression_mm']:.1f}{corrected}"
    errors = [f"{name} {row[name]:g}" for name in TRACKING_ERRORS if row[name]]
    return ", ".join(errors) or "every third image, no error"


def figure_of(runs: list[dict[str, Any]]) -> Figure:
    """Error against tracking errors and compression; a colour is a patient, a line style a quantity."""
    figure = Figure(figsize=(13, 9.5), layout="constrained")
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(2, 1.1))[:, 0]
    panels = above.subplots(2, 3).ravel()
    for axes, (name, label) in zip(panels, TRACKING_ERRORS.items(), strict=True):
        _against_noise(axes, runs, name, label)
    above.suptitle("At rest, by a tracker's errors: error of the volume")
    _legend(panels[0], {"landmarks": "o-", "tumour's centroid": "s--"})
    panels = below.subplots(1, 3)
    for axes, name in zip(panels, COMPRESSION_ERRORS, strict=True):
        _against_compression(axes, runs, name)
    below.suptitle("Pressed over the tumour: the part of it that was scanned")
    _legend(panels[0], {"uncorrected": "o-", "compression corrected": CORRECTED})
    colours = [Line2D([], [], color=f"C{n}", linewidth=3, label=run["patient"]) for n, run in enumerate(runs)]
    figure.legend(handles=colours, loc="outside lower center", ncols=3)
    return figure


def _legend(axes: Axes, styles: dict[str, str]) -> None:
    """The line styles of all panels in a row."""
    handles = [axes.plot([], [], style, color="0.3", label=name)[0] for name, style in styles.items()]
    axes.legend(handles=handles, loc="upper left", fontsize=9)


def _against_noise(axes: Axes, runs: list[dict[str, Any]], name: str, label: str) -> None:
    """Landmark error of the resting sweep, and the distance of the tumour's centroid."""
    others = [error for error in TRACKING_ERRORS if error != name]
    for number, run in enumerate(runs):
        rows = [row for row in run["noise"] if not any(row[error] for error in others)]
        _curve(axes, rows, name, "landmarks", "o-", number)
        if "tumour" in rows[0]:
            _curve(axes, rows, name, "centroid_mm", "s--", number)
    _finish(axes, label, "mm")


def _against_compression(axes: Axes, runs: list[dict[str, Any]], name: str) -> None:
    for number, run in enumerate(runs):
        # A press may move the tumour out of the images.
        known = [row for row in run["compression"] if row["landmarks"]["count"] and _tumour(row)]
        for undone, style in ((False, "o-"), (True, CORRECTED)):
            rows = [row for row in known if row["undone"] == undone]
            _curve(axes, rows, "depth_mm", name, style, number)
    _finish(axes, "depth of the press, mm", COMPRESSION_ERRORS[name])


def _curve(axes: Axes, rows: list[dict[str, Any]], x: str, name: str, style: str, number: int) -> None:
    """A figure of a patient's tumour, or of its landmarks, against one of the settings."""
    values = [
        row["landmarks"]["mean_mm"] if name == "landmarks" else _tumour(row).get(name, math.nan)
        for row in rows
    ]
    axes.plot([row[x] for row in rows], values, style, color=f"C{number}")


def _tumour(row: dict[str, Any]) -> dict[str, float]:
    """The figures of the part of the tumour that was scanned; empty where there is none."""
    return row.get("tumour", {}).get("scanned_part") or {}


def _finish(axes: Axes, x_label: str, y_label: str) -> None:
    draw_panel(axes, xlabel=x_label, ylabel=y_label)
    # A value near zero stays visible above the frame.
    axes.set_ylim(bottom=-0.04 * axes.get_ylim()[1])
