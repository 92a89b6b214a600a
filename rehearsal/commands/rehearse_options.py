"""The options of ``rehearse``, and which of them exclude each other."""

from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from rehearsal.commands.command_line import (
    ARGUMENT,
    ArchOptions,
    CommandError,
    QualityOptions,
)
from rehearsal.tracking.openigtlink_options import LinkOptions
from scenes.scene import EMBEDDED, OPTIONS

# Options that choose resolution and iterations, and the settings of tissue and solver that each leaves to the
# user.
MATERIAL = ("tissue.model", "tissue.young_kpa", "tissue.poisson")
LEFT = {"quality": (*MATERIAL, "tissue.stiffness"), "budget_ms": MATERIAL, "error_mm": MATERIAL}
TISSUE_AND_STEP = [path for path in OPTIONS if path.startswith(("tissue.", "solver."))]
# Options that exclude each other, and options that need another one.
EXCLUDING = {
    ("track", "replay"): "--track: a replay has the recorded poses; leave out --track or --replay",
    (
        "link_leads",
        "track",
    ): "--link-leads: a file moves the probe; leave out --link-leads, or --track and --replay",
    (
        "link_leads",
        "replay",
    ): "--link-leads: a file moves the probe; leave out --link-leads, or --track and --replay",
    ("gamepad", "headless"): "--gamepad: needs a window; leave out --gamepad or --headless",
    ("link_leads", "headless"): "--link-leads: needs a window; leave out --link-leads or --headless",
    ("no_pictures", "link"): "--no-pictures: the link sends images; leave out --no-pictures or --link",
    ("rate", "headless"): "--rate: needs a window; leave out --rate or --headless",
    (
        "quality",
        "budget_ms",
    ): "--quality: --budget-ms chooses resolution and iterations too; leave one of them out",
    (
        "quality",
        "error_mm",
    ): "--quality: --error-mm chooses resolution and iterations too; leave one of them out",
}
NEEDING = {
    ("track_from", "track"): "--track-from: names a transform of a tracked sweep; add its file with --track",
    ("at", "replay"): "--at: is a time in a session; name its file with --replay",
    ("no_pictures", "headless"): "--no-pictures: a window needs images; leave it out, or add --headless",
}


# Options of the window alone: with others the rehearsal without a scene is that of the embedded patient.
OF_ANY_PATIENT = ("out", "arch", "gamepad", "keys", "rate", *LinkOptions.model_fields)


class RehearseOptions(LinkOptions, QualityOptions, ArchOptions):
    """What the user asks of a rehearsal."""

    scene_sections: ClassVar = ("tissue", "solver", "transducer", "image")

    scene: Annotated[Path, ARGUMENT] = EMBEDDED
    headless: bool = False
    """No window: run the scripted press, write images and a report."""
    no_pictures: bool = False
    """With --headless: no images, which take most of the time; only report, surfaces and session."""
    seconds: float | None = Field(None, ge=0.02, le=3600)
    """Simulated seconds without a window [the scene's press]; the scripted press takes this time; a track
    stops then, a replay so long after --at.
    """
    replay: Path | None = None
    """Replay a recorded session of this SCENE, bit for bit."""
    at: float = Field(0.0, ge=0)
    """With --replay: start at this second of the session."""
    track: Path | None = None
    """Recorded poses that move the probe: a tracked sweep (.igs.mha, .igs.nrrd), or poses with times (CSV,
    JSON).
    """
    track_from: str | None = None
    """With --track: the sweep's transform from probe to patient [ProbeToReference]."""
    rate: float | None = Field(None, ge=15, le=1000)
    """Steps a second in a window, as for a haptic device [60]; with a preset fast where nothing else
    chooses the tissue.
    """
    gamepad: bool = False
    """Use a gamepad beside mouse and keys."""
    keys: Path | None = None
    """Your own key map: a TOML file as printed by app.py keys."""
    plan: Path | None = None
    """A sweep to follow, or a resection to compare with: a file of app.py plan."""
    title: str | None = None
    """Title of window and report, instead of the scene's."""
    out: Path = Path("out")
    """Folder for images and report; a run without a window replaces those of an earlier one."""
    budget_ms: float | None = Field(None, ge=0.01, le=10_000)
    """Choose the most accurate resolution and iterations whose step takes no longer on this machine
    (measured first).
    """
    error_mm: float | None = Field(None, ge=0, le=100)
    """Choose the fastest resolution and iterations whose mean bead error (study trade) is no larger."""

    @property
    def preset(self) -> str | None:
        """The preset: of --quality, or the one for --rate."""
        chosen = self.set_by_user(*LEFT, *TISSUE_AND_STEP)
        return "fast" if self.rate is not None and not chosen else self.quality

    @property
    def leaves_patient_open(self) -> bool:
        """Whether nothing says which patient to rehearse, or what of it."""
        own = [name for name in type(self).model_fields if name not in OF_ANY_PATIENT]
        return not self.changes and not self.set_by_user(*own)

    def check(self) -> None:
        """Raises CommandError for options that exclude each other, and for one without another that it
        needs.
        """
        for table, wrong in ((EXCLUDING, 2), (NEEDING, 1)):
            for (first, second), text in table.items():
                if self.set_by_user(first) and len(self.set_by_user(first, second)) == wrong:
                    raise CommandError(text)
        choosers = [field for field in LEFT if self.set_by_user(field)]
        for option in self.set_by_user(*choosers, *OPTIONS) if self.replay else ():
            raise CommandError(f"{option}: a replay computes what was recorded; leave it out")
        for chooser in choosers[:1]:
            for option in self.set_by_user(
                *(field for field in TISSUE_AND_STEP if field not in LEFT[chooser])
            ):
                (other,) = self.set_by_user(chooser)
                raise CommandError(f"{option}: {other} chooses this too; leave one of them out")
