"""Settings: from one declaration follow controls, keys, options, values of sessions, and refusals."""

from collections import Counter
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from settings_at_start import settings_with

from rehearsal.case import case_of
from rehearsal.commands.plan_command import plan
from rehearsal.commands.rehearse_command import rehearse
from rehearsal.live_settings import LiveSettings, initial_settings
from rehearsal.pressed_organ import PressedOrgan
from render.keys import with_next
from render.sliders import draw_sliders
from render.viewer import Geometry
from render.window_layout import FULL_SIZE, Rect
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED, OPTIONS, SETTINGS, Gravity, SolverSection, load_scene
from scenes.tissue import ShapeMatchingTissue
from settings import SettingError, live_settings, live_values, section_of, settings_in, value_of, with_values
from sim.solver import StepSettings
from ultrasound.probe import PROBES, load_probe

GEOMETRY = Geometry(
    (None, np.zeros((0, 3))), np.zeros((2, 3)), tumour=(1, 1), parts={"vessel": 1}, support=(1, 1)
)
SMALL = LoadedAnatomy(trimesh.creation.icosphere(subdivisions=2, radius=20.0), None, None, ())
GROUPS = {setting.control.group for setting in settings_in(LiveSettings) if setting.control is not None}
ALL_BOXES = {group: Rect(0, 0, 100, 100) for group in (*GROUPS, "Tissue")}


class Hand:
    """A GUI whose user moves the control of one label to a value, and leaves all others."""

    def __init__(self, label: str = "", value: object = None) -> None:
        self.label, self.value, self.drawn = label, value, Counter()
        self.whole: list[str] = []

    def sub_window(self, name, *place):
        return nullcontext()

    def checkbox(self, label, value):
        self.drawn[label] += 1
        return self.value if label == self.label else value

    def slider_int(self, label, value, low, high):
        assert isinstance(value, int) and low <= value <= high
        self.whole.append(label)
        return self.checkbox(label, value)

    def slider_float(self, label, value, low, high):
        assert low <= value <= high
        # Of single precision.
        return float(np.float32(self.checkbox(label, value)))

    def button(self, label):
        self.drawn[label] += 1
        return label == self.label


def drawn(settings: LiveSettings, hand: Hand) -> LiveSettings:
    return draw_sliders(hand, settings, GEOMETRY, ALL_BOXES, FULL_SIZE, {})


@pytest.mark.parametrize("probe", sorted(path.stem for path in PROBES.glob("*.toml")))
def test_each_probe_starts_within_its_sliders_and_drawing_changes_nothing(probe):
    settings = settings_with({"tissue.young_kpa": 0.1 + 14.9, "probe.wall_filter_cm_s": 0.7})
    settings = settings.model_copy(update={"probe": load_probe(probe)})
    hand = Hand()
    assert drawn(settings, hand) is settings
    controls = [setting for setting in live_settings(settings) if setting.control is not None]
    # Each number of the TGC has a slider.
    assert hand.drawn.total() == len(controls) + 7
    for setting in controls:
        if not setting.choices:
            low, high = setting.limits_in(section_of(settings, setting))
            assert np.all(low <= np.array(value_of(settings, setting)))
            assert np.all(np.array(value_of(settings, setting)) <= high)


@pytest.mark.parametrize(
    "label, moved, path, value",
    [
        ("Young kPa", 20.25, "tissue.young_kpa", 20.25),
        ("Iter.", 7, "solver.iterations", 7),
        ("Depth mm", 75, "probe.depth_mm", 75.0),
        ("L HU", -20, "image.level_hu", -20.0),
        ("3", 80, "probe.time_gain_compensation", (50.0, 50.0, 80.0, 50.0, 50.0, 50.0, 50.0, 50.0)),
        ("Grey map: dark", None, "probe.grey_map", "linear"),
        ("Compounding: 1", None, "probe.compound_angles", 3),
        ("Harmonics", True, "probe.harmonics", True),
        ("MHz", 1e9, "probe.frequency_mhz", load_probe("linear").frequency_range_mhz[1]),
    ],
)
def test_a_moved_control_changes_its_setting_alone(label, moved, path, value):
    before = settings_with()
    after = live_values(drawn(before, Hand(label, moved)))
    assert after == live_values(before) | {path: value} and type(after[path]) is type(value)


