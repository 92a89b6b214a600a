"""Files that do not say where their axes point are refused, as left and right may be exchanged; the user
may say it.
"""

from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from raw_nrrd import write_nrrd
from synthetic_body import DIRECTIONS, LEFT, TUMOUR, body, coarsely

from app import main
from errors import PatientError
from scenes.import_findings import read_findings
from scenes.patient_space import SPACES, signs_to_lps
from scenes.patients.import_listing import listing_text
from scenes.patients.import_request import import_request
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_files import open_labels
from scenes.surfaces import in_lps, volume_mm3
from scenes.volumes.voxel_grid import VoxelGrid

NAMELESS = ("3D-left-handed", "3D-right-handed", "scanner-xyz")
KINDS = [*NAMELESS, "no space", "no TransformMatrix", "no sform or qform"]


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    coarsely(monkeypatch)


def nrrd(path: Path, image: sitk.Image, field: str, signs: np.ndarray) -> Path:
    """An NRRD whose axes are those of an image, in a space of the given signs."""
    voxels = sitk.GetArrayFromImage(image).astype(np.int16)
    return write_nrrd(path, VoxelGrid.of(image), voxels, field, signs)


def without_matrix(path: Path, image: sitk.Image) -> Path:
    sitk.WriteImage(image, str(path))
    head, mark, voxels = path.read_bytes().partition(b"ElementDataFile")
    left_out = (b"TransformMatrix", b"Offset", b"CenterOfRotation", b"AnatomicalOrientation")
    kept = [line for line in head.split(b"\n") if not line.startswith(left_out)]
    path.write_bytes(b"\n".join(kept) + mark + voxels)
    return path


def without_forms(path: Path, image: sitk.Image) -> Path:
    voxels = sitk.GetArrayFromImage(image).transpose(2, 1, 0).astype(np.int16)
    made = nibabel.Nifti1Image(voxels, None)
    made.header.set_zooms(image.GetSpacing())
    nibabel.save(made, path)
    return path


def written(folder: Path, name: str, image: sitk.Image, kind: str, signs: np.ndarray) -> Path:
    """A file of a kind that does not say where its axes point, in a space of the given signs."""
    if kind in NAMELESS:
        return nrrd(folder / f"{name}.nrrd", image, f"space: {kind}", signs)
    if kind == "no space":
        return nrrd(folder / f"{name}.nrrd", image, "space dimension: 3", signs)
    # Voxels in the order of the axes, and nothing else.
    voxels = sitk.GetArrayFromImage(image)[tuple(slice(None, None, int(s)) for s in signs[::-1])]
    plain = sitk.GetImageFromArray(np.ascontiguousarray(voxels).astype(np.int16))
    plain.SetSpacing(image.GetSpacing())
    if kind == "no TransformMatrix":
        return without_matrix(folder / f"{name}.mha", plain)
    return without_forms(folder / f"{name}.nii.gz", plain)


def pair(folder: Path, kind: str, space: str = "RAS") -> list[Path]:
    signs = signs_to_lps(space)
    return [
        written(folder, name, image, kind, signs)
        for name, image in zip(("ct", "labels"), body(spacing=(4.0, 4.0, 4.0)), strict=True)
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_space_it_is_refused(tmp_path, kind):
    ct, labels = pair(tmp_path, kind)
    for read in (
        lambda: open_ct(ct),
        lambda: open_labels(labels),
        lambda: import_request(ct, [labels], ["2"]),
    ):
        with pytest.raises(
            PatientError, match=r"left and right may be exchanged.*--space, one of LPS"
        ) as caught:
            read()
        assert str(tmp_path) in str(caught.value) and len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("kind", "space"),
    [
        ("3D-right-handed", "RAS"),
        ("3D-left-handed", "LAS"),
        ("scanner-xyz", "RPI"),
        ("no space", "LPS"),
        ("no TransformMatrix", "RPS"),
        ("no sform or qform", "LAI"),
    ],
)
def test_the_users_space(tmp_path, kind, space):
    ct, labels = pair(tmp_path, kind, space)
    patient = import_request(ct, [labels], ["2"], {"tumour": ["3"]}, space=space)
    assert patient.side == "left" and patient.space == space
    # Files with voxels alone have another origin: what is certain is where the tumour is in the kidney.
    apart = patient.tumour.center_mass - patient.organ.center_mass
    np.testing.assert_allclose(apart, (TUMOUR[0] - LEFT[0]), atol=3.0)


