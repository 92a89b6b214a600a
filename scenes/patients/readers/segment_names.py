"""Recognise the tissue and the side of a segment by its name, and structures that are derived from others
for planning.
"""

import re
import unicodedata
from typing import Literal

from scenes.tissue_classes.tissue_map import TISSUES

Side = Literal["left", "right"]

# Patterns are for plain names (``_plain``): lower case, without accents, one space between words. The first
# match counts: a renal mass is a tumour and a kidney cyst a cyst, not a kidney. "": a known structure that is
# not modelled. English, and the words of German, French,
# Spanish, Italian, Portuguese, Dutch, Chinese and Japanese that segments are commonly named with.
TISSUE_OF_NAME: tuple[tuple[str, str], ...] = (
    ("", r"adrenal|suprarenal|gall ?bladder|cystic "
         r"duct|spleen|splen|milz|\bbazo\b|pancrea|stomach|colon|bowel|duoden|intestin|diaphragm|lymph(?!om)|skin|\bbody\b|external"),
    ("tumour",
    r"tum(o|ou|eu)r|\bmass(es|e|a)?\b|\bmasas?\b|raumforderung|l(e|a|ae)sion|lesao|lesoes|laesie|neoplas|neoform|neubild|geschwulst|carcino|karzin|cancer|cancro|krebs|malign|"
               r"sar[ck]om|blastom|lymphom|metasta|adenom|nodul|knoten|nephrom|angiomyolip|\bamls?\b|on[ck]o[cz]yt|\b(cc|p|ch|nc)?rcc\b|\bgtv|肿瘤|腫瘍|腫瘤|肿块"),
    ("cyst", r"\bcysts?\b|zyste|\bkystes?\b|\bquistes?\b|\bcisti\b|\bcistos?\b|\bcysten?\b|bosniak|囊肿|嚢胞"),
    ("stone", r"\bstones?\b|calcul|lithiasis|litiasi|nierenstein|\bpiedras?\b|结石|結石"),
    ("urine", r"collecting|(kidney|renal) pelvis|pelvis (kidney|renal|of the kidney)|pelvi "
            r"renal|pelvical|caly[xc]|calic|ureter|urinary|urine|pyelo|bassinet|nierenbecken|kelch|harn|输尿管|尿管|肾盂|腎盂"),
    ("vessel", r"arter(y|ies|ia)? (and|or|und|et) |vessel|vaisseau|gefa(e|s)?s|vascul|血管"),
    ("artery", r"arter|aorta|动脉|動脈"),
    ("vein", r"\bveins?\b|\bvenen?\b|nierenvene|\bvenas?\b|\bveine|\bveias?\b|venous|\bivc\b|静脉|静脈"),
    ("medulla", r"medulla|pyramid"),
    ("cortex", r"renal cortex|kidney cortex|cortex of (the )?kidney"),
    ("sinus", r"(kidney|renal) sinus|sinus (fat|renal|of the kidney)|nierensinus"),
    ("fat", r"(peri|para)(renal|nephric) fat"),
    ("", r"fascia|gerota|(peri|para)(renal|nephr)|(kidney|renal|nephrectomy) "
         r"(bed|capsule|hilum|hilus|space)\b"),
    ("kidney",
    r"kidneys?\b|\brenal\b|\bren\b|\brene\b|\breni\b|\brenes\b|\bniere|\bnier\b|\breins?\b|\brinon(es)?\b|\brim (direito|esquerdo)\b|\brins\b|肾|腎"),
    ("liver", r"\bliver\b|hepat|\bleber\b|\bfoie\b|\bhigado\b|\bfigado\b|\bfegato\b|肝"),
    ("bone",
    r"vertebr|\bribs?\b|\bbones?\b|\bspine\b|sacrum|\bhip\b|femur|sternum|scapula|humerus|clavicula|costal|knochen|wirbel"),
    ("muscle", r"muscle|muskel|psoas|autochthon|gluteus|quadratus"),
    ("fat", r"\bfat\b|adipose|fett"),
)  # fmt: skip
# The program's own names, as a class image has them.
OWN_NAMES = {tissue.replace("-", " "): tissue for tissue in TISSUES}
# Structures of TotalSegmentator that are too far from a kidney to be in its image.
FAR = (
    r"brain|skull|\bface\b|heart|atri(um|al)|ventric|myocard|lung|pulmon|humerus|clavic|scapula|femur|sacrum|\bhips?\b|"
    r"vertebrae (c\d|t[1-8]\b)|rib (left|right) "
    r"[1-7]\b|trachea|(o|oe)?esophagus|thyroid|prostate|bladder|gluteus|"
    r"brachiocephal|subclavian|carotid|sternum|costal|spinal cord|iliac (artery|vena)"
)
# What encloses or carries the patient, and is no organ.
OUTLINE = (
    r"^(whole |outer )?(body|skin|patient|external|outline|contour)( "
    r"(contour|outline|surface|skin))?( \d+)?$|couch|"
    r"\btable ?(top)?$|^mattress"
)
# Structures that are derived from others by a margin or for the planning of a treatment, as TG-263 (doi
# 10.1016/j.ijrobp.2017.12.013) and its users name them, and by the atlas of a class image: PRV, CTV, PTV,
# ITV, a "z" before the name for optimisation, "~" for a part. A GTV is the tumour itself.
DERIVED = (
    r"\b(prv|(i ?)?[cp]tv|itv|i ?gtv)|bounding box|normal tissue|"
    r"\b(ring|rind|opt(i|im|imi[sz]\w+)?|margins?|bbox|exp(and\w*|ansion)?|dil(at\w+)?|ero(ded|sion)|shr[iu]nk\w*|grow\w*|shell|hull|halo|"
    r"avoid(ance)?|eval|cropp?(ed)?|(iso)?dose)\d*\b"
)
DERIVED_SIGNS = r"^z(?=[A-Z_ ])|^_|~|\(drawn\)$|\+\s*\d|-\s*\d+([.,]\d+)?\s*(mm|cm)\b"
# Of a kidney's name: the width of a margin. Of a tumour's it is the size.
MARGIN = r"\d ?[mc]m\b"
# A kidney with or without its tumour, such as "Kidney_L-GTV", "kidney w/o mass", "Kidney + tumour": first the
# kidney, then the tumour.
COMPOSITE = r"(?i)(.+?)(\bwith(out)?\b|\bw/o?\b|\bminus\b|\b(in|ex)cl\w*|\bohne\b|\bmit\b|\bsans\b|\bavec\b|\band\b|\bund\b|\bet\b|[+&]|\s[-–]\s|[-–](?=i?gtv))(.+)"
# Organs whose lesions are not the kidney's, where a name has no word for a kidney.
OTHER_ORGANS = (
    r"\bliver|hepat|leber|foie|higado|figado|fegato|spleen|splen|milz|pancrea|colon|bowel|lung|pulmon|\bbone|knochen|osse(a|us)|vertebr|\bspine|spinal|"
    r"\brib\b|brain|breast|thyroid|prostat|bladder|stomach|ovar|uter(us|ine)|thalam|\bskin"
)
SIDE_OF_NAME: tuple[tuple[Side, str], ...] = (
    ("left", r"\b(left|lt|l|links|linke[nrs]?|gauche|sinister|sinistr[aeo]|izquierd[ao]s?|esquerd[ao])\b|左"),
    (
        "right",
        r"\b(right|rt|r|rechts|rechte[nrs]?|droite?|dexter|dextra|destr[aeo]|derech[ao]s?|direit[ao])\b|右",
    ),
)
# The words of names that say nothing but a kidney, its side or its parts.
KIDNEY_WORDS = frozenset(
    re.findall(
        r"\w+",
        """
    a all and both cortex droit droite gauche kidney kidneys l label left links lower lt middle native niere nieren normal of organ parenchyma part pole r
    rechts rein ren renal rene right rt segment the total upper whole
    """,
    )
)
WITHHELD = "“...”"
LEAST_DIGITS = 4
# The words that names of segments may have in a patient's folder; a name with another word may be a person's.
PUBLIC_WORDS = frozenset(
    re.findall(
        r"\w+",
        """
    a abdominal accessory adenoma adipose adrenal aml and angiomyolipoma angiomyolipomas aorta arteria arteries artery autochthon avoid bbox
    bladder blood body bone bones bosniak both bowel brachiocephalic brain calyces calyx cancer carcinoma carotid cartilage cartilages cava
    ccrcc chrcc clavicula cm collecting collector colon contrast cord cortex cortical costal couch crop ct ctv cyst cystic cysts derecha derecho
    destro direito droit droite duct duodenum endophytic esophagus esquerdo eval exophytic exp expanded external fascia fat femur fluid foie
    gallbladder gauche gerota gland glands gluteus gtv gtvn gtvp harnleiter heart hepatic hilar hilum hip hips hull humerus igtv ii iii iliac
    iliopsoas inferior intestine itv iv ivc izquierda izquierdo kidney kidneys knoten kyste l label laesion lasion leber left lesion lesione
    lesions links liver lobe lower lt lumbar lung lungs lymph margin mass masse masses maximus medius medulla metastasis middle milz minimus mm
    muscle myocardium necrosis necrotic niere nieren nierenarterie nierenbecken nierentumor nierenvene node nodes nodul nodule nodules nodulo
    nodulos oesophagus of oncocytoma opt or organ pancreas papillary pararenal parenchyma part pelvis perirenal pole portal prcc prostate prv
    psoas ptv pyramid pyramids quadratus quiste r raumforderung rcc rechts renal renale renalis rib ribs right rinon rinones roi rt sacrum
    scapula segment segments shell sinistro sinus skin skull spinal spine spleen splenic sternum stomach stone stones subclavian superior system
    the thyroid tissue total trachea trunk tumeur tumor tumors tumour tumours upper ureter uretere ureters urinary urine vasos vein veins vena
    venous vertebra vertebrae vessel vessels with z zring zyste
    """,
    )
)


