"""Read the contours of a DICOM RTSTRUCT and fill them on their planes."""

from collections.abc import Collection

import numpy as np
from pydicom.dataset import Dataset
from skimage.draw import polygon

from errors import PatientError, parsing
from scenes.patients.readers.dicom_files import SourceFile
from scenes.patients.readers.label_headers import references_of
from scenes.patients.readers.label_maps import (
    NEAR_MM,
    LabelMap,
    Segment,
    Segmentation,
    is_left_out,
    note_of_left_out,
)
from scenes.terminal import Progress, silent
from scenes.volumes.voxel_grid import Box, VoxelGrid

# Largest deviation of a contour from the even planes, as a share of their distance.
OFF_PLANE = 0.3
MOST_POINTS = 20_000_000
STRIP_ROWS = 16
# Values of RTROIInterpretedType that are no tissue.
NO_TISSUE = {"EXTERNAL", "SUPPORT", "FIXATION", "BOLUS"}


def read_structures(
    item: SourceFile, wanted: Collection[str] = (), progress: Progress = silent
) -> Segmentation:
    """The regions of a structure set, which are filled once the CT's grid is known.

    Outlines of the body, couches and structures far from the kidneys are left out, except where they are wanted.

    Args:
        item: the file.
        wanted: names or numbers of regions of the user.
        progress: shows the progress of the contours.

    Raises:
        PatientError: damaged, or regions in several frames of reference.
    """
    data = item.parsed()
    with parsing(f"{item.name}: cannot be read as an RTSTRUCT", "export it again"):
        contours: list[tuple[Segment, list[np.ndarray]]] = []
        left_out = []
        for segment, roi, kind in _regions(data):
            if is_left_out(segment, wanted, kind not in NO_TISSUE):
                left_out.append(segment)
            else:
                contours.append((segment, _contours(roi)))
    references = references_of(data)
    if len(references.frames) > 1:
        raise PatientError(
            f"{item.name}: its regions are in {len(references.frames)} frames of reference; expected one; export the regions of one CT"
        )
    notes = note_of_left_out(left_out)

    def maps(ct: VoxelGrid) -> list[LabelMap]:
        drawn = [(segment, points) for segment, points in contours if points]
        filled = _filled_regions(item.name, drawn, ct, progress)
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
        empty=tuple(segment for segment, points in contours if not points),
    )


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


def _filled_regions(
    name: str, regions: list[tuple[Segment, list[np.ndarray]]], ct: VoxelGrid, progress: Progress
) -> list[LabelMap]:
    """The regions that have contours; where there are kidneys, the others only near them."""
    kidneys = [points for segment, contours in regions if segment.tissue == "kidney" for points in contours]
    near = None
    if kidneys:
        places = np.concatenate(kidneys)
        near = ct.box_around(places.min(axis=0) - NEAR_MM, places.max(axis=0) + NEAR_MM)
    found = []
    for segment, contours in regions:
        box = None if segment.tissue == "kidney" else near
        filled = _filled(name, contours, ct, box, progress)
        if filled and filled[1].any():
            found.append(LabelMap.single(*filled, segment))
    return found


def _colour(roi: Dataset) -> tuple[float, float, float] | None:
    given = roi.get("ROIDisplayColor")
    if given is None or len(given) != 3:
        return None
    red, green, blue = (min(255, max(0, int(c))) / 255 for c in given)
    return red, green, blue


def _contours(roi: Dataset) -> list[np.ndarray]:
    """Points (n, 3) of each closed contour, LPS [mm]."""
    closed = [
        c
        for c in roi.get("ContourSequence") or []
        if c.get("ContourGeometricType") in ("CLOSED_PLANAR", "CLOSEDPLANAR_XOR")
    ]
    points = [_points(c) for c in closed]
    if sum(map(len, points)) > MOST_POINTS or not all(np.isfinite(p).all() for p in points):
        raise ValueError
    return [p for p in points if len(p) >= 3]


