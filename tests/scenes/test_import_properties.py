"""Whatever the orientation, the voxels and the file: the surface lies where the label is, and left stays
left.
"""

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic_body import BODY, LEFT, RIGHT, coarsely, drawn, grid_around, voxels_to_boundary

import scenes.patients.patient_import
from scenes.patients.patient_import import import_patient
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.label_merge import merge_label_maps
from scenes.patients.readers.segment_choice import assign_tissues

# Axes of the voxels along the patient's in any order and sense, 48 in all, half of them left-handed.
PERMUTED = [
    np.eye(3)[list(order)] * sign
    for order in [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
    for sign in np.array(np.meshgrid(*[[1, -1]] * 3)).reshape(3, -1).T
]
# Of the label, on which the surface is made; a CT that is coarser is one of fewer voxels.
SPACING, CT_SPACING = st.floats(1.5, 4.0), st.floats(2.5, 4.0)
ANGLE = st.floats(-40.0, 40.0)


@st.composite
def grids(draw, low, high, along=SPACING):
    """Voxels of any spacing and direction that cover a box."""
    turn = Rotation.from_euler("xyz", draw(st.tuples(ANGLE, ANGLE, ANGLE)), degrees=True).as_matrix()
    direction = (
        turn @ draw(st.sampled_from(PERMUTED)) if draw(st.booleans()) else draw(st.sampled_from(PERMUTED))
    )
    spacing = draw(st.tuples(along, along, along))
    crop = np.array(draw(st.tuples(*[st.floats(0.0, 12.0)] * 3)))
    return grid_around(np.array(low) + crop, np.array(high) - crop, spacing, direction)


@pytest.fixture(autouse=True)
def _without_the_support(monkeypatch):
    """Which is tested by itself, and takes most of the time."""
    coarsely(monkeypatch)
    monkeypatch.setattr(scenes.patients.patient_import, "_support", lambda kind, organ, *_: organ)


@settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    ct_grid=grids((-175, -120, -75), (175, 120, 95), CT_SPACING),
    label_grid=grids((25, -5, -55), (115, 75, 80)),
    ending=st.sampled_from([".nii.gz", ".nrrd", ".mha"]),
    side=st.sampled_from(["left", "right"]),
)
def test_the_surface_lies_where_the_label_is(tmp_path_factory, ct_grid, label_grid, ending, side):
    folder = tmp_path_factory.mktemp("import")
    mirror = np.array([1.0 if side == "left" else -1.0, 1.0, 1.0])
    own = LEFT if side == "left" else RIGHT
    if side == "right":
        low, high = np.array([-110.0, -5, -60]), np.array([-20.0, 70, 45])
        label_grid = grid_around(
            low, high, label_grid.GetSpacing(), np.reshape(label_grid.GetDirection(), (3, 3))
        )
    labels = drawn(label_grid, (1, own))
    for name, image in (("ct", drawn(ct_grid, (40, BODY), (120, LEFT), (120, RIGHT))), ("label", labels)):
        write(image, folder / f"{name}{ending}")
    label_map, _ = merge_label_maps(
        assign_tissues(open_labels(folder / f"label{ending}").maps(None), ["1"], {})
    )

    patient = import_patient(
        open_ct(folder / f"ct{ending}"), label_map, label_map.values_of(["1"]), margin_mm=5.0
    )

    assert patient.side == side
    assert np.sign(patient.organ.center_mass[0]) == mirror[0]
    off = voxels_to_boundary(patient.organ, labels)
    assert np.percentile(off, 95) < 0.5
    assert off.mean() < 0.25
    # The label's own centre is off by far less than a voxel, whatever its grid.
    np.testing.assert_allclose(patient.organ.center_mass, own[0], atol=0.25 * max(labels.GetSpacing()))


def write(image: sitk.Image, path) -> None:
    """With nibabel where it is NIfTI: the reader is not to be checked by its own writer's conventions."""
    if not path.name.endswith(".nii.gz"):
        sitk.WriteImage(image, str(path))
        return
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    nifti = nibabel.Nifti1Image(sitk.GetArrayFromImage(image).T, np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine)
    nifti.set_sform(nifti.affine, code=1)
    nibabel.save(nifti, path)
