"""The views by approach: what a surgeon has at the left, right, top and bottom of the picture."""

import numpy as np
import pytest

from render.approaches import look_by
from render.camera import OrbitCamera
from render.viewer import Approach

BOUNDS = np.array([[-30.0, -25.0, -55.0], [30.0, 25.0, 55.0]])
ANTERIOR = np.array([0.0, -1.0, 0.0])
LEFT, BACK, HEAD = np.eye(3)


def seen_by(approach: Approach, lateral: np.ndarray) -> OrbitCamera:
    camera = OrbitCamera(BOUNDS, ANTERIOR, (0.3, 0.2, 0.55, 1.0), 16 / 9)
    look_by(camera, approach, lateral)
    return camera


def drawn(camera: OrbitCamera, direction: np.ndarray) -> np.ndarray:
    """Where a direction of the patient points to in the picture: to the right, and up. A short piece of it:
    the eye is beside the middle of the window.
    """
    ends = camera.project(np.stack([np.zeros(3), 0.1 * direction]))
    return (ends[1] - ends[0]) * [camera.aspect, 1.0] / 0.1


@pytest.mark.parametrize("lateral, sense", [(LEFT, -1.0), (-LEFT, 1.0)], ids=["left kidney", "right kidney"])
def test_the_scope_sees_the_flank_up_and_the_head_on_its_side(lateral, sense):
    camera = seen_by("surgeon's scope", lateral)
    to_eye = camera.eye() - camera.target
    assert to_eye @ ANTERIOR > 0 and to_eye @ lateral < 0, "the scope comes from the front and the middle"
    right, up = drawn(camera, lateral)
    assert up > 0 and abs(right) < 0.1 * up
    right, up = drawn(camera, HEAD)
    assert sense * right > 10 * abs(up), "the head is left for a left kidney, right for a right one"


@pytest.mark.parametrize("approach, sense", [("from above", 1.0), ("from behind", -1.0)])
def test_front_and_back_have_the_head_up_and_the_sides_as_the_eye_does(approach, sense):
    camera = seen_by(approach, LEFT)
    assert sense * (camera.eye() - camera.target) @ ANTERIOR > 0
    assert drawn(camera, HEAD)[1] > 0
    assert sense * drawn(camera, LEFT)[0] > 0


def test_the_bedside_is_the_initial_view():
    camera = seen_by("surgeon's scope", LEFT)
    camera.pan(0.1, 0.1)
    look_by(camera, "bedside", LEFT)
    first = OrbitCamera(BOUNDS, ANTERIOR, (0.3, 0.2, 0.55, 1.0), 16 / 9)
    assert camera.state == first.state
    assert np.array(camera.axes()) == pytest.approx(np.array(first.axes()))


@pytest.mark.parametrize("approach", ["surgeon's scope", "from above", "from behind"])
def test_the_organ_is_in_its_part_of_the_window(approach):
    camera = seen_by(approach, LEFT)
    assert camera.project(np.zeros((1, 3)))[0] == pytest.approx([0.425, 0.6])
