"""Parts of the organ with their own material: shares of elements, mixture, forces against NumPy, closed
forms.
"""

import numpy as np
import pytest
import trimesh
from lattice_tissue import DENSITY, Energy, lame_parameters, position, put, settings_of
from test_neo_hookean import deformed, forces_of, rounding

from sim.body import Body
from sim.lattice import fill_block, fill_with_cells
from sim.material import Material, mixture
from sim.neo_hookean import NeoHookean
from sim.solver import Solver

OUTSIDE = Material(15.0, 0.45)


def ball_at(centre, radius: float) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return ball.apply_translation(centre)


@pytest.fixture(scope="module")
def organ() -> trimesh.Trimesh:
    return ball_at((0.0, 0.0, 0.0), 16.0)


@pytest.mark.parametrize("cell_mm", [4.0, 2.5])
def test_shares_have_the_parts_volumes(organ, cell_mm):
    parts = [ball_at((3.0, 2.0, -1.0), 7.0), ball_at((-9.0, 1.0, 2.0), 4.0)]
    lattice = fill_with_cells(organ, cell_mm, parts)
    assert lattice.share.shape == (len(lattice.cells), 2)
    assert lattice.share.min() >= 0 and lattice.share.sum(axis=1).max() <= 1 + 1e-12
    volume = lattice.share.T @ lattice.tissue.sum(axis=1)
    # Samples a sixth of a cell apart see a surface of radius r to 1 / 24 of their square over r, three times
    # over the volume's r.
    assert volume == pytest.approx([part.volume for part in parts], rel=0.01)
    centres = lattice.nodes[lattice.cells].mean(axis=1)
    distance = np.linalg.norm(centres - [3.0, 2.0, -1.0], axis=1)
    assert (lattice.share[distance < 7.0 - cell_mm, 0] > 1 - 1e-12).all()
    assert (lattice.share[distance > 7.0 + cell_mm, 0] == 0).all()


def test_where_parts_overlap_the_later_one_counts(organ):
    inner, outer = ball_at((2.0, 0.0, 0.0), 4.0), ball_at((2.0, 0.0, 0.0), 8.0)
    both = fill_with_cells(organ, 3.0, [outer, inner])
    volume = both.share.T @ both.tissue.sum(axis=1)
    assert volume == pytest.approx([outer.volume - inner.volume, inner.volume], rel=0.01)
    hidden = fill_with_cells(organ, 3.0, [inner, outer])
    assert hidden.share.T @ hidden.tissue.sum(axis=1) == pytest.approx(
        [0.0, outer.volume], rel=0.01, abs=1e-9
    )


def test_tissue_outside_the_organ_is_no_part_of_it(organ):
    across = ball_at((16.0, 0.0, 0.0), 6.0)
    lattice = fill_with_cells(organ, 3.0, [across])
    # Of balls with radii 16 and 6 mm, 16 mm apart.
    lens = np.pi * (16 + 6 - 16) ** 2 * (16**2 + 2 * 16 * 22 - 3 * 10**2) / (12 * 16)
    volume = lattice.share[:, 0] @ lattice.tissue.sum(axis=1)
    assert volume == pytest.approx(lens, rel=0.03) and lens < 0.5 * across.volume


def test_without_parts_there_are_no_shares(one_device, organ):
    lattice = fill_with_cells(organ, 4.0)
    assert lattice.share.shape[1] == 0
    assert not hasattr(NeoHookean(Body(lattice.nodes), lattice), "lame_ratio")


def hill_mean(shares, moduli) -> float:
    voigt = sum(share * modulus for share, modulus in zip(shares, moduli, strict=True))
    reuss = 1 / sum(share / modulus for share, modulus in zip(shares, moduli, strict=True))
    assert reuss < voigt
    return (voigt + reuss) / 2


def test_the_mixture_has_hills_moduli_and_the_mean_density():
    stiff, light = Material(60.0, 0.3, 2.0), Material(1.0, 0.499, 0.9)
    share = np.array([[0.0, 0.0], [1.0, 0.0], [0.25, 0.5]])
    mu, lambda_, density = mixture(OUTSIDE, [stiff, light], share)
    for mean, name in ((mu, "mu"), (lambda_ + 2 / 3 * mu, "bulk")):
        moduli = [getattr(material, name) for material in (OUTSIDE, stiff, light)]
        assert mean == pytest.approx([*moduli[:2], hill_mean((0.25, 0.25, 0.5), moduli)], rel=1e-12)
    assert 1e3 * density == pytest.approx([1.05, 2.0, 0.25 * 1.05 + 0.25 * 2.0 + 0.5 * 0.9], rel=1e-12)
    # E = 9 K mu / (3 K + mu).
    assert 9 * stiff.bulk * stiff.mu / (3 * stiff.bulk + stiff.mu) == pytest.approx(60e3, rel=1e-12)
    assert (OUTSIDE.mu, OUTSIDE.lambda_) == pytest.approx(lame_parameters(0.45), rel=1e-12)