def test_a_number_between_the_steps_of_its_slider_stays_until_it_is_moved():
    settings = settings_with({"probe.depth_mm": 62.4, "tissue.young_kpa": 0.35 + 1.0})
    assert drawn(settings, Hand()) is settings
    hand = Hand("Depth mm", 63)
    assert drawn(settings, hand).probe.depth_mm == 63.0
    assert "Depth mm" in hand.whole and "Young kPa" not in hand.whole


@pytest.mark.parametrize("probe, geometry", [("curvilinear", "CURVILINEAR"), ("phased", "PHASED")])
def test_what_a_geometry_excludes_is_no_live_setting(probe, geometry):
    changes = dict(transducer_geometry=geometry, theta_start_deg=-30.0, theta_stop_deg=30.0)
    sector = load_probe("curvilinear").model_copy(update=changes)
    live = live_values(settings_with().model_copy(update={"probe": sector}))
    assert "probe.colour_steering_deg" not in live
    assert ("probe.compound_angles" in live) == (probe != "phased")


def test_a_key_goes_round_all_values_and_every_live_setting_can_be_recorded():
    settings = settings_with()
    for setting in live_settings(settings):
        if setting.key is not None:
            seen = []
            for _ in setting.choices:
                settings = with_next(settings, setting)
                seen.append(value_of(settings, setting))
            assert sorted(seen) == sorted(setting.choices) and settings == settings_with()
    assert with_values(settings, live_values(settings)) == settings


@pytest.mark.parametrize(
    "values, words",
    [
        ({"probe.depth": 50.0}, "probe.depth: there is no such setting"),
        ({"tissue.stiffness": 0.5}, "tissue.stiffness: there is no such setting"),
        ({"image.mode": "x"}, "image.mode = 'x': input should be 'both', 'b-mode' or 'ct'"),
        ({"tissue.young_kpa": -1.0}, "tissue.young_kpa = -1.0: input should be greater than 0"),
        ({"tissue.young_kpa": float("nan")}, "tissue.young_kpa = nan"),
        ({"solver.iterations": 2.5}, "solver.iterations = 2.5"),
        ({"view.cut": 1}, "view.cut = 1: input should be a valid boolean"),
        ({"probe.frequency_mhz": 39.0}, "FrequencyMhz = 39 is outside FrequencyRangeMhz"),
    ],
)
def test_a_value_that_cannot_be_is_refused_in_words(values, words):
    with pytest.raises(SettingError) as error:
        settings_with(values)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_at_the_start_what_the_scene_leaves_open_has_the_models_values():
    settings = initial_settings(case_of(load_scene(EMBEDDED), SMALL))
    assert (settings.solver.substeps, settings.solver.iterations) == (1, 4)
    assert {"solver.substeps", "solver.iterations"} <= live_values(settings).keys()


def test_what_steps_depend_on_follows_the_settings():
    organ = PressedOrgan.__new__(PressedOrgan)
    organ.case, organ.model = SimpleNamespace(gravity_direction=np.array([0.0, 1.0, 0.0])), None
    organ.settings, organ.young_kpa = StepSettings(), None
    tissue = ShapeMatchingTissue(model="shape-matching", stiffness=0.4)
    organ.set(tissue, SolverSection(substeps=2, iterations=7), Gravity(acceleration_m_s2=2.0))
    step = organ.settings
    assert (step.stiffness, step.substeps, step.iterations) == (0.4, 2, 7)
    assert step.gravity == (0.0, 2000.0, 0.0)


def test_values_that_were_not_set_stay_defaults():
    settings = settings_with()
    changed = with_values(settings, {"gravity.acceleration_m_s2": 1.0})
    assert changed.gravity.model_fields_set == {"acceleration_m_s2"} and changed.probe is settings.probe
    assert settings.gravity.acceleration_m_s2 == 9.81


def test_each_option_of_a_scene_is_one_of_a_command_with_its_help():
    options = {
        option for command in (rehearse, plan) for parameter in command.params for option in parameter.opts
    }
    assert {option.split("/")[0] for option in OPTIONS.values()} <= options
    assert all(setting.field.description for setting in SETTINGS if setting.option is not None)
    texts = {parameter.opts[0]: getattr(parameter, "help", "") for parameter in rehearse.params}
    assert texts["--cell"] == "Width of a cell in mm (neo-hookean) [the scene's]."
    assert texts["--model"] == "Tissue model [the scene's]."


def test_no_two_controls_of_a_group_look_alike():
    for group in GROUPS:
        controls = [setting for setting in settings_in(LiveSettings) if setting.control is not None]
        labels = [setting.label for setting in controls if setting.control.group == group]
        assert len(set(labels)) == len(labels)
