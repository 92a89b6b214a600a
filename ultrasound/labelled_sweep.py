"""A sweep of Nephron's: the pictures as PLUS writes them, and beside them, frame by frame, what each pixel is in truth."""

from pathlib import Path

import numpy as np

from ultrasound.probe import Probe
from ultrasound.sweep import Sweep, SweepError
from ultrasound.sweep_file import SweepWriter, read_sweep
from version import VERSION

SUFFIX, MARKS = ".igs.mha", "-marks.igs.mha"
# In the header: what took the pictures, and which version of Nephron.
PROBE_FIELD, VERSION_FIELD = "TransducerName", "NephronVersion"


class LabelledSweep:
    """Writes STEM.igs.mha and STEM-marks.igs.mha into a folder, both or none; the header names the probe and the version.

    Reference is the patient (LPS, mm). Raises OSError.
    """

    def __init__(self, folder: Path, stem: str, probe: Probe) -> None:
        self.name = f"{stem}{SUFFIX}"
        fields = {PROBE_FIELD: probe.transducer_name, VERSION_FIELD: VERSION}
        self._pictures, self._marks = (
            SweepWriter(folder / f"{stem}{end}", fields) for end in (SUFFIX, MARKS)
        )

    @property
    def count(self) -> int:
        """Frames so far."""
        return self._pictures.count

    def add(
        self,
        picture: np.ndarray,
        marks: np.ndarray,
        probe: Probe,
        reference_from_probe: np.ndarray,
        time_s: float,
    ) -> None:
        """One frame: grey values and ``PixelLabel`` values (rows, columns), of a probe at a pose (4, 4). Raises OSError, SweepError."""
        transforms: dict[str, np.ndarray | None] = {
            "ProbeToReference": reference_from_probe,
            "ImageToProbe": probe.image_to_probe(*picture.shape),
        }
        self._pictures.add(picture, transforms, time_s)
        self._marks.add(marks, transforms, time_s)

    def close(self) -> None:
        """Write both files. Raises OSError, SweepError."""
        self._marks.close()
        try:
            self._pictures.close()
        except (OSError, SweepError):
            self._marks.path.unlink(missing_ok=True)
            raise


def read_ground_truth(sweep: Path) -> Sweep | None:
    """The marks of a sweep, where they were recorded. Raises SweepError."""
    path = sweep.with_name(sweep.name.removesuffix(SUFFIX) + MARKS)
    return read_sweep(path) if sweep.name.endswith(SUFFIX) and path != sweep and path.is_file() else None
