"""Solvers for blocks of cells or particles, without a scene."""

import numpy as np
import trimesh

from sim.body import Body, ParticleBody
from sim.lattice import fill_block, surface_points
from sim.neo_hookean import NeoHookean
from sim.particle_contact import ShapeContacts
from sim.sampling import RestBody, group_into_patches
from sim.shape_matching import ShapeMatching
from sim.shapes import ConvexTool
from sim.solver import Solver
from sim.surface_contact import SurfaceContacts

# The paper's friction, and width of a cluster in radii.
FRICTION, CLUSTER_SPACING = 0.35, 3.33


def block_of_cells(side: int, cell_mm: float, shapes: list, tool: ConvexTool | None = None) -> Solver:
    """A cube with a corner at the origin, ``side`` cells along each edge, in contact with shapes, one of
    which may be the tool.
    """
    lattice = fill_block((side, side, side), cell_mm)
    body = Body(lattice.nodes)
    cube = trimesh.creation.box(bounds=[[0.0] * 3, [side * cell_mm] * 3])
    contacts = SurfaceContacts(body, lattice, *surface_points(cube, cell_mm / 2), shapes, FRICTION)
    return Solver(NeoHookean(body, lattice, contacts), tool=tool)


def block_of_particles(
    points_mm: np.ndarray, radius_mm: float, shapes: list, tool: ConvexTool | None = None
) -> Solver:
    """Particles at points (n, 3) [mm], a radius apart, in contact with shapes, one of which may be the
    tool.
    """
    rest = RestBody(points_mm, radius_mm, np.full(len(points_mm), radius_mm / 2))
    arranged, patches = group_into_patches(rest, CLUSTER_SPACING)
    body = ParticleBody(arranged)
    contacts = ShapeContacts(body, shapes, FRICTION)
    return Solver(ShapeMatching(body, patches, contacts), tool=tool)
