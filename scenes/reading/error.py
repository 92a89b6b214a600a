"""What is wrong with a patient's files, for the user."""


class PatientError(ValueError):
    """One line for the user: which file, what was found, what was expected, what to do."""
