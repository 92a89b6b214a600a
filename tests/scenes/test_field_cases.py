"""Imports as they happen in the field, each with a known truth: right, or refused in words, and never wrong
without a word.

Eight kinds: sides exchanged, contours, derived regions, names, slices that nobody segmented, writers of SEG
and RTSTRUCT, privacy, planes of contours.
"""

import unicodedata
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_series import Series, write_segmentation, write_structures
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
    with_voxels,
)
from test_patient_space import nrrd

from app import main
from errors import PatientError
from scenes.patient_space import signs_to_lps
from scenes.patients.import_command import label_words
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
    found = np.full(places.shape[:-1], -1000.0)
    for value, solid in anatomy:
        found[level(places, solid) < 0] = value
    return found


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
    labels = valued(image, *(mask for _, mask in named))
    for n, (name, _) in enumerate(named):
        for key, value in dict(Name=name, LabelValue=str(n + 1), Layer="0", ID=f"Segment_{n}").items():
            labels.SetMetaData(f"Segment{n}_{key}", value)
    return written(path, labels)


def section(solid, origin, direction=DIRECTIONS["identity"], count=48):
    """The contour (n, 3) of an ellipsoid on a plane through a place, along two axes of a direction; None
    where there is none.
    """
    centre, axes = solid
    plane = direction[:, :2] / axes[:, None]
    start = (np.asarray(origin) - centre) / axes
    middle = -np.linalg.lstsq(plane, start, rcond=None)[0]
    nearest = start + plane @ middle
    if nearest @ nearest >= 0.999:
        return None
    metric = np.linalg.cholesky(np.linalg.inv(plane.T @ plane))
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    at = middle[:, None] + np.sqrt(1 - nearest @ nearest) * metric @ [np.cos(angles), np.sin(angles)]
    return np.asarray(origin) + (direction[:, :2] @ at).T


def stack(solid, heights=HEIGHTS):
    return [c for c in (section(solid, (0.0, 0.0, z)) for z in heights) if c is not None]


def circle(x, y, z, radius, count=16):
    return section((np.array([x, y, z]), np.full(3, radius)), (x, y, z), count=count)


def grown(solid, mm):
    return solid[0], solid[1] + mm


class Scan(Series):
    """A DICOM series of the body with pixels of 4 mm."""

    def __init__(self, folder, gap=4.0, direction=DIRECTIONS["identity"], heights=None, **options):
        corners = np.array(np.meshgrid(*zip(LOW, HIGH, strict=True))).reshape(3, -1).T @ direction
        start = corners.min(axis=0)
        size = (np.ceil(np.ptp(corners, axis=0) / (4.0, 4.0, gap)).astype(int) + 1).tolist()
        origin = direction @ start
        if heights is not None:
            size[2] = len(heights)
            options["positions"] = lambda k: origin + (heights[int(k)] - start[2]) * direction[:, 2]
        super().__init__(folder, direction, size=size, gap=gap, origin=origin, field=hounsfield, **options)

    spacing = property(lambda self: (4.0, 4.0), lambda self, value: None)

    def masks(self, solid):
        return level(np.stack([self.places(k) for k in range(self.size[2])]), solid) < 0

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

    def run(regions, edit=lambda data: None, **options):
        path = write_structures(tmp_path / "rs.dcm", regions, edit=edit)
        return import_request(ct[1], [path], **options)

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


def is_right(patient, organ_ml=ORGAN_ML, tumour_ml: float | None = TUMOUR_ML, side="left"):
    """Whether organ, side and tumour are those of the body."""
    if patient is None or patient.side != side or abs(patient.volumes_ml["organ"] / organ_ml - 1) > 0.03:
        return False
    if tumour_ml is None:
        return True
    if patient.tumour is None or np.abs(patient.tumour.center_mass - TUMOUR[0]).max() > 1.5:
        return False
    return abs(patient.volumes_ml["tumour"] / tumour_ml - 1) < 0.12


def assert_right(patient, warnings=0, **truth):
    assert is_right(patient, **truth), (patient.side, patient.volumes_ml, patient.warnings)
    assert len(patient.warnings) == warnings, patient.warnings


