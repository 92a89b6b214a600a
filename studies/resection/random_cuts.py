"""Random scores and cuts: each is refused in words, or gives two closed bodies and valid tissue."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.command import Mark
from rehearsal.rehearsal import Rehearsal
from rehearsal.resection.cut import Cut
from rehearsal.resection.operation import cut_command
from scenes.surfaces import volume_mm3
from studies.harness import positions_of
from studies.resection.random_scores import RandomScore, ScoredPatient, random_score

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
    frame = rehearsal.do(Mark(places_mm=score.marks.tolist()), cut_out)
    if anatomy.cut is None:
        return RandomResult(patient, seed, score.kind, refused=frame.notices[0])
    cut = anatomy.cut
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
        volume_mm3(anatomy.carried_then(np.asarray(each.vertices)), each.faces)
        for each in (cut.specimen, anatomy.case.organ)
    )
    return (remnant + specimen) / organ - 1


def summary(results: Sequence[RandomResult]) -> str:
    """How many were made and refused, the reasons, and each failure with its seed."""
    made = [each for each in results if not each.refused]
    failed = [each for each in results if each.faults]
    lines = [
        f"{len(results)} random scores: {len(made)} cut, {len(results) - len(made)} refused, "
        f"{len(failed)} failed"
    ]
    reasons = Counter(each.reason for each in results if each.refused)
    lines += [f"  {number:3d} refused: {reason}" for reason, number in reasons.most_common()]
    lines += [
        f"  FAILED {each.patient}, seed {each.seed} ({each.kind}): {'; '.join(each.faults)}"
        for each in failed
    ]
    return "\n".join(lines)
