"""One frame: input -> step -> image -> observe -> present. Data flows in this direction only.

In a window, a process of its own makes the steps (``real_time/``); a frame shows the newest of them.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Generic, TypeVar

import numpy as np

from rehearsal.caliper import Caliper
from rehearsal.cine import Cine, CineFrame
from rehearsal.image_and_surface_files import save_screenshot, save_surfaces, save_view
from rehearsal.inputs.input_source import InputSource, ReplayInput, WindowInput
from rehearsal.inputs.user_input import UserInput
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.run_report import Tally
from rehearsal.notices import Notices
from rehearsal.open_window import geometry_of, probe_with_settings
from rehearsal.planning.plans_in_window import PlanControl
from rehearsal.pressed_organ import Step
from rehearsal.real_time.frame_times import FrameTimes
from rehearsal.real_time.solver_process import SolverProcess
from rehearsal.rehearsal import Rehearsal
from rehearsal.resection.resection_plan import ResectionPlan
from rehearsal.resection.resection_view import ResectionView, cut_settings
from rehearsal.stopwatch import timed
from rehearsal.tracking.openigtlink_server import OpenIGTLinkServer, send_live
from rehearsal.tracking.sweep_recording import SweepRecorder
from render.keys import Keys
from render.viewer import Controls, ScannerSettings, Settings, View
from render.window import Window
from scenes.import_findings import acknowledge
from scenes.scene import SceneError
from ultrasound.doppler import scale_colours
from ultrasound.persistence import Persistence
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import image_plane
from ultrasound.scanner import B_MODE, IMAGES_OF_MODE, PlaneImages, Scanner

PREPARING = "PREPARING THE IMAGE"
# How long a notice stays on the screen, and the one that the tissue's state was restored.
NOTICE_S, RESTORED_S = 2.0, 4.0
# The simulation counts as real time from this share of it on.
REAL_TIME = 0.9
# What the figures of speed on the screen are of.
RECENT_S, RECENT_FRAMES = 1.0, 20
# Times of steps and images that a window keeps.
MOST_TIMES = 100
# A frame that took longer moves the transducer as if it had taken this long.
MOST_ELAPSED_S = 0.25
Source = TypeVar("Source", bound=InputSource)
HOW_TO_ACKNOWLEDGE = "{acknowledge}: I have checked this in check.png"
HOW_TO_PRESS = "{press} or {push} presses"


@dataclass
class Frames(Generic[Source]):
    """The frames of one rehearsal, with a window (``WindowFrames``) or without one."""

    rehearsal: Rehearsal
    source: Source
    measurements: LiveMeasurements
    tally: Tally
    link: OpenIGTLinkServer | None = None
    resection_plan: ResectionPlan | None = None
    warnings: tuple[str, ...] = ()
    """Of the import, which nobody has acknowledged."""
    persistence: Persistence = field(default_factory=Persistence, init=False)
    resection: ResectionView = field(init=False)

    def __post_init__(self) -> None:
        self.resection = ResectionView(self.rehearsal, self.resection_plan)

    def input(self, controls: Controls) -> np.ndarray | None:
        """Return the transducer's next pose (4, 4); None if this frame makes no step."""
        return self.source.next_pose(controls)

    def step(self, pose: np.ndarray | None) -> None:
        """Advance the tissue by a time step to a pose, and the surfaces with it."""
        if pose is not None:
            step = self.rehearsal.timed_step(pose)
            self.rehearsal.update_surfaces()
            self.take(step)

    def take(self, step: Step) -> None:
        """Note a step that was made."""
        self.tally.step_ms.append(step.took_ms)
        self.source.after_step(step)

    def image(self, probe: Probe, settings: Settings) -> View:
        """Compute the images of the probe at its present pose."""
        time_s = self.source.session.time_s
        view = image_view(self.rehearsal, probe, settings, self.tally, None, time_s, self.persistence)
        return replace(self.with_resection(view, settings), warnings=self.import_warnings())

    def import_warnings(self) -> tuple[str, ...]:
        """The warnings of the import, as the 3D view shows them."""
        return tuple(f"Import: {text}" for text in self.warnings)

    def with_resection(self, view: View, settings: Settings) -> View:
        """A view with the score and the coming cut."""
        planned = cut_settings(settings)
        now_s = self.source.session.time_s
        self.resection.update(planned, lambda points: self.measurements.coverage.is_seen(points), now_s)
        score = self.resection.score(planned.margin_mm)
        if score is None:
            return view
        plane = self.rehearsal.image_plane()
        return replace(
            view, score=score, resection_mm=self.resection.section(np.linalg.inv(plane.world_from_plane))
        )

    def observe(self, probe: Probe, pose: np.ndarray | None) -> None:
        """Measure, and record the session; no pose is a rollback."""
        self.measurements.watch(self.source.session, probe, is_rollback=pose is None)
        self.measurements.count(pose, self.rehearsal.settings.time_step_s)
        self.source.after_frame()

    def send(self, view: View, probe: Probe) -> None:
        """Send the image over OpenIGTLink, if the link is open."""
        send_live(self.link, self.rehearsal, view, probe, self.source.session.time_s)


