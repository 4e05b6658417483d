"""All faults of a task file or location file, and what can still be judged.

A reader stops after the first stage that finds faults: without TOML there are no keys, and wrong
keys mean nothing. For `petrobot check` the data of the file is mended as its user would mend it,
and read again, until no stage finds more. A name is corrected as its message proposes. Without a
proposal the value is left out, and its names are `unknown`: what is found about them later may
follow from the fault, so it is not reported.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Generic, TypeVar

from msgspec import Struct, field

T = TypeVar("T")
ROUNDS = 12
"""The most times that a file is read."""
STAND_INS = {
    "name": "task",
    "final": "false",
    "deadline": 1e6,
    "type": "any",
    "host": "127.0.0.1",
    "period": 0.1,
}
"""Values for keys that an entry needs, in place of wrong and missing ones."""
MISSPELLED = re.compile("unknown (key|table)")
"""Beginning of the faults that name an unknown key."""
GROUPS = ("places", "transitions", "parameters")
"""Tables of a subnet."""
ALONE = ("schema", "errors", "keys", "links", "coordinator", "parameters")
"""Tables and keys at the top that contain no elements by name."""


class FaultyFile(Struct, Generic[T]):
    """A file that may be faulty, and what was read of it: None if nothing can be judged."""

    source: str
    value: T | None = None
    faults: list[str] = field(default_factory=list)
    """Lines "FILE:LINE: KEY: what is wrong; remedy"."""
    keys: set[str] = field(default_factory=set)
    """The keys of the faults."""
    unknown: set[str] = field(default_factory=set)
    """Names about which the file says something that could not be read."""

    def read(
        self,
        text: str,
        reader: Callable[[str, dict[str, Any] | None], T],
        *refused: type[Exception],
    ) -> None:
        """Read a text by a reader of text and data that raises one of `refused`, a line for each
        fault."""
        data, tried = self._parsed(text, reader, refused), set[str]()
        for _ in range(ROUNDS if data is not None else 0):
            try:
                self.value = reader(text, data)
                return
            except refused as fault:
                lines = str(fault).splitlines()
                self.add(lines)
                found = sorted(
                    map(self._parts, lines), key=lambda one: not MISSPELLED.match(one[1])
                )
                for key, said in found:
                    self._mend(data or {}, key, said, again=key in tried)
                tried |= {key for key, _ in found}

    def add(self, lines: Iterable[str]) -> None:
        """Add the faults that one stage found, without those that follow from earlier ones."""
        found = [(*self._parts(line), line) for line in lines]
        right = set[str]()  # the right names of misspelled keys, which are also missing
        for key, said, _ in found:
            if proposed := _proposed(said) if MISSPELLED.match(said) else "":
                right.add(".".join([*key.split(".")[:-1], proposed]))
        told, known = set[str](), {*self.keys}
        for key, said, line in found:
            if _near(key, right):
                continue
            if said not in told and not _near(key, known) and self.is_new(key, said):
                self.faults.append(line)
            if said.startswith("no module"):  # not once for each action in it
                told.add(said)
            self.keys.add(key)

    def is_new(self, key: str, said: str) -> bool:
        """Return whether a finding does not follow from something unknown in this file."""
        text = _found(said)
        named = re.findall(r"\w{3,}|(?<=['`])\w+(?=['`])", text)  # not `to` or `in` as a word
        return self.unknown.isdisjoint([*_words(key), *named])

    def _parsed(self, text: str, reader: Callable[..., T], refused: Any) -> dict[str, Any] | None:
        """Return the data of the text, with lines that are no TOML mended or left out; None where
        the lines after such a line would be misunderstood."""
        lines, last = text.removeprefix("\ufeff").splitlines(), -1
        while True:
            try:
                return tomllib.loads("\n".join([*lines, ""]))
            except (tomllib.TOMLDecodeError, RecursionError):
                pass
            try:
                reader("\n".join([*lines, ""]), None)
            except refused as fault:
                at = re.match(rf"{re.escape(self.source)}:(\d+): (.*)", str(fault))
                number, said = (int(at[1]), at[2]) if at else (0, "")
                # What follows a line that was left out may be the rest of its value.
                own = last < 0 or number > last + 1 or (number > last and _entry(lines[last]))
                if own:
                    self.faults.append(str(fault))
            if not own or number > len(lines) or lines[number - 1].lstrip().startswith("["):
                return None
            if not _closed(lines, number - 1, said):
                self.unknown |= {*_names_in(lines[:number])}
                lines[number - 1] = ""
            last = number

    def _parts(self, line: str) -> tuple[str, str]:
        """Return key and words of a fault."""
        found = re.fullmatch(rf"{re.escape(self.source)}(?::\d+)?: ([^\s:]+): (.*)", line)
        return (found[1], found[2]) if found else ("", line)

    def _mend(self, data: dict[str, Any], key: str, said: str, *, again: bool) -> None:
        """Mend a fault in the data; `again`: what was tried before did not help."""
        *outer, last = path = key.split(".")
        table: Any = data
        for part in outer:
            table = table.get(part) if isinstance(table, dict) else None
        if not isinstance(table, dict):
            table = data.setdefault(outer[0], {}) if len(outer) == 1 else {}
        if not again and self._as_proposed(table, last, said):
            self.keys.discard(key)  # what is found there later is another fault
            return
        if "missing" in said[:10] and last in table:
            return  # it was there, misspelled
        if last in STAND_INS and not again and not MISSPELLED.match(said):
            table[last] = STAND_INS[last]
            self.unknown |= {last} & {"final", "type"}
        elif last == "port" and not again:
            table[last] = 65535 - len(self.keys)
        elif last in ("node", "device") and not again and data.get("nodes"):
            table.pop(last, None)
            table["node"] = next(iter(data["nodes"]))
        else:
            self.unknown.add(_element(path))
            if said.startswith("unknown "):
                self.unknown |= {*_quoted(_found(said))}
            # A wrong type is that of the whole list.
            words = [] if re.match(r".* is not (a|true) ", said) else _quoted(said)
            self._leave_out(data, path, words, again=again)

    def _as_proposed(self, table: dict[str, Any], key: str, said: str) -> bool:
        """Mend what the message of a fault says how to mend; return whether it does."""
        if write := re.search(rf'write ({key} = (?:"\w+"|\d+))', said):
            table |= tomllib.loads(write[1])
            return True
        proposed, value = _proposed(said), table.get(key)
        if whole := re.search(r"write '([\w.]+:\w+)'", said):
            table[key] = whole[1]
            return True
        if not proposed or value is None:
            return False
        if MISSPELLED.match(said):
            if proposed not in table:
                table[proposed] = table.pop(key)
                return True
            return False
        wrong = _quoted(said)
        table[key] = _replaced(value, wrong[-1], proposed) if wrong else value
        return bool(table[key] != value)

    def _leave_out(
        self, data: dict[str, Any], path: list[str], words: list[str], *, again: bool
    ) -> None:
        """Leave out the items of a list that have one of the words, else the whole value; if that
        was done before, or it is missing, the table around it, up to its element: what the other
        elements say is not in doubt."""
        holders: list[Any] = [data]
        for part in path:
            holders.append(holders[-1].get(part) if isinstance(holders[-1], dict) else None)
        least = min(len(path), _depth(path))
        while len(path) > least and (again or holders[len(path)] is None):
            path, again = path[:-1], False
        if holders[len(path)] is None:
            return
        value, table = holders[len(path)], holders[len(path) - 1]
        known = {*_keys_of(data)}
        wrong = [v for v in value if {*_words(v)} & {*words}] if isinstance(value, list) else []
        for arc in wrong or _arcs(value):
            for name, end in re.findall(r"(\w+)(?::(\w+))?", str(arc)):
                self.unknown.add(name if name in known or not end else end)
        if wrong:
            table[path[-1]] = [v for v in value if v not in wrong]
        else:
            del table[path[-1]]


def _entry(line: str) -> bool:
    """Return whether a line begins with a key, and so with a value of its own."""
    return re.match(r"\s*[\w.-]+\s*=", line) is not None


def _closed(lines: list[str], at: int, said: str) -> bool:
    """Mend a line that is no TOML as the message of its fault proposes; return whether it does."""
    line = lines[at]
    if word := re.match(r".*?(\w+) is (?:Python|a text without quotes)", said):
        right = word[1].lower() if "Python" in said else f'"{word[1]}"'
        lines[at] = re.sub(rf"(?<![\w\"]){word[1]}(?![\w\"])", right, line, count=1)
    elif quote := re.search(r"quote in column (\d+) is not closed", said):
        begin = line[: int(quote[1])]
        text = re.match(r"[^,}\]#]*", line[int(quote[1]) :])
        inside = text[0].rstrip() if text else ""
        lines[at] = f"{begin}{inside}{begin[-1]}{line[len(begin) + len(inside) :]}"
    elif "brace in column" in said:
        joined = ""
        for number in range(at, len(lines)):
            joined += re.sub(r"""(\"[^\"]*\"|'[^']*')|#.*""", r"\1", lines[number])
            lines[number] = ""
            if joined.count("{") <= joined.count("}"):
                break
        lines[at] = re.sub(r",\s*}", "}", joined)
    return lines[at] != line


