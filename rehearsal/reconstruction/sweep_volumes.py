"""Volumes of a tracked sweep: grey values, and, from ground-truth labels, organ, tumour and beads; of its own
poses, or with the errors of a simulated tracker.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import binary_erosion, find_objects

from scenes.terminal import Progress, silent
from ultrasound.reconstruction import Reconstruction, VoxelBox
from ultrasound.sweep import PixelLabel, Sweep, SweepError, transform_fields
from ultrasound.tracking_errors import TrackingErrors, with_tracking_errors

GREY = "grey"
# A voxel belongs to a region from this fraction of its pixels.
HALF = 0.5
# Frame -> the places (rows, columns, 3) of its pixels [mm].
Places = Callable[[int], np.ndarray]


@dataclass(frozen=True)
class ImagePoses:
    """The ``frames`` (n,) of a sweep that have image and pose, and their ``matrices`` (n, 4, 4) from image
    to reference.
    """

    frames: np.ndarray
    matrices: np.ndarray

    @property
    def steps_mm(self) -> np.ndarray:
        """The distances (n - 1,) of the image origin from each frame to the next."""
        return np.linalg.norm(np.diff(self.matrices[:, :3, 3], axis=0), axis=1)


@dataclass
class SweepVolumes:
    """Volumes (x, y, z) on one box: grey values, ``known`` where there are any, regions by name; centroids
    (3,) of beads [mm] by number.
    """

    box: VoxelBox
    grey: np.ndarray
    known: np.ndarray
    regions: dict[str, np.ndarray] = field(default_factory=dict)
    beads: dict[int, np.ndarray] = field(default_factory=dict)


def image_poses_of(sweep: Sweep, reference: str) -> ImagePoses:
    """The poses of a sweep's images in a coordinate system. Raises SweepError where no image has one."""
    frames = filter(sweep.is_image_ok, range(len(sweep)))
    poses = {frame: sweep.transform("Image", reference, frame) for frame in frames}
    usable = {frame: pose for frame, pose in poses.items() if pose is not None}
    if not usable:
        raise SweepError(
            f"no image with a valid pose in {reference}, of {len(sweep)} frames: expected status OK in some"
        )
    return ImagePoses(np.array(list(usable)), np.stack(list(usable.values())))


def with_errors(sweep: Sweep, reference: str, errors: TrackingErrors, seed: int) -> Sweep:
    """The sweep with a tracker's errors on the poses of its probe; frames without a pose keep none.

    Raises SweepError where poses or times cannot be used.
    """
    poses = [sweep.transform("Probe", reference, frame) for frame in range(len(sweep))]
    known = [frame for frame, pose in enumerate(poses) if pose is not None]
    if not known:
        raise SweepError(f"no frame has a pose of the probe in {reference}, to which errors could be added")
    try:
        true_poses = np.stack([pose for pose in poses if pose is not None])
        disturbed = with_tracking_errors(true_poses, sweep.times_s[known], errors, seed)
    except ValueError as error:
        raise SweepError(f"errors of a tracker cannot be added to this sweep: {error}") from None
    name, frames = f"ProbeTo{reference}", [dict(fields) for fields in sweep.frames]
    for frame, pose in zip(known, disturbed, strict=True):
        frames[frame] |= transform_fields(name, pose)
    after = replace(sweep, frames=frames)
    first, pose = next(
        ((frame, pose) for frame, pose in zip(known, disturbed, strict=True) if pose is not None), (0, None)
    )
    if pose is not None and not np.array_equal(pose, after.transform("Probe", reference, first)):  # type: ignore[arg-type]
        raise SweepError(
            f"the sweep holds {reference}ToProbe, to which no errors can be added: expected {name}Transform"
        )
    return after


def lit_pixels(images: np.ndarray) -> np.ndarray:
    """Pixels (rows, columns) that are not black in all frames, as those outside the sector are."""
    return images.max(axis=0) > 0


def corners_of(image_poses: ImagePoses, mask: np.ndarray) -> np.ndarray:
    """Corners (4 n, 3) [mm] of the part of the images (rows, columns) inside a mask."""
    rows, columns = find_objects(mask.astype(np.uint8))[0]
    u, v = (np.array([s.start, s.stop - 1], float) for s in (columns, rows))
    pixels = np.array([[x, y, 0.0, 1.0] for x in u for y in v])
    return (pixels @ image_poses.matrices.transpose(0, 2, 1))[..., :3].reshape(-1, 3)


