"""Write JSON for browsers, scripts and other programs. All JSON that leaves petrobot is written
here.

RFC 8259 has neither infinity nor NaN. Python writes them anyway, and then a browser can read
nothing of the whole text. So a number that is not finite is written as null: "no value".
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from math import isfinite
from numbers import Real
from typing import Any

DEEPEST = 64
"""Deepest nesting that is written; deeper values become an ellipsis, so that a value that contains
itself has an end."""
WIDEST_BITS = 1023
"""A whole number of more bits is infinite for a reader that stores numbers as doubles, as browsers
do."""


def json_text(value: Any, **layout: Any) -> str:
    """Return a value as JSON text, with the options of `json.dumps` for its layout. Never raises
    because of a value.

    Numbers that are not finite become null; types that JSON does not know (a set, an object) become
    text.
    """
    try:
        return json.dumps(value, allow_nan=False, default=_foreign, **layout)
    except (ValueError, TypeError, RecursionError):  # rare: only then the whole value is copied
        return json.dumps(finite(value), allow_nan=False, **layout)


def finite(value: Any, depth: int = DEEPEST) -> Any:
    """Return a copy of the value with only what JSON knows, and null for every number that is not
    finite."""
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, int):
        return int(value) if value.bit_length() <= WIDEST_BITS else None
    if isinstance(value, Mapping):
        return {_key(k): finite(v, depth - 1) for k, v in value.items()} if depth else "…"
    if isinstance(value, list | tuple):
        return [finite(v, depth - 1) for v in value] if depth else "…"
    return _foreign(value)


def _key(key: Any) -> str:
    return (
        key
        if isinstance(key, str)
        else json.dumps(key)
        if key is None or isinstance(key, bool)
        else str(key)
    )


def _foreign(value: Any) -> Any:
    """Convert what the encoder does not know: numbers of other libraries to numbers, all else to
    text."""
    if isinstance(value, Real):
        number = float(value)
        return number if isfinite(number) else None
    try:
        return str(value)
    except Exception:  # an object whose `__str__` fails must not end the data feed
        return f"<{type(value).__name__}>"


_CONTROLS = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\ud800-\udfff\ufffe\uffff]"
)


def without_controls(text: str) -> str:
    """Return a text with a replacement character for each control character but tabs and line ends:
    XML cannot carry them, a terminal obeys them, and some turn the direction of what follows. They
    come with texts of actions, such as the coloured output of a program."""
    return _CONTROLS.sub("\ufffd", text)
