"""The command ``scan``: images of an anatomy at rest, for a list of probe poses."""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import click
import numpy as np
import trimesh
from tqdm import tqdm

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
from rehearsal.result_files import write_json
from rehearsal.tracking.pose_file import load_poses
from scenes.scene import scene_file
from sim.signed_distance import signed_distance
from version import VERSION

# A probe never reaches this depth below the surface of the organ at rest.
DEEP_MM = 20.0


class ScanOptions(ArchOptions):
    """What the user asks of a scan."""

    scene_sections: ClassVar = ("transducer", "image")

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
    clamped: bool = False
    """With --doppler: the renal hilum is clamped, and no blood flows in the kidney."""
    iq: Literal["npz", "mat"] | None = None
    """Write IQ and RF signals of each B-mode image too, before gain, for NumPy or MATLAB, with the motion
    of the tissue.
    """
    sweep: bool = False
    """Write all images as one tracked sweep too (PLUS), with ground-truth labels."""

    @property
    def mode_needs_b_mode(self) -> bool:
        """Whether something is made from the B-mode image."""
        return self.iq is not None or self.doppler != "off"


@command(ScanOptions)
def scan(options: ScanOptions) -> None:
    """Make images of SCENE at a list of probe poses.

    SCENE is a scene file or a patient's folder, at rest as in the CT.
    Writes a PNG image for each pose of a file, and scan.json with the size of the pixels.
    """
    out, pose_by_name = options.out, load_poses(options.poses)
    loaded, anatomy = load_patient(options.scene, options.changes)
    if anatomy.ct is None:
        raise CommandError(
            f"{scene_file(options.scene)}: has no CT: expected anatomy.ct, from which the images are made"
        )
    warn_of_deep_poses(pose_by_name.values(), anatomy.organ)
    scan_probe, settings = probe_of(loaded), loaded.image
    if options.mode_needs_b_mode and settings.mode == "ct":
        raise CommandError(
            "--picture ct: --doppler and --iq are made from a B-mode image; leave them out, or choose both "
            "or b-mode"
        )
    if options.iq is not None and settings.detail_level == "reflection":
        raise CommandError("--iq: the detail level reflection has no phase; choose speckle or elevation")
    if options.clamped and options.doppler == "off":
        raise CommandError("--clamped: changes only Doppler; add --doppler colour or power, or leave it out")
    if options.iq is not None and scan_probe.compound_angles > 1:
        raise CommandError(
            f"--iq: CompoundAngles = {scan_probe.compound_angles} of the probe averages images, which have "
            "no one signal; "
            "choose a probe with 1"
        )
    used = start_taichi(options.arch)
    from rehearsal.pose_scans import PoseScans

    make_folder(out)
    scans = PoseScans(anatomy, anatomy.ct, scan_probe, settings, options.contact, out)
    with scans.recording(options.sweep):
        for name, pose in tqdm(pose_by_name.items(), desc="scan", unit="pose"):
            images = scans.images(pose)
            if options.iq is not None:
                scans.save_iq(name, images, options.iq)
            by_name = images.by_name
            if options.doppler != "off":
                by_name = scans.with_doppler(images, options.doppler, options.clamped)
            scans.save(name, by_name, options.dicom)
    report = dict(
        version=VERSION,
        probe=scan_probe.model_dump(by_alias=True),
        detail_level=settings.detail_level,
        atlas=settings.atlas,
        contact=options.contact,
        contact_gap_mm=scans.scanner.contact_gap_mm,
        doppler=options.doppler,
        clamped=options.clamped,
        arch=used,
        pictures=scans.rows,
    )
    write_json(report, out / "scan.json")
    if scans.empty:
        click.echo(
            f"Warning: {scans.empty} of {len(pose_by_name)} poses show nothing of the organ; they may be of "
            "another patient."
        )
    sweep = ", sweep.igs.mha" if options.sweep else ""
    click.echo(
        f"Wrote {len(scans.rows)} images of {len(pose_by_name)} poses, scan.json{sweep} to {out}; "
        f"{np.median(scans.ms):.1f} ms per pose (median)."
    )


def warn_of_deep_poses(poses: Collection[np.ndarray], organ: trimesh.Trimesh) -> None:
    """Print how many poses (4, 4) are impossible on this organ."""
    faces = np.array([pose[:3, 3] for pose in poses])
    deep = int((signed_distance(organ.vertices, organ.faces, faces)[0] < -DEEP_MM).sum())
    if deep:
        click.echo(
            f"Warning: {deep} of {len(poses)} poses are more than {DEEP_MM:g} mm inside the organ; they may "
            "be of another patient."
        )
