"""Blood flow at voxels: along drawn vessels, from and to the kidney by their kind, with a parabolic
profile.
"""

import numpy as np
import pytest
from conftest import rotation_about

from ultrasound.acoustics import TissueVoxels
from ultrasound.anatomy_volumes import flow_volume
from ultrasound.blood_flow import (
    BEAT_S,
    CHANNELS,
    SYSTOLE_S,
    blood_flow,
    flow_table,
    pulse_share,
    stored_flow,
)

SPACING, SHAPE, RADIUS = np.array([0.8, 0.8, 0.8]), (90, 40, 40), 3.0
TISSUES = {1: "kidney", 2: "artery", 3: "vein", 4: "vessel", 5: "necrosis", 6: "tumour"}


def drawn(value: int, bend: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Labels of a kidney beyond x = 48 mm, which a tube along x enters; and the distance from the tube's
    centreline [mm].
    """
    x, y, z = SPACING[:, None, None, None] * np.indices(SHAPE)
    off = np.hypot(y - 16.0 - bend * np.sin(x / 10), z - 16.0)
    labels = np.where(x > 48.0, 1, 0)
    labels[(off < RADIUS) & (x < 60.0)] = value
    return labels, off


def flow_of(labels: np.ndarray, tissues=None) -> np.ndarray:
    """Flow on the whole grid."""
    low, values = blood_flow(labels, tissues or TISSUES, SPACING)
    whole = np.zeros((*SHAPE, CHANNELS), np.float32)
    whole[tuple(slice(a, a + n) for a, n in zip(low, values.shape, strict=False))] = values
    return whole


@pytest.mark.parametrize("value, kind, sign", [(2, "artery", 1), (3, "vein", -1)])
def test_blood_flows_to_the_kidney_in_arteries_and_from_it_in_veins(value, kind, sign):
    labels, off = drawn(value)
    flow = flow_of(labels)
    middle = (off < 1.0) & (labels == value)
    middle[:10] = middle[65:] = False
    # The path is that of the shortest way, smoothed: along the tube to 5 degrees.
    direction = flow[middle, :3] / np.linalg.norm(flow[middle, :3], axis=1, keepdims=True)
    assert (sign * direction[:, 0] > np.cos(np.radians(5))).mean() > 0.98
    table = flow_table()[kind]
    peak = np.interp(RADIUS, table["radius_mm"], table["peak_cm_s"]) / 100
    assert np.linalg.norm(flow[middle, :3], axis=1).max() == pytest.approx(peak, rel=0.1)
    assert (flow[labels == value, 3] == np.float32(table["resistive_index"])).all()
    assert (flow[labels == value, 4] == 1.0).all() and (flow[labels == 0] == 0).all()


@pytest.mark.parametrize("kind, sign", [("artery", 1), ("vein", -1)])
def test_the_volume_of_flow_is_along_the_vessel_in_thick_oblique_slices(device, kind, sign):
    """A straight vessel of 16 mm into a kidney, off the origin; where it flows and whither, in the
    patient.
    """
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = rotation_about([1, 2, 3], 40) * [0.9, 1.4, 5.0]
    shape, begin, along = (110, 80, 24), np.array([60.0, -40.0, 110.0]), np.array([0.48, 0.64, 0.6])
    mm_from_index[:3, 3] = begin + 25 * along - mm_from_index[:3, :3] @ ((np.array(shape) - 1) / 2)
    places = np.moveaxis(np.indices(shape), 0, -1) @ mm_from_index[:3, :3].T + mm_from_index[:3, 3] - begin
    height = places @ along
    beside = np.linalg.norm(places - height[..., None] * along, axis=-1)
    labels = np.where(height > 36, 1, 0) * (beside < 30)
    labels[(beside < 8) & (height > 0) & (height <= 36)] = 2
    voxels = TissueVoxels(
        np.zeros(shape, np.int16), labels, {1: "sinus", 2: kind}, np.linalg.inv(mm_from_index)
    )
    volume = flow_volume(voxels)
    values, from_mm = volume.values((slice(None),) * 3), volume.index_from_mm
    flows = np.argwhere(np.linalg.norm(values[..., :3], axis=-1) > 0)
    at = flows @ np.linalg.inv(from_mm)[:3, :3].T + np.linalg.inv(from_mm)[:3, 3] - begin
    assert at.mean(axis=0) == pytest.approx(18 * along, abs=2.5)
    middle = flows[(at @ along > 9) & (at @ along < 27)]
    mean = values[tuple(middle.T)][:, :3].mean(axis=0)
    # Both ends of the vessel are half a slice off at most: over its length of 36 mm that is 2 atan(2.5 / 36).
    assert sign * mean @ along > np.cos(2 * np.arctan(2.5 / 36)) * np.linalg.norm(mean)
    # Faster towards the middle: the distance from the wall is right to half a millimetre in the mean of a
    # ring, where the profile's slope is
    # 2 / 8 a millimetre at most. The widest distance is that of the middle of a voxel, 2.4 mm wide in the
    # mean.
    at = middle @ np.linalg.inv(from_mm)[:3, :3].T + np.linalg.inv(from_mm)[:3, 3] - begin
    away = np.linalg.norm(at - np.outer(at @ along, along), axis=1)
    speed = np.linalg.norm(values[tuple(middle.T)][:, :3], axis=1)
    for ring in range(8):
        mean_share = speed[(away >= ring) & (away < ring + 1)].mean() / speed.max()
        assert mean_share == pytest.approx(1 - ((ring + 0.5) / 8) ** 2, abs=0.5 * 2 / 8)
    table = flow_table()[kind]
    slowest, fastest = np.interp([8 - 2.4, 8], table["radius_mm"], table["peak_cm_s"]) / 100
    assert 0.999 * slowest < speed.max() < 1.001 * fastest


def test_the_profile_of_a_vessel_is_parabolic():
    labels, off = drawn(2)
    speed = np.linalg.norm(flow_of(labels)[..., :3], axis=-1)
    within = (
        (labels == 2) & (np.arange(SHAPE[0]) > 12)[:, None, None] & (np.arange(SHAPE[0]) < 55)[:, None, None]
    )
    share = speed[within] / speed[within].max()
    # Distances to the wall are those to the nearest voxel outside, less half a voxel: right to 0.4 mm of 3.
    inner = off[within] < RADIUS - 0.7
    assert share[inner] == pytest.approx(1 - (off[within][inner] / RADIUS) ** 2, abs=0.06)
    assert share[~inner].max() < 0.3


def test_flow_follows_a_bent_vessel():
    labels, _ = drawn(2, bend=4.0)
    flow = flow_of(labels)
    x = SPACING[0] * np.arange(SHAPE[0])
    for i in range(15, 55, 5):
        here = flow[i][labels[i] == 2][:, :3].mean(axis=0)
        assert here[1] / here[0] == pytest.approx(0.4 * np.cos(x[i] / 10), abs=0.12)


def test_a_vessel_of_unknown_kind_is_of_the_kind_of_its_labelled_neighbour():
    labels, off = drawn(3)
    x = SPACING[0] * np.indices(SHAPE)[0]
    labels = np.where((labels == 3) & (x < 36.0), 4, labels)
    flow = flow_of(labels)
    middle = (off < 1.0) & (x > 16.0) & (x < 32.0)
    assert (flow[middle, 0] < -0.05).all()
    # Of the others, those farther than 25 mm from a labelled one keep the table's values of an unknown kind.
    unknown = np.float32(flow_table()["vessel"]["resistive_index"])
    assert (flow[(off < 1.0) & (x < 10.0), 3] == unknown).all()
    assert (flow[(off < 1.0) & (x > 12.0) & (x < 32.0), 3] != unknown).all()
    # Without any labelled vessel, its kind is unknown.
    flow = flow_of(np.where(labels == 3, 1, labels))
    assert (flow[middle, 3] == unknown).all()


def test_small_vessels_of_the_parenchyma_run_outward():
    x = SPACING[:, None, None, None] * np.indices(SHAPE) - np.array([36.0, 16.0, 16.0])[:, None, None, None]
    labels = (np.linalg.norm(x, axis=0) < 14.0).astype(int)
    flow = flow_of(labels, tissues={1: "cortex"})
    speed = np.linalg.norm(flow[..., :3], axis=-1)
    has = (labels == 1) & (speed > 0.005)
    assert 0.1 < has.sum() / (labels == 1).sum() < 0.4
    assert speed.max() <= flow_table()["small"]["cortex"]["peak_cm_s"] / 100 * 1.001
    outward = (flow[..., :3] * np.moveaxis(x, 0, -1)).sum(axis=-1)
    rim = has & (np.linalg.norm(x, axis=0) > 7.0)
    assert (outward[rim] > 0.9 * speed[rim] * np.linalg.norm(x, axis=0)[rim]).mean() > 0.95


def test_the_necrotic_part_of_a_tumour_has_no_flow():
    x = SPACING[:, None, None, None] * np.indices(SHAPE) - np.array([36.0, 16.0, 16.0])[:, None, None, None]
    radius = np.linalg.norm(x, axis=0)
    flow = flow_of(np.select([radius < 8.0, radius < 14.0], [5, 6], 0))
    assert (flow[radius < 8.0] == 0).all() and (flow[(radius >= 8.0) & (radius < 14.0), 4] > 0).all()


def test_no_flow_without_vessels_and_kidney():
    _, values = blood_flow(np.zeros(SHAPE, np.uint8), {}, SPACING)
    assert values.shape[-1] == CHANNELS and (values == 0).all()
    index_from_mm = np.diag([*(1 / SPACING), 1.0])
    for labels in (None, np.zeros(SHAPE, np.uint8)):
        _, values = stored_flow(TissueVoxels(np.zeros(SHAPE, np.int16), labels, TISSUES, index_from_mm))
        assert (values == 0).all()


def test_stored_flow_is_the_flow_whatever_the_hu(monkeypatch):
    monkeypatch.setattr("sim.stored_arrays.FOLDER", None)
    labels, _ = drawn(2)
    low, values = blood_flow(labels, TISSUES, SPACING)
    index_from_mm = np.diag([*(1 / SPACING), 1.0])
    for hu in (40, 200):
        again = stored_flow(TissueVoxels(np.full(SHAPE, hu, np.int16), labels, TISSUES, index_from_mm))
        assert (again[0] == low).all()
        np.testing.assert_allclose(again[1], values, atol=1e-3)


def test_the_pulse_rises_to_systole_and_falls_until_the_next_beat():
    time = np.linspace(0, BEAT_S, 400, endpoint=False)
    share = np.array([pulse_share(instant) for instant in time])
    assert share.max() == pytest.approx(1, abs=0.01) and time[share.argmax()] == pytest.approx(
        SYSTOLE_S, abs=0.01
    )
    assert share[0] == 0 and share[-1] < 0.02 and (np.diff(share[time > SYSTOLE_S]) < 0).all()
    assert pulse_share(SYSTOLE_S) == pytest.approx(1) and pulse_share(BEAT_S - 1e-9) == pytest.approx(
        0, abs=1e-7
    )
    assert pulse_share(0.3) == pytest.approx(pulse_share(0.3 + 2 * BEAT_S))
