"""Blood flow at voxels: along drawn vessels, from and to the kidney by their kind, with a parabolic profile."""

import numpy as np
import pytest

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
TISSUES = {1: "kidney", 2: "artery", 3: "vein"}
PLAIN, ENHANCED = 40.0, 200.0


def drawn(value: int, bend: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Labels of a kidney beyond x = 48 mm, which a tube along x enters; and the distance from the tube's centreline [mm]."""
    x, y, z = SPACING[:, None, None, None] * np.indices(SHAPE)
    off = np.hypot(y - 16.0 - bend * np.sin(x / 10), z - 16.0)
    labels = np.where(x > 48.0, 1, 0)
    labels[(off < RADIUS) & (x < 60.0)] = value
    return labels, off


def flow_of(labels: np.ndarray, hu: float | np.ndarray = PLAIN, tissues=None) -> np.ndarray:
    """Flow on the whole grid."""
    low, values = blood_flow(np.broadcast_to(np.float32(hu), SHAPE), labels, tissues or TISSUES, SPACING)
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


def test_an_enhanced_vessel_without_a_label_is_of_the_kind_of_its_neighbour():
    labels, off = drawn(3)
    x = SPACING[0] * np.indices(SHAPE)[0]
    hu = np.where((labels > 0) | (off < RADIUS), ENHANCED, PLAIN)
    labels = np.where((labels == 3) & (x < 36.0), 0, labels)
    flow = flow_of(labels, hu)
    middle = (off < 1.0) & (x > 16.0) & (x < 32.0)
    assert (flow[middle, 0] < -0.05).all()
    # Without any labelled vessel, its kind is unknown.
    flow = flow_of(np.where(labels == 3, 1, labels), hu)
    assert (flow[middle, 3] == np.float32(flow_table()["vessel"]["resistive_index"])).all()


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
    hu = np.where(radius < 8.0, 20.0, 110.0)
    flow = flow_of((radius < 14.0).astype(int), hu, {1: "tumour"})
    assert (flow[radius < 7.5] == 0).all() and (flow[(radius > 8.5) & (radius < 13.5), 4] > 0).all()


def test_no_flow_without_vessels_and_kidney(monkeypatch):
    low, values = blood_flow(np.zeros(SHAPE, np.float32), None, {}, SPACING)
    assert values.shape[-1] == CHANNELS and (values == 0).all()
    monkeypatch.setattr("sim.stored_arrays.FOLDER", None)
    labels, _ = drawn(2)
    again = stored_flow(np.full(SHAPE, PLAIN, np.float32), labels, TISSUES, SPACING)
    low, values = blood_flow(np.full(SHAPE, PLAIN, np.float32), labels, TISSUES, SPACING)
    assert (again[0] == low).all() and again[1] == pytest.approx(values, abs=1e-3)


def test_the_pulse_rises_to_systole_and_falls_until_the_next_beat():
    time = np.linspace(0, BEAT_S, 400, endpoint=False)
    share = np.array([pulse_share(each) for each in time])
    assert share.max() == pytest.approx(1, abs=0.01) and time[share.argmax()] == pytest.approx(
        SYSTOLE_S, abs=0.01
    )
    assert share[0] == 0 and share[-1] < 0.02 and (np.diff(share[time > SYSTOLE_S]) < 0).all()
    assert pulse_share(SYSTOLE_S) == pytest.approx(1) and pulse_share(BEAT_S - 1e-9) == pytest.approx(
        0, abs=1e-7
    )
    assert pulse_share(0.3) == pytest.approx(pulse_share(0.3 + 2 * BEAT_S))
