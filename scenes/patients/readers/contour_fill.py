"""Fill the closed contours of one plane: nested ones alternate, crossing ones are united, and what stands
there twice counts once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array, csgraph

# A pixel whose centre is this near to a contour [pixels] is on it: files round coordinates.
ON_CONTOUR = 2e-4
# Two contours are copies where no square of this width [pixels] fits between them: no drawn wall is so thin.
COPY_PIXELS, SAMPLES = 0.5, 4
# Two contours of a solid are one, drawn twice, from this intersection over union on: 2 mm within a circle of
# 20 mm radius it is 0.8; of a hole with half of the section's area, wider than a kidney's sinus, 0.5.
LEAST_IOU = 0.7
# A contour with two rounds comes back to its start, within this share of its extent.
RETURN = 0.05
# Of the edges' crossings with rows and columns, so many are held at once.
MOST_CROSSINGS = 1_000_000


@dataclass(frozen=True)
class FilledPlane:
    """The section of a region with a plane."""

    inside: np.ndarray  # bool (rows, columns)
    copies: int  # contours, or second rounds of one, that were left out as they stand there twice
    differing: int  # so many of them differ by more than COPY_PIXELS
    united: int  # contours that cross others


def fill_plane(
    contours: Sequence[np.ndarray],
    shape: tuple[int, int],
    wall: np.ndarray | None = None,
    is_exclusive: bool = False,
) -> FilledPlane:
    """The pixels of a plane of ``shape`` (rows, columns) that are inside contours, or on one of them.

    By the even-odd rule, but for contours that cross: these are strokes of one body, unless ``is_exclusive``.
    Contours that share an edge leave no slit between them, and neither does the channel from a contour to its
    hole (keyhole).

    ``contours`` are the corners (n, 2) of each: rows and columns [pixels]. ``wall`` (rows, columns) is the
    least width [pixels] of the walls of a solid: what is nowhere as wide between two contours, or small
    beside what they share, is no wall but one contour drawn twice, and the larger one counts. None: any
    region.
    """
    rounds = [_first_round(corners) for corners in contours]
    kept, differing = _without_copies(rounds, None if is_exclusive else wall)
    strokes = [] if is_exclusive else _strokes(kept)
    inside, border = _filled(kept, shape)
    for stroke in strokes:
        members = [_filled([kept[n]], shape)[0] for n in stroke]
        inside ^= np.logical_xor.reduce(members) ^ np.logical_or.reduce(members)
    repeated = sum(len(once) < len(corners) for once, corners in zip(rounds, contours, strict=True))
    copies = len(rounds) - len(kept) + repeated
    return FilledPlane(inside | border, copies, differing, sum(map(len, strokes)))


def _filled(contours: Sequence[np.ndarray], shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the pixels inside an odd number of contours, and of those on one: these may be in either or
    both.
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
    return np.logical_xor.accumulate(crossings, axis=1)[:, :-1], border


def _toggle_crossings(crossings: np.ndarray, start: np.ndarray, end: np.ndarray) -> None:
    """Invert the first pixel at or beyond each crossing of an edge with a row; the row of an edge's
    greater end is the next edge's.
    """
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
    """The rows from ``first`` to ``last`` of each edge within a picture, and the column of the edge on
    each of them.
    """
    first = np.clip(first, 0, height).astype(int)
    count = np.maximum(np.clip(last, -1, height - 1).astype(int) - first + 1, 0)
    edge = np.repeat(np.arange(len(start)), count)
    rows = first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    rise = end[:, 0] - start[:, 0]
    slope = (end[:, 1] - start[:, 1]) / np.where(rise == 0, np.inf, rise)
    columns = start[edge, 1] + (rows - start[edge, 0]) * slope[edge]
    least, most = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    return rows, np.clip(columns, least[edge], most[edge])


def _first_round(contour: np.ndarray) -> np.ndarray:
    """A contour, or its first round where its corners go round twice: by the even-odd rule, it would be
    empty.
    """
    quarter = len(contour) // 4
    away = np.abs(contour - contour[0]).max(axis=1)
    at = quarter + int(np.argmin(away[quarter : len(contour) - quarter]))
    first, second = contour[:at], contour[at:]
    is_back = away[at] <= min(COPY_PIXELS, RETURN * np.ptp(contour, axis=0).max())
    if is_back and min(len(first), len(second)) >= 3 and _are_copies(first, second):
        return _first_round(first)
    return contour


def _without_copies(contours: Sequence[np.ndarray], wall: np.ndarray | None) -> tuple[list[np.ndarray], int]:
    """The contours of a plane without those that stand there twice, and how many of these are no exact
    copies; the largest remain.
    """
    areas = np.array([_area(corners) for corners in contours])
    order = np.argsort(-areas, kind="stable")
    contours, areas = [contours[n] for n in order], areas[order]
    boxes = _boxes(contours)
    kept, differing = [], 0
    for n, contour in enumerate(contours):
        off = np.abs(boxes[:n] - boxes[n]).max(axis=1)
        if any(_are_copies(contours[m], contour) for m in np.flatnonzero(off <= 2 * COPY_PIXELS)):
            continue
        if wall is not None:
            # The areas of contours that cross themselves are not exact.
            alike = (areas[n] >= 0.9 * LEAST_IOU * areas[:n]) | (off <= wall.max() + COPY_PIXELS)
            alike &= _overlap(boxes[:n], boxes[n])
            if any(_are_one(contours[m], contour, wall) for m in np.flatnonzero(alike)):
                differing += 1
                continue
        kept.append(contour)
    return kept, differing


def _strokes(contours: list[np.ndarray]) -> list[np.ndarray]:
    """The contours (indices) of each group that is connected by crossings; larger contours come first."""
    boxes = _boxes(contours)
    overlapping = [(n, m) for n in range(len(boxes)) for m in np.flatnonzero(_overlap(boxes[:n], boxes[n]))]
    crossing = [(n, m) for n, m in overlapping if _cross(contours[m], contours[n])]
    if not crossing:
        return []
    pairs = np.array(crossing)
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(boxes), len(boxes)))
    groups = csgraph.connected_components(graph, directed=False)[1]
    return [np.flatnonzero(groups == group) for group in np.unique(groups[pairs])]


def _are_copies(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether what only one of two contours encloses is nowhere as wide as COPY_PIXELS."""
    first, second = _masks(one, other, [one, other], SAMPLES)
    return not _is_wide(first ^ second, COPY_PIXELS)


