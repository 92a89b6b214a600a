"""What a window shows beside frame and image: measurements, score, cine, caliper, notices; and the files
that the user saves.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Literal

import numpy as np

from rehearsal.caliper import Caliper
from rehearsal.cine import Cine, CineFrame
from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.image_and_surface_files import save_screenshot, save_surfaces, save_view
from rehearsal.imaging import image_view, readouts
from rehearsal.live_settings import LiveSettings
from rehearsal.loop.protocols import Source
from rehearsal.machine_signs import machine_signs
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.message_log import MessageLog
from rehearsal.notices import Notices
from rehearsal.page.session_images import SessionImages
from rehearsal.phase_hints import hint
from rehearsal.planning.plans_in_window import PlanControl
from rehearsal.quit_check import QuitCheck
from rehearsal.real_time.frame_times import FrameTimes
from rehearsal.real_time.pace import SEPARATOR
from rehearsal.resection.attempts import AttemptFigureList
from rehearsal.resection.resection_view import ResectionView, cut_settings
from rehearsal.sources.scripted import ReplaySource
from rehearsal.sources.user import UserSource
from rehearsal.tracking.openigtlink_server import OpenIGTLinkServer, send_live
from rehearsal.tracking.sweep_recording import SweepRecorder
from render.keys import Keys
from render.viewer import Controls, Sign, TextTable, View
from scenes.import_findings import acknowledge, side_of
from scenes.scene import SceneError
from ultrasound.probe import Probe

# The simulation counts as real time from this share of it on.
REAL_TIME = 0.9
# What the figures of speed on the screen are of.
RECENT_S, RECENT_FRAMES = 1.0, 20
HOW_TO_ACKNOWLEDGE = "{acknowledge}, or a click on this line: I have checked this in check.png"
HOW_TO_PRESS = "{press} or {push} presses"


class WindowPanel:
    """Adds to a view what the user reads, and does what the keys ask for that changes no tissue.

    ``folder`` is the scene's: the patient's, where one was imported; ``warnings`` of the import are those
    that nobody has acknowledged. ``counts`` are the sizes of the tissue model. ``quit_check`` decides
    whether the key to quit does.
    """

    def __init__(
        self,
        anatomy: DeformedAnatomy,
        source: Source,
        measurements: LiveMeasurements,
        resection: ResectionView,
        plans: PlanControl,
        notices: Notices,
        out: Path,
        keys: Keys,
        counts: dict[str, int],
        link: OpenIGTLinkServer | None = None,
        warnings: tuple[str, ...] = (),
        folder: Path = Path(),
        attempts: AttemptFigureList | None = None,
        quit_check: QuitCheck | None = None,
        images: SessionImages | None = None,
    ) -> None:
        self.anatomy, self.source, self.measurements = anatomy, source, measurements
        self.resection, self.plans, self.notices = resection, plans, notices
        self.out, self.keys, self.counts, self.link = out, keys, counts, link
        self.warnings, self.folder = warnings, folder
        self.attempts = attempts or AttemptFigureList(anatomy)
        self.quit_check = quit_check or QuitCheck(notices)
        # The sign of a cut that the solver computes.
        self.cutting = ""
        self._shows_attempts = False
        self.sweeping = SweepRecorder(anatomy, notices)
        self.images = images or SessionImages()
        self.cine, self.caliper, self.messages = Cine(), Caliper(), MessageLog()
        self._frozen = False

    @property
    def shows_earlier(self) -> bool:
        """Whether the user looks at an earlier frame of the cine memory."""
        return self._frozen and self.cine.back > 0

    @property
    def only_shows(self) -> bool:
        """Whether the images are only shown, and neither recorded nor sent."""
        return not self.sweeping.status and self.link is None

    def forget_images(self) -> None:
        """The frames of the cine memory show other surfaces."""
        self.cine = Cine()

    def control(self, controls: Controls[LiveSettings], frozen: bool) -> None:
        """Do what the keys ask for before the frame."""
        self._frozen = frozen
        if frozen:
            self.cine.go(controls.cine)
        if controls.reset:
            self.caliper.points = ()
        self.notices.post(controls.message)
        if controls.dismiss:
            self.messages.dismiss()
        if controls.acknowledge and self.warnings:
            self._try(self._acknowledge)
        self._shows_attempts ^= controls.show_attempts
        self.plans.control(controls)

    def present(
        self,
        view: View,
        settings: LiveSettings,
        controls: Controls,
        times: FrameTimes,
        image_ms: list[float],
    ) -> View:
        """The view with all that the user reads, sent over the link, and kept in the cine memory."""
        probe, time_s = settings.probe, self.anatomy.frame.time_s
        if not self._frozen:
            self.sweeping.add(time_s, view, probe)
        if controls.sweep:
            self.sweeping.toggle(self.out)
        shown = self.cine.shown if self.shows_earlier else self._measured(view, probe, settings)
        view = shown.view if self.shows_earlier else self.with_resection(shown.view, settings)
        if not self.shows_earlier:
            self.images.observe(view, self.anatomy)
        self.caliper.point(controls.pointed_mm, view.transducer_pose)
        if not self._frozen:
            self.caliper.go_with(view.transducer_pose)
        self._show_notices()
        step_ms = [step.took_ms for step in islice(reversed(times.steps), RECENT_FRAMES)]
        figures = readouts(self.counts, step_ms, image_ms, self._indentation_mm())
        return replace(
            view,
            caliper_mm=self.caliper.points,
            caliper=self.caliper.figure(shown),
            readouts=figures | _speeds(times),
            warnings=self._warnings(),
            table=self._table() if self._shows_attempts else None,
            clock=f"{time_s:.1f} s",
            pace=self._pace(times),
            status=self._status(view),
            signs=self._signs(),
            messages=self.messages.shown(perf_counter()),
            hint=self._hint(settings),
            findings=self._findings(view, settings),
            log=tuple((f"{at_s:.0f} s", text) for at_s, text in self.messages.kept),
            notes={name: self._with_hint(note) for name, note in view.notes.items()},
        )

    def with_resection(self, view: View, settings: LiveSettings) -> View:
        """A view with the score and the coming cut."""
        planned = cut_settings(settings)
        self.resection.update(planned, lambda points: self.measurements.coverage.is_seen(points))
        score = self.resection.score(planned.margin_mm)
        if score is None:
            return view
        return replace(view, score=score, resection_mm=self.resection.section())

    def save(
        self, controls: Controls, settings: LiveSettings, view: View, picture: Callable[[], np.ndarray]
    ) -> None:
        """Save the files that the user asks for."""
        if controls.screenshot:
            self._try(lambda: save_screenshot(picture(), self.out))
        if controls.export:
            self._try(partial(self._export, settings, view))

    def _measured(self, view: View, probe: Probe, settings: LiveSettings) -> CineFrame:
        """The view with its measurements, sent over the link and, unless frozen, kept in the cine memory."""
        send_live(self.link, self.anatomy, view, probe)
        rest = self.anatomy.rest_grid()
        shown = CineFrame(perf_counter(), self.measurements.onto(view, settings.view), rest)
        if not self._frozen:
            self.cine.keep(shown)
        return shown

    def _hint(self, settings: LiveSettings) -> str:
        phase, coming = settings.view.phase, cut_settings(settings)
        guide = self.measurements.guide
        if phase == "Scan" and guide is not None:
            guided = guide.next_in_words(self._side, has_keys=self._has_keys)
            if guided:
                return self.keys.worded(guided)
        return self.keys.worded(hint(phase, self.anatomy, self.measurements, self.resection, coming))

    def _findings(self, view: View, settings: LiveSettings) -> dict[str, str]:
        """The figures that matter in the present phase."""
        if settings.view.phase in ("Score", "Excise") and self.anatomy.cut is None:
            return self.resection.figures(cut_settings(settings))
        return view.findings

    def _indentation_mm(self) -> float:
        return self.measurements.manipulator.indentation_mm(self.anatomy.pose)

    def _warnings(self) -> tuple[str, ...]:
        """The key that acknowledges the warnings of the import, and these: of many, the last are not
        shown.
        """
        shown = tuple(f"Import: {text}" for text in self.warnings)
        return (self.keys.worded(HOW_TO_ACKNOWLEDGE), *shown) if shown else ()

    def _table(self) -> TextTable:
        """The attempts, with the key that returns to one."""
        table = self.attempts.table()
        how = self.keys.worded("{next_attempt} returns to the next attempt")
        return replace(table, title=f"{table.title}   {how}") if table.rows else table

    def _pace(self, times: FrameTimes) -> str:
        """Simulated over real time, if the simulation is slower; empty while frozen."""
        factor = times.rates(RECENT_S)[1]
        return "" if self._frozen or factor >= REAL_TIME else f"{factor:.1g} x real"

    @property
    def _has_keys(self) -> bool:
        """Whether mouse and keys control the probe."""
        source = self.source.user if isinstance(self.source, ReplaySource) else self.source
        return not self._frozen and isinstance(source, UserSource) and source.is_manual

    @cached_property
    def _side(self) -> Literal["left", "right"] | None:
        # The directions can be said without it.
        with suppress(SceneError):
            return side_of(self.anatomy.case.scene, self.folder)
        return None

    def _with_hint(self, note: str) -> str:
        """A note that there is no contact, with the keys that press if these control the probe."""
        if not self._has_keys:
            return note
        return self.keys.worded(f"{note}\n{HOW_TO_PRESS}")

    def _status(self, view: View) -> str:
        """The text over the images, of what makes them other than they seem, the most important first: text
        that does not fit is cut at the end.
        """
        return self.keys.worded("   ".join(filter(None, [view.status, self._state()])))

    def _signs(self) -> tuple[Sign, ...]:
        """The states of the machine."""
        replay = self.source.replay_status if isinstance(self.source, ReplaySource) else ""
        pace = [] if self._frozen else self.anatomy.frame.pace.split(SEPARATOR)
        signs = machine_signs([self.sweeping.status, replay, self.cutting, *pace, self.plans.status])
        worded = self.keys.worded
        return tuple(replace(sign, text=worded(sign.text), meaning=worded(sign.meaning)) for sign in signs)

    def _state(self) -> str:
        if not self._frozen:
            return self.source.status
        return f"FROZEN   {self.cine.age_s:.1f} s" if self.cine.back else "FROZEN"

    def _show_notices(self) -> None:
        """Show the notices of this frame under the 3D view and in the terminal."""
        for text in self.notices.present(self.keys.worded):
            self.messages.add(text[0].upper() + text[1:], self.anatomy.frame.time_s)

    def _try(self, write: Callable[[], None]) -> None:
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

    def _export(self, settings: LiveSettings, view: View) -> None:
        """Save images and surfaces; say what is missing, and why. Raises OSError."""
        if self.only_shows and not self.shows_earlier:
            # With all pixels of the scene.
            whole = image_view(self.anatomy, settings)
            view = replace(view, images=whole.images, doppler=whole.doppler)
        begin, missing = save_view(view, settings.probe, self.out), []
        self.images.export(begin.rstrip("-"), view)
        if view.notes.keys() & view.images.keys():
            missing.append("B-mode image black: the probe does not touch the organ")
        if self.shows_earlier:
            missing.append("no organ (PLY), which has moved since: {freeze} continues")
        else:
            save_surfaces(self.anatomy, self.out, begin)
        self.notices.post("; ".join([f"saved {begin.rstrip('-')}", *missing]))


def _speeds(times: FrameTimes) -> dict[str, str]:
    """Pictures a second, and the time from an input to its picture."""
    latency_ms = times.latency_ms
    recent = [latency_ms[-n] for n in range(1, min(len(latency_ms), RECENT_FRAMES) + 1)]
    return {
        "frames": f"{times.rates(RECENT_S)[0]:.0f} /s",
        "latency": f"{np.median(recent):.0f} ms" if recent else "",
    }
