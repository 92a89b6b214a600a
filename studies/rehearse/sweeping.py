"""Sweeps that the user records: what the scanner shows with where the probe is, as PLUS writes it, and the truth beside it."""

from pathlib import Path

import numpy as np

from render.viewer import View
from studies.rehearsal import Rehearsal
from ultrasound.array import Probe
from ultrasound.plane import image_to_probe
from ultrasound.probe import image_plane
from ultrasound.sweep import SweepError
from ultrasound.sweep_file import SweepWriter

FRAME_S = 1 / 30
MARKS = "-marks"


class Sweeping:
    """Nothing, or a sweep that grows. Reference is the patient (LPS, mm)."""

    def __init__(self, rehearsal: Rehearsal) -> None:
        self.rehearsal = rehearsal
        self.frames = 0
        self._writers: tuple[SweepWriter, ...] = ()
        self._due_s = 0.0

    def toggle(self, out: Path) -> str:
        """Begin a sweep under the next free number of a folder, or end the one that goes on; what there is to say."""
        if self._writers:
            return self.end()
        if self.rehearsal.scanner is None:
            return "No CT, no sweep"
        taken = [int(path.name[6:9]) for path in out.glob("sweep-[0-9][0-9][0-9].igs.mha")]
        stem = f"sweep-{1 + max(taken, default=0):03d}"
        try:
            self._writers = tuple(SweepWriter(out / f"{stem}{which}.igs.mha") for which in ("", MARKS))
        except OSError as error:
            return f"{stem}: cannot be written ({error.strerror})"
        self._due_s = 0.0
        return f"{stem}: recording"

    def end(self) -> str:
        """End the sweep, where there is one; what there is to say."""
        writers, self._writers = self._writers, ()
        if not writers:
            return ""
        try:
            for writer in writers:
                writer.close()
        except (OSError, SweepError) as error:
            return f"No sweep: {error}"
        return f"{writers[0].path.name}: {writers[0].count} pictures"

    def watch(self, time_s: float, view: View, probe: Probe) -> None:
        """Add what is seen now, where a sweep goes on and a frame is due."""
        if not self._writers or time_s < self._due_s - 1e-9 or self.rehearsal.scanner is None:
            return
        self._due_s = time_s + FRAME_S
        picture = next(iter(view.pictures.values()))
        marks = self.rehearsal.scanner.marks.render()
        transforms = transforms_of(self.rehearsal, probe, picture.shape)
        for writer, image in zip(self._writers, (picture, marks), strict=True):
            writer.add(image, transforms, time_s)


def transforms_of(rehearsal: Rehearsal, probe: Probe, shape: tuple[int, ...]) -> dict[str, np.ndarray | None]:
    """Where a picture (rows, columns) of a rehearsal is: on the probe, and the probe in the patient (LPS, mm)."""
    width, depth, above = probe.extent_mm
    pose = image_plane(rehearsal.pose, rehearsal.size_mm[2], *probe.extent_mm).world_from_plane.copy()
    pose[:3, 3] += rehearsal.origin
    on_probe = image_to_probe((depth / shape[0], width / shape[1]), width, above)
    return {"ProbeToReference": pose, "ImageToProbe": on_probe}
