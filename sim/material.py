"""Isotropic elastic materials, and their mixture in elements that several parts of the organ share
(NumPy).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh


@dataclass(frozen=True)
class Material:
    """Young's modulus [kPa], Poisson's ratio and density [g/cm^3] of a part of the organ."""

    young_kpa: float = 15.0
    poisson: float = 0.45
    density_g_cm3: float = 1.05

    @property
    def mu(self) -> float:
        """Shear modulus [g/(mm s^2)]; 1 kPa is 1000 of them."""
        return 1e3 * self.young_kpa / (2 * (1 + self.poisson))

    @property
    def lambda_(self) -> float:
        """Lamé's first parameter [g/(mm s^2)]."""
        return 2 * self.mu * self.poisson / (1 - 2 * self.poisson)

    @property
    def density(self) -> float:
        """Density [g/mm^3]."""
        return 1e-3 * self.density_g_cm3


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the organ that has its own material: all within a closed surface [mm]."""

    name: str
    surface: trimesh.Trimesh
    material: Material


def mixture(
    outside: Material, parts: Sequence[Material], share: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """mu, lambda [g/(mm s^2)] and density [g/mm^3], (m,) each, of elements with volume shares (m, parts) of
    the parts.

    Voigt's rule: the means by volume. An element has one deformation gradient, so that this is its energy
    integrated over the parts, as in the finite cell method; docs/method.md compares it with Reuss's rule and
    others.
    """
    materials = (outside, *parts)
    shares = np.column_stack([1 - share.sum(axis=1), share])
    mu, lambda_, density = (
        shares @ [getattr(material, name) for material in materials] for name in ("mu", "lambda_", "density")
    )
    return mu, lambda_, density