# 1. Sides exchanged.

KITS = dict(organ=["1", "2"], tissues={"tumour": ["3"]}, side="left")


def kits(image, flip=()):
    """Labels of both kidneys and the tumour; voxels turned around along some axes (z, y, x)."""
    labels = valued(image, *(inside(image, solid) for solid in (LEFT, RIGHT, TUMOUR)))
    return flipped(labels, flip)


def flipped(image, axes):
    return with_voxels(image, np.ascontiguousarray(np.flip(sitk.GetArrayFromImage(image), axes)))


def nifti(path: Path, image, sform, qform, mirrored="none"):
    voxels = sitk.GetArrayFromImage(image).transpose(2, 1, 0).astype(np.int16)
    affine = np.diag([-4.0, -4.0, 4.0, 1.0])
    affine[:3, 3] = np.array(image.GetOrigin()) * (-1, -1, 1)
    made, mirror = nibabel.Nifti1Image(voxels, affine), np.diag([-1.0, 1.0, 1.0, 1.0])
    made.set_sform(mirror @ affine if mirrored == "sform" else affine, sform)
    made.set_qform(affine, qform)
    nibabel.save(made, path)
    return path


def metaimage(path: Path, image, old: bytes, new: bytes):
    content = written(path, image).read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    return path


FORMS = {
    "NRRD in LAS": lambda f, image: nrrd(f / "ct.nrrd", image, "space: LAS", signs_to_lps("LAS")),
    "MetaImage with Rotation and Position": lambda f, image: metaimage(
        metaimage(f / "ct.mha", image, b"TransformMatrix", b"Rotation"), image, b"Offset", b"Position"
    ),
    "NIfTI with a qform alone": lambda f, image: nifti(f / "ct.nii.gz", image, 0, 1),
    "NIfTI, a sform of another space": lambda f, image: nifti(f / "ct.nii.gz", image, 2, 1, "sform"),
}


@pytest.mark.parametrize("form", FORMS)
def test_forms_that_state_their_axes(ct, tmp_path, form):
    """ITK, 3D Slicer, FSL and ITK-SNAP state axes in different fields."""
    labels = written(tmp_path / "labels.nrrd", kits(ct[0]))
    assert_right(import_request(FORMS[form](tmp_path, ct[0]), [labels], **KITS))


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


# 2. Contours.


def halves(corners, overlap):
    """A convex contour cut along the patient's length into two that overlap by twice so much [mm]."""
    middle = corners[:, 0].mean()
    found = []
    for sign in (1, -1):
        x, edge = sign * corners[:, 0], sign * middle + overlap
        cut = []
        for n, start in enumerate(corners):
            end, m = corners[n - len(corners) + 1], n - len(corners) + 1
            cut += [start] * bool(x[n] <= edge)
            if (x[n] <= edge) != (x[m] <= edge):
                cut.append(start + (edge - x[n]) / (x[m] - x[n]) * (end - start))
        found.append(np.array(cut))
    return found


def shrunk(corners, share):
    return corners.mean(axis=0) + share * (corners - corners.mean(axis=0))


PLAIN = stack(LEFT)
WIDE = [corners for corners in PLAIN if np.ptp(corners[:, 0]) > 40]
HOLES = [circle(70, 35, corners[0, 2], 6) for corners in WIDE]
SAME = {
    "cut in two that share an edge": [half for c in PLAIN for half in halves(c, 0)],
    "closed explicitly, each point twice": [np.repeat(np.vstack([c, c[:1]]), 2, axis=0) for c in PLAIN],
    "any order, both "
    "directions": [PLAIN[n][:: 1 - 2 * (n % 2)] for n in np.random.default_rng(1).permutation(23)],
    "clicks of one to three "
    "points": [*PLAIN, *(c[:1] for c in PLAIN), *(c[:2] for c in PLAIN), PLAIN[9][[0, 3, 0]]],
    "self-crossing by a misplaced point": [c[[*range(20), 21, 20, *range(22, 48)]] for c in PLAIN],
    "specks": [*PLAIN, circle(20, -60, -20, 0.5), circle(71, 36, 8, 1.0)],
}  # fmt: skip


