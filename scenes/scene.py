"""The scene file: what is modelled and how, one TOML file with a unit in the name of every key that has one.

Lengths are mm in patient coordinates (LPS), times s, angles degrees. ``load_scene`` refuses unknown keys, units
other than the schema's, and values out of range, each by name.
"""

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Literal

import tomli_w
from pydantic import AliasChoices, BaseModel, Field, ValidationError, model_validator

from errors import UserError, explained, meant
from scenes.section import Direction, Length, Section, Vector3
from scenes.tissue import TISSUES, NeoHookeanTissue, Tissue

# The scene that the program has with it.
EMBEDDED = Path(__file__).parent / "phantom.toml"
# The same patient, pressed with a transducer of the paper's size as deep as the paper does; what studies measure.
PAPER = Path(__file__).parent / "paper.toml"
# The command line's names for single values of a scene.
OPTIONS = {
    "tissue.model": "--model",
    "tissue.cell_mm": "--cell",
    "tissue.young_kpa": "--young-kpa",
    "tissue.poisson": "--poisson",
    "tissue.radius_mm": "--radius",
    "tissue.stiffness": "--stiffness",
    "solver.substeps": "--substeps",
    "solver.iterations": "--iterations",
    "transducer.probe": "--probe",
    "image.mode": "--picture",
    "image.detail_level": "--detail-level",
}


class SceneError(UserError):
    """A scene that cannot be used; the message is one line that says where, what was found and what to do."""


