"""Arrays as text for a session's file, without loss of bits: poses, the coverage, and whole states of a
rehearsal.
"""

import base64
import io
import json
import math
import struct
import zipfile
import zlib
from dataclasses import asdict, replace
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, with_config
from typing_extensions import TypedDict

from rehearsal.loop.command import LEAST_STEP_S, MOST_STEP_S
from rehearsal.loop.state import WholeState
from rehearsal.pressed_organ import OrganState
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.resection_state import MOST_MARKS, CutRequest, Resection
from sim.body import BodyState
from sim.divergence_check import FARTHEST_MM, DivergenceState
from sim.solver import SolverState

# Of a pose, all but its last row.
NUMBERS = 12
# Of a wrench: force and torque.
COMPONENTS = 6
# A second has fewer steps; a grid of 1.5 mm over half a metre fewer voxels; all arrays of a body of a million
# particles fewer bytes.
MOST_STEPS, MOST_VOXELS, MOST_BYTES = 1_000_000, 100_000_000, 1 << 30

# What NumPy and zipfile raise for unreadable data.
UNREADABLE = (
    *(ValueError, LookupError, TypeError, RuntimeError, OSError, EOFError, MemoryError, ArithmeticError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)


class StateError(ValueError):
    """A text that is no state of this body."""


@with_config(ConfigDict(extra="forbid", strict=True))
class SeenVoxels(TypedDict):
    """``shape``: voxels along x, y and z.

    ``bits``: one for each, the last axis fastest; packed, zipped, as base64.
    """

    shape: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=3, max_length=3)]
    bits: str


def _packed(array: np.ndarray) -> str:
    return _as_text(zlib.compress(array.tobytes()))


