"""Contours of a structure set: what stands twice counts once, strokes are united, and planes without a
contour are interpolated, or refused.
"""

import numpy as np
import pytest
from dicom_series import Series, refusal, write_structures
from scipy import ndimage

from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_files import open_labels
from scenes.volumes.voxel_grid import VoxelGrid

PIXEL_MM = 1.0
CENTRE = np.array([40.3, 30.6])


def grid_of(gap, planes=60):
    return VoxelGrid((90, 70, planes), np.array([PIXEL_MM, PIXEL_MM, gap]), np.zeros(3), np.eye(3))


def loop(z, radius, centre=CENTRE, points=90):
    """A circle in the plane z [mm]."""
    turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
    return np.column_stack(
        [centre[0] + radius * np.cos(turn), centre[1] + radius * np.sin(turn), np.full(points, z)]
    )


def box(z, low, high):
    (x, y), (right, down) = low, high
    return np.array([[x, y, z], [right, y, z], [right, down, z], [x, down, z]], float)


def ball(heights, middle, radius, centre=CENTRE):
    """Contours of a ball in the planes at some heights [mm] that cut it."""
    radii = [np.sqrt(max(0.0, radius**2 - (z - middle) ** 2)) for z in heights]
    return [loop(z, r, centre) for z, r in zip(heights, radii, strict=True) if r > 0.3]


def spheroid(heights, middle, width, length):
    """Contours of an upright spheroid of half-axes ``width`` and ``length``."""
    shares = [1 - ((z - middle) / length) ** 2 for z in heights]
    return [loop(z, width * np.sqrt(s)) for z, s in zip(heights, shares, strict=True) if s > 0.005]


def read(path, grid, regions, **options):
    """The label maps of regions, in their order, and all notes."""
    drawing = open_labels(write_structures(path / "rt.dcm", regions, **options))
    maps = drawing.maps(grid)
    return maps, [*drawing.notes, *(line for one in maps for line in (*one.notes, *one.warnings))]


def single(path, grid, contours, name="Kidney", **options):
    (one,), notes = read(path, grid, {name: contours}, **options)
    return one, notes


def millilitres(one):
    return one.values.sum() * one.grid.voxel_ml


def on_planes(one, grid):
    """Pixels of each of the CT's planes; the map's planes are among them."""
    first, step = one.grid.index(grid.origin)[2], one.grid.spacing[2] / grid.spacing[2]
    counts = np.zeros(grid.size[2], int)
    at = np.rint((np.arange(one.grid.size[2]) * step) - first * step).astype(int)
    counts[at] = one.values.sum(axis=(1, 2))
    return counts


def planes_of(one, grid):
    return np.flatnonzero(on_planes(one, grid)).tolist()


BALL = ball(3.0 * np.arange(60), 80.0, 20.0)
COPIES = {
    "identical": lambda c: c,
    "shifted by 0.01 mm": lambda c: c + [0.01, -0.01, 0],
    "in another plane by 0.01 mm": lambda c: c + [0, 0, 0.01],
    "other way round": lambda c: c[::-1],
    "other start": lambda c: np.roll(c, 17, axis=0),
    "one point more": lambda c: np.insert(c, 5, c[4:6].mean(axis=0), axis=0),
    "one point less": lambda c: np.delete(c, 7, axis=0),
    "closed again": lambda c: np.concatenate([c, c[:1]]),
}


# One outline as planning systems write it.
SHUFFLED = np.random.default_rng(1).permutation(len(BALL))
OUTLINES = {
    "each point twice": [np.repeat(np.vstack([c, c[:1]]), 2, axis=0) for c in BALL],
    "any order and direction": [BALL[n][:: 1 - 2 * (n % 2)] for n in SHUFFLED],
    "clicks of one to three points": [
        *BALL,
        *(c[:1] for c in BALL),
        *(c[:2] for c in BALL),
        BALL[5][[0, 3, 0]],
    ],
    "a misplaced point": [c[[*range(40), 41, 40, *range(42, 90)]] for c in BALL],
}


