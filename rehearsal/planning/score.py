"""One figure out of what a way was worth, and in words why one is better than another."""

from rehearsal.planning.score_terms import ScoreTerms

# Points for each part: the whole target seen is 100, and what it costs is taken off.
POINTS = {
    "seen": 100.0,
    "compression_mean_mm": -3.0,
    "over_limit": -50.0,
    "contact": 5.0,
    "incidence_deg": -0.2,
    "path_mm": -0.01,
}
# A way that cannot be gone is worth less than any that can.
UNREACHABLE = -300.0
# What a part says of a sweep, and its figure.
SAID = {
    "seen": ("sees {} of the target", "{:.0f} %"),
    "compression_mean_mm": ("squeezes the tissue by {} on average", "{:.1f} mm"),
    "over_limit": ("is over the limit of squeezing at {} of its poses", "{:.0f} %"),
    "contact": ("has contact on {} of the probe's face", "{:.0f} %"),
    "incidence_deg": ("stands {} off square to the surface", "{:.0f} degrees"),
    "path_mm": ("goes a way of {}", "{:.0f} mm"),
}
SHARES = ("seen", "over_limit", "contact")


def points(parts: ScoreTerms) -> dict[str, float]:
    """What each part adds, by name."""
    found = {name: weight * getattr(parts, name) for name, weight in POINTS.items()}
    if parts.reachable < 1.0:
        found["reachable"] = UNREACHABLE * (1.0 + (1.0 - parts.reachable))
    return found


def score(parts: ScoreTerms) -> float:
    """The sum of the points; more is better."""
    return sum(points(parts).values())


def in_words(parts: ScoreTerms) -> str:
    """All parts of a sweep in one sentence, of which it is the subject."""
    *said, last = (_said(parts, name) for name in POINTS)
    return f"it {', '.join(said)}, and {last}"


def why(winner: ScoreTerms, other: ScoreTerms) -> str:
    """What decided between two in one sentence, of which the winner is the subject, and what the other had for it."""
    if other.reachable < 1.0 <= winner.reachable:
        return (
            f"it can be reached everywhere, the other not at {100 * (1 - other.reachable):.0f} % of its poses"
        )
    a, b = points(winner), points(other)
    gains = sorted(((a[name] - b[name], name) for name in POINTS), reverse=True)
    most, name = gains[0]
    text = f"it {_compared(winner, other, name)} ({most:+.1f} points)"
    least, name = gains[-1]
    if least < -0.05:
        text += f", though it {_compared(winner, other, name)} ({least:+.1f})"
    return text


def _compared(winner: ScoreTerms, other: ScoreTerms, name: str) -> str:
    return f"{_said(winner, name)} rather than {_figure(other, name)}"


def _said(parts: ScoreTerms, name: str) -> str:
    return SAID[name][0].format(_figure(parts, name))


def _figure(parts: ScoreTerms, name: str) -> str:
    return SAID[name][1].format(getattr(parts, name) * (100 if name in SHARES else 1))
