"""The command ``study freehand``: how true a volume made of a tracked sweep is."""

import csv
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from scenes.anatomy import load_anatomy
from scenes.scene import EMBEDDED, load_scene, scene_file
from studies.commands import Fault, arch_option, make_folder, start_taichi
from studies.setup import PRESETS
from ultrasound.tracking import TrackingErrors

SWEPT = tuple(each.name for each in fields(TrackingErrors))


@click.command()
@click.argument("scenes", type=click.Path(path_type=Path), nargs=-1)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for tables and picture.")
@click.option("--quick", is_flag=True, help="One size of each error and two depths.")
@arch_option
def freehand(scenes: tuple[Path, ...], out: Path, quick: bool, arch: str) -> None:
    """Volumes of tracked sweeps of SCENES [the embedded patient], against the truth: at rest, with a tracker's errors, pressed."""
    make_folder(out)
    loaded = []
    for scene in scenes or (EMBEDDED,):
        path = scene_file(scene)
        one = load_scene(path)
        anatomy = load_anatomy(one, path.parent)
        if anatomy.ct is None:
            raise Fault(f"{path}: has no CT: expected anatomy.ct, which a sweep shows")
        loaded.append((one, anatomy))
    used = start_taichi(arch)
    from studies.freehand.measure import count_of, measure
    from studies.freehand.study_picture import draw

    setup = PRESETS["neo-hookean"]["balanced"]
    runs = []
    total = sum(count_of(anatomy, quick) for _, anatomy in loaded)
    with tqdm(total=total, desc="freehand", unit="volume") as bar:
        for number, (one, anatomy) in enumerate(loaded, 1):
            figures = measure(one, anatomy, setup, used, quick, bar.update)
            runs.append(dict(patient=one.title or f"patient {number}") | figures)
    (out / "freehand.json").write_text(json.dumps(dict(arch=used, runs=runs), indent=2) + "\n", "utf-8")
    write_csv(runs, out / "freehand.csv")
    draw(runs, out / "freehand.png")
    click.echo("\n".join(["", *(line for run in runs for line in table(run))]))
    click.echo(f"\nWrote freehand.json, freehand.csv and freehand.png to {out}")


def rows_of(run: dict[str, Any]) -> list[dict[str, Any]]:
    """A line a volume and region, of the part of it that was scanned."""
    lines = []
    for kind in ("resting", "noise", "compression"):
        for row in run[kind]:
            about = {name: value for name, value in row.items() if not isinstance(value, dict)}
            for region in ("organ", "tumour"):
                part = row.get(region, {}).get("scanned_part")
                if part:
                    lines.append(
                        dict(
                            patient=run["patient"], sweep=kind, region=region, scanned=row[region]["scanned"]
                        )
                        | part
                        | dict(landmarks_mm=row["landmarks"]["mean_mm"])
                        | about
                    )
    return lines


def write_csv(runs: list[dict[str, Any]], path: Path) -> None:
    """A line a volume and region."""
    rows = [row for run in runs for row in rows_of(run)]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def table(run: dict[str, Any]) -> list[str]:
    """The figures of one patient."""
    lines = [
        f"{run['patient']}: {run['probe']} probe, {run['frames']} pictures {run['apart_mm']:.2f} mm apart, "
        f"voxels of {run['spacing_mm']:g} mm",
        f"{'sweep':<38}region  scanned   Dice  HD95, mm  volume, %  centroid, mm  landmarks, mm",
    ]
    for row in rows_of(run):
        hd95, centroid, landmarks = (
            "" if row[name] is None else f"{row[name]:.2f}"
            for name in ("hd95_mm", "centroid_mm", "landmarks_mm")
        )
        lines.append(
            f"{_named(row):<38}{row['region']:<8}{100 * row['scanned']:>5.0f} %{row['dice']:>8.3f}{hd95:>10}"
            f"{row['volume_percent']:>+11.1f}{centroid:>14}{landmarks:>15}"
        )
    return lines


def _named(row: dict[str, Any]) -> str:
    if row["sweep"] == "resting":
        return f"at rest, {row['method']}"
    if row["sweep"] == "compression":
        undone = ", undone" if row["undone"] else ""
        return f"pressed {row['depth_mm']:g} mm, squeezed {row['compression_mm']:.1f}{undone}"
    swept = [f"{name} {row[name]:g}" for name in SWEPT if row[name]]
    return ", ".join(swept) or "every third picture, no error"
