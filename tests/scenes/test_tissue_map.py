"""All tissues of a CT: labels before HU, the same each time, and what is drawn marked."""

import numpy as np
import pytest
from ellipsoid_kidney import in_ball, surface
from made_abdomen import abdomen

from scenes.anatomy import load_anatomy
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import EMBEDDED, load_scene
from scenes.tissue_classes.tissue_map import (
    CODE,
    CONCAVITY_MM,
    TISSUES,
    KidneyShape,
    codes_of_labels,
    of_tissues,
    tissue_arrays,
    tissue_map,
)
from ultrasound.acoustics import tissue_table

SHAPE = (72, 60, 96)
SPACING = np.array([1.0, 1.0, 1.2])
AT = (np.moveaxis(np.indices(SHAPE), 0, -1) - (np.array(SHAPE) - 1) / 2) * SPACING
INDEX_FROM_MM = np.diag([*(1 / SPACING), 1.0])
INDEX_FROM_MM[:3, 3] = (np.array(SHAPE) - 1) / 2
FAT, PLAIN, ENHANCED = -100.0, 35.0, 180.0
HALF_AXES = np.array([22.0, 18.0, 40.0])
HOLLOW_AT, HOLLOW_MM = np.array([-22.0, 0.0, 0.0]), 9.0


def from_kidney(points: np.ndarray) -> np.ndarray:
    """Distance [mm], nearly, from an ellipsoid with a hollow at one side."""
    scaled = np.linalg.norm(points / HALF_AXES, axis=-1)
    body = (scaled - 1) * scaled / np.maximum(np.linalg.norm(points / HALF_AXES**2, axis=-1), 1e-9)
    return np.maximum(body, -in_ball(HOLLOW_AT, HOLLOW_MM)(points))


ORGAN = surface(from_kidney, reach_mm=(26.0, 22.0, 44.0))
KIDNEY = from_kidney(AT) < 0
HOLLOW = (in_ball(HOLLOW_AT, HOLLOW_MM)(AT) < 0) & (np.linalg.norm(AT / HALF_AXES, axis=-1) < 1)


def scene(level: float, **pieces: tuple[np.ndarray, float]) -> np.ndarray:
    """HU of a kidney in fat, with pieces of other HU."""
    hu = np.where(KIDNEY, level, FAT)
    for where, value in pieces.values():
        hu = np.where(where, value, hu)
    return np.rint(hu).astype(np.int16)


def labelled(**parts: np.ndarray) -> np.ndarray:
    labels = np.where(KIDNEY, CODE["kidney"], 0).astype(np.uint8)
    for name, where in parts.items():
        labels[where] = CODE[name]
    return labels


def found_in(hu: np.ndarray, labels: np.ndarray | None = None, draws: bool = False):
    return tissue_map(hu, labelled() if labels is None else labels, ORGAN, INDEX_FROM_MM, draws)


def ball(x: float, y: float, z: float, radius: float) -> np.ndarray:
    return np.linalg.norm(AT - [x, y, z], axis=-1) < radius


def test_every_tissue_has_acoustic_properties_and_a_code_of_its_own():
    assert len(set(TISSUES)) == len(TISSUES) < 256 and set(TISSUES) <= set(tissue_table())
    codes = codes_of_labels(np.array([[[0, 3, 7, 9]]]), {3: "artery", 7: "cyst", 12: "fat"})
    assert codes.dtype == np.uint8 and codes.ravel().tolist() == [0, CODE["artery"], CODE["cyst"], 0]
    assert of_tissues(codes, "cyst", "fat").ravel().tolist() == [False, False, True, False]


@pytest.mark.parametrize("level", [PLAIN, ENHANCED])
@pytest.mark.parametrize("draws", [False, True])
def test_labels_win_over_everything_but_the_whole_kidney(level, draws):
    rng = np.random.default_rng(5)
    names = (
        "artery",
        "vein",
        "urine",
        "sinus",
        "cortex",
        "medulla",
        "cyst",
        "fat",
        "muscle",
        "bone",
        "liver",
        "fluid",
    )
    labels = labelled()
    for n, name in enumerate(names):
        labels[ball(*rng.uniform([-20, -16, -36], [20, 16, 36]), 4.0 + n % 3)] = CODE[name]
    # HU that mean something else: fat in the kidney, bone and gas in labelled muscle. Stones may be in
    # labelled parenchyma and sinus.
    hu = scene(level).astype(float)
    hu[(labels > 0) & (labels != CODE["kidney"])] = rng.choice([-900, -100, 60, 120])
    classes = found_in(np.rint(hu).astype(np.int16), labels, draws)
    own = (labels > 0) & (labels != CODE["kidney"])
    assert len(np.unique(labels[own])) > 8 and (classes.codes[own] == labels[own]).all()
    assert not classes.drawn[own].any()
    assert (classes.hu == np.rint(hu)).all()


