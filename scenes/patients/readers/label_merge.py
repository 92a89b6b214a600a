"""Merge label maps that may overlap into one: small structures cover their surroundings, and what the user
named is whole.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from scenes.patients.readers.label_maps import LESIONS, LabelMap, Segment, present_values, resample_nearest
from scenes.volumes.voxel_grid import Box, VoxelGrid

# Of overlapping segments, later tissues cover earlier ones: small structures cover their surroundings.
MERGE_ORDER = (
    None, "soft-tissue", "fat", "fascia", "muscle", "perimysium", "bone", "liver", "spleen", "bowel",
    "gas", "fluid", "kidney", "cortex", "medulla", "arcuate", "sinus", "vessel", "vein", "artery",
    "urine", "cyst", "tumour", "pseudocapsule", "necrosis", "stone", "metal",
)  # fmt: skip


def merge_label_maps(maps: list[LabelMap], organ: Sequence[str] = ()) -> tuple[LabelMap, list[int] | None]:
    """One map of one or more, which may overlap and have different grids, on the grid of the first with a
    kidney, extended to cover all; and the values of the named organ, None where none is named.

    ``organ`` has names or values of the segments that the user named as the organ: they are the organ alone,
    whatever covers them.
    """
    if len(maps) == 1:
        return maps[0], maps[0].values_of(organ) if organ else None
    main = next((one for one in maps if _is_main(one, organ)), maps[0])
    grid = _extended(main.grid, maps)
    pieces = [(one, value, segment) for one in maps for value, segment in one.segments.items()]
    pieces.sort(key=lambda piece: (MERGE_ORDER.index(piece[2].tissue), _is_named(piece[2], organ)))
    values = np.zeros(grid.size[::-1], np.uint8 if 2 * len(pieces) < 256 else np.uint16)
    named = np.zeros(values.shape if organ else (0, 0, 0), bool)
    segments = {}
    for code, (one, value, segment) in enumerate(pieces, start=1):
        inside, box = _onto(grid, one.grid, one.values == value)
        values[box[::-1]][inside] = code
        segments[code] = segment
        if _is_named(segment, organ):
            named[box[::-1]] |= inside
    own = _own_values(values, segments, named, organ) if organ else None
    left = set(present_values(values))
    merged = LabelMap(grid, values, {n: segment for n, segment in segments.items() if n in left})
    return merged, own if own is None else [value for value in own if value in left]


def _is_named(segment: Segment, organ: Sequence[str]) -> bool:
    """Whether the user gave a segment as the organ; a tumour or cyst that is given as both is a part of
    it.
    """
    return segment.tissue not in LESIONS and any(segment.matches(word) for word in organ)


def _is_main(one: LabelMap, organ: Sequence[str]) -> bool:
    segments = one.segments.values()
    return any(_is_named(s, organ) if organ else s.tissue == "kidney" for s in segments)


def _own_values(
    values: np.ndarray, segments: dict[int, Segment], named: np.ndarray, organ: Sequence[str]
) -> list[int]:
    """The values of the named organ (z, y, x); what covers a part of it, but for lesions, gets a value of
    its own there.
    """
    own = [code for code, segment in segments.items() if any(segment.matches(word) for word in organ)]
    covered = {
        code
        for code in present_values(values * named)
        if code not in own and segments[code].tissue not in LESIONS
    }
    for code in sorted(covered):
        within = max(segments) + 1
        values[named & (values == code)] = within
        segments[within] = segments[code]
        own.append(within)
    return own


def _extended(grid: VoxelGrid, maps: Iterable[LabelMap]) -> VoxelGrid:
    """A grid extended to cover all maps."""
    places = np.concatenate([grid.index(one.grid.corners()) for one in maps])
    low = np.floor(places.min(axis=0) + 1e-3).astype(int)
    high = np.ceil(places.max(axis=0) - 1e-3).astype(int)
    extended = replace(grid, size=tuple((high - low + 1).tolist()), origin=grid.place(low))
    return extended.checked("the labels")


def _onto(grid: VoxelGrid, own: VoxelGrid, inside: np.ndarray) -> tuple[np.ndarray, Box]:
    """A mask on a grid that covers its own, by nearest neighbour, and its box there."""
    start = np.rint(grid.index(own.origin)).astype(int)
    x, y, z = (slice(int(a), int(a) + n) for a, n in zip(start, own.size, strict=True))
    if grid.part((x, y, z)).same_as(own):
        return inside, (x, y, z)
    reach = 0.5 * np.abs(own.direction) @ own.spacing
    low, high = own.bounds()
    box = grid.box_around(low - reach, high + reach)
    return resample_nearest(own, inside, grid.part(box)), box