def test_it_is_written_where_it_is_read(tmp_path, capfd):
    ct, labels = pair(tmp_path, "3D-right-handed")
    out, options = tmp_path / "a", ["--organ", "2", "--tumour", "3", "--space", "ras"]
    assert main(["import", str(ct), str(labels), "--out", str(out), *options]) == 0
    assert "space      RAS, as given" in capfd.readouterr().out
    assert read_findings(out).space == "RAS"
    assert "scanner" not in listing_text(ct, [labels], space="RAS")


@pytest.mark.parametrize("ending", [".nii.gz", ".nrrd", ".mha"])
def test_where_every_file_states_its_own_it_is_refused(tmp_path, ending):
    ct, labels = body(spacing=(4.0, 4.0, 4.0))
    for name, image in (("ct", ct), ("labels", labels)):
        sitk.WriteImage(image, str(tmp_path / f"{name}{ending}"))
    with pytest.raises(PatientError, match=r"--space RAS: every file states.*leave --space out"):
        import_request(tmp_path / f"ct{ending}", [tmp_path / f"labels{ending}"], ["2"], space="RAS")


@pytest.mark.parametrize(
    "space", ["left-posterior-superior", "right-anterior-superior", "left-anterior-superior"]
)
def test_spaces_of_the_patient_are_read(tmp_path, space):
    image = body(spacing=(6.0, 6.0, 6.0))[0]
    letters = "".join(word[0] for word in space.split("-")).upper()
    volume = open_ct(nrrd(tmp_path / "ct.nrrd", image, f"space: {space}", signs_to_lps(letters)))
    assert volume.grid.same_as(VoxelGrid.of(image)) and volume.space is None


@pytest.mark.parametrize("space", SPACES)
def test_surfaces(space):
    """They keep facing outward, also in a mirrored space."""
    ball = trimesh.creation.icosphere(radius=10)
    ball.apply_translation([1.0, 2.0, 3.0])
    signs = signs_to_lps(space)
    faces = ball.faces if signs.prod() > 0 else ball.faces[:, ::-1]
    found = in_lps(trimesh.Trimesh(ball.vertices * signs, faces, process=False), space)
    np.testing.assert_allclose(found.vertices, ball.vertices)
    assert volume_mm3(np.array(found.vertices), np.array(found.faces)) > 0


def test_a_surface_that_states_no_space_takes_the_users(tmp_path):
    ct, labels = body(spacing=(4.0, 4.0, 4.0))
    sitk.WriteImage(ct, str(tmp_path / "ct.nrrd"))
    sitk.WriteImage(labels, str(tmp_path / "labels.nrrd"))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=8)
    ball.apply_translation(LEFT[0] * signs_to_lps("RAS"))
    ball.export(tmp_path / "tumour.stl")
    patient = import_request(
        tmp_path / "ct.nrrd", [tmp_path / "labels.nrrd", tmp_path / "tumour.stl"], ["2"], space="RAS"
    )
    np.testing.assert_allclose(patient.tumour.center_mass, LEFT[0], atol=1.0)
    assert patient.space == "RAS"


@pytest.mark.parametrize("space", ["RAS", "LAI"])
@pytest.mark.parametrize("direction", ["oblique", "slices first"])
def test_axes_that_are_not_the_patients(tmp_path, direction, space):
    """The space is that of the coordinates, and not of the voxels' axes."""
    image = body(DIRECTIONS[direction], spacing=(6.0, 6.0, 6.0))[0]
    path = nrrd(tmp_path / "ct.nrrd", image, "space: 3D-right-handed", signs_to_lps(space))
    assert open_ct(path, space=space).grid.same_as(VoxelGrid.of(image))
