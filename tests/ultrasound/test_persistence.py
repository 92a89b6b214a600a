"""Persistence: a weighted mean that each viewer has of its own, and what it begins anew with."""

from dataclasses import replace

import numpy as np
import pytest
from test_scanner import PROBE, plane_at

from ultrasound.persistence import Persistence
from ultrasound.scanner import B_MODE, CT, PlaneImages

SHARE, SHAPE = 0.6, (20, 24)


def images_of(number: int, shape=SHAPE, probe=PROBE, version: int = 0, name: str = B_MODE) -> PlaneImages:
    """Images of noise, which its number determines."""
    grey = np.random.default_rng(number).integers(0, 256, shape).astype(np.uint8)
    return PlaneImages({name: grey}, plane_at(), probe, version, number)


def shown(persistence: Persistence, images: PlaneImages, share: float = SHARE) -> np.ndarray:
    return persistence.mixed(images, share).by_name[B_MODE]


def test_each_image_has_its_share_of_the_mean_before():
    persistence, mean = Persistence(), images_of(0).by_name[B_MODE].astype(float)
    for number in range(5):
        grey = images_of(number).by_name[B_MODE]
        mean = SHARE * mean + (1 - SHARE) * grey
        # Half a grey value by rounding, and float32 of 255.
        assert np.abs(shown(persistence, images_of(number)) - mean).max() <= 0.5 + 1e-3
    for _ in range(30):
        mixed = shown(persistence, images_of(number))
    assert np.abs(mixed.astype(float) - grey).max() <= 1.0


def test_the_first_image_and_one_without_a_share_are_bit_for_bit_themselves():
    persistence = Persistence()
    for number, share in ((0, SHARE), (1, 0.0), (2, 0.0), (3, SHARE)):
        assert np.array_equal(shown(persistence, images_of(number), share), images_of(number).by_name[B_MODE])


@pytest.mark.parametrize(
    "other",
    [
        dict(shape=(24, 20)),
        dict(probe=PROBE.model_copy(update={"gain_percent": 61.0})),
        dict(version=1),
    ],
    ids=["shape", "probe", "crater"],
)
def test_it_begins_anew_with_another_shape_probe_or_crater(other):
    persistence = Persistence()
    shown(persistence, images_of(0))
    assert np.array_equal(shown(persistence, images_of(1, **other)), images_of(1, **other).by_name[B_MODE])
    assert np.array_equal(shown(persistence, images_of(2)), images_of(2).by_name[B_MODE])


def test_it_begins_anew_after_the_ct_alone():
    persistence = Persistence()
    shown(persistence, images_of(0))
    alone = images_of(1, name=CT)
    assert persistence.mixed(alone, SHARE) is alone
    assert np.array_equal(shown(persistence, images_of(2)), images_of(2).by_name[B_MODE])


def test_other_images_and_the_given_ones_stay_as_they_are():
    persistence = Persistence()
    for number in (1, 2):
        grey, ct = images_of(number).by_name[B_MODE], images_of(-number % 7, name=CT).by_name[CT]
        images = replace(images_of(number), by_name={B_MODE: grey.copy(), CT: ct})
        mixed = persistence.mixed(images, SHARE)
        assert list(mixed.by_name) == [B_MODE, CT] and mixed.by_name[CT] is ct
        assert np.array_equal(images.by_name[B_MODE], grey) and mixed.location == images.location
