"""The slice: at rest the CT itself, deformed the analytic pull-back; the embedding against brute force."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np
import pytest
import SimpleITK as sitk
import taichi as ti
import taichi.math as tm
from conftest import rotation_about
from particle_tissue import tissue_of
from slicing import hounsfield, organ_mask

from sim.body import BodyState
from sim.embedding import Embedding, Unmoved, tetrahedra_around
from sim.fields import array_of, fill, fill_evenly
from sim.kernels import kernel
from sim.shape_matching import ShapeMatching
from sim.skinning import Skin
from ultrasound.ct_slice import CTSlice
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe_manipulator import ImagePlane, image_plane, pose_at
from ultrasound.sampled_volume import SampledVolume, distance_volume
from ultrasound.scanner import OUTSIDE

RADIUS = 2.0
GRADIENT = np.array([11.0, -7.0, 5.0])  # HU / mm


def ramp_image() -> sitk.Image:
    """HU that grow linearly along a direction, in an oblique grid: every resampling of it is exact."""
    image = sitk.Image(60, 50, 40, sitk.sitkFloat32)
    image.SetSpacing((0.9, 1.1, 1.5))
    image.SetDirection(rotation_about([1, 2, 3], 25).flatten().tolist())
    centre = np.array(image.TransformContinuousIndexToPhysicalPoint((29.5, 24.5, 19.5)))
    image.SetOrigin((-centre).tolist())
    index = np.indices((40, 50, 60))[::-1].reshape(3, -1)
    points = np.array(image.GetDirection()).reshape(3, 3) @ (np.array(image.GetSpacing())[:, None] * index)
    hu = GRADIENT @ (points + np.array(image.GetOrigin())[:, None])
    ramp = sitk.GetImageFromArray(hu.reshape(40, 50, 60).astype(np.float32))
    ramp.CopyInformation(image)
    return ramp


def noisy_image() -> sitk.Image:
    image = ramp_image()
    noise = np.random.default_rng(3).normal(0, 100, sitk.GetArrayFromImage(image).shape).astype(np.float32)
    noisy = sitk.GetImageFromArray(noise)
    noisy.CopyInformation(image)
    return noisy


def voxels_of(image: sitk.Image) -> np.ndarray:
    return sitk.GetArrayFromImage(image).transpose(2, 1, 0)


def volume_of(image: sitk.Image) -> SampledVolume:
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    mm_from_index[:3, 3] = image.GetOrigin()
    return SampledVolume(voxels_of(image), np.linalg.inv(mm_from_index))


def oblique_plane(width: float = 30.0, depth: float = 26.0):
    pose = pose_at(np.array([1.0, 2.0, 12.0]), np.array([0.2, -0.1, -1.0]), np.array([1.0, 0.4, 0.0]), 20.0)
    return image_plane(pose, 20.0, width, depth)


def pixel_points(plane, pixels: int) -> np.ndarray:
    """World positions (rows, columns, 3) of the pixels' centres."""
    x = (np.arange(pixels) + 0.5) * plane.width_mm / pixels - plane.width_mm / 2
    y = (np.arange(pixels) + 0.5) * plane.depth_mm / pixels
    local = np.stack([*np.meshgrid(x, y), np.zeros((pixels, pixels)), np.ones((pixels, pixels))], axis=-1)
    return (local @ plane.world_from_plane.T)[..., :3]


@dataclass(frozen=True)
class Embedded:
    """A body with what carries an image plane, at rest or moved from elsewhere."""

    model: ShapeMatching
    embedding: Embedding

    def snapshot(self) -> BodyState:
        return self.model.body.snapshot()

    def restore(self, state: BodyState) -> None:
        self.model.body.restore(state)
        self.model.update_frames()
        self.embedding.update()

    def move(self, to: np.ndarray) -> None:
        """All particles (n, 3) to other places."""
        self.restore(BodyState(to.astype(np.float32), np.zeros(to.shape, np.float32)))


def embedded(mesh, margin_mm: float = 0.0) -> Embedded:
    model = tissue_of(mesh, RADIUS)
    return Embedded(model, Embedding(model.carrier, mesh, 2 * RADIUS, margin_mm))


