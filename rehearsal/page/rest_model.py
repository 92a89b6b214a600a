"""The anatomy at rest as coloured surfaces (LPS, mm), as GLB for 3D views and STL for printing.

A GLB has the vertices in mm, LPS, and a transform for each node that takes them to glTF's metres, y upward.
"""

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import manifold3d
import numpy as np
import trimesh
from matplotlib.colors import to_rgb

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.resection.cut import Cut
from rehearsal.resection.resection_page import margin_colours
from rehearsal.resection.score_line import LEAST_MARKS, ResectionError, ScoreLine, score_line
from scenes.solids import solid_of, surface_of
from scenes.surfaces import signed_distance_from, translated

KIDNEY, TUMOUR, SCORE = "kidney", "tumour", "score line"
SPECIMEN, TUMOUR_OF_SPECIMEN = "specimen", "tumour in the specimen"
COLOUR = {
    KIDNEY: "#c9877a",
    TUMOUR: "#e8c34a",
    SCORE: "#1f5fd6",
    SPECIMEN: "#d9aaa0",
    TUMOUR_OF_SPECIMEN: "#e8c34a",
}
# Where a tumour protrudes, the kidney's surface is the tumour's, within the error of both.
OVER_TUMOUR_MM = 0.8
# A resection surface where there is no tumour to measure a margin from.
NO_MARGIN = "#8f4a45"
SCORE_RADIUS_MM, SCORE_SIDES = 0.7, 8
# Of what a cut leaves of the tumour in the specimen, less is rounding [mm^3].
LEAST_TUMOUR_MM3 = 1.0
# Vertices of a printed surface that are nearer are one.
MERGED_MM = 0.001
# glTF has x to the patient's left, y to the head, z to the front, in m.
GLTF_FROM_LPS = np.array(
    [[0.001, 0, 0, 0], [0, 0, 0.001, 0], [0, -0.001, 0, 0], [0, 0, 0, 1]],
)
# glTF's colours are linear.
GAMMA = 2.2
TRANSLUCENT = 0.5


@dataclass(frozen=True)
class ModelPart:
    """A closed surface [mm] with a colour (f, 3) for each face, 0 to 1; ``is_cut`` (f,) marks the faces of
    the resection surface.
    """

    surface: trimesh.Trimesh
    colours: np.ndarray
    is_cut: np.ndarray

    @staticmethod
    def plain(surface: trimesh.Trimesh, name: str) -> "ModelPart":
        """A part of one colour."""
        count = len(surface.faces)
        return ModelPart(surface, np.tile(to_rgb(COLOUR[name]), (count, 1)), np.zeros(count, bool))


def model_parts(anatomy: DeformedAnatomy) -> dict[str, ModelPart]:
    """The parts of an anatomy at rest, in the patient (LPS): kidney, tumour and score line, and after a cut
    the specimen and the tumour in it. Raises PatientError.
    """
    case, cut, tumour = anatomy.case, anatomy.cut, anatomy.tumour
    whole = case.organ, np.zeros(len(case.organ.faces), bool)
    remnant = whole if cut is None else (cut.remnant, cut.on_remnant)
    parts = {KIDNEY: _organ_part(KIDNEY, *remnant, case.tumour)}
    if tumour is not None:
        parts[TUMOUR] = ModelPart.plain(tumour, TUMOUR)
    line = score_of(anatomy)
    if line is not None:
        parts[SCORE] = ModelPart.plain(tube(line.points, SCORE_RADIUS_MM), SCORE)
    if cut is not None:
        parts[SPECIMEN] = _organ_part(SPECIMEN, cut.specimen, cut.on_specimen, case.tumour)
        removed = None if case.tumour is None else _tumour_removed(case.tumour, cut)
        if removed is not None:
            parts[TUMOUR_OF_SPECIMEN] = ModelPart.plain(removed, TUMOUR_OF_SPECIMEN)
    return {
        name: ModelPart(translated(part.surface, case.origin), part.colours, part.is_cut)
        for name, part in parts.items()
    }


def score_of(anatomy: DeformedAnatomy) -> ScoreLine | None:
    """The score at rest, relative to the case's origin; None where there is none that can be drawn."""
    if anatomy.cut is not None:
        return anatomy.cut.line
    marks = anatomy.frame.resection.points()
    # A line that cannot be drawn was refused in words already.
    with suppress(ResectionError):
        if len(marks) >= LEAST_MARKS:
            return score_line(anatomy.case.organ, marks)
    return None


