"""A net read from a foreign file, the error of all readers and writers, and files of rates.

Nothing is lost silently: what our nets cannot express is refused (NetFileError) if it changes the
behaviour, and listed in `notes` if it does not.
"""

from __future__ import annotations

import json
import re
from collections.abc import Container, Mapping
from fractions import Fraction
from itertools import chain, count
from typing import Any
from xml.etree.ElementTree import Element

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.analysis.limits import keep_time
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.task.net import Arcs, Net
from petrobot.services.host.toml_text import InputError, TomlError, read_toml

FILE = "the net in the file"
"""What stays unknown if the time is used up before a file has been read."""
BETWEEN = 1_000
"""Elements or arcs of a file between two looks at the clock."""


class NetFileError(InputError, ValueError):
    """A file cannot be read or a net cannot be written: file, line, element, problem, remedy."""

    def __init__(
        self, file: str, element: str, problem: str, remedy: str = "", line: int | None = None
    ) -> None:
        super().__init__(file, element, problem, remedy, line)
        self.file, self.element, self.problem, self.remedy = file, element, problem, remedy
        self.line = line

    def __str__(self) -> str:
        at = self.file if self.line is None else f"{self.file}:{self.line}"
        return f"{at}: {self.element}: {self.problem}" + (f"; {self.remedy}" if self.remedy else "")


