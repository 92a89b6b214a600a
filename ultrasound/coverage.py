"""What of the organ has been in the picture: its tissue by where it was at rest, looked at through the deformed body.

A place counts as seen where the picture's lines went through it from elements that touched the organ. Shadows are not asked for.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
import trimesh
from scipy.ndimage import distance_transform_edt, label, map_coordinates

from sim.distance_grid import distance_grid
from sim.mesh_distance import signed_distance
from ultrasound.probe import Probe

VOXEL_MM = 1.5
# Distances from the organ are known so far around it.
REACH_MM = 6.0
# Places of a picture that are asked where they were at rest, along each side.
GRID_POINTS = 96
# To so much of its length at rest tissue may be squeezed and still leave no voxel between two places.
SQUEEZED = 0.7
# Smaller gaps than this are of the voxels [ml].
LEAST_GAP_ML = 0.05


@dataclass(frozen=True)
class Gap:
    """A coherent part of a target that was not seen: how large, and how thick at most."""

    volume_ml: float
    thickness_mm: float


class Coverage:
    """``seen`` (nx, ny, nz): voxels of the resting organ and around it that were in the picture; ``targets`` the same for each target.

    ``organ`` and ``tumour`` are closed surfaces at rest [mm]; ``margin_mm`` is how much of the organ around the tumour must be seen.
    """

    def __init__(
        self, organ: trimesh.Trimesh, tumour: trimesh.Trimesh | None = None, margin_mm: float = 5.0
    ) -> None:
        self.distance, self.origin_mm = distance_grid(organ.vertices, organ.faces, VOXEL_MM, REACH_MM)
        self.targets = {"organ": self.distance < 0}
        if tumour is not None:
            around = self._around(tumour, margin_mm)
            self.targets["tumour"] = around < 0
            self.targets["margin"] = (around < margin_mm) & ((self.distance < 0) | (around < 0))
        self.seen = np.zeros(self.distance.shape, bool)

    def _around(self, tumour: trimesh.Trimesh, margin_mm: float) -> np.ndarray:
        """Signed distances [mm] of the voxels near a tumour, and far ones of all others."""
        around = np.full(self.distance.shape, np.inf)
        low, high = self._indices(tumour.bounds + np.array([[-margin_mm], [margin_mm]]))
        low = np.maximum(np.floor(low).astype(int), 0)
        high = np.minimum(np.ceil(high).astype(int) + 1, self.distance.shape)
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        places = self.origin_mm + VOXEL_MM * (np.indices(high - low).reshape(3, -1).T + low)
        around[box] = signed_distance(tumour.vertices, tumour.faces, places)[0].reshape(high - low)
        return around

    def _indices(self, places_mm: np.ndarray) -> np.ndarray:
        return (places_mm - self.origin_mm) / VOXEL_MM

    def clear(self) -> None:
        """Nothing was seen yet."""
        self.seen[:] = False

    def add(self, rest_mm: np.ndarray, probe: Probe, gap_mm: float | None) -> np.ndarray:
        """Add what a picture shows; which of its lines touch.

        ``rest_mm`` (n, n, 3) is where the tissue was at rest at places evenly over the picture (``PlaneInTissue.rest_grid``). Lines
        whose element is nearer to the organ than ``gap_mm`` touch; without it, all.
        """
        count = len(rest_mm)
        lines, in_picture = _lines_of(probe, count)
        touches = np.ones(probe.number_of_scanlines, bool)
        if gap_mm is not None:
            touches = self._distance_at(rest_mm[_elements_of(probe, count)]) <= gap_mm
        shown = np.flatnonzero(in_picture & touches[lines])
        # One axis after the other, in voxels.
        at = ((rest_mm.reshape(-1, 3) - self.origin_mm) / VOXEL_MM).astype(np.float32).T.copy()
        near = np.ones(len(shown), bool)
        for along, last in zip(at, np.array(self.seen.shape) - 1, strict=True):
            near &= np.abs(along[shown] - last / 2) < (last + 1) / 2 + probe.elevation_width_mm / VOXEL_MM
        for part in _parts(at, shown[near], probe, count):
            index = np.rint(part).astype(np.int32)
            x, y, z = index[:, _within(index, self.seen.shape)]
            self.seen[x, y, z] = True
        return touches

    def _distance_at(self, places_mm: np.ndarray) -> np.ndarray:
        at = self._indices(places_mm).T
        return map_coordinates(self.distance, at, order=1, mode="constant", cval=np.inf)

    def fraction(self, target: str) -> float:
        """How much of a target was seen, 0 to 1; not a number without that target."""
        mask = self.targets.get(target)
        return float(self.seen[mask].mean()) if mask is not None and mask.any() else float("nan")

    def voxel_centres(self, target: str) -> np.ndarray:
        """The middles (n, 3) of a target's voxels [mm]."""
        return self.origin_mm + VOXEL_MM * np.argwhere(self.targets[target])

    def gaps(self, target: str) -> list[Gap]:
        """What of a target was not seen, the largest part first."""
        missing = self.targets[target] & ~self.seen
        parts, count = label(missing)
        thickness = 2 * VOXEL_MM * distance_transform_edt(missing)
        found = []
        for part in range(1, count + 1):
            mask = parts == part
            volume = float(mask.sum()) * VOXEL_MM**3 / 1000
            if volume >= LEAST_GAP_ML:
                found.append(Gap(volume, float(thickness[mask].max())))
        return sorted(found, key=lambda gap: -gap.volume_ml)

    def is_seen(self, places_mm: np.ndarray) -> np.ndarray:
        """Whether the tissue at places (n, 3) at rest was seen."""
        index = np.clip(np.rint(self._indices(places_mm)).astype(int), 0, np.array(self.seen.shape) - 1)
        return self.seen[tuple(index.T)]


