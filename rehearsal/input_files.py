"""The files that the user of ``rehearse`` names: read, and checked against each other."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from pydantic import ValidationError
from scipy.spatial import cKDTree

from errors import explained
from rehearsal.commands.command_line import CommandError
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.configuration import probe_of, with_quality
from rehearsal.live_settings import DEFAULT_KEYS
from rehearsal.measurements.uncertainty_bands import UncertaintyBands, UncertaintyError, read_bands
from rehearsal.planning.plan_file import Plan, PlanError, is_plan, read_plan
from rehearsal.resection.resection_plan import (
    ResectionPlan,
    ResectionPlanError,
    is_resection_plan,
    read_resection_plan,
)
from rehearsal.sessions.session_file import Log, SessionError, read_log, scene_of_log, settings_apart
from rehearsal.tracking.pose_file import TimedPoses
from rehearsal.tracking.track_file import check_near, load_track
from render.keys import Keys, load_keys
from scenes.anatomy import LoadedAnatomy, fingerprint
from scenes.import_findings import acknowledged_warnings, open_warnings
from scenes.scene import Scene, load_scene, scene_file, with_options
from ultrasound.probe import Probe, ProbeError, probe_of_values

# Between passes the probe moves around the organ, farther off the longer its housing is (up to 500 mm); no
# pose of a plan is farther than this.
MOST_OFF_MM = 1000.0


@dataclass(frozen=True)
class InputFiles:
    """What the user names, as read: the scene and its folder, the probe, and what else was named."""

    folder: Path
    scene: Scene
    probe: Probe
    keys: Keys
    track: TimedPoses | None = None
    plan: Plan | None = None
    resection_plan: ResectionPlan | None = None
    log: Log | None = None
    bands: UncertaintyBands | None = None
    warnings: tuple[str, ...] = ()
    """Of the patient's import, which nobody has acknowledged."""
    acknowledged: tuple[str, ...] = ()
    """Warnings of the import which the user has acknowledged."""


def read_files(options: RehearseOptions) -> InputFiles:
    """Read the files that the user names. Raises UserError, CommandError."""
    path = scene_file(options.scene)
    scene = load_scene(path)
    keys = keys_of(options)
    options.check()
    track = load_track(options.track, options.track_from) if options.track else None
    plan = resection_plan = None
    if options.plan is not None and is_resection_plan(options.plan):
        resection_plan = read_resection_plan(options.plan)
        if options.headless and not (options.track or options.replay):
            raise CommandError(
                f"--plan: {options.plan} is a plan of a resection, and the scripted press cuts nothing; open "
                "it in a window, or add poses "
                "with a cut (--track, such as docs/resection.json on the embedded patient) or a session "
                "(--replay), which is then compared with it"
            )
    elif options.plan is not None:
        plan = read_plan(options.plan)
    log = session_of(options.replay, options.at) if options.replay else None
    changed, probe = as_asked(scene, options) if log is None else as_recorded(log, scene)
    if options.title is not None:
        changed = changed.model_copy(update={"title": options.title})
    bands = None if scene.uncertainty is None else read_bands(path.parent / scene.uncertainty)
    of_import = [find(scene, path.parent) for find in (open_warnings, acknowledged_warnings)]
    return InputFiles(path.parent, changed, probe, keys, track, plan, resection_plan, log, bands, *of_import)


def keys_of(options: RehearseOptions) -> Keys:
    """The keys of the window. Raises KeysError."""
    return load_keys(options.keys, DEFAULT_KEYS) if options.keys else DEFAULT_KEYS