def _near(key: str, others: Iterable[str]) -> bool:
    """Return whether one of the keys is this one, in it or around it."""
    return any(f"{key}.".startswith(f"{k}.") or k.startswith(f"{key}.") for k in others)


def _found(said: str) -> str:
    """Return a fault's words without its remedy."""
    return said.partition("; ")[0]


def _proposed(said: str) -> str:
    found = re.search(r"did you mean '([^']+)'", said)
    return found[1] if found else ""


def _quoted(said: str) -> list[str]:
    return re.findall(r"'(\w+)'", said.partition("did you mean")[0])


def _words(value: Any) -> list[str]:
    return re.findall(r"\w+", str(value))


def _replaced(value: Any, wrong: str, right: str) -> Any:
    """Return a value with one word in place of another in its texts."""
    if isinstance(value, str):
        return re.sub(rf"\b{re.escape(wrong)}\b", right, value)
    if isinstance(value, list):
        return [_replaced(one, wrong, right) for one in value]
    if isinstance(value, dict):
        return {_replaced(k, wrong, right): v for k, v in value.items()}
    return value


def _arcs(value: Any) -> Iterator[Any]:
    """Yield the arcs in a list of them, or of a transition."""
    for one in (value.get("in"), value.get("out")) if isinstance(value, dict) else (value,):
        yield from one if isinstance(one, list) else ()


