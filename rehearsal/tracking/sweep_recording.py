"""Tracked sweeps that the user records in the window."""

from pathlib import Path

from rehearsal.coordinates import probe_in_patient
from rehearsal.rehearsal import Rehearsal
from rehearsal.result_files import next_number
from render.viewer import View
from ultrasound.probe import Probe
from ultrasound.sweep import SweepError
from ultrasound.sweep_file import LabelledSweep

FRAME_S = 1 / 30
NAME = r"sweep-([0-9]{3,9})\.igs\.mha"


class SweepRecorder:
    """Records a sweep between two calls of ``toggle``; methods return a message for the user, or nothing."""

    def __init__(self, rehearsal: Rehearsal) -> None:
        self.rehearsal = rehearsal
        self._sweep: LabelledSweep | None = None
        self._began_s = self._due_s = 0.0
        self._image_kind = ""

    def toggle(self, out: Path) -> str:
        """Begin a sweep under the next free number of a folder, or end the current one."""
        if self._sweep is not None:
            return self.end()
        if self.rehearsal.scanner is None:
            return "No sweep: the scene has no CT"
        stem = f"sweep-{next_number(out, NAME):03d}"
        try:
            self._sweep = LabelledSweep(out, stem, self.rehearsal.probe)
        except OSError as error:
            return f"{stem} cannot be written: {_reason(error)}"
        self._began_s, self._due_s, self._image_kind = 0.0, 0.0, ""
        return f"{stem}: {{sweep}} ends it"

    @property
    def status(self) -> str:
        """A line for the panel during a recording."""
        return "" if self._sweep is None else f"RECORDING {self._due_s - self._began_s:.0f} s"

    def end(self) -> str:
        """End the current sweep."""
        sweep, self._sweep = self._sweep, None
        if sweep is None:
            return ""
        try:
            sweep.close()
        except (OSError, SweepError) as error:
            return f"No sweep: {_reason(error)}"
        return f"{sweep.name}: {sweep.count} images"

    def watch(self, time_s: float, view: View, probe: Probe) -> str:
        """Add the current image where a frame is due."""
        if time_s < self._due_s - FRAME_S - 1e-9:
            # After the end of a replay another session begins, with its own time.
            return self.end()
        if self._sweep is None or time_s < self._due_s - 1e-9 or self.rehearsal.scanner is None:
            return ""
        if self._sweep.count == 0:
            self._began_s = time_s
        self._due_s = time_s + FRAME_S
        kind, image = next(iter(view.images.items()))
        if kind != (self._image_kind or kind):
            # A volume of B-mode and CT images would be neither.
            return self.end()
        self._image_kind = kind
        labels = self.rehearsal.scanner.ground_truth.render()
        try:
            self._sweep.add(image, labels, probe, probe_in_patient(self.rehearsal), time_s)
        except SweepError as error:
            return f"{self.end()}: {error}"
        except OSError as error:
            # The file would contain an incomplete frame.
            self._sweep = None
            return f"No sweep: {_reason(error)}"
        return ""


def _reason(error: OSError | SweepError) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else str(error)