def cut_of(embedding: Embedding | Unmoved, mesh, image: Callable, pixels: int, outside: str) -> CTSlice:
    # Distances finer than usual, so that the border is as exact as these tests ask for.
    volumes = volume_of(image()), distance_volume(mesh, 1.0)
    return CTSlice(PlaneInTissue(embedding, pixels), *volumes, OUTSIDE[outside][0])


def sliced(kept, mesh, image: Callable, move=None, pixels: int = 96, outside: str = "gel"):
    body = kept(embedded, mesh)
    if move is not None:
        body.move(move(body.model.body.rest_points))
    # Only the voxels differ from image to image.
    cut = kept(cut_of, body.embedding, mesh, ramp_image, pixels, outside)
    cut.ct.set_values((slice(None),) * 3, voxels_of(image()))
    plane = oblique_plane()
    cut.plane.locate(plane)
    return cut, plane, body.model, body.embedding


# Of few pixels some that are drawn together are in the organ and others beyond all tissue; 20 are no multiple
# of those.
@pytest.mark.parametrize("outside, pixels", [("gel", 96), ("air", 96), ("background", 96), ("gel", 20)])
def test_at_rest_it_is_an_oblique_resample_of_the_ct(kept, ball, outside, pixels):
    image = noisy_image()
    cut, plane, _, _ = sliced(kept, ball, noisy_image, pixels=pixels, outside=outside)
    grid = sitk.Image(pixels, pixels, 1, sitk.sitkFloat32)
    grid.SetSpacing((plane.width_mm / pixels, plane.depth_mm / pixels, 1.0))
    grid.SetDirection(plane.world_from_plane[:3, :3].flatten().tolist())
    grid.SetOrigin(pixel_points(plane, pixels)[0, 0].tolist())
    resampled = sitk.GetArrayFromImage(
        sitk.Resample(image, grid, sitk.Transform(), sitk.sitkLinear, -1000.0)
    )[0]
    hu, inside = hounsfield(cut), organ_mask(cut)
    assert 0.3 < inside.mean() < 0.9
    # float32 positions of 15 mm carry 1e-6 mm, a barycentric map ten times that; noise of 100 HU/mm.
    assert np.abs(hu - resampled)[inside].max() < 0.05
    beyond = {"gel": 0.0, "air": -1000.0, "background": resampled[~inside]}[outside]
    assert np.abs(hu[~inside] - beyond).max() < 0.05
    in_ball = np.linalg.norm(pixel_points(plane, pixels), axis=-1) < 12.0
    # Linear distances on a 1 mm grid and the ball's facets are off by less than a tenth of a millimetre.
    assert (in_ball ^ inside).mean() < 0.02


def test_under_a_rigid_motion_it_is_the_exact_pull_back(kept, ball):
    turn, shift = rotation_about([1, -1, 2], 20), np.array([1.5, -1.0, 2.0])
    cut, plane, _, _ = sliced(kept, ball, ramp_image, lambda x: x @ turn.T + shift)
    wanted = ((pixel_points(plane, 96) - shift) @ turn) @ GRADIENT
    inside = organ_mask(cut)
    assert inside.mean() > 0.3
    # Frames fitted in float32 turn by 1e-6 at 12 mm; the ramp has 14 HU/mm.
    assert np.abs(hounsfield(cut) - wanted)[inside].max() < 14 * 1e-4


