"""Imports as they happen in the field, each with a known truth: right, or refused in words, and never wrong
without a word: sides exchanged, names, slices that nobody segmented, planes of contours.

What the readers make of contours, names and slices is tested by itself.
"""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_series import Series, write_structures
from raw_nrrd import with_segments
from synthetic_body import (
    BODY,
    DIRECTIONS,
    LEFT,
    RIGHT,
    TUMOUR,
    coarsely,
    grid_around,
    level,
    points_of,
    section,
    with_voxels,
)
from test_patient_space import nrrd

from errors import PatientError
from scenes.patient_space import signs_to_lps
from scenes.patients.import_request import import_request

SPINE = np.array([0.0, 75.0, 0.0]), np.array([24.0, 20.0, 400.0])
LIVER = np.array([-85.0, -25.0, 40.0]), np.array([60.0, 60.0, 75.0])
CYST = np.array([60.0, 50.0, -20.0]), np.array([12.0, 12.0, 12.0])
LOW, HIGH = (-172.0, -120.0, -72.0), (172.0, 120.0, 84.0)
ANATOMY = ((-100, BODY), (110, LIVER), (500, SPINE), (130, LEFT), (130, RIGHT), (70, TUMOUR), (10, CYST))
HEIGHTS = np.arange(-72.0, 85.0, 4.0)
# Of the kidney with its tumour in voxels of 4 mm.
ORGAN_ML, TUMOUR_ML = 96.6, 6.0


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    coarsely(monkeypatch)
    monkeypatch.setattr("scenes.patients.label_surfaces.CELL_MM", (4.0, 4.0))
    # What the organ rests on is no part of these cases.
    monkeypatch.setattr("scenes.patients.patient_import.mould", lambda organ, gravity: organ.bounding_box)


def hounsfield(places, anatomy=ANATOMY):
    values = np.full(places.shape[:-1], -1000.0)
    for value, solid in anatomy:
        values[level(places, solid) < 0] = value
    return values


def scan(spacing=(4.0, 4.0, 4.0), anatomy=ANATOMY, direction=DIRECTIONS["identity"]):
    empty = grid_around(LOW, HIGH, spacing, direction)
    return with_voxels(empty, hounsfield(points_of(empty), anatomy).astype(np.int16))


def inside(image, solid):
    return level(points_of(image), solid) < 0


def written(path: Path, image):
    sitk.WriteImage(image, str(path))
    return path


def valued(image, *masks):
    """A label map: the n-th mask has value n."""
    values = np.zeros(image.GetSize()[::-1], np.uint8)
    for value, mask in enumerate(masks, start=1):
        values[mask] = value
    return with_voxels(image, values)


def slicer(path: Path, image, named):
    """A .seg.nrrd of 3D Slicer: segments (name, mask), of which later ones cover earlier ones."""
    segments = [
        dict(Name=name, LabelValue=n, Layer=0, ID=f"Segment_{n}") for n, (name, _) in enumerate(named, 1)
    ]
    return written(path, with_segments(valued(image, *(mask for _, mask in named)), segments))


def stack(solid, heights=HEIGHTS):
    return [c for c in (section(solid, (0.0, 0.0, z)) for z in heights) if c is not None]


class Scan(Series):
    """A DICOM series of the body with pixels of 4 mm."""

    def __init__(self, folder, gap=4.0, direction=DIRECTIONS["identity"], **options):
        corners = np.array(np.meshgrid(*zip(LOW, HIGH, strict=True))).reshape(3, -1).T @ direction
        start = corners.min(axis=0)
        size = (np.ceil(np.ptp(corners, axis=0) / (4.0, 4.0, gap)).astype(int) + 1).tolist()
        origin = direction @ start
        options |= dict(field=hounsfield, spacing=(4.0, 4.0))
        super().__init__(folder, direction, size=size, gap=gap, origin=origin, **options)

    def contours(self, solid, edit=lambda corners: corners):
        at = [section(solid, self.positions(k), self.direction) for k in range(self.size[2])]
        return [edit(corners) for corners in at if corners is not None]


@pytest.fixture(scope="module")
def ct(tmp_path_factory):
    """The CT, and its file."""
    image = scan()
    return image, written(tmp_path_factory.mktemp("ct") / "ct.nrrd", image)


@pytest.fixture
def of_regions(ct, tmp_path):
    """Imports regions (name -> contours) of an RTSTRUCT."""

    def run(regions):
        return import_request(ct[1], [write_structures(tmp_path / "rs.dcm", regions)])

    return run


