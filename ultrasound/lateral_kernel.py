"""The beam's width across the scanlines, as weights of neighbouring scanlines. NumPy."""

import numpy as np

from ultrasound.beam import lateral_profiles, profile_depths
from ultrasound.probe import Probe
from ultrasound.pulse import FWHM_OF_SD

# Samples of a scanline that share their weights; a probe's samples are a multiple of this.
LANES = 16
# Half width of the kernel in scanlines; less where the beam is below LEAST.
MAX_HALF_WIDTH, LEAST = 24, 0.01
# Scanlines from the middle to one end of the array, or of the sector, have the profiles of so many.
CLASSES = 6
# Scanlines whose energy is summed for the clutter.
GROUP = 8


def scanline_classes(probe: Probe) -> tuple[np.ndarray, np.ndarray]:
    """Class of each scanline, and 1 or, where the profile is mirrored, -1; each (scanlines,) int32."""
    off = 2 * (np.arange(probe.number_of_scanlines) + 0.5) / probe.number_of_scanlines - 1
    classes = np.minimum(np.abs(off) * CLASSES, CLASSES - 1).astype(np.int32)
    return classes, np.where(off < 0, -1, 1).astype(np.int32)


def packet_depths(probe: Probe) -> np.ndarray:
    """The depth [mm] of the middle of each LANES samples."""
    packets = probe.number_of_samples_per_scanline // LANES
    return (np.arange(packets) + 0.5) * LANES * probe.sample_mm


def lateral_kernel(probe: Probe) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The weights of neighbouring scanlines for each class of scanlines and LANES samples.

    Weights (CLASSES, packets, 2 MAX_HALF_WIDTH + 1), of sum 1; the half width in scanlines (CLASSES,
    packets); and the speckle gain (CLASSES, packets), which restores unit mean square of noise with the
    pulse's correlation.
    """
    depth, lag = packet_depths(probe), np.arange(-MAX_HALF_WIDTH, MAX_HALF_WIDTH + 1)
    # The noise already has the width of the pulse in every direction.
    pulse = probe.speckle_sd_mm / np.maximum(probe.line_spacing_mm(depth), 1e-6)
    profiles = np.stack([_profiles(probe, scanline_class, lag, depth) for scanline_class in range(CLASSES)])
    weights = np.empty_like(profiles)
    for index in np.ndindex(profiles.shape[:2]):
        weights[index] = narrowed(profiles[index], pulse[index[1]])
    outside = weights < LEAST
    half = MAX_HALF_WIDTH - np.minimum(outside.argmin(axis=-1), outside[..., ::-1].argmin(axis=-1))
    weights[np.abs(lag) > half[..., None]] = 0.0
    weights /= weights.sum(axis=-1, keepdims=True)
    energy = np.zeros(half.shape)
    for apart in range(len(lag)):
        together = (weights[..., : len(lag) - apart] * weights[..., apart:]).sum(axis=-1)
        energy += (1 if apart == 0 else 2) * together * np.exp(-((apart / pulse) ** 2) / 4)
    return weights, half.astype(np.int32), 1 / np.sqrt(energy)


def narrowed(profile: np.ndarray, pulse_sd: float) -> np.ndarray:
    """The kernel that makes noise of an SD [scanlines] as wide as a profile (2 n + 1,), as far as that is
    possible.
    """
    lag = np.arange(len(profile)) - len(profile) // 2
    fine = np.linspace(lag[0], lag[-1], 20 * len(lag))
    width = np.ptp(fine[np.interp(fine, lag, profile) >= 0.5 * profile.max()]) / FWHM_OF_SD
    ratio = np.sqrt(max(1 - (pulse_sd / max(width, 1e-6)) ** 2, 1e-4))
    return np.interp(lag / ratio, lag, profile, left=0.0, right=0.0)


def _profiles(probe: Probe, scanline_class: int, lag: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
    """The profile of a class (depths, lags)."""
    nodes = profile_depths(probe)
    scanline = ((scanline_class + 0.5) / CLASSES + 1) / 2 * probe.number_of_scanlines - 0.5
    at_nodes = lateral_profiles(probe, scanline, nodes, lag)
    return np.stack([np.interp(depth_mm, nodes, profile) for profile in at_nodes.T], axis=-1)


def clutter_weights(probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
    """The energy that side lobes receive from groups of GROUP scanlines beside a scanline's group, (depths, 2
    groups - 1).

    Relative to the energy within the kernel, of a scanline in the middle; nothing within the kernel.
    """
    groups = -(-probe.number_of_scanlines // GROUP)
    nodes, middle = profile_depths(probe), (probe.number_of_scanlines - 1) / 2
    near = np.arange(-MAX_HALF_WIDTH, MAX_HALF_WIDTH + 1)
    main = (lateral_profiles(probe, middle, nodes, near) ** 2).sum(axis=1)
    # Side lobes of a pulse are smooth and, in the middle, the same on both sides: every second scanline
    # stands for both.
    beyond = np.arange(MAX_HALF_WIDTH // GROUP, groups)
    lag = (GROUP * beyond[:, None] + np.arange(1, GROUP, 2) - GROUP // 2).ravel()
    energy = lateral_profiles(probe, middle, nodes, lag) ** 2 * (lag > MAX_HALF_WIDTH)
    share = np.zeros((len(nodes), groups))
    share[:, beyond] = energy.reshape(len(nodes), len(beyond), -1).mean(axis=2) * GROUP / main[:, None]
    both = np.concatenate([share[:, :0:-1], share], axis=1)
    return np.stack([np.interp(depth_mm, nodes, profile) for profile in both.T], axis=-1)
