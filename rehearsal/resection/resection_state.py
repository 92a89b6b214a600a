"""What was done of a resection: the marks of the score, and the cut; and what a file of poses has done at its
times.

Values alone, so that undo, sessions and replays can keep them.
"""

from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
import trimesh
from pydantic import BaseModel, ConfigDict, Field

from rehearsal.resection.cut import Cut, CutSettings, cut_organ
from rehearsal.resection.score_line import ResectionError, score_line
from render.viewer import Technique
from ultrasound.crater import Filling

Number = Annotated[float, Field(ge=-1e5, le=1e5)]
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


@dataclass(frozen=True)
class Attempt:
    """A cut that was made in this session, whether it was undone since or not; attempts count from 1.

    ``state`` is the number of the state right after it.
    """

    number: int
    state: int
    resection: Resection


def cut_of(resection: Resection, organ: trimesh.Trimesh, tumour: trimesh.Trimesh | None) -> Cut | None:
    """The cut of an organ that a resection asks for, at rest; None where it asks for none.

    Raises ResectionError.
    """
    request = resection.cut
    if request is None:
        return None
    points = np.zeros((0, 3)) if tumour is None else np.asarray(tumour.vertices)
    line = score_line(organ, resection.points())
    return cut_organ(organ, line, request.settings, points[request.seen_of(len(points))])


class ScriptedCut(BaseModel):
    """A cut in a file; see ``CutSettings``."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    technique: Technique = "enucleoresection"
    margin_mm: float = Field(5.0, ge=0, le=20)
    depth_mm: float | None = Field(None, gt=0, le=60)
    filling: Filling = "fluid"

    def settings(self) -> CutSettings:
        """As settings of a cut."""
        return CutSettings(**self.model_dump())


@dataclass(frozen=True)
class ScriptedAction:
    """At a time [s]: marks of the score, at the edges in the image or at places (LPS, mm), or a cut."""

    time_s: float
    score: Literal["image"] | list[Point] | None = None
    margin_mm: float = 5.0
    cut: CutSettings | None = None


class ResectionScript:
    """Actions in the order of their times."""

    def __init__(self, actions: list[ScriptedAction]) -> None:
        self._actions = deque(sorted(actions, key=lambda action: action.time_s))

    def is_due(self, time_s: float) -> bool:
        """Whether there is an action at or before a time [s]."""
        return bool(self._actions) and self._actions[0].time_s <= time_s + 1e-9

    def next(self) -> ScriptedAction:
        """The next action, which is no longer there afterwards."""
        return self._actions.popleft()
