"""Cases from the field for the command line: paths, streams, damaged sessions, tables and texts."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from synthetic_body import body, coarsely, without_picture

import app
from errors import UserError
from rehearsal.tracking.pose_file import load_poses, load_timed_poses
from scenes.atomic_files import atomic_write
from scenes.scene import EMBEDDED
from scenes.terminal import shell_command

CASE = Path(__file__).parents[1] / "studies" / "reference" / "embedded"
# Words of Python, pydantic and parsers, which tell a surgeon nothing.
PYTHONS = re.compile(
    r"codec can't|instance of|max_str_digits|recursion|not iterable|Errno|is None|Expecting "
    r"value|\(char \d|extract fields|datetime\."
)
DEEP, LONG = "[" * 100_000, "9" * 5000
POSE = ["1", "0", "0", "92,5", "0", "1", "0", "-3,25", "0", "0", "1", "20,0", "0", "0", "0", "1"]
GERMAN = ";".join(POSE)


def refused(capsys, *arguments) -> str:
    """The one line with which a command line is refused, in words."""
    assert app.main([str(argument) for argument in arguments]) == 2
    line = capsys.readouterr().err.strip()
    assert line.startswith("nephron: ") and "\n" not in line
    assert not PYTHONS.search(line), line
    return line


def scene_file(folder: Path, change) -> Path:
    (folder / "scene.toml").write_text(change(EMBEDDED.read_text("utf-8")), "utf-8")
    return folder / "scene.toml"


@pytest.fixture(scope="module")
def volumes(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("volumes")
    for name, image in zip(("ct", "labels"), body(spacing=(6.0, 5.0, 6.0)), strict=True):
        sitk.WriteImage(image, str(folder / f"{name}.nii.gz"))
    return folder


# Paths and streams.


@pytest.mark.parametrize("name", [b"Pat\xe9 1", b'a\'b "c" 100%d', b"line\nbreak", b"n" * 240])
def test_any_folder_name_is_read_and_written(volumes, tmp_path, capsys, name):
    """Folders of Linux archives: bytes that are not UTF-8, quotes, %, a line break, 240 letters."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
    folder.mkdir()
    for file in ("ct.nii.gz", "labels.nii.gz"):
        shutil.copy(volumes / file, folder / file)
    assert app.main(["import", str(folder / "ct.nii.gz"), str(folder / "labels.nii.gz"), "--list"]) == 0
    assert "axial" in capsys.readouterr().out


def test_the_command_that_is_printed_can_be_pasted():
    """A patient's folder whose name is not UTF-8: what the terminal shows is what the shell takes."""
    folder = b"Pat\xe9 1"
    shown = shell_command("rehearse", Path(os.fsdecode(folder))).encode("utf-8", "backslashreplace")
    words = shown.split(b" rehearse ", 1)[1]
    printed = subprocess.run(["bash", "-c", b"printf %s " + words], capture_output=True, check=True).stdout
    assert printed == folder


def test_a_file_name_that_is_too_long_is_named_itself(tmp_path):
    """plan --out with 256 letters: the error names that file, not the temporary one."""
    path = tmp_path / ("p" * 251 + ".json")
    with pytest.raises(OSError, match="too long") as caught, atomic_write(path) as partial:
        partial.write_text("{}")
    assert caught.value.filename == str(path)


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_closed_stream_ends_nothing(volumes, tmp_path, monkeypatch, stream):
    """A service or a Windows program without a console starts the import: Python has no such stream."""
    coarsely(monkeypatch)
    without_picture(monkeypatch)
    arguments = ["import", str(volumes / "ct.nii.gz"), str(volumes / "labels.nii.gz"), "--out"]
    options = ["--organ", "1,2", "--tumour", "3", "--side", "left"]
    monkeypatch.setattr(sys, stream, None)
    assert app.main([*arguments, str(tmp_path / "a"), *options]) == 0
    assert (tmp_path / "a" / "scene.toml").is_file()


