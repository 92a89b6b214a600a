"""The embedded patient: a contrast CT of a left kidney with a tumour, and its labels, from closed formulas.

Supine, patient coordinates LPS in mm (+x left, +y posterior, +z head), so gravity points along +y. The result
is deterministic. Signed distances [mm] are negative inside.

The kidney is built in a *kidney frame* (u, v, w) [mm]: w along the long axis to the upper pole, u away from
the hilum, v to the anterior face. The frame is bent so that both poles lean to the hilum: the bean.
"""

from enum import IntEnum
from itertools import combinations, pairwise

import numpy as np
import SimpleITK as sitk
from numpy.typing import ArrayLike
from scipy import ndimage

from scenes.phantom.abdomen import (
    HU,
    ORIGIN,
    SPACING,
    Canvas,
    ellipsoid,
    paint_abdomen,
    smooth_min,
    wall_depth,
    waves_at,
)

SEED = 20130629
POINT_SPREAD_SD = 0.8
NOISE_SD = 10.0
NOISE_CORRELATION = 0.6


class Label(IntEnum):
    """Tissue of a voxel, by its name in ultrasound/acoustic_tissues.toml; the union of all but 0 is the
    organ, one solid without cavities.
    """

    OUTSIDE = 0
    CORTEX = 1
    MEDULLA = 2
    SINUS = 3
    URINE = 4
    ARTERY = 5
    TUMOUR = 6
    VEIN = 7


# Half-axes along (u, v, w): a kidney of 11 x 6 x 4.5 cm, blunter at the poles than an ellipsoid.
KIDNEY_CENTRE = np.array([66.0, 30.0, -328.0])
KIDNEY_HALF_AXES = np.array([29.8, 23.4, 55.5])
KIDNEY_EXPONENT = 2.3
KIDNEY_BEND = 0.0042
HILAR_DEPTH = 8.0
LOBULATION_DEPTH = 1.0
CORTEX_THICKNESS = 5.6
COLUMN_THICKNESS = 3.6
HILAR_STUB = 1.5

SINUS_CENTRE = np.array([-7.0, -0.5, 0.0])
SINUS_HALF_AXES = np.array([15.5, 9.2, 29.0])

TUMOUR_RADIUS = 12.4
TUMOUR_DEPTH = 2.5
TUMOUR_SITE = (78.0, -25.0)

# Where the pyramids point [degrees]: angle about the long axis from lateral (0) to anterior (90), latitude.
PYRAMID_SITES = (
    *((62.0, -46.0), (92.0, -20.0), (52.0, -4.0), (88.0, 18.0), (58.0, 42.0)),
    *((-38.0, -48.0), (-74.0, -24.0), (-28.0, -14.0), (-72.0, 8.0), (-34.0, 24.0)),
    *((0.0, -82.0), (-10.0, 76.0)),
)


def _kidney_axes() -> np.ndarray:
    """Rows u, v, w in LPS, shape (3, 3): the hilum faces medially and 30 degrees to the front, the upper pole
    leans medially (16 degrees) and backward (12 degrees)."""
    w = np.array([-np.tan(np.radians(16)), np.tan(np.radians(12)), 1.0])
    w /= np.linalg.norm(w)
    u = np.array([np.cos(np.radians(30)), np.sin(np.radians(30)), 0.0])
    u -= w * (u @ w)
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(u, w), w])


KIDNEY_AXES = _kidney_axes()


def to_patient(points: np.ndarray) -> np.ndarray:
    """Kidney frame to LPS [mm], shape (..., 3)."""
    bent = np.array(points, dtype=float)
    bent[..., 0] -= KIDNEY_BEND * bent[..., 2] ** 2
    return KIDNEY_CENTRE + bent @ KIDNEY_AXES


def to_kidney(points: ArrayLike) -> np.ndarray:
    """LPS to kidney frame [mm], shape (..., 3)."""
    straight = (np.asarray(points) - KIDNEY_CENTRE) @ KIDNEY_AXES.T
    straight[..., 0] += KIDNEY_BEND * straight[..., 2] ** 2
    return straight


