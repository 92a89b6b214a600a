"""What was in the picture, against closed forms of slabs, sectors and balls."""

import numpy as np
import pytest
import trimesh
from conftest import rotation_about

from ultrasound.coverage import GRID_POINTS, VOXEL_MM, Coverage, _scanlines_of
from ultrasound.probe import load_probe

pytestmark = pytest.mark.usefixtures("one_device")

R = 20.0
# u along x, v along -z, the thickness along y.
UPRIGHT = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]]).T
PROBE = load_probe("linear").model_copy(update=dict(transducer_width_mm=40.0, depth_mm=50.0))


def big_ball(radius: float = R, at=(0, 0, 0), subdivisions: int = 3) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius).apply_translation(at)


def places(probe, axes: np.ndarray, origin) -> np.ndarray:
    """Rest places of a picture that is mapped by u, v, w -> axes @ (u, v, w) + origin."""
    width, depth, above = probe.extent_mm
    u, v = np.meshgrid(
        np.linspace(-width / 2, width / 2, GRID_POINTS), np.linspace(-above, depth - above, GRID_POINTS)
    )
    return (np.stack([u, v, 0 * u], axis=-1) @ axes.T + origin).astype(np.float32)


def centres(coverage: Coverage) -> np.ndarray:
    return coverage.origin_mm + VOXEL_MM * np.moveaxis(np.indices(coverage.seen.shape), 0, -1)


def on_picture(coverage: Coverage, axes: np.ndarray, origin) -> np.ndarray:
    """Where the voxels' middles are on the picture: u, v as it lies, and how far out of it at rest [mm]."""
    at = (centres(coverage) - origin) @ np.linalg.inv(axes).T
    normal = np.cross(axes[:, 0], axes[:, 1])
    at[..., 2] = (centres(coverage) - origin) @ normal / np.linalg.norm(normal)
    return np.moveaxis(at, -1, 0)


@pytest.fixture(scope="module")
def organ(one_device) -> Coverage:
    return Coverage(big_ball())


@pytest.mark.parametrize(
    "axes",
    [
        UPRIGHT,
        rotation_about([1, 2, 3], 70),
        rotation_about([3, 1, -1], 130) @ np.diag([1.1, 0.9, 0.95]),
        rotation_about([0, 1, 1], 200) + 0.1 * np.eye(3)[[1, 2, 0]],
    ],
    ids=["upright", "turned", "stretched", "sheared"],
)
@pytest.mark.parametrize("thickness", [1.5, 2.5, 5.0])
def test_a_plane_shows_a_slab_of_its_thickness(organ, axes, thickness):
    origin = axes @ [3, -24, 4]
    probe = PROBE.model_copy(update=dict(elevation_width_mm=thickness))
    organ.clear()
    assert organ.add(places(probe, axes, origin), probe, None).all()
    u, v, off = on_picture(organ, axes, origin)
    # No voxel is seen whose own half extent does not reach the slab.
    normal = np.cross(axes[:, 0], axes[:, 1])
    normal /= np.linalg.norm(normal)
    reach = VOXEL_MM / 2 * np.abs(normal).sum()
    edge = 0.3 + VOXEL_MM * np.sqrt(3) / 2 * np.linalg.norm(np.linalg.inv(axes), 2)
    aside = np.maximum(np.abs(u) - 20, np.abs(v - 25) - 25)
    assert not organ.seen[(np.abs(off) > thickness / 2 + reach) | (aside > edge)].any()
    # A middle in the slab is half a step of the parts from one of theirs, along each axis: nearer than half a
    # voxel.
    parts = np.ceil(thickness / VOXEL_MM)
    steps = [
        *np.linalg.norm(axes[:, :2], axis=0) * [40 / (GRID_POINTS - 1), 50 / (GRID_POINTS - 1)],
        thickness / parts,
    ]
    inside = (np.abs(off) <= thickness / 2) & (aside < -1)
    if np.linalg.norm(steps) <= VOXEL_MM:
        assert organ.seen[inside].all()
    assert organ.seen[inside].mean() > 0.97


def slab(thickness: float, height: float) -> float:
    """Volume [mm^3] of the ball between two planes."""
    z = height + np.array([-0.5, 0.5]) * thickness
    return float(np.pi * np.diff(R**2 * z - z**3 / 3)[0])


@pytest.mark.parametrize("thickness", [0.5, 1.5, 2.5, 5.0])
def test_on_average_a_plane_along_the_voxels_is_as_thick_as_it_is(organ, thickness):
    probe = PROBE.model_copy(update=dict(elevation_width_mm=thickness))
    volumes = []
    for y in (np.arange(12) + 0.5) / 12 * VOXEL_MM:
        organ.clear()
        organ.add(places(probe, UPRIGHT, (0, y, 22)), probe, None)
        volumes.append((organ.seen & organ.targets["organ"]).sum() * VOXEL_MM**3)
    # Parts of equal thickness, each in the voxel of its middle; one voxel at least. Facets take 1.2 %, and
    # counting.
    parts = np.ceil(thickness / VOXEL_MM)
    assert np.mean(volumes) == pytest.approx(slab(thickness - thickness / parts + VOXEL_MM, 0.0), rel=0.02)


