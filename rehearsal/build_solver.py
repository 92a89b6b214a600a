"""Build the solver of a scene: tissue model, contacts and tool; the settings of its steps."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import trimesh

from scenes.scene import Contact, SolverSection
from scenes.tissue import TissueSection
from sim.attachment import FixedRegion, Tether
from sim.material import Part
from sim.neo_hookean import NeoHookean
from sim.sampling import RestBody
from sim.self_contact import SelfContacts
from sim.shape_matching import ShapeMatching
from sim.shapes import ConvexTool, SignedDistanceField
from sim.solver import Solver, StepSettings
from sim.tissue_model import ModelInputs, TissueModel
from ultrasound.probe import Probe

# Flats that approximate the arc of a curved array: of 60 mm and 60 degrees, to 0.1 mm.
ARC_FLATS = 11


# The class that computes each tissue model of scenes/tissue.py.
TISSUE_MODELS: dict[str, type[TissueModel]] = {"neo-hookean": NeoHookean, "shape-matching": ShapeMatching}


def model_of(tissue: TissueSection) -> type[TissueModel]:
    """The class that computes a tissue."""
    return TISSUE_MODELS[tissue.model]


def static_shape(mesh: trimesh.Trimesh, tissue: TissueSection) -> SignedDistanceField:
    """The signed distance field of a fixed closed surface [mm], as far around as the tissue model needs
    it.
    """
    return SignedDistanceField.of_surface(mesh.vertices, mesh.faces, model_of(tissue).reach_mm(tissue))


def tool_of(probe: Probe) -> ConvexTool:
    """The tool: the probe's housing, with an arc of flats as the face of a curved array."""
    size = np.array(probe.housing_mm)
    if probe.radius_mm == 0:
        return ConvexTool.cuboid(size, probe.edge_radius_mm)
    angle = np.radians(np.linspace(probe.theta_start_deg, probe.theta_stop_deg, ARC_FLATS))
    arc = np.column_stack([np.sin(angle), np.zeros(ARC_FLATS), -np.cos(angle)])
    centre = np.array([0.0, 0.0, probe.radius_mm - size[2] / 2])
    # All sides of the cuboid except the one that the arc replaces.
    sides = np.concatenate([np.eye(3), -np.eye(3)[:2]])
    offsets = np.concatenate([size / 2, size[:2] / 2, arc @ centre + probe.radius_mm])
    return ConvexTool(np.concatenate([sides, arc]), offsets, probe.edge_radius_mm)


def embedding_cell_mm(tissue: TissueSection) -> float:
    """Width [mm] of the coarse tetrahedra that embed the image plane."""
    return model_of(tissue).EMBEDDING_CELL_RATIO * tissue.size_mm


def step_settings(tissue: TissueSection, section: SolverSection) -> StepSettings:
    """The settings of a step: the scene's, else the tissue model's, else the paper's."""
    names = {field.name for field in fields(StepSettings)}
    values = tissue.model_dump() | dict(tissue.step_defaults) | section.model_dump(exclude_none=True)
    own = {name: value for name, value in values.items() if name in names}
    return replace(StepSettings(damping=section.damping_per_s), **own)


def build_solver(
    organ: trimesh.Trimesh | RestBody,
    tissue: TissueSection,
    shapes: list,
    tool: ConvexTool | None,
    contact: Contact | None = None,
    section: SolverSection | None = None,
    serial: bool | None = None,
    fixed: Sequence[FixedRegion] = (),
    tethers: Sequence[Tether] = (),
    parts: Sequence[Part] = (),
) -> Solver:
    """A solver of the organ [mm] among shapes, the tool among them; ``parts`` of it have their own material.
    Raises SamplingError.

    Shape matching also takes an organ that was filled before (``sim.shape_matching.fill_organ``). ``serial``
    says whether a step is one kernel on one core; left open, the body's size and the machine decide.
    """
    contact, section = contact or Contact(), section or SolverSection()
    scaling = section.mass_scaling_per_mm
    inputs = ModelInputs(
        organ,
        tissue,
        shapes,
        contact.shape_friction,
        fixed,
        tethers,
        parts,
        serial,
        section.relaxation,
        scaling,
    )
    model: Any = model_of(tissue).make(inputs)
    self_contacts = SelfContacts(model, contact.particle_friction) if contact.particles else None
    return Solver(model, self_contacts, tool)
