"""The progress of a start: in the terminal, in the window, and with its times."""

from time import perf_counter
from typing import TYPE_CHECKING

from rehearsal.real_time.start_times import StartTimes
from scenes.terminal import ReportProgress

if TYPE_CHECKING:
    from rehearsal.live_settings import LiveSettings
    from render.window import Window

ANATOMY = "Anatomy"
TISSUE = "Building the model: tissue and contacts"
SURFACES = "Building the model: surfaces"
FIRST_IMAGE = "Building the model: the first picture"
FIRST_VIEW = "Building the model: the 3D view"
AT_REST = "Building the model: the tissue comes to rest"
# Those of a window, in their order.
STAGES = ANATOMY, TISSUE, SURFACES, FIRST_IMAGE, FIRST_VIEW, AT_REST


class StartProgress:
    """Called with each stage as it begins; ``viewer`` is the window, as soon as there is one."""

    def __init__(
        self, start: StartTimes, line: ReportProgress, viewer: "Window[LiveSettings] | None" = None
    ) -> None:
        self._start, self._line, self.viewer = start, line, viewer
        self._stage, self._done, self._began_s = "", 0, perf_counter()

    def __call__(self, stage: str) -> None:
        """A stage begins: one of ``STAGES``, or a part of the present one."""
        if stage in STAGES:
            self._done = STAGES.index(stage)
        self._stage, self._began_s = stage, perf_counter()
        self._start.begin(stage)
        self._line(stage)
        self.wait()

    def wait(self) -> None:
        """The present stage goes on: show how long it has lasted."""
        if self.viewer is not None:
            lasted_s = int(perf_counter() - self._began_s)
            text = f"{self._done + 1} of {len(STAGES)}   {self._stage}"
            self.viewer.show_progress(f"{text}, {lasted_s} s" if lasted_s else text, self._done / len(STAGES))
