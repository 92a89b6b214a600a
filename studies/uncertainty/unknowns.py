"""What is not known of a patient's tissue, with its ranges, and the scripted press with given values of it,
in a worker: what the surgeon sees and feels.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np

from rehearsal.case import case_of
from rehearsal.measurements.tumour_measurements import measure
from rehearsal.pressed_organ import attachments_of, parts_of
from rehearsal.rehearsal import Rehearsal
from rehearsal.worker_processes import built_once
from scenes.anatomy import LoadedAnatomy
from scenes.mechanical_tissues import mechanical_properties
from scenes.scene import Scene
from scenes.tissue import NeoHookeanTissue, PartMaterial, PartName
from sim.attachment import total_stiffness
from sim.material import Material
from sim.neo_hookean import NeoHookean
from studies.harness import all_scanlines, rehearsal_of

# Fluid has hardly any shear modulus, whatever the value in the table.
FLUID_POISSON = 0.495
PARENCHYMA = "kidney"


@dataclass(frozen=True)
class Unknown:
    """A parameter: name, unit, range.

    ``is_ratio``: equal ratios are equally likely (log-uniform), and not equal differences (uniform).
    """

    name: str
    unit: str
    low: float
    typical: float
    high: float
    is_ratio: bool = True

    def value(self, share: np.ndarray | float) -> np.ndarray | float:
        """The value at a share of the range, 0 to 1."""
        if self.is_ratio:
            return self.low * (self.high / self.low) ** share
        return self.low + (self.high - self.low) * share


def with_all_parts(scene: Scene, anatomy: LoadedAnatomy) -> Scene:
    """The scene; each part with a surface has its own material: the scene's, or what is typical of it."""
    assert isinstance(scene.tissue, NeoHookeanTissue)
    present = {*anatomy.parts, *(() if anatomy.tumour is None else ("tumour",))}
    typical = {name: PartMaterial() for name in get_args(PartName) if name in present}
    tissue = scene.tissue.model_copy(update={"parts": typical | dict(scene.tissue.parts)})
    return scene.model_copy(update={"tissue": tissue})


def unknowns_of(scene: Scene, anatomy: LoadedAnatomy) -> list[Unknown]:
    """The parameters of a scene ``with_all_parts``, with the ranges of the table of mechanical properties."""
    table, attachment = mechanical_properties(), scene.attachment
    kidney = table.parts[PARENCHYMA]
    unknowns = [
        Unknown(f"{PARENCHYMA} modulus", "kPa", *kidney.young_kpa),
        Unknown(f"{PARENCHYMA} Poisson's ratio", "", *kidney.poisson, is_ratio=False),
    ]
    for part in parts_of(case_of(scene, anatomy)):
        if part.material.poisson < FLUID_POISSON:
            unknowns.append(Unknown(f"{part.name} modulus", "kPa", *table.parts[part.name].young_kpa))
    if getattr(scene.tissue, "capsule_n_mm", 0) > 0:
        unknowns.append(Unknown("capsule", "N/mm", *table.capsule_n_mm))
    if attachment.radius_mm > 0 and attachment.stiffness_n_mm > 0:
        unknowns.append(Unknown("pedicle", "N/mm", *table.pedicle_n_mm))
    if attachment.fat_young_kpa > 0 and anatomy.fat_mm is not None:
        unknowns.append(Unknown("fat modulus", "kPa", *table.fat_young_kpa))
    elif attachment.fat_kpa_mm > 0:
        unknowns.append(Unknown("fat", "kPa/mm", *table.fat_kpa_mm))
    if scene.contact.shape_friction > 0:
        unknowns.append(Unknown("friction", "", *table.friction, is_ratio=False))
    return unknowns


def set_values(rehearsal: Rehearsal, values: Mapping[str, float]) -> None:
    """Give a rehearsal values of the parameters, by their names; others stay as they are."""
    case, organ = rehearsal.case, rehearsal.organ
    model, tissue = organ.model, case.scene.tissue
    assert isinstance(model, NeoHookean) and isinstance(tissue, NeoHookeanTissue)
    parts = [
        Material(
            values.get(f"{part.name} modulus", part.material.young_kpa),
            part.material.poisson,
            part.material.density_g_cm3,
        )
        for part in organ.parts_of_tissue
    ]
    model.set_material(
        values.get(f"{PARENCHYMA} modulus", tissue.young_kpa),
        values.get(f"{PARENCHYMA} Poisson's ratio", tissue.poisson),
        parts,
    )
    if "capsule" in values:
        model.capsule.set_stiffness(values["capsule"])
    if "friction" in values:
        organ.contacts.coefficient = values["friction"]
    keys = {"stiffness_n_mm": "pedicle", "fat_young_kpa": "fat modulus", "fat_kpa_mm": "fat"}
    if not values.keys().isdisjoint(keys.values()):
        changed = {key: values[name] for key, name in keys.items() if name in values}
        attachment = case.scene.attachment.model_copy(update=changed)
        _, tethers = attachments_of(case, attachment)
        model.set_tether(total_stiffness(tethers, model.lattice, case.organ))


# Measured at each depth; those of the tumour only where there is one. Its centroid follows.
QUANTITIES = ("tumour_shift_mm", "to_tumour_mm", "tumour_depth_mm", "margin_mm", "force_n", "compression_mm")


@dataclass(frozen=True)
class PressProblem:
    """A scene and its anatomy, whose press is computed; ``digest`` tells problems apart."""

    scene: Scene
    anatomy: LoadedAnatomy
    digest: str


def press_outcome(problem: PressProblem, values: dict[str, float]) -> np.ndarray:
    """The quantities and the tumour's centroid (depths, 9) [mm, N] of a press with these values.

    NaN for what there is not.
    """
    return _press(built_once(problem.digest, lambda: rehearsal_of(problem.scene, problem.anatomy)), values)


def _press(rehearsal: Rehearsal, values: dict[str, float]) -> np.ndarray:
    """Settle from the stress-free shape, then press by stages, to the same poses for all values."""
    set_values(rehearsal, values)
    case, organ, anatomy = rehearsal.case, rehearsal.organ, rehearsal.anatomy
    press, touches = case.press, all_scanlines(case.probe)
    organ.solver.restart()
    organ.divergence_check.set_initial_state()
    organ.place(rehearsal.pose_at_depth(-200.0))
    organ.come_to_rest()
    organ.place(rehearsal.pose_at_depth(0.0))
    step_s = organ.settings.time_step_s
    outcomes = []
    for stage in range(len(press.indentations_mm)):
        for step in range(press.stage_steps):
            rehearsal.advance(rehearsal.scripted_pose((stage * press.stage_steps + step + 1) * step_s))
        rehearsal.show()
        measurement = measure(anatomy, case.probe, touches)
        quantities = [getattr(measurement, name) for name in QUANTITIES]
        tumour = anatomy.tumour_vertices
        centroid = tumour.mean(axis=0) if len(tumour) else np.full(3, np.nan)
        outcomes.append([*(np.nan if q is None else q for q in quantities), *centroid])
    return np.array(outcomes, float)
