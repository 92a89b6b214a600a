"""A virtual test object in front of a probe, and what its B-mode image measures."""

from collections.abc import Callable

import numpy as np

from sim.embedding import Unmoved
from sim.fields import array_of, fill, fill_evenly
from ultrasound.blood_flow import BEAT_S, CHANNELS, SYSTOLE_S
from ultrasound.bmode import BMode
from ultrasound.doppler import Doppler
from ultrasound.interface import Surface
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe import DetailLevel, Probe
from ultrasound.probe_manipulator import image_plane, pose_at
from ultrasound.propagation import Propagation
from ultrasound.sampled_volume import SampledVolume

VOXEL_MM, MARGIN_MM = 0.25, 2.0
# Of tissue in which sound is as fast as the scanner assumes.
IMPEDANCE, PIXELS = 1.5804, 64
FAR_MM = 1e4
# A vessel, and the heartbeats over which its velocities are averaged.
VESSEL_RADIUS_MM, BEATS = 3.0, 200
Values = float | np.ndarray | Callable[[np.ndarray, np.ndarray], np.ndarray]


class EchoPhantom:
    """Tissue whose properties are functions of u and v of the image plane [mm], the same across it, filled
    anew for each image.
    """

    def __init__(self, probe: Probe, pixels: int = PIXELS) -> None:
        self.probe = probe
        self.doppler: Doppler | None = None
        width, depth, above = probe.extent_mm
        low = np.array([-width / 2 - MARGIN_MM, -above - MARGIN_MM])
        count = round((width + 2 * MARGIN_MM) / VOXEL_MM), round((depth + 2 * MARGIN_MM) / VOXEL_MM)
        index_from_mm = np.diag([1 / VOXEL_MM, 1 / VOXEL_MM, 1 / FAR_MM, 1.0])
        index_from_mm[:2, 3] = -low / VOXEL_MM
        self.u, self.v = low[:, None, None] + VOXEL_MM * np.indices(count)
        self.tissue = SampledVolume(np.zeros((*count, 1, 4)), index_from_mm, outside=0.0)
        organ = SampledVolume(np.full((1, 1, 1), -1.0), np.diag([1 / FAR_MM] * 3 + [1.0]))
        self.plane = PlaneInTissue(Unmoved(), pixels)
        self.flow = SampledVolume(np.zeros((*count, 1, CHANNELS)), index_from_mm, outside=0.0)
        self.bmode = BMode(Propagation(self.tissue, organ, self.plane, probe, VOXEL_MM), probe)

    @property
    def depth_mm(self) -> np.ndarray:
        """Depth of each sample of a scanline."""
        return (np.arange(self.probe.number_of_samples_per_scanline) + 0.5) * self.probe.sample_mm

    def set_surface(self, surface: Surface) -> None:
        """Give the interfaces another surface."""
        self.bmode.sound.surface = surface

    def vessel_velocity(self, speed_cm_s: float, angle_deg: float, depth_mm: float) -> np.ndarray:
        """Velocities [cm/s] that Doppler finds in a straight vessel whose flow has an angle to the direction
        of the array.
        """
        turn = np.radians(angle_deg)
        along = np.array([np.sin(turn), -np.cos(turn)])
        off = np.abs(self.u * along[1] - (self.v - depth_mm) * along[0])
        values = np.zeros((*self.u.shape, 1, CHANNELS), np.float32)
        values[..., 0, :2] = np.where(off < VESSEL_RADIUS_MM, speed_cm_s / 100, 0.0)[..., None] * along
        values[..., 0, 4] = off < VESSEL_RADIUS_MM
        fill((self.flow.voxels, _thin(values)))
        self.fill(backscatter=lambda u, v: 0.01 * (off >= VESSEL_RADIUS_MM))
        self.amplitude()
        if self.doppler is None:
            self.doppler = Doppler(self.bmode.sound, self.bmode, self.flow)
        velocities = []
        for beat in range(BEATS):
            self.doppler.estimate(self.probe, SYSTOLE_S + beat * BEAT_S)
            velocities.append(self.doppler.velocity_cm_s(self.probe))
        middle = self.probe.number_of_scanlines // 2
        step_mm = self.bmode.sound.stride_of(self.probe) * self.probe.sample_mm
        sample = round(depth_mm / step_mm)
        return np.stack(velocities)[:, middle - 4 : middle + 5, sample - 1 : sample + 2]

    def fill(
        self, impedance: Values = IMPEDANCE, attenuation: Values = 0.0, backscatter: Values = 0.0
    ) -> None:
        """Set impedance [MRayl], attenuation [dB/cm/MHz] and backscatter."""
        values = np.zeros((*self.u.shape, 1, 4), np.float32)
        for channel, quantity in enumerate((impedance, attenuation, backscatter)):
            values[..., 0, channel] = quantity(self.u, self.v) if callable(quantity) else quantity
        fill((self.tissue.voxels, _thin(values)))

    def amplitude(
        self,
        across_mm: float = 0.0,
        detail_level: DetailLevel = "speckle",
        probe: Probe | None = None,
    ) -> np.ndarray:
        """Echo (scanlines, samples) without gain, of a probe that is moved out of its image plane."""
        probe = probe or self.probe
        place = np.array([0.0, 0.0, across_mm])
        pose = pose_at(place, np.array([0.0, 1, 0]), np.array([1.0, 0, 0]), probe.housing_mm[2])
        self.plane.locate(image_plane(pose, probe.housing_mm[2], *probe.extent_mm))
        self.bmode.render(probe, detail_level)
        return 10 ** ((array_of(self.bmode.decibel).astype(float) - probe.gain_db()) / 20)

    def point_response(self, scanline: int, depth_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """Distance [mm] along an arc and amplitude on each scanline of a point on one of them."""
        self.fill()
        self.amplitude()
        spacing = float(self.probe.line_spacing_mm(np.array([depth_mm]))[0])
        place = spacing * (np.arange(self.probe.number_of_scanlines) - scanline)
        echo = np.exp(-0.5 * (place / self.probe.speckle_sd_mm) ** 2)
        fill((self.bmode.real, np.repeat(echo[:, None], len(self.depth_mm), axis=1)))
        fill_evenly(self.bmode.imaginary, 0.0)
        self.bmode.spread(0.0, 0, False)
        sample = int(depth_mm / self.probe.sample_mm)
        decibel = array_of(self.bmode.decibel).astype(float) - self.probe.gain_db()
        return place, 10 ** (decibel[:, sample] / 20)


def _thin(values: np.ndarray) -> np.ndarray:
    """Voxels (nx, ny, 1, c) as a field of a thin ``SampledVolume`` has them."""
    return np.pad(values, [(0, 0), (0, 0), (0, 1), (0, 0)], mode="edge").reshape(-1, values.shape[-1])