@pytest.mark.parametrize("contours", SAME)
def test_contours_of_one_kidney(of_regions, contours):
    """Eclipse, MIM and RayStation write one outline in many ways."""
    assert_right(of_regions({"Kidney_L": SAME[contours], "GTV": stack(TUMOUR)}))


@pytest.mark.parametrize(
    "second", [lambda c: c[::-1], lambda c: c[::3] + (1.2, 0, 0)], ids=["reversed", "moved"]
)  # fmt: skip
def test_contours_that_stand_twice(of_regions, second):
    """A region was sent twice, or simplified and merged."""
    patient = of_regions({"Kidney_L": PLAIN + [second(c) for c in PLAIN], "GTV": stack(TUMOUR)})
    assert_right(patient)
    assert any("twice" in note for note in patient.notes)


@pytest.mark.parametrize(
    "second", [lambda c: c + (2.4, 0, 0), lambda c: c + (4, 0, 0), lambda c: shrunk(c, 0.9)], ids=["0.6 "
            "pixels", "a pixel", "two millimetres"]
)  # fmt: skip
def test_contours_that_nearly_stand_twice(of_regions, second):
    """Two observers' contours in one region: the kidney must not become the rim between them."""
    run = lambda: of_regions({"Kidney_L": PLAIN + [second(c) for c in PLAIN], "GTV": stack(TUMOUR)})  # noqa: E731
    patient, words = words_of(run)
    assert (patient and abs(patient.volumes_ml["organ"] / ORGAN_ML - 1) < 0.08) or (
        not patient and "contour" in words
    ), words


def test_contours_that_overlap(tmp_path):
    """The kidney was drawn in two overlapping strokes on thick slices: no slit is between them."""
    image, heights = scan((3.0, 3.0, 8.0)), np.arange(-72.0, 85.0, 8.0)
    drawn = [half for c in stack(LEFT, heights) for half in halves(c, 3)]
    path = write_structures(tmp_path / "rs.dcm", {"Kidney_L": drawn, "GTV": stack(TUMOUR, heights)})
    patient, words = words_of(lambda: import_request(written(tmp_path / "ct.nrrd", image), [path]))
    assert is_right(patient) or (not patient and "contour" in words and "overlap" in words), words


@pytest.mark.parametrize("kind", ["clockwise", "keyhole"])
def test_holes(of_regions, kind):
    """A hole is a contour of its own, in either direction, or is led to by a channel: the warning tells of
    the hollow.
    """
    ends = [c for c in PLAIN if not any(c is one for one in WIDE)]
    channels = [np.vstack([c, c[:1], h[::-1], h[-1:]]) for c, h in zip(WIDE, HOLES, strict=True)]
    contours = [*PLAIN, *(h[::-1] for h in HOLES)] if kind == "clockwise" else [*ends, *channels]
    patient = of_regions({"Kidney_L": contours, "GTV": stack(TUMOUR)})
    assert_right(patient, organ_ml=91.7, warnings=1)
    assert "hollow" in patient.warnings[0]


def as_point(data):
    contours = data.ROIContourSequence[1].ContourSequence
    del contours[1:]
    contours[0].ContourGeometricType, contours[0].ContourData = "POINT", [92, 30, 20]


LOST = {
    "drawn around twice": ([np.vstack([c, c]) for c in stack(TUMOUR)], lambda data: None),
    "smaller than a pixel": ([circle(94, 30, 18, 1.5)], lambda data: None),
    "a point": (stack(TUMOUR), as_point),
}


@pytest.mark.parametrize("tumour", LOST)
def test_a_tumour_without_a_pixel(of_regions, tumour):
    """A tumour that the file has and the patient has not is named."""
    contours, edit = LOST[tumour]
    patient, words = words_of(lambda: of_regions({"Kidney_L": PLAIN, "GTV": contours}, edit))
    assert (patient and patient.tumour) or "GTV" in words or "tumour has no surface" in words, words


