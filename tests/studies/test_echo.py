"""The B-mode image of virtual test objects against SIMUS, and the command that compares them."""

import sys

import pytest
from study_runs import refusal, written

import app
from sim.device import start
from studies.echo import echo_command, echo_phantom, echo_rows
from studies.echo.echo_phantom import EchoPhantom
from studies.echo.echo_rows import (
    Row,
    attenuation,
    cysts,
    doppler_shifts,
    edge_width,
    elevation_lengths,
    lateral_widths,
    speckle_statistics,
    steered_width,
)
from ultrasound.probe import load_probe

pytest.importorskip("pymust")


@pytest.fixture(scope="module", params=["drop-in", "micro", "phased"])
def phantom(request):
    start("cpu")
    return request.param, EchoPhantom(load_probe(request.param))


def test_widths_lengths_and_levels_are_within_the_bars_of_simus(phantom, monkeypatch):
    # With a third of the places the level of a cyst is 0.5 dB off, and with a quarter of the beats a mean
    # velocity 2 %.
    monkeypatch.setattr(echo_rows, "CYST_POINTS", 10_000)
    monkeypatch.setattr(echo_phantom, "BEATS", 50)
    name, test_object = phantom
    further = {
        "drop-in": [edge_width],
        "micro": [edge_width, speckle_statistics, cysts, attenuation, doppler_shifts],
        "phased": [steered_width],
    }[name]
    found = [row for part in (lateral_widths, *further) for row in part(test_object, name)]
    assert len(found) == (23 if name == "micro" else 4)
    assert [row for row in found if not row.is_within] == []


def test_speckle_decorrelates_across_the_plane_as_in_simus(phantom):
    name, test_object = phantom
    at_focus = next(iter(elevation_lengths(test_object, name)))
    assert at_focus.is_within, at_focus


def test_a_row_is_judged_by_its_unit():
    assert Row("a", 1.19, 1.0, "mm").is_within and not Row("a", 0.79, 1.0, "mm").is_within
    assert Row("a", 1.04, 1.0, "kHz").is_within and not Row("a", 1.06, 1.0, "kHz").is_within
    assert Row("a", -12.9, -10.0, "dB").is_within and not Row("a", -6.9, -10.0, "dB").is_within


def test_the_command_writes_what_it_prints(monkeypatch, capsys, tmp_path):
    rows = [
        Row("drop-in, lateral width", 0.5, 0.48, "mm"),
        Row("drop-in, cyst of 4 mm", -40.0, -30.0, "dB", "noise"),
    ]
    monkeypatch.setattr(echo_command, "rows", lambda: iter(rows))
    assert app.main(["study", "echo", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "1 of 2 within" in printed and "noise" in printed
    report, rows = written(tmp_path, "echo")
    assert [row["within"] for row in report["rows"]] == [True, False]
    assert {"name", "ours", "reference", "unit"} <= set(report["rows"][0]) and len(rows) == 2


def test_without_the_simulator_it_says_how_to_install_it(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "pymust", None)
    line = refusal(capsys, "study", "echo", "--out", tmp_path / "echo")
    assert "pymust" in line and "requirements-dev.txt" in line
    assert not (tmp_path / "echo").exists()
