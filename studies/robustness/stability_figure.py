"""The picture of ``study stability``: how the cases of each kind ended."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rehearsal.result_files import save_figure

DPI = 130
WHOLE_MM = 0.1
# How a case may end, and its colour; good ends first.
FATES = {
    "came back to where it lay": "#2a7f4f",
    "put back by the program, to where it lay": "#8fce9d",
    "its shape whole, lies elsewhere": "#4f86c6",
    "put back by the program, its shape whole, lies elsewhere": "#a9c8ea",
    "shape changed": "#f0a030",
    "not finite": "#c0202a",
}


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Write the picture: a panel a model, a bar a kind of case."""
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    models = list(dict.fromkeys(row["model"] for row in rows))
    figure = Figure(figsize=(12, 0.25 * len(kinds) + 2), layout="constrained")
    panels = figure.subplots(1, len(models), sharey=True, squeeze=False)[0]
    for axes, model in zip(panels, models, strict=True):
        _bars(axes, [row for row in rows if row["model"] == model], kinds)
        axes.set_title(model)
    panels[0].invert_yaxis()
    ends = [[fate_of(row) for row in rows if row["model"] == model] for model in models]
    handles = [
        Patch(color=colour, label=f"{fate}: {', '.join(str(each.count(fate)) for each in ends)}")
        for fate, colour in FATES.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    figure.suptitle("How tissue ended that was maltreated and let go")
    save_figure(figure, path, dpi=DPI)


def _bars(axes: Axes, rows: list[dict[str, Any]], kinds: list[str]) -> None:
    fates = [(row["kind"], fate_of(row)) for row in rows]
    begins = [0] * len(kinds)
    for fate, colour in FATES.items():
        counts = [fates.count((kind, fate)) for kind in kinds]
        axes.barh(kinds, counts, left=begins, color=colour)
        begins = [begin + count for begin, count in zip(begins, counts, strict=True)]
    axes.set_xlabel(f"cases, of {len(rows)}")
    axes.grid(alpha=0.3, axis="x")
    axes.set_axisbelow(True)


def fate_of(row: dict[str, Any]) -> str:
    """How a case ended: one of ``FATES``."""
    if not row["finite"]:
        return "not finite"
    if not row["recovered"] and (row["shape_error_mm"] is None or row["shape_error_mm"] > WHOLE_MM):
        return "shape changed"
    own, put_back, elsewhere, both, *_ = FATES
    if row["recovered"]:
        return put_back if row["fallback"] else own
    return both if row["fallback"] else elsewhere
