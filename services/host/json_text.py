"""JSON for whoever reads it: browsers, scripts, other programs. Every text that leaves petrobot as
JSON is written here.

RFC 8259 has no infinity and no NaN. Python writes them anyway, and then no browser can read
anything of that text. So a number that is not finite leaves as null: "no value".
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import isfinite
from numbers import Real
from typing import Any

DEEPEST = 64
"""Levels of nesting that are written; what lies deeper becomes an ellipsis, so that a value that
holds itself has an end."""
WIDEST_BITS = 1023
"""Whole numbers of more bits are infinite for a reader that keeps numbers as doubles, as browsers
do."""


def json_text(value: Any, **layout: Any) -> str:
    """A value as JSON text, with the options of `json.dumps` for its layout. Never raises because
    of a value.

    Numbers that are not finite become null; what JSON does not know (a set, an object) becomes
    text.
    """
    try:
        return json.dumps(value, allow_nan=False, default=_foreign, **layout)
    except (ValueError, TypeError, RecursionError):  # rare, so only then is the whole value copied
        return json.dumps(finite(value), allow_nan=False, **layout)


def finite(value: Any, depth: int = DEEPEST) -> Any:
    """A copy of the value that holds nothing but what JSON knows, with null for every number that
    is not finite."""
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
    """What the encoder does not know: numbers of other libraries as numbers, all else as text."""
    if isinstance(value, Real):
        number = float(value)
        return number if isfinite(number) else None
    try:
        return str(value)
    except Exception:  # an object whose own text fails must not end the feed
        return f"<{type(value).__name__}>"
