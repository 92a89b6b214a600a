"""From a frame to the view of it: images, outlines, captions and read-outs."""

from collections.abc import Sequence

import numpy as np

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.stopwatch import timed
from render.viewer import ScannerSettings, Settings, View
from ultrasound.doppler import scale_colours
from ultrasound.probe import Probe
from ultrasound.scanner import B_MODE

# Figures of speed are medians of so many steps and images.
RECENT = 30


def image_view(
    anatomy: DeformedAnatomy,
    probe: Probe,
    settings: Settings,
    ms: list[float] | None = None,
    shape: tuple[int, int] | None = None,
) -> View:
    """Compute the images of the probe at its present pose, with overlays; add the time that they took to ``ms``.

    ``shape`` are the rows and columns of the images, at most the scene's pixels each, which is also the default.
    """
    scanner, pixels = anatomy.scanner, anatomy.case.scene.image.pixels
    shown = settings.mode, settings.detail_level, settings.window_hu, settings.level_hu

    def images() -> dict[str, np.ndarray]:
        if scanner is None:
            return {"no CT": np.zeros((pixels, pixels), np.uint8)}
        shown_shape = shape and (min(shape[0], pixels), min(shape[1], pixels))
        plane = anatomy.image_plane(probe)
        return scanner.images(plane, probe, *shown, shown_shape, settings.persistence_percent / 100)

    def with_doppler() -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        made = images()
        if scanner is None or settings.doppler == "off" or B_MODE not in made:
            return made, None
        given = made[B_MODE], settings.doppler, anatomy.frame.time_s, settings.clamped
        return made, scanner.doppler(probe, *given)

    made, doppler = timed(with_doppler, [] if ms is None else ms)
    width, depth, above = probe.extent_mm
    return View(
        transducer_pose=anatomy.pose,
        images=made,
        doppler=doppler,
        scale=scale_texts(probe, settings) if doppler is not None else ("", ""),
        scale_colours=None if doppler is None else scale_colours(settings.doppler),
        width_mm=width,
        depth_mm=depth,
        above_mm=above,
        sector=probe.sector,
        focus_mm=None if settings.mode == "ct" else probe.focus_mm,
        outline_mm=anatomy.tumour_outline() if settings.outline else None,
        outline_before_mm=anatomy.tumour_outline(at_rest=True) if settings.outline else None,
        captions=captions(probe, settings),
        title=anatomy.case.scene.title,
    )


def scale_texts(probe: Probe, settings: ScannerSettings) -> tuple[str, str]:
    """Both ends of the scale of Doppler, of velocity in cm/s."""
    limit = f"{probe.velocity_limit_cm_s:.0f}"
    return ("power", "") if settings.doppler == "power" else (f"+{limit}", f"-{limit}")


def captions(probe: Probe, settings: ScannerSettings) -> tuple[str, str, str]:
    """The probe's name, and the settings of the B-mode image and of the CT."""
    b_mode = (
        f"{probe.frequency_mhz:.1f} MHz   G {probe.gain_percent:.0f} %   DR {probe.dyn_range_db:.0f} dB   "
        f"{settings.detail_level}{'   hilum clamped' * settings.clamped}"
    )
    ct = f"W {settings.window_hu}   L {settings.level_hu} HU"
    return (
        probe.transducer_name,
        "" if settings.mode == "ct" else b_mode,
        "" if settings.mode == "b-mode" else ct,
    )


def readouts(
    counts: dict[str, int], step_ms: Sequence[float], image_ms: Sequence[float], indentation_mm: float
) -> dict[str, str]:
    """Name -> figure with its unit: of speed, of the model's size, and the indentation [mm]."""
    size, count = next(iter(counts.items()))
    return {
        "step": f"{np.median(step_ms[-RECENT:]):.1f} ms" if step_ms else "",
        "image": f"{np.median(image_ms[-RECENT:]):.1f} ms" if image_ms else "",
        size: f"{count}",
        "indentation": f"{max(indentation_mm, 0.0):.1f} mm",
    }
