"""Freehand sweeps with known ground truth: a slow one of the resting kidney, ones pressed over the tumour."""

from dataclasses import dataclass

import numpy as np
import trimesh

from rehearsal.deformed_anatomy import scanned_anatomy
from rehearsal.measurements.tumour_measurements import measure
from rehearsal.reconstruction.compression_correction import approach
from rehearsal.rehearsal import Rehearsal
from scenes.anatomy import LoadedAnatomy
from sim.embedding import Unmoved
from sim.signed_distance import signed_distance
from studies.harness import all_scanlines
from ultrasound.bmode import source_of_pixels
from ultrasound.ground_truth_labels import MAX_BEADS, GroundTruthLabels
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ImagePlane, advanced, touching
from ultrasound.sampled_volume import distance_volume
from ultrasound.scanner import Scanner
from ultrasound.sweep import Sweep, transform_fields

FRAMES_A_SECOND = 30
# The slow sweep: its speed, the height of the probe above the organ, and how far it goes beyond both ends.
SPEED_MM_S, ABOVE_MM, BEYOND_MM = 10.0, 12.0, 4.0
# The pressed sweep begins and ends at this distance from the tumour.
BESIDE_MM = 4.0
# Virtual beads as in the paper, around the tumour.
BEAD_RADIUS_MM, BEADS_APART_MM, BEADS_WITHIN_MM = 1.5, 9.0, 24.0


@dataclass
class GroundTruthSweep:
    """A sweep of ``PixelLabel`` images with the true poses (n, 4, 4) of the probe in the patient.

    ``beads_mm`` (k, 3) are at rest (LPS), ``on_probe`` (4, 4) is ImageToProbe, ``mask`` (rows, columns) is
    True in the field of view.
    """

    sweep: Sweep
    poses: np.ndarray
    beads_mm: np.ndarray
    on_probe: np.ndarray
    mask: np.ndarray
    compression_mm: float = 0.0


def beads_of(organ: trimesh.Trimesh, tumour: trimesh.Trimesh | None) -> np.ndarray:
    """Positions (k, 3) of beads [mm], on a grid around the middle of the tumour or the organ."""
    middle = (tumour or organ).center_mass
    most = np.ceil(BEADS_WITHIN_MM / BEADS_APART_MM)
    steps = np.arange(-most, most + 1)
    cells = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    grid = middle + BEADS_APART_MM * cells
    near = grid[np.linalg.norm(grid - middle, axis=1) < BEADS_WITHIN_MM]
    depth = -signed_distance(organ.vertices, organ.faces, near)[0]
    inside = near[depth > 2 * BEAD_RADIUS_MM]
    # At most MAX_BEADS, those nearest to the middle.
    nearest = np.argsort(np.linalg.norm(inside - middle, axis=1), kind="stable")[:MAX_BEADS]
    return inside[np.sort(nearest)]


def resting(
    anatomy: LoadedAnatomy, probe: Probe, direction: np.ndarray, pixels: int, draws: bool
) -> GroundTruthSweep:
    """The slow sweep of the undeformed CT along the organ's long axis; Taichi must have been started."""
    if anatomy.ct is None:
        raise ValueError("a sweep needs a CT")
    organ, tumour = anatomy.organ, anatomy.tumour
    scanned = scanned_anatomy(organ, anatomy.ct, anatomy, np.zeros(3), draws)
    scanner = Scanner(scanned, Unmoved(), probe, pixels, "background", "tissue")
    poses = _along(organ, probe, direction)
    beads = beads_of(organ, tumour)
    marks = _marks(scanner.plane, organ, tumour, beads)
    images = []
    for pose in poses:
        scanner.locate(ImagePlane(pose, *probe.extent_mm))
        images.append(marks.render())
    return _truth(np.stack(images), poses, np.arange(len(poses)) / FRAMES_A_SECOND, probe, beads)


