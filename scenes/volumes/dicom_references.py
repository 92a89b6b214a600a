"""The DICOM objects that a CT consists of, or that labels refer to, and whether labels belong to a CT."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DicomReferences:
    """Identifiers (PHI, never shown) of a CT's own objects, or of those that labels refer to; empty where
    a file has none.
    """

    frames: frozenset[str] = frozenset()  # FrameOfReferenceUID
    series: frozenset[str] = frozenset()  # SeriesInstanceUID
    instances: frozenset[str] = frozenset()  # SOPInstanceUID of the slices
    patient: str = ""  # PatientID


NO_REFERENCES = DicomReferences()


def mismatch(labels: DicomReferences, ct: DicomReferences) -> str:
    """Why labels do not belong to a CT, in words; "" where they do, or where nothing can be compared."""
    frame, drawn_on, patient = _shared(labels, ct)
    if drawn_on:
        return ""
    if frame is False:
        return "have another frame of reference than"
    if frame is None and drawn_on is False:
        return "refer to another series than"
    if patient is False and drawn_on is False:
        return "have another patient ID, and refer to another series, than"
    if patient is False and frame is None:
        return "have another patient ID, and no frame of reference in common with"
    return ""


def doubts(labels: DicomReferences, ct: DicomReferences) -> tuple[str, ...]:
    """What differs in labels that belong to a CT, for the user."""
    frame, drawn_on, patient = _shared(labels, ct)
    if drawn_on and frame is False:
        return (
            "the labels have another frame of reference than the CT, but refer to its series: taken as "
            "labels of it",
        )
    if frame and drawn_on is False:
        return ("the labels were drawn on another series of this CT's frame of reference",)
    if frame and patient is False and not drawn_on:
        return ("the labels have another patient ID than the CT, but its frame of reference",)
    return ()


def _shared(labels: DicomReferences, ct: DicomReferences) -> tuple[bool | None, bool | None, bool | None]:
    """Whether they share the frame of reference, the series or slices, the patient ID; None where one has
    none.
    """
    series, slices = _common(labels.series, ct.series), _common(labels.instances, ct.instances)
    known = [one for one in (series, slices) if one is not None]
    patient = labels.patient == ct.patient if labels.patient and ct.patient else None
    return _common(labels.frames, ct.frames), any(known) if known else None, patient


def _common(one: frozenset[str], other: frozenset[str]) -> bool | None:
    return bool(one & other) if one and other else None
