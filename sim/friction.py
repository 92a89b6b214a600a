"""Coulomb's law of friction, for all contacts: of the surface and of particles with shapes, and between particles.

|friction| <= coefficient x normal. Each contact measures both in its own unit: as elastic slip and depth times stiffness
(``SurfaceContacts.tangential_slip``, return mapping), or as displacements (``ShapeContacts.friction_change``, ``SelfContacts.project``).
"""

import taichi as ti

# Keeps the fraction of no slip finite.
LEAST_SLIP_MM = 1e-12


@ti.func
def tangential(vector, normal):
    """The part of a vector that lies in the plane with this unit normal."""
    return vector - vector.dot(normal) * normal


@ti.func
def sticking_fraction(slip, most):
    """The fraction of a tangential slip that friction withstands, up to the length ``most``: 1 where it sticks."""
    return ti.min(1.0, most / ti.max(slip.norm(), LEAST_SLIP_MM))
