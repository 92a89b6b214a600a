"""The import of a patient by clicks: CT and labels are chosen, and what each label is."""

import re
from pathlib import Path
from typing import Literal, get_args

from rehearsal.start_screen.background_task import BackgroundTask
from rehearsal.start_screen.file_dialog import FileDialog, dialog_command, no_dialog_text
from rehearsal.start_screen.import_run import ImportRun
from rehearsal.start_screen.import_tasks import FoundLabel, ImportChoices, found_labels
from rehearsal.start_screen.patient_list import new_folder_name
from rehearsal.start_screen.start_page import BACK, Outcome, StartPage
from render.start_screen import Button, DrawnScreen, FormRow, LabelRow, form_screen, labels_that_fit
from render.window_layout import WindowLayout
from scenes.patients.readers.segment_names import Side

IMPORT, MORE = "import", "more"
Source = Literal["CT", "labels"]
# What a label can be, with the text of its button; others have options of the command.
ROLES = {"": "by name", "organ": "kidney", "tumour": "tumour", "cyst": "cyst", "urine": "collecting system"}
SIDES: dict[Side | None, str] = {None: "by the labels", "left": "left", "right": "right"}
# How a refusal names what is a choice here.
ON_SCREEN = {
    r"--side (left|right)": r"Kidney \1",
    "--side": "Kidney",
    "--organ": "the button kidney",
    "--tumour": "the button tumour",
    "--cyst": "the button cyst",
    "--collecting": "the button collecting system",
}
BY_COMMAND = "Names with -- are options of the command: python app.py import CT LABELS --out"
ASK = {
    ("CT", False): "The CT: a NIfTI, NRRD or MHA file, or a zip archive of DICOM",
    ("CT", True): "The CT: a folder with DICOM",
    ("labels", False): "The labels: a label map, a surface, DICOM-SEG or RTSTRUCT",
    ("labels", True): "The labels: a folder with one file for each organ",
}


