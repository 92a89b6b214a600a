"""What a window draws of an anatomy: surfaces that move, and those that do not."""

import numpy as np

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.live_settings import LiveSettings, initial_settings
from render.display import window_size
from render.viewer import Geometry, TransducerHousing
from render.window import Window
from render.window_layout import FULL_SIZE
from ultrasound.probe import Probe


def open_viewer(anatomy: DeformedAnatomy, visible: bool) -> Window[LiveSettings]:
    """Open a window that shows an anatomy, on the screen or off it. Raises NoVulkan."""
    size = window_size() if visible else FULL_SIZE
    return Window(drawn_geometry(anatomy), initial_settings(anatomy.case), size, visible)


def drawn_geometry(anatomy: DeformedAnatomy) -> Geometry:
    """What a window draws, of the geometry that is shown."""
    case, tumour, support = anatomy.case, None, None
    if anatomy.tumour is not None and anatomy.drawn_tumour is not None:
        tumour = anatomy.drawn_tumour, np.asarray(anatomy.tumour.faces, np.int32)
    if anatomy.supports:
        fixed = anatomy.supports[0]
        support = np.asarray(fixed.vertices, np.float32), np.asarray(fixed.faces, np.int32)
    faces = np.asarray(anatomy.organ.faces, np.int32)
    specimen = bed = cut_out = source = None
    if (remnant := anatomy.drawn_remnant) is not None:
        faces, source = np.asarray(remnant.faces, np.int32), remnant.source
        bed = anatomy.drawn_organ, faces[remnant.on_cut]
        beside = anatomy.specimen_beside()
        specimen = beside.vertices.astype(np.float32), np.asarray(beside.faces, np.int32)
        if anatomy.tumour_in_specimen is not None:
            triangles = np.asarray(anatomy.tumour_in_specimen.faces, np.int32)
            cut_out = anatomy.tumour_beside().astype(np.float32), triangles
    return Geometry(
        organ=(anatomy.drawn_organ, faces),
        seen_vertices=source,
        bounds=case.organ.bounds,
        up=-case.gravity_direction,
        lateral=case.lateral,
        transducer=drawn_housing(case.probe),
        tumour=tumour,
        parts={
            tissue: (vertices, np.asarray(anatomy.geometry.parts[tissue].faces, np.int32))
            for tissue, vertices in anatomy.drawn_parts.items()
        },
        vessel_kinds=anatomy.vessel_kinds(),
        support=support,
        specimen=specimen,
        tumour_cut_out=cut_out,
        bed=bed,
    )


def drawn_housing(probe: Probe) -> TransducerHousing:
    """What a window draws of a probe."""
    return TransducerHousing(
        probe.housing_mm, probe.edge_radius_mm, probe.radius_mm, probe.fin_mm, probe.cable_mm
    )
