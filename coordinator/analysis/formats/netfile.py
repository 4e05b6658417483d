"""A net read from a foreign file, the error of all readers and writers, and files of rates.

Nothing is lost silently: what our nets cannot express is refused (NetFileError) if it changes the
behaviour, and listed in `notes` if it does not.
"""

from __future__ import annotations

import ast
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element

from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.task.net import Net


class NetFileError(ValueError):
    """A file cannot be read or a net cannot be written: file, element, problem and remedy."""

    def __init__(self, file: str, element: str, problem: str, remedy: str = "") -> None:
        """Compose the one-line message."""
        self.file, self.element, self.problem, self.remedy = file, element, problem, remedy
        super().__init__(f"{file}: {element}: {problem}" + (f"; {remedy}" if remedy else ""))


@dataclass(frozen=True)
class NetFile:
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
    """What the file contains beyond the net, without effect on its behaviour."""
    document: Element | None = field(default=None, compare=False, repr=False)
    """The XML tree of a PNML file, so that writing keeps graphics, pages, tool-specific data."""


class NetDraft:
    """Collects a net while a file is read, in the order of the file."""

    def __init__(self, file: str) -> None:
        """Start an empty net; errors name `file`."""
        self.file = file
        self.places: dict[str, int] = {}
        self.capacity: dict[str, int] = {}
        self.transitions: dict[str, int] = {}
        self.consume: dict[str, dict[str, int]] = {}
        self.produce: dict[str, dict[str, int]] = {}
        self.inhibit: dict[str, dict[str, int]] = {}
        self.rates: dict[str, float] = {}
        self.weights: dict[str, float] = {}
        self.servers: dict[str, int | None] = {}
        self.notes: list[str] = []

    def place(self, name: str, tokens: int, capacity: int | None = None) -> None:
        """Add a place. Raises NetFileError if the id is taken or `tokens` is negative."""
        self._fresh(name)
        if tokens < 0:
            raise NetFileError(self.file, f"place {name}", f"{tokens} tokens", "give 0 or more")
        self.places[name] = tokens
        if capacity is not None:
            self.capacity[name] = capacity

    def transition(self, name: str, priority: int = 0) -> None:
        """Add a transition. Raises NetFileError if the id is taken."""
        self._fresh(name)
        self.transitions[name] = priority
        self.consume[name], self.produce[name], self.inhibit[name] = {}, {}, {}

    def _fresh(self, name: str) -> None:
        if name in self.places or name in self.transitions:
            raise NetFileError(
                self.file, name, "this id occurs twice", "ids must be unique in a file"
            )

    def arc(
        self, source: str, target: str, weight: int, what: str = "normal", element: str = "arc"
    ) -> None:
        """Add an arc of kind normal, inhibitor or test. Parallel normal arcs are added up.

        Raises NetFileError.
        """
        place, transition = (source, target) if source in self.places else (target, source)
        if place not in self.places or transition not in self.transitions:
            remedy = "an arc connects a place and a transition of the file"
            raise NetFileError(
                self.file, element, f"it leads from {source!r} to {target!r}", remedy
            )
        if weight < 1:
            raise NetFileError(self.file, element, f"a weight of {weight}", "give 1 or more")
        into = source == place
        if what == "inhibitor":
            if not into:
                raise NetFileError(
                    self.file,
                    element,
                    "an inhibitor arc that leaves a transition",
                    "it must lead from a place to a transition",
                )
            known = self.inhibit[transition].get(place, weight)
            self.inhibit[transition][place] = min(known, weight)
        elif what == "test":
            self._test(place, transition, weight)
        else:
            table = (self.consume if into else self.produce)[transition]
            if place in table:
                self.notes.append(
                    f"{element}: parallel arcs between {source} and {target} are added up"
                )
            table[place] = table.get(place, 0) + weight

    def _test(self, place: str, transition: str, weight: int) -> None:
        """Add a test arc: take and give back the tokens that are not consumed anyway."""
        missing = weight - self.consume[transition].get(place, 0)
        if missing > 0:
            for table in (self.consume[transition], self.produce[transition]):
                table[place] = table.get(place, 0) + missing

    def net(self) -> Net:
        """Return the net. Raises NetFileError if it is malformed."""
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
            raise NetFileError(self.file, "rates", str(error)) from error


def arithmetic(file: str, element: str, text: str, names: Mapping[str, float]) -> float:
    """Evaluate an expression of numbers, names, + - * / and parentheses. Raises NetFileError."""
    try:
        return _value(ast.parse(text.strip(), mode="eval").body, names)
    except (SyntaxError, KeyError, TypeError, ZeroDivisionError) as error:
        remedy = "use numbers and declared constants with + - * / ( )"
        raise NetFileError(file, element, f"{text!r} has no value", remedy) from error


def _value(node: ast.expr, names: Mapping[str, float]) -> float:
    match node:
        case ast.Constant(value=int() | float() as number):
            return float(number)
        case ast.Name(id=name):
            return names[name]
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            return -_value(inner, names)
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _value(left, names) + _value(right, names)
        case ast.BinOp(left=left, op=ast.Sub(), right=right):
            return _value(left, names) - _value(right, names)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return _value(left, names) * _value(right, names)
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            return _value(left, names) / _value(right, names)
    raise TypeError(type(node).__name__)


def whole_number(
    file: str, element: str, text: str, names: Mapping[str, float] | None = None
) -> int:
    """Evaluate an expression to a whole number. Raises NetFileError."""
    value = arithmetic(file, element, text, names or {})
    if value != int(value):
        raise NetFileError(
            file,
            element,
            f"expected a whole number, got {text!r}",
            "tokens and weights are whole numbers",
        )
    return int(value)


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
        said = json.loads(text) if text.lstrip().startswith("{") else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        raise NetFileError(
            file, "TOML", str(error), "write [rates] and TRANSITION = NUMBER below it"
        ) from error
    return dict(said)


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
