"""The command line as a user meets it: what it writes, and one clear line for each mistake."""

import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import redirect_stderr
from functools import partial
from pathlib import Path
from pkgutil import resolve_name

import click
import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from conftest import ROOT
from PIL import Image
from synthetic_body import body

import app
from rehearsal.commands.command_line import CommandError
from rehearsal.commands.rehearse_command import why_no_display
from rehearsal.commands.rehearse_options import RehearseOptions
from render.display import X11Screen
from render.window import NoVulkan
from studies.study_command import STUDIES
from version import VERSION

REPORTED = {
    "particles",
    "clusters",
    "memberships",
    "tetrahedra",
    "arch",
    "radius_mm",
    "time_step_s",
    "substeps",
    "iterations",
    "stiffness",
    "ms_per_step",
    "ms_per_slice",
    "build_s",
    "finite",
    "volume_ratio_min",
    "max_penetration_mm",
}
SHORT = ("--seconds", "0.3", "--cell", "7", "--arch", "cpu")
PAPER = ("--seconds", "0.1", "--radius", "5", "--picture", "ct", "--arch", "cpu")


def run(*arguments, **environment) -> subprocess.CompletedProcess:
    """The program in a process of its own, without a display unless the environment gives one."""
    variables = {
        name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")
    }
    return subprocess.run(
        [sys.executable, str(ROOT / "app.py"), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=240,
        cwd=ROOT,
        env=variables | environment,
    )


def refused(*arguments) -> str:
    """The one line with which a command is refused."""
    errors = io.StringIO()
    with redirect_stderr(errors):
        status = app.main([str(argument) for argument in arguments])
    lines = errors.getvalue().strip().splitlines()
    assert status == 2 and len(lines) == 1 and lines[0].startswith("nephron: "), errors.getvalue()
    return lines[0]


@pytest.fixture(scope="module")
def pressed(tmp_path_factory) -> Path:
    """The folder of a short press of the embedded patient, with what was said: no command, no display, no
    choice of picture.
    """
    out = tmp_path_factory.mktemp("press")
    done = run(*SHORT, "--out", out)
    assert done.returncode == 0, done.stderr
    (out / "said.txt").write_text(done.stdout)
    return out


def test_a_headless_press_reports_what_it_promises(pressed):
    report = json.loads((pressed / "report.json").read_text())
    assert set(report) >= REPORTED
    page = (pressed / "report-001.html").read_text("utf-8")
    assert f"<h1>{report['title']}</h1>" in page and "B-mode, last image" in page
    assert {path.name for path in pressed.glob("*-001.*")} == {
        *("session-001.jsonl", "report-001.html", "kidney-001.glb", "kidney-001.stl")
    }
    assert report["version"] == VERSION
    assert report["finite"] is True and report["arch"] == "cpu" and report["cell_mm"] == 7
    assert report["particles"] == report["nodes"] > report["cells"] > 300
    for name in ("ms_per_step", "ms_per_slice"):
        spread = report[name]
        assert 0 < spread["min"] <= spread["median"] <= spread["max"] and set(spread) == {
            "mean",
            "sd",
            "min",
            "max",
            "median",
        }
    assert 0.95 < report["volume_ratio_min"] <= 1.01
    assert report["max_penetration_mm"] <= 0.8
    assert report["indentation_max_mm"] == pytest.approx(6.0, abs=1e-3)
    assert (
        report["complexity"]["renal"]["complexity"] == "moderate" and report["complexity"]["not_known"] == []
    )
    assert (report["picture"], report["detail_level"]) == ("both", "speckle") and report["probe"].startswith(
        "Drop-in"
    )


def test_it_leaves_pictures_in_which_the_press_is_seen(pressed):
    slices = [np.asarray(Image.open(path)).astype(int) for path in sorted((pressed / "slices").glob("*.png"))]
    # Echo and CT side by side, each 36 x 50 mm with the longer side as it was sampled.
    assert len(slices) >= 3 and slices[0].shape == (512, 2 * 369)
    assert np.abs(slices[0] - slices[-1]).mean() > 10
    assert slices[0].std() > 30
    with Image.open(pressed / "press.webp") as animation:
        assert animation.n_frames == len(slices)


def test_without_a_display_it_runs_headless_by_itself_and_says_so(pressed):
    said = (pressed / "said.txt").read_text()
    assert (
        "No display (DISPLAY is not set): running" in said and f"Open first: {pressed / 'press.webp'}" in said
    )
    assert len(list((pressed / "frames").glob("*.png"))) == len(list((pressed / "slices").glob("*.png")))


def test_a_display_that_does_not_answer_is_named(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":4242")
    assert why_no_display() == "DISPLAY is :4242, which does not answer"


def test_without_vulkan_it_says_so_in_one_line_and_options_reach_the_solver(tmp_path, monkeypatch, capsys):
    """That a machine has none is found in tests/render/test_render.py."""

    def no_driver(*_, **__):
        raise NoVulkan("no Vulkan driver found")

    monkeypatch.setattr("rehearsal.headless.open_viewer", no_driver)
    steps = "--substeps", "2", "--iterations", "5", "--stiffness", "0.7"
    assert app.main(["rehearse", "--headless", *PAPER, *steps, "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "No display" not in printed and "as the options ask" in printed
    assert sum("no Vulkan driver" in line for line in printed.splitlines()) == 1
    assert list((tmp_path / "slices").glob("*.png")) and not list((tmp_path / "frames").glob("*.png"))
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["substeps"], report["iterations"], report["stiffness"]) == (2, 5, 0.7)
    assert report["model"] == "shape-matching"
    assert report["particles"] > 1000 and report["memberships"] > report["particles"]
    # The particles are outside, but the surface follows clusters of them.
    assert report["max_penetration_mm"] <= 4.0


def test_a_window_without_vulkan_is_refused_before_anything_is_built(monkeypatch, tmp_path):
    monkeypatch.setattr("rehearsal.commands.rehearse_command.display_available", lambda: True)
    monkeypatch.setattr("sim.device.is_available", lambda arch: arch != "vulkan")
    assert "install a Vulkan driver" in refused("rehearse", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="of X11")
@pytest.mark.parametrize("depth", [16, 30])
def test_a_screen_on_which_a_driver_would_end_the_process_is_refused(monkeypatch, tmp_path, depth):
    monkeypatch.setattr("render.display._of_x11", lambda name: X11Screen(1920, 1080, 1.0, depth))
    monkeypatch.setattr("sim.device.is_available", lambda arch: True)
    assert f"has {depth} bits of colour; expected 24" in refused("rehearse", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_python_without_the_packages_is_one_line():
    bare = [sys.executable, "-S", str(ROOT / "app.py"), "--version"]
    done = subprocess.run(bare, capture_output=True, text=True, cwd=ROOT, timeout=60)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1 and "is not installed for this Python; run make run once" in line


def test_ctrl_c_ends_it_in_words(tmp_path, monkeypatch, capsys):
    (tmp_path / "click.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGINT)")
    done = run("--version", PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stderr) == (130, "Stopped.\n")

    def ends(by, keys):
        raise by

    for by, words in ((KeyboardInterrupt(), "Stopped."), (click.exceptions.Exit(130), "")):
        monkeypatch.setattr("rehearsal.commands.rehearse_command.keys_text", partial(ends, by))
        assert app.main(["keys"]) == 130 and capsys.readouterr().err.strip() == words


@pytest.fixture(scope="module")
def volumes(tmp_path_factory) -> tuple[Path, Path]:
    """A CT and its labels."""
    folder = tmp_path_factory.mktemp("volumes")
    for name, image in zip(("ct", "labels"), body(), strict=True):
        sitk.WriteImage(image, str(folder / f"{name}.nrrd"))
    return folder / "ct.nrrd", folder / "labels.nrrd"


# Seconds after the start of Python; the modules are loaded until 1 to 3 s.
@pytest.mark.parametrize(
    ("kind", "after_s"), [(signal.SIGINT, 0.3), (signal.SIGTERM, 0.9), (signal.SIGINT, 2.0)]
)
def test_an_import_that_is_stopped_ends_in_words_and_leaves_nothing(volumes, tmp_path, kind, after_s):
    begun = (
        "import runpy, sys; print(flush=True); sys.argv[0] = 'app.py'; runpy.run_path('app.py', "
        "run_name='__main__')"
    )
    wanted = "import", *volumes, "--organ", "2", "--tumour", "3", "--out", tmp_path / "out"
    program = subprocess.Popen(
        [sys.executable, "-c", begun, *map(str, wanted)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )
    program.stdout.readline()
    time.sleep(after_s)
    program.send_signal(kind)
    printed = program.communicate(timeout=60)[1].decode()
    assert (program.returncode, printed.strip()) == (130, "Stopped.") and not list(tmp_path.iterdir())


@pytest.mark.parametrize("swallows", ["except BaseException: pass", "finally: sys.exit"])
def test_a_module_that_catches_all_does_not_catch_ctrl_c(tmp_path, swallows):
    """As one does that looks for libraries, and goes on without them."""
    swallowing = f"import os, signal, sys\ntry:\n os.kill(os.getpid(), signal.SIGINT)\n{swallows}\n"
    (tmp_path / "matplotlib.py").write_text(swallowing)
    done = run("study", "stability", "--quick", "--out", tmp_path / "out", PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stderr.strip()) == (130, "Stopped.")


@pytest.mark.parametrize(
    ("encoding", "shown"), [("ascii", "Ω – µ".encode()), ("cp1252", b"\\u03a9 \x96 \xb5")]
)
def test_output_shows_what_its_encoding_lacks_in_another_form(
    volumes, tmp_path, monkeypatch, encoding, shown
):
    named = shutil.copy(volumes[1], tmp_path / "Ω – µ.nrrd")
    nowhere = tmp_path / os.fsdecode(b"\xce\xa9 \xe9")
    for labels, status in ((named, 0), (nowhere, 2)):
        for name in ("stdout", "stderr"):
            monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding=encoding))
        assert app.main(["import", "--list", str(volumes[0]), str(labels)]) == status
        printed, errors = (stream.flush() or stream.buffer.getvalue() for stream in (sys.stdout, sys.stderr))
        assert shown in printed if status == 0 else b"no such file" in errors


@pytest.mark.parametrize("command", [("keys",), ("import", "--help")])
def test_a_closed_pipe_ends_it_without_a_traceback(command):
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, str(ROOT / "app.py"), *command], stdout=writing, stderr=subprocess.PIPE, cwd=ROOT
    )
    os.close(writing)
    assert done.returncode == 1 and done.stderr == b""


