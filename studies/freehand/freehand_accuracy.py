"""Accuracy of volumes reconstructed from tracked sweeps: at rest, with a tracker's errors, and under compression."""

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import trimesh

from rehearsal.configuration import Setup, scene_of
from rehearsal.reconstruction.compression_correction import CompressionCorrection
from rehearsal.reconstruction.patient_comparison import compare_with_surfaces, surfaces_of
from rehearsal.reconstruction.sweep_volumes import Places, image_poses_of, reconstruct_volumes
from rehearsal.rehearsal import Rehearsal
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene, with_options
from sim.device import start
from studies.freehand.freehand_sweeps import GroundTruthSweep, pressed, resting, sweep_of
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


def measure(
    scene: Scene,
    anatomy: LoadedAnatomy,
    setup: Setup,
    arch: str,
    quick: bool,
    done: Callable[[], Any],
) -> dict[str, Any]:
    """All figures of one patient; starts Taichi anew."""
    start(arch)
    probe = load_probe(PROBE)
    truth = resting(anatomy, probe, np.array(scene.gravity.direction), PIXELS)
    surfaces = surfaces_of(anatomy)
    rest = []
    for method in METHODS:
        rest.append(dict(method=method) | _row(truth, truth.poses, surfaces, method=method))
        done()
    curves = noise_curves(truth, surfaces, quick, done)
    pressed_rows = [] if anatomy.tumour is None else compression(scene, anatomy, setup, arch, quick, done)
    return dict(
        probe=PROBE,
        spacing_mm=SPACING_MM,
        reach_mm=REACH_MM,
        frames=len(truth.poses),
        apart_mm=round(float(np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1).mean()), 4),
        resting=rest,
        noise=curves,
        compression=pressed_rows,
    )


def count_of(anatomy: LoadedAnatomy, quick: bool) -> int:
    """How often ``measure`` calls ``done``."""
    depths = 0 if anatomy.tumour is None else len(_depths(quick))
    return len(METHODS) + 1 + sum(len(_sizes(values, quick)) for values in VARIED.values()) + depths


def _sizes(values: tuple[float, ...], quick: bool) -> tuple[float, ...]:
    return values[2:3] if quick else values


def _depths(quick: bool) -> tuple[float, ...]:
    return DEPTHS_MM[1:4:2] if quick else DEPTHS_MM


def noise_curves(
    truth: GroundTruthSweep, surfaces: dict[str, trimesh.Trimesh], quick: bool, done: Callable[[], Any]
) -> list[dict[str, Any]]:
    """Figures of the resting sweep for trackers with one error each."""
    times = truth.sweep.times_s[::EVERY]
    few = replace(
        truth,
        sweep=sweep_of(truth.sweep.images[::EVERY], truth.poses[::EVERY], times, truth.on_probe),
        poses=truth.poses[::EVERY],
    )
    trials = [TrackingErrors()] + [
        TrackingErrors(**{name: size}) for name, sizes in VARIED.items() for size in _sizes(sizes, quick)
    ]
    rows = []
    for errors in trials:
        poses = with_tracking_errors(few.poses, few.sweep.times_s, errors, SEED)
        rows.append(asdict(errors) | _row(few, poses, surfaces))
        done()
    return rows


def compression(
    scene: Scene, anatomy: LoadedAnatomy, setup: Setup, arch: str, quick: bool, done: Callable[[], Any]
) -> list[dict[str, Any]]:
    """Figures of sweeps pressed over the tumour at several depths, without and with the compression correction."""
    start(arch)
    small = with_options(scene_of(scene, setup), {"image.pixels": PIXELS})
    fixed = scene.attachment.model_copy(update={"radius_mm": FIXED_MM if scene.attachment.at_mm else 0.0})
    rehearsal = Rehearsal(small.model_copy(update={"attachment": fixed}), anatomy)
    surfaces = surfaces_of(anatomy)
    rows = []
    for depth in _depths(quick):
        truth = pressed(rehearsal, depth)
        rehearsal.reset()
        track = image_poses_of(truth.sweep, REFERENCE)
        correction = CompressionCorrection(rehearsal, truth.sweep, track, REFERENCE)
        for undone, places in ((False, None), (True, correction)):
            row = dict(depth_mm=depth, compression_mm=round(truth.compression_mm, 4), undone=undone)
            rows.append(row | _row(truth, truth.poses, surfaces, places))
        done()
    return rows


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
