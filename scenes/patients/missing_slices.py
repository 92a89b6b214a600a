"""Slices of a label that nobody segmented: found between their neighbours and filled by shape-based
interpolation (Raya and Udupa 1990).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from scipy import ndimage

from scenes.patients.readers.label_maps import LESIONS, LabelMap, among, box_of, listed

# So many neighbouring slices are filled, if they are no thicker than this together; of a tumour or cyst,
# where the kidney is labelled in them, fewer: two tumours may be two slices apart.
MOST_SLICES, MOST_LESION_SLICES, MOST_MM = 6, 1, 20.0
# A section that both neighbours have is missing where this share of it has no label.
LEAST_MISSING = 0.9
# Less area may be the end of a lobe.
LEAST_MM2, LEAST_LESION_MM2 = 100.0, 20.0
# Two bodies end at a gap of several slices where both grow away from it: the product of the sections' shares
# of the largest. At the waist of a kidney it is 0.5 or more, between two balls or their caps of up to half a
# radius 0.4 at most.
TWO_BODIES = 0.45
# Gaps are searched in every second pixel of every second row.
STRIDE = 2


@dataclass(frozen=True)
class _Structure:
    """What must not be missing in a slice; values of the label map."""

    name: str
    itself: list[int]
    own: list[int]  # and what of it is another structure's, such as a tumour in a kidney
    labelled: list[int]  # a voxel of one of these is not missing
    least_mm2: float
    most_slices: int


def fill_missing_slices(labels: LabelMap, organ: list[int]) -> tuple[LabelMap, tuple[str, ...]]:
    """The labels with what is missing of an organ, its tumours and cysts, and warnings that name the slices.

    ``organ`` are the label values of the organ. Labels may be on any grid, and slices may be drawn along any
    axis.
    """
    lesions = {tissue: values for tissue in LESIONS if (values := labels.of_tissues(tissue))}
    everything = list(labels.segments)
    structures = []
    for name, v in lesions.items():
        structures.append(_Structure(name, v, v, v, LEAST_LESION_MM2, MOST_LESION_SLICES))
        structures.append(_Structure(name, v, v, everything, LEAST_LESION_MM2, MOST_SLICES))
    # A slice may have a tumour alone.
    own = [*organ, *chain(*lesions.values())]
    structures.append(_Structure("kidney", organ, own, everything, LEAST_MM2, MOST_SLICES))
    warnings = []
    for structure in structures:
        voxels, slices = _filled(labels, structure)
        if slices:
            labels = replace(labels, values=voxels)
            warnings.append(
                f"no {structure.name} is labelled in the slice{'s' * (len(slices) > 1)} {listed(slices)}, "
                "and it is on both sides: it was "
                "interpolated there; correct the label if that is wrong"
            )
    return labels, tuple(warnings)


def _filled(labels: LabelMap, structure: _Structure) -> tuple[np.ndarray, list[str]]:
    """Voxels (z, y, x) with the missing sections of a structure, and the names of their slices."""
    voxels, spacing = labels.values, labels.grid.spacing
    inside = among(voxels, structure.itself)
    if not inside.any():
        return voxels, []
    box = box_of(inside)[::-1]
    corner = np.array([a.start for a in box[::-1]])
    inside, known = inside[box], among(voxels[box], structure.labelled)
    names: list[str] = []
    for axis in range(3):
        across = 2 - axis
        pixel = np.delete(spacing[::-1], across)
        along, known_along = (np.moveaxis(one, across, 0) for one in (inside, known))
        most = min(structure.most_slices, int(MOST_MM / spacing[axis]))
        for first, last in _gaps(along, known_along, most, structure.least_mm2 / pixel.prod()):
            slices = np.moveaxis(voxels[box], across, 0)[first - 1 : last + 1]
            sections = _sections(slices, structure, pixel)
            if not any(section.any() for section in sections):
                continue
            here = tuple(_wider(a) for a in box_of(np.any(sections, axis=0)[None])[1::-1])
            sides = along[first - 1 :: -1, here[0], here[1]], along[last:, here[0], here[1]]
            if last - first > 1 and np.prod([_share_of_largest(side) for side in sides]) < TWO_BODIES:
                continue
            if not names:
                voxels = voxels.copy()
                slices = np.moveaxis(voxels[box], across, 0)[first - 1 : last + 1]
            values = _organ_values_between(slices[0], slices[-1], structure)
            for k, section in enumerate(sections):
                slices[1 + k][section] = values[section]
                names.append(_name(labels, axis, int(corner[axis]) + first + k, section, corner))
    return voxels, names


def _wider(a: slice) -> slice:
    """A range, three times as wide: a body grows beyond its end's section."""
    width = a.stop - a.start
    return slice(max(0, a.start - width), a.stop + width)


