"""The finite-element reference against closed forms, and its files against their format."""

import csv
import sys
import tomllib
from itertools import combinations

import numpy as np
import pytest
import trimesh
from scipy.optimize import brentq, fsolve
from skfem import LinearForm, MeshTet, MeshTet2
from study_runs import refusal

import app
from studies.accuracy.bead_case import load_case
from studies.reference.equilibrium import Equilibrium, NotConvergedError
from studies.reference.fem_press import FemExperiment, FemPress
from studies.reference.fem_solid import FemMaterial, FemSolid, MeshError
from studies.reference.make_reference import blue_noise, in_case_frame
from studies.reference.penalty_contact import Law, PenaltyContact
from studies.reference.reference_case import ReferenceCase
from studies.reference.smooth_obstacles import DistanceField, RoundedBox
from studies.reference.tetrahedral_mesh import tetrahedra, unfolded

SIDE_MM = 10.0
TISSUE = FemMaterial()


class Plane:
    """The half space below a plane through a point [mm]; the normal points out of it."""

    def __init__(self, point: np.ndarray, normal: np.ndarray) -> None:
        self._normal = np.asarray(normal, float) / np.linalg.norm(normal)
        self._height = float(self._normal @ point)

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Height above the plane [mm], shape (n,)."""
        return points @ self._normal - self._height

    def normal(self, points: np.ndarray) -> np.ndarray:
        """The normal, shape (n, 3)."""
        return np.tile(self._normal, (len(points), 1))


def cube(cells: int, distortion_mm: float = 0.0) -> FemSolid:
    """A cube of tissue from 0 to SIDE_MM, the corners inside it displaced at random."""
    mesh = MeshTet.init_tensor(*[np.linspace(0.0, SIDE_MM, cells + 1)] * 3)
    places = mesh.p.copy()
    inside = mesh.interior_nodes()
    places[:, inside] += np.random.default_rng(1).uniform(-1, 1, (3, len(inside))) * distortion_mm
    return FemSolid(MeshTet2.from_mesh(MeshTet(places, mesh.t)), TISSUE)


def on_faces(solid: FemSolid) -> np.ndarray:
    """Which nodes lie on which of the cube's six faces, shape (nodes, 3, 2): at 0 and at SIDE_MM along
    each axis.
    """
    return np.abs(solid.rest[..., None] - [0.0, SIDE_MM]) < 1e-9


def held(solid: FemSolid, fixed: np.ndarray, contacts: list[PenaltyContact] | None = None) -> Equilibrium:
    """A weightless solid of which some displacements, shape (nodes, 3) bool, are given."""
    return Equilibrium(solid, contacts or [], np.zeros_like(solid.rest), fixed)


def test_edges_become_straight_where_points_of_a_curved_face_are_not_found():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]).T
    straight = MeshTet2.from_mesh(MeshTet(corners, np.arange(4)[:, None]))
    places = straight.doflocs.copy()
    # Its volume ratio is 0.5 to 3.3 at the nodes: not folded there.
    places[:, 4:] += np.random.default_rng(55).normal(0, 0.12, (3, 6))
    curved = MeshTet2(places, straight.t)
    with pytest.raises(MeshError, match="nearly folded"):
        FemSolid(curved, TISSUE)
    assert FemSolid(unfolded(curved), TISSUE).volume_share.sum() == pytest.approx(1 / 6)
    assert np.array_equal(unfolded(straight).doflocs, straight.doflocs)


def test_an_affine_deformation_passes_the_patch_test():
    solid = cube(3, distortion_mm=0.6)
    affine = np.array([[0.15, 0.1, 0.0], [-0.05, -0.2, 0.08], [0.1, 0.0, 0.1]])
    boundary = on_faces(solid).any(axis=(1, 2))
    wanted = solid.rest @ affine.T
    start = np.where(boundary[:, None], wanted, 0.9 * wanted)
    equilibrium = held(solid, np.repeat(boundary[:, None], 3, axis=1))
    solved, _, iterations = equilibrium.solve(start, 1e-13)
    # The field is in the element's space and P is constant: only rounding is left, 1e-16 of 10 mm times the
    # condition of the matrix, some 1e3 on this mesh.
    assert iterations > 1 and (~boundary).sum() > 100
    assert np.abs(solved - wanted).max() < 1e-11


@pytest.mark.parametrize("poisson", [0.3, 0.45])
def test_uniaxial_compression_gives_the_closed_form_force(poisson):
    material = FemMaterial(poisson=poisson)
    solid = FemSolid(cube(2).mesh, material)
    faces = on_faces(solid)
    fixed = faces[:, :, 0].copy()
    fixed[:, 2] |= faces[:, 2, 1]
    stretch, mu, lam = 0.7, material.mu_kpa, material.lambda_kpa

    def stress(along: float, across: float, ratio: float) -> float:
        """Principal value of P = mu (F - F^-T) + lambda ln J F^-T along an axis."""
        return mu * (along - 1 / along) + lam * np.log(ratio) / along

    side = brentq(lambda s: stress(s, s, s * s * stretch), 1.0, 1.5, xtol=1e-15)
    solved, _, _ = held(solid, fixed).solve(solid.rest * [0.0, 0.0, stretch - 1], 1e-12)
    assert np.abs(solved - solid.rest * [side - 1, side - 1, stretch - 1]).max() < 1e-9
    force = solid.elastic_force(solved)[faces[:, 2, 1], 2].sum()
    assert force == pytest.approx(SIDE_MM**2 * stress(stretch, side, side * side * stretch), rel=1e-9)


def test_the_error_falls_with_the_third_power_of_the_mesh():
    """u_x = a sin(k z) is a shear with J = 1, so P_xz = mu a k cos(k z): in balance with b_x = mu a k^2
    sin(k z).
    """
    a, k = 1.0, np.pi / SIDE_MM

    def error(cells: int) -> float:
        solid = cube(cells, distortion_mm=1.0 / cells)
        boundary = on_faces(solid).any(axis=(1, 2))
        wanted = np.zeros_like(solid.rest)
        wanted[:, 0] = a * np.sin(k * solid.rest[:, 2])
        density = LinearForm(lambda v, w: TISSUE.mu_kpa * a * k**2 * np.sin(k * w.x[2]) * v)
        load = np.zeros_like(solid.rest)
        load[:, 0] = density.assemble(solid.basis)
        fixed = np.repeat(boundary[:, None], 3, axis=1)
        solved, _, _ = Equilibrium(solid, [], load, fixed).solve(
            np.where(boundary[:, None], wanted, 0.9 * wanted), 1e-10
        )
        at_points = np.asarray(solid.basis.interpolate(solved[:, 0]))
        exact = a * np.sin(k * np.asarray(solid.basis.global_coordinates())[2])
        return float(np.sqrt((solid.basis.dx * (at_points - exact) ** 2).sum()))

    # Quadratic elements have an error of h^3 in the mean square: 8 for each halving; these
    # meshes are distorted at random, one more than the other, so half an order is let go.
    assert error(3) / error(6) > 2**2.5


def touching_cube(friction: float) -> tuple[Equilibrium, np.ndarray]:
    """A cube cut into by a box's edge, a ball and a plane, slid by less and more than what sticks."""
    solid = cube(3, distortion_mm=0.3)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=6.0)
    ball.apply_translation([5.0, 5.0, -5.5])
    rng = np.random.default_rng(2)
    state = rng.normal(size=solid.rest.shape) * 0.02
    contacts = [
        PenaltyContact(
            solid, RoundedBox(np.array([6.0, 4.0, 6.0]), 1.0), Law(2500.0, friction), (5.0, 5.0, 12.9)
        ),
        PenaltyContact(solid, DistanceField(ball), Law(300.0, friction)),
        PenaltyContact(
            solid, Plane(np.array([0.6, 0.0, 0.0]), np.array([1.0, 0.1, 0.1])), Law(300.0, friction)
        ),
    ]
    for contact in contacts:
        contact.carry(state)
    state = state + rng.normal(size=state.shape) * 0.01
    equilibrium = held(solid, np.zeros(state.shape, bool), contacts)
    equilibrium.tether_kpa_mm2 = 0.1
    return equilibrium, state


