"""The tissue models as a scene names them: each put on the device with its contacts, ready to step."""

from dataclasses import dataclass, replace

import numpy as np
import trimesh

from scenes.scene import Contact, NeoHookeanTissue, ShapeMatchingTissue, SolverSection
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

AnyTissue = NeoHookeanTissue | ShapeMatchingTissue
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


def static_shape(mesh: trimesh.Trimesh, tissue: AnyTissue) -> SignedDistanceField:
    """What a closed surface [mm] that does not move is to a tissue: distances as far around as it asks for them."""
    return SignedDistanceField.of_surface(mesh.vertices, mesh.faces, reach_of(tissue))


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


def reach_of(tissue: AnyTissue) -> float:
    """How far around a shape a tissue asks for its distance [mm]."""
    return REACH_MM if isinstance(tissue, NeoHookeanTissue) else REACH_RADII * tissue.radius_mm


def embedding_cell_mm(tissue: AnyTissue) -> float:
    """Width of the coarse tetrahedra that carry the image plane."""
    return 1.35 * tissue.cell_mm if isinstance(tissue, NeoHookeanTissue) else 2.0 * tissue.radius_mm


def step_settings(tissue: AnyTissue, section: SolverSection) -> StepSettings:
    """The scene's settings of a step; what it leaves out is the tissue model's own choice."""
    own = (
        LATTICE_SETTINGS if isinstance(tissue, NeoHookeanTissue) else StepSettings(stiffness=tissue.stiffness)
    )
    names = ("time_step_s", "substeps", "iterations", "stabilisation_iterations", "relaxation_factor")
    given = {name: getattr(section, name) for name in names if getattr(section, name) is not None}
    return replace(own, damping=section.damping_per_s, **given)


def build_solver(
    organ: trimesh.Trimesh,
    tissue: AnyTissue,
    shapes: list,
    tool: ConvexTool | None,
    contact: Contact | None = None,
    section: SolverSection | None = None,
    rest: RestBody | None = None,
    serial: bool | None = None,
    held: Held | None = None,
) -> Solver:
    """A solver of the organ [mm] among shapes, the tool among them. Raises SamplingError.

    ``held`` is the neo-Hookean model's; ``rest`` is shape matching's: the organ filled before (``fill``), which takes seconds. ``serial`` says whether a step is
    one kernel on one core; left open, the body's size and the machine decide.
    """
    contact, section = contact or Contact(), section or SolverSection()
    if isinstance(tissue, NeoHookeanTissue):
        return _neo_hookean(organ, tissue, shapes, tool, contact, serial, held)
    return _shape_matching(rest or fill(organ, tissue), tissue, shapes, tool, contact, section, serial)


def fill(organ: trimesh.Trimesh, tissue: ShapeMatchingTissue) -> RestBody:
    """The organ [mm] filled with particles. Raises SamplingError."""
    return fill_body(organ, tissue.radius_mm, tissue.volume_sampling, tissue.surface_samples_per_mm2)


def _neo_hookean(
    organ: trimesh.Trimesh,
    tissue: NeoHookeanTissue,
    shapes: list,
    tool: ConvexTool | None,
    contact: Contact,
    serial: bool | None,
    held: Held | None,
) -> Solver:
    lattice = fill_with_cells(organ, tissue.cell_mm)
    body = Body(lattice.nodes)
    contacts = None
    if shapes:
        points, area_mm2 = surface_points(organ, POINTS_A_CELL * tissue.cell_mm)
        contacts = SurfaceContacts(body, lattice, points, area_mm2, shapes, contact.shape_friction)
    material = (tissue.young_kpa, tissue.poisson, tissue.density_g_cm3)
    nodes = None if held is None else held.nodes(lattice.nodes)
    model = NeoHookean(body, lattice, contacts, *material, held=nodes, serial=serial)
    return Solver(model, tool=tool)


def _shape_matching(
    rest: RestBody,
    tissue: ShapeMatchingTissue,
    shapes: list,
    tool: ConvexTool | None,
    contact: Contact,
    section: SolverSection,
    serial: bool | None,
) -> Solver:
    arranged, patches = arrange(rest, tissue.cluster_spacing)
    body = ParticleBody(arranged, section.mass_scaling_per_mm)
    contacts = ShapeContacts(body, shapes, contact.shape_friction) if shapes else None
    model = ShapeMatching(body, patches, contacts, section.relaxation, serial)
    pairs = ParticleContacts(model, contact.particle_friction) if contact.particles else None
    return Solver(model, pairs, tool)
