"""Where the pixels of a tracked sweep were at rest: the same body pressed again by a probe on the tracked way."""

import numpy as np

from rehearsal.coordinates import transducer_at
from rehearsal.reconstruction.sweep_volumes import Track
from rehearsal.rehearsal import Rehearsal
from ultrasound.image_plane import ImagePlane, PlaneInTissue
from ultrasound.probe_manipulator import advanced, image_plane, poses_between
from ultrasound.sweep import Sweep, SweepError

# The probe comes from so far above its first place, in so long, and waits so long there for the tissue to come to rest.
FROM_MM, COMES_S, WAITS_S = 30.0, 0.5, 1.0
# A pause in a sweep is computed no longer than this.
LONGEST_S = 2.0


class CompressionCorrection:
    """Called with the frames of a track in their order, it gives where the tissue at each pixel (rows, columns, 3) was at rest (LPS, mm).

    Raises SweepError for a sweep that has no probe, or pictures with other than as many rows as columns.
    """

    def __init__(self, rehearsal: Rehearsal, sweep: Sweep, track: Track, reference: str) -> None:
        rows, columns = sweep.images.shape[1:]
        if rows != columns:
            raise SweepError(f"pictures of {rows} x {columns} pixels: expected a sweep that Nephron recorded")
        self.rehearsal, self.times_s = rehearsal, sweep.times_s
        self.plane = PlaneInTissue(rehearsal.embedding, rows)
        self._poses, self._on_probe = {}, {}
        for frame in map(int, track.frames):
            probe, on_probe = (
                sweep.transform("Probe", reference, frame),
                sweep.transform("Image", "Probe", frame),
            )
            if probe is None or on_probe is None:
                raise SweepError(f"frame {frame}: no pose of the probe, which is to be pressed again")
            if not np.allclose(on_probe[:3, :3], np.diag([on_probe[0, 0], on_probe[1, 1], 1.0]), atol=1e-6):
                raise SweepError(
                    f"frame {frame}: ImageToProbe turns the picture: expected a sweep of Nephron's"
                )
            self._on_probe[frame] = on_probe
            self._poses[frame] = transducer_at(rehearsal, probe)
        self._frame = int(track.frames[0])
        come(rehearsal, self._poses[self._frame])

    def __call__(self, frame: int) -> np.ndarray:
        if frame != self._frame:
            waited = float(self.times_s[frame] - self.times_s[self._frame])
            go(self.rehearsal, self._poses[frame], min(waited, LONGEST_S))
            self._frame = frame
        self.rehearsal.embedding.update()
        self.plane.locate(self._plane_of(frame))
        return self.plane.rest_grid(self.plane.pixels) + self.rehearsal.origin

    def _plane_of(self, frame: int) -> ImagePlane:
        on_probe = self._on_probe[frame]
        column_mm, row_mm = on_probe[0, 0], on_probe[1, 1]
        pose, length = self._poses[frame], self.rehearsal.size_mm[2]
        extent = self.plane.pixels * column_mm, self.plane.pixels * row_mm, row_mm / 2 - on_probe[1, 3]
        return image_plane(pose, length, *extent)


def come(rehearsal: Rehearsal, pose: np.ndarray) -> None:
    """Bring the transducer to a pose from above, and let the tissue come to rest under it."""
    rehearsal.pose = advanced(pose, -FROM_MM)
    go(rehearsal, pose, COMES_S)
    go(rehearsal, pose, WAITS_S)


def go(rehearsal: Rehearsal, pose: np.ndarray, seconds: float) -> None:
    """Move the transducer evenly to a pose in so many seconds."""
    steps = max(1, round(seconds / rehearsal.settings.time_step_s))
    for step in poses_between(rehearsal.pose, pose, steps)[1:]:
        rehearsal.advance(step)
