"""Labels that are unlike one whole kidney: ellipsoids whose length and volume are known."""

import re

import numpy as np
import pytest
import trimesh
from synthetic_body import DIRECTIONS, grid_around, points_of

from scenes.patients.kidney_plausibility import (
    flat_end_warnings,
    hollow_warnings,
    kidney_warnings,
    length_mm,
    midline_warnings,
)
from scenes.patients.organ_selection import Organ, find_organs
from scenes.patients.readers.label_maps import LabelMap
from scenes.volumes.voxel_grid import VoxelGrid

NAMES = {1: "kidney", 2: "tumour", 3: "cyst"}
# 110 mm long, 144 ml, left of the midline at x = 0.
CENTRE, AXES = np.array([60.0, 20.0, 0.0]), np.array([25.0, 25.0, 55.0])


def ellipsoid(centre, axes):
    return lambda places: np.linalg.norm((places - centre) / axes, axis=-1) < 1


KIDNEY = ellipsoid(CENTRE, AXES)


def labelled(*solids, spacing=(2.5, 2.5, 2.5), direction="identity", low=(-5, -40, -75), high=(115, 80, 75)):
    """A label map with solids (value, inside) painted one over the other, and its organ; it covers an LPS
    box [mm].
    """
    grid = VoxelGrid.of(grid_around(low, high, spacing, DIRECTIONS[direction]))
    places = points_of(grid.image(np.zeros(grid.size[::-1], np.uint8)))
    values = np.zeros(grid.size[::-1], np.uint8)
    for value, inside in solids:
        values[inside(places)] = value
    labels = LabelMap.valued(grid, values, NAMES)
    return labels, *find_organs(labels)


def box_mesh(piece: Organ, volume_ml: float) -> trimesh.Trimesh:
    """A convex surface of a volume."""
    return trimesh.creation.box(np.full(3, (1000 * volume_ml) ** (1 / 3)))


def warned(labels, piece, midline=0.0):
    surface = box_mesh(piece, piece.volume_ml)
    return kidney_warnings(piece, labels, surface, piece.side_of(0.0), midline)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("spacing", [(2.5, 2.5, 2.5), (1.0, 2.0, 5.0)], ids=str)
def test_a_normal_kidney(direction, spacing):
    labels, piece = labelled((1, KIDNEY), direction=direction, spacing=spacing)
    assert warned(labels, piece) == ()
    # Between the centres of voxels, of which one at each end may be missing.
    assert 110 - 2 * max(spacing) - 0.6 < length_mm(piece, piece.mask) < 110 + 0.6


@pytest.mark.parametrize("axes", [(21, 21, 49), (30, 30, 64)], ids=str)
def test_the_smallest_and_largest_of_most_adults(axes):
    assert warned(*labelled((1, ellipsoid(CENTRE, axes)))) == ()