@pytest.mark.parametrize("kind", ["OPEN_PLANAR", None])
def test_a_kidney_without_closed_contours(of_regions, kind):
    """The refusal names the region that the file has, and why it was not read."""

    def edit(data):
        for contour in data.ROIContourSequence[0].ContourSequence:
            contour.ContourGeometricType = kind
            if kind is None:
                del contour.ContourGeometricType

    patient, words = words_of(lambda: of_regions({"Kidney_L": PLAIN, "GTV": stack(TUMOUR)}, edit))
    assert is_right(patient) or ("Kidney_L" in words and "closed" in words), words


# 3. Derived regions, and words of the user.


@pytest.mark.parametrize("name", ["zKidney_L", "Kidney_L_PTV"])
def test_derived_regions_are_left_out(of_regions, name):
    """TG-263 and its users."""
    patient = of_regions({"Kidney_L": PLAIN, "GTV": stack(TUMOUR), name: stack(grown(LEFT, 8))})
    assert_right(patient)
    assert any(name in note for note in patient.notes)


@pytest.mark.parametrize("name", ["Kidney_L+5", "Kidney_L_5mm", "Kidney_L_exp5", "_Kidney_L"])
def test_a_margin_without_a_word(of_regions, name):
    """A kidney with a margin has twice its volume: it is no second drawing of the same structure."""
    patient = of_regions({"Kidney_L": PLAIN, "GTV": stack(TUMOUR), name: stack(grown(LEFT, 8))})
    assert is_right(patient) or any(name in line for line in patient.warnings), patient.volumes_ml


REST = ["kidney w/o tumor", "Kidney_L - Tumor", "Kidney+Tumor", "kidney without tumor"]


@pytest.mark.parametrize("name", REST)
def test_the_kidney_without_its_tumour(of_regions, name):
    """The only kidney has a name with the word tumour: what a refusal advises must work."""
    regions = {name: PLAIN, "Tumor": stack(TUMOUR)}
    patient, words = words_of(lambda: of_regions(regions))
    assert is_right(patient) or (name in words and "--organ" in words), words
    if patient is None:
        assert_right(of_regions(regions, organ=[name]))


def test_a_kidney_covered_by_kidney_and_tumour(of_regions):
    """A kidney, the kidney with the tumour, and the tumour: the refusal must not say that there is no
    kidney.
    """
    regions = {"Kidney_L": PLAIN, "Kidney_L incl GTV": stack(grown(LEFT, 2)), "GTV": stack(TUMOUR)}
    patient, words = words_of(lambda: of_regions(regions))
    assert is_right(patient) or "“Kidney_L”" in words, words


def test_two_observers(of_regions):
    """Both drew the same kidney: a note says that they were united."""
    patient = of_regions({"Kidney_L_AB": PLAIN, "Kidney_L_CD": [shrunk(c, 0.97) for c in PLAIN]})
    assert_right(patient, organ_ml=93.8, tumour_ml=None)
    assert any("united" in note and "_AB" in note and "_CD" in note for note in patient.notes)


def test_a_copy_is_named_once(of_regions):
    """Two plain drawings of a kidney, and an old one: each name once in the note."""
    patient = of_regions(
        {"Kidney_L": PLAIN, "Kidney_L_1": PLAIN, "Kidney_L old": PLAIN, "GTV": stack(TUMOUR)}
    )
    assert_right(patient)
    assert sum(note.count("“Kidney_L old”") for note in patient.notes) == 1


def test_names_with_commas(of_segments):
    """Words of the command line are split at commas, which names of segments have, too."""
    named = [("Kidney, left", LEFT), ("Kidney, right", RIGHT), ("Finding, left, upper", TUMOUR)]
    words = [label_words(text, "organ") for text in ("Kidney, left", "Finding,left, upper")]
    assert_right(of_segments(named, organ=words[0], tissues={"tumour": words[1]}))


def test_a_name_as_it_is_shown(of_segments):
    """A name with typographic quotation marks is shown without them, and may be given so."""
    named = [("Organ “L”", LEFT), ("Tumor", TUMOUR)]
    _, words = words_of(lambda: of_segments(named))
    shown = words.split("“")[1].split("”")[0]
    assert_right(of_segments(named, organ=[shown]))


