"""The scene file: one TOML file that states what is modelled and how; the unit is in the name of each key.

Lengths are mm in patient coordinates (LPS), times s, angles degrees. ``load_scene`` refuses unknown keys,
units other than the schema's, and values out of range, and names each.
"""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import AliasChoices, Field, ValidationError, model_validator

from errors import UserError, explained, meant
from scenes.section import LIST, Direction, Length, Vector3
from scenes.tissue import TISSUES, NeoHookeanTissue, Tissue
from settings import UNITS, Control, Key, Section, settings_in, settings_of
from text_files import TextError, read_toml
from version import FORMAT, of_this_format

# The scene of the embedded patient.
EMBEDDED = Path(__file__).parent / "phantom.toml"
# The same patient, with the transducer and the indentation depths of the paper; the studies use it.
PAPER = Path(__file__).parent / "paper.toml"
# Rigid shapes, and the probe's, have a bit each of a word of 31.
MOST_SHAPES = 30

UNIT = re.compile(f"_({'|'.join(UNITS)})$")


class SceneError(UserError):
    """A scene that cannot be used."""


LabelValue = Annotated[str, Field(pattern=r"^[1-9]\d*$")]


class AnatomyFiles(Section):
    """The embedded patient, or files in the scene's folder; without a CT there is no image.

    ``parts`` are further surfaces in the organ, by tissue. ``tissues`` maps each value of ``labels`` to a
    tissue of ``ultrasound/acoustic_tissues.toml``; ``corrected_tissues`` those of ``corrections``, a volume
    on any grid, 0 where the tissue is as labelled or classified.
    """

    phantom: bool = False
    organ: str = "organ.stl"
    tumour: str | None = None
    parts: dict[Literal["sinus", "vessel", "urine", "cyst"], str] = Field(default_factory=dict)
    ct: str | None = None
    labels: str | None = None
    tissues: dict[LabelValue, str] = Field(default_factory=dict)
    corrections: str | None = None
    corrected_tissues: dict[LabelValue, str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_patient(self) -> "AnatomyFiles":
        if self.phantom and self != AnatomyFiles.model_construct(phantom=True):
            raise ValueError(
                "phantom = true is the embedded patient, which has its own files: name no others"
            )
        return self


class SolverSection(Section):
    """One time step. Values that are left out are the tissue model's defaults; those of shape matching are
    the paper's Table 1.

    ``relaxation`` (Eq. 7), ``stabilisation_iterations`` and ``mass_scaling_per_mm`` belong to shape matching.
    """

    time_step_s: float = Field(1 / 60, gt=0, le=0.1)
    substeps: Annotated[int | None, "--substeps", Control("Substeps", "Tissue", 1, 10)] = Field(
        None, ge=1, le=100
    )
    """Substeps of a time step."""
    iterations: Annotated[int | None, "--iterations", Control("Iter.", "Tissue", 1, 40)] = Field(
        None, ge=1, le=1000
    )
    """Iterations of the solver in a substep."""
    stabilisation_iterations: int | None = Field(None, ge=0, le=100)
    relaxation: Literal["local", "global"] = "local"
    relaxation_factor: float | None = Field(None, ge=1, lt=2)
    damping_per_s: float = Field(12.0, ge=0, le=1000)
    mass_scaling_per_mm: float = Field(0.0, ge=0, le=1)


class Gravity(Section):
    acceleration_m_s2: Annotated[float, Control("g", "Tissue", 0, 20)] = Field(9.81, ge=0, le=100)
    direction: Direction = (0.0, 1.0, 0.0)


class Contact(Section):
    """``particles`` switches self-contact of shape matching's particles on."""

    shape_friction: float = Field(0.35, ge=0, le=10)
    particle_friction: float = Field(0.25, ge=0, le=10)
    particles: bool = False


class Attachment(Section):
    """What holds the organ: its pedicle at the hilum, and perirenal fat.

    The tissue within ``radius_mm`` of ``at_mm`` is tied to its place at rest by a tether of
    ``stiffness_n_mm`` in all; with 0 it is fixed. A radius of 0: no pedicle. ``fat_young_kpa`` is Young's
    modulus of the fat, whose thickness the CT shows; ``fat_kpa_mm`` the stiffness of the fat where no CT
    shows it. Both 0: no fat. The surgeon has removed it where the surface faces ``approach``, which points
    from the organ to him and is by default against the press, within ``freed_deg``; and where a tumour is
    nearer than ``freed_margin_mm``.
    """

    at_mm: Vector3 | None = None
    radius_mm: float = Field(0.0, ge=0, le=100)
    stiffness_n_mm: float = Field(0.0, ge=0, le=1000)
    fat_young_kpa: float = Field(0.0, ge=0, le=1000)
    fat_kpa_mm: float = Field(0.0, ge=0, le=1000)
    approach: Direction | None = None
    freed_deg: float = Field(90.0, ge=0, le=180)
    freed_margin_mm: float = Field(15.0, ge=0, le=100)

    @model_validator(mode="after")
    def _somewhere(self) -> "Attachment":
        if self.radius_mm > 0 and self.at_mm is None:
            raise ValueError(
                "attachment.radius_mm needs a position: give attachment.at_mm, or leave both out"
            )
        if self.stiffness_n_mm > 0 and self.radius_mm == 0:
            raise ValueError(
                "attachment.stiffness_n_mm needs the tissue that it holds: give attachment.radius_mm, or "
                "leave both out"
            )
        return self

    @property
    def has_fat(self) -> bool:
        """Whether there is perirenal fat."""
        return self.fat_young_kpa > 0 or self.fat_kpa_mm > 0

    @property
    def holds(self) -> bool:
        """Whether anything holds the organ."""
        return self.radius_mm > 0 or self.has_fat


class PlaneShape(Section):
    kind: Literal["plane"]
    normal: Direction
    offset_mm: float


class MeshShape(Section):
    """A closed surface in STL, PLY or OBJ."""

    kind: Literal["mesh"]
    file: str


class DistanceShape(Section):
    """A volume of signed distances in mm, negative inside (NRRD, MHA or NIfTI, axes along the patient's)."""

    kind: Literal["sdf"]
    file: str


Shape = Annotated[PlaneShape | MeshShape | DistanceShape, Field(discriminator="kind")]


# Of a probe's housing, as in its file.
ProbeLength = Annotated[float, Field(gt=0, le=150)]


class Transducer(Section):
    """A probe: the name of one in ``ultrasound/probes``, or of a file in the scene's folder; it moves at
    ``speed_mm_s`` at most.

    Its shape is a cuboid, lateral x elevation x length: the probe's housing, or ``size_mm``. The window warns
    where the tissue under it is compressed by more than ``compression_warning_mm``. It presses with at most
    ``force_limit_n``: where the hand asks for more, the probe stays behind it.
    """

    probe: Annotated[str, "--probe"] = "drop-in"
    """Probe, by its name or as a file."""
    size_mm: Annotated[tuple[ProbeLength, ProbeLength, ProbeLength], LIST] | None = None
    speed_mm_s: float = Field(150.0, gt=0, le=2000)
    compression_warning_mm: float = Field(8.0, gt=0, le=100)
    force_limit_n: float = Field(10.0, gt=0, le=100)


class Trocar(Section):
    """The instrument's port, a remote centre of motion: the shaft passes ``at_mm``, within a cone, and ends
    in a wrist.

    ``axis`` points into the body; its default is the direction to the target. ``wrist_deg`` is the largest
    angle between probe and shaft: 0 for a rigid one. Without ``at_mm`` the instrument's path is not checked.
    """

    at_mm: Annotated[Vector3 | None, "--trocar"] = None
    """Position of the trocar: x y z, LPS, mm."""
    axis: Direction | None = None
    cone_deg: Annotated[float, "--cone-deg"] = Field(50.0, gt=0, le=90)
    """Largest angle of the shaft to the axis of the trocar."""
    wrist_deg: Annotated[float, "--wrist-deg"] = Field(90.0, ge=0, le=180)
    """Largest angle of the probe to the shaft."""
    longest_mm: Length = 250.0


class Image(Section):
    """The ultrasound panel: the kind of image, its detail level (``rung`` in scenes of version 1.0), and the
    CT window.

    The default depth is the probe's. An element is in contact where the organ is in front of it, nearer
    than ``contact_gap_mm``; with ``contact`` "tissue", where the CT shows anything but gas there.
    ``outside`` "fluid": a layer of irrigation fluid of ``fluid_gap_mm`` covers the organ, through which
    elements are in contact too; in front of it is gas. Between two wet surfaces capillarity alone holds water
    up to twice its capillary length, 2 x 2.7 mm; the default is an estimate of what it holds while the
    assistant irrigates: the ends of a flat array of 36 mm are 8 mm above a surface with a radius of 24 mm.
    With ``atlas``, what the CT cannot show is drawn from an atlas: pyramids without enhancement, the renal
    fascia, layers in muscle.
    """

    mode: Annotated[
        Literal["both", "b-mode", "ct"],
        "--picture",
        Key("B", "Image", "B-mode and CT, B-mode alone, CT alone"),
    ] = "both"
    """B-mode, CT or both."""
    detail_level: Annotated[
        Literal["reflection", "speckle", "elevation"],
        "--detail-level",
        Key("V", "Image", "detail level of the B-mode image"),
    ] = Field("speckle", validation_alias=AliasChoices("detail_level", "rung"))
    """Detail level (realism) of the B-mode image."""
    depth_mm: float | None = Field(None, ge=5, le=300)
    pixels: int = Field(512, ge=16, le=4096)
    window_hu: Annotated[float, Control("W", "Image", 1, 2000, is_whole=True)] = Field(350.0, gt=0, le=10000)
    level_hu: Annotated[float, Control("L", "Image", -500, 500, is_whole=True)] = Field(
        40.0, ge=-2000, le=4000
    )
    outside: Literal["background", "gel", "air", "fluid"] = "background"
    contact: Literal["organ", "tissue"] = "organ"
    contact_gap_mm: float = Field(1.5, ge=0, le=20)
    fluid_gap_mm: float = Field(8.0, ge=0, le=10)
    atlas: Annotated[bool, "--atlas/--no-atlas"] = True
    """Draw from an atlas what the CT cannot show: pyramids without enhancement, the renal fascia, layers in
    muscle.
    """

    @model_validator(mode="after")
    def _fluid_is_on_the_organ(self) -> "Image":
        if self.outside == "fluid" and self.contact != "organ":
            raise ValueError(
                f'image.outside = "fluid" couples the array to the organ, image.contact is "{self.contact}": '
                'set it to "organ", or leave it out'
            )
        return self

    @property
    def coupling_gap_mm(self) -> float:
        """The distance from the organ up to which an element is in contact, through gel or fluid [mm]."""
        return max(self.contact_gap_mm, self.fluid_gap_mm) if self.outside == "fluid" else self.contact_gap_mm


class Press(Section):
    """The scripted press, with the paper's warm-up and number of steps per stage.

    After the warm-up, in which the organ settles on its support, the transducer's axis passes ``target_mm``
    along ``direction``, with the image's lateral axis along ``lateral``. It starts where it just touches the
    organ and presses to each of ``indentations_mm``, by default within the default
    ``compression_warning_mm``.
    """

    target_mm: Vector3 | None = None
    direction: Direction | None = None
    lateral: Direction | None = None
    warm_up_steps: int = Field(120, ge=0, le=100000)
    stage_steps: int = Field(90, ge=1, le=100000)
    indentations_mm: Annotated[tuple[Annotated[float, Field(ge=0, le=40)], ...], LIST] = (2.0, 4.0, 6.0)


class Scene(Section):
    """A scene.

    ``nephron_scene`` is the format; scenes without it are read as those of this version. ``shape`` lists the
    rigid shapes: the support first. ``uncertainty`` is a file of ``study uncertainty``.
    """

    nephron_scene: int = FORMAT
    title: str = ""
    uncertainty: str | None = None
    anatomy: AnatomyFiles
    tissue: Tissue = NeoHookeanTissue()
    solver: SolverSection = SolverSection()
    gravity: Gravity = Gravity()
    contact: Contact = Contact()
    attachment: Attachment = Attachment()
    shape: Annotated[tuple[Shape, ...], LIST, Field(max_length=MOST_SHAPES)] = ()
    transducer: Transducer = Transducer()
    trocar: Trocar = Trocar()
    image: Image = Image()
    press: Press = Press()

    @model_validator(mode="before")
    @classmethod
    def _has_this_format(cls, values: Any) -> Any:
        return of_this_format(values, "nephron_scene")

    @model_validator(mode="after")
    def _has_its_parts(self) -> "Scene":
        anatomy = self.anatomy
        has = {*anatomy.parts, *(["tumour"] if anatomy.tumour else [])}
        for name in getattr(self.tissue, "parts", {}):
            if name not in has and not anatomy.phantom:
                where = "anatomy.tumour" if name == "tumour" else f"anatomy.parts.{name}"
                raise ValueError(f"tissue.parts.{name} needs a surface: give {where}, or leave it out")
        return self

    @model_validator(mode="after")
    def _suits_its_tissue(self) -> "Scene":
        for wanted, support, refusal in (
            (
                self.contact.particles,
                "self_contact",
                "contact.particles = true needs particles: {}, or leave it out",
            ),
            (
                self.attachment.holds,
                "attachment",
                "attachment.radius_mm, fat_young_kpa and fat_kpa_mm hold nodes: {}, or them to 0",
            ),
        ):
            able = [name for name, tissue in TISSUES.items() if getattr(tissue, f"supports_{support}")]
            if wanted and self.tissue.model not in able:
                raise ValueError(refusal.format(f"set tissue.model to {' or '.join(able)}"))
        return self


# The settings of a scene, of each tissue model, and what options of the command line change of them: path ->
# option.
SETTINGS = (
    *(setting for model in TISSUES.values() for setting in settings_of("tissue", model)),
    *(setting for setting in settings_in(Scene) if not setting.path.startswith("tissue.")),
)
OPTIONS = {setting.path: setting.option for setting in SETTINGS if setting.option is not None}


# Files that are given by mistake instead of a scene, by the end of their names, and the commands that read
# them.
NOT_SCENES: dict[str | tuple[str, ...], str] = {
    (".igs.mha", ".igs.nrrd"): "a tracked sweep: give it to app.py reconstruct or rehearse --track",
    (
        ".dcm",
        ".nii",
        ".nii.gz",
        ".nrrd",
        ".mha",
        ".zip",
    ): "a CT or labels: app.py import makes a patient's folder from them",
    ".jsonl": "a session: give it to rehearse --replay",
    (".json", ".csv"): "a plan or poses: give it to rehearse --plan, rehearse --track or scan --pose",
    (".stl", ".ply"): "a surface: name it in a scene's [anatomy]",
    ".xml": "a PLUS configuration: give it to reconstruct --config",
    (".png", ".webp", ".jpg", ".jpeg"): "a picture",
}
EXPECTED = "expected a scene file (TOML in UTF-8) or a patient's folder"


def scene_file(named: Path) -> Path:
    """A path to a scene file: ``named`` itself, or scene.toml of a patient's folder. Raises SceneError."""
    if not named.is_dir():
        return named
    path = named / "scene.toml"
    if not path.is_file():
        if session := next(named.glob("session-*.jsonl"), None):
            raise SceneError(
                f"{named}: contains {session.name}, a session: give that file to rehearse --replay; "
                f"{EXPECTED}"
            )
        raise SceneError(f"{named}: has no scene.toml; make a patient's folder from a CT with: app.py import")
    return path


def load_scene(path: Path) -> Scene:
    """Read a scene file; a probe's file gets its absolute path.

    Raises SceneError that names the file, the key and the remedy.
    """
    for ends, what in NOT_SCENES.items():
        if path.name.lower().endswith(ends) and path.is_file():
            raise SceneError(f"{path}: is {what}; {EXPECTED}")
    try:
        values = read_toml(path)
    except (FileNotFoundError, NotADirectoryError):
        raise SceneError(f"{path}: no such scene file or patient's folder") from None
    except TextError as error:
        raise SceneError(f"{path}: cannot be read ({error}); {EXPECTED}") from None
    try:
        scene = Scene.model_validate(values)
    except ValidationError as error:
        raise SceneError(f"{path}: {_explain(error)}") from None
    # The program's own probes have names without a suffix.
    beside = path.parent / scene.transducer.probe
    if not beside.suffix:
        return scene
    transducer = scene.transducer.model_copy(update={"probe": str(beside.resolve())})
    return scene.model_copy(update={"transducer": transducer})


def with_options(scene: Scene, options: Mapping[str, float | int | str | None]) -> Scene:
    """The scene with single values changed, such as ``{"tissue.radius_mm": 3.0}``; None leaves what is there.

    A value that only another tissue model has selects that model, which starts from its own defaults, and
    without an attachment where it has none. A probe's file is named
    from where the program was started, not from beside the scene. Raises SceneError for a value out of range,
    and for values of two models.
    """
    values = scene.model_dump(exclude_unset=True)
    changed = [name.removeprefix("tissue.") for name, value in options.items() if value is not None]
    model = str(options.get("tissue.model") or model_with(changed, scene.tissue.model))
    if model != scene.tissue.model:
        values["tissue"] = {"model": model}
        if not TISSUES[model].supports_attachment:
            values.pop("attachment", None)
    for name, value in options.items():
        if value is not None:
            section, key = name.split(".")
            is_file = name == "transducer.probe" and Path(str(value)).is_file()
            values.setdefault(section, {})[key] = str(Path(str(value)).resolve()) if is_file else value
    try:
        return Scene.model_validate(values)
    except ValidationError as error:
        text = _explain(error)
        for key, option in OPTIONS.items():
            text = re.sub(rf"\b{re.escape(key)}(\.\d+)?\b", option, text)
        raise SceneError(text) from None


def model_with(keys: Iterable[str], usual: str) -> str:
    """A tissue model that has all of the given keys of tissue models: ``usual`` where it has them."""
    special = {key for key in keys if any(key in section.model_fields for section in TISSUES.values())}
    having = [name for name, section in TISSUES.items() if special <= set(section.model_fields)]
    return having[0] if having and usual not in having else usual


def scene_text(scene: Scene) -> str:
    """The scene as TOML with the value of every key."""
    values = scene.model_dump(mode="json", exclude_none=True)
    return tomli_w.dumps(values)


def _explain(error: ValidationError) -> str:
    return explained(error, _unknown, tags=("plane", "mesh", "sdf"))


def _unknown(where: list[str]) -> str:
    """The advice for an unknown key: the model that it belongs to, its unit, or the likely intended key."""
    *sections, key = where
    owners = [model for model, section in TISSUES.items() if key in section.model_fields]
    if sections == ["tissue"] and owners:
        return f"belongs to the tissue model {owners[0]}; choose it with tissue.model, or leave this out"
    if where == ["image", "width_mm"]:
        return (
            "unknown key; the picture is as wide as the probe's array (TransducerWidthMm in its file): "
            "leave this out"
        )
    kinds: Iterable[Any] = [Scene]
    if sections:
        kinds = {"tissue": TISSUES.values(), "shape": (PlaneShape, MeshShape, DistanceShape)}.get(
            sections[0], [Scene.model_fields[sections[0]].annotation]
        )
    known = list(dict.fromkeys(name for kind in kinds for name in kind.model_fields))
    for name in known:
        quantity = UNIT.sub("", name)
        if name not in (key, quantity) and key.startswith(quantity):
            return f"unknown key; the unit is in the key: write {name}"
    return f"unknown key; {meant(key, known)}"
