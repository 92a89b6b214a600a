"""A tracked ultrasound sweep: images and tracked transforms, as in an IGSIO sequence metafile.

The transform ``ImageToProbe`` maps a point (x, y, z, 1) of Image to Probe. Image is in pixels (column, row,
0) of orientation MF, every other coordinate system in mm.
"""

import re
import reprlib
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from errors import UserError

# As in IGSIO: the To of a name is not followed by a small letter, so that ToolToTracker has only one.
TRANSFORM_NAME = re.compile(r"(\w+?)To((?![a-z])\w+)")
TRANSFORM_FIELD = re.compile(r"(\w+?To(?![a-z])\w+)Transform")
CONFIGURATION_LIMIT = 1 << 22
# Directions of increasing column and row: (un)marked side, far or near. U with F, and M with N, make a
# left-handed image, whose third axis is descending in IGSIO; a third letter has no effect on a single slice.
ORIENTATIONS = {orientation: orientation for orientation in ("MF", "MN", "UF", "UN", "FM", "NM", "FU", "NU")}
ORIENTATIONS |= {f"{orientation}A": orientation for orientation in ORIENTATIONS} | {"UFD": "UF", "MND": "MN"}


class PixelLabel(IntEnum):
    """Ground-truth labels of pixels. A bead adds its number (from 1) times BEAD to the label around it."""

    OUTSIDE = 0
    ORGAN = 1
    TUMOUR = 2
    BEAD = 4


class SweepError(UserError):
    """A sweep that cannot be used; the message is one line."""


@dataclass
class Sweep:
    """Images and transforms of one sweep.

    ``images`` is uint8 (n, rows, columns) in orientation MF: columns increase to the marked side, rows away
    from the face; (n, 0, 0) for a sweep of poses only. It may be read-only. ``frames`` are the fields of each
    frame and ``fields`` those of the header, as text, in the file's order. ``constant`` are transforms (4, 4)
    of all frames, by name (see ``load_constants``).

    Raises SweepError where images and frames differ in number.
    """

    images: np.ndarray
    frames: list[dict[str, str]]
    fields: dict[str, str]
    constant: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.images.dtype != np.uint8 or self.images.ndim != 3 or len(self.images) != len(self.frames):
            raise SweepError(
                f"images of {self.images.dtype} {self.images.shape}: expected uint8 ({len(self.frames)}, "
                "rows, columns)"
            )

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def times_s(self) -> np.ndarray:
        """Time of each frame (n,) [s]. Raises SweepError where a timestamp is missing or not a finite
        number.
        """
        times = np.full(len(self), np.nan)
        for frame, fields in enumerate(self.frames):
            text = fields.get("Timestamp", "")
            with suppress(ValueError):
                times[frame] = float(text)
            if not np.isfinite(times[frame]):
                raise SweepError(
                    f"frame {frame}: Timestamp = {reprlib.repr(text)}: expected a finite number of seconds"
                )
        return times

    def transform(self, start: str, end: str, frame: int) -> np.ndarray | None:
        """The matrix (4, 4) from ``start`` to ``end``, such as "Image" and "Reference", along the shortest
        chain of transforms.

        None where a transform of the chain was not tracked (status not OK). Raises SweepError where no chain
        joins the two, or where one of its transforms is not an affine matrix.
        """
        fields = self.frames[frame]
        tracked = [match[1] for key in fields if (match := TRANSFORM_FIELD.fullmatch(key))]
        names = [*tracked, *(name for name in self.constant if name not in tracked)]
        chain = shortest_chain(names, start, end)
        if chain is None:
            known = ", ".join(names) or "none"
            raise SweepError(f"frame {frame}: no chain of transforms from {start} to {end}, of {known}")
        matrix = np.eye(4)
        for name, inverted in chain:
            step = self._tracked(name, frame) if name in tracked else self.constant[name]
            if step is None:
                return None
            try:
                matrix = (np.linalg.inv(step) if inverted else step) @ matrix
            except np.linalg.LinAlgError as error:
                raise SweepError(f"frame {frame}: {name} has no inverse") from error
        return matrix

    def is_image_ok(self, frame: int) -> bool:
        """Whether there are pixels and no status other than OK."""
        return self.images[frame].size > 0 and _is_ok(self.frames[frame].get("ImageStatus", "OK"))

    def _tracked(self, name: str, frame: int) -> np.ndarray | None:
        fields = self.frames[frame]
        # A transform that was not tracked is in the file as a matrix without meaning.
        if not _is_ok(fields.get(f"{name}TransformStatus", "")):
            return None
        return matrix_of(fields[f"{name}Transform"], f"frame {frame}: {name}Transform")


