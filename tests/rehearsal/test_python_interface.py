"""The Python interface: the code of its page runs, and the Gymnasium environment is one."""

import re
from functools import partial

import numpy as np
import pytest
from ball_patient import folder_of_ball
from conftest import ROOT
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv
from scipy.spatial.transform import Rotation

from errors import UserError
from rehearsal.gymnasium_environment import MOST_DEG, MOST_MM, ProbeEnvironment
from rehearsal.loop.command import SetValues, Undo
from rehearsal.rehearsal import Rehearsal, open_rehearsal
from studies.planning.baseline_sweeps import random_sweep, straight
from studies.planning.environment_comparison import followed
from ultrasound.probe_manipulator import array_face_centre

pytestmark = pytest.mark.usefixtures("arrays_stored")


def test_the_code_of_the_page_runs(capsys):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text("utf-8"), re.DOTALL)
    names: dict = {}
    for block in blocks:
        exec(block, names)  # the page's own code
    printed = capsys.readouterr().out
    assert len(blocks) == 4 and re.search(r"^0\.\d\d N; tumour in \d+ % of the image$", printed, re.MULTILINE)
    assert 0.5 < float(re.search(r"has moved by (\S+) mm", printed)[1]) < 6.0
    assert "now 30.0 kPa" in printed and "the first pixel is at [" in printed
    observation = names["observation"]
    assert observation["image"].shape == (64, 64) and observation["image"].any()


@pytest.fixture(scope="module")
def held(tmp_path_factory) -> Rehearsal:
    return open_rehearsal(folder_of_ball(tmp_path_factory.mktemp("ball")), changes={"press.warm_up_steps": 2})


def test_without_a_ct_there_are_no_images(tmp_path):
    rehearsal = open_rehearsal(folder_of_ball(tmp_path), changes={"press.warm_up_steps": 2})
    frame = rehearsal.move(rehearsal.pose_at_depth(2.0))
    assert frame.number == 1 and frame.wrench is not None and np.isfinite(frame.positions).all()
    with pytest.raises(UserError, match="no CT"):
        rehearsal.images()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda it: it.do(SetValues(values={"tissue.young_kpa": -3.0})), "set: tissue.young_kpa = -3.0"),
        (lambda it: it.do(SetValues(values={"tissue.yong_kpa": 3.0})), "there is no such setting"),
        (lambda it: it.do(Undo()), "undo: Nothing to undo"),
        (lambda it: it.do("undo"), "'undo' is no command"),
        (lambda it: it.do(Undo), "is no command"),
        (lambda it: it.move([1, 2, 3]), "pose"),
        (lambda it: it.images("MR"), "mode = 'MR'"),
        (lambda it: it.images(shape=(0, 5)), "at least one row"),
        (lambda it: open_rehearsal(quality="quick"), "quality = 'quick'"),
        (lambda it: open_rehearsal(changes={"tissue.yong_kpa": 3.0}), "did you mean young_kpa"),
    ],
)
def test_mistakes_of_a_program_are_errors_in_words(held, wrong, words):
    with pytest.raises(UserError) as error:
        wrong(held)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_settings_in_force_can_be_read(held):
    held.do(SetValues(values={"tissue.young_kpa": 30.0}))
    assert held.scene.tissue.young_kpa == 30.0 and held.case.scene.tissue.young_kpa == 15.0


def episode(environment: ProbeEnvironment, actions: np.ndarray, seed: int = 1) -> tuple[float, list[bytes]]:
    """The sum of the rewards of actions (n, 6), and each observation's bytes."""
    observation, _ = environment.reset(seed=seed)
    seen, total = [], 0.0
    for action in actions:
        observation, reward, _, _, _ = environment.step(action)
        total += reward
        seen.append(b"".join(observation[name].tobytes() for name in sorted(observation)))
    return total, seen


@pytest.fixture(scope="module")
def environment() -> ProbeEnvironment:
    return ProbeEnvironment(actions=12, pixels=24)


def test_it_is_an_environment_of_gymnasium(environment):
    with pytest.warns(UserWarning, match="value is -?infinity"):
        check_env(environment, skip_render_check=True)


def test_the_same_seed_and_actions_give_the_same_bits_and_another_seed_another_place(environment):
    actions = np.random.default_rng(3).uniform(-1, 1, (6, 6))
    first, second, other = (episode(environment, actions, seed) for seed in (1, 1, 2))
    assert first == second and first[1] != other[1]


def test_an_action_is_made_along_and_about_the_axes_of_the_transducer(environment):
    environment.reset(seed=4)
    organ, size_mm = environment._rehearsal.organ, environment._rehearsal.case.size_mm
    for action in np.eye(6):
        # Lifted, so that no organ is in its way.
        environment.step(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
        before = organ.pose
        environment.step(action)
        moved = array_face_centre(organ.pose, size_mm[2]) - array_face_centre(before, size_mm[2])
        turned = Rotation.from_matrix(before[:3, :3].T @ organ.pose[:3, :3]).as_rotvec(degrees=True)
        assert before[:3, :3].T @ moved == pytest.approx(MOST_MM * action[:3], abs=1e-6)
        assert turned == pytest.approx(MOST_DEG * action[3:], abs=1e-6)


def test_a_straight_sweep_over_the_tumour_scores_more_than_a_random_one(environment):
    passes = straight(environment.trial)
    figures = followed(environment, [one[::3] for one in passes])
    assert figures["covered_percent"] > 60.0 and figures["rewards"] > 50.0
    by_chance = random_sweep(environment.trial, 1, seed=0)
    assert figures["rewards"] > followed(environment, [one[::3] for one in by_chance])["rewards"]


def test_environments_run_in_parallel():
    make = partial(ProbeEnvironment, actions=2, pixels=16)
    environments = AsyncVectorEnv([make, make], context="spawn")
    try:
        observation, _ = environments.reset(seed=[1, 1])
        for values in observation.values():
            assert np.array_equal(values[0], values[1])
        _, rewards, _, _, _ = environments.step(np.zeros((2, 6), np.float32))
        assert rewards[0] == rewards[1]
    finally:
        environments.close()
