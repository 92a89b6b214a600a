"""The cut: an organ at rest is separated along the score into a specimen and what remains (manifold3d).

The resection surface is the lower side of a convex hull, of the line and of what the technique goes around:

- enucleation: the tumour, along its pseudocapsule;
- enucleoresection: the tumour and a margin;
- wedge: straight walls that meet below the tumour and the margin, in a ridge along the line's longest extent.

The cut never extends beyond the line, seen along the line's direction, but for what the line encloses and
bulges over it: all of a tumour that protrudes from the kidney comes with the specimen. Techniques: Minervini
et al. 2014, "Standardized reporting of resection technique during nephron-sparing surgery: the
Surface-Intermediate-Base margin score" (Eur. Urol. 66:803).
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import manifold3d
import numpy as np
import trimesh
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as checked_dataclass
from skimage.measure import points_in_poly

from rehearsal.resection.score_line import ResectionError, ScoreLine, enclosed_by, places_on
from render.viewer import Technique
from scenes.scene import Attachment
from scenes.solids import solid_of, surface_of
from scenes.surfaces import translated
from ultrasound.crater import Filling

# Longest edge of the triangles of the resection surface; the hull is simplified by at most the second.
EDGE_MM, SIMPLIFIED_MM = 2.0, 0.05
# The cutter extends this far above the organ.
ABOVE_MM = 5.0
# It is this much wider than what bulges over the line, so that it does not graze that.
BESIDE_MM = 1.0
# A floor at a given depth is this part of the line's width.
FLOOR_SHARE = 0.5
LEAST_SPECIMEN_ML, MOST_OF_ORGAN = 0.1, 0.5
# Volume of tissue that is cut off in another place and so stays, from which it is worth a warning.
LEAST_STAYING_ML = 0.05
# Pieces of less volume are rounding: flat, of some 1e-14 [mm^3].
LEAST_PIECE_MM3 = 1e-6
# Less of a part is within the error of its surface [mm^3].
LEAST_LEFT_MM3 = 1.0
# Largest share of the tissue that the hilum's vessels hold that a cut may remove.
MOST_OF_HILUM = 0.25
# A wedge is at most so many times as deep as the tumour and the margin.
STEEPEST = 3.0


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class CutSettings:
    """How the surgeon cuts: by which technique, with which margin [mm] around the tumour, or to a depth [mm]
    below the line where one is given; ``filling`` is what the crater then contains. Raises ValueError for a
    value out of range.
    """

    technique: Technique = "enucleoresection"
    margin_mm: float = Field(default=5.0, ge=0, le=100)
    depth_mm: float | None = Field(default=None, gt=0, le=500)
    filling: Filling = "fluid"


@dataclass(frozen=True)
class Cut:
    """An organ in two, all at rest [mm]; both surfaces are closed and face outward.

    ``on_specimen`` and ``on_remnant`` (f,) mark the faces of each that are of the resection surface.
    """

    line: ScoreLine
    settings: CutSettings
    specimen: trimesh.Trimesh
    remnant: trimesh.Trimesh
    on_specimen: np.ndarray
    on_remnant: np.ndarray
    warnings: tuple[str, ...] = field(default=())

    def resection_surface(self) -> trimesh.Trimesh:
        """The faces of the resection surface, outward of the specimen."""
        return faces_of(self.specimen, self.on_specimen)


def cut_organ(
    organ: trimesh.Trimesh, line: ScoreLine, settings: CutSettings, tumour_points: np.ndarray
) -> Cut:
    """Cut an organ along a line around points (n, 3) [mm] of the tumour's surface as far as it was seen.

    Raises ResectionError.
    """
    whole = solid_of(organ, "organ").as_original()
    cutter = _cutter(organ, line, settings, tumour_points).as_original()
    inner, outer = whole ^ cutter, whole - cutter
    _check_size(inner.volume(), organ.volume)
    pieces = sorted(_pieces(inner), key=lambda piece: _distance_mm(piece, line))
    staying_ml = sum(piece.volume() for piece in pieces[1:]) / 1000
    warnings = []
    if staying_ml > LEAST_STAYING_ML:
        warnings.append(f"the cut would touch the organ in another place too; {staying_ml:.1f} ml there stay")
    specimen = pieces[0]
    # A flat piece, which rounding leaves, would also be a flat slit in the remnant.
    remnant, *separated = _pieces(outer if len(inner.decompose()) == 1 else whole - specimen)
    if separated:
        # What the cut separates from the organ elsewhere, such as the rim of a tumour on a stalk, comes with
        # the specimen.
        specimen = _pieces(whole - remnant)[0]
    _check_size(specimen.volume(), organ.volume)
    own, of_own = surface_of(specimen)
    rest, of_rest = surface_of(remnant)
    capsule = whole.original_id()
    return Cut(line, settings, own, rest, of_own != capsule, of_rest != capsule, tuple(warnings))


def hilum_of(attachment: Attachment, origin: np.ndarray) -> trimesh.Trimesh | None:
    """The ball that a scene's attachment holds, relative to an origin (3,) [mm, LPS]; None where it holds
    nothing.
    """
    if attachment.at_mm is None or attachment.radius_mm == 0:
        return None
    return translated(
        trimesh.creation.icosphere(radius=attachment.radius_mm), np.array(attachment.at_mm) - origin
    )


def check_hilum(cut: Cut, organ: trimesh.Trimesh, hilum: trimesh.Trimesh | None) -> None:
    """Raises ResectionError where the specimen would contain much of an organ's tissue around its hilum."""
    if hilum is None:
        return
    around = solid_of(hilum, "hilum")
    removed, whole = ((solid_of(surface, "organ") ^ around).volume() for surface in (cut.specimen, organ))
    if removed > MOST_OF_HILUM * whole:
        raise ResectionError(
            f"the cut removes {removed / whole:.0%} of the tissue around the hilum, where the kidney's "
            "vessels enter; set the score "
            "nearer to the tumour"
        )


