"""Label maps: what each value is, the user's word on it, and several maps made into one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import SimpleITK as sitk

from errors import PatientError
from scenes.patients.readers.segment_names import Side, side_of, tissue_of
from scenes.volumes.voxel_grid import Box, VoxelGrid

# Painted in this order, so that what is small and matters is not lost under what surrounds it.
PAINTED = (None, "fat", "muscle", "bone", "liver", "kidney", "cortex", "medulla", "sinus", "vessel", "urine", "cyst", "tumour", "necrosis", "stone")  # fmt: skip


Colour = tuple[float, float, float]  # red, green, blue, 0 to 1


@dataclass(frozen=True)
class Segment:
    """One thing that is labelled."""

    name: str
    value: int | None  # in its file, where values tell things apart
    tissue: str | None  # by its name, or the user's word; None: HU tell
    side: Side | None  # by its name
    colour: Colour | None = None  # where the file gives one

    @classmethod
    def named(cls, name: str, value: int | None = None, colour: Colour | None = None) -> Segment:
        """A segment whose name says what it is."""
        return cls(name, value, tissue_of(name), side_of(name), colour)

    def called(self, word: str) -> bool:
        """Whether a user's word, a name or a number, is this segment."""
        return word.casefold() == self.name.casefold() or (self.value is not None and word == str(self.value))

    def __str__(self) -> str:
        return " ".join(str(part) for part in (self.value, self.name) if part not in (None, ""))


@dataclass(frozen=True)
class LabelMap:
    """Voxels of one value each, in the patient."""

    grid: VoxelGrid
    values: np.ndarray  # uint8 or uint16 (z, y, x), 0 = nothing
    segments: dict[int, Segment]  # of each value that occurs

    @classmethod
    def of(cls, image: sitk.Image, names: Mapping[int, str] | None = None) -> LabelMap:
        """An image's label map. Raises PatientError where it holds no labels."""
        voxels = sitk.GetArrayViewFromImage(image)
        return cls.valued(VoxelGrid.of(image), whole_numbers(voxels, "the label map"), names)

    @classmethod
    def valued(cls, grid: VoxelGrid, values: np.ndarray, names: Mapping[int, str] | None = None) -> LabelMap:
        """A label map whose values have names, or none."""
        found = {v: Segment.named((names or {}).get(v, ""), v) for v in present_values(values)}
        return cls(grid, values, found)

    @classmethod
    def single(cls, grid: VoxelGrid, inside: np.ndarray, segment: Segment) -> LabelMap | None:
        """The map of one segment, cropped to it; None where it is empty."""
        box = box_of(inside)
        if box is None:
            return None
        return cls(grid.part(box), inside[box[::-1]].astype(np.uint8), {1: segment})

    def of_tissues(self, *tissues: str | None) -> list[int]:
        """Values of the segments of some tissues."""
        return [value for value, segment in self.segments.items() if segment.tissue in tissues]

    def called(self, words: Sequence[str]) -> list[int]:
        """Values of the segments that words, names or numbers, call."""
        return [
            value for value, segment in self.segments.items() if any(segment.called(word) for word in words)
        ]

    def listed(self) -> str:
        """What there is, for errors."""
        return listed([str(segment) for segment in self.segments.values()])


def listed(names: Sequence[str]) -> str:
    """Names for an error, not too many."""
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def whole_numbers(voxels: np.ndarray, name: str) -> np.ndarray:
    """Label values as the smallest unsigned integers. Raises PatientError."""
    low, high = voxels.min(), voxels.max()
    if low < 0 or high > 65535 or (voxels.dtype.kind == "f" and (voxels != np.rint(voxels)).any()):
        raise PatientError(
            f"{name}: holds values from {low:g} to {high:g}; expected whole numbers from 0 up; check that CT and "
            "labels are not swapped and that the map is no probability"
        )
    if high == 0:
        raise PatientError(f"{name}: is empty, every voxel is 0; expected an organ; choose another file")
    return voxels.astype(np.uint8 if high < 256 else np.uint16)


