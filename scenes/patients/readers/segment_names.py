"""Recognise the tissue and the side of a segment by its name."""

import re
from collections.abc import Iterable
from typing import Literal

Side = Literal["left", "right"]

# The first match counts: a renal mass is a tumour and a kidney cyst a cyst, not a kidney. "": a known structure that is not modelled.
TISSUE_OF_NAME: tuple[tuple[str, str], ...] = (
    ("", r"adrenal|suprarenal|gall ?bladder|cystic duct|spleen|milz|pancrea|stomach|colon|bowel|duoden|intestin|diaphragm|lymph|skin|\bbody\b|external"),
    ("tumour", r"tumou?r|tumeur|\bmass\b|\bmasse\b|raumforderung|lesion|läsion|neoplas|carcinom|karzinom|cancer|krebs|malignan|\b[cp]?rcc\b|\bgtv"),
    ("cyst", r"\bcysts?\b|zyste|\bkyste|\bquiste"),
    ("stone", r"\bstones?\b|calcul|lithiasis|nierenstein"),
    ("urine", r"collecting|renal pelvis|pelvis renal|pelvical|caly[xc]|calic|ureter|uret[eè]re|urinary|urine|nierenbecken|harn"),
    ("vessel", r"arter(y|ies|ia)? (and|or|und|et) |vessel|vaisseau|gefäß|vascul"),
    ("artery", r"arter|aorta"),
    ("vein", r"\bveins?\b|\bvenen?\b|\bvena\b|\bveine|venous|\bivc\b"),
    ("medulla", r"medulla|pyramid"),
    ("cortex", r"renal cortex|kidney cortex|cortex of (the )?kidney"),
    ("sinus", r"renal sinus|sinus fat"),
    ("kidney", r"kidneys?\b|\brenal\b|\bren\b|\bniere|\breins?\b|\briñ[oó]n"),
    ("liver", r"\bliver\b|hepat|\bleber\b|\bfoie\b"),
    ("bone", r"vertebra|\bribs?\b|\bbones?\b|\bspine\b|sacrum|\bhip\b|femur|sternum|scapula|humerus|clavicula|costal"),
    ("muscle", r"muscle|psoas|autochthon|gluteus|quadratus"),
    ("fat", r"\bfat\b|adipose"),
)  # fmt: skip
# Structures of TotalSegmentator that are too far from a kidney to be in its image.
FAR = (
    r"brain|skull|\bface\b|heart|atri(um|al)|ventric|myocard|lung|pulmon|humerus|clavic|scapula|femur|sacrum|\bhips?\b|"
    r"vertebrae (c\d|t[1-8]\b)|rib (left|right) [1-7]\b|trachea|o?esophagus|thyroid|prostate|bladder|gluteus|"
    r"brachiocephal|subclavian|carotid|sternum|costal|spinal cord|iliac (artery|vena)"
)
# What encloses or carries the patient, and is no organ.
OUTLINE = (
    r"^(whole |outer )?(body|skin|patient|external|outline|contour)( (contour|outline|surface|skin))?( \d+)?$|couch|"
    r"\btable ?(top)?$|^mattress"
)
# Words that are in names of structures, and mean none alone.
BESIDE_STRUCTURES = (
    r"\b(and|of|the|gland|lobe|upper|middle|lower|small|large|inferior|superior|cava|portal|splenic|maximus|medius|minimus|cartilages?|"
    r"[ctls]\d+|segment|label)\b"
)
SIDE_OF_NAME: tuple[tuple[Side, str], ...] = (
    ("left", r"\b(left|lt|l|links|gauche|sinister|sinistra)\b"),
    ("right", r"\b(right|rt|r|rechts|droite?|dexter|dextra)\b"),
)


def tissue_of(name: str) -> str | None:
    """The tissue of ``ultrasound/acoustic_tissues.toml`` that a name means, or None."""
    plain = _plain(name)
    found = next((tissue for tissue, pattern in TISSUE_OF_NAME if re.search(pattern, plain)), "")
    return found or None


def is_understood(name: str) -> bool:
    """Whether a name is of a known structure, modelled or not."""
    return bool(name) and any(re.search(pattern, _plain(name)) for _, pattern in TISSUE_OF_NAME)


def is_far(name: str) -> bool:
    """Whether a name is of a structure far from the kidneys."""
    return re.search(FAR, _plain(name)) is not None


def is_needless(name: str) -> bool:
    """Whether a name is of a structure that an import does not need: far from the kidneys, the body's outline, a couch."""
    return is_far(name) or re.search(OUTLINE, _plain(name)) is not None


def is_anatomy(text: str) -> bool:
    """Whether all words of a text are of structures and sides, which identify nobody; short numbers are no words."""
    plain = _plain(text)
    patterns = [
        *(pattern for _, pattern in (*TISSUE_OF_NAME, *SIDE_OF_NAME)),
        FAR,
        OUTLINE,
        BESIDE_STRUCTURES,
    ]
    known = [found.span() for pattern in patterns for found in re.finditer(pattern, plain)]
    return all(
        any(start < word.end() and word.start() < end for start, end in known)
        for word in re.finditer(r"[^\W\d_]+|\d{4,}", plain)
    )


def names_that_may_identify(names: Iterable[str], place: str) -> dict[str, str]:
    """The names that have other words than structures and sides, such as the patient's, and where they stand."""
    return {name: place for name in names if not is_anatomy(name)}


def side_of(name: str) -> Side | None:
    """The side in a name such as kidney_left or "Kidney R"; None where it has none, or both."""
    plain = _plain(name)
    found = [side for side, pattern in SIDE_OF_NAME if re.search(pattern, plain)]
    return found[0] if len(found) == 1 else None


def _plain(name: str) -> str:
    """Lower case, one space between words: kidneyL, kidney_L and "Kidney-L" become equal."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return re.sub(r"[\W_]+", " ", apart).strip().lower()
