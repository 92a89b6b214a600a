"""Patient import against synthetic bodies whose organs are known in LPS mm, and against the real data."""

from pathlib import Path

import igl
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import trimesh
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
from scipy.spatial.transform import Rotation

from scenes.patient import PatientError, describe, import_patient, read_volume, save_patient
from scenes.support import cradle
from scenes.surfaces import self_intersections, surface_from_mask

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

# Organs of the synthetic body: centre and half-axes in LPS [mm]. Left and right differ in size and place, so
# that a mirrored, swapped or shifted import cannot pass.
LEFT = np.array([70.0, 35.0, 12.0]), np.array([25.0, 20.0, 45.0])
RIGHT = np.array([-62.0, 30.0, -10.0]), np.array([28.0, 22.0, 38.0])
TUMOUR = np.array([92.0, 30.0, 20.0]), np.array([11.0, 11.0, 11.0])  # sticks out of the left kidney
BODY = np.array([0.0, 0.0, 0.0]), np.array([160.0, 110.0, 400.0])
LEFT_ML = 4 / 3 * np.pi * LEFT[1].prod() / 1000

DIRECTIONS = {
    "identity": np.eye(3),
    "RAS": np.diag([-1.0, -1.0, 1.0]),
    "left-handed": np.diag([1.0, 1.0, -1.0]),
    "slices first": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "oblique": Rotation.from_euler("xyz", [14, -9, 23], degrees=True).as_matrix(),
}
SPACINGS = {"thick": (1.3, 1.1, 4.5), "even": (1.5, 1.5, 1.5)}


def level(points, solid):
    """(|p - c| / a) - 1 of an ellipsoid; negative inside."""
    centre, axes = solid
    return np.linalg.norm((points - centre) / axes, axis=-1) - 1


def grid_around(low, high, spacing, direction=DIRECTIONS["identity"]):
    """An image of the given spacing and direction that covers the LPS box [low, high], all zero."""
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T @ direction
    size = np.ceil(np.ptp(corners, axis=0) / spacing).astype(int) + 1
    image = sitk.Image(size.tolist(), sitk.sitkInt16)
    image.SetSpacing(list(map(float, spacing)))
    image.SetDirection(np.asarray(direction).ravel().tolist())
    image.SetOrigin((direction @ corners.min(axis=0)).tolist())
    return image


def points_of(image):
    """LPS of every voxel, shape (z, y, x, 3)."""
    nx, ny, nz = image.GetSize()
    index = np.stack(np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij"), axis=-1)[
        ..., ::-1
    ]
    direction = np.array(image.GetDirection()).reshape(3, 3)
    return index * np.array(image.GetSpacing()) @ direction.T + np.array(image.GetOrigin())


def drawn(image, *solids):
    """`image` with the i-th solid (value, centre and axes) painted over the earlier ones."""
    points = points_of(image)
    voxels = np.full(points.shape[:3], -1000 if solids[0][0] > 9 else 0, np.int16)
    for value, solid in solids:
        voxels[level(points, solid) < 0] = value
    painted = sitk.GetImageFromArray(voxels)
    painted.CopyInformation(image)
    return painted


def body(direction=DIRECTIONS["identity"], spacing=(3.0, 2.5, 4.0), z=(-90.0, 90.0)):
    """CT [HU] and labels (1 right, 2 left, 3 tumour of the left) of the synthetic body."""
    empty = grid_around((-175, -120, z[0]), (175, 120, z[1]), spacing, direction)
    ct = drawn(empty, (40, BODY), (120, LEFT), (120, RIGHT), (70, TUMOUR))
    labels = drawn(empty, (1, RIGHT), (2, LEFT), (3, TUMOUR))
    return ct, labels


def with_voxels(image, voxels):
    changed = sitk.GetImageFromArray(voxels)
    changed.CopyInformation(image)
    return changed


def mapped(labels, values):
    """Label map with each value replaced by values[value]."""
    return with_voxels(labels, np.array(values, np.int16)[sitk.GetArrayFromImage(labels)])


