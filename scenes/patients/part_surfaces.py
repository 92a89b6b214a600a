"""Surfaces of an organ and of its parts: tumours, cysts, vessels, collecting system, sinus."""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from typing import TypeAlias, cast

import numpy as np
import SimpleITK as sitk
import trimesh
from joblib import cpu_count
from joblib.externals.loky import ProcessPoolExecutor
from scipy import ndimage

from errors import PatientError
from scenes.patients.label_surfaces import surface_from_mask
from scenes.patients.organ_selection import HILAR, LESIONS, VESSELS, Organ
from scenes.patients.readers.label_maps import Colour, LabelMap
from scenes.terminal import Progress
from scenes.volumes.voxel_grid import VoxelGrid

# Vessels and the collecting system are modelled up to this distance from the organ: its pedicle.
PEDICLE_MM = 15.0
# The number of faces is proportional to the area: a tumour is meshed as finely as a kidney of this area;
# branching parts, finer.
FACES, FACES_AT_MM2 = 5000, 17000.0
LEAST_FACES = 500
BRANCHING = 3.0
# Smooth area per area of voxel faces.
SMOOTH_AREA = 2 / 3
# Surfaces of less area than this are made sooner than a process starts.
PROCESSES_FROM_MM2 = 5000.0
# Parts with a surface: tissue -> file name. Arteries and veins are in one surface.
PARTS = {
    "tumour": "tumour",
    "cyst": "cyst",
    "urine": "collecting-system",
    "vessel": "vessels",
    "sinus": "sinus",
}
# Tissue -> grid and mask (z, y, x).
PartMasks: TypeAlias = dict[str, tuple[VoxelGrid, np.ndarray]]


def organ_surface(piece: Organ) -> trimesh.Trimesh:
    """Surface of the organ with its tumours and cysts. Raises PatientError."""
    return _surface(piece.grid.image(piece.mask.astype(np.uint8)), "organ", FACES)


def part_masks(labels: LabelMap, piece: Organ) -> PartMasks:
    """Masks of the parts in the organ, and of vessels and collecting system near it."""
    masks = {}
    for tissue in PARTS:
        values = labels.of_tissues(*(VESSELS if tissue == "vessel" else (tissue,)))
        if not values:
            continue
        grid, inside = piece.grid, piece.mask & np.isin(piece.values, values)
        if tissue in HILAR:
            grid, inside = near_organ(labels, piece, values)
        if inside.any():
            masks[tissue] = grid, inside
    return masks


def parts_elsewhere(
    labels: LabelMap, piece: Organ, pieces: Sequence[Organ], masks: PartMasks, assigned: Collection[str]
) -> list[str]:
    """Notes of the assigned tissues whose labels are not in ``masks``, the parts of one of the organs."""
    notes = []
    for tissue in assigned:
        values = labels.of_tissues(tissue)
        part = "vessel" if tissue in VESSELS else tissue
        if not values or part not in PARTS or part in masks:
            continue
        if tissue in HILAR:
            notes.append(f"the {tissue}'s label is more than {PEDICLE_MM:g} mm from this kidney")
        elif any(np.isin(other.values[other.mask], values).any() for other in pieces if other is not piece):
            notes.append(f"the {tissue}'s label is only in the other kidney")
    return notes


@contextmanager
def part_surfaces_in_processes(
    masks: PartMasks,
) -> Iterator[Callable[[Progress], dict[str, trimesh.Trimesh]]]:
    """Start to make the surfaces of all parts, in processes where they are large; yield a function that waits
    for them.

    Raises PatientError where a tumour or cyst has no surface.
    """
    jobs = min(cpu_count(), len(masks))
    if jobs < 2 or sum(_area_mm2(*part) for part in masks.values()) < PROCESSES_FROM_MM2:
        yield lambda progress: _without_empty(
            (t, part_surface(*masks[t], t)) for t in progress(masks, "surfaces")
        )
        return
    with ProcessPoolExecutor(jobs) as pool:
        # The last parts take longest.
        made = {tissue: pool.submit(part_surface, *masks[tissue], tissue) for tissue in reversed(masks)}
        try:
            yield lambda progress: _without_empty((t, made[t].result()) for t in progress(masks, "surfaces"))
        except BrokenExecutor:
            raise PatientError(
                "a process that made surfaces was ended, perhaps for lack of memory; close other programs "
                "and try again"
            ) from None