def _as_text(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _unpacked(text: str, most: int) -> bytes:
    """At most so many bytes of a text. Raises ValueError."""
    unzip = zlib.decompressobj()
    try:
        content = unzip.decompress(base64.b64decode(text, validate=True), most)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if not unzip.eof:
        raise ValueError("a packed array that is cut off or too long")
    return content


def pack_poses(poses: list[np.ndarray]) -> str:
    """Poses (4, 4)."""
    rows = np.array([np.asarray(pose, float)[:3].ravel() for pose in poses])
    return _packed(rows.astype("<f8"))


def unpack_poses(text: str) -> np.ndarray:
    """Poses (n, 4, 4). Raises ValueError."""
    rows = np.frombuffer(_unpacked(text, MOST_STEPS * NUMBERS * 8), "<f8").reshape(-1, NUMBERS)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    if not np.isfinite(poses).all():
        raise ValueError("a pose that is not finite")
    return poses


def pack_wrenches(wrenches: list[np.ndarray | None]) -> str:
    """Wrenches (6,) [N, N mm] on the probe, or None where there is none."""
    rows = np.full((len(wrenches), COMPONENTS), np.nan)
    for row, wrench in zip(rows, wrenches, strict=True):
        if wrench is not None:
            row[:] = wrench
    return _packed(rows.astype("<f4"))


def unpack_wrenches(text: str) -> np.ndarray:
    """Wrenches (n, 6) [N, N mm], NaN where there is none. Raises ValueError."""
    rows = np.frombuffer(_unpacked(text, MOST_STEPS * COMPONENTS * 4), "<f4")
    if np.isinf(rows).any():
        raise ValueError("a force that is not finite")
    return rows.reshape(-1, COMPONENTS)


def pack_lengths(lengths_s: list[float]) -> str:
    """The lengths of steps [s]."""
    return _packed(np.array(lengths_s, "<f8"))


def unpack_lengths(text: str) -> np.ndarray:
    """The lengths (n,) of steps [s]. Raises ValueError."""
    lengths_s = np.frombuffer(_unpacked(text, MOST_STEPS * 8), "<f8")
    if not ((lengths_s >= LEAST_STEP_S) & (lengths_s <= MOST_STEP_S)).all():
        raise ValueError(f"a step that is not {LEAST_STEP_S:g} to {MOST_STEP_S:g} s long")
    return lengths_s


def pack_bits(bits: list[bool]) -> str:
    """Yes or no, for each of some steps."""
    return _packed(np.packbits(bits))


def unpack_bits(text: str, count: int) -> np.ndarray:
    """So many bits (n,). Raises ValueError."""
    octets = _unpacked(text, -(-count // 8) + 1)
    if len(octets) != -(-count // 8):
        raise ValueError(f"bits of other than its {count} steps")
    return np.unpackbits(np.frombuffer(octets, np.uint8), count=count).view(bool)


def pack_seen(seen: np.ndarray) -> SeenVoxels:
    """Which voxels (nx, ny, nz) were imaged."""
    return SeenVoxels(shape=list(seen.shape), bits=_packed(np.packbits(seen)))


def unpack_seen(packed: SeenVoxels) -> np.ndarray:
    """Which voxels (nx, ny, nz) were imaged. Raises ValueError."""
    count = math.prod(packed["shape"])
    if count > MOST_VOXELS:
        raise ValueError(f"{count} voxels, expected at most {MOST_VOXELS}")
    return unpack_bits(packed["bits"], count).reshape(packed["shape"])


def _unpackable(packed: SeenVoxels) -> SeenVoxels:
    unpack_seen(packed)
    return packed


# As a file has it.
Seen = Annotated[SeenVoxels, AfterValidator(_unpackable)]


def pack_state(state: WholeState) -> str:
    """A whole state, without its manipulator."""
    organ, check = state.organ, state.organ.divergence
    now, good = _of_solver("now", organ.solver), _of_solver("good", check.good)
    arrays: dict[str, Any] = {
        **now,
        **({} if all(map(np.array_equal, now.values(), good.values())) else good),
        "pose": organ.pose,
        "since_good_s": check.since_good_s,
        "numbers": [organ.steps, check.steps_since_good, check.steps_tangled, check.is_restored],
        **_of_resection(state.resection),
    }
    packed = io.BytesIO()
    np.savez_compressed(packed, allow_pickle=False, **arrays)
    return _as_text(packed.getvalue())


def unpack_state(text: str, positions: np.ndarray) -> WholeState:
    """A state of the body that has positions (n, 3) [mm]. Raises StateError."""
    try:
        packed = zipfile.ZipFile(io.BytesIO(base64.b64decode(text, validate=True)))
        if sum(member.file_size for member in packed.infolist()) > MOST_BYTES:
            raise StateError("a state that is too large")
        arrays = dict(np.load(io.BytesIO(packed.fp.getvalue()), allow_pickle=False))  # type: ignore[union-attr]
        now = _solver(arrays, "now", positions)
        steps, since_good, tangled, restored = map(int, arrays["numbers"])
        good = _solver(arrays, "good", positions) if "good.position" in arrays else now
        since_good_s = float(arrays["since_good_s"])
        if not np.isfinite(since_good_s):
            raise StateError("a time that is not finite")
        check = DivergenceState(good, since_good, tangled, bool(restored), since_good_s)
        pose = _pose(arrays, "pose")
        resection = _resection(arrays, positions.shape)
    except UNREADABLE as error:
        what = str(error) or "damaged"
        raise StateError(f"a state that cannot be used ({what.splitlines()[0]})") from None
    return WholeState(OrganState(now, check, pose, steps), resection)


def _of_resection(resection: Resection) -> dict[str, Any]:
    """The arrays of a resection: none before its first mark."""
    if not resection.marks:
        return {}
    marks = {"resection.marks": resection.points()}
    cut = resection.cut
    if cut is None:
        return marks
    return marks | {
        "resection.settings": json.dumps(asdict(cut.settings)),
        "resection.seen": np.frombuffer(cut.seen, np.uint8),
        "resection.nodes": cut.nodes_mm.astype(np.float32),
    }


def _resection(arrays: dict[str, np.ndarray], nodes: tuple[int, ...]) -> Resection:
    if "resection.marks" not in arrays:
        return Resection()
    places = arrays["resection.marks"].reshape(-1, 3)
    if len(places) > MOST_MARKS or not (np.abs(places) <= FARTHEST_MM).all():
        raise StateError("marks that are no places on the organ")
    marks = Resection().with_marks(places)
    if "resection.settings" not in arrays:
        return marks
    settings = TypeAdapter(CutSettings).validate_python(json.loads(str(arrays["resection.settings"])))
    position = arrays["resection.nodes"]
    if position.shape != nodes or position.dtype != np.float32 or not (np.abs(position) <= FARTHEST_MM).all():
        raise StateError("a cut of another body")
    return replace(marks, cut=CutRequest(settings, arrays["resection.seen"].tobytes(), position.tobytes()))


def _pose(arrays: dict[str, np.ndarray], name: str) -> np.ndarray:
    pose = arrays[name]
    if pose.shape != (4, 4) or pose.dtype != float or not np.isfinite(pose).all():
        raise StateError(f"{name} is no pose")
    return pose


def _of_solver(name: str, state: SolverState) -> dict[str, np.ndarray]:
    contacts = {f"{name}.contacts.{key}": values for key, values in state.internal_state.items()}
    return {f"{name}.position": state.body.position, f"{name}.velocity": state.body.velocity} | contacts


def _solver(arrays: dict[str, np.ndarray], name: str, positions: np.ndarray) -> SolverState:
    body = [arrays[f"{name}.{key}"] for key in ("position", "velocity")]
    for values in body:
        if values.shape != positions.shape or values.dtype != np.float32 or not np.isfinite(values).all():
            raise StateError(f"{values.dtype} {values.shape}: expected finite float32 {positions.shape}")
    begin = f"{name}.contacts."
    internal_state = {
        key.removeprefix(begin): values for key, values in arrays.items() if key.startswith(begin)
    }
    return SolverState(BodyState(*body), internal_state)
