"""Mouse, keys and gamepad move the transducer over the settled organ."""

import numpy as np

from render.viewer import Controls
from ultrasound.probe_manipulator import ProbeManipulator

Ray = tuple[np.ndarray, np.ndarray]


class Hand:
    """What mouse, keys and gamepad ask of the manipulator.

    ``waits``: the transducer stays until the user moves it.
    """

    def __init__(self, manipulator: ProbeManipulator, waits: bool = False) -> None:
        self.manipulator, self.waits = manipulator, waits
        self._ray: Ray | None = None
        self._ray_at_slide: Ray | None = None

    def wait(self, ray: Ray | None) -> None:
        """Stay until the mouse leaves a ray, or a key is pressed."""
        self.waits, self._ray = True, ray

    def pose(self, controls: Controls, pose: np.ndarray, time_s: float) -> np.ndarray:
        """The transducer's next pose (4, 4) after the last one, a time [s] later."""
        if self.waits and self._ray is None:
            self._ray = controls.ray
        self.waits = self.waits and not acts(controls, self._ray)
        if self.waits:
            return pose
        manipulator = self.manipulator
        if any(controls.slide_mm):
            manipulator.slide(*controls.slide_mm)
            self._ray_at_slide = controls.ray
        elif controls.ray is not None and mouse_moved(controls.ray, self._ray_at_slide):
            manipulator.point(*controls.ray)
            self._ray_at_slide = None
        manipulator.press(controls.press, time_s, controls.press_share)
        manipulator.push(controls.push_mm)
        manipulator.turn(controls.tilt_deg, controls.rock_deg, controls.rotate_deg)
        return manipulator.pose_towards(manipulator.pose(), pose, time_s)


def acts(controls: Controls, ray: Ray | None) -> bool:
    """Whether the user does anything but keep the mouse on a ray."""
    turns = controls.push_mm, controls.tilt_deg, controls.rock_deg, controls.rotate_deg
    return mouse_moved(controls.ray, ray) or controls.press or any(turns) or any(controls.slide_mm)


def mouse_moved(ray: Ray | None, before: Ray | None) -> bool:
    """Whether the mouse is on a ray, and on another than before."""
    if ray is None or before is None:
        return ray is not None
    return not all(np.array_equal(a, b) for a, b in zip(ray, before, strict=True))
