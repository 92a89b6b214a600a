"""Draw the abdomen of the embedded patient around its left kidney, and the canvas to draw on.

LPS mm; signed distances [mm] are negative inside. The layout (vertebra, psoas, body wall, kidney bed) follows
an axial CT of a slim adult, CRLM-CT-1004 (TCIA).
"""

import numpy as np
from numpy.typing import ArrayLike

SPACING = 0.9
ORIGIN = (-12.0, -48.0, -402.0)
SIZE = (160, 151, 162)

# Attenuation [HU] in the phase of the kidney. Measured for comparison in CRLM-CT-1004: muscle 73, spleen 113,
# vertebral body 188, aorta 144 (later after the injection than here).
HU_FAT = -104.0
HU_MUSCLE = 62.0
HU_ARTERY = 205.0
HU_VEIN = 190.0
HU_SPLEEN = 122.0
HU_PANCREAS = 100.0
HU_ADRENAL = 80.0
HU_BOWEL_WALL = 92.0
HU_CHYME = 28.0
HU_GAS = -880.0
HU_CANAL = 32.0
HU_DISC = 88.0
HU_SPONGIOSA = 160.0
HU_COMPACTA = 480.0


class Canvas:
    """The volume to draw on: hu [HU], shape (z, y, x), with the voxel centres x, y, z [mm].

    coarse and fine are random fields of unit SD that make outlines irregular and tissues uneven.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.x, self.y, self.z = (
            np.arange(n, dtype=np.float32) * np.float32(SPACING) + np.float32(o)
            for n, o in zip(SIZE, ORIGIN, strict=True)
        )
        self.hu = np.full(SIZE[::-1], HU_FAT, dtype=np.float32)
        self.coarse = self.waves(27, rng)
        self.fine = self.waves(9, rng)

    def box(self, low: np.ndarray, high: np.ndarray) -> tuple[tuple, np.ndarray, np.ndarray, np.ndarray]:
        """Slices (z, y, x) of the voxels between two corners [mm], and their coordinates to broadcast."""
        spans = [
            slice(*np.searchsorted(axis, (a, b)))
            for axis, a, b in zip((self.x, self.y, self.z), low, high, strict=True)
        ]
        x, y, z = (axis[s] for axis, s in zip((self.x, self.y, self.z), spans, strict=True))
        return tuple(spans[::-1]), x, y[:, None], z[:, None, None]

    def paint(self, distance: np.ndarray, value: float | np.ndarray, where: tuple = (...,)) -> None:
        """Set the inside of a distance field to value [HU]; voxels on its surface are mixed."""
        self.hu[where] += np.clip(0.5 - distance / SPACING, 0, 1) * (value - self.hu[where])

    def loft(
        self,
        sections: ArrayLike,
        value: float,
        rim: float | None = None,
        wall: float = 0.8,
        rough: float = 0.7,
        texture: float = 0.0,
    ) -> None:
        """Draw an organ given by ellipses (z, x, y, half-width, half-depth, turn in degrees), one a row.

        With rim, the outermost `wall` mm have that value instead. `rough` [mm] is the SD of the outline,
        `texture` [HU] that of the inside.
        """
        sections = np.asarray(sections, dtype=float)
        reach = sections[:, 3:5].max() + 2
        low = np.append(sections[:, 1:3].min(axis=0) - reach, sections[0, 0])
        high = np.append(sections[:, 1:3].max(axis=0) + reach, sections[-1, 0])
        where, x, y, z = self.box(low, high)
        cx, cy, a, b, turn = (
            np.interp(z, sections[:, 0], column).astype(np.float32) for column in sections[:, 1:].T
        )
        cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        p = ((x - cx) * cos + (y - cy) * sin) / a
        q = ((y - cy) * cos - (x - cx) * sin) / b
        rho = np.sqrt(p * p + q * q) + np.float32(1e-6)
        distance = (rho - 1) * rho / np.sqrt((p / a) ** 2 + (q / b) ** 2 + np.float32(1e-9))
        distance = distance - np.float32(rough) * self.coarse[where]
        if rim is not None:
            self.paint(distance, rim, where)
            distance = distance + wall
        self.paint(distance, value + np.float32(texture) * self.fine[where], where)

    def tube_distance(self, tubes: list[tuple]) -> np.ndarray:
        """Distance to tubes (start, end, first and last radius) [mm], shape (z, y, x); 9 if none is near."""
        distance = np.full(self.hu.shape, 9.0, dtype=np.float32)
        for start, end, first, last in tubes:
            margin = max(first, last) + 3
            where, x, y, z = self.box(np.minimum(start, end) - margin, np.maximum(start, end) + margin)
            d = (end - start).astype(np.float32)
            px, py, pz = x - np.float32(start[0]), y - np.float32(start[1]), z - np.float32(start[2])
            t = np.clip((px * d[0] + py * d[1] + pz * d[2]) / (d @ d), 0, 1)
            radius = np.sqrt((px - t * d[0]) ** 2 + (py - t * d[1]) ** 2 + (pz - t * d[2]) ** 2)
            distance[where] = np.minimum(
                distance[where], radius - np.float32(first) - np.float32(last - first) * t
            )
        return distance

    def waves(self, wavelength: float, rng: np.random.Generator, count: int = 7) -> np.ndarray:
        """A smooth random field of zero mean and unit SD on the canvas, shape (z, y, x): plane waves."""
        field = np.zeros(self.hu.shape, dtype=np.float32)
        for k, phase in _wave_vectors(wavelength, rng, count):
            wave = [
                np.exp(1j * k[i] * axis).astype(np.complex64)
                for i, axis in enumerate((self.x, self.y, self.z))
            ]
            plane = wave[1][:, None] * wave[0] * np.complex64(np.exp(1j * phase))
            field += plane.real * wave[2].real[:, None, None] - plane.imag * wave[2].imag[:, None, None]
        return field * np.float32(np.sqrt(2 / count))


def _wave_vectors(wavelength: float, rng: np.random.Generator, count: int) -> list[tuple[np.ndarray, float]]:
    """Wave vectors [1/mm] in random directions about one wavelength [mm], each with its phase."""
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scale = 2 * np.pi / (wavelength * rng.uniform(0.75, 1.35, count))
    return list(zip(directions * scale[:, None], rng.uniform(0, 2 * np.pi, count), strict=True))


def waves_at(points: np.ndarray, wavelength: float, rng: np.random.Generator, count: int = 6) -> np.ndarray:
    """Canvas.waves at points [mm], shape (n, 3)."""
    waves = (
        np.cos(points @ k.astype(np.float32) + np.float32(phase))
        for k, phase in _wave_vectors(wavelength, rng, count)
    )
    total = sum(waves, start=np.zeros(len(points), dtype=np.float32))
    return total * np.float32(np.sqrt(2 / count))


def smooth_min(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Union of two solids whose joint is rounded over `width` mm."""
    blend = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    return b + (a - b) * blend - width * blend * (1 - blend)


