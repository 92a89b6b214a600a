"""The interactive loop: input -> transducer -> step -> surfaces and pictures -> window."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter

import click

from rehearsal.cine import Caliper, Cine, CineFrame
from rehearsal.frame_view import probe_as_set, take_view
from rehearsal.inputs.input_source import InputSource, ReplayInput
from rehearsal.inputs.user_input import UserInput
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.run_report import Tally
from rehearsal.planning.plans_in_window import Plans
from rehearsal.rehearsal import Rehearsal
from rehearsal.saving import save_screenshot, save_surfaces, save_view
from rehearsal.tracking.openigtlink_image import send_live
from rehearsal.tracking.openigtlink_server import Server
from rehearsal.tracking.sweep_recording import Sweeping
from render.keys import Keys
from render.viewer import Controls, Settings, View, Viewer

# How long what was done is said, and that the guard put the tissue back.
SAID_S, PUT_BACK_S = 2.0, 4.0
# A share of real time that is as good as that.
REAL = 0.9
HOW_TO_PRESS = "{press} or {push} presses"


@dataclass
class FrameLoop:
    """The frames of one rehearsal in a window, led by a driver."""

    rehearsal: Rehearsal
    viewer: Viewer
    out: Path
    tally: Tally
    driver: InputSource
    instruments: LiveMeasurements
    sweeping: Sweeping
    plans: Plans
    cine: Cine = field(default_factory=Cine)
    caliper: Caliper = field(default_factory=Caliper)
    keys: Keys = field(default_factory=Keys)
    link: Server | None = None
    frozen: bool = False
    rate: float = 0.0
    _said: str = ""
    _said_until: float = 0.0
    _put_back_until: float = 0.0

    def run(self) -> None:
        """Go on until the window is closed."""
        before = perf_counter()
        while self.viewer.running:
            controls = self.viewer.read_controls()
            view = self.frame(controls)
            now = perf_counter()
            self.rate = 0.9 * self.rate + 0.1 / max(now - before, 1e-6)
            before = now
            self.viewer.draw(view)
            try:
                self._save(controls, view)
            except OSError as error:
                self._say(f"Not saved: {error.strerror}")

    def _save(self, controls: Controls, view: View) -> None:
        """What the user wants as files. Raises OSError."""
        if controls.screenshot:
            save_screenshot(self.viewer.picture(), self.out)
        if controls.export:
            self._export(controls.settings, view)

    def _export(self, settings: Settings, view: View) -> None:
        """Save the picture and the tissue, and say what is not in them, and why. Raises OSError."""
        begin, missing = save_view(view, probe_as_set(self.rehearsal.probe, settings), self.out), []
        if view.notes.keys() & view.pictures.keys():
            missing.append("echo black: the probe does not touch the organ")
        if self.frozen and self.cine.back:
            missing.append("no organ (PLY), which has moved since: {freeze} goes on")
        else:
            save_surfaces(self.rehearsal, self.out, begin)
        self._say("   ".join([f"saved {begin.rstrip('-')}", *missing]))
        self._tell("; ".join(missing))

    def frame(self, controls: Controls) -> View:
        """One frame: what the user did, a moment unless frozen, and what is to be seen."""
        ends_freeze = (controls.reset, controls.undo, controls.redo, controls.bookmark, controls.to_bookmark)
        if controls.freeze or (self.frozen and (any(ends_freeze) or controls.take_over)):
            self.frozen = not self.frozen
        if controls.reset:
            self.caliper.points = ()
        self._announce(controls.message)
        self._announce(self.plans.watch(controls))
        shown = self._looked_back(controls) or self._taken(controls)
        if controls.sweep:
            self._announce(self.sweeping.toggle(self.out))
        view = shown.view
        self.caliper.point(controls.pointed_mm, view.transducer_pose)
        if not self.frozen:
            self.caliper.go_with(view.transducer_pose)
        return replace(
            view,
            caliper_mm=self.caliper.points,
            caliper=self.caliper.figure(shown),
            readouts=view.readouts | {"frames": f"{self.rate:.0f} /s"},
            clock=f"{self.driver.session.time_s:.1f} s",
            pace=self._pace(),
            status=self._status(view),
            notes={name: self._hinted(note) for name, note in view.notes.items()},
        )

    def _pace(self) -> str:
        """How slowly simulated time goes, where it is slower than real; a frozen one stands."""
        speed = self.rate * self.rehearsal.settings.time_step_s
        return "" if self.frozen or speed >= REAL else f"{speed:.1g} x real"

    def _hinted(self, note: str) -> str:
        """A note that there is no contact, with what the user can do about it, if anything."""
        live = self.driver.live if isinstance(self.driver, ReplayInput) else self.driver
        if self.frozen or not isinstance(live, UserInput) or not live.is_by_hand:
            return note
        return self.keys.worded(f"{note}\n{HOW_TO_PRESS}")

    def _status(self, view: View) -> str:
        """What stands over the pictures, by weight: the tissue before all else, for the last words go where there is no room."""
        now = perf_counter()
        put_back = "TISSUE PUT BACK" if now < self._put_back_until else ""
        news = [self._said] if now < self._said_until else [self._state(), self.plans.status]
        return self.keys.worded(
            "   ".join(filter(None, [put_back, view.status, self.sweeping.status, *news]))
        )

    def _state(self) -> str:
        if not self.frozen:
            return self.driver.status
        return f"FROZEN   {self.cine.age_s:.1f} s" if self.cine.back else "FROZEN"

    def _announce(self, text: str) -> None:
        """Say something in the window and in the terminal."""
        self._say(text)
        self._tell(text)

    def _say(self, text: str) -> None:
        if text:
            words = self.keys.worded(text)
            self._said, self._said_until = words[0].upper() + words[1:], perf_counter() + SAID_S

    def _looked_back(self, controls: Controls) -> CineFrame | None:
        """A frame of the last seconds, where the user is looking at one."""
        if self.frozen:
            self.cine.go(controls.cine)
        if not self.frozen or self.cine.back == 0:
            return None
        return self.cine.shown

    def _taken(self, controls: Controls) -> CineFrame:
        """A new frame. A frozen one shows the same tissue with the scanner set anew, and is not kept."""
        if self.frozen:
            view = take_view(self.rehearsal, controls.settings, None, self.tally)
            return self._sent(view, controls.settings)
        pose = self.driver.move(controls)
        self._say(self.driver.take_said())
        view = take_view(self.rehearsal, controls.settings, pose, self.tally)
        if pose is not None:
            if self.rehearsal.notice:
                self._tell(self.rehearsal.notice)
                self._put_back_until = perf_counter() + PUT_BACK_S
            self._tell(self.driver.stepped(self.tally.step_ms[-1]))
        probe = probe_as_set(self.rehearsal.probe, controls.settings)
        self.instruments.watch(self.driver.session, probe, pose)
        self._announce(self.sweeping.watch(self.driver.session.time_s, view, probe))
        self._tell(self.driver.watch())
        frame = self._sent(view, controls.settings)
        self.cine.keep(frame)
        return frame

    def _sent(self, view: View, settings: Settings) -> CineFrame:
        """A view sent over the link, and with what the instruments read."""
        probe = probe_as_set(self.rehearsal.probe, settings)
        send_live(self.link, self.rehearsal, view, probe, self.driver.session.time_s)
        return CineFrame(perf_counter(), self.instruments.onto(view, settings), self.rehearsal.rest_grid())

    def _tell(self, news: str) -> None:
        if news:
            click.echo(self.keys.worded(news))