def least_gap(support, organ):
    """Least distance [mm] of 20000 points of the support's surface to the organ; negative inside."""
    points, _ = trimesh.sample.sample_surface(support, 20000, seed=1)
    faces = np.asarray(organ.faces, np.int64)
    return igl.signed_distance(np.ascontiguousarray(points), np.asarray(organ.vertices), faces)[0].min()


def label_boundary(voxels):
    """Faces between inside and outside, in index coordinates (x, y, z): vertices and triangles."""
    padded = np.pad(voxels, 1)
    corners = []
    for axis in range(3):
        centre = np.argwhere(np.diff(padded.astype(np.int8), axis=axis) != 0) - 1.0
        centre[:, axis] += 0.5
        one, two = np.delete(np.eye(3), axis, axis=0) * 0.5
        corners.append(centre[:, None] + np.array([-one - two, one - two, one + two, two - one]))
    quads = np.concatenate(corners)
    first = 4 * np.arange(len(quads))[:, None]
    return quads.reshape(-1, 3), np.vstack([first + [0, 1, 2], first + [0, 2, 3]])


def voxels_to_boundary(surface, mask):
    """Distance of each vertex from the label's boundary, each axis measured in voxels."""
    direction = np.array(mask.GetDirection()).reshape(3, 3)
    index = (surface.vertices - np.array(mask.GetOrigin())) @ direction / np.array(mask.GetSpacing())
    vertices, faces = label_boundary(sitk.GetArrayFromImage(mask).transpose(2, 1, 0) != 0)
    squared = igl.point_mesh_squared_distance(np.ascontiguousarray(index), vertices, faces)[0]
    return np.sqrt(squared)


def assert_sound(mesh):
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert mesh.body_count == 1
    assert self_intersections(mesh) == 0


@pytest.fixture(scope="module")
def ct_and_labels():
    return body()


@pytest.fixture(scope="module")
def patient(ct_and_labels):
    return import_patient(*ct_and_labels, organ=[2], tumour=[3], margin_mm=20.0)


class TestSurface:
    @pytest.mark.parametrize("spacing", SPACINGS.values(), ids=SPACINGS)
    @pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
    def test_lies_where_the_label_is(self, direction, spacing):
        centre, axes = LEFT
        mask = drawn(grid_around(centre - axes - 12, centre + axes + 7, spacing, direction), (1, LEFT))
        surface = surface_from_mask(mask, faces=2000)

        assert_sound(surface)
        assert len(surface.faces) == pytest.approx(2000, abs=20)
        label_ml = sitk.GetArrayViewFromImage(mask).sum() * np.prod(spacing) / 1000
        assert surface.volume / 1000 == pytest.approx(label_ml, rel=1e-3)
        assert surface.volume / 1000 == pytest.approx(LEFT_ML, rel=0.03)
        assert voxels_to_boundary(surface, mask).max() < 1
        # The label knows each boundary point to half a voxel; the smoothed surface must not be worse than
        # that against the true ellipsoid, along the normal, where a voxel measures |n| . spacing.
        gradient = (surface.vertices - centre) / axes**2
        normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        off = np.abs(level(surface.vertices, LEFT) / np.linalg.norm(gradient, axis=1))
        assert (off <= 0.5 * np.abs(normal @ direction) @ np.array(spacing)).all()
        assert np.abs(surface.center_mass - centre).max() < 0.1 * max(spacing)

    def test_has_no_stairs_between_thick_slices(self):
        centre, axes = LEFT
        mask = drawn(grid_around(centre - axes - 9, centre + axes + 9, (0.8, 0.8, 5.0)), (1, LEFT))
        surface = surface_from_mask(mask)
        # Stairs would turn the normal by 90 degrees at each of 18 slices; 5000 even triangles of an
        # ellipsoid with 9 mm as its least radius of curvature turn by about 1.5 mm / 9 mm, 10 degrees.
        turn = np.degrees(surface.face_adjacency_angles)
        assert np.percentile(turn, 99) < 15
        assert np.degrees(surface.face_angles.min(axis=1)).min() > 5

    def test_drops_islands_and_fills_holes(self):
        centre, axes = LEFT
        empty = grid_around(centre - axes - 30, centre + axes + 10, (1.5, 1.5, 1.5))
        island = centre - axes - 15, np.full(3, 5.0)
        hole = centre, np.full(3, 6.0)
        surface = surface_from_mask(drawn(empty, (1, LEFT), (1, island), (0, hole)), faces=2000)
        assert_sound(surface)
        assert surface.volume / 1000 == pytest.approx(LEFT_ML, rel=0.01)

    def test_empty_mask_is_refused(self):
        with pytest.raises(ValueError, match="empty"):
            surface_from_mask(sitk.Image([9, 9, 9], sitk.sitkUInt8))

    def test_same_bits_twice(self):
        centre, axes = TUMOUR
        mask = drawn(grid_around(centre - axes - 9, centre + axes + 9, (1.5, 1.5, 1.5)), (1, TUMOUR))
        first, second = surface_from_mask(mask, 1000), surface_from_mask(mask, 1000)
        assert np.array_equal(first.vertices, second.vertices)
        assert np.array_equal(first.faces, second.faces)

    def test_self_intersections_are_found(self):
        ball = trimesh.creation.icosphere(subdivisions=2)
        assert self_intersections(ball) == 0
        ball.vertices[0] = -1.5 * ball.vertices[0]
        assert self_intersections(ball) > 0