def test_names_that_are_other_values(of_segments):
    """Segment 1 is named 2, and segment 2 is named 1: a number is refused as ambiguous, or one of both
    meanings.
    """
    named = [("2", LEFT), ("1", TUMOUR), ("Kidney_R", RIGHT)]
    patient, words = words_of(lambda: of_segments(named, organ=["2"], tissues={"tumour": ["1"]}))
    assert is_right(patient) or ("2" in words and ("name" in words and "value" in words)), words


def test_names_that_differ_in_case(of_segments):
    """An exact name is that segment; a refusal would have to say that values tell them apart."""
    named = [("Kidney_L", LEFT), ("finding", TUMOUR), ("FINDING", CYST)]
    run = lambda: of_segments(named, tissues={"tumour": ["finding"], "cyst": ["FINDING"]})  # noqa: E731
    patient, words = words_of(run)
    assert is_right(patient, organ_ml=101.9) or "value" in words, words


def test_names_that_differ_in_accents(of_segments):
    """Läsion in either encoding is one name, and Lasion another."""
    named = [("Kidney_L", LEFT), (unicodedata.normalize("NFD", "Läsion"), TUMOUR), ("Lasion", CYST)]
    patient = of_segments(named, tissues={"tumour": ["Läsion"], "cyst": ["Lasion"]})
    assert_right(patient, organ_ml=101.9)


# 4. Names.


@pytest.mark.parametrize("name", ["Nierentu links", "renal Ca", "Kidney nádor", "kidney target"])
def test_a_finding_named_after_the_kidney(of_regions, name):
    """A small region in the kidney is no second drawing of it: it is the tumour, or a warning tells that
    it was left out.
    """
    patient = of_regions({"Kidney_L": PLAIN, name: stack(TUMOUR)})
    assert patient.tumour or any(name in line for line in patient.warnings), patient.notes


@pytest.mark.parametrize("name, "
            "tissue", [("Left kidney "
            "pelvis", "urine"), ("Nierensinus", "sinus"), ("sinus renal", "sinus")])  # fmt: skip
def test_hollows_named_after_the_kidney(of_segments, name, tissue):
    """Pelvis and sinus are no parenchyma."""
    patient = of_segments([("Kidney_L", LEFT), (name, (LEFT[0] - (10, 0, 0), np.array([9.0, 9.0, 18.0])))])
    assert tissue in patient.tissues.values() or any(name in line for line in patient.warnings)


NEAR_RIGHT = np.array([-70.0, 20.0, 38.0]), np.full(3, 12.0)
NEAR_LEFT = np.array([88.0, 20.0, 58.0]), np.full(3, 14.0)


@pytest.mark.parametrize(
    "name, solid, side",
    [
        ("Liver lesion", NEAR_RIGHT, "right"),
        ("Leberzyste", NEAR_RIGHT, "right"),
        ("Splenic cyst", NEAR_LEFT, "left"),
        ("Bone metastasis", NEAR_LEFT, "left"),
        ("Adrenal mass", NEAR_LEFT, "left"),
    ],
)
def test_lesions_of_other_organs(of_regions, name, solid, side):
    """What touches the kidney, and is another organ's by its name, is no part of it without a word."""
    patient = of_regions({"Kidney_L": PLAIN, "Kidney_R": stack(RIGHT), name: stack(solid)}, side=side)
    alone = 93.8 if side == "left" else 95.7
    assert is_right(patient, organ_ml=alone, tumour_ml=None, side=side) or any(
        name in w for w in patient.warnings
    )


@pytest.mark.parametrize("name", ["Опухоль", "nádor", ""])
def test_a_finding_in_another_language(of_segments, name):
    """A warning names it, with its place; the user's word has it in, in the other encoding, too."""
    named = [("Kidney_L", LEFT), (unicodedata.normalize("NFD", name), TUMOUR)]
    patient = of_segments(named)
    assert any(
        unicodedata.normalize("NFD", name) in line and "no known tissue" in line for line in patient.warnings
    )
    if name in ("nádor", ""):
        assert_right(of_segments(named, tissues={"tumour": [name or "2"]}))


