"""The face of a cut along the image plane: what of each surface lies on it, in its colour.

The scene is a parameter, so that window.py alone imports the user interface. Lengths in mm.
"""

from dataclasses import dataclass

import numpy as np

from render.surface_shading import ShadedSurface
from sim.fields import array_of, fields_of, fill

CELLS = 160
FLESH = (0.78, 0.50, 0.44)
# So much of a cell is covered at the face's border, which is so much sharper than a cell: what is left of cells there hides no organ.
BORDER, SHARPER = 0.25, 3.0
# An organ seen so nearly along the cut (sine of the angle) keeps the half that it kept before.
EDGE_ON = 0.2


def side_of_eye(pose: np.ndarray, eye: np.ndarray, before: float) -> float:
    """The side of the image plane of a pose (4, 4) that the eye is on, 1 or -1; seen edge on, the one of before, 0 where none was."""
    toward = (eye - pose[:3, 3]) / np.linalg.norm(eye - pose[:3, 3])
    sine = float(toward @ pose[:3, 1])
    return before if before and abs(sine) < EDGE_ON else float(np.copysign(1.0, sine))


def section(vertices: np.ndarray, faces: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Where the image plane of a pose (4, 4) cuts a closed surface (n, 3), (m, 3): segments (k, 2, 2) along the pose's x and z,
    all of which go round what is inside in the same sense."""
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
    """Square cells of a plane: the first one's middle (2,) and their width."""

    low: np.ndarray
    width: float
    count: int

    @classmethod
    def around(cls, segments: list[np.ndarray], count: int) -> "Raster":
        """The cells, ``count`` along each side, that hold segments (k, 2, 2)."""
        points = np.concatenate([*segments, np.zeros((1, 2, 2))]).reshape(-1, 2)
        low, high = points.min(axis=0), points.max(axis=0)
        # Two cells more at each side: the outermost are empty.
        width = max(float((high - low).max()) / (count - 5), 1e-3)
        return cls(low - 2 * width, width, count)

    def places(self) -> np.ndarray:
        """The cells' middles (count * count, 2), row by row."""
        along = self.width * np.arange(self.count)
        return self.low + np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)

    def covered(self, segments: np.ndarray) -> np.ndarray:
        """How much of each cell lies inside segments (k, 2, 2) of one sense, 0 to 1, shape (count, count), by rows."""
        start, end = np.moveaxis((segments - self.low) / self.width, 1, 0)
        low, high = np.sort(np.stack([start[:, 1], end[:, 1]]), axis=0)
        first = np.ceil(low).astype(int)
        times = np.maximum(np.ceil(high).astype(int) - first, 0)
        which = np.repeat(np.arange(len(segments)), times)
        row = first[which] + np.arange(len(which)) - np.repeat(np.cumsum(times) - times, times)
        run = end[which] - start[which]
        at = start[which, 0] + (row - start[which, 1]) / run[:, 1] * run[:, 0]
        # Right of where a segment goes up a row lies one side of the surface, right of where one goes down the other.
        sense, column = np.sign(run[:, 1]), np.floor(at + 0.5).astype(int)
        change = np.zeros((self.count, self.count + 1))
        part = column + 0.5 - at
        np.add.at(change, (row, column), sense * part)
        np.add.at(change, (row, column + 1), sense * (1 - part))
        inside = np.clip(np.abs(np.cumsum(change, axis=1)[:, :-1]), 0.0, 1.0)
        # Rows are looked at along their middle: their neighbours make a slope of a step.
        inside[1:-1] = inside[:-2] / 4 + inside[1:-1] / 2 + inside[2:] / 4
        return inside


class CutFace:
    """The fields of what is drawn."""

    def __init__(self) -> None:
        count = CELLS**2
        self._points, self._normals, self._colours = fields_of(
            *np.ones((2, count, 3)), np.zeros((count, 4)), within=1
        )
        first = (np.arange(CELLS - 1)[:, None] * CELLS + np.arange(CELLS - 1)).reshape(-1, 1)
        self._quads = (first + [0, CELLS, 1, 1, CELLS, CELLS + 1]).astype(np.int32)

    def draw(
        self, scene, organ: ShadedSurface, inner: list[ShadedSurface], pose: np.ndarray, key: np.ndarray
    ) -> None:
        """Hand the face on the image plane of a pose (4, 4) to a scene, evenly lit by a light at ``key`` (3,)."""
        cuts = [section(array_of(each.vertices), each.faces, pose) for each in (organ, *inner)]
        raster = Raster.around(cuts, CELLS)
        covered = [raster.covered(each).reshape(-1, 1) for each in cuts]
        colour = np.tile(FLESH, (CELLS**2, 1))
        for share, each in zip(covered[1:], inner, strict=True):
            colour += share * (np.array(each.base) - colour)
        most = np.max(covered, axis=0)
        places = raster.places()
        points = pose[:3, 3] + places @ pose[:3, [0, 2]].T
        toward = key - points.mean(axis=0)
        normals = np.tile(toward / np.linalg.norm(toward), (len(points), 1))
        fill((self._points, points), (self._normals, normals))
        # Not clamped: blending clamps each pixel.
        opacity = 0.5 + SHARPER * (most - BORDER)
        fill((self._colours, np.hstack([colour, opacity])))
        shown = self._quads[(opacity[self._quads] > 0).any(axis=(1, 2))]
        if len(shown):
            scene.mesh(self._points, shown.reshape(-1), self._normals, per_vertex_color=self._colours)
