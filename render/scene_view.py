"""The 3D view: organ, internal structures, support, transducer, image plane and planned sweep in a GGUI
scene.

The scene is a parameter: graphics_scene.py or software_scene.py. Lengths in mm.
"""

from collections.abc import Sequence

import numpy as np

from render import transducer_shape
from render.camera import OrbitCamera
from render.cut_face import CutFace, side_of_eye
from render.surface_shading import CUT_EDGE_MM, GLASS, ORGAN, SOLID, Cut, DrawnMesh, ShadedSurface
from render.viewer import Geometry, Guidance, Score, Surface, View, ViewSettings
from sim.fields import field_of, fill, zeros

PLANE_ROWS, PLANE_COLUMNS = 96, 64
KEY_LIGHT, FILL_LIGHT, AMBIENT = (0.82, 0.80, 0.77), (0.17, 0.19, 0.23), (0.17, 0.17, 0.19)
TUMOUR, SUPPORT, EDGE, FRAME = (0.93, 0.76, 0.28), (0.30, 0.33, 0.36), (0.85, 0.9, 0.94), (0.25, 0.77, 1.0)
# As in an atlas; a vessel is neither red nor blue where no label says whether it is artery or vein.
PARTS = {
    "cyst": (0.55, 0.80, 0.95),
    "urine": (0.92, 0.94, 0.55),
    "artery": (0.86, 0.10, 0.08),
    "vein": (0.14, 0.26, 0.80),
    "vessel": (0.56, 0.30, 0.66),
}
LINE_WIDTH = 1.2
# Panel, title, strip, compass, findings, warnings, five signs and the meaning of one.
MASKS = 12
# Lines of a planned sweep.
MAX_SEGMENTS = 2000
TO_GO, DONE = np.array([1.0, 0.93, 0.17], np.float32), np.array([0.30, 0.75, 0.42], np.float32)
GOAL = (1.0, 0.86, 0.45)
PLAN_WIDTH, GOAL_WIDTH = 2.6, 1.8
# Arrows to the next pose: so many segments at most, and the tip's length and slope.
ARROW, ARROW_WIDTH, MAX_ARROW, TIP_MM, TIP_SLOPE = (1.0, 0.45, 0.85), 3.0, 64, 3.5, 0.5
# The hand, where the probe stays behind it.
GHOST, GHOST_WIDTH = (0.98, 0.55, 0.20), 1.8
SPECIMEN, BED = (0.72, 0.45, 0.38), (0.86, 0.56, 0.47)
# The score: a line over the capsule, red where it is too near to the tumour, and its marks as small crosses.
SCORED, NEAR = np.array([0.61, 0.77, 1.0], np.float32), np.array([0.98, 0.23, 0.18], np.float32)
MAX_SCORE, MAX_MARKS, MARK_MM, SCORE_LIFT_MM, SCORE_WIDTH = 600, 200, 1.2, 0.6, 3.0