@pytest.mark.parametrize("stretch", [0.05, 0.15])
def test_under_an_affine_deformation_it_is_the_pull_back_within_the_skins_error(kept, ball, stretch):
    shear = np.eye(3) + stretch * np.array([[0.6, 0.5, 0.0], [0.0, -1.0, 0.3], [0.2, 0.0, 0.4]])
    shift = np.array([0.5, 0.0, -1.0])
    cut, plane, model, embedding = sliced(kept, ball, ramp_image, lambda x: x @ shear.T + shift)
    wanted = ((pixel_points(plane, 96) - shift) @ np.linalg.inv(shear).T) @ GRADIENT
    inside = organ_mask(cut)
    # A vertex at X goes to R X + (F - R) c, with c the weighted mean of its clusters' centres, instead of to
    # F X: it is off by (F - R)(X - c). Pulled back, that is an error of F^-1 (F - R)(X - c) at most, in any
    # tetrahedron.
    u, _, vt = np.linalg.svd(shear)
    skin = embedding.skin
    centre = np.einsum("vk,vkj->vj", array_of(skin.weight), model.rest_centres[array_of(skin.frame)])
    used = np.unique(array_of(cut.plane.owner)[inside])
    vertices = np.unique(array_of(embedding.tetrahedron)[used])
    off = (array_of(skin.rest) - centre)[vertices] @ (np.linalg.inv(shear) @ (shear - u @ vt)).T
    bound = np.linalg.norm(off, axis=1).max() * np.linalg.norm(GRADIENT)
    error = np.abs(hounsfield(cut) - wanted)[inside]
    assert error.max() < bound
    # Were the tissue taken as undeformed, it would be wrong by far more than that on average.
    undeformed = np.abs(pixel_points(plane, 96) @ GRADIENT - wanted)[inside]
    assert error.mean() < 0.35 * undeformed.mean()


def bent(x: np.ndarray) -> np.ndarray:
    return x + 0.03 * x[:, [1, 2, 0]] ** 2


def test_the_pixel_near_a_place_is_the_nearest(one_device):
    plane = PlaneInTissue(Unmoved(), 24)
    plane.locate(ImagePlane(np.eye(4), 30.0, 18.0, 4.0))
    places = np.random.default_rng(6).uniform([-20, -8], [20, 18], (300, 2)).astype(np.float32)
    pixels = np.zeros((300, 2), np.int32)

    @kernel
    def ask(
        plane: ti.template(),
        places: ti.types.ndarray(ti.f32, ndim=2),
        pixels: ti.types.ndarray(ti.i32, ndim=2),
    ):
        for i in range(300):
            at = tm.vec2(places[i, 0], places[i, 1])
            pixels[i, 0], pixels[i, 1] = plane.pixel_near(at)

    ask(plane, places, pixels)
    middles = (np.arange(24) + 0.5) / 24
    u, v = middles * 30.0 - 15.0, middles * 18.0 - 4.0
    assert np.array_equal(pixels[:, 0], np.abs(places[:, 1:] - v).argmin(axis=1))
    assert np.array_equal(pixels[:, 1], np.abs(places[:, :1] - u).argmin(axis=1))


def edges_of(embedding: Embedding) -> tuple[np.ndarray, np.ndarray]:
    """Last corners (t, 3) of the tetrahedra, and the edges (t, 3, 3) from there to the others, as columns."""
    corners = array_of(embedding.skin.vertices).astype(float)[array_of(embedding.tetrahedron)]
    return corners[:, 3], np.moveaxis(corners[:, :3] - corners[:, 3:], 1, 2)


