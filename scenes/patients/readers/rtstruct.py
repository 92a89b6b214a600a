"""Read the regions of a DICOM RTSTRUCT: their names, types and closed contours."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from pydicom.dataset import Dataset

from errors import PatientError, parsing
from scenes.patients.readers.contour_stack import DrawnRegion, stack_contours
from scenes.patients.readers.dicom_files import SourceFile
from scenes.patients.readers.label_headers import references_of
from scenes.patients.readers.label_maps import (
    NEAR_MM,
    LabelMap,
    Segment,
    Segmentation,
    is_left_out,
    listed,
    note_of_left_out,
)
from scenes.terminal import Progress, silent
from scenes.volumes.voxel_grid import VoxelGrid

MOST_POINTS = 20_000_000
# Values of ContourGeometricType that enclose an area, as they are and without underscores.
EXCLUSIVE = "CLOSEDPLANARXOR"
CLOSED = {"CLOSEDPLANAR", EXCLUSIVE, "INTERPOLATEDPLANAR"}
# Tissues of the organ and its lesions, of which no part may be lost.
ORGAN = {"kidney", "tumour", "cyst"}
# Values of RTROIInterpretedType that are no tissue.
NO_TISSUE = {"EXTERNAL", "SUPPORT", "FIXATION", "BOLUS"}


def read_structures(
    item: SourceFile, wanted: Collection[str] = (), progress: Progress = silent
) -> Segmentation:
    """The regions of a structure set, which are filled once the CT's grid is known.

    Outlines of the body, couches and structures far from the kidneys are left out, except where they are
    ``wanted``: names or numbers of regions of the user. ``progress`` shows the progress of the contours.
    Raises PatientError where the file is damaged, or has regions in several frames of reference.
    """
    data = item.parsed()
    with parsing(f"{item.name}: cannot be read as an RTSTRUCT", "export it again"):
        regions, left_out = [], []
        for segment, roi, kind in _regions(data):
            if is_left_out(segment, wanted, kind not in NO_TISSUE):
                left_out.append(segment)
            else:
                regions.append(_drawn(item.name, segment, roi, wanted))
    references = references_of(data)
    if len(references.frames) > 1:
        raise PatientError(
            f"{item.name}: its regions are in {len(references.frames)} frames of reference; expected one; "
            "export the regions of one CT"
        )
    empty = tuple(region.segment for region in regions if not region.contours)
    notes = (*note_of_left_out(left_out), *_note_of_empty(empty))

    def maps(ct: VoxelGrid) -> list[LabelMap]:
        filled = _filled_regions([region for region in regions if region.contours], ct, progress)
        if not filled:
            why = "".join(f" ({note})" for note in notes)
            raise PatientError(
                f"{item.name}: has no closed contour{why}; expected an organ's; choose another file"
            )
        return filled

    return Segmentation(
        maps,
        notes=notes,
        references=references,
        empty=empty,
    )


def _note_of_empty(segments: Sequence[Segment]) -> tuple[str, ...]:
    names = listed([str(segment) for segment in segments])
    return (f"without a closed contour, so not read: {names}",) * bool(segments)


def _regions(data: Dataset) -> list[tuple[Segment, Dataset, str]]:
    """Each region, its contours, and its RTROIInterpretedType."""
    names = {int(roi.ROINumber): str(roi.get("ROIName", "")) for roi in data.StructureSetROISequence}
    kinds = {
        int(one.get("ReferencedROINumber") or 0): str(one.get("RTROIInterpretedType") or "").upper()
        for one in data.get("RTROIObservationsSequence") or []
    }
    return [
        (Segment.named(names.get(number, ""), number, _colour(roi)), roi, kinds.get(number, ""))
        for roi in data.ROIContourSequence
        for number in [int(roi.ReferencedROINumber)]
    ]


def _filled_regions(regions: list[DrawnRegion], ct: VoxelGrid, progress: Progress) -> list[LabelMap]:
    """The regions that have contours; where there are kidneys, the others only near them."""
    kidneys = [
        points for region in regions if region.segment.tissue == "kidney" for points in region.contours
    ]
    near = None
    if kidneys:
        places = np.concatenate(kidneys)
        near = ct.box_around(places.min(axis=0) - NEAR_MM, places.max(axis=0) + NEAR_MM)
    maps = []
    for region in regions:
        segment = region.segment
        filled = stack_contours(region, ct, None if segment.tissue == "kidney" else near, progress)
        if filled and filled.inside.any():
            notes, warnings = (
                tuple(f"region {segment.value}: {line}" for line in lines)
                for lines in (filled.notes, filled.warnings)
            )
            one = LabelMap.single(filled.grid, filled.inside, segment)
            notes, warnings = (notes, warnings) if region.is_organ else ((*notes, *warnings), ())
            maps.append(replace(one, notes=notes, warnings=warnings))
    return maps


def _colour(roi: Dataset) -> tuple[float, float, float] | None:
    rgb = roi.get("ROIDisplayColor")
    if rgb is None or len(rgb) != 3:
        return None
    red, green, blue = (min(255, max(0, int(c))) / 255 for c in rgb)
    return red, green, blue


def _drawn(file: str, segment: Segment, roi: Dataset, wanted: Collection[str]) -> DrawnRegion:
    """A region's closed contours. Raises ValueError where they are damaged."""
    closed = [
        (kind, one) for one in roi.get("ContourSequence") or [] for kind in [_kind(one)] if kind in CLOSED
    ]
    points = [_points(one) for _, one in closed]
    if sum(map(len, points)) > MOST_POINTS or not all(np.isfinite(p).all() for p in points):
        raise ValueError
    is_organ = segment.tissue in ORGAN or any(segment.matches(word) for word in wanted)
    is_exclusive = any(kind == EXCLUSIVE for kind, _ in closed)
    return DrawnRegion(file, segment, [p for p in points if len(p) >= 3], is_organ, is_exclusive)


def _kind(contour: Dataset) -> str:
    """The type of a contour, without underscores."""
    return str(contour.get("ContourGeometricType") or "").strip().upper().replace("_", "")


def _points(contour: Dataset) -> np.ndarray:
    """Points (n, 3) of a contour; pydicom converts each number to an object, which takes ten times as
    long.
    """
    value = contour.get_item("ContourData").value
    return np.array(value.split(b"\\") if isinstance(value, bytes) else value, float).reshape(-1, 3)
