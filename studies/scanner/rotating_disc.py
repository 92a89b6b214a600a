"""Doppler of a rotating disc: a scanner's channel data, beamformed by pymust, through the estimator of
``ultrasound/doppler.py``.

A rigid rotation moves each point along the beam by the angular velocity times its lateral place, whatever its
depth.
"""

from dataclasses import dataclass

import numpy as np

from studies.echo.echo_phantom import EchoPhantom
from studies.echo.simus_beam import pymust
from studies.scanner.recordings import ChannelData, ScannerRow, rows_of
from ultrasound.doppler import Doppler, autocorrelation
from ultrasound.probe import Probe

PART = "rotating disc"
F_NUMBER = 1.0
# The disc: what has this much of the greatest energy, and this part of its radius.
LEAST_ENERGY_DB, INNER = -15.0, 0.9
# Beyond these the channel data have no echoes of the whole aperture [mm].
DEPTHS_MM = (8.0, 43.0)


@dataclass(frozen=True)
class Rotation:
    """Axial velocity away from the array, offset + lateral slope x + axial slope z, fitted to points: lateral
    place x, depth z [m] and velocity [m/s], each (n,).
    """

    offset_m_s: float
    slope_per_s: float
    depth_slope_per_s: float
    x_m: np.ndarray
    z_m: np.ndarray
    velocity_m_s: np.ndarray

    @property
    def residual_m_s(self) -> np.ndarray:
        """Velocity less the rotation's (n,)."""
        rotation = self.offset_m_s + self.slope_per_s * self.x_m + self.depth_slope_per_s * self.z_m
        return self.velocity_m_s - rotation


def probe_of(data: ChannelData) -> Probe:
    """A probe with the array of the recording, whose velocity scale is the limit of its pulse repetition."""
    width_mm = 1e3 * data.pitch_m * data.rf.shape[1]
    return Probe(
        transducer_name="recorded array",
        housing_mm=(width_mm, 10.0, 20.0),
        transducer_width_mm=width_mm,
        number_of_scanlines=data.rf.shape[1],
        number_of_elements=data.rf.shape[1],
        frequency_mhz=data.centre_hz / 1e6,
        f_number=F_NUMBER,
        depth_mm=48.0,
        velocity_scale_cm_s=100 * data.sound_m_s * data.repetition_hz / (4 * data.centre_hz),
    )


def beamformed(data: ChannelData, x_m: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    """IQ signal (x, z, firings) by delay and sum, 0 beyond the recorded depths.

    Raises EchoStudyError without pymust.
    """
    must = pymust()
    parameters = must.utils.Param()
    parameters.fs, parameters.fc, parameters.c = data.sampling_hz, data.centre_hz, data.sound_m_s
    parameters.bandwidth, parameters.pitch = data.bandwidth_percent, data.pitch_m
    parameters.t0, parameters.fnumber = np.array([data.start_s]), F_NUMBER
    samples, elements, firings = data.rf.shape
    parameters.Nelements = elements
    signal = must.rf2iq(data.rf, parameters).reshape(samples, elements, firings)
    x, z = np.meshgrid(x_m, z_m, indexing="ij")
    matrix = must.dasmtx(1j * np.array([samples, elements]), x, z, np.zeros((1, elements)), parameters)
    channels = signal.transpose(1, 0, 2).reshape(samples * elements, firings)
    return np.stack(
        [(matrix @ channels[:, firing]).reshape(x.shape, order="F") for firing in range(firings)], axis=-1
    )


def our_velocity(phantom: EchoPhantom, iq: np.ndarray) -> np.ndarray:
    """Velocity away from the array [m/s] (scanlines, tissue samples) that our sample volume and phase make of
    an ensemble of IQ (scanlines, tissue samples, firings) of the phantom's probe.
    """
    phantom.fill()
    phantom.amplitude()
    doppler = Doppler(phantom.bmode.sound, phantom.bmode, phantom.flow)
    doppler.estimate_of(phantom.probe, autocorrelation(iq))
    return -doppler.velocity_cm_s(phantom.probe) / 100


def fitted_rotation(x_m: np.ndarray, z_m: np.ndarray, velocity_m_s: np.ndarray) -> Rotation:
    """Rotation that fits best, by least squares, points (n,)."""
    system = np.column_stack([np.ones_like(x_m), x_m, z_m])
    offset, slope, depth_slope = np.linalg.lstsq(system, velocity_m_s, rcond=None)[0]
    return Rotation(float(offset), float(slope), float(depth_slope), x_m, z_m, velocity_m_s)


def disc_of(energy: np.ndarray, x_m: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    """Which points of a grid, energy (x, z), are in the inner part of a bright disc."""
    x, z = np.meshgrid(x_m, z_m, indexing="ij")
    bright = (energy > energy.max() * 10 ** (LEAST_ENERGY_DB / 10)) & _is_recorded(z)
    area = bright.sum() * (x_m[1] - x_m[0]) * (z_m[1] - z_m[0])
    centre_x, centre_z = np.median(x[bright]), np.median(z[bright])
    return np.hypot(x - centre_x, z - centre_z) < INNER * np.sqrt(area / np.pi)


def _is_recorded(z_m: np.ndarray) -> np.ndarray:
    return (1e3 * z_m > DEPTHS_MM[0]) & (1e3 * z_m < DEPTHS_MM[1])


def rotation_of(data: ChannelData) -> Rotation:
    """Rotation that our Doppler finds in channel data. Taichi must run."""
    phantom = EchoPhantom(probe_of(data))
    probe, sound = phantom.probe, phantom.bmode.sound
    x_m = probe.elements()[:, 0] / 1e3
    z_m = sound.stride_of(probe) * probe.sample_mm / 1e3 * np.arange(sound.most)
    recorded = _is_recorded(z_m)
    iq = np.zeros((len(x_m), len(z_m), data.rf.shape[-1]), complex)
    iq[:, recorded] = beamformed(data, x_m, z_m[recorded])
    velocity = our_velocity(phantom, iq)
    within = disc_of((np.abs(iq) ** 2).mean(axis=-1), x_m, z_m)
    x, z = np.meshgrid(x_m, z_m, indexing="ij")
    return fitted_rotation(x[within], z[within], velocity[within])


def measurements(rotation: Rotation) -> list[ScannerRow]:
    """Lines of the table; beside ours is an independent evaluation of the same recording."""
    residual = 1e3 * float(np.median(np.abs(rotation.residual_m_s)))
    slope, depth_slope = rotation.slope_per_s, rotation.depth_slope_per_s
    note = "recorded: an independent evaluation; ours: our Doppler"
    return rows_of(
        PART,
        ("axial velocity: lateral slope", 61.4, slope, "m/s per m", note),
        ("axial velocity: slope with depth", 0.2, depth_slope, "m/s per m", "0 in a rotation"),
        ("median residual", 8.6, residual, "mm/s", f"{len(rotation.x_m)} points of the disc"),
    )
