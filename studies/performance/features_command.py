"""The command ``study features``: what each feature of a scene costs, on and off."""

from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from rehearsal.commands.command_line import arch_option, load_patient, make_folder, start_taichi
from rehearsal.configuration import PRESETS
from rehearsal.result_files import write_csv, write_json
from scenes.scene import PAPER
from scenes.tissue import USUAL

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
    """Measure what each feature of SCENE costs.

    In time, memory and kernels: the same press with it and without, in turn.
    """
    make_folder(out)
    loaded, anatomy = load_patient(scene)
    used = start_taichi(arch)
    from studies.performance import feature_costs
    from studies.performance.features_figure import draw

    models = [USUAL] if quick else list(feature_costs.FEATURES)
    rows: list[dict[str, Any]] = []
    with tqdm(
        total=sum(len(feature_costs.FEATURES[model]) for model in models) + 1, desc="features", unit="feature"
    ) as bar:
        for model in models:
            preset = PRESETS[model]["fast" if quick else "balanced"]
            body = feature_costs.body_of(loaded, anatomy, model, preset.size_mm)
            found = feature_costs.of_steps(body, feature_costs.FEATURES[model], used, quick, bar.update)
            rows += [dict(model=model) | row for row in found]
        rows += [dict(model="frame") | row for row in feature_costs.of_frame(loaded, anatomy, used)]
        bar.update()
    rows = [{name: row[name] for name in COLUMNS} for row in rows]
    write_json(dict(arch=used, features=rows), out / "features.json")
    write_csv(rows, out / "features.csv")
    draw(rows, out / "features.png")
    click.echo("\n".join(["", *table(rows)]))
    click.echo(f"\nWrote features.json, features.csv and features.png to {out}")


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
