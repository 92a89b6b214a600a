"""Parts of a labelled tumour by HU and depth."""

import numpy as np
import pytest

from scenes.tissue_classes.lesion_parts import NECROSIS_BELOW_MEDIAN_HU, PSEUDOCAPSULE_MM, lesion_parts

SHAPE = (40, 36, 32)


def distance(spacing: np.ndarray) -> np.ndarray:
    return np.linalg.norm(
        (np.moveaxis(np.indices(SHAPE), 0, -1) - (np.array(SHAPE) - 1) / 2) * spacing, axis=-1
    )


@pytest.mark.parametrize("spacing", [(0.4, 0.4, 0.4), (0.8, 0.9, 1.2), (1.5, 1.5, 1.5)])
def test_the_pseudocapsule_is_a_shell_of_its_thickness_and_at_least_one_voxel(spacing):
    away = distance(np.array(spacing))
    radius = 7.0 * max(spacing) / 0.8
    tumour = away < radius
    rim = lesion_parts(np.full(SHAPE, 100.0), tumour, np.array(spacing))["pseudocapsule"]
    thickness = max(PSEUDOCAPSULE_MM, min(spacing))
    # Right to a voxel's diagonal on either side.
    slack = np.linalg.norm(spacing)
    assert rim[tumour & (away > radius - thickness + slack / 2)].all()
    assert not rim[away < radius - thickness - slack].any() and not (rim & ~tumour).any()


@pytest.mark.parametrize("off, is_necrosis", [(-1.0, True), (1.0, False)])
def test_what_of_a_tumour_takes_up_no_contrast_agent_is_necrosis(off, is_necrosis):
    away = distance(np.ones(3))
    tumour, core = away < 14.0, away < 6.0
    hu = np.where(core, 110.0 - NECROSIS_BELOW_MEDIAN_HU + off, np.where(tumour, 110.0, -90.0))
    assert (lesion_parts(hu, tumour, np.ones(3))["necrosis"] == (core & is_necrosis)).all()


def test_without_a_tumour_there_are_no_parts():
    assert lesion_parts(np.zeros(SHAPE), np.zeros(SHAPE, bool), np.ones(3)) == {}