def check_anatomy(files: InputFiles, options: RehearseOptions, anatomy: LoadedAnatomy) -> None:
    """Raises UserError if session, track or plan belong to other anatomy than the scene."""
    log = files.log
    if log is not None and fingerprint(anatomy) != log.header.anatomy:
        raise SessionError(
            f"the session belongs to other anatomy than this scene ({files.scene.title or 'no title'}): name "
            "its scene or patient's folder before --replay; a patient imported again counts as another"
        )
    if files.bands is not None and files.bands.anatomy != fingerprint(anatomy):
        raise UncertaintyError(
            f"{files.scene.uncertainty}: is of other anatomy than this scene; make it anew with: app.py "
            "study uncertainty, or leave "
            "uncertainty out"
        )
    plans = [] if files.plan is None else [files.plan]
    if files.track is not None and options.track is not None:
        check_near(files.track, anatomy.organ.vertices, options.track)
        plans += [read_plan(options.track)] if is_plan(options.track) else []
    for plan in plans:
        check_plan(plan, fingerprint(anatomy), files.probe)
        check_reach(plan, anatomy.organ.vertices)
    if files.resection_plan is not None and files.resection_plan.anatomy != fingerprint(anatomy):
        raise ResectionPlanError(
            "the plan of the resection is for other anatomy than this scene: name its scene or patient's "
            "folder before --plan; a patient "
            "imported again counts as another"
        )


def as_asked(scene: Scene, options: RehearseOptions) -> tuple[Scene, Probe]:
    """A scene with the options of the command line, and its probe; prints if they change the tissue model.

    Raises SceneError, ProbeError.
    """
    changed = with_quality(with_options(scene, options.changes), options.preset)
    if "tissue.model" not in options.changes and changed.tissue.model != scene.tissue.model:
        click.echo(f"Tissue model: {changed.tissue.model}, as the options ask for it.")
    return changed, probe_of(changed)


def session_of(path: Path, at_s: float) -> Log:
    """The session to replay from a second on. Raises CommandError, SessionError."""
    log = read_log(path)
    if at_s > log.length_s:
        raise CommandError(
            f"--at {at_s:g}: the session is {log.length_s:.1f} s long; choose an earlier second"
        )
    return log


def as_recorded(log: Log, scene: Scene) -> tuple[Scene, Probe]:
    """The patient of a scene with all other settings of a session, and the session's probe; prints where
    these differ from the scene's.

    Raises SessionError.
    """
    try:
        recorded, probe = scene_of_log(log.header, scene), probe_of_values(log.header.probe)
    except ValidationError as error:
        raise SessionError(f"the session's scene cannot be used: {explained(error)}") from None
    except ProbeError as error:
        raise SessionError(f"the session's probe cannot be used: {error}") from None
    click.echo(
        f"Replay of {log.length_s:.1f} s on the anatomy of: {scene.title or 'a scene without a title'}"
    )
    if apart := settings_apart(recorded, scene):
        click.echo(f"With the settings of the session, which are not the scene's: {', '.join(apart)}")
    return recorded, probe


def check_plan(plan: Plan, anatomy: str, probe: Probe) -> None:
    """Raises PlanError if a plan is for other anatomy (by its fingerprint) or for another probe."""
    if plan.anatomy != anatomy:
        raise PlanError(
            "the plan is for other anatomy than this scene: name its scene or patient's folder before "
            "--plan; "
            "a patient imported again counts as another"
        )
    planned = _probe_name(plan.probe.get("TransducerName"), plan.probe.get("HousingMm"))
    present = _probe_name(probe.transducer_name, probe.housing_mm)
    if planned != present:
        raise PlanError(
            f"the plan is for the probe {planned}, found {present}: choose it with --probe, or plan anew"
        )


def check_reach(plan: Plan, organ: np.ndarray) -> None:
    """Raises PlanError where a pose of a plan, of its passes or between them, is far from an organ's
    vertices (n, 3) [mm, LPS].
    """
    tree = cKDTree(organ)
    for number, sweep in enumerate(plan.sweeps, 1):
        for kind, lists in (("pass", sweep.passes), ("transfer", sweep.transfers)):
            for place, poses in enumerate(lists, 1):
                off_mm = tree.query(np.array(poses)[:, :3, 3])[0]
                worst = int(off_mm.argmax())
                if off_mm[worst] > MOST_OFF_MM:
                    raise PlanError(
                        f"the plan's sweep {number}, {kind} {place}, pose {worst + 1} is {off_mm[worst]:.0f} "
                        "mm from the organ: expected "
                        f"at most {MOST_OFF_MM:g} mm; the file was changed, plan anew with: app.py plan"
                    )


def _probe_name(name: Any, housing_mm: Any) -> str:
    return f"{name!r} of {' x '.join(f'{length:g}' for length in housing_mm or ())} mm"
