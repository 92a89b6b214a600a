"""A clamped beam measured, from beam theory and computed by the tissue model: rows, table, figure."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

from studies.beam.cantilever import ITERATIONS, BeamMaterial, Cantilever
from studies.beam.motion_capture import BeamError, Capture, Oscillation, oscillation
from studies.tables_and_panels import Curve, draw_panel, panels_of, table_of

FRAME_S = 0.01
# Computed duration, in periods of beam theory.
PERIODS = 5.0
# The computed beam is sampled as often as the recorded one, or at least this often in a period.
FRAMES_A_PERIOD = 10
GRAVITY_M_S2 = 9.81
COLUMNS = (
    ("load, g", "{load_g:.0f}"),
    ("tip, measured, mm", "{measured_mm:.2f} ± {measured_error_mm:.2f}"),
    ("computed", "{computed_mm:.2f}"),
    ("off, %", "{off_mm:+.1f}"),
    ("theory", "{theory_mm:.2f}"),
    ("first frequency, measured, Hz", "{measured_hz:.3f} ± {measured_error_hz:.3f}"),
    ("computed", "{computed_hz:.3f}"),
    ("off, %", "{off_hz:+.1f}"),
    ("theory", "{theory_hz:.3f}"),
    ("damping ratio", "{measured_damping_ratio:.3f}"),
)


def theory(size_mm: np.ndarray, material: BeamMaterial, load_g: float) -> tuple[float, float]:
    """Sag [mm] of a Timoshenko cantilever, frequency [Hz] of an Euler-Bernoulli one with a mass at its tip.

    Small deflections, a clamped end that is free to change its width; the frequency is without shear and
    rotary inertia.
    """
    height, width, length = 1e-3 * np.asarray(size_mm, float)
    young = 1e3 * material.young_kpa
    area, bending = height * width, young * width * height**3 / 12
    shear = 5 / 6 * area * young / (2 * (1 + material.poisson))
    mass = 1e3 * material.density_g_cm3 * area
    load = 1e-3 * load_g
    sag = mass * (length**4 / (8 * bending) + length**2 / (2 * shear))
    sag += load * (length**3 / (3 * bending) + length / shear)
    ratio = load / (mass * length)

    def condition(b: float) -> float:
        swing = np.cos(b) * np.sinh(b) - np.sin(b) * np.cosh(b)
        return float(1 + np.cos(b) * np.cosh(b) + ratio * b * swing)

    root = brentq(condition, 1e-3, 1.9)
    return 1e3 * GRAVITY_M_S2 * sag, root**2 / (2 * np.pi) * np.sqrt(bending / (mass * length**4))


def compare(
    captures: list[Capture], build: Callable[..., Cantilever], cell_mm: float
) -> tuple[dict[str, Any], np.ndarray]:
    """One load's row, and time [s] and computed height [mm] of the markers after the release, shape (2,
    frames).

    ``build`` makes a beam from a cell width and a load; the rest position is computed on cells of half the
    width. In the row are lengths of the tip's final displacement [mm] and first frequencies [Hz]; measurement
    errors cover the repeats; ``rest_left_mm`` is the change of the computed rest position when its iterations
    were doubled.
    """
    load_g = captures[0].load_g
    beam = build(cell_mm=cell_mm, load_g=load_g)
    sag, theory_hz = theory(beam.size_mm, beam.material, load_g)
    rest_mm, rest_left_mm = build(cell_mm=cell_mm / 2, load_g=load_g).rest()
    frame_s = min(FRAME_S, 1 / (FRAMES_A_PERIOD * theory_hz))
    trace = released(beam, int(np.ceil(PERIODS / theory_hz / frame_s)), frame_s)
    computed = computed_oscillation(beam, trace)
    finals = [mean_length(capture.final_mm()) for capture in captures]
    swings = [measured_oscillation(capture) for capture in captures]
    hz = [swing.hz for swing in swings]
    row = dict(
        load_g=load_g,
        recordings=len(captures),
        measured_mm=float(np.mean(finals)),
        measured_error_mm=float(np.ptp(finals) / 2),
        computed_mm=mean_length(rest_mm),
        theory_mm=float(sag),
        measured_hz=float(np.mean(hz)),
        measured_error_hz=float(max(np.ptp(hz) / 2, *(swing.error_hz for swing in swings))),
        computed_hz=computed.hz,
        theory_hz=float(theory_hz),
        measured_damping_ratio=float(np.mean([swing.damping_ratio for swing in swings])),
        computed_damping_ratio=computed.damping_ratio,
        rest_left_mm=rest_left_mm,
    )
    return row, trace


def released(
    beam: Cantilever, frames: int, frame_s: float, finer: int = 1, iterations: int | None = None
) -> np.ndarray:
    """Time [s] and mean height [mm] of the markers after a release, shape (2, frames + 1)."""
    height = beam.swing(frames, frame_s, finer * beam.substeps(frame_s), iterations)[:, :, 0].mean(axis=1)
    return np.array([frame_s * np.arange(frames + 1), height])


def computed_oscillation(beam: Cantilever, trace: np.ndarray) -> Oscillation:
    """Of a computed trace (2, frames). Raises BeamError, naming the beam."""
    try:
        return oscillation(*trace)
    except BeamError as error:
        raise BeamError(f"the computed beam, E {beam.material.young_kpa:g} kPa: {error}") from None


def mean_length(displacement_mm: np.ndarray) -> float:
    """Mean length [mm] of the markers' displacements (n, 3), which is the same in any frame."""
    return float(np.linalg.norm(displacement_mm, axis=1).mean())