class AnatomyFiles(Section):
    """The embedded patient, or files beside the scene; without a CT there is no picture.

    ``parts`` are surfaces of what else is in the organ, by tissue. ``tissues`` says what each value of ``labels`` is for sound: a tissue of ``ultrasound/tissues.toml``.
    """

    phantom: bool = False
    organ: str = "organ.stl"
    tumour: str | None = None
    parts: dict[Literal["cyst", "urine", "vessel"], str] = Field(default_factory=dict)
    ct: str | None = None
    labels: str | None = None
    tissues: dict[Annotated[str, Field(pattern=r"^[1-9]\d*$")], str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_patient(self) -> "AnatomyFiles":
        named = (
            self.tumour or self.parts or self.ct or self.labels or self.tissues or self.organ != "organ.stl"
        )
        if self.phantom and named:
            raise ValueError(
                "phantom = true is the embedded patient, which has files of its own: name no others"
            )
        return self


class SolverSection(Section):
    """One time step. What is left out is the tissue model's own choice; that of shape matching is the paper's Table 1.

    ``relaxation`` (Eq. 7), ``stabilisation_iterations`` and ``mass_scaling_per_mm`` are shape matching's.
    """

    time_step_s: float = Field(1 / 60, gt=0, le=0.1)
    substeps: int | None = Field(None, ge=1, le=100)
    iterations: int | None = Field(None, ge=1, le=1000)
    stabilisation_iterations: int | None = Field(None, ge=0, le=100)
    relaxation: Literal["local", "global"] = "local"
    relaxation_factor: float | None = Field(None, ge=1, lt=2)
    damping_per_s: float = Field(12.0, ge=0, le=1000)
    mass_scaling_per_mm: float = Field(0.0, ge=0, le=1)


class Gravity(Section):
    acceleration_m_s2: float = Field(9.81, ge=0, le=100)
    direction: Direction = (0.0, 1.0, 0.0)


class Contact(Section):
    """``particles`` switches contacts of shape matching's particles with each other on."""

    shape_friction: float = Field(0.35, ge=0, le=10)
    particle_friction: float = Field(0.25, ge=0, le=10)
    particles: bool = False


class Attachment(Section):
    """Tissue that stays where it is, such as the hilum by its vessels: all within ``radius_mm`` of ``at_mm``; 0: none."""

    at_mm: Vector3 | None = None
    radius_mm: float = Field(0.0, ge=0, le=100)

    @model_validator(mode="after")
    def _somewhere(self) -> "Attachment":
        if self.radius_mm > 0 and self.at_mm is None:
            raise ValueError("attachment.radius_mm needs a place: give attachment.at_mm, or leave both out")
        return self


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


class Transducer(Section):
    """A probe, by the name of one that comes with the program or of a file beside the scene; it moves as fast as a hand.

    It is a cuboid, lateral x elevation x length: the probe's housing, unless ``size_mm`` says otherwise. The window warns where it
    squeezes the tissue before it by more than ``compression_warning_mm``.
    """

    probe: str = "linear"
    size_mm: tuple[Length, Length, Length] | None = None
    speed_mm_s: float = Field(150.0, gt=0, le=2000)
    compression_warning_mm: float = Field(8.0, gt=0, le=100)


class Trocar(Section):
    """A remote centre of motion: the shaft goes through ``at_mm``, within a cone, and bends at its end by a wrist.

    ``axis`` points into the body; without it, it is to what is to be seen. ``wrist_deg`` is how far the probe may look aside from
    the shaft: 0 for a stiff one. A scene without ``at_mm`` asks nothing of the way in.
    """

    at_mm: Vector3 | None = None
    axis: Direction | None = None
    cone_deg: float = Field(50.0, gt=0, le=90)
    wrist_deg: float = Field(90.0, ge=0, le=180)
    longest_mm: Length = 250.0


class Image(Section):
    """The ultrasound panel: which picture, its level of detail (``rung`` in scenes of version 1.0), and the CT window.

    The depth is the probe's, unless it is given. Sound leaves where the organ is nearer to the array than ``contact_gap_mm``; with
    ``contact`` "tissue", where anything but gas is.
    """

    mode: Literal["ct", "b-mode", "both"] = "both"
    detail_level: Literal["reflection", "speckle", "elevation"] = Field(
        "speckle", validation_alias=AliasChoices("detail_level", "rung")
    )
    depth_mm: float | None = Field(None, ge=5, le=300)
    pixels: int = Field(512, ge=16, le=4096)
    window_hu: float = Field(350.0, gt=0, le=10000)
    level_hu: float = Field(40.0, ge=-2000, le=4000)
    outside: Literal["background", "gel", "air"] = "background"
    contact: Literal["organ", "tissue"] = "organ"
    contact_gap_mm: float = Field(1.5, ge=0, le=20)


class Press(Section):
    """The scripted press, with the paper's warm-up and steps a stage.

    After the warm-up, in which the organ settles on its support, the transducer's axis goes through ``target_mm``
    along ``direction``, its image's width along ``lateral``; it starts where it just touches the organ and goes down
    to each of ``indentations_mm``.
    """

    target_mm: Vector3 | None = None
    direction: Direction | None = None
    lateral: Direction | None = None
    warm_up_steps: int = Field(120, ge=0, le=100000)
    stage_steps: int = Field(90, ge=1, le=100000)
    indentations_mm: tuple[Annotated[float, Field(ge=0, le=40)], ...] = (5.95, 9.48, 12.38)


class Scene(Section):
    """A whole scene. ``shape`` lists what does not move: the support first."""

    title: str = ""
    anatomy: AnatomyFiles
    tissue: Tissue = NeoHookeanTissue()
    solver: SolverSection = SolverSection()
    gravity: Gravity = Gravity()
    contact: Contact = Contact()
    attachment: Attachment = Attachment()
    shape: tuple[Annotated[PlaneShape | MeshShape | DistanceShape, Field(discriminator="kind")], ...] = ()
    transducer: Transducer = Transducer()
    trocar: Trocar = Trocar()
    image: Image = Image()
    press: Press = Press()

    @model_validator(mode="after")
    def _suits_its_tissue(self) -> "Scene":
        if self.contact.particles and not self.tissue.CAN_TOUCH_ITSELF:
            able = " or ".join(name for name, section in TISSUES.items() if section.CAN_TOUCH_ITSELF)
            raise ValueError(
                f"contact.particles = true needs particles: set tissue.model to {able}, or leave it out"
            )
        if self.attachment.radius_mm > 0 and not self.tissue.CAN_BE_HELD:
            able = " or ".join(name for name, section in TISSUES.items() if section.CAN_BE_HELD)
            raise ValueError(
                f"attachment.radius_mm holds nodes: set tissue.model to {able}, or the radius to 0"
            )
        return self


# What a file is that is given in a scene's place, by how its name ends, and what takes it.
NO_SCENES: dict[str | tuple[str, ...], str] = {
    ".igs.mha": "a tracked sweep: app.py reconstruct and rehearse --track take it",
    (
        ".dcm",
        ".nii",
        ".nii.gz",
        ".nrrd",
        ".mha",
        ".zip",
    ): "a CT or labels: app.py import makes a patient's folder of them",
    ".jsonl": "a session: rehearse --replay takes it",
    (".json", ".csv"): "a plan or poses: rehearse --plan, rehearse --track and scan --pose take them",
    (".stl", ".ply"): "a surface: a scene's [anatomy] names it",
    ".xml": "a PLUS configuration: reconstruct --config takes it",
    (".png", ".webp", ".jpg", ".jpeg"): "a picture",
}
EXPECTED = "expected a scene file (TOML) or a patient's folder"


def scene_file(named: Path) -> Path:
    """The scene file that a path names: itself, or that of a patient's folder. Raises SceneError."""
    if not named.is_dir():
        return named
    path = named / "scene.toml"
    if not path.is_file():
        if session := next(named.glob("session-*.jsonl"), None):
            raise SceneError(
                f"{named}: holds {session.name}, a session: rehearse --replay takes that file; {EXPECTED}"
            )
        raise SceneError(f"{named}: holds no scene.toml; make a patient's folder of a CT with: app.py import")
    return path


def load_scene(path: Path) -> Scene:
    """Read a scene file; a probe's file is named by its whole path. Raises SceneError with one line that names the file, the key and
    the mend.
    """
    for ends, what in NO_SCENES.items():
        if path.name.lower().endswith(ends) and path.is_file():
            raise SceneError(f"{path}: is {what}; {EXPECTED}")
    try:
        values = tomllib.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise SceneError(f"{path}: no such scene file or patient's folder") from None
    except UnicodeDecodeError:
        raise SceneError(f"{path}: is no text; {EXPECTED}") from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read as a scene ({_first_line(error)})") from None
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{path}: not valid TOML: {_first_line(error)}; {EXPECTED}") from None
    try:
        return _with_probe_beside(path, Scene.model_validate(values))
    except ValidationError as error:
        raise SceneError(f"{path}: {_explain(error)}") from None


def _with_probe_beside(path: Path, scene: Scene) -> Scene:
    """A scene that names its probe's file from anywhere; probes that come with the program have names without a suffix."""
    named = path.parent / scene.transducer.probe
    if not named.suffix:
        return scene
    transducer = scene.transducer.model_copy(update={"probe": str(named.resolve())})
    return scene.model_copy(update={"transducer": transducer})


def with_options(scene: Scene, options: Mapping[str, float | int | str | None]) -> Scene:
    """The scene with single values changed, such as ``{"tissue.radius_mm": 3.0}``; None leaves what is there.

    A value that only another tissue model has asks for that model, which starts from its own defaults. A probe's file is named
    from where the program was started, not from beside the scene. Raises SceneError for a value out of range, and for values of
    two models.
    """
    values = scene.model_dump(exclude_unset=True)
    asked = [name.removeprefix("tissue.") for name, value in options.items() if value is not None]
    model = options.get("tissue.model") or model_with(asked, scene.tissue.model)
    if model != scene.tissue.model:
        values["tissue"] = {"model": model}
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
            text = text.replace(key, option)
        raise SceneError(text) from None


def model_with(keys: Iterable[str], usual: str) -> str:
    """The tissue model that has all of some keys that belong to any: the usual one where it will do."""
    special = {key for key in keys if any(key in section.model_fields for section in TISSUES.values())}
    having = [name for name, section in TISSUES.items() if special <= set(section.model_fields)]
    return having[0] if having and usual not in having else usual


def scene_text(scene: Scene) -> str:
    """The scene as TOML, every key with its value, so that a reader finds what can be changed."""
    values = scene.model_dump(mode="json", exclude_none=True)
    return tomli_w.dumps(values)


def _explain(error: ValidationError) -> str:
    return explained(error, _unknown, tags=("plane", "mesh", "sdf"))


def _unknown(where: list[str]) -> str:
    """What is to be done about a key that is unknown here."""
    return _owner(where) or f"unknown key; {_suggest(where)}"


def _owner(where: list[str]) -> str:
    """Whose key it is that another tissue model does not have; empty where it is nobody's."""
    owners = [model for model, section in TISSUES.items() if where[-1] in section.model_fields]
    if where[0] != "tissue" or not owners:
        return ""
    return f"belongs to the tissue model {owners[0]}; choose it with tissue.model, or leave this out"


def _suggest(where: list[str]) -> str:
    """What the writer of an unknown key may have meant; a unit other than the schema's is named as such."""
    known = _keys_beside(where)
    key = where[-1]
    for name in known:
        if name != key and key.startswith(_quantity(name)) and _quantity(name) != name:
            return f"the unit is in the key: write {name}"
    if where == ["image", "width_mm"]:
        return "the picture is as wide as the probe's array (TransducerWidthMm in its file): leave this out"
    return meant(key, known)


def _quantity(name: str) -> str:
    """A key without its unit: radius_mm -> radius."""
    for unit in ("_mm2", "_mm", "_m_s2", "_mm_s", "_g_cm3", "_per_mm", "_per_s", "_deg", "_hu", "_s"):
        if name.endswith(unit):
            return name[: -len(unit)]
    return name


def _keys_beside(where: list[str]) -> list[str]:
    section: type[BaseModel] = Scene
    for part in where[:-1]:
        if part == "tissue":
            return sorted({key for kind in TISSUES.values() for key in kind.model_fields})
        if part == "shape":
            return sorted(
                {key for kind in (PlaneShape, MeshShape, DistanceShape) for key in kind.model_fields}
            )
        if part in section.model_fields:
            annotation = section.model_fields[part].annotation
            if isinstance(annotation, type) and issubclass(annotation, BaseModel):
                section = annotation
    return list(section.model_fields)


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]
