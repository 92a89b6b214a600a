"""The patients and sessions that the start screen lists: all of them, in order, and without their names."""

import json
import os
from time import time

import numpy as np
import pytest
from ball_patient import folder_of_ball
from conftest import ROOT
from PIL import Image
from recorded_session import header
from test_import_findings import findings

from rehearsal.sessions.session_file import EndLine
from rehearsal.start_screen.patient_list import (
    EMBEDDED_PICTURE,
    complexity_lines,
    listed_patient,
    listed_patients,
    new_folder_name,
    since_text,
)
from rehearsal.start_screen.session_list import listed_sessions
from scenes.scene import EMBEDDED

PERSON = "Doe_Jane_1950-01-02"


def figures(**renal) -> dict:
    """Of a complexity, as in import.json."""
    of_renal = dict(least=6, most=8, suffix="a", complexity="low to moderate") | renal
    of_padua = dict(least=10, most=10, suffix="a", complexity="high")
    return dict(tumours=1, diameter_mm=22.68, renal=of_renal, padua=of_padua)


def patient(folder, ages_s: float = 0.0, **changes):
    """A patient's folder, imported so many seconds ago."""
    folder.mkdir()
    folder_of_ball(folder)
    (folder / "import.json").write_text(json.dumps(findings(True, False) | changes))
    then = time() - ages_s
    os.utime(folder / "scene.toml", (then, then))
    return folder


def all_text(listed) -> str:
    return " ".join([listed.title, *listed.lines, listed.fault])


def test_the_embedded_patient_is_first_then_the_last_imported(tmp_path):
    for name, age_s in (("old", 90_000), ("new", 10), ("middle", 7300)):
        patient(tmp_path / name, age_s)
    (tmp_path / "no patient").mkdir()
    # What an import is still writing.
    patient(tmp_path / ".12-ab.partial-patient-001")
    listed = listed_patients(tmp_path)
    assert [each.scene for each in listed] == [EMBEDDED, *(tmp_path / n for n in ("new", "middle", "old"))]
    ages = [each.lines[-1] for each in listed[1:]]
    assert ages == ["Imported just now", "Imported 2 hours ago", "Imported 1 day ago"]


def test_without_a_folder_there_is_the_embedded_patient_alone(tmp_path):
    (listed,) = listed_patients(tmp_path / "none")
    assert listed.scene == EMBEDDED and not listed.fault and listed.picture is not None


def test_a_patient_has_tumour_complexity_and_open_warnings(tmp_path):
    listed = listed_patient(patient(tmp_path / "a", complexity=figures()))
    assert listed.lines[:3] == ("Tumour of 23 mm", "R.E.N.A.L. 6-8a, low to moderate", "PADUA 10a, high")
    # One of the two is acknowledged.
    assert listed.warnings == 1 and not listed.fault
    without = listed_patient(patient(tmp_path / "b"))
    assert without.lines[0] == "No tumour labelled"


def test_no_name_of_a_folder_is_shown(tmp_path):
    named = patient(tmp_path / PERSON, complexity=figures())
    damaged = tmp_path / f"{PERSON}_2"
    damaged.mkdir()
    (damaged / "scene.toml").write_text("nonsense = ")
    texts = [all_text(each) for each in listed_patients(tmp_path)] + [all_text(listed_patient(named))]
    assert len(texts) == 4 and not any(part in text for text in texts for part in PERSON.split("_"))


@pytest.mark.parametrize("wrong", ["scene.toml", "import.json", None])
def test_a_damaged_patient_is_listed_with_what_to_do(tmp_path, wrong):
    folder = patient(tmp_path / "a")
    if wrong is None:
        listed = listed_patient(tmp_path)
    else:
        (folder / wrong).write_text("{ nonsense")
        listed = listed_patient(folder)
    assert "import the patient again" in listed.fault and "python app.py rehearse" in listed.fault


def test_a_picture_is_the_middle_of_the_first_section(tmp_path):
    folder = patient(tmp_path / "a")
    assert listed_patient(folder).picture is None
    # A check picture whose first section has a bright middle.
    picture = np.zeros((960, 1300, 3), np.uint8)
    picture[240:330, 180:290] = 200
    Image.fromarray(picture).save(folder / "check.png")
    shown = listed_patient(folder).picture
    assert shown.shape[0] == pytest.approx(shown.shape[1], abs=2)
    bright = np.argwhere(shown[..., 0] > 0).mean(axis=0) / shown.shape[:2]
    assert bright == pytest.approx([0.5, 0.5], abs=0.05)
    # Another patient in the folder has another picture.
    Image.fromarray(255 - picture).save(folder / "check.png")
    assert listed_patient(folder).picture[0, 0, 0] == 255
    (folder / "check.png").write_bytes(b"no picture")
    assert listed_patient(folder).picture is None
    assert EMBEDDED_PICTURE == ROOT / "docs" / "check.png" and EMBEDDED_PICTURE.is_file()


def test_a_new_folder_has_the_next_number_and_no_name(tmp_path):
    assert new_folder_name(tmp_path).name == "patient-001"
    (tmp_path / "patient-007").mkdir()
    (tmp_path / "patient-x").mkdir()
    assert new_folder_name(tmp_path) == tmp_path / "patient-008"


def test_a_certain_score_is_one_number():
    assert complexity_lines(figures(least=8, most=8)) == ["R.E.N.A.L. 8a, low to moderate", "PADUA 10a, high"]
    assert complexity_lines(None) == []


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        *((-5, "just now"), (59, "just now"), (60, "1 minute ago"), (3599, "59 minutes ago")),
        *((3600, "1 hour ago"), (86_399, "23 hours ago"), (86_400 * 3.9, "3 days ago")),
    ],
)
def test_times_are_said_without_a_date(seconds, text):
    assert since_text(seconds) == text


class TestSessions:
    def session(self, folder, number: int, age_s: float, summary: dict | None, anatomy: str = "a" * 16):
        of = header()
        of.anatomy = anatomy
        lines = [of.model_dump_json()]
        lines += [] if summary is None else [EndLine(summary=summary).model_dump_json()]
        path = folder / f"session-{number:03d}.jsonl"
        path.write_text("\n".join(lines) + "\n")
        os.utime(path, (time() - age_s,) * 2)
        return path

    def test_the_last_ones_are_listed_the_newest_first(self, tmp_path):
        for number in range(1, 9):
            self.session(tmp_path, number, 100.0 * (10 - number), dict(duration_s=float(number)))
        (tmp_path / "session-009.jsonl").write_text("no session\n")
        (tmp_path / "report-009.html").write_text("")
        listed = listed_sessions(tmp_path)
        # The file that is no session takes one of the places.
        assert [each.path.name for each in listed] == [f"session-00{n}.jsonl" for n in (8, 7, 6, 5)]
        assert listed[0].lines == ("8 s", "3 minutes ago") and listed[0].anatomy == "a" * 16

    def test_cuts_are_counted_and_a_session_that_was_cut_off_is_named(self, tmp_path):
        self.session(tmp_path, 1, 10, dict(duration_s=42.3, attempts=[{}, {}]))
        self.session(tmp_path, 2, 5, None)
        off, cut = listed_sessions(tmp_path)
        assert cut.lines[0] == "42 s, 2 cuts" and off.lines[0] == "Not ended in order"

    def test_without_a_folder_there_are_none(self, tmp_path):
        assert listed_sessions(tmp_path / "none") == []
