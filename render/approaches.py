"""The views of a kidney by the surgeon's approach; patient coordinates are LPS: to left, back and head."""

import numpy as np

from render.camera import OrbitCamera
from render.viewer import Approach

BACK, HEAD = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
# The scope of a transperitoneal operation comes from the front and the middle; the patient is on the other
# side, so that the flank of the kidney is up, and the scope looks up to it by this angle.
SCOPE_DEG = 30.0


def look_by(camera: OrbitCamera, approach: Approach, lateral: np.ndarray) -> None:
    """Turn a camera to see a kidney by an approach; ``lateral`` (3,) is the side that the kidney is on."""
    turn = np.radians(SCOPE_DEG)
    match approach:
        case "bedside":
            camera.look_from_home()
        case "surgeon's scope":
            camera.look(np.cos(turn) * BACK + np.sin(turn) * lateral, lateral)
        case "from above":
            camera.look(BACK, HEAD)
        case "from behind":
            camera.look(-BACK, HEAD)