def test_a_kidney_in_another_language(of_segments):
    """It is asked for by name, and found by it."""
    named = [(unicodedata.normalize("NFD", "신장"), LEFT), ("Tumor", TUMOUR)]
    patient, words = words_of(lambda: of_segments(named))
    assert patient is None and "--organ" in words
    assert_right(of_segments(named, organ=["신장"]))


@pytest.mark.parametrize("name", ["hip"])
def test_a_known_structure_in_the_kidney(of_segments, name):
    """A name of what cannot be in a kidney leaves a hole in it: a warning names it."""
    patient = of_segments([("Kidney_L", LEFT), (name, TUMOUR)])
    assert any(name in line for line in patient.warnings)


def test_a_named_tumour_apart(of_segments):
    """A tumour a centimetre from the kidney is left out: a warning tells so, as of one that the user
    named.
    """
    patient = of_segments([("Kidney_L", LEFT), ("Tumor", (np.array([116.0, 35.0, 12.0]), np.full(3, 12.0)))])
    assert any("tumour" in line for line in patient.warnings)


@pytest.mark.parametrize("junk", [".DS_Store", "._kidney_left.nii.gz"])
def test_files_of_a_mac(ct, tmp_path, junk):
    """A Mac puts files of its own beside those on a stick."""
    image, path = ct
    folder = tmp_path / "segmentations"
    folder.mkdir()
    for name, solid in dict(kidney_left=LEFT, kidney_right=RIGHT, kidney_tumor=TUMOUR).items():
        written(folder / f"{name}.nii.gz", valued(image, inside(image, solid)))
    (folder / junk).write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X" + bytes(60))
    assert_right(import_request(path, [folder], side="left"))


# 5. Slices that nobody segmented.


def without(image, solid, slices, axis=0):
    mask = inside(image, solid)
    mask[(slice(None),) * axis + (slices,)] = False
    return mask


@pytest.mark.parametrize(
    "slices, "
    "z", [([13], "-20.0"), ([30], "48.0"), ([24], "24.0"), ([18, 19], "0.0")], ids=["cyst", "pole", "tumour", "two"]
)  # fmt: skip
def test_missing_slices_of_a_kidney(ct, of_segments, slices, z):
    """One or two slices of 4 mm, also bridged by a cyst or tumour: interpolated, and named by their
    places.
    """
    named = [("Kidney_L", without(ct[0], LEFT, slices)), ("Tumor", TUMOUR), ("Cyst", CYST)]
    patient = of_segments(named)
    assert_right(patient, organ_ml=101.9, warnings=1)
    assert f"z {z} mm" in patient.warnings[0]


@pytest.mark.parametrize("lacking", ["kidney", "tumour"])
def test_missing_slices_thinner_than_pixels(tmp_path, of_segments, lacking):
    """A CT of thin slices, 3 mm with pixels of 4 mm (0.6 and 0.8 in the field): its slices lack just so,
    and are named.
    """
    image = scan((4.0, 4.0, 3.0))
    path = written(tmp_path / "ct.nrrd", image)
    slices = {name: [31] if name == lacking else [] for name in ("kidney", "tumour")}
    named = [
        ("Kidney_L", without(image, LEFT, slices["kidney"])),
        ("Tumor", without(image, TUMOUR, slices["tumour"])),
    ]
    patient = of_segments(named, image, path)
    assert any(lacking in line and "z 21.0 mm" in line for line in patient.warnings), patient.volumes_ml


@pytest.mark.parametrize("direction", ["identity", "left-handed"])
def test_a_tumour_beside_missing_slices(ct, of_segments, direction):
    """Two slices of the kidney are missing below the tumour's end: it does not grow into them, in either
    order of slices.
    """
    image = scan(direction=DIRECTIONS[direction])
    heights = points_of(image)[:, 0, 0, 2]
    missing = np.flatnonzero(np.isin(heights, (4.0, 8.0)))
    patient = of_segments([("Kidney_L", without(image, LEFT, missing)), ("Tumor", TUMOUR)], image)
    assert patient.volumes_ml["tumour"] == pytest.approx(TUMOUR_ML, rel=0.05)
    assert patient.tumour.center_mass[2] == pytest.approx(TUMOUR[0][2], abs=1.0)


