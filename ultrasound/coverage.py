"""Coverage: which tissue of the organ has been imaged, by its rest position.

A voxel counts as imaged where a scanline of an element in contact passed through it. Acoustic shadows are not
considered.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
import trimesh
from scipy.ndimage import distance_transform_edt, label, map_coordinates

from sim.signed_distance import distance_grid, signed_distance
from sim.stored_arrays import stored
from ultrasound.probe import Probe

VOXEL_MM = 1.5
# The voxels cover the organ and this much around it.
REACH_MM = 6.0
# Points along each side of an image whose rest positions are sampled.
GRID_POINTS = 96
# Least compressed length, as a fraction of the rest length, at which no voxel between two points is missed.
MIN_STRETCH = 0.7
# Smaller gaps come from the voxel size.
MIN_GAP_ML = 0.05


@dataclass(frozen=True)
class Gap:
    """A connected part of a target that was not imaged: its volume and greatest thickness."""

    volume_ml: float
    thickness_mm: float


class Coverage:
    """``seen`` (nx, ny, nz): voxels of the organ at rest, and around it, that were imaged; ``targets``: those
    of each target.

    ``organ`` and ``tumour`` are closed surfaces at rest [mm]; ``margin_mm`` is the width of the margin around
    the tumour.
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
        """Signed distances [mm] from the tumour: of the voxels near it, infinity elsewhere."""
        around = np.full(self.distance.shape, np.inf)
        low, high = self._indices(tumour.bounds + np.array([[-margin_mm], [margin_mm]]))
        low = np.maximum(np.floor(low).astype(int), 0)
        high = np.minimum(np.ceil(high).astype(int) + 1, self.distance.shape)
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        points = self.origin_mm + VOXEL_MM * (np.indices(high - low).reshape(3, -1).T + low)
        distance = stored(signed_distance, tumour.vertices, tumour.faces, points)[0]
        around[box] = distance.reshape(high - low)
        return around

    def _indices(self, points_mm: np.ndarray) -> np.ndarray:
        return (points_mm - self.origin_mm) / VOXEL_MM

    def clear(self) -> None:
        """Reset to nothing imaged."""
        self.seen[:] = False

    def add(self, rest_mm: np.ndarray, probe: Probe, gap_mm: float | None) -> np.ndarray:
        """Add an image; return which of its scanlines are in contact.

        ``rest_mm`` (n, n, 3) are rest positions at points evenly over the image
        (``PlaneInTissue.rest_grid``). A scanline is in contact where the organ is in front of its element,
        nearer than ``gap_mm`` (as ``Propagation``); without it, all are.
        """
        count = len(rest_mm)
        lines, in_image = _scanlines_of(probe, count)
        contact = np.ones(probe.number_of_scanlines, bool)
        if gap_mm is not None:
            width, depth, above = probe.extent_mm
            ends = probe.elements() + gap_mm * probe.face_normals()
            share = (ends + [width / 2, above]) / [width, depth]
            # The grid point nearest to the end of each gap.
            column, row = np.clip(np.rint(share * (count - 1)).astype(int), 0, count - 1).T
            places = self._indices(rest_mm[row, column]).T
            contact = map_coordinates(self.distance, places, order=1, mode="constant", cval=np.inf) <= 0
        shown = np.flatnonzero(in_image & contact[lines])
        # In voxels, axis by axis.
        at = ((rest_mm.reshape(-1, 3) - self.origin_mm) / VOXEL_MM).astype(np.float32).T.copy()
        near = np.ones(len(shown), bool)
        for along, last in zip(at, np.array(self.seen.shape) - 1, strict=True):
            near &= np.abs(along[shown] - last / 2) < (last + 1) / 2 + probe.elevation_width_mm / VOXEL_MM
        for part in _subdivisions(at, shown[near], probe, count):
            index = np.rint(part).astype(np.int32)
            within = ((index >= 0) & (index < np.array(self.seen.shape)[:, None])).all(axis=0)
            x, y, z = index[:, within]
            self.seen[x, y, z] = True
        return contact

    def fraction(self, target: str) -> float:
        """The imaged fraction of a target, 0 to 1; NaN without that target."""
        mask = self.targets.get(target)
        return float(self.seen[mask].mean()) if mask is not None and mask.any() else float("nan")

    def voxel_centres(self, target: str) -> np.ndarray:
        """The centres (n, 3) of a target's voxels [mm]."""
        return self.origin_mm + VOXEL_MM * np.argwhere(self.targets[target])

    def gaps(self, target: str) -> list[Gap]:
        """The parts of a target that were not imaged, the largest first."""
        missing = self.targets[target] & ~self.seen
        parts, count = label(missing)
        thickness = 2 * VOXEL_MM * distance_transform_edt(missing)
        gaps = []
        for part in range(1, count + 1):
            mask = parts == part
            volume = float(mask.sum()) * VOXEL_MM**3 / 1000
            if volume >= MIN_GAP_ML:
                gaps.append(Gap(volume, float(thickness[mask].max())))
        return sorted(gaps, key=lambda gap: -gap.volume_ml)

    def is_seen(self, points_mm: np.ndarray) -> np.ndarray:
        """Whether the tissue at rest positions (n, 3) was imaged."""
        index = np.clip(np.rint(self._indices(points_mm)).astype(int), 0, np.array(self.seen.shape) - 1)
        return self.seen[tuple(index.T)]


@lru_cache(maxsize=4)
def _scanlines_of(probe: Probe, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The scanline of each of count x count points of an image, and whether the point is in the sector."""
    width, depth, above = probe.extent_mm
    share = np.linspace(0.0, 1.0, count)
    line, along = probe.beam_coordinates(*np.meshgrid(width * (share - 0.5), depth * share - above))
    last = probe.number_of_scanlines - 1
    # Only one of the two edges counts, so that the points together are as wide as the image.
    inside = (line >= -0.5) & (line < last + 0.5) & (along >= 0) & (along <= probe.depth_mm)
    return np.clip(np.rint(line).astype(int), 0, last), inside


def _subdivisions(at: np.ndarray, shown: np.ndarray, probe: Probe, count: int) -> Iterator[np.ndarray]:
    """Yield centres (3, n) of the parts, no larger than a voxel, into which the box of tissue around each
    grid point is divided.

    ``at`` (3, count * count) are the rest positions of all points [voxels], ``shown`` the points to use.
    """
    width, depth, _ = probe.extent_mm
    row, column = np.divmod(shown, count)
    first, last = count * np.maximum(row - 1, 0), count * np.minimum(row + 1, count - 1)
    down = (at[:, last + column] - at[:, first + column]) * (count / (last - first)).astype(np.float32)
    first, last = np.maximum(column - 1, 0), np.minimum(column + 1, count - 1)
    across = (at[:, count * row + last] - at[:, count * row + first]) / (last - first).astype(np.float32)
    normal = np.stack([across[k - 2] * down[k - 1] - across[k - 1] * down[k - 2] for k in range(3)])
    normal *= probe.elevation_width_mm / VOXEL_MM / np.maximum(np.sqrt((normal**2).sum(axis=0)), 1e-9)
    spacing = np.array([width, depth]) / (count - 1) / MIN_STRETCH
    sizes = [*spacing, probe.elevation_width_mm]
    middle = at[:, shown]
    counts = (int(np.ceil(size / VOXEL_MM)) for size in sizes)
    # The centres of equal parts of a unit length about 0.
    for shares in product(*([(k + 0.5) / n - 0.5 for k in range(n)] for n in counts)):
        point = middle
        for share, along in zip(shares, (across, down, normal), strict=True):
            point = point + share * along if share else point
        yield point
