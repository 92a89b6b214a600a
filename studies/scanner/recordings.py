"""Recordings of real scanners, which are no part of this project: where they are in a folder, reading them,
and the rows of what is measured of them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from errors import UserError


@dataclass(frozen=True)
class ScannerRow:
    """A quantity: of the recording, ours beside it if there is one, its unit, what to know of it."""

    part: str
    quantity: str
    recorded: float | None
    ours: float | None = None
    unit: str = ""
    note: str = ""


def rows_of(part: str, *lines: tuple) -> list[ScannerRow]:
    """Rows of one part; a line has quantity, recorded, ours, unit and note, the last of them may lack."""
    return [ScannerRow(part, *line) for line in lines]


# Beside a checkout of the project.
FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "us"
BK_IQ = "bk_curvilinear/BkCurvilinearRfData.igs.mhd"
BK_PICTURE = "bk_curvilinear/BkCurvilinearScanConvertedData.igs.mha"
LINEAR_IQ = "ultrasonix_linear/UltrasonixLinearRfData.igs.mha"
LINEAR_PICTURE = "ultrasonix_linear/UltrasonixLinearScanConvertedData.igs.mha"
DISC = "pwi_disk/PWI_disk.mat"
WIRES = "NwirePhantomFreehand.igs.mha"
WIRES_CONFIGURATION = "PlusDeviceSet_NwirePhantomFreehand_vtkVolumeReconstructorTest2.xml"
SPINE = "SpinePhantomFreehand.igs.mha"


class RecordingError(UserError):
    """A recording that cannot be used; the message is one line."""


@dataclass(frozen=True)
class ChannelData:
    """Echoes of plane waves, ``rf`` (samples, elements, firings), as in PyMUST's PWI_disk.mat; SI units."""

    rf: np.ndarray
    sampling_hz: float
    centre_hz: float
    bandwidth_percent: float
    pitch_m: float
    start_s: float
    repetition_hz: float
    sound_m_s: float


def read_iq(path: Path) -> np.ndarray:
    """IQ signal (scanlines, samples) complex128 of a PLUS recording, from the array downwards. Raises
    RecordingError.

    PLUS stores I and Q of a sample side by side (RF_IQ_LINE), or a line of I and one of Q (RF_I_LINE_Q_LINE).
    """
    image = _read(path)
    lines = sitk.GetArrayFromImage(image).astype(float).squeeze()
    kind, orientation = (_field(image, f"UltrasoundImage{name}") for name in ("Type", "Orientation"))
    if lines.ndim != 2 or kind not in ("RF_IQ_LINE", "RF_I_LINE_Q_LINE"):
        raise RecordingError(
            f"{path.name}: UltrasoundImageType = {kind}, {lines.ndim} dimensions: expected one frame, "
            "RF_IQ_LINE or RF_I_LINE_Q_LINE"
        )
    iq = lines[:, ::2] + 1j * lines[:, 1::2] if kind == "RF_IQ_LINE" else lines[::2] + 1j * lines[1::2]
    # N is from far to near.
    return iq[:, ::-1] if orientation.startswith("N") else iq


def read_picture(path: Path) -> np.ndarray:
    """A recording's picture (rows, columns) float64. Raises RecordingError."""
    return sitk.GetArrayFromImage(_read(path)).astype(float).squeeze()


def read_channel_data(path: Path) -> ChannelData:
    """PyMUST's rotating disc. Raises RecordingError."""
    try:
        content = loadmat(path, squeeze_me=True)
        rf, fields = content["RF"].astype(float), content["param"]
        names = ("fs", "fc", "bandwidth", "pitch", "t0", "PRF", "c")
        return ChannelData(rf, *(float(fields[name]) for name in names))
    except (OSError, MatReadError, ValueError, LookupError, TypeError, NotImplementedError) as error:
        raise RecordingError(f"{path.name}: {error}; expected PyMUST's PWI_disk.mat") from None


def _read(path: Path) -> Any:
    try:
        return sitk.ReadImage(str(path))
    except RuntimeError:
        raise RecordingError(f"{path.name}: cannot be read; expected a MetaImage of PLUS") from None


def _field(image: Any, name: str) -> str:
    return str(image.GetMetaData(name)).strip() if image.HasMetaDataKey(name) else "missing"
