"""The path of a tracked probe, which a rehearsal follows, from a file."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from rehearsal.planning.plan_file import is_plan, read_plan, timed_poses
from rehearsal.tracking.pose_file import PoseError, TimedPoses, check_rigid, load_timed_poses
from ultrasound.sweep import TRANSFORM_NAME, SweepError
from ultrasound.sweep_file import read_sweep

PROBE_IN_PATIENT = "ProbeToReference"
# If all poses are farther from the organ, they are not of this patient.
FAR_MM = 50.0


def load_track(path: Path, name: str | None = None) -> TimedPoses:
    """The poses of a probe in the patient, from a tracked sweep (.igs.mha, .igs.nrrd), the first sweep of a
    plan, or a pose file with times.

    ``name`` is the sweep's transform from the probe to the patient, ProbeToReference where it is None. Raises
    PoseError, SweepError, PlanError.
    """
    if path.suffix.lower() in (".mha", ".nrrd"):
        return _sweep_poses(path, name or PROBE_IN_PATIENT)
    if path.suffix.lower() in (".mhd", ".nhdr"):
        raise SweepError(
            f"{path.name}: is a header whose images are in another file; expected a sweep in one file "
            "(.igs.mha, .igs.nrrd), a plan, or "
            "poses with times (.json, .csv); save it as .igs.mha, as PLUS and 3D Slicer do"
        )
    if name is not None:
        raise PoseError(
            f"--track-from {name}: names a transform of a sweep, and {path.name} is not a sweep (.igs.mha, "
            ".igs.nrrd); leave it out"
        )
    if is_plan(path):
        plan = read_plan(path)
        return timed_poses(plan.sweeps[0], plan.speed_mm_s)
    return load_timed_poses(path)


def check_near(track: TimedPoses, organ: np.ndarray, path: Path) -> None:
    """Raises PoseError where no pose is near an organ's vertices (n, 3) in the patient (LPS, mm)."""
    places = np.array([pose[:3, 3] for pose in track.poses if pose is not None])
    nearest = float(cKDTree(organ).query(places)[0].min())
    if nearest > FAR_MM:
        raise PoseError(
            f"{path.name}: the nearest pose is {nearest:.0f} mm from the organ; expected the probe's poses "
            "in this patient "
            "(LPS, mm): register the tracker to the patient first"
        )


def _sweep_poses(path: Path, name: str) -> TimedPoses:
    match = TRANSFORM_NAME.fullmatch(name)
    if match is None:
        raise SweepError(f"--track-from {name!r}: expected a transform's name such as {PROBE_IN_PATIENT}")
    probe, patient = match.groups()
    sweep = read_sweep(path)
    try:
        poses = [sweep.transform(probe, patient, frame) for frame in range(len(sweep))]
        for frame, pose in enumerate(poses):
            if pose is not None:
                try:
                    check_rigid(pose)
                except PoseError as error:
                    raise PoseError(f"frame {frame}: {name} is {error}") from None
        if all(pose is None for pose in poses):
            raise SweepError(f"{name} has the status OK in none of {len(poses)} frames; expected some")
        return TimedPoses(sweep.times_s, poses)
    except (SweepError, PoseError) as error:
        raise type(error)(f"{path.name}: {error}") from None
