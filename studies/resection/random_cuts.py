"""Random scores and cuts, sensible and absurd ones, each from its own seed: each is refused in words, or
gives two closed bodies and valid tissue.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from errors import UserError
from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.command import Mark
from rehearsal.rehearsal import Rehearsal
from rehearsal.resection.cut import Cut, CutSettings
from rehearsal.resection.operation import cut_command
from rehearsal.resection.proposal import marks_around
from rehearsal.resection.score_line import places_on
from scenes.surfaces import volume_mm3
from studies.harness import positions_of
from studies.resection.planned_cuts import TECHNIQUES
from ultrasound.crater import FILLINGS

CIRCLE_MARKS = 12
MOST_MARGIN_MM, DEPTHS_MM = 8.0, (2.0, 40.0)
# Share of the cuts to a given depth, where a tumour gives one otherwise; standard deviation of displaced
# marks.
GIVEN_DEPTH, DISPLACED_MM = 0.4, 3.0


@dataclass(frozen=True)
class RandomScore:
    """A score and a cut: marks (n, 3) [mm] near the organ's surface, and which vertices (v,) of the tumour
    count as seen.
    """

    kind: str
    marks: np.ndarray
    settings: CutSettings
    seen: np.ndarray


@dataclass(frozen=True)
class ScoredPatient:
    """Surfaces at rest [mm] that scores are set on; ``hilum`` (3,) is a place there."""

    organ: trimesh.Trimesh
    tumour: trimesh.Trimesh | None
    hilum: np.ndarray


Marks = Callable[[ScoredPatient, np.random.Generator], np.ndarray]


def random_score(patient: ScoredPatient, seed: int) -> RandomScore:
    """The score and the cut of a seed."""
    random = np.random.default_rng(seed)
    kinds = [name for name in KINDS if name != "around" or patient.tumour is not None]
    # Every other one is around the tumour, where there is one.
    kind = kinds[0] if seed % 2 == 0 else str(random.choice(kinds))
    marks = KINDS[kind](patient, random)
    return RandomScore(kind, marks, _settings(patient, random), _seen(patient, random))


def _settings(patient: ScoredPatient, random: np.random.Generator) -> CutSettings:
    is_given = patient.tumour is None or random.random() < GIVEN_DEPTH
    return CutSettings(
        technique=TECHNIQUES[random.integers(len(TECHNIQUES))],
        margin_mm=float(random.uniform(0, MOST_MARGIN_MM)),
        depth_mm=float(random.uniform(*DEPTHS_MM)) if is_given else None,
        filling=FILLINGS[random.integers(len(FILLINGS))],
    )


def _seen(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    """All of the tumour, the part on one side of a plane, or none."""
    points = np.zeros((0, 3)) if patient.tumour is None else np.asarray(patient.tumour.vertices)
    along = (points - points.mean(axis=0) if len(points) else points) @ _direction(random)
    reach = np.abs(along).max(initial=0.0)
    return along > random.choice([-1.1, -1.1, -0.3, 0.3, 1.1]) * reach


def _direction(random: np.random.Generator) -> np.ndarray:
    direction = random.normal(size=3)
    return direction / np.linalg.norm(direction)


def _around(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    """Around tumour and margin, seen along a direction that is out of the organ at the tumour or any
    other; marks displaced.
    """
    assert patient.tumour is not None
    middle = np.asarray(patient.tumour.center_mass)
    outward = middle - np.asarray(patient.organ.center_mass)
    turned = random.choice([0.2, 0.2, 2.0]) * _direction(random)
    direction = outward / np.linalg.norm(outward) + turned
    direction /= np.linalg.norm(direction)
    marks = marks_around(patient.organ, patient.tumour, random.uniform(0, MOST_MARGIN_MM), direction)
    return marks + random.choice([0.0, 1.0]) * DISPLACED_MM * random.normal(size=marks.shape)


def _ring(middle: np.ndarray, across: np.ndarray, radius_mm: float, begin: float) -> np.ndarray:
    """Places (n, 3) at a radius about a place, on the plane of two axes (2, 3), from a share of a step on."""
    angle = 2 * np.pi * (np.arange(CIRCLE_MARKS) + begin) / CIRCLE_MARKS
    return middle + radius_mm * np.column_stack([np.cos(angle), np.sin(angle)]) @ across


def _circle(
    organ: trimesh.Trimesh, middle: np.ndarray, radius_mm: float, random: np.random.Generator
) -> np.ndarray:
    """Marks (n, 3) about a radius from a place, across the surface's normal there."""
    place, normal = places_on(organ, middle)
    across = np.linalg.svd(normal)[2][1:]
    return places_on(organ, _ring(place, across, radius_mm, random.random()))[0]


