"""A rehearsal from start to end: its source, its observers, its recording, and its summary."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import click
import numpy as np
from click.exceptions import Exit

from errors import UserError
from rehearsal.announcements import Announcements
from rehearsal.commands.command_line import STOPPED, CommandError
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.headless import HeadlessLoop, run_headless
from rehearsal.input_files import InputFiles
from rehearsal.live_settings import LiveSettings, initial_settings
from rehearsal.loop.command import Checkpoint, SetValues
from rehearsal.loop.frame import Applied, Checkpointed, Frame
from rehearsal.loop.protocols import Observer, Source, Stepper
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.run_report import Tally
from rehearsal.measurements.session_summary import summary_text
from rehearsal.notices import Notices
from rehearsal.page.session_images import SessionImages
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.plans_in_window import PlanControl
from rehearsal.quit_check import QuitCheck
from rehearsal.real_time.solver_process import SolverEnded
from rehearsal.real_time.start_times import StartTimes
from rehearsal.rehearsal import Rehearsal, script_length_s, scripted_pose
from rehearsal.resection.attempts import AttemptFigureList, attempts_text
from rehearsal.resection.resection_state import ResectionScript
from rehearsal.resection.resection_view import ResectionView
from rehearsal.sessions.packed_arrays import pack_seen
from rehearsal.sessions.recorder import SessionRecorder, header_of, next_path, number_of
from rehearsal.sessions.replay import Replay, ReplayCheck, open_session
from rehearsal.sessions.session_file import Header, Log
from rehearsal.sources.scripted import ReplaySource, ScriptedPress
from rehearsal.sources.tracker import Tracker, played_pose
from rehearsal.sources.user import UserSource
from rehearsal.tracking.openigtlink_server import OpenIGTLinkServer
from rehearsal.tracking.pose_file import TimedPoses
from rehearsal.vessel_kinds import unlabelled_in_words
from rehearsal.window_loop import WindowLoop
from rehearsal.window_panel import WindowPanel
from render.window import Window
from scenes.anatomy import LoadedAnatomy
from scenes.import_findings import import_remarks, open_warnings
from scenes.scene import EMBEDDED, SceneError
from scenes.terminal import shell_command
from scenes.tumour_complexity import complexity
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ProbeManipulator
from version import VERSION

# How long the last state may take to come from the solver's process.
LAST_STATE_S = 2.0


@dataclass
class Built:
    """A case ready to be rehearsed: its stepper, what a frame shows of it, and what moves the transducer;
    ``counts`` and ``serial`` are those of its tissue model. ``rehearsal`` is there where the steps are made
    in this process.
    """

    anatomy: DeformedAnatomy
    stepper: Stepper
    manipulator: ProbeManipulator
    counts: dict[str, int]
    serial: bool
    rehearsal: Rehearsal | None = None


@dataclass
class RehearsalRun:
    """One rehearsal, its anatomy as loaded, the backend's name, what the user asked for, and the files that
    were read for it.

    ``viewer`` is the window, if there is one. ``build_s`` is the time that building took.
    """

    built: Built
    loaded: LoadedAnatomy
    arch: str
    options: RehearseOptions
    files: InputFiles
    viewer: Window[LiveSettings] | None = None
    link: OpenIGTLinkServer | None = None
    build_s: float = 0.0
    start: StartTimes = field(default_factory=StartTimes)
    recording: "Recording | None" = field(default=None, init=False)
    notices: Notices = field(default_factory=Notices, init=False)

    def __post_init__(self) -> None:
        self.anatomy, self.manipulator = self.built.anatomy, self.built.manipulator
        plan = self.files.plan
        guide = None if plan is None else PlanGuidance(self.anatomy.case, self.manipulator, plan)
        self.measurements = LiveMeasurements(self.anatomy, self.manipulator, guide, self.files.bands)
        self.resection = ResectionView(self.anatomy, self.files.resection_plan)
        self.attempts = AttemptFigureList(self.anatomy, self.files.resection_plan)
        self.images = SessionImages()

    def in_window(self, prepare: Callable[[WindowLoop], None] = lambda loop: None) -> None:
        """Run in the window, after a replay if there is one; ``prepare`` is called with its loop before the
        first frame.

        Raises SessionError, SolverEnded.
        """
        if self.viewer is None:
            raise ValueError("expected a window")
        viewer, log = self.viewer, self.files.log
        check = None if log is None else ReplayCheck(log, self.notices)
        source = self._user() if log is None else self._replay_in_window(log, viewer, check)
        text = (
            f"The window is open, {self.start.now_s:.0f} s after the start; {{help}} shows the keys, "
            f"{{quit}} quits."
        )
        click.echo(self.files.keys.worded(text))
        self.notices.post(unlabelled_in_words(self.anatomy.vessel_kinds()), in_terminal=False)
        announcements = Announcements(self.anatomy, self.notices)
        plans = PlanControl(self.anatomy.case, self.loaded, self.measurements, self.options.out, self.notices)
        observers = self._observers(announcements, check)
        panel = WindowPanel(
            self.anatomy,
            source,
            self.measurements,
            self.resection,
            plans,
            self.notices,
            self.options.out,
            self.files.keys,
            self.built.counts,
            self.link,
            self.files.warnings,
            self.files.folder,
            self.attempts,
            QuitCheck(self.notices, self._acted_at),
            self.images,
        )
        loop = WindowLoop(
            viewer, self.built.stepper, source, self.anatomy, self.measurements, observers, panel
        )
        prepare(loop)
        try:
            with self._summarised(check):
                loop.run()
        finally:
            plans.stop()
            panel.sweeping.end()
            self.notices.present(self.files.keys.worded)

    def headless(self) -> None:
        """Run the scripted press, a replay or recorded poses to their end.

        Raises CommandError, SessionError.
        """
        rehearsal, log = self.built.rehearsal, self.files.log
        if rehearsal is None:
            raise ValueError("expected the solver in this process")
        settings = initial_settings(self.anatomy.case)
        source: Source
        check = None if log is None else ReplayCheck(log, self.notices)
        if log is not None:
            replay = Replay(log, one_by_one=True)
            settings = self._open(replay, settings, check)
            source, steps = replay, self._replayed_steps(replay)
        elif self.files.track is not None:
            source, steps = self._tracked(self.files.track)
        else:
            source, steps = self._scripted()
        loop = HeadlessLoop(
            rehearsal,
            source,
            self.measurements,
            self._observers(Announcements(self.anatomy, self.notices), check),
            settings,
            Tally(self.build_s),
            self.notices,
            self.resection,
            self.link,
            self.files.warnings,
            self.images,
        )
        with self._summarised(check):
            draws, about = not self.options.no_pictures, self._about_patient()
            plan, attempts = self.files.resection_plan, self.attempts
            run_headless(loop, steps, self.arch, self.options.out, draws, plan, about, attempts.report)

    def _observers(self, announcements: Announcements, check: ReplayCheck | None) -> list[Observer]:
        """Those of each frame, in this order: beside a whole state the coverage is recorded, with the
        image of that state.
        """
        self.recording = Recording(self, is_replay=check is not None)
        observers: list[Observer] = [self.measurements, self.recording, self.attempts, announcements]
        return observers if check is None else [*observers, check]

    def _about_patient(self) -> dict[str, Any]:
        """The complexity of the tumour and the warnings of the import, for the report."""
        of_tumour = complexity(self.loaded, self.anatomy.case.scene.attachment.at_mm)
        return dict(
            complexity=None if of_tumour is None else of_tumour.figures(),
            import_warnings=list(self.files.warnings),
            acknowledged_warnings=list(self.files.acknowledged),
        )

    def _replayed_steps(self, replay: Replay) -> int:
        """How many times around a replay takes."""
        last = len(replay.log.commands)
        if replay.place == last:
            raise CommandError(
                f"the session has nothing after {self.options.at:g} s: it is {replay.log.length_s:.1f} s long"
            )
        if self.options.seconds is not None:
            last = max(replay.log.place_at(replay.time_s + self.options.seconds), replay.place + 1)
        return max(1, replay.frames_until(last))

    def _tracked(self, track: TimedPoses) -> tuple[Source, int]:
        length_s = min(self.options.seconds or np.inf, track.length_s)
        # One step at 0 s and one at the end.
        return self._user(), 1 + int(length_s / self._step_s + 1e-9)

    def _scripted(self) -> tuple[Source, int]:
        case, manipulator = self.anatomy.case, self.manipulator
        length_s = script_length_s(case)
        steps = max(1, round((self.options.seconds or length_s) / self._step_s))

        def next_pose(share: float, pose: np.ndarray) -> np.ndarray:
            goal = scripted_pose(case, manipulator, length_s * share)
            return manipulator.pose_towards(goal, pose, self._step_s)

        return ScriptedPress(next_pose, steps), steps

    @property
    def _step_s(self) -> float:
        return self.anatomy.case.scene.solver.time_step_s

    def _user(self, waits: bool = False) -> UserSource:
        tracker = script = None
        case, track = self.anatomy.case, self.files.track
        if track is not None:
            tracker = Tracker(partial(played_pose, track), case)
            script = ResectionScript(list(track.actions))
        elif self.link is not None and self.options.link_leads:
            received = self.link.received_pose
            tracker = Tracker(lambda time_s: received.pose(), case)
        return UserSource(
            self.anatomy,
            self.manipulator,
            self.notices,
            tracker,
            script,
            self.files.resection_plan,
            lambda points: self.measurements.coverage.is_seen(points),
            waits,
        )

    def _replay_in_window(
        self, log: Log, viewer: Window[LiveSettings], check: ReplayCheck | None
    ) -> ReplaySource:
        replay = Replay(log)
        viewer.settings = self._open(replay, viewer.settings, check)
        return ReplaySource(replay, self._take_over, self.notices)

    def _take_over(self) -> UserSource:
        """The user continues where the replay is: in a new session."""
        self.manipulator.match(self.anatomy.pose)
        return self._user(waits=True)

    def _open(self, replay: Replay, settings: LiveSettings, check: ReplayCheck | None) -> LiveSettings:
        """Take the rehearsal to where the replay begins; return the settings there."""
        _echo(replay_warning(replay.log.header, self.arch))
        observers: list[Observer] = [self.measurements] if check is None else [self.measurements, check]
        return open_session(
            replay, self.options.at, self.built.stepper, self.anatomy, settings, self.measurements, observers
        )

    @contextmanager
    def _summarised(self, check: ReplayCheck | None) -> Iterator[None]:
        """Print the summary at the end, also after Ctrl-C."""
        try:
            yield
        except KeyboardInterrupt:
            click.echo(f"\nStopped at {self.anatomy.frame.time_s:.1f} s; until then:")
            raise Exit(STOPPED) from None
        finally:
            self._end()
            _echo(_verdict(check, self.anatomy.frame))

    def _acted_at(self) -> float | None:
        return None if self.recording is None else self.recording.action_at

    def _save_page(self, report: dict[str, Any], number: int) -> None:
        """Write the page of the resection of a session's number, and print its figures."""
        from rehearsal.resection.resection_page import rows_of, save_page

        click.echo("\n".join(f"{name:<21}  {value}" for name, value in rows_of(report)))
        try:
            files = save_page(self.anatomy, report, self.options.out, number)
            click.echo("Saved " + " and ".join(map(str, files)))
        except OSError as error:
            click.echo(f"Warning: the page of the resection is not saved: {error.strerror}")

    def _save_report(self, session: Path, summary: dict[str, Any], resection: dict[str, Any] | None) -> None:
        """Write the page of a recorded session for colleagues."""
        # With Matplotlib.
        from rehearsal.page.page_files import save_page_files

        about = summary, self.images, resection, self.attempts.table(), self._import_remarks()
        try:
            written = save_page_files(self.anatomy, self.loaded, session, *about)
        except (OSError, UserError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            click.echo(f"Warning: the page of the session is not saved: {reason}")
        else:
            others = ", ".join(path.name for path in written[1:])
            click.echo(f"Saved {written[0]} to open, print or send; for 3D programs and printers: {others}")

    def _import_remarks(self) -> list[str]:
        """What readers of the page must know of the patient's import."""
        with suppress(SceneError):
            return import_remarks(self.files.scene, self.files.folder)
        return [f"Warning of the import: {text}" for text in self.files.warnings]

    def _open_warnings(self) -> tuple[str, ...]:
        """Those of the import that nobody has acknowledged by now."""
        # Damaged since the start: the session must still end in order.
        with suppress(SceneError):
            return open_warnings(self.files.scene, self.files.folder)
        return self.files.warnings

    def _resection_report(self) -> dict[str, Any] | None:
        """The figures of the resection; None without any."""
        if self.anatomy.judgement is None:
            return None
        # Matplotlib takes half a second to import.
        from rehearsal.resection.resection_page import report_of

        figures = report_of(self.anatomy, self.files.resection_plan)
        return figures | dict(import_warnings=list(self._open_warnings()))

    def _end(self) -> None:
        bookmarks = len(self.anatomy.frame.bookmarks)
        summary, report = self.measurements.summary(bookmarks), self._resection_report()
        click.echo(summary_text(summary))
        _echo(attempts_text(self.attempts.figures))
        if self.attempts.figures:
            summary |= dict(attempts=self.attempts.report())
        if report is not None:
            summary |= dict(resection=report)
        elif self.files.resection_plan is not None:
            click.echo("resection   no cut at the end: there is nothing to compare with the plan")
        guide = self.measurements.guide
        if guide is not None:
            _echo(guide.in_words(summary.get(f"seen_{guide.plan.target}")))
        recorder = None if self.recording is None else self.recording.close(self.built.stepper, summary)
        # After the session is safe.
        if report is not None:
            path = next_path(self.options.out) if recorder is None else recorder.path
            self._save_page(report, number_of(path))
        if recorder is not None:
            if not recorder.fault:
                self._save_report(recorder.path, summary, report)
            scene = [] if self.options.scene == EMBEDDED else [self.options.scene]
            again = shell_command("rehearse", *scene, "--replay", recorder.path)
            click.echo(recorder.fault or f"Recorded; replay it with: {again}")


class Recording:
    """An ``Observer``: records each session of a run in a file of its own.

    A replay is not recorded, but what follows it is.
    """

    def __init__(self, run: RehearsalRun, is_replay: bool) -> None:
        self._run = run
        self.recorder: SessionRecorder | None = None
        # When the user acted last, by the clock [s]; None in a replay.
        self.action_at: float | None = None
        self._is_replay = is_replay
        if not is_replay:
            self._begin(None)

    def observe(self, frame: Frame, probe: Probe) -> None:
        """As ``Observer.observe``."""
        if frame.begins is not None:
            self._is_replay = False
            self._begin(frame.begins)
        events = () if self._is_replay else frame.of_session.events
        if any(isinstance(e, Applied) and not isinstance(e.command, SetValues) for e in events):
            self.action_at = perf_counter()
        if self.recorder is not None:
            self.recorder.observe(frame.of_session)

    def close(self, stepper: Stepper, summary: dict[str, Any]) -> SessionRecorder | None:
        """Record the last state, from which the session can be continued, and the summary."""
        if self.recorder is None:
            return None
        # A solver that has ended has no last state; what is recorded can be replayed without it.
        with suppress(SolverEnded):
            stepper.submit(Checkpoint())
            stepper.wait(LAST_STATE_S)
            self.recorder.observe(stepper.newest())
        self.recorder.close(summary)
        return self.recorder

    def _begin(self, event: Checkpointed | None) -> None:
        run = self._run
        case, begins = run.anatomy.case, None if event is None else event.state
        header = header_of(
            case, run.loaded, run.arch, run.built.serial, case.scene.solver.time_step_s, begins
        )
        try:
            self.recorder = SessionRecorder(
                next_path(run.options.out),
                header,
                run.notices,
                lambda: pack_seen(run.measurements.coverage.seen),
            )
        except OSError as error:
            self.recorder = None
            click.echo(
                f"Warning: this session is not recorded: {run.options.out} cannot be written to "
                f"({error.strerror})"
            )
        run.measurements.note = self._note
        run.images.clear()

    def _note(self, number: int, reading: dict[str, Any]) -> None:
        if self.recorder is not None:
            self.recorder.note(number, reading)


def replay_warning(header: Header, arch: str) -> str:
    """Why a replay may differ in bits from the recording: another version or backend; empty if both are
    the same.
    """
    if header.version not in (None, VERSION):
        return (
            f"Warning: recorded by version {header.version}, replayed by {VERSION}: the results may differ."
        )
    if header.arch != arch:
        return (
            f"Warning: recorded on {header.arch}, replayed on {arch}: the same up to rounding, not bit "
            "for bit."
        )
    return ""


def _verdict(check: ReplayCheck | None, frame: Frame) -> str:
    """Whether a replay was the recorded session."""
    if check is None or check.compared == 0:
        return ""
    if check.differs_s is not None:
        return f"replay    differs from {check.differs_s:.1f} s on: other bits, of another backend or version"
    return (
        f"replay    identical in all {check.compared} states compared, to {check.compared_s:.1f} s; "
        f"state {check.digest}"
    )


def _echo(text: str) -> None:
    if text:
        click.echo(text)
