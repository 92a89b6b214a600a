"""Recognise the tissue and the side of a segment by its name."""

import re
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
    r"brain|skull|face|heart|atri(um|al)|ventric|myocard|lung|pulmon|humerus|clavic|scapula|femur|sacrum|\bhips?\b|"
    r"vertebrae (c\d|t[1-8]\b)|rib (left|right) [1-7]\b|trachea|o?esophagus|thyroid|prostate|bladder|gluteus|"
    r"brachiocephal|subclavian|carotid|sternum|costal|spinal cord|iliac (artery|vena)"
)
# What encloses or carries the patient, and is no organ.
OUTLINE = (
    r"^(whole |outer )?(body|skin|patient|external|outline|contour)( (contour|outline|surface|skin))?( \d+)?$|couch|"
    r"\btable ?(top)?$|^mattress"
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
    """Whether all words of a text are structures and sides, which identify nobody."""
    return all(
        is_understood(word) or is_needless(word) or side_of(word) for word in re.findall(r"[^\W_]+", text)
    )


def side_of(name: str) -> Side | None:
    """The side in a name such as kidney_left or "Kidney R"; None where it has none, or both."""
    plain = _plain(name)
    found = [side for side, pattern in SIDE_OF_NAME if re.search(pattern, plain)]
    return found[0] if len(found) == 1 else None


def _plain(name: str) -> str:
    """Lower case, one space between words: kidneyL, kidney_L and "Kidney-L" become equal."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return re.sub(r"[\W_]+", " ", apart).strip().lower()
