"""What a tissue model is: the interface that solver, contacts, skin and embedding know, and nothing else of it.

A new one is a file of this folder with its class, its section of a scene file in ``scenes.tissue``, what its solver is put
together from in ``studies.models.KINDS`` and its presets in ``studies.setup.PRESETS``; the tests of all models then are its own.
"""

from typing import Protocol, runtime_checkable

import numpy as np
import taichi as ti

from sim.body import Body
from sim.contact import ShapeContacts
from sim.surface_contact import SurfaceContacts


class TissueModel(Protocol):
    """Rest data, a projection of its constraints on the body's estimates, and a way to carry points along.

    One file a model. ``serial`` says that it is too small for more than one core of a CPU.
    ``begin`` to ``project`` are ti.funcs that the solver's kernels inline, so their outermost loops are parallel.
    """

    @property
    def body(self) -> Body: ...

    @property
    def contacts(self) -> ShapeContacts | SurfaceContacts | None: ...

    @property
    def serial(self) -> bool: ...

    def begin(self, dt: float) -> None:
        """Once a substep [s], when the solver has predicted the estimates."""

    def gather(self) -> None:
        """Before passes, when something else has moved the estimates."""

    def scatter(self) -> None:
        """After passes, when something else needs the estimates."""

    def project(self, stiffness: float, relaxation_factor: float, dt: float) -> None:
        """One pass over all constraints, those of contact with shapes too."""

    def update_frames(self) -> None:
        """Once a step, when positions are final, for ``carry``."""

    def attach(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames (n, k) and weights (n, k) of rest points (n, 3) [mm], for ``carry``."""
        ...

    def carry(self, rest: ti.Field, frame: ti.Field, weight: ti.Field, out: ti.Field) -> None:
        """Where attached points are now."""

    def counts(self) -> dict[str, int]:
        """Its size, for reports: ``particles`` or ``nodes`` first."""
        ...


@runtime_checkable
class MaterialModel(Protocol):
    """A tissue model of a material, which can be changed between steps."""

    def set_young(self, young_kpa: float) -> None:
        """Change Young's modulus [kPa]."""