def measured_oscillation(capture: Capture) -> Oscillation:
    """Of one recording, from its release on. Raises BeamError, naming it."""
    first = capture.release()
    try:
        return oscillation(capture.time_s[first:], capture.height_mm()[first:])
    except BeamError as error:
        raise BeamError(f"{capture.name}: {error}") from None


def table(rows: list[dict[str, Any]]) -> str:
    """Final displacement of the tip, first frequency and damping ratio of each load."""
    described = []
    for row in rows:
        ratios = {unit: row[f"computed_{unit}"] / row[f"measured_{unit}"] for unit in ("mm", "hz")}
        described.append(row | {f"off_{unit}": 100 * (ratio - 1) for unit, ratio in ratios.items()})
    return table_of(COLUMNS, described)


def check(build: Callable[..., Cantilever], cell_mm: float, load_g: float, time_s: np.ndarray) -> str:
    """Convergence study: frequency against time step and iterations; frequency and rest against cells,
    material and load.

    Args:
        build: makes a beam from a cell width, a load, a material and the height at which the load hangs.
        cell_mm: cell width of motion and rest.
        load_g: at the tip.
        time_s: times after the release, of ``compare``, shape (frames,).
    """
    frames, frame_s = len(time_s) - 1, float(time_s[1])

    def line(name: str, beam: Cantilever, rests: bool = True, **changes: int) -> str:
        sag = f"{mean_length(beam.rest()[0]):8.3f} mm" if rests else " " * 11
        trace = released(beam, frames, frame_s, **changes)
        return f"  {name:32s} {sag}  {computed_oscillation(beam, trace).hz:7.4f} Hz"

    beam = build(cell_mm=cell_mm, load_g=load_g)
    softer, stiffer = (replace(beam.material, poisson=poisson) for poisson in (0.45, 0.49))
    lines = [
        f"Convergence study, {load_g:.0f} g, cells of {cell_mm:g} mm:",
        line("as above", beam),
        line("half the time step", beam, rests=False, finer=2),
        line("twice the iterations", beam, rests=False, iterations=2 * ITERATIONS),
        line("Poisson's ratio 0.45", build(cell_mm, load_g, softer)),
        line("Poisson's ratio 0.49", build(cell_mm, load_g, stiffer)),
        line(f"0.45 on cells of {cell_mm / 2:g} mm", build(cell_mm / 2, load_g, softer)),
    ]
    if load_g > 0:
        lines.append(
            line("load across the end's middle", build(cell_mm, load_g, hung_mm=beam.size_mm[0] / 2))
        )
    return "\n".join(lines)


def figure_of(groups: list[list[Capture]], traces: list[np.ndarray], rows: list[dict[str, Any]]) -> Figure:
    """Tip height over time, measured and computed, a panel a load."""
    figure, panels = panels_of((11, 3.2 * len(rows)), len(rows))
    for axes, captures, trace, row in zip(panels[:, 0], groups, traces, rows, strict=True):
        curves = []
        for capture in captures:
            first = capture.release()
            time_s = capture.time_s[first:] - capture.time_s[first]
            curves.append(Curve(time_s, capture.height_mm()[first:], "-", capture.name))
        curves.append(Curve(trace[0], trace[1], "k--", "computed, undamped", dict(lw=1)))
        draw_panel(axes, curves, dict(loc="upper right", fontsize=8), ylabel="tip height, mm")
        axes.set_xlim(0, 1.2 * trace[0, -1])
        measured, computed = f"measured {row['measured_hz']:.2f} Hz", f"computed {row['computed_hz']:.2f} Hz"
        axes.set_title(f"{row['load_g']:.0f} g at the tip: {measured}, {computed}", loc="left")
    panels[-1, 0].set_xlabel("time since the release, s")
    return figure
