"""Read the text of services.toml, and report every fault in it with line, key and remedy."""

from __future__ import annotations

import hashlib
import ipaddress
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, NamedTuple

from petrobot.services.comm.protocol.messages import COORDINATOR
from petrobot.services.comm.protocol.plain import NotPlainError, plain
from petrobot.services.host.toml_text import TomlError, key_lines, line_of, read_toml, shortened

SCHEMA = 1
Tables = dict[str, dict[str, Any]]


class KeySpec(NamedTuple):
    """What one key of a table may hold: a description for people, and the check."""

    wants: str
    fits: Callable[[Any], bool]
    required: bool = False


CELLS: list[str] = []
"""Folders of location files that this process has put on Python's path, the latest first."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint with the nearest known name, or with all names when there are few."""
    import difflib  # here, because each process of a node reads the file, and few find a fault

    names = list(dict.fromkeys(known))
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known: {', '.join(names)}" if 0 < len(names) <= 12 else ""


def nearest_in(module: str, name: str, names: Iterable[str]) -> str:
    """Return the same hint for a name that a module does not have. A package, an installed module
    or Python's own hides one of the user that has its name."""
    near = nearest(name, names)
    folders = (folder for folder in sys.path if folder not in CELLS[1:])
    files, spec = (Path(f, f"{module}.py") for f in folders), PathFinder.find_spec(module)
    *_, own = None, *(file for file in files if file.is_file())  # the user's folder is the last
    if own and spec and spec.origin and not own.samefile(spec.origin):
        return f"; {spec.origin} hides {own}: give yours another name"
    if module in sys.stdlib_module_names and not near.startswith("; did"):
        return f"; {module!r} is Python's own module: give yours another name"
    return near


def _number(value: Any) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and value == value
        and abs(value) < 1e9
    )


