"""The timeline, beside the solver: it applies commands, and keeps the states that undo, redo and bookmarks
restore.

It is deterministic: the same commands give the same states, events and bits, whoever gives them.
"""

import base64
from dataclasses import replace

import numpy as np

from errors import UserError
from rehearsal.loop.command import (
    BeginAction,
    Bookmark,
    Checkpoint,
    Command,
    CutOut,
    Follow,
    GoTo,
    Load,
    Mark,
    Move,
    NewSession,
    Pause,
    Recorded,
    Redo,
    Reset,
    SetValues,
    Undo,
)
from rehearsal.loop.frame import (
    Applied,
    Checkpointed,
    Digest,
    Event,
    Frame,
    Refused,
    RestGeometry,
    Step,
    whole_geometry,
)
from rehearsal.loop.state import History, WholeState
from rehearsal.pressed_organ import PressedOrgan
from rehearsal.resection.cut import Cut, CutSettings, check_hilum, hilum_of, part_cut_out, part_left
from rehearsal.resection.resection_state import NO_RESECTION, Attempt, CutRequest, Resection, cut_of
from rehearsal.resection.score_line import ResectionError
from settings import Value, with_values
from sim.fields import array_of
from sim.skinning import ClusterCarrier
from ultrasound.probe_manipulator import ManipulatorState

# The number of the state before the first: tissue settled, transducer just touching.
SETTLED = -1
# Simulated time between two digests, and between two whole states for a session's file.
DIGEST_S, CHECKPOINT_S = 1.0, 60.0
# The sections of settings that steps depend on.
STEPPED = "tissue", "solver", "gravity"
# Geometries of this many cuts are kept, for undo and redo.
KEPT_CUTS = 4