# Damaged sessions.

HEADER = dict(nephron_session=2, anatomy="0", scene={}, probe={}, arch="cpu", time_step_s=0.01)
AFTER_HEADER = {
    "at-nan": b'{"at": NaN, "poses": "", "digest": ""}',
    "number": b"5",
    "list": b"[]",
    "text": b'"summary"',
    "blank": b"\n{}",
    "zero-line": bytes(50),
    "long": b'{"at": ' + LONG.encode() + b"}",
    "deep": DEEP.encode(),
}
SESSIONS = {
    "empty": b"",
    "zeros": bytes(4096),
    "format": json.dumps(HEADER | {"nephron_session": 10**40}).encode(),
    "nan": json.dumps(HEADER | {"time_step_s": float("nan")}).encode() + b"\n",
    "utf-16": (json.dumps(HEADER) + '\n{"at": 0}\n').encode("utf-16"),
    **{name: json.dumps(HEADER).encode() + b"\n" + line + b"\n" for name, line in AFTER_HEADER.items()},
}


@pytest.mark.parametrize("content", SESSIONS.values(), ids=SESSIONS)
def test_a_damaged_session_is_refused_in_words(tmp_path, capsys, content):
    """A session after a power cut, an editor or a download."""
    path = tmp_path / "session-001.jsonl"
    path.write_bytes(content)
    line = refused(capsys, "rehearse", "--headless", "--replay", path, "--out", tmp_path / "o")
    assert path.name in line and len(line) < 400
    assert not (tmp_path / "o").exists() or not any((tmp_path / "o").iterdir())


# Tables and texts.


@pytest.mark.parametrize("content", [DEEP, f'[{{"time_s": {LONG}}}]'], ids=["deep", "long"])
def test_poses_of_a_damaged_json_are_refused_in_words(tmp_path, capsys, content):
    """A damaged list of poses: brackets without end, digits without end."""
    (tmp_path / "poses.json").write_text(content)
    line = refused(capsys, "scan", EMBEDDED, "--pose", tmp_path / "poses.json", "--out", tmp_path / "o")
    assert "poses.json" in line


@pytest.mark.parametrize("content", ["x = " + DEEP, "x = " + LONG], ids=["deep", "long"])
@pytest.mark.parametrize("kind", ["scene", "probe", "keys"])
def test_a_damaged_toml_is_refused_in_words(tmp_path, capsys, kind, content):
    """A damaged scene, probe or key file: brackets without end, digits without end."""
    (tmp_path / "a.toml").write_text(content)
    arguments = dict(
        scene=["export", tmp_path / "a.toml", "--out", tmp_path / "o"],
        probe=["import", "ct", "labels", "--out", tmp_path / "o", "--probe", tmp_path / "a.toml"],
        keys=["rehearse", "--headless", "--keys", tmp_path / "a.toml", "--out", tmp_path / "o"],
    )[kind]
    assert "a.toml" in refused(capsys, *arguments)


@pytest.mark.parametrize(
    ("section", "value"),
    [("tissue", '"soft"'), ("image", "[1]"), ("shape", "[5]"), ("gravity", "2024-01-01")],
)
def test_a_value_where_a_section_is_expected_is_said_without_class_names(tmp_path, capsys, section, value):
    """A scene edited by hand: a section's name used as a key."""

    def change(text: str) -> str:
        anatomy = text[text.index("[anatomy]") :].split("\n[", 1)[0]
        return f"{section} = {value}\n{anatomy}\n"

    assert section in refused(capsys, "export", scene_file(tmp_path, change), "--out", tmp_path / "o")