@dataclass(kw_only=True)
class WindowFrames(Frames[WindowInput]):
    """The frames in a window; while it is frozen the solver makes no step.

    While the solver makes the step towards an input, this process measures the last state and draws it in 3D; then it makes the image
    of the new one.
    """

    solver: SolverProcess
    viewer: Window
    out: Path
    notices: Notices
    sweeping: SweepRecorder
    plans: PlanControl
    keys: Keys = field(default_factory=Keys)
    folder: Path = Path()
    """Of the scene: the patient's, where one was imported."""
    cine: Cine = field(default_factory=Cine)
    caliper: Caliper = field(default_factory=Caliper)
    times: FrameTimes = field(default_factory=FrameTimes)
    frozen: bool = False
    _last_step: Step | None = field(default=None, init=False)
    _shown_input_s: float | None = field(default=None, init=False)
    _steps: list[Step] = field(default_factory=list, init=False)
    _rollbacks: int = field(init=False)
    _input_at_s: float | None = field(default=None, init=False)
    # Probe and pose of the last image, and whether its state was measured.
    _imaged: tuple[Probe, np.ndarray] | None = field(default=None, init=False)
    _is_observed: bool = field(default=False, init=False)
    _notice: str = field(default="", init=False)
    _notice_until: float = field(default=0.0, init=False)
    _restored_until: float = field(default=0.0, init=False)
    _shown_version: int = field(default=0, init=False)
    _kinds: set[tuple[str | bool, ...]] = field(default_factory=set, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.solver.on_step = self.take
        self._rollbacks = self.source.session.rollbacks

    def run(self) -> None:
        """Draw frames until the window is closed."""
        view: View | None = None
        while self.viewer.running:
            controls = self.viewer.read_controls()
            with self.times.stage("input"):
                self.drive(controls)
            if view is not None:
                with self.times.stage("last state"):
                    self._use_waiting_time(view)
            self._announce_new_kind(view, controls.settings)
            view = self.next_view(controls)
            self._draw(view, controls)
            if controls.export:
                self._save(partial(self._export, controls.settings, view))
        self._observe_last()

    def next_view(self, controls: Controls) -> View:
        """Take the newest state over, and return its view."""
        has_changed = not self._has_imaged_state
        with self.times.stage("state"):
            self.solver.collect()
            self.rehearsal.update_surfaces()
        if self.rehearsal.geometry_version != self._shown_version:
            self._shown_version = self.rehearsal.geometry_version
            self.viewer.change_geometry(geometry_of(self.rehearsal))
            # Its frames show other surfaces.
            self.cine = Cine()
        self._shown_input_s = None if self.frozen or self._last_step is None else self._last_step.input_s
        probe = probe_with_settings(self.rehearsal.probe, controls.settings)
        with self.times.stage("image"):
            view = self.image(probe, controls.settings)
        self._imaged, self._is_observed = (probe, self.rehearsal.pose), False
        for times_ms in (self.tally.step_ms, self.tally.slice_ms):
            del times_ms[:-MOST_TIMES]
        with self.times.stage("measurements"):
            if has_changed:
                self.observe_window(probe)
            self._record_sweep(probe, view, controls)
            return self.present(view, probe, controls)

    def _announce_new_kind(self, view: View | None, settings: ScannerSettings) -> None:
        """Say over the last image that one of a new kind is prepared: compiling its kernels may take seconds."""
        steered = settings.colour_steering_deg != 0
        kind = settings.mode, settings.detail_level, settings.compounding, settings.doppler, steered
        if view is not None and kind not in self._kinds:
            self.viewer.draw(replace(view, status=PREPARING))
        self._kinds.add(kind)

    def _use_waiting_time(self, view: View) -> None:
        """While the solver makes the next step, measure the last state and draw it in 3D, unless it has been changed since its image."""
        before = self.measurements.latest
        self._observe_last()
        self.viewer.draw_scene(view, may_wait=self.measurements.latest is not before)

    def _observe_last(self) -> None:
        """Measure the state of the last image, unless that was done or it has been changed since."""
        if self._imaged is not None and self._has_imaged_state and not self._is_observed:
            self.observe_window(self._imaged[0])

    @property
    def _has_imaged_state(self) -> bool:
        """Whether the rehearsal has the state of the last image: each that is taken over has a pose of its own."""
        return self._imaged is not None and self.rehearsal.pose is self._imaged[1]

    def _draw(self, view: View, controls: Controls) -> None:
        with self.times.stage("drawing"):
            self.viewer.draw(view)
        self.times.end_frame(self.source.session.time_s, self._shown_input_s or None)
        if controls.screenshot:
            self._save(lambda: save_screenshot(self.viewer.picture(), self.out))

    def drive(self, controls: Controls) -> None:
        """Apply the keys of freeze, cine and plans; then tell the solver what to do, unless frozen."""
        restores = (controls.reset, controls.undo, controls.redo, controls.bookmark, controls.to_bookmark)
        ends_freeze = (*restores, controls.operates)
        if any(ends_freeze):
            # They change the state, whose image counts for the coverage.
            self._observe_last()
        if controls.freeze or (self.frozen and (any(ends_freeze) or controls.take_over)):
            self.frozen = not self.frozen
            self.times.restart()
        if controls.reset:
            self.caliper.points = ()
        self.notices.post(controls.message)
        if controls.acknowledge and self.warnings:
            self._save(self._acknowledge)
        self.plans.watch(controls)
        now, before = perf_counter(), self._input_at_s
        self._input_at_s = now
        if self.frozen:
            self.solver.pause()
            self.cine.go(controls.cine)
        else:
            elapsed_s = self.rehearsal.settings.time_step_s if before is None else now - before
            self.source.drive(self.solver, controls, min(elapsed_s, MOST_ELAPSED_S))

    def take(self, step: Step) -> None:
        """Note a step that was made; post a notice if the divergence check restored its state."""
        super().take(step)
        self._last_step = step
        self._steps.append(step)
        self.times.steps.append(step)
        if step.notice:
            self.notices.post(step.notice, on_screen=False)
            self._restored_until = perf_counter() + RESTORED_S

    def image(self, probe: Probe, settings: Settings) -> View:
        """Compute the images, also of frozen tissue with other settings; of an earlier frame return those that it had.

        They have the pixels of their boxes in the window, unless they are recorded or sent too.
        """
        if self._shows_earlier:
            return self.cine.shown.view
        count, (width, depth, _) = len(IMAGES_OF_MODE[settings.mode]), probe.extent_mm
        shape = self.viewer.image_shape(count, width, depth) if self._only_shows else None
        time_s = self.source.session.time_s
        return image_view(self.rehearsal, probe, settings, self.tally, shape, time_s, self.persistence)

    @property
    def _only_shows(self) -> bool:
        """Whether the images are only shown, and neither recorded nor sent."""
        return not self.sweeping.status and self.link is None

    def observe_window(self, probe: Probe) -> None:
        """Measure and record, unless frozen."""
        if not self.frozen:
            self._is_observed = True
            session = self.source.session
            rollbacks, self._rollbacks = session.rollbacks - self._rollbacks, session.rollbacks
            self.measurements.watch(session, probe, is_rollback=rollbacks > 0)
            for step in self._steps:
                self.measurements.count(step.pose, step.length_s)
            for _ in range(rollbacks):
                self.measurements.count(None, self.rehearsal.settings.time_step_s)
            self._steps.clear()
            self.source.while_running()

    def present(self, view: View, probe: Probe, controls: Controls) -> View:
        """Add measurements, caliper and status to the view."""
        shown = self.cine.shown if self._shows_earlier else self._measured(view, probe, controls.settings)
        view = shown.view if self._shows_earlier else self.with_resection(shown.view, controls.settings)
        self.caliper.point(controls.pointed_mm, view.transducer_pose)
        if not self.frozen:
            self.caliper.go_with(view.transducer_pose)
        self._show_notices()
        return replace(
            view,
            caliper_mm=self.caliper.points,
            caliper=self.caliper.figure(shown),
            readouts=view.readouts | self._speeds(),
            warnings=self.import_warnings(),
            clock=f"{self.source.session.time_s:.1f} s",
            pace=self._pace(),
            status=self._status(view, controls.settings),
            notes={name: self._with_hint(note) for name, note in view.notes.items()},
        )

    def import_warnings(self) -> tuple[str, ...]:
        """The key that acknowledges the warnings of the import, and these: of many, the last are not shown."""
        shown = super().import_warnings()
        return (self.keys.worded(HOW_TO_ACKNOWLEDGE), *shown) if shown else ()

    def _record_sweep(self, probe: Probe, view: View, controls: Controls) -> None:
        if not self.frozen:
            self.sweeping.watch(self.source.session.time_s, view, probe)
        if controls.sweep:
            self.sweeping.toggle(self.out)

    @property
    def _shows_earlier(self) -> bool:
        """Whether the user looks at an earlier frame of the cine memory."""
        return self.frozen and self.cine.back > 0

    def _measured(self, view: View, probe: Probe, settings: Settings) -> CineFrame:
        """The view with its measurements, sent over the link and, unless frozen, kept in the cine memory."""
        self.send(view, probe)
        rest = self.rehearsal.rest_grid()
        shown = CineFrame(perf_counter(), self.measurements.onto(view, settings), rest)
        if not self.frozen:
            self.cine.keep(shown)
        return shown

    def _speeds(self) -> dict[str, str]:
        """Pictures a second, and the time from an input to its picture."""
        latency_ms = self.times.latency_ms
        recent = [latency_ms[-n] for n in range(1, min(len(latency_ms), RECENT_FRAMES) + 1)]
        return {
            "frames": f"{self.times.rates(RECENT_S)[0]:.0f} /s",
            "latency": f"{np.median(recent):.0f} ms" if recent else "",
        }

    def _pace(self) -> str:
        """Simulated over real time, if the simulation is slower; empty while frozen."""
        factor = self.times.rates(RECENT_S)[1]
        return "" if self.frozen or factor >= REAL_TIME else f"{factor:.1g} x real"

    def _with_hint(self, note: str) -> str:
        """A note that there is no contact, with the keys that press if these control the probe."""
        source = self.source.user_input if isinstance(self.source, ReplayInput) else self.source
        if self.frozen or not isinstance(source, UserInput) or not source.is_manual:
            return note
        return self.keys.worded(f"{note}\n{HOW_TO_PRESS}")

    def _status(self, view: View, settings: Settings) -> str:
        """The text over the images, the most important first: text that does not fit is cut at the end."""
        now = perf_counter()
        restored = "STATE RESTORED" if now < self._restored_until else ""
        news = [self._notice] if now < self._notice_until else [self._state(), self.plans.status]
        score = self.resection.status(cut_settings(settings))
        parts = [restored, view.status, self.sweeping.status, *news, score]
        return self.keys.worded("   ".join(filter(None, parts)))

    def _state(self) -> str:
        if not self.frozen:
            return self.source.status
        return f"FROZEN   {self.cine.age_s:.1f} s" if self.cine.back else "FROZEN"

    def _show_notices(self) -> None:
        """Show the notices of this frame in the panel and in the terminal."""
        for text in self.notices.present(self.keys.worded):
            self._notice, self._notice_until = text[0].upper() + text[1:], perf_counter() + NOTICE_S

    def _save(self, write: Callable[[], None]) -> None:
        """Write files that the user asked for."""
        try:
            write()
        except (OSError, SceneError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            self.notices.post(f"Not saved: {reason}", in_terminal=False)

    def _acknowledge(self) -> None:
        """Mark the warnings of the import as checked. Raises OSError, SceneError."""
        acknowledge(self.folder, self.warnings)
        self.warnings = ()
        self.notices.post("warnings of the import acknowledged")

    def _export(self, settings: Settings, view: View) -> None:
        """Save images and surfaces; say what is missing, and why. Raises OSError."""
        probe = probe_with_settings(self.rehearsal.probe, settings)
        if self._only_shows and not self._shows_earlier:
            # With all pixels of the scene.
            whole = image_view(self.rehearsal, probe, settings, Tally(0.0), None, self.source.session.time_s)
            view = replace(view, images=whole.images, doppler=whole.doppler)
        begin, missing = save_view(view, probe, self.out), []
        if view.notes.keys() & view.images.keys():
            missing.append("B-mode image black: the probe does not touch the organ")
        if self._shows_earlier:
            missing.append("no organ (PLY), which has moved since: {freeze} continues")
        else:
            save_surfaces(self.rehearsal, self.out, begin)
        self.notices.post("   ".join([f"saved {begin.rstrip('-')}", *missing]), in_terminal=False)
        self.notices.post("; ".join(missing), on_screen=False)


def image_view(
    rehearsal: Rehearsal,
    probe: Probe,
    settings: Settings,
    tally: Tally,
    shape: tuple[int, int] | None = None,
    time_s: float = 0.0,
    persistence: Persistence | None = None,
) -> View:
    """Compute the images of the probe at its present pose, with overlays and read-outs, at a time of the session.

    ``shape`` are the rows and columns of the images, at most the scene's pixels each, which is also the default.
    ``persistence`` is that of the images shown before; without it an image stands alone.
    """
    scanner, pixels = rehearsal.scanner, rehearsal.scene.image.pixels
    plane = image_plane(rehearsal.pose, probe.housing_mm[2], *probe.extent_mm)
    shown = settings.mode, settings.detail_level, settings.window_hu, settings.level_hu

    def images() -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        if scanner is None:
            return {"no CT": np.zeros((pixels, pixels), np.uint8)}, None
        shown_shape = shape and (min(shape[0], pixels), min(shape[1], pixels))
        made = scanner.images(plane, probe, *shown, shown_shape)
        if persistence is not None:
            made = persistence.mixed(made, settings.persistence_percent / 100)
        return made.by_name, doppler_of(scanner, made, settings, time_s)

    made, doppler = timed(images, tally.slice_ms)
    width, depth, above = probe.extent_mm
    return View(
        transducer_pose=rehearsal.pose,
        images=made,
        doppler=doppler,
        scale=scale_texts(probe, settings) if doppler is not None else ("", ""),
        scale_colours=None if doppler is None else scale_colours(settings.doppler),
        width_mm=width,
        depth_mm=depth,
        above_mm=above,
        sector=probe.sector,
        focus_mm=None if settings.mode == "ct" else probe.focus_mm,
        outline_mm=rehearsal.tumour_outline() if settings.outline else None,
        outline_before_mm=rehearsal.tumour_outline(at_rest=True) if settings.outline else None,
        captions=captions(probe, settings),
        readouts=readouts(rehearsal, tally),
        title=rehearsal.scene.title,
    )


def doppler_of(
    scanner: Scanner, images: PlaneImages, settings: ScannerSettings, time_s: float
) -> np.ndarray | None:
    """The B-mode image with Doppler over it; None where that is off."""
    if settings.doppler == "off" or B_MODE not in images.by_name:
        return None
    return scanner.doppler(images, settings.doppler, time_s, settings.clamped)


def scale_texts(probe: Probe, settings: ScannerSettings) -> tuple[str, str]:
    """Both ends of the scale of Doppler, of velocity in cm/s."""
    limit = f"{probe.velocity_limit_cm_s:.0f}"
    return ("power", "") if settings.doppler == "power" else (f"+{limit}", f"-{limit}")


def captions(probe: Probe, settings: ScannerSettings) -> tuple[str, str, str]:
    """The probe's name, and the settings of the B-mode image and of the CT."""
    b_mode = (
        f"{probe.frequency_mhz:.1f} MHz   G {probe.gain_percent:.0f} %   DR {probe.dyn_range_db:.0f} dB   "
        f"{settings.detail_level}{'   hilum clamped' * settings.clamped}"
    )
    ct = f"W {settings.window_hu}   L {settings.level_hu} HU"
    return (
        probe.transducer_name,
        "" if settings.mode == "ct" else b_mode,
        "" if settings.mode == "b-mode" else ct,
    )


def readouts(rehearsal: Rehearsal, tally: Tally) -> dict[str, str]:
    """Name -> figure with its unit."""
    size, count = next(iter(rehearsal.model.counts().items()))
    return {
        "step": f"{np.median(tally.step_ms[-30:]):.1f} ms" if tally.step_ms else "",
        "image": f"{np.median(tally.slice_ms[-30:]):.1f} ms",
        size: f"{count}",
        "indentation": f"{max(rehearsal.indentation_mm(), 0.0):.1f} mm",
    }
