"""The command ``reconstruct``: a tracked sweep made into a volume, and compared with the patient."""

from pathlib import Path
from typing import Any

import click
import numpy as np
from tqdm import tqdm

from rehearsal.commands.command_line import (
    CommandError,
    NumberRange,
    arch_option,
    load_patient,
    make_folder,
    start_taichi,
)
from rehearsal.configuration import probe_of
from rehearsal.reconstruction.reconstruction_figure import save_picture
from rehearsal.reconstruction.reconstruction_files import save_volumes
from rehearsal.reconstruction.simulated_tracker import with_errors
from rehearsal.reconstruction.sweep_volumes import Places, Rebuilt, Track, lit, rebuild, track_of
from rehearsal.result_files import write_json
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from ultrasound.labelled_sweep import PROBE_FIELD, read_ground_truth
from ultrasound.reconstruction import METHODS
from ultrasound.sweep import Sweep, load_constants
from ultrasound.sweep_file import read_sweep, write_sweep
from ultrasound.tracking_errors import TrackingErrors
from version import VERSION

MOST_REACH_MM = 5.0
# Of less of the organ its figures say nothing, and of less than the second they are easily taken for the whole organ's.
LEAST_SCANNED, LITTLE_SCANNED = 0.01, 0.3


@click.command()
@click.argument("sweep", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder for the volume and the report."
)
@click.option(
    "--scene",
    type=click.Path(path_type=Path),
    help="Scene or patient's folder that the sweep is of: compare with it.",
)
@click.option(
    "--config",
    type=click.Path(path_type=Path),
    help="PLUS configuration (XML) with ImageToProbe, where the sweep has none.",
)
@click.option(
    "--reference",
    default="Reference",
    show_default=True,
    help="Coordinate system of the volume, as PLUS names it.",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="smooth",
    show_default=True,
    help="How pixels become voxels.",
)
@click.option(
    "--spacing-mm", type=NumberRange(0.05, 10), default=0.5, show_default=True, help="Width of a voxel."
)
@click.option(
    "--reach-mm",
    type=NumberRange(0, 20),
    help="Gaps up to twice as wide are filled [as wide as most pictures are apart].",
)
@click.option(
    "--undo-compression",
    is_flag=True,
    help="Press the scene's organ once more on the tracked way, and put each pixel where its tissue was at rest.",
)
@click.option(
    "--noise-mm", type=NumberRange(0), default=0.0, help="Add a tracker's noise: SD of each coordinate."
)
@click.option("--noise-deg", type=NumberRange(0), default=0.0, help="The same of the angle about each axis.")
@click.option(
    "--calibration-mm",
    type=NumberRange(0),
    default=0.0,
    help="Image off the probe by so much, in all frames.",
)
@click.option(
    "--calibration-deg", type=NumberRange(0), default=0.0, help="Image turned on the probe by so much."
)
@click.option("--latency-s", type=NumberRange(0), default=0.0, help="Poses of so much earlier.")
@click.option("--lost", type=NumberRange(0, 1), default=0.0, help="Share of frames without a pose.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of these errors.")
@arch_option
def reconstruct(
    sweep: Path,
    out: Path,
    scene: Path | None,
    config: Path | None,
    reference: str,
    method: str,
    spacing_mm: float,
    reach_mm: float | None,
    undo_compression: bool,
    seed: int,
    arch: str,
    **tracker: float,
) -> None:
    """Make a volume of SWEEP, a tracked sweep (.igs.mha).

    The sweep is Nephron's or PLUS's. Writes volume.nrrd, volume.png and report.json; beside a sweep of marks (SWEEP-marks.igs.mha, which a rehearsal records) the
    organ and tumour as they were seen, in labels.nrrd. With a tracker's errors, the sweep that has them is left as tracked.igs.mha.
    """
    if undo_compression and scene is None:
        raise CommandError("--undo-compression: presses the organ of a scene; name it with --scene")
    pictures = read_sweep(sweep)
    pictures.constant |= load_constants(config) if config else {}
    marks = read_ground_truth(sweep)
    errors = _errors_of(tracker)
    if errors != TrackingErrors():
        pictures = with_errors(pictures, reference, errors, seed)
    track = track_of(pictures, reference)
    about = _of_track(pictures, track)
    patient = None if scene is None else load_patient(scene)
    make_folder(out)
    if errors != TrackingErrors():
        write_sweep(out / "tracked.igs.mha", pictures)
    settings: dict[str, Any] = dict(
        method=method,
        spacing_mm=spacing_mm,
        reach_mm=usual_reach_mm(track, spacing_mm) if reach_mm is None else reach_mm,
    )
    places = None
    if undo_compression and patient is not None:
        places = _unsqueezed(patient, pictures, track, reference, arch)
    with tqdm(total=len(track.frames), desc="reconstruct", unit="picture") as bar:
        try:
            seen = lit(pictures.images)
            rebuilt = rebuild(pictures, track, seen, **settings, marks=marks, places=places, done=bar.update)
        except ValueError as error:
            raise CommandError(f"{sweep.name}: {error}") from None
    save_volumes(rebuilt, out)
    report = dict(
        version=VERSION,
        **settings,
        reference=reference,
        undo_compression=undo_compression,
        tracker=tracker,
        **about,
        shape=list(rebuilt.box.shape),
        agreement=_agreement(rebuilt, patient),
    )
    save_picture(rebuilt, out / "volume.png")
    write_json(report, out / "report.json")
    click.echo(in_words(report))
    click.echo(f"Wrote volume.nrrd, volume.png and report.json to {out}")


