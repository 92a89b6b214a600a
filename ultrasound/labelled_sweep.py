"""A simulated sweep: images in PLUS's format, and ground-truth labels of the same frames in a second file."""

from pathlib import Path

import numpy as np

from ultrasound.probe import Probe
from ultrasound.sweep import Sweep, SweepError
from ultrasound.sweep_file import SweepWriter, read_sweep
from version import VERSION

SUFFIX, LABELS_SUFFIX = ".igs.mha", "-marks.igs.mha"
# Fields of the header: the probe, and the version of Nephron.
PROBE_FIELD, VERSION_FIELD = "TransducerName", "NephronVersion"


class LabelledSweep:
    """Writes STEM.igs.mha and STEM-marks.igs.mha into a folder, both or none. Reference is the patient (LPS, mm). Raises OSError."""

    def __init__(self, folder: Path, stem: str, probe: Probe) -> None:
        self.name = f"{stem}{SUFFIX}"
        fields = {PROBE_FIELD: probe.transducer_name, VERSION_FIELD: VERSION}
        self._images, self._labels = (
            SweepWriter(folder / f"{stem}{end}", fields) for end in (SUFFIX, LABELS_SUFFIX)
        )

    @property
    def count(self) -> int:
        """Number of frames so far."""
        return self._images.count

    def add(
        self,
        image: np.ndarray,
        labels: np.ndarray,
        probe: Probe,
        reference_from_probe: np.ndarray,
        time_s: float,
    ) -> None:
        """Add a frame: grey values and ``PixelLabel`` values (rows, columns), probe pose (4, 4), time. Raises OSError, SweepError."""
        transforms: dict[str, np.ndarray | None] = {
            "ProbeToReference": reference_from_probe,
            "ImageToProbe": probe.image_to_probe(*image.shape),
        }
        self._images.add(image, transforms, time_s)
        self._labels.add(labels, transforms, time_s)

    def close(self) -> None:
        """Write both files. Raises OSError, SweepError."""
        self._labels.close()
        try:
            self._images.close()
        except (OSError, SweepError):
            self._labels.path.unlink(missing_ok=True)
            raise


def read_ground_truth(sweep: Path) -> Sweep | None:
    """Return the labels recorded with a sweep, None where there are none. Raises SweepError."""
    path = sweep.with_name(sweep.name.removesuffix(SUFFIX) + LABELS_SUFFIX)
    return read_sweep(path) if sweep.name.endswith(SUFFIX) and path != sweep and path.is_file() else None