def _points(contour: Dataset) -> np.ndarray:
    """Points (n, 3) of a contour; pydicom converts each number to an object, which takes ten times as long."""
    value = contour.get_item("ContourData").value
    return np.array(value.split(b"\\") if isinstance(value, bytes) else value, float).reshape(-1, 3)


def _filled(
    name: str, contours: list[np.ndarray], ct: VoxelGrid, near: Box | None, progress: Progress
) -> tuple[VoxelGrid, np.ndarray] | None:
    """Grid and mask (z, y, x) of a region: a CT's pixels on the planes of its contours; None where none is near.

    Nested contours on one plane alternate between inside and outside.

    Args:
        name: of the file, for errors.
        contours: points (n, 3) of each, LPS [mm].
        ct: the CT's voxels.
        near: the box of voxels outside which nothing is filled; None: all is filled.
        progress: shows the progress of the contours.

    Raises:
        PatientError: far outside the CT, or not parallel to its slices.
    """
    places = [ct.index(points) for points in contours]
    ends = np.array(ct.size)
    if any((place < -ends).any() or (place > 2 * ends).any() for place in places):
        raise PatientError(
            f"{name}: contours are far outside this CT; expected contours on it; give the CT that they were drawn on"
        )
    if max(np.ptp(place[:, 2]) for place in places) > 1:
        raise PatientError(
            f"{name}: contours cross the slices of this CT; expected contours on them; give the CT that they were drawn on"
        )
    least, most = (-ends, 2 * ends) if near is None else np.array([(a.start, a.stop - 1) for a in near]).T
    places = [p for p in places if (p.max(axis=0) >= least).all() and (p.min(axis=0) <= most).all()]
    if not places:
        return None
    heights = np.array([place[:, 2].mean() for place in places])
    step, numbers = _planes(name, heights)
    low = np.floor(np.min([p[:, :2].min(axis=0) for p in places], axis=0)).astype(int) - 1
    high = np.ceil(np.max([p[:, :2].max(axis=0) for p in places], axis=0)).astype(int) + 1
    low, high = np.maximum(low, least[:2]), np.minimum(high, most[:2])
    size = (*(high - low + 1).tolist(), max(2, int(numbers.max()) + 1))
    origin = ct.place(np.array([low[0], low[1], heights.min()]))
    grid = VoxelGrid(size, ct.spacing * (1, 1, step), origin, ct.direction).checked(name)
    inside = np.zeros(size[::-1], bool)
    for place, number in progress(list(zip(places, numbers, strict=True)), "contours"):
        _toggle(inside[number], place[:, 1::-1] - low[::-1])
    return grid, inside


def _toggle(plane: np.ndarray, corners: np.ndarray) -> None:
    """Invert the pixels (rows, columns) in and on a polygon with corners (n, 2).

    Strip by strip, as each pixel is compared with each corner: of those above a strip, or below it, only the first and last of a
    row of them count.
    """
    for start in range(0, len(plane), STRIP_ROWS):
        strip = plane[start : start + STRIP_ROWS]
        side = (corners[:, 0] > start + len(strip)) - 1 * (corners[:, 0] < start - 1)
        between = (side != 0) & (side == np.roll(side, 1)) & (side == np.roll(side, -1))
        part = corners[~between]
        if len(part):
            strip[polygon(part[:, 0] - start, part[:, 1], strip.shape)] ^= True


def _planes(name: str, heights: np.ndarray) -> tuple[float, np.ndarray]:
    """The distance of even planes [slices], and the plane of each contour, from 0. Raises PatientError where they are uneven."""
    gaps = np.diff(np.unique(np.round(heights, 2)))
    step = float(gaps[gaps > OFF_PLANE].min()) if (gaps > OFF_PLANE).any() else 1.0
    numbers = (heights - heights.min()) / step
    if np.abs(numbers - np.rint(numbers)).max() > OFF_PLANE:
        raise PatientError(
            f"{name}: contours are unevenly spaced; expected one distance between planes; export it as a label map"
        )
    return step, np.rint(numbers).astype(int)
