"""The one organ of a label map: which voxels, which side; refused in words where that is not plain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import SimpleITK as sitk
from scipy import ndimage

from scenes.reading import PatientError

Side = Literal["left", "right"]

PLAUSIBLE_ORGAN_ML = (20.0, 2000.0)
PLAUSIBLE_ORGAN_HU = (-150.0, 600.0)
ORGAN_FROM_ML = 20.0  # a connected piece from this volume on is an organ, below it an island of the label
CUT_AREA_MM2 = 100.0  # a pole that just grazes the border is whole to within the thickness of a slice
BODY_ABOVE_HU = -300.0
BODY_WIDTH_MM = 150.0
MIDLINE_MARGIN_MM = 10.0
KIDNEYS_APART_MM = 60.0  # nearer pieces may both be of one kidney


@dataclass(frozen=True)
class LabelledOrgan:
    """One large connected piece of organ and tumour labels."""

    values: list[int]  # label values of the organ that occur in it, the tumour's left out
    volume_ml: float
    centre_x_mm: float  # LPS
    mask: np.ndarray  # bool, axes (z, y, x), shape of the CT; tumour included
    tumour: np.ndarray  # bool, same shape
    labels: np.ndarray  # label values of the voxels in it, 0 elsewhere, same shape

    def side_of(self, midline_x_mm: float) -> Side:
        return "left" if self.centre_x_mm > midline_x_mm else "right"


def labelled_organ(
    ct: sitk.Image,
    labels: sitk.Image,
    organ: Sequence[int] | None,
    tumour: Sequence[int] | None,
    side: Side | None,
) -> tuple[LabelledOrgan, Side]:
    """The one whole organ that label values and side single out, and its side; arguments as import_patient.

    Raises:
        PatientError: there is none, there are several, or it is cut off, implausible or on another side.
    """
    if side not in (None, "left", "right"):
        raise PatientError(f"the side is {side!r}: expected left or right")
    values = _values_on_grid(ct, labels)
    organ_values, tumour_values = _chosen_values(values, organ, tumour)
    pieces = _pieces(ct, values, organ_values, tumour_values)
    midline = _midline_x(ct, np.isin(values, organ_values))
    piece, told_side = _single_out(pieces, midline, side)
    _check_organ(ct, piece)
    if tumour_values and not piece.tumour.any():
        raise PatientError(
            f"the tumour's label {_listed(tumour_values)} has no voxel in the {told_side} kidney: expected a "
            "tumour of that kidney; choose the other side or leave the tumour out"
        )
    return piece, told_side


def _values_on_grid(ct: sitk.Image, labels: sitk.Image) -> np.ndarray:
    """Label values on the grid of the CT, whole numbers; axes (z, y, x)."""
    found = sitk.GetArrayFromImage(labels)
    if found.min() < 0 or (found != np.round(found)).any():
        raise PatientError(
            f"the label map holds values from {found.min():g} to {found.max():g}: expected whole numbers "
            "from 0 up; check that CT and labels are not swapped and that the map is no probability"
        )
    if not found.any():
        raise PatientError("the label map is empty, every voxel is 0: expected an organ; choose another file")
    if not _same_grid(labels, ct):
        whole = sitk.Cast(labels, sitk.sitkInt32)
        found = sitk.GetArrayFromImage(
            sitk.Resample(whole, ct, sitk.Transform(), sitk.sitkNearestNeighbor, 0)
        )
        if not found.any():
            raise PatientError(
                "the label map lies outside the CT: expected both to overlap in patient coordinates; choose "
                "labels that were drawn on this CT"
            )
    return found.astype(np.min_scalar_type(int(found.max())))


def _same_grid(a: sitk.Image, b: sitk.Image) -> bool:
    """Whether size and, to a hundredth of a voxel, all corners agree; files round their geometry."""
    if a.GetSize() != b.GetSize():
        return False
    corners = np.array(np.meshgrid(*[(0, n - 1) for n in a.GetSize()])).reshape(3, -1).T.tolist()
    place_a, place_b = ([i.TransformIndexToPhysicalPoint(c) for c in corners] for i in (a, b))
    return bool(np.abs(np.subtract(place_a, place_b)).max() <= 0.01 * min(b.GetSpacing()))


def _chosen_values(
    values: np.ndarray, organ: Sequence[int] | None, tumour: Sequence[int] | None
) -> tuple[list[int], list[int]]:
    """Label values of organ and tumour, each of them present in the map and none in both."""
    present = [value for value in np.unique(values).tolist() if value != 0]
    for name, wanted in (("organ", organ), ("tumour", tumour)):
        absent = sorted(set(wanted or []) - set(present))
        if absent or (wanted is not None and len(wanted) == 0):
            raise PatientError(
                f"the {name}'s label {_listed(absent) or '(none given)'} is not in the label map: it holds "
                f"{_listed(present)}; give --{name} one of these"
            )
    tumour_values = sorted(set(tumour or []))
    organ_values = sorted(set(present) - set(tumour_values) if organ is None else set(organ))
    both = sorted(set(organ_values) & set(tumour_values))
    if both:
        raise PatientError(f"label {_listed(both)} is given as organ and as tumour: give it as one of them")
    if not organ_values:
        raise PatientError(
            f"the label map holds the tumour's label alone ({_listed(present)}): expected an organ's too; "
            "choose a file with both"
        )
    return organ_values, tumour_values


def _pieces(
    ct: sitk.Image, values: np.ndarray, organ_values: list[int], tumour_values: list[int]
) -> list[LabelledOrgan]:
    """Large connected pieces of organ and tumour together, from right to left.

    Islands belong to none, and neither does a tumour apart from every kidney. Two values that touch are one
    piece: cortex and medulla, or kidney and cyst, are one organ.
    """
    box = ndimage.find_objects(np.isin(values, organ_values + tumour_values).astype(np.uint8))[0]
    inside = values[box]
    labelled, count = ndimage.label(np.isin(inside, organ_values + tumour_values), np.ones((3, 3, 3)))
    voxel_ml = float(np.prod(ct.GetSpacing())) / 1000.0
    volumes = np.bincount(labelled.ravel(), minlength=count + 1) * voxel_ml
    of_organ = np.unique(labelled[np.isin(inside, organ_values)])
    large = [n for n in of_organ if volumes[n] >= ORGAN_FROM_ML] or [of_organ[np.argmax(volumes[of_organ])]]

    pieces = []
    for n in large:
        mask = np.zeros(values.shape, bool)
        mask[box] = labelled == n
        pieces.append(
            LabelledOrgan(
                values=[v for v in np.unique(values[mask]).tolist() if v in organ_values],
                volume_ml=float(volumes[n]),
                centre_x_mm=float(_physical(ct, np.argwhere(mask))[0].mean()),
                mask=mask,
                tumour=mask & np.isin(values, tumour_values),
                labels=np.where(mask, values, 0),
            )
        )
    return sorted(pieces, key=lambda piece: piece.centre_x_mm)


def _midline_x(ct: sitk.Image, organs: np.ndarray) -> float | None:
    """LPS x [mm] of the middle of the body at the organs' level; None where the CT shows no body's width.

    The centroid of the body, not the middle of its box: arms and table edges reach far but weigh little.
    """
    stride = np.array([max(1, int(4.0 / s)) for s in ct.GetSpacing()])[::-1]
    thin = tuple(slice(None, None, n) for n in stride)
    labelled, count = ndimage.label(sitk.GetArrayViewFromImage(ct)[thin] > BODY_ABOVE_HU)
    if count == 0:
        return None
    body = labelled == 1 + np.argmax(np.bincount(labelled.ravel())[1:])
    x, _, z = _physical(ct, np.argwhere(body) * stride)
    organ_z = _physical(ct, np.argwhere(organs[thin]) * stride)[2]
    if organ_z.size:
        level = (z >= organ_z.min() - 5.0) & (z <= organ_z.max() + 5.0)
        x = x[level]
    return float(x.mean()) if x.size and np.ptp(x) >= BODY_WIDTH_MM else None


def _single_out(
    pieces: list[LabelledOrgan], midline: float | None, side: Side | None
) -> tuple[LabelledOrgan, Side]:
    """The piece on the wanted side; with no body around it, the user's word stands for the midline."""
    ends = pieces[0].centre_x_mm, pieces[-1].centre_x_mm
    if midline is None and len(pieces) == 2 and ends[1] - ends[0] > KIDNEYS_APART_MM:
        midline = 0.5 * sum(ends)
    found = _named(pieces, midline)
    unsure = midline is None or all(abs(p.centre_x_mm - midline) < MIDLINE_MARGIN_MM for p in pieces)
    if unsure and len(pieces) == 1:
        if side is None:
            raise PatientError(
                f"the CT does not show on which side of the body the organ lies ({found}): expected the "
                "body's whole width and an organ off its midline; give --side left or --side right"
            )
        return pieces[0], side
    chosen = pieces if side is None or midline is None else [p for p in pieces if p.side_of(midline) == side]
    if not chosen:
        raise PatientError(
            f"no {side} kidney is labelled, found: {found}; give the side that is there, or check that the "
            "labels are not mirrored"
        )
    # Without a midline there are several here.
    if midline is None or len(chosen) > 1:
        split = midline is not None and len({p.side_of(midline) for p in chosen}) == len(chosen)
        advice = "--side left or --side right, or --organ with" if split else "--organ with"
        raise PatientError(
            f"{len(chosen)} organs are labelled, expected one, found: {found}; give {advice} the label of one"
        )
    return chosen[0], chosen[0].side_of(midline)


