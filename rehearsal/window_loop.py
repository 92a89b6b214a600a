"""The window's loop. Each time around:

1. the source gives commands: from the user's controls, a recorded session or a tracked probe; the solver's
   process takes them;
2. while it makes the next step, the observers look at the last frame, and its 3D view is drawn;
3. the newest frame is shown: surfaces and image plane move;
4. its image is computed;
5. it is drawn, with what was observed; while nothing moves, an image of another kind is prepared.
"""

from dataclasses import dataclass, field, replace
from time import perf_counter

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.drawn_geometry import drawn_geometry
from rehearsal.image_preparation import ImagePreparation
from rehearsal.imaging import image_view
from rehearsal.live_settings import LiveSettings, with_recorded
from rehearsal.loop.command import CutOut, SetValues
from rehearsal.loop.frame import Applied, Frame, Refused
from rehearsal.loop.protocols import Observer, Source, Stepper
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.real_time.frame_times import FrameTimes
from rehearsal.window_panel import WindowPanel
from render.viewer import Controls, View
from render.window import Window
from settings import with_values
from ultrasound.persistence import Persistence
from ultrasound.probe import Probe
from ultrasound.scanner import IMAGES_OF_MODE

PREPARING = "PREPARING THE IMAGE"
# How long a picture waits for the step that shows its input.
MOST_WAIT_S = 0.1
# A frame that took longer moves the transducer as if it had taken this long.
MOST_ELAPSED_S = 0.25
# Times of images that a window keeps.
MOST_TIMES = 100


@dataclass
class WindowLoop:
    """A rehearsal in a window: ``run`` until it is closed. While it is frozen the solver makes no step."""

    window: Window[LiveSettings]
    stepper: Stepper
    source: Source
    anatomy: DeformedAnatomy
    measurements: LiveMeasurements
    observers: list[Observer]
    panel: WindowPanel
    times: FrameTimes = field(default_factory=FrameTimes)
    frozen: bool = False
    _persistence: Persistence = field(default_factory=Persistence, init=False)
    _image_ms: list[float] = field(default_factory=list, init=False)
    _input_at_s: float | None = field(default=None, init=False)
    _version: int = field(default=0, init=False)
    _preparation: ImagePreparation = field(default_factory=ImagePreparation, init=False)

    def run(self) -> None:
        """Draw frames until the window is closed."""
        # Its events were observed where it was shown.
        frame, view = replace(self.anatomy.frame, events=()), None
        probe = self.anatomy.case.probe
        while self.window.running:
            controls = self._controls()
            with self.times.stage("input"):
                self._submit(frame, controls)
            with self.times.stage("last state"):
                self._use_waiting_time(frame, probe, view)
            settings = self.window.settings
            probe = settings.probe
            self._announce_new_kind(view, settings)
            with self.times.stage("state"):
                frame = self._newest()
            with self.times.stage("image"):
                view = self._image(settings)
            with self.times.stage("panel"):
                view = self.panel.present(view, settings, controls, self.times, self._image_ms)
            with self.times.stage("drawing"):
                self.window.draw(view)
            self._end(frame, view, controls)
            self._prepare_image(frame, settings)
        self._observe(frame, probe)

    def _controls(self) -> Controls[LiveSettings]:
        """The user's controls; freeze is a toggle, which what changes the tissue ends."""
        controls = self.window.read_controls()
        ends_freeze = controls.restores or controls.operates or controls.take_over
        if controls.freeze or (self.frozen and ends_freeze):
            self.frozen = not self.frozen
            self.times.restart()
        self.panel.control(controls, self.frozen)
        if controls.quit and self.panel.quit_check.quits(self.anatomy.frame):
            self.window.quit()
        return replace(controls, frozen=self.frozen)

    def _submit(self, frame: Frame, controls: Controls[LiveSettings]) -> None:
        now, before = perf_counter(), self._input_at_s
        self._input_at_s = now
        step_s = self.anatomy.case.scene.solver.time_step_s
        elapsed_s = step_s if before is None else min(now - before, MOST_ELAPSED_S)
        for command in self.source.commands(frame, controls, elapsed_s):
            if isinstance(command, SetValues):
                # Those of a replay are the window's too.
                self.window.settings = with_recorded(self.window.settings, command.values)
            if isinstance(command, CutOut):
                self.panel.cutting = "Cutting"
            self.stepper.submit(command)

    def _use_waiting_time(self, frame: Frame, probe: Probe, view: View | None) -> None:
        before = self.measurements.latest
        self._observe(frame, probe)
        if view is not None:
            self.window.draw_scene(view, may_wait=self.measurements.latest is not before)

    def _observe(self, frame: Frame, probe: Probe) -> None:
        if not frame.events:
            return
        self.times.steps.extend(frame.steps)
        for observer in self.observers:
            observer.observe(frame, probe)

    def _newest(self) -> Frame:
        """Show the newest frame."""
        frame = self.stepper.newest(MOST_WAIT_S)
        if any(isinstance(e, Applied | Refused) and isinstance(e.command, CutOut) for e in frame.events):
            self.panel.cutting = ""
        self.anatomy.show(frame)
        if frame.geometry.version != self._version:
            self._version = frame.geometry.version
            self.window.change_geometry(drawn_geometry(self.anatomy))
            self.panel.forget_images()
            # What was cut is judged next; a cut that was taken back is made again.
            phase = "Excise" if self.anatomy.cut is None else "Inspect"
            self.window.settings = with_values(self.window.settings, {"view.phase": phase})
        return frame

    def _image(self, settings: LiveSettings) -> View:
        """The images, also of frozen tissue with other settings; of an earlier frame those that it had.

        They have the pixels of their boxes in the window, unless they are recorded or sent too.
        """
        if self.panel.shows_earlier:
            return self.panel.cine.shown.view
        count, (width, depth, _) = len(IMAGES_OF_MODE[settings.image.mode]), settings.probe.extent_mm
        shape = self.window.image_shape(count, width, depth) if self.panel.only_shows else None
        view = image_view(self.anatomy, settings, self._image_ms, shape, self._persistence)
        del self._image_ms[:-MOST_TIMES]
        return view

    def _announce_new_kind(self, view: View | None, settings: LiveSettings) -> None:
        """Say over the last image that one of a new kind is prepared: compiling its kernels may take
        seconds.
        """
        if view is not None and self._preparation.is_new(settings):
            self.window.draw(replace(view, status=PREPARING))
        self._preparation.note(settings)

    def _prepare_image(self, frame: Frame, settings: LiveSettings) -> None:
        """While nothing moves, make an image of a kind that the next key may ask for."""
        other = self._preparation.next(settings, frame.pose)
        if other is not None and self.anatomy.scanner is not None:
            image_view(self.anatomy, other)
            self._preparation.note(other)

    def _end(self, frame: Frame, view: View, controls: Controls) -> None:
        input_s = frame.steps[-1].input_s if frame.steps and not self.frozen else None
        self.times.end_frame(frame.time_s, input_s or None)
        self.panel.save(controls, self.window.settings, view, self.window.picture)
