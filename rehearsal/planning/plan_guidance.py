"""A plan followed by hand: where the probe is to go next, and how well it went there."""

from dataclasses import dataclass

import numpy as np

from rehearsal.planning.plan_file import Plan
from rehearsal.planning.plan_poses import passes_in
from rehearsal.planning.score_terms import faces_of
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.session import Session
from render.viewer import Guidance
from ultrasound.probe_manipulator import advanced, indentation

# A probe farther than this from the sweep is elsewhere; nearer than that to a pose it is there.
NEAR_MM, THERE_MM = 6.0, 1.0
# A turn beside the sweep by so many degrees is as far beside it as one millimetre.
DEG_BESIDE_A_MM = 3.0
# So many poses are looked ahead for the one that the probe is at.
AHEAD = 6
# So far above the organ the way is drawn.
ABOVE_MM = 1.5


@dataclass(frozen=True)
class _Gone:
    """How far a sweep was followed: the next pose, and how far from each pose the probe was (``PlanGuidance``)."""

    at: int
    off: np.ndarray
    far: np.ndarray


@dataclass
class PlanGuidance:
    """The sweep of a plan that is shown, and the way along it so far. ``number`` says which sweep; one past the last is none."""

    rehearsal: Rehearsal
    plan: Plan
    number: int = 0

    def __post_init__(self) -> None:
        self.begin_anew()

    def begin_anew(self) -> None:
        """Nothing of the sweep was gone yet."""
        self.at = 0
        self._kept: dict[int, _Gone] = {}
        shown = self.number < len(self.plan.sweeps)
        passes = passes_in(self.rehearsal, self.plan.sweeps[self.number]) if shown else []
        self._poses = np.concatenate(passes) if shown else np.zeros((0, 4, 4))
        # How far the probe was from each pose when it was nearest to it, in mm and degrees, and both together.
        self._off, self._far = np.zeros((len(self._poses), 2)), np.full(len(self._poses), np.inf)
        drawn = [np.stack([self._above(pose) for pose in each]) for each in passes]
        segments = [np.stack([each[:-1], each[1:]], axis=1) for each in drawn]
        # The pose at the end of each segment, by its place in the whole sweep.
        starts = np.cumsum([0] + [len(each) for each in drawn])
        ends = [start + np.arange(1, len(each)) for start, each in zip(starts, drawn, strict=False)]
        self._segments = np.concatenate(segments) if segments else np.zeros((0, 2, 3))
        self._ends = np.concatenate(ends) if ends else np.zeros(0, int)

    def _above(self, pose: np.ndarray) -> np.ndarray:
        """The face's middle (3,) as far outside as the settled organ reaches there."""
        manipulator = self.rehearsal.manipulator
        depth = indentation(pose, manipulator.size_mm, manipulator.samples, manipulator.radius_mm)
        return faces_of(manipulator, advanced(pose, -max(depth, 0.0) - ABOVE_MM)[None])[0]

    def next_sweep(self) -> str:
        """Show the plan's next sweep, after the last none; what there is to say."""
        self.number = (self.number + 1) % (len(self.plan.sweeps) + 1)
        self.begin_anew()
        return self.said()

    def said(self) -> str:
        """Which sweep is shown, for the user."""
        if self.number == len(self.plan.sweeps):
            return "Plan hidden"
        sweep = self.plan.sweeps[self.number]
        return f"Plan {self.number + 1}: {sweep.name}, sees {100 * sweep.parts['seen']:.0f} %"

    def go_with(self, session: Session) -> None:
        """Watch a session's last moment; one that went back takes what was gone of the sweep back too."""
        now = _Gone(self.at, self._off, self._far)
        kept = dict.fromkeys(session.kept_states, now) | self._kept
        if session.rolled_back_to is not None:
            then = kept.get(session.rolled_back_to, now)
            self.at, self._off, self._far = then.at, then.off, then.far
        self._kept = {moment: kept[moment] for moment in session.kept_states}
        self.watch(self.rehearsal.pose)

    def watch(self, pose: np.ndarray) -> None:
        """Where the transducer is now (4, 4)."""
        first = max(self.at - AHEAD, 0)
        off = self._distance(pose, self._poses[first : self.at + AHEAD])
        far = off[:, 0] + off[:, 1] / DEG_BESIDE_A_MM
        places = first + np.flatnonzero(far < self._far[first : self.at + AHEAD])
        # What was kept of them stays as it is.
        self._off, self._far = self._off.copy(), self._far.copy()
        self._off[places], self._far[places] = off[places - first], far[places - first]
        ahead = far[self.at - first :]
        if len(ahead) and ahead.min() <= NEAR_MM:
            nearest = self.at + int(np.argmin(ahead))
            is_at_end = nearest == first + int(np.argmin(far)) == len(self._poses) - 1
            self.at = nearest + int(is_at_end or ahead.min() <= THERE_MM)

    def _distance(self, pose: np.ndarray, others: np.ndarray) -> np.ndarray:
        """How far a pose is from others (n, 4, 4): of the face's middle [mm], and of the turn [degrees]; (n, 2)."""
        manipulator = self.rehearsal.manipulator
        away = np.linalg.norm(faces_of(manipulator, others) - faces_of(manipulator, pose[None]), axis=1)
        cosine = (np.einsum("nij,ij->n", others[:, :3, :3], pose[:3, :3]) - 1) / 2
        return np.column_stack([away, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))])

    @property
    def followed(self) -> float:
        """Share of the sweep that is behind, 0 to 1."""
        return self.at / len(self._poses) if len(self._poses) else 0.0

    def figures(self) -> dict[str, float | None]:
        """For the record; nothing where no sweep is shown."""
        if len(self._poses) == 0:
            return {}
        off = self._beside() or (None, None)
        return dict(plan_followed=self.followed, plan_off_mm=off[0], plan_off_deg=off[1])

    def _beside(self) -> tuple[float, float] | None:
        """How far beside the sweep the probe went, on average (mm, degrees); None where it did not yet."""
        if self.at == 0:
            return None
        off_mm, off_deg = self._off[: self.at].mean(axis=0)
        return float(off_mm), float(off_deg)

    def findings(self) -> dict[str, str]:
        """For the window."""
        if len(self._poses) == 0:
            return {}
        off = self._beside()
        beside = f"{off[0]:.1f} mm {off[1]:.0f} deg" if off else ""
        return {"plan": f"{100 * self.followed:.0f} %", "off plan": beside}

    def guidance(self) -> Guidance | None:
        """What is drawn of it."""
        if len(self._poses) == 0:
            return None
        goal = self._poses[self.at] if self.at < len(self._poses) else None
        return Guidance(goal, self._segments, self._ends < self.at)

    def in_words(self, seen: float | None) -> str:
        """How it went, for the terminal; ``seen`` is the share of the target that was seen. Empty where no sweep is shown."""
        if len(self._poses) == 0:
            return ""
        sweep = self.plan.sweeps[self.number]
        text = f"plan      {sweep.name}: {100 * self.followed:.0f} % of it followed"
        if off := self._beside():
            text += f", {off[0]:.1f} mm and {off[1]:.0f} degrees beside it"
        if seen is not None:
            text += (
                f"; {self.plan.target} seen {100 * seen:.0f} % (planned {100 * sweep.parts['seen']:.0f} %)"
            )
        return text
