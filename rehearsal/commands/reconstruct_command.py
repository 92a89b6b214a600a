"""The command ``reconstruct``: the volume of a tracked sweep, compared with the patient."""

from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any

import click
import numpy as np
from pydantic import Field

from rehearsal.commands.command_line import (
    ARGUMENT,
    ArchOptions,
    CommandError,
    command,
    load_patient,
    make_folder,
    start_taichi,
)
from rehearsal.configuration import probe_of
from rehearsal.reconstruction.reconstruction_files import save_slices_figure, save_volumes
from rehearsal.reconstruction.sweep_volumes import (
    ImagePoses,
    Places,
    SweepVolumes,
    image_poses_of,
    lit_pixels,
    reconstruct_volumes,
    with_errors,
)
from rehearsal.result_files import write_json
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from scenes.terminal import bar, stages
from ultrasound.reconstruction import METHODS
from ultrasound.sweep import Sweep, load_constants
from ultrasound.sweep_file import PROBE_FIELD, read_ground_truth, read_sweep, suffix_of, write_sweep
from ultrasound.tracking_errors import TrackingErrors
from version import VERSION

MOST_REACH_MM = 5.0
# A smaller scanned fraction of the organ is not compared; below the second, the summary calls it a small
# part.
LEAST_SCANNED, SMALL_SCANNED = 0.01, 0.3


class ReconstructOptions(ArchOptions):
    """What the user asks of a reconstruction."""

    sweep: Annotated[Path, ARGUMENT]
    out: Path
    """Folder for the volume and the report."""
    scene: Path | None = None
    """Scene or patient's folder of the sweep, to compare with."""
    config: Path | None = None
    """PLUS configuration (XML) with ImageToProbe, where the sweep has none."""
    reference: str = "Reference"
    """Coordinate system of the volume, as PLUS names it."""
    method: Annotated[str, click.Choice(METHODS)] = "smooth"
    """Interpolation from pixels to voxels."""
    spacing_mm: float = Field(0.5, ge=0.05, le=10)
    """Width of a voxel."""
    reach_mm: float | None = Field(None, ge=0, le=20)
    """Gaps up to twice this width are filled [the distance of most images]."""
    undo_compression: bool = False
    """Compression correction: press the scene's organ along the tracked path, and move each pixel to its
    place at rest.
    """
    noise_mm: float = Field(0.0, ge=0)
    """Simulated tracker noise: SD of each coordinate."""
    noise_deg: float = Field(0.0, ge=0)
    """SD of the angle about each axis."""
    calibration_mm: float = Field(0.0, ge=0)
    """Constant offset of the image on the probe."""
    calibration_deg: float = Field(0.0, ge=0)
    """Constant rotation of the image on the probe."""
    latency_s: float = Field(0.0, ge=0)
    """Delay of the poses."""
    lost: float = Field(0.0, ge=0, le=1)
    """Fraction of frames without a pose."""
    seed: int = 0
    """Random seed of these errors."""


@command(ReconstructOptions)
def reconstruct(options: ReconstructOptions) -> None:
    """Reconstruct a volume from SWEEP, a tracked sweep (.igs.mha, .igs.nrrd).

    The sweep is from Nephron or PLUS. Writes volume.nrrd, volume.png and report.json; with ground-truth
    labels (SWEEP-marks.igs.mha, which a rehearsal records) also organ and tumour in labels.nrrd. With
    simulated tracker errors, it also writes the sweep that has them, tracked.igs.mha, or .igs.nrrd as the
    sweep.
    """
    out, reference = options.out, options.reference
    if options.undo_compression and options.scene is None:
        raise CommandError("--undo-compression: needs the organ of a scene; name it with --scene")
    images = read_sweep(options.sweep)
    images.constant |= load_constants(options.config) if options.config else {}
    labels = read_ground_truth(options.sweep)
    errors = TrackingErrors(**{field.name: getattr(options, field.name) for field in fields(TrackingErrors)})
    if errors != TrackingErrors():
        images = with_errors(images, reference, errors, options.seed)
    image_poses = image_poses_of(images, reference)
    about = _describe(images, image_poses)
    patient = None if options.scene is None else load_patient(options.scene)
    make_folder(out)
    if errors != TrackingErrors():
        write_sweep(out / f"tracked{suffix_of(options.sweep)}", images)
    settings: dict[str, Any] = dict(
        method=options.method,
        spacing_mm=options.spacing_mm,
        reach_mm=default_reach_mm(image_poses, options.spacing_mm)
        if options.reach_mm is None
        else options.reach_mm,
    )
    places = None
    if options.undo_compression and patient is not None:
        places = _compression_correction(patient, images, image_poses, reference, options.arch)
    try:
        mask = lit_pixels(images.images)
        volumes = reconstruct_volumes(
            images, image_poses, mask, **settings, labels=labels, places=places, progress=bar
        )
    except ValueError as error:
        raise CommandError(f"{options.sweep.name}: {error}") from None
    with stages() as stage:
        stage("Writing the volumes")
        save_volumes(volumes, out)
        save_slices_figure(volumes, out / "volume.png")
        stage("Comparing with the patient")
        agreement, fault = _metrics(volumes, patient)
    if fault:
        click.echo(fault)
    report = dict(
        version=VERSION,
        **settings,
        reference=reference,
        undo_compression=options.undo_compression,
        tracker=asdict(errors),
        **about,
        shape=list(volumes.box.shape),
        agreement=agreement,
    )
    write_json(report, out / "report.json")
    click.echo(in_words(report))
    click.echo(f"Wrote volume.nrrd, volume.png and report.json to {out}")