@pytest.mark.parametrize("part", [Material(60.0, 0.45), Material(0.3, 0.499), Material(15000.0, 0.2)])
def test_force_and_hessian_are_the_energys_derivatives(one_device, part):
    organ = ball_at((0.0, 0.0, 0.0), 8.0)
    lattice = fill_with_cells(organ, 4.0, [ball_at((2.0, 1.0, 0.0), 5.0)])
    model = NeoHookean(Body(lattice.nodes), lattice, None, OUTSIDE, [part])
    mu, lambda_, _ = mixture(OUTSIDE, [part], lattice.share)
    x = deformed(lattice.nodes)
    energy = Energy(lattice, mu=mu, lambda_=lambda_)
    force, hessian = forces_of(model, x)
    wanted = energy.force(x)
    # As for a uniform body of the stiffest of its elements.
    tolerance = rounding(Energy(lattice, mu=mu.max(), lambda_=lambda_.max()), x)
    assert np.abs(wanted).max() > 1e4 * tolerance
    assert np.abs(force - wanted).max() < tolerance
    blocks = np.concatenate([energy.hessian(x, colour) for colour in range(8)])
    assert np.abs(hessian - blocks).max() < tolerance


def test_changing_a_material_gives_the_model_of_that_material(one_device):
    organ, part = ball_at((0.0, 0.0, 0.0), 8.0), [ball_at((2.0, 1.0, 0.0), 5.0)]
    lattice = fill_with_cells(organ, 4.0, part)
    changed = NeoHookean(Body(lattice.nodes), lattice, None, OUTSIDE, [Material(60.0, 0.45)])
    changed.set_material(30.0, 0.3, [Material(5.0, 0.4)])
    fresh = NeoHookean(Body(lattice.nodes), lattice, None, Material(30.0, 0.3), [Material(5.0, 0.4)])
    x = deformed(lattice.nodes)
    assert (forces_of(changed, x)[0] == forces_of(fresh, x)[0]).all()
    # Without further values, those of Poisson's ratio and of the parts stay.
    changed.set_material(15.0)
    assert changed.material.poisson == 0.3 and changed.parts == (Material(5.0, 0.4),)


def test_masses_are_those_of_the_materials(organ):
    part = ball_at((3.0, 2.0, -1.0), 7.0)
    lattice = fill_with_cells(organ, 3.0, [part])
    _, _, density = mixture(Material(15.0, 0.45, 1.05), [Material(15.0, 0.45, 2.1)], lattice.share)
    mass = lattice.node_mass(density)
    assert mass.sum() == pytest.approx(DENSITY * (organ.volume + part.volume), rel=0.005)
    centre = mass @ lattice.nodes / mass.sum()
    wanted = part.volume * np.array([3.0, 2.0, -1.0]) / (organ.volume + part.volume)
    assert np.abs(centre - wanted).max() < 0.05


def test_layers_in_series_yield_as_springs_in_series(one_device):
    """With nu = 0 a column of layers is a chain of springs; the layer that the interface cuts has Hill's mean
    of the moduli.

    Its ends are moved by 1 % of the length, where Hooke's law is off by about that.
    """
    cell, layers, cut = 4.0, 6, 2.3
    high = trimesh.creation.box(bounds=[[-9, -9, cut * cell], [17, 17, 99.0]])
    lattice = fill_block((2, 2, layers), cell, [high])
    share = np.clip(np.arange(1, layers + 1) - cut, 0, 1)
    level = np.rint(lattice.nodes[:, 2] / cell).astype(int)
    assert lattice.share[:, 0] == pytest.approx(share[level[lattice.cells[:, 0]]], abs=1e-6)
    fixed = (level == 0) | (level == layers)
    model = NeoHookean(
        Body(lattice.nodes), lattice, None, Material(15.0, 0.0), [Material(90.0, 0.0)], fixed=fixed
    )
    put(model, lattice.nodes + 0.01 * layers * cell * np.outer(level == layers, [0, 0, 1]))
    solver = Solver(model)
    for _ in range(200):
        solver.step(settings_of(20))
    moved = (position(solver) - lattice.nodes)[:, 2]
    compliance = 1 / np.array([(15 + 75 * s + 1 / ((1 - s) / 15 + s / 90)) / 2 for s in share])
    wanted = 0.01 * layers * cell * np.append(0, np.cumsum(compliance)) / compliance.sum()
    assert np.abs(moved - wanted[level]).max() < 0.02 * wanted.max()
    assert np.ptp(moved[level == 4]) < 1e-3


@pytest.mark.parametrize("young_kpa", [0.15, 90.0])
def test_a_ball_in_sheared_tissue_strains_as_eshelby_has_it(one_device, young_kpa):
    """The strain inside is even (Eshelby 1957); the block is large enough that its faces change it by 1 %.

    The ball's radius is two elements. With Voigt's mean the soft ball is 10 % off, with Reuss's 23 %.
    """
    cell, count, radius, shear = 4.0, 15, 8.0, 0.01
    lattice = fill_block((count,) * 3, cell, [ball_at([(count / 2 + 0.3) * cell] * 3, radius)])
    at_faces = (lattice.nodes < 1e-6) | (lattice.nodes > count * cell - 1e-6)
    model = NeoHookean(
        Body(lattice.nodes), lattice, None, OUTSIDE, [Material(young_kpa, 0.45)], fixed=at_faces.any(axis=1)
    )
    put(model, lattice.nodes + shear * np.outer(lattice.nodes[:, 2], [1, 0, 0]))
    solver = Solver(model)
    for _ in range(60):
        solver.step(settings_of(20))
    inside = lattice.share[:, 0] > 0.999
    deformation = np.einsum("mka,mkb->mab", position(solver)[lattice.cells[inside]], lattice.gradient[inside])
    strain = (deformation[:, 0, 2] + deformation[:, 2, 0]).mean() / shear
    beta = 2 * (4 - 5 * 0.45) / (15 * (1 - 0.45))
    assert strain == pytest.approx(1 / (1 + beta * (young_kpa / 15.0 - 1)), rel=0.08)