@pytest.mark.parametrize("outline", OUTLINES)
def test_writers_of_one_outline(tmp_path, outline):
    plain, _ = single(tmp_path, grid_of(3.0), BALL)
    one, notes = single(tmp_path, grid_of(3.0), OUTLINES[outline])
    assert notes == [] and millilitres(one) == pytest.approx(millilitres(plain), rel=1e-3)


class TestCopies:
    @pytest.mark.parametrize("copy", COPIES)
    @pytest.mark.parametrize(("radius", "often"), [(20.0, 1), (5.0, 2)])
    def test_count_once(self, tmp_path, copy, radius, often):
        grid = grid_of(3.0)
        contours = [loop(3.0 * k, radius) for k in range(3, 9)]
        plain, notes = single(tmp_path, grid, contours)
        assert notes == []
        twice = [COPIES[copy](c) for c in contours[1:4]] * often
        one, notes = single(tmp_path, grid, contours + twice)
        assert notes == [f"region 1: contours that stand twice in a plane, counted once: {3 * often}"]
        assert millilitres(one) == pytest.approx(millilitres(plain), rel=2e-3)
        assert ndimage.label(one.values)[1] == 1

    @pytest.mark.parametrize(
        ("name", "kind"), [("aorta", "CLOSED_PLANAR"), ("aorta", "CLOSEDPLANAR_XOR"),
        ("Kidney", "CLOSEDPLANAR_XOR")]
    )  # fmt: skip
    @pytest.mark.parametrize(
        ("radius", "inner", "aside"), [(20.0, 10.0, 0.0), (20.0, 19.2, 0.0), (20.0, 19.0, 0.9), (2.5, 1.5, 0)]
    )
    def test_a_hole_is_no_copy(self, tmp_path, name, kind, radius, inner, aside):
        """Not in a wall of a pixel, nor where it is thin on one side alone; of an organ, where the file
        says so.
        """
        contours = [
            c
            for z in (6.0, 9.0)
            for c in (loop(z, radius, points=400), loop(z, inner, CENTRE + [aside, 0], 400))
        ]
        one, notes = single(tmp_path, grid_of(3.0), contours, name, kind=kind)
        assert notes == []
        expected = 6 * np.pi * (radius**2 - inner**2) / 1000
        assert millilitres(one) == pytest.approx(expected, rel=0.08)

    @pytest.mark.parametrize("wall", [0.1, 0.3])
    def test_no_wall_is_thinner_than_half_a_pixel(self, tmp_path, wall):
        contours = [c for z in (6.0, 9.0) for c in (loop(z, 15.0), loop(z, 15.0 - wall))]
        one, notes = single(tmp_path, grid_of(3.0), contours)
        assert notes == ["region 1: contours that stand twice in a plane, counted once: 2"]
        assert millilitres(one) == pytest.approx(6 * np.pi * 15**2 / 1000, rel=0.01)

    @pytest.mark.parametrize("width", [2.0, 6.0])
    def test_a_contour_with_a_bump_is_another(self, tmp_path, width):
        """Nearly the same outline, but for what the region is: only the bump."""
        low, high = (10.4, 10.4), (50.4, 50.4)
        bumpy = np.insert(
            box(6.0, low, high), 2, [[50.4, 20.4, 6], [50.4 + width, 20.4, 6], [50.4 + width, 26.4, 6],
            [50.4, 26.4, 6]], axis=0
        )  # fmt: skip
        contours = [c + [0, 0, z] for z in (0, 3.0) for c in (bumpy, box(6.0, low, high))]
        one, notes = single(tmp_path, grid_of(3.0), contours, "aorta")
        assert notes == [] and one.values.sum() == 2 * 6 * width


def moved(contours, mm):
    return [c + [mm, 0, 0] for c in contours]


def inset(contours, mm):
    """Circles with smaller radii."""
    middle = [*CENTRE, 0]
    radii = [np.linalg.norm((c - middle)[:, :2], axis=1)[0] for c in contours]
    return [loop(c[0, 2], r - mm) for c, r in zip(contours, radii, strict=True) if r > mm + 0.5]


