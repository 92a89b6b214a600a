"""Recognise the tissue and the side of a segment by its codes, in 3D Slicer's terminology entries and in
DICOM.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass

from pydicom.dataset import Dataset

from scenes.patients.readers.segment_names import Side, is_understood, side_of, tissue_of

# Words, as names have them, of codes of SNOMED CT, whatever the language of their meaning. pydicom knows
# which codes of SNOMED RT are the same.
WORDS = {
    "64033007": "kidney", "18639004": "left kidney", "9846003": "right kidney", "50403003": "renal cortex",
    "30737000": "renal medulla", "25990002": "renal pelvis", "2334006": "calyx", "87953007": "ureter",
    "95570007": "kidney stone", "56381008": "calculus", "4147007": "mass", "108369006": "neoplasm",
    "86049000": "neoplasm", "14799000": "neoplasm", "52988006": "lesion", "367643001": "cyst",
    "59820001": "blood vessel", "51114001": "artery", "29092000": "vein", "2841007": "renal artery",
    "56400007": "renal vein", "15825003": "aorta", "64131007": "inferior vena cava", "10200004": "liver",
    "78961009": "spleen", "28231008": "gallbladder", "15776009": "pancreas", "23451007": "adrenal gland",
    "69695003": "stomach", "38848004": "duodenum", "30315005": "small bowel", "71854001": "colon",
    "272673000": "bone", "51282000": "vertebra", "113197003": "rib", "91727004": "muscle", "55603005": "fat",
    "7771000": "left", "24028007": "right", "51440002": "right and left",
}  # fmt: skip
# Names of the scheme SNOMED RT in older files.
RT_SCHEMES = ("SRT", "SNM3", "99SDM")
TERMINOLOGY_ENTRY = re.compile(r"(?:^|\|)TerminologyEntry:([^|]*)")
# Places in a terminology entry: the property type and its modifier, the anatomic region and its modifier.
TYPE, TYPE_MODIFIER, REGION, REGION_MODIFIER = 2, 3, 5, 6
# A lesion of one of these is the kidney's.
RENAL = ("kidney", "cortex", "medulla", "sinus", "urine")
LESIONS = ("tumour", "cyst", "stone")


@dataclass(frozen=True)
class CodedMeaning:
    """What the codes of a segment mean, in words; empty where there is no code."""

    kind: str = ""  # the property type, such as "kidney"
    region: str = ""  # the anatomic region
    modifiers: tuple[str, ...] = ()  # of both, such as "left"

    @property
    def tissue(self) -> str | None:
        """The tissue, or None: a general type, such as tissue, is that of the region; a lesion of another
        organ is not modelled.
        """
        if not is_understood(self.kind):
            return tissue_of(self.region)
        tissue = tissue_of(self.kind)
        elsewhere = is_understood(self.region) and tissue_of(self.region) not in RENAL
        return None if tissue in LESIONS and elsewhere else tissue

    @property
    def sides(self) -> set[Side]:
        """The sides of all codes; more than one where they disagree."""
        return {side for words in (self.kind, self.region, *self.modifiers) if (side := side_of(words))}

    def __str__(self) -> str:
        return ", ".join(words for words in (self.kind, self.region, *self.modifiers) if words)


def slicer_meaning(tags: str) -> CodedMeaning:
    """The meaning of the terminology entry in a segment's tags, as 3D Slicer writes them; empty where
    there is none.
    """
    entry = TERMINOLOGY_ENTRY.search(tags)
    fields = [field.split("^") for field in entry[1].split("~")] if entry else []
    words = [_words(*field) if len(field) == 3 else "" for field in fields]
    words += [""] * (REGION_MODIFIER + 1 - len(words))
    return CodedMeaning(words[TYPE], words[REGION], (words[TYPE_MODIFIER], words[REGION_MODIFIER]))


def dicom_meaning(segment: Dataset) -> CodedMeaning:
    """The meaning of the codes in an item of a DICOM-SEG's SegmentSequence."""
    types = segment.get("SegmentedPropertyTypeCodeSequence") or []
    regions = [
        item
        for name in ("AnatomicRegionSequence", "PrimaryAnatomicStructureSequence")
        for item in segment.get(name) or []
    ]
    modifiers = [
        item
        for coded in (*types, *regions, segment)
        for name in (
            "SegmentedPropertyTypeModifierCodeSequence",
            "AnatomicRegionModifierSequence",
            "PrimaryAnatomicStructureModifierSequence",
        )
        for item in coded.get(name) or []
    ]
    return CodedMeaning(_all_words(types), _all_words(regions), tuple(map(_item_words, modifiers)))


def _all_words(items: Iterable[Dataset]) -> str:
    return " ".join(words for words in map(_item_words, items) if words)


def _item_words(item: Dataset) -> str:
    value = next((item.get(name) for name in ("CodeValue", "LongCodeValue") if item.get(name)), "")
    return _words(
        str(item.get("CodingSchemeDesignator") or ""), str(value), str(item.get("CodeMeaning") or "")
    )


def _words(scheme: str, value: str, meaning: str) -> str:
    """The words of a code, those of its meaning where it is not known here."""
    from pydicom.sr.coding import Code  # takes 50 ms: few imports have codes

    code = Code(value, "SRT" if scheme in RT_SCHEMES else scheme, meaning)
    return next((words for known, words in WORDS.items() if code == Code(known, "SCT", "")), meaning)
