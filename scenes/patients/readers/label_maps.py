"""Label maps: the voxels of one source, and the segment of each value."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import SimpleITK as sitk
from scipy import ndimage

from errors import PatientError
from scenes.patient_space import Space
from scenes.patients.readers.segment_codes import CodedMeaning
from scenes.patients.readers.segment_names import (
    Side,
    is_needless,
    is_understood,
    quoted,
    same_name,
    side_of,
    tissue_of,
)
from scenes.volumes.dicom_references import NO_REFERENCES, DicomReferences
from scenes.volumes.voxel_grid import Box, VoxelGrid

# Part of the organ, also where they protrude.
LESIONS = ("tumour", "cyst", "necrosis")
# Of other structures only what is this near to a kidney is read; an import keeps 60 mm around its organ.
NEAR_MM = 80.0

Colour = tuple[float, float, float]  # red, green, blue, 0 to 1


@dataclass(frozen=True)
class Segment:
    """One labelled structure."""

    name: str
    value: int | None  # in its file, if it has one
    tissue: str | None  # by its name, its codes or the user; None: unknown, left to HU
    side: Side | None  # by its name or its codes
    colour: Colour | None = None  # in its file
    meaning: str = ""  # of its codes, where the name is not understood

    @classmethod
    def named(cls, name: str, value: int | None = None, colour: Colour | None = None) -> Segment:
        """A segment with tissue and side by its name."""
        return cls(name, value, tissue_of(name), side_of(name), colour)

    @classmethod
    def coded(
        cls, file: str, name: str, codes: CodedMeaning, value: int | None = None, colour: Colour | None = None
    ) -> Segment:
        """A segment with tissue and side by its name, or by its codes where the name is not understood.

        Raises PatientError, which names the file, where the sides of name and codes differ.
        """
        named = cls.named(name, value, colour)
        by_name = is_understood(name)
        sides = {named.side} - {None} if by_name or not codes.sides else set()
        sides |= codes.sides
        if len(sides) > 1:
            raise PatientError(
                f"{file}: segment {named} has the codes {codes}, which are of another side than its name or "
                "than each other; "
                "expected one side; correct the segment's name or terminology, for example in 3D Slicer"
            )
        side = next(iter(sides), None)
        if by_name:
            return replace(named, side=side)
        meaning = str(codes) if is_understood(str(codes)) else ""
        return replace(named, tissue=codes.tissue, side=side, meaning=meaning)

    @property
    def is_understood(self) -> bool:
        """Whether its name or its codes are of a known structure, modelled or not."""
        return is_understood(self.name) or bool(self.meaning)

    def matches(self, word: str) -> bool:
        """Whether a user's word is its name or its value."""
        return same_name(word, self.name) or (self.value is not None and word == str(self.value))

    def __str__(self) -> str:
        name, meaning = (quoted(words) if words else "" for words in (self.name, self.meaning))
        parts = (self.value, name, f"({meaning})" if meaning else "")
        return " ".join(str(part) for part in parts if part not in (None, ""))


@dataclass(frozen=True)
class LabelMap:
    """Voxels with one label value each, in patient coordinates."""

    grid: VoxelGrid
    values: np.ndarray  # uint8 or uint16 (z, y, x), 0 = background
    segments: dict[int, Segment]  # of each value that occurs
    notes: tuple[str, ...] = ()  # what was mended when it was made
    warnings: tuple[str, ...] = ()  # what was missing, and is assumed

    @classmethod
    def of(cls, image: sitk.Image, names: Mapping[int, str] | None = None) -> LabelMap:
        """The label map of an image. Raises PatientError where it has no labels."""
        voxels = sitk.GetArrayViewFromImage(image)
        return cls.valued(VoxelGrid.of(image), whole_numbers(voxels, "the label map"), names)

    @classmethod
    def valued(cls, grid: VoxelGrid, values: np.ndarray, names: Mapping[int, str] | None = None) -> LabelMap:
        """A label map of voxel values, with names where they are known."""
        segments = {v: Segment.named((names or {}).get(v, ""), v) for v in present_values(values)}
        return cls(grid, values, segments)

    @classmethod
    def single(cls, grid: VoxelGrid, inside: np.ndarray, segment: Segment) -> LabelMap:
        """The map of one segment that is not empty, cropped to it."""
        box = box_of(inside)
        return cls(grid.part(box), inside[box[::-1]].astype(np.uint8), {1: segment})

    def of_tissues(self, *tissues: str | None) -> list[int]:
        """Values of the segments of the given tissues."""
        return [value for value, segment in self.segments.items() if segment.tissue in tissues]

    def values_of(self, words: Sequence[str]) -> list[int]:
        """Values of the segments with the given names or values."""
        return [
            value for value, segment in self.segments.items() if any(segment.matches(word) for word in words)
        ]

    def listed(self) -> str:
        """All segments, for errors."""
        return listed([str(segment) for segment in self.segments.values()])