def _site_on_hull(angle: float, latitude: float) -> np.ndarray:
    """Point of the bean, before lobes and hilum, in a direction given in degrees; kidney frame [mm]."""
    angle, latitude = np.radians([angle, latitude])
    direction = np.array(
        [np.cos(latitude) * np.cos(angle), np.cos(latitude) * np.sin(angle), np.sin(latitude)]
    )
    radius = (np.abs(direction) ** KIDNEY_EXPONENT).sum() ** (1 / KIDNEY_EXPONENT)
    return KIDNEY_HALF_AXES * direction / radius


PYRAMID_BASES = np.array([_site_on_hull(*site) for site in PYRAMID_SITES])


_DIRECTIONS = PYRAMID_BASES / KIDNEY_HALF_AXES
# Tips of the pyramids on the sinus, kidney frame [mm], shape (pyramids, 3).
PAPILLAE = SINUS_CENTRE + SINUS_HALF_AXES * (_DIRECTIONS / np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True))
PYRAMID_AXES = (PYRAMID_BASES - PAPILLAE) / np.linalg.norm(PYRAMID_BASES - PAPILLAE, axis=1, keepdims=True)


def _bean(canvas: Canvas) -> np.ndarray:
    """Distance to the kidney without lobes and tumour, on the canvas: a bent superellipsoid with a hilum."""
    x, y, z = canvas.x, canvas.y[:, None], canvas.z[:, None, None]
    u, v, w = (
        (x - KIDNEY_CENTRE[0]) * a[0] + ((y - KIDNEY_CENTRE[1]) * a[1] + (z - KIDNEY_CENTRE[2]) * a[2])
        for a in KIDNEY_AXES.astype(np.float32)
    )
    u += np.float32(KIDNEY_BEND) * w * w
    total = np.full(u.shape, 1e-6, dtype=np.float32)
    slope = np.full(u.shape, 1e-12, dtype=np.float32)
    for q, half in zip((u, v, w), KIDNEY_HALF_AXES, strict=True):
        scaled = np.abs(q) / np.float32(half) + np.float32(1e-5)
        power = scaled ** np.float32(KIDNEY_EXPONENT - 1)
        total += power * scaled
        slope += (power / np.float32(half)) ** 2
    rho = total ** np.float32(1 / KIDNEY_EXPONENT)
    distance = (rho - 1) * total / rho / np.sqrt(slope)
    medial = np.clip(-u / 12, 0, 1)
    return distance + np.float32(HILAR_DEPTH) * medial * np.exp(
        -((w + 1) ** 2) / 18**2 - (v - 1) ** 2 / 13**2
    )


def _lobulation(points: np.ndarray) -> np.ndarray:
    """Depth [mm] of the furrows between the renal lobes, one lobe a pyramid, at points near the surface."""
    distance = np.stack([np.linalg.norm(points - base, axis=1) for base in PYRAMID_BASES.astype(np.float32)])
    first, second = np.partition(distance, 1, axis=0)[:2]
    return np.float32(LOBULATION_DEPTH) * np.exp(-(((second - first) / 5) ** 2))


