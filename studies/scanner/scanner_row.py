"""One line of the table of ``study scanner``."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ScannerRow:
    """A quantity: of the recording, ours beside it where there is one, its unit, and what has to be known
    of it.
    """

    part: str
    quantity: str
    recorded: float | None
    ours: float | None = None
    unit: str = ""
    note: str = ""
