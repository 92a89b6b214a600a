"""The import of a patient by clicks: from the files that are chosen to the patient to rehearse, with what the
import refuses in between.
"""

from pathlib import Path
from time import monotonic, sleep

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_series import Series, write_segmentation
from synthetic_body import DIRECTIONS, LEFT_ML, body, coarsely

from errors import PatientError
from rehearsal.start_screen import import_form, import_run
from rehearsal.start_screen.background_task import BackgroundTask
from rehearsal.start_screen.import_form import ImportForm
from rehearsal.start_screen.import_run import ImportResult, ImportRun
from rehearsal.start_screen.import_tasks import found_labels
from rehearsal.start_screen.start_page import BACK, StartChoice
from render.start_screen import DrawnScreen
from render.ultrasound_panel import ALERT
from render.window_layout import WindowLayout
from scenes.import_findings import read_findings

PERSON = "Doe_Jane_1950"
LAYOUT = WindowLayout(1280, 720)
END_S = 120.0


class Here:
    """A background task in this process: done when it is made."""

    is_done = True

    def __init__(self, function, *arguments) -> None:
        self.steps, self.fault, self.result = [], "", None
        try:
            self.result = function(*arguments, self.steps.append)
        except PatientError as error:
            self.fault = str(error)
        self.step = self.steps[-1]

    def update(self) -> None: ...

    def stop(self) -> None: ...


class Back:
    """The page from which the import was begun."""

    first, keys = "", {}


@pytest.fixture(scope="module")
def hospital(tmp_path_factory):
    """CT and labels without names, 1 right, 2 left, 3 tumour, in a folder named after a person."""
    folder = tmp_path_factory.mktemp("hospital") / PERSON
    folder.mkdir()
    for name, image in zip(("ct", "labels"), body(), strict=True):
        sitk.WriteImage(image, folder / f"{name}.nii.gz")
    return folder


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    coarsely(monkeypatch)
    for module in (import_form, import_run):
        monkeypatch.setattr(module, "BackgroundTask", Here)


@pytest.fixture
def choosing(monkeypatch):
    """Have the dialogue end with a path; None: cancelled."""
    asked = []

    def choose(path: Path | None) -> None:
        class Dialog:
            is_done, fault = True, ""

            def __init__(self, command) -> None:
                self.path = path

            def update(self) -> None: ...

            def stop(self) -> None: ...

        monkeypatch.setattr(import_form, "FileDialog", Dialog)
        monkeypatch.setattr(import_form, "dialog_command", lambda *asks: asked.append(asks) or ["dialog"])

    choose.asked = asked
    return choose


@pytest.fixture
def form(tmp_path):
    return ImportForm(tmp_path / "patients", Back())


@pytest.fixture
def filled(form, hospital, choosing):
    """A form with CT and labels."""
    take(form, choosing, "CT file", hospital / "ct.nii.gz")
    take(form, choosing, "labels file", hospital / "labels.nii.gz")
    return form


def take(form: ImportForm, choosing, action: str, path: Path | None) -> None:
    choosing(path)
    form.act(action)
    form.update()


def boxes(page) -> set[str]:
    return set(page.drawn(LAYOUT, "").boxes)


def has_message(screen: DrawnScreen) -> bool:
    return bool((screen.image == ALERT).all(axis=2).any())


def imported(form: ImportForm) -> ImportResult | ImportForm:
    """The page after the import."""
    run = form.act("import")
    assert isinstance(run, ImportRun)
    run.open()
    return run.update()


def test_the_dialogue_asks_for_what_the_button_says(form, choosing):
    for action, (word, is_folder) in {
        "CT file": ("CT", False),
        "CT folder": ("CT", True),
        "labels file": ("labels", False),
        "labels folder": ("labels", True),
    }.items():
        take(form, choosing, action, None)
        title, chooses_folder = choosing.asked[-1]
        assert word in title and chooses_folder is is_folder


