"""The summary of an import for the terminal and the check image, without names, dates or paths."""

from scenes.patients.organ_selection import HILAR
from scenes.patients.part_surfaces import PARTS, PEDICLE_MM
from scenes.patients.patient_import import Patient

DRAFT = "made by region growing from a seed, drawn by nobody: check every outline in check.png"


def summary_rows(patient: Patient) -> list[tuple[str, str]]:
    """Rows of a title and a line each."""
    volumes = patient.volumes_ml
    size = " x ".join(str(n) for n in patient.ct.GetSize())
    spacing = " x ".join(f"{s:.2f}" for s in patient.spacing_mm)
    extent = " x ".join(f"{e:.0f}" for e in patient.organ.extents)
    surface_ml = patient.organ.volume / 1000
    rows = [("DRAFT", DRAFT)] if patient.draft else []
    rows += [("WARNING", line) for line in patient.warnings]
    rows.append(("organ", f"{patient.side} kidney, {volumes['organ']:.1f} ml (surface {surface_ml:.1f})"))
    rows.append(("extent", f"{extent} mm (right-left x front-back x foot-head)"))
    rows.append(("surface", f"{len(patient.organ.faces)} faces, watertight"))
    for tissue, name in PARTS.items():
        word = name.replace("-system", "")
        if tissue in patient.parts:
            where = f", as labelled, {PEDICLE_MM:g} mm from the organ at most" if tissue in HILAR else ""
            rows.append((word, f"{volumes[tissue]:.1f} ml, {len(patient.parts[tissue].faces)} faces{where}"))
        elif tissue == "tumour":
            rows.append((word, "none labelled as one"))
    rows.append(("support", f"{len(patient.support.faces)} faces, for a patient lying supine"))
    rows.append(("CT", f"{size} voxels of {spacing} mm"))
    return rows + [("note", note) for note in patient.notes]


def as_table(rows: list[tuple[str, str]]) -> str:
    """Rows as lines of text."""
    return "\n".join(f"{word:<11}{line}" for word, line in rows)
