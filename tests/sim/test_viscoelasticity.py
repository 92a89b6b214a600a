"""Relaxation of the tissue: stresses of a bar against the hereditary integral, its creep against the
closed form.
"""

import numpy as np
import pytest
from lattice_tissue import put, settings_of
from scipy.integrate import quad
from test_neo_hookean import deformed, forces_of

from sim.body import Body
from sim.fields import array_of
from sim.lattice import fill_block
from sim.material import Material
from sim.neo_hookean import NeoHookean
from sim.solver import Solver
from sim.viscoelasticity import PronyTerm

DT = 1 / 60
TERMS = (PronyTerm(0.8, 0.3), PronyTerm(0.4, 2.0))
CELL = 4.0
BAR = (1, 1, 4)
MATERIAL = Material(15.0, 0.0, 0.01)


def elastic_stress(stretch):
    """Second Piola-Kirchhoff stress [kPa] along a bar with nu = 0, where the width stays: mu (1 - 1 /
    stretch^2).
    """
    return MATERIAL.mu / 1e3 * (1 - stretch**-2.0)


def hereditary(times, stretch_at):
    """S_e(t) + sum gamma int exp(-(t - s) / tau) dS_e/ds ds [kPa], by quadrature."""

    def rate(s):
        return (elastic_stress(stretch_at(s + 1e-6)) - elastic_stress(stretch_at(s - 1e-6))) / 2e-6

    def past(t, term):
        return (
            term.modulus_ratio
            * quad(lambda s: np.exp(-(t - s) / term.time_s) * rate(s), 0, t, limit=200, points=[min(t, 0.5)])[
                0
            ]
        )

    return np.array([elastic_stress(stretch_at(t)) + sum(past(t, term) for term in TERMS) for t in times])


@pytest.mark.parametrize("ramp_s", [0.1, 1.0])
def test_a_bars_stress_relaxes_as_the_hereditary_integral(one_device, ramp_s):
    lattice = fill_block(BAR, CELL)
    model = NeoHookean(
        Body(lattice.nodes), lattice, None, MATERIAL, prony=TERMS, fixed=np.ones(len(lattice.nodes), bool)
    )
    solver = Solver(model)

    def stretch_at(t):
        return 1 + 0.3 * np.clip(t / ramp_s, 0, 1)

    stresses, times = [], []
    for step in range(1, 151):
        put(model, lattice.nodes * [1, 1, stretch_at(step * DT)])
        solver.step(settings_of(1))
        if step % 15 == 0:
            stress = array_of(model.relaxation.elastic) + array_of(model.relaxation.overstress).sum(axis=1)
            assert np.abs(stress - stress[0]).max() < 1e-4 * np.abs(stress).max()
            stresses.append(stress[0, 2] / 1e3)
            times.append(step * DT)
    wanted = hereditary(times, stretch_at)
    # Within a step the elastic stress is taken as linear in time: off by dt^2 / 8 of its second derivative.
    second = 0.3**2 * 6 * MATERIAL.mu / 1e3 / ramp_s**2
    assert np.abs(np.array(stresses) - wanted).max() < 1.2 * DT**2 / 8 * second + 1e-4
    # At the end most of the overstress has gone, and a fast ramp had more of it.
    assert wanted[0] > 1.3 * elastic_stress(stretch_at(times[0])) or ramp_s > 0.5
    assert abs(stresses[-1] / elastic_stress(1.3) - 1) < 0.25


@pytest.mark.parametrize("term", [PronyTerm(1.0, 0.5), PronyTerm(3.0, 2.0)])
def test_a_loaded_bar_creeps_as_the_standard_linear_solid(one_device, term):
    """Strain (sigma / E) (1 - g / (1 + g) exp(-t / (tau (1 + g)))) under a constant load on its end."""
    lattice = fill_block(BAR, CELL)
    end = lattice.nodes[:, 2] > BAR[2] * CELL - 1e-6
    strain, gravity = 0.01, 9810.0
    load_g = strain * 1e3 * MATERIAL.young_kpa * CELL**2 / gravity / end.sum() * end
    fixed = lattice.nodes[:, 2] < 1e-6
    model = NeoHookean(Body(lattice.nodes), lattice, None, MATERIAL, fixed=fixed, load_g=load_g, prony=[term])
    # The load has a mass too, which swings, unless damped: in steps of one iteration at most a twentieth of a
    # second.
    solver, strains = Solver(model), []
    settings = settings_of(60, gravity=(0, 0, gravity), damping=120.0)
    times = np.arange(1, 181) * DT
    for _ in times:
        solver.step(settings)
        moved = array_of(model.body.position)[end, 2] - lattice.nodes[end, 2]
        strains.append(moved.mean() / (BAR[2] * CELL))
    g, tau = term.modulus_ratio, term.time_s
    wanted = strain * (1 - g / (1 + g) * np.exp(-times / tau / (1 + g)))
    late = times > 0.5
    # Strains of 1 %: Hooke's law is off by that much.
    assert np.abs(np.array(strains) - wanted)[late].max() < 0.03 * strain


def test_fast_deformation_is_resisted_by_the_sum_of_all_stiffnesses(one_device):
    """Force and Hessian without internal variables are those of elastic tissue times 1 + sum gamma (1 -
    exp(-x)) / x, x = dt / tau.
    """
    lattice = fill_block(BAR, CELL)
    forces = []
    for prony in ((), TERMS):
        model = NeoHookean(Body(lattice.nodes), lattice, prony=prony, hourglass_stiffness=0.0)
        forces.append(forces_of(model, deformed(lattice.nodes)))
    x = [DT / term.time_s for term in TERMS]
    factor = 1 + sum(
        term.modulus_ratio * (1 - np.exp(-ratio)) / ratio for term, ratio in zip(TERMS, x, strict=True)
    )
    for elastic, relaxing in zip(*forces, strict=True):
        assert relaxing == pytest.approx(factor * elastic, rel=1e-4, abs=1e-5 * np.abs(elastic).max())


def test_the_internal_variables_belong_to_the_state(one_device):
    lattice = fill_block(BAR, CELL)
    fixed = lattice.nodes[:, 2] < 1e-6
    solver = Solver(NeoHookean(Body(lattice.nodes), lattice, None, MATERIAL, fixed=fixed, prony=TERMS))
    settings = settings_of(4, gravity=(0, 0, -9810.0 * 300))
    for _ in range(20):
        solver.step(settings)
    state = solver.snapshot()
    assert {"elastic_stress", "overstress"} <= state.internal_state.keys()
    ends = []
    for _ in range(2):
        solver.restore(state)
        for _ in range(10):
            solver.step(settings)
        ends.append(solver.snapshot())
    assert (ends[0].body.position == ends[1].body.position).all()
    assert (ends[0].internal_state["overstress"] == ends[1].internal_state["overstress"]).all()
    solver.restart()
    assert np.abs(solver.snapshot().internal_state["overstress"]).max() == 0


def test_tissue_without_terms_has_no_internal_variables(one_device):
    lattice = fill_block(BAR, CELL)
    solver = Solver(NeoHookean(Body(lattice.nodes), lattice))
    assert solver.snapshot().internal_state == {} and not hasattr(solver.model, "relaxation")
