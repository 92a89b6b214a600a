"""Neo-Hookean tissue: its forces against a NumPy float64 energy, its rest states against closed forms."""

import numpy as np
import pytest
import taichi as ti
import trimesh
from conftest import rotation_about
from lattice_tissue import (
    DENSITY,
    YOUNG_KPA,
    Energy,
    G,
    jacobians,
    lame_parameters,
    lifted,
    position,
    put,
    settings_of,
    tissue_of,
)
from scipy.linalg import polar
from scipy.optimize import brentq

from sim.body import Body
from sim.fields import array_of, fill, zeros
from sim.kernels import kernel
from sim.lattice import ERSATZ, Lattice, fill_with_cells
from sim.neo_hookean import HOURGLASS_STIFFNESS, LEAST_J, NeoHookean, ln
from sim.shapes import ConvexTool, Plane
from sim.solver import Solver
from sim.surface_contact import PENALTY_DEPTH_MM

DT = 1 / 60
EPS = 2.0**-23


@kernel
def begin(model: ti.template(), dt: float):
    model.begin(dt)
    model.gather()


@kernel
def project(model: ti.template(), factor: float, dt: float):
    model.project(1.0, factor, dt)
    model.scatter()


@kernel
def measure(model: ti.template(), force: ti.template(), hessian: ti.template()):
    for i in range(force.shape[0]):
        f, h, _ = model.elastic(i)
        force[i], hessian[i] = f.xyz, h