def reconstruct_volumes(
    sweep: Sweep,
    image_poses: ImagePoses,
    mask: np.ndarray,
    spacing_mm: float,
    method: str,
    reach_mm: float,
    labels: Sweep | None = None,
    places: Places | None = None,
    with_grey: bool = True,
    progress: Progress = silent,
) -> SweepVolumes:
    """Reconstruct volumes from the images of a sweep.

    ``labels`` are the same frames with ``PixelLabel`` values. ``places`` is called with the frames in order;
    without it the pixels are where the tracked poses place them. Without grey values there must be labels.
    ``progress`` shows the progress over frames and volumes.

    Raises SweepError where labels and images do not match or the images are no volume, ValueError as
    ``VoxelBox.around``.
    """
    if labels is not None and labels.images.shape != sweep.images.shape:
        raise SweepError(
            f"labels of {labels.images.shape}: expected {sweep.images.shape}, one for each image"
        )
    if not mask.any():
        raise SweepError("all images are black: there is nothing to reconstruct")
    corners = corners_of(image_poses, mask)
    _check_thickness(corners, spacing_mm)
    if places is not None:
        # Compressed tissue extends farther at rest.
        corners = np.concatenate([corners - reach_mm - 10.0, corners + reach_mm + 10.0])
    box = VoxelBox.around(corners, spacing_mm)
    channels = _channels(labels)
    if not with_grey:
        channels.pop(GREY)
    reconstructions = {name: Reconstruction(box, method) for name in channels}
    beads = _Beads(mask)
    for k, frame in enumerate(progress(image_poses.frames, "images")):
        at = None if places is None else places(int(frame))
        for name, is_of in channels.items():
            values = sweep.images[frame] if is_of is None else is_of(labels.images[frame])  # type: ignore[union-attr]
            if at is None:
                reconstructions[name].add(values, image_poses.matrices[k], mask)
            else:
                reconstructions[name].add_points(values[mask], at[mask])
        if labels is not None:
            is_end = k in (0, len(image_poses.frames) - 1)
            beads.add(labels.images[frame], image_poses.matrices[k], at, is_end)
    volumes = {
        name: reconstructions[name].volume(reach_mm) for name in progress([*reconstructions], "fill holes")
    }
    known = next(iter(volumes.values()))[1]
    grey = volumes.pop(GREY)[0] if with_grey else np.zeros(box.shape, np.float32)
    regions = {name: values > HALF for name, (values, _) in volumes.items()}
    return SweepVolumes(box, grey, known, regions, beads.centroids)


def _check_thickness(corners: np.ndarray, spacing_mm: float) -> None:
    """Raises SweepError where corners (n, 3) [mm] are in one plane or line, within less than a voxel."""
    centred = corners - corners.mean(axis=0)
    across = np.linalg.svd(centred, full_matrices=False)[2][-1]
    thickness = float(np.ptp(centred @ across))
    if thickness < spacing_mm:
        raise SweepError(
            f"the images are in one plane: together they are {thickness:.2f} mm thick, less than a voxel of "
            f"{spacing_mm:g} mm; expected two "
            "images or more at different positions"
        )


def _channels(labels: Sweep | None) -> dict[str, Callable[[np.ndarray], np.ndarray] | None]:
    """What is reconstructed: the grey values, and from labels the fractions of organ and tumour."""
    channels: dict[str, Callable[[np.ndarray], np.ndarray] | None] = {GREY: None}
    if labels is not None:
        channels["organ"] = lambda image: image % PixelLabel.BEAD >= PixelLabel.ORGAN
        if (labels.images % PixelLabel.BEAD == PixelLabel.TUMOUR).any():
            channels["tumour"] = lambda image: image % PixelLabel.BEAD == PixelLabel.TUMOUR
    return channels


class _Beads:
    """Centroids of the pixels of each bead; a bead that the edge of the image or an end of the sweep cuts
    has none.
    """

    def __init__(self, mask: np.ndarray) -> None:
        self._edge = ~binary_erosion(mask)
        self._sums: dict[int, np.ndarray] = {}
        self._cut: set[int] = set()

    def add(self, labels: np.ndarray, matrix: np.ndarray, at: np.ndarray | None, is_end: bool) -> None:
        """Add a label image (rows, columns), with its pose, or the places of its pixels (rows, columns, 3)
        [mm].
        """
        rows, columns = np.nonzero(labels >= PixelLabel.BEAD)
        if at is not None:
            places = at[rows, columns]
        else:
            pixels = np.column_stack([columns, rows, np.zeros(len(rows)), np.ones(len(rows))])
            places = pixels @ matrix[:3].T
        beads = labels[rows, columns] // PixelLabel.BEAD - 1
        cut = beads if is_end else beads[self._edge[rows, columns]]
        self._cut |= set(cut.tolist())
        for bead in map(int, np.unique(beads)):
            own = places[beads == bead]
            self._sums[bead] = self._sums.get(bead, np.zeros(4)) + np.append(own.sum(axis=0), len(own))

    @property
    def centroids(self) -> dict[int, np.ndarray]:
        """The centroids (3,) [mm] of the beads that were imaged completely, by their index."""
        return {bead: total[:3] / total[3] for bead, total in self._sums.items() if bead not in self._cut}
