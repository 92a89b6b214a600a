"""The command ``study scanner``: echoes of real scanners through our own chain."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from scipy.stats import spearmanr

from rehearsal.commands.command_line import make_folder, start_taichi
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
from studies.study_options import out_option
from studies.study_results import finish_axes, table_of, write_results
from ultrasound.probe import load_probe
from ultrasound.sweep_file import read_sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = (
    ("part", "{part}"),
    ("quantity", "{quantity}"),
    ("recorded", "{recorded:.3g}"),
    ("ours", "{ours:.3g}"),
    ("unit", "{unit}"),
    ("mind", "{note}"),
)
# The image in a picture of the sweep of the spine, and its soft tissue above the bone.
SPINE_IMAGE = slice(None), slice(12, 602), slice(187, 632)
SPINE_TISSUE = slice(None), slice(62, 212), slice(187, 632)
Panel = Callable[["Axes"], None]


@click.command()
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    default=FOLDER,
    help="Folder of the recordings [shared/data/us beside the checkout].",
)
@out_option
def scanner(data: Path, out: Path) -> None:
    """Send echoes of real scanners through the B-mode and Doppler chain.

    The recordings of PLUS (PlusLibData) and PyMUST are no part of this project; a part whose files are
    missing is left out, with a note. One minute.
    """
    pymust()
    make_folder(out)
    backend = start_taichi("cpu")
    lines: list[ScannerRow] = []
    panels: list[Panel] = []
    missing: dict[str, list[str]] = {}
    for name, (files, part) in PARTS.items():
        absent = [file for file in files if not (data / file).is_file()]
        if absent:
            missing[name] = absent
            continue
        measured, drawn = part(data)
        lines += measured
        panels += drawn
    described = [asdict(each) for each in lines]
    left_out = [f"{name}: left out, as {', '.join(files)} is not there" for name, files in missing.items()]
    text = "\n".join([table_of(COLUMNS, described), *left_out])
    report: dict[str, Any] = dict(backend=backend, left_out=missing, rows=described)
    write_results(out, "scanner", report, text, described, figure_of(panels) if panels else None)


def figure_of(panels: list[Panel]) -> "Figure":
    """Return one figure of all panels."""
    from matplotlib.figure import Figure

    rows = -(-len(panels) // 2)
    figure = Figure((12, 4.6 * rows), layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False).ravel()
    for each, panel in zip(axes, panels, strict=False):
        panel(each)
    for unused in axes[len(panels) :]:
        unused.axis("off")
    return figure


def _disc(data: Path) -> tuple[list[ScannerRow], list[Panel]]:
    rotation = rotating_disc.rotation_of(read_channel_data(data / DISC))

    def panel(axes: "Axes") -> None:
        ends = np.array([rotation.x_m.min(), rotation.x_m.max()])
        axes.plot(1e3 * rotation.x_m, rotation.velocity_m_s, ".", ms=2, label="our Doppler")
        axes.plot(
            1e3 * ends,
            rotation.offset_m_s + rotation.slope_per_s * ends,
            "k",
            label=f"{rotation.slope_per_s:.1f} m/s per m",
        )
        finish_axes(
            axes, {}, title="Rotating disc", xlabel="lateral [mm]", ylabel="away from the array [m/s]"
        )

    return rotating_disc.measurements(rotation), [panel]


def _curved(data: Path) -> tuple[list[ScannerRow], list[Panel]]:
    iq, picture = read_iq(data / BK_IQ), read_picture(data / BK_PICTURE)
    amplitude = np.abs(iq)
    phantom = EchoPhantom(recorded_speckle.probe_of(iq.shape[1]), grey_maps.PIXELS)
    lines = recorded_speckle.measurements(iq, phantom)
    line, sample = grey_maps.curved_source(picture, *iq.shape)
    sector = np.isfinite(line)
    found = grey_maps.fitted_grey_map(
        grey_maps.root_at(amplitude, line[sector], sample[sector]), picture[sector]
    )
    ours = grey_maps.on_pixels_of(grey_maps.our_picture(amplitude, phantom), phantom, picture)
    both = sector & (ours > 0)
    lines += [
        *grey_maps.map_lines("curved array", found),
        ScannerRow(
            grey_maps.PART,
            "curved array: rank correlation of our picture of its IQ",
            float(spearmanr(ours[both], picture[both]).statistic),
            None,
            "",
            "with PLUS's picture",
        ),
        *grey_maps.histogram_lines("curved array, sector", picture[sector], "PLUS's map"),
    ]
    for region in recorded_speckle.SPECKLE:
        inside = sector & _within(region.scanlines, line) & _within(region.samples, sample)
        lines += grey_maps.histogram_lines(f"curved array, {region.name}", picture[inside], "PLUS's map")
    return lines, [
        _map_panel("curved array", found),
        _picture_panel("PLUS's picture", picture),
        _picture_panel("Ours", ours),
    ]


def _within(part: slice, place: np.ndarray) -> np.ndarray:
    return (place >= part.start) & (place < part.stop)


def _linear(data: Path) -> tuple[list[ScannerRow], list[Panel]]:
    iq, picture = read_iq(data / LINEAR_IQ), read_picture(data / LINEAR_PICTURE)
    ring = ring_down.fitted_ring_down(iq)
    image = picture[grey_maps.LINEAR_ROWS, grey_maps.LINEAR_COLUMNS]
    found = grey_maps.fitted_grey_map(
        grey_maps.root_at(np.abs(iq), *grey_maps.linear_source(len(iq))).ravel(), image.ravel()
    )
    lines = [
        *ring_down.measurements(ring, load_probe("linear")),
        *grey_maps.map_lines("linear array in air", found),
        *grey_maps.histogram_lines("linear array in air, image", image, "PLUS's map"),
    ]

    def panel(axes: "Axes") -> None:
        axes.plot(ring.depth, ring.level_db, lw=0.8, label="recorded")
        axes.plot(
            ring.depth,
            ring.fitted_db(ring.depth),
            "k",
            lw=1,
            label=f"fitted: 1/e in {ring.fall:.1f} wavelengths",
        )
        finish_axes(axes, {}, title="Linear array in air", xlabel="depth [wavelengths]", ylabel="level [dB]")

    return lines, [panel, _map_panel("linear array in air", found)]


def _wires(data: Path) -> tuple[list[ScannerRow], list[Panel]]:
    images, size = read_sweep(data / WIRES).images, wire_widths.pixel_size(data / WIRES_CONFIGURATION)
    depth, width = wire_widths.wire_widths(images, size)
    probe = load_probe("linear")

    def panel(axes: "Axes") -> None:
        at = np.arange(10.0, 35.0, 2.0)
        axes.plot(depth, width, ".", ms=3, label="wires, half of the grey value")
        for level in wire_widths.LEVELS_DB:
            axes.plot(
                at,
                [wire_widths.beam_width_mm(probe, each, level) for each in at],
                label=f"our linear probe, {level:g} dB",
            )
        finish_axes(
            axes, dict(fontsize=8), title="Wires in water", xlabel="depth [mm]", ylabel="lateral width [mm]"
        )

    lines = wire_widths.measurements(depth, width, probe)
    return [*lines, *grey_maps.histogram_lines("wires in water, all", images)], [panel]


def _spine(data: Path) -> tuple[list[ScannerRow], list[Panel]]:
    images = read_sweep(data / SPINE).images
    lines = [
        *grey_maps.histogram_lines("spine, whole picture", images),
        *grey_maps.histogram_lines("spine, image", images[SPINE_IMAGE]),
        *grey_maps.histogram_lines("spine, soft tissue above the bone", images[SPINE_TISSUE]),
    ]
    return lines, []


def _map_panel(name: str, found: grey_maps.GreyMap) -> Panel:
    def panel(axes: "Axes") -> None:
        axes.plot(found.amplitude_db, found.grey, "o", ms=3, label="picture")
        power = found.scale * 10 ** (found.amplitude_db / 20 * found.exponent)
        axes.plot(
            found.amplitude_db, power, "k", lw=1, label=f"{found.scale:.1f} amplitude^{found.exponent:.3f}"
        )
        finish_axes(axes, {}, title=f"Grey map, {name}", xlabel="recorded amplitude [dB]", ylabel="grey")

    return panel


def _picture_panel(title: str, picture: np.ndarray) -> Panel:
    def panel(axes: "Axes") -> None:
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255)
        axes.set(title=title, xticks=[], yticks=[])

    return panel


PARTS: dict[str, tuple[tuple[str, ...], Callable[[Path], tuple[list[ScannerRow], list[Panel]]]]] = {
    "rotating disc": ((DISC,), _disc),
    "curved array": ((BK_IQ, BK_PICTURE), _curved),
    "linear array in air": ((LINEAR_IQ, LINEAR_PICTURE), _linear),
    "wires": ((WIRES, WIRES_CONFIGURATION), _wires),
    "spine": ((SPINE,), _spine),
}
