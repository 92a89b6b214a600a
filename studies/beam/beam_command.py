"""The command ``beam``: a clamped silicone beam, recorded by motion capture, against the tissue model."""

from dataclasses import asdict
from itertools import groupby
from pathlib import Path

import click
import numpy as np
import trimesh
from tqdm import tqdm

from rehearsal.commands.command_line import make_folder, make_place, save_figures, start_taichi
from rehearsal.result_files import save_figure
from studies.beam.beam_comparison import check, compare, figure_of, table
from studies.beam.cantilever import ITERATIONS, REST_RELAXATION, REST_TOLERANCE_MM, BeamMaterial, Cantilever
from studies.beam.motion_capture import BeamError, load_captures
from studies.study import number_option

BEAM = "beam.stl"
DPI = 110
# Tip markers are balls at this distance from the surface at the free end: on top, on one side, on the other,
# at these shares of height and width (as in the simulation of the recordings' authors).
STAND_OFF_MM = 6.0
MARKERS = np.array([[1.0, 0.5], [0.8, 1.0], [0.2, 0.0]])
OUTWARD = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@number_option("--cell", "cell_mm", low=1, high=30, default=10.0, help="Width of a cell in mm.")
@number_option("--young-kpa", low=0, high=1e6, min_open=True, default=263.8, help="Young's modulus in kPa.")
@number_option("--poisson", low=0, high=0.5, max_open=True, default=0.499, help="Poisson's ratio.")
@number_option("--density", low=0, high=30, min_open=True, default=1.07, help="Density in g/cm^3.")
@click.option(
    "--check",
    "checked",
    is_flag=True,
    help="Also a convergence study of time step, iterations, cells and Poisson's ratio.",
)
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="File for the results.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the figure, beam.png.")
def beam(
    folder: Path,
    cell_mm: float,
    young_kpa: float,
    poisson: float,
    density: float,
    checked: bool,
    json_path: Path | None,
    out: Path | None,
) -> None:
    """Compare with the silicone beam of FOLDER (motion capture).

    The beam (beam.stl) is clamped and loaded; compared are the rest position of its tip and its first
    frequency.
    """
    captures = load_captures(folder)
    size = beam_size(folder)
    if out is not None:
        make_folder(out)
    make_place(json_path)
    start_taichi("cpu")
    material = BeamMaterial(young_kpa, poisson, density)
    groups = [list(group) for _, group in groupby(captures, key=lambda capture: capture.load_g)]

    def build(
        cell_mm: float, load_g: float, changed: BeamMaterial = material, hung_mm: float | None = None
    ) -> Cantilever:
        return Cantilever(size, changed, cell_mm, load_g, markers_on(size), hung_mm)

    compared = [compare(group, build, cell_mm) for group in tqdm(groups, desc="beam", unit="load")]
    rows, traces = [row for row, _ in compared], [trace for _, trace in compared]
    frame_s = float(traces[0][0, 1])
    settings: dict[str, float] = dict(
        **asdict(material),
        cell_mm=cell_mm,
        time_step_s=frame_s / build(cell_mm, 0.0).substeps(frame_s),
        passes=ITERATIONS,
        damping=0.0,
        rest_cell_mm=cell_mm / 2,
        rest_relaxation_factor=REST_RELAXATION,
        rest_left_mm=max(row["rest_left_mm"] for row in rows),
    )
    click.echo(", ".join(f"{name} {value:.4g}" for name, value in settings.items()))
    click.echo(table(rows))
    for row in rows:
        if row["rest_left_mm"] > REST_TOLERANCE_MM:
            click.echo(
                f"{row['load_g']:.0f} g: not quite at rest, it moved {row['rest_left_mm']:.3f} mm in the "
                "last iterations"
            )
    if checked:
        for first_or_last in sorted({0, len(rows) - 1}):
            click.echo(check(build, cell_mm, rows[first_or_last]["load_g"], traces[first_or_last][0]))
    if json_path is not None:
        save_figures(dict(settings=settings, loads=rows), json_path)
    if out is not None:
        save_figure(figure_of(groups, traces, rows), out / "beam.png", dpi=DPI)
        click.echo(f"Wrote {out / 'beam.png'}")


def markers_on(size_mm: np.ndarray) -> np.ndarray:
    """Tip markers (3, 3) [mm] in the frame of beam.stl, for a beam of height, width and length (3,)."""
    across = MARKERS * size_mm[:2] + STAND_OFF_MM * OUTWARD
    return np.column_stack([across, np.full(len(across), size_mm[2])])


def beam_size(folder: Path) -> np.ndarray:
    """Height, width and length (3,) [mm] of the folder's beam. Raises BeamError."""
    path = folder / BEAM
    try:
        size = np.ptp(trimesh.load_mesh(path).bounds, axis=0)
    except Exception as error:  # an invalid STL raises many types
        raise BeamError(f"{path}: cannot be read as a surface ({error})") from None
    if size.argmax() != 2:
        raise BeamError(f"{path}: the beam's length must be along z")
    return size
