"""How faults are worded for people: where, what, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from enum import StrEnum
from textwrap import wrap

from msgspec import Struct
from msgspec.structs import force_setattr

from petrobot.services.host.toml_text import shortened

COLUMNS = 100
"""The widest text in a terminal."""


class Severity(StrEnum):
    """How much something matters."""

    NOTE = "note"
    WARNING = "warning"
    ERROR = "error"


class Fault(Struct, frozen=True):
    """One thing that is wrong: its key (`transitions.start.in`), a sentence, and the remedy."""

    key: str
    text: str
    remedy: str = ""

    def __post_init__(self) -> None:
        force_setattr(self, "text", shortened(self.text))

    def __str__(self) -> str:
        return f"{self.key}: {self.text}" + (f"; {self.remedy}" if self.remedy else "")


def nearest(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` when a known word is close, else nothing."""
    words = list(known)
    near = get_close_matches(word, words, 1)
    if not near and len(word) > 3:  # a name that was made longer or shorter
        near = [w for w in words if len(w) > 3 and (w.startswith(word) or word.startswith(w))]
    return f" (did you mean '{near[0]}'?)" if near else ""


def wrapped(text: str, hang: int) -> str:
    """Return a line as lines of at most 100 columns; those after the first are indented by `hang`.
    Words are never broken."""
    return "\n".join(
        wrap(
            text,
            COLUMNS,
            subsequent_indent=" " * hang,
            break_long_words=False,
            break_on_hyphens=False,
        )
    )


def listed(words: Iterable[str]) -> str:
    """The words, sorted and separated by commas."""
    return ", ".join(sorted(words)) or "none"


FEW = 6
"""The most names of a long list that a sentence tells."""


def together(texts: Iterable[str]) -> list[str]:
    """Return texts `NAME: TEXT` so that each TEXT stands once, after all its names."""
    names: dict[str, list[str]] = {}
    for text in texts:
        name, colon, rest = text.partition(": ")
        own = colon and " " not in name
        names.setdefault(colon + rest if own else text, []).extend([name] if own else [])
    return [", ".join(some) + text for text, some in names.items()]


def few(words: Sequence[str]) -> str:
    """The words separated by commas; of many the first few, and how many more there are."""
    if len(words) <= FEW + 1:
        return ", ".join(words)
    return f"{', '.join(words[:FEW])} and {len(words) - FEW} more"
