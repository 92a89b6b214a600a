"""Random scores and cuts of a patient, sensible and absurd ones, each from its own seed."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from rehearsal.resection.cut import CutSettings
from rehearsal.resection.proposal import marks_around
from rehearsal.resection.score_line import places_on
from studies.resection.cut_lines import TECHNIQUES
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


def _circle(
    organ: trimesh.Trimesh, middle: np.ndarray, radius_mm: float, random: np.random.Generator
) -> np.ndarray:
    """Marks (n, 3) about a radius from a place, across the surface's normal there."""
    place, normal = places_on(organ, middle)
    across = np.linalg.svd(normal)[2][1:]
    angle = 2 * np.pi * (np.arange(CIRCLE_MARKS) + random.random()) / CIRCLE_MARKS
    ring = place + radius_mm * np.column_stack([np.cos(angle), np.sin(angle)]) @ across
    return places_on(organ, ring)[0]


def _anywhere(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    """A circle at any place, for example far from the tumour."""
    middle = np.asarray(patient.organ.vertices)[random.integers(len(patient.organ.vertices))]
    return _circle(patient.organ, middle, random.uniform(4, 25), random)


def _tiny(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    middle = np.asarray(patient.organ.vertices)[random.integers(len(patient.organ.vertices))]
    return _circle(patient.organ, middle, random.uniform(0.05, 3), random)


def _half(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    """Around half of the organ: marks on a plane through it."""
    middle, across = np.asarray(patient.organ.center_mass), np.linalg.svd(_direction(random)[None])[2][1:]
    angle = 2 * np.pi * np.arange(CIRCLE_MARKS) / CIRCLE_MARKS
    size = np.ptp(patient.organ.vertices, axis=0).max()
    ring = middle + size * np.column_stack([np.cos(angle), np.sin(angle)]) @ across
    return places_on(patient.organ, ring)[0]


def _hilum(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    return _circle(patient.organ, patient.hilum, random.uniform(6, 25), random)


def _crossing(patient: ScoredPatient, random: np.random.Generator) -> np.ndarray:
    """Marks anywhere on the organ: their line is folded, or crosses itself."""
    count = int(random.integers(1, CIRCLE_MARKS))
    return np.asarray(patient.organ.vertices)[random.integers(len(patient.organ.vertices), size=count)]


Marks = Callable[[ScoredPatient, np.random.Generator], np.ndarray]
KINDS: dict[str, Marks] = {
    "around": _around,
    "anywhere": _anywhere,
    "tiny": _tiny,
    "half": _half,
    "hilum": _hilum,
    "crossing": _crossing,
}
