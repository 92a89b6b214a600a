"""What is wrong with a patient's files, for the user."""

from errors import UserError


class PatientError(UserError):
    """One line for the user: which file, what was found, what was expected, what to do."""

    def __init__(self, line: str) -> None:
        super().__init__("".join(letter if letter.isprintable() else "?" for letter in line))
