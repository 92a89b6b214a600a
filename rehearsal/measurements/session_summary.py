"""Summary of a session: duration, path, presses, compression, coverage."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rehearsal.result_files import counted
from ultrasound.coverage import Gap

# A press begins above the first compression [mm] and ends below the second.
PRESSED_MM, RELEASED_MM = 1.0, 0.5
FIGURES = (
    *("duration_s", "path_mm", "fastest_mm_s"),
    *("compression_max_mm", "compression_warning_mm", "over_warning_s", "force_max_n"),
)


@dataclass
class SessionCourse:
    """Accumulates the figures of a summary, under their names in it, step by step."""

    compression_warning_mm: float
    duration_s: float = 0.0
    path_mm: float = 0.0
    fastest_mm_s: float = 0.0
    compression_max_mm: float = 0.0
    over_warning_s: float = 0.0
    force_max_n: float | None = None
    presses: int = 0
    went_back: int = 0
    _is_pressed: bool = field(default=False, init=False)
    _at: np.ndarray | None = field(default=None, init=False)

    def add(
        self, pose: np.ndarray | None, compression_mm: float, length_s: float, force_n: float | None = None
    ) -> None:
        """Add a step by its pose (4, 4), or a rollback by None, with compression [mm], length [s], and
        force on the probe [N].
        """
        self.duration_s += length_s
        if pose is None:
            self.went_back += 1
            self._at = None
            return
        if self._at is not None:
            path = float(np.linalg.norm(pose[:3, 3] - self._at))
            self.path_mm += path
            self.fastest_mm_s = max(self.fastest_mm_s, path / length_s)
        self._at = pose[:3, 3].copy()
        self.compression_max_mm = max(self.compression_max_mm, compression_mm)
        if force_n is not None:
            self.force_max_n = max(self.force_max_n or 0.0, force_n)
        self.over_warning_s += length_s * (compression_mm > self.compression_warning_mm)
        if not self._is_pressed and compression_mm > PRESSED_MM:
            self.presses += 1
        self._is_pressed = compression_mm > (RELEASED_MM if self._is_pressed else PRESSED_MM)

    def summary(self, latest: dict[str, Any], gaps: Iterable[Gap], bookmarks: int) -> dict[str, Any]:
        """The summary; ``latest`` is the last measurement, ``gaps`` are the regions not imaged."""
        return {
            **{name: _rounded(getattr(self, name)) for name in FIGURES},
            **dict(presses=self.presses, went_back=self.went_back, bookmarks=bookmarks),
            **{name: value for name, value in latest.items() if name.startswith("seen_")},
            "gaps": [
                dict(volume_ml=round(gap.volume_ml, 3), thickness_mm=round(gap.thickness_mm, 2))
                for gap in gaps
            ],
        }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), 3)


def summary_text(summary: dict[str, Any]) -> str:
    """A summary for the terminal."""
    seen = ", ".join(
        f"{name.removeprefix('seen_')} {100 * value:.0f} %"
        for name, value in summary.items()
        if name.startswith("seen_")
    )
    gaps, force_n = summary["gaps"], summary["force_max_n"]
    largest = ""
    if gaps:
        volume_ml, thickness_mm = gaps[0]["volume_ml"], gaps[0]["thickness_mm"]
        largest = f"; the largest region not imaged is {volume_ml:.1f} ml, up to {thickness_mm:.1f} mm thick"
    return "\n".join(
        [
            f"session     {summary['duration_s']:.1f} s, {counted(summary['presses'], 'press')}, the path of "
            "the transducer "
            f"{summary['path_mm']:.0f} mm, at most {summary['fastest_mm_s']:.0f} mm/s; "
            f"{counted(summary['bookmarks'], 'bookmark')}",
            f"compression {summary['compression_max_mm']:.1f} mm at most, also by the organ's own weight; "
            f"{summary['over_warning_s']:.1f} s above the limit of {summary['compression_warning_mm']:g} mm",
            *([] if force_n is None else [f"force       {force_n:.2f} N at most on the probe"]),
            f"coverage    {f'of the volume: {seen}' if seen else 'none: there is no CT'}{largest}",
        ]
    )
