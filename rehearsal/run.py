"""A rehearsal from its first moment to its last: who leads it, what is recorded of it, and what is said at its end."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import time

import click
import numpy as np
from click.exceptions import Exit
from psutil import Process

from rehearsal.adaptive_iterations import AdaptiveIterations
from rehearsal.commands.command_line import STOPPED, CommandError
from rehearsal.commands.option_checks import origin_in_words
from rehearsal.frame import FrameLoop
from rehearsal.frame_view import open_viewer, settings_of
from rehearsal.headless import run_headless
from rehearsal.inputs.input_source import InputSource, ReplayInput, ScriptedInput
from rehearsal.inputs.user_input import UserInput
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.run_report import Tally
from rehearsal.measurements.session_summary import summary_text
from rehearsal.planning.plan_file import Plan
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.plans_in_window import Plans
from rehearsal.rehearsal import Rehearsal, RehearsalState
from rehearsal.sessions.open_session import opened
from rehearsal.sessions.recorder import SessionRecorder, record
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import Log
from rehearsal.tracking.openigtlink_server import Server
from rehearsal.tracking.pose_file import TimedPoses
from rehearsal.tracking.sweep_recording import Sweeping
from rehearsal.tracking.tracked_probe import PlayedPoses, Tracked
from render.gamepad import Gamepad, SdlPads
from render.keys import Keys
from render.viewer import Settings
from render.window import NoVulkan
from scenes.anatomy import LoadedAnatomy
from scenes.shell_quoting import pasted


@dataclass
class RehearsalRun:
    """One rehearsal, its anatomy, the folder for what comes of it, and what leads beside the mouse.

    ``tracked`` is a probe that is tracked now, ``track`` the way of one that was; ``scene`` is the path that the user named, if any.
    """

    rehearsal: Rehearsal
    anatomy: LoadedAnatomy
    arch: str
    out: Path
    budget_ms: float | None = None
    tracked: Tracked | None = None
    track: TimedPoses | None = None
    keys: Keys = field(default_factory=Keys)
    gamepad: bool = False
    link: Server | None = None
    plan: Plan | None = None
    scene: Path | None = None
    recorded: SessionRecorder | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        guide = None if self.plan is None else PlanGuidance(self.rehearsal, self.plan)
        self.instruments = LiveMeasurements(self.rehearsal, guide)

    def in_window(self, log: Log | None, at_s: float) -> None:
        """Led by the user, in a window; with a log by that first. Raises CommandError, SessionError."""
        pad = Gamepad(SdlPads(), self.keys.buttons) if self.gamepad else None
        try:
            viewer = open_viewer(self.rehearsal, visible=True, keys=self.keys, gamepad=pad)
        except NoVulkan as reason:
            raise CommandError(f"{reason}; install a Vulkan driver, or run with --headless") from None
        replay = None if log is None else self._replay(log, at_s, viewer.settings)
        driver: InputSource = self._live() if replay is None else ReplayInput(replay, self._take_over)
        sweeping = Sweeping(self.rehearsal)
        after_s = time() - Process().create_time()
        told = (
            f"The window is open, {after_s:.0f} s after the start; {{help}} shows the keys, {{quit}} quits."
        )
        click.echo(self.keys.worded(told))
        plans = Plans(self.rehearsal, self.anatomy, self.instruments, self.out)
        parts = driver, self.instruments, sweeping, plans
        loop = FrameLoop(self.rehearsal, viewer, self.out, Tally(0.0), *parts, keys=self.keys, link=self.link)
        try:
            with self._summed_up(driver, replay):
                loop.run()
        finally:
            viewer.close()
            plans.stop()
            _say(sweeping.end())

    def headless(
        self, log: Log | None, at_s: float, seconds: float | None, build_s: float, draws: bool = True
    ) -> None:
        """Led by the scene's script, a log, or a tracked file, as long as that is. Raises CommandError, SessionError."""
        rehearsal, settings = self.rehearsal, settings_of(self.rehearsal)
        replay = None if log is None else self._replay(log, at_s, settings)
        step_s = rehearsal.settings.time_step_s
        driver: InputSource
        if self.track is not None:
            length_s = self.track.length_s if seconds is None else min(seconds, self.track.length_s)
            # A moment at 0 s, and one at the end; no step is too slow, so that the bits do not turn on the machine.
            steps = 1 + int(length_s / step_s + 1e-9)
            driver = self._live(budget_ms=np.inf)
        elif replay is None:
            steps = max(1, round((seconds or rehearsal.script_length_s()) / step_s))
            session = self._session()
            driver = ScriptedInput(session, self._record(session), steps)
        else:
            steps = len(replay.log.poses) - replay.session.moment
            if seconds:
                steps = min(steps, max(1, round(seconds / step_s)))
            if steps == 0:
                raise CommandError(
                    f"the session has nothing after {at_s:g} s: it is {replay.log.length_s:.1f} s long"
                )
            driver = ReplayInput(replay, self._take_over)
        told = self.instruments, self.arch, self.out, build_s, draws, self.link
        with self._summed_up(driver, replay):
            run_headless(rehearsal, driver, steps, settings, *told)

    def _session(self) -> Session:
        return Session(self.rehearsal, seen=lambda: self.instruments.coverage.seen)

    def _live(self, begins: RehearsalState | None = None, budget_ms: float | None = None) -> UserInput:
        ladder = AdaptiveIterations(budget_ms or self.budget_ms or 1000 * self.rehearsal.settings.time_step_s)
        session = self._session()
        tracked = self.tracked if self.track is None else PlayedPoses(self.track, session)
        waits = begins is not None
        return UserInput(session, ladder, self._record(session, begins), waits=waits, tracked=tracked)

    def _take_over(self) -> UserInput:
        """The user leads on from where a replay is: a session of its own."""
        self.rehearsal.manipulator.match(self.rehearsal.pose)
        self.instruments.begin_anew()
        return self._live(self.rehearsal.snapshot())

    def _record(self, session: Session, begins: RehearsalState | None = None) -> SessionRecorder | None:
        try:
            self.recorded = record(session, self.anatomy, self.arch, self.out, begins)
        except OSError as error:
            click.echo(
                f"Mind: this session is not recorded: {self.out} cannot be written to ({error.strerror})"
            )
        return self.recorded

    def _replay(self, log: Log, at_s: float, settings: Settings) -> Replay:
        _say(origin_in_words(log.header, self.arch))
        return opened(log, at_s, self.rehearsal, settings, self.instruments)

    @contextmanager
    def _summed_up(self, driver: InputSource, replay: Replay | None) -> Iterator[None]:
        """Say at the end how it went, also where Ctrl-C is the end."""
        try:
            yield
        except KeyboardInterrupt:
            click.echo(f"\nStopped at {driver.session.time_s:.1f} s; until then:")
            raise Exit(STOPPED) from None
        finally:
            self._end(driver.bookmarks)
            _say(_verdict(replay))

    def _end(self, bookmarks: int) -> None:
        summary = self.instruments.summary(bookmarks)
        click.echo(summary_text(summary))
        guide = self.instruments.guide
        if guide is not None:
            _say(guide.in_words(summary.get(f"seen_{guide.plan.target}")))
        if self.recorded is not None:
            self.recorded.close(summary)
            told = f"SessionRecorder; replay it with: {self._replaying(self.recorded.recording.path)}"
            click.echo(self.recorded.recording.fault or told)

    def _replaying(self, session: Path) -> str:
        """The command line that replays a session, to be pasted."""
        scene = [] if self.scene is None else [self.scene]
        return pasted("rehearse", *scene, "--replay", session)


def _verdict(replay: Replay | None) -> str:
    """Whether a replay was the recorded session."""
    if replay is None or replay.compared == 0:
        return ""
    if replay.differs_s is not None:
        return (
            f"replay    differs from {replay.differs_s:.1f} s on: other bits, of another backend or version"
        )
    return f"replay    identical in all {replay.compared} states compared, to {replay.time_s:.1f} s; state {replay.state}"


def _say(text: str) -> None:
    if text:
        click.echo(text)
