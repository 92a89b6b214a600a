"""The table of mechanical properties, and what a scene takes from it."""

from typing import get_args

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError
from small_bead_case import briefly, small_anatomy

from rehearsal.case import case_of
from rehearsal.pressed_organ import PressedOrgan, parts_of
from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.mechanical_tissues import TABLE, MechanicalProperties, mechanical_properties
from scenes.scene import AnatomyFiles, Scene, SceneError, load_scene
from scenes.tissue import NeoHookeanTissue, PartName, Prony
from sim.fields import array_of
from sim.material import Material

pytestmark = pytest.mark.usefixtures("arrays_stored")

STIFF_TUMOUR = TABLE.parent / "stiff_tumour.toml"


def test_every_part_has_its_ranges_and_their_source():
    table = mechanical_properties()
    assert set(table.parts) == {"kidney", *get_args(PartName)}
    kidney = table.parts["kidney"]
    usual = NeoHookeanTissue()
    assert (kidney.young_kpa[1], kidney.poisson[1]) == (usual.young_kpa, usual.poisson)
    for properties in table.parts.values():
        low, typical, high = properties.young_kpa
        assert 0 < low < typical < high and properties.poisson[2] <= 0.4999
    for line in TABLE.read_text("utf-8").splitlines():
        if " = [" in line:
            assert "#" in line or "poisson" in line or "density" in line, line


def test_a_range_out_of_order_is_refused():
    values = mechanical_properties().model_dump()
    values["friction"] = (0.5, 0.35, 0.1)
    with pytest.raises(ValidationError, match="expected low, typical and high"):
        MechanicalProperties.model_validate(values)


def patient(**parts: trimesh.Trimesh) -> LoadedAnatomy:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=15.0)
    tumour = trimesh.creation.icosphere(subdivisions=2, radius=5.0)
    return LoadedAnatomy(ball, tumour, None, (), parts=parts)


def scene_with(**parts: dict) -> Scene:
    files = AnatomyFiles(tumour="tumour.stl", parts=dict.fromkeys(parts.keys() - {"tumour"}, "part.stl"))
    return Scene(anatomy=files, tissue=dict(cell_mm=5.0, parts=parts), press=dict(warm_up_steps=0))


def test_what_a_part_leaves_out_is_typical_of_it():
    cyst = trimesh.creation.icosphere(subdivisions=2, radius=3.0).apply_translation([8, 0, 0])
    scene, moved = scene_with(tumour=dict(young_kpa=60.0), cyst={}), patient(cyst=cyst)
    moved.organ.apply_translation([1.0, 2.0, 3.0])
    first, second = parts_of(case_of(scene, moved))
    # In the order in which the later one counts.
    assert first.material == Material(0.3, 0.499, 1.01) and second.material == Material(60.0, 0.45, 1.05)
    assert first.surface.center_mass == pytest.approx([7.0, -2.0, -3.0], abs=1e-9)
    with pytest.raises(SceneError, match=r"tissue\.parts\.cyst: this patient has no cyst"):
        parts_of(case_of(scene, patient()))


def test_a_scene_without_parts_is_uniform(device):
    organ = PressedOrgan(case_of(scene_with(), patient()))
    assert not organ.model.has_parts and organ.model.internal_state == {} and not organ.model.has_capsule


def test_parts_capsule_and_relaxation_reach_the_solver_and_the_state_at_rest(device):
    plain = scene_with()
    full = scene_with(tumour={}).model_dump()
    full["tissue"] |= dict(capsule_n_mm=0.5, prony=[dict(modulus_ratio=0.5, time_s=1.0)])
    organ = PressedOrgan(case_of(Scene.model_validate(full), patient()))
    model = organ.model
    assert model.has_parts and model.has_capsule and model.has_relaxation
    assert model.parts == (Material(60.0, 0.45, 1.05),)
    organ.settle()
    assert set(organ.snapshot().solver.internal_state) >= {"elastic_stress", "overstress"}
    assert np.abs(organ.snapshot().solver.internal_state["overstress"]).max() == 0
    keys = [
        tuple(
            repr(each)
            for each in PressedOrgan(case_of(scene, patient()))._inputs()
            if not hasattr(each, "faces")
        )
        for scene in (plain, scene_with(tumour={}), scene_with(tumour=dict(young_kpa=30.0)))
    ]
    assert len(set(keys)) == 3


def test_the_embedded_patient_with_a_stiff_tumour(device):
    scene = load_scene(STIFF_TUMOUR)
    organ = PressedOrgan(case_of(scene, load_anatomy(scene, STIFF_TUMOUR.parent)))
    share = organ.model.lattice.share
    volume = share.T @ organ.model.lattice.tissue.sum(axis=1)
    sinus, urine, tumour = (part.surface.volume for part in organ.parts_of_tissue)
    # The pelvis leaves the kidney, and the calyces lie in the sinus.
    assert volume[2] == pytest.approx(tumour, rel=0.03)
    assert 0.3 * urine < volume[1] < 1.02 * urine and volume[0] < 1.02 * sinus
    assert array_of(organ.model.lame_ratio).max() > 100


def test_a_rehearsal_begins_with_tissue_that_has_relaxed(device):
    """Its rest under its own weight is that of the same tissue without relaxation, however slowly it
    relaxes.
    """
    scene = briefly(200)
    slow = dict(prony=(Prony(modulus_ratio=2.0, time_s=1000.0),), cell_mm=4.0)
    strains = []
    for values in (dict(cell_mm=4.0), slow):
        tissue = scene.tissue.model_copy(update=values)
        organ = PressedOrgan(case_of(scene.model_copy(update=dict(tissue=tissue)), small_anatomy()))
        organ.settle()
        model = organ.model
        corner = array_of(organ.body.position)[model.lattice.cells].astype(float)
        f = np.einsum("mia,mib->mab", corner, model.lattice.gradient)
        strains.append(np.linalg.norm(f.transpose(0, 2, 1) @ f - np.eye(3)))
    # The ball may have rolled a little. If the stress had remained, the strain would be a third.
    assert strains[1] == pytest.approx(strains[0], rel=0.1) and strains[0] > 0.01