# A second observer's contours.
OTHERS = {
    "moved by 0.4 mm": moved(BALL, 0.4),
    "moved by 2.4 mm": moved(BALL, 2.4),
    "moved by 4 mm": moved(BALL, 4.0),
    "2 mm inside": inset(BALL, 2.0),
    "10 % smaller": [c + 0.1 * ([*CENTRE, c[0, 2]] - c) for c in BALL],
    "by two more": inset(BALL, 1.5) + inset(BALL, 3.5),
}


class TestSolids:
    """An organ and its lesions are no thin shells: two observers' contours in one region."""

    @pytest.mark.parametrize("name", ["Kidney", "GTV", "cyst"])
    @pytest.mark.parametrize("other", OTHERS)
    def test_two_observers(self, tmp_path, name, other):
        plain, _ = single(tmp_path, grid_of(3.0), BALL, name)
        one, notes = single(tmp_path, grid_of(3.0), BALL + OTHERS[other], name)
        assert "counted once" in notes[0] and ("differ" in notes[0]) == (other != "moved by 0.4 mm")
        assert all(np.array_equal(ndimage.binary_fill_holes(p), p) for p in one.values)
        # Small sections at the ends, which share little, are united.
        assert millilitres(one) == pytest.approx(millilitres(plain), rel=0.05)

    @pytest.mark.parametrize("radius", [12.0, 25.0])
    @pytest.mark.parametrize("turn", [1, -1])
    def test_a_hole_of_half_the_area(self, tmp_path, radius, turn):
        """A wide sinus."""
        contours = [c for z in (6.0, 9.0) for c in (loop(z, radius), loop(z, radius * np.sqrt(0.5))[::turn])]
        one, notes = single(tmp_path, grid_of(3.0), contours)
        assert notes == []
        assert millilitres(one) == pytest.approx(6 * np.pi * radius**2 / 2 / 1000, rel=0.02)

    def test_shells_are_of_other_structures(self, tmp_path):
        """The wall of an aorta is one; what the user names as the patient's organ is none."""
        contours = BALL + inset(BALL, 2.0)
        wall, notes = single(tmp_path, grid_of(3.0), contours, "spleen")
        assert notes == []
        path = write_structures(tmp_path / "rt.dcm", {"spleen": contours})
        (solid,) = open_labels(path, wanted=["spleen"]).maps(grid_of(3.0))
        assert millilitres(wall) < 0.4 * millilitres(solid) and "differ" in solid.notes[0]

    @pytest.mark.parametrize("apart", [-0.5, 0.5, 2.0])
    def test_small_bodies_side_by_side(self, tmp_path, apart):
        """Two tumours, as large as two observers' contours are apart."""
        centres = CENTRE, CENTRE + [3.0 + apart, 0]
        contours = [loop(z, 1.5, centre) for z in (6.0, 9.0) for centre in centres]
        one, notes = single(tmp_path, grid_of(3.0), contours, "GTV")
        whole, _ = single(tmp_path, grid_of(3.0), [loop(z, 1.5) for z in (6.0, 9.0)], "GTV")
        assert not any("once" in note for note in notes) and one.values.sum() > 1.5 * whole.values.sum()


def row_of_boxes(count, overlap):
    """Boxes of 10 by 20 pixels beside each other, each ``overlap`` [pixels] over the next; at half pixels."""
    steps = (10 - overlap) * np.arange(count) + 10.5
    return [box(z, (x, 10.5), (x + 10, 30.5)) for z in (6.0, 9.0) for x in steps]