@pytest.mark.parametrize(
    "text",
    [
        "sep=;\r\n" + GERMAN,
        '"sep=;"\r\n' + GERMAN,
        GERMAN + ";;",
        GERMAN + "\r\n" + ";" * 15 + "\r\n" + ";" * 15,
        ";".join(f'"{cell}"' for cell in POSE),
        GERMAN.replace("92,5", "9,25E+01"),
        GERMAN.replace("-3,25", "-3,25\u00a0"),
    ],
    ids=["sep", "quoted-sep", "empty-columns", "empty-rows", "quoted-cells", "exponent", "no-break-space"],
)
def test_one_pose_of_excel_is_one_pose(tmp_path, text):
    """A pose saved by a German Excel, with what Excel leaves around the cells."""
    (tmp_path / "poses.csv").write_bytes((text + "\r\n").encode())
    ((_, pose),) = load_poses(tmp_path / "poses.csv").items()
    assert pose[:3, 3].tolist() == [92.5, -3.25, 20.0]


@pytest.mark.parametrize("wrong", ["#WERT!", "1.092,5", "tx", "'92,5"])
def test_a_cell_that_is_no_number_is_quoted(tmp_path, capsys, wrong):
    """A cell with Excel's error, thousands, a heading or an apostrophe: the message shows it."""
    (tmp_path / "poses.csv").write_text(GERMAN.replace("92,5", wrong))
    line = refused(capsys, "scan", EMBEDDED, "--pose", tmp_path / "poses.csv", "--out", tmp_path / "o")
    assert wrong in line and "pose 1" in line


def test_a_point_for_thousands_is_not_taken_for_a_decimal_point(tmp_path):
    """Times 0,5 s and 1.200 s of a German Excel: 1200 s, or refused, and never 1.2 s."""
    (tmp_path / "track.csv").write_text(f"0,5;{GERMAN}\n1.200;{GERMAN}\n")
    try:
        times = load_timed_poses(tmp_path / "track.csv").times_s.tolist()
    except UserError as error:
        times = str(error)
    assert times == [0.5, 1200.0] or "1.200" in times


@pytest.mark.parametrize("suffix", [".txt", ".tsv"])
def test_excels_text_separated_by_tabs_is_read_or_its_suffix_named(tmp_path, capsys, suffix):
    """Excel saves text separated by tabs as .txt: no word of JSON helps there."""
    path = tmp_path / f"poses{suffix}"
    path.write_bytes("\t".join(POSE).encode("utf-16"))
    try:
        read = load_poses(path)["0001"][0, 3]
    except UserError as error:
        read = str(error)
    assert read == 92.5 or (".csv" in read and "not valid JSON" not in read)


def test_a_pose_name_that_is_not_possible_is_quoted(tmp_path, capsys):
    """A pose named in the user's language: the message shows the name, and no pattern in other letters."""
    pose = dict(name="Läsion 1", probe_to_patient=np.eye(4).tolist())
    (tmp_path / "poses.json").write_text(json.dumps([pose], ensure_ascii=False), "utf-8")
    line = refused(capsys, "scan", EMBEDDED, "--pose", tmp_path / "poses.json", "--out", tmp_path / "o")
    assert "Läsion 1" in line and "a-za-z" not in line


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: (text.replace("\n", ",Größe\n", 1)).encode("cp1252"), "UTF-8"),
        (
            lambda text: ("# made by hand\n\n" + re.sub(r"\n([^,\n]*),[^,\n]*", r"\n\1,zz", text)).encode(),
            "line 4",
        ),
        (lambda text: re.sub(r"(\n[^,\n]*,[^,\n]*)[^\n]*", r"\1", text, count=1).encode(), "line 2"),
    ],
    ids=["code-page", "line-number", "short-line"],
)
def test_a_fault_in_a_table_of_beads_is_said_in_words(tmp_path, capsys, change, words):
    """beads.csv of a laboratory: Excel's code page, a comment before the header, a line that was cut off."""
    shutil.copytree(CASE, tmp_path / "case")
    beads = tmp_path / "case" / "beads.csv"
    beads.write_bytes(change(beads.read_text("utf-8")))
    assert words in refused(capsys, "validate", tmp_path / "case")
