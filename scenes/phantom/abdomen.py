"""Draw the abdomen of the embedded patient around its left kidney, by abdomen.toml, and the canvas to draw
on.

LPS mm; signed distances [mm] are negative inside.
"""

import tomllib
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

SPACING = 0.9
ORIGIN = (-12.0, -48.0, -402.0)
SIZE = (160, 151, 162)
BODY_HALF_AXES = (121.0, 90.0)
WALL_THICKNESS = 15.0

_ABDOMEN = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
# Attenuation [HU] of each tissue.
HU = {name: tissue["hu"] for name, tissue in _ABDOMEN["tissue"].items()}


class Canvas:
    """The volume to draw on: hu [HU], shape (z, y, x), with the voxel centres x, y, z [mm].

    coarse and fine are random fields of unit SD that make outlines irregular and tissues uneven.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.x, self.y, self.z = (
            np.arange(n, dtype=np.float32) * np.float32(SPACING) + np.float32(o)
            for n, o in zip(SIZE, ORIGIN, strict=True)
        )
        self.bottom, self.top = self.z[0] - 1, self.z[-1] + 1
        self.hu = np.full(SIZE[::-1], HU["fat"], dtype=np.float32)
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
        hu: float,
        rim: float | None = None,
        wall: float = 0.0,
        rough: float = 0.0,
        texture: float = 0.0,
    ) -> None:
        """Draw an organ given by ellipses (n, 6), as abdomen.toml describes them and the attenuation."""
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
        self.paint(distance, hu + np.float32(texture) * self.fine[where], where)

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


def wall_depth(canvas: Canvas) -> np.ndarray:
    """Distance from the inner face of the abdominal wall, negative in the cavity [mm], shape (y, x)."""
    p, q = canvas.x / BODY_HALF_AXES[0], canvas.y[:, None] / BODY_HALF_AXES[1]
    rho = np.sqrt(p * p + q * q) + 1e-6
    return (rho - 1) * rho / np.sqrt((p / BODY_HALF_AXES[0]) ** 2 + (q / BODY_HALF_AXES[1]) ** 2 + 1e-9)


def _paint_body_wall(canvas: Canvas) -> None:
    """Three flat muscles with fat planes between them, subcutaneous fat outside, ribs 11 and 12 within."""
    x, depth = canvas.x, wall_depth(canvas)
    canvas.paint(np.abs(depth - WALL_THICKNESS / 2) - WALL_THICKNESS / 2, HU["muscle"])
    for plane in (4.5, 9.5):
        canvas.paint(np.abs(depth - plane) - 0.5, HU["fat"])
    slant = canvas.z[:, None, None] - 0.75 * (canvas.y[:, None] - 60)
    for level in (-345.0, -300.0, -255.0):
        rib = np.hypot(0.8 * (slant - level) + 0 * x, 1.9 * (depth - 5.5)) - 6.0
        rib = np.maximum(rib, 30 - x)
        canvas.paint(rib, _ABDOMEN["tissue"]["bone"]["rim"])
        canvas.paint(rib + 2.2, HU["bone"])


def _paint_mesenteric_vessels(canvas: Canvas, rng: np.random.Generator) -> None:
    """Branches that wander through the mesentery."""
    levels = np.linspace(canvas.bottom, canvas.top, 9)
    for _ in range(16):
        start, drift = rng.uniform((18, -46), (96, -18)), np.cumsum(rng.normal(0, 5, (9, 2)), axis=0)
        radius = np.full((9, 2), rng.uniform(0.9, 1.7))
        canvas.loft(np.column_stack([levels, start + drift, radius, 0 * levels]), HU["vein"])


def paint_abdomen(canvas: Canvas, rng: np.random.Generator) -> None:
    """Draw all but the kidney and its perirenal space."""
    _paint_body_wall(canvas)
    _paint_mesenteric_vessels(canvas, rng)
    for organ in _ABDOMEN["organ"]:
        sections = np.array(organ["sections"], dtype=float)
        sections[:, 0] = np.nan_to_num(sections[:, 0], neginf=canvas.bottom, posinf=canvas.top)
        for level in organ.get("levels", [0]):
            canvas.loft(sections + [level, 0, 0, 0, 0, 0], **_ABDOMEN["tissue"][organ["tissue"]])
    canvas.hu += np.float32(4) * canvas.coarse + np.float32(4) * canvas.fine