def test_a_mistake_ends_the_program_with_one_line_and_status_2(tmp_path):
    done = run("rehearse", tmp_path / "none.toml")
    assert done.returncode == 2 and done.stderr.startswith("nephron: ") and done.stderr.count("\n") == 1


def test_mistakes_are_one_line(tmp_path, monkeypatch):
    assert "no such scene file" in refused("rehearse", tmp_path / "none.toml")
    assert "Did you mean one of: '--headless'" in refused("rehearse", "--hedless")
    assert "No such command 'rehears'. Did you mean 'rehearse'?" in refused("rehears")
    assert "Did you mean" not in refused("xyz")
    assert "leave out --no-pictures or --link" in refused("rehearse", "--headless", "--no-pictures", "--link")
    with pytest.raises(CommandError, match="add --headless"):
        RehearseOptions(no_pictures=True).check()
    monkeypatch.setattr("rehearsal.commands.rehearse_command.display_available", lambda: True)
    assert "a window stays open" in refused("rehearse", "--seconds", "5")
    assert "--arch" in refused("rehearse", "--arch", "abacus")
    assert "--seconds" in refused("rehearse", "--seconds", "-1")
    assert "--radius = 0.0" in refused("rehearse", "--radius", "0")
    (tmp_path / "file").write_text("")
    assert "choose another --out" in refused("rehearse", "--headless", "--out", tmp_path / "file")
    (tmp_path / "scene.toml").write_text("[anatomy]\n[tissue]\ncell_cm = 1\n")
    assert "write cell_mm" in refused("rehearse", tmp_path)
    (tmp_path / "empty").mkdir()
    assert "has no scene.toml" in refused("rehearse", tmp_path / "empty")


