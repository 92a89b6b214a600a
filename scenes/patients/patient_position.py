"""How the patient lay in the CT: by the user, by DICOM's PatientPosition (0018,5100), or assumed; and what
the CT itself shows.

The organ at rest in the CT lies under the CT's gravity. Patient axes do not change with the position.
"""

import re
from typing import Literal, get_args

import numpy as np
import SimpleITK as sitk
from scipy import ndimage

from scenes.section import Vector3
from scenes.volumes.lazy_volume import AIR_HU
from scenes.volumes.voxel_grid import VoxelGrid

Position = Literal["supine", "prone", "left-decubitus", "right-decubitus"]
POSITIONS: tuple[Position, ...] = get_args(Position)

# Its direction, LPS. In a left decubitus position the left side is down (DICOM PS3.3 C.7.3.1.1.2).
GRAVITY: dict[Position, Vector3] = {
    "supine": (0.0, 1.0, 0.0),
    "prone": (0.0, -1.0, 0.0),
    "left-decubitus": (1.0, 0.0, 0.0),
    "right-decubitus": (-1.0, 0.0, 0.0),
}
LYING: dict[Position, str] = {
    "supine": "lying supine",
    "prone": "lying prone",
    "left-decubitus": "lying on the left side (left decubitus)",
    "right-decubitus": "lying on the right side (right decubitus)",
}
# The part of the body that enters the scanner first, then the position.
TERM = re.compile("(?:HF|FF|LF|RF|AF|PF)(S|P|DL|DR)")
OF_TERM: dict[str, Position] = {
    "S": "supine",
    "P": "prone",
    "DL": "left-decubitus",
    "DR": "right-decubitus",
}

# The grid on which a CT is searched: millimetres along LPS.
GRID_MM = np.array([2.5, 2.5, 10.0])
BODY_ABOVE_HU, GAS_BELOW_HU, LUNG_ABOVE_HU, FLUID_ABOVE_HU = -300, -600, -900, -200
# Shells and cushions of a table.
TABLE_ABOVE_HU = -500
# A table is thinner than twice this, and an arm is not.
THIN_MM = 8.0
# Share of the body's shadow in which a table must be seen; a level's extent along a slice, and the area of
# all levels.
LEAST_TABLE, LEVEL_MM, LEAST_LEVELS_CM2 = 0.3, 25.0, 3.0
# On the lower side there is so many times as much of either as on any other side.
CLEARLY = 2.0
# Voxels from gas to the fluid under it; the one between is partly of both.
LEVEL_DEPTH = 2


def position_of(term: str, of_user: Position | None) -> tuple[Position, tuple[str, ...]]:
    """The patient's position: the user's, else that of DICOM's PatientPosition, else supine; and notes of
    what was chosen.

    ``term`` is DICOM's, such as HFS or FFDL; it may be empty, or none that DICOM has.
    """
    match = TERM.fullmatch(term)
    of_header = OF_TERM[match[1]] if match else None
    if of_user and of_header and of_user != of_header:
        return of_user, (f"the patient is {LYING[of_user]}, as given; the CT's header has {term}",)
    if of_user or of_header:
        return of_user or of_header or "supine", ()
    reason = "PatientPosition is not one of DICOM's" if term else "the CT has no PatientPosition"
    return "supine", (f"assumed supine, as {reason}: --position gives another",)


def position_warnings(ct: sitk.Image, position: Position) -> tuple[str, ...]:
    """A warning where the CT [HU], in its full width, shows clearly that the patient lay otherwise."""
    seen = seen_position(ct)
    if seen in (None, position):
        return ()
    return (
        f"the table, or the fluid levels in the bowel, are those of a patient {LYING[seen]}, but the "
        "organ is supported "
        f"as {LYING[position]}; compare check.png with the patient; if the CT is right, give --position "
        f"{seen}",
    )


def seen_position(ct: sitk.Image) -> Position | None:
    """The position in which a CT [HU] shows the patient: by the table under the body, and by fluid levels
    under gas in the bowel.

    None where it shows neither clearly, or where they contradict each other.
    """
    hounsfield = _along_patient_axes(ct)
    body = _body(hounsfield)
    positions = {
        _clear(_table_shares(hounsfield, body), LEAST_TABLE),
        _clear(_levels_cm2(hounsfield, body), LEAST_LEVELS_CM2),
    }
    positions.discard(None)
    return positions.pop() if len(positions) == 1 else None


