"""The kinds of sweep that a plan chooses from; each has a few parameters with ranges, which define a path over the organ."""

from dataclasses import dataclass

import numpy as np

from rehearsal.planning.sweep_path import FAR_MM, frame_towards, pose_over, sliding, tilting, turned
from rehearsal.planning.sweep_trial import Trial
from ultrasound.probe_manipulator import ProbeManipulator

# Directions sampled around the organ; the smallest cosine of one to "above"; the smallest angle between two sides.
DIRECTIONS, LEAST_COSINE, APART_DEG = 300, 0.1, 20.0
MOST_PASSES = 6
# Depth of an unplanned sweep below the settled surface: the middle of the range of a scene's press.
DEFAULT_DEPTH_MM = 3.0


@dataclass(frozen=True)
class SweepCandidate:
    """``motion`` is "slide" or "tilt", ``count`` the number of passes, ``frame`` (4, 4) theirs before the parameters rotate it.

    ``ranges`` are the least, the greatest and the default value of each parameter.
    """

    side: str
    motion: str
    count: int
    frame: np.ndarray
    ranges: dict[str, tuple[float, float, float]]

    def name(self, count: int) -> str:
        """The name of its sweep with so many passes."""
        if self.motion == "slide":
            return f"{'one pass' if count == 1 else f'{count} passes'} {self.side}"
        return f"tilting in {'one place' if count == 1 else f'{count} places'} {self.side}"

    def start(self) -> np.ndarray:
        """The default parameters (n,), scaled to 0 to 1."""
        return np.array([(start - low) / (high - low) for low, high, start in self.ranges.values()])

    def values(self, scaled: np.ndarray) -> dict[str, float]:
        """Name -> value of parameters (n,) that are scaled to 0 to 1; others are clipped."""
        pairs = zip(self.ranges.items(), np.clip(scaled, 0.0, 1.0), strict=True)
        return {name: float(low + share * (high - low)) for (name, (low, high, _)), share in pairs}

    def path(self, manipulator: ProbeManipulator, values: dict[str, float]) -> list[np.ndarray]:
        """The passes that the parameters define."""
        frame = turned(self.frame, (values["lean_deg"], values["lean_aside_deg"]), values["heading_deg"])
        rows = np.arange(self.count) - (self.count - 1) / 2
        aside = values["aside_mm"] + values.get("apart_mm", 0.0) * rows
        if self.motion == "slide":
            along = values["start_mm"], values["end_mm"]
            return sliding(manipulator, frame, aside, *along, values["depth_mm"], values["follow"])
        angles = values["first_deg"], values["last_deg"]
        return tilting(manipulator, frame, aside, values["ahead_mm"], angles, values["depth_mm"])


def candidates_of(trial: Trial) -> list[SweepCandidate]:
    """Candidates that may cover the target: from above and from the side nearest to it, sliding and tilting."""
    above = -np.array(trial.rehearsal.press.direction)
    outwards = {"from above": above}
    nearest = nearest_side(trial)
    if nearest is not None and nearest @ above < np.cos(np.radians(APART_DEG)):
        outwards["from the nearest side"] = nearest
    found = []
    for side, outward in outwards.items():
        frame, half, width, count = target_from(trial, outward)
        kinds = [("slide", count)]
        if side == list(outwards)[-1]:
            kinds += [("slide", count + 1), ("tilt", count)]
        found += [
            SweepCandidate(side, motion, passes, frame, _ranges(motion, passes, half, width))
            for motion, passes in kinds
            if passes <= MOST_PASSES
        ]
    return found


def target_from(trial: Trial, outward: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, int]:
    """The target as seen from a direction (3,), for passes over it.

    The frame (4, 4) at its centre, half of its extent (2,) across and along the passes, the width of the image at the centre with the
    probe on the surface above it, and how many passes cover the extent.
    """
    frame = frame_towards(trial.places.mean(axis=0), outward, np.array(trial.rehearsal.press.lateral))
    half = np.abs((trial.places - frame[:3, 3]) @ frame[:3, :2]).max(axis=0)
    outward, centre = frame[:3, 2], frame[:3, 3]
    top = trial.rehearsal.manipulator.ray_hit(centre + FAR_MM * outward, -outward)
    depth = 0.0 if top is None else max(float((top - centre) @ outward), 0.0)
    probe = trial.rehearsal.probe
    width = float(probe.number_of_scanlines * probe.line_spacing_mm(np.array([depth]))[0])
    return frame, half, width, int(np.clip(np.ceil(2 * half[0] / width), 1, MOST_PASSES))


def nearest_side(trial: Trial) -> np.ndarray | None:
    """The direction (3,) from the target to the nearest surface where a probe can be placed; None where there is none."""
    manipulator, press, centre = trial.rehearsal.manipulator, trial.rehearsal.press, trial.places.mean(axis=0)
    least, found = np.inf, None
    for outward in directions(DIRECTIONS):
        place = manipulator.ray_hit(centre + FAR_MM * outward, -outward)
        if outward @ -np.array(press.direction) < LEAST_COSINE or place is None:
            continue
        distance = float((place - centre) @ outward)
        if distance < least:
            frame = frame_towards(centre, outward, np.array(press.lateral))
            pose = pose_over(manipulator, frame, 0.0, 0.0, 0.0, 1.0)
            if pose is not None and trial.reach(pose[None])[0]:
                least, found = distance, outward
    return found


def directions(count: int) -> np.ndarray:
    """Unit vectors (n, 3) evenly over a sphere: a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def _ranges(motion: str, count: int, half: np.ndarray, width: float) -> dict[str, tuple[float, float, float]]:
    """The ranges of a motion's parameters; the defaults of "slide" are straight rows."""
    aside, ahead = half
    ranges = {
        "lean_deg": (-40.0, 40.0, 0.0),
        "lean_aside_deg": (-40.0, 40.0, 0.0),
        "heading_deg": (-90.0, 90.0, 0.0),
        "aside_mm": (-aside, aside, 0.0),
    }
    if motion == "slide":
        ranges |= {
            "start_mm": (-1.4 * ahead, 0.0, -ahead),
            "end_mm": (0.0, 1.4 * ahead, ahead),
            "follow": (0.0, 1.0, 0.0),
            "depth_mm": (0.0, 6.0, DEFAULT_DEPTH_MM),
        }
    else:
        ranges |= {
            "ahead_mm": (-ahead, ahead, 0.0),
            "first_deg": (-45.0, 0.0, -30.0),
            "last_deg": (0.0, 45.0, 30.0),
            "depth_mm": (0.0, 6.0, 1.5),
        }
    return ranges if count == 1 else ranges | {"apart_mm": (0.4 * width, 1.1 * width, width)}