def shortest_chain(names: Iterable[str], start: str, end: str) -> list[tuple[str, bool]] | None:
    """The transforms from ``start`` to ``end``, each with whether to invert it; None where no chain joins
    them.
    """
    steps: dict[str, list[tuple[str, str, bool]]] = {}
    for name in names:
        if match := TRANSFORM_NAME.fullmatch(name):
            a, b = match.groups()
            steps.setdefault(a, []).append((b, name, False))
            steps.setdefault(b, []).append((a, name, True))
    chains: dict[str, list[tuple[str, bool]]] = {start: []}
    front = deque([start])
    while front and end not in chains:
        here = front.popleft()
        for there, name, inverted in steps.get(here, []):
            if there not in chains:
                chains[there] = [*chains[here], (name, inverted)]
                front.append(there)
    return chains.get(end)


def reoriented(images: np.ndarray, orientation: str) -> np.ndarray:
    """Images (n, rows, columns) of one of the ORIENTATIONS in MF."""
    column, row = tuple(ORIENTATIONS[orientation])
    if column in "FN":
        images, column, row = images.transpose(0, 2, 1), row, column
    return np.ascontiguousarray(images[:, :: -1 if row == "N" else 1, :: -1 if column == "U" else 1])


def load_constants(path: Path) -> dict[str, np.ndarray]:
    """The transforms (4, 4) of a PLUS configuration's CoordinateDefinitions, by name: {"ImageToProbe": ...}.

    Raises SweepError for a file that cannot be read, has no transform, or an invalid one.
    """
    constants: dict[str, np.ndarray] = {}
    try:
        with path.open("rb") as file:
            content = file.read(CONFIGURATION_LIMIT + 1)
        if len(content) > CONFIGURATION_LIMIT:
            raise SweepError(f"more than {CONFIGURATION_LIMIT >> 20} MB")
        for element in ElementTree.fromstring(content).iterfind("CoordinateDefinitions/Transform"):
            name = f"{element.get('From', '')}To{element.get('To', '')}"
            if not TRANSFORM_NAME.fullmatch(name) or name in constants:
                raise SweepError(
                    f"Transform {reprlib.repr(name)}: expected From and To, each pair once, To with a capital"
                )
            constants[name] = matrix_of(element.get("Matrix", ""), f"{name} Matrix")
        if not constants:
            raise SweepError("no CoordinateDefinitions with a Transform")
    except (OSError, SweepError, ElementTree.ParseError, LookupError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        if not isinstance(error, (OSError, SweepError)):
            reason = f"no XML: {reason}"
        raise SweepError(
            f"{path.name}: {reason}; expected a PLUS configuration (XML); a scene or a patient's folder goes "
            "after --scene"
        ) from error
    return constants


def transform_fields(name: str, matrix: np.ndarray | None) -> dict[str, str]:
    """The fields of a frame for a transform, such as "ProbeToReference"; None is one that was not tracked."""
    status = "INVALID" if matrix is None else "OK"
    text = transform_text(np.eye(4) if matrix is None else matrix)
    return {f"{name}Transform": text, f"{name}TransformStatus": status}


def transform_text(matrix: np.ndarray) -> str:
    """Sixteen numbers row by row that read back to the same float64. Raises SweepError where the matrix is
    not affine (4, 4).
    """
    affine = _affine(np.asarray(matrix, float), "a transform", reprlib.repr(np.asarray(matrix).tolist()))
    # Adding 0 removes the sign of a negative zero.
    return " ".join(repr(float(number) + 0.0).removesuffix(".0") for number in affine.flat)


def matrix_of(text: str, what: str) -> np.ndarray:
    """The affine matrix (4, 4) of sixteen numbers row by row. Raises SweepError, which names ``what``."""
    try:
        numbers = np.array(text.split(), float)
    except ValueError:
        numbers = np.empty(0)
    return _affine(numbers.reshape(4, 4) if numbers.size == 16 else numbers, what, reprlib.repr(text))


def _affine(matrix: np.ndarray, what: str, text: str) -> np.ndarray:
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or (matrix[3] != [0, 0, 0, 1]).any():
        raise SweepError(f"{what} = {text}: expected sixteen finite numbers row by row, the last row 0 0 0 1")
    return matrix


def _is_ok(status: str) -> bool:
    return status.strip().upper() == "OK"
