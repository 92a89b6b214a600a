"""Errors that the user can correct, and their messages; used by all folders."""

import difflib
import gzip
import reprlib
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from datetime import date, time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError

# The largest number that is written with its digits; Python refuses to write those of thousands.
MOST_INT = 10**40


class _Found(reprlib.Repr):
    """How what was found is written: as Python has it, but never a whole matrix or file, and dates as TOML
    has them.
    """

    def repr_date(self, value: date | time, level: int) -> str:
        return str(value)

    repr_datetime = repr_time = repr_date

    def repr_int(self, value: int, level: int) -> str:
        return super().repr_int(value, level) if abs(value) < MOST_INT else "a number with many digits"


FOUND = _Found()
FOUND.maxlist, FOUND.maxstring = 4, 80
# What pydantic says where a table is expected names classes of Python.
NO_TABLE = ("model_type", "model_attributes_type", "dataclass_type", "dict_type", "mapping_type")
# Wrong keys of a file that a message names besides the first.
MOST_NAMED = 4


# What errors of parsers mean, the special ones first.
CAUSES: tuple[tuple[type[Exception], str], ...] = (
    (EOFError, "it ends too early"),
    (struct.error, "it ends too early"),
    (zlib.error, "its compression is damaged"),
    (gzip.BadGzipFile, "its compression is damaged"),
    (zipfile.BadZipFile, "its end or list of files is damaged"),
    (RecursionError, "it is nested too deeply"),
    (NotImplementedError, "a form that is not supported"),
    (UnicodeError, "a text of unknown encoding"),
    (LookupError, "something is missing in it"),
    (OverflowError, "a number that is too large"),
    (ValueError, "a value that is not possible"),
    (TypeError, "a value of another kind"),
)


class UserError(ValueError):
    """What the user can mend.

    The message is one line: where, what was found, what was expected, what to do.
    """


class PatientError(UserError):
    """What is wrong with a patient's files.

    Letters that do not print, which could control a terminal, become question marks.
    """

    def __init__(self, line: str) -> None:
        super().__init__("".join(letter if letter.isprintable() else "?" for letter in line))


@contextmanager
def parsing(what: str, advice: str) -> Iterator[None]:
    """A library's parser raises many kinds of error: each becomes a PatientError with its cause in words,
    where that is known.

    Its own words and its warnings, which may name the patient, are dropped.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except PatientError:
        raise
    except MemoryError as error:
        raise PatientError(
            f"{what.rpartition(': ')[0] or what}: the memory is full while it is read; close other programs "
            "and try again; where there is "
            "enough memory, the file is damaged"
        ) from error
    except Exception as error:
        cause = _cause(error)
        raise PatientError(f"{what}{f' ({cause})' if cause else ''}; {advice}") from error


def _cause(error: Exception) -> str:
    """What a parser's error means, without any text of the file; empty where its kind does not show it."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, AttributeError) and error.name:
        return f"no {error.name}"
    return next((words for kind, words in CAUSES if isinstance(error, kind)), "")


def explained(
    error: "ValidationError",
    unknown: Callable[[list[str]], str] = lambda where: "unknown key",
    tags: Collection[str] = (),
) -> str:
    """The first problem in a line: the key, what was found, what was expected, and the other keys that are
    wrong.

    ``unknown`` suggests what the writer of an unknown key, given by its place, may have meant. ``tags`` are
    the kinds of a union, which pydantic names among the keys. A validator's own message that begins with its
    key is left as it is.
    """
    problems = error.errors(include_url=False)
    # A key that is missing under one spelling and unknown under another is one mistake: name the unknown one.
    problems.sort(key=lambda problem: problem["type"] != "extra_forbidden")
    first = problems[0]
    places = [[str(part) for part in problem["loc"] if part not in tags] for problem in problems]
    where, names = places[0], [".".join(place) for place in places]
    name, message = names[0], first["msg"][0].lower() + first["msg"][1:]
    if first["type"] in NO_TABLE:
        message = "expected a table of keys and values"
    elif first["type"] == "value_error":
        message = str(first["ctx"]["error"])
    if first["type"] == "extra_forbidden":
        text = f"{name}: {unknown(where)}"
    elif first["type"] == "missing":
        text = f"{name}: missing"
    elif first["type"] == "json_invalid":
        text = "invalid JSON"
    elif isinstance(first["input"], dict):
        text = message if message.startswith(name) else f"{name}: {message}"
    else:
        text = f"{f'{name} = ' if name else ''}{FOUND.repr(first['input'])}: {message}"
    more = list(dict.fromkeys(other for other in names if other != name))
    others = ", ".join(more[:MOST_NAMED]) + (", ..." if len(more) > MOST_NAMED else "")
    return text + (f" (and {len(more)} more: {others})" if more else "")


def meant(key: str, known: Iterable[str]) -> str:
    """What the writer of an unknown key may have meant."""
    close = difflib.get_close_matches(key, list(known), n=1)
    return f"did you mean {close[0]}?" if close else f"known here: {', '.join(known)}"