@lru_cache(maxsize=4)
def _lines_of(probe: Probe, places: int) -> tuple[np.ndarray, np.ndarray]:
    """Which line each place (n, n) of a picture is on, and whether it is in the picture."""
    width, depth, above = probe.extent_mm
    share = np.linspace(0.0, 1.0, places)
    line, along = probe.beam_coordinates(*np.meshgrid(width * (share - 0.5), depth * share - above))
    last = probe.number_of_scanlines - 1
    # Of the places on the two edges one counts, so that all that places stand for is as wide as the picture.
    inside = (line >= -0.5) & (line < last + 0.5) & (along >= 0) & (along <= probe.depth_mm)
    return np.clip(np.rint(line).astype(int), 0, last), inside


def _elements_of(probe: Probe, places: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the place of a picture nearest to each element."""
    width, depth, above = probe.extent_mm
    share = (probe.elements() + [width / 2, above]) / [width, depth]
    column, row = np.clip(np.rint(share * (places - 1)).astype(int), 0, places - 1).T
    return row, column


def _within(index: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Which indices (3, n) are of a grid."""
    x, y, z = index
    return (x >= 0) & (y >= 0) & (z >= 0) & (x < shape[0]) & (y < shape[1]) & (z < shape[2])


def _parts(at: np.ndarray, shown: np.ndarray, probe: Probe, count: int) -> Iterator[np.ndarray]:
    """Middles (3, n) of the parts of what places of a picture stand for, its thickness too, no larger than voxels are.

    ``at`` (3, count * count) are all places at rest [voxels], ``shown`` those that count.
    """
    width, depth, _ = probe.extent_mm
    row, column = np.divmod(shown, count)
    first, last = count * np.maximum(row - 1, 0), count * np.minimum(row + 1, count - 1)
    down = (at[:, last + column] - at[:, first + column]) * (count / (last - first)).astype(np.float32)
    first, last = np.maximum(column - 1, 0), np.minimum(column + 1, count - 1)
    across = (at[:, count * row + last] - at[:, count * row + first]) / (last - first).astype(np.float32)
    normal = np.stack([across[k - 2] * down[k - 1] - across[k - 1] * down[k - 2] for k in range(3)])
    normal *= probe.elevation_width_mm / VOXEL_MM / np.maximum(np.sqrt((normal**2).sum(axis=0)), 1e-9)
    spacing = np.array([width, depth]) / (count - 1) / SQUEEZED
    sizes = [*spacing, probe.elevation_width_mm]
    middle = at[:, shown]
    for shares in product(*(_middles(int(np.ceil(size / VOXEL_MM))) for size in sizes)):
        place = middle
        for share, along in zip(shares, (across, down, normal), strict=True):
            place = place + share * along if share else place
        yield place


def _middles(count: int) -> list[float]:
    """Of so many equal parts of a length of 1 about 0."""
    return [(k + 0.5) / count - 0.5 for k in range(count)]
