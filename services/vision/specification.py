"""Options of an action as a checked record: every field a number, an unknown or bad one refused
with its name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self


@dataclass(frozen=True, slots=True)
class Specification:
    """Base of an action's options; subclasses declare float fields with defaults."""

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Self:
        """From keyword arguments. Raises ValueError naming the option."""
        known = [field.name for field in fields(cls)]
        for name, value in options.items():
            if name not in known:
                raise ValueError(f"no option {name!r}; there are {', '.join(known)}")
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or not math.isfinite(value)
                or value < 0
            ):
                raise ValueError(f"option {name} = {value!r}: a number not below 0 is needed")
        return cls(**options)
