"""The phases: every action of an operation has a button, and none is cut off or covers another."""

from itertools import combinations, pairwise

import pytest
from settings_at_start import settings_with

from rehearsal.live_settings import DEFAULT_KEYS
from render.keys import KEY_MAP
from render.phases import TOOLS, Tool, tabs_of, tools_of
from render.text import font
from render.viewer import PHASES, Phase
from render.window_layout import FULL_SIZE, WindowLayout

SIZES = [(1024, 600), FULL_SIZE, (1920, 1080), (2560, 1440), (3840, 2160)]


def tools_in(phase: Phase, size: tuple[int, int] = FULL_SIZE, **values) -> list[Tool]:
    settings = settings_with({"view.phase": phase} | values)
    return tools_of(WindowLayout(*size), settings, DEFAULT_KEYS)


def test_each_phase_has_tools_whose_actions_have_keys():
    assert set(TOOLS) == set(PHASES)
    for rows in TOOLS.values():
        actions = [action for row in rows for action in row.values()]
        assert set(actions) <= DEFAULT_KEYS.of.keys() and len(set(actions)) == len(actions)


def test_all_that_cuts_can_be_done_by_a_click():
    """But for marks on the organ, which are clicks themselves."""
    actions = {action for keys in KEY_MAP["Resection"].values() for action in keys}
    used = {action for rows in TOOLS.values() for row in rows for action in row.values()}
    assert actions - used == {"score_under"}
    assert {"push", "lift", "freeze", "undo", "redo", "doppler", "show_scanner", "technique"} <= used


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("phase", PHASES)
def test_all_tools_of_a_phase_are_whole_in_the_window(phase, size):
    layout, tools = WindowLayout(*size), tools_in(phase, size)
    wanted = [action for row in TOOLS[phase] for action in row.values()]
    assert [tool.action for tool in tools] == wanted
    for tool in tools:
        assert layout.tools.left <= tool.box.left and tool.box.right <= layout.tools.right
        assert layout.tools.top <= tool.box.top and tool.box.bottom <= layout.tools.bottom
        text = font(layout.px(14)).getlength(tool.label) + font(layout.px(14)).getlength(tool.key)
        assert text + layout.px(14) <= tool.box.width
    for one, other in combinations([tool.box for tool in tools], 2):
        assert one.top != other.top or one.right < other.left


@pytest.mark.parametrize("size", [(700, 420), *SIZES])
def test_the_tabs_are_side_by_side_in_the_titles_row(size):
    layout = WindowLayout(*size)
    boxes = list(tabs_of(layout).values())
    assert all(one.right <= other.left for one, other in pairwise(boxes))
    assert boxes[-1].right < layout.title.right and boxes[0].bottom <= layout.title.bottom


def test_a_tool_shows_its_setting():
    technique = {tool.action: tool.label for tool in tools_in("Score", **{"resection.technique": "wedge"})}
    assert technique["technique"] == "Technique: wedge"
    for is_on in (False, True):
        on = {tool.action for tool in tools_in("Scan", **{"view.outline": is_on}) if tool.is_on}
        assert ("outline" in on) == is_on and "freeze" not in on
