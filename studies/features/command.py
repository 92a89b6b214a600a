"""The command ``study features``: what each feature of a scene costs, on and off."""

import csv
import json
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from scenes.anatomy import load_anatomy
from scenes.scene import PAPER, load_scene, scene_file
from studies.commands import arch_option, make_folder, start_taichi
from studies.setup import PRESETS

COLUMNS = (
    "model",
    "feature",
    "ms_on",
    "ms_off",
    "mb_on",
    "mb_off",
    "kernels_on",
    "kernels_off",
    "launches_on",
    "launches_off",
)


@click.command()
@click.argument("scene", type=click.Path(path_type=Path), default=PAPER, required=False)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for table and picture.")
@click.option(
    "--quick",
    is_flag=True,
    help="Neo-Hookean alone, coarse, not in turn, no kernels counted: in less than a minute.",
)
@arch_option
def features(scene: Path, out: Path, quick: bool, arch: str) -> None:
    """What each feature of SCENE costs in time, memory and kernels: the same press with it and without, in turn."""
    make_folder(out)
    path = scene_file(scene)
    loaded = load_scene(path)
    anatomy = load_anatomy(loaded, path.parent)
    used = start_taichi(arch)
    from studies.features import measure
    from studies.features.picture import draw

    models = ["neo-hookean"] if quick else list(measure.FEATURES)
    rows: list[dict[str, Any]] = []
    with tqdm(
        total=sum(len(measure.FEATURES[model]) for model in models) + 1, desc="features", unit="feature"
    ) as bar:
        for model in models:
            preset = PRESETS[model]["fast" if quick else "balanced"]
            size = preset.cell_mm if model == "neo-hookean" else preset.radius_mm
            body = measure.body_of(loaded, anatomy, model, size)
            found = measure.of_steps(body, measure.FEATURES[model], used, quick, bar.update)
            rows += [dict(model=model) | row for row in found]
        rows += [dict(model="frame") | row for row in measure.of_frame(loaded, anatomy, used)]
        bar.update()
    rows = [{name: row[name] for name in COLUMNS} for row in rows]
    (out / "features.json").write_text(json.dumps(dict(arch=used, features=rows), indent=2) + "\n", "utf-8")
    write_csv(rows, out / "features.csv")
    draw(rows, out / "features.png")
    click.echo("\n".join(["", *table(rows)]))
    click.echo(f"\nWrote features.json, features.csv and features.png to {out}")


def write_csv(rows: list[dict[str, Any]], path: Path) -> None:
    """A line a feature."""
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = csv.DictWriter(file, COLUMNS)
        lines.writeheader()
        lines.writerows(rows)


def table(rows: list[dict[str, Any]]) -> list[str]:
    """What each adds: time of a step or of a frame's piece, memory, kernels where they run in parallel and their launches."""
    lines = [
        "model            feature                        ms with  without   adds      MB  kernels  launches"
    ]
    for row in rows:
        adds = row["ms_on"] - row["ms_off"]
        lines.append(
            f"{row['model']:<17}{row['feature']:<29}{row['ms_on']:>9.3f}{row['ms_off']:>9.3f}{adds:>+8.3f}"
            f"{row['mb_on'] - row['mb_off']:>+8.2f}{_added(row, 'kernels'):>9}{_added(row, 'launches'):>10}"
        )
    return lines


def _added(row: dict[str, Any], what: str) -> str:
    on = row[f"{what}_on"]
    return "" if on is None else f"{on - row[f'{what}_off']:+d}"
