"""What one frame of a rehearsal shows: pictures, read-outs, and what the sliders start from."""

from functools import partial

import numpy as np

from rehearsal.measurements.run_report import Tally, expected_error_of
from rehearsal.rehearsal import Rehearsal
from rehearsal.stopwatch import timed
from render.display import window_size
from render.gamepad import Gamepad
from render.keys import Keys
from render.viewer import Geometry, Settings, View, Viewer
from render.window_layout import FULL_SIZE
from ultrasound.probe import TGC_SLIDERS, Probe

TGC = tuple(f"tgc_{i + 1}" for i in range(TGC_SLIDERS))


def settings_of(rehearsal: Rehearsal) -> Settings:
    """What the sliders start from."""
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


def probe_as_set(probe: Probe, settings: Settings) -> Probe:
    """The probe with the scanner set as the sliders are."""
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
    """The window, or its off-screen twin. Raises NoVulkan."""
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
        settings_of(rehearsal),
        window_size() if visible else FULL_SIZE,
        visible,
        keys=keys,
        gamepad=gamepad,
    )


def take_step(rehearsal: Rehearsal, pose: np.ndarray | None, tally: Tally) -> None:
    """Step with the transducer going to a pose, where there is one, and carry the surfaces."""
    if pose is not None:
        timed(partial(rehearsal.advance, pose), tally.step_ms)
        rehearsal.update_surfaces()


def take_view(
    rehearsal: Rehearsal,
    settings: Settings,
    pose: np.ndarray | None,
    tally: Tally,
) -> View:
    """One frame, on screen and off: step with the transducer going to a pose, carry the surfaces, take the pictures.

    Without a pose, as when frozen, the pictures alone are taken anew.
    """
    take_step(rehearsal, pose, tally)
    probe = probe_as_set(rehearsal.probe, settings)
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


def captions(probe: Probe, settings: Settings) -> tuple[str, str, str]:
    """The probe, and what echo and CT are shown with."""
    echo = f"{probe.frequency_mhz:.1f} MHz   G {probe.gain_percent:.0f} %   DR {probe.dyn_range_db:.0f} dB   {settings.detail_level}"
    ct = f"W {settings.window_hu}   L {settings.level_hu} HU"
    return (
        probe.transducer_name,
        "" if settings.mode == "ct" else echo,
        "" if settings.mode == "b-mode" else ct,
    )


def readouts(rehearsal: Rehearsal, tally: Tally) -> dict[str, str]:
    """Name -> figure with its unit."""
    size, count = next(iter(rehearsal.model.counts().items()))
    error = expected_error_of(rehearsal)
    return {
        "step": f"{np.median(tally.step_ms[-30:]):.1f} ms" if tally.step_ms else "",
        "error": "not known" if error is None else f"± {error:.2f} mm",
        "picture": f"{np.median(tally.slice_ms[-30:]):.1f} ms",
        size: f"{count}",
        "indentation": f"{max(rehearsal.indentation_mm(), 0.0):.1f} mm",
    }