def test_the_same_ct_has_the_same_tissues_and_no_input_is_changed():
    body = abdomen("right", True, (5.0, 5.0, 5.0))
    inputs = body.hu.copy(), body.labels.copy(), body.index_from_mm.copy()
    first = tissue_map(body.hu, body.labels, body.organ, body.index_from_mm)
    again = tissue_arrays(body.hu, body.labels, body.organ, body.index_from_mm, 1)
    assert all(np.array_equal(one, two) for one, two in zip(first.arrays, again, strict=True))
    assert all(
        np.array_equal(*pair) for pair in zip(inputs, (body.hu, body.labels, body.index_from_mm), strict=True)
    )
    assert (first.codes > 0).all()


def test_what_no_ct_shows_is_drawn_on_request_and_marked():
    hu = scene(PLAIN, muscle=(AT[..., 1] > 25.0, 55.0))
    plain, drawn = found_in(hu), found_in(hu, draws=True)
    assert not plain.drawn.any() and not plain.mask("cortex", "medulla", "fascia", "perimysium").any()
    changed = plain.codes != drawn.codes
    assert changed.any() and drawn.drawn[changed].all()
    assert drawn.mask("medulla").sum() > 0.05 * KIDNEY.sum()
    # Pyramids are of the parenchyma, fascia of fat.
    assert (
        plain.mask("kidney")[drawn.mask("cortex", "medulla")].all()
        and plain.mask("fat")[drawn.mask("fascia")].all()
    )


def test_where_the_phase_shows_pyramids_none_are_drawn():
    depth = -np.maximum(from_kidney(AT), np.linalg.norm(AT / HALF_AXES, axis=-1) * 18 - 18)
    medulla = KIDNEY & (depth > 6.0) & (np.abs(AT[..., 2] % 16 - 8) < 6)
    classes = found_in(scene(190.0, medulla=(medulla, 85.0)), draws=True)
    assert not classes.drawn[KIDNEY].any()
    both = classes.mask("medulla") & medulla
    assert 2 * both.sum() > 0.8 * (classes.mask("medulla").sum() + medulla.sum())


@pytest.mark.parametrize("level", [PLAIN, ENHANCED])
def test_fat_in_the_hollow_is_sinus_and_fat_around_the_kidney_is_not(level):
    classes = found_in(scene(level))
    inner = (
        HOLLOW
        & (np.linalg.norm((AT - [2.0, 0.0, 0.0]) / HALF_AXES, axis=-1) < 0.85)
        & (from_kidney(AT) > 1.5)
    )
    assert inner.sum() > 50 and classes.mask("sinus")[inner].all()
    outside = np.linalg.norm(AT / HALF_AXES, axis=-1) > 1.15
    assert not classes.mask("sinus")[outside].any() and classes.mask("fat")[outside & (AT[..., 0] > 0)].all()


def test_small_stones_remain():
    stone = ball(8.0, 2.0, 10.0, 1.1)
    assert stone.sum() < 12
    assert found_in(scene(PLAIN, stone=(stone, 700))).mask("stone")[stone].all()


def test_stones_are_not_drawn_though_the_parenchyma_about_them_is():
    stone = ball(-14.0, 0.0, 10.0, 2.5) & KIDNEY
    classes = found_in(scene(PLAIN, stone=(stone, 700)), draws=True)
    assert classes.mask("stone")[stone].all() and not (classes.drawn & classes.mask("stone")).any()
    assert classes.drawn[KIDNEY].any()


def test_contrast_agent_in_labelled_urine_and_about_it_is_no_stone():
    urine, agent = ball(6.0, 0.0, 0.0, 4.0), ball(6.0, 0.0, 0.0, 4.6)
    classes = found_in(scene(ENHANCED, agent=(agent, 500)), labelled(urine=urine))
    assert not classes.mask("stone").any() and classes.mask("urine")[urine].all()
    # A stone in the sinus of a plain CT is one though the sinus is labelled.
    classes = found_in(scene(PLAIN, stone=(agent, 700)), labelled(sinus=ball(6.0, 0.0, 0.0, 8.0)))
    assert classes.mask("stone")[agent].all()