class TestSupport:
    @pytest.mark.parametrize("gravity", [(0, 0, -1), (0, 1, 0), (0.6, 0, -0.8)])
    def test_lies_under_the_organ_and_clear_of_it(self, gravity):
        organ = trimesh.creation.icosphere(subdivisions=4)
        organ.vertices = organ.vertices * (50, 22, 28) + (10, -300, 40)
        support = cradle(organ, np.array(gravity))

        assert_sound(support)
        assert len(support.faces) == pytest.approx(5000, abs=50)
        assert 0.0 < least_gap(support, organ) < 0.35
        down = np.array(gravity)
        height = np.ptp(organ.vertices @ down)
        bottom, top = (organ.vertices @ down).max(), (support.vertices @ down).min()
        assert bottom - top == pytest.approx(0.35 * height, abs=0.1)
        assert (support.vertices @ down).max() == pytest.approx(bottom + 8, abs=0.1)

    def test_moulds_the_underside(self):
        organ = trimesh.creation.icosphere(subdivisions=4, radius=30)
        support = cradle(organ, np.array([0, 0, -1]), clearance_mm=0.5)
        # Polar angles up to 40 degrees lie in the mould, well inside of its filleted rim (at 73 degrees).
        under = organ.vertices[organ.vertices[:, 2] < -30 * np.cos(np.radians(40))]
        faces = np.asarray(support.faces, np.int64)
        gap = igl.signed_distance(np.ascontiguousarray(under), np.asarray(support.vertices), faces)[0]
        assert np.abs(gap - 0.5).max() < 0.15

    def test_organ_can_be_lifted_out(self):
        leaning = trimesh.creation.icosphere(subdivisions=4, radius=30)
        leaning.vertices[:, 0] -= leaning.vertices[
            :, 2
        ]  # its lower end reaches far under the rim: an undercut
        up = np.array([0.0, 0.0, 1.0])
        support = cradle(leaning, -up)
        for lift in (1.0, 5.0, 20.0):
            lifted = leaning.copy().apply_translation(lift * up)
            assert least_gap(support, lifted) > 0

    @pytest.mark.parametrize("gravity", [(0, 0, 0), (np.nan, 0, 1)])
    def test_gravity_without_direction_is_refused(self, gravity):
        with pytest.raises(ValueError, match="gravity"):
            cradle(trimesh.creation.icosphere(radius=30), np.array(gravity))


