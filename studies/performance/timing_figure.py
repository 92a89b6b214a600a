"""The picture of ``study timing``: the paper's Figures 7 and 8, its Table 5 and cost against size, in four panels."""

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rehearsal.result_files import save_figure
from studies.performance.step_phases import AFTER, BEFORE, CONTACTS, PASSES
from studies.performance.step_timing import TimedPress

DPI = 130
# The paper's Table 5: radius [mm], mean, minimum and maximum [ms].
PAPER = (
    (2.2, 12.10, 11.68, 12.77),
    (2.5, 12.10, 11.68, 12.77),
    (2.7, 12.37, 11.96, 12.84),
    (3.0, 12.66, 12.28, 13.37),
    (3.3, 14.16, 13.67, 15.68),
)
FRAME_MS = 1000 / 60
LEAST_SHARE = 2.0


def draw(presses: list[TimedPress], sizes: list[dict], path: Path) -> None:
    """Write the picture."""
    figure = Figure(figsize=(13, 9), layout="constrained")
    panels = figure.subplots(2, 2)
    matched = [press for press in presses if press.case["model"] == "shape-matching"]
    _against_time(panels[0, 0], matched[0])
    _pieces(panels[0, 1], presses)
    _radii(panels[1, 0], matched)
    _sizes(panels[1, 1], sizes)
    save_figure(figure, path, dpi=DPI)


def _against_time(axes: Axes, press: TimedPress) -> None:
    """The paper's Figure 7."""
    case = press.case
    contacts = [sum(ms.get(name, 0.0) for name in CONTACTS) for ms in press.pieces_ms]
    axes.plot(press.elapsed_s, press.step_ms, linewidth=0.8, label="whole step")
    axes.plot(press.elapsed_s, contacts, linewidth=0.8, label="contacts")
    axes.axvline(press.warm_up_s, color="0.5", linestyle="--", linewidth=0.8)
    axes.annotate(" press", (press.warm_up_s, 0), color="0.4", va="bottom")
    axes.set_ylim(0, 1.5 * sorted(press.step_ms)[int(0.98 * len(press.step_ms))])
    axes.set(
        title=f"Time of a step, {case['particles']} particles of {case['radius_mm']:g} mm (the paper's Fig. 7)",
        xlabel="simulated time (s)",
        ylabel="ms",
    )
    axes.grid(alpha=0.3)
    axes.legend()


def _pieces(axes: Axes, presses: list[TimedPress]) -> None:
    """The paper's Figure 8, for every model and size: what takes less than a fiftieth everywhere is the rest."""
    shares = []
    for press in presses:
        phases = press.case["phases_ms"]
        shares.append({name: 100 * ms / sum(phases.values()) for name, ms in phases.items()})
    names = [*BEFORE, *PASSES[False], *PASSES[True], *AFTER, "frames"]
    shown = [name for name in names if max(share.get(name, 0.0) for share in shares) > LEAST_SHARE]
    left = np.zeros(len(presses))
    for number, name in enumerate(shown):
        width = np.array([share.get(name, 0.0) for share in shares])
        colour = colormaps["tab20"](number)
        axes.barh(range(len(presses)), width, left=left, color=colour, label=name)
        left += width
    axes.barh(range(len(presses)), 100 - left, left=left, color="0.8", label="the rest")
    axes.set_yticks(range(len(presses)), [_name(press.case) for press in presses])
    axes.invert_yaxis()
    axes.set(title="Pieces of a step (the paper's Fig. 8)", xlabel="% of the step", xlim=(0, 100))
    axes.legend(fontsize=8, ncols=1, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _name(case: dict) -> str:
    size = case["radius_mm"] or case["cell_mm"]
    return f"{'shape matching' if case['radius_mm'] else 'neo-Hookean'} {size:g} mm"


def _radii(axes: Axes, matched: list[TimedPress]) -> None:
    """The paper's Table 5."""
    rows = [
        (press.case["radius_mm"], *(press.case["ms"][key] for key in ("mean", "min", "max")))
        for press in matched
    ]
    for shown, marker, colour, name in (
        (rows, "o", "tab:blue", "here, one core"),
        (PAPER, "s", "0.5", "the paper's, a GPU of 1536 cores"),
    ):
        radius, mean, least, most = np.array(shown).T
        spread = [mean - least, most - mean]
        axes.errorbar(radius, mean, spread, fmt=marker, color=colour, capsize=3, label=name)
    axes.axhline(FRAME_MS, color="0.6", linestyle=":", label="1/60 s")
    axes.set(
        title="Mean, least and longest step (the paper's Table 5)",
        xlabel="particle radius (mm)",
        ylabel="ms",
        ylim=(0, None),
    )
    axes.grid(alpha=0.3)
    axes.legend()


def _sizes(axes: Axes, sizes: list[dict]) -> None:
    for model, name, label in (
        ("shape-matching", "shape matching, 3 x 9", dict(xytext=(4, -9))),
        ("neo-hookean", "neo-Hookean, 1 x 8", dict(xytext=(-4, 5), ha="right")),
    ):
        rows = [size for size in sizes if size["model"] == model]
        axes.loglog(
            [row["particles"] for row in rows], [row["ms"]["median"] for row in rows], "o-", label=name
        )
        for row in rows:
            axes.annotate(
                f"{row['memory_mb']:.0f} MB",
                (row["particles"], row["ms"]["median"]),
                fontsize=7,
                textcoords="offset points",
                **label,
            )
    axes.axhline(FRAME_MS, color="0.6", linestyle=":", label="1/60 s")
    axes.set(
        title="Blocks at rest: time and memory against size",
        xlabel="particles or nodes",
        ylabel="median ms a step",
    )
    axes.grid(alpha=0.3, which="both")
    axes.legend()
