"""Patient import: from a CT and its labels to surfaces of an organ and its parts, a support, and the cropped
CT.

All coordinates are DICOM's: LPS [mm], +x to the patient's left, +y posterior, +z to the head. Voxels are
cropped, and resampled only where a series is tilted or unevenly spaced.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import numpy as np
import SimpleITK as sitk
import trimesh

from errors import PatientError
from scenes.kidney_axes import kidney_axes
from scenes.patient_space import Space
from scenes.patients.body_orientation import orientation_warnings
from scenes.patients.class_corrections import corrections_of
from scenes.patients.dense_findings import dense_findings
from scenes.patients.import_warnings import fat_warnings, label_warnings
from scenes.patients.kidney_plausibility import kidney_warnings
from scenes.patients.label_islands import island_warnings
from scenes.patients.label_shift import shift_warnings
from scenes.patients.missing_slices import fill_missing_slices
from scenes.patients.organ_selection import (
    HILAR,
    LESIONS,
    PARENCHYMA,
    Organ,
    choose_organ,
    find_organs,
    midline_x,
    organ_values,
)
from scenes.patients.organ_support import bed_of_file, bed_of_labels, mould
from scenes.patients.part_surfaces import (
    colours_of_labels,
    organ_surface,
    part_masks,
    part_surfaces_in_processes,
    parts_elsewhere,
)
from scenes.patients.patient_position import GRAVITY, Position, position_of, position_warnings
from scenes.patients.readers.label_maps import Colour, LabelMap, present_values, resample_nearest
from scenes.patients.readers.segment_names import Side
from scenes.terminal import Progress, silent
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.voxel_grid import Box, VoxelGrid

PLAUSIBLE_ORGAN_HU = (-150.0, 600.0)
PLAUSIBLE_ORGAN_ML = (20.0, 2000.0)
CUT_AREA_MM2 = 100.0  # a pole that only touches the border is complete to within a slice
LEAST_OVERLAP = 0.99
MOST_VOLUME_OFF = 0.05
OVERVIEW_MM = 1.5
# The code of an imported label map; other tissues follow.
KIDNEY = 1
# A CT of a body contains fat and much brighter tissue.
FAT_HU, LEAST_SPAN_HU = -60, 200


@dataclass(frozen=True)
class Patient:
    """One imported organ; meshes in LPS [mm], watertight, normals outward."""

    ct: sitk.Image  # int16 [HU], cropped around the organ, original voxels and direction
    labels: sitk.Image  # uint8 on the grid of `ct`: a tissue code each
    tissues: dict[int, str]  # of the codes: 1 = kidney, 2 = tumour, ...
    organ: trimesh.Trimesh  # tumours and cysts included
    parts: dict[str, trimesh.Trimesh]  # by tissue
    support: trimesh.Trimesh
    side: Side
    volumes_ml: dict[str, float]  # of the labels: "organ" with all its parts, and each part
    overview: sitk.Image  # int16 [HU], the CT's full width at the organ's level, coarse; only for check.png
    source: VoxelGrid  # of the whole CT, before it was cropped
    series: str = ""  # number of the CT's series
    notes: tuple[str, ...] = ()  # what was chosen, left out, resampled
    warnings: tuple[str, ...] = ()  # what looks wrong or was assumed
    colours: dict[str, Colour] = field(default_factory=dict)  # of organ and parts, where labels have one
    draft: bool = False  # made by region growing
    position: Position = "supine"  # in the CT, which gives gravity
    space: Space | None = None  # of the axes of files that do not name it, by the user
    corrections: sitk.Image | None = (
        None  # uint8: a code of TISSUES where a class image corrects the classification
    )

    @property
    def tumour(self) -> trimesh.Trimesh | None:
        return self.parts.get("tumour")

    @property
    def length_mm(self) -> float:
        """From pole to pole, without tumours and cysts."""
        lesions = [surface for tissue, surface in self.parts.items() if tissue in LESIONS]
        return kidney_axes(self.organ, lesions, {}).length_mm


def import_patient(
    ct: LazyVolume,
    labels: LabelMap,
    organ: Sequence[int] | None = None,
    side: Side | None = None,
    margin_mm: float = 60.0,
    support: str = "mould",
    assigned: Collection[str] = (),
    drawn: Sequence[LabelMap] = (),
    position: Position | None = None,
    progress: Progress = silent,
    classes: Sequence[LabelMap] = (),
) -> Patient:
    """Crop one organ from a CT and its label map, and make its surfaces and its support.

    ``ct`` is a scalar volume [HU], of which only the part around the organ is read, up to ``margin_mm`` from
    it. ``labels`` may be on any grid; surfaces are made on it, and it is resampled to the CT's by nearest
    neighbour. ``drawn`` are the label maps before they were merged, as some segments may be covered in
    ``labels``; none: they are ``labels``. ``classes`` are those of class images, which correct the tissues
    around the organ and of its parts.

    ``organ`` are the label values of the organ; None: those named as a kidney, or all that are nothing else.
    ``assigned`` are the tissues whose labels the user named: a note tells which of them this organ does not
    have. ``side`` selects one of two kidneys, or checks the only one; it is needed where neither the CT nor
    the labels' names show the side. ``support`` is what the organ rests on: a "mould" of its underside, a bed
    of the surrounding "labels", or a surface file. ``position`` is how the patient lay in the CT; None: as in
    its header, else supine. ``progress`` shows the progress of the surfaces.

    Raises PatientError, which names what was found, what was expected and what to do.
    """
    if not margin_mm >= 0:
        raise PatientError(f"the margin is {margin_mm} mm: expected 0 or more")
    own = organ_values(labels, organ)
    labels, warnings_of_slices = fill_missing_slices(labels, own)
    pieces = find_organs(labels, own)
    slab, level_hu = _level(ct, pieces, margin_mm)
    level = ct.grid.part(slab)
    heights = np.concatenate([piece.grid.corners()[:, 2] for piece in pieces])
    midline = midline_x(level, level_hu, heights.min(), heights.max())
    piece, actual_side = choose_organ(pieces, midline, side)
    _check_complete(ct.grid, piece)
    grid, hounsfield = _cropped(ct.grid, slab, level_hu, piece, margin_mm)
    on_ct = resample_nearest(piece.grid, piece.mask, grid)
    _check_place(ct.grid, grid, on_ct, hounsfield, piece)
    coded, tissues = _tissue_labels(labels, grid, on_ct)
    actual_position, position_notes = position_of(ct.patient_position, position)
    overview = _overview(level, level_hu)
    warnings = (
        *position_warnings(overview, actual_position),
        *orientation_warnings(overview, labels, midline, float(piece.grid.corners()[:, 2].mean())),
        *_misplaced(piece, grid, hounsfield, on_ct, coded),
    )
    masks = part_masks(labels, piece)
    part_notes = parts_elsewhere(labels, piece, pieces, masks, assigned)
    with part_surfaces_in_processes(masks) as parts_made:
        surface = organ_surface(piece)
        _check_surface(surface, piece)
        of_ct = grid, hounsfield, coded, tissues, surface
        corrections, correction_notes = corrections_of(*of_ct, classes) if classes else (None, [])
        dense, phase_note = dense_findings(*of_ct, corrections)
        warnings += (
            *dense,
            *warnings_of_slices,
            *island_warnings(labels, own, pieces, piece),
            *label_warnings(labels, piece, organ is not None, drawn or [labels]),
            *kidney_warnings(piece, labels, surface, actual_side, midline),
        )
        bed = _support(support, surface, labels, piece, actual_position)
        parts = parts_made(progress)
    volumes = {part: float(inside.sum() * part_grid.voxel_ml) for part, (part_grid, inside) in masks.items()}
    return Patient(
        ct=grid.image(hounsfield),
        labels=grid.image(coded),
        tissues=tissues,
        corrections=corrections,
        organ=surface,
        parts=parts,
        support=bed,
        side=actual_side,
        volumes_ml={"organ": piece.volume_ml, **{part: volumes[part] for part in parts}},
        overview=overview,
        source=ct.grid,
        series=ct.series,
        notes=(*ct.notes, *position_notes, *part_notes, phase_note, *correction_notes),
        warnings=warnings,
        colours=colours_of_labels(labels, [*parts]),
        position=actual_position,
    )


def _misplaced(
    piece: Organ, grid: VoxelGrid, hounsfield: np.ndarray, on_ct: np.ndarray, coded: np.ndarray
) -> tuple[str, ...]:
    """Warnings of labels that are not where the CT shows the organ; ``on_ct`` and ``coded`` are on its
    grid.
    """
    # Fat in the rim of a label that is shifted by a few millimetres has the same cause.
    return shift_warnings(grid, hounsfield, piece.grid, piece.mask) or fat_warnings(
        grid, hounsfield, on_ct, coded == KIDNEY, float(piece.grid.spacing.max())
    )


def _support(
    kind: str, organ: trimesh.Trimesh, labels: LabelMap, piece: Organ, position: Position
) -> trimesh.Trimesh:
    gravity = np.array(GRAVITY[position])
    if kind == "labels":
        own = [int(value) for value in np.unique(piece.values[piece.mask])]
        return bed_of_labels(organ, labels, [*own, *labels.of_tissues(*HILAR)], gravity)
    if kind != "mould":
        return bed_of_file(Path(kind), organ, gravity)
    try:
        return mould(organ, gravity)
    except ValueError as error:
        raise PatientError(f"no support fits under the organ: {error}; check the organ's label") from error


def _level(ct: LazyVolume, pieces: list[Organ], margin_mm: float) -> tuple[Box, np.ndarray]:
    """The box of a CT at the level of all organs, and its HU: enough to find the midline and to crop."""
    if max(_overlap(ct.grid, piece) for piece in pieces) == 0:
        raise PatientError(
            "the labels are outside the CT, with 0 % of the organ in it: expected both to overlap in patient "
            "coordinates; "
            "choose labels that were drawn on this CT"
        )
    places = np.concatenate([piece.grid.corners() for piece in pieces])
    low, high = ct.grid.bounds()
    low[2], high[2] = places[:, 2].min() - margin_mm, places[:, 2].max() + margin_mm
    box = ct.grid.box_around(low, high)
    hounsfield = ct.hounsfield(box)
    darkest, brightest = int(hounsfield.min()), int(hounsfield.max())
    if darkest > FAT_HU or brightest - darkest < LEAST_SPAN_HU:
        raise PatientError(
            f"the CT has values from {darkest} to {brightest}: expected HU, fat about -100 and air -1000; "
            "give the CT first, then the "
            "labels, and export it with its rescale and without normalising"
        )
    return box, hounsfield


def _overview(grid: VoxelGrid, hounsfield: np.ndarray) -> sitk.Image:
    step = np.maximum(1, np.rint(OVERVIEW_MM / grid.spacing)).astype(int)
    coarse = np.ascontiguousarray(hounsfield[:: step[2], :: step[1], :: step[0]])
    return replace(grid, size=coarse.shape[::-1], spacing=grid.spacing * step).image(coarse)


def _overlap(grid: VoxelGrid, piece: Organ) -> float:
    """Share of an organ's voxels within a grid."""
    indices = np.argwhere(piece.mask)[:, ::-1]
    return grid.share_inside(piece.grid.place(indices[:: max(1, len(indices) // 200_000)]))


def _check_complete(grid: VoxelGrid, piece: Organ) -> None:
    """Raises PatientError where an organ's volume is implausible, or some of it is outside the CT."""
    least, most = PLAUSIBLE_ORGAN_ML
    if not least <= piece.volume_ml <= most:
        raise PatientError(
            f"{piece.title} has {piece.volume_ml:.1f} ml: expected {least:g} to {most:g} ml; choose the "
            "organ's "
            "label values with --organ"
        )
    share = _overlap(grid, piece)
    if share < LEAST_OVERLAP:
        raise PatientError(
            f"{piece.title} has {share:.0%} of its voxels in the CT: expected all of the organ; choose a CT "
            "that shows all of "
            "it, or the labels that were drawn on this one"
        )


def _cropped(
    grid: VoxelGrid, slab: Box, hounsfield: np.ndarray, piece: Organ, margin_mm: float
) -> tuple[VoxelGrid, np.ndarray]:
    """The CT around the organ: its grid and its HU (z, y, x)."""
    indices = grid.index(piece.grid.corners())
    rim = margin_mm / grid.spacing
    low = np.floor(indices.min(axis=0) - rim).astype(int)
    high = np.ceil(indices.max(axis=0) + rim).astype(int) + 1
    box = tuple(
        slice(max(int(a), s.start), min(int(b), s.stop)) for a, b, s in zip(low, high, slab, strict=True)
    )
    inner = tuple(slice(b.start - s.start, b.stop - s.start) for b, s in zip(box, slab, strict=True))
    return grid.part(cast(Box, box)), np.ascontiguousarray(hounsfield[inner[::-1]])


def _check_place(
    full: VoxelGrid, grid: VoxelGrid, on_ct: np.ndarray, hounsfield: np.ndarray, piece: Organ
) -> None:
    """Raises PatientError where the organ is cut off by the CT's border or is not soft tissue."""
    first = np.rint(full.index(grid.origin)).astype(int)
    for axis in range(3):
        at_border = {0: first[axis] == 0, -1: first[axis] + grid.size[axis] == full.size[axis]}
        ends = [on_ct.take(end, axis=2 - axis).sum() for end, there in at_border.items() if there]
        cut = max(ends, default=0) * np.prod(grid.spacing) / grid.spacing[axis]
        if cut > CUT_AREA_MM2:
            raise PatientError(
                f"{piece.title} is cut off at the border of the CT over {cut / 100:.1f} cm2: expected a "
                "whole "
                "organ; choose a CT that shows all of it"
            )
    median = float(np.median(hounsfield[on_ct])) if on_ct.any() else 0.0
    if not PLAUSIBLE_ORGAN_HU[0] <= median <= PLAUSIBLE_ORGAN_HU[1]:
        raise PatientError(
            f"{piece.title} has a median of {median:.0f} HU: expected soft tissue; check that the labels "
            "belong to "
            "this CT and that the CT is in HU"
        )


def _check_surface(surface: trimesh.Trimesh, piece: Organ) -> None:
    """Raises PatientError where a surface leaves out a part of its label."""
    found_ml = surface.volume / 1000
    if found_ml < (1 - MOST_VOLUME_OFF) * piece.volume_ml:
        raise PatientError(
            f"{piece.title} has {piece.volume_ml:.1f} ml, and its surface encloses {found_ml:.1f}: expected "
            "all of it; parts of it "
            "are connected by thin bridges; correct the label, or name the organ's own with --organ"
        )


def _tissue_labels(labels: LabelMap, grid: VoxelGrid, on_ct: np.ndarray) -> tuple[np.ndarray, dict[int, str]]:
    """Tissue codes (z, y, x) of the cropped CT and their tissues: parts of this organ, and all of other
    tissues.

    1 = kidney, 2 = tumour, the rest by name from 3.
    """
    values = resample_nearest(labels.grid, labels.values, grid)
    there = set(present_values(values))
    tissue_of = {v: s.tissue for v, s in labels.segments.items() if v in there and s.tissue}
    others = sorted(set(tissue_of.values()) - {"kidney", "tumour"})
    codes = {tissue: code for code, tissue in enumerate(["kidney", "tumour", *others], start=KIDNEY)}
    coded = on_ct.astype(np.uint8)
    for value, tissue in tissue_of.items():
        if tissue != "kidney":
            here = values == value
            coded[here & on_ct if tissue in (*LESIONS, *PARENCHYMA) else here] = codes[tissue]
    return coded, {code: tissue for tissue, code in codes.items()}