def _along(organ: trimesh.Trimesh, probe: Probe, direction: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) along the organ's long axis: the beam along a direction, images across the axis."""
    down = direction / np.linalg.norm(direction)
    centred = organ.vertices - organ.center_mass
    axis = np.linalg.svd(centred - np.outer(centred @ down, down), full_matrices=False)[2][0]
    along, depth = centred @ axis, centred @ down
    steps = np.arange(along.min() - BEYOND_MM, along.max() + BEYOND_MM, SPEED_MM_S / FRAMES_A_SECOND)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([np.cross(down, axis), down, axis])
    poses = np.tile(pose, (len(steps), 1, 1))
    poses[:, :3, 3] = organ.center_mass + (depth.min() - ABOVE_MM) * down + steps[:, None] * axis
    return poses


def pressed(rehearsal: Rehearsal, depth_mm: float) -> GroundTruthSweep:
    """A sweep of the deforming body over the tumour, at a depth [mm] and along the probe's elevation axis."""
    case, anatomy = rehearsal.case, rehearsal.anatomy
    if case.tumour is None or anatomy.scanner is None:
        raise ValueError("a pressed sweep needs a tumour and a CT")
    rehearsal.reset()
    probe, path = case.probe, _path(rehearsal, case.tumour, depth_mm)
    beads = beads_of(case.organ, case.tumour)
    marks = _marks(anatomy.scanner.plane, case.organ, case.tumour, beads)
    touches = all_scanlines(probe)
    approach(rehearsal, path[0])
    images, poses, compression = [], [], []
    step_s = rehearsal.organ.settings.time_step_s
    every = round(1 / (FRAMES_A_SECOND * step_s))
    for step, pose in enumerate(path):
        rehearsal.advance(pose)
        if step % every == 0:
            rehearsal.show()
            anatomy.find_plane(probe)
            images.append(marks.render())
            poses.append(anatomy.probe_in_patient())
            compression.append(measure(anatomy, probe, touches).compression_mm)
    times = np.arange(len(poses)) * every * step_s
    truth = _truth(np.stack(images), np.stack(poses), times, probe, beads + case.origin)
    truth.compression_mm = float(np.mean(compression))
    return truth


def _path(rehearsal: Rehearsal, tumour: trimesh.Trimesh, depth_mm: float) -> np.ndarray:
    """Poses (n, 4, 4) of each step over the middle of a tumour, at a depth [mm] under the settled surface."""
    manipulator = rehearsal.manipulator
    home = manipulator.home
    local = (np.asarray(tumour.vertices) - home[:3, 3]) @ home[:3, :3]
    low, high = local.min(axis=0)[:2], local.max(axis=0)[:2]
    step_mm, poses = SPEED_MM_S * rehearsal.organ.settings.time_step_s, []
    for offset in np.arange(low[1] - BESIDE_MM, high[1] + BESIDE_MM, step_mm):
        pose = home.copy()
        pose[:3, 3] += pose[:3, :2] @ [(low[0] + high[0]) / 2, offset]
        above = touching(pose, manipulator.size_mm, manipulator.samples, manipulator.radius_mm)
        poses.append(advanced(above, depth_mm))
    return np.stack(poses)


def _marks(
    plane: PlaneInTissue, organ: trimesh.Trimesh, tumour: trimesh.Trimesh | None, beads: np.ndarray
) -> GroundTruthLabels:
    around = None if tumour is None else distance_volume(tumour, 1.0)
    return GroundTruthLabels(plane, distance_volume(organ, 1.0), around, beads, BEAD_RADIUS_MM)


def _truth(
    images: np.ndarray, poses: np.ndarray, times_s: np.ndarray, probe: Probe, beads_mm: np.ndarray
) -> GroundTruthSweep:
    on_probe = probe.image_to_probe(*images.shape[1:])
    mask = source_of_pixels(probe, *images.shape[1:])[..., 0] > -1.0
    return GroundTruthSweep(sweep_of(images, poses, times_s, on_probe), poses, beads_mm, on_probe, mask)


def sweep_of(
    images: np.ndarray, poses: list[np.ndarray | None] | np.ndarray, times_s: np.ndarray, on_probe: np.ndarray
) -> Sweep:
    """A sweep of images (n, rows, columns) and poses of the probe in the patient, None where it was lost."""
    frames = [
        transform_fields("ProbeToReference", pose) | {"Timestamp": repr(float(time_s))}
        for pose, time_s in zip(poses, times_s, strict=True)
    ]
    return Sweep(images, frames, {}, {"ImageToProbe": on_probe})
