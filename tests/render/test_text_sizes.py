"""No text of a window of 1280 x 720 is smaller than 14 pixels."""

import numpy as np
import pytest
from PIL import ImageFont

from render.background_image import BackgroundImage
from render.text import font
from render.viewer import View
from render.window_layout import WindowLayout

LEAST_PX = 14
FINDINGS = {
    "compression": "12.5 mm",
    "slip": "100 % of contact",
    "tumour volume seen": "100 %",
    "calyces opened": "125 mm2",
    "vessels cut": "12, vein 12.7 mm",
}


@pytest.fixture
def sizes(monkeypatch):
    """The sizes that are drawn with from now on."""
    load, used = ImageFont.load_default, set[int]()

    def recorded(size):
        used.add(size)
        return load(size=size)

    font.cache_clear()
    monkeypatch.setattr(ImageFont, "load_default", recorded)
    yield used
    font.cache_clear()


def test_all_texts_can_be_read(sizes):
    image, layout = np.zeros((40, 30), np.uint8), WindowLayout(1280, 720)
    view = View(
        np.eye(4),
        {"B-mode": image, "CT": image},
        36.0,
        50.0,
        scale=("+15 cm/s", "-15"),
        outline_mm=np.zeros((0, 2, 2)),
        caliper_mm=((0.0, 5.0), (5.0, 9.0)),
        caliper="6.4 mm",
        notes={"B-mode": "NO CONTACT\npress the probe in"},
        captions=("Drop-in, 5-13 MHz", "9.0 MHz   G 70 %   DR 60 dB   speckle", "W 340   L 60 HU"),
        findings=FINDINGS,
        status="LONGER STEPS   1/15 s",
        clock="149.4 s",
        messages=("a long message of the session, such as a refusal, with all its reasons " * 6,),
        warnings=("1.2 ml in the kidney are dense: shown as stone, with its shadow",),
        title="Left kidney with a tumour",
    )
    page = BackgroundImage(layout)
    page.compose(view, np.eye(3))
    page.show_page("help", view)
    page.show_page("log", view)
    assert sizes and min(sizes) >= LEAST_PX