class TestStrokes:
    """Contours that cross are of one body."""

    @pytest.mark.parametrize("name", ["Kidney", "aorta"])
    @pytest.mark.parametrize(("count", "overlap"), [(2, 1), (2, 4), (3, 3), (4, 6)])
    def test_are_united(self, tmp_path, name, count, overlap):
        one, notes = single(tmp_path, grid_of(3.0), row_of_boxes(count, overlap), name)
        assert notes == [f"region 1: contours that overlap in a plane, united: {2 * count}"]
        assert one.values.all() and one.values.sum() == 2 * 20 * (10 * count - (count - 1) * overlap)

    @pytest.mark.parametrize("name", ["Kidney", "aorta"])
    def test_have_holes(self, tmp_path, name):
        """In one of them, in a larger body's hole, and a hole that is drawn a little beyond the edge."""
        strokes = row_of_boxes(3, 3)
        holes = [box(z, (12.5, 14.5), (15.5, 20.5)) for z in (6.0, 9.0)]
        one, _ = single(tmp_path, grid_of(3.0), strokes + holes, name)
        assert one.values.sum() == 2 * (20 * 24 - 3 * 6)
        around = [box(z, (5.5, 5.5), (45.5, 40.5)) for z in (6.0, 9.0)]
        one, _ = single(tmp_path, grid_of(3.0), strokes + around, name)
        assert one.values.sum() == 2 * (40 * 35 - 20 * 24)
        around = [box(z, (5.1, 5.5), (45.5, 40.5)) for z in (6.0, 9.0)]
        at_edge = [box(z, (4.9, 14.5), (15.5, 20.5)) for z in (6.0, 9.0)]
        one, notes = single(tmp_path, grid_of(3.0), around + at_edge, name)
        assert one.values.sum() == 2 * (40 * 35 - 10 * 6 + 6) and notes == []


ROUNDS = {
    "twice": lambda c: np.vstack([c, c]),
    "twice, closed": lambda c: np.vstack([c, c[:1], c, c[:1]]),
    "coarser": lambda c: np.vstack([c, c[::2]]),
    "moved a little": lambda c: np.vstack([c, c + [0.1, 0, 0]]),
    "four times": lambda c: np.vstack([c, c, c, c]),
}


@pytest.mark.parametrize("name", ["Kidney", "aorta"])
@pytest.mark.parametrize("rounds", ROUNDS)
@pytest.mark.parametrize("radius", [2.0, 20.0])
def test_contours_that_go_round_twice(tmp_path, name, rounds, radius):
    contours = [loop(3.0 * k, radius) for k in range(3, 9)]
    plain, _ = single(tmp_path, grid_of(3.0), contours, name)
    one, notes = single(tmp_path, grid_of(3.0), [ROUNDS[rounds](c) for c in contours], name)
    assert notes == ["region 1: contours that stand twice in a plane, counted once: 6"]
    assert np.array_equal(one.values, plain.values)


class TestWithoutAPixel:
    """A region that is smaller than a pixel."""

    @pytest.mark.parametrize("heights", [(6.0,), (6.0, 9.0), (6.0, 7.1, 12.4)])
    @pytest.mark.parametrize("name", ["GTV", "cyst"])
    def test_of_an_organ_is_marked(self, tmp_path, heights, name):
        contours = [loop(z, 0.3, [40.4, 30.6]) for z in heights]
        one, _ = single(tmp_path, grid_of(3.0), contours, name)
        assert any(f"“{name}” is smaller than a pixel" in line for line in one.warnings)
        places = one.grid.place(np.argwhere(one.values)[:, ::-1])
        assert np.abs(places[:, :2] - [40, 31]).max() < 1e-6
        assert {min(heights, key=lambda z, at=at: abs(z - at)) for at in places[:, 2]} == set(heights)

    def test_of_the_user_is_marked(self, tmp_path):
        """What the user names; of other structures, nothing is left."""
        regions = {"Kidney": BALL, "aorta": [loop(60.0, 0.3, [40.4, 30.6])]}
        path = write_structures(tmp_path / "rt.dcm", regions)
        assert len(open_labels(path).maps(grid_of(3.0))) == 1
        _, one = open_labels(path, wanted=["aorta"]).maps(grid_of(3.0))
        assert one.values.sum() == 1 and "“aorta” is smaller than a pixel" in one.warnings[0]

    def test_specks_beside_a_body(self, tmp_path):
        """A contour without a pixel is none of a region that has some."""
        one, notes = single(tmp_path, grid_of(3.0), [*BALL, loop(60.0, 0.3, [10.4, 10.6])])
        plain, _ = single(tmp_path, grid_of(3.0), BALL)
        assert one.values.sum() == plain.values.sum() and notes == []