class TestImport:
    def test_finds_the_organ(self, patient, ct_and_labels):
        ct, labels = ct_and_labels
        values = sitk.GetArrayViewFromImage(labels)
        voxel_ml = np.prod(ct.GetSpacing()) / 1000
        assert patient.side == "left"
        assert patient.organ_volume_ml == pytest.approx((values >= 2).sum() * voxel_ml)
        assert patient.tumour_volume_ml == pytest.approx((values == 3).sum() * voxel_ml)
        assert patient.organ.volume / 1000 == pytest.approx(patient.organ_volume_ml, rel=0.005)
        assert patient.tumour.volume / 1000 == pytest.approx(patient.tumour_volume_ml, rel=0.005)
        for mesh in (patient.organ, patient.tumour, patient.support):
            assert_sound(mesh)
        np.testing.assert_allclose(patient.tumour.center_mass, TUMOUR[0], atol=1.0)
        assert least_gap(patient.support, patient.organ) > 0
        assert patient.support.bounds[1, 1] > patient.organ.bounds[1, 1]  # posterior of it: supine
        text = describe(patient)
        assert "left" in text and f"{patient.organ_volume_ml:.1f} ml" in text and "2.50" in text

    def test_crop_keeps_voxels_where_they_were(self, patient, ct_and_labels):
        assert patient.ct.GetPixelID() == sitk.sitkInt16 and patient.labels.GetPixelID() == sitk.sitkUInt8
        again = sitk.Resample(ct_and_labels[0], patient.ct, sitk.Transform(), sitk.sitkNearestNeighbor)
        assert np.array_equal(sitk.GetArrayViewFromImage(again), sitk.GetArrayViewFromImage(patient.ct))
        points, marked = points_of(patient.labels), sitk.GetArrayViewFromImage(patient.labels) > 0
        assert (points.reshape(-1, 3).min(axis=0) <= points[marked].min(axis=0) - 20).all()
        assert (points.reshape(-1, 3).max(axis=0) >= points[marked].max(axis=0) + 20).all()
        assert set(np.unique(sitk.GetArrayViewFromImage(patient.labels)).tolist()) == {0, 1, 2}

    @pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
    @pytest.mark.parametrize(("value", "side"), [(1, "right"), (2, "left")])
    def test_tells_left_from_right(self, direction, value, side):
        from scenes.labels import labelled_organ

        ct, labels = body(direction, spacing=(4.0, 3.5, 5.0))
        assert labelled_organ(ct, labels, [value], None, None)[1] == side
        assert labelled_organ(ct, labels, None, [3] if value == 2 else None, side)[0].values == [value]
        only_one = mapped(labels, [0, value == 1, value == 2, value == 2])
        assert labelled_organ(ct, only_one, None, None, None)[1] == side
        both_one_value = mapped(labels, [0, 1, 1, 1])
        organ, told = labelled_organ(ct, both_one_value, None, None, side)
        assert told == side and np.sign(organ.centre_x_mm) == (1 if side == "left" else -1)
        with pytest.raises(PatientError, match="no (left|right) kidney"):
            labelled_organ(ct, only_one, None, None, "left" if side == "right" else "right")

    def test_labels_on_another_grid(self, ct_and_labels):
        from scenes.labels import labelled_organ

        ct, _ = ct_and_labels
        finer = drawn(grid_around((-110, -20, -70), (120, 80, 80), (2.0, 2.0, 2.0)), (1, RIGHT), (2, LEFT))
        organ, side = labelled_organ(ct, finer, [2], None, None)
        assert side == "left" and organ.mask.shape == ct.GetSize()[::-1]
        assert organ.volume_ml == pytest.approx(LEFT_ML, rel=0.03)

    def test_padding_becomes_air(self, ct_and_labels):
        ct, labels = ct_and_labels
        voxels = sitk.GetArrayFromImage(ct)
        voxels[voxels == -1000] = -3024
        import scenes.patient as module

        organ, _ = module.labelled_organ(with_voxels(ct, voxels), labels, [2], [3], None)
        cropped, marked = module._crop(with_voxels(ct, voxels), organ, 300.0)
        assert sitk.GetArrayViewFromImage(cropped).min() == -1000
        assert not sitk.GetArrayViewFromImage(marked)[
            points_of(marked)[..., 0] < 0
        ].any()  # not the other kidney

    def test_cropped_ct_needs_the_side(self, ct_and_labels):
        from scenes.labels import labelled_organ

        ct, labels = ct_and_labels
        near = [slice(ct.TransformPhysicalPointToIndex((30.0, 0, 0))[0], None), slice(None), slice(None)]
        with pytest.raises(PatientError, match="--side left or --side right"):
            labelled_organ(ct[near], labels[near], [2], None, None)
        assert labelled_organ(ct[near], labels[near], [2], None, "left")[1] == "left"


