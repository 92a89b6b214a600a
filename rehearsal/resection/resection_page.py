"""The page of a resection: the margin as a map on the specimen, and its figures; as PNG and JSON."""

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.resection.cut import Cut
from rehearsal.resection.judgement import MARGIN_LIMITS_MM, NOT_LABELLED, Judgement, drawn_mm, shown
from rehearsal.resection.operation import distance_to_tumour, seen_share
from rehearsal.resection.proposal import KEPT_WITHIN_MM
from rehearsal.resection.resection_plan import ResectionPlan, against_plan
from rehearsal.resection.score_line import ResectionError
from rehearsal.result_files import counted, save_figure, write_json
from render.background_image import are_apart, ends_of
from scenes.surfaces import signed_distance_from

# Width of a letter of the compass, whose axes have length 1.
LETTER = 0.35
NAME = "resection"
# Colours of the margin: in the tumour, then up to each limit, then beyond the last.
COLOURS = ("#7a0016", "#e5383b", "#ef8a00", "#ffd60a", "#52b483")
CAPSULE = "#d1caca"
# Views of the specimen along the axes of the score's frame: title, direction from which it is seen, and what
# is up.
VIEWS = (
    ("specimen from below: resection surface", (0, 0, -1), (0, 1, 0)),
    ("specimen from the side", (0, -1, 0), (0, 0, 1)),
)
NEAR_END, FAR_END = "#222222", "#a6a6a6"
TEXT_WIDTH = 40
LIGHT = np.array([0.4, 0.6, 0.7])


def figures_of(
    cut: Cut, judgement: Judgement, tumour: trimesh.Trimesh, seen_percent: float | None = None
) -> dict[str, Any]:
    """The figures of a cut, and how it was made; ``seen_percent`` of the tumour's surface was seen, None
    where no image was.
    """
    settings = cut.settings
    return dict(
        technique=settings.technique,
        margin_asked_mm=settings.margin_mm,
        depth_mm=settings.depth_mm,
        filling=settings.filling,
        tumour_seen_percent=seen_percent,
        score_to_tumour_mm=round(float(distance_to_tumour(cut.line, tumour).min()), 2),
        **judgement.report(),
    )


def report_of(anatomy: DeformedAnatomy, plan: ResectionPlan | None = None) -> dict[str, Any]:
    """The figures of a cut, how it was made, and its comparison with a plan, for ``report.json``.

    Raises ResectionError without a cut.
    """
    cut, judgement, tumour = _judged(anatomy)
    seen_percent = round(100 * seen_share(anatomy), 1)
    compared = {} if plan is None else dict(against_plan=plan.compared(judgement))
    return figures_of(cut, judgement, tumour, seen_percent) | compared


def _judged(anatomy: DeformedAnatomy) -> tuple[Cut, Judgement, trimesh.Trimesh]:
    """The cut of an anatomy, its judgement and the tumour. Raises ResectionError where one is missing."""
    cut, judgement, tumour = anatomy.cut, anatomy.judgement, anatomy.case.tumour
    if cut is None or judgement is None or tumour is None:
        raise ResectionError("nothing was cut, or there is no tumour to judge by")
    return cut, judgement, tumour


def save_page(anatomy: DeformedAnatomy, report: dict[str, Any], out: Path, number: int) -> list[Path]:
    """Write the page and ``report`` of the session of a number into a folder, as ``resection-001.png`` and
    ``resection-001.json``; return them.

    Raises ResectionError, OSError.
    """
    cut, judgement, tumour = _judged(anatomy)
    page, figures = (out / f"{NAME}-{number:03d}.{ending}" for ending in ("png", "json"))
    draw_page(cut, judgement, tumour, report, page, "Resection")
    write_json(report, figures)
    return [page, figures]


def draw_page(
    cut: Cut, judgement: Judgement, tumour: trimesh.Trimesh, report: dict[str, Any], path: Path, title: str
) -> None:
    """Draw the page of a cut with its report as PNG. Raises OSError."""
    figure = Figure(figsize=(13.5, 6.0), facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.03, 0.93, f"{title}: the specimen, coloured by its margin", fontsize=17, weight="bold")
    faces = np.asarray(cut.specimen.vertices)[np.asarray(cut.specimen.faces)]
    colours = _colours(signed_distance_from(tumour, faces.mean(axis=1)), cut)
    for place, (name, eye, up) in enumerate(VIEWS):
        axes = figure.add_axes((0.01 + 0.3 * place, 0.14, 0.3, 0.76), projection="3d")
        seen = _axes(cut, eye, up)
        draw_faces(axes, faces @ seen.T, colours, name)
        draw_compass(figure.add_axes((0.02 + 0.3 * place, 0.12, 0.07, 0.158)), seen)
    lowest = _draw_figures(figure, report)
    _draw_histogram(figure.add_axes((0.67, 0.12, 0.31, min(0.28, lowest - 0.15))), judgement)
    _draw_legend(figure)
    save_figure(figure, path, dpi=110)


