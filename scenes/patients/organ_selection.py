"""Select one organ of a label map: its voxels and its side; an ambiguous choice is refused."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from errors import PatientError
from scenes.patients.readers.label_maps import LESIONS, LabelMap, among, box_of, listed
from scenes.patients.readers.segment_names import Side
from scenes.volumes.voxel_grid import VoxelGrid

ORGAN_FROM_ML = 20.0  # a smaller connected piece is an island of the label
BODY_ABOVE_HU = -300.0
BODY_WIDTH_MM = 150.0
MIDLINE_MARGIN_MM = 10.0
CORNERS = np.ones((3, 3, 3), bool)
KIDNEYS_APART_MM = 60.0  # closer pieces may belong to one kidney
COARSE_MM = 4.0
# Vessels and the collecting system belong to the organ inside hollows of it no wider than twice this.
CLOSING_MM = 10.0
PARENCHYMA = ("kidney", "cortex", "medulla", "sinus", "stone")
VESSELS = ("vessel", "vein", "artery")
HILAR = (*VESSELS, "urine", "fat")


@dataclass(frozen=True)
class Organ:
    """One large connected piece of organ labels with its tumours and cysts, in a box of the label map."""

    grid: VoxelGrid
    values: np.ndarray  # label values of all voxels of the box (z, y, x)
    mask: np.ndarray  # bool: the organ
    present: list[int]  # its label values
    names: list[str]  # and their names
    named_sides: set[Side]  # the sides in these names
    volume_ml: float
    centre_x_mm: float  # LPS

    def side_of(self, midline_x_mm: float) -> Side:
        return "left" if self.centre_x_mm > midline_x_mm else "right"

    @property
    def title(self) -> str:
        return f"the organ (label {listed(self.names)})"


def find_organs(labels: LabelMap, organ: Sequence[int] | None = None) -> list[Organ]:
    """Large connected pieces of organ, tumours and cysts, from right to left.

    Islands, and tumours apart from every kidney, are left out. Labels that touch are one piece, such as
    cortex and medulla. ``organ`` are the label values of the organ; None: those named as a kidney, or without
    names all but tumours, cysts and vessels, which are recognised by their tissue. Raises PatientError where
    no label is an organ.
    """
    own = organ_values(labels, organ)
    lesions = [value for value in labels.of_tissues(*LESIONS) if value not in own]
    wanted = among(labels.values, own + lesions)
    if not wanted.any():
        raise PatientError(f"the labels contain no voxel of an organ: {labels.listed()}; choose other labels")
    box = box_of(wanted)
    part = box[::-1]
    parts, count = ndimage.label(wanted[part])
    volumes = np.bincount(parts.ravel(), minlength=count + 1) * labels.grid.voxel_ml
    of_organ = [int(n) for n in np.unique(parts[np.isin(labels.values[part], own)]) if n]
    large = [n for n in of_organ if volumes[n] >= ORGAN_FROM_ML] or [max(of_organ, key=lambda n: volumes[n])]
    masks = [_with_touching(parts, n, of_organ) for n in large]
    pieces = [_piece(labels, labels.grid.part(box), labels.values[part], mask, own) for mask in masks]
    return sorted(pieces, key=lambda piece: piece.centre_x_mm)


def _with_touching(parts: np.ndarray, n: int, of_organ: list[int]) -> np.ndarray:
    """Part n, with tumours and cysts that touch it only at edges or corners, and the voxels that connect them
    by faces.

    Without a common face they would not be in one surface.
    """
    mask = parts == n
    around = ndimage.binary_dilation(mask, CORNERS)
    for other in np.unique(parts[around & ~mask]).tolist():
        if other and other not in of_organ:
            lesion = parts == other
            mask |= lesion | (around & ndimage.binary_dilation(lesion, CORNERS) & (parts == 0))
    return mask


def organ_values(labels: LabelMap, organ: Sequence[int] | None) -> list[int]:
    """Label values of the organ: the user's, those named as a kidney, or without names all that are no
    other tissue. Raises PatientError.
    """
    if organ is not None:
        # Tumours and cysts are lesions wherever they are given: apart from every kidney they are no organ.
        own = [value for value in organ if labels.segments[value].tissue not in LESIONS]
        if not own:
            raise PatientError(
                "the organ's labels are only those of tumours and cysts; give the kidney's own with --organ, "
                "too"
            )
        return own
    named = any(segment.name or segment.tissue for segment in labels.segments.values())
    own = labels.of_tissues(*PARENCHYMA)
    if not own and all(not s.name for s in labels.segments.values()):
        own = labels.of_tissues(None)
    if own:
        return own
    if named and labels.of_tissues(None):
        raise PatientError(
            f"no label is named as a kidney: {labels.listed()}; name the kidney's with --organ"
        )
    raise PatientError(
        f"the labels contain no organ, only {labels.listed()}; expected a kidney too; choose labels with both"
    )


def _piece(labels: LabelMap, grid: VoxelGrid, values: np.ndarray, mask: np.ndarray, own: list[int]) -> Organ:
    """An organ in its box, with the hilar structures in its hollows."""
    box = box_of(mask)
    z, y, x = (slice(a.start, a.stop) for a in box[::-1])
    inside, around = mask[z, y, x], values[z, y, x]
    inner = np.isin(around, [v for v in labels.of_tissues(*HILAR) if v not in own])
    if inner.any():
        inside = inside | (inner & closing(inside, grid.spacing[::-1]))
    present = [int(v) for v in np.unique(around[inside]) if int(v) in own]
    segments = [labels.segments[v] for v in present]
    indices = np.argwhere(inside).mean(axis=0)[::-1] + [a.start for a in box]
    return Organ(
        grid=grid.part(box),
        values=around,
        mask=inside,
        present=present,
        names=[str(segment) for segment in segments],
        named_sides={segment.side for segment in segments if segment.side},
        volume_ml=float(inside.sum() * grid.voxel_ml),
        centre_x_mm=float(grid.place(indices[None])[0, 0]),
    )


def closing(mask: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Morphological closing of a mask (z, y, x) by a ball of CLOSING_MM; spacing [mm] along the same axes."""
    rim = [(int(n), int(n)) for n in np.ceil(CLOSING_MM / spacing) + 1]
    dilated = ndimage.distance_transform_edt(~np.pad(mask, rim), sampling=spacing) <= CLOSING_MM
    closed = ndimage.distance_transform_edt(dilated, sampling=spacing) > CLOSING_MM
    return closed[tuple(slice(low, n - high) for (low, high), n in zip(rim, closed.shape, strict=True))]


