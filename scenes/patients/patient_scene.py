"""The scene of an imported patient: its files, the materials of its parts, the CT window, the hilum, the
support, the probe and where it starts.
"""

from typing import Any

import numpy as np
import SimpleITK as sitk
import trimesh

from scenes.mechanical_tissues import mechanical_properties
from scenes.patients.opening_pose import opening_press
from scenes.patients.organ_selection import LESIONS, PARENCHYMA
from scenes.patients.part_surfaces import PARTS
from scenes.patients.patient_import import Patient
from scenes.patients.patient_position import GRAVITY
from scenes.patients.readers.segment_names import Side
from scenes.perirenal_fat import fat_thickness, removed
from scenes.scene import AnatomyFiles, Attachment, Gravity, Image, MeshShape, Scene, Transducer
from scenes.surfaces import depth_below_hull
from scenes.tissue import NeoHookeanTissue, PartMaterial, PartName
from scenes.tissue_classes.tissue_map import TISSUES
from scenes.volumes.voxel_grid import VoxelGrid

FAT_HU = -110.0
LEAST_WINDOW_HU = 310.0  # up to 200 HU at least, or an unenhanced kidney is white

# The hilum is the mean of the vertices within this distance of the deepest one.
FLOOR_MM = 8.0
# The pedicle holds the tissue within this distance of the hilum's centre.
PEDICLE_RADIUS_MM = 20.0
# Least medial component of the normal at the hilum.
LEAST_MEDIAL = 0.3
# Parts that have their own material. Vessels have none: those within a kidney are smaller than its elements.
STIFF_OR_SOFT: tuple[PartName, ...] = ("sinus", "urine", "cyst", "tumour")
PROBE = "drop-in"
# The housing of ``drop-in``, lateral x elevation x length.
HOUSING_MM = (42.0, 9.0, 7.5)


def hilum(organ: trimesh.Trimesh, side: Side) -> tuple[float, float, float]:
    """Centre of the hilum, LPS [mm]: around the medial vertex that is deepest below the surface's convex
    hull.
    """
    medial = np.array([-1.0 if side == "left" else 1.0, 0.0, 0.0])
    depth = depth_below_hull(organ, organ.vertices)
    facing = organ.vertex_normals @ medial > LEAST_MEDIAL
    if not facing.any():
        facing[:] = True
    deepest = organ.vertices[np.argmax(np.where(facing, depth, -1.0))]
    floor = organ.vertices[np.linalg.norm(organ.vertices - deepest, axis=1) <= FLOOR_MM]
    x, y, z = floor.mean(axis=0).round(1).tolist()
    return x, y, z


def part_materials(patient: Patient) -> dict[PartName, PartMaterial]:
    """The materials of the patient's parts: what is typical of each."""
    typical = mechanical_properties().parts
    return {
        name: PartMaterial(**{key: values[1] for key, values in typical[name].model_dump().items()})
        for name in STIFF_OR_SOFT
        if name in patient.parts
    }


def stiffness_row(scene: Scene) -> tuple[str, str]:
    """A row of the import's summary: Young's moduli of the scene's parts."""
    tissue = scene.tissue
    assert isinstance(tissue, NeoHookeanTissue)
    if not tissue.parts:
        return "stiffness", f"{tissue.young_kpa:g} kPa everywhere"
    words = [
        f"{PARTS[name].replace('-', ' ')} {part.young_kpa:g}" for name, part in reversed(tissue.parts.items())
    ]
    return (
        "stiffness",
        f"{', '.join([f'parenchyma {tissue.young_kpa:g}', *words])} kPa (typical values; --uniform: one "
        "for all)",
    )


def fat_row(patient: Patient, scene: Scene) -> tuple[str, str]:
    """A row of the import's summary: the perirenal fat that holds the organ, where it is removed, and where
    the CT does not show it.
    """
    attachment, area_mm2 = scene.attachment, patient.organ.area_faces
    voxels = sitk.GetArrayViewFromImage(patient.ct).transpose(2, 1, 0).astype(np.float32)
    thickness = fat_thickness(patient.organ, voxels, VoxelGrid.of(patient.ct).index_from_mm)
    assert scene.press.direction is not None
    free = removed(attachment, patient.organ, patient.tumour, -np.array(scene.press.direction))
    shown = thickness[~free & np.isfinite(thickness)]
    freed, hidden = (
        100 * area_mm2[mask].sum() / area_mm2.sum() for mask in (free, ~free & np.isnan(thickness))
    )
    thick = f", {np.median(shown):.0f} mm thick (median, by HU)" if len(shown) else ""
    around = f", and {attachment.freed_margin_mm:g} mm around the tumour" if patient.tumour else ""
    return (
        "fat",
        f"{attachment.fat_young_kpa:g} kPa{thick}; none on {freed:.0f} % of the surface, freed: towards the "
        f"probe{around}; {hidden:.0f} % not shown by the CT: {attachment.fat_kpa_mm:g} kPa/mm there",
    )


def patient_scene(
    patient: Patient,
    uniform: bool = False,
    probe: str = PROBE,
    housing_mm: tuple[float, float, float] = HOUSING_MM,
) -> Scene:
    """The scene that an import writes into the patient's folder: lying as in the CT, on its support, under a
    probe.

    ``uniform`` tissue has no parts of their own material.
    """
    tumour = None if patient.tumour is None else "tumour.stl"
    own = [code for code, tissue in patient.tissues.items() if tissue in (*PARENCHYMA, *LESIONS)]
    hu = sitk.GetArrayViewFromImage(patient.ct)[np.isin(sitk.GetArrayViewFromImage(patient.labels), own)]
    # From fat to the organ's 99th percentile, with any contrast agent.
    darkest = FAT_HU
    brightest = max(round(float(np.percentile(hu, 99)), -1), darkest + LEAST_WINDOW_HU)
    return Scene(
        image=Image(window_hu=brightest - darkest, level_hu=(brightest + darkest) / 2, outside="fluid"),
        title=f"{patient.side.capitalize()} kidney{' (draft)' if patient.draft else ''}",
        anatomy=AnatomyFiles.model_validate(
            dict(
                tumour=tumour,
                parts={tissue: f"{PARTS[tissue]}.stl" for tissue in patient.parts if tissue != "tumour"},
                ct="ct.nrrd",
                labels="labels.nrrd",
                tissues={str(code): tissue for code, tissue in patient.tissues.items()},
                **_corrections(patient),
            )
        ),
        tissue=NeoHookeanTissue(parts={} if uniform else part_materials(patient)),
        gravity=Gravity(direction=GRAVITY[patient.position]),
        attachment=Attachment(
            at_mm=hilum(patient.organ, patient.side),
            radius_mm=PEDICLE_RADIUS_MM,
            stiffness_n_mm=mechanical_properties().pedicle_n_mm[1],
            fat_young_kpa=mechanical_properties().fat_young_kpa[1],
            fat_kpa_mm=mechanical_properties().fat_kpa_mm[1],
        ),
        shape=(MeshShape(kind="mesh", file="support.stl"),),
        transducer=Transducer(probe=probe),
        press=opening_press(
            patient.organ, patient.tumour, patient.support, GRAVITY[patient.position], housing_mm
        ),
    )


def _corrections(patient: Patient) -> dict[str, Any]:
    """The file of corrections, and the tissues of its values."""
    if patient.corrections is None:
        return {}
    values = np.unique(sitk.GetArrayViewFromImage(patient.corrections))
    return dict(
        corrections="corrections.nrrd",
        corrected_tissues={str(code): TISSUES[code - 1] for code in values.tolist() if code},
    )