def least_weights(inverse: np.ndarray, corner: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Least barycentric coordinate (t,) of a place in each tetrahedron: negative where it is outside."""
    weights = np.einsum("tij,tj->ti", inverse, place - corner)
    return np.minimum(weights.min(axis=1), 1 - weights.sum(axis=1))


def test_every_pixel_finds_the_tetrahedron_that_holds_it(kept, ball):
    cut, plane, _, embedding = sliced(kept, ball, ramp_image, bent)
    corner, edges = edges_of(embedding)
    inverse, points, owner = np.linalg.inv(edges), pixel_points(plane, 96), array_of(cut.plane.owner)
    for row, column in np.random.default_rng(5).integers(0, 96, (300, 2)):
        least = least_weights(inverse, corner, points[row, column])
        if owner[row, column] == embedding.count:
            assert least.max() < 1e-4
        else:
            assert least[owner[row, column]] > -1e-4


@pytest.mark.parametrize(
    "direction, lateral", [((0, 0, -1), (1, 0, 0)), ((0, -1, -1), (1, 0, 0)), ((1, 1, 1), (1, -1, 0))]
)
def test_no_pixel_falls_between_tetrahedra_where_the_plane_goes_along_their_sides(
    kept, ball, direction, lateral
):
    embedding = kept(embedded, ball).embedding
    vertices = array_of(embedding.skin.rest).astype(float)
    centre = vertices[np.linalg.norm(vertices, axis=1).argmin()]
    # Through a vertex amid the ball, with pixels on the edges: 4 mm are 8 of them.
    pose = pose_at(np.zeros(3), np.array(direction, float), np.array(lateral, float), 20.0)
    plane = PlaneInTissue(embedding, 33)
    axes = image_plane(pose, 20.0, 16.5, 16.5).world_from_plane
    for out in np.eye(3):
        world = axes.copy()
        # Each of the probe's axes in turn is square to the plane.
        world[:3, :3] = np.roll(axes[:3, :3], int(out.argmax()), axis=1)
        world[:3, 3] = centre - world[:3, :3] @ [0.0, 8.25, 0.0]
        plane.locate(ImagePlane(world, 16.5, 16.5))
        assert (array_of(plane.owner) < embedding.count).all()


@pytest.mark.parametrize("shape", [(32, 96), (96, 32), (32, 32)])
def test_fewer_pixels_are_in_the_tetrahedra_of_the_places_that_they_show(kept, ball, shape):
    cut, plane, _, embedding = sliced(kept, ball, ramp_image, bent)
    owner, rest = array_of(cut.plane.owner), cut.plane.rest_grid(96).copy()
    # Of three pixels the middle one has the centre of a pixel three times as large.
    middle = tuple(slice(1, None, 3) if count == 32 else slice(None) for count in shape)
    cut.plane.locate(plane, shape)
    fewer = array_of(cut.plane.owner)[: shape[0], : shape[1]]
    # Rounding decides on what is between two tetrahedra.
    assert (fewer != owner[middle]).mean() < 0.002 and (fewer < embedding.count).mean() > 0.2
    # Places that are measured stay where they are; a map continues up to 0.4 mm beyond its tetrahedron, which
    # is bent by 0.1 per mm.
    inside = owner < embedding.count
    assert np.abs(cut.plane.rest_grid(96) - rest)[inside].mean() < 0.02
    assert np.abs(cut.plane.rest_grid(96) - rest)[middle][inside[middle]].max() < 1e-3


def test_of_overlapping_tetrahedra_the_lowest_is_taken_whatever_the_threads(kept, ball):
    def folded(x):
        return x - np.column_stack([0 * x[:, 0], 0 * x[:, 0], 10.0 * (x[:, 2] > 1.0)])

    cut, plane, _, embedding = sliced(kept, ball, ramp_image, folded)
    corner, edges = edges_of(embedding)
    # What is turned inside out is not taken: the tissue that it was squeezed into is there too.
    solid = np.linalg.det(edges) < -0.1
    inverse = np.zeros_like(edges)
    inverse[solid] = np.linalg.inv(edges[solid])
    points, owner = pixel_points(plane, 96), array_of(cut.plane.owner)
    overlaps = 0
    for row, column in np.argwhere(owner != embedding.count)[::3]:
        least = least_weights(inverse, corner, points[row, column])
        holds = np.flatnonzero(solid & (least > 1e-3))
        overlaps += len(holds) > 1
        assert len(holds) == 0 or owner[row, column] <= holds[0]
        assert np.linalg.det(edges[owner[row, column]]) < 0
    assert overlaps > 50
    # One after the other or in parallel: the same.
    axes = np.linalg.inv(plane.world_from_plane), plane.world_from_plane, *array_of(cut.plane.grid)
    matrices = [ti.Matrix(values.tolist()) for values in axes]
    other = copy(embedding)
    other.serial = not embedding.serial
    fill_evenly(cut.plane.owner, -1)
    other.locate_on_plane(*matrices, *cut.plane.shape, cut.plane.owner)
    assert np.array_equal(array_of(cut.plane.owner), owner)


@pytest.mark.parametrize("squash", [(1, 1, 0), (1, 0, 0), (0, 0, 0), (1, 1, -1), (1, 1, 1e-6)])
def test_flat_collapsed_and_inverted_tissue_still_gives_a_picture(kept, ball, squash):
    cut, _, _, embedding = sliced(kept, ball, ramp_image, lambda x: x * np.array(squash) + [0, 0, 3.0])
    owner = array_of(cut.plane.owner)
    assert ((owner >= 0) & (owner <= embedding.count)).all()
    assert np.isfinite(hounsfield(cut)).all()


def test_surroundings_deform_with_the_organ_and_far_tissue_is_fixed(kept, ball):
    shift = np.array([0.0, 0.0, 4.0])
    body = kept(embedded, ball, margin_mm=25.0)
    body.move(body.model.body.rest_points + shift)
    embedding = body.embedding
    moved = array_of(embedding.skin.vertices) - array_of(embedding.skin.rest)
    away = np.linalg.norm(array_of(embedding.skin.rest), axis=1) - 12.0
    assert np.abs(moved[away < 2 * RADIUS] - shift).max() < 1e-4
    assert np.abs(moved[away > 26.0]).max() < 1e-4
    between = (away > 10.0) & (away < 20.0)
    assert 0.5 < moved[between, 2].mean() < 3.5


def test_surroundings_that_fold_over_the_organ_do_not_cover_it(kept, ball):
    embedding = kept(embedded, ball, margin_mm=25.0).embedding
    cut = cut_of(embedding, ball, ramp_image, 96, "background")
    cut.plane.locate(oblique_plane())
    organ, owner = organ_mask(cut), array_of(cut.plane.owner)
    vertices = array_of(embedding.skin.vertices)
    outside = np.linalg.norm(array_of(embedding.skin.rest), axis=1) > 12.0 + 2 * RADIUS * np.sqrt(3)
    vertices[outside & (vertices[:, 2] > 0)] -= [0.0, 0.0, 26.0]
    fill((embedding.skin.vertices, vertices))
    cut.plane.locate(oblique_plane())
    assert organ.sum() > 1000 and (array_of(cut.plane.owner) != owner)[~organ].sum() > 100
    assert (array_of(cut.plane.owner) == owner)[organ].all()


def test_tissue_that_does_not_move_is_shown_in_place(kept, ball):
    cut = cut_of(Unmoved(), ball, noisy_image, 96, "background")
    plane = oblique_plane()
    cut.plane.locate(plane)
    assert np.abs(cut.plane.rest_grid(96) - pixel_points(plane, 96)).max() < 1e-4
    still, _, _, _ = sliced(kept, ball, noisy_image, outside="background")
    assert np.abs(hounsfield(cut) - hounsfield(still)).max() < 0.05


def test_tetrahedra_fill_the_organ_without_gaps(ball):
    vertices, tetrahedra = tetrahedra_around(ball, 4.0)
    corners = vertices[tetrahedra]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert volume == pytest.approx(np.full(len(volume), 4.0**3 / 6))
    inside = np.random.default_rng(0).normal(size=(500, 3))
    inside *= 11.9 / np.linalg.norm(inside, axis=1, keepdims=True)
    for point in inside:
        weights = np.linalg.solve(
            np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 2), (point - corners[:, 0])[..., None]
        )
        least = np.minimum(weights.min(axis=(1, 2)), 1 - weights.sum(axis=(1, 2)))
        assert least.max() > -1e-9


def test_skin_weights_fall_off_with_the_inverse_square(kept, ball):
    model = kept(embedded, ball).model
    skin = Skin(model.carrier, ball.vertices)
    frame, weight = array_of(skin.frame), array_of(skin.weight)
    assert frame.shape[1] == 4
    assert weight.sum(axis=1) == pytest.approx(np.ones(len(weight)), abs=1e-6)
    squared = ((ball.vertices[:, None] - model.rest_centres[frame]) ** 2).sum(axis=2)
    assert weight * squared == pytest.approx((weight * squared)[:, :1].repeat(4, axis=1), rel=1e-3)
    others = np.sort(((ball.vertices[:, None] - model.rest_centres[None]) ** 2).sum(axis=2), axis=1)
    assert np.sort(squared, axis=1) == pytest.approx(others[:, :4])
