"""What was done of a resection: the marks of the score, and the cut.

Values alone, so that undo, sessions and replays can keep them.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rehearsal.resection.cut import CutSettings
from rehearsal.resection.score_line import ResectionError

Point = tuple[float, float, float]
MOST_MARKS = 200


@dataclass(frozen=True)
class CutRequest:
    """A cut: how the surgeon cut, which vertices of the tumour's surface the image had shown (bits, packed),
    and the positions of the tissue's nodes when it was cut (n, 3) [mm], float32 bytes.
    """

    settings: CutSettings
    seen: bytes
    position: bytes

    @classmethod
    def of(cls, settings: CutSettings, seen: np.ndarray, position: np.ndarray) -> "CutRequest":
        """From a mask (v,) of vertices and positions (n, 3)."""
        return cls(settings, np.packbits(seen).tobytes(), position.astype(np.float32).tobytes())

    def seen_of(self, count: int) -> np.ndarray:
        """The mask (count,) of the tumour's vertices. Raises ResectionError where it is of another tumour."""
        if len(self.seen) != -(-count // 8):
            raise ResectionError("the recorded cut belongs to another tumour")
        return np.unpackbits(np.frombuffer(self.seen, np.uint8), count=count).astype(bool)

    @cached_property
    def nodes_mm(self) -> np.ndarray:
        """Positions (n, 3) of the nodes [mm]."""
        return np.frombuffer(self.position, np.float32).reshape(-1, 3).astype(float)


@dataclass(frozen=True)
class Resection:
    """The marks of the score, on the organ's surface at rest [mm], and the cut if it was made."""

    marks: tuple[Point, ...] = ()
    cut: CutRequest | None = None

    def points(self) -> np.ndarray:
        """The marks, shape (n, 3) [mm]."""
        return np.array(self.marks, float).reshape(-1, 3)

    def with_marks(self, points: np.ndarray) -> "Resection":
        """The same with more marks (n, 3) [mm]. Raises ResectionError after the cut."""
        if self.cut is not None:
            raise ResectionError("the specimen is cut out already; undo the cut before you set marks")
        if len(self.marks) + len(points) > MOST_MARKS:
            raise ResectionError(
                f"the score has {len(self.marks)} marks already; expected at most {MOST_MARKS}"
            )
        return Resection((*self.marks, *((x, y, z) for x, y, z in np.asarray(points, float).tolist())))


NO_RESECTION = Resection()
