"""The window on a rehearsal: its geometry, and its settings: where the sliders start, and what they set of the probe."""

import numpy as np

from rehearsal.rehearsal import Rehearsal
from render.display import window_size
from render.viewer import Geometry, ScannerSettings, Settings
from render.window import Window
from render.window_layout import FULL_SIZE
from ultrasound.probe import TGC_SLIDERS, Probe

TGC = tuple(f"tgc_{i + 1}" for i in range(TGC_SLIDERS))


def initial_settings(rehearsal: Rehearsal) -> Settings:
    """The settings at the start: those of scene and probe."""
    scene, step, probe = rehearsal.scene, rehearsal.settings, rehearsal.probe
    tissue = scene.tissue
    settings = Settings(
        young_kpa=getattr(tissue, "young_kpa", None),
        stiffness=step.stiffness if hasattr(tissue, "stiffness") else None,
        iterations=step.iterations,
        substeps=step.substeps,
        gravity_m_s2=scene.gravity.acceleration_m_s2,
        window_hu=round(scene.image.window_hu),
        level_hu=round(scene.image.level_hu),
        depth_mm=round(probe.depth_mm),
        gain_percent=round(probe.gain_percent),
        dyn_range_db=round(probe.dyn_range_db),
        frequency_mhz=probe.frequency_mhz,
        focus_percent=round(probe.focus_depth_percent),
        compounding=probe.compound_angles > 1,
        harmonics=probe.harmonics,
        dark_map=probe.grey_map == "dark",
        velocity_scale_cm_s=round(probe.velocity_scale_cm_s),
        wall_filter_cm_s=probe.wall_filter_cm_s,
        colour_gain_percent=round(probe.colour_gain_percent),
        colour_steering_deg=round(probe.colour_steering_deg),
        mode=scene.image.mode,
        detail_level=scene.image.detail_level,
    )
    for name, value in zip(TGC, probe.time_gain_compensation, strict=True):
        setattr(settings, name, round(value))
    return settings


def probe_with_settings(probe: Probe, settings: ScannerSettings) -> Probe:
    """The probe with the scanner's settings."""
    low, high = probe.frequency_range_mhz
    geometry = probe.transducer_geometry
    compounded = probe.compound_angles if probe.compound_angles > 1 else 3
    return probe.model_copy(
        update=dict(
            depth_mm=float(settings.depth_mm),
            gain_percent=float(settings.gain_percent),
            dyn_range_db=float(settings.dyn_range_db),
            frequency_mhz=min(max(settings.frequency_mhz, low), high),
            focus_depth_percent=float(settings.focus_percent),
            compound_angles=compounded if settings.compounding and geometry != "PHASED" else 1,
            harmonics=settings.harmonics,
            grey_map="dark" if settings.dark_map else "linear",
            velocity_scale_cm_s=float(settings.velocity_scale_cm_s),
            wall_filter_cm_s=float(settings.wall_filter_cm_s),
            colour_gain_percent=float(settings.colour_gain_percent),
            colour_steering_deg=float(settings.colour_steering_deg) if geometry == "LINEAR" else 0.0,
            time_gain_compensation=tuple(float(getattr(settings, name)) for name in TGC),
        )
    )


def open_viewer(rehearsal: Rehearsal, visible: bool) -> Window:
    """Open a window that shows a rehearsal, on the screen or off it. Raises NoVulkan."""
    size = window_size() if visible else FULL_SIZE
    return Window(geometry_of(rehearsal), initial_settings(rehearsal), size, visible)


def geometry_of(rehearsal: Rehearsal) -> Geometry:
    """The geometry that a window draws."""
    tumour, support = None, None
    if rehearsal.tumour is not None and rehearsal.tumour_skin is not None:
        tumour = rehearsal.tumour_skin.vertices, np.asarray(rehearsal.tumour.faces, np.int32)
    if rehearsal.supports:
        fixed = rehearsal.supports[0]
        support = np.asarray(fixed.vertices, np.float32), np.asarray(fixed.faces, np.int32)
    specimen = bed = None
    if rehearsal.cut is not None:
        bed = (
            rehearsal.organ_skin.vertices,
            np.asarray(rehearsal.organ.faces, np.int32)[rehearsal.cut.on_remnant],
        )
        specimen = (
            rehearsal.specimen_beside().astype(np.float32),
            np.asarray(rehearsal.cut.specimen.faces, np.int32),
        )
    return Geometry(
        organ=(rehearsal.organ_skin.vertices, np.asarray(rehearsal.organ.faces, np.int32)),
        bounds=rehearsal.whole_organ.bounds,
        up=-rehearsal.gravity_direction,
        transducer_size_mm=rehearsal.size_mm,
        transducer_radius_mm=rehearsal.probe.radius_mm,
        frequency_range_mhz=rehearsal.probe.frequency_range_mhz,
        tumour=tumour,
        parts={
            tissue: (skin.vertices, np.asarray(rehearsal.parts[tissue].faces, np.int32))
            for tissue, skin in rehearsal.part_skins.items()
        },
        support=support,
        specimen=specimen,
        bed=bed,
    )
