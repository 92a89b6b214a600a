"""The one organ of a label map: which voxels, which side; refused in words where that is not plain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

from errors import PatientError
from scenes.patients.readers.label_maps import LabelMap, box_of, listed
from scenes.patients.readers.segment_names import Side
from scenes.volumes.voxel_grid import Box, VoxelGrid

PLAUSIBLE_ORGAN_ML = (20.0, 2000.0)
ORGAN_FROM_ML = 20.0  # a connected piece from this volume on is an organ, below it an island of the label
BODY_ABOVE_HU = -300.0
BODY_WIDTH_MM = 150.0
MIDLINE_MARGIN_MM = 10.0
CORNERS = np.ones((3, 3, 3), bool)
KIDNEYS_APART_MM = 60.0  # nearer pieces may both be of one kidney
COARSE_MM = 4.0
# Vessels and the collecting system are of the organ where they lie in a hollow of it no wider than twice this.
HOLLOW_MM = 10.0
PARENCHYMA = ("kidney", "cortex", "medulla", "sinus", "stone")
LESIONS = ("tumour", "cyst", "necrosis")  # in the organ or out of it, they move with it
HILAR = ("vessel", "urine", "fat")


@dataclass(frozen=True)
class Organ:
    """One large connected piece of organ labels with its tumours and cysts, in a box of the label map."""

    grid: VoxelGrid
    values: np.ndarray  # label values of all voxels of the box (z, y, x)
    mask: np.ndarray  # bool: the organ
    present: list[int]  # label values of the organ that occur in it
    names: list[str]  # and what they are called
    named_sides: set[Side]  # what these say
    volume_ml: float
    centre_x_mm: float  # LPS

    def side_of(self, midline_x_mm: float) -> Side:
        return "left" if self.centre_x_mm > midline_x_mm else "right"

    @property
    def title(self) -> str:
        return f"the organ (label {listed(self.names)})"


def find_organs(labels: LabelMap, organ: Sequence[int] | None = None) -> list[Organ]:
    """Large connected pieces of organ, tumours and cysts, from right to left.

    Islands belong to none, and neither does a tumour apart from every kidney. Two values that touch are one
    piece: cortex and medulla, or kidney and cyst, are one organ.

    Args:
        labels: what is labelled; tumours and cysts are known by their tissue.
        organ: values that together are the organ; None: those of a kidney by name, or where nothing has a name all but
            tumours, cysts and vessels.

    Raises:
        PatientError: no label is an organ's.
    """
    own = _organ_values(labels, organ)
    grown = [value for value in labels.of_tissues(*LESIONS) if value not in own]
    wanted = np.isin(labels.values, own + grown)
    box = box_of(wanted)
    if box is None:
        raise PatientError(f"the labels hold no voxel of an organ: {labels.listed()}; choose other labels")
    part = box[::-1]
    parts, count = ndimage.label(wanted[part])
    volumes = np.bincount(parts.ravel(), minlength=count + 1) * labels.grid.voxel_ml
    of_organ = [int(n) for n in np.unique(parts[np.isin(labels.values[part], own)]) if n]
    large = [n for n in of_organ if volumes[n] >= ORGAN_FROM_ML] or [max(of_organ, key=lambda n: volumes[n])]
    masks = [_with_touching(parts, n, of_organ) for n in large]
    pieces = [_piece(labels, labels.grid.part(box), labels.values[part], mask, own) for mask in masks]
    return sorted(pieces, key=lambda piece: piece.centre_x_mm)


def _with_touching(parts: np.ndarray, n: int, of_organ: list[int]) -> np.ndarray:
    """Part n, with tumours and cysts that touch it by edges or corners alone, and the voxels that bridge them.

    A surface needs a common face, or what hangs by a corner falls off it.
    """
    mask = parts == n
    around = ndimage.binary_dilation(mask, CORNERS)
    for other in np.unique(parts[around & ~mask]).tolist():
        if other and other not in of_organ:
            grown = parts == other
            mask |= grown | (around & ndimage.binary_dilation(grown, CORNERS) & (parts == 0))
    return mask


def _organ_values(labels: LabelMap, organ: Sequence[int] | None) -> list[int]:
    if organ is not None:
        return list(organ)
    named = any(segment.name or segment.tissue for segment in labels.segments.values())
    own = labels.of_tissues(*PARENCHYMA)
    if not own and all(not s.name for s in labels.segments.values()):
        own = labels.of_tissues(None)
    if own:
        return own
    if named and labels.of_tissues(None):
        raise PatientError(
            f"no label says that it is a kidney: {labels.listed()}; name the kidney's with --organ"
        )
    raise PatientError(
        f"the labels hold no organ, but {labels.listed()}; expected a kidney's too; choose labels with both"
    )


def _piece(labels: LabelMap, grid: VoxelGrid, values: np.ndarray, mask: np.ndarray, own: list[int]) -> Organ:
    """The box around one piece, wide enough for what lies in its hollows."""
    box = cast(Box, box_of(mask))  # a piece has voxels
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
    """What a mask (z, y, x) encloses: its closing by a ball of HOLLOW_MM."""
    rim = [(int(n), int(n)) for n in np.ceil(HOLLOW_MM / spacing) + 1]
    grown = ndimage.distance_transform_edt(~np.pad(mask, rim), sampling=spacing) <= HOLLOW_MM
    closed = ndimage.distance_transform_edt(grown, sampling=spacing) > HOLLOW_MM
    return closed[tuple(slice(low, n - high) for (low, high), n in zip(rim, closed.shape, strict=True))]


def midline_x(grid: VoxelGrid, hounsfield: np.ndarray, low_z_mm: float, high_z_mm: float) -> float | None:
    """LPS x [mm] of the middle of the body between two heights; None where the CT shows no body's width.

    The centroid of the body, not the middle of its box: arms and table edges reach far but weigh little.
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
    """The piece on the wanted side; with no body around it, the user's word or the label's name stands for the midline.

    Raises PatientError: there is none, there are several, or it is called by the other side's name.
    """
    ends = pieces[0].centre_x_mm, pieces[-1].centre_x_mm
    if midline is None and len(pieces) == 2 and ends[1] - ends[0] > KIDNEYS_APART_MM:
        midline = 0.5 * sum(ends)
    found = _named(pieces, midline)
    unsure = midline is None or abs(pieces[0].centre_x_mm - midline) < MIDLINE_MARGIN_MM
    if unsure and len(pieces) == 1:
        return pieces[0], _told(pieces[0], side, found)
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
        where = f" on the {side}" if side and midline is not None else ""
        raise PatientError(
            f"{len(chosen)} organs are labelled{where}, expected one, found: {found}; give {advice} the label of one; labels that "
            "touch are taken together, and a label in two pieces has an empty slice"
        )
    lies: Side = chosen[0].side_of(midline)
    if chosen[0].named_sides == {"right" if lies == "left" else "left"}:
        raise PatientError(
            f"{chosen[0].title} lies on the patient's {lies}, which its name denies; expected both to agree; the labels or "
            "the CT may be mirrored: check the export"
        )
    return chosen[0], lies


def _told(piece: Organ, side: Side | None, found: str) -> Side:
    """The side of the only organ where the CT does not show it."""
    named = next(iter(piece.named_sides)) if len(piece.named_sides) == 1 else None
    if side and named and side != named:
        raise PatientError(f"{piece.title} is called by the other side's name than --side {side}; check both")
    told = side or named
    if told is None:
        raise PatientError(
            f"the CT does not show on which side of the body the organ lies ({found}): expected the "
            "body's whole width and an organ off its midline; give --side left or --side right"
        )
    return told


def _named(pieces: list[Organ], midline: float | None) -> str:
    return "; ".join(
        f"label {'+'.join(p.names[:6])}{'+...' * (len(p.names) > 6)}, "
        + ("" if midline is None else f"{p.side_of(midline)}, ")
        + f"{p.volume_ml:.1f} ml"
        for p in pieces
    )


def check_volume(organ: Organ) -> None:
    """Refuse what has no organ's volume. Raises PatientError."""
    least, most = PLAUSIBLE_ORGAN_ML
    if not least <= organ.volume_ml <= most:
        raise PatientError(
            f"{organ.title} has {organ.volume_ml:.1f} ml: expected {least:g} to {most:g} ml; choose the organ's "
            "label values with --organ"
        )
