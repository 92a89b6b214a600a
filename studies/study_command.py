"""The commands ``study ...``: accuracy, performance and robustness, measured on the user's machine."""

import click

from rehearsal.commands.lazy_group import LazyGroup

STUDIES = {
    "timing": ("studies.performance.step_timing:timing", "Measure how long a time step of SCENE takes."),
    "features": (
        "studies.performance.feature_costs:features",
        "Measure what each feature of SCENE costs.",
    ),
    "frames": (
        "studies.performance.frame_rate:frames",
        "Measure pictures a second, pace and latency of SCENE in a window.",
    ),
    "gpu": ("studies.gpu.gpu_command:gpu", "Measure step, picture and frame on each graphics card."),
    "trade": (
        "studies.performance.tradeoff:trade",
        "Measure the error of beads against the time of a step.",
    ),
    "stability": (
        "studies.robustness.stress_study:stability",
        "Stress-test the tissue and see whether it recovers.",
    ),
    "hand": (
        "studies.robustness.hand_study:hand",
        "Move the probe of SCENE fast and at random, and look at what it does to the organ.",
    ),
    "soak": ("studies.robustness.soak_study:soak", "Rehearse for an hour in SCENE, faster than real time."),
    "uncertainty": (
        "studies.uncertainty.uncertainty_command:uncertainty",
        "Estimate how far SCENE's press depends on what is not known of the tissue.",
    ),
    "cohort": (
        "studies.cohort.cohort_command:cohort",
        "Settle, press and plan for each patient, in one table.",
    ),
    "import": ("studies.performance.import_timing:intake", "Measure an import: seconds and memory."),
    "freehand": (
        "studies.freehand.freehand_accuracy:freehand",
        "Compare volumes of tracked sweeps with the ground truth.",
    ),
    "replay": ("studies.robustness.replay_study:replay", "Record a session in SCENE and compute it again."),
    "echo": (
        "studies.echo.echo_command:echo",
        "Compare the B-mode image with an independent wave simulator.",
    ),
    "scanner": (
        "studies.scanner.scanner_command:scanner",
        "Send echoes of real scanners through the B-mode and Doppler chain.",
    ),
    "patient-images": (
        "studies.patient_images.patient_images_command:patient_images",
        "Show B-mode images of kidneys beside their CT, and measure what can be seen.",
    ),
    "resection": (
        "studies.resection.resection_command:resection",
        "Measure margins, balance, random cuts and times of the resection.",
    ),
    "plan": (
        "studies.planning.plan_comparison:plan_study",
        "Compare planned sweeps with straight and random ones.",
    ),
    "gymnasium": (
        "studies.planning.environment_comparison:gymnasium_study",
        "Follow planned, straight and random sweeps in the Gymnasium environment.",
    ),
}


@click.group(cls=LazyGroup, commands_at=STUDIES)
def study() -> None:
    """Measure on this machine: tables and figures in a folder."""