class TestImportRefuses:
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({}, r"2 organs .*label 1, right, \d+\.\d ml; label 2\+3, left, \d+\.\d ml.*--side"),
            ({"organ": [5]}, "label 5 is not in the label map: it holds 1, 2, 3; give --organ"),
            ({"organ": []}, "none given"),
            ({"tumour": [8], "organ": [1]}, "tumour's label 8 is not"),
            ({"organ": [1, 3], "tumour": [3]}, "label 3 is given as organ and as tumour"),
            ({"organ": [1], "tumour": [3]}, "no voxel in the right kidney"),
            ({"organ": [1], "side": "left"}, "no left kidney is labelled, found: label 1, right"),
            ({"organ": [1], "side": "up"}, "expected left or right"),
            ({"organ": [3]}, r"has 5\.\d ml: expected 20 to 2000 ml"),
            ({"organ": [2], "margin_mm": -1.0}, "margin"),
        ],
    )
    def test_options(self, ct_and_labels, options, words):
        with pytest.raises(PatientError, match=words) as caught:
            import_patient(*ct_and_labels, **options)
        assert "\n" not in str(caught.value)

    def test_labels_that_are_none(self, ct_and_labels):
        ct, labels = ct_and_labels
        with pytest.raises(PatientError, match="empty"):
            import_patient(ct, labels * 0)
        with pytest.raises(PatientError, match="swapped"):
            import_patient(labels, ct)
        with pytest.raises(PatientError, match="whole numbers"):
            import_patient(ct, sitk.Cast(labels, sitk.sitkFloat32) * 0.3)
        with pytest.raises(PatientError, match="the tumour's label alone"):
            import_patient(ct, mapped(labels, [0, 0, 0, 3]), tumour=[3])

    def test_labels_of_another_place(self, ct_and_labels):
        ct, labels = ct_and_labels
        far = sitk.Image(labels)
        far.SetOrigin((1000.0, 0.0, 0.0))
        with pytest.raises(PatientError, match="outside the CT"):
            import_patient(ct, far)

    def test_organ_cut_off(self):
        ct, labels = body(z=(-90.0, 20.0))
        with pytest.raises(PatientError, match="cut off at the border"):
            import_patient(ct, labels, organ=[2])

    def test_implausible_organ(self, ct_and_labels):
        ct, labels = ct_and_labels
        everything = with_voxels(labels, (sitk.GetArrayViewFromImage(ct) > -500).astype(np.int16))
        with pytest.raises(PatientError, match="expected 20 to 2000 ml"):
            import_patient(ct, everything, side="left")

    def test_organ_that_is_no_soft_tissue(self, ct_and_labels):
        ct, labels = ct_and_labels
        with pytest.raises(PatientError, match="soft tissue"):
            import_patient(ct + 1024, labels, organ=[2])


