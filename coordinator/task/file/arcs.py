"""The short notation of arcs: `ball`, `runs*2`, `locate_ball:normal`, `catch_ball:preempt=success`,
`!blocked*3`."""

from __future__ import annotations

import re
from enum import StrEnum
from typing import TypeVar

from petrobot.coordinator.task import Counts, End, Inhibitor, Input, Output, Status
from petrobot.coordinator.task.wording import nearest

W = TypeVar("W", bound=StrEnum)
_ARC = re.compile(
    r"(?P<bar>!?)\s*(?P<place>[\w.]+)(?::(?P<end>\w+)(?:=(?P<counts>\w+))?)?(?:\s*\*\s*(?P<weight>\d{1,9}))?\Z"
)


class ArcError(ValueError):
    """The text is not an arc; the message says how one is written."""


def read_input(text: str) -> Input | Inhibitor:
    """An arc of `in`. Raises ArcError."""
    found = _ARC.match(text.strip())
    if not found:
        raise ArcError(
            f"{text!r} is not an arc: write PLACE, PLACE*2, PLACE:normal, PLACE:preempt=success "
            "or !PLACE"
        )
    weight = int(found["weight"] or 1)
    if found["bar"]:
        if found["end"]:
            raise ArcError(
                f"{text!r}: an inhibitor arc looks at tokens alone: write !{found['place']}"
            )
        return Inhibitor(found["place"], weight)
    end = _word(End, found["end"], text)
    counts = _word(Counts, found["counts"], text)
    return Input(found["place"], weight, end, counts)


def read_output(text: str) -> Output:
    """An arc of `out`. Raises ArcError."""
    found = _ARC.match(text.strip())
    if not found or found["bar"] or found["end"]:
        raise ArcError(f"{text!r} is not an arc of `out`: write PLACE or PLACE*2")
    return Output(found["place"], int(found["weight"] or 1))


def write_arc(arc: Input | Inhibitor | Output) -> str:
    """The notation of an arc."""
    if isinstance(arc, Inhibitor):
        return f"!{arc.place}{_times(arc.threshold)}"
    end = ""
    if isinstance(arc, Input) and arc.end is not None:
        end = f":{arc.end}" + (f"={arc.counts}" if arc.counts is not None else "")
    return f"{arc.place}{end}{_times(arc.weight)}"


def _times(weight: int) -> str:
    return "" if weight == 1 else f"*{weight}"


def _word(words: type[W], text: str | None, arc: str) -> W | None:
    if text is None:
        return None
    try:
        return words(text)
    except ValueError:
        what = f"{arc!r}: {text!r} is none of {', '.join(words)}{nearest(text, list(words))}"
        place, _, _ = arc.partition(":")
        if words is End and text in (Status.SUCCESS, Status.FAILURE):
            what += f"; write {place}:normal, and when = \"{place}.status == '{text}'\""
        raise ArcError(what) from None
