"""Vectors of three carried as four, the width of the vector units that compilers use where no entry is left out."""

import taichi as ti
import taichi.math as tm


@ti.func
def four(vector):
    """A vector of three with 0 as the fourth entry."""
    return tm.vec4(vector.x, vector.y, vector.z, 0.0)


@ti.func
def row(matrix, k: ti.template()):
    """Row k of a matrix of four columns."""
    return tm.vec4(matrix[k, 0], matrix[k, 1], matrix[k, 2], matrix[k, 3])


@ti.func
def cross(a, b):
    """Cross product of the first three entries."""
    return tm.vec4(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x, 0.0)