def forces_of(model: NeoHookean, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Elastic forces (n, 3) [uN] at positions x, and their negative derivatives (n, 3, 3) by each node's
    position.
    """
    put(model, x)
    begin(model, DT)
    force, hessian = zeros(len(x), 3, within=1), zeros(len(x), 3, 3, within=2)
    measure(model, force, hessian)
    return array_of(force).astype(float), array_of(hessian).astype(float)


def small_lattice() -> Lattice:
    return fill_with_cells(trimesh.creation.icosphere(subdivisions=2, radius=8.0), 4.0)


def small_model() -> NeoHookean:
    lattice = small_lattice()
    return NeoHookean(Body(lattice.nodes), lattice)


def deformed(x: np.ndarray, noise_mm: float = 0.25) -> np.ndarray:
    """Positions bent, stretched, rotated and translated, with noise; no cell inverted."""
    random = np.random.default_rng(2)
    bent = x + 0.015 * x[:, [2, 0, 1]] ** 2 + random.normal(0, noise_mm, x.shape)
    return (1.1 * bent @ rotation_about([1, 2, 3], 70).T + [5.0, -3.0, 8.0]).astype(np.float32).astype(float)


def rounding(energy: Energy, x: np.ndarray) -> float:
    """Rounding error of a force in float32 [uN].

    F is a sum of 8 positions times their gradients, 1 / 4 cell each, so that it is off by 8 ^ 0.5 EPS |x| / 4
    cell; a stress by (lambda_ + 2 mu) / J^2 as much. A force sums it over 8 cells, times volume / 4 cell =
    cell^2 / 4 each, and the worst of some hundred nodes is three times as far off as most.
    """
    cell = energy.lattice.cell_mm
    strain = 8**0.5 * EPS * np.abs(x).max() / 4 / cell
    least = max(jacobians(energy.lattice, x).min(), LEAST_J)
    return 3 * (energy.lambda_ + 2 * energy.mu) / min(least, 1.0) ** 2 * strain * 8**0.5 * cell**2 / 4


@pytest.mark.parametrize("noise_mm", [0.25, 0.8, 2.0])
def test_force_and_hessian_are_the_energys_derivatives(kept, noise_mm):
    model = kept(small_model)
    lattice = model.lattice
    x = deformed(lattice.nodes, noise_mm)
    # The strongest noise inverts cells.
    assert (jacobians(lattice, x).min() < LEAST_J) == (noise_mm == 2.0)
    for poisson in (0.45, 0.3, 0.0):
        model.set_material(YOUNG_KPA, poisson)
        energy = Energy(lattice, poisson)
        force, hessian = forces_of(model, x)
        wanted = energy.force(x)
        tolerance = rounding(energy, x)
        assert np.abs(wanted).max() > 1e4 * tolerance
        assert np.abs(force - wanted).max() < tolerance
        # Beyond J = 2.7 or so the energy is concave, which the model leaves out; at LEAST_J its curvature
        # jumps.
        j = jacobians(lattice, x)
        wild = (j > 2.5) | (np.abs(j - LEAST_J) < 1e-3)
        calm = np.bincount(lattice.cells[wild].ravel(), minlength=len(x)) == 0
        assert calm.sum() > len(x) / 3
        # A force's error, over the quarter of a cell in which a strain of 1 is made.
        blocks = np.concatenate([energy.hessian(x, colour) for colour in range(8)])
        assert np.abs(hessian - blocks)[calm].max() < tolerance
        assert np.linalg.eigvalsh(hessian).min() > 0


def test_youngs_modulus_changes_the_penalty_stiffness_and_not_poissons_ratio(one_device, block):
    model = tissue_of(block, 8.0, [Plane(np.array([0.0, 0.0, 1.0]), -8.0)], poisson=0.3).model
    model.set_material(2 * YOUNG_KPA)
    moduli = model.mu, model.lambda_, model.contacts.stiffness
    assert moduli == pytest.approx(
        [2 * modulus for modulus in (*lame_parameters(0.3), YOUNG_KPA / PENALTY_DEPTH_MM)], rel=1e-6
    )


def test_the_logarithm_is_exact_to_rounding(one_device):
    values = np.concatenate([np.geomspace(LEAST_J, 1e30, 4000), 1 + np.linspace(-0.4, 0.4, 4001)]).astype(
        np.float32
    )
    number, logarithm = zeros(len(values)), zeros(len(values))
    fill((number, values))

    @kernel
    def ask(number: ti.template(), logarithm: ti.template()):
        for i in range(number.shape[0]):
            logarithm[i] = ln(number[i])

    ask(number, logarithm)
    wanted = np.log(values.astype(float))
    # Of the sum of exponent and series each rounds by half a unit, the series' own terms by three more.
    assert (np.abs(array_of(logarithm) - wanted) <= 4 * EPS * np.maximum(np.abs(wanted), 0.35)).all()


@pytest.mark.parametrize("with_fixed", [False, True])
def test_an_iteration_is_a_gauss_seidel_sweep_over_the_colours(one_device, with_fixed):
    lattice, factor = small_lattice(), 1.7
    fixed = np.random.default_rng(5).uniform(size=len(lattice.nodes)) < 0.3 if with_fixed else None
    # On one core and by colours.
    model = NeoHookean(Body(lattice.nodes), lattice, fixed=fixed, serial=with_fixed)
    energy = Energy(lattice, 0.45)
    x = deformed(lattice.nodes, 0.5)
    target = x + np.random.default_rng(6).normal(0, 3.0, x.shape)
    put(model, x)
    fill((model.body.predicted, target))
    begin(model, DT)
    inertia = lattice.node_mass(np.full(len(lattice.cells), DENSITY)) / DT**2
    # It starts from the rigid-body coarse correction, which has its own test.
    x = array_of(model.body.predicted).astype(float)
    y, capped = x.copy(), 0
    project(model, factor, DT)
    for colour, (first, last) in enumerate(model.colours):
        mine = slice(first, last)
        pull = np.stack([energy.slope(y, colour, axis) for axis in range(3)], axis=1)
        force = inertia[mine, None] * (target - y)[mine] - pull
        hessian = energy.hessian(y, colour) + inertia[mine, None, None] * np.eye(3)
        change = factor * np.linalg.solve(hessian, force[..., None])[..., 0]
        length = np.linalg.norm(change, axis=1, keepdims=True)
        capped += (length > 2.0).sum()
        change *= np.minimum(1.0, 0.5 * 4.0 / length)
        y[mine] += change if fixed is None else change * ~fixed[mine, None]
    assert capped > 0 and np.abs(y - x).max() > 1.0
    # A force's rounding over a node's stiffness, at least mu cell / 4: the share of a cell with an eighth of
    # tissue.
    tolerance = rounding(energy, y) / (energy.mu * 4.0 / 4)
    assert tolerance < 1e-3
    assert np.abs(array_of(model.body.predicted) - y).max() < tolerance
    # The elements' F is updated with the nodes, not computed again.
    carried = np.einsum("mia,mib->mab", y[lattice.cells], lattice.gradient)
    columns = array_of(model.deformation)[:-1, :, :3]
    assert np.abs(columns.transpose(0, 2, 1) - carried).max() < tolerance


def shear(amount: float) -> np.ndarray:
    return np.eye(3) + amount * np.outer([1, 0, 0], [0, 1, 0])


def with_fixed_surface(mesh) -> NeoHookean:
    """A body whose cells at the surface do not move."""
    lattice = fill_with_cells(mesh, 3.0)
    fixed = np.zeros(len(lattice.nodes), bool)
    fixed[lattice.cells[lattice.volume < 3.0**3 * (1 - 1e-9)]] = True
    return NeoHookean(Body(lattice.nodes), lattice, fixed=fixed)


@pytest.mark.parametrize("wanted", ["simple shear", "any"])
def test_a_fixed_surface_gives_affine_deformation_with_the_closed_form_stress(kept, block, wanted):
    model = kept(with_fixed_surface, block)
    lattice, fixed = model.lattice, array_of(model.fixed) > 0
    assert 30 < (~fixed).sum() < fixed.sum()
    f = shear(0.4) if wanted == "simple shear" else rotation_about([1, 1, 0], 20) @ np.diag([1.2, 0.8, 0.9])
    affine = lattice.nodes @ f.T
    start = np.where(fixed[:, None], affine, lattice.nodes)
    put(model, start)
    Solver(model).step(settings_of(150, time_step_s=10.0))
    x = array_of(model.body.position).astype(float)
    energy = Energy(lattice, 0.45)
    assert np.abs(start - affine).max() > 1.0 and (x[fixed] == affine[fixed].astype(np.float32)).all()
    # A force's rounding over a whole node's stiffness, mu cell and more, spread by its neighbours, ten times.
    assert np.abs(x - affine).max() < 10 * rounding(energy, affine) / (energy.mu * 3.0)
    # Virtual work: the reactions' power at F' = e_a e_b is the volume times P_ab, with P = mu (F - F^-T) +
    # lambda_ ln J F^-T.
    inverse = np.linalg.inv(f).T
    p = energy.mu * (f - inverse) + energy.lambda_ * np.log(np.linalg.det(f)) * inverse
    power = -forces_of(model, x)[0].T @ lattice.nodes
    volume = lattice.volume.sum()
    if wanted == "simple shear":
        assert power[0, 1] == pytest.approx(volume * energy.mu * 0.4, rel=1e-4)
    assert np.abs(power - volume * p).max() < rounding(energy, affine) * len(x) ** 0.5 * 13


def uniaxial(stretch: float, poisson: float) -> tuple[float, float]:
    """Lateral stretch q and nominal stress [g/(mm s^2)] of a free bar: mu (q^2 - 1) + lambda_ ln(q^2
    stretch) = 0.
    """
    mu, lambda_ = lame_parameters(poisson)
    q = brentq(lambda q: mu * (q * q - 1) + lambda_ * np.log(q * q * stretch), 0.5, 2.0)
    return q, mu * (stretch - 1 / stretch) + lambda_ * np.log(q * q * stretch) / stretch


def test_uniaxial_compression_between_frictionless_plates(one_device, block):
    cell, gap = 4.0, 12.0
    plate = ConvexTool.cuboid(np.array([80.0, 80.0, 40.0]))
    solver = tissue_of(block, cell, [Plane(np.array([0.0, 0.0, 1.0]), -8.0), plate])
    model, contacts, lattice = solver.model, solver.contacts, solver.model.lattice
    area = array_of(contacts.area)
    for poisson in (0.45, 0.3):
        model.set_material(YOUNG_KPA, poisson)
        put(model, lattice.nodes)
        contacts.reset()
        height = 16.0
        for _ in range(40):
            lower = max(height - 0.1, gap)
            solver.step(settings_of(10), np.array([lifted(height + 12.0), lifted(lower + 12.0)]))
            height = lower
        for _ in range(12):
            before = position(solver)
            solver.step(settings_of(60, time_step_s=0.1))
        x = position(solver)
        # It is at rest, to a hundredth of the tolerance below.
        assert np.abs(x - before).max() < 1e-3
        # The contacts at both ends have the penetration pressure * PENALTY_DEPTH_MM / E.
        stretch = brentq(
            lambda s: 16 * s - gap + 2 * uniaxial(s, poisson)[1] * PENALTY_DEPTH_MM / (1e3 * YOUNG_KPA),
            0.7,
            0.8,
        )
        q, stress = uniaxial(stretch, poisson)
        inside = (np.abs(lattice.nodes) < [12, 10, 8]).all(axis=1)
        known = np.column_stack([lattice.nodes[inside], np.ones(inside.sum())])
        # Without friction the block may rotate between the plates: only its stretch is compared.
        measured = polar(np.linalg.lstsq(known, x[inside], rcond=None)[0][:3].T)[1]
        # What is wrong is the section: as the cells round its edges off, the faces stand out; and what is
        # empty resists.
        whole = (np.abs(lattice.nodes[lattice.cells][:, :, 2].mean(axis=1)) < 3).nonzero()[0]
        area_mm2 = (
            lattice.volume[whole].sum() / (len(np.unique(lattice.nodes[lattice.cells[whole], 2])) - 1) / cell
        )
        section = area_mm2 / (24 * 20) - 1
        assert 0 < section < 0.03
        assert np.diag(measured) == pytest.approx([q, q, stretch], abs=section * (1 - stretch))
        assert np.abs(measured - np.diag(np.diag(measured))).max() < section * (1 - stretch)
        at = np.einsum("pk,pkd->pd", array_of(contacts.weight), x[array_of(contacts.node)])[:, 2]
        penalty = 1e3 * YOUNG_KPA / PENALTY_DEPTH_MM * area
        below, above = (penalty * np.maximum(-8 - at, 0)).sum(), (penalty * np.maximum(at - gap + 8, 0)).sum()
        # Heights of 8 nodes each, known to an ulp of 16 mm, of a depth of 0.017 mm.
        assert below == pytest.approx(above, rel=2 * 8 * 2.0**-20 / 0.017)
        assert below == pytest.approx(-stress * area_mm2, rel=0.5 * section)


def sag(poisson: float, cell: float, iterations: int, side: float = 8.0, span: float = 40.0) -> float:
    """Sag at the tip of a cantilever under a hundredth of its weight, over Timoshenko's."""
    beam = trimesh.creation.box([span + 1.5 * cell, side, side])
    # So nodes lie in the plane x = 0, where it is clamped.
    beam.apply_translation([(span - 1.5 * cell) / 2, 0.0, 0.0])
    solver = tissue_of(beam, cell, poisson=poisson, fixed=lambda nodes: nodes[:, 0] < 1e-9)
    gravity = G / 100
    # Inertia is negligible over ten seconds, so this is one static solve.
    solver.step(settings_of(iterations, (0, 0, -gravity), time_step_s=10.0, relaxation_factor=1.95))
    lattice = solver.model.lattice
    nodes, weights = lattice.interpolation.attach(np.array([[span, 0.0, 0.0]]))
    tip = weights[0] @ (position(solver) - lattice.nodes)[nodes[0]]
    load, young = DENSITY * gravity * side**2, 1e3 * YOUNG_KPA
    shear_factor = 10 * (1 + poisson) / (12 + 11 * poisson)
    bending = load * span**4 / (8 * young * side**4 / 12)
    shearing = load * span**2 / (2 * shear_factor * lame_parameters(poisson)[0] * side**2)
    return -tip[2] / (bending + shearing)


def beam_error(poisson: float, cell: float, side: float = 8.0, span: float = 40.0) -> float:
    """Tolerance of the sag, relative to Timoshenko's.

    Empty space in cut cells adds ERSATZ times their second moment of area; edges lack tissue, in weight and
    in stiffness; bending inside cells is HOURGLASS_STIFFNESS / (1 + nu) times as stiff as it should be, and
    is 1 / n^2 of it all in a beam n cells thick; the clamp keeps the section from widening, which stiffens
    nu^2 of a length of one side.
    """
    n = side / cell
    empty = ERSATZ * ((1 + 1 / n) ** 4 - 1)
    edges = (cell / 2) ** 2 / 8 * 2 * np.pi / side**2
    inside = abs(HOURGLASS_STIFFNESS / (1 + poisson) - 1) / n**2
    return empty + edges + inside + poisson**2 * side / span


# The last is nearly incompressible: it does not lock.
@pytest.mark.parametrize(
    ("poisson", "cell", "iterations", "most"),
    [(0.0, 4.0, 700, 0.26), (0.0, 8 / 3, 1200, 0.13), (0.45, 8 / 3, 1500, 0.18)],
)
def test_a_cantilevers_sag_is_beam_theorys(one_device, poisson, cell, iterations, most):
    assert abs(1 - sag(poisson, cell, iterations)) < beam_error(poisson, cell) < most
