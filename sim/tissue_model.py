"""The interface of a tissue model: all that solver, contacts, skin and embedding know of it.

docs/adding-a-tissue-model.md shows how to add one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from sim.attachment import FixedRegion, Tether
from sim.body import Body
from sim.material import Part
from sim.particle_contact import ShapeContacts
from sim.skinning import Carrier
from sim.surface_contact import SurfaceContacts


@dataclass(frozen=True)
class ModelInputs:
    """What a tissue model is made from: an organ [mm], the shapes around it, and the scene's settings of the
    tissue.

    ``organ`` is a closed surface, or what the model itself accepts instead; ``tissue`` has the model's
    parameters by the names of its section; ``friction`` is Coulomb's coefficient on shapes; ``parts`` have
    their own material, a later one where they overlap. ``serial``: run a step as one kernel on one core; None
    decides by size and machine. ``relaxation`` and ``mass_scaling_per_mm`` are for shape matching.
    """

    organ: Any
    tissue: Any
    shapes: list
    friction: float
    fixed: Sequence[FixedRegion]
    tethers: Sequence[Tether]
    parts: Sequence[Part]
    serial: bool | None
    relaxation: str
    mass_scaling_per_mm: float


class TissueModel(Protocol):
    """Rest state, projection of the constraints on the predicted positions, and what carries points of the
    tissue along.

    ``serial``: the model is too small for more than one core of a CPU. ``EMBEDDING_CELL_RATIO``: width of the
    coarse tetrahedra that carry the image plane, over the resolution of the tissue. ``begin`` to ``project``
    are ti.funcs that the solver's kernels inline, so their outermost loops are parallel. A model whose
    material can be changed between steps also has ``set_material(young_kpa)``. One that carries more than the
    body from step to step has ``internal_state``, these fields by name, which its ti.func ``finish(dt)``
    updates at the end of each substep.
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

    @property
    def carrier(self) -> Carrier:
        """What carries points of the tissue along, of the model's own fields."""
        ...

    def update_frames(self) -> None:
        """Prepare the carrier. Called once a step, when positions are final."""

    def counts(self) -> dict[str, int]:
        """Sizes of the model, for reports: ``particles`` or ``nodes`` first."""
        ...
