"""The command ``scan``: pictures of an anatomy at rest for a list of probe poses."""

from collections.abc import Collection
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click
import numpy as np
import trimesh
from tqdm import tqdm

from rehearsal.commands.command_line import CommandError, arch_option, make_folder, start_taichi
from rehearsal.configuration import probe_of
from rehearsal.result_files import write_json
from rehearsal.tracking.pose_file import load_poses
from scenes.anatomy import load_anatomy
from scenes.scene import load_scene, scene_file, with_options
from sim.signed_distance import signed_distance
from ultrasound.probe import DETAIL_LEVELS, MODES, Probe
from version import VERSION

if TYPE_CHECKING:
    from rehearsal.image_files import SavedPicture

FRAMES_A_SECOND = 30
# No hand presses a probe as deep as this into where an organ lies at rest.
DEEP_MM = 20.0


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "--pose", "poses", type=click.Path(path_type=Path), required=True, help="Poses of the probe, JSON or CSV."
)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder for the pictures and scan.json."
)
@click.option("--probe", help="Probe, by its name or as a file [the scene's].")
@click.option("--picture", type=click.Choice(MODES), help="Echo, CT or both [the scene's].")
@click.option(
    "--detail-level",
    "--rung",
    "detail_level",
    type=click.Choice(DETAIL_LEVELS),
    help="How much of the echo is computed [the scene's].",
)
@click.option(
    "--contact",
    type=click.Choice(["tissue", "organ"]),
    default="tissue",
    show_default=True,
    help="What lets sound in where it touches the array: anything but gas, as the CT has it, or the organ alone.",
)
@click.option("--dicom", is_flag=True, help="Each echo picture as DICOM too.")
@click.option(
    "--sweep",
    is_flag=True,
    help="All as one tracked sweep too, as PLUS writes them, with the truth beside it.",
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
    """Take pictures of SCENE at a list of probe poses.

    SCENE is a scene file or a patient's folder. It lies as in the CT: no body, no window.
    For each pose of a file, what the probe shows there. Writes PNG pictures and scan.json, which says how large their pixels are.
    """
    path = scene_file(scene)
    options = {"transducer.probe": probe, "image.mode": picture, "image.detail_level": detail_level}
    loaded = with_options(load_scene(path), options)
    placed = load_poses(poses)
    anatomy = load_anatomy(loaded, path.parent)
    if anatomy.ct is None:
        raise CommandError(f"{path}: has no CT: expected anatomy.ct, of which pictures are made")
    warn_of_deep(placed.values(), anatomy.organ)
    held, image = probe_of(loaded), loaded.image
    used = start_taichi(arch)
    from rehearsal.image_files import save_pictures
    from rehearsal.rehearsal import scanned_anatomy
    from sim.embedding import Unmoved
    from ultrasound.image_plane import ImagePlane
    from ultrasound.labelled_sweep import LabelledSweep
    from ultrasound.scanner import Scanner

    make_folder(out)
    scanned = scanned_anatomy(anatomy.organ, anatomy.ct, anatomy, np.zeros(3))
    scanner = Scanner(scanned, Unmoved(), held, image.pixels, "background", contact, image.contact_gap_mm)
    swept = LabelledSweep(out, "sweep", held) if sweep else None
    rows, ms, empty = [], [], 0
    for name, pose in tqdm(placed.items(), desc="scan", unit="pose"):
        began = perf_counter()
        plane = ImagePlane(pose, *held.extent_mm)
        shown = scanner.images(plane, held, image.mode, image.detail_level, image.window_hu, image.level_hu)
        ms.append(1000 * (perf_counter() - began))
        marks = scanner.ground_truth.render()
        empty += not marks.any()
        if swept is not None:
            grey = next(iter(shown.values()))
            swept.add(grey, marks, held, pose, swept.count / FRAMES_A_SECOND)
        saved = save_pictures(shown, *held.extent_mm[:2], held, out / name, dicom)
        rows += [dict(pose=name, probe_to_patient=pose.tolist()) | _row(each, held) for each in saved]
    if swept is not None:
        swept.close()
    report = dict(
        version=VERSION,
        probe=held.model_dump(by_alias=True),
        detail_level=image.detail_level,
        contact=contact,
        contact_gap_mm=image.contact_gap_mm,
        arch=used,
        pictures=rows,
    )
    write_json(report, out / "scan.json")
    if empty:
        click.echo(
            f"Mind: {empty} of {len(placed)} poses show nothing of the organ; they may be of another patient."
        )
    click.echo(
        f"Wrote {len(rows)} pictures of {len(placed)} poses and scan.json to {out}; {np.median(ms):.1f} ms a pose (median)."
    )


def warn_of_deep(poses: Collection[np.ndarray], organ: trimesh.Trimesh) -> None:
    """Say how many poses (4, 4) no probe can take on this organ."""
    faces = np.array([pose[:3, 3] for pose in poses])
    deep = int((signed_distance(organ.vertices, organ.faces, faces)[0] < -DEEP_MM).sum())
    if deep:
        click.echo(
            f"Mind: {deep} of {len(poses)} poses lie more than {DEEP_MM:g} mm inside the organ; they may be of another patient."
        )


def _row(saved: "SavedPicture", probe: Probe) -> dict[str, Any]:
    """What scan.json says of a picture."""
    return dict(
        picture=saved.kind,
        file=saved.path.name,
        row_mm=saved.spacing_mm[0],
        column_mm=saved.spacing_mm[1],
        image_to_probe=probe.image_to_probe(*saved.shape).tolist(),
    )