class TestSave:
    def test_writes_what_was_imported_and_nothing_of_the_source(self, patient, tmp_path):
        named = sitk.Image(patient.ct)
        named.SetMetaData("0010|0010", "Doe^Jane")
        object.__setattr__(patient, "ct", named)
        folder = tmp_path / "new" / "patient"
        save_patient(patient, folder, texts={"scene.toml": "a = 1\n"})

        names = {file.name for file in folder.iterdir()}
        assert names == {"ct.nrrd", "labels.nrrd", "organ.stl", "tumour.stl", "support.stl", "scene.toml"}
        assert [entry.name for entry in folder.parent.iterdir()] == ["patient"]
        for name in ("ct", "labels"):
            again, image = read_volume(folder / f"{name}.nrrd"), getattr(patient, name)
            assert np.array_equal(sitk.GetArrayViewFromImage(again), sitk.GetArrayViewFromImage(image))
            np.testing.assert_allclose(again.GetOrigin(), image.GetOrigin(), atol=1e-6)
            np.testing.assert_allclose(again.GetDirection(), image.GetDirection(), atol=1e-9)
        organ = trimesh.load(folder / "organ.stl")
        assert organ.is_watertight and organ.volume == pytest.approx(patient.organ.volume, rel=1e-5)
        for file in folder.iterdir():
            content = file.read_bytes()
            assert b"Doe" not in content and str(tmp_path).encode() not in content

    def test_leaves_what_is_there(self, patient, tmp_path):
        (tmp_path / "precious.txt").write_text("mine")
        with pytest.raises(PatientError, match="not an empty folder"):
            save_patient(patient, tmp_path)
        with pytest.raises(PatientError, match="not an empty folder"):
            save_patient(patient, tmp_path / "precious.txt")
        assert [entry.name for entry in tmp_path.iterdir()] == ["precious.txt"]

    def test_interrupted_leaves_nothing(self, patient, tmp_path, monkeypatch):
        monkeypatch.setattr(
            trimesh.Trimesh, "export", lambda *_: (_ for _ in ()).throw(OSError(28, "No space"))
        )
        with pytest.raises(PatientError, match="No space"):
            save_patient(patient, tmp_path / "patient")
        assert list(tmp_path.iterdir()) == []


class Series:
    """A tiny CT series on disk: 6 slices of 12 x 10 voxels, 0.8 x 0.7 mm, 2.5 mm apart, any orientation."""

    size, spacing, gap = (12, 10, 6), (0.8, 0.7), 2.5

    def __init__(self, folder, direction=DIRECTIONS["oblique"], origin=(-31.5, 20.25, -400.0), number=1):
        self.folder, self.direction, self.origin = folder, direction, np.array(origin)
        self.uid, self.number = generate_uid(), number
        nx, ny, nz = self.size
        self.hounsfield = np.random.default_rng(7).integers(-1000, 1500, (nz, ny, nx))

    def position(self, k):
        return self.origin + k * self.gap * self.direction[:, 2]

    def write(self, order=range(6), position=None, **tags):
        self.folder.mkdir(parents=True, exist_ok=True)
        for n, k in enumerate(order):
            meta = FileMetaDataset()
            meta.MediaStorageSOPClassUID, meta.TransferSyntaxUID = CTImageStorage, ExplicitVRLittleEndian
            meta.MediaStorageSOPInstanceUID = generate_uid()
            file = self.folder / f"s{self.number}-{n}.dcm"
            data = FileDataset(str(file), {}, file_meta=meta, preamble=b"\0" * 128)
            data.SOPClassUID, data.SOPInstanceUID = CTImageStorage, meta.MediaStorageSOPInstanceUID
            data.Modality, data.SeriesInstanceUID, data.SeriesNumber = "CT", self.uid, self.number
            data.PatientName, data.PatientID, data.StudyInstanceUID = "Doe^Jane", "4711", self.uid
            data.ImagePositionPatient = np.round((position or self.position)(k), 6).tolist()
            data.ImageOrientationPatient = np.round(self.direction[:, :2].T.ravel(), 8).tolist()
            data.PixelSpacing = [self.spacing[1], self.spacing[0]]
            data.SliceThickness, data.InstanceNumber = self.gap, 6 - n
            data.Columns, data.Rows, _ = self.size
            data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
            data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 12, 11, 0
            data.RescaleIntercept, data.RescaleSlope = -1024, 1
            data.PixelData = (self.hounsfield[k] + 1024).astype("<u2").tobytes()
            for name, value in tags.items():
                setattr(data, name, value)
            pydicom.dcmwrite(file, data, enforce_file_format=True)
        return self.folder


