"""The command ``study timing``: the paper's Figures 7 and 8 and its Table 5 for this machine, and what bounds them."""

from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from rehearsal.commands.command_line import arch_option, load_patient, make_folder, start_taichi
from rehearsal.configuration import PRESETS, Setup, setup_of
from rehearsal.result_files import write_csv, write_json
from scenes.scene import PAPER

RADII_MM = (2.2, 2.5, 2.7, 3.0, 3.3)
COUNTS = [1_000, 4_000, 16_000, 64_000, 250_000, 1_000_000]
QUICK_COUNTS = [1_000, 4_000, 16_000]
# The size on which the paper says its figures are, and which is compared with other programs.
PAPERS = setup_of("shape-matching", radius_mm=2.2)
STEPS, QUICK_STEPS, QUICK_SHARE = 7, 3, 0.1
COLUMNS = (
    "model",
    "radius_mm",
    "cell_mm",
    "particles",
    "clusters",
    "memberships",
    "substeps",
    "iterations",
    "arch",
    "cores",
    "memory_mb",
)


@click.command()
@click.argument("scene", type=click.Path(path_type=Path), default=PAPER, required=False)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for tables and pictures.")
@click.option("--quick", is_flag=True, help="Fewer sizes and shorter presses, in less than a minute.")
@arch_option
def timing(scene: Path, out: Path, quick: bool, arch: str) -> None:
    """Measure how long a time step of SCENE takes.

    Against time, by its pieces, by size, and against a plain loop in C.
    """
    make_folder(out)
    loaded, anatomy = load_patient(scene)
    used = start_taichi(arch)
    from studies.performance import step_timing
    from studies.performance.timing_figure import draw

    setups = _setups(quick)
    counts = QUICK_COUNTS if quick else COUNTS
    presses, sizes = [], []
    comparison: dict[str, Any] = {}
    missing: list[str] = []
    with tqdm(total=len(setups) + 2 * len(counts), desc="timing", unit="size") as bar:
        for setup in setups:
            rehearsal = step_timing.build(loaded, anatomy, setup, used)
            presses.append(step_timing.measure(rehearsal, setup, QUICK_SHARE if quick else 1.0, used))
            if setup == PAPERS:
                comparison, missing = step_timing.compare(rehearsal)
            bar.update()
        for size in step_timing.blocks(counts, used, QUICK_STEPS if quick else STEPS):
            sizes.append(size)
            bar.update()
        bar.total = bar.n
    bound_ms = comparison.get("bound_ms")
    cases = [press.case | dict(bound_ms=bound_ms if press.setup == PAPERS else None) for press in presses]
    report = dict(arch=used, cases=cases, bound_ms=bound_ms, comparison=comparison, sizes=sizes)
    write_json(report, out / "timing.json")
    write_csv([_flat(case) for case in cases + sizes], out / "timing.csv")
    draw(presses, sizes, out / "timing.png")
    click.echo("\n".join(["", *table(cases, sizes), *pieces(cases), *against(comparison), *missing]))
    click.echo(f"\nWrote timing.json, timing.csv and timing.png to {out}")


def _setups(quick: bool) -> list[Setup]:
    presets = PRESETS["neo-hookean"]
    if quick:
        return [presets["balanced"], PAPERS]
    return [*presets.values(), *(setup_of("shape-matching", radius_mm=radius) for radius in RADII_MM)]


def _flat(case: dict) -> dict[str, Any]:
    """A case's size, and mean, SD, min, max and median of its steps [ms]."""
    return {name: case[name] for name in COLUMNS} | {f"{name}_ms": ms for name, ms in case["ms"].items()}


def table(cases: list[dict], sizes: list[dict]) -> list[str]:
    """The paper's Table 5, and the blocks."""
    head = "model              size particles iterations    mean     SD    min     max  median      MB"
    lines = ["Time of a step (ms), over warm-up and press (the paper's Table 5):", head, *map(_row, cases)]
    return [*lines, "Blocks at rest on a plane:", *map(_row, sizes)]


def _row(case: dict) -> str:
    size, ms = case["radius_mm"] or case["cell_mm"], case["ms"]
    return (
        f"{case['model']:15}{size:>5g} mm{case['particles']:>10}{case['substeps']:>6} x {case['iterations']:<2}"
        f"{ms['mean']:>8.2f}{ms['sd']:>7.2f}{ms['min']:>7.2f}{ms['max']:>8.2f}{ms['median']:>8.2f}"
        f"{case['memory_mb']:>8.1f}"
    )


def pieces(cases: list[dict]) -> list[str]:
    """The paper's Figure 8 in figures."""
    lines = []
    for case in cases:
        phases, size = case["phases_ms"], case["radius_mm"] or case["cell_mm"]
        total = sum(phases.values())
        lines.append(f"\nPieces of a step, {case['model']} {size:g} mm (mean ms, share):")
        lines += [f"  {name:20}{ms:8.3f}{100 * ms / total:6.1f} %" for name, ms in phases.items()]
    return lines


def against(figures: dict) -> list[str]:
    """The step beside the loop in C and pypbd."""
    if not figures:
        return []
    lines = [
        f"\nIn turn, {PAPERS.size_mm:g} mm, medians: a step with all contacts {figures['step_ms']:.2f} ms, without any "
        f"{figures['without_contacts_ms']:.2f} ms"
    ]
    if figures["bound_ms"]:
        lines.append(
            f"  fits and averages alone in plain C: {figures['bound_1_core_ms']:.2f} ms on one core, "
            f"{figures['bound_2_cores_ms']:.2f} ms on two; the step with contacts is {figures['ratio_to_bound']:.2f} times that"
        )
    if figures["times_pypbd"]:
        lines.append(
            f"  pypbd's shape matching: {figures['pypbd_1_core_ms']:.2f} ms; {figures['pypbd_million_a_second']:.0f} million "
            f"membership-iterations a second against {figures['million_a_second']:.0f}: {figures['times_pypbd']:.1f} times"
        )
    return lines
