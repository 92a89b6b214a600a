"""Shape-matched tissue as tests build it."""

from sim.body import ParticleBody
from sim.particle_contact import ShapeContacts
from sim.sampling import fill_body, group_into_patches
from sim.shape_matching import ShapeMatching


def tissue_of(
    mesh, radius=2.0, shapes=(), friction=0.35, relaxation="local", scaling=0.0, spacing=3.33, serial=None
) -> ShapeMatching:
    """A closed surface [mm] filled with particles among shapes."""
    rest, patches = group_into_patches(fill_body(mesh, radius), spacing)
    body = ParticleBody(rest, scaling)
    contacts = ShapeContacts(body, list(shapes), friction) if shapes else None
    return ShapeMatching(body, patches, contacts, relaxation, serial)