class SceneView:
    """Fields of the drawn objects; ``draw`` draws them all.

    ``before`` is the view of other geometry that this one replaces.
    """

    def __init__(self, geometry: Geometry, camera: OrbitCamera, before: "SceneView | None" = None):
        self.camera, self._up = camera, np.asarray(geometry.up, float)
        self._organ = ShadedSurface(*geometry.organ, _colours_of_organ(geometry))
        self._seen_vertices = geometry.seen_vertices
        # The coverage that was drawn last, and that of the drawn vertices.
        self._coverage: tuple[np.ndarray | None, np.ndarray | None] = None, None
        self._tumour = self._support = None
        self._parts = [
            ShadedSurface(*part, _colours_of(tissue, geometry)) for tissue, part in geometry.parts.items()
        ]
        if geometry.tumour is not None:
            self._tumour = ShadedSurface(*geometry.tumour, TUMOUR)
        self._specimen = _still(geometry.specimen, SPECIMEN)
        self._tumour_cut_out = _still(geometry.tumour_cut_out, TUMOUR)
        # The eye that saw them last, and the order of the specimen's faces for it.
        self._specimen_eye, self._specimen_order = np.full(3, np.nan), np.zeros(0, np.int32)
        self._bed = None if geometry.bed is None else ShadedSurface(*geometry.bed, BED)
        if geometry.support is not None:
            self._support = self._matt_support(*geometry.support)
        self._half_axis_mm = geometry.transducer.size_mm[2] / 2
        self._probe = transducer_shape.transducer(geometry.transducer)
        self._probe_mesh = DrawnMesh(len(self._probe.vertices))
        self._probe_edges = transducer_shape.edges(geometry.transducer)
        self._edge_points, self._ghost_points = (field_of(self._probe_edges, within=1) for _ in range(2))
        # Made when they are first drawn, and for other geometry only once.
        self.plan_lines: PlanLines | None = before.plan_lines if before else None
        self.score_lines: ScoreLines | None = before.score_lines if before else None
        self.cut_face: CutFace | None = before.cut_face if before else None
        self._cut_side = 0.0
        self._plane = transducer_shape.image_plane_grid(PLANE_ROWS, PLANE_COLUMNS)
        self._plane_indices = transducer_shape.grid_triangles(PLANE_ROWS, PLANE_COLUMNS).reshape(-1)
        self._plane_mesh = DrawnMesh(len(self._plane))
        self._frame_points = field_of(np.zeros((2 * transducer_shape.FRAME_SIDES, 3)), within=1)
        self._masks = DrawnMesh(6 * MASKS, channels=4)

    def _matt_support(self, vertices: np.ndarray, faces: np.ndarray) -> ShadedSurface:
        support = ShadedSurface(field_of(vertices, within=1), faces, SUPPORT, gloss=0.0)
        # It is fixed and matt, so its colours are computed once, as seen from far above.
        above = self.camera.target + 10.0 * self.camera.distance_home * self._up
        support.shade(above, above)
        return support

    def draw(
        self, scene, view: View, shown: ViewSettings, masked: Sequence[tuple[float, float, float, float]] = ()
    ) -> None:
        """Draw everything into `scene`, in the order that depth and blending need.

        masked: at most MASKS boxes of the window (left, bottom, right, top) that nothing may cover.
        """
        right, up, ahead = self.camera.axes()
        eye, distance = self.camera.eye(), self.camera.distance_home
        key = eye + distance * (0.55 * up - 0.85 * right)
        scene.ambient_light(AMBIENT)
        scene.point_light(key.tolist(), KEY_LIGHT)
        scene.point_light((eye + distance * (0.9 * right - 0.2 * up)).tolist(), FILL_LIGHT)
        if masked:
            self._mask(scene, masked)
        # From beneath, it would hide the organ.
        is_above = -ahead @ self._up > 0
        if self._support is not None and shown.show_support and is_above:
            # A decimated mesh has slivers that face the wrong way, which would appear as black specks.
            self._support.draw(scene, two_sided=True)
        self._draw_specimen(scene, eye, key, ahead)
        self._draw_transducer(scene, view.transducer_pose)
        if view.hand_pose is not None:
            fill((self._ghost_points, transducer_shape.placed(self._probe_edges, view.hand_pose)))
            scene.lines(self._ghost_points, GHOST_WIDTH, color=GHOST)
        inner = self._inner(view, shown)
        cut = self._draw_cut_face(scene, view, inner, eye, key) if shown.cut else None
        if cut is None:
            self._cut_side = 0.0
            self._draw_inner(scene, inner, eye, key, ahead)
        self._draw_image_plane(scene, view, key)
        if cut is not None:
            self._draw_inner(scene, inner, eye, key, ahead, cut)
        if view.guidance is not None:
            self.plan_lines = self.plan_lines or PlanLines(self._probe_edges)
            self.plan_lines.draw(scene, view.guidance, toward=-ahead)
        if view.score is not None:
            self.score_lines = self.score_lines or ScoreLines()
            self.score_lines.draw(scene, view.score, toward=-ahead)
        if self._bed is not None and shown.translucent and cut is None:
            # A crater in a translucent surface is not seen.
            self._bed.shade(eye, key)
            self._bed.draw(scene)
        opacity = GLASS if shown.translucent else SOLID
        self._organ.tint(self._covered(view.seen.get("organ")))
        self._organ.shade(eye, key, opacity, cut)
        self._organ.draw(scene, ahead if opacity < SOLID or cut is not None else None, cut)

    def _covered(self, seen: np.ndarray | None) -> np.ndarray | None:
        """Coverage of the drawn vertices of the organ."""
        if seen is None or self._seen_vertices is None:
            return seen
        if seen is not self._coverage[0]:
            self._coverage = seen, seen[self._seen_vertices]
        return self._coverage[1]

    def _draw_specimen(self, scene, eye, key, ahead: np.ndarray) -> None:
        """Draw what was cut out, translucent, so that the tumour in it is seen."""
        # It does not move: its shades and the order of its faces are those of the camera.
        if not np.array_equal(eye, self._specimen_eye):
            self._specimen_eye = eye
            for surface, opacity in ((self._tumour_cut_out, SOLID), (self._specimen, GLASS)):
                if surface is not None:
                    surface.shade(eye, key, opacity)
            if self._specimen is not None:
                self._specimen_order = self._specimen.indices(ahead)
        if self._tumour_cut_out is not None:
            self._tumour_cut_out.draw(scene)
        if (specimen := self._specimen) is not None:
            scene.mesh(
                specimen.vertices, self._specimen_order, specimen.normal, per_vertex_color=specimen.colour
            )

    def _inner(self, view: View, shown: ViewSettings) -> list[ShadedSurface]:
        """The shown surfaces inside the organ."""
        surfaces = list(self._parts) if shown.show_parts else []
        if self._tumour is not None and shown.show_tumour:
            self._tumour.tint(view.seen.get("tumour"))
            surfaces.append(self._tumour)
        return surfaces

    def _draw_inner(
        self, scene, inner: list[ShadedSurface], eye, key, ahead: np.ndarray, cut: Cut | None = None
    ) -> None:
        for surface in inner:
            surface.shade(eye, key, SOLID, cut)
            surface.draw(scene, None if cut is None else ahead, cut)

    def _mask(self, scene, masked) -> None:
        """Draw quads of alpha 0 just behind the near plane: the background stays visible, what is drawn
        later is hidden.
        """
        if len(masked) > MASKS:
            raise ValueError(f"{len(masked)} boxes to mask: at most {MASKS} are expected")
        corners = np.full((MASKS, 6, 2), -1.0)
        for quad, box in zip(corners, masked, strict=False):
            # Of left, bottom, right and top: the corners of two triangles.
            quad[:] = np.array(box)[[[0, 1], [2, 1], [2, 3], [0, 1], [2, 3], [0, 3]]]
        depth = 1.02 * self.camera.near_far()[0]
        points = self.camera.eye() + depth * self.camera.direction(corners.reshape(-1, 2))
        count = len(points)
        self._masks.draw(
            scene, np.arange(count, dtype=np.int32), points, np.ones((count, 3)), np.zeros((count, 4))
        )

    def _draw_transducer(self, scene, pose: np.ndarray) -> None:
        probe = self._probe
        indices = np.arange(len(probe.vertices), dtype=np.int32)
        points, normals = transducer_shape.placed(probe.vertices, pose), probe.normals @ pose[:3, :3].T
        self._probe_mesh.draw(scene, indices, points, normals, probe.colours)
        fill((self._edge_points, transducer_shape.placed(self._probe_edges, pose)))
        scene.lines(self._edge_points, LINE_WIDTH, color=EDGE)

    def _draw_cut_face(self, scene, view: View, inner: list[ShadedSurface], eye, key) -> Cut:
        """Draw the section and return the cut that removes the half before the eye."""
        self._cut_side = side_of_eye(view.transducer_pose, eye, self._cut_side)
        self.cut_face = self.cut_face or CutFace()
        away, behind = self._cut_side * view.transducer_pose[:3, 1], np.array(view.transducer_pose)
        # The cut is shifted by half its soft edge, which must not be in front of the image.
        behind[:3, 3] -= CUT_EDGE_MM / 2 * away
        self.cut_face.draw(scene, self._organ, inner, behind, key)
        return behind[:3, 3], away

    def _draw_image_plane(self, scene, view: View, key: np.ndarray) -> None:
        face = np.array(view.transducer_pose, dtype=np.float64)
        face[:3, 3] -= face[:3, 2] * self._half_axis_mm
        places = transducer_shape.on_plane(self._plane, view)
        points = transducer_shape.placed(transducer_shape.on_transducer(places), face)
        toward = key - points
        # Normals towards the key light make the plane evenly bright: grey values are those of the image.
        normals = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        grey = transducer_shape.sampled(next(iter(view.images.values())), places, view)
        self._plane_mesh.draw(
            scene, self._plane_indices, points, normals, np.repeat(grey[:, None], 3, axis=1)
        )
        fill((self._frame_points, transducer_shape.placed(transducer_shape.image_plane_frame(view), face)))
        scene.lines(self._frame_points, LINE_WIDTH, color=FRAME)


