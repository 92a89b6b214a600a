"""The files of a rehearsal for colleagues, numbered as its session: the page, and the parts for 3D views and
printing.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.page.measurement_charts import MeasurementCourse, charts
from rehearsal.page.page_pictures import draw_ct, draw_model, image_png
from rehearsal.page.report_page import ModelView, ReportPage
from rehearsal.page.rest_model import (
    COLOUR,
    KIDNEY,
    SCORE,
    SPECIMEN,
    TUMOUR,
    TUMOUR_OF_SPECIMEN,
    ModelPart,
    glb,
    model_parts,
    printable,
    score_of,
)
from rehearsal.page.session_images import SessionImages
from rehearsal.result_files import counted
from rehearsal.sessions.session_file import read_log
from render.viewer import TextTable
from scenes.anatomy import LoadedAnatomy
from scenes.atomic_files import atomic_write
from scenes.surfaces import save_surface, translated
from scenes.tumour_complexity import complexity

# The specimen is shown so far above its place, as a share of its extent.
LIFTED = 0.9
ASIDE_DEG = 50.0
FRONT, HEAD = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
# A direction with a larger share of the front than this is frontal.
FRONTAL = 0.9
OF_SPECIMEN = SPECIMEN, TUMOUR_OF_SPECIMEN
# Parts as surfaces for printing, by the names of their files.
PRINTED = {"kidney": KIDNEY, "specimen": SPECIMEN, "score": SCORE}


def save_page_files(
    anatomy: DeformedAnatomy,
    loaded: LoadedAnatomy,
    session: Path,
    summary: Mapping[str, Any],
    images: SessionImages,
    resection: dict[str, Any] | None,
    attempts: TextTable,
    remarks: Sequence[str],
) -> list[Path]:
    """Write the page of a recorded session and its surfaces beside the session's file; return them.

    ``summary`` is the session's, ``resection`` has the figures of the present cut, if there is one,
    ``remarks`` are those of ``import_remarks``. Raises OSError, UserError.
    """
    parts = model_parts(anatomy)
    page = page_of(anatomy, loaded, parts, session, summary, images, resection, attempts, remarks)
    number = session.stem.rpartition("-")[2]
    written = [session.with_name(f"report-{number}.html")]
    with atomic_write(written[0]) as partial:
        partial.write_text(page.html(), "utf-8")
    # A kidney that is not cut shows the tumour in it.
    translucent = [KIDNEY] if page.view.translucent else []
    kidney = {name: part for name, part in parts.items() if name not in OF_SPECIMEN}
    specimen = {name: part for name, part in parts.items() if name in OF_SPECIMEN}
    for name, some in (("kidney", kidney), ("specimen", specimen)):
        if some:
            written.append(session.with_name(f"{name}-{number}.glb"))
            with atomic_write(written[-1]) as partial:
                partial.write_bytes(glb(some, translucent))
    for name, part in PRINTED.items():
        if part in parts:
            written.append(session.with_name(f"{name}-{number}.stl"))
            save_surface(printable(parts[part].surface), written[-1])
    return written


def page_of(
    anatomy: DeformedAnatomy,
    loaded: LoadedAnatomy,
    parts: Mapping[str, ModelPart],
    session: Path,
    summary: Mapping[str, Any],
    images: SessionImages,
    resection: dict[str, Any] | None,
    attempts: TextTable,
    remarks: Sequence[str],
) -> ReportPage:
    """The page, as ``save_page_files`` writes it. Raises UserError."""
    case, cut = anatomy.case, anatomy.cut
    towards, view = outward(anatomy), first_view(anatomy, parts)
    of_tumour = complexity(loaded, case.scene.attachment.at_mm)
    surface = None if cut is None else translated(cut.resection_surface(), case.origin)
    shown = images.captioned(has_cut=cut is not None)
    course = MeasurementCourse.of(read_log(session))
    return ReportPage(
        title=case.scene.title,
        model=glb(parts),
        view=view,
        still=draw_model(parts, towards),
        ct=draw_ct(loaded, surface),
        images=[(caption, image_png(image)) for caption, image in shown],
        resection=resection,
        attempts=attempts,
        tumour=[] if of_tumour is None else of_tumour.rows(),
        session=session_rows(anatomy, summary),
        charts=charts(course, case.scene.transducer.compression_warning_mm),
        remarks=remarks,
    )


def outward(anatomy: DeformedAnatomy) -> np.ndarray:
    """The direction (3,) of an eye above the score, or from the tumour's side, or from the front."""
    case, line = anatomy.case, score_of(anatomy)
    if line is not None:
        return line.direction
    if case.tumour is None:
        return FRONT
    direction = case.tumour.center_mass - case.organ.center_mass
    return direction / np.linalg.norm(direction)


def first_view(anatomy: DeformedAnatomy, parts: Mapping[str, ModelPart]) -> ModelView:
    """From outward of tumour or score; after a cut aside of that, so that the lifted specimen does not hide
    the crater.
    """
    towards, cut = outward(anatomy), anatomy.cut
    return ModelView(
        eye=(towards if cut is None else aside(towards)).tolist(),
        colours={name: COLOUR[name] for name in parts},
        translucent=TUMOUR in parts and cut is None,
        lifted=[name for name in parts if name in OF_SPECIMEN],
        lift=towards.tolist(),
        lift_mm=0.0 if cut is None else round(LIFTED * float(cut.specimen.extents.max()), 1),
    )


def aside(towards: np.ndarray) -> np.ndarray:
    """A direction (3,) turned by ASIDE_DEG to the front, or where it is the front, to the head."""
    axis = FRONT if abs(towards @ FRONT) < FRONTAL else HEAD
    across = axis - (axis @ towards) * towards
    angle = np.radians(ASIDE_DEG)
    return np.cos(angle) * towards + np.sin(angle) * across / np.linalg.norm(across)


def session_rows(anatomy: DeformedAnatomy, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The session in a few lines."""
    force_n = summary["force_max_n"]
    force = "" if force_n is None else f"; force on the probe at most {force_n:.1f} N"
    seen = ", ".join(
        f"{'tumour and margin' if name == 'seen_margin' else name.removeprefix('seen_')} {100 * value:.0f} %"
        for name, value in summary.items()
        if name.startswith("seen_")
    )
    pressed = counted(summary["presses"], "press")
    return [
        ("duration", f"{summary['duration_s']:.0f} s simulated, {pressed}"),
        ("probe", anatomy.case.probe.transducer_name),
        ("compression", f"{summary['compression_max_mm']:.1f} mm at most{force}"),
        *([("volume seen", seen)] if seen else []),
    ]
