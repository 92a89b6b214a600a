"""The first page of the start screen: patients and last sessions."""

from pathlib import Path

from errors import UserError
from rehearsal.result_files import counted
from rehearsal.sessions.session_file import read_log
from rehearsal.start_screen.background_task import BackgroundTask
from rehearsal.start_screen.file_dialog import FileDialog, dialog_command, no_dialog_text
from rehearsal.start_screen.import_form import ImportForm
from rehearsal.start_screen.import_tasks import PatientSurvey, survey
from rehearsal.start_screen.patient_list import ListedPatient, listed_patient, listed_patients
from rehearsal.start_screen.session_list import ListedSession, listed_sessions
from rehearsal.start_screen.start_page import BACK, Outcome, StartChoice
from render.start_screen import Button, DrawnScreen, PatientCard, SessionRow, cards_that_fit, list_screen
from render.window_layout import WindowLayout
from scenes.scene import EMBEDDED

IMPORT, OPEN, MORE = "import", "open", "more"
PATIENT, REPLAY, GO_ON = "patient ", "replay ", "go on "
LOOKING, UNKNOWN = "Looking for its patient", "Of a patient who is not listed"


class PatientPage:
    """Patients in a folder, and the sessions in the folder of --out."""

    first = f"{PATIENT}0"

    def __init__(self, patients: Path, out: Path) -> None:
        self.keys = {"I": IMPORT, "O": OPEN, "N": MORE}
        self._folder, self._out = patients, out
        self._patients: list[ListedPatient] = []
        self._sessions: list[ListedSession] = []
        self._surveyed: dict[Path, PatientSurvey] = {}
        self._survey: BackgroundTask | None = None
        self._to_survey: list[list[Path]] = []
        self._dialog: FileDialog | None = None
        # The first patient that is shown, and how many are.
        self._begin, self._shown = 0, 1
        self._message = ""

    def open(self) -> None:
        """As ``StartPage.open``."""
        # A folder may have another patient than before; the embedded one stays.
        self._surveyed = {scene: of for scene, of in self._surveyed.items() if scene == EMBEDDED}
        self._list()
        self._sessions, self._begin, self._message = listed_sessions(self._out), 0, ""
        # The embedded patient last: at the first start its files must be made.
        scenes = [patient.scene for patient in self._patients]
        self._to_survey = [scenes[1:], [] if EMBEDDED in self._surveyed else scenes[:1]]
        self._survey_next()

    def update(self) -> Outcome:
        """As ``StartPage.update``."""
        if self._survey is not None:
            self._survey.update()
            if self._survey.is_done:
                self._survey.stop()
                self._surveyed |= self._survey.result or {}
                self._list()
                self._survey_next()
        if self._dialog is not None:
            self._dialog.update()
            if self._dialog.is_done:
                dialog, self._dialog = self._dialog, None
                self._message = dialog.fault
                if dialog.path is not None:
                    return self._with_patient(listed_patient(dialog.path))
        return self

    def drawn(self, layout: WindowLayout, selected: str) -> DrawnScreen:
        """As ``StartPage.drawn``."""
        self._shown = cards_that_fit(layout, self._message)
        places = range(self._begin, min(self._begin + self._shown, len(self._patients)))
        cards = [card_of(f"{PATIENT}{place}", self._patients[place]) for place in places]
        sessions = [self._row(place, session) for place, session in enumerate(self._sessions)]
        buttons = [Button(IMPORT, "Import a patient", "I"), Button(OPEN, "Open a patient's folder", "O")]
        if others := len(self._patients) - len(cards):
            buttons.append(Button(MORE, f"Further patients ({others})", "N"))
        buttons.append(Button(BACK, "Quit", "Esc"))
        return list_screen(layout, cards, sessions, buttons, self._message, selected)

    def act(self, action: str) -> Outcome:
        """As ``StartPage.act``."""
        if action == BACK:
            return None
        if action == IMPORT:
            return ImportForm(self._folder, self)
        if action == OPEN:
            self._ask_for_folder()
        elif action == MORE:
            following = self._begin + self._shown
            self._begin = following if following < len(self._patients) else 0
        elif action.startswith(PATIENT):
            return self._with_patient(self._patients[int(action.removeprefix(PATIENT))])
        elif action.startswith((REPLAY, GO_ON)):
            return self._with_session(action)
        return self

    def close(self) -> None:
        """As ``StartPage.close``."""
        for task in (self._survey, self._dialog):
            if task is not None:
                task.stop()
        self._survey = self._dialog = None

    def _survey_next(self) -> None:
        """Begin with the next patients to find something out of, if there are any."""
        self._to_survey = [scenes for scenes in self._to_survey if scenes]
        self._survey = BackgroundTask(survey, self._to_survey.pop(0)) if self._to_survey else None

    def _list(self) -> None:
        of_embedded = self._surveyed.get(EMBEDDED)
        figures = None if of_embedded is None else of_embedded.complexity
        self._patients = listed_patients(self._folder, figures)

    def _row(self, place: int, session: ListedSession) -> SessionRow:
        patient = self._patient_of(session)
        if patient is None:
            return SessionRow(UNKNOWN if self._survey is None else LOOKING, session.lines, {})
        buttons = {f"{REPLAY}{place}": "Replay", f"{GO_ON}{place}": "Go on"}
        return SessionRow(patient.title, session.lines, buttons, patient.picture)

    def _patient_of(self, session: ListedSession) -> ListedPatient | None:
        """The patient whose anatomy a session has, once that is known."""
        scenes = {scene for scene, of in self._surveyed.items() if of.anatomy == session.anatomy}
        return next((patient for patient in self._patients if patient.scene in scenes), None)

    def _with_patient(self, patient: ListedPatient) -> Outcome:
        self._message = patient.fault
        return self if patient.fault else StartChoice(patient.scene)

    def _with_session(self, action: str) -> Outcome:
        goes_on = action.startswith(GO_ON)
        session = self._sessions[int(action.removeprefix(GO_ON if goes_on else REPLAY))]
        patient = self._patient_of(session)
        if patient is None:
            return self
        try:
            length_s = read_log(session.path).length_s
        except UserError as error:
            self._message = str(error)
            return self
        return StartChoice(patient.scene, session.path, length_s if goes_on else 0.0)

    def _ask_for_folder(self) -> None:
        """Open a dialogue for a patient's folder, unless one is open."""
        if self._dialog is not None:
            return
        command = dialog_command("A patient's folder, made by import", chooses_folder=True)
        if command is None:
            self._message = f"{no_dialog_text()}; or type: python app.py rehearse FOLDER"
        else:
            self._dialog, self._message = FileDialog(command), ""


def card_of(action: str, patient: ListedPatient) -> PatientCard:
    """What is drawn of a patient."""
    alert = f"{counted(patient.warnings, 'warning')} of the import to check" if patient.warnings else ""
    return PatientCard(action, patient.title, patient.lines, patient.fault or alert, patient.picture)
