"""The 3D view that the processor draws, against a slow drawing of the same triangles pixel by pixel in
float64.
"""

import numpy as np
import pytest

from render.camera import OrbitCamera
from render.software_scene import SoftwareScene, _draw
from render.window_layout import Rect
from sim.fields import fields_of, fill

WIDTH, HEIGHT = 48, 40
GREY = 60
# Pixels nearer than this to an edge may fall on either side of it in float32.
EDGE = 1e-3


def drawn(screen, colours, triangles, box=(0, WIDTH, 0, HEIGHT), pixels=None) -> np.ndarray:
    """The pixels (WIDTH, HEIGHT, 3) after the triangles."""
    if pixels is None:
        pixels = np.full((WIDTH, HEIGHT, 4), GREY, np.uint8)
    depth = np.zeros((WIDTH, HEIGHT), np.float32)
    arrays = (
        np.asarray(screen, np.float32),
        np.asarray(colours, np.float32),
        np.asarray(triangles, np.int32),
    )
    _draw(*arrays, *box, depth, pixels.view(np.uint32)[..., 0])
    assert (pixels[..., 3][box[0] : box[1], box[2] : box[3]] >= GREY).all()
    return pixels[..., :3].astype(int)


def slowly_drawn(screen, colours, triangles) -> tuple[np.ndarray, np.ndarray]:
    """The same, and which pixels are not near an edge."""
    image = np.full((WIDTH, HEIGHT, 3), float(GREY))
    depth, clear = np.zeros((WIDTH, HEIGHT)), np.ones((WIDTH, HEIGHT), bool)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5, indexing="ij")
    for triangle in triangles:
        corners = np.asarray(screen, float)[triangle]
        if (corners[:, 2] <= 0).any():
            continue
        system = np.stack([corners[:, 0], corners[:, 1], np.ones(3)])
        shares = np.einsum("ij,jxy->ixy", np.linalg.inv(system), np.stack([x, y, np.ones_like(x)]))
        reach = np.linalg.norm(np.roll(corners[:, :2], -1, axis=0) - corners[:, :2], axis=1).max()
        clear &= np.abs(shares).min(axis=0) * reach > EDGE
        nearness = np.einsum("i,ixy->xy", corners[:, 2], shares)
        hit = (shares > 0).all(axis=0) & (nearness >= depth)
        colour = np.clip(np.einsum("ic,ixy->xyc", np.asarray(colours, float)[triangle], shares), 0, 1)
        alpha = colour[..., 3:]
        image = np.where(hit[..., None], image + alpha * (255 * colour[..., :3] - image), image)
        depth = np.where(hit, nearness, depth)
    return image, clear


def random_triangles(seed: int, count: int = 25):
    random = np.random.default_rng(seed)
    screen = np.column_stack(
        [random.uniform(-15, WIDTH + 15, 3 * count), random.uniform(-15, HEIGHT + 15, 3 * count)]
        + [random.uniform(0.01, 0.1, 3 * count)]
    )
    colours = random.uniform(0, 1, (3 * count, 4))
    # Half of them solid.
    colours[: 3 * (count // 2), 3] = 1.0
    order = random.permutation(count)
    return screen, colours, np.arange(3 * count).reshape(-1, 3)[order]


@pytest.mark.parametrize("seed", range(4))
def test_triangles_cover_hide_and_blend_as_in_float64(one_device, seed):
    triangles = random_triangles(seed)
    expected, clear = slowly_drawn(*triangles)
    image = drawn(*triangles)
    # Each blend rounds to a level, and the next ones pass on less than all of it.
    assert clear.mean() > 0.9 and np.abs(image - expected)[clear].max() <= 2.5
    assert np.abs(expected - GREY).max() > 100


def test_an_edge_that_two_triangles_share_is_drawn_once(one_device):
    random = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(9), indexing="ij"), axis=-1).reshape(-1, 2)
    places = 4.0 + 4.0 * grid + random.uniform(-1.2, 1.2, grid.shape)
    # Some on the centres of pixels, and some edges along columns and rows.
    places[::3] = np.floor(places[::3]) + 0.5
    screen = np.column_stack([places, np.full(len(places), 0.05)])
    corner = (9 * np.arange(8)[:, None] + np.arange(8)).ravel()
    triangles = np.concatenate(
        [
            np.column_stack([corner, corner + 1, corner + 9]),
            np.column_stack([corner + 1, corner + 9, corner + 10]),
        ]
    )
    colours = np.tile([1.0, 1.0, 1.0, 0.5], (len(places), 1))
    level = drawn(screen, colours, triangles)[..., 0]
    once = round(GREY + 0.5 * (255 - GREY))
    assert set(np.unique(level)) == {GREY, once}
    # All of what lies well within the border is covered.
    assert (level[8:34, 8:34] == once).all()