def _are_one(one: np.ndarray, other: np.ndarray, wall: np.ndarray) -> bool:
    """Whether two contours of a solid, the smaller one last, enclose nearly the same, so that neither is a
    hole.
    """
    first, second = _masks(one, other, [one, other], SAMPLES)
    shared = (first & second).sum()
    if shared >= LEAST_IOU * (first | second).sum():
        return True
    return bool(2 * shared >= second.sum()) and not _is_wide(first ^ second, wall)


def _cross(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two contours, the smaller one last, share pixels, and each encloses what the other does not:
    nowhere thin as copies.
    """
    first, second = _masks(one, other, [other])
    if not (first & second).any() or not (second & ~first).any():
        return False
    first, second = _masks(one, other, [one])
    if not (first & ~second).any():
        return False
    first, second = _masks(one, other, [one, other], SAMPLES)
    return _is_wide(first & ~second, COPY_PIXELS) and _is_wide(second & ~first, COPY_PIXELS)


def _masks(
    one: np.ndarray, other: np.ndarray, around: Sequence[np.ndarray], samples: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Masks of what each of two contours encloses, within the box around some, with so many samples along
    each pixel.
    """
    corners = np.concatenate(around)
    low = np.floor(corners.min(axis=0))
    rows, columns = np.ceil((corners.max(axis=0) - low) * samples).astype(int) + 1
    (first, edge), (second, rim) = (
        _filled([(contour - low) * samples], (int(rows), int(columns))) for contour in (one, other)
    )
    return first & ~edge, second & ~rim


def _is_wide(mask: np.ndarray, width: np.ndarray | float) -> bool:
    """Whether a rectangle of some width (rows, columns) [pixels] fits into a mask of SAMPLES along each
    pixel.
    """
    rows, columns = (np.broadcast_to(width, 2) * SAMPLES).astype(int) + 1
    across = ndimage.minimum_filter1d(mask.view(np.uint8), columns, axis=1, mode="constant")
    return bool(ndimage.minimum_filter1d(across, rows, axis=0, mode="constant").any())


def _area(corners: np.ndarray) -> float:
    """Area of a contour [pixels^2]."""
    (y, x), (down, right) = corners.T, np.roll(corners, -1, axis=0).T
    return abs(float((x * down - right * y).sum())) / 2


def _boxes(contours: Sequence[np.ndarray]) -> np.ndarray:
    """Least and greatest row and column of each contour, (n, 4)."""
    return np.array([[*corners.min(axis=0), *corners.max(axis=0)] for corners in contours]).reshape(-1, 4)


def _overlap(boxes: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Whether each of some boxes (n, 4) overlaps one."""
    return np.logical_and((boxes[:, :2] < box[2:]).all(axis=1), (boxes[:, 2:] > box[:2]).all(axis=1))
