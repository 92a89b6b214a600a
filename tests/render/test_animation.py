"""The animated picture that a rehearsal without a window leaves."""

import numpy as np
import pytest
from PIL import Image

from render.animation import ANIMATION_FPS, save_animation, scaled_down


def test_an_animation_runs_in_real_time_for_ever_and_keeps_its_greys(tmp_path):
    count = ANIMATION_FPS * 2
    ramp = np.tile(np.linspace(0, 255, 1280).astype(np.uint8), (720, 1))
    frames = [scaled_down(Image.fromarray(np.roll(ramp, 32 * i, axis=1))) for i in range(count)]
    save_animation(frames, tmp_path / "press.webp")
    with Image.open(tmp_path / "press.webp") as animation:
        assert (animation.size, animation.n_frames, animation.info["loop"]) == ((960, 540), count, 0)
        spent_ms = 0
        for i, frame in enumerate(frames):
            animation.seek(i)
            animation.load()
            spent_ms += animation.info["duration"]
            shown = np.asarray(animation.convert("L"), float)
            # Half of the level between two greys of a scale of 32: what a lossy picture may cost.
            assert np.abs(shown - np.asarray(frame, float)).mean() < 4
    assert spent_ms == pytest.approx(2000, rel=0.01)
