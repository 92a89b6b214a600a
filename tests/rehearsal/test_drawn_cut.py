"""The cut as it is drawn: near the cut itself, with less of its facets, closed along its rim."""

import igl
import numpy as np
import pytest
import trimesh
from cut_ball import R, ball, cut_by

from rehearsal.resection.drawn_cut import DrawnCut, drawn_cut

# The drawn cut may be so far from the cut itself [mm].
NEAR_MM = 0.2


@pytest.fixture(scope="module", params=["specimen", "remnant"])
def part(request) -> tuple[trimesh.Trimesh, np.ndarray, DrawnCut]:
    """One part of a ball that a smaller one, of facets of 3 mm, has cut: the surface, its cut faces, and it
    as drawn.
    """
    cut = cut_by(ball(R), ball(15.0, (0.4, 0.7, 25.0), fine=3))
    surface, on_cut = getattr(cut, request.param), getattr(cut, f"on_{request.param}")
    return surface, on_cut, drawn_cut(surface, on_cut)


def surface_of(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


def away(surface: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Distances (n,) [mm] of points (n, 3) from a surface."""
    of = np.asarray(surface.vertices, float), np.asarray(surface.faces, np.int64)
    return np.sqrt(igl.point_mesh_squared_distance(points, *of)[0])


def drawn_bed(drawn: DrawnCut) -> trimesh.Trimesh:
    return surface_of(drawn.vertices, drawn.faces[drawn.on_cut])


def test_it_is_within_two_tenths_of_a_millimetre_of_the_cut(part):
    surface, on_cut, drawn = part
    cut = surface_of(surface.vertices, surface.faces[on_cut])
    for one, other in ((drawn_bed(drawn), cut), (cut, drawn_bed(drawn))):
        points = trimesh.sample.sample_surface(one, 3000, seed=1)[0]
        assert away(other, points).max() < NEAR_MM
    whole = surface_of(drawn.vertices, drawn.faces)
    points = trimesh.sample.sample_surface(whole, 3000, seed=1)[0]
    assert away(surface, points).max() < NEAR_MM


def test_its_facets_are_smaller_and_its_rim_has_less_teeth(part):
    surface, on_cut, drawn = part
    bed = drawn_bed(drawn)
    assert len(bed.faces) == 4 * on_cut.sum()
    assert (
        bed.face_adjacency_angles.mean()
        < 0.7 * surface_of(surface.vertices, surface.faces[on_cut]).face_adjacency_angles.mean()
    )


def test_capsule_and_cut_meet_along_the_rim(part):
    _, _, drawn = part
    capsule = surface_of(drawn.vertices, drawn.faces[~drawn.on_cut])
    rims = []
    for surface in (capsule, drawn_bed(drawn)):
        edges = surface.edges_sorted
        once = trimesh.grouping.group_rows(edges, require_count=1)
        rims.append(drawn.vertices[edges[once]])
    # Each edge of the capsule's rim has two of the cut: both ends and its middle.
    expected = np.concatenate([rims[0].reshape(-1, 3), rims[0].mean(axis=1)])
    found = rims[1].reshape(-1, 3)
    assert len(rims[1]) == 2 * len(rims[0])
    apart = np.linalg.norm(found[:, None] - expected[None], axis=2).min(axis=1)
    assert apart.max() < 1e-6


def test_each_vertex_has_the_coverage_of_the_nearest(part):
    surface, _, drawn = part
    apart = np.linalg.norm(drawn.vertices - surface.vertices[drawn.source], axis=1)
    longest = surface.edges_unique_length.max()
    assert apart.max() < longest / 2 + NEAR_MM
    nearest = [np.linalg.norm(surface.vertices - point, axis=1).min() for point in drawn.vertices[::20]]
    assert (apart[::20] <= np.array(nearest) + 2 * NEAR_MM).all()
