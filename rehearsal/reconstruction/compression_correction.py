"""Compression correction of a tracked sweep: a probe presses the same body along the tracked path, which
gives each pixel's place at rest.
"""

import numpy as np

from rehearsal.reconstruction.sweep_volumes import ImagePoses
from rehearsal.rehearsal import Rehearsal
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe_manipulator import ImagePlane, advanced, image_plane, poses_between
from ultrasound.sweep import Sweep, SweepError

# The probe starts this far above its first pose, takes this time to come there, and this time for the tissue
# to come to rest.
APPROACH_MM, APPROACH_S, SETTLE_S = 30.0, 0.5, 1.0
# A longer pause between frames is shortened to this.
LONGEST_S = 2.0


class CompressionCorrection:
    """Called with the frames of a sweep in order, it returns the place of each pixel (rows, columns, 3) at
    rest (LPS, mm).

    Raises SweepError for a sweep without the probe's poses, or without square images.
    """

    def __init__(self, rehearsal: Rehearsal, sweep: Sweep, image_poses: ImagePoses, reference: str) -> None:
        rows, columns = sweep.images.shape[1:]
        if rows != columns:
            raise SweepError(f"images of {rows} x {columns} pixels: expected a sweep that Nephron recorded")
        self.rehearsal, self.times_s = rehearsal, sweep.times_s
        self.plane = PlaneInTissue(rehearsal.anatomy.embedding, rows)
        self._poses, self._image_to_probe = {}, {}
        for frame in map(int, image_poses.frames):
            probe = sweep.transform("Probe", reference, frame)
            image_to_probe = sweep.transform("Image", "Probe", frame)
            if probe is None or image_to_probe is None:
                raise SweepError(f"frame {frame}: the probe has no pose, which compression correction needs")
            scales = np.diag([image_to_probe[0, 0], image_to_probe[1, 1], 1.0])
            if not np.allclose(image_to_probe[:3, :3], scales, atol=1e-6):
                raise SweepError(
                    f"frame {frame}: ImageToProbe rotates the image: expected a sweep that Nephron recorded"
                )
            self._image_to_probe[frame] = image_to_probe
            self._poses[frame] = rehearsal.case.transducer_at(probe)
        self._frame = int(image_poses.frames[0])
        approach(rehearsal, self._poses[self._frame])

    def __call__(self, frame: int) -> np.ndarray:
        if frame != self._frame:
            elapsed = float(self.times_s[frame] - self.times_s[self._frame])
            move_to(self.rehearsal, self._poses[frame], min(elapsed, LONGEST_S))
            self._frame = frame
        self.rehearsal.show()
        self.rehearsal.anatomy.embedding.update()
        self.plane.locate(self._plane_of(frame))
        return self.plane.rest_grid(self.plane.pixels) + self.rehearsal.case.origin

    def _plane_of(self, frame: int) -> ImagePlane:
        image_to_probe = self._image_to_probe[frame]
        column_mm, row_mm = image_to_probe[0, 0], image_to_probe[1, 1]
        pose, length = self._poses[frame], self.rehearsal.case.size_mm[2]
        extent = self.plane.pixels * column_mm, self.plane.pixels * row_mm, row_mm / 2 - image_to_probe[1, 3]
        return image_plane(pose, length, *extent)


def approach(rehearsal: Rehearsal, pose: np.ndarray) -> None:
    """Bring the transducer to a pose from above, and wait until the tissue is at rest."""
    rehearsal.organ.place(advanced(pose, -APPROACH_MM))
    move_to(rehearsal, pose, APPROACH_S)
    move_to(rehearsal, pose, SETTLE_S)


def move_to(rehearsal: Rehearsal, pose: np.ndarray, seconds: float) -> None:
    """Move the transducer to a pose at a constant speed."""
    steps = max(1, round(seconds / rehearsal.organ.settings.time_step_s))
    for step in poses_between(rehearsal.organ.pose, pose, steps)[1:]:
        rehearsal.advance(step)
