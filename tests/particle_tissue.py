"""Shape-matched tissue as tests build it."""

from collections.abc import Callable

import numpy as np
import trimesh

from sim.body import BodyState, ParticleBody
from sim.embedding import Embedding
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


def carried_along() -> tuple[Embedding, Callable[[np.ndarray, np.ndarray], None]]:
    """Tissue that a ball of 12 mm carries along, and what moves it: x -> matrix @ x + shift."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=12.0)
    model = tissue_of(ball)
    embedding = Embedding(model.carrier, ball, 4.0)

    def move(matrix: np.ndarray, shift: np.ndarray) -> None:
        x = (model.body.rest_points @ np.transpose(matrix) + shift).astype(np.float32)
        model.body.restore(BodyState(x, np.zeros_like(x)))
        model.update_frames()
        embedding.update()

    return embedding, move
