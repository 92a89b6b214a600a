"""Proposals of a resection: lines on the capsule around tumour and margin, and what a cut along each would
take.
"""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from rehearsal.resection.cut import Cut, CutSettings, check_hilum, cut_organ, grown
from rehearsal.resection.judgement import Carried, Judgement, judge
from rehearsal.resection.score_line import ResectionError, ScoreLine, places_on, score_line
from render.viewer import Technique
from scenes.anatomy import Grid
from scenes.solids import solid_of

MARKS = 16
# The line is this much wider than tumour and margin, so that the walls of the cut are not in the margin.
SLACK_MM = 0.5
# The walls of a wedge are oblique: its line is this much wider.
WEDGE_WIDER_MM = 4.0
# A line's direction is found in so many turns at most, to the first cosine; lines below the second are
# different.
MOST_TURNS, SAME_DIRECTION, DIFFERENT_DIRECTION = 10, 0.9999, 0.99
# Weights, chosen by us: 100 mm2 of opened collecting system, or a vessel of 3 mm, count as 1 ml of
# parenchyma, a missing millimetre of margin as 5 ml, and 1 cm2 of tumour left as 50 ml. A margin counts as
# kept within the last value.
OPENED_ML_MM2, VESSEL_ML_MM2, MISSING_ML_MM, LEFT_ML_MM2, KEPT_WITHIN_MM = 0.01, 0.14, 5.0, 0.5, 0.1


def marks_around(
    organ: trimesh.Trimesh, tumour: trimesh.Trimesh, margin_mm: float, direction: np.ndarray
) -> np.ndarray:
    """Marks (n, 3) [mm] on an organ's surface around a tumour and a margin, seen along a direction (3,)
    out of the organ.
    """
    axes = np.vstack([np.linalg.svd(direction[None])[2][1:], direction])
    points = grown(np.asarray(tumour.vertices), margin_mm + SLACK_MM) @ axes.T
    outline = ConvexHull(points[:, :2])
    middle = outline.points[outline.vertices].mean(axis=0)
    # Distance of the middle from each side of the outline, with the side's normal.
    normals, apart = outline.equations[:, :2], -outline.equations[:, :2] @ middle - outline.equations[:, 2]
    height = float((np.asarray(tumour.vertices) @ direction).mean())
    solid = solid_of(organ, "organ")
    beyond = _beyond(organ, tumour, margin_mm + SLACK_MM)
    above = float((np.asarray(organ.vertices) @ direction).max()) + 1.0
    below = float((np.asarray(organ.vertices) @ direction).min()) - 1.0
    marks = []
    for angle in 2 * np.pi * np.arange(MARKS) / MARKS:
        ray = np.array([np.cos(angle), np.sin(angle)])
        ahead = normals @ ray > 1e-9
        edge = middle + ray * float((apart[ahead] / (normals[ahead] @ ray)).min())
        start, end = np.array([*edge, above]) @ axes, np.array([*edge, below]) @ axes
        hits = solid.ray_cast(start, end)
        if hits:
            marks.append(hits[0].position)
        else:
            # Beside the organ: its nearest place, not on the tumour.
            away = np.linalg.norm(beyond - np.array([*edge, height]) @ axes, axis=1)
            marks.append(beyond[away.argmin()])
    return places_on(organ, np.array(marks))[0]


def _beyond(organ: trimesh.Trimesh, tumour: trimesh.Trimesh, margin_mm: float) -> np.ndarray:
    """The vertices (n, 3) of an organ that are farther from a tumour than a margin [mm]; all where none
    is.
    """
    vertices = np.asarray(organ.vertices, float)
    beyond = vertices[np.linalg.norm(places_on(tumour, vertices)[0] - vertices, axis=1) > margin_mm]
    return beyond if len(beyond) else vertices


def line_around(
    organ: trimesh.Trimesh, tumour: trimesh.Trimesh, margin_mm: float, direction: np.ndarray
) -> ScoreLine:
    """The line around a tumour and a margin, seen along its own direction, which is found from another (3,).

    Raises ResectionError.
    """
    for _ in range(MOST_TURNS):
        line = score_line(organ, marks_around(organ, tumour, margin_mm, direction))
        turned, direction = line.direction @ direction, line.direction
        if turned > SAME_DIRECTION:
            break
    return line


@dataclass(frozen=True)
class Proposal:
    """A cut of the patient at rest, with its figures; ``cost_ml`` is what it takes, in ml of parenchyma."""

    cut: Cut
    judgement: Judgement

    @property
    def settings(self) -> CutSettings:
        """Technique and margin."""
        return self.cut.settings

    @property
    def cost_ml(self) -> float:
        """See ``cost_ml``."""
        return cost_ml(self.judgement, self.settings.margin_mm)


