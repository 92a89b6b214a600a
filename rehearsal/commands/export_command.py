"""The command ``export``: the surfaces and volumes of a scene as files."""

from pathlib import Path
from typing import Annotated

import click
import trimesh

from rehearsal.commands.command_line import ARGUMENT, CommandOptions, command, echo_import_warnings
from rehearsal.result_files import counted
from rehearsal.tissue_voxels import stored_tissue_map
from scenes.anatomy import LoadedAnatomy, files_of, load_anatomy
from scenes.atomic_files import check_folder, new_folder
from scenes.patients.part_surfaces import PARTS
from scenes.scene import Scene, load_scene, scene_file
from scenes.surfaces import FORMATS, save_surface
from scenes.tissue_classes.class_image import CLASS_IMAGE_FILE, class_image
from scenes.volumes.volume_files import file_volume, save_image


class ExportOptions(CommandOptions):
    """What the user asks of an export."""

    scene: Annotated[Path, ARGUMENT]
    out: Path
    """Folder to write to; new or empty."""
    suffix: Annotated[str, "--format", click.Choice(FORMATS)] = "stl"
    """Format of the surfaces; PLY keeps the order of their vertices."""


@command(ExportOptions)
def export(options: ExportOptions) -> None:
    """Write surfaces, CT and labels of SCENE as files.

    SCENE is a scene file or a patient's folder. Surfaces become STL or PLY, CT and label map NRRD.
    classes.seg.nrrd, for 3D Slicer, is the tissue of every voxel, as labelled, classified and drawn;
    corrected there, it is given to import beside the labels.
    All is in mm, in the patient's LPS, at rest; rehearse writes the deformed surfaces.
    """
    path, out, suffix = scene_file(options.scene), options.out, options.suffix
    check_folder(out)
    loaded = load_scene(path)
    echo_import_warnings(loaded, path.parent)
    anatomy = load_anatomy(loaded, path.parent)
    named = surfaces(anatomy)
    with new_folder(out) as partial:
        for name, surface in named.items():
            save_surface(surface, partial / f"{name}.{suffix}")
        volumes = [*save_volumes(loaded, path.parent, partial), *save_classes(loaded, anatomy, partial)]
    click.echo(
        f"Wrote to {out}, in mm, LPS: {', '.join([*(f'{name}.{suffix}' for name in named), *volumes])}"
    )
    without = sum(not isinstance(shape, trimesh.Trimesh) for shape in anatomy.shapes)
    if without:
        click.echo(
            f"Left out: {counted(without, 'shape')} under the organ; planes and distance fields are not "
            "surfaces."
        )


def surfaces(anatomy: LoadedAnatomy) -> dict[str, trimesh.Trimesh]:
    """The surfaces of an anatomy, by the names of their files: organ, tumour, parts, support, support-2,
    ...
    """
    surfaces = {"organ": anatomy.organ}
    if anatomy.tumour is not None:
        surfaces["tumour"] = anatomy.tumour
    surfaces |= {PARTS[tissue]: part for tissue, part in anatomy.parts.items()}
    supports = [shape for shape in anatomy.shapes if isinstance(shape, trimesh.Trimesh)]
    return surfaces | {
        "support" if n == 1 else f"support-{n}": support for n, support in enumerate(supports, 1)
    }


def save_volumes(scene: Scene, folder: Path, out: Path) -> list[str]:
    """Write the voxels of CT and label map, unchanged and without metadata; return the names of the files.

    Raises OSError.
    """
    folder, files = files_of(scene, folder)
    wanted = {"ct.nrrd": files.ct, "labels.nrrd": files.labels}
    written = {name: file for name, file in wanted.items() if file}
    for name, file in written.items():
        save_image(file_volume(folder / file).image(), out / name)
    return list(written)


def save_classes(scene: Scene, anatomy: LoadedAnatomy, out: Path) -> list[str]:
    """Write the tissue of every voxel as a segmentation of 3D Slicer; return the names of the files, none
    without labels. Raises OSError.
    """
    if anatomy.ct is None or anatomy.labels is None:
        return []
    tissues = stored_tissue_map(anatomy.labels, anatomy, anatomy.ct, scene.image.atlas)
    save_image(class_image(tissues), out / CLASS_IMAGE_FILE)
    return [CLASS_IMAGE_FILE]
