"""The command ``study soak``: an hour of rehearsal, faster than real time; its table and its figure."""

from pathlib import Path
from typing import Any

import click
from matplotlib.figure import Figure
from tqdm import tqdm

from rehearsal.commands.command_line import WholeRange, arch_option, load_patient, make_folder, start_taichi
from rehearsal.configuration import PRESETS
from scenes.scene import PAPER
from studies.study_options import out_option, scene_argument
from studies.study_results import text_table, write_results

HOUR = 60
SHOWN = (
    ("shape_mm", "shape: mean distance from the first rest,\nafter a rigid fit (mm)"),
    ("moved_mm", "position: mean distance from the first rest (mm);\nfriction alone holds the pushed kidney"),
    ("memory_mb", "memory of the process since the first minute (MB)"),
    ("ms_median", "time of a step (ms)"),
)
# Half the least range of the axis of memory.
LEAST_MB = 10.0
HEADERS = ("model", "minute", "moved, mm", "shape, mm", "volume", "ms a step", "memory, MB")
FORMATS = ("", "g", ".3f", ".4f", ".4f", ".2f", ".1f")
COLUMNS = ("minute", "moved_mm", "shape_mm", "volume_ratio", "ms_median", "memory_mb")


@click.command()
@scene_argument(PAPER)
@out_option
@click.option(
    "--minutes", type=WholeRange(1, 6000), default=HOUR, show_default=True, help="Simulated minutes."
)
@click.option("--quick", is_flag=True, help="A quarter of a simulated minute of each model.")
@click.option("--model", type=click.Choice(list(PRESETS)), help="One tissue model [all].")
@arch_option
def soak(scene: Path, out: Path, minutes: int, quick: bool, model: str | None, arch: str) -> None:
    """Rehearse for an hour in SCENE, faster than real time.

    Does the rest shape drift, memory grow, a replay differ?
    """
    make_folder(out)
    loaded, anatomy = load_patient(scene)
    used = start_taichi(arch)
    from studies.robustness.soak_test import MINUTE_S, QUICK_MINUTE_S, REPLAYED_MINUTES, run_soak

    minutes, minute_s = (1, QUICK_MINUTE_S) if quick else (minutes, MINUTE_S)
    setups = [presets["fast"] for name, presets in PRESETS.items() if model in (None, name)]
    total = len(setups) * (minutes + min(minutes, REPLAYED_MINUTES))
    with tqdm(total=total, desc="soak", unit="min") as bar:
        runs = [run_soak(loaded, anatomy, setup, minutes, minute_s, used, bar.update) for setup in setups]
    rows = [dict(model=run["model"]) | row for run in runs for row in run["minutes"]]
    write_results(out, "soak", dict(arch=used, runs=runs), table(runs), rows, figure_of(runs))


def table(runs: list[dict[str, Any]]) -> str:
    """The first, the middle and the last minute of each model, and what must be equal."""
    rows, lines = [], []
    for run in runs:
        minutes = run["minutes"]
        for at in sorted({0, len(minutes) // 2, len(minutes) - 1}):
            rows.append([run["model"], *(minutes[at][name] for name in COLUMNS)])
        worst = max(row["shape_mm"] for row in minutes)
        same = {name: "identical" if run[f"{name}_equal"] else "DIFFERS" for name in ("replay", "reset")}
        lines.append(
            f"{run['model']}: shape at most {worst:.4f} mm from the first rest; memory {run['memory_growth_mb']:+.1f} MB; "
            f"replay {same['replay']}; reset {same['reset']}; state restored {run['fallbacks']} times"
        )
    return "\n".join([text_table(HEADERS, rows, FORMATS), *lines])


def figure_of(runs: list[dict[str, Any]]) -> Figure:
    """Shape, position, memory and time of a step over the minutes."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True)
    for axes, (name, label) in zip(panels.ravel(), SHOWN, strict=True):
        for run in runs:
            rows = run["minutes"]
            begins = rows[0][name] if name == "memory_mb" else 0.0
            at = [row["minute"] for row in rows]
            axes.plot(at, [row[name] - begins for row in rows], marker=".", label=run["model"])
        axes.set_title(label, fontsize=10)
        axes.grid(alpha=0.3)
        low, high = axes.get_ylim()
        if name == "memory_mb":
            axes.set_ylim(min(low, -LEAST_MB), max(high, LEAST_MB))
        else:
            axes.set_ylim(0, 1.05 * high)
    for axes in panels[1]:
        axes.set_xlabel("simulated minutes, each of random presses and drags and a rest")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(runs))
    figure.suptitle("An hour of rehearsal" if len(runs[0]["minutes"]) == HOUR else "Soak test")
    return figure
