"""How long it still takes: a bar for the terminal, or nothing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, TypeVar

from tqdm import tqdm

Thing = TypeVar("Thing")


class Progress(Protocol):
    """Hands things on, one by one, and shows how far it is."""

    def __call__(self, things: Iterable[Thing], what: str) -> Iterable[Thing]: ...


def silent(things: Iterable[Thing], what: str) -> Iterable[Thing]:
    """No bar."""
    return things


def bar(things: Iterable[Thing], what: str) -> Iterable[Thing]:
    """A bar on the terminal's error stream; none where that is no terminal."""
    return tqdm(things, desc=f"{what:10}", leave=False, disable=None)