class TestOnPixels:
    """Corners and edges on the centres of pixels."""

    @pytest.mark.parametrize("turned", [False, True])
    @pytest.mark.parametrize("more", [0, 3])
    def test_neighbours_leave_no_slit(self, tmp_path, turned, more):
        """A shared edge, also one that only one of them has more corners on."""
        one, other = box(6.0, (10, 10), (20, 30)), box(6.0, (20, 10), (33, 30))
        along = np.linspace(30, 10, more + 2)[1:-1]
        one = np.insert(one, 2, np.column_stack([np.full(more, 20), along[::-1], np.full(more, 6)]), axis=0)
        contours = [one, other]
        if turned:
            contours = [c[:, [1, 0, 2]] for c in contours]
        filled, notes = single(tmp_path, grid_of(3.0), contours)
        assert filled.values.sum() == 24 * 21 and filled.values.all(axis=(1, 2)).any() and notes == []

    @pytest.mark.parametrize(("start", "end"), [((20, 25), (10, 25)), ((20, 22), (10, 13))])
    def test_keyhole(self, tmp_path, start, end):
        """A channel to the hole, along pixels or across them: no pixel of it is lost."""
        x, y = start
        hole = [[x, y], [20, 20], [30, 20], [30, 30], [20, 30], [x, y]]
        outer = [list(end), [10, 10], [40, 10], [40, 40], [10, 40], list(end)]
        corners = np.array([[*p, 6.0] for p in outer + hole[:1] + hole[1:]], float)
        filled, _ = single(tmp_path, grid_of(3.0), [corners])
        expected = np.ones((31, 31), int)
        expected[11:20, 11:20] = 0  # between the hole's edges, which are of the region
        assert np.array_equal(filled.values[0], expected)

    @pytest.mark.parametrize("kind", ["CLOSED_PLANAR", "CLOSEDPLANAR_XOR"])
    def test_body_in_a_hole(self, tmp_path, kind):
        contours = [box(6.0, (n + 0.5, n + 0.5), (60.5 - n, 60.5 - n)) for n in (0, 10, 20)]
        filled, _ = single(tmp_path, grid_of(3.0), contours, kind=kind)
        assert filled.values.sum() == 60**2 - 40**2 + 20**2


class TestTypes:
    @pytest.mark.parametrize(
        "kind",
        [
            "INTERPOLATED_PLANAR",
            "interpolated_planar",
            "CLOSED_PLANAR ",
            " closed_planar",
            "Closedplanar_xor",
        ],
    )
    def test_closed(self, tmp_path, kind):
        one, _ = single(tmp_path, grid_of(3.0), [loop(6.0, 9.0), loop(9.0, 9.0)], kind=kind)
        assert one.values.any(axis=(1, 2)).sum() == 2

    @pytest.mark.parametrize("kind", ["POINT", "OPEN_PLANAR"])
    def test_without_a_closed_contour(self, tmp_path, kind):
        def edit(data):
            for contour in data.ROIContourSequence[1].ContourSequence:
                contour.ContourGeometricType = kind

        contours = [loop(6.0, 9.0), loop(9.0, 9.0)]
        maps, notes = read(tmp_path, grid_of(3.0), {"Kidney": contours, "aorta": contours}, edit=edit)
        assert len(maps) == 1 and notes == ["without a closed contour, so not read: 2 “aorta”"]


