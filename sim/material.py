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
    def bulk(self) -> float:
        """Bulk modulus [g/(mm s^2)]."""
        return self.lambda_ + 2 / 3 * self.mu

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

    The density is the mean by volume, shear and bulk modulus are Hill's means; docs/method.md compares them
    with other rules.
    """
    materials = (outside, *parts)
    shares = np.column_stack([1 - share.sum(axis=1), share])
    mu = _hill_mean(shares, np.array([material.mu for material in materials]))
    bulk = _hill_mean(shares, np.array([material.bulk for material in materials]))
    return mu, bulk - 2 / 3 * mu, shares @ [material.density for material in materials]


def _hill_mean(shares: np.ndarray, moduli: np.ndarray) -> np.ndarray:
    """Effective modulus (m,) of moduli (k,) by their volume shares (m, k): the mean of the bounds of Voigt,
    one strain in all parts, and Reuss, one stress (Hill 1952).
    """
    return (shares @ moduli + 1 / (shares @ (1 / moduli))) / 2
