"""What a location file promises of this host, looked at before anything is launched: code that is
there, keys, files of numbers.

Nothing is imported: a module is found, and its names are read from its source. So the look is
quick, and does not run what it finds. A node's own start imports everything and says what else is
wrong.
"""

from __future__ import annotations

import ast
import errno
import importlib.util
import ipaddress
import socket
from collections.abc import Container, Iterator
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from pathlib import Path

from petrobot.services.comm.location_file import Directory, DirectoryError, module_name
from petrobot.services.comm.location_file.reading import Faults, nearest

LOOPBACK_NAMES = ("localhost", "ip6-localhost")


def misplaced(
    directory: Directory, *, everywhere: bool = False, actions: bool = True
) -> tuple[str, ...]:
    """One line for each fault, as "FILE:LINE: KEY: what is wrong; remedy"; empty when there is
    none.

    Import paths are looked at for nodes on loopback addresses alone, as what other hosts have is
    not known here; `everywhere`: for all nodes, as a lock-step cell launches them all here.
    `actions` False: theirs are not, as scripted ones replace them.
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
                    "make it with `petrobot keys`"
                    if table == "keys"
                    else "write the path of a file"
                )
                faults.add(f"{table}.{name}", f"{directory.file(path)} is not there; {made}")
    here = {n.name for n in directory.nodes.values() if everywhere or is_loopback(n.host)}
    for key, path in _imports(directory, here, actions):
        fault = _unknown(path)
        if fault:
            faults.add(key, fault)
    if actions:
        _check_arguments(directory, here, faults)
    return tuple(faults.lines)


def is_loopback(host: str) -> bool:
    """Whether only this host reaches the address."""
    if host in LOOPBACK_NAMES:
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (
        OSError,
        UnicodeDecodeError,
    ):  # a directory that was made of a text: its lines are not known
        return ""


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
        known = _parameters(action.run) if action.node in here and action.args else None
        for name in action.args if known is not None else ():
            if name not in (known or ()):
                function = action.run.partition(":")[2]
                faults.add(
                    f"actions.{action.name}.args",
                    f"{function} has no argument {name!r}{nearest(name, known or ())}",
                )


def _parameters(path: str) -> set[str] | None:
    """What a function may be given by name beside its context; None if that cannot be told, or if
    it takes anything."""
    module, _, attribute = path.partition(":")
    tree = _source(_spec(module))
    for statement in tree.body if tree is not None else ():
        if (
            isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef)
            and statement.name == attribute
        ):
            if statement.args.kwarg is not None or statement.decorator_list:
                return None
            return {a.arg for a in [*statement.args.args[1:], *statement.args.kwonlyargs]}
    return None


def _spec(module: str) -> ModuleSpec | None:
    try:
        return importlib.util.find_spec(module_name(module))
    except (
        Exception
    ):  # a parent package that cannot be imported, whatever it raises: told by `_unknown`
        return None


def _source(spec: ModuleSpec | None) -> ast.Module | None:
    if spec is None or not spec.has_location or not str(spec.origin).endswith(".py"):
        return None
    try:
        return ast.parse(Path(str(spec.origin)).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return None


def _unknown(path: str) -> str:
    """What is wrong with an import path, with the remedy; empty if nothing is, as far as its source
    tells."""
    module, _, attribute = path.partition(":")
    try:
        spec = importlib.util.find_spec(module_name(module))
    except Exception as fault:  # a parent package that cannot be imported, whatever it raises
        return (
            f"cannot find {module!r} ({type(fault).__name__}: {fault}); install its "
            "package here or put its folder on PYTHONPATH"
        )
    if spec is None:
        return (
            f"no module {module!r} on this host; install its package here or put its "
            "folder on PYTHONPATH"
        )
    names = _names(spec)
    if names is None or attribute in names:
        return ""
    return f"{module!r} has no {attribute!r}{nearest(attribute, names)}"


def _names(spec: ModuleSpec) -> set[str] | None:
    """Names that a module's source binds at its top level; None if that cannot be told from it."""
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
                targets = (
                    statement.targets if isinstance(statement, ast.Assign) else [statement.target]
                )
                found |= {target.id for target in targets if isinstance(target, ast.Name)}
            case ast.Expr():
                pass
            case _:
                return None  # bound under a condition, in a loop, ...
    return None if "*" in found or "__getattr__" in found else found


# Why a node cannot listen at the address that services.toml gives it: file, key and remedy instead
# of the system's words.

WORDS = {
    errno.EADDRINUSE: (
        "port",
        "{port} is in use on {host}; end the process that listens there, or give another port",
    ),
    errno.EACCES: ("port", "{port} may not be used by this user; give one above 1023"),
    errno.EADDRNOTAVAIL: (
        "host",
        "{host} is no address of this host; start the node on its own host, or correct it",
    ),
}
"""By errno: the key that is at fault, and what to do about it."""


def cannot_listen(key: str, host: str, port: int, fault: OSError) -> str:
    """Why nobody can listen there; `key` is the table that holds host and port."""
    at, words = WORDS.get(
        fault.errno or 0, ("host", "cannot listen on {host}:{port}: {why}; correct host and port")
    )
    if isinstance(fault, socket.gaierror):
        at, words = "host", "{host} is no address and no known name ({why}); correct it"
    return f"{key}.{at}: " + words.format(host=host, port=port, why=fault.strerror or fault)


@contextmanager
def listening(directory: Directory, node: str) -> Iterator[None]:
    """What fails to listen in here is the address's fault. Raises DirectoryError in place of
    OSError."""
    try:
        yield
    except OSError as fault:
        host, port = directory.address(node)
        text = cannot_listen(f"nodes.{node}", host, port, fault)
        raise DirectoryError((f"{directory.source}: {text}",)) from fault


def refuse_unusable(directory: Directory, node: str) -> None:
    """Refuse an address that cannot be had, before devices are touched: a second process of a node
    must leave those of the first alone. Raises DirectoryError."""
    host, port = directory.address(node)
    with listening(directory, node):
        family, kind, number, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[
            0
        ]
        with socket.socket(family, kind, number) as probe:
            probe.setsockopt(
                socket.SOL_SOCKET, socket.SO_REUSEADDR, 1
            )  # as the listener: what has ended is not in the way
            probe.bind(address)
