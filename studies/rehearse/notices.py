"""What the guard had to put right, said to the user."""

from collections.abc import Callable
from time import perf_counter

# How long a notice stands in the panel.
SHOWN_S = 4.0


class Notices:
    """Tells the user once, and shows for a while, what the guard had to put right."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._until = 0.0

    def tell(self, notice: str) -> None:
        """Take over a step's notice; most are empty."""
        if notice:
            self._tell(notice)
            self._until = perf_counter() + SHOWN_S

    @property
    def shown(self) -> str:
        """What the panel says now."""
        return "TISSUE PUT BACK" if perf_counter() < self._until else ""
