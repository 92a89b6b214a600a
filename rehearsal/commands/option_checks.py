"""What of a command line does not go together, or not with this patient."""

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from errors import explained
from rehearsal.commands.command_line import CommandError
from rehearsal.planning.plan_file import Plan, PlanError, is_plan, read_plan
from rehearsal.sessions.recorded_scene import scene_of_log
from rehearsal.sessions.session_file import Header, Log, SessionError, read_log
from rehearsal.tracking.pose_file import TimedPoses
from rehearsal.tracking.track_file import check_near
from scenes.anatomy import LoadedAnatomy, fingerprint
from scenes.scene import OPTIONS, Scene
from ultrasound.probe import Probe, ProbeError, probe_of_values
from version import VERSION

# What of tissue and solver each option that chooses size and passes leaves to the user.
MATERIAL = ("tissue.model", "tissue.young_kpa", "tissue.poisson")
LEFT = {"--quality": (*MATERIAL, "tissue.stiffness"), "--budget-ms": MATERIAL, "--error-mm": MATERIAL}


def refuse_inputs(
    track: Path | None,
    track_from: str | None,
    replay: Path | None,
    link_leads: bool,
) -> None:
    """Raises CommandError where what is to lead the transducer does not go together."""
    if track is None and track_from is not None:
        raise CommandError(
            "--track-from: says what of a tracked sweep is the probe; name its file with --track"
        )
    if track is not None and replay is not None:
        raise CommandError("--track: a replay goes the recorded way; leave out --track or --replay")
    if link_leads and (track is not None or replay is not None):
        raise CommandError("--link-leads: a file leads already; leave it out, or --track and --replay")


def refuse_headless(headless: bool, gamepad: bool, link_leads: bool) -> None:
    """Raises CommandError where what leads in a window alone is asked for without one."""
    for option, given in {"--gamepad": gamepad, "--link-leads": link_leads}.items():
        if headless and given:
            raise CommandError(f"{option}: leads in a window; leave out {option} or --headless")


def refuse_no_vulkan(headless: bool) -> None:
    """Raises CommandError where a window has no driver to be drawn with: before minutes are spent on what it would show."""
    from sim.device import is_there

    if not headless and not is_there("vulkan"):
        raise CommandError(
            "no Vulkan driver found: the window needs one; install a Vulkan driver, or run with --headless"
        )


def refuse_no_pictures(headless: bool, link: bool) -> None:
    """Raises CommandError where pictures that are to be left out are needed."""
    if not headless:
        raise CommandError("--no-pictures: a window is pictures; leave it out, or add --headless")
    if link:
        raise CommandError(
            "--no-pictures: pictures are what the link sends; leave out --no-pictures or --link"
        )


def session_of(
    replay: Path | None,
    at_s: float,
    changed: dict[str, float | str | None],
    choosers: dict[str, float | str | None],
) -> Log | None:
    """The session to be replayed, where one is. Raises CommandError, where other options would make another of it, SessionError."""
    if replay is None:
        if at_s > 0:
            raise CommandError("--at: says where to open a session; name its file with --replay")
        return None
    for option, value in (choosers | {option: changed[key] for key, option in OPTIONS.items()}).items():
        if value is not None:
            raise CommandError(f"{option}: a replay computes what was recorded; leave it out")
    log = read_log(replay)
    if at_s > log.length_s:
        raise CommandError(
            f"--at {at_s:g}: the session is {log.length_s:.1f} s long; open it at an earlier second"
        )
    return log


def as_recorded(log: Log, scene: Scene) -> tuple[Scene, Probe]:
    """A scene's patient with all else as a session has it, and its probe. Raises SessionError."""
    try:
        recorded = scene_of_log(log.header, scene)
    except ValidationError as error:
        raise SessionError(f"the session's scene cannot be used: {explained(error)}") from None
    try:
        return recorded, probe_of_values(log.header.probe)
    except ProbeError as error:
        raise SessionError(f"the session's probe cannot be used: {error}") from None


def check_anatomy(log: Log, anatomy: LoadedAnatomy, title: str) -> None:
    """Raises SessionError where a session is of another patient than an anatomy."""
    if fingerprint(anatomy) != log.header.anatomy:
        raise SessionError(
            f"the session is of other anatomy than this scene's ({title or 'no title'}): name "
            "its scene or patient's folder before --replay; a patient imported anew is another one"
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
    """Raises SessionError, PoseError or PlanError where one of the files is of another patient than an anatomy, or of another probe."""
    if log is not None:
        check_anatomy(log, anatomy, title)
    if track is not None and track_file is not None:
        check_track(track, track_file, anatomy, probe)
    if plan is not None:
        check_plan(plan, fingerprint(anatomy), probe)


def check_track(track: TimedPoses, path: Path, anatomy: LoadedAnatomy, probe: Probe) -> None:
    """Raises PoseError where a track is far from the organ, PlanError where it is a plan for other anatomy or another probe."""
    check_near(track, anatomy.organ.vertices, path)
    if is_plan(path):
        check_plan(read_plan(path), fingerprint(anatomy), probe)


def replay_warning(header: Header, arch: str) -> str:
    """Why a replay may not be bit for bit what was recorded; nothing where the backend and the version, if it is known, are the same."""
    if header.version not in (None, VERSION):
        return f"Mind: recorded by version {header.version}, replayed by {VERSION}: what changed between them may show."
    if header.arch != arch:
        return f"Mind: recorded on {header.arch}, replayed on {arch}: the same to the eye, not to the bit."
    return ""


def check_plan(plan: Plan, anatomy: str, probe: Probe) -> None:
    """Raises PlanError where a plan is for other anatomy than that of a fingerprint, or for another probe."""
    if plan.anatomy != anatomy:
        raise PlanError(
            "the plan is of other anatomy than this scene's: name its scene or patient's folder before --plan; "
            "a patient imported anew is another one"
        )
    planned = _probe_said(plan.probe.get("TransducerName"), plan.probe.get("HousingMm"))
    found = _probe_said(probe.transducer_name, probe.housing_mm)
    if planned != found:
        raise PlanError(
            f"the plan is for the probe {planned}, found {found}: choose it with --probe, or plan anew"
        )


def _probe_said(name: Any, housing_mm: Any) -> str:
    return f"{name!r} of {' x '.join(f'{each:g}' for each in housing_mm or ())} mm"


def refuse_sizes(changed: dict[str, float | str | None], choosers: dict[str, float | str | None]) -> None:
    """Raises CommandError where a preset or a budget is to choose size and passes, and another option says them too.

    ``choosers`` are --quality, --budget-ms and --error-mm.
    """
    given = [option for option, value in choosers.items() if value is not None]
    if not given:
        return
    if given[0] == "--quality" and len(given) > 1:
        raise CommandError(f"--quality: {given[1]} chooses size and passes too; leave one of them out")
    for key, value in changed.items():
        chosen = key.startswith(("tissue.", "solver.")) and key not in LEFT[given[0]]
        if value is not None and chosen:
            raise CommandError(f"{OPTIONS[key]}: {given[0]} chooses this too; leave one of them out")