def _keys_of(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield key
            yield from _keys_of(inner)


def _depth(path: list[str]) -> int:
    """Return how many parts of a key name its element."""
    if path[0] in ALONE:
        return 1
    return 4 if path[0] == "subnets" and path[2:3] in ([one] for one in GROUPS) else 2


def _element(path: list[str]) -> str:
    """Return the name of the element that a key belongs to; of `[errors]`, which actions without a
    branch of their own need, the word of their arcs."""
    if path[-2:] == ["errors", "to"]:
        return "error"
    if path[0] == "task":
        return path[-1]
    return path[3] if path[0] == "subnets" and len(path) > 3 else path[min(1, len(path) - 1)]


def _names_in(lines: list[str]) -> Iterator[str]:
    """Yield the names in the last line: its key, that of its table, and those of its arcs."""
    yield from re.findall(r"^\s*(\w+)", lines[-1])
    yield from re.findall(r'\brun\s*=\s*"\w+:(\w+)', lines[-1])
    header = next((one for one in reversed(lines) if one.startswith("[")), "")
    yield from (name for name in re.findall(r"\.(\w+)\]", header) if name not in GROUPS)
    for arcs in re.findall(r"\[([^\]]*)", lines[-1]):
        yield from re.findall(r"(?<![\w:])\w+", arcs)