@pytest.mark.parametrize("friction", [0.0, 0.35])
def test_the_tangent_is_the_derivative_of_the_residual(friction):
    equilibrium, state = touching_cube(friction)
    direction = np.random.default_rng(3).normal(size=state.shape)
    step = 1e-6

    def residual(at: np.ndarray) -> np.ndarray:
        return equilibrium.balance(at).residual.ravel()

    difference = (residual(state + step * direction) - residual(state - step * direction)) / (2 * step)
    assert all((contact.gaps(state) < 0).sum() > 3 for contact in equilibrium.contacts)
    # Central differences: h^2 f''' / 6 with f''' / f' up to eps / delta / stiffness, and rounding 1e-16 / h.
    error = difference - equilibrium.tangent(state) @ direction.ravel()
    assert np.linalg.norm(error) < 1e-7 * np.linalg.norm(difference)


def test_friction_of_a_block_that_slides_is_coulombs():
    solid = cube(2)
    faces = on_faces(solid)
    plane = PenaltyContact(solid, Plane(np.zeros(3), np.array([0.0, 0.0, 1.0])), Law(300.0, friction=0.35))
    lid = faces[:, 2, 1]
    equilibrium = held(solid, np.repeat(lid[:, None], 3, axis=1), [plane])
    equilibrium.tether_kpa_mm2 = 1e-6
    state = np.zeros_like(solid.rest)
    plane.carry(state)
    ratios = []
    for slid in (0.0, 0.5, 2.0, 4.0, 6.0, 8.0):
        state = state.copy()
        state[lid] = [slid, 0.0, -1.0]
        equilibrium.tethered_to = state
        state, _, _ = equilibrium.solve(state, 1e-9)
        plane.carry(state)
        force = plane.force(state)[1]
        ratios.append(-force[0] / force[2])
    assert ratios[0] < 0.01 and np.all(np.diff(ratios[:3]) > 0)
    # All points slide the same way once the sliding outweighs the block's spreading before it: the angle that
    # is left between them falls with each increment, and its cosine is lost from the sum.
    assert ratios[-1] == pytest.approx(0.35, abs=1e-3)
    assert max(ratios) <= 0.35 * (1 + 1e-9)


