"""What looks at frames, and where their commands come from."""

from collections.abc import Iterable
from typing import Protocol

from rehearsal.loop.command import Command
from rehearsal.loop.frame import Frame
from render.viewer import Controls
from ultrasound.probe import Probe


class Source(Protocol):
    """Where commands come from: the user, a tracker, a recorded session, a script."""

    @property
    def status(self) -> str:
        """A line for the panel; empty if there is none."""
        ...

    def commands(self, frame: Frame, controls: Controls, elapsed_s: float) -> Iterable[Command]:
        """The commands after a frame, with the user's controls, a time [s] after the last ones."""
        ...


class Observer(Protocol):
    """Looks at each frame once, while the anatomy shows it and its image is there: measures, records,
    compares, announces.
    """

    def observe(self, frame: Frame, probe: Probe) -> None:
        """Look at a frame, and at the probe with the scanner's settings."""
