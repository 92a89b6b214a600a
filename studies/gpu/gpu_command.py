"""The command ``study gpu``: step, picture and frame on graphics cards, beside the processor's."""

import os
import platform
from collections.abc import Iterator
from time import monotonic
from typing import Any

import click
import numpy as np
from tqdm import tqdm

from render.vulkan_device import vulkan_devices
from studies.gpu.backend_runs import BackendRun, run_backend
from studies.gpu.device_cases import MOST_MS, CaseFigures, cases
from studies.study import Results, Study, number_option, study_command
from studies.tables_and_panels import table_of
from version import VERSION

BACKENDS = ("cpu", "cuda", "vulkan")
# The processor is only what the others are compared with.
CPU_SHARE = 0.5
# The most that a backend's results may differ from the processor's.
MOST_APART = dict(beads_apart_mm=0.01, grey_apart=1)
COLUMNS = {
    "backend": "{backend}",
    "case": "{case}",
    "median ms": "{median_ms:.2f}",
    "min": "{min_ms:.2f}",
    "max": "{max_ms:.2f}",
    "before, s": "{first_s:.1f}",
    "beads apart, mm": "{beads_apart_mm:.4f}",
    "force, %": "{force_apart_percent:.2f}",
    "grey levels": "{grey_apart:.0f}",
    "pixels beyond 1, %": "{grey_share_percent:.2f}",
}


@study_command(
    "gpu",
    number_option("--seconds", low=10, high=3600, default=480, help="How long it may take."),
    click.option("--try-refused", is_flag=True, help="Measure a driver whose results are refused, too."),
)
def gpu(study: Study, seconds: float, try_refused: bool) -> Results:
    """Measure step, picture and frame on each graphics card.

    CUDA and Vulkan, compared with the processor.
    """
    with study.progress(sum(len(cases(backend)) for backend in BACKENDS), "case") as bar:
        runs = list(_runs(seconds, try_refused, bar))
    reference = {figures.case: figures for figures in runs[0].measured}
    rows = [row(run.backend, figures, reference) for run in runs for figures in run.measured]
    missing = [
        dict(backend=run.backend, cases=[case for case, of in run.missing.items() if of == why], why=why)
        for run in runs
        for why in dict.fromkeys(run.missing.values())
    ]
    report = dict(
        version=VERSION,
        system=platform.platform(),
        cores=os.cpu_count(),
        vulkan_devices=[device.name for device in vulkan_devices()],
        rows=rows,
        not_measured=missing,
        faults=faults(rows),
    )
    return Results(report, text_of(report))


def _runs(seconds: float, try_refused: bool, bar: tqdm) -> Iterator[BackendRun]:
    end_s = monotonic() + seconds
    for number, backend in enumerate(BACKENDS):
        left = end_s - monotonic()
        share = CPU_SHARE if backend == "cpu" else 1 / (len(BACKENDS) - number)
        before = bar.n
        run = BackendRun(backend)
        for run in run_backend(backend, share * left, try_refused):
            bar.set_postfix_str(backend)
            bar.n = before + run.ended
            bar.refresh()
        yield run


def row(backend: str, measured: CaseFigures, reference: dict[str, CaseFigures]) -> dict[str, Any]:
    """The figures of a case; how far from the processor's its results are is None for the processor, and
    for what has no such result.
    """
    apart: dict[str, Any] = dict.fromkeys(
        ("beads_apart_mm", "force_apart_percent", "grey_apart", "grey_share_percent")
    )
    if backend != "cpu" and measured.case in reference:
        apart |= differences(measured.arrays, reference[measured.case].arrays)
    times = {f"{name}_ms": ms for name, ms in measured.ms.items()}
    return dict(
        backend=backend,
        case=measured.case,
        first_s=round(measured.first_s, 2),
        **times,
        most_ms=None if backend == "cpu" else MOST_MS.get(measured.case),
        **apart,
        **measured.figures,
    )


def differences(results: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest distance of a bead [mm]; of a force, in % of the largest; of a grey level, and how many
    pixels [%] differ by more than one level.
    """
    apart = {}
    for name in results.keys() & expected.keys():
        # Grey levels are unsigned.
        difference = results[name].astype(float) - expected[name].astype(float)
        if name == "beads_mm":
            apart["beads_apart_mm"] = np.linalg.norm(difference, axis=-1).max()
        elif name == "force_n":
            most = np.linalg.norm(expected[name], axis=-1).max()
            apart["force_apart_percent"] = 100 * np.linalg.norm(difference, axis=-1).max() / most
        else:
            apart["grey_apart"] = np.abs(difference).max()
            apart["grey_share_percent"] = 100 * (np.abs(difference) > 1).mean()
    return {name: round(float(value), 5) for name, value in apart.items()}


def faults(rows: list[dict[str, Any]]) -> list[str]:
    """What is slower, or farther from the processor's result, than is asked."""
    lines = []
    for row in rows:
        where = f"{row['backend']}, {row['case']}"
        if row["most_ms"] is not None and row["median_ms"] > row["most_ms"]:
            lines.append(f"{where}: {row['median_ms']:.2f} ms; asked: at most {row['most_ms']:g} ms")
        for name, most in MOST_APART.items():
            if row[name] is not None and row[name] > most:
                unit = "mm" if name.endswith("mm") else "grey levels"
                lines.append(f"{where}: {row[name]:g} {unit} from the processor's; asked: at most {most:g}")
    return lines


def text_of(report: dict[str, Any]) -> str:
    """The table, what was not measured, and what is not as asked."""
    devices = ", ".join(report["vulkan_devices"]) or "none"
    head = f"{report['cores']} cores; Vulkan devices: {devices}"
    lines = [
        f"{head}. Differences are from the processor's results.\n",
        table_of(COLUMNS, report["rows"]),
    ]
    if report["not_measured"]:
        lines.append("\nNot measured:")
        lines += [f"  {m['backend']}, {', '.join(m['cases'])}: {m['why']}" for m in report["not_measured"]]
    if report["faults"]:
        lines += ["\nNot as asked:", *(f"  {fault}" for fault in report["faults"])]
    return "\n".join(lines)