@pytest.fixture
def of_segments(ct, tmp_path):
    """Imports segments (name, mask or solid) of a .seg.nrrd."""

    def run(named, image=ct[0], ct_path=ct[1], **options):
        masks = [(name, inside(image, one) if isinstance(one, tuple) else one) for name, one in named]
        return import_request(ct_path, [slicer(tmp_path / "s.seg.nrrd", image, masks)], **options)

    return run


def words_of(run):
    """The patient, or None where it is refused, and what the import says."""
    try:
        patient = run()
    except PatientError as error:
        return None, str(error)
    return patient, "\n".join((*patient.notes, *patient.warnings))


def is_right(patient, organ_ml=ORGAN_ML, tumour_ml: float | None = TUMOUR_ML):
    """Whether organ, side and tumour are those of the body."""
    if patient is None or patient.side != "left" or abs(patient.volumes_ml["organ"] / organ_ml - 1) > 0.03:
        return False
    if tumour_ml is None:
        return True
    if patient.tumour is None or np.abs(patient.tumour.center_mass - TUMOUR[0]).max() > 1.5:
        return False
    return abs(patient.volumes_ml["tumour"] / tumour_ml - 1) < 0.12


def assert_right(patient, **truth):
    assert is_right(patient, **truth), (patient.side, patient.volumes_ml, patient.warnings)
    assert patient.warnings == ()


# 1. Sides exchanged.

KITS = dict(organ=["1", "2"], tissues={"tumour": ["3"]}, side="left")


def kits(image, flip=()):
    """Labels of both kidneys and the tumour; voxels turned around along some axes (z, y, x)."""
    labels = valued(image, *(inside(image, solid) for solid in (LEFT, RIGHT, TUMOUR)))
    return flipped(labels, flip)


def flipped(image, axes):
    return with_voxels(image, np.ascontiguousarray(np.flip(sitk.GetArrayFromImage(image), axes)))


@pytest.mark.parametrize(
    "axes, of_ct, word",
    [
        ((2,), True, "mirrored"),
        ((1, 2), True, "turned over"),
        ((0,), True, "upside down"),
        ((0,), False, "shifted, mirrored"),
        ((1,), False, "shifted, mirrored"),
        ((2,), False, "shifted, mirrored"),
    ],
    ids=str,
)
def test_a_header_that_lies(ct, tmp_path, axes, of_ct, word):
    """Voxels are turned around and the header is not: the anatomy objects.

    A liver shows also where the head is.
    """
    image = written(tmp_path / "ct.nrrd", flipped(ct[0], axes)) if of_ct else ct[1]
    labels = written(tmp_path / "labels.nrrd", kits(ct[0], axes))
    assert any(word in line for line in import_request(image, [labels], **KITS).warnings)


@pytest.mark.parametrize("space, word", [("LPS", ""), ("RPS", "mirrored"), ("LAS", "mirrored")])
def test_space_of_the_labels_alone(ct, tmp_path, space, word):
    """ImageJ writes labels without a space; the CT has one."""
    labels = nrrd(tmp_path / "labels.nrrd", kits(ct[0]), "space dimension: 3", np.ones(3))
    with pytest.raises(PatientError, match="--space"):
        import_request(ct[1], [labels], **KITS)
    patient = import_request(ct[1], [labels], space=space, **KITS)
    assert patient.space == space
    assert is_right(patient) and not patient.warnings if not word else word in patient.warnings[0]


def test_a_space_that_nrrd_does_not_have(ct, tmp_path):
    """A script wrote RPI; the file is whole, and copying it again does not help."""
    path = nrrd(tmp_path / "ct.nrrd", ct[0], "space: RPI", signs_to_lps("RPI"))
    with pytest.raises(PatientError, match="its field space is 'RPI', which NRRD does not have"):
        import_request(path, [written(tmp_path / "labels.nrrd", kits(ct[0]))], **KITS)


LARGE = np.array([95.0, -15.0, 10.0]), np.full(3, 60.0)
SPLEEN = np.array([95.0, 0.0, 50.0]), np.array([50.0, 60.0, 70.0])
FEW_LIVER = LIVER[0] + (0, 0, 65), LIVER[1]
KIDNEYS = ((500, SPINE), (130, LEFT), (130, RIGHT))
BOWEL = [
    (450, (np.array([x, -60.0, z]), np.array([22.0, 18.0, 25.0])))
    for x in (-30, 30, 70)
    for z in (-50, 0, 50)
]
HEALTHY = {
    "large labelled tumour on the left": ((-100, BODY), (75, LARGE), (110, FEW_LIVER), *KIDNEYS),
    "fatty liver, large spleen": ((-100, BODY), (-10, LIVER), (120, SPLEEN), *KIDNEYS, (70, TUMOUR)),
    "oral contrast agent": ((-100, BODY), (110, LIVER), *BOWEL, *KIDNEYS, (70, TUMOUR)),
}


