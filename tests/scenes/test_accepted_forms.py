"""Every form of labels on a CT of any view: the surface has the volume and place that SimpleITK measures
in the voxels.
"""

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_series import Series, write_segmentation, write_structures
from raw_nrrd import segment_lines, write_nrrd
from synthetic_body import DIRECTIONS, coarsely, ellipsoid, level, section

from scenes.patients.import_request import import_request
from scenes.volumes.voxel_grid import VoxelGrid

# Three different half-axes [mm], off the origin: no axis may be mirrored or exchanged.
KIDNEY = np.array([40.0, 22.0, -63.0]), np.array([18.0, 14.0, 27.0])
NEAR = np.array([26.0, 22.0, 35.0])
# Rows along the body, so that its slices are coronal.
VIEWS = {
    "axial": DIRECTIONS["identity"],
    "coronal": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "feet first": np.diag([-1.0, 1.0, -1.0]),
    "oblique": DIRECTIONS["oblique"],
}
LAYER = dict(Name="left kidney", LabelValue="1", Layer="1", Extent="0 1 0 1 0 1")


def hounsfield(places):
    """A kidney in fat; no two voxels of a row are equal."""
    return np.where(level(places, KIDNEY) < 0, 120.0, -100.0) + 20 * np.sin(places @ [0.9, 1.3, 1.7])


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Writes a CT of a view, once; gives its folder, its series, and the voxels of the kidney as an image."""
    made = {}

    def make(view):
        if view not in made:
            direction, gap = VIEWS[view], 3.0
            corners = KIDNEY[0] + NEAR * (np.indices((2, 2, 2)).reshape(3, -1).T * 2 - 1)
            along = corners @ direction
            size = np.ceil(np.ptp(along, axis=0) / [0.8, 0.7, gap]).astype(int) + 1
            folder = tmp_path_factory.mktemp("ct")
            origin = direction @ along.min(axis=0)
            series = Series(
                folder, direction, size=tuple(size.tolist()), gap=gap, field=hounsfield, origin=origin
            )
            series.write(PatientPosition="HFS")
            inside = level(np.stack([series.places(k) for k in range(size[2])]), KIDNEY) < 0
            image = sitk.GetImageFromArray(inside.astype(np.uint8))
            image.SetSpacing((*series.spacing, gap))
            image.SetDirection(direction.ravel().tolist())
            image.SetOrigin(origin.tolist())
            made[view] = folder, series, image
        return made[view]

    return make


def segmentation(kind):
    def write(folder, series, image):
        inside = sitk.GetArrayFromImage(image)
        shares = inside * 0.9 if kind == "FRACTIONAL" else inside.astype(bool)
        return write_segmentation(folder / "seg.dcm", series, {"Left kidney": shares}, kind)

    return write


def structures(folder, series, _):
    """Each slice's section of the ellipsoid, as its polygon."""
    sections = [section(KIDNEY, series.positions(k), series.direction, 200) for k in range(series.size[2])]
    contours = [corners for corners in sections if corners is not None]
    return write_structures(folder / "rt.dcm", {"Niere links": contours}, series.uid)


def slicer(folder, _, image):
    """A second layer, in RAS."""
    inside = sitk.GetArrayFromImage(image)
    layers = np.stack([np.zeros_like(inside), inside], axis=-1)
    in_ras = dict(space="space: right-anterior-superior", signs=(-1, -1, 1))
    path, fields = folder / "labels.seg.nrrd", segment_lines([LAYER])
    return write_nrrd(path, VoxelGrid.of(image), layers, **in_ras, fields=fields)


def file_per_organ(folder, _, image):
    (folder / "organs").mkdir()
    for name, one in (("kidney_left", image), ("spleen", image * 0), ("heart", image)):
        sitk.WriteImage(one, str(folder / "organs" / f"{name}.nii.gz"))
    return folder / "organs"


def surface(ending, space, scale):
    def write(folder, *_):
        body = ellipsoid(KIDNEY, subdivisions=4)
        body.vertices *= scale
        if np.prod(scale) < 0:
            body.invert()
        path = folder / f"left kidney{ending}"
        if ending == ".stl":
            path.write_bytes(f"SPACE={space}".encode().ljust(80) + body.export(file_type="stl")[80:])
        else:
            lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in body.vertices]
            lines += [f"f {a} {b} {c}" for a, b, c in body.faces + 1]
            path.write_text("\n".join([f"# SPACE={space}", *lines, ""]))
        return path

    return write


@pytest.mark.parametrize(
    ("view", "labels"),
    [
        pytest.param("coronal", segmentation("BINARY"), id="SEG binary, coronal"),
        pytest.param("oblique", segmentation("FRACTIONAL"), id="SEG fractional, oblique"),
        pytest.param("feet first", segmentation("LABELMAP"), id="SEG label map, feet first"),
        pytest.param("coronal", structures, id="RTSTRUCT, coronal"),
        pytest.param("feet first", structures, id="RTSTRUCT, feet first"),
        pytest.param("oblique", slicer, id="seg.nrrd, oblique"),
        pytest.param("axial", file_per_organ, id="folder, axial"),
        pytest.param("axial", surface(".stl", "RAS", (-1, -1, 1)), id="STL in RAS, axial"),
        pytest.param("oblique", surface(".obj", "LPS", (1, 1, 1)), id="OBJ in LPS, oblique"),
    ],
)
def test_volume_and_place(source, tmp_path, monkeypatch, view, labels):
    coarsely(monkeypatch)
    # The support is tested by itself, and takes most of the time.
    monkeypatch.setattr("scenes.patients.patient_import._support", lambda kind, organ, *_: organ)
    folder, series, image = source(view)
    patient = import_request(folder, [labels(tmp_path, series, image)], side="left")

    measured = sitk.LabelShapeStatisticsImageFilter()
    measured.Execute(image)
    assert patient.organ.volume == pytest.approx(measured.GetPhysicalSize(1), rel=0.01)
    off = (patient.organ.center_mass - measured.GetCentroid(1)) @ series.direction
    assert (np.abs(off) <= 0.5 * np.array(image.GetSpacing())).all()
    own = sitk.LabelShapeStatisticsImageFilter()
    own.Execute(patient.labels)
    assert own.GetPhysicalSize(1) == pytest.approx(measured.GetPhysicalSize(1), rel=0.01)
    assert own.GetCentroid(1) == pytest.approx(measured.GetCentroid(1), abs=0.5 * min(image.GetSpacing()))
    # Every voxel is where it was.
    for k, j, i in np.random.default_rng(3).integers(0, series.size[::-1], (50, 3)).tolist():
        here = patient.ct.TransformPhysicalPointToIndex(series.places(k)[j, i].tolist())
        assert patient.ct[here] == series.hounsfield[k, j, i]
