"""Slices of a label that nobody segmented: found between their neighbours and filled by shape-based interpolation (Raya and Udupa 1990)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from scipy import ndimage

from scenes.patients.readers.label_maps import LESIONS, LabelMap, among, box_of, listed

# So many neighbouring slices are filled, if they are no thicker than this together; a wider gap is two pieces, or two tumours.
MOST_SLICES, MOST_LESION_SLICES, MOST_MM = 3, 1, 10.0
# A section that both neighbours have is missing where this share of it has no label.
LEAST_MISSING = 0.9
# Less area may be the end of a lobe.
LEAST_MM2, LEAST_LESION_MM2 = 100.0, 20.0
# Slices are drawn along the longest side of the voxels; of voxels with sides within this ratio, along any.
SAME_SIDE = 1.2


@dataclass(frozen=True)
class _Structure:
    """What must not be missing in a slice; values of the label map."""

    name: str
    own: list[int]  # and what of it is another structure's, such as a tumour in a kidney
    itself: list[int]
    labelled: list[int]  # a voxel of one of these is not missing
    least_mm2: float
    most_slices: int


def fill_missing_slices(labels: LabelMap, organ: list[int]) -> tuple[LabelMap, tuple[str, ...]]:
    """The labels with what is missing of an organ, its tumours and cysts, and a warning that names the slices.

    Args:
        labels: on any grid.
        organ: values of the organ.
    """
    lesions = {tissue: values for tissue in LESIONS if (values := labels.of_tissues(tissue))}
    structures = [
        _Structure(name, v, v, v, LEAST_LESION_MM2, MOST_LESION_SLICES) for name, v in lesions.items()
    ]
    # A slice may have a tumour alone.
    both = [*organ, *chain(*lesions.values())]
    structures.append(_Structure("kidney", both, organ, list(labels.segments), LEAST_MM2, MOST_SLICES))
    warnings = []
    for structure in structures:
        voxels, slices = _filled(labels, structure)
        if slices:
            labels = replace(labels, values=voxels)
            warnings.append(
                f"no {structure.name} is labelled in {listed(slices)}, and it is on both sides: it was interpolated there; "
                "correct the label if that is wrong"
            )
    return labels, tuple(warnings)


def _filled(labels: LabelMap, structure: _Structure) -> tuple[np.ndarray, list[str]]:
    """Voxels (z, y, x) with the missing sections of a structure, and the names of their slices."""
    voxels, spacing = labels.values, labels.grid.spacing
    inside = among(voxels, structure.own)
    if not inside.any():
        return voxels, []
    box = box_of(inside)[::-1]
    inside, known = inside[box], among(voxels[box], structure.labelled)
    names: dict[str, None] = {}
    for axis in _slice_axes(spacing):
        across = 2 - axis
        pixel = np.delete(spacing[::-1], across)
        least = structure.least_mm2 / pixel.prod()
        along, known_along = (np.moveaxis(one, across, 0) for one in (inside, known))
        most = min(structure.most_slices, int(MOST_MM / spacing[axis]))
        for first, last in _gaps(along, known_along, most, least):
            slices = np.moveaxis(voxels[box], across, 0)[first - 1 : last + 1]
            sections = _sections(slices, structure, pixel)
            if not any(section.any() for section in sections):
                continue
            if not names:
                voxels = voxels.copy()
                slices = np.moveaxis(voxels[box], across, 0)[first - 1 : last + 1]
            values = np.where(np.isin(slices[0], structure.own), slices[0], slices[-1])
            for k, section in enumerate(sections):
                slices[1 + k][section] = values[section]
                corner = np.array([a.start for a in box[::-1]])
                names[_name(labels, axis, int(corner[axis]) + first + k, section, corner)] = None
    return voxels, list(names)


def _slice_axes(spacing: np.ndarray) -> list[int]:
    """The axes x, y, z along which slices may be drawn."""
    return [axis for axis in range(3) if spacing[axis] * SAME_SIDE >= spacing.max()]


def _gaps(inside: np.ndarray, known: np.ndarray, most: int, least: float) -> Iterator[tuple[int, int]]:
    """First slice, and the one after the last, of gaps that may be missing: much is labelled on both sides and not between them.

    Args:
        inside: the structure, slices along the first axis.
        known: what is labelled.
        most: slices of a gap.
        least: pixels.
    """
    for count in range(1, min(most, len(inside) - 2) + 1):
        missing = inside[: -count - 1] & inside[count + 1 :]
        for k in range(1, count + 1):
            missing &= ~known[k : len(known) - count - 1 + k]
        pixels = np.count_nonzero(missing.reshape(len(missing), -1), axis=1)
        yield from ((int(n) + 1, int(n) + 1 + count) for n in np.flatnonzero(pixels >= least))


def _sections(slices: np.ndarray, structure: _Structure, pixel: np.ndarray) -> list[np.ndarray]:
    """The missing sections of all slices but the first and last, between which they are interpolated, as masks."""
    ends = [np.isin(end, structure.own) for end in (slices[0], slices[-1])]
    between = slices[1:-1]
    known = np.isin(between, structure.labelled)
    there = np.isin(between, structure.itself).any(axis=0)
    parts, count = ndimage.label(ends[0] & ends[1])
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
    """A slice as a reader of the label finds it: its number, and where the missing section is, in LPS [mm].

    ``corner`` is the index (3,) of the section's first pixel.
    """
    rows, columns = np.argwhere(section).mean(axis=0)
    index = corner + np.insert([columns, rows], axis, 0.0)
    index[axis] = number
    place = labels.grid.place(index[None])[0]
    main = int(np.argmax(np.abs(labels.grid.direction[:, axis])))
    around = ", ".join(
        f"{name} {at:.0f}" for n, (name, at) in enumerate(zip("xyz", place, strict=True)) if n != main
    )
    return f"slice {number + 1} ({'xyz'[main]} {place[main]:.1f} mm, around {around})"
