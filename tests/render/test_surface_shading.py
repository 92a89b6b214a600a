"""Normals and colours of a surface, against their formulas in NumPy."""

import numpy as np
import pytest
import trimesh

from render.surface_shading import CUT_EDGE_MM, GLASS, SOLID, TINT, ShadedSurface
from sim.fields import array_of, field_of

EYE, LIGHT = np.array([60.0, -25.0, 40.0]), np.array([-20.0, 70.0, 35.0])
CUT = np.array([1.0, -2.0, 0.5]), np.array([0.0, 0.6, 0.8])
BASE, GLOSS = (0.7, 0.2, 0.4), 0.3


def bean() -> trimesh.Trimesh:
    """A closed surface without symmetry."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    x, y, z = ball.vertices.T
    return trimesh.Trimesh(np.column_stack([1.4 * x + 0.02 * z * z, y, 0.8 * z]), ball.faces, process=False)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def normals_of(mesh: trimesh.Trimesh) -> np.ndarray:
    """Sums of the normals of the faces around each vertex, by their areas."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    total = np.zeros_like(mesh.vertices)
    for corner in mesh.faces.T:
        np.add.at(total, corner, np.cross(b - a, c - a))
    return unit(total)


def colours_of(mesh: trimesh.Trimesh, opacity: float, tinted: np.ndarray, is_cut: bool) -> np.ndarray:
    normal, to_eye = normals_of(mesh), unit(EYE - mesh.vertices)
    half = unit(unit(LIGHT - mesh.vertices) + to_eye)
    sheen = GLOSS * np.maximum((normal * half).sum(axis=1), 0.0) ** 36
    rim = (1.0 - np.abs((normal * to_eye).sum(axis=1))) ** 2
    alpha = np.minimum(opacity + (1.0 - opacity) * (0.75 * rim + sheen), 1.0)
    if is_cut:
        alpha = 0.5 - (mesh.vertices - CUT[0]) @ CUT[1] / CUT_EDGE_MM
    base = np.where(tinted[:, None], TINT, BASE)
    return np.column_stack([base * (1.0 - 0.25 * rim)[:, None] + sheen[:, None], alpha])


@pytest.mark.parametrize("opacity, is_cut", [(SOLID, False), (GLASS, False), (SOLID, True)])
def test_a_surface_is_shaded_by_the_formulas(device, opacity, is_cut):
    mesh = bean()
    surface = ShadedSurface(field_of(mesh.vertices, 1), mesh.faces, BASE, GLOSS)
    tinted = mesh.vertices[:, 0] > 3.0
    surface.tint(tinted)
    surface.shade(EYE, LIGHT, opacity, CUT if is_cut else None)
    # Edges of 1 mm between float32 places of 14 mm are 1e-6 off, so are normals; the power multiplies this by
    # 36.
    assert array_of(surface.normal) == pytest.approx(normals_of(mesh), abs=1e-5)
    wanted = colours_of(mesh, opacity, tinted, is_cut)
    assert array_of(surface.colour) == pytest.approx(wanted, abs=1e-4 if is_cut else 2e-5)
    surface.tint(None)
    surface.shade(EYE, LIGHT, opacity, CUT if is_cut else None)
    untinted = colours_of(mesh, opacity, np.zeros(len(mesh.vertices), bool), is_cut)
    assert array_of(surface.colour) == pytest.approx(untinted, abs=1e-4 if is_cut else 2e-5)