def _text(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _one_of(*choices: str) -> KeySpec:
    return KeySpec("one of " + ", ".join(f'"{c}"' for c in choices), lambda v: v in choices)


def _host(value: Any) -> bool:
    """Return whether this is a name, an IPv4 or an IPv6 address. What looks like an address must be
    one."""
    if not isinstance(value, str) or not _HOST_NAME.fullmatch(value):
        return isinstance(value, str) and _is_address(value)
    return not value.rpartition(".")[2].isdigit() or _is_address(value)


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


_HOST_NAME = re.compile(
    r"[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?(\.[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?)*\.?"
)
"""Letters, digits and hyphens in labels (RFC 1123), and underscores, which many local networks use
too."""
_IMPORT_PATH = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")
_NAME = re.compile(r"[A-Za-z_][\w-]*")
LONGEST_NAME = 200
"""Characters of a name. With a prefix or suffix (`memory:`, `stream:`) it still fits a name of a
message (255)."""


def _path_key(what: str, *, required: bool = False) -> KeySpec:
    return KeySpec(
        f'an import path "module:{what}"',
        lambda v: isinstance(v, str) and bool(_IMPORT_PATH.fullmatch(v)),
        required,
    )


def _name_key(what: str, *, required: bool = False) -> KeySpec:
    return KeySpec(f"the name of {what}", _text, required)


_POSITIVE = KeySpec("a number of seconds above 0 and below 1e9", lambda v: _number(v) and v > 0)
_NOT_NEGATIVE = KeySpec("a number of seconds from 0 to 1e9", lambda v: _number(v) and v >= 0)
_PERIOD = _POSITIVE._replace(required=True)

SHAPES: Mapping[str, Mapping[str, KeySpec]] = {
    "nodes": {
        "host": KeySpec('a host name or address such as "127.0.0.1", without a port', _host, True),
        "port": KeySpec(
            "a port from 1 to 65535",
            lambda v: isinstance(v, int) and not isinstance(v, bool) and 0 < v < 65536,
            True,
        ),
        "sim": _path_key("function"),
        "physics": KeySpec("the name of what computes a laboratory's mechanics", _text),
        "worker_memory_mb": KeySpec(
            "a whole number of MiB above 0",
            lambda v: isinstance(v, int) and not isinstance(v, bool) and v > 0,
        ),
        "workers": KeySpec(
            "a whole number of processes above 0",
            lambda v: isinstance(v, int) and not isinstance(v, bool) and v > 0,
        ),
    },
    "devices": {"node": _name_key("a node", required=True), "driver": _path_key("Class")},
    "actions": {
        "run": _path_key("function", required=True),
        "task": _name_key("the primitive task that the action does"),
        "device": _name_key("a device"),
        "node": KeySpec("the name of one node", _text),
        "args": KeySpec("a table of arguments", lambda v: isinstance(v, dict)),
        "deadline": _POSITIVE,
        "orphan_time": _NOT_NEGATIVE,
        "on_resume": _one_of("rejoin", "error", "ask"),
        "compute_time": _NOT_NEGATIVE,
        "start": _one_of("when_stopped", "at_once"),
    },
    "services": {
        "node": _name_key("a node", required=True),
        "run": _path_key("function"),
        "scope": _one_of("network", "local"),
    },
    "streams": {"to": _name_key("the device that receives it", required=True), "period": _PERIOD},
    "timers": {"node": _name_key("a node", required=True), "period": _PERIOD},
}
OPEN = ("devices",)
"""Tables whose entries may have further keys of their own."""
FLAT: Mapping[str, KeySpec] = {
    "links": KeySpec(
        "a delay in seconds, 0.004 (one tick) or more", lambda v: _number(v) and v >= 0.004
    ),
    "keys": KeySpec("the path of a file or folder, relative to this one", _text),
    "parameters": KeySpec("the path of a file, relative to this one", _text),
}
CHANNELS = ("call", "can", "serial", "tcp", "image", "stream", "control")
KEYS = ("file", "certificates", "also")
COORDINATOR_PORT = 7299
"""Port of the coordinator unless `[coordinator]` sets another."""
INSTALLATION = "installation"
TOP = ("schema", "dry_run", INSTALLATION, COORDINATOR, *SHAPES, *FLAT)
DRY = "dry run of "
"""How the hash of a file with `dry_run = true` begins: in its messages one sees why hashes
differ."""


class Faults:
    """Collects faults as lines "FILE:LINE: KEY: what is wrong; remedy"."""

    def __init__(self, text: str, source: str) -> None:
        self._text = text
        self._source = source
        self.lines: list[str] = []

    def add(self, key: str, fault: str) -> None:
        """Add a fault of a key, given as "table.name.key"."""
        line = line_of(key, key_lines(self._text))
        self.lines.append(f"{self._source}:{line}: {key}: {shortened(fault)}")


def read(
    text: str, source: str, memory: str, data: dict[str, Any] | None = None
) -> tuple[Tables, str, list[str]]:
    """Return the tables of the file, the hash of its data, and all faults. With faults the tables
    must not be used. `data` is read in place of the text's own."""
    faults = Faults(text, source)
    try:
        data = read_toml(text, source) if data is None else data
    except TomlError as fault:
        return {}, "", [str(fault)]
    _check_top(data, faults)
    tables: Tables = {name: data.get(name, {}) for name in (*SHAPES, *FLAT)}
    tables[COORDINATOR] = _coordinator(data, faults)
    tables[INSTALLATION] = {"name": data.get(INSTALLATION, "")}
    for name in (*SHAPES, *FLAT):
        if not isinstance(tables[name], dict):
            faults.add(name, f"is not a table; write [{name}]")
            tables[name] = {}
    for table, shape in SHAPES.items():
        tables[table] = dict(_entries(table, shape, tables[table], faults))
    for table, key in FLAT.items():
        for name, value in tables[table].items():
            if not key.fits(value):
                faults.add(f"{table}.{name}", f"is {value!r}; write {key.wants}")
    for name in tables["links"]:
        if "/" not in name and name not in CHANNELS:
            faults.add(
                f"links.{name}",
                f'unknown link; write a channel or "source/target"{nearest(name, CHANNELS)}',
            )
    for name in tables["keys"]:
        if name not in KEYS:
            faults.add(
                f"keys.{name}",
                f'unknown; write file = "cell.key" or certificates = "keys"{nearest(name, KEYS)}',
            )
    if {"file", "certificates"} <= tables["keys"].keys():
        faults.add("keys", "a shared key and certificates; name one of them")
    elif tables["keys"].keys() == {"also"}:
        faults.add(
            "keys.also",
            'is accepted beside another key, and there is none; write file = "cell.key" or '
            'certificates = "keys", too',
        )
    if not faults.lines:
        _check_places(tables, faults, memory)
    _check_names(tables, faults)
    return tables, _digest(data), faults.lines


def _digest(data: Mapping[str, Any]) -> str:
    """Return the hash of the file's data without `keys`.

    While keys are being replaced, hosts name different ones; a wrong key is refused in the
    handshake anyway.
    """
    told = {name: table for name, table in data.items() if name not in ("keys", "dry_run")}
    digest = hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()
    return (DRY if data.get("dry_run") else "") + digest


def _check_top(data: Mapping[str, Any], faults: Faults) -> None:
    for name in data:
        if name not in TOP:
            faults.add(name, f"unknown table{nearest(name, TOP)}")
    if not isinstance(data.get(INSTALLATION, ""), str):
        faults.add(
            INSTALLATION, f'is {data[INSTALLATION]!r}; write the cell\'s name, such as "cell 2"'
        )
    schema = data.get("schema")
    if schema != SCHEMA:
        known = "is missing" if schema is None else f"is {schema!r}"
        faults.add(
            "schema", f"{known}; write schema = {SCHEMA}, the layout that this version reads"
        )
    if not isinstance(data.get("dry_run", False), bool):
        faults.add("dry_run", f"is {data['dry_run']!r}; write true or false")
    if not data.get("nodes"):
        faults.add("nodes", "no node here; write at least one [nodes.NAME] with host and port")


def _coordinator(data: Mapping[str, Any], faults: Faults) -> dict[str, Any]:
    """Return host and port of the coordinator, as far as they are given."""
    given = data.get(COORDINATOR, {})
    if not isinstance(given, dict):
        faults.add(COORDINATOR, f"is not a table; write [{COORDINATOR}] above its keys")
        return {}
    shape = {key: SHAPES["nodes"][key] for key in ("host", "port")}
    for key, value in given.items():
        _check_key(f"{COORDINATOR}.{key}", key, value, shape, False, faults)
    return given


def _entries(
    table: str, shape: Mapping[str, KeySpec], entries: Mapping[str, Any], faults: Faults
) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, entry in entries.items():
        here = f"{table}.{name}"
        if not isinstance(entry, dict):
            faults.add(here, f"is not a table; write [{table}.NAME] above its keys")
            continue
        if not _NAME.fullmatch(name):
            faults.add(here, "a name has letters, digits, _ and - only, and starts with a letter")
        if len(name) > LONGEST_NAME:
            faults.add(here, f"a name has at most {LONGEST_NAME} characters, found {len(name)}")
        for key, value in entry.items():
            _check_key(f"{here}.{key}", key, value, shape, table in OPEN, faults)
        for key, spec in shape.items():
            if spec.required and key not in entry:
                faults.add(f"{here}.{key}", f"is missing; write {spec.wants}")
        yield name, entry


def _check_key(
    here: str, key: str, value: Any, shape: Mapping[str, KeySpec], open_: bool, faults: Faults
) -> None:
    if key in shape and not shape[key].fits(value):
        faults.add(here, f"is {value!r}; write {shape[key].wants}")
        return
    if key not in shape and not open_:
        faults.add(here, f"unknown key{nearest(key, shape)}")
        return
    try:  # TOML has dates and long integers, which no message carries
        plain(value, here)
    except NotPlainError as fault:
        name, _, text = str(fault).partition(": ")
        faults.add(name, text if ";" in text else f"{text}; write it in quotes")


def _check_places(tables: Tables, faults: Faults, memory: str) -> None:
    nodes, devices = tables["nodes"], tables["devices"]
    _check_addresses(nodes, tables[COORDINATOR], faults)
    for table in ("devices", "services", "timers"):
        for name, entry in tables[table].items():
            _check_node(f"{table}.{name}.node", entry["node"], nodes, faults)
    for name, entry in devices.items():
        node = nodes.get(entry["node"], {})
        if "driver" not in entry and node and not node.get("sim"):
            faults.add(f"devices.{name}.driver", 'is missing; write an import path "module:Class"')
    for name, entry in tables["services"].items():
        node = nodes.get(entry["node"], {})
        if "run" not in entry and name != memory and node and not node.get("sim"):
            faults.add(
                f"services.{name}.run",
                f'is missing; write an import path (only "{memory}" is built in)',
            )
        elif "run" in entry and name == memory:
            text = "is built in, and actions use it by `ctx.get` and `ctx.put`"
            faults.add(f"services.{name}.run", f"{text}; drop it, or rename your service")
    for name, entry in tables["streams"].items():
        if entry["to"] not in devices:
            faults.add(
                f"streams.{name}.to",
                f"no device is named {entry['to']!r}{nearest(entry['to'], devices)}",
            )
    for name, entry in tables["actions"].items():
        _check_action(f"actions.{name}", entry, tables, faults)


def _check_node(key: str, node: str, nodes: Mapping[str, Any], faults: Faults) -> None:
    if node not in nodes:
        faults.add(key, f"no node is named {node!r}{nearest(node, nodes)}")


def _check_addresses(
    nodes: Mapping[str, Any], coordinator: Mapping[str, Any], faults: Faults
) -> None:
    taken: dict[tuple[str, int], str] = {}
    for name, entry in nodes.items():
        if name == COORDINATOR:
            faults.add(f"nodes.{name}", "this name belongs to the coordinator; rename the node")
        address = (entry["host"], entry["port"])
        if address in taken:
            where = f"{address[0]}:{address[1]}"
            faults.add(
                f"nodes.{name}.port",
                f"{where} is already node {taken[address]!r}'s; give each its own port",
            )
        taken.setdefault(address, name)
    own = (coordinator.get("host", "127.0.0.1"), coordinator.get("port", COORDINATOR_PORT))
    if own in taken:
        faults.add(
            f"{COORDINATOR}.port",
            f"{own[0]}:{own[1]} is already node {taken[own]!r}'s; give each its own port",
        )


def _check_action(here: str, entry: Mapping[str, Any], tables: Tables, faults: Faults) -> None:
    nodes, devices = tables["nodes"], tables["devices"]
    device, node = entry.get("device"), entry.get("node")
    if node is not None:
        _check_node(f"{here}.node", node, nodes, faults)
    if device is None and node is None:
        faults.add(
            here,
            'is on no node; write device = "..." (it runs where its device is) or node = "..."',
        )
    elif device is not None and device not in devices:
        faults.add(f"{here}.device", f"no device is named {device!r}{nearest(device, devices)}")
    elif device is not None and node is not None and devices[device]["node"] != node:
        home = devices[device]["node"]
        faults.add(
            f"{here}.node",
            f"is on two nodes: its device {device!r} is on {home!r}, node says {node!r}; "
            "remove node",
        )


def _check_names(tables: Tables, faults: Faults) -> None:
    """Check that all names differ: messages are addressed by endpoint name alone, so all tables
    share one name space."""
    owner: dict[str, str] = {}
    for table in SHAPES:
        for name in tables[table]:
            if name in owner:
                faults.add(
                    f"{table}.{name}",
                    f"the name is taken by {owner[name]}.{name}; rename one of them",
                )
            owner.setdefault(name, table)