def cost_terms(judgement: Judgement, margin_mm: float) -> dict[str, float]:
    """Parenchyma removed [ml], and what counts as so many ml more: an opened collecting system, divided
    vessels, missing and positive margin.
    """
    missing = max(margin_mm - float(judgement.margin.margin_mm.min()) - KEPT_WITHIN_MM, 0.0)
    return {
        "parenchyma": judgement.parenchyma_removed_ml,
        "collecting system": OPENED_ML_MM2 * (judgement.collecting_system_opened_mm2 or 0.0),
        "vessels": VESSEL_ML_MM2
        * sum(np.pi / 4 * vessel.diameter_mm**2 for vessel in judgement.vessels or ()),
        "missing margin": MISSING_ML_MM * missing,
        "positive margin": LEFT_ML_MM2 * judgement.margin.positive_mm2,
    }


def cost_ml(judgement: Judgement, margin_mm: float) -> float:
    """What a cut takes, in ml of parenchyma: the sum of its ``cost_terms``."""
    return sum(cost_terms(judgement, margin_mm).values())


def why_first(proposals: list[Proposal]) -> str:
    """Why the first of proposals comes before the second, in a sentence; empty where there is no second."""
    if len(proposals) < 2:
        return ""
    first, second = proposals[:2]
    costs = [cost_terms(proposal.judgement, proposal.settings.margin_mm) for proposal in (first, second)]
    differing = [
        f"{name} {a:.1f} points instead of {b:.1f}"
        for (name, a), b in zip(costs[0].items(), costs[1].values(), strict=True)
        if f"{a:.1f}" != f"{b:.1f}"
    ]
    return (
        f"The first, {first.settings.technique}, costs {second.cost_ml - first.cost_ml:.1f} points less "
        "than the next"
        f"{': ' * bool(differing)}{', '.join(differing)}."
    )


def propose(
    organ: trimesh.Trimesh,
    tumour: trimesh.Trimesh,
    parts: Mapping[str, trimesh.Trimesh],
    margin_mm: float,
    labels: Grid | None = None,
    tissues: Mapping[int, str] | None = None,
    hilum: trimesh.Trimesh | None = None,
) -> list[Proposal]:
    """Cuts of an organ at rest around its tumour with a margin [mm], the best first: at most one for each
    technique and direction.

    A cut that removes much of the tissue within ``hilum`` is none. Raises ResectionError where none can be
    made.
    """
    around_tumour: Technique = "enucleation" if margin_mm == 0 else "enucleoresection"
    at_rest = Carried(*(np.asarray(surface.vertices, float) for surface in (organ, organ, organ, tumour)))
    proposals = []
    for technique, wider_mm in ((around_tumour, 0.0), ("wedge", WEDGE_WIDER_MM)):
        for line in _lines(organ, tumour, margin_mm + wider_mm):
            try:
                cut = cut_organ(organ, line, CutSettings(technique, margin_mm), np.asarray(tumour.vertices))
                check_hilum(cut, organ, hilum)
            except ResectionError:
                continue
            carried = replace(
                at_rest, specimen=np.asarray(cut.specimen.vertices), remnant=np.asarray(cut.remnant.vertices)
            )
            judged = judge(cut, organ, tumour, parts, carried, labels, tissues)
            proposals.append(Proposal(cut, judged))
    if not proposals:
        raise ResectionError(
            f"no cut with a margin of {margin_mm:g} mm around this tumour leaves most of the kidney and of "
            "its hilum; choose a smaller margin"
        )
    return sorted(proposals, key=lambda proposal: proposal.cost_ml)


def _lines(organ: trimesh.Trimesh, tumour: trimesh.Trimesh, margin_mm: float) -> list[ScoreLine]:
    """Different lines around a tumour, found from directions on all sides of the organ that are near to
    it.
    """
    outward = places_on(organ, tumour.center_mass[None])[1][0]
    starts = [
        outward,
        *(vertex for vertex in trimesh.creation.icosahedron().vertices if vertex @ outward > 0),
    ]
    lines: list[ScoreLine] = []
    for start in starts:
        with contextlib.suppress(ResectionError):
            line = line_around(organ, tumour, margin_mm, start)
            if all(line.direction @ other.direction < DIFFERENT_DIRECTION for other in lines):
                lines.append(line)
    return lines
