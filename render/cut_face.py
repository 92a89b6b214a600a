"""The section of the organ on the image plane, filled with the colours of what it cuts.

The scene is a parameter: graphics_scene.py or software_scene.py. Lengths in mm.
"""

from dataclasses import dataclass

import numpy as np

from render.surface_shading import DrawnMesh, ShadedSurface
from render.transducer_shape import grid_triangles
from sim.fields import array_of

CELLS = 160
FLESH = (0.78, 0.50, 0.44)
# Coverage of a cell at which the border is drawn, and the sharpness of the border.
BORDER, SHARPER = 0.25, 3.0
# At a smaller angle between view and cut (its sine) the half that is removed does not change.
EDGE_ON = 0.2


def side_of_eye(pose: np.ndarray, eye: np.ndarray, before: float) -> float:
    """The side of the image plane of a pose (4, 4) that the eye is on, 1 or -1; edge on, the side ``before``
    (0: none).
    """
    toward = (eye - pose[:3, 3]) / np.linalg.norm(eye - pose[:3, 3])
    sine = float(toward @ pose[:3, 1])
    return before if before and abs(sine) < EDGE_ON else float(np.copysign(1.0, sine))


def oriented_section(vertices: np.ndarray, faces: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """The section of a closed surface (n, 3), (m, 3) with the image plane of a pose (4, 4): segments (k, 2,
    2) along the pose's x and z, all in the same sense around the inside.
    """
    local = (vertices - pose[:3, 3]) @ pose[:3, :3]
    below = local[:, 1] < 0
    cut = faces[below[faces].any(axis=1) & ~below[faces].all(axis=1)]
    start, end = local[cut], local[np.roll(cut, -1, axis=1)]
    share = start[..., 1] / np.where(start[..., 1] == end[..., 1], 1.0, start[..., 1] - end[..., 1])
    crossing = (start + share[..., None] * (end - start))[..., [0, 2]]
    down = ~below[cut] & below[np.roll(cut, -1, axis=1)]
    up = below[cut] & ~below[np.roll(cut, -1, axis=1)]
    return np.stack([crossing[down], crossing[up]], axis=1)


@dataclass(frozen=True)
class Raster:
    """Square cells of a plane: the centre (2,) of the first one, and their width."""

    low: np.ndarray
    width: float
    count: int

    @classmethod
    def around(cls, segments: list[np.ndarray], count: int) -> "Raster":
        """Cells, ``count`` along each side, that contain segments (k, 2, 2)."""
        points = np.concatenate([*segments, np.zeros((1, 2, 2))]).reshape(-1, 2)
        low, high = points.min(axis=0), points.max(axis=0)
        # Two more cells at each side: the outermost are empty.
        width = max(float((high - low).max()) / (count - 5), 1e-3)
        return cls(low - 2 * width, width, count)

    def places(self) -> np.ndarray:
        """The centres (count * count, 2) of the cells, row by row."""
        along = self.width * np.arange(self.count)
        return self.low + np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)

    def covered(self, segments: np.ndarray) -> np.ndarray:
        """The covered fraction of each cell inside segments (k, 2, 2) of one sense, shape (count, count), by
        rows.
        """
        start, end = np.moveaxis((segments - self.low) / self.width, 1, 0)
        low, high = np.sort(np.stack([start[:, 1], end[:, 1]]), axis=0)
        first = np.ceil(low).astype(int)
        times = np.maximum(np.ceil(high).astype(int) - first, 0)
        which = np.repeat(np.arange(len(segments)), times)
        row = first[which] + np.arange(len(which)) - np.repeat(np.cumsum(times) - times, times)
        run = end[which] - start[which]
        at = start[which, 0] + (row - start[which, 1]) / run[:, 1] * run[:, 0]
        # Scan conversion: along a row, a segment that goes up enters the surface, one that goes down leaves
        # it, or the reverse.
        sense, column = np.sign(run[:, 1]), np.floor(at + 0.5).astype(int)
        change = np.zeros((self.count, self.count + 1))
        part = column + 0.5 - at
        np.add.at(change, (row, column), sense * part)
        np.add.at(change, (row, column + 1), sense * (1 - part))
        inside = np.clip(np.abs(np.cumsum(change, axis=1)[:, :-1]), 0.0, 1.0)
        # Rows are sampled at their centres: smooth the steps between them.
        inside[1:-1] = inside[:-2] / 4 + inside[1:-1] / 2 + inside[2:] / 4
        return inside


class CutFace:
    """Fields of the drawn section."""

    def __init__(self) -> None:
        self._mesh = DrawnMesh(CELLS**2, channels=4)
        self._quads = grid_triangles(CELLS, CELLS)

    def draw(
        self, scene, organ: ShadedSurface, inner: list[ShadedSurface], pose: np.ndarray, key: np.ndarray
    ) -> None:
        """Draw the section on the image plane of a pose (4, 4) into a scene, evenly lit by a light at
        ``key`` (3,).
        """
        cuts = [
            oriented_section(array_of(surface.vertices), surface.faces, pose) for surface in (organ, *inner)
        ]
        raster = Raster.around(cuts, CELLS)
        covered = [raster.covered(cut).reshape(-1, 1) for cut in cuts]
        places = raster.places()
        points = pose[:3, 3] + places @ pose[:3, [0, 2]].T
        colour = np.tile(FLESH, (CELLS**2, 1))
        for share, surface in zip(covered[1:], inner, strict=True):
            here = share[:, 0] > 0
            colour[here] += share[here] * (surface.base_near(points[here]) - colour[here])
        most = np.max(covered, axis=0)
        toward = key - points.mean(axis=0)
        normals = np.tile(toward / np.linalg.norm(toward), (len(points), 1))
        # Not clamped: blending clamps each pixel.
        opacity = 0.5 + SHARPER * (most - BORDER)
        shown = self._quads[(opacity[self._quads] > 0).any(axis=(1, 2))]
        if len(shown):
            self._mesh.draw(scene, shown.reshape(-1), points, normals, np.hstack([colour, opacity]))
