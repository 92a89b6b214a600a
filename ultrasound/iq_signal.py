"""IQ and RF signals of the scanlines of an image, with the position of the tissue at each sample: for
developers of algorithms. NumPy.

Names and axes as in USTB and MUST: depth along the columns, one column for each scanline.
"""

from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import scipy

from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ImagePlane
from ultrasound.pulse import SOUND_MM_US

MAT_HEADER, MAT_HEADER_BYTES = b"MATLAB 5.0 MAT-file, simulated by Nephron", 116
# Samples of RF per period.
RF_PER_PERIOD = 4


@dataclass(frozen=True)
class IQSignal:
    """Signals of one image before gain; 1 is the echo of a perfect reflector at the face.

    ``rest_mm`` is where the tissue of each sample is in the CT (LPS): of two images, samples with the same
    position show the same scatterers. ``motion_mm`` is how these moved on the image plane since the image
    before (u, v, and w out of the plane); zero for the first.
    """

    iq: np.ndarray
    """Complex, shape (samples, scanlines), demodulated at the centre frequency."""
    rf: np.ndarray
    """Shape (RF samples, scanlines)."""
    iq_sampling_mhz: float
    rf_sampling_mhz: float
    centre_frequency_mhz: float
    speed_of_sound_mm_us: float
    depth_mm: np.ndarray
    """Depth of each IQ sample, as the scanner shows it, shape (samples,)."""
    scanline_start_mm: np.ndarray
    """On the image plane (u, v), shape (scanlines, 2)."""
    scanline_direction: np.ndarray
    """Shape (scanlines, 2)."""
    rest_mm: np.ndarray
    """Shape (samples, scanlines, 3)."""
    motion_mm: np.ndarray
    """Shape (samples, scanlines, 3)."""
    probe_to_patient: np.ndarray
    """Shape (4, 4), LPS [mm]."""
    phase_reference: int
    """Images with the same number have phases that can be compared."""


def iq_signal(
    iq: np.ndarray,
    rest_mm: np.ndarray,
    probe: Probe,
    plane: ImagePlane,
    before: ImagePlane | None,
    phase_reference: int = 0,
) -> IQSignal:
    """The signals of IQ (scanlines, samples) of tissue at rest positions (scanlines, samples, 3) [mm]."""
    iq, rest_mm = iq.T.astype(np.complex64), np.swapaxes(rest_mm, 0, 1)
    rf, rf_sampling_mhz = rf_of(iq, probe)
    start, direction = probe.scanlines()
    motion = np.zeros_like(rest_mm) if before is None else _on(plane, rest_mm) - _on(before, rest_mm)
    return IQSignal(
        iq=iq,
        rf=rf,
        iq_sampling_mhz=SOUND_MM_US / (2 * probe.sample_mm),
        rf_sampling_mhz=rf_sampling_mhz,
        centre_frequency_mhz=probe.frequency_mhz,
        speed_of_sound_mm_us=SOUND_MM_US,
        depth_mm=(np.arange(len(iq)) + 0.5) * probe.sample_mm,
        scanline_start_mm=start,
        scanline_direction=direction,
        rest_mm=rest_mm.astype(np.float32),
        motion_mm=motion.astype(np.float32),
        probe_to_patient=np.asarray(plane.world_from_plane, float),
        phase_reference=phase_reference,
    )


def rf_of(iq: np.ndarray, probe: Probe) -> tuple[np.ndarray, float]:
    """The RF signal (RF samples, scanlines) float32 of IQ (samples, scanlines), and its sampling frequency
    [MHz].
    """
    duration_us = 2 * probe.depth_mm / SOUND_MM_US
    count = round(RF_PER_PERIOD * probe.frequency_mhz * duration_us)
    envelope = scipy.signal.resample(iq, count, axis=0)
    # The first IQ sample is half a sample behind the face.
    time_us = np.arange(count) * duration_us / count + probe.sample_mm / SOUND_MM_US
    carrier = np.exp(2j * np.pi * probe.frequency_mhz * time_us)[:, None]
    return (envelope * carrier).real.astype(np.float32), count / duration_us


def _on(plane: ImagePlane, places_mm: np.ndarray) -> np.ndarray:
    """Points (.., 3) of the world on the axes of an image plane [mm]."""
    matrix = np.linalg.inv(plane.world_from_plane)
    return places_mm @ matrix[:3, :3].T + matrix[:3, 3]


def save_iq(signals: IQSignal, path: Path, suffix: str) -> None:
    """Write signals in the format of NumPy ("npz") or MATLAB ("mat"). Raises OSError."""
    arrays = asdict(signals)
    content = BytesIO()
    if suffix == "mat":
        scipy.io.savemat(content, arrays, do_compression=True)
        # SciPy writes the date and the operating system.
        content.seek(0)
        content.write(MAT_HEADER.ljust(MAT_HEADER_BYTES))
    else:
        np.savez_compressed(content, **arrays)
    path.write_bytes(content.getvalue())
