"""The commands ``study ...``: what Nephron costs, and what cannot break it, measured on the user's machine."""

import click

from studies.features.command import features
from studies.freehand.study_command import freehand
from studies.intake.command import intake
from studies.plan.study_command import plan_study
from studies.replay.command import replay
from studies.soak.command import soak
from studies.stability.command import stability
from studies.timing.command import timing
from studies.trade.command import trade


@click.group()
def study() -> None:
    """Measure on this machine: tables and a picture in a folder."""


for command in (timing, features, trade, stability, soak, intake, freehand, replay, plan_study):
    study.add_command(command)