def test_many_missing_slices_bridged_by_a_cyst(ct, of_segments):
    """Five slices have the cyst alone: too many to interpolate, and none is lost without a word."""
    named = [("Kidney_L", without(ct[0], LEFT, [13, 14, 15, 16, 17])), ("Tumor", TUMOUR), ("Cyst", CYST)]
    patient, words = words_of(lambda: of_segments(named))
    missing = [z for z in (-20, -16, -12, -8, -4) if f"z {z}.0" not in words]
    assert is_right(patient, organ_ml=101.9) or not missing, (words, patient and patient.volumes_ml)


def test_a_missing_slice_in_a_file_that_is_cropped(ct, tmp_path):
    """Files of a folder are cropped when they are read: the slice is named by its place, which the user's
    viewer shows too.
    """
    image, path = ct
    folder = tmp_path / "segmentations"
    folder.mkdir()
    masks = dict(kidney_left=without(image, LEFT, [21]), kidney_right=inside(image, RIGHT))
    for name, mask in masks.items():
        written(folder / f"{name}.nii.gz", valued(image, mask))
    patient = import_request(path, [folder], side="left")
    assert any("the slice z 12.0 mm" in line for line in patient.warnings), patient.warnings


def test_a_slice_missing_in_both_kidneys(ct, of_segments):
    """The place that is named is in a kidney, and not in the spine between them."""
    patient = of_segments([(name, without(ct[0], s, [18])) for name, s in (("Kidney_L", LEFT), ("Kidney_R", RIGHT))], side="left")  # fmt: skip
    (line,) = [line for line in patient.warnings if "z 0.0 mm" in line]
    assert abs(float(line.split("around x ")[1].split(",")[0])) > 35, line


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


@pytest.mark.parametrize("touching_mm", [1.5, 3.0])
def test_a_tumour_that_hardly_touches(tmp_path, of_segments, touching_mm):
    """Fat between an exophytic tumour and the kidney is no missing slice: none of it becomes kidney, and
    nothing warns.
    """
    tumour = np.array([113.0 - touching_mm, 35.0, 12.0]), np.full(3, 18.0)
    image = scan((3.0, 3.0, 3.0), ((-100, BODY), (110, LIVER), *KIDNEYS, (70, tumour)))
    union = inside(image, LEFT) | inside(image, tumour)
    path = written(tmp_path / "ct.nrrd", image)
    patient = of_segments([("Kidney_L", LEFT), ("Tumor", tumour)], image, path)
    assert patient.warnings == ()
    assert patient.volumes_ml["organ"] == pytest.approx(union.sum() * 0.027, rel=1e-3)


# 6. SEG and RTSTRUCT as other writers make them.


def from_zero(data):
    for segment in data.SegmentSequence:
        segment.SegmentNumber -= 1
    for frame in data.PerFrameFunctionalGroupsSequence:
        frame.SegmentIdentificationSequence[0].ReferencedSegmentNumber -= 1


def bare(data):
    for name in ("FrameOfReferenceUID", "ReferencedSeriesSequence", "NumberOfFrames", "ContentLabel"):
        delattr(data, name)


@pytest.mark.parametrize("kind, edit", [("BINARY", from_zero), ("LABELMAP", bare)])
def test_a_seg_of_another_writer(tmp_path, kind, edit):
    """Numbered from 0, or without what voxels do not need; frames of the labelled slices alone."""
    series = Scan(tmp_path / "ct")
    masks = {
        "Left kidney": series.masks(LEFT),
        "Right kidney": series.masks(RIGHT),
        "Renal mass": series.masks(TUMOUR),
    }
    masks["Left kidney"] &= ~masks["Renal mass"]
    path = write_segmentation(tmp_path / "seg.dcm", series, masks, kind, slices=range(4, 36))
    data = pydicom.dcmread(path)
    edit(data)
    data.save_as(path)
    assert_right(import_request(series.write(), [path], side="left"))


