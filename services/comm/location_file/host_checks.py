"""Checks of what services.toml says about this host: code, keys, parameter files, and the address
to listen at.

The checks of code run before anything is launched and import nothing: a module is located, and its
names are read from its source. So they are fast and do not run the code that they check. A node
imports everything when it starts, and then reports all other faults.
"""

from __future__ import annotations

import ast
import errno
import importlib.util
import socket
import time
from collections.abc import Container, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from petrobot.services.comm.location_file import Directory, DirectoryError, module_name
from petrobot.services.comm.location_file.reading import Faults, nearest, nearest_in
from petrobot.services.comm.protocol.security import is_loopback


def misplaced(
    directory: Directory, *, everywhere: bool = False, actions: bool = True
) -> tuple[str, ...]:
    """Return one line for each fault, as "FILE:LINE: KEY: what is wrong; remedy"; empty when there
    is none.

    Import paths are checked only for nodes on loopback addresses, because this host does not know
    what other hosts have installed. `everywhere`: for all nodes, because a lock-step cell launches
    them all here. `actions` False: not for actions, because scripted ones replace them.
    """
    faults = Faults(_text(directory.source), str(directory.source))
    open_nodes = [n.name for n in directory.nodes.values() if not is_loopback(n.host)]
    if open_nodes and not directory.keys and not everywhere:
        for name in open_nodes:
            host = directory.nodes[name].host
            faults.add(
                f"nodes.{name}.host",
                f"{host} can be reached by other hosts, and there is no key; make one with "
                "`petrobot keys`, copy it to each "
                'host and write [keys] file = "cell.key", or write host = "127.0.0.1"',
            )
    for table, files in (("keys", directory.keys), ("parameters", directory.parameters)):
        for name, path in files.items():
            if not directory.file(path).exists():
                made = (
                    "copy it from a host that has it; if none has, make it with `petrobot keys` "
                    "and copy it to each host"
                    if table == "keys"
                    else "write the path of a file"
                )
                faults.add(f"{table}.{name}", f"{directory.file(path)} is not there; {made}")
    here = {n.name for n in directory.nodes.values() if everywhere or is_loopback(n.host)}
    for key, path in _imports(directory, here, actions):
        fault = _unknown(path, directory.source.parent)
        if fault:
            faults.add(key, fault)
    if actions:
        _check_arguments(directory, here, faults)
    return tuple(faults.lines)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return ""  # the directory was made from a text; its lines are not known


def _imports(
    directory: Directory, here: Container[str], actions: bool
) -> Iterator[tuple[str, str]]:
    for node in directory.nodes.values():
        if node.name in here and node.sim:
            yield f"nodes.{node.name}.sim", node.sim
    for device in directory.devices.values():
        if device.node in here and device.driver:
            yield f"devices.{device.name}.driver", device.driver
    for action in directory.actions.values():
        if actions and action.node in here:
            yield f"actions.{action.name}.run", action.run
    for service in directory.services.values():
        if service.node in here and service.run:
            yield f"services.{service.name}.run", service.run


def _check_arguments(directory: Directory, here: Container[str], faults: Faults) -> None:
    for action in directory.actions.values():
        known = _signature(action.run) if action.node in here and action.args else None
        for name in action.args if known is not None else ():
            if known is not None and name not in known["parameters"]:
                function = action.run.partition(":")[2]
                near = nearest(name, known["parameters"]) or "; it has none: drop this"
                text = f"{function} has no argument {name!r}{near}"
                faults.add(f"actions.{action.name}.args", text)


def signatures(directory: Directory, *, everywhere: bool) -> dict[str, Mapping[str, Any]]:
    """Return by action what its source says of its arguments: `parameters` by name, `required` and
    `open`; actions whose source does not show it, or of other hosts, are left out. `everywhere`: as
    in `misplaced`."""
    here = {n.name for n in directory.nodes.values() if everywhere or is_loopback(n.host)}
    actions = (a for a in directory.actions.values() if a.node in here)
    found = {action.name: _signature(action.run) for action in actions}
    return {name: facts for name, facts in found.items() if facts is not None}


def _signature(path: str) -> Mapping[str, Any] | None:
    """Return the arguments of a function without its context; None if unknown or if it accepts any
    name."""
    module, _, attribute = path.partition(":")
    tree = _source(_spec(module))
    for statement in reversed(tree.body if tree is not None else ()):  # the last one counts
        match statement:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) if name == attribute:
                if statement.args.kwarg is not None or statement.decorator_list:
                    return None
                given = statement.args
                ordered = [*given.posonlyargs, *given.args]
                needed = ordered[1 : len(ordered) - len(given.defaults)]
                pairs = zip(given.kwonlyargs, given.kw_defaults, strict=True)
                needed += [one for one, default in pairs if default is None]
                known = [one.arg for one in (*ordered[1:], *given.kwonlyargs)]
                return {
                    "parameters": dict.fromkeys(known, ""),
                    "required": [one.arg for one in needed],
                    "open": False,
                }
            case ast.Assign() | ast.AnnAssign() if attribute in _bound(statement):
                return None
    return None


def _spec(module: str) -> ModuleSpec | None:
    try:
        return importlib.util.find_spec(module_name(module))
    except Exception:  # a parent package that cannot be imported; `_unknown` reports it
        return None


