"""Fields of a sequence file, of the whole and of each frame: what the two formats of a sweep have in
common.
"""

import re
import reprlib
from collections.abc import Sequence

from ultrasound.sweep import SweepError

HEADER_LIMIT = 64 << 20
PIXEL_LIMIT = (1 << 32) - 1  # PLUS counts a sweep's bytes in 32 bits.
FRAME_FIELD = re.compile(r"Seq_Frame([0-9]{4,9})_(.+)", re.DOTALL)
FrameFields = dict[int, dict[str, str]]


def put_field(name: str, text: str, fields: dict[str, str], frames: FrameFields) -> None:
    """Put a field among those of the header, or of its frame by number.

    Raises SweepError where it is there already, or a frame's has no number.
    """
    match = FRAME_FIELD.fullmatch(name)
    if name.startswith("Seq_Frame") and not match:
        raise SweepError(f"field {reprlib.repr(name)}: expected Seq_Frame0000_Name")
    into, key = (frames.setdefault(int(match[1]), {}), match[2]) if match else (fields, name)
    if key in into:
        raise SweepError(f"field {reprlib.repr(name)}: found twice")
    into[key] = text


def numbers_of(name: str, text: str, expected: str) -> tuple[int, ...]:
    """The columns, rows and frames, or more numbers, in a text.

    Raises SweepError where they are other than ``expected``, or too many pixels.
    """
    words = text.split()
    if len(words) != len(expected.split()) or not all(re.fullmatch("[0-9]{1,9}", word) for word in words):
        raise SweepError(f"{name} = {reprlib.repr(text)}: expected {expected}")
    numbers = tuple(map(int, words))
    pixels = 1
    for number in numbers:
        pixels *= number
    if not numbers[-1] or pixels > PIXEL_LIMIT:
        raise SweepError(f"{name} = {reprlib.repr(text)}: expected 1 frame to {PIXEL_LIMIT} bytes of them")
    return numbers


def in_order(frames: FrameFields, count: int, name: str) -> list[dict[str, str]]:
    """The fields of each frame. Raises SweepError where these are not as many as the field ``name`` has."""
    last = max(frames, default=-1)
    if len(frames) != count or last != count - 1:
        raise SweepError(f"{name} has {count} frames, but {len(frames)} have fields, the last is {last}")
    return [frames[number] for number in range(count)]


def accept(name: str, text: str, accepted: Sequence[str]) -> str:
    """A field's text with single spaces. Raises SweepError where it is none of the accepted."""
    plain = " ".join(text.split())
    if plain not in accepted:
        raise SweepError(f"{name} = {reprlib.repr(text)}: expected {' or '.join(accepted)}")
    return plain


def field_line(name: str, separator: str, text: str) -> bytes:
    """The line of a field. Raises SweepError for a name or text that would be read as another."""
    # What ends a name, or makes a line of NRRD a comment.
    marks = separator.strip() + "#" * (":" in separator)
    if set(name) & set(marks) or name != name.strip() or not name or "\n" in name + text:
        raise SweepError(
            f"field {reprlib.repr(name + ' = ' + text)}: expected one line, no {' or '.join(marks)} in the "
            "name"
        )
    try:
        return f"{name}{separator}{text}\n".encode("latin-1")
    except UnicodeEncodeError as error:
        raise SweepError(f"field {reprlib.repr(name)}: a character beyond Latin-1") from error