def test_a_mesh_fills_a_round_surface_and_is_finer_where_asked(ball):
    mesh = tetrahedra(ball, lambda points: np.where(points[:, 2] > 6, 2.0, 6.0))
    solid = FemSolid(mesh, TISSUE)
    weight = np.linalg.norm(solid.weight(np.array([0.0, 0.0, -9.81])).sum(axis=0)) / 1000
    assert weight == pytest.approx(ball.volume * 1e-9 * 1050 * 9.81, rel=2e-3)
    edges = mesh.p[:, mesh.edges]
    lengths, heights = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=0), edges[2].mean(axis=0)
    assert np.median(lengths[heights > 7]) < 0.6 * np.median(lengths[heights < 0])


def pressed_ball(indentations_mm: tuple[float, ...]) -> tuple[FemExperiment, list[trimesh.Trimesh]]:
    """A flat ball on a block under a press, and both: small, with everything that a kidney's case has."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=12.0)
    ball.apply_scale([1.0, 0.9, 0.7])
    block = trimesh.creation.box([40.0, 40.0, 8.0])
    block.apply_translation([0.0, 0.0, -12.7])
    press = FemPress(size_mm=(12.0, 6.0, 8.0), indentations_mm=indentations_mm)
    mesh = tetrahedra(ball, lambda points: np.full(len(points), 12.0))
    return FemExperiment(mesh, block, TISSUE, press), [ball, block]


@pytest.fixture(scope="module")
def solved_case() -> ReferenceCase:
    """The ball pressed by 1 mm."""
    experiment, (ball, block) = pressed_ball((0.0, 1.0))
    stages = list(experiment.stages())
    made = dict(time_s=1.0, edge_near_probe_mm=9.0)
    # Deep, where tetrahedra are straight.
    beads = blue_noise(ball, count=12, depth_mm=6.0)
    same = np.zeros((len(stages), len(beads)))
    return ReferenceCase(ball, block, beads, experiment.solid, experiment.press, stages, made, same)


def test_slow_motion_comes_to_the_same_rest_as_newtons_method(solved_case, monkeypatch):
    monkeypatch.setattr("studies.reference.fem_press.MOST_ITERATIONS", 0)
    monkeypatch.setattr("studies.reference.fem_press.LEAST_INCREMENT_MM", 1.0)
    monkeypatch.setattr(FemExperiment, "_first_guess", lambda self, state: state)
    experiment, _ = pressed_ball((0.0, 0.5, 1.0))
    *_, last = experiment.stages()
    pressed = solved_case.stages[-1]
    assert last.residual <= 1e-5
    # Friction remembers the way: it lets points rest within the slip at which its elastic stick gives way,
    # 1.5 times 0.35 of some 3 kPa over 150 kPa/mm.
    apart = np.linalg.norm(last.displacement_mm - pressed.displacement_mm, axis=1)
    assert apart.max() < 0.01
    assert last.probe_force_n[2] == pytest.approx(pressed.probe_force_n[2], rel=0.01)


def test_support_and_probe_hold_the_weight(solved_case):
    weight = solved_case.kidney.volume * 1e-9 * 1050 * 9.81
    first, *pressed = solved_case.stages
    # A relative residual of 1e-5 of all forces, and the mesh's volume, which is right to 0.2 %.
    assert first.support_force_n == pytest.approx([0, 0, weight], rel=2.1e-3, abs=1e-4 * weight)
    assert np.abs(first.probe_force_n).max() < 1e-9 * weight
    for stage in pressed:
        largest = np.abs(stage.support_force_n).max()
        assert stage.probe_force_n[2] < 0
        total = stage.probe_force_n + stage.support_force_n
        assert total == pytest.approx([0, 0, weight], rel=2.1e-3, abs=1e-4 * largest)
        moved = first.position_mm - stage.position_mm
        assert moved == pytest.approx([0, 0, stage.indentation_mm], abs=1e-9)


def test_a_case_folder_follows_the_format(solved_case, tmp_path):
    solved_case.write(tmp_path)
    case = tomllib.loads((tmp_path / "case.toml").read_text())
    assert case["format_version"] == 1 and case["files"]["fem"] == "result.npz"
    assert [stage["indentation_mm"] for stage in case["stage"]] == [0.0, 1.0]
    assert {"young_kPa", "poisson", "density", "weight_N", "model"} <= set(case["material"])
    assert {"size_mm", "edge_radius_mm", "press_direction", "rotation"} <= set(case["probe"])
    for name in ("kidney", "support"):
        assert trimesh.load_mesh(tmp_path / case["files"][name]).is_watertight
    rows = list(csv.DictReader((tmp_path / "beads.csv").open()))
    assert list(rows[0]) == ["id", *(f"{axis}{stage}" for stage in ("", 0, 1) for axis in "xyz")]
    assert len(rows) == 12
    result = np.load(tmp_path / "result.npz")
    nodes = len(result["nodes"])
    assert result["displacement"].shape == (2, nodes, 3) and result["tets10"].shape[1] == 10
    assert set(result["surface_faces"].ravel()) <= set(result["surface_nodes"])


def test_the_command_writes_a_case_that_validate_reads(solved_case, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("studies.reference.make_reference.solved", lambda *arguments: solved_case)
    monkeypatch.setattr("studies.reference.make_reference.blue_noise", lambda kidney: solved_case.beads)
    assert app.main(["reference", "--out", str(tmp_path / "case")]) == 0
    assert "difference to a coarser mesh 0.000 mm" in capsys.readouterr().out
    case = load_case(tmp_path / "case")
    np.testing.assert_allclose(case.beads, solved_case.beads, atol=1e-4)
    np.testing.assert_allclose(case.measured, solved_case.moved_beads, atol=1e-4)
    for pose, stage in zip(case.poses, solved_case.stages, strict=True):
        np.testing.assert_allclose(pose[:3, 3], stage.position_mm, atol=1e-6)
    assert (case.young_kpa, case.poisson, case.density_kg_m3, case.friction) == (15.0, 0.45, 1050.0, 0.35)
    assert case.organ.volume == pytest.approx(solved_case.kidney.volume, rel=1e-6)


def shape_of(local: np.ndarray) -> np.ndarray:
    """Shape functions (10,) of a quadratic tetrahedron at local coordinates (3,)."""
    of = np.array([1 - local.sum(), *local])
    return np.array([*(of * (2 * of - 1)), *(4 * of[i] * of[j] for i, j in combinations(range(4), 2))])


def test_the_files_agree_on_the_deformation(solved_case, tmp_path):
    """Beads through result.npz alone: shape functions of the file's order of nodes, also in curved
    tetrahedra.
    """
    solved_case.write(tmp_path)
    result = np.load(tmp_path / "result.npz")
    table = np.genfromtxt(tmp_path / "beads.csv", delimiter=",", skip_header=1)[:, 1:].reshape(12, 3, 3)
    corners = result["nodes"][result["tets10"][:, :4]]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    assert np.linalg.det(edges).min() > 0
    checked = 0
    for bead, *moved in table:
        straight = np.linalg.solve(edges, (bead - corners[:, 0])[..., None])[..., 0]
        tet = np.column_stack([1 - straight.sum(axis=1), straight]).min(axis=1).argmax()
        nodes = result["tets10"][tet]
        local = fsolve(
            lambda at, nodes=nodes, bead=bead: shape_of(at) @ result["nodes"][nodes] - bead, straight[tet]
        )
        if min(*local, 1 - local.sum()) < 0:
            continue  # in a neighbour of a curved one
        for stage, place in enumerate(moved):
            shift = shape_of(local) @ result["displacement"][stage][nodes]
            np.testing.assert_allclose(place, bead + shift, atol=2e-4)  # the table has four digits
        checked += 1
    assert checked >= 9


def test_beads_are_deep_and_far_apart(ball):
    beads = blue_noise(ball)
    assert beads.shape == (45, 3) and np.linalg.norm(beads, axis=1).max() <= 9.0
    apart = np.linalg.norm(beads[:, None] - beads, axis=2) + 99 * np.eye(45)
    # 45 random points have a least distance of some V^(1/3) / 45^(2/3), 1.1 mm here.
    assert apart.min() > 2.0
    np.testing.assert_array_equal(beads, blue_noise(ball))


def test_the_frame_of_the_files_is_upright_and_right_handed(block):
    block.apply_translation([50.0, 20.0, -300.0])
    upright = in_case_frame(block, np.array([0.0, 1.0, 0.0]), block)
    assert upright.volume == pytest.approx(block.volume)
    np.testing.assert_allclose(upright.center_mass, 0, atol=1e-9)
    np.testing.assert_allclose(np.ptp(upright.vertices, axis=0), [24, 16, 20])


def test_a_body_without_fixed_nodes_is_refused():
    solid = cube(2)
    free = Equilibrium(solid, [], solid.weight(np.array([0.0, 0.0, -9.81])))
    with pytest.raises(NotConvergedError):
        free.solve(np.zeros_like(solid.rest), 1e-6)


def test_a_missing_library_is_one_line(monkeypatch, capsys, tmp_path):
    for loaded in ("studies.reference.make_reference", "studies.reference.tetrahedral_mesh"):
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, "mmgpy", None)
    line = refusal(capsys, "reference", "--out", tmp_path / "case")
    assert "mmgpy" in line and "requirements-dev.txt" in line