def _share_of_largest(side: np.ndarray) -> float:
    """The area of the first of some slices (n, y, x), as a share of the largest in the body that begins
    there.
    """
    areas = np.count_nonzero(side, axis=(1, 2))
    return float(areas[0] / areas[: int(np.argmin(areas > 0)) or None].max())


def _organ_values_between(before: np.ndarray, after: np.ndarray, structure: _Structure) -> np.ndarray:
    """For each pixel, the structure's value in a section, else in the other, else its most frequent one."""
    is_before, is_after = (np.isin(section, structure.itself) for section in (before, after))
    usual = np.bincount(before[is_before]).argmax()
    return np.where(is_before, before, np.where(is_after, after, usual))


def _gaps(inside: np.ndarray, known: np.ndarray, most: int, least: float) -> Iterator[tuple[int, int]]:
    """First slice, and the one after the last, of gaps that may be missing: much is labelled on both sides
    and not between them.

    ``inside`` is the structure, slices along the first axis, ``known`` what is labelled. A gap has at
    most ``most`` slices, and at least ``least`` pixels.
    """
    inside, unknown = inside[:, ::STRIDE, ::STRIDE], ~known[:, ::STRIDE, ::STRIDE]
    # Of a small section, more or fewer pixels than its share are searched.
    least = 0.5 * least / STRIDE**2
    for count in range(1, min(most, len(inside) - 2) + 1):
        missing = inside[: -count - 1] & inside[count + 1 :]
        for k in range(1, count + 1):
            missing &= unknown[k : len(unknown) - count - 1 + k]
        pixels = np.count_nonzero(missing.reshape(len(missing), -1), axis=1)
        yield from ((int(n) + 1, int(n) + 1 + count) for n in np.flatnonzero(pixels >= least))


def _sections(slices: np.ndarray, structure: _Structure, pixel: np.ndarray) -> list[np.ndarray]:
    """The missing sections of all slices but the first and last, between which they are interpolated, as
    masks.
    """
    ends = [np.isin(end, structure.own) for end in (slices[0], slices[-1])]
    itself = [np.isin(end, structure.itself) for end in (slices[0], slices[-1])]
    between = slices[1:-1]
    known = np.isin(between, structure.labelled)
    there = np.isin(between, structure.itself).any(axis=0)
    parts, count = ndimage.label(itself[0] & itself[1])
    gone, left = (
        np.bincount(parts.ravel(), weights.ravel(), count + 1) for weights in (~known.any(axis=0), there)
    )
    is_missing = (gone >= LEAST_MISSING * (gone + left)) & (gone * pixel.prod() >= structure.least_mm2)
    is_missing[0] = False
    if not is_missing.any():
        return []
    distances = [_signed_distance(end, pixel) for end in ends]
    sections = []
    for k, labelled in enumerate(known, start=1):
        share = k / (len(between) + 1)
        pieces, _ = ndimage.label((1 - share) * distances[0] + share * distances[1] < 0)
        wanted = np.unique(pieces[is_missing[parts]])
        sections.append(np.isin(pieces, wanted[wanted > 0]) & ~labelled)
    return sections


def _signed_distance(section: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Distance [mm] from the outline of a section, negative inside."""
    outside, inside = (ndimage.distance_transform_edt(one, sampling=spacing) for one in (~section, section))
    return outside - inside


def _name(labels: LabelMap, axis: int, number: int, section: np.ndarray, corner: np.ndarray) -> str:
    """Where a slice and the largest of its missing sections are, LPS [mm].

    ``corner`` is the index (3,) of the section's first pixel.
    """
    parts, _ = ndimage.label(section)
    largest = parts == np.bincount(parts[section]).argmax()
    rows, columns = np.argwhere(largest).mean(axis=0)
    index = corner + np.insert([columns, rows], axis, 0.0)
    index[axis] = number
    place = labels.grid.place(index[None])[0]
    main = int(np.argmax(np.abs(labels.grid.direction[:, axis])))
    around = ", ".join(
        f"{name} {at:.0f}" for n, (name, at) in enumerate(zip("xyz", place, strict=True)) if n != main
    )
    return f"{'xyz'[main]} {place[main]:.1f} mm (around {around})"
