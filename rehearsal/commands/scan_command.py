"""The command ``scan``: images of an anatomy at rest, for a list of probe poses."""

from collections.abc import Collection
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import click
import numpy as np
import trimesh
from tqdm import tqdm

from rehearsal.commands.command_line import (
    ARGUMENT,
    ArchOptions,
    CommandError,
    ImageOptions,
    command,
    load_patient,
    make_folder,
    start_taichi,
)
from rehearsal.configuration import probe_of
from rehearsal.result_files import write_json
from rehearsal.tracking.pose_file import load_poses
from scenes.scene import scene_file
from sim.signed_distance import signed_distance
from version import VERSION

FRAMES_PER_SECOND = 30
# A probe never reaches this depth below the surface of the organ at rest.
DEEP_MM = 20.0


class ScanOptions(ImageOptions, ArchOptions):
    """What the user asks of a scan."""

    scene: Annotated[Path, ARGUMENT]
    poses: Annotated[Path, "--pose"]
    """Poses of the probe, JSON or CSV."""
    out: Path
    """Folder for the images and scan.json."""
    contact: Literal["tissue", "organ"] = "tissue"
    """What counts as contact with the array: everything but gas in the CT, or the organ only."""
    dicom: bool = False
    """Write each B-mode image as DICOM too."""
    doppler: Literal["off", "colour", "power"] = "off"
    """Write each B-mode image with colour or power Doppler too, at the peak of systole."""
    iq: Literal["npz", "mat"] | None = None
    """Write IQ and RF signals of each B-mode image too, before gain, for NumPy or MATLAB, with the motion of the tissue."""
    sweep: bool = False
    """Write all images as one tracked sweep too (PLUS), with ground-truth labels."""


@command(ScanOptions)
def scan(asked: ScanOptions) -> None:
    """Make images of SCENE at a list of probe poses.

    SCENE is a scene file or a patient's folder, at rest as in the CT.
    Writes a PNG image for each pose of a file, and scan.json with the size of the pixels.
    """
    out, pose_by_name = asked.out, load_poses(asked.poses)
    loaded, anatomy = load_patient(asked.scene, asked.changes)
    if anatomy.ct is None:
        raise CommandError(
            f"{scene_file(asked.scene)}: has no CT: expected anatomy.ct, from which the images are made"
        )
    warn_of_deep_poses(pose_by_name.values(), anatomy.organ)
    scan_probe, settings = probe_of(loaded), loaded.image
    used = start_taichi(asked.arch)
    from rehearsal.image_and_surface_files import save_images
    from rehearsal.rehearsal import scanned_anatomy
    from sim.embedding import Unmoved
    from ultrasound.blood_flow import SYSTOLE_S
    from ultrasound.iq_signal import save_iq
    from ultrasound.probe_manipulator import ImagePlane
    from ultrasound.scanner import B_MODE, DOPPLER, Scanner
    from ultrasound.sweep_file import LabelledSweep

    make_folder(out)
    scanned = scanned_anatomy(anatomy.organ, anatomy.ct, anatomy, np.zeros(3))
    scanner = Scanner(
        scanned, Unmoved(), scan_probe, settings.pixels, "background", asked.contact, settings.contact_gap_mm
    )
    recording = LabelledSweep(out, "sweep", scan_probe) if asked.sweep else None
    rows, ms, empty = [], [], 0
    planes: list[ImagePlane] = []
    for name, pose in tqdm(pose_by_name.items(), desc="scan", unit="pose"):
        began = perf_counter()
        plane = ImagePlane(pose, *scan_probe.extent_mm)
        images = scanner.images(
            plane, scan_probe, settings.mode, settings.detail_level, settings.window_hu, settings.level_hu
        )
        ms.append(1000 * (perf_counter() - began))
        labels = scanner.ground_truth.render()
        empty += not labels.any()
        if recording is not None:
            grey = next(iter(images.values()))
            recording.add(grey, labels, scan_probe, pose, recording.count / FRAMES_PER_SECOND)
        if asked.iq is not None and B_MODE in images:
            signals = scanner.iq(
                scan_probe, plane, planes[-1] if planes else None, planes[0] if planes else plane
            )
            save_iq(signals, out / f"{name}-iq.{asked.iq}")
            planes.append(plane)
        if asked.doppler != "off" and B_MODE in images:
            given = scan_probe, images[B_MODE], asked.doppler, SYSTOLE_S
            images[DOPPLER] = scanner.doppler(*given)
        saved = save_images(images, *scan_probe.extent_mm[:2], scan_probe, out / name, asked.dicom)
        rows += [
            dict(
                pose=name,
                probe_to_patient=pose.tolist(),
                picture=each.kind,
                file=each.path.name,
                row_mm=each.spacing_mm[0],
                column_mm=each.spacing_mm[1],
                image_to_probe=scan_probe.image_to_probe(*each.shape).tolist(),
            )
            for each in saved
        ]
    if recording is not None:
        recording.close()
    report = dict(
        version=VERSION,
        probe=scan_probe.model_dump(by_alias=True),
        detail_level=settings.detail_level,
        contact=asked.contact,
        contact_gap_mm=settings.contact_gap_mm,
        arch=used,
        pictures=rows,
    )
    write_json(report, out / "scan.json")
    if empty:
        click.echo(
            f"Warning: {empty} of {len(pose_by_name)} poses show nothing of the organ; they may be of another patient."
        )
    click.echo(
        f"Wrote {len(rows)} images of {len(pose_by_name)} poses and scan.json to {out}; {np.median(ms):.1f} ms per pose (median)."
    )


def warn_of_deep_poses(poses: Collection[np.ndarray], organ: trimesh.Trimesh) -> None:
    """Print how many poses (4, 4) are impossible on this organ."""
    faces = np.array([pose[:3, 3] for pose in poses])
    deep = int((signed_distance(organ.vertices, organ.faces, faces)[0] < -DEEP_MM).sum())
    if deep:
        click.echo(
            f"Warning: {deep} of {len(poses)} poses are more than {DEEP_MM:g} mm inside the organ; they may be of another patient."
        )