def _anywhere(low_mm: float, high_mm: float) -> Marks:
    """Circles of radii between two at any place, for example far from the tumour."""

    def marks(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
        middle = np.asarray(patient.organ.vertices)[random.integers(len(patient.organ.vertices))]
        return _circle(patient.organ, middle, random.uniform(low_mm, high_mm), random)

    return marks


def _half(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    """Around half of the organ: marks on a plane through it."""
    middle, across = np.asarray(patient.organ.center_mass), np.linalg.svd(_direction(random)[None])[2][1:]
    size = np.ptp(patient.organ.vertices, axis=0).max()
    return places_on(patient.organ, _ring(middle, across, size, 0.0))[0]


def _hilum(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    return _circle(patient.organ, patient.hilum, random.uniform(6, 25), random)


def _crossing(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    """Marks anywhere on the organ: their line is folded, or crosses itself."""
    count = int(random.integers(1, CIRCLE_MARKS))
    return np.asarray(patient.organ.vertices)[random.integers(len(patient.organ.vertices), size=count)]


KINDS: dict[str, Marks] = {
    "around": _around,
    "anywhere": _anywhere(4, 25),
    "tiny": _anywhere(0.05, 3),
    "half": _half,
    "hilum": _hilum,
    "crossing": _crossing,
}


STEPS = 30
VOLUME_BAR = 0.005


@dataclass(frozen=True)
class RandomResult:
    """What came of a random cut: ``refused`` says why it was not made, ``faults`` what is wrong with it."""

    patient: str
    seed: int
    kind: str
    refused: str = ""
    faults: tuple[str, ...] = ()
    specimen_ml: float | None = None
    volume_change_percent: float | None = None

    @property
    def reason(self) -> str:
        """The refusal without its numbers."""
        return re.sub(r"\d+(\.\d+)?", "N", self.refused)


def random_results(patient: str, rehearsal: Rehearsal, seeds: Sequence[int]) -> Iterator[RandomResult]:
    """Make the cut of each seed from the organ at rest, and undo it."""
    scored = scored_patient(rehearsal)
    for seed in seeds:
        score = random_score(scored, seed)
        rehearsal.reset()
        try:
            yield _result(patient, seed, rehearsal, score)
        except Exception as error:  # any other error is a fault, and the next seeds are tried
            fault = f"{type(error).__name__}: {error}"
            yield RandomResult(patient, seed, score.kind, faults=(fault,))


def scored_patient(rehearsal: Rehearsal) -> ScoredPatient:
    """The patient whom scores are set on.

    Its hilum is the middle of the vessels, or the innermost place of the surface.
    """
    case = rehearsal.case
    organ, vessel = case.organ, case.parts.get("vessel")
    if vessel is not None:
        hilum = np.asarray(vessel.vertices).mean(axis=0)
    else:
        vertices = np.asarray(organ.vertices)
        hilum = vertices[np.linalg.norm(vertices - organ.center_mass, axis=1).argmin()]
    return ScoredPatient(organ, case.tumour, hilum)


def _result(patient: str, seed: int, rehearsal: Rehearsal, score: RandomScore) -> RandomResult:
    organ, anatomy = rehearsal.organ, rehearsal.anatomy
    restorations = organ.divergence_check.restorations
    cut_out = cut_command(anatomy, score.settings, lambda points: score.seen)
    try:
        rehearsal.do(Mark(places_mm=score.marks.tolist()), cut_out)
    except UserError as error:
        return RandomResult(patient, seed, score.kind, refused=str(error).partition(": ")[2])
    cut = anatomy.cut
    assert cut is not None
    faults = surface_faults(cut, rehearsal.case.organ)
    for _ in range(STEPS):
        rehearsal.advance(organ.pose)
    rehearsal.show()
    change = volume_change(anatomy, cut)
    if not np.isfinite(positions_of(organ.solver)).all():
        faults.append("positions are not finite")
    if organ.divergence_check.restorations > restorations:
        faults.append("the divergence check restored a state")
    if not abs(change) <= VOLUME_BAR:
        faults.append(f"remnant and specimen have {100 * change:+.2f} % of the organ's volume")
    return RandomResult(
        patient,
        seed,
        score.kind,
        faults=tuple(faults),
        specimen_ml=cut.specimen.volume / 1000,
        volume_change_percent=100 * change,
    )


def surface_faults(cut: Cut, organ: trimesh.Trimesh) -> list[str]:
    """What is wrong with the surfaces of a cut at rest, in words."""
    faults = []
    for name, surface in (("specimen", cut.specimen), ("remnant", cut.remnant)):
        if not surface.is_watertight or surface.volume <= 0:
            faults.append(f"the {name} is not closed")
        pieces = surface.body_count
        if pieces != 1:
            faults.append(f"the {name} has {pieces} pieces")
    total = (cut.specimen.volume + cut.remnant.volume) / organ.volume
    if abs(total - 1) > VOLUME_BAR:
        faults.append(f"specimen and remnant have {100 * total:.2f} % of the organ's volume at rest")
    return faults


def volume_change(anatomy: DeformedAnatomy, cut: Cut) -> float:
    """Relative change of volume since the cut: whole organ then, remnant now and specimen as cut."""
    remnant = volume_mm3(anatomy.vertices, cut.remnant.faces)
    specimen, organ = (
        volume_mm3(anatomy.carried_then(np.asarray(surface.vertices)), surface.faces)
        for surface in (cut.specimen, anatomy.case.organ)
    )
    return (remnant + specimen) / organ - 1


def summary(results: Sequence[RandomResult]) -> str:
    """How many were made and refused, the reasons, and each failure with its seed."""
    reasons = Counter(result.reason for result in results if result.refused)
    failed = [result for result in results if result.faults]
    refused = reasons.total()
    lines = [
        f"{len(results)} random scores: {len(results) - refused} cut, {refused} refused, {len(failed)} failed"
    ]
    lines += [f"  {number:3d} refused: {reason}" for reason, number in reasons.most_common()]
    for result in failed:
        where = f"{result.patient}, seed {result.seed} ({result.kind})"
        lines.append(f"  FAILED {where}: {'; '.join(result.faults)}")
    return "\n".join(lines)
