"""What a tissue model is: the interface that solver, contacts, skin and embedding know, and nothing else of it.

How another one is added is in docs/adding-a-tissue-model.md.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import taichi as ti

from sim.body import Body
from sim.particle_contact import ShapeContacts
from sim.sampling import SamplingError
from sim.surface_contact import SurfaceContacts


@dataclass(frozen=True)
class FixedRegion:
    """Tissue that stays where it is: all within a distance [mm] of a place (3,) [mm]."""

    at_mm: np.ndarray
    radius_mm: float

    def nodes(self, nodes: np.ndarray) -> np.ndarray:
        """Which nodes (n, 3) are fixed. Raises SamplingError where there are none, or where all are."""
        apart = np.linalg.norm(nodes - self.at_mm, axis=1)
        fixed = apart <= self.radius_mm
        if fixed.all() or not fixed.any():
            raise SamplingError(
                f"attachment.radius_mm = {self.radius_mm:g} holds {'all' if fixed.all() else 'none'} of the organ, which lies "
                f"{apart.min():.1f} to {apart.max():.1f} mm from attachment.at_mm: choose another radius or place"
            )
        return fixed


@dataclass(frozen=True)
class ModelInputs:
    """What a tissue model is made of: an organ [mm] among shapes, and all that a scene says of the tissue.

    ``organ`` is a closed surface, or what the model itself takes in its stead; ``tissue`` has the model's parameters by the names
    of its section; ``friction`` is Coulomb's coefficient on shapes. ``serial`` says whether a step is one kernel on one core; left
    open, size and machine decide. ``relaxation`` and ``mass_scaling_per_mm`` are shape matching's.
    """

    organ: Any
    tissue: Any
    shapes: list
    friction: float
    fixed: FixedRegion | None
    serial: bool | None
    relaxation: str
    mass_scaling_per_mm: float


class TissueModel(Protocol):
    """Rest data, a projection of its constraints on the body's estimates, and a way to carry points along.

    One file a model. ``serial`` says that it is too small for more than one core of a CPU. The coarse tetrahedra that carry the
    image plane are ``EMBEDDING_CELL_RATIO`` sizes of the tissue wide. ``begin`` to ``project`` are ti.funcs that the solver's kernels inline, so their outermost loops are parallel.
    """

    EMBEDDING_CELL_RATIO: ClassVar[float]

    @classmethod
    def make(cls, parts: ModelInputs) -> "TissueModel":
        """The organ at rest, with its contacts. Raises SamplingError."""
        ...

    @staticmethod
    def reach_mm(tissue: Any) -> float:
        """How far around a shape that does not move a tissue asks for its distance [mm]."""
        ...

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