class TestSize:
    @pytest.mark.parametrize("axes", [(43, 43, 60), (22, 22, 80)], ids=["wide", "long"])
    def test_too_large(self, axes):
        (warning,) = warned(*labelled((1, ellipsoid(CENTRE, axes)), low=(-5, -40, -85), high=(115, 80, 85)))
        length, volume = map(float, re.search(r"is (\d+) mm long and has (\d+) ml", warning).groups())
        assert 2 * axes[2] - 6 < length <= 2 * axes[2]
        assert volume == pytest.approx(4 / 3 * np.pi * np.prod(axes) / 1000, rel=0.02)
        assert "90 to 130 mm long and have 90 to 250 ml" in warning
        assert "horseshoe" in warning and "--tumour" in warning and "\n" not in warning

    @pytest.mark.parametrize("value", [2, 3])
    def test_large_by_its_tumour_or_cyst(self, value):
        """A ball of 268 ml at the lower pole: 412 ml and 170 mm in all."""
        tumour = ellipsoid(CENTRE - [0, 0, 75], np.full(3, 40.0))
        labels, piece = labelled((1, KIDNEY), (value, tumour), low=(-5, -40, -120))
        assert piece.volume_ml > 350 and length_mm(piece, piece.mask) > 150
        assert warned(labels, piece) == ()
        (warning,) = warned(*labelled((1, KIDNEY), (1, tumour), low=(-5, -40, -120)))
        assert "--tumour" in warning

    @pytest.mark.parametrize("axes", [(16, 16, 34), (18, 18, 45), (32, 32, 38)], ids=str)
    def test_small(self, axes):
        """In mild words: of a child, or shrunken."""
        (warning,) = warned(*labelled((1, ellipsoid(CENTRE, axes))))
        assert warning.startswith("the kidney is small") and "child's or a shrunken kidney" in warning

    def test_small_without_its_tumour(self):
        """Parenchyma of 60 ml beside a tumour of 68 ml is no small kidney."""
        upper = ellipsoid(CENTRE + [0, 0, 20], (20, 20, 36))
        labels, piece = labelled((1, upper), (2, ellipsoid(CENTRE - [0, 0, 30], (25, 25, 26))))
        assert (piece.values[piece.mask] == 1).sum() * 0.008 < 70 and warned(labels, piece) == ()


class TestMidline:
    @pytest.mark.parametrize(("sign", "side"), [(1, "left"), (-1, "right")])
    def test_a_horseshoe_kidney(self, sign, side):
        """Two kidneys, one smaller, with an isthmus in front of the spine."""
        mirror = np.array([sign, 1, 1])
        own, other = ellipsoid(CENTRE * mirror, AXES), ellipsoid(CENTRE * -mirror * [1, -1, -1], AXES * 0.8)
        isthmus = ellipsoid(CENTRE * [0, 1, 1] - [0, 0, 30], (70, 12, 12))
        found = warned(*labelled((1, own), (1, other), (1, isthmus), low=(-90, -10, -60), high=(90, 50, 60)))
        assert len(found) == 2 and "horseshoe" in found[0]
        assert f"the {side} kidney extends" in found[1] and "across the body's midline" in found[1]

    def test_figures(self):
        """A bar of 22.5 x 22.5 mm to x = -35 mm has 25 mm, or 12.7 ml, more than 10 mm beyond the midline."""

        def bar(p):
            return (p[..., 0] > -36) & (p[..., 0] < 60) & (np.abs(p[..., 1:] - CENTRE[1:]) < 11).all(axis=-1)

        _, piece = labelled((1, KIDNEY), (1, bar), low=(-60, -40, -75))
        (warning,) = midline_warnings(piece, piece.mask, "left", 0.0)
        assert "extends 35 mm" in warning and "with 13 ml" in warning
        assert midline_warnings(piece, piece.mask, "right", 0.0)
        assert midline_warnings(piece, piece.mask, "left", None) == ()
        assert midline_warnings(piece, piece.mask, "left", -24.0) == ()

    def test_a_tumour_may_cross_it(self):
        tumour = ellipsoid(CENTRE - [50, 0, 0], np.full(3, 38.0))
        assert warned(*labelled((1, KIDNEY), (2, tumour), low=(-40, -40, -75))) == ()
        found = warned(*labelled((1, KIDNEY), (1, tumour), low=(-40, -40, -75)))
        assert any("midline" in line for line in found)


