"""Settings of a rehearsal: where they start, what they set of the probe, and those of a recorded session."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from errors import FOUND, UserError
from rehearsal.build_solver import step_settings
from rehearsal.case import Case
from render.viewer import TECHNIQUES, ScannerSettings, Settings
from ultrasound.probe import DETAIL_LEVELS, DOPPLER_MODES, MODES, TGC_SLIDERS, Probe
from ultrasound.target import TARGETS

CHOICES: dict[str, tuple[str, ...]] = {
    "mode": MODES,
    "detail_level": DETAIL_LEVELS,
    "doppler": DOPPLER_MODES,
    "plan_for": TARGETS,
    "technique": TECHNIQUES,
}

TGC = tuple(f"tgc_{i + 1}" for i in range(TGC_SLIDERS))


def initial_settings(case: Case) -> Settings:
    """The settings at the start: those of scene and probe."""
    scene, probe = case.scene, case.probe
    tissue, step = scene.tissue, step_settings(scene.tissue, scene.solver)
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


def set_settings(settings: Settings, values: dict[str, Any]) -> None:
    """Set what a session recorded. Raises UserError for an unknown setting or a value out of its range."""
    known = {setting.name: setting.metadata for setting in fields(settings)}
    for name, value in values.items():
        if name not in known or not _fits(getattr(settings, name), value, name, known[name]):
            raise UserError(
                f"the session sets {name} to {FOUND.repr(value)}, which it cannot be: its file is damaged"
            )
        setattr(settings, name, value)


def _fits(usual: Any, value: Any, name: str, about: Mapping[str, Any]) -> bool:
    """Whether a value is of a setting's kind and within its slider."""
    if name in CHOICES:
        return value in CHOICES[name]
    if value is None:
        return usual is None
    if isinstance(usual, bool) or isinstance(value, bool):
        return type(value) is type(usual)
    if not isinstance(value, int if isinstance(usual, int) else (int, float)):
        return False
    return not about or bool(about["low"] <= value <= about["high"])
