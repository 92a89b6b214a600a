"""What to do next in each phase of an operation, in words; ``{action}`` stands for the key of an action."""

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.operation import LEAST_SEEN
from rehearsal.resection.resection_view import TOLERANCE_MM, ResectionView
from rehearsal.resection.score_line import LEAST_MARKS
from render.viewer import Phase

# A volume counts as seen from this share of it on.
ENOUGH_SEEN = 0.95
HOW_TO_SCAN = "The probe follows the mouse over the kidney; {press} or {push} presses it in. "
MARKS = (
    "{score_under} on the kidney sets a mark; {score_image} sets two beside the tumour's edges in the image"
)


def hint(
    phase: Phase,
    anatomy: DeformedAnatomy,
    measurements: LiveMeasurements,
    resection: ResectionView,
    settings: CutSettings,
) -> str:
    """What to do next; ``settings`` are those of the next cut."""
    if phase == "Scan":
        return HOW_TO_SCAN + _to_see(anatomy, measurements)
    if anatomy.case.tumour is None:
        return "This patient has no tumour: there is nothing to cut out."
    if anatomy.cut is not None:
        return _after_cut(phase)
    if phase == "Inspect":
        return "Nothing was cut yet. Score the line first, then cut: Score."
    return _to_score(resection, settings) if phase == "Score" else _to_cut(resection, settings)


def _to_see(anatomy: DeformedAnatomy, measurements: LiveMeasurements) -> str:
    if anatomy.scanner is None:
        return ""
    coverage = measurements.coverage
    if anatomy.case.tumour is None:
        return f"Seen of the kidney: {100 * coverage.fraction('organ'):.0f} %."
    around = f"the tumour and {measurements.margin_mm:.0f} mm around it"
    share = coverage.fraction("margin")
    if share < ENOUGH_SEEN:
        turn = "{rotate_left} and {rotate_right} turn the probe."
        return f"See {around} whole, {100 * share:.0f} % so far; {turn}"
    return f"Seen: {around}. Next: Score."


def _to_score(resection: ResectionView, settings: CutSettings) -> str:
    line, count = resection.line, resection.mark_count
    if line is None:
        have = f"{count} of at least {LEAST_MARKS} marks. " if count else "Mark the line around the tumour. "
        return have + (resection.fault + ". " if resection.fault else "") + MARKS
    nearest_mm = resection.tumour_mm.min()
    if nearest_mm < settings.margin_mm - TOLERANCE_MM:
        return (
            f"The line is {nearest_mm:.1f} mm from the tumour where it is red, {settings.margin_mm:.0f} mm "
            "are asked: add a mark outside each red part ({score_under} on the kidney); {undo} takes the "
            "last mark back; {show_resection} asks for less."
        )
    return f"The line keeps {nearest_mm:.1f} mm from the tumour's outline. Next: Excise."


def _to_cut(resection: ResectionView, settings: CutSettings) -> str:
    if resection.line is None:
        return "There is no line to cut along yet: Score comes first."
    if resection.fault:
        return f"This cut is not possible: {resection.fault}."
    if settings.depth_mm is None and resection.seen_share < LEAST_SEEN:
        seen = f"{100 * resection.seen_share:.0f} %"
        return (
            f"Seen of the tumour's surface: {seen}. The cut keeps no margin from the rest: see it first, in "
            "Scan, or choose the depth yourself ({show_resection})."
        )
    depth = "as deep as seen" if settings.depth_mm is None else f"{settings.depth_mm:.0f} mm deep"
    how = f"{settings.technique}, {settings.margin_mm:.0f} mm of margin, {depth}"
    if (nearest_mm := resection.tumour_mm.min()) < settings.margin_mm - TOLERANCE_MM:
        how += f"; the line is nearer, {nearest_mm:.1f} mm at least"
    return f"{{cut_out}} cuts along the line: {how}."


def _after_cut(phase: Phase) -> str:
    again = "{undo} takes the cut back for another attempt."
    if phase == "Inspect":
        return "The figures are those of the cut. {cut} opens the kidney; " + again
    return "The tumour is cut out. Next: Inspect; or " + again
