"""The interface of a tissue model: all that solver, contacts, skin and embedding know of it.

docs/adding-a-tissue-model.md shows how to add one.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import taichi as ti

from sim.body import Body
from sim.particle_contact import ShapeContacts
from sim.sampling import SamplingError
from sim.surface_contact import SurfaceContacts


@dataclass(frozen=True)
class FixedRegion:
    """Tissue that cannot move (Dirichlet boundary): all within a distance [mm] of a point (3,) [mm]."""

    at_mm: np.ndarray
    radius_mm: float

    def nodes(self, nodes: np.ndarray) -> np.ndarray:
        """Mask (n,) of the nodes (n, 3) that are fixed. Raises SamplingError where it is none or all of them."""
        distance = np.linalg.norm(nodes - self.at_mm, axis=1)
        fixed = distance <= self.radius_mm
        if fixed.all() or not fixed.any():
            raise SamplingError(
                f"attachment.radius_mm = {self.radius_mm:g} fixes {'all' if fixed.all() else 'none'} of the organ, which is "
                f"{distance.min():.1f} to {distance.max():.1f} mm from attachment.at_mm: choose another radius or point"
            )
        return fixed


@dataclass(frozen=True)
class ModelInputs:
    """What a tissue model is made from: an organ [mm], the shapes around it, and the scene's settings of the tissue.

    ``organ`` is a closed surface, or what the model itself accepts instead; ``tissue`` has the model's parameters by the names
    of its section; ``friction`` is Coulomb's coefficient on shapes. ``serial``: run a step as one kernel on one core; None
    decides by size and machine. ``relaxation`` and ``mass_scaling_per_mm`` are for shape matching.
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
    """Rest state, projection of the constraints on the predicted positions, and interpolation of points in the tissue.

    ``serial``: the model is too small for more than one core of a CPU. ``EMBEDDING_CELL_RATIO``: width of the coarse tetrahedra
    that carry the image plane, over the resolution of the tissue. ``begin`` to ``project`` are ti.funcs that the solver's
    kernels inline, so their outermost loops are parallel; ``carried`` is one for a single point. A model whose material can be
    changed between steps also has ``set_material(young_kpa)``.
    """

    EMBEDDING_CELL_RATIO: ClassVar[float]

    @classmethod
    def make(cls, inputs: ModelInputs) -> "TissueModel":
        """The organ at rest, with its contacts. Raises SamplingError."""
        ...

    @staticmethod
    def reach_mm(tissue: Any) -> float:
        """Distance [mm] around a static shape within which the model needs to know the distance to it."""
        ...

    @property
    def body(self) -> Body: ...

    @property
    def contacts(self) -> ShapeContacts | SurfaceContacts | None: ...

    @property
    def serial(self) -> bool: ...

    def begin(self, dt: float) -> None:
        """Called once a substep [s], after the solver's prediction."""

    def gather(self) -> None:
        """Read the body's predicted positions. Called before iterations, when other code has changed them."""

    def scatter(self) -> None:
        """Write the body's predicted positions. Called after iterations, when other code needs them."""

    def project(self, stiffness: float, relaxation_factor: float, dt: float) -> None:
        """One iteration over all constraints, contacts with shapes included."""

    def update_frames(self) -> None:
        """Prepare ``carried``. Called once a step, when positions are final."""

    def attach(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames (n, k) and weights (n, k) of rest points (n, 3) [mm], for ``carried``."""
        ...

    def carried(self, point: ti.Vector, frame: ti.Vector, weight: ti.Vector) -> ti.Vector:
        """Return the current position (3,) [mm] of an attached point, from its rest position, frames (k,) and weights (k,)."""
        ...

    def counts(self) -> dict[str, int]:
        """Sizes of the model, for reports: ``particles`` or ``nodes`` first."""
        ...