class NetFile(Struct, frozen=True):
    """A net and everything else that its file contains.

    Places and transitions are named by the ids in the file.
    """

    net: Net
    name: str = ""
    gspn: Gspn | None = None
    """None if the file has no rates or weights."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Display names by id, if they differ from the ids."""
    positions: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Drawing positions by id (drawing units of the file, y downwards)."""
    notes: tuple[str, ...] = ()
    """How the net here differs from its file, without effect on the behaviour."""
    beyond: tuple[str, ...] = ()
    """What the file contains beyond the net: pages, drawings, data of other tools."""
    document: Element | None = None
    """The XML tree of an ISO PNML file, so that writing PNML keeps what is in `beyond`."""

    def with_names(self, legal: re.Pattern[str]) -> tuple[NetFile, dict[str, str]]:
        """Return the net with names that match a pattern and differ from each other.

        Also returns the new names of the nodes that got one, by their old names. Their old names
        become labels.
        """
        net = self.net
        kept = [name for name in net.places if legal.fullmatch(name)]
        taken = set(kept)
        new: dict[tuple[str, str], str] = {("place", name): name for name in kept}
        for name in net.transitions:
            if legal.fullmatch(name) and name not in taken:
                new["transition", name] = name
                taken.add(name)
        for kind, names in (("place", net.places), ("transition", net.transitions)):
            for name in names:
                if (kind, name) not in new:
                    new[kind, name] = _unused(name, legal, taken, kind[0])
                    taken.add(new[kind, name])
        changed = {name: to for (_, name), to in new.items() if name != to}
        if not changed:
            return self, {}
        places = tuple(new["place", name] for name in net.places)
        transitions = tuple(new["transition", name] for name in net.transitions)
        renamed = replace(net, places=places, transitions=transitions)
        moved = {
            to: self.labels.get(name, name)
            for (_, name), to in new.items()
            if name != to or name in self.labels
        }
        return replace(
            self,
            net=renamed,
            gspn=replace(self.gspn, net=renamed) if self.gspn else None,
            labels=moved,
            positions={
                to: self.positions[name] for (_, name), to in new.items() if name in self.positions
            },
        ), changed


def _unused(name: str, legal: re.Pattern[str], taken: set[str], letter: str) -> str:
    """Return a legal name like `name` that is not taken."""
    stem = re.sub(r"\W", "_", name, flags=re.ASCII)
    return unused(stem if legal.fullmatch(stem) else f"{letter}_{stem}", taken)


def unused(stem: str, taken: Container[str]) -> str:
    """Return the name, with a number behind it if it is taken."""
    return next(one for one in chain([stem], (f"{stem}_{i}" for i in count(2))) if one not in taken)


def thresholds(net: Net, t: int) -> Arcs:
    """Return the inhibitor arcs that have the effect of those of t and of all capacities.

    Raises NetFileError if no inhibitor arc has that effect.
    """
    bars = net.compiled.bars[t]
    if any(k < 1 for _, k in bars):
        raise NetFileError(
            "net",
            f"transition {net.transitions[t]}",
            "it would always exceed a capacity, so it can never fire",
            "raise the capacity",
        )
    return bars


class NetDraft:
    """Collects a net while a file is read, in the order of the file."""

    def __init__(self, file: str) -> None:
        """Start an empty net; errors name `file`."""
        self.file = file
        self.line: int | None = None
        """The line that is being read; the reader keeps it up to date for the errors."""
        self.places: dict[str, int] = {}
        self.capacity: dict[str, int] = {}
        self.transitions: dict[str, int] = {}
        self.lines: dict[str, int | None] = {}
        """The line of each transition."""
        self.consume: dict[str, dict[str, int]] = {}
        self.produce: dict[str, dict[str, int]] = {}
        self.inhibit: dict[str, dict[str, int]] = {}
        self.test: dict[str, dict[str, int]] = {}
        self.rates: dict[str, float] = {}
        self.weights: dict[str, float] = {}
        self.servers: dict[str, int | None] = {}
        self.constants: dict[str, Fraction] = {}
        self.notes: list[str] = []
        self.arcs = 0
        """How many arcs were read."""

    def beyond(self) -> list[str]:
        """Return what the file says and no net keeps: the names of its constants."""
        names = ", ".join(self.constants)
        return [f"the names of the constants {names}"] if names else []

    def fault(self, element: str, problem: str, remedy: str = "") -> NetFileError:
        """Return an error at the line that is being read."""
        return NetFileError(self.file, element, problem, remedy, line=self.line)

    def place(self, name: str, tokens: int, capacity: int | None = None) -> None:
        """Add a place. Raises NetFileError if the id is taken or a number is negative."""
        self._fresh(name)
        for what, number in (("tokens", tokens), ("tokens as its capacity", capacity)):
            if number is not None and number < 0:
                raise self.fault(f"place {name}", f"{number} {what}", "give 0 or more")
        self.places[name] = tokens
        if capacity is not None:
            self.capacity[name] = capacity

    def transition(self, name: str, priority: int = 0) -> None:
        """Add a transition. Raises NetFileError if the id is taken."""
        self._fresh(name)
        self.transitions[name], self.lines[name] = priority, self.line
        for table in (self.consume, self.produce, self.inhibit, self.test):
            table[name] = {}

    def _fresh(self, name: str) -> None:
        if name in self.places or name in self.transitions:
            raise self.fault(name, "this id occurs twice", "ids must be unique in a file")

    def arc(
        self, source: str, target: str, weight: int, what: str = "normal", element: str = "arc"
    ) -> None:
        """Add an arc of kind normal, inhibitor or test. Parallel normal arcs are added up.

        Raises NetFileError.
        """
        self.arcs += 1
        if self.arcs % BETWEEN == 0:
            keep_time(FILE)
        place, transition = (source, target) if source in self.places else (target, source)
        if place not in self.places or transition not in self.transitions:
            remedy = "an arc connects a place and a transition of the file"
            raise self.fault(element, f"it leads from {source!r} to {target!r}", remedy)
        if weight < 1:
            raise self.fault(element, f"a weight of {weight}", "give 1 or more")
        into = source == place
        if what != "normal" and not into:
            raise self.fault(
                element,
                f"{'an inhibitor' if what == 'inhibitor' else 'a test'} arc that leaves a "
                "transition",
                "it must lead from a place to a transition",
            )
        if what == "inhibitor":
            known = self.inhibit[transition].get(place)
            if known is not None:
                self.notes.append(
                    f"{element}: of parallel inhibitor arcs between {source} and {target} the "
                    "lowest weight counts"
                )
            self.inhibit[transition][place] = min(known or weight, weight)
        elif what == "test":
            known = self.test[transition].get(place, 0)
            self.test[transition][place] = max(known, weight)
        else:
            table = (self.consume if into else self.produce)[transition]
            if place in table:
                self.notes.append(
                    f"{element}: parallel arcs between {source} and {target} are added up"
                )
            table[place] = table.get(place, 0) + weight

    def number(self, element: str, text: str) -> Fraction:
        """Return the exact value of an expression of numbers, constants, + - * / and parentheses.

        Raises NetFileError.
        """
        try:
            return evaluate(text, self.constants)
        except (ValueError, ZeroDivisionError) as error:
            remedy = "use numbers and declared constants with + - * / ( )"
            why = "division by zero" if isinstance(error, ZeroDivisionError) else error
            raise self.fault(element, f"{_short(text)!r} has no value: {why}", remedy) from error

    def whole(self, element: str, text: str) -> int:
        """Return an expression as a whole number. Raises NetFileError."""
        value = self.number(element, text)
        if value.denominator != 1:
            raise self.fault(
                element,
                f"expected a whole number, got {_short(text)!r}",
                "tokens and weights are whole numbers",
            )
        return int(value)

    def position(self, element: str, x: str | None, y: str | None) -> tuple[float, float]:
        """Return the position in a drawing; a missing coordinate is 0. Raises NetFileError."""
        return float(self.number(element, x or "0")), float(self.number(element, y or "0"))

    def net(self) -> Net:
        """Return the net. Raises NetFileError if it is malformed.

        A test arc takes and gives back what no other arc takes anyway.
        """
        for t, tests in self.test.items():
            for place, weight in tests.items():
                missing = weight - self.consume[t].get(place, 0)
                for table in (self.consume[t], self.produce[t]) if missing > 0 else ():
                    table[place] = table.get(place, 0) + missing
        self.test.clear()
        try:
            return Net.build(
                self.places,
                {t: (self.consume[t], self.produce[t]) for t in self.transitions},
                inhibitors=self.inhibit,
                capacity=self.capacity,
                priority=self.transitions,
            )
        except ValueError as error:
            raise NetFileError(self.file, "net", str(error)) from error

    def gspn(self, net: Net) -> Gspn | None:
        """Return the GSPN if the file has any rate or weight, else None. Raises NetFileError."""
        if not self.rates and not self.weights:
            return None
        try:
            return Gspn.of(net, self.rates, weights=self.weights, servers=self.servers)
        except ValueError as error:
            said = str(error)  # "TRANSITION: what is wrong"
            at = next((self.lines[t] for t in self.transitions if said.startswith(f"{t}:")), None)
            raise NetFileError(self.file, "rates", said, line=at) from error


def _short(text: str) -> str:
    """Return a text cut to the length of a message."""
    return text if len(text) <= 40 else f"{text[:39]}…"


LEXEME = re.compile(
    r"\s*(?:(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[^\W\d]\w*)|(?P<sign>[-+*/()]))"
)
LARGEST = Fraction(10**300)
"""Magnitude of the numbers in net files: with it every value is also a finite float."""
NESTED = 50
"""The most parentheses and signs inside each other."""


def evaluate(text: str, names: Mapping[str, Fraction]) -> Fraction:
    """Return the exact value of an expression of numbers, names, + - * / and parentheses.

    Raises ValueError and ZeroDivisionError.
    """
    return _Expression(text, names).value()


class _Expression:
    """Arithmetic as other tools write it, by recursive descent; exact, because tokens are.

    It is our own because Python's parser refuses constants that are named like its keywords
    (`lambda`) and accepts much that no other tool means.
    """

    def __init__(self, text: str, names: Mapping[str, Fraction]) -> None:
        self.names = names
        self.words: list[tuple[str, str]] = []
        at = 0
        text = text.strip()
        while at < len(text):
            found = LEXEME.match(text, at)
            if found is None:
                raise ValueError(f"unexpected {text[at:].strip()[:1]!r}")
            self.words.append((found.lastgroup or "", found[found.lastgroup or 0]))
            at = found.end()
        self.next = 0

    def value(self) -> Fraction:
        """Return the value of the whole text. Raises ValueError and ZeroDivisionError."""
        value = self._sum(0)
        if self.next < len(self.words):
            raise ValueError(f"unexpected {self.words[self.next][1]!r}")
        return value

    def _accept(self, signs: str) -> str:
        """Return and skip the next sign if it is one of these, else ""."""
        kind, word = self.words[self.next] if self.next < len(self.words) else ("", "")
        if kind != "sign" or word not in signs:
            return ""
        self.next += 1
        return word

    def _sum(self, depth: int) -> Fraction:
        value = self._product(depth)
        while sign := self._accept("+-"):
            term = self._product(depth)
            value = _bounded(value + term if sign == "+" else value - term)
        return value

    def _product(self, depth: int) -> Fraction:
        value = self._factor(depth)
        while sign := self._accept("*/"):
            factor = self._factor(depth)
            value = _bounded(value * factor if sign == "*" else value / factor)
        return value

    def _factor(self, depth: int) -> Fraction:
        if depth > NESTED:
            raise ValueError(f"nested more than {NESTED} deep")
        if sign := self._accept("+-"):
            value = self._factor(depth + 1)
            return -value if sign == "-" else value
        if self._accept("("):
            value = self._sum(depth + 1)
            if not self._accept(")"):
                raise ValueError("a closing parenthesis is missing")
            return value
        if self.next >= len(self.words):
            raise ValueError("it ends too early")
        kind, word = self.words[self.next]
        self.next += 1
        if kind == "number":
            # Fraction("1e999999999") would need gigabytes; a float tells the magnitude first.
            if len(word) > 300 or not float(word) < float(LARGEST):
                raise ValueError("the number is too large")
            if "e" in word.lower() and float(word) < 1 / float(LARGEST):
                return Fraction(0)
            return Fraction(word)
        if kind == "name":
            if word not in self.names:
                raise ValueError(f"unknown name {word!r}")
            return self.names[word]
        raise ValueError(f"unexpected {word!r}")


def _bounded(value: Fraction) -> Fraction:
    """Return the value. Raises ValueError where arithmetic with it would not end in time."""
    if abs(value) > LARGEST or value.denominator > LARGEST:
        raise ValueError("the number is too large or too fine")
    return value


TABLES = {"rates", "weights", "servers", "default_rate"}


def unit_rates(model: NetFile) -> Gspn:
    """Return a GSPN in which every transition has the rate 1/s and one server."""
    return Gspn.of(model.net, dict.fromkeys(model.net.transitions, 1.0))


def read_rates(text: str, file: str, model: NetFile) -> Gspn:
    """Return a GSPN from the text of a rates file. Raises NetFileError.

    TOML: `[rates]` in 1/s, `[weights]` of immediate transitions, `[servers]` (a number or
    "infinite") and `default_rate`; or just `transition = rate` at the top. JSON of the same form is
    accepted as well. A transition that the file does not name keeps its values from the net file;
    if there are none, its rate is `default_rate` (1/s unless given).
    """
    said = _sorted_in(_tables(text, file), file, model)
    rates, weights = (_numbers(said.get(key, {}), file, key) for key in ("rates", "weights"))
    servers = _servers(said.get("servers", {}), file)
    default = _numbers({"default_rate": said.get("default_rate", 1.0)}, file, "default_rate")[
        "default_rate"
    ]
    for given in (rates, weights, servers):
        for name in given:
            if name not in model.net.transition_index:
                raise NetFileError(
                    file,
                    name,
                    "the net has no transition with this id",
                    "use the ids of the net file",
                )
    for name in rates:
        if name in weights:
            raise NetFileError(
                file,
                name,
                "it has both a rate and a weight",
                "give a rate (timed) or a weight (immediate)",
            )
    _fill_in(model, rates, weights, servers, default)
    try:
        return Gspn.of(model.net, rates, weights=weights, servers=servers)
    except (ValueError, TypeError) as error:
        raise NetFileError(file, "rates", str(error)) from error


def _tables(text: str, file: str) -> dict[str, Any]:
    try:
        return json.loads(text) if text.lstrip().startswith("{") else read_toml(text, file)
    except TomlError as error:
        raise NetFileError(file, error.key, error.found, error.remedy, line=error.line) from error
    except json.JSONDecodeError as error:
        remedy = 'write {"rates": {"TRANSITION": NUMBER}}'
        raise NetFileError(file, "JSON", error.msg, remedy, line=error.lineno) from error
    except RecursionError as error:
        raise NetFileError(file, "JSON", "nested too deeply", "flatten it") from error


def _sorted_in(said: dict[str, Any], file: str, model: NetFile) -> dict[str, Any]:
    """Move rates from the top of the file into `rates`. Raises NetFileError for an unknown key."""
    loose = {key: value for key, value in said.items() if key not in TABLES}
    for key in loose:
        if key not in model.net.transition_index:
            raise NetFileError(
                file,
                key,
                "neither a transition nor a known key",
                f"known keys are {', '.join(sorted(TABLES))}",
            )
    rest = {key: value for key, value in said.items() if key in TABLES}
    return rest | {"rates": {**rest.get("rates", {}), **loose}} if loose else rest


def _numbers(table: Any, file: str, key: str) -> dict[str, float]:
    good = isinstance(table, dict) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in table.values()
    )
    if not good:
        raise NetFileError(
            file,
            key,
            "expected a table of numbers",
            f"write [{key}] and TRANSITION = NUMBER below it",
        )
    return {name: float(value) for name, value in table.items()}


def _servers(table: Any, file: str) -> dict[str, int | None]:
    if not isinstance(table, dict):
        raise NetFileError(
            file, "servers", "expected a table", "write [servers] and TRANSITION = NUMBER below it"
        )
    for name, n in table.items():
        if n != "infinite" and (not isinstance(n, int) or isinstance(n, bool)):
            raise NetFileError(
                file, f"servers.{name}", f"{n!r} servers", 'give a whole number, or "infinite"'
            )
    return {name: None if n == "infinite" else n for name, n in table.items()}


def _fill_in(
    model: NetFile,
    rates: dict[str, float],
    weights: dict[str, float],
    servers: dict[str, int | None],
    default: float,
) -> None:
    """Fill in the transitions that the rates file does not name."""
    for t, name in enumerate(model.net.transitions):
        if name in rates or name in weights:
            continue
        if model.gspn is None:
            rates[name] = default
        elif (rate := model.gspn.rate[t]) is not None:
            rates[name] = rate
            servers.setdefault(name, model.gspn.servers[t])
        else:
            weights[name] = model.gspn.weight[t]
