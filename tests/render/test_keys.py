"""Keys and gamepad buttons: one map for what they do, what the help says, and the user's own file."""

import dataclasses
import subprocess
import sys

import pytest
from conftest import ROOT
from settings_at_start import settings_with

import app
from rehearsal.live_settings import DEFAULT_KEYS as USUAL
from rehearsal.live_settings import LiveSettings
from render.keys import (
    HELD,
    KEYS,
    PAGES,
    STEPS,
    VIEW_ACTIONS,
    KeysError,
    begin,
    hold,
    keys_text,
    load_keys,
)
from render.viewer import Controls
from settings import settings_in


def file_of(tmp_path, text: str):
    path = tmp_path / "keys.toml"
    path.write_text(text)
    return path


def refused(tmp_path, text: str) -> str:
    with pytest.raises(KeysError) as error:
        load_keys(file_of(tmp_path, text), USUAL)
    assert "\n" not in str(error.value) and "keys.toml: " in str(error.value)
    return str(error.value)


def test_every_action_does_one_thing():
    # The mouse presses and dismisses, and the window says whether it is frozen.
    no_keys = "press", "frozen", "dismiss"
    flags = {
        each.name
        for each in dataclasses.fields(Controls)
        if each.default is False and each.name not in no_keys
    }
    settings = [setting.name for setting in settings_in(LiveSettings) if setting.key is not None]
    mouse = USUAL.of.keys() - USUAL.keyed.keys()
    does = [*mouse - flags, *HELD, *STEPS, *VIEW_ACTIONS, *PAGES, *flags, *settings]
    assert sorted(does) == sorted(USUAL.of)


def test_a_held_key_cannot_be_with_shift(tmp_path):
    assert "is held down" in refused(tmp_path, '[keys]\npush = "Shift+W"\n')


def test_an_action_changes_what_it_is_named_for():
    controls = Controls(settings_with())
    for action in ("undo", "sweep", "cut", "translucent", "mode", "cine_back", "cine_back", "cine_forth"):
        begin(action, controls)
    settings = controls.settings
    mode = settings.image.mode
    assert controls.undo and controls.sweep and not controls.redo and controls.cine == -1
    assert settings.view.cut and not settings.view.translucent and mode == "b-mode"
    begin("mode", controls)
    begin("mode", controls)
    assert controls.settings.image.mode == "both"
    before = dataclasses.replace(controls)
    for action in ("push", "help", "zoom_in", ""):
        begin(action, controls)
    assert controls == before


@pytest.mark.parametrize(
    ("action", "name", "a_second"),
    [
        ("push", "push_mm", 15.0),
        ("lift", "push_mm", -15.0),
        ("rotate_left", "rotate_deg", 45.0),
        ("rotate_right", "rotate_deg", -45.0),
        ("rock_left", "rock_deg", 30.0),
        ("rock_right", "rock_deg", -30.0),
        ("tilt_back", "tilt_deg", -30.0),
        ("tilt_forward", "tilt_deg", 30.0),
    ],
)
def test_a_held_action_goes_on_with_time(action, name, a_second):
    controls = Controls(settings_with(), **{name: 1.0})
    hold(action, controls, 0.1)
    assert controls == Controls(controls.settings, **{name: pytest.approx(1.0 + 0.1 * a_second)})
    hold("undo", controls, 0.1)
    assert not controls.undo


def test_the_printed_file_is_the_usual_map(tmp_path, capsys):
    assert app.main(["keys"]) == 0
    printed = capsys.readouterr().out
    assert printed == keys_text(USUAL)
    keys = load_keys(file_of(tmp_path, printed), USUAL)
    assert keys == USUAL
    assert load_keys(file_of(tmp_path, ""), USUAL) == USUAL


def test_a_file_changes_behaviour_help_and_words(tmp_path):
    keys = load_keys(
        file_of(
            tmp_path,
            '[keys]\npush = "i"\nexport = "w"\nfreeze = "space"\nhelp = "Return"\nplan_for = "f"\nplan = '
            '"h"\n[gamepad]\nundo = "guide"\nredo = "b"\n',
        ),
        USUAL,
    )
    assert [keys.action_of(key) for key in ("i", "w", " ", "f", "h", "F1", "Return", "Escape")] == [
        "push",
        "export",
        "freeze",
        "plan_for",
        "plan",
        "",
        "help",
        "quit",
    ]
    assert dict(keys.held())["push"] == "i" and dict(keys.held())["zoom_in"] == "Up"
    groups = keys.lines()
    assert {group: len(rows) for group, rows in groups.items()} == {
        group: len(rows) for group, rows in USUAL.groups.items()
    }
    lines = {text: key for rows in groups.values() for key, text in rows}
    assert lines["push it in, lift it"] == "I / S" and lines["freeze and unfreeze"] == "Space"
    assert [key for key, _ in groups["Transducer"]][:2] == ["Mouse", "Left button"]
    assert keys.worded("{help} shows, {quit} quits {so} {}") == "Return shows, Esc quits {so} {}"
    assert keys.buttons["undo"] == "Guide" and keys.buttons["redo"] == "B"


def test_every_usual_key_is_a_key_and_there_once():
    assert len(set(USUAL.of.values())) == len(USUAL.of)
    assert [USUAL.action_of(KEYS[key]) for key in USUAL.keyed.values()] == list(USUAL.keyed)
    # With shift a key that has no action of its own with it has its usual one.
    assert [USUAL.action_of(key, with_shift=True) for key in ("x", "m", "w", "F1")] == [
        "cut_out",
        "score_image",
        "push",
        "",
    ]
    assert [USUAL.action_of(key) for key in ("x", "m")] == ["cut", "bookmark"]
    assert len(set(KEYS.values())) == len(KEYS)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[keys]\npusch = "i"', "keys.pusch: unknown action; did you mean push?"),
        ('[keys]\npush = "F13"', "keys.push = 'F13': unknown key; known here: A, B"),
        ('[keys]\npush = "1"', "keys.push = '1': unknown key; known here: A, B"),
        ('[keys]\npush = "Spce"', "did you mean Space?"),
        ('[keys]\npush = "u"', "keys: push and undo are both on U; change one of them"),
        ('[keys]\npush = "Space"\nlift = "space"', "keys: push and lift are both on Space"),
        ('[keys]\npoint = "m"', "keys.point: is an action of the mouse; leave it out"),
        ('[gamepad]\nundo = "A"', "gamepad: freeze and undo are both on A"),
        ('[gamepad]\nundo = "Q"', "gamepad.undo = 'Q': unknown button"),
        ('[gamepad]\nzoom_in = "Guide"', "gamepad.zoom_in: unknown action"),
        ('[gamepad]\npress = "Guide"', "gamepad.press: is an action of the mouse"),
        ("[keys]\npush = 1", "keys.push = 1: input should be a valid string"),
        ('[kesy]\npush = "i"', "kesy: unknown key; expected the sections"),
        ('push = "i"', "push: unknown key; expected the sections"),
        ("[keys", "cannot be read as a TOML key file"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_words(tmp_path, text, words):
    assert words in refused(tmp_path, text)


def test_the_command_line_refuses_in_one_line(tmp_path, capsys):
    assert app.main(["rehearse", "--keys", str(tmp_path / "none.toml")]) == 2
    assert "no such key file; app.py keys prints one" in capsys.readouterr().err
    assert app.main(["rehearse", "--gamepad", "--headless"]) == 2
    assert "--gamepad: needs a window" in capsys.readouterr().err


def test_the_program_starts_without_pygame_and_taichi():
    asked = "import sys, app, render.gamepad; print({'pygame', 'taichi'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "set()", done.stderr