def _tumour(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Distances to a nodular tumour and to its necrotic core, at points in the kidney frame."""
    site = _site_on_hull(*TUMOUR_SITE)
    normal = np.sign(site) * np.abs(site / KIDNEY_HALF_AXES) ** (KIDNEY_EXPONENT - 1) / KIDNEY_HALF_AXES
    centre = site - TUMOUR_DEPTH * normal / np.linalg.norm(normal)
    radius = np.linalg.norm(points - np.float32(centre), axis=1)
    core = ellipsoid(points, centre + np.array([-1.0, -1.5, 1.5]), np.array([6.5, 4.5, 5.5]))
    return radius - TUMOUR_RADIUS - 0.5 * waves_at(points, 16, rng), core + 1.3 * waves_at(points, 9, rng)


def _medulla(points: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Distance to the pyramids; depth [mm] below the capsule bounds them by an arched base.

    Each is a cone on its papilla. Where two meet, a column of Bertin keeps them apart.
    """
    cones, radii = [], []
    for tip, axis in zip(PAPILLAE.astype(np.float32), PYRAMID_AXES.astype(np.float32), strict=True):
        height = (points - tip) @ axis
        radii.append(np.linalg.norm(points - tip - height[:, None] * axis, axis=1))
        cones.append(np.maximum((radii[-1] - 2.2 - 0.92 * np.maximum(height, 0)) * 0.8, -1.8 - height))
    first, second = np.partition(cones, 1, axis=0)[:2]
    offset = np.choose(np.argmin(cones, axis=0), radii)
    column = (COLUMN_THICKNESS - (second - first)) / 2
    base = CORTEX_THICKNESS + 0.022 * offset**2 - depth
    return np.maximum(np.maximum(first, column), base)


def _sinus(points: np.ndarray) -> np.ndarray:
    """Distance to the renal sinus: its core, the opening at the hilum, and a recess around each calyx."""
    core = ellipsoid(points, SINUS_CENTRE, SINUS_HALF_AXES)
    hilum = ellipsoid(points, np.array([-24.0, 0.5, -1.0]), np.array([15.0, 7.5, 15.0]))
    sinus = smooth_min(core, hilum, 5.0)
    for cup in PAPILLAE - 2.0 * PYRAMID_AXES:
        sinus = smooth_min(sinus, np.linalg.norm(points - np.float32(cup), axis=1) - np.float32(5.8), 3.0)
    return sinus


def _calyces(points: np.ndarray) -> np.ndarray:
    """Distance to the cups around the papillae; the medulla is drawn over them."""
    cups = np.full(len(points), 99.0, dtype=np.float32)
    for tip, axis in zip(PAPILLAE.astype(np.float32), PYRAMID_AXES.astype(np.float32), strict=True):
        height = (points - tip) @ axis
        ball = np.linalg.norm(points - (tip - 1.2 * axis), axis=1) - np.float32(5.0)
        cups = np.minimum(cups, np.maximum(ball, height - 1.0))
    return cups


MAJOR_CALYCES = np.array([[-9.0, -1.5, 15.0], [-10.0, -1.5, -1.0], [-9.0, -1.5, -16.0]])
PELVIS = np.array([-19.0, -4.0, -2.0])


def _curve(*controls: ArrayLike, radii: tuple[float, float], pieces: int = 7) -> list[tuple]:
    """A Bezier curve in the kidney frame as short tapering tubes (start, end, radius, radius) in LPS [mm]."""
    t = np.linspace(0, 1, pieces + 1)
    points = np.array(controls, dtype=float)[:, None, :] * np.ones((1, len(t), 1))
    while len(points) > 1:
        points = points[:-1] * (1 - t[:, None]) + points[1:] * t[:, None]
    path, widths = to_patient(points[0]), np.interp(t, (0, 1), radii)
    return [(*ends, *size) for ends, size in zip(pairwise(path), pairwise(widths), strict=True)]


def _urinary_tract() -> list[tuple]:
    """Infundibula, major calyces, pelvis, ureteropelvic junction and ureter."""
    tubes = []
    for node, radius in zip(MAJOR_CALYCES, (2.8, 2.0, 2.8), strict=True):
        tubes += _curve(PELVIS, (PELVIS + node) / 2, node, radii=(3.6, radius))
    for tip, axis in zip(PAPILLAE, PYRAMID_AXES, strict=True):
        node = MAJOR_CALYCES[np.argmin(np.abs(MAJOR_CALYCES[:, 2] - 0.6 * tip[2]))]
        end = tip - 3.5 * axis
        tubes += _curve(node, (node + end) / 2 - 2.0 * axis, end, radii=(2.0, 1.5), pieces=4)
    tubes += _curve(PELVIS, (-25, -5, -5), (-30, -5, -11), (-33, -3, -20), radii=(4.6, 2.0))
    return tubes + _curve((-33, -3, -20), (-36, -2, -30), (-28, -2, -52), (-12, 0, -85), radii=(2.0, 1.9))


def _interlobar(roots: np.ndarray, radii: tuple[float, float], side: float) -> list[tuple]:
    """Vessels that climb in the columns between neighbouring pyramids to the base of the medulla."""
    tubes = []
    for i, j in combinations(range(len(PYRAMID_BASES)), 2):
        if np.linalg.norm(PYRAMID_BASES[i] - PYRAMID_BASES[j]) > 31:
            continue
        base, tip = (PYRAMID_BASES[i] + PYRAMID_BASES[j]) / 2, (PAPILLAE[i] + PAPILLAE[j]) / 2
        outward = (base - tip) / np.linalg.norm(base - tip)
        lean = side * np.cross(outward, PYRAMID_BASES[i] - PYRAMID_BASES[j])
        lean /= np.linalg.norm(PYRAMID_BASES[i] - PYRAMID_BASES[j])
        end = base + lean - 5.5 * outward
        root = roots[np.argmin(np.linalg.norm(roots - tip, axis=1))]
        tubes += _curve(root, tip + 1.5 * lean, end, radii=radii, pieces=6)
    return tubes


def _arteries() -> list[tuple]:
    """Renal artery from the aorta; its anterior division runs before the pelvis, the posterior behind."""
    fork = np.array([-28.0, 4.0, 4.0])
    front = np.array([[-12.0, 5.0, 18.0], [-10.0, 6.0, 6.0], [-10.0, 6.0, -7.0], [-12.0, 5.0, -18.0]])
    back = np.array([[-10.0, -7.5, 9.0], [-10.0, -7.5, -9.0]])
    tubes = _curve(to_kidney((18.0, -2.0, -322.0)), (-42, 3, 7), fork, radii=(3.1, 2.7))
    for end in front:
        tubes += _curve(fork, (-20, 6.5, 0.5 * end[2]), end, radii=(2.1, 1.4))
    for end in back:
        tubes += _curve(fork, (-24, 0, 14), (-15, -10, 12), end, radii=(1.9, 1.3))
    return tubes + _interlobar(np.vstack([front, back]), (1.2, 0.7), 1.0)


def _veins() -> list[tuple]:
    """Renal vein, anterior to the artery, from three lobar veins, crossing in front of the aorta."""
    fork = np.array([-29.0, 8.0, -1.0])
    ends = np.array([[-9.0, 2.5, 14.0], [-8.0, 3.5, 0.0], [-9.0, 2.5, -14.0]])
    crossing = to_kidney((-4.0, -25.5, -318.0))
    tubes = _curve(crossing, to_kidney((24.0, -29.0, -320.0)), (-38, 8, 2), fork, radii=(4.2, 4.8), pieces=12)
    for end in ends:
        tubes += _curve(fork, (-20, 8.0, 0.5 * end[2]), end, radii=(3.4, 2.0))
    return tubes + _interlobar(ends, (1.6, 0.9), -1.0)


def _paint_perirenal_space(canvas: Canvas, bean: np.ndarray, rng: np.random.Generator) -> None:
    """Perirenal fat with its bridging septa inside Gerota's fascia, which widens downward into a cone."""
    widening = np.clip((KIDNEY_CENTRE[2] - canvas.z) * 0.07, -1.5, 4).astype(np.float32)[:, None, None]
    lateral = np.clip((canvas.x - KIDNEY_CENTRE[0]) * 0.09, -3.5, 2).astype(np.float32)
    fascia = bean - 8.5 - widening - lateral - 3 * canvas.waves(70, rng)
    fascia = np.maximum(fascia, wall_depth(canvas) + 2.5)
    canvas.paint(fascia, HU["fat"])
    for wavelength, thickness in ((44, 0.04), (30, 0.03)):
        sheet = np.abs(canvas.waves(wavelength, rng)) / 6 - np.float32(thickness)
        canvas.paint(np.maximum(sheet * np.float32(0.6 * wavelength), fascia), HU["septa"])
    canvas.paint(np.abs(fascia) - 0.35, HU["fascia"])


def _kidney_parts(
    canvas: Canvas, bean: np.ndarray, near: tuple, points: np.ndarray, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Distances [mm] to the parts: of vessels and urine on the canvas, of the others at voxels ``near``,
    with these points.
    """
    tumour, necrosis = _tumour(points, rng)
    kidney = bean[near] + _lobulation(points)
    urine, arteries, veins = (canvas.tube_distance(t()) for t in (_urinary_tract, _arteries, _veins))
    pelvis = ellipsoid(points, PELVIS, np.array([8.5, 4.2, 8.5]))
    urine[near] = smooth_min(smooth_min(urine[near], pelvis, 3.0), _calyces(points), 1.5)
    return dict(
        hull=smooth_min(kidney, tumour, 5.0),
        sinus=np.maximum(_sinus(points), kidney - 0.5),
        urine=urine,
        medulla=np.maximum(_medulla(points, -kidney), kidney + 1),
        veins=veins,
        arteries=arteries,
        tumour=tumour,
        viable=tumour + 1.1,
        necrosis=necrosis,
    )


def _paint_kidney(
    canvas: Canvas, near: tuple, points: np.ndarray, parts: dict[str, np.ndarray], rng: np.random.Generator
) -> None:
    """Draw the kidney, its vessels and ureter up to the canvas's border; each over those before it."""
    modulation = 5 * waves_at(points, 26, rng) + 4 * waves_at(points, 9, rng)
    values = dict(
        hull=HU["cortex"] + modulation,
        sinus=HU["fat"] + 6,
        urine=HU["urine"],
        medulla=HU["medulla"] + modulation,
        veins=HU["vein"],
        arteries=HU["artery"],
        tumour=HU["pseudocapsule"],
        viable=HU["tumour"] + 9 * waves_at(points, 12, rng) + 6 * waves_at(points, 6, rng),
        necrosis=HU["necrosis"],
    )
    for part, hu in values.items():
        canvas.paint(parts[part], hu, near if parts[part].ndim == 1 else (...,))


def _labels(near: tuple, points: np.ndarray, parts: dict[str, np.ndarray]) -> np.ndarray:
    """Label of each voxel, uint8, shape (z, y, x)."""
    inside = parts["hull"] < 0
    gate = (points[:, 0] < -12) & (np.abs(points[:, 2]) < 22)
    with_stubs = inside | (gate & (parts["hull"] < HILAR_STUB))
    tissue = np.where(inside, np.uint8(Label.CORTEX), np.uint8(Label.OUTSIDE))
    tissue[inside & (parts["sinus"] < 0)] = Label.SINUS
    tissue[with_stubs & (parts["urine"][near] < 0)] = Label.URINE
    tissue[inside & (parts["medulla"] < 0)] = Label.MEDULLA
    tissue[with_stubs & (parts["veins"][near] < 0)] = Label.VEIN
    tissue[with_stubs & (parts["arteries"][near] < 0)] = Label.ARTERY
    tissue[parts["tumour"] < 0] = Label.TUMOUR
    labels = np.zeros(parts["urine"].shape, dtype=np.uint8)
    labels[near] = tissue
    # Fat between the stubs of the hilar vessels is added to the solid, which would otherwise have slits and
    # cavities.
    closed = ndimage.binary_fill_holes(ndimage.binary_closing(labels > 0, iterations=3))
    tissue[gate & closed[near] & (tissue == Label.OUTSIDE)] = Label.SINUS
    labels[near] = tissue
    return labels


def _scan(hu: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The CT's point spread, and noise with the correlation of a soft kernel."""
    noise = rng.standard_normal(hu.shape, dtype=np.float32)
    noise = ndimage.gaussian_filter(noise, NOISE_CORRELATION / SPACING, truncate=3)
    noise *= np.float32(NOISE_SD) / noise.std()
    blurred = ndimage.gaussian_filter(hu, POINT_SPREAD_SD / SPACING, truncate=3)
    return np.clip(np.rint(blurred + noise), -1024, 3071).astype(np.int16)


def _image(voxels: np.ndarray) -> sitk.Image:
    image = sitk.GetImageFromArray(voxels)
    image.SetSpacing((SPACING,) * 3)
    image.SetOrigin(ORIGIN)
    return image


def make_phantom() -> tuple[sitk.Image, sitk.Image]:
    """The CT (int16, HU) and its label map (uint8, values of Label) on one grid, LPS mm."""
    rng = np.random.default_rng(SEED)
    canvas = Canvas(rng)
    paint_abdomen(canvas, rng)
    bean = _bean(canvas)
    _paint_perirenal_space(canvas, bean, rng)
    near = np.nonzero(bean < 12)
    points = np.stack([canvas.x[near[2]], canvas.y[near[1]], canvas.z[near[0]]], axis=1)
    points = to_kidney(points).astype(np.float32)
    parts = _kidney_parts(canvas, bean, near, points, rng)
    _paint_kidney(canvas, near, points, parts, rng)
    return _image(_scan(canvas.hu, rng)), _image(_labels(near, points, parts))