def _named(pieces: list[LabelledOrgan], midline: float | None) -> str:
    return "; ".join(
        f"label {'+'.join(map(str, p.values[:6]))}{'+...' * (len(p.values) > 6)}, "
        + ("" if midline is None else f"{p.side_of(midline)}, ")
        + f"{p.volume_ml:.1f} ml"
        for p in pieces
    )


def _check_organ(ct: sitk.Image, piece: LabelledOrgan) -> None:
    """Refuse what is no whole organ in soft tissue."""
    name = f"the organ (label {_listed(piece.values)})"
    least, most = PLAUSIBLE_ORGAN_ML
    if not least <= piece.volume_ml <= most:
        raise PatientError(
            f"{name} has {piece.volume_ml:.1f} ml: expected {least:g} to {most:g} ml; choose the organ's "
            "label values with --organ"
        )
    spacing = ct.GetSpacing()[::-1]
    for axis in range(3):
        face_mm2 = np.prod(spacing) / spacing[axis]
        cut = max(piece.mask.take(end, axis=axis).sum() for end in (0, -1)) * face_mm2
        if cut > CUT_AREA_MM2:
            raise PatientError(
                f"{name} is cut off at the border of the CT over {cut / 100:.1f} cm2: expected a whole "
                "organ; choose a CT that shows all of it"
            )
    median = float(np.median(sitk.GetArrayViewFromImage(ct)[piece.mask]))
    if not PLAUSIBLE_ORGAN_HU[0] <= median <= PLAUSIBLE_ORGAN_HU[1]:
        raise PatientError(
            f"{name} has a median of {median:.0f} HU: expected soft tissue; check that the labels belong to "
            "this CT and that the CT is in HU"
        )
    if float(sitk.GetArrayViewFromImage(ct).min()) >= 0:
        raise PatientError(
            "the CT holds no value below 0: expected HU, in which fat and air are negative; give the CT first, then "
            "the labels"
        )


def _physical(image: sitk.Image, indices_zyx: np.ndarray) -> np.ndarray:
    """LPS coordinates [mm] of voxels given as (z, y, x), shape (3, n)."""
    direction = np.array(image.GetDirection()).reshape(3, 3)
    scaled = indices_zyx[:, ::-1] * np.array(image.GetSpacing())
    return direction @ scaled.T + np.array(image.GetOrigin())[:, None]


def _listed(values: Sequence[int]) -> str:
    shown = ", ".join(str(v) for v in values[:12])
    return shown + (f" and {len(values) - 12} more" if len(values) > 12 else "")