def test_what_has_a_label_is_no_bone():
    bone = ball(30.0, 0.0, 0.0, 9.0)
    hu = scene(PLAIN, bone=(bone & ~KIDNEY, 700))
    muscle = bone & (AT[..., 2] > 0) & ~KIDNEY
    classes = found_in(hu, labelled(muscle=muscle))
    assert (
        classes.mask("muscle")[muscle].all() and classes.mask("bone")[bone & ~muscle & ~KIDNEY].mean() > 0.9
    )
    assert found_in(hu).mask("bone")[bone & ~KIDNEY].mean() > 0.9


def test_a_clip_is_metal_and_what_is_brighter_than_parenchyma_outside_is_blood_with_contrast_agent():
    clip, vessel = ball(-30.0, -20.0, 0.0, 1.2), ball(-28.0, 18.0, 20.0, 5.0)
    classes = found_in(scene(ENHANCED, clip=(clip, 3000), vessel=(vessel, 190)))
    assert classes.mask("metal")[clip].all()
    assert classes.mask("vessel")[vessel & (from_kidney(AT) > 3.0)].mean() > 0.7
    assert (
        not found_in(scene(PLAIN, vessel=(vessel, 45)))
        .mask("vessel")[~HOLLOW & (from_kidney(AT) > 1.5)]
        .any()
    )


def test_a_tumour_has_its_parts():
    tumour, core = ball(8.0, 0.0, 20.0, 8.0), ball(8.0, 0.0, 20.0, 3.0)
    classes = found_in(scene(ENHANCED, tumour=(tumour, 110), core=(core, 20)), labelled(tumour=tumour))
    assert classes.mask("necrosis")[core].all() and not classes.mask("necrosis")[~tumour].any()
    parts = classes.mask("tumour", "pseudocapsule", "necrosis")
    assert (parts == tumour).all()


@pytest.mark.parametrize("share, is_closed", [(0.75, True), (1.2, False)])
def test_a_groove_is_a_hollow_where_no_ball_goes_in(share, is_closed):
    width = share * 2 * CONCAVITY_MM

    def block(points):
        box = np.abs(points) - [26.0, 24.0, 30.0]
        groove = np.maximum(np.abs(points[..., 0]) - width / 2, -12.0 - points[..., 1])
        return np.maximum(box.max(axis=-1), -groove)

    organ = surface(block, reach_mm=(30.0, 28.0, 34.0))
    shape = KidneyShape.of(organ, INDEX_FROM_MM, SHAPE)
    at = AT[shape.box]
    # A ball rests on the walls' edges and dips in by R (1 - sqrt(1 - share^2)), 5 mm of 36; the grid is of 2
    # mm.
    deep = (
        (np.abs(at[..., 0]) < width / 2 - 2.5)
        & (at[..., 1] > -9.0)
        & (at[..., 1] < 12.0)
        & (np.abs(at[..., 2]) < 12.0)
    )
    if not is_closed:
        deep &= np.abs(at[..., 0]) < 2.0
    assert shape.hollow[deep].all() if is_closed else not shape.hollow[deep].any()
    assert not (shape.hollow & shape.inside).any()


@pytest.fixture(scope="module")
def embedded():
    phantom_folder()
    return load_anatomy(load_scene(EMBEDDED), EMBEDDED.parent)


def test_the_embedded_patients_cortex_and_medulla_are_found_by_hu_without_their_labels(embedded):
    """Late in the corticomedullary phase, of cortex of 185 HU and medulla of 108."""
    labels = codes_of_labels(embedded.labels.voxels, embedded.tissues)
    truth = {name: labels == CODE[name] for name in ("cortex", "medulla")}
    if not truth["medulla"].any():
        pytest.skip("the embedded patient's labels do not tell medulla from cortex")
    unlabelled = np.where(of_tissues(labels, "cortex", "medulla"), CODE["kidney"], labels).astype(np.uint8)
    classes = tissue_map(embedded.ct.voxels, unlabelled, embedded.organ, embedded.ct.index_from_mm)
    factors = np.array(classes.codes.shape) // labels.shape
    assert (factors == 1).all()
    # The border is right to half a voxel of pyramids some 14 mm wide.
    for name, least in (("medulla", 0.75), ("cortex", 0.85)):
        mask = classes.mask(name)
        assert 2 * (mask & truth[name]).sum() > least * (mask.sum() + truth[name].sum()), name
    assert not (classes.drawn & truth["medulla"]).any()
