"""A tracked sweep made into volumes: what its pictures show, and, where their truth was recorded, organ, tumour and beads."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import binary_erosion, find_objects

from ultrasound.reconstruction import Reconstruction, VoxelBox
from ultrasound.sweep import PixelLabel, Sweep, SweepError

GREY = "grey"
# A share of pixels from which on a voxel is of a region.
HALF = 0.5
# Where the pixels (rows, columns) of a frame are (rows, columns, 3) [mm].
Places = Callable[[int], np.ndarray]


@dataclass(frozen=True)
class Track:
    """Where a probe was: which frames of a sweep have picture and pose: ``frames`` (n,), and image to reference ``matrices`` (n, 4, 4)."""

    frames: np.ndarray
    matrices: np.ndarray

    @property
    def steps_mm(self) -> np.ndarray:
        """How far the origin of the picture goes from each frame to the next (n - 1,)."""
        return np.linalg.norm(np.diff(self.matrices[:, :3, 3], axis=0), axis=1)


@dataclass
class Rebuilt:
    """Volumes (x, y, z) on one box: grey values, where there are any, and regions by name; the middles of beads (3,) [mm] by number."""

    box: VoxelBox
    grey: np.ndarray
    known: np.ndarray
    regions: dict[str, np.ndarray] = field(default_factory=dict)
    beads: dict[int, np.ndarray] = field(default_factory=dict)


def track_of(sweep: Sweep, reference: str) -> Track:
    """Where the pictures of a sweep are in a coordinate system. Raises SweepError where it has none, or none with a pose."""
    found = [(k, sweep.transform("Image", reference, k)) for k in range(len(sweep)) if sweep.is_image_ok(k)]
    usable = [(k, matrix) for k, matrix in found if matrix is not None]
    if not usable:
        raise SweepError(
            f"no picture with a valid pose in {reference}, of {len(sweep)} frames: expected status OK in some"
        )
    return Track(np.array([k for k, _ in usable]), np.stack([matrix for _, matrix in usable]))


def lit(images: np.ndarray) -> np.ndarray:
    """Pixels (rows, columns) that some frame lights: those outside the scanner's sector are black in all."""
    return images.max(axis=0) > 0


def corners_of(track: Track, mask: np.ndarray) -> np.ndarray:
    """Corners (4 n, 3) [mm] of the part of the pictures (rows, columns) that a mask keeps."""
    rows, columns = find_objects(mask.astype(np.uint8))[0]
    u, v = (np.array([s.start, s.stop - 1], float) for s in (columns, rows))
    pixels = np.array([[x, y, 0.0, 1.0] for x in u for y in v])
    return (pixels @ track.matrices.transpose(0, 2, 1))[..., :3].reshape(-1, 3)


def rebuild(
    sweep: Sweep,
    track: Track,
    mask: np.ndarray,
    spacing_mm: float,
    method: str,
    reach_mm: float,
    marks: Sweep | None = None,
    places: Places | None = None,
    with_grey: bool = True,
    done: Callable[[], object] = lambda: None,
) -> Rebuilt:
    """Put the pictures of a sweep together.

    ``marks`` are the same frames with ``PixelLabel`` values. ``places`` says where each frame's pixels are, asked for in the order of frames;
    without it they are where the tracker says. Without grey values there must be marks. ``done`` is told of each frame.

    Raises SweepError where marks and pictures do not go together, ValueError as ``VoxelBox.around``.
    """
    if marks is not None and marks.images.shape != sweep.images.shape:
        raise SweepError(
            f"marks of {marks.images.shape}: expected {sweep.images.shape}, one for each picture"
        )
    if not mask.any():
        raise SweepError("all pictures are black: there is nothing to put together")
    corners = corners_of(track, mask)
    if places is not None:
        # What was squeezed is farther apart at rest.
        corners = np.concatenate([corners - reach_mm - 10.0, corners + reach_mm + 10.0])
    box = VoxelBox.around(corners, spacing_mm)
    channels = _channels(marks)
    if not with_grey:
        channels.pop(GREY)
    gathered = {name: Reconstruction(box, method) for name in channels}
    beads = _Beads(mask)
    for k, frame in enumerate(track.frames):
        at = None if places is None else places(int(frame))
        for name, is_of in channels.items():
            values = sweep.images[frame] if is_of is None else is_of(marks.images[frame])  # type: ignore[union-attr]
            if at is None:
                gathered[name].add(values, track.matrices[k], mask)
            else:
                gathered[name].add_points(values[mask], at[mask])
        if marks is not None:
            beads.add(marks.images[frame], track.matrices[k], at, k in (0, len(track.frames) - 1))
        done()
    volumes = {name: each.volume(reach_mm) for name, each in gathered.items()}
    known = next(iter(volumes.values()))[1]
    grey = volumes.pop(GREY)[0] if with_grey else np.zeros(box.shape, np.float32)
    regions = {name: values > HALF for name, (values, _) in volumes.items()}
    return Rebuilt(box, grey, known, regions, beads.middles)


def _channels(marks: Sweep | None) -> dict[str, Callable[[np.ndarray], np.ndarray] | None]:
    """What is put together: the grey values, and of marks the shares of organ and tumour."""
    channels: dict[str, Callable[[np.ndarray], np.ndarray] | None] = {GREY: None}
    if marks is not None:
        channels["organ"] = lambda image: image % PixelLabel.BEAD >= PixelLabel.ORGAN
        if (marks.images % PixelLabel.BEAD == PixelLabel.TUMOUR).any():
            channels["tumour"] = lambda image: image % PixelLabel.BEAD == PixelLabel.TUMOUR
    return channels


class _Beads:
    """Gathers where the pixels of each bead are. One that the pictures' edge cuts, or the sweep's end, has no middle."""

    def __init__(self, mask: np.ndarray) -> None:
        self._edge = ~binary_erosion(mask)
        self._sums: dict[int, np.ndarray] = {}
        self._cut: set[int] = set()

    def add(self, marks: np.ndarray, matrix: np.ndarray, at: np.ndarray | None, is_end: bool) -> None:
        """A picture of marks (rows, columns): where its pixels are by a matrix, or one by one (rows, columns, 3) [mm]."""
        rows, columns = np.nonzero(marks >= PixelLabel.BEAD)
        if at is not None:
            places = at[rows, columns]
        else:
            pixels = np.column_stack([columns, rows, np.zeros(len(rows)), np.ones(len(rows))])
            places = pixels @ matrix[:3].T
        beads = marks[rows, columns] // PixelLabel.BEAD - 1
        cut = beads if is_end else beads[self._edge[rows, columns]]
        self._cut |= set(cut.tolist())
        for bead in map(int, np.unique(beads)):
            own = places[beads == bead]
            self._sums[bead] = self._sums.get(bead, np.zeros(4)) + np.append(own.sum(axis=0), len(own))

    @property
    def middles(self) -> dict[int, np.ndarray]:
        """Mean place (3,) [mm] of the pixels of each bead that was seen whole, by its place in their order."""
        return {bead: total[:3] / total[3] for bead, total in self._sums.items() if bead not in self._cut}
