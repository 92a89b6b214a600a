"""The default probe over a tumour of 28 mm, 4 mm under the surface of a convex organ."""

from math import sqrt

import numpy as np
import pytest
import trimesh

from sim.embedding import Unmoved
from sim.fields import array_of
from ultrasound.acoustics import acoustic_values
from ultrasound.probe import Probe, load_probe
from ultrasound.probe_manipulator import image_plane, pose_at
from ultrasound.scanned_anatomy import ScannedAnatomy
from ultrasound.scanner import B_MODE, Scanner
from ultrasound.sweep import PixelLabel

PROBE = load_probe("drop-in")
ORGAN_MM, TUMOUR_MM, DEPTH_MM = 30.0, 14.0, 4.0
# Of the tumour's middle above the organ's.
MIDDLE_MM = ORGAN_MM - DEPTH_MM - TUMOUR_MM
REACH, PIXELS = 40, 256


def anatomy() -> ScannedAnatomy:
    """A ball of kidney with a ball of tumour, in fat, in voxels of 1 mm."""
    at = np.moveaxis(np.indices([2 * REACH + 1] * 3), 0, -1) - REACH
    labels = (np.linalg.norm(at, axis=-1) < ORGAN_MM).astype(np.int16)
    labels[np.linalg.norm(at - [0, 0, MIDDLE_MM], axis=-1) < TUMOUR_MM] = 2
    index_from_mm = np.eye(4)
    index_from_mm[:3, 3] = REACH
    organ, tumour = (trimesh.creation.icosphere(4, radius) for radius in (ORGAN_MM, TUMOUR_MM))
    hu = np.array([-90, 32, 40], np.int16)[labels]
    tissues = {1: "kidney", 2: "tumour"}
    tumour.apply_translation([0, 0, MIDDLE_MM])
    return ScannedAnatomy(organ, hu, index_from_mm, labels, tissues, tumour)


def scanned(
    outside: str, gap_mm: float, probe: Probe = PROBE, above_mm: float = 0.0
) -> tuple[Scanner, np.ndarray]:
    """The scanner and its B-mode image, where the face is so far above the organ over the tumour."""
    scanner = Scanner(anatomy(), Unmoved(), probe, PIXELS, outside, contact_gap_mm=gap_mm)
    length = probe.housing_mm[2]
    pose = pose_at(np.array([0.0, 0.0, ORGAN_MM + above_mm]), [0, 0, -1.0], [1.0, 0, 0], length)
    plane = image_plane(pose, length, *probe.extent_mm)
    return scanner, scanner.images(plane, probe, "b-mode", "speckle", 350.0, 40.0).by_name[B_MODE]


@pytest.fixture(scope="module")
def wet(one_device) -> tuple[Scanner, np.ndarray]:
    return scanned("fluid", 8.0)


def test_the_array_is_on_the_flat_part_of_the_face():
    flat = np.array(PROBE.housing_mm[:2]) - 2 * PROBE.edge_radius_mm
    assert PROBE.array_width_mm <= flat[0] and PROBE.element_height_mm <= flat[1]


def test_housing_and_fin_pass_a_port_of_12_mm():
    """Its section is in the circle through the fin's corners and the rounded ones of the face."""
    (_, width, length), (_, fin, height), radius = PROBE.housing_mm, PROBE.fin_mm, PROBE.edge_radius_mm
    back = length + height
    # The middle of each rounded corner of the face, and the corners of the fin.
    aside, above = width / 2 - radius * (1 - sqrt(0.5)), radius * (1 - sqrt(0.5))
    centre = (back**2 + (fin / 2) ** 2 - aside**2 - above**2) / (2 * (back - above))
    assert 2 * np.hypot(fin / 2, back - centre) < 12.0 and np.hypot(width / 2, length - centre) < 6.0


def test_the_whole_tumour_is_in_the_image(wet):
    tumour = wet[0].ground_truth.render() == PixelLabel.TUMOUR
    rows, columns = np.nonzero(tumour)
    pixel = np.array([PROBE.depth_mm, PROBE.array_width_mm]) / PIXELS
    assert tumour.sum() * pixel.prod() == pytest.approx(np.pi * TUMOUR_MM**2, rel=0.02)
    # With 3 mm of what is beside it, and more of what is behind.
    assert min(columns.min(), PIXELS - 1 - columns.max()) * pixel[1] > 3.0
    assert rows.min() * pixel[0] == pytest.approx(DEPTH_MM, abs=0.5)
    assert (PIXELS - 1 - rows.max()) * pixel[0] > 10.0


def test_through_the_fluid_all_of_the_tumour_is_seen_without_pressing(wet):
    scanner, picture = wet
    tumour = scanner.ground_truth.render() == PixelLabel.TUMOUR
    dry, dark = scanned("background", 1.5)
    assert array_of(scanner.bmode.sound.contact).all()
    assert 0.3 < array_of(dry.bmode.sound.contact).mean() < 0.7
    sides = np.ptp(np.nonzero(tumour)[1]) // 8, np.nonzero(tumour)[1].min()
    left = np.s_[:, sides[1] : sides[1] + sides[0]]
    assert picture[left][tumour[left]].mean() > 3 * dark[left][tumour[left]].mean()
    assert picture[left][tumour[left]].mean() > 0.6 * picture[tumour].mean()


def test_the_fluid_is_black_and_the_organ_begins_with_a_bright_line(wet):
    _, picture = wet
    u = (np.arange(PIXELS) + 0.5) / PIXELS * PROBE.array_width_mm - PROBE.array_width_mm / 2
    surface = ORGAN_MM - np.sqrt(ORGAN_MM**2 - u**2)
    v = (np.arange(PIXELS) + 0.5)[:, None] / PIXELS * PROBE.depth_mm
    # Below the ringing of the array.
    fluid = (v > 1.5) & (v < surface - 1.0) & (np.abs(u) > 14)
    line = (np.abs(v - surface) < 0.6) & (np.abs(u) < 6) & (np.abs(u) > 3)
    organ = (v > surface + 1.5) & (v < surface + 6.0) & (np.abs(u) < 8)
    assert fluid.sum() > 100 and picture[fluid].mean() < 0.1 * picture[organ].mean()
    assert picture[line].max() > 2 * picture[organ].mean()


def test_the_highest_layer_is_fluid_from_the_face_on(one_device):
    sound = scanned("fluid", 10.0, above_mm=9.5)[0].bmode.sound
    middle = array_of(sound.tissue)[PROBE.number_of_scanlines // 2]
    depth = array_of(sound.depth)[PROBE.number_of_scanlines // 2]
    attenuation = middle[: np.argmax(depth > 9.0), 1]
    assert len(attenuation) > 10
    assert attenuation == pytest.approx(np.full(len(attenuation), acoustic_values("fluid")[1]))


def test_the_same_tissue_is_as_bright_as_under_the_micro_probe(wet):
    micro = load_probe("micro")
    means = []
    for probe, picture in ((PROBE, wet[1]), (micro, scanned("fluid", 8.0, micro)[1])):
        u = ((np.arange(PIXELS) + 0.5) / PIXELS - 0.5) * probe.array_width_mm
        v = (np.arange(PIXELS) + 0.5) / PIXELS * probe.depth_mm
        means.append([picture[np.ix_((v > a) & (v < a + 7), np.abs(u) < 4)].mean() for a in (6, 13, 20, 33)])
    # Speckle of 8 x 7 mm; in the depth the narrow array has the smaller aperture.
    assert means[0] == pytest.approx(means[1], rel=0.15) and min(means[0]) > 10