class TestReading:
    def test_dicom_series(self, tmp_path):
        series = Series(tmp_path / "ct")
        series.write(order=(3, 0, 5, 1, 4, 2))
        (tmp_path / "ct" / "notes.txt").write_text("no slice")
        image = read_volume(tmp_path / "ct")

        assert np.array_equal(sitk.GetArrayViewFromImage(image), series.hounsfield)
        np.testing.assert_allclose(image.GetSpacing(), (0.8, 0.7, 2.5), atol=1e-5)
        np.testing.assert_allclose(image.GetOrigin(), series.origin, atol=1e-5)
        np.testing.assert_allclose(np.reshape(image.GetDirection(), (3, 3)), series.direction, atol=1e-6)
        assert not image.GetMetaDataKeys()

    def test_two_series_are_named(self, tmp_path):
        Series(tmp_path, number=3).write()
        Series(tmp_path, number=8).write(order=range(4))
        with pytest.raises(PatientError, match=r"2 series.*series 3 \(CT, 6 files.*series 8 \(CT, 4 files"):
            read_volume(tmp_path)

    @pytest.mark.parametrize(
        ("writing", "words"),
        [
            ({"Modality": "MR"}, "the modality is MR; expected CT"),
            ({"order": (0, 1, 2, 4, 5)}, r"s1-2.dcm and s1-3.dcm are 5\.00 mm apart, the others 2\.50 mm"),
            ({"order": (0, 1, 2, 2, 3)}, "lie at one position"),
            ({"order": (2,)}, "one slice only"),
            ({"NumberOfFrames": 2}, "holds 2 frames"),
        ],
    )
    def test_bad_series(self, tmp_path, writing, words):
        with pytest.raises(PatientError, match=words) as caught:
            read_volume(Series(tmp_path).write(**writing))
        assert "Doe" not in str(caught.value) and "4711" not in str(caught.value)

    def test_uneven_and_tilted_series(self, tmp_path):
        uneven = Series(tmp_path / "uneven", DIRECTIONS["identity"])
        with pytest.raises(PatientError, match="off an even spacing"):
            read_volume(uneven.write(position=lambda k: uneven.position(k + 0.02 * k**2)))
        tilted = Series(tmp_path / "tilted", DIRECTIONS["identity"])
        with pytest.raises(PatientError, match="gantry tilt"):
            read_volume(tilted.write(position=lambda k: tilted.position(k) + (0, 0.3 * k, 0)))

    def test_mixed_slices(self, tmp_path):
        series = Series(tmp_path)
        series.write(order=range(3))
        other = pydicom.dcmread(tmp_path / "s1-2.dcm")
        other.ImageOrientationPatient = [1, 0, 0, 0, 0, -1]
        other.save_as(tmp_path / "s1-2.dcm")
        with pytest.raises(PatientError, match="orientation"):
            read_volume(tmp_path)

    def test_folder_without_dicom(self, tmp_path):
        with pytest.raises(PatientError, match="no DICOM file"):
            read_volume(tmp_path)
        with pytest.raises(PatientError, match="no such file"):
            read_volume(tmp_path / "absent.nrrd")

    @pytest.mark.parametrize("ending", [".nii", ".nii.gz", ".nrrd", ".mha", ".mhd"])
    def test_files_keep_their_place(self, tmp_path, ending):
        image = grid_around((0, 0, 0), (20, 15, 10), (1.0, 1.5, 2.0), DIRECTIONS["oblique"])
        image = with_voxels(
            image, np.random.default_rng(3).integers(-900, 900, image.GetSize()[::-1], np.int16)
        )
        image.SetMetaData("descrip", "Doe^Jane")
        sitk.WriteImage(image, str(tmp_path / f"ct{ending}"))
        again = read_volume(tmp_path / f"ct{ending}")
        assert np.array_equal(sitk.GetArrayViewFromImage(again), sitk.GetArrayViewFromImage(image))
        np.testing.assert_allclose(again.GetOrigin(), image.GetOrigin(), atol=1e-4)
        np.testing.assert_allclose(again.GetDirection(), image.GetDirection(), atol=1e-5)
        assert not again.GetMetaDataKeys()

    def test_bad_files(self, tmp_path):
        (tmp_path / "cut.nrrd").write_bytes(b"NRRD0004\nnonsense")
        (tmp_path / "ct.txt").write_text("text")
        sitk.WriteImage(sitk.Image([8, 8], sitk.sitkInt16), str(tmp_path / "flat.mha"))
        sitk.WriteImage(sitk.Image([8, 8, 8], sitk.sitkVectorUInt8, 3), str(tmp_path / "rgb.mha"))
        holed = with_voxels(sitk.Image([4, 4, 4], sitk.sitkFloat32), np.full((4, 4, 4), np.nan, np.float32))
        sitk.WriteImage(holed, str(tmp_path / "nan.mha"))
        for name, words in [
            ("cut.nrrd", "cannot be read"),
            ("ct.txt", "unknown kind of file"),
            ("flat.mha", "expected one 3D volume"),
            ("rgb.mha", "expected one number"),
            ("nan.mha", "64 voxels are not finite"),
        ]:
            with pytest.raises(PatientError, match=words) as caught:
                read_volume(tmp_path / name)
            assert "\n" not in str(caught.value) and name in str(caught.value)