class TestGaps:
    @pytest.mark.parametrize("slice_mm", [1.25, 3.0])
    @pytest.mark.parametrize(
        "kept",
        [
            [*range(8, 41), 42, 44, 48],
            [*range(14, 41), 42, 44, 46, 48],
            [8, 12, 14, 16, *range(17, 49)],
            [*range(8, 24), *range(24, 49, 2)],
        ],
    )
    def test_contours_that_thin_out(self, tmp_path, slice_mm, kept):
        grid = grid_of(slice_mm)
        heights = slice_mm * np.array(kept)
        middle, length = 28.3 * slice_mm, 21.5 * slice_mm
        one, (note,) = single(tmp_path, grid, spheroid(heights, middle, 22.0, length))
        assert note.startswith("region 1: ")
        all_heights = slice_mm * np.arange(kept[0], kept[-1] + 1)
        whole, _ = single(tmp_path, grid, spheroid(all_heights, middle, 22.0, length))
        assert ndimage.label(one.values)[1] == 1
        assert planes_of(one, grid) == list(range(kept[0], kept[-1] + 1))
        # Signed distances are interpolated linearly: the convex sections between become smaller by this at
        # most.
        assert millilitres(one) == pytest.approx(millilitres(whole), rel=0.01)

    @pytest.mark.parametrize(("slice_mm", "missing"), [(3.0, 11), (1.25, 30)])
    def test_a_slice_that_nobody_contoured(self, tmp_path, slice_mm, missing):
        grid = grid_of(slice_mm)
        heights = slice_mm * np.delete(np.arange(5, 50), missing - 5)
        one, notes = single(tmp_path, grid, spheroid(heights, 27.2 * slice_mm, 20.0, 23 * slice_mm))
        assert notes == [
            "region 1: slices without a contour, interpolated between their neighbours, at z "
            f"{missing * slice_mm:.1f} mm"
        ]
        counts = on_planes(one, grid)
        assert counts[missing] == pytest.approx((counts[missing - 1] + counts[missing + 1]) / 2, rel=0.02)

    @pytest.mark.parametrize(
        ("slice_mm", "radius", "apart"),
        [(3.0, 8.0, 12.0), (3.0, 5.0, 18.0), (1.25, 8.0, 5.0), (1.0, 15.0, 6.0), (2.5, 10.0, 40.0)],
    )
    @pytest.mark.parametrize("aside", [0.0, 3.0])
    def test_two_bodies_above_each_other(self, tmp_path, slice_mm, radius, apart, aside):
        """The distance of their surfaces; nothing is between them, and nothing is said."""
        grid = grid_of(slice_mm, 100)
        heights = slice_mm * np.arange(100)
        middles = 20.3, 20.3 + 2 * radius + apart
        contours = ball(heights, middles[0], radius) + ball(heights, middles[1], radius, CENTRE + [aside, 0])
        one, notes = single(tmp_path, grid, contours, name="GTV")
        drawn = sorted({round(c[0, 2] / slice_mm) for c in contours})
        assert planes_of(one, grid) == drawn and notes == []
        assert ndimage.label(one.values)[1] == 2

    @pytest.mark.parametrize("slice_mm", [2.5, 5.0])
    def test_a_gap_too_wide(self, tmp_path, slice_mm):
        """In the middle of an organ: refused; of another structure: left empty, and named."""
        grid = grid_of(slice_mm)
        heights = np.array([z for z in slice_mm * np.arange(2, 42) if not 41 < z < 59])
        contours = spheroid(heights, 21 * slice_mm, 25.0, 20.5 * slice_mm)
        message = refusal(
            write_structures(tmp_path / "rt.dcm", {"Kidney": contours}),
            read=lambda path: open_labels(path).maps(grid),
        )
        assert (
            "region 1 “Kidney” has no contour between z 40.0 and z 60.0 mm" in message and "15 mm" in message
        )
        one, notes = single(tmp_path, grid, contours, name="spleen")
        assert notes == [
            "region 1: a gap too wide to interpolate was left empty, between z 40.0 and z 60.0 mm"
        ]
        assert ndimage.label(one.values)[1] == 2
        named = open_labels(tmp_path / "rt.dcm", wanted=["spleen"])
        assert "too wide" not in str(notes[1:]) and named.empty == ()
        refusal(
            tmp_path / "rt.dcm",
            read=lambda path: open_labels(path, wanted=["spleen"]).maps(grid),
        )

    @pytest.mark.parametrize("step", [2, 3])
    def test_contours_on_every_second_slice(self, tmp_path, step):
        """Even planes stay as they are drawn, as thick as their distance; what lacks among them is
        interpolated.
        """
        grid = grid_of(2.5)
        kept = np.arange(6, 48, step)
        contours = spheroid(2.5 * kept, 67.0, 20.0, 50.0)
        one, notes = single(tmp_path, grid, contours)
        assert one.grid.spacing[2] == pytest.approx(2.5 * step) and notes == []
        lacking, notes = single(tmp_path, grid, contours[:5] + contours[6:])
        assert f"at z {contours[5][0, 2]:.1f} mm" in notes[0]
        assert one.grid.size == lacking.grid.size
        assert millilitres(lacking) == pytest.approx(millilitres(one), rel=5e-3)


