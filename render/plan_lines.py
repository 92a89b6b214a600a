"""A planned sweep in the 3D view: the path of the array face, and the outline of the probe at the next pose.

The scene is a parameter: only window.py imports taichi.ui. Lengths in mm.
"""

import numpy as np
import taichi as ti

from render import transducer_shape
from render.viewer import Guidance
from sim.fields import fill

MAX_SEGMENTS = 2000
TO_GO, DONE = np.array([1.0, 0.72, 0.20], np.float32), np.array([0.30, 0.75, 0.42], np.float32)
GOAL = (1.0, 0.86, 0.45)
WIDTH, GOAL_WIDTH = 2.6, 1.8


class PlanLines:
    """Fields of the drawn lines. Of a path of more than MAX_SEGMENTS only every n-th segment is drawn."""

    def __init__(self, edges: np.ndarray) -> None:
        self._edges = edges
        self._goal = ti.Vector.field(3, ti.f32, len(edges))
        self._path, self._colours = (ti.Vector.field(3, ti.f32, 2 * MAX_SEGMENTS) for _ in range(2))
        self._shown = np.zeros((0, 2, 3)), 0

    def draw(self, scene, guidance: Guidance) -> None:
        """Draw the lines into a scene."""
        path, done = guidance.path_mm, int(guidance.done.sum())
        if self._shown[0] is not path or self._shown[1] != done:
            self._fill(guidance)
            self._shown = path, done
        scene.lines(self._path, WIDTH, per_vertex_color=self._colours)
        if guidance.goal is not None:
            fill((self._goal, transducer_shape.placed(self._edges, guidance.goal)))
            scene.lines(self._goal, GOAL_WIDTH, color=GOAL)

    def _fill(self, guidance: Guidance) -> None:
        every = -(-len(guidance.path_mm) // MAX_SEGMENTS)
        segments, done = guidance.path_mm[::every], guidance.done[::every]
        # Unused segments have no length.
        points = np.repeat(segments[-1:, 1:], 2 * MAX_SEGMENTS, axis=1)[0].astype(np.float32)
        colours = np.tile(DONE, (2 * MAX_SEGMENTS, 1))
        points[: 2 * len(segments)] = segments.reshape(-1, 3)
        colours[: 2 * len(segments)] = np.where(np.repeat(done, 2)[:, None], DONE, TO_GO)
        fill((self._path, points), (self._colours, colours))
