"""The tissue models as a scene names them: each put on the device with its contacts, ready to step."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh

from scenes.scene import Contact, SolverSection
from scenes.tissue import ShapeMatchingTissue, TissueSection
from sim.body import Body, ParticleBody, RestBody, fill_body
from sim.contact import REACH_RADII, ShapeContacts
from sim.lattice import fill_with_cells, surface_points
from sim.neighbours import ParticleContacts
from sim.neo_hookean import LATTICE_SETTINGS, NeoHookean
from sim.patches import arrange
from sim.sampling import SamplingError
from sim.shape_matching import ShapeMatching
from sim.shapes import ConvexTool, SignedDistanceField
from sim.solver import Solver, StepSettings
from sim.surface_contact import REACH_MM, SurfaceContacts
from ultrasound.array import Probe

# Points of the surface that can touch are this share of a cell apart.
POINTS_A_CELL = 0.5
# Flats that stand for the arc of a curved array: of 60 mm and 60 degrees, they are nowhere 0.1 mm off it.
ARC_FLATS = 11


@dataclass(frozen=True)
class Held:
    """Tissue that stays where it is: all within a distance [mm] of a place (3,) [mm]."""

    at_mm: np.ndarray
    radius_mm: float

    def nodes(self, nodes: np.ndarray) -> np.ndarray:
        """Which nodes (n, 3) are held. Raises SamplingError where there are none, or where all are."""
        apart = np.linalg.norm(nodes - self.at_mm, axis=1)
        held = apart <= self.radius_mm
        if held.all() or not held.any():
            raise SamplingError(
                f"attachment.radius_mm = {self.radius_mm:g} holds {'all' if held.all() else 'none'} of the organ, which lies "
                f"{apart.min():.1f} to {apart.max():.1f} mm from attachment.at_mm: choose another radius or place"
            )
        return held


@dataclass(frozen=True)
class Parts:
    """What a solver is put together from: an organ [mm] of a tissue among shapes, the tool among them (``build_solver``)."""

    organ: Any
    tissue: Any
    shapes: list
    tool: ConvexTool | None
    contact: Contact
    section: SolverSection
    serial: bool | None
    held: Held | None


@dataclass(frozen=True)
class Kind:
    """What is asked of a tissue model besides its ``TissueModel``.

    ``build`` puts its solver together and raises SamplingError; ``settings`` is its own choice of a step for a tissue;
    ``reach_mm`` is how far around a shape a tissue asks for its distance, and the coarse tetrahedra that carry the image
    plane are ``embedding_sizes`` sizes of the tissue wide. ``reported`` is its line of a report, with names of its section and
    of its counts.
    """

    build: Callable[[Parts], Solver]
    settings: Callable[[Any], StepSettings]
    reach_mm: Callable[[Any], float]
    embedding_sizes: float
    reported: str


def static_shape(mesh: trimesh.Trimesh, tissue: TissueSection) -> SignedDistanceField:
    """What a closed surface [mm] that does not move is to a tissue: distances as far around as it asks for them."""
    return SignedDistanceField.of_surface(mesh.vertices, mesh.faces, KINDS[tissue.model].reach_mm(tissue))


def tool_of(probe: Probe) -> ConvexTool:
    """What touches the tissue: the probe's housing, its face an arc of flats where the array is curved."""
    size = np.array(probe.housing_mm)
    if probe.radius_mm == 0:
        return ConvexTool.cuboid(size, probe.edge_radius_mm)
    angle = np.radians(np.linspace(probe.theta_start_deg, probe.theta_stop_deg, ARC_FLATS))
    arc = np.column_stack([np.sin(angle), np.zeros(ARC_FLATS), -np.cos(angle)])
    centre = np.array([0.0, 0.0, probe.radius_mm - size[2] / 2])
    # All sides of the cuboid but the one that the arc takes the place of.
    sides = np.concatenate([np.eye(3), -np.eye(3)[:2]])
    offsets = np.concatenate([size / 2, size[:2] / 2, arc @ centre + probe.radius_mm])
    return ConvexTool(np.concatenate([sides, arc]), offsets, probe.edge_radius_mm)


