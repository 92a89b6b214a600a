"""Persistence: each B-mode image has a share of those before it, as long as they show the same."""

from dataclasses import replace

import numpy as np

from ultrasound.scanner import B_MODE, PlaneImages


class Persistence:
    """The weighted mean of the B-mode images that one viewer was shown so far."""

    def __init__(self) -> None:
        self._mean: np.ndarray | None = None
        self._shows: tuple = ()

    def mixed(self, images: PlaneImages, share: float) -> PlaneImages:
        """The images, their B-mode image with a share (0 to 1) of the mean before.

        The mean begins anew where shape, probe or crater differ from those of the last image, and after
        images without a share or without a B-mode image.
        """
        image = images.by_name.get(B_MODE)
        if image is None or share == 0.0:
            self._mean = None
            return images
        shows = image.shape, images.probe.model_dump(), images.version
        if self._mean is None or self._shows != shows:
            self._mean, self._shows = image.astype(np.float32), shows
        self._mean = self._mean + (1 - share) * (image - self._mean)
        return replace(images, by_name=images.by_name | {B_MODE: np.rint(self._mean).astype(np.uint8)})