class Timeline:
    """The states of one organ.

    A command that cannot be applied changes nothing, and is an event with the reason.
    """

    def __init__(self, organ: PressedOrgan) -> None:
        self.organ = organ
        self.number, self.time_s = 0, 0.0
        self.history = History()
        self.resection = NO_RESECTION
        self.attempts: tuple[Attempt, ...] = ()
        self._manipulator: ManipulatorState | None = None
        self._kept = {SETTLED: WholeState(organ.snapshot())}
        self._whole = whole_geometry(organ.case, organ.model.carrier.interpolation)
        self._cuts: dict[Resection, RestGeometry] = {}
        self.geometry = self._whole
        self._made_cuts = 0
        # The state whose digest was recorded last.
        self._digested = SETTLED
        self._events: list[Event] = []
        self._noted_iterations = organ.settings.iterations
        # With the settings of tissue, solver and gravity that are in force.
        self.scene = organ.case.scene

    def submit(self, command: Command) -> None:
        """Apply a command at once. ``Follow`` is a step of the length that is set."""
        match command:
            case Move():
                self.step(command.pose, command.length_s, presses=command.presses)
            case Follow():
                self.aim(command)
                self.step(command.pose, presses=command.presses)
            case Checkpoint():
                self._checkpoint()
            case NewSession():
                self._begin_session(command.pose)
            case Load():
                self._load(command)
            case Pause():
                pass
            case _:
                self._try(command)

    def aim(self, command: Follow) -> None:
        """Note how the hand holds the transducer."""
        self._manipulator = command.manipulator or self._manipulator

    def step(
        self,
        hand: np.ndarray,
        length_s: float | None = None,
        iterations: int | None = None,
        input_s: float = 0.0,
        late_ms: float = 0.0,
        awaited: bool = False,
        presses: bool = True,
    ) -> Step:
        """Make a step of a length [s] with so many iterations, where given, in which the transducer follows a
        hand at a pose (4, 4), and return it; for the others see ``Step``.
        """
        settings = self.organ.settings
        length_s, iterations = length_s or settings.time_step_s, iterations or settings.iterations
        if iterations != self._noted_iterations:
            self._noted_iterations = iterations
            self._events.append(Applied(self.number, SetValues(values={"solver.iterations": iterations})))
        took_ms, wrench = self.organ.timed_step(hand, length_s, iterations, presses)
        of_step = length_s, iterations, took_ms, wrench, self.organ.notice, presses
        step = Step(self.number, self.organ.pose, hand, *of_step, input_s, late_ms, awaited)
        self._events.append(step)
        self._end_state(length_s)
        return step

    def newest(self, wait_s: float = 0.0) -> Frame:
        """The present state, with the events since the last call."""
        events, self._events = tuple(self._events), []
        organ, carrier = self.organ, self.organ.model.carrier
        load = organ.load()
        return Frame(
            number=self.number,
            time_s=self.time_s,
            pose=organ.pose,
            hand=organ.hand,
            positions=array_of(organ.body.position),
            frames=carrier.values() if isinstance(carrier, ClusterCarrier) else None,
            geometry=self.geometry,
            wrench=None if load is None else load.wrench,
            sliding_share=None if load is None else load.sliding_share,
            friction_ratio=None if load is None else load.friction_ratio,
            resection=self.resection,
            manipulator=self._manipulator,
            kept=frozenset(self._kept),
            bookmarks=self.history.bookmarks,
            attempts=self.attempts,
            events=events,
        )

    def wait(self, most_s: float = np.inf) -> None:
        """Nothing to wait for: commands are applied at once."""

    def whole_state(self) -> WholeState:
        """A copy of the present state."""
        return WholeState(self.organ.snapshot(), self.resection, self._manipulator)

    def _try(self, command: Recorded) -> None:
        """Apply a command that a session records, or say why it cannot be applied."""
        number = self.number
        try:
            restored = self._do(command)
        except UserError as error:
            self._events.append(Refused(number, command, str(error)))
            return
        self._events.append(Applied(number, command, restored))
        if isinstance(command, Mark | CutOut) or restored is not None:
            self._end_state()
        if isinstance(command, CutOut):
            self._keep_attempt()
        if isinstance(command, Bookmark | CutOut):
            self._checkpoint()

    def _do(self, command: Recorded) -> int | None:
        """Apply a command; return the number of the state that it restored, if it did.

        Raises UserError, and nothing has changed.
        """
        match command:
            case SetValues():
                self._set(command.values)
            case BeginAction():
                self._begin(command.manipulator)
            case Mark() | CutOut():
                self._operate(command)
            case Bookmark():
                self._keep()
                self.history = self.history.marked(self.number)
            case Undo():
                history, number = self.history.undo(self.number)
                return self._restore(history, number, "Nothing to undo")
            case Redo():
                history, number = self.history.redo(self.number)
                return self._restore(history, number, "Nothing to redo")
            case Reset():
                return self._restore(self.history.begun(self.number), SETTLED)
            case GoTo():
                is_known = command.state in self.history.marked_states
                number = command.state if is_known else None
                fault = "There is no such bookmark or attempt"
                return self._restore(self.history.begun(self.number), number, fault)
        return None

    def _set(self, values: dict[str, Value]) -> None:
        """Set what steps depend on; other settings are only recorded. Raises SettingError."""
        of_step = {path: value for path, value in values.items() if path.split(".")[0] in STEPPED}
        self.scene = with_values(self.scene, of_step)
        self.organ.set(self.scene.tissue, self.scene.solver, self.scene.gravity)
        self._noted_iterations = self.organ.settings.iterations

    def _begin(self, manipulator: ManipulatorState | None = None) -> None:
        """An action begins here."""
        self._keep(manipulator)
        self.history = self.history.begun(self.number)
        self._discard()

    def _operate(self, command: Mark | CutOut) -> None:
        """Set marks of the score, or cut. Raises ResectionError."""
        if isinstance(command, Mark):
            before = replace(self.resection, marks=()) if command.replaces else self.resection
            resection = before.with_marks(np.array(command.places_mm, float).reshape(-1, 3))
        else:
            resection = replace(self.resection, cut=self._request(command))
        geometry = self._geometry_of(resection)
        self._begin()
        self._show(resection, geometry)

    def _request(self, command: CutOut) -> CutRequest:
        """The cut of the tissue as it is now. Raises ResectionError."""
        if self.resection.cut is not None:
            raise ResectionError("the specimen is cut out already; undo the cut before you make another")
        if self.organ.case.tumour is None and command.depth_mm is None:
            raise ResectionError(
                "this patient has no tumour that would give the depth of the cut; set a depth"
            )
        self.organ.check_can_be_cut()
        settings = CutSettings(command.technique, command.margin_mm, command.depth_mm, command.filling)
        position = array_of(self.organ.body.position).tobytes()
        return CutRequest(settings, base64.b64decode(command.seen), position)

    def _geometry_of(self, resection: Resection) -> RestGeometry:
        """The geometry of a resection, whose cut is made if it was not.

        Raises ResectionError, PatientError.
        """
        case = self.organ.case
        if resection.cut is None:
            return self._whole
        if resection not in self._cuts and (cut := cut_of(resection, case.organ, case.tumour)) is not None:
            check_hilum(cut, case.organ, hilum_of(case.scene.attachment, case.origin))
            self._made_cuts += 1
            self._cuts = dict([*self._cuts.items(), (resection, self._after(cut))][-KEPT_CUTS:])
        return self._cuts[resection]

    def _after(self, cut: Cut) -> RestGeometry:
        """What a cut leaves; ``_show`` completes it with the interpolation. Raises PatientError."""
        whole = self._whole
        parts = {tissue: part_left(part, cut) for tissue, part in whole.parts.items()}
        tumour = None if whole.tumour is None else part_left(whole.tumour, cut, is_within=True)
        return replace(
            whole,
            version=self._made_cuts,
            organ=cut.remnant,
            tumour=tumour,
            parts={tissue: part for tissue, part in parts.items() if part is not None},
            cut=cut,
            tumour_cut_out=None if whole.tumour is None else part_cut_out(whole.tumour, cut),
        )

    def _show(self, resection: Resection, geometry: RestGeometry) -> None:
        """Have these marks of the score, and the tissue of a geometry. Raises ResectionError."""
        self.organ.apply_cut(geometry.cut)
        self.resection = resection
        self.geometry = replace(geometry, interpolation=self.organ.model.carrier.interpolation)

    def _restore(self, history: History, number: int | None, fault: str = "") -> int:
        """Restore the state of a number; ``history`` is the one afterwards.

        Raises UserError where there is none.
        """
        if number is None:
            raise UserError(fault)
        self._keep()
        self.history = history
        # First the tissue that is there: contact points that the cut moves lose their friction, which the
        # state then restores.
        state = self._kept[number]
        self._show(state.resection, self._geometry_of(state.resection))
        self.organ.restore(state.organ)
        self._manipulator = state.manipulator
        self._discard()
        return number

    def _keep_attempt(self) -> None:
        """Keep the present state as another attempt."""
        self._keep()
        self.history = self.history.attempted(self.number)
        attempt = Attempt(len(self.attempts) + 1, self.number, self.resection)
        self.attempts = (*self.attempts, attempt)

    def _keep(self, manipulator: ManipulatorState | None = None) -> None:
        """Keep the present state, with the manipulator's present state or another one."""
        if self.number not in self._kept:
            state = self.whole_state()
            self._kept[self.number] = replace(state, manipulator=manipulator or state.manipulator)

    def _discard(self) -> None:
        """Discard the states that nothing restores any more."""
        needed = {SETTLED, *self.history.numbers}
        self._kept = {number: state for number, state in self._kept.items() if number in needed}

    def _end_state(self, length_s: float | None = None) -> None:
        """Another state has been reached: by a step of a length [s], or by a command."""
        before, self.time_s = self.time_s, self.time_s + (length_s or 0.0)
        self.number += 1
        if length_s is None or periods(self.time_s, DIGEST_S) != periods(before, DIGEST_S):
            self._digest()
        if periods(self.time_s, CHECKPOINT_S) != periods(before, CHECKPOINT_S):
            self._checkpoint()

    def _digest(self) -> None:
        """Record the hash of the tissue, once for each state."""
        if self.number != self._digested:
            self._digested = self.number
            self._events.append(Digest(self.number, self.organ.digest()))

    def _checkpoint(self) -> None:
        """Record the whole state.

        It also becomes what the divergence check would restore, so that it is recorded once.
        """
        self._digest()
        self.organ.store_valid_state()
        state = self.whole_state()
        if self.number in self._kept:
            self._kept[self.number] = replace(state, manipulator=self._kept[self.number].manipulator)
        self._events.append(Checkpointed(self.number, state))

    def _begin_session(self, pose: np.ndarray | None) -> None:
        self.number, self.time_s, self.history, self.attempts = 0, 0.0, History(), ()
        self._digested = SETTLED
        self._noted_iterations = self.organ.settings.iterations
        if pose is None:
            self._kept = {SETTLED: self._kept[SETTLED]}
            self._events.append(Checkpointed(0, self.whole_state(), begins=True))
            return
        self.organ.place(pose)
        self.organ.divergence_check.set_initial_state()
        self._kept = {SETTLED: self.whole_state()}

    def _load(self, command: Load) -> None:
        """Continue from a recorded state, if it is one of this body."""
        like = _shapes_of(self._kept[SETTLED])
        if any(_shapes_of(state) != like for state in (command.state, *command.kept.values())):
            reason = "a state of another body, or a damaged one"
            self._events.append(Refused(self.number, command, reason))
            return
        self._show(command.state.resection, self._geometry_of(command.state.resection))
        self.organ.restore(command.state.organ)
        self.number, self.time_s, self.history = command.number, command.time_s, command.history
        self._kept = {SETTLED: self._kept[SETTLED]} | command.kept
        self.attempts = tuple(
            Attempt(count, number, self._kept[number].resection)
            for count, number in enumerate(self.history.attempts, 1)
        )


def _shapes_of(state: WholeState) -> list[tuple]:
    """The names, shapes and kinds of a state's arrays."""
    solvers = state.organ.solver, state.organ.divergence.good
    return [
        (name, values.shape, values.dtype.str)
        for solver in solvers
        for name, values in [("", solver.body.position), *sorted(solver.internal_state.items())]
    ]


def periods(time_s: float, period_s: float) -> int:
    """How many whole periods a sum of steps has lasted."""
    return int(time_s / period_s + 1e-6)
