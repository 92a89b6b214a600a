"""Replay a recorded session, bit for bit: a source of its commands, and an observer that compares the
tissue.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import click
import numpy as np
from tqdm import tqdm

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.live_settings import LiveSettings, with_recorded
from rehearsal.loop.command import Bookmark, Checkpoint, Command, Load, SetValues
from rehearsal.loop.frame import Digest, Frame, Refused
from rehearsal.loop.protocols import Observer, Stepper
from rehearsal.loop.state import History, WholeState
from rehearsal.loop.timeline import SETTLED
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.notices import Notices
from rehearsal.sessions.packed_arrays import StateError, unpack_state
from rehearsal.sessions.session_file import ROUNDING_S, Log, SessionError, history_after, makes_state
from render.viewer import Controls
from ultrasound.probe import Probe

# A replay that is further behind the clock than this goes on from there.
MOST_DUE_S = 0.25


class Replay:
    """A ``Source``: the commands of a log in real time, or ``one_by_one``, with a state for each frame.

    ``place`` is the index of the next command. Raises SessionError where the log's states belong to another
    body.
    """

    def __init__(self, log: Log, one_by_one: bool = False) -> None:
        self.log, self._one_by_one = log, one_by_one
        self._ends_s = log.ends_s
        self.place = 0
        self.bookmarks = 0
        self._due_s = 0.0

    @property
    def is_over(self) -> bool:
        """Whether all commands were given."""
        return self.place >= len(self.log.commands)

    @property
    def time_s(self) -> float:
        """Simulated time [s] of the commands that were given."""
        return float(self._ends_s[self.place - 1]) if self.place else 0.0

    @property
    def status(self) -> str:
        """For the window."""
        return f"Replay {self.time_s:.0f} s: {{take_over}} takes control"

    def begin(self, positions: np.ndarray, seconds: float = 0.0) -> Iterator[Command]:
        """The commands that restore the last recorded state before a time [s] from which the rest can be
        replayed.

        ``positions`` (n, 3) are those of the body. Raises SessionError.
        """
        log = self.log
        if log.header.begins is not None:
            yield Load(state=self._state(log.header.begins, positions))
        self.place, kept = self._start(log.place_at(seconds))
        if self.place == 0:
            return
        history, values = History(), dict[str, Any]()
        for number, command in log.commands[: self.place]:
            history, _ = history_after(history, number, command)
            if isinstance(command, SetValues):
                values |= command.values
        # Files of earlier versions have no state of an attempt.
        attempts = tuple(state for state in history.attempts if state in log.states)
        history, kept = replace(history, attempts=attempts), kept | set(attempts)
        number = self._number_at(self.place)
        yield SetValues(values=values)
        yield Load(
            state=self._state(log.states[number], positions),
            number=number,
            time_s=self.time_s,
            history=history,
            kept={other: self._state(log.states[other], positions) for other in kept},
        )

    def commands(self, frame: Frame, controls: Controls[LiveSettings], elapsed_s: float) -> Iterator[Command]:
        """As ``Source.commands``: those of a time [s], unless the steps before are not made yet.

        Raises SessionError.
        """
        self.check(frame)
        if self._one_by_one:
            yield from self._next()
            return
        self._due_s = min(self._due_s + elapsed_s, MOST_DUE_S)
        if self.time_s - frame.time_s > MOST_DUE_S:
            return
        until_s = self.time_s + self._due_s
        while not self.is_over and self.time_s < until_s - ROUNDING_S:
            before_s = self.time_s
            yield from self._next()
            self._due_s -= self.time_s - before_s
            if self.time_s == before_s:
                # What a command restores has a frame of its own, which takes its time.
                self._due_s = 0.0
                return

    def check(self, frame: Frame) -> None:
        """Raises SessionError where a command of the log was refused."""
        for event in frame.events:
            if isinstance(event, Refused):
                raise SessionError(
                    f"the session's {event.command.kind} cannot be repeated: {event.reason}; its file is "
                    "damaged, or of another body"
                )

    def until(self, seconds: float) -> Iterator[tuple[Command, ...]]:
        """The commands up to a time [s], as many at a time as there are up to a move."""
        last = self.log.place_at(seconds)
        while self.place < last:
            yield tuple(self._next(last))

    def frames_until(self, place: int) -> int:
        """How often ``commands`` gives what comes before the command of a place, ``one_by_one``."""
        commands = self.log.commands[self.place : place]
        states = sum(makes_state(command) for _, command in commands)
        return states + (len(commands) > 0 and not makes_state(commands[-1][1]))

    def _next(self, last: int | None = None) -> Iterator[Command]:
        """The commands up to the next state."""
        commands = self.log.commands
        last = len(commands) if last is None else last
        while self.place < last:
            command = commands[self.place][1]
            self.place += 1
            self.bookmarks += isinstance(command, Bookmark)
            yield command
            if makes_state(command):
                break
        if self.is_over:
            # As at the end of the recording.
            yield Checkpoint()

    def _number_at(self, place: int) -> int:
        return self.log.commands[place][0] if place < len(self.log.commands) else self.log.last_number

    def _start(self, most: int) -> tuple[int, set[int]]:
        """The place at most so far from which the rest can be replayed, and the recorded states before it
        that the rest restores.
        """
        log, restored = self.log, self.log.restored()
        places = {self._number_at(place): place for place in range(most, -1, -1)}
        for number in sorted((n for n in log.states if n in places), reverse=True):
            place = places[number]
            later = {to for at, to, _ in restored if at >= place and to != SETTLED and to < number}
            if later <= log.states.keys():
                return place, later
        return 0, set()

    def _state(self, text: str, positions: np.ndarray) -> WholeState:
        try:
            return unpack_state(text, positions)
        except StateError as error:
            raise SessionError(f"the session holds {error}: it is damaged, or of another body") from None


class ReplayCheck:
    """An ``Observer`` that compares a replay with its log, and says once where the tissue differs.

    ``differs_s`` is the time [s] from which on it does, None where it does not; ``digest`` is that of the
    last comparison, at a time ``compared_s``.
    """

    def __init__(self, log: Log, notices: Notices) -> None:
        self.log, self._notices = log, notices
        self.compared_s = 0.0
        self._compared: set[int] = set()
        self.digest = ""
        self.differs_s: float | None = None
        self._is_over = False

    @property
    def compared(self) -> int:
        """The number of states that were compared."""
        return len(self._compared)

    def observe(self, frame: Frame, probe: Probe) -> None:
        """As ``Observer.observe``, until another session begins."""
        self._is_over = self._is_over or frame.begins is not None
        for event in frame.events:
            if not self._is_over and isinstance(event, Digest) and event.number in self.log.digests:
                self._compare(event, frame.time_s)

    def _compare(self, event: Digest, time_s: float) -> None:
        self._compared.add(event.number)
        self.compared_s, self.digest = time_s, event.digest
        if self.differs_s is None and event.digest != self.log.digests[event.number]:
            self.differs_s = time_s
            self._notices.post(f"Warning: from {time_s:.0f} s on the tissue differs from the recorded one.")


def open_session(
    replay: Replay,
    at_s: float,
    stepper: Stepper,
    anatomy: DeformedAnatomy,
    settings: LiveSettings,
    measurements: LiveMeasurements,
    observers: list[Observer],
) -> LiveSettings:
    """Take a rehearsal to a time [s] of a session: the tissue, the measurements and the coverage until then;
    return the settings of that time.

    Raises SessionError, UserError.
    """

    def apply(commands: Iterable[Command]) -> Frame:
        nonlocal settings
        for command in commands:
            if isinstance(command, SetValues):
                settings = with_recorded(settings, command.values)
            stepper.submit(command)
        stepper.wait()
        frame = stepper.newest()
        replay.check(frame)
        anatomy.show(frame)
        anatomy.find_plane(settings.probe)
        return frame

    frame = apply(replay.begin(anatomy.frame.positions, at_s))
    begins, aim = frame.number, replay.log.place_at(at_s)
    if not measurements.recall(replay.log, begins):
        click.echo(
            f"Warning: the session has no record of the coverage until {replay.time_s:.0f} s; coverage and "
            "summary begin there."
        )
    for commands in tqdm(replay.until(at_s), desc=f"to {at_s:g} s", total=aim, unit="step", disable=aim == 0):
        frame = apply(commands)
        for observer in observers:
            observer.observe(frame, settings.probe)
    return settings