def default_reach_mm(image_poses: ImagePoses, spacing_mm: float) -> float:
    """The distance of most images, and at least two voxels [mm]."""
    distance = float(np.percentile(image_poses.steps_mm, 95)) if len(image_poses.frames) > 1 else 0.0
    return max(2 * spacing_mm, min(distance, MOST_REACH_MM))


def _compression_correction(
    patient: tuple[Scene, LoadedAnatomy], images: Sweep, image_poses: ImagePoses, reference: str, arch: str
) -> Places:
    scene, anatomy = patient
    start_taichi(arch)
    from rehearsal.case import case_of
    from rehearsal.reconstruction.compression_correction import CompressionCorrection
    from rehearsal.rehearsal import Rehearsal

    click.echo("Building the model.")
    probe = probe_of(scene)
    sweep_probe = images.fields.get(PROBE_FIELD, probe.transducer_name)
    if sweep_probe != probe.transducer_name:
        raise CommandError(
            f"--undo-compression: the sweep was made with the probe {sweep_probe}, the scene has "
            f"{probe.transducer_name}: "
            "set transducer.probe in the scene"
        )
    rehearsal = Rehearsal(case_of(scene, anatomy, probe), anatomy)
    return CompressionCorrection(rehearsal, images, image_poses, reference)


def _describe(images: Sweep, image_poses: ImagePoses) -> dict[str, Any]:
    """The number of images, their distances, and the speed of the probe."""
    steps = image_poses.steps_mm
    intervals = np.diff(images.times_s[image_poses.frames])
    speed = steps[intervals > 0] / intervals[intervals > 0]
    return dict(
        frames=len(images),
        used=len(image_poses.frames),
        way_mm=round(float(steps.sum()), 3),
        between_median_mm=round(float(np.median(steps)), 4) if len(steps) else 0.0,
        between_max_mm=round(float(steps.max()), 4) if len(steps) else 0.0,
        speed_median_mm_s=round(float(np.median(speed)), 3) if len(speed) else 0.0,
        speed_max_mm_s=round(float(speed.max()), 3) if len(speed) else 0.0,
    )


def _metrics(
    volumes: SweepVolumes, patient: tuple[Scene, LoadedAnatomy] | None
) -> tuple[dict[str, Any], str]:
    """The segmentation metrics of organ and tumour, or why there are none."""
    if patient is None or not volumes.regions:
        return {}, ""
    from rehearsal.reconstruction.patient_comparison import are_apart, compare_with_surfaces, surfaces_of

    surfaces = surfaces_of(patient[1])
    try:
        # A box that encloses both could exceed the memory.
        comparison = (
            {} if are_apart(volumes.box, surfaces["organ"]) else compare_with_surfaces(volumes, surfaces)
        )
    except ValueError as error:
        return {}, f"Not compared with the whole organ: {error}"
    scanned = comparison["organ"]["scanned"] if "organ" in comparison else 0.0
    if scanned < LEAST_SCANNED:
        return {}, (
            f"Not compared: the sweep covers {100 * scanned:.1f} % of this organ, so it is of another organ "
            "or patient. Name its own "
            "scene with --scene."
        )
    return comparison, ""


def in_words(report: dict[str, Any]) -> str:
    """The main results, in a few lines for the terminal."""
    lines = [
        f"images    {report['used']} of {report['frames']} with a pose, "
        f"{report['between_median_mm']:.2f} mm apart (median; at most "
        f"{report['between_max_mm']:.2f}), {report['speed_median_mm_s']:.0f} mm/s",
        f"volume    {' x '.join(map(str, report['shape']))} voxels of {report['spacing_mm']:g} mm, "
        f"{report['method']}" + (", compression corrected" if report["undo_compression"] else ""),
    ]
    for name, figures in report["agreement"].items():
        line = f"{name:<9} {100 * figures['scanned']:.0f} % scanned"
        if part := figures["scanned_part"]:
            line += "; in this part " if figures["scanned"] >= SMALL_SCANNED else "; only in this small part "
            line += _metrics_in_words(part)
        lines.append(line)
    return "\n".join(lines)


def _metrics_in_words(part: dict[str, float | None]) -> str:
    if part["centroid_mm"] is None:
        return "nothing found"
    return (
        f"Dice {part['dice']:.3f}, HD95 {part['hd95_mm']:.2f} mm, volume {part['volume_percent']:+.1f} %, "
        f"centroid {part['centroid_mm']:.2f} mm off"
    )