REAL = [
    ("crlm_1004", "crlm_1004_labels/kidneys_provisional.nii.gz", 1, "right", 108.8),
    ("crlm_1004", "crlm_1004_labels/kidneys_provisional.nii.gz", 2, "left", 125.6),
    ("totalseg/ct.nii.gz", "totalseg/kidneys.nii.gz", 1, "left", 138.9),
    ("totalseg/ct.nii.gz", "totalseg/kidneys.nii.gz", 2, "right", 188.8),
]


@pytest.mark.skipif(not (DATA / "ct").is_dir(), reason="real data (../shared/data/ct) is not here")
class TestRealData:
    @pytest.mark.parametrize(("ct", "labels", "value", "side", "volume_ml"), REAL)
    def test_kidney(self, ct, labels, value, side, volume_ml):
        ct, labels = read_volume(DATA / "ct" / ct), read_volume(DATA / "ct" / labels)
        patient = import_patient(ct, labels, organ=[value])
        assert patient.side == side
        assert patient.organ.volume / 1000 == pytest.approx(volume_ml, rel=0.01)
        assert len(patient.organ.faces) == pytest.approx(5000, abs=20)
        assert_sound(patient.organ)
        assert_sound(patient.support)
        assert voxels_to_boundary(patient.organ, labels == value).max() < 1
        assert least_gap(patient.support, patient.organ) > 0
        assert sitk.GetArrayViewFromImage(patient.ct).min() >= -1024

    def test_series_that_must_be_refused(self):
        failing = DATA / "dicom" / "dicom2nifti" / "tests" / "data" / "failing"
        if not failing.is_dir():
            pytest.skip("../shared/data/dicom is not here")
        folders = {file.parent for file in failing.rglob("*") if file.is_file()}
        for folder in sorted(folders):
            with pytest.raises(PatientError):
                read_volume(folder)


@pytest.mark.skipif(
    not (DATA / "truth").is_dir(), reason="bead experiments (../shared/data/truth) are not here"
)
@pytest.mark.parametrize("case", ["bean", "kits040"])
def test_support_like_that_of_the_bead_experiments(case):
    organ = trimesh.load(DATA / "truth" / case / "kidney.stl")
    expected = trimesh.load(DATA / "truth" / case / "support.stl")
    support = cradle(organ, np.array([0.0, 0.0, -1.0]))
    assert_sound(support)
    np.testing.assert_allclose(support.bounds[:, 2], expected.bounds[:, 2], atol=0.1)
    # The mould itself: organ's underside, away from the rim, as far from our support as from theirs.
    low, high = organ.bounds[:, 2]
    under = organ.vertices[organ.vertices[:, 2] < low + 0.2 * (high - low)]
    gaps = [
        igl.signed_distance(
            np.ascontiguousarray(under), np.asarray(m.vertices), np.asarray(m.faces, np.int64)
        )[0]
        for m in (support, expected)
    ]
    assert np.abs(gaps[0] - gaps[1]).mean() < 0.1
