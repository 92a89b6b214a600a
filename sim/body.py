"""A soft body on the device: its rest positions and its current state, which the solver changes."""

from dataclasses import dataclass

import numpy as np

from sim.fields import array_of, field_of, fill, zeros
from sim.sampling import RestBody


@dataclass(frozen=True)
class BodyState:
    """Positions (n, 3) [mm] and velocities (n, 3) [mm/s], float32."""

    position: np.ndarray
    velocity: np.ndarray


class Body:
    """Particles or nodes; vectors are float32 fields of shape (n,).

    ``rest_points`` (n, 3) float64 [mm] are the rest positions; ``predicted`` [mm] the predicted positions of
    a substep.
    """

    mass_scaled = False

    def __init__(self, rest_points: np.ndarray) -> None:
        self.rest_points = np.asarray(rest_points, np.float64)
        self.count = len(rest_points)
        self.position = zeros(self.count, 3, within=1)
        self.velocity = zeros(self.count, 3, within=1)
        self.predicted = zeros(self.count, 3, within=1)
        self.rest = zeros(self.count, 3, within=1)
        fill((self.rest, self.rest_points))
        self.restore(self.rest_state())

    def rest_state(self) -> BodyState:
        """The state without deformation or motion."""
        position = self.rest_points.astype(np.float32)
        return BodyState(position, np.zeros_like(position))

    def snapshot(self) -> BodyState:
        """A copy of the current state."""
        return BodyState(array_of(self.position), array_of(self.velocity))

    def restore(self, state: BodyState) -> None:
        """Restore a state; the steps that follow give the same bits as they did from it before."""
        position, velocity = state.position, state.velocity
        fill((self.position, position), (self.predicted, position), (self.velocity, velocity))


class ParticleBody(Body):
    """A body of particles. ``contact_radius`` (n,) [mm]: smallest allowed distance of each particle's centre
    from a shape.

    ``mass_scaling_per_mm`` is k of Algorithm 1, line 4; at 0 there is no ``mass_scale`` (n,).
    """

    def __init__(self, rest: RestBody, mass_scaling_per_mm: float = 0.0) -> None:
        super().__init__(rest.particles)
        self.radius_mm = rest.radius_mm
        self.contact_radius = field_of(rest.contact_radius)
        self.mass_scaling_per_mm = mass_scaling_per_mm
        self.mass_scaled = mass_scaling_per_mm > 0
        if self.mass_scaled:
            self.mass_scale = field_of(np.ones(self.count))
