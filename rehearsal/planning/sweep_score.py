"""The score of a sweep: its terms, their weighted sum, and sentences that explain it."""

from dataclasses import dataclass

import numpy as np

from ultrasound.probe_manipulator import ProbeManipulator

# Points per unit of each term: full coverage of the target gives 100, costs are subtracted.
POINTS = {
    "seen": 100.0,
    "compression_mean_mm": -3.0,
    "over_limit": -50.0,
    "contact": 5.0,
    "incidence_deg": -0.2,
    "path_mm": -0.01,
}
# A sweep with unreachable poses scores less than any sweep without.
UNREACHABLE = -300.0
# The verb phrase for each term, and the format of its value.
WORDING = {
    "seen": ("covers {} of the target", "{:.0f} %"),
    "compression_mean_mm": ("compresses the tissue by {} on average", "{:.1f} mm"),
    "over_limit": ("exceeds the compression limit at {} of its poses", "{:.0f} %"),
    "contact": ("has contact on {} of the array", "{:.0f} %"),
    "incidence_deg": ("has a mean angle of incidence of {}", "{:.0f} degrees"),
    "path_mm": ("has a path of {}", "{:.0f} mm"),
}
FRACTIONS = ("seen", "over_limit", "contact")


@dataclass(frozen=True)
class ScoreTerms:
    """What a sweep achieves and costs, under the names of the plan file. Means are over its poses."""

    seen: float
    """Coverage: fraction of the target that was in the image plane under contact, 0 to 1."""
    compression_mean_mm: float
    compression_max_mm: float
    over_limit: float
    """Fraction of poses with more compression than the scene's warning, or with a state restored by the divergence check."""
    contact: float
    """Fraction of the scanlines in contact."""
    incidence_deg: float
    """Mean angle between the probe's axis and the normal of the settled surface."""
    path_mm: float
    """Path length of the centre of the array face, including the moves between passes."""
    time_s: float
    reachable: float
    """Fraction of poses that an instrument through the trocar can hold."""

    @classmethod
    def zero(cls) -> "ScoreTerms":
        """The terms of a sweep without poses."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def face_centres(manipulator: ProbeManipulator, poses: np.ndarray) -> np.ndarray:
    """The centres (n, 3) of the array face at poses (n, 4, 4) [mm]."""
    return poses[:, :3, 3] - manipulator.size_mm[2] / 2 * poses[:, :3, 2]


def path_mm(manipulator: ProbeManipulator, poses: np.ndarray) -> float:
    """The path length of the centre of the array face."""
    return float(np.linalg.norm(np.diff(face_centres(manipulator, poses), axis=0), axis=1).sum())


def incidence_deg(manipulator: ProbeManipulator, poses: np.ndarray) -> float:
    """The mean angle between the probe's axis and the normal of the settled surface."""
    normals = np.stack([manipulator.surface_normal(face) for face in face_centres(manipulator, poses)])
    cosine = np.einsum("ij,ij->i", normals, poses[:, :3, 2])
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean())


def points(terms: ScoreTerms) -> dict[str, float]:
    """The points of each term, by name."""
    found = {name: weight * getattr(terms, name) for name, weight in POINTS.items()}
    if terms.reachable < 1.0:
        found["reachable"] = UNREACHABLE * (1.0 + (1.0 - terms.reachable))
    return found


def score(terms: ScoreTerms) -> float:
    """The sum of the points; more is better."""
    return sum(points(terms).values())


def in_words(terms: ScoreTerms) -> str:
    """All terms in one clause that begins with "it"."""
    *phrases, last = (_phrase(terms, name) for name in POINTS)
    return f"it {', '.join(phrases)}, and {last}"


def why_better(winner: ScoreTerms, other: ScoreTerms) -> str:
    """The largest advantage and disadvantage of the winner, in one clause that begins with "it"."""
    if other.reachable < 1.0 <= winner.reachable:
        return f"it is reachable at all poses, the other is not at {100 * (1 - other.reachable):.0f} %"
    a, b = points(winner), points(other)
    gains = sorted(((a[name] - b[name], name) for name in POINTS), reverse=True)
    most, name = gains[0]
    text = f"it {_comparison(winner, other, name)} ({most:+.1f} points)"
    least, name = gains[-1]
    if least < -0.05:
        text += f", although it {_comparison(winner, other, name)} ({least:+.1f})"
    return text


def _comparison(winner: ScoreTerms, other: ScoreTerms, name: str) -> str:
    return f"{_phrase(winner, name)} instead of {_value(other, name)}"


def _phrase(terms: ScoreTerms, name: str) -> str:
    return WORDING[name][0].format(_value(terms, name))


def _value(terms: ScoreTerms, name: str) -> str:
    return WORDING[name][1].format(getattr(terms, name) * (100 if name in FRACTIONS else 1))
