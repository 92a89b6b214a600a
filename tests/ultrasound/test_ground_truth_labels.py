"""GroundTruthLabels: what each pixel is, against shapes cut by a plane; and the matrices beside a picture,
against the picture.
"""

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from plan_ball import case_of_ball

from sim.embedding import Unmoved
from sim.fields import fill
from ultrasound.ground_truth_labels import GroundTruthLabels
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe import load_probe
from ultrasound.probe_manipulator import ImagePlane, pose_at
from ultrasound.sampled_volume import distance_volume
from ultrasound.scanned_anatomy import ScannedAnatomy
from ultrasound.scanner import CT, Scanner
from ultrasound.sweep import PixelLabel

PIXELS = 120
WIDTH, DEPTH, ABOVE = 48.0, 60.0, 6.0
PIXEL_MM = WIDTH * DEPTH / PIXELS**2
WORLD = np.eye(4)
WORLD[:3, :3], WORLD[:3, 3] = rotation_about([1, -2, 3], 50), (30.0, -12.0, 7.0)
PLANE = ImagePlane(WORLD, WIDTH, DEPTH, ABOVE)
U, V = np.meshgrid(
    (np.arange(PIXELS) + 0.5) / PIXELS * WIDTH - WIDTH / 2,
    (np.arange(PIXELS) + 0.5) / PIXELS * DEPTH - ABOVE,
)


def in_world(*place: float) -> np.ndarray:
    """A place (u, v, w) of the plane."""
    return WORLD[:3, :3] @ place + WORLD[:3, 3]


def box(size: tuple[float, ...], *place: float) -> trimesh.Trimesh:
    """A box along the plane's axes about a place of it."""
    there = WORLD.copy()
    there[:3, 3] = in_world(*place)
    return trimesh.creation.box(size, transform=there)


def ball(radius: float, *place: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius).apply_translation(in_world(*place))


def taken(embedding: Unmoved | None = None) -> PlaneInTissue:
    plane = PlaneInTissue(embedding or Unmoved(), PIXELS)
    plane.locate(PLANE)
    return plane


def middle(shown: np.ndarray) -> tuple[float, float]:
    return U[shown].mean(), V[shown].mean()


def test_a_box_is_marked_where_the_plane_cuts_it(device):
    # 26 x 14 mm on the plane, from w = -3 to 9: neither its sides nor its place are alike along the axes.
    marks = GroundTruthLabels(taken(), distance_volume(box((26, 14, 12), -6, 31, 3), 1.0)).render()
    aside = np.maximum(np.abs(U + 6) - 13, np.abs(V - 31) - 7)
    # Distances are linear near its faces; linear between points 1 mm apart they are off around its edges
    # alone.
    assert np.array_equal(marks[np.abs(aside) > 0.3] == PixelLabel.ORGAN, aside[np.abs(aside) > 0.3] < 0)
    assert set(np.unique(marks)) == {PixelLabel.OUTSIDE, PixelLabel.ORGAN}
    # Half a pixel along each side.
    assert (marks == PixelLabel.ORGAN).sum() * PIXEL_MM == pytest.approx(26 * 14, abs=26 * 0.5 + 14 * 0.4)
    assert middle(marks == PixelLabel.ORGAN) == pytest.approx((-6, 31), abs=0.25)


def test_balls_are_marked_as_large_as_the_plane_cuts_them(device):
    # Middles off the plane: what is cut is smaller than the ball.
    organ, tumour = distance_volume(ball(20, 2, 25, 6)), distance_volume(ball(7, 9, 33, -4), 1.0)
    beads = np.array(
        [in_world(-6, 20, 1.2), in_world(-4, 12, -1.5), in_world(9, 33, 0), in_world(0, 15, 2.5)]
    )
    marks = GroundTruthLabels(taken(), organ, tumour, beads, 2.4).render()
    inside, bead = marks % PixelLabel.BEAD, marks // PixelLabel.BEAD
    # The last bead's middle is farther off the plane than it reaches.
    assert set(np.unique(inside)) == {0, 1, 2} and set(np.unique(bead)) == {0, 1, 2, 3}
    # Linear distances 2 mm apart, of facets that are 0.1 % in, move an outline by a tenth of a millimetre; a
    # pixel has 0.4 x 0.5.
    for shown, radius, off, place in [
        (inside >= PixelLabel.ORGAN, 20, 6, (2, 25)),
        (inside == PixelLabel.TUMOUR, 7, -4, (9, 33)),
        (bead == 1, 2.4, 1.2, (-6, 20)),
        (bead == 2, 2.4, -1.5, (-4, 12)),
        (bead == 3, 2.4, 0, (9, 33)),
    ]:
        cut = np.sqrt(radius**2 - off**2)
        assert middle(shown) == pytest.approx(place, abs=0.2)
        # Pixels on the outline are counted or not as their middles lie, half of them each: to half a pixel's
        # breadth.
        assert shown.sum() * PIXEL_MM == pytest.approx(np.pi * cut**2, abs=2 * np.pi * cut * 0.25)
        distance = np.hypot(U - place[0], V - place[1]) - cut
        assert np.array_equal(shown[np.abs(distance) > 0.2], distance[np.abs(distance) > 0.2] < 0)