def test_a_cancelled_dialogue_is_no_error_and_keeps_what_was_chosen(filled, choosing):
    before = filled.drawn(LAYOUT, "")
    take(filled, choosing, "labels file", None)
    after = filled.drawn(LAYOUT, "")
    assert (before.image == after.image).all() and not has_message(after)


def test_labels_are_shown_once_ct_and_labels_are_chosen(form, hospital, choosing):
    take(form, choosing, "CT file", hospital / "ct.nii.gz")
    assert "import" not in boxes(form) and form.first == "labels file"
    take(form, choosing, "labels file", hospital / "labels.nii.gz")
    assert "import" in boxes(form) and form.first == "import"
    assert {f"label {n} {role}" for n in range(3) for role in ("", "organ", "tumour", "cyst")} <= boxes(form)


def test_labels_have_their_volumes(hospital):
    labels = found_labels(hospital / "ct.nii.gz", hospital / "labels.nii.gz", lambda step: None)
    assert [label.word for label in labels] == ["1", "2", "3"]
    # Without the part of it that the tumour covers.
    assert 0.9 * LEFT_ML < labels[1].volume_ml < LEFT_ML


def test_another_ct_takes_its_own_labels(filled, hospital, choosing):
    filled.act("label 2 tumour")
    take(filled, choosing, "CT file", hospital / "ct.nii.gz")
    assert "import" not in boxes(filled) and filled.first == "labels file"


def test_labels_beside_a_dicom_ct_need_no_choice_and_without_them_it_asks(form, tmp_path, choosing):
    series = Series(tmp_path / "dicom", DIRECTIONS["identity"], size=(40, 40, 8), gap=4.0)
    series.write()
    take(form, choosing, "CT folder", tmp_path / "dicom")
    assert "import" not in boxes(form) and "choose the labels" in form._message
    places = np.stack([series.places(k) for k in range(8)])
    masks = {"Left kidney": np.linalg.norm(places - places.mean(axis=(0, 1, 2)), axis=-1) < 12}
    write_segmentation(tmp_path / "dicom" / "labels.dcm", series, masks)
    take(form, choosing, "CT folder", tmp_path / "dicom")
    assert form.first == "import" and not has_message(form.drawn(LAYOUT, ""))
    assert [(label.word, label.tissue) for label in form._labels] == [("Left kidney", "kidney")]


def test_a_folder_without_a_ct_is_refused_in_words(form, tmp_path, choosing):
    (tmp_path / "empty").mkdir()
    take(form, choosing, "CT folder", tmp_path / "empty")
    assert has_message(form.drawn(LAYOUT, "")) and form._message.startswith("the CT: ")


def test_two_kidneys_are_refused_with_the_choice_that_helps(filled):
    page = imported(filled)
    assert page is filled and has_message(page.drawn(LAYOUT, "")) and page.first == "side left"
    assert "2 organs are labelled, expected one" in page._message
    assert "Kidney left or Kidney right" in page._message and "--" not in page._message
    assert {"side left", "side right"} <= boxes(page)
    page.act("side right")
    assert page.first == "import"


def test_a_refusal_has_no_folder_of_the_patient_and_names_the_command(filled, hospital, choosing):
    take(filled, choosing, "labels file", hospital / "ct.nii.gz")
    assert "import" not in boxes(filled) and has_message(filled.drawn(LAYOUT, ""))
    for name in ("ct", "labels"):
        take(filled, choosing, f"{name.replace('ct', 'CT')} file", hospital / f"{name}.nii.gz")
    filled.refuse(f"{hospital / 'labels.nii.gz'}: its axes are not known; give --space")
    assert filled._message.startswith("the labels: its axes")
    for part in PERSON.split("_"):
        assert part not in filled._message
    assert "python app.py import CT LABELS --out" in filled._message


