"""The key map: in the documents and in the window's help."""

import numpy as np
import pytest
from conftest import ROOT
from PIL import ImageDraw

from rehearsal.live_settings import DEFAULT_KEYS
from render.background_image import help_image, in_columns
from render.window_layout import FULL_SIZE, WindowLayout

LINES = [
    {action: DEFAULT_KEYS.of[action] for action in actions}
    for group in DEFAULT_KEYS.groups.values()
    for actions in group.values()
]


def key_table() -> str:
    """The key map as docs/keys.md has it."""
    rows = ["| Key | What it does |", "| --- | --- |"]
    for group, lines in DEFAULT_KEYS.lines().items():
        rows += [f"| **{group}** | |", *(f"| {keys} | {text} |" for keys, text in lines)]
    return "\n".join(rows)


def test_key_map_names_every_key_and_action_once():
    for values in (LINES, [keys.values() for keys in LINES]):
        named = [each.lower() for line in values for each in line]
        assert len(set(named)) == len(named)


def test_docs_keys_has_the_key_map():
    assert key_table() in (ROOT / "docs" / "keys.md").read_text("utf-8")


def test_readme_keys_are_rows_of_the_key_map():
    section = (ROOT / "README.md").read_text("utf-8").partition("\n## Keys\n")[2].partition("\n## ")[0]
    rows = [row for row in section.splitlines() if row.startswith("|")]
    known = key_table().splitlines()
    assert rows == [row for row in known if row in rows]
    shown = {row.split(" | ")[0].removeprefix("| ") for row in rows}
    actions = {action for keys in LINES if " / ".join(keys.values()) in shown for action in keys}
    assert {"point", "press", "rock_left", "tilt_back", "rotate_left", "reset", "help"} <= actions
    assert len(actions) < sum(map(len, LINES)) / 2


@pytest.mark.parametrize(
    "size", [(700, 420), (1024, 600), (1202, 676), (1280, 720), (1920, 1080), (2560, 1440)]
)
def test_all_keys_fit_into_the_help_of_any_window(monkeypatch, size):
    layout, written = WindowLayout(*size), []
    text = ImageDraw.ImageDraw.text

    def noted(draw, place, words, **how):
        written.append(
            (draw.textbbox(place, words, font=how["font"], anchor=how["anchor"]), how["font"].size)
        )
        text(draw, place, words, **how)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", noted)
    picture = help_image(layout, DEFAULT_KEYS.lines())
    assert picture.shape == (size[1], size[0], 3)
    boxes = np.array([box for box, _ in written if box[2] > box[0]])
    assert (boxes[:, :2] >= 0).all() and (boxes[:, 2:] <= size).all()
    for number, box in enumerate(boxes):
        others = np.delete(boxes, number, axis=0)
        apart = (others[:, :2] >= box[2:]).any(axis=1) | (others[:, 2:] <= box[:2]).any(axis=1)
        assert apart.all()
    if size == FULL_SIZE:
        assert min(size for _, size in written) >= 13


def test_help_keeps_each_group_together_under_its_name():
    groups = DEFAULT_KEYS.lines()
    columns = in_columns(groups)
    assert max(map(len, columns)) <= 0.6 * sum(map(len, columns))
    rows = [row for column in columns for row in column]
    for name, lines in groups.items():
        at = rows.index(("", name))
        assert rows[at + 1 : at + 1 + len(lines)] == lines