def ellipsoid(points: np.ndarray, centre: np.ndarray, half_axes: np.ndarray) -> np.ndarray:
    """Distance to an ellipsoid, exact to first order at its surface."""
    scaled = (points - np.float32(centre)) / np.float32(half_axes)
    rho = np.linalg.norm(scaled, axis=-1)
    return (rho - 1) * rho / (np.linalg.norm(scaled / np.float32(half_axes), axis=-1) + np.float32(1e-6))


BODY_HALF_AXES = (121.0, 90.0)
WALL_THICKNESS = 15.0
VERTEBRA_MIDS = (-415.0, -378.0, -341.0, -304.0, -267.0)
VERTEBRA_PITCH = 37.0


def wall_depth(canvas: Canvas) -> np.ndarray:
    """Distance from the inner face of the abdominal wall, negative in the cavity [mm], shape (y, x)."""
    p, q = canvas.x / BODY_HALF_AXES[0], canvas.y[:, None] / BODY_HALF_AXES[1]
    rho = np.sqrt(p * p + q * q) + 1e-6
    return (rho - 1) * rho / np.sqrt((p / BODY_HALF_AXES[0]) ** 2 + (q / BODY_HALF_AXES[1]) ** 2 + 1e-9)


def _paint_body_wall(canvas: Canvas) -> None:
    """Three flat muscles with fat planes between them, subcutaneous fat outside, ribs 11 and 12 within."""
    x, depth = canvas.x, wall_depth(canvas)
    canvas.paint(np.abs(depth - WALL_THICKNESS / 2) - WALL_THICKNESS / 2, HU_MUSCLE)
    for plane in (4.5, 9.5):
        canvas.paint(np.abs(depth - plane) - 0.5, HU_FAT)
    slant = canvas.z[:, None, None] - 0.75 * (canvas.y[:, None] - 60)
    for level in (-345.0, -300.0, -255.0):
        rib = np.hypot(0.8 * (slant - level) + 0 * x, 1.9 * (depth - 5.5)) - 6.0
        rib = np.maximum(rib, 30 - x)
        canvas.paint(rib, HU_COMPACTA)
        canvas.paint(rib + 2.2, HU_SPONGIOSA)