def _source(spec: ModuleSpec | None) -> ast.Module | None:
    if spec is None or not spec.has_location or not str(spec.origin).endswith(".py"):
        return None
    try:
        file = Path(str(spec.origin))
        return _parsed(file, file.stat().st_mtime_ns)
    except (OSError, SyntaxError, ValueError):
        return None


@lru_cache(maxsize=64)
def _parsed(file: Path, changed: int) -> ast.Module:
    """Parse a source file once for all that it is asked for; `changed` is its time."""
    return ast.parse(file.read_bytes())


def _unknown(path: str, beside: Path) -> str:
    """Return what is wrong with an import path, with the remedy; empty if nothing is, as far as its
    source shows. `beside`: the folder of the location file."""
    module, _, attribute = path.partition(":")
    if module.endswith(".py"):
        return f"a module is named without .py: write {module[:-3] + ':' + attribute!r}"
    try:
        spec = importlib.util.find_spec(module_name(module))
    except Exception as fault:  # a parent package that cannot be imported, whatever it raises
        return (
            f"cannot find {module!r} ({type(fault).__name__}: {fault}); install its "
            "package here or put it beside the location file"
        )
    if spec is None:
        near = nearest(module, sorted(file.stem for file in beside.glob("*.py")))
        return (
            f"no module {module!r} on this host; install its package here or put it beside "
            f"the location file{near if 'did you mean' in near else ''}"
        )
    names = _names(spec)
    if names is None or attribute in names:
        return ""
    return f"{module!r} has no {attribute!r}{nearest_in(module, attribute, names)}"


def _bound(statement: ast.Assign | ast.AnnAssign) -> set[str]:
    targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
    return {target.id for target in targets if isinstance(target, ast.Name)}


def _names(spec: ModuleSpec) -> set[str] | None:
    """Return the names that a module's source binds at its top level; None if the source does not
    show them."""
    tree = _source(spec)
    if tree is None:
        return None
    found: set[str] = set()
    for statement in tree.body:
        match statement:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                found.add(statement.name)
            case ast.Import() | ast.ImportFrom():
                found |= {
                    (alias.asname or alias.name).partition(".")[0] for alias in statement.names
                }
            case ast.Assign() | ast.AnnAssign():
                found |= _bound(statement)
            case ast.Expr():
                pass
            case _:
                return None  # names may be bound under a condition, in a loop, ...
    return None if "*" in found or "__getattr__" in found else found


# Why a node cannot listen at its address in services.toml: file, key and remedy instead of the
# text of the operating system.

WORDS = {
    errno.EADDRINUSE: (
        "port",
        "{port} is in use on {host}: does this node run already (`petrobot nodes`)? Else end the "
        "process that listens there, or write another port",
    ),
    errno.EACCES: ("port", "{port} may not be used by this user; write one above 1023"),
    errno.EADDRNOTAVAIL: (
        "host",
        "{host} is not an address of this host; start the node on its own host, or correct it",
    ),
}
"""By errno: the wrong key, and what to do about it."""


def cannot_listen(key: str, host: str, port: int, fault: OSError) -> str:
    """Return why it is not possible to listen there; `key` is the table with host and port."""
    at, words = WORDS.get(
        fault.errno or 0, ("host", "cannot listen on {host}:{port}: {why}; correct host and port")
    )
    if isinstance(fault, socket.gaierror):
        at, words = "host", "{host} is neither an address nor a known name ({why}); correct it"
    return f"{key}.{at}: " + words.format(host=host, port=port, why=fault.strerror or fault)


@contextmanager
def listening(directory: Directory, node: str) -> Iterator[None]:
    """Convert an OSError of the code inside to a DirectoryError that names the address in
    services.toml."""
    try:
        yield
    except OSError as fault:
        host, port = directory.address(node)
        text = cannot_listen(f"nodes.{node}", host, port, fault)
        raise DirectoryError((f"{directory.source}: {text}",)) from fault


CLAIM_LIMIT = 15.0
"""How long a node waits for another process of its address that does not listen (s): longer than
that may take to end (GOOD_ORDER and STOP_ROUTINE in `parent_death.py`)."""


def claim(directory: Directory, node: str) -> socket.socket:
    """Check that the address can be used, before devices are touched. Raises DirectoryError.

    A second process of a node must not disturb the devices of the first, which listens only while
    they are ready. So as long as the returned socket is open, the address is this process's: the
    kernel gives its name, which is no file, to one socket. It must stay open until the devices'
    processes have ended.
    """
    host, port = directory.address(node)
    until = time.monotonic() + CLAIM_LIMIT
    with listening(directory, node):
        family, kind, number, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[
            0
        ]
        while True:
            with socket.socket(family, kind, number) as probe:
                # The same option as the listener has: connections that have ended do not block the
                # port.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
            claimed = socket.socket(socket.AF_UNIX)
            try:
                claimed.bind(f"\0petrobot {address[0]!s} {port}")
            except OSError:
                claimed.close()
                if time.monotonic() > until:
                    raise
            else:
                return claimed
            time.sleep(0.05)  # the other one is starting, and will listen, or it is closing