def test_contours_that_thin_out(of_regions):
    """Planes are closer towards a pole, and some contours are interpolated ones."""
    heights = np.r_[-40.0, -36.0, np.arange(-32, 53, 4.0), 54.0, 55.0, 56.0]

    def edit(data):
        for contour in list(data.ROIContourSequence[0].ContourSequence)[1::2]:
            contour.ContourGeometricType = "INTERPOLATED_PLANAR"

    assert_right(of_regions({"Kidney_L": stack(LEFT, heights), "GTV": stack(TUMOUR)}, edit))


# 7. Privacy.

PRIVATE = ("Front^Back", "Bone^Rene", "29.02.60", "471-1-23", "Long_Small", "St Elsewhere")


@pytest.fixture(scope="module")
def folder_of_files(tmp_path_factory):
    """The files of an import, whose source names the patient in every field, path and region."""
    folder = tmp_path_factory.mktemp("patients")
    with pytest.MonkeyPatch.context() as patch:
        coarsely(patch)
        series = Scan(folder / "Long_Small" / "ct")
        series.write(PatientName="Front^Back", PatientID="471-1-23", InstitutionName="St Elsewhere")
        inner = stack((LEFT[0] - (0, 0, 22), np.full(3, 9.0)))
        regions = {
            "Kidney_L": PLAIN,
            "PRV Kidney_L Bone^Rene": PLAIN,
            "PRV Kidney_L Front^Back": PLAIN,
            "PRV Kidney_L 471-1-23": PLAIN,
            "Befund 29.02.60": inner,
            "GTV": stack(TUMOUR),
        }
        frame = series.frame_of_reference
        path = write_structures(folder / "Long_Small" / "Front^Back.dcm", regions, frame_of_reference=frame)
        assert main(["import", str(series.folder), str(path), "--out", str(folder / "a")]) == 0
    return folder / "a"


@pytest.mark.parametrize("text", PRIVATE)
def test_no_file_names_the_patient(folder_of_files, text):
    """Names of regions with the patient's name, date of birth or ID, also where they are words or numbers
    of structures.
    """
    assert len(list(folder_of_files.iterdir())) == 8
    assert not [file.name for file in folder_of_files.iterdir() if text.encode() in file.read_bytes()]


# 8. Planes of contours and of the CT.

TILT = np.radians(15)
TILTED = np.array([[1, 0, 0], [0, np.cos(TILT), -np.sin(TILT)], [0, np.sin(TILT), np.cos(TILT)]])
SCANS = {
    "a gap, resampled": dict(heights=np.r_[np.arange(-72.0, 0, 4), np.arange(2.0, 85.0, 4)]),
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


def test_decubitus(tmp_path):
    """Axes of the patient do not turn with the patient; gravity does."""
    series = Scan(tmp_path / "ct")
    regions = {"Kidney_L": series.contours(LEFT), "GTV": series.contours(TUMOUR)}
    path = write_structures(tmp_path / "rs.dcm", regions, frame_of_reference=series.frame_of_reference)
    patient = import_request(series.write(PatientPosition="FFDR"), [path])
    assert_right(patient)
    assert patient.position == "right-decubitus"


def test_axial_contours_on_a_tilted_ct(tmp_path):
    """They were drawn on a resampled CT: refused, with the advice to give that one."""
    series = Scan(tmp_path / "ct", **SCANS["tilted gantry"])
    path = write_structures(tmp_path / "rs.dcm", {"Kidney_L": PLAIN})
    patient, words = words_of(lambda: import_request(series.write(), [path]))
    assert patient is None and "cross the slices" in words and "CT that they were drawn on" in words


def test_planes_thicker_than_slices(tmp_path):
    """Contours of 5 mm slices on the thin slices of the same scan are right: no warning of another CT."""
    adult = LEFT[0], np.array([30.0, 26.0, 54.0])
    image = scan((2.5, 2.5, 1.25), ((-100, BODY), (110, LIVER), (500, SPINE), (130, adult), (130, RIGHT)))
    path = write_structures(tmp_path / "rs.dcm", {"Kidney_L": stack(adult, np.arange(-72.0, 85.0, 5.0))})
    patient = import_request(written(tmp_path / "ct.nrrd", image), [path])
    assert_right(patient, organ_ml=176.4, tumour_ml=None)