def _errors_of(tracker: dict[str, float]) -> TrackingErrors:
    try:
        return TrackingErrors(**tracker)
    except ValueError as error:
        raise CommandError(f"errors of a tracker: {error}") from None


def usual_reach_mm(track: Track, spacing_mm: float) -> float:
    """So far that most gaps between pictures close, and two voxels at least [mm]."""
    usual = float(np.percentile(track.steps_mm, 95)) if len(track.frames) > 1 else 0.0
    return max(2 * spacing_mm, min(usual, MOST_REACH_MM))


def _unsqueezed(
    patient: tuple[Scene, LoadedAnatomy], pictures: Sweep, track: Track, reference: str, arch: str
) -> Places:
    scene, anatomy = patient
    start_taichi(arch)
    from rehearsal.reconstruction.compression_correction import CompressionCorrection
    from rehearsal.rehearsal import Rehearsal

    click.echo("Building the model.")
    probe = probe_of(scene)
    taken_with = pictures.fields.get(PROBE_FIELD, probe.transducer_name)
    if taken_with != probe.transducer_name:
        raise CommandError(
            f"--undo-compression: the sweep was taken with the probe {taken_with}, the scene has {probe.transducer_name}: "
            "set transducer.probe in the scene"
        )
    rehearsal = Rehearsal(scene, anatomy, probe)
    return CompressionCorrection(rehearsal, pictures, track, reference)


def _of_track(pictures: Sweep, track: Track) -> dict[str, Any]:
    """How many pictures there are, how far apart and how fast the probe went."""
    steps = track.steps_mm
    waits = np.diff(pictures.times_s[track.frames])
    speed = steps[waits > 0] / waits[waits > 0]
    return dict(
        frames=len(pictures),
        used=len(track.frames),
        way_mm=round(float(steps.sum()), 3),
        between_median_mm=round(float(np.median(steps)), 4) if len(steps) else 0.0,
        between_max_mm=round(float(steps.max()), 4) if len(steps) else 0.0,
        speed_median_mm_s=round(float(np.median(speed)), 3) if len(speed) else 0.0,
        speed_max_mm_s=round(float(speed.max()), 3) if len(speed) else 0.0,
    )


def _agreement(rebuilt: Rebuilt, patient: tuple[Scene, LoadedAnatomy] | None) -> dict[str, Any]:
    if patient is None or not rebuilt.regions:
        return {}
    from rehearsal.reconstruction.patient_comparison import are_apart, compared, surfaces_of

    surfaces = surfaces_of(patient[1])
    try:
        # A box around both could be larger than the memory.
        found = {} if are_apart(rebuilt.box, surfaces["organ"]) else compared(rebuilt, surfaces)
    except ValueError as error:
        click.echo(f"Not compared with the whole organ: {error}")
        return {}
    scanned = found["organ"]["scanned"] if "organ" in found else 0.0
    if scanned < LEAST_SCANNED:
        click.echo(
            f"Not compared: the sweep is not of this organ, or of another patient; it shows {100 * scanned:.1f} % of it. Name its own "
            "scene with --scene."
        )
        return {}
    return found


def _of_that(scanned: float) -> str:
    return "of that" if scanned >= LITTLE_SCANNED else "of that small part alone"


def in_words(report: dict[str, Any]) -> str:
    """The figures that matter, in a few lines for the terminal."""
    lines = [
        f"pictures  {report['used']} of {report['frames']} with a pose, {report['between_median_mm']:.2f} mm apart (median; at most "
        f"{report['between_max_mm']:.2f}), {report['speed_median_mm_s']:.0f} mm/s",
        f"volume    {' x '.join(map(str, report['shape']))} voxels of {report['spacing_mm']:g} mm, {report['method']}"
        + (", compression undone" if report["undo_compression"] else ""),
    ]
    for name, figures in report["agreement"].items():
        part = figures["scanned_part"]
        lines.append(
            f"{name:<9} {100 * figures['scanned']:.0f} % scanned"
            + (
                ""
                if not part
                else f"; {_of_that(figures['scanned'])} nothing found"
                if part["centroid_mm"] is None
                else f"; {_of_that(figures['scanned'])} Dice {part['dice']:.3f}, HD95 {part['hd95_mm']:.2f} mm, volume {part['volume_percent']:+.1f} %, "
                f"centroid {part['centroid_mm']:.2f} mm off"
            )
        )
    return "\n".join(lines)
