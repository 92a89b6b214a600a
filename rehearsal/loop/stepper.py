"""Steppers turn commands into frames: in this process (``LocalStepper``), or in one of its own
(``real_time.solver_process``).
"""

from typing import Protocol

import numpy as np

from rehearsal.loop.command import Command
from rehearsal.loop.frame import Frame
from rehearsal.loop.timeline import Timeline


class Stepper(Protocol):
    """Applies commands in their order."""

    def submit(self, command: Command) -> None:
        """Have a command applied."""

    def newest(self, wait_s: float = 0.0) -> Frame:
        """The newest frame, with the events since the last call.

        Where one that shows the newest input is due, wait for it so long.
        """
        ...

    def wait(self, most_s: float = np.inf) -> None:
        """Wait until all commands are applied, or for a time [s]."""


class LocalStepper:
    """Applies each command at once, in this process: the same commands give the same frames."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline

    def submit(self, command: Command) -> None:
        """As ``Stepper.submit``."""
        self.timeline.apply(command)

    def newest(self, wait_s: float = 0.0) -> Frame:
        """As ``Stepper.newest``: never waits."""
        return self.timeline.frame()

    def wait(self, most_s: float = np.inf) -> None:
        """As ``Stepper.wait``: they are applied at once."""
