"""The kinds of pass that a sweep is made of: each has a few parameters with ranges, which define a pass
over the organ.
"""

from dataclasses import dataclass

import numpy as np

from rehearsal.planning.sweep_path import FAR_MM, frame_towards, pose_over, sliding, tilting, turned
from rehearsal.planning.sweep_trial import Trial
from ultrasound.probe_manipulator import ProbeManipulator

# Directions sampled around the organ; the smallest cosine of one to "above"; the smallest angle between two
# sides.
DIRECTIONS, LEAST_COSINE, APART_DEG = 300, 0.1, 20.0
# A sweep has at most a few passes; where more are needed side by side, as for a whole kidney, as many, up to
# the most.
FEW_PASSES, MOST_PASSES = 4, 6
# A target that is a single voxel counts as so wide.
LEAST_MM = 0.1
# Depth of an unplanned sweep below the settled surface: the middle of the range of a scene's press.
DEFAULT_DEPTH_MM = 3.0
# For each parameter its least and greatest value, and those at the beginning of a search. Places are relative
# to half of the target's extent, across the pass and along it.
COMMON = {
    "lean_deg": (-40.0, 40.0, -25.0, 25.0),
    "lean_aside_deg": (-40.0, 40.0, -25.0, 25.0),
    "heading_deg": (-90.0, 90.0, -90.0, 90.0),
    "aside": (-1.0, 1.0, -1.0, 1.0),
    "depth_mm": (0.0, 6.0, 0.3, 4.0),
}
RANGES = {
    "slide": COMMON
    | {
        "start": (-1.4, 1.4, -1.3, -0.6),
        "end": (-1.4, 1.4, 0.6, 1.3),
        "follow": (0.0, 1.0, 0.0, 1.0),
    },
    "tilt": COMMON
    | {
        "ahead": (-1.0, 1.0, -1.0, 1.0),
        "first_deg": (-45.0, 45.0, -45.0, -20.0),
        "last_deg": (-45.0, 45.0, 20.0, 45.0),
    },
}


@dataclass(frozen=True)
class PassKind:
    """Passes of a ``motion``, "slide" or "tilt", on one side of the organ.

    ``frame`` (4, 4) is at the centre of the target, with z towards that side; ``half_mm`` (2,) is half of the
    target's extent along its x and y, ``width_mm`` the width of the image there.
    """

    side: str
    motion: str
    frame: np.ndarray
    half_mm: np.ndarray
    width_mm: float

    def name(self, count: int) -> str:
        """The name of a sweep of so many passes."""
        if self.motion == "slide":
            return f"{'one pass' if count == 1 else f'{count} passes'} {self.side}"
        return f"tilting in {'one place' if count == 1 else f'{count} places'} {self.side}"

    def values(self, scaled: np.ndarray) -> dict[str, float]:
        """Name -> value of parameters (n,) that are scaled to 0 to 1; others are clipped."""
        pairs = zip(RANGES[self.motion].items(), np.clip(scaled, 0.0, 1.0), strict=True)
        return {name: float(low + share * (high - low)) for (name, (low, high, *_)), share in pairs}

    def scaled(self, values: dict[str, float]) -> np.ndarray:
        """Parameters (n,), scaled to 0 to 1."""
        ranges = RANGES[self.motion].items()
        return np.array([(values[name] - low) / (high - low) for name, (low, high, *_) in ranges])

    def poses(self, manipulator: ProbeManipulator, values: dict[str, float]) -> np.ndarray | None:
        """The poses (n, 4, 4) of the pass with these parameters; None beside the organ."""
        frame = turned(self.frame, (values["lean_deg"], values["lean_aside_deg"]), values["heading_deg"])
        across, along = self.extent_mm(values["heading_deg"])
        aside, depth = np.array([values["aside"] * across]), values["depth_mm"]
        if self.motion == "slide":
            ends = values["start"] * along, values["end"] * along
            passes = sliding(manipulator, frame, aside, *ends, depth, values["follow"])
        else:
            angles = values["first_deg"], values["last_deg"]
            passes = tilting(manipulator, frame, aside, values["ahead"] * along, angles, depth)
        return passes[0] if passes else None

    def extent_mm(self, heading_deg: float) -> tuple[float, float]:
        """Half of the target's extent across and along passes of a heading."""
        cosine, sine = np.abs([np.cos(np.radians(heading_deg)), np.sin(np.radians(heading_deg))])
        x, y = self.half_mm
        return float(x * cosine + y * sine), float(y * cosine + x * sine)

    @property
    def most_passes(self) -> int:
        """The most passes of a sweep."""
        return max(FEW_PASSES, min(self.needed(0.0), self.needed(90.0)))

    def needed(self, heading_deg: float) -> int:
        """How many passes of a heading, side by side, cover the width of the target."""
        return int(np.clip(np.ceil(2 * self.extent_mm(heading_deg)[0] / self.width_mm), 1, MOST_PASSES))

    def rows(self) -> list[np.ndarray]:
        """Straight passes side by side over the whole target, in two headings and two numbers: their
        parameters.
        """
        middle = {name: (low + high) / 2 for name, (_, _, low, high) in RANGES[self.motion].items()}
        rows = []
        for heading in (0.0, 90.0):
            across, count = max(self.extent_mm(heading)[0], LEAST_MM), self.needed(heading)
            for number in (count, count + 1):
                apart = min(self.width_mm / across, 2 / number)
                for aside in apart * (np.arange(number) - (number - 1) / 2):
                    own = dict(heading_deg=heading, aside=float(aside), lean_deg=0.0, lean_aside_deg=0.0)
                    rows.append(self.scaled(middle | own | ({"follow": 0.0} if "follow" in middle else {})))
        return rows

    def random(self, random: np.random.Generator, count: int) -> list[np.ndarray]:
        """Random parameters for the beginning of a search; half of the passes run backwards."""
        ranges = RANGES[self.motion]
        ends = ("start", "end") if self.motion == "slide" else ("first_deg", "last_deg")
        beginnings = []
        for number in range(count):
            values = {name: random.uniform(low, high) for name, (_, _, low, high) in ranges.items()}
            if number % 2:
                values[ends[0]], values[ends[1]] = values[ends[1]], values[ends[0]]
            beginnings.append(self.scaled(values))
        return beginnings