class TestImport:
    @pytest.fixture
    def result(self, filled):
        filled.act("label 2 tumour")
        filled.act("side left")
        page = imported(filled)
        assert isinstance(page, ImportResult), filled._message
        return page

    def test_the_chosen_kidney_with_its_tumour_is_imported(self, result, tmp_path):
        findings = read_findings(tmp_path / "patients" / "patient-001")
        assert findings.side == "left" and set(findings.surfaces) == {"organ", "tumour", "support"}
        # What the labels have: the tumour is half outside the kidney.
        assert LEFT_ML < findings.surfaces["organ"].label_ml < 1.05 * LEFT_ML
        assert findings.complexity["diameter_mm"] == pytest.approx(22.0, abs=1.5)

    def test_the_check_picture_and_its_text_are_shown(self, result, tmp_path):
        findings = read_findings(tmp_path / "patients" / "patient-001")
        words = dict(reversed(result._rows))
        assert words["organ"].startswith("left kidney") and "R.E.N.A.L." in words
        notes = [text for name, text in result._rows if name == "note"]
        assert notes == list(findings.notes) and len(notes) > 1
        first, second = (self.shown(result) for _ in range(2))
        assert (first.image != second.image).mean() > 0.1

    def shown(self, result: ImportResult) -> DrawnScreen:
        screen = result.drawn(LAYOUT, "")
        result.act("more")
        return screen

    def test_rehearse_opens_it(self, result, tmp_path):
        assert result.first == "rehearse"
        assert result.act("rehearse") == StartChoice(tmp_path / "patients" / "patient-001")

    def test_discard_removes_it_and_back_keeps_it(self, result, tmp_path):
        folder = tmp_path / "patients" / "patient-001"
        assert isinstance(result.act(BACK), Back) and folder.is_dir()
        assert isinstance(result.act("discard"), Back) and not folder.exists()

    def test_the_next_one_has_a_folder_of_its_own(self, result, filled, tmp_path):
        assert imported(filled).act("rehearse") == StartChoice(tmp_path / "patients" / "patient-002")


def test_the_steps_are_shown_as_they_come(filled, monkeypatch):
    class Slow(Here):
        is_done, fault, result = False, "", None

        def __init__(self, *arguments) -> None:
            self.step = "Reading"

    monkeypatch.setattr(import_run, "BackgroundTask", Slow)
    run = filled.act("import")
    run.open()
    steps = []
    for step in ("Reading: 1 of 2", "Reading: 2 of 2", "Making the surfaces: 1 of 1"):
        run._task.step = step
        assert run.update() is run
        steps.append(run._steps[1:])
    assert steps == [
        ["Reading: 1 of 2"],
        ["Reading: 2 of 2"],
        ["Reading: 2 of 2", "Making the surfaces: 1 of 1"],
    ]
    shown = run.drawn(LAYOUT, BACK).image
    assert (shown != np.asarray(shown[-1, -1])).any()
    # Esc stops it, and the form is as it was.
    assert run.act(BACK) is filled and "import" in boxes(filled)


@pytest.mark.parametrize("exists", [True, False])
def test_a_process_of_its_own_has_result_or_refusal(hospital, exists):
    labels = hospital / ("labels.nii.gz" if exists else "none.nii.gz")
    task = BackgroundTask(found_labels, hospital / "ct.nii.gz", labels)
    end = monotonic() + END_S
    while not task.is_done and monotonic() < end:
        task.update()
        sleep(0.01)
    task.stop()
    if exists:
        assert task.fault == "" and [label.value for label in task.result] == [1, 2, 3]
        assert task.step == "Reading the labels"
    else:
        assert "no such file" in task.fault and task.result is None


def test_a_process_that_is_ended_is_a_refusal_with_a_remedy():
    task = BackgroundTask(sleep_long)
    task._process.kill()
    end = monotonic() + END_S
    while not task.is_done and monotonic() < end:
        task.update()
    task.stop()
    assert "close other programs" in task.fault


def sleep_long(progress) -> None:
    sleep(60)
