"""The whole state of a rehearsal: what undo, bookmarks and sessions keep."""

from dataclasses import dataclass

from rehearsal.pressed_organ import OrganState
from rehearsal.resection.resection_state import NO_RESECTION, Resection
from ultrasound.probe_manipulator import ManipulatorState


@dataclass(frozen=True)
class WholeState:
    """All that commands change; steps from it give the same bits as before.

    ``manipulator`` is None where no hand has moved it.
    """

    organ: OrganState
    resection: Resection = NO_RESECTION
    manipulator: ManipulatorState | None = None