def kinds_of(trial: Trial) -> list[PassKind]:
    """Kinds of pass that may show the target: sliding from above, sliding and tilting from the side
    nearest to it.
    """
    above = -np.array(trial.case.press.direction)
    outwards = {"from above": above}
    nearest = nearest_side(trial)
    if nearest is not None and nearest @ above < np.cos(np.radians(APART_DEG)):
        outwards["from the nearest side"] = nearest
    seen_from = {side: target_from(trial, outward)[:3] for side, outward in outwards.items()}
    kinds = [PassKind(side, "slide", *seen) for side, seen in seen_from.items()]
    side, seen = list(seen_from.items())[-1]
    return [*kinds, PassKind(side, "tilt", *seen)]


def target_from(trial: Trial, outward: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, int]:
    """The target as seen from a direction (3,), for passes over it.

    The frame (4, 4) at its centre, half of its extent (2,) across and along the passes, the width of the
    image at the centre with the probe on the surface above it, and how many passes cover the extent.
    """
    frame = frame_towards(trial.places.mean(axis=0), outward, np.array(trial.case.press.lateral))
    half = np.abs((trial.places - frame[:3, 3]) @ frame[:3, :2]).max(axis=0)
    outward, centre = frame[:3, 2], frame[:3, 3]
    top = trial.manipulator.ray_hit(centre + FAR_MM * outward, -outward)
    depth = 0.0 if top is None else max(float((top - centre) @ outward), 0.0)
    probe = trial.case.probe
    width = float(probe.number_of_scanlines * probe.line_spacing_mm(np.array([depth]))[0])
    return frame, half, width, int(np.clip(np.ceil(2 * half[0] / width), 1, MOST_PASSES))


def nearest_side(trial: Trial) -> np.ndarray | None:
    """The direction (3,) from the target to the nearest surface where a probe can be placed; None where
    there is none.
    """
    manipulator, press, centre = trial.manipulator, trial.case.press, trial.places.mean(axis=0)
    least, nearest = np.inf, None
    for outward in directions(DIRECTIONS):
        place = manipulator.ray_hit(centre + FAR_MM * outward, -outward)
        if outward @ -np.array(press.direction) < LEAST_COSINE or place is None:
            continue
        distance = float((place - centre) @ outward)
        if distance < least:
            frame = frame_towards(centre, outward, np.array(press.lateral))
            pose = pose_over(manipulator, frame, 0.0, 0.0, 0.0, 1.0)
            if pose is not None and trial.reach(pose[None])[0]:
                least, nearest = distance, outward
    return nearest


def directions(count: int) -> np.ndarray:
    """Unit vectors (n, 3) evenly over a sphere: a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])
