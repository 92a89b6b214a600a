"""A table over the 3D view: whole texts of readable size, above the compass, the marked row in its colour."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import ImageDraw

from render.background_image import BackgroundImage
from render.table_box import LETTERS_PX, MARKED, table_image, table_rect
from render.viewer import TextTable, View
from render.window_layout import WindowLayout

HEADINGS = (
    *("attempt", "technique", "margin asked, mm", "least kept, mm", "mean kept, mm"),
    *("parenchyma removed, ml", "collecting system opened, mm2", "vessels divided", "points (plan 102.3)"),
)
ROW = ("12", "enucleoresection", "12.5", "10.2", "11.4", "104.9", "not labelled", "not labelled", "112.8")
FULL = WindowLayout(1280, 720)


def table(rows: int, marked: int | None = None) -> TextTable:
    return TextTable(f"{rows} attempts", HEADINGS, tuple((str(n), *ROW[1:]) for n in range(rows)), marked)


@pytest.mark.parametrize("size", [(1280, 720), (1366, 768), (1920, 1080), (3840, 2160)])
@pytest.mark.parametrize("rows", [0, 2, 30])
def test_texts_are_whole_and_apart_and_at_least_14_pixels(monkeypatch, size, rows):
    layout, written = WindowLayout(*size), []
    draw = ImageDraw.ImageDraw.text

    def noted(self, at, text, font=None, anchor=None, **kwargs) -> None:
        written.append((self.textbbox(at, text, font=font, anchor=anchor), font.size))
        draw(self, at, text, font=font, anchor=anchor, **kwargs)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", noted)
    table_image.cache_clear()
    box = table_rect(layout, table(rows))
    picture = table_image(layout, table(rows))
    assert picture.shape == (box.height, box.width, 3) and box.bottom <= layout.compass.top
    assert layout.scene.left <= box.left and box.right <= layout.scene.right
    boxes = np.array([each for each, _ in written])
    assert (boxes[:, :2] >= 0).all() and (boxes[:, 2:] <= (box.width, box.height)).all()
    for number, each in enumerate(boxes):
        others = np.delete(boxes, number, axis=0)
        assert ((others[:, :2] >= each[2:]) | (others[:, 2:] <= each[:2])).any(axis=1).all()
    assert min(letters for _, letters in written) >= LETTERS_PX * layout.scale >= 14


def test_the_marked_row_is_marked_and_the_last_rows_are_shown_where_not_all_fit(monkeypatch):
    plain, marked = table_image(FULL, table(3)), table_image(FULL, table(3, marked=1))
    rows = np.flatnonzero((plain != marked).any(axis=(1, 2)))
    assert 20 <= len(rows) <= 30 and (marked[rows[3], 40:44] == MARKED).all()
    written: list[str] = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda self, at, text, **_: written.append(text))
    table_image.cache_clear()
    table_image(FULL, table(30))
    assert "29" in written and "0" not in written and written[0].endswith("earlier ones are not shown")


def test_the_table_takes_the_place_of_the_findings():
    page = BackgroundImage(FULL)
    shown = View(np.eye(4), {"CT": np.zeros((4, 4), np.uint8)}, 40.0, 40.0, findings={"margin": "5 mm"})
    axes = np.eye(3)
    page.compose(shown, axes)
    before = page.pixels.copy()
    page.compose(replace(shown, table=table(2)), axes)
    box = table_rect(FULL, table(2))
    assert page.boxes_over_scene(replace(shown, table=table(2))) == [FULL.compass, box]
    rows = page.pixels.transpose(1, 0, 2)[::-1, :, :3]
    assert (rows[box.slices] == table_image(FULL, table(2))).all()
    page.compose(shown, axes)
    assert (page.pixels == before).all()


def test_without_a_table_there_is_no_box():
    assert table_rect(FULL, None) is None