def test_where_beads_overlap_the_last_is_marked(device):
    beads = np.array([in_world(0, 20, 0), in_world(1, 20, 0), in_world(0.5, 20.8, 0)])
    marks = GroundTruthLabels(
        taken(), distance_volume(ball(20, 2, 25, 6)), beads=beads, radius_mm=2.4
    ).render()
    assert set(np.unique(marks)) == {0, *(PixelLabel.ORGAN + PixelLabel.BEAD * k for k in range(4))}
    assert (marks[np.hypot(U - 0.5, V - 20.8) < 2.3] == PixelLabel.ORGAN + 3 * PixelLabel.BEAD).all()


def test_marks_are_of_where_tissue_was_at_rest(device):
    embedding = Unmoved()
    plane = taken(embedding)
    # Now it lies turned and shifted on the plane: u, v show what was at rest at v + 4, u - 9.
    moved = WORLD @ np.array([[0, 1, 0, 4], [1, 0, 0, -9], [0, 0, -1, 0], [0, 0, 0, 1.0]])
    fill((embedding.rest_from_plane, moved[None, :3]))
    marks = GroundTruthLabels(plane, distance_volume(box((14, 6, 10), 30, -12, 0), 1.0)).render()
    assert middle(marks == PixelLabel.ORGAN) == pytest.approx((-12 + 9, 30 - 4), abs=0.25)
    assert np.ptp(V[marks == PixelLabel.ORGAN]) == pytest.approx(14, abs=0.51)


class Nowhere(Unmoved):
    """Holds nothing."""

    count = 0


def test_what_no_tissue_holds_is_outside(device):
    organ = distance_volume(ball(20, 0, 25, 0))
    assert not GroundTruthLabels(taken(Nowhere()), organ, organ, in_world(0, 25, 0)[None]).render().any()


# A probe whose picture starts behind its face, in a patient.
CASE = case_of_ball(probe=load_probe("curvilinear"), origin=np.array([-61.0, 112.0, 1240.0]))
POSE = pose_at(np.array([9.0, -4, 17]), np.array([0.3, -0.2, -1]), np.array([1, 0.5, 0.2]), 30.0)


def test_the_matrices_beside_a_picture_lead_to_what_it_shows(device):
    shown = CASE.probe_in_patient(POSE) @ CASE.probe.image_to_probe(PIXELS, PIXELS)
    # A bright spot in the patient, at a pixel that neither mirror nor transpose leaves in place; a tumour at
    # another.
    spot, tumour = ((shown @ [*at, 0, 1])[:3] for at in ((83, 41), (30, 95)))
    first, voxel = spot - [20, 21, 22], 1.5
    grid = first + voxel * np.moveaxis(np.indices((30, 30, 30)), 0, -1)
    hu = 1000 * np.exp(-((grid - spot) ** 2).sum(axis=-1) / (2 * 4.0**2)) - 1000
    # As a rehearsal has it: all relative to its origin.
    index_from_mm = np.diag([1 / voxel] * 3 + [1.0])
    index_from_mm[:3, 3] = (CASE.origin - first) / voxel
    organ, mass = (
        trimesh.creation.icosphere(subdivisions=3, radius=r).apply_translation(tumour - CASE.origin)
        for r in (30.0, 12.0)
    )
    scanner = Scanner(ScannedAnatomy(organ, hu, index_from_mm, tumour=mass), Unmoved(), CASE.probe, PIXELS)
    images = scanner.images(CASE.image_plane(POSE), CASE.probe, "ct", "speckle", 1000.0, -500.0)
    picture = images.by_name[CT].astype(float)
    rows, columns = np.indices(picture.shape)
    light = picture**2
    # A spot of 4 mm in voxels of 1.5 mm and pixels of 1.5 x 1.1.
    assert (light * columns).sum() / light.sum() == pytest.approx(83, abs=0.1)
    assert (light * rows).sum() / light.sum() == pytest.approx(41, abs=0.1)
    marks = scanner.ground_truth.render()
    assert columns[marks == PixelLabel.TUMOUR].mean() == pytest.approx(30, abs=0.5)
    assert rows[marks == PixelLabel.TUMOUR].mean() == pytest.approx(95, abs=0.5)
    width, depth, _ = CASE.probe.extent_mm
    area = (marks == PixelLabel.TUMOUR).sum() * width * depth / PIXELS**2
    assert area == pytest.approx(np.pi * 12**2, rel=0.06)