def _paint_spine(canvas: Canvas) -> None:
    """Vertebral bodies and discs, arch and canal, transverse and spinous processes."""
    top, bottom = canvas.z[-1] + 1, canvas.z[0] - 1
    bone = {"rim": HU_COMPACTA, "wall": 1.6, "rough": 0.3, "texture": 15.0}
    canvas.loft([(bottom, 0, 66, 5, 22, 0), (top, 0, 66, 5, 22, 0)], HU_SPONGIOSA, **bone)
    for mid in VERTEBRA_MIDS:
        arch = [(mid - 9, 0, 44, 21, 14, 0), (mid, 0, 44, 24, 16, 0), (mid + 9, 0, 44, 21, 13, 0)]
        canvas.loft(arch, HU_SPONGIOSA, **bone)
        process = [(mid - 6, 24, 53, 12, 2.5, 14), (mid, 25, 53, 16, 4.5, 14), (mid + 6, 24, 53, 12, 2.5, 14)]
        canvas.loft(process, HU_SPONGIOSA, **bone)
        body = [(mid - 14, 0, 20, 26, 20, 0), (mid, 0, 20, 23.5, 18.5, 0), (mid + 14, 0, 20, 26, 20, 0)]
        canvas.loft(body, HU_SPONGIOSA, **bone)
        disc = mid + VERTEBRA_PITCH / 2
        canvas.loft([(disc - 4.5, 0, 20, 25, 19, 0), (disc + 4.5, 0, 20, 25, 19, 0)], HU_DISC)
    canvas.loft([(bottom, 0, 46, 11, 8, 0), (top, 0, 46, 11, 8, 0)], HU_CANAL, HU_FAT, 1.5, rough=0.2)


def _paint_muscles(canvas: Canvas) -> None:
    """Muscles in sheaths of fat, which separate them in CT."""
    top, bottom = canvas.z[-1] + 1, canvas.z[0] - 1
    sheath = {"rim": -30.0, "wall": 0.9, "rough": 0.7, "texture": 6.0}
    for sections in (
        # Iliocostalis, longissimus, multifidus, quadratus lumborum, psoas, diaphragmatic crus.
        [(bottom, 58, 82, 16, 17, -20), (top, 56, 84, 17, 15, -24)],
        [(bottom, 34, 80, 17, 20, -6), (top, 33, 81, 16, 19, -8)],
        [(bottom, 14, 70, 9, 19, 0), (top, 13, 70, 8, 18, 0)],
        [(bottom, 72, 63, 20, 10, -14), (-340, 64, 66, 19, 8, -10), (-290, 54, 69, 15, 5, -8)],
        [
            (bottom, 45, 36, 19, 22, 20),
            (-340, 35, 34, 13, 18, 12),
            (-295, 28, 28, 7, 12, 8),
            (-270, 26, 24, 3, 6, 0),
        ],
        [(-345, 21, 4, 2, 4, 30), (-300, 20, 6, 4, 13, 20), (top, 20, 8, 5, 17, 15)],
    ):
        canvas.loft(sections, HU_MUSCLE, **sheath)


