"""Whether a label is plausible as one whole kidney: its size, its side of the body, cavities, ends that
look cut off.
"""

from collections.abc import Iterator

import numpy as np
import trimesh
from scipy import ndimage

from scenes.patients.organ_selection import LESIONS, MIDLINE_MARGIN_MM, Organ
from scenes.patients.readers.label_maps import LabelMap
from scenes.patients.readers.segment_names import Side

# Of an adult's kidney, without tumours and cysts. Length: 110 mm, standard deviation 12 (CT of 1040 adults;
# Glodny et al. 2009, BMC
# Urology 9:19). Volume: medians of 138 ml (women) and 174 ml (men), 5th percentile 92 ml in women over 60
# (MRI of 1815 adults;
# J Clin Med 2024, 13(3):769).
LENGTH_MM, VOLUME_ML = (90.0, 130.0), (90.0, 250.0)
# So far outside, as a share, is no cause for a warning: labels of thick slices end a slice earlier or later.
TOLERANCE = 0.1
# Smaller parts on the other side of the midline give no warning.
LEAST_ACROSS_ML = 2.0
# The surface fills cavities of the label; this share of its volume gives no warning.
MOST_FILLED = 0.05
# Kidneys of the development data fill at least 80 % of the convex hull of their surface.
LEAST_SOLIDITY = 0.65
# A label's end of this area is cut off where the section this deep inside is not clearly larger. A pole in
# slices as thick as this widens by a factor of 1.7 or more.
FLAT_MM2, FLAT_DEPTH_MM, LEAST_WIDENING = 200.0, 5.0, 1.5
# Along LPS.
TOWARDS = (("right", "left"), ("front", "back"), ("feet", "head"))


def kidney_warnings(
    piece: Organ, labels: LabelMap, surface: trimesh.Trimesh, side: Side, midline: float | None
) -> tuple[str, ...]:
    """Warnings of an organ that is unlike one whole kidney.

    ``piece`` is the organ, ``surface`` its closed surface, LPS [mm], and ``side`` that of the body. Tumours
    and cysts in ``labels`` are recognised by their tissue. ``midline`` is LPS x [mm], None where the CT does
    not show it.
    """
    healthy = piece.mask & ~np.isin(piece.values, labels.of_tissues(*LESIONS))
    return (
        *size_warnings(piece, healthy),
        *midline_warnings(piece, healthy, side, midline),
        *hollow_warnings(piece, surface),
        *flat_end_warnings(piece),
    )


def size_warnings(piece: Organ, healthy: np.ndarray) -> tuple[str, ...]:
    """A warning where an organ is larger than an adult's kidney without its tumours and cysts, or smaller
    with them.

    ``healthy`` (z, y, x) are the voxels of the organ that are neither tumour nor cyst.
    """
    normal = f"most adult kidneys are {_range(LENGTH_MM)} mm long and have {_range(VOLUME_ML)} ml"
    large = length_mm(piece, healthy), float(healthy.sum() * piece.grid.voxel_ml)
    if large[0] > (1 + TOLERANCE) * LENGTH_MM[1] or large[1] > (1 + TOLERANCE) * VOLUME_ML[1]:
        return (
            f"without its labelled tumours and cysts, the kidney is {large[0]:.0f} mm long and has "
            f"{large[1]:.0f} ml; {normal}; the label "
            "may contain both kidneys (a horseshoe kidney), other organs, or a tumour or cyst without a "
            "label of its own (--tumour, --cyst)",
        )
    small = length_mm(piece, piece.mask), piece.volume_ml
    if small[0] < (1 - TOLERANCE) * LENGTH_MM[0] or small[1] < (1 - TOLERANCE) * VOLUME_ML[0]:
        return (
            f"the kidney is small, {small[0]:.0f} mm long and {small[1]:.0f} ml; {normal}; a child's or a "
            "shrunken kidney may be; "
            "otherwise check that its label is complete",
        )
    return ()


