"""The command ``scan``: images of an anatomy at rest, for a list of probe poses."""

from collections.abc import Collection
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click
import numpy as np
import trimesh
from tqdm import tqdm

from rehearsal.commands.command_line import (
    CommandError,
    arch_option,
    image_options,
    make_folder,
    start_taichi,
)
from rehearsal.configuration import probe_of
from rehearsal.result_files import write_json
from rehearsal.tracking.pose_file import load_poses
from scenes.anatomy import load_anatomy
from scenes.scene import load_scene, scene_file, with_options
from sim.signed_distance import signed_distance
from ultrasound.probe import Probe
from version import VERSION

if TYPE_CHECKING:
    from rehearsal.image_and_surface_files import SavedImage

FRAMES_PER_SECOND = 30
# A probe never reaches this depth below the surface of the organ at rest.
DEEP_MM = 20.0


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "--pose", "poses", type=click.Path(path_type=Path), required=True, help="Poses of the probe, JSON or CSV."
)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder for the images and scan.json."
)
@image_options
@click.option(
    "--contact",
    type=click.Choice(["tissue", "organ"]),
    default="tissue",
    show_default=True,
    help="What counts as contact with the array: everything but gas in the CT, or the organ only.",
)
@click.option("--dicom", is_flag=True, help="Write each B-mode image as DICOM too.")
@click.option(
    "--sweep",
    is_flag=True,
    help="Write all images as one tracked sweep too (PLUS), with ground-truth labels.",
)
@arch_option
def scan(
    scene: Path,
    poses: Path,
    out: Path,
    probe: str | None,
    picture: str | None,
    detail_level: str | None,
    contact: str,
    dicom: bool,
    sweep: bool,
    arch: str,
) -> None:
    """Make images of SCENE at a list of probe poses.

    SCENE is a scene file or a patient's folder, at rest as in the CT.
    Writes a PNG image for each pose of a file, and scan.json with the size of the pixels.
    """
    path = scene_file(scene)
    options = {"transducer.probe": probe, "image.mode": picture, "image.detail_level": detail_level}
    loaded = with_options(load_scene(path), options)
    pose_by_name = load_poses(poses)
    anatomy = load_anatomy(loaded, path.parent)
    if anatomy.ct is None:
        raise CommandError(f"{path}: has no CT: expected anatomy.ct, from which the images are made")
    warn_of_deep_poses(pose_by_name.values(), anatomy.organ)
    scan_probe, settings = probe_of(loaded), loaded.image
    used = start_taichi(arch)
    from rehearsal.image_and_surface_files import save_images
    from rehearsal.rehearsal import scanned_anatomy
    from sim.embedding import Unmoved
    from ultrasound.probe_manipulator import ImagePlane
    from ultrasound.scanner import Scanner
    from ultrasound.sweep_file import LabelledSweep

    make_folder(out)
    scanned = scanned_anatomy(anatomy.organ, anatomy.ct, anatomy, np.zeros(3))
    scanner = Scanner(
        scanned, Unmoved(), scan_probe, settings.pixels, "background", contact, settings.contact_gap_mm
    )
    recording = LabelledSweep(out, "sweep", scan_probe) if sweep else None
    rows, ms, empty = [], [], 0
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
        saved = save_images(images, *scan_probe.extent_mm[:2], scan_probe, out / name, dicom)
        rows += [dict(pose=name, probe_to_patient=pose.tolist()) | _row(each, scan_probe) for each in saved]
    if recording is not None:
        recording.close()
    report = dict(
        version=VERSION,
        probe=scan_probe.model_dump(by_alias=True),
        detail_level=settings.detail_level,
        contact=contact,
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


def _row(saved: "SavedImage", probe: Probe) -> dict[str, Any]:
    """The entry of an image in scan.json."""
    return dict(
        picture=saved.kind,
        file=saved.path.name,
        row_mm=saved.spacing_mm[0],
        column_mm=saved.spacing_mm[1],
        image_to_probe=probe.image_to_probe(*saved.shape).tolist(),
    )
