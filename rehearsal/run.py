"""A rehearsal from start to end: its input source, its recording, and its summary."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import click
import numpy as np
from click.exceptions import Exit

from rehearsal.asked_files import AskedFiles
from rehearsal.commands.command_line import STOPPED, CommandError
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.frame import Frames, WindowFrames
from rehearsal.headless import run_headless
from rehearsal.inputs.input_source import InputSource, ReplayInput, ScriptedInput
from rehearsal.inputs.user_input import UserInput
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.run_report import Tally
from rehearsal.measurements.session_summary import summary_text
from rehearsal.notices import Notices
from rehearsal.open_window import initial_settings
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.plans_in_window import PlanControl
from rehearsal.real_time.solver_process import SolverProcess
from rehearsal.real_time.start_times import StartTimes
from rehearsal.rehearsal import Rehearsal, RehearsalState
from rehearsal.resection.script import ResectionScript
from rehearsal.sessions.open_session import open_session
from rehearsal.sessions.recorder import SessionRecorder, record
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import Header, Log
from rehearsal.tracking.openigtlink_server import OpenIGTLinkServer
from rehearsal.tracking.pose_file import TimedPoses
from rehearsal.tracking.sweep_recording import SweepRecorder
from rehearsal.tracking.tracked_probe import PoseSource, played_pose
from render.viewer import Settings
from render.window import Window
from scenes.anatomy import LoadedAnatomy
from scenes.import_findings import open_warnings
from scenes.scene import EMBEDDED, SceneError
from scenes.terminal import shell_command
from scenes.tumour_complexity import complexity
from version import VERSION


@dataclass
class RehearsalRun:
    """One rehearsal, its anatomy, the backend's name, what the user asked for, and the files that were read for it.

    ``viewer`` is the window, if there is one, and ``solver`` makes its steps. ``build_s`` is the time that building took.
    """

    rehearsal: Rehearsal
    anatomy: LoadedAnatomy
    arch: str
    asked: RehearseOptions
    files: AskedFiles
    viewer: Window | None = None
    solver: SolverProcess | None = None
    link: OpenIGTLinkServer | None = None
    build_s: float = 0.0
    start: StartTimes = field(default_factory=StartTimes)
    recorder: SessionRecorder | None = field(default=None, init=False)
    notices: Notices = field(default_factory=Notices, init=False)

    def __post_init__(self) -> None:
        guide = None if self.files.plan is None else PlanGuidance(self.rehearsal, self.files.plan)
        self.measurements = LiveMeasurements(self.rehearsal, guide, self.files.bands)

    def in_window(self, prepare: Callable[[WindowFrames], None] = lambda frames: None) -> None:
        """Run in a window that shows the scene, after a replay if there is one; ``prepare`` is called with its frames before the first.

        Raises SessionError, SolverEnded.
        """
        if self.solver is None or self.viewer is None:
            raise ValueError("expected a window and the process of the solver")
        viewer = self.viewer
        replay = None if self.files.log is None else self._replay(self.files.log, viewer.settings)
        source = self._user_input() if replay is None else self._replay_input(replay)
        text = f"The window is open, {self.start.now_s:.0f} s after the start; {{help}} shows the keys, {{quit}} quits."
        click.echo(self.files.keys.worded(text))
        frames = WindowFrames(
            self.rehearsal,
            source,
            self.measurements,
            Tally(0.0),
            self.link,
            solver=self.solver,
            viewer=viewer,
            out=self.asked.out,
            notices=self.notices,
            sweeping=SweepRecorder(self.rehearsal, self.notices),
            plans=PlanControl(self.rehearsal, self.anatomy, self.measurements, self.asked.out, self.notices),
            keys=self.files.keys,
            resection_plan=self.files.resection_plan,
            warnings=self.files.warnings,
            folder=self.files.folder,
        )
        prepare(frames)
        try:
            with self._summarised(source, replay):
                frames.run()
        finally:
            frames.plans.stop()
            frames.sweeping.end()
            self.notices.present(self.files.keys.worded)

    def headless(self) -> None:
        """Run the scripted press, a replay or recorded poses to their end. Raises CommandError, SessionError."""
        settings = initial_settings(self.rehearsal)
        replay = None if self.files.log is None else self._replay(self.files.log, settings)
        source: InputSource
        if replay is not None:
            source, steps = self._replay_input(replay), self._replayed_steps(replay)
        elif self.files.track is not None:
            source, steps = self._tracked_input(self.files.track)
        else:
            source, steps = self._scripted_input()
        frames = Frames(
            self.rehearsal,
            source,
            self.measurements,
            Tally(self.build_s),
            self.link,
            self.files.resection_plan,
            self.files.warnings,
        )
        with self._summarised(source, replay):
            run_headless(
                frames,
                self.notices,
                steps,
                settings,
                self.arch,
                self.asked.out,
                not self.asked.no_pictures,
                self._about_patient(),
            )

    def _about_patient(self) -> dict[str, Any]:
        """The complexity of the tumour and the warnings of the import, for the report."""
        found = complexity(self.anatomy, self.rehearsal.scene.attachment.at_mm)
        return dict(
            complexity=None if found is None else found.figures(),
            import_warnings=list(self.files.warnings),
            acknowledged_warnings=list(self.files.acknowledged),
        )

    def _replayed_steps(self, replay: Replay) -> int:
        steps, seconds = len(replay.log.poses) - replay.session.step_index, self.asked.seconds
        if steps == 0:
            raise CommandError(
                f"the session has nothing after {self.asked.at:g} s: it is {replay.log.length_s:.1f} s long"
            )
        if seconds is None:
            return steps
        return max(1, replay.log.step_at(replay.time_s + seconds) - replay.session.step_index)

    def _tracked_input(self, track: TimedPoses) -> tuple[InputSource, int]:
        length_s = min(self.asked.seconds or np.inf, track.length_s)
        # One step at 0 s and one at the end.
        return self._user_input(), 1 + int(length_s / self._step_s + 1e-9)

    def _scripted_input(self) -> tuple[InputSource, int]:
        steps = max(1, round((self.asked.seconds or self.rehearsal.script_length_s()) / self._step_s))
        session = self._session()
        return ScriptedInput(session, self._record(session), steps), steps

    @property
    def _step_s(self) -> float:
        return self.rehearsal.settings.time_step_s

    def _session(self) -> Session:
        return Session(self.rehearsal, coverage=lambda: self.measurements.coverage)

    def _user_input(self, begins: RehearsalState | None = None) -> UserInput:
        session = self._session()
        recorder = self._record(session, begins)
        tracked: PoseSource | None = None
        script = None
        if self.files.track is not None:
            tracked = partial(played_pose, self.files.track, session)
            script = ResectionScript(list(self.files.track.actions))
        elif self.link is not None and self.asked.link_leads:
            tracked = self.link.received_pose.pose
        begun = begins is not None
        return UserInput(session, recorder, begun, tracked, script, self.notices, self.files.resection_plan)

    def _replay_input(self, replay: Replay) -> ReplayInput:
        return ReplayInput(replay, self._take_over, self.notices)

    def _take_over(self) -> UserInput:
        """The user continues where the replay is: in a new session."""
        self.rehearsal.manipulator.match(self.rehearsal.pose)
        self.rehearsal.settings.time_step_s = self.rehearsal.scene.solver.time_step_s
        self.measurements.restart()
        return self._user_input(self.rehearsal.snapshot())

    def _record(self, session: Session, begins: RehearsalState | None = None) -> SessionRecorder | None:
        try:
            self.recorder = record(session, self.anatomy, self.arch, self.asked.out, begins, self.notices)
        except OSError as error:
            click.echo(
                f"Warning: this session is not recorded: {self.asked.out} cannot be written to ({error.strerror})"
            )
        return self.recorder

    def _replay(self, log: Log, settings: Settings) -> Replay:
        _echo(replay_warning(log.header, self.arch))
        return open_session(log, self.asked.at, self.rehearsal, settings, self.measurements)

    @contextmanager
    def _summarised(self, source: InputSource, replay: Replay | None) -> Iterator[None]:
        """Print the summary at the end, also after Ctrl-C."""
        try:
            yield
        except KeyboardInterrupt:
            click.echo(f"\nStopped at {source.session.time_s:.1f} s; until then:")
            raise Exit(STOPPED) from None
        finally:
            self._end(source.bookmarks)
            _echo(_verdict(replay))

    def _save_page(self, report: dict[str, Any]) -> None:
        """Write the page of the resection, and print its figures."""
        from rehearsal.resection.resection_page import rows_of, save_page

        click.echo("\n".join(f"{name:<21}  {value}" for name, value in rows_of(report)))
        try:
            click.echo("Saved " + " and ".join(map(str, save_page(self.rehearsal, report, self.asked.out))))
        except OSError as error:
            click.echo(f"Warning: the page of the resection is not saved: {error.strerror}")

    def _resection(self) -> dict[str, Any] | None:
        """The figures of the resection; None without any."""
        if self.rehearsal.judgement is None:
            return None
        # Matplotlib takes half a second to import.
        from rehearsal.resection.resection_page import report_of

        warnings = self.files.warnings
        # Damaged since the start: the session must still end in order.
        with suppress(SceneError):
            warnings = open_warnings(self.files.scene, self.files.folder)
        return report_of(self.rehearsal, self.files.resection_plan) | dict(import_warnings=list(warnings))

    def _end(self, bookmarks: int) -> None:
        summary, report = self.measurements.summary(bookmarks), self._resection()
        click.echo(summary_text(summary))
        if report is not None:
            summary |= dict(resection=report)
        elif self.files.resection_plan is not None:
            click.echo("resection   nothing was cut: there is nothing to compare with the plan")
        guide = self.measurements.guide
        if guide is not None:
            _echo(guide.in_words(summary.get(f"seen_{guide.plan.target}")))
        if self.recorder is not None:
            self.recorder.close(summary)
        # After the session is safe.
        if report is not None:
            self._save_page(report)
        if self.recorder is not None:
            scene = [] if self.asked.scene == EMBEDDED else [self.asked.scene]
            again = shell_command("rehearse", *scene, "--replay", self.recorder.path)
            click.echo(self.recorder.fault or f"Recorded; replay it with: {again}")


def replay_warning(header: Header, arch: str) -> str:
    """Why a replay may differ in bits from the recording: another version or backend; empty if both are the same."""
    if header.version not in (None, VERSION):
        return (
            f"Warning: recorded by version {header.version}, replayed by {VERSION}: the results may differ."
        )
    if header.arch != arch:
        return f"Warning: recorded on {header.arch}, replayed on {arch}: the same up to rounding, not bit for bit."
    return ""


def _verdict(replay: Replay | None) -> str:
    """Whether a replay was the recorded session."""
    if replay is None or replay.compared == 0:
        return ""
    if replay.differs_s is not None:
        return (
            f"replay    differs from {replay.differs_s:.1f} s on: other bits, of another backend or version"
        )
    return f"replay    identical in all {replay.compared} states compared, to {replay.time_s:.1f} s; state {replay.state}"


def _echo(text: str) -> None:
    if text:
        click.echo(text)
