"""From a frame to the view of it: images, outlines, captions and read-outs."""

from collections.abc import Sequence

import numpy as np

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.live_settings import LiveSettings
from rehearsal.loop.frame import LEAST_LAG_MM
from rehearsal.stopwatch import timed
from render.viewer import View
from ultrasound.doppler import scale_colours
from ultrasound.persistence import Persistence
from ultrasound.probe import DopplerMode, Probe, ScannerSettings
from ultrasound.scanner import B_MODE, PlaneImages, Scanner

# Figures of speed are medians of so many steps and images.
RECENT = 30


def image_view(
    anatomy: DeformedAnatomy,
    settings: LiveSettings,
    ms: list[float] | None = None,
    shape: tuple[int, int] | None = None,
    persistence: Persistence | None = None,
) -> View:
    """Compute the images of the probe at its present pose, with overlays; add the time that they took to
    ``ms``.

    ``shape`` are the rows and columns of the images, at most the scene's pixels each, which is also the
    default. ``persistence`` is that of the images shown before; without it an image stands alone.
    """
    scanner, probe, image = anatomy.scanner, settings.probe, settings.image
    pixels, outlined = image.pixels, settings.view.outline

    def images() -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        if scanner is None:
            return {"no CT": np.zeros((pixels, pixels), np.uint8)}, None
        shown_shape = shape and (min(shape[0], pixels), min(shape[1], pixels))
        made = scanner.images(
            anatomy.image_plane(probe),
            probe,
            image.mode,
            image.detail_level,
            image.window_hu,
            image.level_hu,
            shown_shape,
        )
        if persistence is not None:
            made = persistence.mixed(made, settings.scanner.persistence_percent / 100)
        return made.by_name, doppler_of(scanner, made, settings.scanner, anatomy.frame.time_s)

    made, doppler = timed(images, [] if ms is None else ms)
    width, depth, above = probe.extent_mm
    return View(
        transducer_pose=anatomy.pose,
        hand_pose=anatomy.frame.hand if anatomy.frame.lag_mm > LEAST_LAG_MM else None,
        images=made,
        doppler=doppler,
        scale=scale_texts(probe, settings.scanner.doppler) if doppler is not None else ("", ""),
        scale_colours=None if doppler is None else scale_colours(settings.scanner.doppler),
        width_mm=width,
        depth_mm=depth,
        above_mm=above,
        sector=probe.sector,
        focus_mm=None if image.mode == "ct" else probe.focus_mm,
        outline_mm=anatomy.tumour_outline() if outlined else None,
        outline_before_mm=anatomy.tumour_outline(at_rest=True) if outlined else None,
        captions=captions(settings),
        title=anatomy.case.scene.title,
    )


def doppler_of(
    scanner: Scanner, images: PlaneImages, settings: ScannerSettings, time_s: float
) -> np.ndarray | None:
    """The B-mode image with Doppler over it; None where that is off."""
    if settings.doppler == "off" or B_MODE not in images.by_name:
        return None
    return scanner.doppler(images, settings.doppler, time_s, settings.clamped)


def scale_texts(probe: Probe, mode: DopplerMode) -> tuple[str, str]:
    """Both ends of the scale of Doppler, of velocity in cm/s."""
    limit = f"{probe.velocity_limit_cm_s:.0f}"
    return ("power", "") if mode == "power" else (f"+{limit}", f"-{limit}")


def captions(settings: LiveSettings) -> tuple[str, str, str]:
    """The probe's name, and the settings of the B-mode image and of the CT."""
    probe, image, clamped = settings.probe, settings.image, settings.scanner.clamped
    b_mode = (
        f"{probe.frequency_mhz:.1f} MHz   G {probe.gain_percent:.0f} %   DR {probe.dyn_range_db:.0f} dB   "
        f"{image.detail_level}{'   hilum clamped' * clamped}"
    )
    ct = f"W {image.window_hu:.0f}   L {image.level_hu:.0f} HU"
    return (
        probe.transducer_name,
        "" if image.mode == "ct" else b_mode,
        "" if image.mode == "b-mode" else ct,
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
