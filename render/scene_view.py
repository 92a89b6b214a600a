"""The 3D view: organ, internal structures, support, transducer and image plane in a GGUI scene.

The scene is a parameter: only window.py imports taichi.ui. Lengths in mm.
"""

import numpy as np

from render import transducer_shape
from render.camera import OrbitCamera
from render.cut_face import CutFace, side_of_eye
from render.plan_lines import PlanLines
from render.surface_shading import CUT_EDGE_MM, GLASS, SOLID, Cut, ShadedSurface
from render.viewer import Geometry, Settings, View
from sim.fields import field_of, fields_of, fill

PLANE_ROWS, PLANE_COLUMNS = 96, 64
KEY_LIGHT, FILL_LIGHT, AMBIENT = (0.82, 0.80, 0.77), (0.17, 0.19, 0.23), (0.17, 0.17, 0.19)
TUMOUR, SUPPORT, EDGE, FRAME = (0.93, 0.76, 0.28), (0.30, 0.33, 0.36), (0.85, 0.9, 0.94), (0.25, 0.77, 1.0)
PARTS = {"cyst": (0.30, 0.60, 0.86), "urine": (0.62, 0.74, 0.33), "vessel": (0.80, 0.16, 0.20)}
LINE_WIDTH = 1.2
MASKS = 5


