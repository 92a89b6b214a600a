"""What commands share."""

from pathlib import Path, PurePosixPath

import click.testing
import pytest

from errors import PatientError
from rehearsal.commands.command_line import CommandError, load_patient, make_folder, save_figures
from rehearsal.commands.plan_command import PlanOptions, rehearse_command_line
from scenes.atomic_files import check_folder
from scenes.scene import EMBEDDED
from scenes.terminal import shell_command


def test_a_folder_stands_for_its_scene(tmp_path):
    (tmp_path / "scene.toml").write_text(Path(EMBEDDED).read_text("utf-8"), "utf-8")
    scene, anatomy = load_patient(tmp_path)
    assert scene.anatomy.phantom and anatomy.organ.is_watertight and anatomy.tumour.is_watertight


def test_a_folder_is_tried_before_the_work(tmp_path, bytes_to_a_file):
    make_folder(tmp_path / "out")
    # It may be entered and listed, and what is written to it does not stay.
    with bytes_to_a_file(0):
        with pytest.raises(CommandError, match=r"out: cannot be written to \(.+\); choose another --out"):
            make_folder(tmp_path / "out")
        with pytest.raises(PatientError, match=r"a: cannot be made in .* \(.+\); choose a folder"):
            check_folder(tmp_path / "out" / "a")
    check_folder(tmp_path / "out" / "a")
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("system", "quoted"), [("linux", """'Fritz "$HOME"/a b'"""), ("win32", r'"Fritz \"$HOME\"/a b"')]
)
def test_a_command_to_be_pasted_is_quoted_as_its_shell_needs_it(monkeypatch, system, quoted):
    monkeypatch.setattr("scenes.terminal.sys.platform", system)
    path = PurePosixPath('Fritz "$HOME"/a b')
    assert shell_command("rehearse", path, "--at", "3") == f"python app.py rehearse {quoted} --at 3"


@pytest.mark.parametrize(
    ("scene", "probe", "words"),
    [(EMBEDDED, None, []), (Path("a b"), "linear", ["a b", "--probe", "linear"])],
)
def test_what_follows_a_plan_names_its_scene_and_probe(scene, probe, words):
    changes = {"transducer.probe": probe} if probe else {}
    asked = PlanOptions(scene=scene, out=Path("plan.json"), changes=changes)
    assert rehearse_command_line(asked) == shell_command("rehearse", *words, "--plan", "plan.json")


def test_figures_that_cannot_be_written_say_so(tmp_path, capsys):
    save_figures({"mm": 1.0}, tmp_path / "a.json")
    assert (tmp_path / "a.json").is_file() and "Wrote" in capsys.readouterr().out
    with pytest.raises(CommandError, match=r"cannot be written \(.*\); choose another --json"):
        save_figures({"mm": 1.0}, tmp_path / "none" / "a.json")


@pytest.mark.parametrize("leaves", [[], ["a.txt"]])
def test_a_command_that_leaves_nothing_leaves_no_folder(tmp_path, leaves):
    out = tmp_path / "made" / "here"

    @click.command()
    def command() -> None:
        make_folder(out)
        for name in leaves:
            (out / name).write_text("")
        raise CommandError("no display")

    assert click.testing.CliRunner().invoke(command).exit_code == 1
    assert list(tmp_path.rglob("*.txt")) == [out / name for name in leaves]
    assert out.exists() == (tmp_path / "made").exists() == bool(leaves)
    # One that was there stays.
    out.mkdir(parents=True, exist_ok=True)
    assert click.testing.CliRunner().invoke(command).exit_code == 1 and out.is_dir()
