"""Reading one TOML table: every key is asked for by name and type, every fault is collected,
leftovers are refused."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from math import isfinite
from typing import Any, TypeVar

from petrobot.coordinator.conditions.wording import Fault, nearest

E = TypeVar("E", bound=StrEnum)
_KINDS: Mapping[type, str] = {
    str: "a text",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    list: "a list",
    dict: "a table",
}


class Table:
    """A table, its key in the file and the list that collects faults. Wrong or missing values read
    as their default."""

    def __init__(self, data: Mapping[str, Any], key: str, faults: list[Fault]) -> None:
        self.data = data
        self.key = key
        self.faults = faults
        self.asked: set[str] = set()

    def fault(self, name: str, text: str, remedy: str = "") -> None:
        """Note a fault of one of the table's keys."""
        self.faults.append(Fault(f"{self.key}.{name}" if self.key else name, text, remedy))

    def text(self, name: str, default: str | None = None) -> str:
        """A text; required without a default."""
        value: str = self._value(name, str, default, "")
        return value

    def number(self, name: str, default: float | None = None) -> float:
        """A finite number; required without a default."""
        value = float(self._value(name, float, default, 1.0))
        if not isfinite(value):
            self.fault(name, f"{value} is no finite number", "give a finite number")
            return 1.0
        return value

    def maybe_number(self, name: str) -> float | None:
        """A finite number, or None if the key is absent."""
        self.asked.add(name)
        return self.number(name) if name in self.data else None

    def integer(self, name: str, default: int) -> int:
        """A whole number."""
        value: int = self._value(name, int, default, default)
        return value

    def maybe_integer(self, name: str) -> int | None:
        """A whole number, or None if the key is absent."""
        self.asked.add(name)
        return self.integer(name, 1) if name in self.data else None

    def flag(self, name: str) -> bool:
        """True or false; false if absent."""
        value: bool = self._value(name, bool, False, False)
        return value

    def word(self, name: str, words: type[E], default: E | None = None) -> E:
        """One of the words of an enumeration; required without a default."""
        first = next(iter(words))
        text = self._value(name, str, default, first)
        try:
            return words(text)
        except ValueError:
            self.fault(
                name,
                f"{text!r} is none of {', '.join(words)}",
                nearest(text, list(words)).strip(" ()"),
            )
            return first

    def texts(self, name: str, single: bool = False) -> tuple[str, ...]:
        """A list of texts (or, if allowed, a single text); empty if absent."""
        if single and isinstance(self.data.get(name), str):
            return (self.text(name),)
        values: list[Any] = self._value(name, list, [], [])
        for value in values:
            if not isinstance(value, str):
                self.fault(name, f"{value!r} is no text", "write each in quotes")
        return tuple(v for v in values if isinstance(v, str))

    def plain(self, name: str) -> dict[str, Any]:
        """A table taken as it is; empty if absent."""
        value: dict[str, Any] = self._value(name, dict, {}, {})
        return dict(value)

    def any(self, name: str) -> Any:
        """Any value, or None if the key is absent."""
        self.asked.add(name)
        return self.data.get(name)

    def table(self, name: str) -> Table:
        """A table in this one; an absent one is empty."""
        return Table(self.plain(name), f"{self.key}.{name}" if self.key else name, self.faults)

    def tables(self, name: str) -> dict[str, Table]:
        """A table of tables."""
        outer = self.table(name)
        found: dict[str, Table] = {}
        for key, value in outer.data.items():
            if isinstance(value, dict):
                found[key] = Table(value, f"{outer.key}.{key}", self.faults)
            else:
                outer.fault(key, f"{value!r} is no table", f"write [{outer.key}.{key}]")
        return found

    def done(self) -> None:
        """Refuse every key that was not asked for."""
        for name in self.data:
            if name not in self.asked:
                near = nearest(name, self.asked).strip(" ()")
                self.fault(
                    name, "unknown key", near or f"known here: {', '.join(sorted(self.asked))}"
                )

    def _value(self, name: str, kind: type, default: Any, fallback: Any) -> Any:
        self.asked.add(name)
        if name not in self.data:
            if default is None:
                self.fault(name, "missing", f"give {_KINDS[kind]}")
                return fallback
            return default
        value = self.data[name]
        fits = isinstance(value, (int, float) if kind is float else kind)
        if fits and (kind is bool or not isinstance(value, bool)):
            return value
        self.fault(name, f"{value!r} is not {_KINDS[kind]}", f"give {_KINDS[kind]}")
        return fallback
