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
    """Measure on this machine: tables, CSV, JSON and a picture into a folder."""


study.add_command(timing)
study.add_command(features)
study.add_command(trade)
study.add_command(stability)
study.add_command(soak)
study.add_command(intake)
study.add_command(freehand)
study.add_command(replay)
study.add_command(plan_study)
