"""Rates for a net that has none of its own: a file of rates, weights and servers by transition, or
one rate for all."""

from __future__ import annotations

import json
import tomllib
from typing import Any

from petrobot.coordinator.analysis.formats.netfile import FormatError, NetFile
from petrobot.coordinator.analysis.time.gspn import Gspn

TABLES = {"rates", "weights", "servers", "default_rate"}


def unit_rates(model: NetFile) -> Gspn:
    """Every transition with rate 1/s and one server."""
    return Gspn.of(model.net, dict.fromkeys(model.net.transitions, 1.0))


def read_rates(text: str, file: str, model: NetFile) -> Gspn:
    """A GSPN from a rates file. Raises FormatError.

    TOML: `[rates]` transition = 1/s, `[weights]` of immediate transitions, `[servers]` (a number or
    "infinite"), and `default_rate`; or just `transition = rate` at the top. JSON of the same form
    is read as well. A transition that is not named keeps what the net file says of it, else it gets
    `default_rate`, or 1/s.
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
                raise FormatError(
                    file,
                    name,
                    "no transition of the net has this id",
                    "name transitions by their ids",
                )
    for name in rates:
        if name in weights:
            raise FormatError(
                file,
                name,
                "it has a rate and a weight",
                "a rate makes it timed, a weight immediate",
            )
    _fill_in(model, rates, weights, servers, default)
    try:
        return Gspn.of(model.net, rates, weights=weights, servers=servers)
    except (ValueError, TypeError) as error:
        raise FormatError(file, "rates", str(error)) from error


def _tables(text: str, file: str) -> dict[str, Any]:
    try:
        said = json.loads(text) if text.lstrip().startswith("{") else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        raise FormatError(
            file, "TOML", str(error), "write [rates] and TRANSITION = NUMBER below it"
        ) from error
    return dict(said)


def _sorted_in(said: dict[str, Any], file: str, model: NetFile) -> dict[str, Any]:
    """Rates that stand at the top of the file, put where they belong. Raises FormatError for any
    other key."""
    loose = {key: value for key, value in said.items() if key not in TABLES}
    for key in loose:
        if key not in model.net.transition_index:
            raise FormatError(
                file,
                key,
                "an unknown key, and no transition",
                f"known are {', '.join(sorted(TABLES))}",
            )
    rest = {key: value for key, value in said.items() if key in TABLES}
    return rest | {"rates": {**rest.get("rates", {}), **loose}} if loose else rest


def _numbers(table: Any, file: str, key: str) -> dict[str, float]:
    good = isinstance(table, dict) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in table.values()
    )
    if not good:
        raise FormatError(
            file, key, "no table of numbers", f"write [{key}] and TRANSITION = NUMBER below it"
        )
    return {name: float(value) for name, value in table.items()}


def _servers(table: Any, file: str) -> dict[str, int | None]:
    if not isinstance(table, dict):
        raise FormatError(
            file, "servers", "no table", "write [servers] and TRANSITION = NUMBER below it"
        )
    for name, n in table.items():
        if n != "infinite" and (not isinstance(n, int) or isinstance(n, bool)):
            raise FormatError(
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
    """What the file leaves open: as the net file says, else the default rate."""
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
