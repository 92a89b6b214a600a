"""A recorded sweep with the errors of a simulated tracker."""

from dataclasses import replace

import numpy as np

from ultrasound.sweep import Sweep, SweepError, transform_fields
from ultrasound.tracking_errors import TrackingErrors, with_tracking_errors


def with_errors(sweep: Sweep, reference: str, errors: TrackingErrors, seed: int) -> Sweep:
    """The sweep with a tracker's errors on the poses of its probe; frames without a pose keep none.

    Raises SweepError where poses or times cannot be used.
    """
    poses = [sweep.transform("Probe", reference, frame) for frame in range(len(sweep))]
    known = [frame for frame, pose in enumerate(poses) if pose is not None]
    if not known:
        raise SweepError(f"no frame has a pose of the probe in {reference}, to which errors could be added")
    try:
        true_poses = np.stack([pose for pose in poses if pose is not None])
        found = with_tracking_errors(true_poses, sweep.times_s[known], errors, seed)
    except ValueError as error:
        raise SweepError(f"errors of a tracker cannot be added to this sweep: {error}") from None
    name, frames = f"ProbeTo{reference}", [dict(fields) for fields in sweep.frames]
    for frame, pose in zip(known, found, strict=True):
        frames[frame] |= transform_fields(name, pose)
    after = replace(sweep, frames=frames)
    first, pose = next(
        ((frame, pose) for frame, pose in zip(known, found, strict=True) if pose is not None), (0, None)
    )
    if pose is not None and not np.array_equal(pose, after.transform("Probe", reference, first)):  # type: ignore[arg-type]
        raise SweepError(
            f"the sweep holds {reference}ToProbe, to which no errors can be added: expected {name}Transform"
        )
    return after
