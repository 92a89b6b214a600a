"""A session of a restless user, recorded and computed again."""

import json

import pytest
from small_bead_case import briefly, small_anatomy

import app
from rehearsal.loop.command import Move
from rehearsal.sessions.session_file import read_log
from studies import study
from studies.robustness import replay_study


@pytest.mark.usefixtures("arrays_stored")
def test_a_session_is_computed_again_to_the_bit(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "load_patient", lambda _: (briefly(5), small_anatomy()))
    # Three seconds in which much happens.
    monkeypatch.setattr(replay_study, "CHANGE_S", 0.1)
    monkeypatch.setattr(replay_study, "PACE_PROBABILITY", 0.1)
    asked = ["--minutes", "0.05", "--quality", "fast", "--arch", "cpu", "--out", str(tmp_path)]
    assert app.main(["study", "replay", *asked]) == 0
    figures, log = (
        json.loads((tmp_path / "replay.json").read_text()),
        read_log(tmp_path / "session-001.jsonl"),
    )
    steps = [command for _, command in log.commands if isinstance(command, Move)]
    assert figures["ways_back"] > 0 and figures["moments"] == len(steps) + figures["ways_back"]
    assert len({step.length_s for step in steps}) > 1 and log.last_number in log.states
    assert len(figures["replays"]) == 3
    for run in figures["replays"]:
        assert run["digest"] == figures["digest"] and run["differs_s"] is None and run["compared"] > 2
    assert figures["replays"][2]["begins_s"] <= log.length_s / 2
    assert capsys.readouterr().out.count("identical") == 3
