"""One figure out of what a way was worth, and in words why one is better than another."""

from studies.plan.parts import Parts

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
SAID = {
    "seen": "sees {:.0f} % of the target",
    "compression_mean_mm": "squeezes {:.1f} mm",
    "over_limit": "is over the limit at {:.0f} % of its poses",
    "contact": "touches with {:.0f} % of its lines",
    "incidence_deg": "looks {:.0f} degrees aside of square",
    "path_mm": "is {:.0f} mm long",
}
SHARES = ("seen", "over_limit", "contact")


def points(parts: Parts) -> dict[str, float]:
    """What each part adds, by name."""
    found = {name: weight * getattr(parts, name) for name, weight in POINTS.items()}
    if parts.reachable < 1.0:
        found["reachable"] = UNREACHABLE * (1.0 + (1.0 - parts.reachable))
    return found


def score(parts: Parts) -> float:
    """The sum of the points; more is better."""
    return sum(points(parts).values())


def in_words(parts: Parts) -> str:
    """All parts in one line."""
    return ", ".join(_said(parts, name) for name in POINTS)


def why(winner: Parts, other: Parts) -> str:
    """What decided between two, and what the other had for it."""
    if other.reachable < 1.0 <= winner.reachable:
        return f"the other cannot be reached at {100 * (1 - other.reachable):.0f} % of its poses"
    a, b = points(winner), points(other)
    gains = sorted(((a[name] - b[name], name) for name in POINTS), reverse=True)
    most, name = gains[0]
    text = f"it {_said(winner, name)}, the other {_said(other, name)} ({most:+.1f} points)"
    least, name = gains[-1]
    if least < -0.05:
        text += f"; the other {_said(other, name)}, it {_said(winner, name)} ({least:+.1f})"
    return text


def _said(parts: Parts, name: str) -> str:
    return SAID[name].format(getattr(parts, name) * (100 if name in SHARES else 1))