@pytest.mark.parametrize("anatomy", HEALTHY)
def test_no_alarm_of_a_right_header(tmp_path, anatomy):
    """The patient's disease looks like an organ of the other side."""
    image = scan(anatomy=HEALTHY[anatomy])
    tumour = LARGE if "tumour" in anatomy else TUMOUR
    labels = valued(image, *(inside(image, solid) for solid in (LEFT, RIGHT, tumour)))
    paths = written(tmp_path / "ct.nrrd", image), [written(tmp_path / "labels.nrrd", labels)]
    assert import_request(*paths, **KITS).warnings == ()


# 2. Names.


@pytest.mark.parametrize("name", ["Nierentu links", "renal Ca", "Kidney nádor", "kidney target"])
def test_a_finding_named_after_the_kidney(of_regions, name):
    """A small region in the kidney is no second drawing of it: it is the tumour, or a warning tells that
    it was left out.
    """
    patient = of_regions({"Kidney_L": stack(LEFT), name: stack(TUMOUR)})
    assert patient.tumour or any(name in line for line in patient.warnings), patient.notes


# 3. Slices that nobody segmented.


def without(image, solid, slices):
    mask = inside(image, solid)
    mask[slices] = False
    return mask


def test_many_missing_slices_bridged_by_a_cyst(ct, of_segments):
    """Five slices have the cyst alone: too many to interpolate, and none is lost without a word."""
    named = [("Kidney_L", without(ct[0], LEFT, [13, 14, 15, 16, 17])), ("Tumor", TUMOUR), ("Cyst", CYST)]
    patient, words = words_of(lambda: of_segments(named))
    missing = [z for z in (-20, -16, -12, -8, -4) if f"z {z}.0" not in words]
    assert is_right(patient, organ_ml=101.9) or not missing, (words, patient and patient.volumes_ml)


def test_every_fifth_slice(tmp_path, of_segments):
    """Nobody filled between slices: what is missing is interpolated and named, or refused as missing, not
    as a wrong side.
    """
    image = scan((4.0, 4.0, 2.5))
    mask = without(image, LEFT, [k for k in range(63) if k % 5])
    path = written(tmp_path / "ct.nrrd", image)
    patient, words = words_of(
        lambda: of_segments([("Kidney_L", mask), ("Kidney_R", RIGHT)], image, path, side="left")
    )
    assert "slice" in words and (patient is None or abs(patient.volumes_ml["organ"] / 93.8 - 1) < 0.06), words


# 4. Planes of contours and of the CT.

TILT = np.radians(15)
TILTED = np.array([[1, 0, 0], [0, np.cos(TILT), -np.sin(TILT)], [0, np.sin(TILT), np.cos(TILT)]])
SCANS = {
    "oblique": dict(direction=DIRECTIONS["oblique"]),
    "tilted gantry": dict(direction=TILTED, positions=lambda k: np.array([-172.0, -125.0, -110.0 + 4 * k])),
}


@pytest.mark.parametrize("of_scan", SCANS)
def test_contours_at_rounded_positions(tmp_path, of_scan):
    """A planning system rounds coordinates to 0.1 mm."""
    series = Scan(tmp_path / "ct", **SCANS[of_scan])
    rounded = lambda corners: np.round(corners, 1)  # noqa: E731
    regions = {"Kidney_L": series.contours(LEFT, rounded), "GTV": series.contours(TUMOUR, rounded)}
    path = write_structures(tmp_path / "rs.dcm", regions, frame_of_reference=series.frame_of_reference)
    assert_right(import_request(series.write(), [path]), tumour_ml=5.58)


def test_planes_thicker_than_slices(tmp_path):
    """Contours of 5 mm slices on the thin slices of the same scan are right: no warning of another CT."""
    adult = LEFT[0], np.array([30.0, 26.0, 54.0])
    image = scan((2.5, 2.5, 1.25), ((-100, BODY), (110, LIVER), (500, SPINE), (130, adult), (130, RIGHT)))
    path = write_structures(tmp_path / "rs.dcm", {"Kidney_L": stack(adult, np.arange(-72.0, 85.0, 5.0))})
    patient = import_request(written(tmp_path / "ct.nrrd", image), [path])
    assert_right(patient, organ_ml=176.4, tumour_ml=None)
