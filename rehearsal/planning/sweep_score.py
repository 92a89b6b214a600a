"""The score of a sweep: its terms, their weighted sum, and sentences that explain it."""

from dataclasses import dataclass

import numpy as np

from ultrasound.probe_manipulator import ProbeManipulator

# For each term: the points per unit (full coverage of the target gives 100, costs are subtracted), the verb
# phrase, the factor from the value to the one that is printed, and the format of that.
WORDING = {
    "seen": (100.0, "covers {} of the target", 100, "{:.0f} %"),
    "compression_mean_mm": (-3.0, "compresses the tissue by {} on average", 1, "{:.1f} mm"),
    "compression_max_mm": (0.0, "by {} at most", 1, "{:.1f} mm"),
    "over_limit": (-50.0, "exceeds the compression limit at {} of its poses", 100, "{:.0f} %"),
    "contact": (5.0, "has contact on {} of the array", 100, "{:.0f} %"),
    "incidence_deg": (-0.2, "has a mean angle of incidence of {}", 1, "{:.0f} degrees"),
    "path_mm": (-0.01, "has a path of {}", 1, "{:.0f} mm"),
}
# A sweep with unreachable poses scores less than any sweep without.
UNREACHABLE = -300.0


@dataclass(frozen=True)
class ScoreTerms:
    """What a sweep achieves and costs, under the names of the plan file.

    Means are over its poses; all are 0 without poses.
    """

    seen: float = 0.0
    """Coverage: fraction of the target that was in the image plane under contact, 0 to 1."""
    compression_mean_mm: float = 0.0
    compression_max_mm: float = 0.0
    over_limit: float = 0.0
    """Fraction of poses with more compression than the scene's warning, or with a state restored by the
    divergence check.
    """
    contact: float = 0.0
    """Fraction of the scanlines in contact."""
    incidence_deg: float = 0.0
    """Mean angle between the probe's axis and the normal of the settled surface."""
    path_mm: float = 0.0
    """Path length of the centre of the array face, including the moves between passes."""
    time_s: float = 0.0
    reachable: float = 0.0
    """Fraction of poses that an instrument through the trocar can hold."""


# The terms that are means over a sweep's poses.
MEANS = ("compression_mean_mm", "over_limit", "contact", "incidence_deg")


@dataclass(frozen=True)
class TriedPass:
    """``parameters`` (n,) of a pass, scaled to 0 to 1, and what it does alone: ``seen`` (p,), sampled places
    of the target, and its ``path_mm``.

    ``sums`` (4,) are the ``MEANS``, summed over its ``poses``.
    """

    parameters: np.ndarray
    seen: np.ndarray
    sums: np.ndarray
    poses: int
    path_mm: float


def face_centres(manipulator: ProbeManipulator, poses: np.ndarray) -> np.ndarray:
    """The centres (n, 3) of the array face at poses (n, 4, 4) [mm]."""
    return poses[:, :3, 3] - manipulator.size_mm[2] / 2 * poses[:, :3, 2]


def path_mm(manipulator: ProbeManipulator, poses: np.ndarray) -> float:
    """The path length of the centre of the array face."""
    return float(np.linalg.norm(np.diff(face_centres(manipulator, poses), axis=0), axis=1).sum())


def incidence_deg(manipulator: ProbeManipulator, poses: np.ndarray) -> float:
    """The mean angle between the probe's axis and the normal of the settled surface."""
    normals = manipulator.surface_normals(face_centres(manipulator, poses))
    cosine = np.einsum("ij,ij->i", normals, poses[:, :3, 2])
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean())


def points(terms: ScoreTerms) -> dict[str, float]:
    """The points of each term, by name."""
    by_name = {name: weight * getattr(terms, name) for name, (weight, *_) in WORDING.items()}
    if terms.reachable < 1.0:
        by_name["reachable"] = UNREACHABLE * (1.0 + (1.0 - terms.reachable))
    return by_name


def score(terms: ScoreTerms) -> float:
    """The sum of the points; more is better."""
    return sum(points(terms).values())


def in_words(terms: ScoreTerms) -> str:
    """All terms in one clause that begins with "it"."""
    *phrases, last = (_phrase(terms, name) for name in WORDING)
    return f"it {', '.join(phrases)}, and {last}"


def why_better(winner: ScoreTerms, other: ScoreTerms) -> str:
    """The largest advantage and disadvantage of the winner, in one clause that begins with "it"."""
    if other.reachable < 1.0 <= winner.reachable:
        return f"it is reachable at all poses, the other is not at {100 * (1 - other.reachable):.0f} %"
    a, b = points(winner), points(other)
    gains = sorted(((a[name] - b[name], name) for name in WORDING), reverse=True)
    (most, best), (least, worst) = gains[0], gains[-1]
    text = f"it {_phrase(winner, best)} instead of {_value(other, best)} ({most:+.1f} points)"
    if least < -0.05:
        text += f", although it {_phrase(winner, worst)} instead of {_value(other, worst)} ({least:+.1f})"
    return text


def _phrase(terms: ScoreTerms, name: str) -> str:
    return WORDING[name][1].format(_value(terms, name))


def _value(terms: ScoreTerms, name: str) -> str:
    _, _, factor, unit = WORDING[name]
    return unit.format(getattr(terms, name) * factor)
