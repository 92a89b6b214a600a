"""Sweeps that the user records in the window."""

from pathlib import Path

from rehearsal.coordinates import probe_in_patient
from rehearsal.numbered_files import next_number
from rehearsal.rehearsal import Rehearsal
from render.viewer import View
from ultrasound.labelled_sweep import LabelledSweep
from ultrasound.probe import Probe
from ultrasound.sweep import SweepError

FRAME_S = 1 / 30
NAME = r"sweep-([0-9]{3,9})\.igs\.mha"


class Sweeping:
    """Nothing, or a sweep that grows."""

    def __init__(self, rehearsal: Rehearsal) -> None:
        self.rehearsal = rehearsal
        self._sweep: LabelledSweep | None = None
        self._began_s = self._due_s = 0.0
        self._shows = ""

    def toggle(self, out: Path) -> str:
        """Begin a sweep under the next free number of a folder, or end the one that goes on; what there is to say."""
        if self._sweep is not None:
            return self.end()
        if self.rehearsal.scanner is None:
            return "No CT, no sweep"
        stem = f"sweep-{next_number(out, NAME):03d}"
        try:
            self._sweep = LabelledSweep(out, stem, self.rehearsal.probe)
        except OSError as error:
            return f"{stem} cannot be written: {_words(error)}"
        self._began_s, self._due_s, self._shows = 0.0, 0.0, ""
        return f"{stem}: {{sweep}} ends it"

    @property
    def status(self) -> str:
        """What stands in the panel while a sweep goes on."""
        return "" if self._sweep is None else f"RECORDING {self._due_s - self._began_s:.0f} s"

    def end(self) -> str:
        """End the sweep, where there is one; what there is to say."""
        sweep, self._sweep = self._sweep, None
        if sweep is None:
            return ""
        try:
            sweep.close()
        except (OSError, SweepError) as error:
            return f"No sweep: {_words(error)}"
        return f"{sweep.name}: {sweep.count} pictures"

    def watch(self, time_s: float, view: View, probe: Probe) -> str:
        """Add what is seen now, where a sweep goes on and a frame is due; what there is to say."""
        if time_s < self._due_s - FRAME_S - 1e-9:
            # A replay was taken over: another session, with a time of its own.
            return self.end()
        if self._sweep is None or time_s < self._due_s - 1e-9 or self.rehearsal.scanner is None:
            return ""
        if self._sweep.count == 0:
            self._began_s = time_s
        self._due_s = time_s + FRAME_S
        name, picture = next(iter(view.pictures.items()))
        if name != (self._shows or name):
            # Echo and CT in one sweep would be no volume of either.
            return self.end()
        self._shows = name
        marks = self.rehearsal.scanner.ground_truth.render()
        try:
            self._sweep.add(picture, marks, probe, probe_in_patient(self.rehearsal), time_s)
        except SweepError as error:
            return f"{self.end()}: {error}"
        except OSError as error:
            # A frame that was half written would be in the file.
            self._sweep = None
            return f"No sweep: {_words(error)}"
        return ""


def _words(error: OSError | SweepError) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else str(error)
