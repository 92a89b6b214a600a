"""The commands ``study ...``: what Nephron costs, and what cannot break it, measured on the user's machine."""

import click

from studies.freehand.freehand_command import freehand
from studies.performance.features_command import features
from studies.performance.import_timing_command import intake
from studies.performance.timing_command import timing
from studies.performance.tradeoff_command import trade
from studies.planning.plan_study_command import plan_study
from studies.robustness.replay_command import replay
from studies.robustness.soak_command import soak
from studies.robustness.stability_command import stability


@click.group()
def study() -> None:
    """Measure on this machine: tables and a picture in a folder."""


for command in (timing, features, trade, stability, soak, intake, freehand, replay, plan_study):
    study.add_command(command)