def _pieces(solid: manifold3d.Manifold) -> list[manifold3d.Manifold]:
    """The separate pieces of a solid, the largest first.

    Rounding of a Boolean operation leaves flat ones, which are none.
    """
    pieces = [piece for piece in solid.decompose() if piece.volume() > LEAST_PIECE_MM3]
    return sorted(pieces, key=lambda piece: -piece.volume())


def _distance_mm(piece: manifold3d.Manifold, line: ScoreLine) -> float:
    """Mean distance [mm] of a line's points from a solid's surface."""
    near = places_on(surface_of(piece)[0], line.points)[0]
    return float(np.linalg.norm(near - line.points, axis=1).mean())


def _check_size(volume_mm3: float, organ_mm3: float) -> None:
    """Raises ResectionError for a specimen that is next to nothing, or most of the organ."""
    if volume_mm3 < 1000 * LEAST_SPECIMEN_ML:
        raise ResectionError(
            f"the cut removes only {volume_mm3 / 1000:.2f} ml; set the score farther around the tumour, or "
            "cut deeper"
        )
    if volume_mm3 > MOST_OF_ORGAN * organ_mm3:
        raise ResectionError(
            f"the cut removes {volume_mm3 / organ_mm3:.0%} of the organ, expected at most "
            f"{MOST_OF_ORGAN:.0%}: a partial nephrectomy "
            "leaves most of it; set the score nearer to the tumour"
        )


def _cutter(
    organ: trimesh.Trimesh, line: ScoreLine, settings: CutSettings, tumour_points: np.ndarray
) -> manifold3d.Manifold:
    """The solid that is cut out, which extends above the organ."""
    axes, middle = line.frame(), line.points.mean(axis=0)
    rim = (line.points - middle) @ axes.T
    top = float(((np.asarray(organ.vertices) - middle) @ axes.T)[:, 2].max()) + ABOVE_MM
    around = (tumour_points - middle) @ axes.T
    below = _below(rim, settings, around)
    outline = _outline([rim])
    enclosed = (organ.triangles[enclosed_by(organ, line)].view(np.ndarray) - middle) @ axes.T
    bulge = _bulge(enclosed, outline)
    edge = [rim, below, grown(bulge.reshape(-1, 3), BESIDE_MM)]
    raised = [np.column_stack([points[:, :2], np.full(len(points), top)]) for points in edge]
    hull = manifold3d.Manifold.hull_points(np.concatenate([*edge, *raised]))
    outline += _outline(bulge).offset(BESIDE_MM, manifold3d.JoinType.Round)
    column = outline.extrude(2 * top - below[:, 2].min())
    cutter = hull ^ column.translate([0.0, 0.0, below[:, 2].min() - top / 2])
    placed = np.column_stack([axes.T, middle])
    return cutter.simplify(SIMPLIFIED_MM).refine_to_length(EDGE_MM).transform(placed)


def _bulge(enclosed: np.ndarray, outline: manifold3d.CrossSection) -> np.ndarray:
    """The triangles (n, 3, 3) of a surface that are beyond the line's outline by more than BESIDE_MM,
    along the axes of the line.
    """
    around = outline.offset(BESIDE_MM, manifold3d.JoinType.Round).to_polygons()[0]
    seen = points_in_poly(enclosed[:, :, :2].reshape(-1, 2), around)
    return enclosed[~seen.reshape(-1, 3).all(axis=1)]


