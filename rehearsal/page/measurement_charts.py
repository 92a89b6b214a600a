"""Measurements of a session over time, as small charts in SVG."""

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape

import numpy as np

from rehearsal.loop.command import CutOut
from rehearsal.sessions.session_file import Log, makes_state

WIDTH, HEIGHT = 300, 118
LEFT, RIGHT, TOP, BOTTOM = 34, 12, 20, 18
# Steps between the numbers of an axis, times a power of ten.
STEPS = (1.0, 2.0, 5.0, 10.0)
MOST_TICKS = 4
# Less than this [mm or N] would fill a chart with what is next to nothing.
LEAST_SCALE = 1.0
# A session of an hour has more measurements than a chart has pixels.
MOST_POINTS = 1500


@dataclass(frozen=True)
class Quantity:
    """A measurement by its name in a session, its title, and its unit."""

    name: str
    title: str
    unit: str


QUANTITIES = (
    Quantity("compression_mm", "compression", "mm"),
    Quantity("force_n", "force on the probe", "N"),
    Quantity("to_tumour_mm", "distance to the tumour", "mm"),
    Quantity("penetration_mm", "penetration (numerical error)", "mm"),
)


@dataclass(frozen=True)
class MeasurementCourse:
    """Measurements over simulated time: times (n,) [s], and values (n,) by name, NaN where there is none;
    ``cuts_s`` are the times of cuts.
    """

    time_s: np.ndarray
    values: dict[str, np.ndarray]
    cuts_s: list[float]

    @staticmethod
    def of(log: Log) -> "MeasurementCourse":
        """The measurements of a session."""
        ends_s = log.ends_s
        # The time of a state is the end of the last command before it.
        made = [place for place, (_, command) in enumerate(log.commands) if makes_state(command)]
        numbers = np.array([log.commands[place][0] + 1 for place in made], int)
        times = np.concatenate([[0.0], ends_s[made]])
        measured = sorted(log.readings)
        at = np.searchsorted(numbers, measured, side="right")
        values = {
            each.name: np.array([log.readings[number].get(each.name) for number in measured], float)
            for each in QUANTITIES
        }
        cuts_s = [
            float(end)
            for end, (_, command) in zip(ends_s, log.commands, strict=True)
            if isinstance(command, CutOut)
        ]
        return MeasurementCourse(times[at], values, cuts_s)


def charts(course: MeasurementCourse, compression_limit_mm: float) -> list[str]:
    """A chart as SVG for each quantity that was measured; the limit of the compression is a line where the
    scale reaches it.
    """
    return [
        chart(each, course, compression_limit_mm if each.name == "compression_mm" else None)
        for each in QUANTITIES
        if np.isfinite(course.values[each.name]).any()
    ]


def chart(quantity: Quantity, course: MeasurementCourse, limit: float | None = None) -> str:
    """The chart of one quantity, from 0 on, as SVG."""
    values = course.values[quantity.name]
    y_ticks = ticks(max(float(np.nanmax(values)), LEAST_SCALE))
    y_most, x_most = y_ticks[-1], max(float(course.time_s[-1]), 1e-3)
    x_ticks = [time_s for time_s in ticks(x_most) if time_s <= x_most]

    def place(time_s: np.ndarray | float, value: np.ndarray | float) -> tuple:
        x = LEFT + np.divide(time_s, x_most) * (WIDTH - LEFT - RIGHT)
        return x, HEIGHT - BOTTOM - np.divide(np.clip(value, 0, None), y_most) * (HEIGHT - TOP - BOTTOM)

    parts = [f'<text class="title" x="{LEFT}" y="12">{escape(quantity.title)}, {quantity.unit}</text>']
    for value in y_ticks:
        x, y = place(0.0, value)
        parts.append(f'<path class="grid" d="M{x:.1f} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text class="y" x="{x - 4:.1f}" y="{y + 3:.1f}">{value:g}</text>')
    for value in x_ticks:
        x, y = place(value, 0.0)
        unit = " s" if value == x_ticks[-1] else ""
        parts.append(f'<text class="x" x="{x:.1f}" y="{y + 13:.1f}">{value:g}{unit}</text>')
    if limit is not None and limit <= y_most:
        x, y = place(0.0, limit)
        parts.append(f'<path class="limit" d="M{x:.1f} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text class="limit" x="{x + 4:.1f}" y="{y + 10:.1f}">limit</text>')
    for time_s in course.cuts_s:
        x, _ = place(time_s, 0.0)
        parts.append(f'<path class="cut" d="M{x:.1f} {TOP}V{HEIGHT - BOTTOM}"/>')
        parts.append(f'<text class="cut" x="{x - 3:.1f}" y="{TOP + 8}">cut</text>')
    for times, run in _runs(course.time_s, values):
        x, y = place(times, run)
        line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
        parts.append(f'<polyline class="line" points="{line}"/>')
    return f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{"".join(parts)}</svg>'


def ticks(most: float) -> list[float]:
    """Even numbers from 0 to the first that is no less than ``most``."""
    power = 10.0 ** np.floor(np.log10(most / MOST_TICKS))
    step = next(step * power for step in STEPS if most <= MOST_TICKS * step * power * (1 + 1e-9))
    count = int(np.ceil(most / step - 1e-9))
    return [round(float(step * number), 9) for number in range(count + 1)]


def _runs(time_s: np.ndarray, values: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Times and values between gaps; of many the largest of several neighbours."""
    every = -(-len(values) // MOST_POINTS)
    starts = np.arange(0, len(values), every)
    time_s, values = time_s[starts], np.fmax.reduceat(values, starts)
    finite = np.isfinite(values)
    edges = np.flatnonzero(np.diff(finite.astype(int), prepend=0, append=0))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        yield time_s[start:end], values[start:end]