def _paint_bowel(canvas: Canvas) -> None:
    """Descending colon with gas on top of its contents, stomach, jejunum with its folds."""
    bottom, top = canvas.z[0] - 1, canvas.z[-1] + 1
    colon = [(bottom, 100, -4, 14, 13, 0), (-380, 103, -8, 12, 14, 0), (-362, 101, -12, 15, 15, 0)]
    colon += [(-342, 103, -15, 12, 12, 0), (-325, 100, -22, 15, 14, 0), (-312, 96, -30, 11, 11, 0)]
    canvas.loft(colon, HU_CHYME, HU_BOWEL_WALL, 2.2, rough=1.6, texture=18)
    gas = [(z, x, y - 0.4 * b, 0.55 * a, 0.35 * b, 0) for z, x, y, a, b, _ in colon[:-1]]
    canvas.loft(gas, HU_GAS)
    loops = (
        [
            (bottom, 60, -36, 15, 13, 10),
            (-375, 54, -40, 17, 14, 0),
            (-352, 62, -38, 13, 12, 0),
            (-346, 64, -38, 5, 5, 0),
        ],
        [
            (bottom, 27, -42, 14, 11, 0),
            (-370, 24, -40, 13, 10, 0),
            (-350, 34, -40, 15, 11, 0),
            (-330, 40, -42, 6, 6, 0),
        ],
        [
            (-338, 62, -42, 6, 5, 0),
            (-325, 66, -38, 15, 11, 0),
            (-308, 58, -42, 14, 12, 0),
            (-298, 52, -44, 5, 5, 0),
        ],
        [
            (-396, 84, -26, 4, 4, 0),
            (-376, 80, -22, 9, 10, 20),
            (-358, 82, -26, 11, 9, 30),
            (-346, 80, -30, 4, 4, 0),
        ],
        [
            (-350, 84, -42, 5, 5, 0),
            (-338, 82, -38, 12, 11, 0),
            (-318, 80, -40, 13, 10, 0),
            (-306, 76, -44, 5, 5, 0),
        ],
    )
    for loop in loops:
        canvas.loft(loop, HU_CHYME, HU_BOWEL_WALL, 2.4, rough=1.8, texture=30)
    stomach = [(-304, 56, -58, 14, 6, -8), (-288, 60, -56, 30, 15, -12), (top, 66, -52, 34, 20, -14)]
    canvas.loft(stomach, HU_CHYME, HU_BOWEL_WALL, 3.5, rough=1.5, texture=8)


def _paint_viscera(canvas: Canvas) -> None:
    """Spleen, tail of the pancreas, adrenal gland."""
    top = canvas.z[-1] + 1
    spleen = [
        (-322, 106, 14, 3, 8, 12),
        (-305, 104, 10, 10, 26, 14),
        (-280, 100, 6, 15, 38, 16),
        (top, 96, 4, 18, 44, 18),
    ]
    canvas.loft(spleen, HU_SPLEEN, rough=0.8, texture=3)
    pancreas = [
        (-312, 30, -22, 8, 5, 0),
        (-296, 52, -20, 26, 8, -10),
        (-278, 60, -18, 22, 7, -14),
        (-270, 66, -16, 6, 4, -14),
    ]
    canvas.loft(pancreas, HU_PANCREAS, rough=2.2, texture=16)
    for turn in (-12, 42):
        limb = [
            (-292, 45, 4, 1.5, 3, turn),
            (-280, 40, 7, 2.0, 10, turn),
            (-266, 37, 9, 1.6, 9, turn),
            (-260, 36, 9, 1, 3, turn),
        ]
        canvas.loft(limb, HU_ADRENAL)


def _paint_vessels(canvas: Canvas, rng: np.random.Generator) -> None:
    """Aorta, superior and inferior mesenteric vessels, gonadal vein, and branches in the mesentery."""
    top, bottom = canvas.z[-1] + 1, canvas.z[0] - 1
    levels = np.linspace(bottom, top, 9)
    for _ in range(16):
        start, drift = rng.uniform((18, -46), (96, -18)), np.cumsum(rng.normal(0, 5, (9, 2)), axis=0)
        radius = np.full((9, 2), rng.uniform(0.9, 1.7))
        canvas.loft(np.column_stack([levels, start + drift, radius, 0 * levels]), HU_VEIN, rough=0)
    canvas.loft([(bottom, 9, -10, 9, 9, 0), (top, 11, -11, 10.5, 10.5, 0)], HU_ARTERY, rough=0.3)
    canvas.loft(
        [(bottom, 4, -38, 3.2, 3.2, 0), (-312, 8, -36, 3.6, 3.6, 0), (-298, 10, -20, 3.8, 4.5, 0)], HU_ARTERY
    )
    canvas.loft([(bottom, 50, 4, 1.9, 1.9, 0), (-322, 43, 6, 2.3, 2.3, 0)], HU_VEIN, rough=0)
    canvas.loft([(bottom, 33, -14, 2.2, 2.2, 0), (-300, 26, -24, 2.6, 2.6, 0)], HU_VEIN, rough=0)


def paint_abdomen(canvas: Canvas, rng: np.random.Generator) -> None:
    """Draw all but the kidney and its perirenal space."""
    _paint_body_wall(canvas)
    _paint_muscles(canvas)
    _paint_spine(canvas)
    _paint_vessels(canvas, rng)
    _paint_bowel(canvas)
    _paint_viscera(canvas)
    canvas.hu += np.float32(4) * canvas.coarse + np.float32(4) * canvas.fine
