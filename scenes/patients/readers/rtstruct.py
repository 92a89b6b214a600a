"""Read the contours of a DICOM RTSTRUCT and fill them on their planes."""

import numpy as np
from pydicom.dataset import Dataset
from skimage.draw import polygon

from errors import PatientError, parsing
from scenes.patients.readers.dicom_files import SourceFile
from scenes.patients.readers.identifiers import identifiers_of
from scenes.patients.readers.label_headers import references_of
from scenes.patients.readers.label_maps import LabelMap, Segment, Segmentation
from scenes.volumes.voxel_grid import VoxelGrid

# Largest deviation of a contour from the even planes, as a share of their distance.
OFF_PLANE = 0.3
MOST_POINTS = 20_000_000


def read_structures(item: SourceFile) -> Segmentation:
    """The regions of a structure set, which are filled once the CT's grid is known. Raises PatientError where it is damaged."""
    data = item.parsed()
    with parsing(f"{item.name}: cannot be read as an RTSTRUCT", "export it again"):
        names = {int(roi.ROINumber): str(roi.get("ROIName", "")) for roi in data.StructureSetROISequence}
        regions = [
            (Segment.named(names.get(number, ""), number, _colour(roi)), _contours(roi))
            for roi in data.ROIContourSequence
            for number in [int(roi.ReferencedROINumber)]
        ]

    def maps(ct: VoxelGrid) -> list[LabelMap]:
        filled = [(*_filled(item.name, contours, ct), segment) for segment, contours in regions if contours]
        found = [LabelMap.single(*region) for region in filled if region[1].any()]
        if not found:
            raise PatientError(
                f"{item.name}: has no closed contour; expected an organ's; choose another file"
            )
        return found

    return Segmentation(maps, identifiers=identifiers_of(item), references=references_of(data))


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
    points = [np.array(c.ContourData, float).reshape(-1, 3) for c in closed]
    if sum(map(len, points)) > MOST_POINTS or not all(np.isfinite(p).all() for p in points):
        raise ValueError
    return [p for p in points if len(p) >= 3]


def _filled(name: str, contours: list[np.ndarray], ct: VoxelGrid) -> tuple[VoxelGrid, np.ndarray]:
    """Grid and mask (z, y, x) of a region: a CT's pixels on the planes of its contours.

    Nested contours on one plane alternate between inside and outside. Raises PatientError: not parallel to the CT's slices.
    """
    places = [ct.index(points) for points in contours]
    ends = np.array(ct.size)
    if any((place < -ends).any() or (place > 2 * ends).any() for place in places):
        raise PatientError(
            f"{name}: contours are far outside this CT; expected contours on it; give the CT that they were drawn on"
        )
    heights = np.array([place[:, 2].mean() for place in places])
    if max(np.ptp(place[:, 2]) for place in places) > 1:
        raise PatientError(
            f"{name}: contours cross the slices of this CT; expected contours on them; give the CT that they were drawn on"
        )
    planes = np.unique(np.round(heights, 2))
    gaps = np.diff(planes)
    step = float(gaps[gaps > OFF_PLANE].min()) if (gaps > OFF_PLANE).any() else 1.0
    numbers = (heights - heights.min()) / step
    if np.abs(numbers - np.rint(numbers)).max() > OFF_PLANE:
        raise PatientError(
            f"{name}: contours are unevenly spaced; expected one distance between planes; export it as a label map"
        )
    low = np.floor(np.min([p[:, :2].min(axis=0) for p in places], axis=0)).astype(int) - 1
    high = np.ceil(np.max([p[:, :2].max(axis=0) for p in places], axis=0)).astype(int) + 1
    size = (*(high - low + 1).tolist(), max(2, int(np.rint(numbers).max()) + 1))
    spacing = ct.spacing * (1, 1, step)
    origin = ct.place(np.array([low[0], low[1], heights.min()]))
    grid = VoxelGrid(size, spacing, origin, ct.direction).checked(name)
    inside = np.zeros(size[::-1], bool)
    for place, number in zip(places, np.rint(numbers).astype(int), strict=True):
        rows, columns = polygon(place[:, 1] - low[1], place[:, 0] - low[0], inside.shape[1:])
        inside[number, rows, columns] ^= True
    return grid, inside