@dataclass(frozen=True)
class Segmentation:
    """Labels of one source; contours are filled once the CT's grid is known."""

    maps: Callable[[VoxelGrid], list[LabelMap]]  # on the CT's grid
    notes: tuple[str, ...] = ()
    references: DicomReferences = NO_REFERENCES  # the DICOM objects that they refer to
    grid: VoxelGrid | None = None  # of label maps: all voxels of the first
    empty: tuple[Segment, ...] = ()  # segments that no voxel has
    space: Space | None = None  # of the axes, by the user, where a file names none
    is_class_image: bool = False  # of the tissue of every voxel, as an export writes it


def is_left_out(segment: Segment, wanted: Collection[str], is_tissue: bool = True) -> bool:
    """Whether a segment is not read: it is no tissue, far from the kidneys or the body's outline, and no
    ``wanted`` name or value.
    """
    needless = not is_tissue or is_needless(segment.name)
    return needless and not any(segment.matches(word) for word in wanted)


def note_of_left_out(segments: Sequence[Segment]) -> tuple[str, ...]:
    """A note that names segments that are not read."""
    names = listed([str(segment) for segment in segments])
    return (f"not read, as they are far from the kidneys or no organ: {names}",) * bool(segments)


def listed(names: Sequence[str]) -> str:
    """At most twelve names, for errors."""
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def whole_numbers(voxels: np.ndarray, name: str) -> np.ndarray:
    """Label values as the smallest unsigned integers. Raises PatientError."""
    low, high = voxels.min(), voxels.max()
    if low < 0 or high > 65535 or (voxels.dtype.kind == "f" and (voxels != np.rint(voxels)).any()):
        raise PatientError(
            f"{name}: has values from {low:g} to {high:g}; expected whole numbers from 0 up; check that CT "
            "and "
            "labels are not exchanged and that the map is not a probability"
        )
    if high == 0:
        raise PatientError(f"{name}: is empty, every voxel is 0; expected an organ; choose another file")
    return voxels.astype(np.uint8 if high < 256 else np.uint16)


def present_values(values: np.ndarray) -> list[int]:
    """The non-zero values that occur; plane by plane, as np.unique takes eight times the memory."""
    there = np.zeros(1 + np.iinfo(values.dtype).max, bool)
    for plane in values:
        there[plane.ravel()] = True
    return [int(v) for v in np.flatnonzero(there) if v]


def among(voxels: np.ndarray, wanted: Sequence[int]) -> np.ndarray:
    """Whether each voxel has one of the wanted values; plane by plane, as np.isin takes three times the
    memory.
    """
    mask = np.empty(voxels.shape, bool)
    for plane, inside in zip(voxels, mask, strict=True):
        inside[:] = np.isin(plane, wanted)
    return mask


def box_of(inside: np.ndarray) -> Box:
    """The box (x, y, z) around non-zero voxels (z, y, x), of which there is one or more."""
    z, y, x = ndimage.find_objects(np.asarray(inside, bool).view(np.uint8))[0]
    return x, y, z


def resample_nearest(grid: VoxelGrid, voxels: np.ndarray, onto: VoxelGrid) -> np.ndarray:
    """Voxels (z, y, x) of one grid on another, by nearest neighbour; 0 outside the first grid."""
    if grid.same_as(onto):
        return voxels
    image = grid.image(voxels.astype(np.uint8) if voxels.dtype == bool else voxels)
    return onto.sampled(image, sitk.sitkNearestNeighbor, 0).astype(voxels.dtype)