@pytest.mark.parametrize("shift", [0.0, 5.0, -8.0])
def test_scanlines_without_contact_add_nothing(organ, shift):
    organ.clear()
    touches = organ.add(places(PROBE, UPRIGHT, (shift, 0, R)), PROBE, 1.5)
    x = PROBE.elements()[:, 0] + shift
    # The face lies in a tangent plane: an element at x is hypot(x, R) - R from the ball. That is known to
    # what facets
    # (0.4 % of the radius) and voxels (VOXEL^2 / 8 of the curvatures 2 / R) leave, at the nearest of places
    # 0.42 mm apart.
    gap = np.hypot(x, R) - R
    known = np.abs(gap - 1.5) > 0.004 * R + VOXEL_MM**2 / 8 * 2 / R + 0.21
    assert known.mean() > 0.8
    assert np.array_equal(touches[known], gap[known] <= 1.5)
    u = on_picture(organ, UPRIGHT, (shift, 0, R))[0]
    seen = u[organ.seen]
    first, last = np.flatnonzero(touches)[[0, -1]]
    edges = PROBE.elements()[[first, last], 0]
    # Half a voxel and half a line's place.
    assert seen.min() == pytest.approx(edges[0], abs=VOXEL_MM / 2 + 0.42)
    assert seen.max() == pytest.approx(edges[1], abs=VOXEL_MM / 2 + 0.42)


def test_the_first_and_last_places_stand_for_as_much_as_the_others(organ):
    probe, count = PROBE.model_copy(update=dict(transducer_width_mm=36.0, depth_mm=36.0)), 8
    organ.clear()
    few = np.linspace(0, GRID_POINTS - 1, count).astype(int)
    organ.add(places(probe, UPRIGHT, (0, 0, 18))[np.ix_(few, few)], probe, None)
    u, v, _ = on_picture(organ, UPRIGHT, (0, 0, 18))
    # Half a place beyond the ends, less half of a part: of those there is one a voxel where tissue is
    # squeezed by 0.7.
    spacing = 36.0 / (count - 1)
    beyond = spacing / 2 * (1 - 1 / np.ceil(spacing / 0.7 / VOXEL_MM))
    ends = [u[organ.seen].min() + 18, v[organ.seen].min(), v[organ.seen].max() - 36]
    # A voxel is seen from any place in it; steps of 13 or 14 of the 95 are off by 3 % of half a place.
    assert ends == pytest.approx([-beyond, -beyond, beyond], abs=VOXEL_MM / 2 + 0.1)


@pytest.mark.parametrize("lines", [127, 128])
def test_the_columns_of_places_are_together_as_wide_as_the_picture(lines):
    """Each stands for what is half a step to either side of it: of as many as there are, one too many."""
    probe = PROBE.model_copy(update=dict(number_of_scanlines=lines))
    assert _scanlines_of(probe, GRID_POINTS)[1].all(axis=0).sum() == GRID_POINTS - 1


def test_off_the_organ_nothing_is_seen(organ):
    organ.clear()
    assert not organ.add(places(PROBE, UPRIGHT, (0, 0, R + 3)), PROBE, 1.5).any()
    assert not organ.seen.any() and organ.fraction("organ") == 0


@pytest.mark.parametrize(
    "name, middle", [("curvilinear", (50, 60)), ("curvilinear", (-5, 115)), ("phased", (-45, 70))]
)
def test_a_sector_shows_all_of_itself_and_nothing_beside(name, middle):
    probe = load_probe(name)
    # The ball lies across the sector's edge, or across its end.
    coverage, origin = Coverage(big_ball()), np.array([-middle[0], 0, middle[1]])
    coverage.add(places(probe, UPRIGHT, origin), probe, None)
    u, v, off = on_picture(coverage, UPRIGHT, origin)
    angle, along = np.arctan2(u, v + probe.radius_mm), np.hypot(u, v + probe.radius_mm) - probe.radius_mm
    start, stop = np.radians([probe.theta_start_deg, probe.theta_stop_deg])
    edge = np.minimum(angle - start, stop - angle) * (along + probe.radius_mm)
    inside = np.minimum(edge, np.minimum(along, probe.depth_mm - along))
    # A place stands for half of its cell, 1.9 x 1.4 mm at most, a voxel for half of its own.
    slack = np.hypot(0.95, 0.7) + VOXEL_MM / np.sqrt(2)
    assert (inside[coverage.targets["organ"]] < -slack).any()
    assert not coverage.seen[inside < -slack].any()
    # The picture lies along the voxels, whose rows all must be met.
    assert coverage.seen[(inside > slack) & (np.abs(off) <= probe.elevation_width_mm / 2)].all()
    assert coverage.seen.sum() > 500