class PlanLines:
    """A planned sweep: the path of the array face, the outline of the probe at the next pose, and arrows
    that lead there.

    Of a path of more than MAX_SEGMENTS only every n-th segment is drawn.
    """

    def __init__(self, edges: np.ndarray) -> None:
        self._edges = edges
        self._goal = zeros(len(edges), 3, within=1)
        self._path, self._colours = (zeros(2 * MAX_SEGMENTS, 3, within=1) for _ in range(2))
        self._arrows = zeros(2 * MAX_ARROW, 3, within=1)
        self._shown = np.zeros((0, 2, 3)), 0

    def draw(self, scene, guidance: Guidance, toward: np.ndarray) -> None:
        """Draw the lines into a scene, seen from ``toward`` (3,)."""
        path, done = guidance.path_mm, int(guidance.done.sum())
        if self._shown[0] is not path or self._shown[1] != done:
            self._fill(guidance)
            self._shown = path, done
        scene.lines(self._path, PLAN_WIDTH, per_vertex_color=self._colours)
        if guidance.goal is not None:
            fill((self._goal, transducer_shape.placed(self._edges, guidance.goal)))
            scene.lines(self._goal, GOAL_WIDTH, color=GOAL)
        if guidance.arrows_mm:
            arrows = np.concatenate([arrow_segments(path, toward) for path in guidance.arrows_mm])[:MAX_ARROW]
            # Unused segments have no length.
            points = np.repeat(arrows[-1:, 1], 2 * MAX_ARROW, axis=0).astype(np.float32)
            points[: 2 * len(arrows)] = arrows.reshape(-1, 3)
            fill((self._arrows, points))
            scene.lines(self._arrows, ARROW_WIDTH, color=ARROW)

    def _fill(self, guidance: Guidance) -> None:
        every = -(-len(guidance.path_mm) // MAX_SEGMENTS)
        segments, done = guidance.path_mm[::every], guidance.done[::every]
        # Unused segments have no length.
        points = np.repeat(segments[-1:, 1:], 2 * MAX_SEGMENTS, axis=1)[0].astype(np.float32)
        colours = np.tile(DONE, (2 * MAX_SEGMENTS, 1))
        points[: 2 * len(segments)] = segments.reshape(-1, 3)
        colours[: 2 * len(segments)] = np.where(np.repeat(done, 2)[:, None], DONE, TO_GO)
        fill((self._path, points), (self._colours, colours))


class ScoreLines:
    """The closed line of the score and its marks; of a line of more than MAX_SCORE points only every n-th
    is drawn.
    """

    def __init__(self) -> None:
        self._points, self._colours = (zeros(4 * (MAX_SCORE + MAX_MARKS), 3, within=1) for _ in range(2))

    def draw(self, scene, score: Score, toward: np.ndarray) -> None:
        """Draw the lines into a scene, lifted a little off the surface, ``toward`` (3,) the eye."""
        line, near = thinned(score.line_mm), thinned(score.is_near)
        across = np.linalg.svd(toward[None])[2][1:]
        crosses = score.marks_mm[:, None, None] + MARK_MM * np.stack([across, -across], axis=1)
        planned = closed(thinned(score.planned_mm))
        drawn = (
            (planned, np.tile(TO_GO, (len(planned), 1))),
            (closed(line), np.where(near[:, None], NEAR, SCORED)),
            (crosses.reshape(-1, 2, 3), np.tile(SCORED, (2 * len(crosses), 1))),
        )
        segments, colours = (np.concatenate([lines[k] for lines in drawn]) for k in range(2))
        segments = segments + SCORE_LIFT_MM * toward
        if len(segments) == 0:
            return
        count = 2 * len(segments)
        # Unused segments have no length.
        points = np.repeat(segments[-1:, 1], self._points.shape[0], axis=0).astype(np.float32)
        points[:count] = segments.reshape(-1, 3)
        shades = np.tile(SCORED, (len(points), 1))
        shades[:count] = np.repeat(colours, 2, axis=0)
        fill((self._points, points), (self._colours, shades))
        scene.lines(self._points, SCORE_WIDTH, per_vertex_color=self._colours)


def _colours_of_organ(geometry: Geometry) -> np.ndarray:
    """The colour (3,) of the organ, or after a cut those of its vertices (n, 3)."""
    if geometry.bed is None:
        return np.array(ORGAN)
    colours = np.tile(ORGAN, (geometry.organ[0].shape[0], 1))
    colours[geometry.bed[1]] = BED
    return colours


def _colours_of(tissue: str, geometry: Geometry) -> np.ndarray:
    """The colour (3,) of a part, or of the vessels those of their vertices (n, 3)."""
    if tissue != "vessel" or geometry.vessel_kinds is None:
        return np.array(PARTS[tissue])
    return np.array([PARTS[str(kind)] for kind in geometry.vessel_kinds])


def _still(surface: Surface | None, colour: tuple[float, float, float]) -> ShadedSurface | None:
    """A surface that does not move, if there is one."""
    return None if surface is None else ShadedSurface(field_of(surface[0], within=1), surface[1], colour)


def arrow_segments(path: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """The segments (k + 1, 2, 3) of a path (k, 3) and of a tip at its end, whose sides are seen from
    ``toward`` (3,).
    """
    end, back = path[-1], path[-2] - path[-1]
    back = back / np.linalg.norm(back)
    across = np.cross(back, toward)
    across /= max(float(np.linalg.norm(across)), 1e-6)
    sides = np.stack([end + TIP_MM * (back + sign * TIP_SLOPE * across) for sign in (-1.0, 1.0)])
    shaft = np.stack([path[:-1], path[1:]], axis=1)
    return np.concatenate([shaft, np.stack([np.stack([end, end]), sides], axis=1)])


def thinned(line: np.ndarray) -> np.ndarray:
    """Every n-th point of a line (k, ...), so that there are no more than MAX_SCORE."""
    return line[:: max(1, -(-len(line) // MAX_SCORE))]


def closed(line: np.ndarray) -> np.ndarray:
    """The segments (k, 2, 3) of a closed line (k, 3)."""
    return np.stack([line, np.roll(line, -1, axis=0)], axis=1)