def tissue_of(name: str) -> str | None:
    """The tissue of ``ultrasound/acoustic_tissues.toml`` that a name means; None where it means none, or
    is of a derived structure.
    """
    return None if is_derived(name) else _tissue(name) or None


def is_understood(name: str) -> bool:
    """Whether a name is of a known structure, modelled or not."""
    return is_derived(name) or _tissue(name) is not None


def is_derived(name: str) -> bool:
    """Whether a name is of a structure that was made from another, for example by a margin, and is no
    organ.
    """
    plain = _plain(name)
    if re.search(DERIVED, plain) or re.search(DERIVED_SIGNS, name):
        return True
    return re.search(MARGIN, plain) is not None and _tissue(name) == "kidney"


def is_plain_kidney(name: str) -> bool:
    """Whether a name is that of a kidney, or of a part of it, and says nothing else."""
    return all(word in KIDNEY_WORDS for word in re.findall(r"[^\W\d_]+", _plain(name)))


def _tissue(name: str) -> str | None:
    """The tissue that a name means, also where it is of a derived structure; "" of a known one that is not
    modelled; None without.
    """
    plain = _plain(name)
    if plain in OWN_NAMES:
        return OWN_NAMES[plain]
    tissue = next((tissue for tissue, pattern in TISSUE_OF_NAME if re.search(pattern, plain)), None)
    if tissue in ("tumour", "cyst"):
        parts = re.match(COMPOSITE, unicodedata.normalize("NFC", name))
        if parts is not None and _tissue(parts[1]) == "kidney":
            return "kidney"
        is_renal = re.search(dict(TISSUE_OF_NAME)["kidney"], plain) is not None
        return "" if re.search(OTHER_ORGANS, plain) and not is_renal else tissue
    return tissue