def embedding_cell_mm(tissue: TissueSection) -> float:
    """Width of the coarse tetrahedra that carry the image plane."""
    return KINDS[tissue.model].embedding_sizes * tissue.size_mm


def step_settings(tissue: TissueSection, section: SolverSection) -> StepSettings:
    """The scene's settings of a step; what it leaves out is the tissue model's own choice."""
    names = ("time_step_s", "substeps", "iterations", "stabilisation_iterations", "relaxation_factor")
    given = {name: getattr(section, name) for name in names if getattr(section, name) is not None}
    return replace(KINDS[tissue.model].settings(tissue), damping=section.damping_per_s, **given)


def build_solver(
    organ: trimesh.Trimesh | RestBody,
    tissue: TissueSection,
    shapes: list,
    tool: ConvexTool | None,
    contact: Contact | None = None,
    section: SolverSection | None = None,
    serial: bool | None = None,
    held: Held | None = None,
) -> Solver:
    """A solver of the organ [mm] among shapes, the tool among them. Raises SamplingError.

    Shape matching also takes an organ that was filled before (``fill``), which takes seconds; ``held`` is the neo-Hookean
    model's. ``serial`` says whether a step is one kernel on one core; left open, the body's size and the machine decide.
    """
    section = section or SolverSection()
    parts = Parts(organ, tissue, shapes, tool, contact or Contact(), section, serial, held)
    return KINDS[tissue.model].build(parts)


def fill(organ: trimesh.Trimesh, tissue: ShapeMatchingTissue) -> RestBody:
    """The organ [mm] filled with particles. Raises SamplingError."""
    return fill_body(organ, tissue.radius_mm, tissue.volume_sampling, tissue.surface_samples_per_mm2)


def _neo_hookean(parts: Parts) -> Solver:
    organ, tissue = parts.organ, parts.tissue
    lattice = fill_with_cells(organ, tissue.cell_mm)
    body = Body(lattice.nodes)
    contacts = None
    if parts.shapes:
        points, area_mm2 = surface_points(organ, POINTS_A_CELL * tissue.cell_mm)
        contacts = SurfaceContacts(
            body, lattice, points, area_mm2, parts.shapes, parts.contact.shape_friction
        )
    material = (tissue.young_kpa, tissue.poisson, tissue.density_g_cm3)
    held = None if parts.held is None else parts.held.nodes(lattice.nodes)
    model = NeoHookean(body, lattice, contacts, *material, held=held, serial=parts.serial)
    return Solver(model, tool=parts.tool)


def _shape_matching(parts: Parts) -> Solver:
    contact, section = parts.contact, parts.section
    rest = parts.organ if isinstance(parts.organ, RestBody) else fill(parts.organ, parts.tissue)
    arranged, patches = arrange(rest, parts.tissue.cluster_spacing)
    body = ParticleBody(arranged, section.mass_scaling_per_mm)
    contacts = ShapeContacts(body, parts.shapes, contact.shape_friction) if parts.shapes else None
    model = ShapeMatching(body, patches, contacts, section.relaxation, parts.serial)
    pairs = ParticleContacts(model, contact.particle_friction) if contact.particles else None
    return Solver(model, pairs, parts.tool)


# All models, by the names of ``scenes.tissue``: a new one is added here.
KINDS = {
    "neo-hookean": Kind(
        build=_neo_hookean,
        settings=lambda tissue: LATTICE_SETTINGS,
        reach_mm=lambda tissue: REACH_MM,
        embedding_sizes=1.35,
        reported="neo-Hookean, E {young_kpa:g} kPa, nu {poisson:g}: {cells} cells of {cell_mm:g} mm, {nodes} nodes, "
        "{tetrahedra} tetrahedra",
    ),
    "shape-matching": Kind(
        build=_shape_matching,
        settings=lambda tissue: StepSettings(stiffness=tissue.stiffness),
        reach_mm=lambda tissue: REACH_RADII * tissue.radius_mm,
        embedding_sizes=2.0,
        reported="shape matching, stiffness {stiffness:g}: {particles} particles of {radius_mm:g} mm, {clusters} clusters, "
        "{memberships} memberships, {tetrahedra} tetrahedra",
    ),
}