def _outline(polygons: Iterable[np.ndarray]) -> manifold3d.CrossSection:
    """The union of closed polygons (k, 3), seen along the third axis; either way round."""
    sections = [
        manifold3d.CrossSection([polygon[:, :2]], manifold3d.FillRule.NonZero) for polygon in polygons
    ]
    return manifold3d.CrossSection.batch_boolean(sections, manifold3d.OpType.Add)


def _below(rim: np.ndarray, settings: CutSettings, tumour: np.ndarray) -> np.ndarray:
    """Points (n, 3) under the rim (k, 3) that the resection surface goes around, along the axes of the line.

    Raises ResectionError.
    """
    if settings.depth_mm is None and len(tumour) == 0:
        raise ResectionError(
            "no part of the tumour was seen in the image, so that the depth of the cut is not known; sweep "
            "the probe over the tumour "
            "first, or set a depth"
        )
    is_wedge = settings.technique == "wedge"
    if settings.depth_mm is not None:
        if is_wedge:
            return _ridge(rim, -settings.depth_mm)
        return np.column_stack([FLOOR_SHARE * rim[:, :2], np.full(len(rim), -settings.depth_mm)])
    margin_mm = 0.0 if settings.technique == "enucleation" else settings.margin_mm
    around = grown(tumour, margin_mm)
    return _ridge(rim, _ridge_height(rim, around)) if is_wedge else around


def grown(points: np.ndarray, by_mm: float) -> np.ndarray:
    """Points whose convex hull contains all balls of a radius [mm] around points (n, 3), by 5 % of it more
    at most.
    """
    if by_mm == 0:
        return points
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.vertices /= np.abs(np.einsum("ij,ij->i", ball.triangles_center, ball.face_normals)).min()
    # Only corners of the hull of the points can be corners of the larger one.
    return (points[:, None] + by_mm * ball.vertices).reshape(-1, 3)


def _ridge(rim: np.ndarray, height: float) -> np.ndarray:
    """The ends (2, 3) of a wedge's ridge at a height: as much shorter than the line as that is wide."""
    centre, length, _ = _roof(rim)
    return np.array([[centre[0] - length, centre[1], height], [centre[0] + length, centre[1], height]])


def _roof(rim: np.ndarray) -> tuple[np.ndarray, float, float]:
    """The centre (2,) of a line's extent, half of the length of the ridge over it, and half of its width."""
    half = np.ptp(rim[:, :2], axis=0) / 2
    return rim[:, :2].min(axis=0) + half, max(half[0] - half[1], 0.0), max(half[1], 1e-6)


def _ridge_height(rim: np.ndarray, around: np.ndarray) -> float:
    """The height of the ridge at which straight walls from the rim contain points (n, 3), as far as the
    rim is wide enough.
    """
    centre, length, half_width = _roof(rim)
    # Distance from the axis of the ridge, as a share of the rim's: at a depth d walls are at 1 - d / depth of
    # it.
    along = np.abs(around[:, 0] - centre[0])
    aside = np.hypot(np.maximum(along - length, 0.0), around[:, 1] - centre[1]) / half_width
    depth = np.maximum(-around[:, 2], 0.0)
    needed = depth / np.maximum(1.0 - aside, 1e-6)
    return -float(min(needed.max(), STEEPEST * depth.max()))


def faces_of(surface: trimesh.Trimesh, chosen: np.ndarray) -> trimesh.Trimesh:
    """The chosen faces (f,) of a surface."""
    part = trimesh.Trimesh(surface.vertices, np.asarray(surface.faces)[chosen], process=False)
    part.remove_unreferenced_vertices()
    return part


def part_left(part: trimesh.Trimesh, cut: Cut | None, is_within: bool = False) -> trimesh.Trimesh | None:
    """The surface of what a cut leaves of a part of the organ; None where next to nothing is left. Raises
    PatientError.

    What is outside of the organ stays, as of vessels at the hilum; for a part ``is_within`` the organ, that
    is the error of its surface.
    """
    if cut is None:
        return part
    solid = solid_of(part, "part")
    left = solid ^ solid_of(cut.remnant, "organ") if is_within else solid - solid_of(cut.specimen, "specimen")
    return surface_of(left)[0] if left.volume() > LEAST_LEFT_MM3 else None


def part_cut_out(part: trimesh.Trimesh, cut: Cut) -> trimesh.Trimesh | None:
    """The surface of what a cut takes of a part within the organ; None where that is next to nothing. Raises
    PatientError.
    """
    out = solid_of(part, "part") ^ solid_of(cut.specimen, "specimen")
    return surface_of(out)[0] if out.volume() > LEAST_LEFT_MM3 else None
