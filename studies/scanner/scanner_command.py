"""The command ``study scanner``: echoes of real scanners through our own chain."""

from collections.abc import Callable
from dataclasses import asdict
from itertools import chain, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from scipy.stats import spearmanr

from studies.echo.echo_phantom import EchoPhantom
from studies.echo.simus_beam import pymust
from studies.scanner import grey_maps, recorded_speckle, ring_down, rotating_disc, wire_widths
from studies.scanner.recordings import (
    BK_IQ,
    BK_PICTURE,
    DISC,
    FOLDER,
    LINEAR_IQ,
    LINEAR_PICTURE,
    SPINE,
    WIRES,
    WIRES_CONFIGURATION,
    ScannerRow,
    read_channel_data,
    read_iq,
    read_picture,
)
from studies.study import Results, Study, study_command
from studies.tables_and_panels import Curve, draw_panel, panels_of, table_of
from ultrasound.probe import load_probe
from ultrasound.sweep_file import read_sweep

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = {
    "part": "{part}",
    "quantity": "{quantity}",
    "recorded": "{recorded:.3g}",
    "ours": "{ours:.3g}",
    "unit": "{unit}",
    "mind": "{note}",
}
# The image in a picture of the sweep of the spine, and its soft tissue above the bone.
SPINE_IMAGE = slice(None), slice(12, 602), slice(187, 632)
SPINE_TISSUE = slice(None), slice(62, 212), slice(187, 632)
# A panel: the arguments of ``draw_panel``, or a picture and its title.
Panel = dict[str, Any] | tuple[np.ndarray, str]
Part = tuple[list[ScannerRow], list[Panel]]


@study_command(
    "scanner",
    click.option(
        "--data",
        type=click.Path(path_type=Path),
        default=FOLDER,
        help="Folder of the recordings [shared/data/us beside the checkout].",
    ),
    arch="cpu",
)
def scanner(study: Study, data: Path) -> Results:
    """Send echoes of real scanners through the B-mode and Doppler chain.

    The recordings of PLUS (PlusLibData) and PyMUST are no part of this project; a part whose files are
    missing is left out, with a note. One minute.
    """
    pymust()
    missing = {
        name: absent
        for name, (files, _) in PARTS.items()
        if (absent := [file for file in files if not (data / file).is_file()])
    }
    parts = [part(data) for name, (_, part) in PARTS.items() if name not in missing]
    described = [asdict(row) for rows, _ in parts for row in rows]
    left_out = [f"{name}: left out, as {', '.join(files)} is not there" for name, files in missing.items()]
    text = "\n".join([table_of(COLUMNS, described), *left_out])
    report: dict[str, Any] = dict(backend=study.backend, left_out=missing, rows=described)
    panels = [panel for _, drawn in parts for panel in drawn]
    return Results(report, text, described, figure_of(panels) if panels else None)