def assign_tissues(
    maps: list[LabelMap], organ: Sequence[str], chosen: Mapping[str, Sequence[str]]
) -> list[LabelMap]:
    """The maps with the user's word on what segments are, by names or values.

    Args:
        maps: what is labelled.
        organ: what together is the organ; what of it says no tissue is kidney.
        chosen: tissue -> what is of it, which is all that is.

    Raises:
        PatientError: a word that nothing is called, or one segment given twice.
    """
    segments = [segment for one in maps for segment in one.segments.values()]
    said = {"organ": organ, **chosen}
    for option, words in said.items():
        for word in words:
            if not any(segment.called(word) for segment in segments):
                raise PatientError(
                    f"the {option}'s label {word} is not in the label map: it holds {listed([str(s) for s in segments])}; "
                    "give one of these"
                )

    def told(segment: Segment) -> Segment:
        found = [option for option, words in said.items() if any(segment.called(word) for word in words)]
        if len(found) > 1:
            raise PatientError(
                f"label {segment} is given as {' and as '.join(found)}: give it as one of them"
            )
        if found and found[0] != "organ":
            return replace(segment, tissue=found[0])
        if segment.tissue in chosen:
            segment = replace(segment, tissue=None)
        return replace(segment, tissue=segment.tissue or "kidney") if found else segment

    return [replace(one, segments={v: told(s) for v, s in one.segments.items()}) for one in maps]


def merge_label_maps(maps: list[LabelMap]) -> LabelMap:
    """One map of several that may overlap and lie on different grids: on that of the first with a kidney, widened to hold all."""
    if len(maps) == 1:
        return maps[0]
    main = next((one for one in maps if one.of_tissues("kidney")), maps[0])
    grid = _widened(main.grid, maps)
    pieces = [(one, value, segment) for one in maps for value, segment in one.segments.items()]
    pieces.sort(key=lambda piece: PAINTED.index(piece[2].tissue))
    values = np.zeros(grid.size[::-1], np.uint8 if len(pieces) < 256 else np.uint16)
    for code, (one, value, _) in enumerate(pieces, start=1):
        inside, box = _onto(grid, one.grid, one.values == value)
        values[box[::-1]][inside] = code
    left = set(present_values(values))
    return LabelMap(grid, values, {n: piece[2] for n, piece in enumerate(pieces, start=1) if n in left})


def present_values(values: np.ndarray) -> list[int]:
    """The values but 0 that occur, a plane at a time: counting widens them eightfold."""
    there = np.zeros(1 + np.iinfo(values.dtype).max, bool)
    for plane in values:
        there[plane.ravel()] = True
    return [int(v) for v in np.flatnonzero(there) if v]


def box_of(inside: np.ndarray) -> Box | None:
    """The box (x, y, z) around what is not zero in voxels (z, y, x)."""
    spans = []
    for axis in range(3):
        others = tuple(a for a in range(3) if a != axis)
        there = np.flatnonzero(inside.any(axis=others))
        if not len(there):
            return None
        spans.append(slice(int(there[0]), int(there[-1]) + 1))
    z, y, x = spans
    return x, y, z


def resample_nearest(grid: VoxelGrid, voxels: np.ndarray, onto: VoxelGrid) -> np.ndarray:
    """Voxels (z, y, x) of one grid on another, by nearest neighbour; 0 beyond the first grid."""
    if grid.same_as(onto):
        return voxels
    image = grid.image(voxels.astype(np.uint8) if voxels.dtype == bool else voxels)
    return onto.sampled(image, sitk.sitkNearestNeighbor, 0).astype(voxels.dtype)


def _widened(grid: VoxelGrid, maps: Iterable[LabelMap]) -> VoxelGrid:
    """A grid, continued so that it covers all maps."""
    places = np.concatenate([grid.index(one.grid.corners()) for one in maps])
    low = np.floor(places.min(axis=0) + 1e-3).astype(int)
    high = np.ceil(places.max(axis=0) - 1e-3).astype(int)
    wide = replace(grid, size=tuple((high - low + 1).tolist()), origin=grid.place(low))
    return wide.checked("the labels")


def _onto(grid: VoxelGrid, own: VoxelGrid, inside: np.ndarray) -> tuple[np.ndarray, Box]:
    """Voxels on a grid that covers theirs, by nearest neighbour, and the box of it that they fill."""
    start = np.rint(grid.index(own.origin)).astype(int)
    x, y, z = (slice(int(a), int(a) + n) for a, n in zip(start, own.size, strict=True))
    if grid.part((x, y, z)).same_as(own):
        return inside, (x, y, z)
    reach = 0.5 * np.abs(own.direction) @ own.spacing
    low, high = own.bounds()
    box = grid.box_around(low - reach, high + reach)
    return resample_nearest(own, inside, grid.part(box)), box
