"""Options of an action as a checked record: every field is a number; an unknown or bad option is
refused by its name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self


@dataclass(frozen=True, slots=True)
class Specification:
    """Base class of an action's options; subclasses declare float fields with defaults."""

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Self:
        """Return the options given as keyword arguments. Raises ValueError naming the option."""
        known = [field.name for field in fields(cls)]
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
