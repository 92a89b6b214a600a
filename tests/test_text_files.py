"""Text and tables as editors and spreadsheets save them."""

import json
from pathlib import Path

import numpy as np
import pytest

from errors import PatientError, UserError, parsing
from rehearsal.live_settings import DEFAULT_KEYS
from rehearsal.planning.plan_file import is_plan
from rehearsal.tracking.pose_file import PoseError, load_poses, load_timed_poses
from render.keys import keys_text, load_keys
from scenes.scene import EMBEDDED, SceneError, load_scene
from studies.number_table import read_numbers
from text_files import TextError, json_value, read_json, read_text, read_toml, table_rows
from ultrasound.probe import load_probe

ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"]


def saved(path: Path, text: str, encoding: str) -> Path:
    path.write_bytes(text.replace("\n", "\r\n").encode(encoding))
    return path


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_text_is_read_as_windows_saves_it(tmp_path, encoding):
    assert read_text(saved(tmp_path / "a.txt", "a = 'Ω µ'\nb\n", encoding)) == "a = 'Ω µ'\nb\n"


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_so_are_scenes_probes_keys_plans_and_poses(tmp_path, encoding):
    scene = saved(tmp_path / "scene.toml", EMBEDDED.read_text("utf-8"), encoding)
    assert load_scene(scene) == load_scene(EMBEDDED)
    probe = Path("ultrasound/probes/linear.toml").resolve()
    assert load_probe(str(saved(tmp_path / "probe.toml", probe.read_text("utf-8"), encoding))) == load_probe(
        "linear"
    )
    assert (
        load_keys(saved(tmp_path / "keys.toml", keys_text(DEFAULT_KEYS), encoding), DEFAULT_KEYS)
        == DEFAULT_KEYS
    )
    assert is_plan(saved(tmp_path / "plan.json", '{"nephron_plan": 1}', encoding))
    pose = [dict(probe_to_patient=np.eye(4).tolist())]
    assert len(load_poses(saved(tmp_path / "poses.json", json.dumps(pose), encoding))) == 1


@pytest.mark.parametrize("content", [b"title = 'K\xf6ln'\n[anatomy]\n", b"\xff\xfe\x00\xd8\x00\xd8"])
def test_another_encoding_is_named_with_its_remedy(tmp_path, content):
    (tmp_path / "scene.toml").write_bytes(content)
    with pytest.raises(SceneError, match="not text in UTF-8.; expected a scene file .TOML in UTF-8"):
        load_scene(tmp_path / "scene.toml")
    (tmp_path / "poses.csv").write_bytes(content)
    with pytest.raises(PoseError, match="not text in UTF-8"):
        load_poses(tmp_path / "poses.csv")


SEPARATED = {"comma": (",", "."), "Excel": (";", ","), "semicolon": (";", "."), "tab": ("\t", ",")}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize(("separator", "point"), SEPARATED.values(), ids=SEPARATED)
def test_poses_and_tables_of_numbers_are_read_from_spreadsheets(tmp_path, encoding, separator, point):
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[1.5, -20.25, 0.5], [2.5, -1e-3, 7.0]]
    rows = [[n / 2, *pose.ravel()] for n, pose in enumerate(poses)]
    lines = [separator.join(f"{number:.4f}".replace(".", point) for number in row) for row in rows]
    track = load_timed_poses(saved(tmp_path / "poses.csv", "\n".join(["# a comment", *lines, ""]), encoding))
    np.testing.assert_allclose(track.times_s, [0.0, 0.5])
    np.testing.assert_allclose(track.poses, poses)
    table = "\n".join(
        [separator.join(["id", "x", "y"]), separator.join(["1", f"0{point}5", f"-1{point}25e1"]), ""]
    )
    numbers, lines = read_numbers(saved(tmp_path / "beads.csv", table, encoding), ["x", "y"], UserError)
    np.testing.assert_allclose(numbers, [[0.5, -12.5]])
    assert lines == [2]


@pytest.mark.parametrize("lines", [["0,5,1,0"], ["1,0"] * 2])
def test_decimal_commas_between_commas_are_refused_with_the_remedy(tmp_path, lines):
    path = saved(tmp_path / "poses.csv", "\n".join(lines), "utf-8")
    with pytest.raises(PoseError, match="semicolons where there are decimal commas"):
        load_poses(path)


@pytest.mark.parametrize("stated", ["sep=;", "SEP=;", '"sep=;"'])
def test_what_excel_leaves_around_a_table_is_no_row(stated):
    table = f"{stated}\n\na;b;;\n;;;\n1,5;x,y;;\n# a comment;;\n;2;;\n"
    assert table_rows(table) == {3: ["a", "b"], 5: ["1.5", "x,y"], 7: ["", "2"]}
    assert table_rows(";;\n") == table_rows("") == {}


def test_a_cell_without_end_is_refused_in_words():
    with pytest.raises(TextError, match="not valid CSV"):
        table_rows("a," + "b" * 200_000)


@pytest.mark.parametrize("cell", ["1.200", "-12.345.678"])
@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_point_that_may_be_of_thousands_is_refused_among_decimal_commas(cell, separator):
    with pytest.raises(TextError, match=f"line 2: {cell} may be thousands"):
        table_rows(f"0,5{separator}1\n{cell}{separator}2\n")
    assert table_rows(f"0.5{separator}1\n{cell}{separator}2\n")[2] == [cell, "2"]
    assert table_rows(f"0,5{separator}0.125{separator}1.25\n") == {1: ["0.5", "0.125", "1.25"]}


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (read_json, "[" * 100_000, "^not valid JSON: nested too deeply$"),
        (read_json, "[" + "9" * 5000 + "]", "^not valid JSON: a number with thousands of digits$"),
        (read_json, '{\n "a": }', "^not valid JSON at line 2, column 7$"),
        (read_toml, "a = " + "[" * 100_000, "^not valid TOML: nested too deeply$"),
        (read_toml, "a = " + "9" * 5000, "^not valid TOML: a number with thousands of digits$"),
        (read_toml, "a = 1\nb\n", "^not valid TOML: .*line 2"),
    ],
)
def test_damaged_json_and_toml_are_refused_in_words(tmp_path, read, text, words):
    (tmp_path / "a").write_text(text)
    with pytest.raises(TextError, match=words):
        read(tmp_path / "a")


def test_what_is_no_text_is_refused_in_words(tmp_path):
    with pytest.raises(TextError, match="^is a directory$|^permission denied$"):
        read_text(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_toml(tmp_path / "none")
    with pytest.raises(TextError, match="^not text in UTF-8$"):
        json_value(b'"\xe9"')


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (EOFError(), "x (it ends too early); y"),
        (PermissionError(13, "Permission denied", "/patients/Doe"), "x (Permission denied); y"),
        (AttributeError("no", name="Rows"), "x (no Rows); y"),
        (KeyError("Doe^Jane"), "x (something is missing in it); y"),
        (UnicodeDecodeError("utf-8", b"Doe", 0, 1, "Doe"), "x (a text of unknown encoding); y"),
        (RuntimeError("Doe"), "x; y"),
    ],
)
def test_what_a_parser_raises_is_said_in_words(error, words):
    with pytest.raises(PatientError) as caught, parsing("x", "y"):
        raise error
    assert str(caught.value) == words


def test_a_full_memory_is_no_damaged_file():
    with (
        pytest.raises(PatientError, match=r"^scan/ct.dcm: the memory is full") as caught,
        parsing("scan/ct.dcm: a damaged DICOM file", "copy it again"),
    ):
        raise MemoryError
    assert "copy it again" not in str(caught.value)