def _along_patient_axes(ct: sitk.Image) -> np.ndarray:
    """HU (z, y, x) on a coarse grid along LPS that covers a CT; air outside it."""
    low, high = VoxelGrid.of(ct).bounds()
    size = np.maximum(1, np.ceil((high - low) / GRID_MM).astype(int) + 1)
    grid = VoxelGrid(tuple(size.tolist()), GRID_MM, low, np.eye(3))
    return grid.sampled(ct, sitk.sitkLinear, AIR_HU)


def _disc() -> np.ndarray:
    """A disc of THIN_MM in the plane of a slice (1, y, x)."""
    reach = int(THIN_MM / GRID_MM[0])
    y, x = np.ogrid[-reach : reach + 1, -reach : reach + 1]
    return (x**2 + y**2 <= reach**2)[None]


def _body(hounsfield: np.ndarray) -> np.ndarray:
    """The body without its cavities, table and covers (z, y, x)."""
    filled = ndimage.binary_fill_holes(hounsfield > BODY_ABOVE_HU, np.ones((1, 3, 3)))
    parts, count = ndimage.label(ndimage.binary_opening(filled, _disc()))
    return parts == 1 + np.argmax(np.bincount(parts.ravel(), minlength=count + 1)[1:]) if count else parts > 0


def _downwards(position: Position, *volumes: np.ndarray) -> list[np.ndarray]:
    """Volumes (z, y, x) turned so that gravity of a position is along the second axis."""
    x, y, _ = GRAVITY[position]
    turned = [volume.swapaxes(1, 2) if x else volume for volume in volumes]
    return [volume if x + y > 0 else volume[:, ::-1] for volume in turned]


def _table_shares(hounsfield: np.ndarray, body: np.ndarray) -> dict[Position, float]:
    """For each position, the share of the body's shadow in which something thin is under the body."""
    apart = (hounsfield > TABLE_ABOVE_HU) & ~ndimage.binary_dilation(body, _disc())
    if not apart.any():
        return dict.fromkeys(POSITIONS, 0.0)
    thick = ndimage.binary_dilation(ndimage.binary_opening(apart, _disc()), _disc())

    def share(position: Position) -> float:
        thin, above = _downwards(position, apart & ~thick, body)
        under = thin & np.logical_or.accumulate(above, axis=1)
        shadow = above.any(axis=1)
        return float((under.any(axis=1) & shadow).sum() / max(1, shadow.sum()))

    return {position: share(position) for position in POSITIONS}


def _levels_cm2(hounsfield: np.ndarray, body: np.ndarray) -> dict[Position, float]:
    """For each position, the area of flat, level surfaces of fluid under gas in the bowel [cm2]."""
    gas = (hounsfield < GAS_BELOW_HU) & ndimage.binary_erosion(body, _disc())
    if not gas.any():
        return dict.fromkeys(POSITIONS, 0.0)
    parts, count = ndimage.label(gas)
    numbers = np.arange(1, count + 1)
    is_bowel = np.append(False, np.asarray(ndimage.median(hounsfield, parts, numbers)) < LUNG_ABOVE_HU)
    gas &= is_bowel[parts]
    along = np.ones((1, 1, round(LEVEL_MM / GRID_MM[0])), bool)

    def area(position: Position) -> float:
        above, voxels = _downwards(position, gas, hounsfield)
        ends = above[:, :-1] & ~above[:, 1:]
        level = ends[:, : 1 - LEVEL_DEPTH] & (voxels[:, LEVEL_DEPTH:] > FLUID_ABOVE_HU)
        return float(ndimage.binary_opening(level, along).sum() * GRID_MM[0] * GRID_MM[2] / 100)

    return {position: area(position) for position in POSITIONS}


def _clear(evidence: dict[Position, float], least: float) -> Position | None:
    """The position with enough evidence, and clearly more than any other."""
    *_, second, best = sorted(evidence, key=lambda position: evidence[position])
    return best if evidence[best] >= max(least, CLEARLY * evidence[second]) else None
