"""What an import found, in the words of the terminal and of the checking picture. No name, date or path."""

from scenes.patient import PARTS, Patient

SUPINE = "under the organ of a patient lying supine"


def facts(patient: Patient) -> list[tuple[str, str]]:
    """What was found: a word and a line each."""
    size = " x ".join(str(n) for n in patient.ct.GetSize())
    spacing = " x ".join(f"{s:.2f}" for s in patient.spacing_mm)
    extent = " x ".join(f"{e:.0f}" for e in patient.organ.extents)
    rows = [
        (
            "organ",
            f"{patient.side} kidney, {patient.volumes_ml['organ']:.1f} ml (surface {patient.organ.volume / 1000:.1f})",
        ),
        ("extent", f"{extent} mm (right-left x front-back x foot-head)"),
        ("surface", f"{len(patient.organ.faces)} faces, watertight"),
    ]
    for tissue, name in PARTS.items():
        if tissue in patient.parts:
            rows.append(
                (
                    name.replace("-system", ""),
                    f"{patient.volumes_ml[tissue]:.1f} ml, {len(patient.parts[tissue].faces)} faces",
                )
            )
        elif tissue == "tumour":
            rows.append((name, "none"))
    rows.append(("support", f"{len(patient.support.faces)} faces, {SUPINE}"))
    rows.append(("CT", f"{size} voxels of {spacing} mm"))
    return rows + [("note", note) for note in patient.notes]


def told(rows: list[tuple[str, str]]) -> str:
    """Facts as lines of a table."""
    return "\n".join(f"{word:<11}{line}" for word, line in rows)