def test_what_is_in_a_box_does_not_depend_on_how_it_is_divided(one_device):
    triangles = random_triangles(9)
    whole = drawn(*triangles)
    pixels = np.full((WIDTH, HEIGHT, 4), GREY, np.uint8)
    for box in ((0, 13, 0, HEIGHT), (13, WIDTH, 0, 22), (13, WIDTH, 22, HEIGHT)):
        parts = drawn(*triangles, box=box, pixels=pixels)
    assert np.array_equal(parts, whole)
    clipped = drawn(*triangles, box=(5, 20, 8, 30))
    assert np.array_equal(clipped[5:20, 8:30], whole[5:20, 8:30])
    clipped[5:20, 8:30] = GREY
    assert (clipped == GREY).all()


def test_a_triangle_behind_the_eye_or_far_outside_draws_nothing(one_device):
    screen, colours = np.array([[5.0, 5.0, 0.05], [30.0, 8.0, 0.05], [12.0, 30.0, 0.05]]), np.ones((3, 4))
    assert (drawn(screen, colours, [[0, 1, 2]]) != GREY).any()
    behind = screen.copy()
    behind[1, 2] = 0.0
    assert (drawn(behind, colours, [[0, 1, 2]]) == GREY).all()
    for shift in ([1e9, 0.0, 0.0], [-1e9, 0.0, 0.0], [0.0, 1e9, 0.0], [0.0, -1e9, 0.0]):
        assert (drawn(screen + shift, colours, [[0, 1, 2]]) == GREY).all()
    flat = np.array([[5.0, 5.0, 0.05], [10.0, 10.0, 0.05], [20.0, 20.0, 0.05]])
    assert (drawn(flat, colours, [[0, 1, 2]]) == GREY).all()


# The scene


@pytest.fixture
def scene(one_device) -> SoftwareScene:
    camera = OrbitCamera(np.array([[-10.0] * 3, [10.0] * 3]), [0, 0, 1], (0.0, 0.0, 1.0, 1.0), WIDTH / HEIGHT)
    return SoftwareScene(camera, (WIDTH, HEIGHT))


def shown(scene: SoftwareScene) -> np.ndarray:
    pixels = np.full((WIDTH, HEIGHT, 4), GREY, np.uint8)
    scene.render(Rect(0, 0, WIDTH, HEIGHT), pixels)
    return pixels[..., :3].astype(int)