class ImportForm:
    """What is imported; after a refusal it comes again, with its words and all choices."""

    def __init__(self, patients: Path, back: StartPage) -> None:
        self.keys = {"C": "CT file", "D": "CT folder", "L": "labels file", "G": "labels folder"}
        self.keys |= {"I": IMPORT, "N": MORE}
        self._patients, self._back = patients, back
        self._paths: dict[Source, Path] = {}
        self._side: Side | None = None
        self._roles: dict[str, str] = {}
        self._labels: list[FoundLabel] | None = None
        self._reading: BackgroundTask | None = None
        self._dialog: FileDialog | None = None
        self._asked: Source = "CT"
        self._begin, self._shown, self._message = 0, 1, ""
        # Whether the import was refused for want of it.
        self._needs_side = False

    @property
    def first(self) -> str:
        """As ``StartPage.first``: what comes next."""
        if self._labels:
            return "side left" if self._needs_side and self._side is None else IMPORT
        return "labels file" if "CT" in self._paths else "CT file"

    def refuse(self, fault: str) -> None:
        """Show why the import has been refused."""
        self._needs_side = "--side left" in fault
        self._message = self._in_words(fault)

    def open(self) -> None:
        """As ``StartPage.open``."""

    def update(self) -> Outcome:
        """As ``StartPage.update``."""
        if self._dialog is not None:
            self._dialog.update()
            if self._dialog.is_done:
                dialog, self._dialog = self._dialog, None
                self._message = dialog.fault
                if dialog.path is not None:
                    self._take(dialog.path)
        if self._reading is not None:
            self._reading.update()
            if self._reading.is_done:
                reading, self._reading = self._reading, None
                reading.stop()
                self._labels = reading.result
                self._message = self._in_words(reading.fault)
                if self._labels == []:
                    self._message = "No labels are in the folder of the CT: choose the labels"
        return self

    def drawn(self, layout: WindowLayout, selected: str) -> DrawnScreen:
        """As ``StartPage.drawn``."""
        rows = [self._source_row("CT"), self._source_row("labels"), self._side_row()]
        self._shown, found = labels_that_fit(layout, len(rows), self._message), self._labels or []
        labels = [
            self._label_row(place, label)
            for place, label in enumerate(found)
            if self._begin <= place < self._begin + self._shown
        ]
        buttons = [Button(IMPORT, "Import", "I")] if found else []
        if others := len(found) - len(labels):
            buttons.append(Button(MORE, f"Further labels ({others})", "N"))
        buttons.append(Button(BACK, "Back", "Esc"))
        return form_screen(layout, rows, labels, self._heading(), buttons, self._message, selected)

    def act(self, action: str) -> Outcome:
        """As ``StartPage.act``."""
        word, _, choice = action.partition(" ")
        if action == BACK:
            return self._back
        if action == IMPORT:
            return self._import()
        if action == MORE:
            following = self._begin + self._shown
            self._begin = following if following < len(self._labels or []) else 0
        elif word == "side":
            self._side = next(side for side in SIDES if str(side) == choice)
        elif word == "label":
            place, _, role = choice.partition(" ")
            self._roles[(self._labels or [])[int(place)].word] = role
        else:
            self._ask(next(source for source in get_args(Source) if source == word), choice == "folder")
        return self

    def close(self) -> None:
        """As ``StartPage.close``."""
        for task in (self._reading, self._dialog):
            if task is not None:
                task.stop()
        self._reading = self._dialog = None

    def _ask(self, source: Source, chooses_folder: bool) -> None:
        """Open a dialogue, unless one is open."""
        if self._dialog is not None:
            return
        command = dialog_command(ASK[source, chooses_folder], chooses_folder)
        if command is None:
            self._message = f"{no_dialog_text()}; or type: {self._command()}"
        else:
            self._dialog, self._asked, self._message = FileDialog(command), source, ""

    def _take(self, path: Path) -> None:
        """Have a path that was chosen, and read the labels once there are some to read."""
        if self._asked == "CT":
            self._paths.pop("labels", None)
        self._paths[self._asked] = path
        if self._reading is not None:
            self._reading.stop()
        self._labels, self._roles, self._begin, self._reading = None, {}, 0, None
        self._needs_side = False
        ct, labels = self._paths.get("CT"), self._paths.get("labels")
        if ct is not None and (labels is not None or ct.is_dir()):
            self._reading = BackgroundTask(found_labels, ct, labels)

    def _import(self) -> Outcome:
        roles = {word: role for word, role in self._roles.items() if role}
        choices = ImportChoices(self._paths["CT"], self._paths.get("labels"), self._side, roles)
        self._message = ""
        return ImportRun(choices, new_folder_name(self._patients), self, self._back)

    def _heading(self) -> str:
        if self._dialog is not None:
            return "Choose in the window of the file dialogue, which may be behind this one."
        if self._reading is not None:
            return f"{self._reading.step or 'Reading the labels'} ..."
        if not self._labels:
            return "Choose the CT, then its labels. The patient's name is not copied."
        if not any(label.name or label.tissue for label in self._labels):
            return "The labels have no names: those for which you choose nothing count as the kidney."
        return "What each label is: the import recognises names; choose for those that it does not."

    def _source_row(self, source: Source) -> FormRow:
        path = self._paths.get(source)
        keys = {action: key for key, action in self.keys.items()}
        buttons = tuple(
            Button(f"{source} {kind}", f"Choose a {kind}", keys[f"{source} {kind}"])
            for kind in ("file", "folder")
        )
        hint = "a NIfTI, NRRD or MHA file, a zip archive or a folder with DICOM"
        if source == "labels":
            hint = "label map, surfaces, DICOM-SEG or RTSTRUCT; none: those in the CT's folder"
        name = {"CT": "CT", "labels": "Labels"}[source]
        return FormRow(name, path.name if path else hint, buttons, path is not None)

    def _side_row(self) -> FormRow:
        buttons = tuple(Button(f"side {side}", text, "", side == self._side) for side, text in SIDES.items())
        return FormRow("Kidney", "which one, where there are both", buttons)

    def _label_row(self, place: int, label: FoundLabel) -> LabelRow:
        value = "" if label.value is None else f"{label.value}  "
        volume = "" if label.volume_ml is None else f"{label.volume_ml:.1f} ml"
        role = self._roles.get(label.word, "")
        buttons = tuple(Button(f"label {place} {of}", text, "", of == role) for of, text in ROLES.items())
        name = f"{value}{label.name or '(no name)'}"
        return LabelRow(name, label.tissue or "not recognised", volume, buttons)

    def _in_words(self, fault: str) -> str:
        """A refusal in the words of this page: without the user's paths, and with its choices."""
        for source, path in self._paths.items():
            fault = fault.replace(str(path), f"the {source}")
        for option, words in ON_SCREEN.items():
            fault = re.sub(option, words, fault)
        return f"{fault}. {BY_COMMAND} {new_folder_name(self._patients)}" if "--" in fault else fault

    def _command(self) -> str:
        return f"python app.py import CT LABELS --out {new_folder_name(self._patients)}"
