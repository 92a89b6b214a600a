"""Nephrometry scores of a renal tumour: R.E.N.A.L. and PADUA, from its measured anatomy.

R.E.N.A.L.: Kutikov & Uzzo 2009, J Urol 182, 844. PADUA: Ficarra et al. 2009, Eur Urol 56, 786. Both are read
by eye from CT. Where the papers leave a measure open, the rules are close to the computer-generated scores of
Heller et al. 2022 (J Urol 207, 1105).
"""

from dataclasses import dataclass

from scenes.tumour_anatomy import TumourAnatomy

# A share of the volume below this is an error of the surfaces: the tumour is entirely endophytic.
LEAST_EXOPHYTIC = 0.02
# The tumour is anterior or posterior with this share of its volume in front of the kidney's plane or behind
# it; else x.
FACE_SHARE = 2 / 3
# A tumour this near to sinus or collecting system involves it (Heller et al.).
INVOLVED_MM = 2.0
RENAL_CLASSES = ((6, "low"), (9, "moderate"), (12, "high"))
PADUA_CLASSES = ((7, "low"), (9, "intermediate"), (14, "high"))
NAMES = {"urine": "collecting system", "sinus": "renal sinus"}
NEEDS_HILUM = ("renal sinus",)


@dataclass(frozen=True)
class Component:
    """One component of a score."""

    name: str
    points: tuple[int, ...]
    """Possible points: several where the labels leave it open."""
    measure: float | None
    """What the points are given for; None where it is not known."""
    unit: str
    """"mm", or "share" of the volume, 0 to 1."""
    estimated: bool = False
    needs: tuple[str, ...] = ()
    """The structures whose labels would make the points certain."""


@dataclass(frozen=True)
class NephrometryScore:
    """A score with its components; ``least`` and ``most`` differ where a component is not certain."""

    components: tuple[Component, ...]
    suffix: str
    """Face a, p or x; then h where a main vessel is touched."""
    classes: tuple[tuple[int, str], ...]
    """Greatest total of each class, and its name."""

    @property
    def least(self) -> int:
        return sum(min(component.points) for component in self.components)

    @property
    def most(self) -> int:
        return sum(max(component.points) for component in self.components)

    @property
    def complexity(self) -> str:
        """The class of the total, or the classes that are possible."""
        low, high = (
            next(word for limit, word in self.classes if total <= limit) for total in (self.least, self.most)
        )
        return low if low == high else f"{low} to {high}"

    def __str__(self) -> str:
        total = f"{self.least}" if self.least == self.most else f"{self.least} to {self.most}"
        return f"{total}{self.suffix}"


def renal_score(tumour: TumourAnatomy) -> NephrometryScore:
    """R.E.N.A.L. nephrometry score, 4 to 12 points: low to 6, moderate to 9, high from 10.

    R: diameter, up to 40 mm 1, below 70 mm 2, else 3. E: exophytic share of the volume, from 50 % 1, below 2,
    entirely endophytic 3. N: distance to collecting system or sinus, from 7 mm 1, above 4 mm 2, else 3. L:
    entirely above or below the polar lines 1, across one 2; 3 with more than half of the volume between them,
    or across the midline between them. A: ``face_of``. Suffix h: the tumour touches the main renal artery or
    vein.
    """
    radius = 1 if tumour.diameter_mm <= 40 else 2 if tumour.diameter_mm < 70 else 3
    return NephrometryScore(
        (
            Component("R", (radius,), tumour.diameter_mm, "mm"),
            Component("E", (_exophytic_points(tumour),), tumour.exophytic_share, "share"),
            _nearness(tumour),
            _polar_location(tumour),
        ),
        face_of(tumour) + ("h" if tumour.touches_main_vessel else ""),
        RENAL_CLASSES,
    )


