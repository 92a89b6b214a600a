"""The command ``study freehand``: how true a volume made of a tracked sweep is."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from rehearsal.commands.command_line import CommandError, arch_option, load_patient, make_folder, start_taichi
from rehearsal.configuration import PRESETS
from rehearsal.result_files import write_csv, write_json
from scenes.scene import EMBEDDED
from ultrasound.tracking_errors import TrackingErrors

VARIED = tuple(each.name for each in fields(TrackingErrors))


@click.command()
@click.argument("scenes", type=click.Path(path_type=Path), nargs=-1)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for tables and picture.")
@click.option("--quick", is_flag=True, help="One size of each error and two depths.")
@arch_option
def freehand(scenes: tuple[Path, ...], out: Path, quick: bool, arch: str) -> None:
    """Compare volumes of tracked sweeps with the truth.

    Of SCENES [the embedded patient]: at rest, with a tracker's errors, pressed.
    """
    make_folder(out)
    loaded = []
    for scene in scenes or (EMBEDDED,):
        one, anatomy = load_patient(scene)
        if anatomy.ct is None:
            raise CommandError(f"{scene}: has no CT: expected anatomy.ct, which a sweep shows")
        loaded.append((one, anatomy))
    used = start_taichi(arch)
    from studies.freehand.freehand_accuracy import count_of, measure
    from studies.freehand.freehand_figure import draw

    setup = PRESETS["neo-hookean"]["balanced"]
    runs = []
    total = sum(count_of(anatomy, quick) for _, anatomy in loaded)
    with tqdm(total=total, desc="freehand", unit="volume") as bar:
        for number, (one, anatomy) in enumerate(loaded, 1):
            figures = measure(one, anatomy, setup, used, quick, bar.update)
            runs.append(dict(patient=one.title or f"patient {number}") | figures)
    write_json(dict(arch=used, runs=runs), out / "freehand.json")
    write_csv([row for run in runs for row in rows_of(run)], out / "freehand.csv")
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
    varied = [f"{name} {row[name]:g}" for name in VARIED if row[name]]
    return ", ".join(varied) or "every third picture, no error"
