"""The command ``study import``: time and memory from a large CT, a synthetic trunk with the embedded
patient's abdomen in it, to a scene.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click
import numpy as np
import psutil
import SimpleITK as sitk
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
from tqdm import tqdm

from scenes.phantom.kidney import make_phantom
from scenes.volumes.lazy_volume import AIR_HU
from scenes.volumes.voxel_grid import VoxelGrid
from studies.study import Results, Study, study_command, whole_option

PIXELS, PIXEL_MM = 512, 0.78
GAP_MM = 0.75
HALF_WIDTH_MM, HALF_DEPTH_MM = 170.0, 115.0
BODY_HU, NOISE_HU = 40, 12.0
SEED = 20160101


def write_whole_body(folder: Path, slices: int) -> Path:
    """Write folder/ct, a DICOM series of 512 x 512 pixels, and folder/labels.nii.gz; return the folder."""
    ct, labels = make_phantom()
    centre = np.array(ct.TransformContinuousIndexToPhysicalPoint([n / 2 for n in ct.GetSize()]))
    span = (PIXELS - 1) * PIXEL_MM
    origin = np.array([-span / 2, centre[1] - span / 2, centre[2] - (slices - 1) * GAP_MM / 2])
    (folder / "ct").mkdir(parents=True)
    noise = np.random.default_rng(SEED).normal(0, NOISE_HU, (PIXELS, PIXELS))
    series, frame = generate_uid(), generate_uid()
    marked = np.zeros((slices, PIXELS, PIXELS), np.uint8)
    for k in tqdm(range(slices), desc="writing", unit="slice"):
        place = origin + (0, 0, k * GAP_MM)
        marked[k] = _plane(labels, place, sitk.sitkNearestNeighbor, 0)
        pixels = _body(place, centre[1]) + np.roll(noise, 17 * k)
        inside = _plane(ct, place, sitk.sitkLinear, -2000)
        pixels = np.where(inside > -2000, inside, pixels)
        _write_slice(folder / "ct" / f"{k:04d}.dcm", k, place, pixels, series, frame)
    image = sitk.GetImageFromArray(marked)
    image.SetSpacing([PIXEL_MM, PIXEL_MM, GAP_MM])
    image.SetOrigin(origin.tolist())
    sitk.WriteImage(image, str(folder / "labels.nii.gz"))
    return folder


def _body(place: np.ndarray, middle_y: float) -> np.ndarray:
    """HU of one slice of the trunk."""
    x = place[0] + PIXEL_MM * np.arange(PIXELS)
    y = place[1] + PIXEL_MM * np.arange(PIXELS)[:, None]
    inside = (x / HALF_WIDTH_MM) ** 2 + ((y - middle_y) / HALF_DEPTH_MM) ** 2 < 1
    return np.where(inside, BODY_HU, AIR_HU)


def _plane(image: sitk.Image, place: np.ndarray, method: int, beyond: float) -> np.ndarray:
    plane = VoxelGrid((PIXELS, PIXELS, 1), np.array([PIXEL_MM, PIXEL_MM, GAP_MM]), place, np.eye(3))
    return plane.sampled(image, method, beyond)[0]


def _write_slice(file: Path, k: int, place: np.ndarray, pixels: np.ndarray, series: str, frame: str) -> None:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.TransferSyntaxUID = CTImageStorage, ExplicitVRLittleEndian
    meta.MediaStorageSOPInstanceUID = generate_uid()
    data = FileDataset(str(file), {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = CTImageStorage, meta.MediaStorageSOPInstanceUID
    data.Modality, data.SeriesInstanceUID, data.StudyInstanceUID = "CT", series, series
    data.FrameOfReferenceUID, data.SeriesNumber, data.InstanceNumber = frame, 1, k + 1
    data.ImagePositionPatient = [f"{v:.4f}" for v in place]
    data.ImageOrientationPatient, data.PixelSpacing = [1, 0, 0, 0, 1, 0], [PIXEL_MM, PIXEL_MM]
    data.Rows = data.Columns = PIXELS
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 1
    data.RescaleIntercept, data.RescaleSlope = 0, 1
    data.PixelData = np.clip(np.rint(pixels), -1024, 3071).astype("<i2").tobytes()
    data.save_as(file, enforce_file_format=True)


APP = Path(__file__).resolve().parents[2] / "app.py"
POLL_S = 0.02
KIDNEY_OF_PHANTOM = "1,2,3,4,5"
TUMOUR_OF_PHANTOM = "6"


@study_command(
    "import",
    whole_option("--slices", 200, 2000, 800, "Slices of 512 x 512 pixels."),
    whole_option("--runs", 1, 20, 3),
)
def intake(study: Study, slices: int, runs: int) -> Results:
    """Measure an import: seconds and memory.

    Of a synthetic trunk of 512 x 512 pixels a slice, from DICOM and NIfTI labels.
    """
    with tempfile.TemporaryDirectory() as temporary:
        body = write_whole_body(Path(temporary), slices)
        seconds, peak_gb = zip(
            *(_run(body, Path(temporary) / f"patient-{n}") for n in range(runs)), strict=True
        )
    lines = [
        f"512 x 512 x {slices} CT and labels to a scene, {runs} runs, one after another:",
        "seconds    " + ", ".join(f"{s:.1f}" for s in seconds),
        "memory     " + ", ".join(f"{gb:.2f}" for gb in peak_gb) + " GB at most",
    ]
    return Results(dict(slices=slices, seconds=seconds, peak_gb=peak_gb), "\n".join(lines))


def _run(body: Path, folder: Path) -> tuple[float, float]:
    """Seconds, and the largest memory [GB], of one import in a process of its own."""
    labels = body / "labels.nii.gz"
    command = [sys.executable, str(APP), "import", str(body / "ct"), str(labels), "--out", str(folder)]
    start, most = time.perf_counter(), 0
    child = subprocess.Popen(
        [*command, "--organ", KIDNEY_OF_PHANTOM, "--tumour", TUMOUR_OF_PHANTOM],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    watched = psutil.Process(child.pid)
    while child.poll() is None:
        try:
            most = max(most, watched.memory_info().rss)
        except psutil.Error:  # it has just ended
            break
        time.sleep(POLL_S)
    _, errors = child.communicate()
    if child.returncode != 0:
        raise click.ClickException(f"the import failed: {errors.decode('utf-8', 'replace').strip()}")
    return time.perf_counter() - start, most / 1e9