def _axes(cut: Cut, eye: tuple[int, int, int], up: tuple[int, int, int]) -> np.ndarray:
    """Rows (3, 3): right, up, and towards the eye."""
    frame, toward, above = cut.line.frame(), np.array(eye, float), np.array(up, float)
    return np.stack([np.cross(above, toward), above, toward]) @ frame


def _colours(distance_mm: np.ndarray, cut: Cut) -> np.ndarray:
    """Colours (f, 3) of the specimen's faces: those of the margin, or of the capsule."""
    colours = margin_colours(distance_mm)
    colours[~cut.on_specimen] = to_rgb(CAPSULE)
    return colours


def margin_colours(distance_mm: np.ndarray) -> np.ndarray:
    """Colours (n, 3) of a resection surface at distances (n,) [mm] from the tumour, negative inside."""
    of_margin = np.array([to_rgb(colour) for colour in COLOURS])
    return of_margin[np.digitize(drawn_mm(distance_mm), [0.0, *MARGIN_LIMITS_MM])]


def draw_faces(axes: Any, faces: np.ndarray, colours: np.ndarray, title: str) -> None:
    """Draw faces (f, 3, 3) in the axes right, up, towards the eye; colours (f, 3), or (f, 4) with opacity."""
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    bright = 0.72 + 0.28 * np.clip(normal @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    seen = normal[:, 2] > 0
    # Matplotlib's axes are x to the right, z up, and y away from the eye.
    placed = np.stack([faces[..., 0], -faces[..., 2], faces[..., 1]], axis=-1)[seen]
    shaded = np.column_stack([colours[:, :3] * bright[:, None], colours[:, 3:]])[seen]
    # Edges of translucent faces would be drawn twice.
    edges = 0.4 if colours.shape[1] == 3 else 0.0
    axes.add_collection3d(Poly3DCollection(placed, facecolors=shaded, edgecolors=shaded, linewidths=edges))
    low, high = placed.min(axis=(0, 1)), placed.max(axis=(0, 1))
    half, middle = (high - low).max() / 2, (high + low) / 2
    axes.set(**{f"{name}lim": (m - half, m + half) for name, m in zip("xyz", middle, strict=True)})
    axes.set_box_aspect((1, 1, 1), zoom=1.45)
    axes.set_proj_type("ortho")
    axes.view_init(elev=0, azim=-90)
    axes.set_axis_off()
    axes.set_title(title, fontsize=12)


def draw_compass(axes: Axes, seen: np.ndarray) -> None:
    """Draw the patient's axes by their letters, for a view's axes right, up, towards the eye (3, 3); ends
    towards the eye are dark.
    """
    ends = ends_of(seen * [[1], [1], [-1]])
    places = np.array([end * (1 + 0.35 / np.linalg.norm(end)) for _, end in ends])
    for rank, shows_letter in enumerate(are_apart(places, LETTER)):
        (letter, end), (x, y) = ends[rank], places[rank]
        colour = NEAR_END if rank >= len(ends) / 2 else FAR_END
        axes.plot([0, end[0]], [0, end[1]], color=colour, linewidth=1.2)
        if shows_letter:
            axes.text(x, y, letter, fontsize=10, color=colour, ha="center", va="center")
    axes.set(xlim=(-1.4, 1.4), ylim=(-1.4, 1.4), aspect="equal")
    axes.set_axis_off()


def _draw_histogram(axes: Axes, judgement: Judgement) -> None:
    """Draw the area of the resection surface by its margin."""
    margin, area = drawn_mm(judgement.margin.distance_mm), judgement.margin.area_mm2
    last = max(MARGIN_LIMITS_MM[-1] + 2, np.ceil(margin.max()))
    edges = np.arange(np.floor(min(margin.min(), 0.0)), last + 0.5, 0.5)
    area_of = np.histogram(margin, edges, weights=area)[0]
    colours = [
        COLOURS[number] for number in np.digitize((edges[:-1] + edges[1:]) / 2, [0.0, *MARGIN_LIMITS_MM])
    ]
    axes.bar(edges[:-1], area_of / 100, width=0.5, align="edge", color=colours)
    axes.set(xlabel="margin, mm (below 0: in the tumour)", ylabel="area, cm2")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _draw_legend(figure: Figure) -> None:
    names = [
        "in the tumour",
        *(f"below {limit:g} mm" for limit in MARGIN_LIMITS_MM),
        f"{MARGIN_LIMITS_MM[-1]:g} mm and more",
    ]
    patches = [
        Patch(color=colour, label=name)
        for colour, name in zip((*COLOURS, CAPSULE), (*names, "capsule"), strict=True)
    ]
    figure.legend(
        handles=patches, loc="lower left", bbox_to_anchor=(0.03, 0.02), ncol=6, frameon=False, fontsize=10
    )


def _draw_figures(figure: Figure, report: dict[str, Any]) -> float:
    """Write the figures, and return the height below the last one, as a share of the page."""
    rows = rows_of(report)
    height = 0.93
    for name, value in rows:
        figure.text(0.62, height, name, fontsize=10.5, color="#555555", va="top")
        lines = textwrap.wrap(value, TEXT_WIDTH)
        figure.text(0.755, height, "\n".join(lines), fontsize=10.5, va="top")
        height -= 0.038 * len(lines)
    return height


def why_less(report: dict[str, Any]) -> list[tuple[str, str]]:
    """Why the least margin is below the one that was asked for, as a row; none where it is not."""
    margin_mm, line, seen = (
        report[name] for name in ("margin_asked_mm", "score_to_tumour_mm", "tumour_seen_percent")
    )
    if report["margin_min_mm"] >= margin_mm - KEPT_WITHIN_MM:
        return []
    reasons = []
    if report["depth_mm"] is not None:
        reasons.append("the depth was set")
    elif report["technique"] == "enucleation":
        reasons.append("an enucleation has no margin")
    elif seen is not None and seen < 100:
        reasons.append("kept only from the tumour surface seen")
    if line < margin_mm:
        reasons.append(f"the score is {line:.1f} mm from the tumour")
    if report["technique"] == "wedge":
        reasons.append("the walls of a wedge are straight")
    return [("less than asked", "; ".join(reasons))] if reasons else []


def rows_of(report: dict[str, Any]) -> list[tuple[str, str]]:
    """Names and values of a report, for the page and the terminal."""
    depth = "to the tumour's depth" if report["depth_mm"] is None else f"{report['depth_mm']:g} mm deep"
    seen = report["tumour_seen_percent"]
    opened, divided = report["collecting_system_opened_mm2"], report["vessels"]
    vessels = [f"{vessel['tissue']} {vessel['diameter_mm']:.1f} mm" for vessel in divided or []]
    cut_vessels = ", ".join(vessels[:3]) + (f" and {len(vessels) - 3} more" if len(vessels) > 3 else "")
    below = ", ".join(f"{report[f'margin_below_{limit:g}_mm2']:.0f}" for limit in MARGIN_LIMITS_MM)
    limits = ", ".join(f"{limit:g}" for limit in MARGIN_LIMITS_MM)
    plan, warnings = report.get("against_plan"), len(report.get("import_warnings", []))
    against = [] if plan is None else [("against the plan", against_plan(plan))]
    return [
        ("technique", f"{report['technique']}, {depth}; {report['filling']} in the crater"),
        *([] if seen is None else [("tumour surface seen", f"{seen:.0f} %")]),
        (
            "margin",
            f"{report['margin_min_mm']:.1f} mm least, {report['margin_mean_mm']:.1f} mm mean; asked "
            f"{report['margin_asked_mm']:g}",
        ),
        *why_less(report),
        (
            "margin, tissue as cut",
            f"{report['margin_min_as_cut_mm']:.1f} mm least, {report['margin_mean_as_cut_mm']:.1f} mm mean",
        ),
        (f"area below {limits} mm", f"{below} mm2"),
        (
            "positive margin",
            f"{shown(report['positive_margin_mm2'], 'mm2')}; tumour left "
            f"{shown(report['tumour_left_ml'], 'ml', 2)}",
        ),
        ("specimen", f"{report['specimen_ml']:.1f} ml"),
        (
            "parenchyma removed",
            f"{report['parenchyma_removed_ml']:.1f} ml, {report['parenchyma_removed_percent']:.1f} % of the "
            "kidney",
        ),
        ("collecting system", NOT_LABELLED if opened is None else f"{opened:.0f} mm2 opened"),
        ("vessels cut", NOT_LABELLED if divided is None else cut_vessels or "none"),
        ("bed", f"{report['bed_mm2'] / 100:.1f} cm2"),
        *against,
        *([("import", f"{counted(warnings, 'warning')} not acknowledged")] if warnings else []),
    ]
