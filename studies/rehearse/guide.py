"""A plan followed by hand: where the probe is to go next, and how well it went there."""

from dataclasses import dataclass

import numpy as np

from render.viewer import Guidance
from studies.freehand.unsqueeze import shifted
from studies.plan.file import Plan
from studies.plan.parts import faces_of
from studies.rehearsal import Rehearsal
from ultrasound.probe import advanced, held_at, indentation

# Nearer to the sweep than this in place, or in angle, it is followed; half of both is as near.
NEAR_MM, NEAR_DEG = 6.0, 18.0
# So many poses on from where the probe was it may be now.
AHEAD = 6
# So far above the organ the way is drawn.
ABOVE_MM = 1.5


@dataclass
class Guide:
    """The sweep of a plan that is shown, and the way along it so far. ``number`` says which sweep; one past the last is none."""

    rehearsal: Rehearsal
    plan: Plan
    number: int = 0

    def __post_init__(self) -> None:
        self.begin_anew()

    def begin_anew(self) -> None:
        """Nothing of the sweep was gone yet."""
        # Which pose the probe was at last, and how near each that it was at came: (mm, degrees).
        self.at = -1
        self._off: dict[int, tuple[float, float]] = {}
        shown = self.number < len(self.plan.sweeps)
        length, origin = self.rehearsal.size_mm[2], self.rehearsal.origin
        passes = [
            np.stack([held_at(shifted(pose, -origin), length) for pose in each])
            for each in (self.plan.sweeps[self.number].poses() if shown else [])
        ]
        self._poses = np.concatenate(passes) if shown else np.zeros((0, 4, 4))
        self._faces = faces_of(self.rehearsal.hand, self._poses)
        drawn = [np.stack([self._above(pose) for pose in each]) for each in passes]
        segments = [np.stack([each[:-1], each[1:]], axis=1) for each in drawn]
        # The pose at the end of each segment, by its place in the whole sweep.
        starts = np.cumsum([0] + [len(each) for each in drawn])
        ends = [start + np.arange(1, len(each)) for start, each in zip(starts, drawn, strict=False)]
        self._segments = np.concatenate(segments) if segments else np.zeros((0, 2, 3))
        self._ends = np.concatenate(ends) if ends else np.zeros(0, int)

    def _above(self, pose: np.ndarray) -> np.ndarray:
        """The face's middle (3,) as far outside as the settled organ reaches there."""
        hand = self.rehearsal.hand
        depth = indentation(pose, hand.size_mm, hand.samples, hand.radius_mm)
        return faces_of(hand, advanced(pose, -max(depth, 0.0) - ABOVE_MM)[None])[0]

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

    def watch(self, pose: np.ndarray) -> None:
        """Where the transducer is now (4, 4)."""
        first = max(self.at, 0)
        window = slice(first, first + AHEAD + 1)
        if len(self._poses) == 0:
            return
        off_mm = np.linalg.norm(self._faces[window] - faces_of(self.rehearsal.hand, pose[None]), axis=1)
        cosine = (np.einsum("nij,ij->n", self._poses[window, :3, :3], pose[:3, :3]) - 1) / 2
        off_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        off = off_mm / NEAR_MM + off_deg / NEAR_DEG
        nearest = int(np.argmin(off))
        if off[nearest] <= 1.0:
            self.at = first + nearest
            beside = float(off_mm[nearest]), float(off_deg[nearest])
            self._off[self.at] = min(beside, self._off.get(self.at, beside))

    @property
    def followed(self) -> float:
        """Share of the sweep that is behind, 0 to 1."""
        return (self.at + 1) / len(self._poses) if len(self._poses) else 0.0

    def figures(self) -> dict[str, float | None]:
        """For the record; nothing where no sweep is shown."""
        if len(self._poses) == 0:
            return {}
        off = self._beside() or (None, None)
        return dict(plan_followed=self.followed, plan_off_mm=off[0], plan_off_deg=off[1])

    def _beside(self) -> tuple[float, float] | None:
        """How far beside the sweep the probe went, on average (mm, degrees); None where it did not yet."""
        if not self._off:
            return None
        off_mm, off_deg = np.mean(list(self._off.values()), axis=0)
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
        goal = self._poses[self.at + 1] if self.at + 1 < len(self._poses) else None
        return Guidance(goal, self._segments, self._ends <= self.at)

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