@pytest.mark.parametrize(
    "fault, words",
    [
        (
            OSError(errno.ENOSPC, "No space left on device"),
            "what was to be written: No space left on device; free some",
        ),
        (OSError(errno.EACCES, "Permission denied", "a.json"), "a.json: Permission denied; check"),
        (MemoryError(), "larger cells"),
    ],
)
def test_what_a_machine_lacks_is_one_line(fault, words, monkeypatch):
    def fails(keys):
        raise fault

    monkeypatch.setattr("rehearsal.commands.rehearse_command.keys_text", fails)
    assert words in refused("keys")


def types(group: click.Group) -> Iterator[click.ParamType]:
    """Of what kind the options of all commands are."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            yield from types(command)
        yield from (option.type for option in command.params)


def test_no_range_of_numbers_lets_one_through_that_is_none():
    ranges = [number for number in types(app.cli) if isinstance(number, click.FloatRange)]
    assert len(ranges) > 20
    for number in ranges:
        for word in ("nan", "inf", "-inf"):
            with pytest.raises(click.BadParameter):
                number.convert(word, None, None)


@pytest.mark.parametrize(
    ("table", "name"), [(table, name) for table in (app.COMMANDS, STUDIES) for name in table]
)
def test_the_list_of_commands_has_each_commands_own_first_sentence(table, name):
    place, text = table[name]
    own = resolve_name(place).help.split("\n\n")[0]
    assert text == " ".join(own.split())


def test_help_comes_without_the_libraries_that_take_seconds():
    code = (
        "import sys, app; app.main(['--help']); print({'taichi', 'trimesh', 'matplotlib', 'pydantic'} & "
        "set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip().endswith("set()"), done.stdout


def test_numbers_have_everyday_names_in_the_help():
    named = {option.name for option in types(app.cli)}
    assert {"number", "integer"} <= named and not [
        name for name in named if "float" in name or "range" in name
    ]


def test_an_organ_too_small_for_its_particles_is_refused_in_one_line(tmp_path):
    trimesh.creation.icosphere(subdivisions=2, radius=3.0).export(tmp_path / "organ.stl")
    (tmp_path / "scene.toml").write_text("[anatomy]\n[tissue]\nmodel = 'shape-matching'\nradius_mm = 20.0\n")
    assert "choose a smaller radius" in refused("rehearse", tmp_path, "--headless", "--out", tmp_path / "out")


def test_import_refuses_in_one_line_too(tmp_path):
    assert "no such file or folder" in refused(
        "import", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "o"
    )
    assert "--out" in refused("import", tmp_path / "a", tmp_path / "b")
    image = sitk.Image(8, 8, 8, sitk.sitkInt16)
    sitk.WriteImage(image, str(tmp_path / "ct.nrrd"))
    volume = tmp_path / "ct.nrrd"
    assert "--organ is '1,,2'" in refused(
        "import", volume, volume, "--organ", "1,,2", "--out", tmp_path / "o"
    )
    assert not (tmp_path / "o").exists()


def test_a_real_kidney_comes_in_and_gives_way(data, tmp_path, monkeypatch, capsys):
    ct, labels, side = "crlm_1004", "crlm_1004_labels/kidneys_provisional.nii.gz", "left"
    patient = tmp_path / "patient"
    files = str(data / "ct" / ct), str(data / "ct" / labels)
    assert app.main(["import", *files, "--side", side, "--out", str(patient)]) == 0
    said = capsys.readouterr().out
    organ = trimesh.load_mesh(patient / "organ.stl")
    assert organ.is_watertight and organ.volume / 1000 == pytest.approx(125.6, rel=0.01)
    assert f"{side} kidney" in said and "crlm" not in (patient / "scene.toml").read_text()
    monkeypatch.setattr("rehearsal.headless.open_viewer", lambda *_, **__: None)
    few = *SHORT, "--picture", "ct"
    assert app.main(["rehearse", str(patient), "--headless", *few, "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    # At the corners of the probe, between the points of contact.
    assert report["finite"] and report["max_penetration_mm"] <= 2.5 and report["volume_ratio_min"] > 0.95
    slices = [
        np.asarray(Image.open(path)).astype(int)
        for path in sorted((tmp_path / "out" / "slices").glob("*.png"))
    ]
    assert np.abs(slices[0] - slices[-1]).mean() > 5


@pytest.mark.skipif(sys.platform == "win32", reason="a shell of POSIX")
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_no_file_gets_the_number_of_a_closed_stream(tmp_path, closed):
    """What a library prints would be written into that file."""
    script = (
        "import app, sys; app.main(['--version']); print(open(sys.argv[1], 'w').fileno(), "
        "file=open(sys.argv[2], 'w'))"
    )
    names = [str(tmp_path / "first"), str(tmp_path / "number")]
    subprocess.run(
        ["sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", script, *names], cwd=ROOT, check=True
    )
    assert int((tmp_path / "number").read_text()) > 2
