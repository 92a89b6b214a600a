"""Coulomb's law of friction, for all contacts: of the surface and of particles with shapes, and between
particles.

|friction| <= coefficient x normal. Each contact measures both in its own unit: as elastic slip and depth
times stiffness (``SurfaceContacts.tangential_slip``, return mapping), or as displacements
(``ShapeContacts.friction_change``, ``SelfContacts.project``).
"""

import taichi as ti

# Avoids a division by zero where there is no slip.
LEAST_SLIP_MM = 1e-12


@ti.func
def tangential(vector, normal):
    """The part of a vector that lies in the plane with this unit normal."""
    return vector - vector.dot(normal) * normal


@ti.func
def sticking_fraction(slip, limit_mm):
    """The fraction of a tangential slip that friction withstands, up to a length [mm]: 1 where it sticks."""
    return ti.min(1.0, limit_mm / ti.max(slip.norm(), LEAST_SLIP_MM))
