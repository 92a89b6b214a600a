"""Relaxation of the tissue: finite-strain viscoelasticity with a Prony series.

S(t) = S_e(t) + sum_i gamma_i int exp(-(t - s) / tau_i) dS_e(s), with the elastic second Piola-Kirchhoff
stress S_e; the integral is updated from step to step (Simo & Hughes 1998, Sec. 10.3; Holzapfel 2000, Eq.
6.245). Stresses at rest are the elastic ones, so Young's modulus is that of slow deformation; a fast one is
resisted (1 + sum gamma_i) times as much.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti

from sim.fields import field_of, fill_evenly, zeros

# Components of a symmetric tensor: 11, 22, 33, 12, 13, 23.
COMPONENTS = 6


@dataclass(frozen=True)
class PronyTerm:
    """gamma: modulus relative to that at rest; ``time_s``: tau [s]."""

    modulus_ratio: float
    time_s: float


class Relaxation:
    """Internal variables of ``count`` elements: stresses relative to each element's stiffness.

    elastic (m,): S_e at the end of the last substep; overstress (m, terms): the integrals. In a substep the
    stress is ``factor`` S_e + ``past_stress`` (m,).
    """

    def __init__(self, terms: Sequence[PronyTerm], count: int) -> None:
        self.count = count
        self.terms = len(terms)
        self.ratio, self.time_s = (
            field_of(np.array(values, float))
            for values in ([t.modulus_ratio for t in terms], [t.time_s for t in terms])
        )
        self.elastic = zeros(count, COMPONENTS, within=1)
        self.overstress = zeros(count, self.terms, COMPONENTS, within=1)
        self.past_stress = zeros(count + 1, COMPONENTS, within=1)
        self.factor = zeros()
        self.state = dict(elastic_stress=self.elastic, overstress=self.overstress)
        self.reset()

    def reset(self) -> None:
        """The internal variables of tissue that never was deformed."""
        for field in (*self.state.values(), self.past_stress):
            fill_evenly(field, 0.0)

    def complete(self) -> None:
        """Relax wholly: tissue that has been at rest for long has its elastic stress alone."""
        fill_evenly(self.overstress, 0.0)

    @ti.func
    def begin(self, dt: float):
        """The part of the stress that does not depend on the new positions, and the factor of the part
        that does.
        """
        for _ in range(1):
            factor = 1.0
            for t in range(self.terms):
                factor += self.ratio[t] * mean_decay(dt / self.time_s[t])
            self.factor[None] = factor
        for c in range(self.count):
            stress = -(self.factor[None] - 1.0) * self.elastic[c]
            for t in range(self.terms):
                stress += ti.exp(-dt / self.time_s[t]) * self.overstress[c, t]
            self.past_stress[c] = stress

    @ti.func
    def finish(self, c, elastic, dt: float):
        """Store the elastic stress of element c at the end of a substep."""
        change = elastic - self.elastic[c]
        for t in range(self.terms):
            x = dt / self.time_s[t]
            self.overstress[c, t] = (
                ti.exp(-x) * self.overstress[c, t] + self.ratio[t] * mean_decay(x) * change
            )
        self.elastic[c] = elastic


@ti.func
def mean_decay(x):
    """(1 - exp(-x)) / x: what remains of stress that was added evenly during a substep."""
    return (1.0 - ti.exp(-x)) / x if x > 1e-3 else 1.0 - 0.5 * x
