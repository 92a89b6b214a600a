"""What sound meets in voxels: HU by the published fits, labels before HU, the table's values, texture, and
what HU vary within a tissue.
"""

import numpy as np
import pytest
import trimesh
from conftest import rotation_about

from sim import stored_arrays
from ultrasound import acoustics
from ultrasound.acoustics import (
    ANISOTROPY,
    ATTENUATION,
    BACKSCATTER,
    CORTEX_DB,
    DB_OF_HU,
    IMPEDANCE,
    LEVEL_SMOOTHING_VOXELS,
    MOST_OF_HU_DB,
    OF_HU_MM,
    TissueError,
    TissueVoxels,
    impedance_of_hu,
    impedance_of_tissue,
    properties,
    stored_properties,
    tissue_table,
)
from ultrasound.scanned_anatomy import ScannedAnatomy

TISSUES = [name for name in tissue_table() if name != "hounsfield"]
# Of contrast agent in the corticomedullary phase, far above what density makes of it.
ENHANCED_HU = 185.0
SHAPE = (24, 24, 24)


def block(width: int) -> tuple[slice, ...]:
    """A cube of voxels in the middle of SHAPE."""
    return (slice(12 - width // 2, 12 - width // 2 + width),) * 3


def labelled(width: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """HU and labels: an enhanced cube, label 1, in muscle."""
    hu, labels = np.full(SHAPE, 55.0, np.float32), np.zeros(SHAPE, np.uint8)
    hu[block(width)], labels[block(width)] = ENHANCED_HU, 1
    return hu, labels


def decibel_of(values: np.ndarray) -> np.ndarray:
    """Backscatter against cortex [dB]."""
    return 20 * np.log10(values[..., BACKSCATTER].astype(float)) - CORTEX_DB


def expected(tissue: str) -> list[float]:
    return [tissue_table()[tissue][key] for key in ("impedance_mrayl", "attenuation_db_cm_mhz")]


def anisotropy_of(tissue: str) -> float:
    return tissue_table()[tissue].get("anisotropy_db", 0.0)


@pytest.mark.parametrize(
    "hu, density",
    [
        (-1000.0, 1.2),
        (-100.0, 917.53),
        (0.0, 1011.886),
        (30.0, 1039.134),
        (150.0, 1127.46),
        (700.0, 1475.169),
    ],
)
def test_impedance_is_that_of_the_density_by_schneider_and_the_speed_by_mast(hu, density):
    # By hand, a piece each: 1.02579 * 900 - 5.680; 0.90827 * 1000 + 103.615; the same at 1030; 0.51084 * 1150
    # + 539.998;
    # 0.66254 * 1700 + 348.856; nothing is lighter than air. The coefficients have six figures here.
    speed = (density + 349) / 0.893
    assert float(impedance_of_hu(hu)) == pytest.approx(density * speed * 1e-6, rel=2e-5)


def test_impedance_of_kidney_is_that_of_tables_and_rises_with_hu():
    assert float(impedance_of_hu(30.0)) == pytest.approx(1.615, abs=5e-4)
    assert float(impedance_of_hu(30.0)) == pytest.approx(expected("kidney")[0], rel=0.01)
    # Where pieces meet they differ by less than a step of one HU.
    assert (np.diff(impedance_of_hu(np.arange(-990.0, 2000.0))) > 0).all()


def test_without_labels_everything_goes_by_hu():
    for hu in (-100.0, 40.0, 300.0):
        values = properties(np.full(SHAPE, hu, np.float32))
        assert values.dtype == np.float32 and values.shape == (*SHAPE, 4)
        table = tissue_table()["hounsfield"]
        np.testing.assert_allclose(values[..., IMPEDANCE], float(impedance_of_hu(hu)), rtol=1e-6)
        wanted = np.interp(hu, table["hu"], table["attenuation_db_cm_mhz"])
        np.testing.assert_allclose(values[..., ATTENUATION], wanted, rtol=1e-5)


@pytest.mark.parametrize("tissue", TISSUES)
def test_a_label_wins_over_hu_away_from_borders(tissue):
    hu, labels = labelled()
    by_hu = properties(hu)
    values = properties(hu, labels, {1: tissue, 2: "bone"})
    # Smoothing reaches two voxels.
    core = values[block(10)]
    np.testing.assert_allclose(core[..., :2], np.broadcast_to(expected(tissue), (10, 10, 10, 2)), rtol=1e-6)
    assert core[..., ANISOTROPY] == pytest.approx(anisotropy_of(tissue), rel=1e-5)
    assert (by_hu[..., ANISOTROPY] == 0).all()
    away = np.ones(SHAPE, bool)
    away[block(20)] = False
    assert (values[away] == by_hu[away]).all()
    # Enhanced as it is, HU alone take the cube for parenchyma, not for something denser.
    assert by_hu[12, 12, 12, IMPEDANCE] == pytest.approx(float(impedance_of_hu(55.0)), rel=1e-5)


def test_labels_without_a_tissue_and_the_background_go_by_hu():
    hu, labels = labelled()
    assert (properties(hu, labels, {2: "kidney"}) == properties(hu)).all()
    assert (properties(hu, labels, {}) == properties(hu)).all()
    both = labels.copy()
    both[:12] *= 2
    assert (properties(hu, both, {1: "liver", 2: "liver"}) == properties(hu, labels, {1: "liver"})).all()


@pytest.mark.parametrize("tissue", ["stone", "metal"])
def test_a_small_stone_or_clip_keeps_its_impedance_and_level_and_is_not_anisotropic(tissue):
    hu, labels = labelled()
    labels[block(3)] = 2
    values = properties(hu, labels, {1: "kidney", 2: tissue})
    middle = values[12, 12, 12]
    assert middle[:2] == pytest.approx(expected(tissue), rel=1e-6)
    assert decibel_of(middle) == pytest.approx(tissue_table()[tissue]["backscatter_db"], abs=1e-4)
    assert middle[ANISOTROPY] < 0.1 and values[7, 7, 7, ANISOTROPY] > 1.5
    # Smoothing reaches two voxels: beyond, it is as without.
    without = properties(hu, np.minimum(labels, 1), {1: "kidney"})
    away = np.ones(SHAPE, bool)
    away[block(8)] = False
    np.testing.assert_allclose(values[away], without[away], rtol=1e-6)


def test_arcuate_vessels_are_bright_in_places_between_cortex_and_medulla():
    hu, labels = labelled(20)
    labels[block(10)] = 2
    values = properties(hu, labels, {1: "cortex", 2: "medulla"}, np.full(3, 1.0))
    level = 20 * np.log10(values[..., BACKSCATTER]) - CORTEX_DB
    border, deep = level[7, 8:16, 8:16], level[block(4)]
    assert 0.1 < (border > 0).mean() < 0.5 and deep.max() < -4


def test_an_unknown_tissue_is_refused_with_those_known():
    hu, labels = labelled()
    for name in ("pancreas", "hounsfield"):
        with pytest.raises(
            TissueError, match=f"label 1 is '{name}': no tissue of that name; known: "
        ) as refused:
            properties(hu, labels, {1: name})
        assert all(tissue in str(refused.value) for tissue in TISSUES)


def test_stored_properties_are_computed_once_and_anew_for_another_table(monkeypatch, tmp_path):
    computed: list[int] = []
    monkeypatch.setattr(stored_arrays, "FOLDER", tmp_path / "arrays")
    monkeypatch.setattr(
        acoustics, "properties", lambda *voxels_of: computed.append(1) or properties(*voxels_of)
    )
    hu = np.random.default_rng(0).integers(-50, 90, (9, 8, 7)).astype(np.float32)
    labels, spacing = np.zeros(hu.shape, np.uint8), np.array([1.0, 2.0, 3.0])
    labels[3:6, 2:6, 2:5] = 2
    to_index = np.diag([*(1 / spacing), 1.0])
    for tissues in ({2: "tumour"}, {2: "kidney"}):
        voxels = TissueVoxels(hu, labels, tissues, to_index)
        expected = properties(hu, labels, tissues, spacing)
        for _ in range(2):
            assert np.array_equal(stored_properties(voxels), expected)
    assert len(computed) == 2
    table = tmp_path / "tissues.toml"
    table.write_text(f"{acoustics.TISSUES.read_text('utf-8')}\n# Changed.\n", "utf-8")
    monkeypatch.setattr(acoustics, "TISSUES", table)
    stored_properties(voxels)
    assert len(computed) == 3


def test_voxels_have_their_spacing_along_their_own_axes():
    spacing, turn = np.array([0.8, 1.25, 3.0]), rotation_about([1, 2, 3], 40)
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = turn * spacing
    voxels = TissueVoxels(np.zeros(SHAPE), None, {}, np.linalg.inv(mm_from_index))
    assert voxels.spacing_mm == pytest.approx(spacing)
    anatomy = ScannedAnatomy(trimesh.Trimesh(), np.zeros(SHAPE), np.linalg.inv(mm_from_index))
    assert anatomy.voxel_mm == pytest.approx(spacing)


def test_the_same_voxels_have_the_same_properties():
    hu, labels = labelled()
    hu += np.random.default_rng(1).normal(0, 12, SHAPE).astype(np.float32)
    before = hu.copy(), labels.copy()
    first = properties(hu, labels, {1: "kidney"}, np.array([0.8, 0.9, 1.0]))
    assert (properties(hu, labels, {1: "kidney"}, np.array([0.8, 0.9, 1.0])) == first).all()
    assert (hu == before[0]).all() and (labels == before[1]).all()
    assert np.isfinite(first).all() and (first[..., :ANISOTROPY] > 0).all()


@pytest.mark.parametrize("hu", [60.0, 110.0, 150.0])
def test_contrast_agent_does_not_make_unlabelled_tissue_denser(hu):
    parenchyma = float(impedance_of_hu(55.0))
    # Between liver and muscle of the table.
    assert 1.64 < parenchyma < 1.68
    assert impedance_of_tissue(np.array([hu])) == pytest.approx(parenchyma, rel=1e-6)
    every = np.arange(-990.0, 2000.0)
    assert (np.diff(impedance_of_tissue(every)) >= 0).all()
    unlike = (every > 55) & (every < 300)
    assert (impedance_of_tissue(every) == impedance_of_hu(every))[~unlike].all()


def test_a_labelled_cyst_of_3_mm_reaches_its_level():
    shape = (21, 21, 21)
    away = np.sqrt(((np.indices(shape) - 10) ** 2).sum(axis=0))
    labels = np.where(away <= 1.5, 2, 1)
    values = properties(np.full(shape, 120, np.int16), labels, {1: "kidney", 2: "cyst"}, np.ones(3))
    level = 20 * np.log10(values[10, 10, 10, BACKSCATTER]) - CORTEX_DB
    # Of the smoothing's 27 voxels the 8 at the corners are kidney, with 1 % of the weight.
    assert level == pytest.approx(tissue_table()["cyst"]["backscatter_db"], abs=1.5)


@pytest.mark.parametrize("tissue", TISSUES)
def test_every_tissue_has_sane_values(tissue):
    table = tissue_table()[tissue]
    keys = {"impedance_mrayl", "attenuation_db_cm_mhz", "backscatter_db", "texture_db", "texture_mm"}
    assert set(table) - {"anisotropy_db", "follows_hu"} == keys and 0 <= anisotropy_of(tissue) < 6
    # By which parenchyma, and so the renal capsule, is known.
    assert (anisotropy_of(tissue) > 1.0) == (tissue in ("kidney", "cortex", "medulla"))
    # From fat to cortical bone, or titanium, from water to what nothing passes; and no echo above all of the
    # sound.
    assert (0.0 if tissue == "gas" else 1.3) < table["impedance_mrayl"] < (
        28.0 if tissue == "metal" else 8.0
    ) and 0 < table["attenuation_db_cm_mhz"] <= 12.0
    assert -70.0 < table["backscatter_db"] < -10.0 - CORTEX_DB
    assert 0 <= table["texture_db"] < 6.0 and 0.5 <= table["texture_mm"] <= 5.0


def test_the_table_has_the_values_of_the_literature():
    wanted = {
        "kidney": (1.62, 0.7),
        "fat": (1.38, 0.63),
        "vessel": (1.61, 0.18),
        "liver": (1.65, 0.5),
        "bone": (7.8, 9.0),
    }
    for tissue, values in wanted.items():
        assert expected(tissue) == pytest.approx(values)
    by_hu = tissue_table()["hounsfield"]
    assert (np.diff(by_hu["hu"]) > 0).all()
    assert len(by_hu["hu"]) == len(by_hu["attenuation_db_cm_mhz"]) == len(by_hu["backscatter_db"])


@pytest.mark.parametrize("tissue", ["kidney", "tumour", "vessel"])
def test_backscatter_has_the_tables_level_and_texture(tissue):
    table, spacing, shape = tissue_table()[tissue], 0.3, (64, 64, 64)
    values = properties(
        np.full(shape, 120.0, np.float32), np.ones(shape, np.uint8), {1: tissue}, np.full(3, spacing)
    )
    decibel = 20 * np.log10(values[..., BACKSCATTER].astype(float))
    # Some 200 patches, of which the mean is an SD of 0.07 off that of texture.
    level = table["backscatter_db"] + CORTEX_DB
    assert decibel.mean() == pytest.approx(level, abs=0.01 + 0.2 * table["texture_db"])
    # Of patches of SD s voxels, cut at 2 SD (0.88 s), the smoothing by 0.5 voxels takes 1 - (1 + (0.5 / 0.88
    # s)^2)^-0.75.
    patch = table["texture_mm"] / 2 / spacing
    kept = (1 + (0.5 / (0.88 * patch)) ** 2) ** -0.75
    assert decibel.std() == pytest.approx(kept * table["texture_db"], rel=0.03, abs=1e-4)
    if table["texture_db"]:
        # Noise through a Gaussian of half the distance correlates by exp(-1) over it, here with 0.07 of
        # sampling.
        lag, off = round(table["texture_mm"] / spacing), decibel - decibel.mean()
        along = np.mean([(np.roll(off, lag, axis) * off).mean() for axis in range(3)]) / off.var()
        assert along == pytest.approx(np.exp(-1), abs=0.15)


# What is denser in the renal sinus are vessels and calyces.
DARKER = ["sinus"]


def variation(hu: np.ndarray, tissue: str = "kidney", spacing_mm: float = 1.0) -> np.ndarray:
    """How the level [dB] of a tissue varies with HU: against the same voxels, and so the same texture, of
    even HU.
    """
    labels, spacing = np.ones(hu.shape, np.uint8), np.full(3, spacing_mm)
    varied, even = (
        properties(values.astype(np.float32), labels, {1: tissue}, spacing) for values in (hu, 0 * hu + 40)
    )
    assert np.array_equal(varied[..., :BACKSCATTER], even[..., :BACKSCATTER])
    return decibel_of(varied) - decibel_of(even)


def stripes(width: int, hu: float) -> np.ndarray:
    """HU of stripes of a width in voxels, as much above 40 as below."""
    at = np.arange(80) // width % 2
    return np.broadcast_to((40 + hu * (2 * at - 1))[:, None, None], (80, 20, 20))


@pytest.mark.parametrize("tissue", TISSUES)
def test_what_is_denser_in_the_ct_scatters_more_and_the_mean_stays(tissue):
    """But for fluids and what is drawn."""
    level = variation(stripes(20, 10.0), tissue)
    middle = level[[10, 30, 50, 70], 10, 10]
    # Amid stripes as wide as 13 SDs of the smoothing all of it is there; in float32 of some -40 dB.
    factor = tissue_table()[tissue].get("follows_hu", 0.0)
    assert factor or not level.any()
    assert middle == pytest.approx(factor * DB_OF_HU * np.array([-10.0, 10.0, -10.0, 10.0]), abs=1e-4)
    assert (factor < 0) == (tissue in DARKER)
    # Half of the voxels are above the tissue's median as far as the other half is below it.
    assert variation(stripes(10, 10.0), tissue).mean() == pytest.approx(0.0, abs=1e-3)


def test_a_few_decibels_are_the_most_that_hu_make():
    level = variation(stripes(20, 800.0))
    assert level[[10, 30, 50, 70], 10, 10] == pytest.approx(
        MOST_OF_HU_DB * np.array([-1, 1, -1, 1]), abs=1e-4
    )
    assert 2.0 <= np.abs(level).max() <= MOST_OF_HU_DB + 1e-4 <= 4.0


def test_the_border_of_two_tissues_is_no_variation_however_far_apart_their_hu_are():
    hu, labels = labelled()
    tissues = {0: "fat", 1: "kidney"}
    borders = properties(np.where(labels, 200.0, -100.0), labels, tissues)
    assert np.array_equal(borders, properties(hu * 0, labels, tissues))


def gaussian(sd: float, reach_sd: float) -> np.ndarray:
    """A Gaussian of an SD in voxels, cut at so many SDs, whose sum is 1."""
    reach = int(reach_sd * sd + 0.5)
    values = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sd) ** 2)
    return values / values.sum()


@pytest.mark.parametrize("spacing", [0.5, 0.8, 1.2])
def test_noise_of_a_ct_does_not_become_texture(spacing):
    shape, sd_hu = (72, 72, 72), 12.0
    noise = np.random.default_rng(4).normal(40, sd_hu, shape)
    sd = variation(noise, spacing_mm=spacing)[8:-8, 8:-8, 8:-8].std()
    # White noise through a kernel keeps its SD times the root of the sum of the kernel's squares; along each
    # axis the kernel is two Gaussians, that of HU and that of the level, one after the other.
    kernel = np.convolve(gaussian(OF_HU_MM / spacing, 2.0), gaussian(LEVEL_SMOOTHING_VOXELS, 2.5))
    wanted = DB_OF_HU * sd_hu * (kernel**2).sum() ** 1.5
    # Of 56^3 voxels some 56^3 / (2 sqrt(pi) s)^3 are independent: at least 500, of which the SD is known to 1
    # / sqrt(1000).
    assert sd == pytest.approx(wanted, rel=0.08)
    # Less than a third of the texture of parenchyma.
    assert sd < 0.35 * tissue_table()["kidney"]["texture_db"]
