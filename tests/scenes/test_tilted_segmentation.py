"""A DICOM-SEG drawn on a tilted gantry's slices lies where it was drawn."""

import numpy as np
import pytest
from dicom_series import Series, write_segmentation
from scipy.spatial.transform import Rotation
from synthetic_body import level

from scenes.patients.readers.label_files import open_labels

TILT = Rotation.from_euler("x", 18.0, degrees=True).as_matrix()
ORIGIN = np.array([-20.0, -14.0, -30.0])
BALL = np.array([-4.0, 1.0, -12.0]), np.array([7.0, 7.0, 9.0])
SIZE = (40, 60, 24)


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL"])
def test_straightened_as_its_slices_are(tmp_path, kind):
    series = Series(
        tmp_path, TILT, size=SIZE, gap=1.5, positions=lambda k: ORIGIN + [0, 0, 1.5 * k], origin=ORIGIN
    )
    inside = np.stack([level(series.places(k), BALL) < 0 for k in range(SIZE[2])])
    assert not inside[[0, -1]].any()
    file = write_segmentation(tmp_path / "seg.dcm", series, {"Left kidney": inside.astype(float)}, kind=kind)

    (one,) = open_labels(file).maps(None)

    indices = np.argwhere(one.values)[:, ::-1]
    places = one.grid.place(indices)
    np.testing.assert_allclose(one.grid.direction, TILT, atol=1e-6)
    # Within half a pixel and half a slice of the ball, and as much of it.
    reach = BALL[1] + 0.5 * np.linalg.norm(one.grid.spacing)
    assert (level(places, (BALL[0], reach)) < 0).all()
    volume = len(indices) * np.prod(one.grid.spacing)
    assert volume == pytest.approx(4 / 3 * np.pi * BALL[1].prod(), rel=0.03)
    np.testing.assert_allclose(places.mean(axis=0), BALL[0], atol=0.2)
    (segment,) = one.segments.values()
    assert (segment.name, segment.tissue, segment.side) == ("Left kidney", "kidney", "left")
