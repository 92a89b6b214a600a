"""Tracked sweeps that the user records in the window."""

from pathlib import Path

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.notices import Notices
from rehearsal.result_files import next_number
from render.viewer import View
from ultrasound.probe import Probe
from ultrasound.sweep import SweepError
from ultrasound.sweep_file import LabelledSweep

FRAME_S = 1 / 30
NAME = r"sweep-([0-9]{3,9})\.igs\.mha"


class SweepRecorder:
    """Records a sweep between two calls of ``toggle``."""

    def __init__(self, anatomy: DeformedAnatomy, notices: Notices) -> None:
        self.anatomy, self.notices = anatomy, notices
        self._sweep: LabelledSweep | None = None
        self._began_s = self._due_s = 0.0
        self._image_kind = ""

    def toggle(self, out: Path) -> None:
        """Begin a sweep under the next free number of a folder, or end the current one."""
        if self._sweep is not None:
            self.end()
            return
        if self.anatomy.scanner is None:
            self.notices.post("No sweep: the scene has no CT")
            return
        stem = f"sweep-{next_number(out, NAME):03d}"
        try:
            self._sweep = LabelledSweep(out, stem, self.anatomy.case.probe)
        except OSError as error:
            self.notices.post(f"{stem} cannot be written: {_reason(error)}")
            return
        self._began_s, self._due_s, self._image_kind = 0.0, 0.0, ""
        self.notices.post(f"{stem}: {{sweep}} ends it")

    @property
    def status(self) -> str:
        """For the window during a recording."""
        return "" if self._sweep is None else f"Recording {self._due_s - self._began_s:.0f} s"

    def end(self, why: str = "") -> None:
        """End the current sweep, if there is one."""
        sweep, self._sweep = self._sweep, None
        if sweep is None:
            return
        try:
            sweep.close()
            self.notices.post(f"{sweep.name}: {sweep.count} images{why}")
        except (OSError, SweepError) as error:
            self.notices.post(f"No sweep: {_reason(error)}{why}")

    def add(self, time_s: float, view: View, probe: Probe) -> None:
        """Add the current image where a frame is due."""
        kind, image = next(iter(view.images.items()))
        # After the end of a replay another session begins, with its own time; a volume of B-mode and CT
        # images would be neither.
        if time_s < self._due_s - FRAME_S - 1e-9 or (self._image_kind and kind != self._image_kind):
            self.end()
        if self._sweep is None or time_s < self._due_s - 1e-9 or self.anatomy.scanner is None:
            return
        if self._sweep.count == 0:
            self._began_s = time_s
        self._due_s, self._image_kind = time_s + FRAME_S, kind
        labels = self.anatomy.scanner.ground_truth.render()
        try:
            self._sweep.add(image, labels, probe, self.anatomy.probe_in_patient(), time_s)
        except SweepError as error:
            self.end(f": {error}")
        except OSError as error:
            # The file would contain an incomplete frame.
            self._sweep = None
            self.notices.post(f"No sweep: {_reason(error)}")


def _reason(error: OSError | SweepError) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else str(error)
