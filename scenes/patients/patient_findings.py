"""The findings of an imported patient, for ``import.json``."""

from scenes.import_findings import GridFindings, ImportFindings, ImportWarning, SurfaceFindings
from scenes.patients.patient_import import Patient
from scenes.tumour_complexity import Complexity
from scenes.volumes.voxel_grid import VoxelGrid
from version import VERSION

DIGITS = 4


def findings_of(patient: Patient, complexity: Complexity | None) -> ImportFindings:
    """What the import of a patient found; its warnings are not acknowledged."""
    surfaces = {"organ": patient.organ, **patient.parts, "support": patient.support}
    return ImportFindings(
        version=VERSION,
        side=patient.side,
        draft=patient.draft,
        position=patient.position,
        space=patient.space,
        extent_mm=_rounded(patient.organ.extents),
        length_mm=round(patient.length_mm, DIGITS),
        surfaces={
            name: SurfaceFindings(
                faces=len(surface.faces),
                volume_ml=round(float(surface.volume) / 1000, DIGITS),
                label_ml=round(patient.volumes_ml[name], DIGITS) if name in patient.volumes_ml else None,
            )
            for name, surface in surfaces.items()
        },
        series=patient.series,
        source=_grid(patient.source),
        ct=_grid(VoxelGrid.of(patient.ct)),
        tissues={str(code): tissue for code, tissue in patient.tissues.items()},
        complexity=None if complexity is None else complexity.figures(),
        warnings=tuple(ImportWarning(text=text) for text in patient.warnings),
        notes=patient.notes,
    )


def _grid(grid: VoxelGrid) -> GridFindings:
    first, second, third = map(_rounded, grid.direction)
    return GridFindings(
        size=grid.size,
        spacing_mm=_rounded(grid.spacing),
        origin_mm=_rounded(grid.origin),
        direction=(first, second, third),
    )


def _rounded(vector) -> tuple[float, float, float]:
    x, y, z = (round(float(value), DIGITS) + 0.0 for value in vector)
    return x, y, z