def is_far(name: str) -> bool:
    """Whether a name is of a structure far from the kidneys."""
    return re.search(FAR, _plain(name)) is not None


def is_needless(name: str) -> bool:
    """Whether a name is of a structure that an import does not need: far from the kidneys, the body's
    outline, a couch.
    """
    return is_far(name) or re.search(OUTLINE, _plain(name)) is not None


def is_public(name: str) -> bool:
    """Whether all words of a name are of structures and sides, which identify nobody, and its digits are
    too few for a date or an ID.
    """
    words = re.findall(r"[^\W\d_]+", _plain(name))
    digits = sum(letter.isdigit() for letter in name)
    return "^" not in name and digits < LEAST_DIGITS and all(word in PUBLIC_WORDS for word in words)


def quoted(name: str) -> str:
    """A name of the source in a sentence, in quotation marks, by which ``public_text`` finds it."""
    return f"“{re.sub('[“”]', '', name)}”"


def public_text(sentence: str) -> str:
    """A sentence for a patient's folder: names in quotation marks that may be a person's are replaced by
    three dots.
    """
    return re.sub("“([^”]*)”", lambda match: match[0] if is_public(match[1]) else WITHHELD, sentence)


def side_of(name: str) -> Side | None:
    """The side in a name such as kidney_left or "Kidney R"; None where it has none, or both."""
    plain = _plain(name)
    sides = [side for side, pattern in SIDE_OF_NAME if re.search(pattern, plain)]
    return sides[0] if len(sides) == 1 else None


def same_name(one: str, other: str) -> bool:
    """Whether two names are the same text but for case, and for how letters with accents are encoded."""
    first, second = (
        re.sub("[“”]", "", unicodedata.normalize("NFC", name)).casefold() for name in (one, other)
    )
    return first.strip() == second.strip()


def _plain(name: str) -> str:
    """Lower case without accents, one space between words: kidneyL, kidney_L and "Kidney-L" become equal,
    and Läsion is lasion.
    """
    letters = "".join(c for c in unicodedata.normalize("NFKD", name) if not unicodedata.combining(c))
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", letters)
    return re.sub(r"[\W_]+", " ", apart).strip().casefold()