def figure_of(panels: list[Panel]) -> "Figure":
    """One figure of all panels."""
    rows = -(-len(panels) // 2)
    figure, grid = panels_of((12, 4.6 * rows), rows, 2)
    for axes, panel in zip_longest(grid.flat, panels):
        if isinstance(panel, dict):
            draw_panel(axes, **panel)
        elif panel:
            axes.imshow(panel[0], cmap="gray", vmin=0, vmax=255)
            axes.set(title=panel[1], xticks=[], yticks=[])
        else:
            axes.axis("off")
    return figure


def _disc(data: Path) -> Part:
    rotation = rotating_disc.rotation_of(read_channel_data(data / DISC))
    ends = np.array([rotation.x_m.min(), rotation.x_m.max()])
    line = rotation.offset_m_s + rotation.slope_per_s * ends
    curves = [
        Curve(1e3 * rotation.x_m, rotation.velocity_m_s, ".", "our Doppler", dict(ms=2)),
        Curve(1e3 * ends, line, "k", f"{rotation.slope_per_s:.1f} m/s per m"),
    ]
    labels = dict(title="Rotating disc", xlabel="lateral [mm]", ylabel="away from the array [m/s]")
    return rotating_disc.measurements(rotation), [dict(curves=curves, legend={}, **labels)]


def _curved(data: Path) -> Part:
    iq, picture = read_iq(data / BK_IQ), read_picture(data / BK_PICTURE)
    amplitude = np.abs(iq)
    phantom = EchoPhantom(recorded_speckle.probe_of(iq.shape[1]), grey_maps.PIXELS)
    line, sample = grey_maps.curved_source(picture, *iq.shape)
    sector = np.isfinite(line)
    in_sector = grey_maps.root_at(amplitude, line[sector], sample[sector])
    grey_map = grey_maps.fitted_grey_map(in_sector, picture[sector])
    speckle = recorded_speckle.measurements(iq, phantom)
    ours = grey_maps.on_pixels_of(grey_maps.our_picture(amplitude, phantom), phantom, picture)
    both = sector & (ours > 0)
    correlation = float(spearmanr(ours[both], picture[both]).statistic)
    name = "curved array: rank correlation of our picture of its IQ"
    rows = [
        *speckle,
        *grey_maps.map_lines("curved array", grey_map),
        ScannerRow(grey_maps.PART, name, correlation, None, "", "with PLUS's picture"),
        *grey_maps.histogram_lines("curved array, sector", picture[sector], "PLUS's map"),
    ]
    for region in recorded_speckle.SPECKLE:
        inside = sector & _within(region.scanlines, line) & _within(region.samples, sample)
        rows += grey_maps.histogram_lines(f"curved array, {region.name}", picture[inside], "PLUS's map")
    return rows, [_map_panel("curved array", grey_map), (picture, "PLUS's picture"), (ours, "Ours")]


def _within(part: slice, place: np.ndarray) -> np.ndarray:
    return (place >= part.start) & (place < part.stop)


def _linear(data: Path) -> Part:
    iq, picture = read_iq(data / LINEAR_IQ), read_picture(data / LINEAR_PICTURE)
    ring = ring_down.fitted_ring_down(iq)
    image = picture[grey_maps.LINEAR_ROWS, grey_maps.LINEAR_COLUMNS]
    at_pixels = grey_maps.root_at(np.abs(iq), *grey_maps.linear_source(len(iq)))
    grey_map = grey_maps.fitted_grey_map(at_pixels.ravel(), image.ravel())
    rows = [
        *ring_down.measurements(ring, load_probe("linear")),
        *grey_maps.map_lines("linear array in air", grey_map),
        *grey_maps.histogram_lines("linear array in air, image", image, "PLUS's map"),
    ]
    law = f"fitted: 1/e in {ring.fall:.1f} wavelengths"
    curves = [
        Curve(ring.depth, ring.level_db, "-", "recorded", dict(lw=0.8)),
        Curve(ring.depth, ring.fitted_db(ring.depth), "k", law, dict(lw=1)),
    ]
    labels = dict(title="Linear array in air", xlabel="depth [wavelengths]", ylabel="level [dB]")
    panel = dict(curves=curves, legend={}, **labels)
    return rows, [panel, _map_panel("linear array in air", grey_map)]


def _wires(data: Path) -> Part:
    images, size = read_sweep(data / WIRES).images, wire_widths.pixel_size(data / WIRES_CONFIGURATION)
    depth, width = wire_widths.wire_widths(images, size)
    probe, at = load_probe("linear"), np.arange(10.0, 35.0, 2.0)
    curves = [Curve(depth, width, ".", "wires, half of the grey value", dict(ms=3))]
    for level in wire_widths.LEVELS_DB:
        ours = [wire_widths.beam_width_mm(probe, depth_mm, level) for depth_mm in at]
        curves.append(Curve(at, ours, "-", f"our linear probe, {level:g} dB"))
    rows = wire_widths.measurements(depth, width, probe)
    labels = dict(title="Wires in water", xlabel="depth [mm]", ylabel="lateral width [mm]")
    panel = dict(curves=curves, legend=dict(fontsize=8), **labels)
    return [*rows, *grey_maps.histogram_lines("wires in water, all", images)], [panel]


def _spine(data: Path) -> Part:
    images = read_sweep(data / SPINE).images
    parts = {
        "whole picture": images,
        "image": images[SPINE_IMAGE],
        "soft tissue above the bone": images[SPINE_TISSUE],
    }
    rows = [grey_maps.histogram_lines(f"spine, {name}", part) for name, part in parts.items()]
    return list(chain.from_iterable(rows)), []


def _map_panel(name: str, grey_map: grey_maps.GreyMap) -> Panel:
    law = f"{grey_map.scale:.1f} amplitude^{grey_map.exponent:.3f}"
    curves = [
        Curve(grey_map.amplitude_db, grey_map.grey, "o", "picture", dict(ms=3)),
        Curve(grey_map.amplitude_db, grey_map.power(), "k", law, dict(lw=1)),
    ]
    labels = dict(title=f"Grey map, {name}", xlabel="recorded amplitude [dB]", ylabel="grey")
    return dict(curves=curves, legend={}, **labels)


PARTS: dict[str, tuple[tuple[str, ...], Callable[[Path], Part]]] = {
    "rotating disc": ((DISC,), _disc),
    "curved array": ((BK_IQ, BK_PICTURE), _curved),
    "linear array in air": ((LINEAR_IQ, LINEAR_PICTURE), _linear),
    "wires": ((WIRES, WIRES_CONFIGURATION), _wires),
    "spine": ((SPINE,), _spine),
}