class TestPlanes:
    """Contours at the slices of a CT that are not exactly on its planes."""

    MIDDLE, WIDTH, LENGTH = 55.0, 22.0, 45.0
    ML = 4 / 3 * np.pi * 22.0**2 * 45.0 / 1000

    @pytest.mark.parametrize(("gap", "digits"), [(0.625, 1), (0.67, 1), (1.25, 1), (0.625, 2), (0.4883, 3)])
    def test_rounded_positions(self, tmp_path, gap, digits):
        """The CT's grid is even: positions are off by half of the last digit."""
        n = int(110 / gap)
        positions = np.round(gap * np.arange(n), digits)
        grid = VoxelGrid((90, 70, n), np.array([1.0, 1.0, positions[-1] / (n - 1)]), np.zeros(3), np.eye(3))
        one, notes = single(tmp_path, grid, spheroid(positions, self.MIDDLE, self.WIDTH, self.LENGTH))
        assert notes == [] and ndimage.label(one.values)[1] == 1
        assert millilitres(one) == pytest.approx(self.ML, rel=0.01)

    @pytest.mark.parametrize("gaps", [(5.0, 7.0), (2.0, 2.5, 3.0)])
    def test_a_resampled_ct(self, tmp_path, gaps):
        """Its slices are unevenly spaced: contours stand at them, not at the planes of its grid."""
        positions = np.concatenate([[0.0], np.cumsum(np.resize(gaps, int(112 / np.mean(gaps))))])
        series = Series(
            tmp_path / "ct",
            np.eye(3),
            size=(90, 70, len(positions)),
            spacing=(1.0, 1.0),
            positions=lambda k: np.array([0, 0, positions[int(k)]]),
        )
        ct = open_ct(series.write())
        assert any("resampled" in note for note in ct.notes)
        contours = spheroid(positions, self.MIDDLE, self.WIDTH, self.LENGTH)
        one, (note,) = single(tmp_path, ct.grid, contours)
        assert "unevenly spaced" in note and ndimage.label(one.values)[1] == 1
        assert millilitres(one) == pytest.approx(self.ML, rel=0.02)
        inside = one.grid.index([[*CENTRE, self.MIDDLE]])[0] / one.grid.size
        assert np.abs(inside - 0.5).max() < 0.04

    @pytest.mark.parametrize("step", [0.37, 1.63])
    def test_planes_of_their_own(self, tmp_path, step):
        """Evenly spaced, between the CT's slices: they stay where they were drawn."""
        grid = grid_of(2.5)
        heights = 3.1 + 2.5 * step * np.arange(int(100 / step / 2.5))
        one, notes = single(tmp_path, grid, spheroid(heights, self.MIDDLE, self.WIDTH, self.LENGTH))
        assert notes == [] and one.grid.spacing[2] == pytest.approx(2.5 * step, abs=1e-4)
        assert millilitres(one) == pytest.approx(self.ML, rel=0.01)

    @pytest.mark.parametrize("at", [3.5, 3.3])
    def test_a_lone_contour_is_kept(self, tmp_path, at):
        """A small body in one contour, between planes and far from the others."""
        grid = grid_of(2.5)
        aside = loop(2.5 * (at + 20), 4.0, CENTRE + [25, 0])
        contours = [loop(2.5 * k, 9.0) for k in (3, 4, 5.5, 6.2, 8)]
        one, _ = single(tmp_path, grid, [*contours, aside])
        assert ndimage.label(one.values)[1] == 2


@pytest.mark.parametrize("names", [("Kidney", "Kidney"), ("GTV", "GTV")])
def test_regions_of_one_name(tmp_path, names):
    """Two observers: both are read, and their numbers tell them apart."""

    def edit(data):
        for roi, name in zip(data.StructureSetROISequence, names, strict=True):
            roi.ROIName = name

    regions = {f"{n}": [loop(z, 8.0 + n) for z in (6.0, 9.0)] for n in range(2)}
    maps, _ = read(tmp_path, grid_of(3.0), regions, edit=edit)
    (one,), (other,) = (list(m.segments.values()) for m in maps)
    assert (one.name, other.name) == names and (one.value, other.value) == (1, 2)
    assert millilitres(maps[0]) < millilitres(maps[1])
