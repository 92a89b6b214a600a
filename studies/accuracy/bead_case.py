"""Files of a bead experiment: an organ on its support, pressed stage by stage, with beads measured at each
stage.

A case is a folder with ``case.toml`` (``CaseFile`` below), two closed surfaces and a table of beads. Lengths
are mm in the frame of the organ's surface. Other keys are ignored.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import trimesh
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from errors import PatientError, UserError, explained
from scenes.section import LIST, Direction, Length, Vector3
from scenes.surfaces import load_surface
from sim.attachment import FixedRegion
from sim.material import Material, Part
from sim.signed_distance import signed_distance
from studies.number_table import read_numbers
from text_files import TextError, read_toml

# The paper's, where a case has none.
DENSITY_KG_M3 = 1050.0
UNITS = ("_mm", "_kPa", "_N")
# Between the nominal indentation and the measured position of the probe.
MOST_APART_MM = 0.5


class CaseError(UserError):
    """A case that cannot be used; the message is one line with file, what was found and what to do."""


def _proper(rows: tuple[Vector3, Vector3, Vector3]) -> tuple[Vector3, Vector3, Vector3]:
    matrix = np.array(rows)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-4 or np.linalg.det(matrix) < 0:
        raise ValueError("expected a rotation matrix: orthonormal rows, determinant 1")
    return rows


Rotation = Annotated[tuple[Vector3, Vector3, Vector3], LIST, AfterValidator(_proper)]


class CaseSection(BaseModel):
    """A table of case.toml.

    Other keys are ignored, unless they are a known key in another unit. A text is no number.
    """

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False, strict=True)

    @model_validator(mode="after")
    def _own_units(self) -> "CaseSection":
        for known in type(self).model_fields:
            quantity = known.removesuffix(next((unit for unit in UNITS if known.endswith(unit)), ""))
            for key in self.model_extra or {}:
                if quantity != known and key.rpartition("_")[0] == quantity:
                    raise ValueError(f"{key}: the unit is in the key; write {known}")
        return self


class Units(CaseSection):
    length: Literal["mm"]
    acceleration: Literal["m/s^2"]
    pressure: Literal["kPa"] = "kPa"
    density: Literal["kg/m^3"] = "kg/m^3"


class CaseGravity(CaseSection):
    g: float = Field(ge=0, le=100)
    direction: Direction


class CasePart(CaseSection):
    """A part of the organ within a closed surface, with its own material."""

    name: str
    surface: str
    young_kPa: float = Field(gt=0, le=1e6)
    poisson: float = Field(ge=0, le=0.4999)
    density: float = Field(DENSITY_KG_M3, ge=100, le=20000)


class CaseMaterial(CaseSection):
    """Material of the tissue outside the parts; not every model needs all of it."""

    young_kPa: float | None = Field(None, gt=0, le=1e6)
    poisson: float | None = Field(None, ge=0, lt=0.5)
    density: float | None = Field(None, ge=100, le=20000)
    part: Annotated[tuple[CasePart, ...], LIST] = ()


class CaseContact(CaseSection):
    """Coulomb friction, the same on support and probe."""

    friction_coefficient: float = Field(0.35, ge=0, le=10)
    friction_on_support: Literal[True] = True
    friction_on_probe: Literal[True] = True


class Files(CaseSection):
    kidney: str = "kidney.stl"
    support: str = "support.stl"
    beads: str = "beads.csv"


class CaseProbe(CaseSection):
    """A cuboid: full lengths along its axes, the columns of ``rotation``; its edges are rounded inside."""

    shape: Literal["cuboid"]
    size_mm: tuple[Length, ...] = Field(min_length=3, max_length=3, strict=False)
    edge_radius_mm: float = Field(0.0, ge=0)
    press_direction: Direction
    rotation: Rotation

    @model_validator(mode="after")
    def _room_for_edges(self) -> "CaseProbe":
        if self.edge_radius_mm > min(self.size_mm) / 2:
            raise ValueError(
                f"edge_radius_mm is {self.edge_radius_mm:g}: expected at most half of the least of size_mm"
            )
        return self


class CaseHold(CaseSection):
    """A ball in which the tissue stays at its stress-free place."""

    shape: Literal["sphere"]
    centre: Vector3
    radius_mm: float = Field(gt=0, le=500)


class CaseStage(CaseSection):
    """Centre of the probe and its travel since stage 0; with its own rotation if it has turned.

    ``slide_mm``: how far it moved sideways from the line of the press. ``probe_force_N``: the probe's force
    on the tissue.
    """

    index: int
    indentation_mm: float = Field(ge=0, le=500)
    slide_mm: float | None = None
    probe_force_N: Vector3 | None = None
    position: Vector3
    rotation: Rotation | None = None


class CaseFile(CaseSection):
    """``case.toml``."""

    format_version: Literal[1]
    name: str = ""
    units: Units
    gravity: CaseGravity
    material: CaseMaterial = CaseMaterial()
    contact: CaseContact = CaseContact()
    files: Files = Files()
    probe: CaseProbe
    hold: Annotated[tuple[CaseHold, ...], LIST] = ()
    stage: tuple[CaseStage, ...] = Field(min_length=2, strict=False)

    @model_validator(mode="after")
    def _in_order(self) -> "CaseFile":
        first, direction = self.stage[0], _unit(self.probe.press_direction)
        for place, stage in enumerate(self.stage):
            if stage.index != place:
                raise ValueError(f"stage {place} has index {stage.index}: list the stages in order, from 0")
            if place == 0 and stage.indentation_mm != 0:
                raise ValueError(
                    f"stage 0 has indentation_mm {stage.indentation_mm:g}: expected 0, just touching"
                )
            slides = stage.slide_mm is not None
            if place > 0 and not slides and stage.indentation_mm <= self.stage[place - 1].indentation_mm:
                raise ValueError(
                    f"stage {place} has indentation_mm {stage.indentation_mm:g}: expected more than "
                    f"{self.stage[place - 1].indentation_mm:g} of the stage before"
                )
            along = float((np.array(stage.position) - first.position) @ direction)
            if abs(along - stage.indentation_mm) > MOST_APART_MM:
                raise ValueError(
                    f"stage {place} has indentation_mm {stage.indentation_mm:g}, but its position is "
                    f"{along:.2f} mm from stage 0's along press_direction: correct one of them"
                )
        return self


@dataclass(frozen=True, eq=False)
class BeadCase:
    """One experiment: float64, mm, in the frame of the organ's stress-free surface.

    ``beads`` (n, 3) stress-free, ``measured`` (stages, n, 3), ``poses`` (stages, 4, 4) world from probe,
    ``indentation_mm`` (stages,), ``press_direction`` (3,) unit, ``size_mm`` (3,), ``gravity`` (3,) in mm/s^2.
    Unknown material values are None. ``parts`` have their own material; tissue in the regions ``fixed`` does
    not move. ``probe_force_n`` (stages, 3) [N] is the tissue's force on the probe, NaN where unknown.
    ``digest`` is a hash of all files.
    """

    name: str
    digest: str
    organ: trimesh.Trimesh
    support: trimesh.Trimesh
    beads: np.ndarray
    measured: np.ndarray
    poses: np.ndarray
    indentation_mm: np.ndarray
    press_direction: np.ndarray
    size_mm: np.ndarray
    edge_radius_mm: float
    gravity: np.ndarray
    friction: float
    young_kpa: float | None
    poisson: float | None
    density_kg_m3: float | None
    parts: tuple[Part, ...]
    fixed: tuple[FixedRegion, ...]
    probe_force_n: np.ndarray


def load_case(folder: Path) -> BeadCase:
    """Read a case folder. Raises CaseError with one line."""
    file = _read_file(folder)
    probe, material, files = file.probe, file.material, file.files
    organ, support = _surface(folder, files.kidney), _surface(folder, files.support)
    beads, measured, lines = _read_beads(folder / files.beads, len(file.stage))
    _check_beads(folder / files.beads, beads, measured, lines, organ)
    poses = np.tile(np.eye(4), (len(file.stage), 1, 1))
    poses[:, :3, :3] = [stage.rotation or probe.rotation for stage in file.stage]
    poses[:, :3, 3] = [stage.position for stage in file.stage]
    names = ("case.toml", files.kidney, files.support, files.beads, *(part.surface for part in material.part))
    parts = tuple(_part(folder, part) for part in material.part)
    contents = [folder / name for name in names]
    return BeadCase(
        name=file.name or folder.resolve().name,
        digest=hashlib.sha256(b"".join(path.read_bytes() for path in contents)).hexdigest(),
        organ=organ,
        support=support,
        beads=beads,
        measured=measured,
        poses=poses,
        indentation_mm=np.array([stage.indentation_mm for stage in file.stage]),
        press_direction=_unit(probe.press_direction),
        size_mm=np.array(probe.size_mm),
        edge_radius_mm=probe.edge_radius_mm,
        gravity=1000.0 * file.gravity.g * _unit(file.gravity.direction),
        friction=file.contact.friction_coefficient,
        young_kpa=material.young_kPa,
        poisson=material.poisson,
        density_kg_m3=material.density,
        parts=parts,
        fixed=tuple(FixedRegion(np.array(hold.centre), hold.radius_mm) for hold in file.hold),
        probe_force_n=-np.array([stage.probe_force_N or (np.nan,) * 3 for stage in file.stage]),
    )


def _part(folder: Path, part: CasePart) -> Part:
    return Part(
        part.name, _surface(folder, part.surface), Material(part.young_kPa, part.poisson, part.density / 1000)
    )


def _read_file(folder: Path) -> CaseFile:
    path = folder / "case.toml"
    try:
        return CaseFile.model_validate(read_toml(path))
    except (FileNotFoundError, NotADirectoryError):
        raise CaseError(
            f"{folder}: holds no case.toml; name a folder with case.toml, two STL surfaces and beads.csv"
        ) from None
    except TextError as error:
        raise CaseError(f"{path}: cannot be read ({error}); expected TOML in UTF-8") from None
    except ValidationError as error:
        raise CaseError(f"{path}: {explained(error)}; correct it there") from None


def _surface(folder: Path, name: str) -> trimesh.Trimesh:
    try:
        return load_surface(folder / name)
    except PatientError as error:
        raise CaseError(str(error)) from None


def _read_beads(path: Path, stages: int) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Beads (n, 3) stress-free and (stages, n, 3) measured [mm], and their lines in the file (n,)."""
    columns = [f"{axis}{stage}" for stage in ("", *range(stages)) for axis in "xyz"]
    values, lines = read_numbers(path, columns, CaseError)
    positions = values.reshape(len(values), stages + 1, 3).transpose(1, 0, 2)
    return positions[0].copy(), positions[1:].copy(), lines


def _check_beads(
    path: Path, beads: np.ndarray, measured: np.ndarray, lines: list[int], organ: trimesh.Trimesh
) -> None:
    outside = signed_distance(organ.vertices, organ.faces, beads)[0]
    if outside.max() > 0:
        raise CaseError(
            f"{path}: the bead on line {lines[outside.argmax()]} is {outside.max():.2f} mm outside the organ "
            "at x, y, z: expected a place inside, in mm in the organ's frame"
        )
    moved = np.linalg.norm(measured - beads, axis=2)
    stage, bead = np.unravel_index(moved.argmax(), moved.shape)
    if moved.max() > organ.extents.max():
        raise CaseError(
            f"{path}: the bead on line {lines[bead]} is {moved.max():.0f} mm from its stress-free place at "
            f"stage {stage}: expected less than the organ's length, in mm in the organ's frame"
        )


def _unit(direction: Vector3) -> np.ndarray:
    return np.array(direction) / np.linalg.norm(direction)