def midline_warnings(piece: Organ, healthy: np.ndarray, side: Side, midline: float | None) -> tuple[str, ...]:
    """A warning where a part of a kidney that is neither tumour nor cyst is on the other side of the
    body's midline, LPS x [mm].
    """
    if midline is None:
        return ()
    x = piece.grid.place(np.argwhere(healthy)[:, ::-1])[:, 0]
    across_mm = (midline - x if side == "left" else x - midline) - MIDLINE_MARGIN_MM
    across_ml = float((across_mm > 0).sum() * piece.grid.voxel_ml)
    if across_ml < LEAST_ACROSS_ML:
        return ()
    return (
        f"the {side} kidney extends {across_mm.max() + MIDLINE_MARGIN_MM:.0f} mm across the body's "
        f"midline, with {across_ml:.0f} ml more than "
        f"{MIDLINE_MARGIN_MM:g} mm beyond it; expected one kidney on one side; it may be a horseshoe "
        "kidney, or its label may contain both",
    )


def hollow_warnings(piece: Organ, surface: trimesh.Trimesh) -> tuple[str, ...]:
    """A warning where a label has a cavity: closed, so that its surface (LPS [mm]) fills it, or open."""
    filled_ml, hull_ml = surface.volume / 1000, surface.convex_hull.volume / 1000
    advice = "check the label; if its inside is kidney, sinus, tumour or cyst, label it"
    if filled_ml > (1 + MOST_FILLED) * piece.volume_ml:
        return (
            f"the organ's label is hollow: it has {piece.volume_ml:.1f} ml, and its surface encloses "
            f"{filled_ml:.1f} ml, all of which is "
            f"simulated as kidney; {advice}",
        )
    if piece.volume_ml < LEAST_SOLIDITY * hull_ml:
        return (
            f"the organ's label fills {piece.volume_ml / hull_ml:.0%} of its convex hull, a kidney "
            f"{LEAST_SOLIDITY:.0%} or more; it may be "
            f"hollow, torn or connected to something else; {advice}",
        )
    return ()


def flat_end_warnings(piece: Organ) -> tuple[str, ...]:
    """A warning for each direction in which a label ends in a flat face, as at the edge of a label volume
    that is too small.
    """
    return tuple(
        f"the organ's label ends towards the {towards} in a flat face of {area_mm2 / 100:.1f} cm2, as if "
        "it were cut off there; check that "
        "the label contains the whole organ"
        for towards, area_mm2, inner_mm2 in _ends(piece)
        if area_mm2 >= FLAT_MM2 and inner_mm2 < LEAST_WIDENING * area_mm2
    )


def length_mm(piece: Organ, inside: np.ndarray) -> float:
    """Greatest distance [mm] between the centres of two voxels (z, y, x) in an organ's box, to 0.5 %; 0
    where there is none.
    """
    # No corner of the convex hull is between two voxels of a row.
    between = [ndimage.binary_erosion(inside, np.ones(shape)) for shape in ((3, 1, 1), (1, 3, 1), (1, 1, 3))]
    places = piece.grid.place(np.argwhere(inside & ~np.any(between, axis=0))[:, ::-1])
    return float(np.ptp(places @ _directions().T, axis=0).max()) if len(places) else 0.0


def _directions() -> np.ndarray:
    """Unit vectors (n, 3) of a half sphere, at most 5.4 degrees from any direction."""
    return np.asarray(trimesh.creation.icosphere(subdivisions=3).vertices)


def _ends(piece: Organ) -> Iterator[tuple[str, float, float]]:
    """Of the six ends of an organ's box: their direction, the organ's section there and FLAT_DEPTH_MM
    deeper [mm2].
    """
    spacing, size = piece.grid.spacing, piece.grid.size
    for axis in range(3):
        area = piece.mask.sum(axis=tuple({0, 1, 2} - {2 - axis})) * np.prod(spacing) / spacing[axis]
        deeper = min(max(1, round(FLAT_DEPTH_MM / spacing[axis])), size[axis] - 1)
        main = int(np.argmax(np.abs(piece.grid.direction[:, axis])))
        is_up = piece.grid.direction[main, axis] > 0
        yield TOWARDS[main][int(not is_up)], float(area[0]), float(area[deeper])
        yield TOWARDS[main][int(is_up)], float(area[-1]), float(area[-1 - deeper])


def _range(limits: tuple[float, float]) -> str:
    return f"{limits[0]:g} to {limits[1]:g}"
