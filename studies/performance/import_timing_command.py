"""The command ``study import``: time and memory from a large CT to a scene."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click
import psutil

from rehearsal.commands.command_line import WholeRange, make_folder
from studies.performance.synthetic_trunk import write_whole_body
from studies.study_options import out_option
from studies.study_results import write_results

APP = Path(__file__).resolve().parents[2] / "app.py"
POLL_S = 0.02
KIDNEY_OF_PHANTOM = "1,2,3,4,5"
TUMOUR_OF_PHANTOM = "6"


@click.command("import")
@out_option
@click.option(
    "--slices",
    type=WholeRange(200, 2000),
    default=800,
    show_default=True,
    help="Slices of 512 x 512 pixels.",
)
@click.option("--runs", type=WholeRange(1, 20), default=3, show_default=True)
def intake(out: Path, slices: int, runs: int) -> None:
    """Measure an import: seconds and memory.

    Of a synthetic trunk of 512 x 512 pixels a slice, from DICOM and NIfTI labels.
    """
    make_folder(out)
    with tempfile.TemporaryDirectory() as temporary:
        body = write_whole_body(Path(temporary), slices)
        found = [_run(body, Path(temporary) / f"patient-{n}") for n in range(runs)]
    figures = dict(slices=slices, seconds=[s for s, _ in found], peak_gb=[g for _, g in found])
    lines = [
        f"512 x 512 x {slices} CT and labels to a scene, {runs} runs, one after another:",
        "seconds    " + ", ".join(f"{s:.1f}" for s, _ in found),
        "memory     " + ", ".join(f"{g:.2f}" for _, g in found) + " GB at most",
    ]
    write_results(out, "import", figures, "\n".join(lines))


def _run(body: Path, folder: Path) -> tuple[float, float]:
    """Seconds, and the largest memory [GB], of one import in a process of its own."""
    labels = body / "labels.nii.gz"
    command = [sys.executable, str(APP), "import", str(body / "ct"), str(labels), "--out", str(folder)]
    start, most = time.perf_counter(), 0
    child = subprocess.Popen(
        [*command, "--organ", KIDNEY_OF_PHANTOM, "--tumour", TUMOUR_OF_PHANTOM],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    watched = psutil.Process(child.pid)
    while child.poll() is None:
        try:
            most = max(most, watched.memory_info().rss)
        except psutil.Error:  # it has just ended
            break
        time.sleep(POLL_S)
    _, errors = child.communicate()
    if child.returncode != 0:
        raise click.ClickException(f"the import failed: {errors.decode('utf-8', 'replace').strip()}")
    return time.perf_counter() - start, most / 1e9