def padua_score(tumour: TumourAnatomy) -> NephrometryScore:
    """PADUA score, 6 to 14 points: low to 7, intermediate to 9, high from 10.

    Location: more than half of the volume between the sinus lines 2, else 1. Exophytic rate: as E. Rim:
    centre of mass on the hilum's side of the polar axis (medial) 2, else 1. Sinus and collecting system:
    involved 2, else 1; that a tumour only displaces the collecting system is not measured. Size: diameter up
    to 40 mm 1, up to 70 mm 2, else 3.
    """
    size = 1 if tumour.diameter_mm <= 40 else 2 if tumour.diameter_mm <= 70 else 3
    face = face_of(tumour)
    return NephrometryScore(
        (
            _sinus_location(tumour),
            Component("exophytic", (_exophytic_points(tumour),), tumour.exophytic_share, "share"),
            _rim(tumour),
            _involvement(tumour, "sinus"),
            _involvement(tumour, "urine"),
            Component("size", (size,), tumour.diameter_mm, "mm"),
        ),
        "" if face == "x" else face,
        PADUA_CLASSES,
    )


def face_of(tumour: TumourAnatomy) -> str:
    """a or p: FACE_SHARE of the volume is in front of, or behind, the plane through polar axis and hilum;
    x: neither; "": not known.
    """
    if tumour.axes.anterior is None:
        return ""
    share = float(((tumour.points - tumour.axes.centre) @ tumour.axes.anterior > 0).mean())
    return "a" if share >= FACE_SHARE else "p" if share <= 1 - FACE_SHARE else "x"


def _exophytic_points(tumour: TumourAnatomy) -> int:
    share = tumour.exophytic_share
    return 1 if share >= 0.5 else 2 if share >= LEAST_EXOPHYTIC else 3


def _nearness(tumour: TumourAnatomy) -> Component:
    """The nearer of sinus and collecting system; one that is not labelled may be nearer still, with more
    points.
    """
    known = {t: tumour.distance_mm[t] for t in ("urine", "sinus") if t in tumour.distance_mm}
    needs = tuple(name for t, name in NAMES.items() if t not in known)
    if not known:
        return Component("N", (1, 2, 3), None, "mm", needs=needs)
    distance = min(known.values())
    points = 1 if distance >= 7 else 2 if distance > 4 else 3
    if len(known) == 2 or points == 3:
        return Component("N", (points,), distance, "mm")
    return Component("N", tuple(range(points, 4)), distance, "mm", needs=needs)


def _polar_location(tumour: TumourAnatomy) -> Component:
    if tumour.axes.polar_lines is None:
        return Component("L", (1, 2, 3), None, "share", needs=NEEDS_HILUM)
    (lower, upper), (lowest, highest) = tumour.axes.polar_lines, tumour.heights_mm
    share, midline = _share_between(tumour, lower, upper), (lower + upper) / 2
    if share > 0.5 or lowest < midline < highest:
        points = 3
    else:
        points = 1 if lowest >= upper or highest <= lower else 2
    return Component("L", (points,), share, "share", tumour.axes.estimated)


def _sinus_location(tumour: TumourAnatomy) -> Component:
    if tumour.axes.sinus_lines is None:
        return Component("location", (1, 2), None, "share", needs=NEEDS_HILUM)
    share = _share_between(tumour, *tumour.axes.sinus_lines)
    estimated = tumour.axes.estimated and "sinus" not in tumour.distance_mm
    return Component("location", (2 if share > 0.5 else 1,), share, "share", estimated)


def _share_between(tumour: TumourAnatomy, lower: float, upper: float) -> float:
    heights = tumour.axes.heights(tumour.points)
    return float(((heights > lower) & (heights < upper)).mean())


def _rim(tumour: TumourAnatomy) -> Component:
    if tumour.axes.hilar is None:
        return Component("rim", (1, 2), None, "mm", needs=NEEDS_HILUM)
    medial = float((tumour.points.mean(axis=0) - tumour.axes.centre) @ tumour.axes.hilar)
    return Component("rim", (2 if medial > 0 else 1,), medial, "mm", tumour.axes.estimated)


def _involvement(tumour: TumourAnatomy, tissue: str) -> Component:
    name, distance = NAMES[tissue], tumour.distance_mm.get(tissue)
    if distance is None:
        return Component(name, (1, 2), None, "mm", needs=(name,))
    return Component(name, (2 if distance <= INVOLVED_MM else 1,), distance, "mm")