class SceneView:
    """Fields of the drawn objects; ``draw`` draws them all."""

    def __init__(self, geometry: Geometry, camera: OrbitCamera):
        self.camera = camera
        self._organ = ShadedSurface(geometry.organ_vertices, geometry.organ_faces)
        self._tumour = self._support = None
        self._parts = [
            ShadedSurface(vertices, faces, PARTS[tissue])
            for tissue, (vertices, faces) in geometry.parts.items()
        ]
        if geometry.tumour_vertices is not None and geometry.tumour_faces is not None:
            self._tumour = ShadedSurface(geometry.tumour_vertices, geometry.tumour_faces, TUMOUR)
        if geometry.support_vertices is not None and geometry.support_faces is not None:
            self._support = self._matt_support(geometry.support_vertices, geometry.support_faces)
        self._half_axis_mm = geometry.transducer_size_mm[2] / 2
        self._probe = transducer_shape.transducer(geometry.transducer_size_mm, geometry.transducer_radius_mm)
        self._probe_vertices, self._probe_normals, self._probe_colours = fields_of(*self._probe[:3], within=1)
        self._probe_edges = transducer_shape.edges(geometry.transducer_size_mm, geometry.transducer_radius_mm)
        self._edge_points = field_of(self._probe_edges, within=1)
        self._guide: PlanLines | None = None
        self._cut_face: CutFace | None = None
        self._cut_side = 0.0
        self._plane, self._plane_indices = transducer_shape.image_plane_grid(PLANE_ROWS, PLANE_COLUMNS)
        self._plane_points, self._plane_normals, self._plane_colours = fields_of(
            *np.ones((3, len(self._plane), 3)), within=1
        )
        self._frame_points = field_of(np.zeros((2 * transducer_shape.FRAME_SIDES, 3)), within=1)
        self._mask_points, self._mask_normals, self._mask_colours = fields_of(
            *np.ones((2, 6 * MASKS, 3)), np.zeros((6 * MASKS, 4)), within=1
        )
        self._mask_indices = np.arange(6 * MASKS, dtype=np.int32)

    def _matt_support(self, vertices: np.ndarray, faces: np.ndarray) -> ShadedSurface:
        support = ShadedSurface(field_of(vertices, within=1), faces, SUPPORT, gloss=0.0)
        # It is fixed and matt, so its colours are computed once, as seen from far above.
        above = self.camera.target + 10.0 * self.camera.distance_home * self.camera.up
        support.shade(above, above)
        return support

    def draw(
        self, scene, view: View, settings: Settings, masked: list[tuple[float, float, float, float]]
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
        self._mask(scene, masked)
        if self._support is not None and settings.show_support:
            # A decimated mesh has slivers that face the wrong way, which would appear as black specks.
            _draw_surface(scene, self._support, two_sided=True)
        self._draw_transducer(scene, view.transducer_pose)
        inner = self._inner(view, settings)
        cut = self._draw_cut_face(scene, view, inner, eye, key) if settings.cut else None
        if cut is None:
            self._cut_side = 0.0
            self._draw_inner(scene, inner, eye, key, ahead)
        self._draw_image_plane(scene, view, key)
        if cut is not None:
            self._draw_inner(scene, inner, eye, key, ahead, cut)
        if view.guidance is not None:
            self._guide = self._guide or PlanLines(self._probe_edges)
            self._guide.draw(scene, view.guidance)
        opacity = GLASS if settings.translucent else SOLID
        self._organ.tint(view.seen.get("organ"))
        self._organ.shade(eye, key, opacity, cut)
        _draw_surface(scene, self._organ, ahead if opacity < SOLID or cut is not None else None, cut)

    def _inner(self, view: View, settings: Settings) -> list[ShadedSurface]:
        """Return the shown surfaces inside the organ."""
        shown = list(self._parts) if settings.show_parts else []
        if self._tumour is not None and settings.show_tumour:
            self._tumour.tint(view.seen.get("tumour"))
            shown.append(self._tumour)
        return shown

    def _draw_inner(
        self, scene, inner: list[ShadedSurface], eye, key, ahead: np.ndarray, cut: Cut | None = None
    ) -> None:
        for surface in inner:
            surface.shade(eye, key, SOLID, cut)
            _draw_surface(scene, surface, None if cut is None else ahead, cut)

    def _mask(self, scene, masked) -> None:
        """Draw quads of alpha 0 just behind the near plane: the background stays visible, what is drawn later is hidden."""
        corners = np.full((MASKS, 6, 2), -1.0)
        for quad, (left, bottom, right, top) in zip(corners, masked, strict=False):
            quad[:] = [
                [left, bottom],
                [right, bottom],
                [right, top],
                [left, bottom],
                [right, top],
                [left, top],
            ]
        depth = 1.02 * self.camera.near_far()[0]
        fill((self._mask_points, self.camera.eye() + depth * self.camera.direction(corners.reshape(-1, 2))))
        scene.mesh(
            self._mask_points, self._mask_indices, self._mask_normals, per_vertex_color=self._mask_colours
        )

    def _draw_transducer(self, scene, pose: np.ndarray) -> None:
        probe = self._probe
        fill(
            (self._probe_vertices, transducer_shape.placed(probe.vertices, pose)),
            (self._probe_normals, probe.normals @ pose[:3, :3].T),
            (self._edge_points, transducer_shape.placed(self._probe_edges, pose)),
        )
        scene.mesh(
            self._probe_vertices, probe.indices, self._probe_normals, per_vertex_color=self._probe_colours
        )
        scene.lines(self._edge_points, LINE_WIDTH, color=EDGE)

    def _draw_cut_face(self, scene, view: View, inner: list[ShadedSurface], eye, key) -> Cut:
        """Draw the section and return the cut that removes the half before the eye."""
        self._cut_side = side_of_eye(view.transducer_pose, eye, self._cut_side)
        self._cut_face = self._cut_face or CutFace()
        away, behind = self._cut_side * view.transducer_pose[:3, 1], np.array(view.transducer_pose)
        # The cut is shifted by half its soft edge, which must not be in front of the image.
        behind[:3, 3] -= CUT_EDGE_MM / 2 * away
        self._cut_face.draw(scene, self._organ, inner, behind, key)
        return behind[:3, 3], away

    def _draw_image_plane(self, scene, view: View, key: np.ndarray) -> None:
        face = np.array(view.transducer_pose, dtype=np.float64)
        face[:3, 3] -= face[:3, 2] * self._half_axis_mm
        places = transducer_shape.on_plane(self._plane, view)
        points = transducer_shape.placed(transducer_shape.on_transducer(places), face)
        toward = key - points
        # Normals towards the key light make the plane evenly bright: grey values are those of the image.
        grey = transducer_shape.sampled(next(iter(view.pictures.values())), places, view)
        fill(
            (self._plane_points, points),
            (self._plane_normals, toward / np.linalg.norm(toward, axis=1, keepdims=True)),
            (self._plane_colours, np.repeat(grey[:, None], 3, axis=1)),
            (self._frame_points, transducer_shape.placed(transducer_shape.image_plane_frame(view), face)),
        )
        scene.mesh(
            self._plane_points, self._plane_indices, self._plane_normals, per_vertex_color=self._plane_colours
        )
        scene.lines(self._frame_points, LINE_WIDTH, color=FRAME)


def _draw_surface(
    scene,
    surface: ShadedSurface,
    ahead: np.ndarray | None = None,
    cut: Cut | None = None,
    two_sided=False,
) -> None:
    scene.mesh(
        surface.vertices,
        surface.indices(ahead, cut),
        surface.normal,
        per_vertex_color=surface.colour,
        two_sided=two_sided,
    )
