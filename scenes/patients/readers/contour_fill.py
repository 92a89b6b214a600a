"""Fill the closed contours of one plane by the even-odd rule; contours that stand there twice count once."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

# A pixel whose centre is this near to a contour [pixels] is on it: files round coordinates.
ON_CONTOUR = 2e-4
# Two contours are copies where no square of this width [pixels] fits between them: no drawn wall is so thin.
COPY_PIXELS, SAMPLES = 0.5, 4
# Of the edges' crossings with rows and columns, so many are held at once.
MOST_CROSSINGS = 1_000_000


def fill(contours: Sequence[np.ndarray], shape: tuple[int, int]) -> np.ndarray:
    """Mask (rows, columns) of the pixels inside an odd number of contours, or on one of them.

    Contours that share an edge leave no slit between them, and neither does the channel from a contour to its hole (keyhole).

    Args:
        contours: corners (n, 2) of each: rows and columns [pixels].
        shape: rows and columns.
    """
    starts = np.concatenate(contours)
    ends = np.concatenate([np.roll(corners, -1, axis=0) for corners in contours])
    # One column more: a crossing beyond the last changes no pixel.
    crossings = np.zeros((shape[0], shape[1] + 1), bool)
    border = np.zeros(shape, bool)
    part = max(1, MOST_CROSSINGS // max(shape))
    for at in range(0, len(starts), part):
        start, end = starts[at : at + part], ends[at : at + part]
        _toggle_crossings(crossings, start, end)
        _mark_border(border, start, end)
        _mark_border(border.T, start[:, ::-1], end[:, ::-1])
    return np.logical_xor.accumulate(crossings, axis=1)[:, :-1] | border


def _toggle_crossings(crossings: np.ndarray, start: np.ndarray, end: np.ndarray) -> None:
    """Invert the first pixel at or beyond each crossing of an edge with a row; the row of an edge's greater end is the next edge's."""
    first = np.ceil(np.minimum(start[:, 0], end[:, 0]))
    last = np.ceil(np.maximum(start[:, 0], end[:, 0])) - 1
    rows, columns = _rows_of(start, end, first, last, len(crossings))
    columns = np.clip(np.ceil(columns), 0, crossings.shape[1] - 1).astype(int)
    places, count = np.unique(rows * crossings.shape[1] + columns, return_counts=True)
    crossings.reshape(-1)[places] ^= count % 2 == 1


def _mark_border(border: np.ndarray, start: np.ndarray, end: np.ndarray) -> None:
    """Mark the pixels whose centre is where an edge crosses their row."""
    first = np.ceil(np.minimum(start[:, 0], end[:, 0]) - ON_CONTOUR)
    last = np.floor(np.maximum(start[:, 0], end[:, 0]) + ON_CONTOUR)
    rows, columns = _rows_of(start, end, first, last, len(border))
    nearest = np.rint(columns)
    on = (np.abs(columns - nearest) <= ON_CONTOUR) & (nearest >= 0) & (nearest < border.shape[1])
    border[rows[on], nearest[on].astype(int)] = True


def _rows_of(
    start: np.ndarray, end: np.ndarray, first: np.ndarray, last: np.ndarray, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """The rows from ``first`` to ``last`` of each edge within a picture, and the column of the edge on each of them."""
    first = np.clip(first, 0, height).astype(int)
    count = np.maximum(np.clip(last, -1, height - 1).astype(int) - first + 1, 0)
    edge = np.repeat(np.arange(len(start)), count)
    rows = first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    rise = end[:, 0] - start[:, 0]
    slope = (end[:, 1] - start[:, 1]) / np.where(rise == 0, np.inf, rise)
    columns = start[edge, 1] + (rows - start[edge, 0]) * slope[edge]
    least, most = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    return rows, np.clip(columns, least[edge], most[edge])


def without_copies(contours: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The contours of a plane, corners (n, 2) [pixels], each once."""
    kept: list[np.ndarray] = []
    corners: list[np.ndarray] = []
    for contour in contours:
        box = np.concatenate([contour.min(axis=0), contour.max(axis=0)])
        near = np.abs(np.array(corners).reshape(-1, 4) - box).max(axis=1) <= 1
        if not any(_are_copies(kept[n], contour) for n in np.flatnonzero(near)):
            kept.append(contour)
            corners.append(box)
    return kept


def _are_copies(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether what only one of two contours encloses is nowhere as wide as COPY_PIXELS."""
    low = np.minimum(one.min(axis=0), other.min(axis=0))
    fine = [(contour - low) * SAMPLES for contour in (one, other)]
    size = np.ceil(np.max([contour.max(axis=0) for contour in fine], axis=0)).astype(int) + 1
    between = fill(fine, (int(size[0]), int(size[1])))
    width = int(COPY_PIXELS * SAMPLES) + 1
    return not ndimage.binary_erosion(between, np.ones((width, width))).any()
