"""A frame: all that anybody may look at, at one instant. It is frozen; a newer one takes its place."""

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh

from rehearsal.case import Case
from rehearsal.loop.command import Load, Recorded
from rehearsal.loop.state import WholeState
from rehearsal.resection.cut import Cut
from rehearsal.resection.resection_state import NO_RESECTION, Attempt, Resection
from sim.skinning import Interpolation
from ultrasound.probe_manipulator import ManipulatorState

# The sinus surrounds the other parts, and would hide them.
NOT_SHOWN = "sinus"
# A probe that is nearer to the hand than this follows it.
LEAST_LAG_MM = 1.0


@dataclass(frozen=True)
class RestGeometry:
    """The surfaces at rest [mm], of one version: a cut makes another one, and undo returns to the one before.

    ``organ`` is what remains after a ``cut``; ``tumour`` and ``parts`` are what the cut leaves of them, and
    ``tumour_cut_out`` is what came with the specimen.
    ``interpolation`` is for points of the tissue that is there, ``whole`` for those of the whole organ.
    """

    version: int
    organ: trimesh.Trimesh
    tumour: trimesh.Trimesh | None
    parts: dict[str, trimesh.Trimesh]
    interpolation: Interpolation
    whole: Interpolation
    cut: Cut | None = None
    tumour_cut_out: trimesh.Trimesh | None = None


@dataclass(frozen=True)
class Step:
    """A step that was made from the state of a number: the transducer's pose (4, 4) at its end, that of the
    ``hand`` which it follows, its length [s], its iterations, the time that it took [ms], the wrench (6,) on
    the probe. ``notice`` is the divergence check's, if it restored the state. Unless the transducer
    ``presses``, it only touches.

    Where steps follow a clock, ``input_s`` is the time of the input that the pose shows, ``late_ms`` how much
    later than due the step began, and ``awaited`` says whether it waited for its input, because steps had to
    become long.
    """

    number: int
    pose: np.ndarray
    hand: np.ndarray
    length_s: float
    iterations: int
    took_ms: float
    wrench: np.ndarray | None = None
    notice: str = ""
    presses: bool = True
    input_s: float = 0.0
    late_ms: float = 0.0
    awaited: bool = False


@dataclass(frozen=True)
class Applied:
    """A command that was applied to the state of a number.

    ``restored`` is the number of the state that it restored, if it did.
    """

    number: int
    command: Recorded
    restored: int | None = None


@dataclass(frozen=True)
class Refused:
    """A command that was not applied to the state of a number, and why."""

    number: int
    command: Recorded | Load
    reason: str


@dataclass(frozen=True)
class Digest:
    """A hash of the tissue in the state of a number."""

    number: int
    digest: str


@dataclass(frozen=True)
class Checkpointed:
    """The whole state of a number, for a session's file; ``begins`` a session."""

    number: int
    state: WholeState
    begins: bool = False


Event = Step | Applied | Refused | Digest | Checkpointed


@dataclass(frozen=True)
class Frame:
    """The newest state, and the events since the frame before.

    ``number`` counts the states since the session began: each step and each command that changes the tissue
    makes another one. ``positions`` (n, 3) [mm] are those of nodes or particles, ``frames`` (k, 4, 4) those
    of clusters where the tissue model has them. ``hand`` (4, 4) is the pose that the transducer follows, and
    ``pose`` where the tissue lets it be. ``wrench`` (6,): force [N] on the probe, and torque [N mm]
    about the centre of the array face (LPS); ``sliding_share`` and ``friction_ratio`` are those of
    ``sim.surface_contact.ContactLoad``. ``kept`` are the numbers of the states that undo, redo and
    ``bookmarks`` may restore; ``attempts`` are the cuts of this session, undone or not. ``pace`` says how
    steps differ from what is set.
    """

    number: int
    time_s: float
    pose: np.ndarray
    hand: np.ndarray
    positions: np.ndarray
    geometry: RestGeometry
    frames: np.ndarray | None = None
    wrench: np.ndarray | None = None
    sliding_share: float | None = None
    friction_ratio: float | None = None
    resection: Resection = NO_RESECTION
    manipulator: ManipulatorState | None = None
    kept: frozenset[int] = frozenset()
    bookmarks: tuple[int, ...] = ()
    attempts: tuple[Attempt, ...] = ()
    pace: str = ""
    events: tuple[Event, ...] = field(default=(), repr=False)

    @property
    def carriers(self) -> np.ndarray:
        """What a ``Carrier`` of this geometry takes over."""
        return self.positions if self.frames is None else self.frames

    @property
    def lag_mm(self) -> float:
        """How far the transducer is behind the hand."""
        return float(np.linalg.norm(self.hand[:3, 3] - self.pose[:3, 3]))

    @property
    def of_session(self) -> "Frame":
        """The same, without the events of a session that has ended."""
        begins = [
            n for n, event in enumerate(self.events) if isinstance(event, Checkpointed) and event.begins
        ]
        return replace(self, events=self.events[begins[-1] + 1 :]) if begins else self

    @property
    def begins(self) -> Checkpointed | None:
        """The event with which a session began since the frame before, if one did."""
        events = [event for event in self.events if isinstance(event, Checkpointed) and event.begins]
        return events[-1] if events else None

    @property
    def present_attempt(self) -> Attempt | None:
        """The attempt whose cut the tissue has; None without a cut."""
        made = [attempt for attempt in self.attempts if attempt.resection == self.resection]
        return made[-1] if made else None

    @property
    def steps(self) -> list[Step]:
        """The steps since the frame before."""
        return [event for event in self.events if isinstance(event, Step)]

    @property
    def notices(self) -> list[str]:
        """What the user is to know of the events: states that were restored, commands that were refused."""
        refused = [event.reason for event in self.events if isinstance(event, Refused)]
        return [*(step.notice for step in self.steps if step.notice), *refused]

    @property
    def restored(self) -> list[int]:
        """The numbers of the states that were restored since the frame before."""
        return [
            event.restored
            for event in self.events
            if isinstance(event, Applied) and event.restored is not None
        ]


def whole_geometry(case: Case, interpolation: Interpolation) -> RestGeometry:
    """The surfaces of a case before any cut."""
    parts = {tissue: part for tissue, part in case.parts.items() if tissue != NOT_SHOWN}
    return RestGeometry(0, case.organ, case.tumour, parts, interpolation, interpolation)


def at_rest(case: Case, interpolation: Interpolation) -> Frame:
    """A frame of the anatomy as it was segmented, with the transducer at the scripted press."""
    values = interpolation.carrier().values()
    positions, frames = (values, None) if values.ndim == 2 else (np.zeros((0, 3), np.float32), values)
    geometry = whole_geometry(case, interpolation)
    return Frame(0, 0.0, case.press_pose, case.press_pose, positions, geometry, frames)