@pytest.mark.parametrize("squeezed", [1.0, 0.75])
def test_compressed_tissue_leaves_no_voxel_between_two_points(squeezed):
    probe = load_probe("curvilinear")
    coverage, axes, origin = Coverage(big_ball()), UPRIGHT / squeezed, np.array([0.0, 0, 60 / squeezed])
    coverage.add(places(probe, axes, origin), probe, None)
    off = on_picture(coverage, axes, origin)[2]
    assert coverage.seen[coverage.targets["organ"] & (np.abs(off) <= probe.elevation_width_mm / 2)].all()


def sweep(coverage: Coverage, first: float, last: float) -> None:
    """Show all between two planes across x."""
    probe = PROBE.model_copy(update=dict(transducer_width_mm=50.0, elevation_width_mm=2.0))
    axes = rotation_about([0, 0, 1], 90) @ UPRIGHT
    for x in np.arange(first + 1, last - 0.9, 1.0):
        coverage.add(places(probe, axes, (x, 0, 25)), probe, None)


def cap(height: float) -> float:
    """Volume [ml] of a cap of the ball."""
    return np.pi * height**2 * (3 * R - height) / 3 / 1000


@pytest.mark.parametrize("first, last", [(-25, 0), (-4, 8), (5, 25)])
def test_what_was_not_imaged_is_the_gap(organ, first, last):
    organ.clear()
    sweep(organ, first, last)
    caps = sorted([cap(R + x) for x in (first, -last) if R + x > 0], reverse=True)
    sides = {first: -1, last: 1}
    gaps = organ.gaps("organ")
    assert len(gaps) == len(caps)
    for gap, volume in zip(gaps, caps, strict=True):
        edge = first if np.isclose(volume, cap(R + first)) and first > -R else last
        # The edge lies half a voxel off at most; facets take 1.2 % of a volume.
        off = VOXEL_MM / 2 * np.pi * (R**2 - edge**2) / 1000
        assert gap.volume_ml == pytest.approx(volume, abs=off + 0.012 * volume)
        # The largest ball in a cap has its height across; of layers, a voxel more or less, the even number at
        # or above is reported.
        height = R - sides[edge] * edge
        assert height - VOXEL_MM <= gap.thickness_mm <= height + 2 * VOXEL_MM
    missing = sum(caps) / (4 / 3 * np.pi * R**3 / 1000)
    assert organ.fraction("organ") == pytest.approx(
        1 - missing, abs=VOXEL_MM / 2 * 0.75 / R * len(caps) + 0.01
    )


def test_coverage_accumulates_and_can_be_cleared(organ):
    organ.clear()
    sweep(organ, -10, 0)
    once = organ.seen.copy()
    sweep(organ, 5, 12)
    assert organ.seen[once].all()
    assert organ.is_seen(np.array([[-5.0, 3, 4], [2.5, 3, 4], [8, -2, 1], [16, 0, 0]])).tolist() == [
        1,
        0,
        1,
        0,
    ]
    off = np.random.default_rng(3).uniform(-0.49, 0.49, (*organ.seen.shape, 3)) * VOXEL_MM
    assert np.array_equal(organ.is_seen((centres(organ) + off).reshape(-1, 3)), organ.seen.ravel())
    assert len(organ.gaps("organ")) == 3
    organ.clear()
    assert organ.fraction("organ") == 0 and not organ.is_seen(np.zeros((1, 3))).any()
    assert np.isnan(organ.fraction("tumour"))


def lens(a: float, b: float, d: float) -> float:
    """Volume [ml] that two balls of radii share whose middles are so far apart."""
    if d <= abs(a - b):
        return 4 / 3 * np.pi * min(a, b) ** 3 / 1000
    return np.pi * (a + b - d) ** 2 * (d**2 + 2 * d * (a + b) - 3 * (a - b) ** 2) / (12 * d) / 1000


@pytest.mark.parametrize("away", [0.0, 12.0, 18.0])
@pytest.mark.parametrize("margin", [5.0, 8.0])
def test_the_margin_is_the_organ_around_the_tumour_and_the_tumour(away, margin):
    direction = np.array([2, -1, 2]) / 3
    coverage = Coverage(big_ball(), big_ball(6.0, away * direction), margin)
    volume = {name: mask.sum() * VOXEL_MM**3 / 1000 for name, mask in coverage.targets.items()}
    tumour = 4 / 3 * np.pi * 6**3 / 1000
    # Facets take 1.2 % of a volume, and a sphere through 268 voxels counts them to a few of a hundred.
    assert volume["tumour"] == pytest.approx(tumour, rel=0.04)
    around = lens(R, 6 + margin, away) + tumour - lens(R, 6, away)
    assert volume["margin"] == pytest.approx(around, rel=0.025)
    assert volume["organ"] == pytest.approx(4 / 3 * np.pi * R**3 / 1000, rel=0.015)
    at = centres(coverage)[coverage.targets["tumour"]].mean(axis=0)
    assert at == pytest.approx(away * direction, abs=0.1)
    # What is sunk in the organ is in its distances too; what is swept of both is told apart.
    sweep(coverage, away * direction[0] - 25, away * direction[0])
    assert coverage.fraction("tumour") == pytest.approx(0.5, abs=VOXEL_MM / 2 * 0.75 / 6 + 0.02)