class TestHollow:
    def test_a_closed_cavity(self):
        """A shell of 75 ml around 51 ml, which the surface fills."""
        _, piece = labelled((1, ellipsoid(CENTRE, (25, 25, 48))), (0, ellipsoid(CENTRE, (18, 18, 37.5))))
        (warning,) = hollow_warnings(piece, box_mesh(piece, 126.0))
        assert f"it has {piece.volume_ml:.1f} ml, and its surface encloses 126.0 ml" in warning

    def test_an_open_one(self):
        """A shell with a hole in it: its surface has an inside, and its volume is the label's."""
        _, piece = labelled((1, KIDNEY), (0, ellipsoid(CENTRE, AXES - 5)))
        surface = box_mesh(piece, 144.0)
        inside = box_mesh(piece, 144.0 - piece.volume_ml)
        inside.invert()
        (warning,) = hollow_warnings(piece, trimesh.util.concatenate([surface, inside]))
        assert f"fills {piece.volume_ml / 144:.0%} of its convex hull, a kidney 65% or more" in warning

    def test_small_cavities(self):
        """Calyces and sinus fat, 4 % of the volume."""
        _, piece = labelled((1, KIDNEY), (0, ellipsoid(CENTRE, (8, 8, 22))))
        assert hollow_warnings(piece, box_mesh(piece, 144.0)) == ()


class TestFlatEnd:
    @pytest.mark.parametrize("direction", ["identity", "RAS", "left-handed", "slices first"])
    @pytest.mark.parametrize(("axis", "sign", "towards"), [
        (0, 1, "left"), (0, -1, "right"), (1, 1, "back"), (1, -1, "front"), (2, 1, "head"), (2, -1, "feet"),
    ])  # fmt: skip
    def test_each_end(self, direction, axis, sign, towards):
        """A fifth of the length, cut off: the section has 0.64 of the middle's area."""

        def there(places):
            return KIDNEY(places) & (sign * (places - CENTRE)[..., axis] < 0.6 * AXES[axis])

        _, piece = labelled((1, there), direction=direction, spacing=(1.5, 2.0, 2.5))
        (warning,) = flat_end_warnings(piece)
        assert f"towards the {towards} in a flat face of" in warning
        # Of the last plane of voxels, which is at the cut or up to 2.5 mm before it.
        heights = 0.6 - np.array([0, 2.5]) / AXES[axis]
        least, most = np.pi * np.delete(AXES, axis).prod() * (1 - heights**2) / 100
        assert 0.97 * least < float(re.search(r"([\d.]+) cm2", warning)[1]) < 1.03 * most

    @pytest.mark.parametrize(("kept", "spacing"), [(30, 2.5), (44, 2.5), (30, 5), (44, 5), (30, 10)])
    def test_at_the_edge_of_a_label_volume(self, kept, spacing):
        """The last plane of the volume goes through the kidney; also where empty planes were added to it."""
        for low in (-kept, -kept - 4 * spacing):
            _, piece = labelled(
                (1, lambda places: KIDNEY(places) & (places[..., 2] > -kept - 0.1)),
                spacing=(2.5, 2.5, spacing), low=(30, -10, low), high=(90, 50, 75),
            )  # fmt: skip
            (warning,) = flat_end_warnings(piece)
            assert "towards the feet" in warning

    @pytest.mark.parametrize("shift", np.linspace(0, 1, 5, endpoint=False))
    @pytest.mark.parametrize("spacing", [0.8, 3.0, 5.0, 10.0])
    def test_poles_wherever_the_slices_are(self, spacing, shift):
        low = -70.0 + shift * spacing
        _, piece = labelled((1, KIDNEY), spacing=(2.5, 2.5, spacing), low=(30, -10, low), high=(90, 50, 75))
        assert flat_end_warnings(piece) == ()

    @pytest.mark.parametrize("spacing", [2.0, 5.0])
    def test_a_box_around_the_label_cuts_nothing(self, spacing):
        """DICOM-SEG and RTSTRUCT end where the label ends."""
        labels, piece = labelled((1, KIDNEY), spacing=(2.0, 2.0, spacing))
        tight = LabelMap(piece.grid, piece.values, labels.segments)
        assert flat_end_warnings(find_organs(tight)[0]) == ()

    def test_a_label_of_two_planes(self):
        """As flat as can be, and no error."""
        _, piece = labelled((1, KIDNEY), spacing=(2.5, 2.5, 30.0), low=(30, -10, -15.0), high=(90, 50, 14.0))
        assert len(flat_end_warnings(piece)) == 2