def _without_empty(made: Iterable[tuple[str, trimesh.Trimesh | None]]) -> dict[str, trimesh.Trimesh]:
    return {tissue: surface for tissue, surface in made if surface is not None}


def colours_of_labels(labels: LabelMap, tissues: Sequence[str]) -> dict[str, Colour]:
    """Colours of the organ and its parts in the label files."""
    colours = {s.tissue: s.colour for s in reversed(labels.segments.values()) if s.tissue and s.colour}
    named = {"organ": colours.get("kidney"), **{tissue: colours.get(tissue) for tissue in tissues}}
    return {name: colour for name, colour in named.items() if colour}


def near_organ(labels: LabelMap, piece: Organ, values: list[int]) -> tuple[VoxelGrid, np.ndarray]:
    """Grid and mask (z, y, x) of labels within PEDICLE_MM of the organ."""
    start = np.rint(labels.grid.index(piece.grid.origin)).astype(int)
    rim = np.ceil(PEDICLE_MM / labels.grid.spacing).astype(int)
    low = np.maximum(start - rim, 0)
    high = np.minimum(start + piece.grid.size + rim, labels.grid.size)
    x, y, z = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    organ = np.zeros([a.stop - a.start for a in (z, y, x)], bool)
    at = start - low
    organ[tuple(slice(int(a), int(a) + n) for a, n in zip(at[::-1], piece.mask.shape, strict=True))] = (
        piece.mask
    )
    distance = ndimage.distance_transform_edt(~organ, sampling=labels.grid.spacing[::-1])
    return labels.grid.part((x, y, z)), (distance <= PEDICLE_MM) & np.isin(labels.values[z, y, x], values)


def _surface(mask: sitk.Image, name: str, faces: int) -> trimesh.Trimesh:
    try:
        return surface_from_mask(mask, faces)
    except ValueError as error:
        grid, inside = VoxelGrid.of(mask), sitk.GetArrayViewFromImage(mask) != 0
        x, y, z = grid.place(np.argwhere(inside).mean(axis=0)[None, ::-1])[0]
        raise PatientError(
            f"the {name} has no surface: {error}; its label has {inside.sum()} voxels, "
            f"{inside.sum() * grid.voxel_ml:.2f} ml, there, around "
            f"{x:.0f}, {y:.0f}, {z:.0f} mm (LPS); remove them from the label, or draw it on smaller voxels"
        ) from error


def part_surface(grid: VoxelGrid, inside: np.ndarray, tissue: str) -> trimesh.Trimesh | None:
    """Surface of a part: all its bodies but specks in one mesh.

    None where a part other than a lesion is too thin.
    """
    labelled, _ = ndimage.label(inside)
    sizes = np.bincount(labelled.ravel())[1:]
    finer = BRANCHING if tissue in HILAR else 1.0
    surfaces = []
    for n in np.flatnonzero(sizes >= 0.1 * sizes.max()):
        body = labelled == n + 1
        faces = np.clip(finer * FACES * _area_mm2(grid, body) / FACES_AT_MM2, LEAST_FACES, FACES)
        try:
            name = PARTS[tissue].replace("-", " ")
            surfaces.append(_surface(grid.image(body.astype(np.uint8)), name, int(faces)))
        except PatientError:
            if tissue in LESIONS:
                raise
    if not surfaces:
        return None
    return surfaces[0] if len(surfaces) == 1 else cast(trimesh.Trimesh, trimesh.util.concatenate(surfaces))


def _area_mm2(grid: VoxelGrid, inside: np.ndarray) -> float:
    """Approximate area of a label's surface."""
    padded = np.pad(inside, 1)
    steps = [int((np.diff(padded.view(np.int8), axis=axis) != 0).sum()) for axis in range(3)]
    faces_mm2 = (np.prod(grid.spacing) / grid.spacing)[::-1]
    return float(SMOOTH_AREA * np.dot(steps, faces_mm2))
