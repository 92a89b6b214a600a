"""The view of one frame: images, overlays and read-outs; the window's geometry; where the sliders start."""

from functools import partial

import numpy as np

from rehearsal.measurements.run_report import Tally, expected_error_of
from rehearsal.rehearsal import Rehearsal
from rehearsal.stopwatch import timed
from render.display import window_size
from render.gamepad import Gamepad
from render.keys import Keys
from render.viewer import Geometry, ScannerSettings, Settings, View, Viewer
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
        mode=scene.image.mode,
        detail_level=scene.image.detail_level,
    )
    for name, value in zip(TGC, probe.time_gain_compensation, strict=True):
        setattr(settings, name, round(value))
    return settings


def probe_with_settings(probe: Probe, settings: ScannerSettings) -> Probe:
    """The probe with the scanner's settings."""
    low, high = probe.frequency_range_mhz
    return probe.model_copy(
        update=dict(
            depth_mm=float(settings.depth_mm),
            gain_percent=float(settings.gain_percent),
            dyn_range_db=float(settings.dyn_range_db),
            frequency_mhz=min(max(settings.frequency_mhz, low), high),
            focus_depth_percent=float(settings.focus_percent),
            time_gain_compensation=tuple(float(getattr(settings, name)) for name in TGC),
        )
    )


def open_viewer(
    rehearsal: Rehearsal, visible: bool, keys: Keys | None = None, gamepad: Gamepad | None = None
) -> Viewer:
    """Open the window, on the screen or off it. Raises NoVulkan."""
    from render.window import Window

    support, tumour = rehearsal.supports, rehearsal.tumour
    return Window(
        Geometry(
            organ_vertices=rehearsal.organ_skin.vertices,
            organ_faces=np.asarray(rehearsal.organ.faces, np.int32),
            bounds=rehearsal.organ.bounds,
            up=-rehearsal.gravity_direction,
            transducer_size_mm=rehearsal.size_mm,
            transducer_radius_mm=rehearsal.probe.radius_mm,
            frequency_range_mhz=rehearsal.probe.frequency_range_mhz,
            tumour_vertices=rehearsal.tumour_skin and rehearsal.tumour_skin.vertices,
            tumour_faces=None if tumour is None else np.asarray(tumour.faces, np.int32),
            parts={
                tissue: (skin.vertices, np.asarray(rehearsal.parts[tissue].faces, np.int32))
                for tissue, skin in rehearsal.part_skins.items()
            },
            support_vertices=np.asarray(support[0].vertices, np.float32) if support else None,
            support_faces=np.asarray(support[0].faces, np.int32) if support else None,
        ),
        initial_settings(rehearsal),
        window_size() if visible else FULL_SIZE,
        visible,
        keys=keys,
        gamepad=gamepad,
    )


def image_view(rehearsal: Rehearsal, probe: Probe, settings: Settings, tally: Tally) -> View:
    """Compute the images of the probe at its present pose, with overlays and read-outs."""
    shown = settings.mode, settings.detail_level, settings.window_hu, settings.level_hu
    pictures = timed(partial(rehearsal.look, probe, *shown), tally.slice_ms)
    width, depth, above = probe.extent_mm
    return View(
        transducer_pose=rehearsal.pose,
        pictures=pictures,
        width_mm=width,
        depth_mm=depth,
        above_mm=above,
        sector=probe.sector,
        focus_mm=None if settings.mode == "ct" else probe.focus_mm,
        outline_mm=rehearsal.tumour_outline() if settings.outline else None,
        outline_before_mm=rehearsal.tumour_outline(at_rest=True) if settings.outline else None,
        captions=captions(probe, settings),
        readouts=readouts(rehearsal, tally),
        title=rehearsal.scene.title,
    )


def captions(probe: Probe, settings: ScannerSettings) -> tuple[str, str, str]:
    """The probe's name, and the settings of the B-mode image and of the CT."""
    b_mode = (
        f"{probe.frequency_mhz:.1f} MHz   G {probe.gain_percent:.0f} %   DR {probe.dyn_range_db:.0f} dB   "
        f"{settings.detail_level}"
    )
    ct = f"W {settings.window_hu}   L {settings.level_hu} HU"
    return (
        probe.transducer_name,
        "" if settings.mode == "ct" else b_mode,
        "" if settings.mode == "b-mode" else ct,
    )


def readouts(rehearsal: Rehearsal, tally: Tally) -> dict[str, str]:
    """Name -> figure with its unit."""
    size, count = next(iter(rehearsal.model.counts().items()))
    error = expected_error_of(rehearsal)
    return {
        "step": f"{np.median(tally.step_ms[-30:]):.1f} ms" if tally.step_ms else "",
        "error": "not known" if error is None else f"± {error:.2f} mm",
        "image": f"{np.median(tally.slice_ms[-30:]):.1f} ms",
        size: f"{count}",
        "indentation": f"{max(rehearsal.indentation_mm(), 0.0):.1f} mm",
    }
