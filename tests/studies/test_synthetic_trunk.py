"""The large CT that `study import` imports: the embedded patient's abdomen where it was, in a trunk."""

import numpy as np
import pytest
import SimpleITK as sitk

from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_files import open_labels
from scenes.phantom.embedded_patient import phantom_folder
from studies.performance import import_timing
from studies.performance.import_timing import GAP_MM, PIXELS, write_whole_body


def embedded() -> tuple[sitk.Image, sitk.Image]:
    """CT and labels, read: to make them takes seconds."""
    return tuple(sitk.ReadImage(str(phantom_folder() / name)) for name in ("ct.nrrd", "labels.nrrd"))


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_timing, "make_phantom", embedded)
        return write_whole_body(tmp_path_factory.mktemp("body") / "b", 24)


def test_the_abdomen_is_where_it_was(body):
    volume = open_ct(body / "ct")
    assert volume.grid.size == (PIXELS, PIXELS, 24) and volume.grid.spacing[2] == pytest.approx(GAP_MM)
    found = volume.grid.image(volume.hounsfield())
    ct, labels = embedded()
    expected = sitk.Resample(ct, found, sitk.Transform(), sitk.sitkLinear, -2000)
    inside = sitk.GetArrayViewFromImage(expected) > -2000
    assert inside.mean() > 0.05
    difference = sitk.GetArrayFromImage(found).astype(int) - sitk.GetArrayViewFromImage(expected)
    assert np.abs(difference[inside]).max() <= 1  # rounding
    (marked,) = open_labels(body / "labels.nii.gz").maps(volume.grid)
    again = sitk.Resample(labels, found, sitk.Transform(), sitk.sitkNearestNeighbor, 0)
    assert np.array_equal(marked.values, sitk.GetArrayViewFromImage(again))
    assert (sitk.GetArrayViewFromImage(found)[:, 0, 0] < -900).all()
