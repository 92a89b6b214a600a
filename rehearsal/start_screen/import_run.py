"""The import as it runs, and what it has made: the check picture and the warnings, to keep or to discard."""

import shutil
from pathlib import Path
from time import perf_counter
from typing import Protocol

import numpy as np
from PIL import Image

from rehearsal.start_screen.background_task import BackgroundTask
from rehearsal.start_screen.import_tasks import ImportChoices, import_choices
from rehearsal.start_screen.patient_list import CHECK_PICTURE
from rehearsal.start_screen.start_page import BACK, Outcome, StartChoice, StartPage
from render.start_screen import (
    Button,
    DrawnScreen,
    progress_screen,
    result_pages,
    result_screen,
)
from render.window_layout import WindowLayout

REHEARSE, DISCARD, MORE = "rehearse", "discard", "more"
MOST_STEPS = 12


class RefusedPage(StartPage, Protocol):
    """A page that shows why an import was refused."""

    def refuse(self, fault: str) -> None:
        """Show it."""


class ImportRun:
    """The steps of an import; a refusal is shown on the form."""

    first = BACK

    def __init__(self, choices: ImportChoices, folder: Path, form: RefusedPage, back: StartPage) -> None:
        self.keys: dict[str, str] = {}
        self._choices, self._folder, self._form, self._back = choices, folder, form, back
        self._steps = ["Starting the import"]
        self._task: BackgroundTask | None = None
        self._began = perf_counter()

    def open(self) -> None:
        """As ``StartPage.open``."""
        self._began = perf_counter()
        self._task = BackgroundTask(import_choices, self._choices, self._folder)

    def update(self) -> Outcome:
        """As ``StartPage.update``."""
        if self._task is None:
            return self
        self._task.update()
        self._add(self._task.step)
        if self._task.fault:
            self._form.refuse(self._task.fault)
            return self._form
        return ImportResult(self._folder, self._task.result, self._back) if self._task.is_done else self

    def drawn(self, layout: WindowLayout, selected: str) -> DrawnScreen:
        """As ``StartPage.drawn``."""
        title = f"Importing ({perf_counter() - self._began:.0f} s)"
        return progress_screen(layout, title, self._steps, [Button(BACK, "Stop", "Esc")], selected)

    def act(self, action: str) -> Outcome:
        """As ``StartPage.act``."""
        return self._form

    def close(self) -> None:
        """As ``StartPage.close``."""
        if self._task is not None:
            self._task.stop()
        self._task = None

    def _add(self, step: str) -> None:
        """Add a step, or replace the last one, where only what is done of it differs."""
        if not step or step in self._steps[-1:]:
            return
        if self._steps and self._steps[-1].partition(":")[0] == step.partition(":")[0]:
            self._steps.pop()
        self._steps = [*self._steps, step][-MOST_STEPS:]


class ImportResult:
    """What an import has made."""

    first = REHEARSE

    def __init__(self, folder: Path, rows: list[tuple[str, str]], back: StartPage) -> None:
        self.keys = {"R": REHEARSE, "N": MORE}
        self._folder, self._rows, self._back = folder, rows, back
        with Image.open(folder / CHECK_PICTURE) as image:
            self._picture = np.asarray(image.convert("RGB"))
        self._number, self._pages = 0, 1

    def open(self) -> None:
        """As ``StartPage.open``."""

    def update(self) -> Outcome:
        """As ``StartPage.update``."""
        return self

    def drawn(self, layout: WindowLayout, selected: str) -> DrawnScreen:
        """As ``StartPage.drawn``."""
        self._pages = result_pages(layout, self._rows)
        has_warning = any(name == "WARNING" for name, _ in self._rows)
        question = "are side, organ and orientation correct?"
        title = f"Imported: {'read the warnings, and compare with the patient' if has_warning else question}"
        buttons = [Button(REHEARSE, "Rehearse", "R"), Button(DISCARD, "Discard")]
        buttons.append(Button(MORE, f"Page {self._number + 1} of {self._pages}: next", "N"))
        buttons.append(Button(BACK, "Keep, and back to the list", "Esc"))
        return result_screen(layout, title, self._picture, self._rows, buttons, selected, self._number)

    def act(self, action: str) -> Outcome:
        """As ``StartPage.act``."""
        if action == REHEARSE:
            return StartChoice(self._folder)
        if action == MORE:
            self._number = (self._number + 1) % self._pages
            return self
        if action == DISCARD:
            shutil.rmtree(self._folder, ignore_errors=True)
        return self._back

    def close(self) -> None:
        """As ``StartPage.close``."""
