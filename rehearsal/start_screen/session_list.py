"""The last sessions that the start screen shows: those in the folder of --out."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rehearsal.result_files import counted
from rehearsal.start_screen.patient_list import age_text

SESSION_NAME = r"session-([0-9]{3,9})\.jsonl"
MOST_SESSIONS = 5
# The first and the last line of a session's file have at most this length, or they are not read.
MOST_LINE_BYTES = 2_000_000


@dataclass(frozen=True)
class ListedSession:
    """A recorded session: its file, the fingerprint of its patient's anatomy, and what is shown of it."""

    path: Path
    anatomy: str
    lines: tuple[str, ...]


def listed_sessions(folder: Path) -> list[ListedSession]:
    """The last sessions in a folder, the newest first."""
    files = [path for path in folder.glob("session-*.jsonl") if re.fullmatch(SESSION_NAME, path.name)]
    files.sort(key=lambda path: path.stat().st_mtime, reverse=True)
    listed = (_listed(path) for path in files[:MOST_SESSIONS])
    return [session for session in listed if session is not None]


def _listed(path: Path) -> ListedSession | None:
    """A session by the first and the last line of its file; None where the first is of no session."""
    try:
        with path.open("rb") as file:
            header = _values(file.readline(MOST_LINE_BYTES))
            file.seek(max(0, path.stat().st_size - MOST_LINE_BYTES))
            end = _values(file.read().rstrip(b"\n").rpartition(b"\n")[2])
    except OSError:
        return None
    anatomy = header.get("anatomy")
    if not isinstance(anatomy, str):
        return None
    return ListedSession(path, anatomy, (_contents(end.get("summary")), age_text(path)))


def _contents(summary: Any) -> str:
    """What a session has, by its summary; one that was cut off has none."""
    if not isinstance(summary, dict) or not isinstance(summary.get("duration_s"), int | float):
        return "Not ended in order"
    attempts = summary.get("attempts")
    cuts = f", {counted(len(attempts), 'cut')}" if isinstance(attempts, list) and attempts else ""
    return f"{summary['duration_s']:.0f} s{cuts}"


def _values(line: bytes) -> dict[str, Any]:
    try:
        values = json.loads(line)
    except ValueError:
        return {}
    return values if isinstance(values, dict) else {}
