"""Complexity of a renal tumour: its measures and scores, in lines of text and as figures for a report."""

from dataclasses import dataclass
from typing import Any

from scenes.anatomy import LoadedAnatomy
from scenes.nephrometry import Component, NephrometryScore, face_of, padua_score, renal_score
from scenes.scene import Vector3
from scenes.tumour_anatomy import TumourAnatomy, tumour_anatomy

WORD = {"urine": "collecting system"}
DIGITS = 3


@dataclass(frozen=True)
class Complexity:
    """The measures of a tumour, and the scores that they give."""

    tumour: TumourAnatomy
    renal: NephrometryScore
    padua: NephrometryScore

    @property
    def estimated(self) -> list[str]:
        """What depends on the hilar concavity, because no sinus is labelled."""
        names = [component.name for component in self._components if component.estimated]
        return names + (["a/p"] if self.tumour.axes.estimated and face_of(self.tumour) else [])

    @property
    def not_known(self) -> list[str]:
        """What the labels leave open."""
        names = [component.name for component in self._components if component.needs]
        names += [] if face_of(self.tumour) else ["a/p"]
        return names + (["h"] if self.tumour.touches_main_vessel is None else [])

    @property
    def labels_needed(self) -> list[str]:
        """The structures whose labels would show what is not known."""
        needed = [name for component in self._components for name in component.needs]
        needed += ["renal artery and vein"] if self.tumour.touches_main_vessel is None else []
        return list(dict.fromkeys(needed))

    @property
    def _components(self) -> tuple[Component, ...]:
        return (*self.renal.components, *self.padua.components)

    def rows(self) -> list[tuple[str, str]]:
        """Lines for the terminal and the check image: a title and a text each."""
        tumour = self.tumour
        share, several = 100 * tumour.exophytic_share, f"; largest of {tumour.tumours} tumours"
        size = f"{tumour.diameter_mm:.0f} mm, {share:.0f} % exophytic, contact {tumour.contact_cm2:.1f} cm2"
        near = ", ".join(f"{WORD.get(tissue, tissue)} {mm:.1f}" for tissue, mm in tumour.distance_mm.items())
        rows = [
            ("size", size + (several if tumour.tumours > 1 else "")),
            ("distance", f"{near} mm"),
            ("R.E.N.A.L.", _in_words(self.renal, measures=True)),
            ("PADUA", _in_words(self.padua, measures=False)),
            ("estimated", f"{', '.join(self.estimated)}, from the hilar concavity; label the renal sinus"),
            ("not known", f"{', '.join(self.not_known)}; label the {', '.join(self.labels_needed)}"),
        ]
        shown = {"distance": near, "estimated": self.estimated, "not known": self.not_known}
        return [row for row in rows if shown.get(row[0], True)]

    def figures(self) -> dict[str, Any]:
        """The same for a report: lengths in mm, shares 0 to 1; None for what is not known."""
        tumour = self.tumour
        return dict(
            tumours=tumour.tumours,
            diameter_mm=round(tumour.diameter_mm, DIGITS),
            volume_ml=round(tumour.volume_ml, DIGITS),
            exophytic_share=round(tumour.exophytic_share, DIGITS),
            contact_cm2=round(tumour.contact_cm2, DIGITS),
            distance_mm={
                WORD.get(tissue, tissue): round(mm, DIGITS) for tissue, mm in tumour.distance_mm.items()
            },
            touches_main_vessel=tumour.touches_main_vessel,
            renal=_figures(self.renal),
            padua=_figures(self.padua),
            estimated=self.estimated,
            not_known=self.not_known,
            labels_needed=self.labels_needed,
        )


def complexity(anatomy: LoadedAnatomy, hilum_mm: Vector3 | None) -> Complexity | None:
    """The complexity of a kidney's largest tumour; None without a tumour.

    ``hilum_mm``: for where no sinus is labelled.
    """
    if anatomy.tumour is None:
        return None
    tumour = tumour_anatomy(
        anatomy.organ, anatomy.tumour, anatomy.parts, anatomy.labels, anatomy.tissues, hilum_mm
    )
    return Complexity(tumour, renal_score(tumour), padua_score(tumour))


def _in_words(score: NephrometryScore, measures: bool) -> str:
    return f"{score}, {score.complexity}: " + ", ".join(
        _component(component, measures) for component in score.components
    )


def _component(component: Component, measures: bool) -> str:
    points = "-".join(str(n) for n in sorted({component.points[0], component.points[-1]}))
    if component.measure is None or not measures:
        return f"{component.name} {points}"
    measure = f"{component.measure:.1f} mm" if component.unit == "mm" else f"{100 * component.measure:.0f} %"
    return f"{component.name} {points} ({measure})"


def _figures(score: NephrometryScore) -> dict[str, Any]:
    return dict(
        least=score.least,
        most=score.most,
        suffix=score.suffix,
        complexity=score.complexity,
        components={
            component.name: dict(
                points=list(component.points),
                measure=None if component.measure is None else round(component.measure, DIGITS),
                unit=component.unit,
                estimated=component.estimated,
            )
            for component in score.components
        },
    )
