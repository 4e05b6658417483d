"""Options of an action as a checked record: every field is a number; an unknown or bad option is
refused by its name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Self

from msgspec import Struct


class Specification(Struct, frozen=True):
    """Base class of an action's options; subclasses declare float fields with defaults."""

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Self:
        """Return the options given as keyword arguments. Raises ValueError naming the option."""
        known = cls.__struct_fields__
        for name, value in options.items():
            if name not in known:
                raise ValueError(f"unknown option {name!r}; the options are {', '.join(known)}")
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or not math.isfinite(value)
                or value < 0
            ):
                raise ValueError(f"option {name}: expected a number of 0 or more, got {value!r}")
        return cls(**options)