def midline_x(grid: VoxelGrid, hounsfield: np.ndarray, low_z_mm: float, high_z_mm: float) -> float | None:
    """LPS x [mm] of the body's midline between two heights; None where the CT does not show the body's width.

    It is the body's centroid, not the middle of its box, which arms and table edges would shift.
    """
    step = np.maximum(1, (COARSE_MM / grid.spacing).astype(int))
    parts, count = ndimage.label(hounsfield[:: step[2], :: step[1], :: step[0]] > BODY_ABOVE_HU)
    if count == 0:
        return None
    body = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
    x, _, z = grid.place(np.argwhere(body)[:, ::-1] * step).T
    x = x[(z >= low_z_mm - 5.0) & (z <= high_z_mm + 5.0)]
    return float(x.mean()) if x.size and np.ptp(x) >= BODY_WIDTH_MM else None


def choose_organ(pieces: list[Organ], midline: float | None, side: Side | None) -> tuple[Organ, Side]:
    """The organ on the requested side; where the CT shows no body, ``side`` or the label's name replaces the
    midline.

    Raises PatientError where there is none, or several, or one with a name of the other side.
    """
    ends = pieces[0].centre_x_mm, pieces[-1].centre_x_mm
    if midline is None and len(pieces) == 2 and ends[1] - ends[0] > KIDNEYS_APART_MM:
        midline = 0.5 * sum(ends)
    description = _described(pieces, midline)
    unsure = midline is None or abs(pieces[0].centre_x_mm - midline) < MIDLINE_MARGIN_MM
    if unsure and len(pieces) == 1:
        return pieces[0], _side_without_midline(pieces[0], side, description)
    chosen = pieces if side is None or midline is None else [p for p in pieces if p.side_of(midline) == side]
    if not chosen:
        raise PatientError(
            f"no {side} kidney is labelled, found: {description}; give the side that is there, or check "
            "that the labels are not mirrored"
        )
    # Without a midline there are several here.
    if midline is None or len(chosen) > 1:
        split = midline is not None and len({p.side_of(midline) for p in chosen}) == len(chosen)
        advice = "--side left or --side right, or --organ with" if split else "--organ with"
        where = f" on the {side}" if side and midline is not None else ""
        raise PatientError(
            f"{len(chosen)} organs are labelled{where}, expected one, found: {description}; give {advice} "
            "the label of one; labels that touch are taken together, and a label in two pieces has an empty "
            "slice"
        )
    actual: Side = chosen[0].side_of(midline)
    if chosen[0].named_sides == {"right" if actual == "left" else "left"}:
        raise PatientError(
            f"{chosen[0].title} is on the patient's {actual}, but its name has the other side; expected both "
            "to agree; the labels or "
            "the CT may be mirrored: check the export"
        )
    return chosen[0], actual


def _side_without_midline(piece: Organ, side: Side | None, description: str) -> Side:
    """The side of the only organ where the CT does not show the midline."""
    named = next(iter(piece.named_sides)) if len(piece.named_sides) == 1 else None
    if side and named and side != named:
        raise PatientError(f"{piece.title} has a name of the other side than --side {side}; check both")
    stated = side or named
    if stated is None:
        raise PatientError(
            f"the CT does not show on which side of the body the organ is ({description}): expected the "
            "body's whole width and an organ off its midline; give --side left or --side right"
        )
    return stated


def _described(pieces: list[Organ], midline: float | None) -> str:
    return "; ".join(
        f"label {'+'.join(p.names[:6])}{'+...' * (len(p.names) > 6)}, "
        + ("" if midline is None else f"{p.side_of(midline)}, ")
        + f"{p.volume_ml:.1f} ml"
        for p in pieces
    )
