"""A kidney in its fat lies where it lay, after the probe has dragged over it."""

import numpy as np
from coarse_patient import coarse_patient

from rehearsal.case import case_of
from rehearsal.rehearsal import Rehearsal
from scenes.scene import with_options
from ultrasound.probe_manipulator import advanced, interpolated

# Pressed in so deep, the probe slides so far to each side; then it is lifted for 2 s.
PRESSED_MM, SLIDE_MM, LIFTED_MM, REST_STEPS = 4.0, 15.0, 60.0, 120


def shift_after_drags(rehearsal: Rehearsal) -> float:
    """The largest distance [mm] of the surface from where it had settled, after a drag to each side."""
    settled, organ, manipulator = surface(rehearsal), rehearsal.organ, rehearsal.manipulator
    for lateral, elevation in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        manipulator.state = type(manipulator.state)()
        go(organ, manipulator.pose(), 20)
        manipulator.push(PRESSED_MM)
        go(organ, manipulator.pose(), 20)
        for _ in range(int(SLIDE_MM / 0.5)):
            manipulator.slide(0.5 * lateral, 0.5 * elevation)
            go(organ, manipulator.pose(), 1)
        go(organ, advanced(organ.pose, -LIFTED_MM), 20)
    for _ in range(REST_STEPS):
        organ.advance(organ.pose)
    return float(np.linalg.norm(surface(rehearsal) - settled, axis=1).max())


def go(organ, pose: np.ndarray, steps: int) -> None:
    """Move the probe evenly to a pose."""
    start = organ.pose
    for step in range(steps):
        organ.advance(interpolated(start, pose, (step + 1) / steps))


def surface(rehearsal: Rehearsal) -> np.ndarray:
    """The vertices (n, 3) [mm] of the organ's present surface."""
    rehearsal.show()
    return rehearsal.anatomy.vertices.copy()


def test_it_comes_back_after_drags(device):
    in_fat, anatomy = coarse_patient()
    assert shift_after_drags(in_fat) < 0.1
    bare = with_options(in_fat.case.scene, {"attachment.fat_young_kpa": 0.0, "attachment.fat_kpa_mm": 0.0})
    on_its_support = Rehearsal(case_of(bare, anatomy, in_fat.case.probe), anatomy)
    # Friction holds it there. The bar of a patient's kidney is 1 mm.
    assert shift_after_drags(on_its_support) > 0.5
