"""A ball-shaped organ with a score around its top, and cuts of it by planes and balls, whose figures have
closed forms.
"""

import numpy as np
import trimesh

from rehearsal.resection.cut import Cut, CutSettings
from rehearsal.resection.score_line import ScoreLine, score_line
from scenes.solids import solid_of, surface_of

R = 30.0
# The score's marks are at this angle from the top, in such a number; the line is as high as RIM_MM and as
# wide.
MARKS, ANGLE = 60, np.radians(35)
RIM_MM, HEIGHT_MM = R * np.sin(ANGLE), R * np.cos(ANGLE)


def ball(radius: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0), fine: int = 4) -> trimesh.Trimesh:
    """A ball [mm], of a surface that is inside it by its ``inset``."""
    return trimesh.creation.icosphere(subdivisions=fine, radius=radius).apply_translation(at)


def inset(surface: trimesh.Trimesh) -> float:
    """How far the faces of a ball about the origin are inside it at most, as a share of the radius."""
    radius = np.linalg.norm(surface.vertices, axis=1).max()
    return 1 - float(np.linalg.norm(surface.triangles_center, axis=1).min()) / radius


def circle(count: int = MARKS, angle: float = ANGLE) -> np.ndarray:
    """Marks (n, 3) on the ball at an angle from its top."""
    return ring(count, R * np.sin(angle), R * np.cos(angle))


def ring(count: int, radius: float, height: float) -> np.ndarray:
    """Points (n, 3) on a circle about the z axis."""
    turn = 2 * np.pi * np.arange(count) / count
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.full(count, height)])


def line_on_ball(organ: trimesh.Trimesh) -> ScoreLine:
    """The score at HEIGHT_MM."""
    return score_line(organ, circle())


def cap_mm3(radius: float, height: float) -> float:
    """Volume of a ball's cap."""
    return np.pi * height**2 * (3 * radius - height) / 3


def cut_by(organ: trimesh.Trimesh, cutter: trimesh.Trimesh) -> Cut:
    """The cut that takes what is inside a closed surface; its score has no meaning."""
    whole, tool = solid_of(organ, "organ").as_original(), solid_of(cutter, "cutter").as_original()
    specimen, on_specimen = surface_of(whole ^ tool)
    remnant, on_remnant = surface_of(whole - tool)
    capsule = whole.original_id()
    line = ScoreLine(np.zeros((3, 3)), np.zeros((8, 3)), np.array([0.0, 0.0, 1.0]))
    return Cut(line, CutSettings(), specimen, remnant, on_specimen != capsule, on_remnant != capsule)


def half_space(above_mm: float) -> trimesh.Trimesh:
    """What is above a height [mm], as a box wider than the ball, of small faces."""
    box = trimesh.creation.box([70.0, 70.0, 40.0])
    vertices, faces = trimesh.remesh.subdivide_to_size(box.vertices, box.faces, 6.0)
    fine = trimesh.Trimesh(vertices, faces)
    return fine.apply_translation([0.0, 0.0, above_mm + 20.0])