def _organ_part(
    name: str, surface: trimesh.Trimesh, is_cut: np.ndarray, tumour: trimesh.Trimesh | None
) -> ModelPart:
    """A surface in the colours of the margin on its resection surface, and of the tumour on its capsule."""
    colours = ModelPart.plain(surface, name).colours
    colours[is_cut] = to_rgb(NO_MARGIN)
    if tumour is not None:
        away = signed_distance_from(tumour, surface.triangles_center)
        colours[~is_cut & (away < OVER_TUMOUR_MM)] = to_rgb(COLOUR[TUMOUR])
        colours[is_cut] = margin_colours(away[is_cut])
    return ModelPart(surface, colours, is_cut)


def _tumour_removed(tumour: trimesh.Trimesh, cut: Cut) -> trimesh.Trimesh | None:
    """The part of the tumour in the specimen, if there is any. Raises PatientError."""
    removed = solid_of(tumour, "tumour") ^ solid_of(cut.specimen, "specimen")
    return surface_of(removed)[0] if removed.volume() > LEAST_TUMOUR_MM3 else None


def tube(points: np.ndarray, radius_mm: float) -> trimesh.Trimesh:
    """A closed surface of a radius around a closed line (k, 3)."""
    ball = manifold3d.Manifold.sphere(radius_mm, SCORE_SIDES)
    pieces = [
        manifold3d.Manifold.batch_hull([ball.translate(start.tolist()), ball.translate(end.tolist())])
        for start, end in zip(points, np.roll(points, -1, axis=0), strict=True)
    ]
    return surface_of(manifold3d.Manifold.batch_boolean(pieces, manifold3d.OpType.Add))[0]


def printable(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    """A closed surface [mm] without the flat triangles that a cut leaves where its edges meet: programs for
    printing would find it open there.
    """
    vertices = np.asarray(surface.vertices)
    _, first, index = np.unique(np.rint(vertices / MERGED_MM), axis=0, return_index=True, return_inverse=True)
    faces = index.ravel()[np.asarray(surface.faces)]
    has_area = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return trimesh.Trimesh(vertices[first], faces[has_area], process=False)


def glb(parts: Mapping[str, ModelPart], translucent: Collection[str] = ()) -> bytes:
    """Parts as a binary glTF, by name, with the normals and colours of their vertices."""
    scene = trimesh.Scene()
    for name, part in parts.items():
        scene.add_geometry(_vertex_coloured(part), name, name, transform=GLTF_FROM_LPS)

    def add_materials(tree: dict[str, Any]) -> None:
        tree["materials"] = [_material(1.0), _material(TRANSLUCENT)]
        for mesh in tree["meshes"]:
            mesh["primitives"][0]["material"] = int(mesh["name"] in translucent)

    return trimesh.exchange.gltf.export_glb(scene, include_normals=True, tree_postprocessor=add_materials)


def _material(opacity: float) -> dict[str, Any]:
    surface = dict(baseColorFactor=[1.0, 1.0, 1.0, opacity], metallicFactor=0.0, roughnessFactor=0.7)
    mode = "OPAQUE" if opacity == 1 else "BLEND"
    return dict(pbrMetallicRoughness=surface, alphaMode=mode, doubleSided=True)


def _vertex_coloured(part: ModelPart) -> trimesh.Trimesh:
    """The surface with colours of vertices: where colours meet, and at the edge of the cut, there is a
    vertex for each.
    """
    surface, faces = part.surface, np.asarray(part.surface.faces)
    kinds, kind = np.unique(np.column_stack([part.colours, part.is_cut]), axis=0, return_inverse=True)
    corners = np.column_stack([faces.ravel(), np.repeat(kind.ravel(), 3)])
    used, index = np.unique(corners, axis=0, return_inverse=True)
    is_cut = kinds[used[:, 1], 3] > 0
    sides = [_normals(surface, part.is_cut == side)[used[:, 0]] for side in (False, True)]
    colours = np.rint(255 * kinds[used[:, 1], :3] ** GAMMA).astype(np.uint8)
    return trimesh.Trimesh(
        np.asarray(surface.vertices)[used[:, 0]],
        index.reshape(-1, 3),
        vertex_normals=np.where(is_cut[:, None], sides[1], sides[0]),
        vertex_colors=np.column_stack([colours, np.full(len(colours), 255, np.uint8)]),
        process=False,
    )


def _normals(surface: trimesh.Trimesh, chosen: np.ndarray) -> np.ndarray:
    """Normals (v, 3) of a surface's vertices by the chosen faces alone."""
    part = trimesh.Trimesh(surface.vertices, np.asarray(surface.faces)[chosen], process=False)
    return np.asarray(part.vertex_normals)