def facing(scene: SoftwareScene, size_mm: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a square in the middle of the view that faces the eye, and its normal."""
    right, up, ahead = scene.camera.axes()
    sides = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size_mm
    return scene.camera.target + sides @ np.stack([right, up]), -ahead


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_surface_is_lit_by_lamberts_law(scene, side, two_sided):
    points, normal = facing(scene)
    light_at = scene.camera.target + 30 * normal + 20 * scene.camera.axes()[0]
    scene.ambient_light((0.1, 0.2, 0.3))
    scene.point_light(light_at, (0.5, 0.4, 0.3))
    base = np.array([0.9, 0.6, 0.3])
    vertices, normals, colours = fields_of(
        points, np.tile(side * normal, (4, 1)), np.tile(base, (4, 1)), within=1
    )
    scene.mesh(vertices, np.array([0, 1, 2, 0, 2, 3]), normals, colours, two_sided)
    colour = shown(scene)[WIDTH // 2, HEIGHT // 2]
    # In the middle of the square the light's direction is nearly that of its corners' mean.
    towards = (light_at - points) / np.linalg.norm(light_at - points, axis=1, keepdims=True)
    lit = side > 0 or two_sided
    cosine = float((towards @ normal).mean()) if lit else 0.0
    expected = 255 * base * (np.array([0.1, 0.2, 0.3]) + cosine * np.array([0.5, 0.4, 0.3]))
    assert np.abs(colour - expected).max() <= 1.0


def test_points_are_where_the_camera_projects_them(scene):
    random = np.random.default_rng(0)
    points = random.uniform(-8, 8, (50, 3))
    expected = scene.camera.project(points) * (WIDTH, HEIGHT)
    screen = scene._projected(points.astype(np.float32))
    assert screen[:, :2] == pytest.approx(expected, abs=1e-3)
    ahead = scene.camera.axes()[2]
    assert 1 / screen[:, 2] == pytest.approx((points - scene.camera.eye()) @ ahead, rel=1e-5)
    assert scene._projected((scene.camera.eye() - ahead)[None])[0, 2] == 0.0


def test_a_line_has_its_width_and_is_drawn_over_the_surface_it_is_on(scene):
    points, normal = facing(scene)
    white = np.ones((4, 3))
    scene.ambient_light((1.0, 1.0, 1.0))
    fields = fields_of(points, np.tile(normal, (4, 1)), white, within=1)
    scene.mesh(fields[0], np.array([0, 1, 2, 0, 2, 3]), fields[1], fields[2])
    (ends,) = fields_of(np.stack([points[[0, 3]].mean(axis=0), points[[1, 2]].mean(axis=0)]), within=1)
    scene.lines(ends, 3.0, color=(1.0, 0.0, 0.0))
    red = (shown(scene) == [255, 0, 0]).all(axis=2)
    assert red[WIDTH // 2].sum() == 3


def test_what_is_kept_of_the_first_mesh_is_what_would_be_drawn_anew(scene):
    points, normal = facing(scene)
    bars = np.array([0, 1, 2, 0, 2, 3])
    (vertices, normals, colours), behind = (
        fields_of(at, np.tile(normal, (4, 1)), np.tile([0.4, 0.5, 0.6], (4, 1)), within=1)
        for at in (points, 0.5 * points - 3.0 * normal)
    )

    def drawn(by: SoftwareScene, grey: int = GREY) -> np.ndarray:
        by.look()
        by.ambient_light((1.0, 1.0, 1.0))
        by.mesh(vertices, bars, normals, colours)
        by.mesh(behind[0], bars, behind[1], behind[2])
        by.lines(behind[0], 2.0, color=(1.0, 0.0, 0.0))
        pixels = np.full((WIDTH, HEIGHT, 4), grey, np.uint8)
        by.render(Rect(0, 0, WIDTH, HEIGHT), pixels)
        return pixels

    def anew(grey: int = GREY) -> np.ndarray:
        return drawn(SoftwareScene(scene.camera, (WIDTH, HEIGHT)), grey)

    first = drawn(scene)
    kept = scene._layer
    assert np.array_equal(drawn(scene), first) and scene._layer is kept
    # Another background, other colours, another place, another camera.
    assert np.array_equal(drawn(scene, 20), anew(20))
    fill((colours, np.tile([0.9, 0.1, 0.2], (4, 1))))
    assert np.array_equal(drawn(scene), anew()) and not np.array_equal(anew(), first)
    fill((vertices, points + 2.0))
    assert np.array_equal(drawn(scene), anew())
    scene.camera.orbit(0.1, 0.05)
    assert np.array_equal(drawn(scene), anew())
