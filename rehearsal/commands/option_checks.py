"""Check options against each other and files against the patient."""

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from errors import explained
from rehearsal.commands.command_line import CommandError
from rehearsal.planning.plan_file import Plan, PlanError, is_plan, read_plan
from rehearsal.sessions.session_file import Header, Log, SessionError, read_log, scene_of_log
from rehearsal.tracking.pose_file import TimedPoses
from rehearsal.tracking.track_file import check_near
from scenes.anatomy import LoadedAnatomy, fingerprint
from scenes.scene import OPTIONS, Scene
from ultrasound.probe import Probe, ProbeError, probe_of_values
from version import VERSION

# The values of tissue and solver that each option which chooses resolution and iterations leaves to the user.
MATERIAL = ("tissue.model", "tissue.young_kpa", "tissue.poisson")
LEFT = {"--quality": (*MATERIAL, "tissue.stiffness"), "--budget-ms": MATERIAL, "--error-mm": MATERIAL}


def refuse_inputs(track: Path | None, track_from: str | None, replay: Path | None, link_leads: bool) -> None:
    """Raises CommandError for input sources that exclude each other."""
    if track is None and track_from is not None:
        raise CommandError("--track-from: names a transform of a tracked sweep; add its file with --track")
    if track is not None and replay is not None:
        raise CommandError("--track: a replay has the recorded poses; leave out --track or --replay")
    if link_leads and (track is not None or replay is not None):
        raise CommandError(
            "--link-leads: a file moves the probe; leave out --link-leads, or --track and --replay"
        )


def refuse_headless(headless: bool, gamepad: bool, link_leads: bool) -> None:
    """Raises CommandError for an input source that needs a window."""
    for option, given in {"--gamepad": gamepad, "--link-leads": link_leads}.items():
        if headless and given:
            raise CommandError(f"{option}: needs a window; leave out {option} or --headless")


def refuse_no_vulkan(headless: bool) -> None:
    """Raises CommandError if a window has no Vulkan driver, before minutes are spent on building the model."""
    from sim.device import is_available

    if not headless and not is_available("vulkan"):
        raise CommandError(
            "no Vulkan driver found: the window needs one; install a Vulkan driver, or run with --headless"
        )


def refuse_no_pictures(headless: bool, link: bool) -> None:
    """Raises CommandError if the images that --no-pictures leaves out are needed."""
    if not headless:
        raise CommandError("--no-pictures: a window needs images; leave it out, or add --headless")
    if link:
        raise CommandError("--no-pictures: the link sends images; leave out --no-pictures or --link")


def session_of(
    replay: Path | None,
    at_s: float,
    changed: dict[str, float | str | None],
    choosers: dict[str, float | str | None],
) -> Log | None:
    """The session to replay, if any. Raises CommandError for options that would change it, SessionError."""
    if replay is None:
        if at_s > 0:
            raise CommandError("--at: is a time in a session; name its file with --replay")
        return None
    for option, value in (choosers | {option: changed[key] for key, option in OPTIONS.items()}).items():
        if value is not None:
            raise CommandError(f"{option}: a replay computes what was recorded; leave it out")
    log = read_log(replay)
    if at_s > log.length_s:
        raise CommandError(
            f"--at {at_s:g}: the session is {log.length_s:.1f} s long; choose an earlier second"
        )
    return log


def as_recorded(log: Log, scene: Scene) -> tuple[Scene, Probe]:
    """The patient of a scene with all other settings of a session, and the session's probe. Raises SessionError."""
    try:
        recorded = scene_of_log(log.header, scene)
    except ValidationError as error:
        raise SessionError(f"the session's scene cannot be used: {explained(error)}") from None
    try:
        return recorded, probe_of_values(log.header.probe)
    except ProbeError as error:
        raise SessionError(f"the session's probe cannot be used: {error}") from None


def check_anatomy(log: Log, anatomy: LoadedAnatomy, title: str) -> None:
    """Raises SessionError if a session belongs to other anatomy."""
    if fingerprint(anatomy) != log.header.anatomy:
        raise SessionError(
            f"the session belongs to other anatomy than this scene ({title or 'no title'}): name "
            "its scene or patient's folder before --replay; a patient imported again counts as another"
        )


def check_files(
    anatomy: LoadedAnatomy,
    title: str,
    probe: Probe,
    log: Log | None,
    track_file: Path | None,
    track: TimedPoses | None,
    plan: Plan | None,
) -> None:
    """Raises SessionError, PoseError or PlanError if a file belongs to other anatomy or to another probe."""
    if log is not None:
        check_anatomy(log, anatomy, title)
    if track is not None and track_file is not None:
        check_track(track, track_file, anatomy, probe)
    if plan is not None:
        check_plan(plan, fingerprint(anatomy), probe)


def check_track(track: TimedPoses, path: Path, anatomy: LoadedAnatomy, probe: Probe) -> None:
    """Raises PoseError if a track is far from the organ, PlanError if it is a plan for other anatomy or another probe."""
    check_near(track, anatomy.organ.vertices, path)
    if is_plan(path):
        check_plan(read_plan(path), fingerprint(anatomy), probe)


def replay_warning(header: Header, arch: str) -> str:
    """Why a replay may differ in bits from the recording: another version or backend; empty if both are the same."""
    if header.version not in (None, VERSION):
        return (
            f"Warning: recorded by version {header.version}, replayed by {VERSION}: the results may differ."
        )
    if header.arch != arch:
        return f"Warning: recorded on {header.arch}, replayed on {arch}: the same up to rounding, not bit for bit."
    return ""


def check_plan(plan: Plan, anatomy: str, probe: Probe) -> None:
    """Raises PlanError if a plan is for other anatomy (by its fingerprint) or for another probe."""
    if plan.anatomy != anatomy:
        raise PlanError(
            "the plan is for other anatomy than this scene: name its scene or patient's folder before --plan; "
            "a patient imported again counts as another"
        )
    planned = _probe_name(plan.probe.get("TransducerName"), plan.probe.get("HousingMm"))
    found = _probe_name(probe.transducer_name, probe.housing_mm)
    if planned != found:
        raise PlanError(
            f"the plan is for the probe {planned}, found {found}: choose it with --probe, or plan anew"
        )


def _probe_name(name: Any, housing_mm: Any) -> str:
    return f"{name!r} of {' x '.join(f'{each:g}' for each in housing_mm or ())} mm"


def refuse_sizes(changed: dict[str, float | str | None], choosers: dict[str, float | str | None]) -> None:
    """Raises CommandError if a preset or a budget chooses resolution and iterations, and another option sets them too.

    ``choosers`` are --quality, --budget-ms and --error-mm.
    """
    given = [option for option, value in choosers.items() if value is not None]
    if not given:
        return
    if given[0] == "--quality" and len(given) > 1:
        raise CommandError(
            f"--quality: {given[1]} chooses resolution and iterations too; leave one of them out"
        )
    for key, value in changed.items():
        chosen = key.startswith(("tissue.", "solver.")) and key not in LEFT[given[0]]
        if value is not None and chosen:
            raise CommandError(f"{OPTIONS[key]}: {given[0]} chooses this too; leave one of them out")
