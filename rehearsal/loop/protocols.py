"""The three roles of the loop: a source gives commands, a stepper turns them into frames, observers look at
frames.

The stepper of this process is ``Timeline``, that of a process of its own is ``SolverProcess``.
"""

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from rehearsal.live_settings import LiveSettings
from rehearsal.loop.command import Command
from rehearsal.loop.frame import Frame
from render.viewer import Controls
from ultrasound.probe import Probe


class Source(Protocol):
    """Where commands come from: the user, a tracker, a recorded session, a script."""

    @property
    def status(self) -> str:
        """What is wrong with the pose, for the line over the images; empty if nothing is."""
        ...

    def commands(self, frame: Frame, controls: Controls[LiveSettings], elapsed_s: float) -> Iterable[Command]:
        """The commands after a frame, with the user's controls, a time [s] after the last ones."""
        ...


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


class Observer(Protocol):
    """Looks at each frame once, while the anatomy shows it and its image is there: measures, records,
    compares, announces.
    """

    def observe(self, frame: Frame, probe: Probe) -> None:
        """Look at a frame, and at the probe with the scanner's settings."""
