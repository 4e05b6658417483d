"""The location file services.toml as immutable data: where everything is. Read by every host and by
the coordinator."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import logging
import math
import sys
import traceback
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from msgspec import Struct, field

from petrobot.services.comm.location_file import reading as directory_file
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.comm.protocol.messages import COORDINATOR
from petrobot.services.host.toml_text import InputError, not_utf8

_log = logging.getLogger(__name__)
COORDINATOR_PORT = directory_file.COORDINATOR_PORT
SHIPPED = Path(__file__).parents[3]
"""Folder with petrobot's own files, so that a copied services.toml still finds the shipped
parameter files."""
CELL = "services.toml"
MEMORY = "memory"
MEMORY_CALLS = ("memory.get", "memory.put", "memory.compare_and_set", "memory.list")
"""Services of the node that has the global memory."""


class DirectoryError(InputError):
    """services.toml is invalid, or a name is not in it. `faults` has one line per fault, with its
    remedy."""

    def __init__(self, faults: tuple[str, ...]) -> None:
        super().__init__(faults)
        self.faults = faults

    def __str__(self) -> str:
        return "\n".join(self.faults)


class NodeEntry(Struct, frozen=True):
    """A node: one process, with its workers, at one address."""

    name: str
    host: str
    port: int
    sim: str = ""
    """Import path of the function that makes the simulated laboratory's party, `function(directory,
    name)`; empty for a real node."""
    physics: str = ""
    """Simulated node: what computes its mechanics, by a name that its laboratory knows; empty: the
    laboratory's own choice."""
    worker_memory_mb: int = 4096
    """Limit of the address space of each worker process (MiB).

    Address space is not memory in use: numpy, opencv and scipy together reserve about 0.6 GiB on a
    small host, and some libraries reserve more for each core.
    """
    workers: int = 32
    """Most worker processes for actions without a device, so as many runs of such actions at a
    time."""


class DeviceEntry(Struct, frozen=True):
    """A device: its node, its driver ("module:Class"; empty on a simulated node) and the driver's
    own keys."""

    name: str
    node: str
    driver: str
    config: Mapping[str, Any] = field(default_factory=dict)


class ActionEntry(Struct, frozen=True):
    """A primitive action: the primitive task that it implements, its node or device, and its limits
    (s)."""

    name: str
    run: str
    """Import path, "module:function"."""
    task: str
    node: str
    device: str = ""
    """Empty for an action that needs none."""
    args: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of every call, unless the call overrides them."""
    deadline: float | None = None
    orphan_time: float | None = None
    """How long a run stays active without its coordinator's connection; None: without limit."""
    on_resume: str = "rejoin"
    """What a resumed coordinator does with an active run: rejoin, error or ask."""
    compute_time: float = 0.0
    """Simulated computing time in lock step: the result is delayed by it."""
    at_once: bool = False
    """Start even while an earlier run of its device is still stopping (for example hold)."""


class ServiceEntry(Struct, frozen=True):
    """A general-purpose service. `run` is empty for the global memory and for services that a
    simulated node answers itself."""

    name: str
    node: str
    run: str = ""
    local: bool = False
    """Only callers on the node's own host may call it."""


class StreamEntry(Struct, frozen=True):
    """A set-point stream: the device that receives it, and the period at which it is sent (s)."""

    name: str
    to: str
    period: float


class TimerEntry(Struct, frozen=True):
    """A timer that raises the external pulse event of its name with this period (s)."""

    name: str
    node: str
    period: float


class Directory(Struct, frozen=True):
    """The content of services.toml. The mappings keep the order of the file."""

    source: Path
    hash: str
    """SHA-256 of the file's data (without comments and spacing), compared in the handshake of every
    connection."""
    nodes: Mapping[str, NodeEntry]
    devices: Mapping[str, DeviceEntry]
    actions: Mapping[str, ActionEntry]
    services: Mapping[str, ServiceEntry]
    streams: Mapping[str, StreamEntry]
    timers: Mapping[str, TimerEntry]
    links: Mapping[str, float]
    """Lock-step delays (s) by channel or "source/target" (endpoint names)."""
    keys: Mapping[str, str]
    coordinator: NodeEntry
    """Address at which the coordinator listens (in lock step)."""
    parameters: Mapping[str, str]
    """Parameter files that the cell's programs share, by name; paths relative to this file."""
    dry_run: bool = False
    """Whether all drives stay off. Programs of a dry run and others refuse each other."""
    installation: str = ""
    """Name of this cell, if there are several alike: what was learned in one is not pooled with
    what was learned in another."""

    @property
    def text(self) -> str:
        """The text of the file for the other programs of the cell. Raises DirectoryError,
        OSError."""
        text = read_text(self.source)
        return dry(text) if self.dry_run and not parse(text, self.source).dry_run else text

    def where(self, name: str) -> str:
        """Return the node of an action, service, device, stream's receiver or timer. Raises
        DirectoryError."""
        if name in self.streams:
            return self.devices[self.streams[name].to].node
        key = MEMORY if name in MEMORY_CALLS else name
        for table in (self.actions, self.services, self.devices, self.timers):
            if key in table:
                return str(table[key].node)
        known = [*self.actions, *self.services, *self.devices, *self.timers, *self.streams]
        hint = directory_file.nearest(key, known)
        if key == MEMORY:
            hint = f'; the global memory is on no node: write [services.{MEMORY}] node = "..."'
        raise DirectoryError((f"{self.source}: nothing is named {name!r}{hint}",))

    def party(self, endpoint: str) -> str:
        """Lock step: return the party of an endpoint; a name that is not in the file is a party
        itself."""
        try:
            return endpoint if endpoint in self.nodes else self.where(endpoint)
        except DirectoryError:
            return endpoint

    def without_actions(self, node: str) -> frozenset[str]:
        """Return the devices of a node that no action uses: a button, a light barrier."""
        used = {action.device for action in self.actions.values()}
        return frozenset(d.name for d in self.devices.values() if d.node == node) - used

    def address(self, node: str) -> tuple[str, int]:
        """Return host and port of a node or of the coordinator."""
        entry = self.coordinator if node == COORDINATOR else self.nodes[node]
        return entry.host, entry.port

    def members(self) -> dict[str, tuple[str, int]]:
        """Return the addresses of all members of a lock-step cell: its nodes and the
        coordinator."""
        return {name: self.address(name) for name in (*self.nodes, COORDINATOR)}

    def same_host(self, node: str, party: str) -> bool:
        """Return whether a party is on a node's host. A party that is not a node (a coordinator in
        lock step) counts as on it."""
        return party not in self.nodes or self.nodes[party].host == self.nodes[node].host

    def plant(self, *, scripted: bool, lockstep: bool) -> str:
        """Return where runs take place: in scripted actions (`mock`), in a cell with drives off
        (`dry-run`), in a simulated laboratory (also in lock step, whose time is simulated), or in a
        real cell, with the name of its installation."""
        if scripted:
            return MOCK
        if self.dry_run or any(d.config.get("dry_run") is True for d in self.devices.values()):
            return DRY_RUN
        if lockstep or self.laboratory():
            return SIMULATED
        return f"{REAL} {self.installation}".strip()

    def laboratory(self) -> str:
        """Return the simulated node, empty when there is none."""
        return next((n.name for n in self.nodes.values() if n.sim), "")

    def file(self, path: str) -> Path:
        """Return a path from services.toml, relative to it. A file that is missing there but comes
        with petrobot is taken from petrobot."""
        beside = self.source.parent / path
        shipped = SHIPPED / path
        return shipped if not beside.exists() and shipped.exists() else beside

    def delays(self) -> dict[str, int]:
        """Return the lock-step delays of the links in whole ticks, rounded up, as for
        `lockstep.cell.Delays`."""
        return {
            name: max(1, math.ceil(seconds / TICK - 1e-6)) for name, seconds in self.links.items()
        }


def load(path: str | Path, dry_run: bool = False) -> Directory:
    """Read services.toml; with `dry_run` as if it said `dry_run = true`. Raises DirectoryError with
    every fault in it, OSError when it cannot be read."""
    source = Path(path)
    text = read_text(source)
    found = parse(text, source)
    return parse(dry(text), source) if dry_run and not found.dry_run else found


def dry(text: str) -> str:
    """Return the text of a location file with all drives off."""
    return "dry_run = true\n" + text.removeprefix("\ufeff")


def read_text(source: Path) -> str:
    """Return the text of a location file.

    Raises DirectoryError with the line that is not UTF-8, OSError when it cannot be read.
    """
    try:
        return source.read_text(encoding="utf-8")
    except UnicodeDecodeError as fault:
        raise DirectoryError((str(not_utf8(fault, str(source))),)) from fault


def parse(text: str, source: Path, data: dict[str, Any] | None = None) -> Directory:
    """Read the text of a services.toml; `source` is its path, for messages and for relative paths.
    `data` is read in place of the text's own, which then only gives the lines of faults."""
    text = text.removeprefix("\ufeff")  # some editors begin a file with a byte-order mark
    tables, digest, faults = directory_file.read(text, str(source), MEMORY, data)
    if faults:
        raise DirectoryError(tuple(faults))
    _find_modules_in(source.parent)
    devices = {n: _device(n, t) for n, t in tables["devices"].items()}
    return Directory(
        source=source,
        hash=digest,
        nodes={n: NodeEntry(n, **t) for n, t in tables["nodes"].items()},
        devices=devices,
        actions={n: _action(n, t, devices) for n, t in tables["actions"].items()},
        services={n: _service(n, t) for n, t in tables["services"].items()},
        streams={
            n: StreamEntry(n, t["to"], float(t["period"])) for n, t in tables["streams"].items()
        },
        timers={
            n: TimerEntry(n, t["node"], float(t["period"])) for n, t in tables["timers"].items()
        },
        links={n: float(d) for n, d in tables["links"].items()},
        keys=dict(tables["keys"]),
        coordinator=NodeEntry(
            COORDINATOR, **{"host": "127.0.0.1", "port": COORDINATOR_PORT, **tables[COORDINATOR]}
        ),
        parameters=dict(tables["parameters"]),
        dry_run=digest.startswith(directory_file.DRY),
        installation=str(tables["installation"]["name"]),
    )


def _device(name: str, table: Mapping[str, Any]) -> DeviceEntry:
    config = {key: value for key, value in table.items() if key not in ("node", "driver")}
    return DeviceEntry(name, table["node"], table.get("driver", ""), config)


def _action(name: str, table: Mapping[str, Any], devices: Mapping[str, DeviceEntry]) -> ActionEntry:
    device = table.get("device", "")
    orphan_time = table.get("orphan_time", 1.0 if device else None)
    return ActionEntry(
        name=name,
        run=table["run"],
        task=table.get("task", ""),
        node=devices[device].node if device else table["node"],
        device=device,
        args=table.get("args", {}),
        deadline=_seconds(table.get("deadline")),
        orphan_time=_seconds(orphan_time),
        on_resume=table.get("on_resume", "rejoin"),
        compute_time=float(table.get("compute_time", 0.0)),
        at_once=table.get("start", "when_stopped") == "at_once",
    )


def _service(name: str, table: Mapping[str, Any]) -> ServiceEntry:
    return ServiceEntry(
        name, table["node"], table.get("run", ""), table.get("scope", "network") == "local"
    )


def _seconds(value: float | None) -> float | None:
    return None if value is None else float(value)


FIRST_PHYSICS = "bullet 3.2.7"
"""What made the records of a laboratory that has more than one physics, if they do not say it: at
first there was only this one."""
MOCK, DRY_RUN, SIMULATED, REAL = "mock", "dry-run", "simulated", "real"
"""Plants: scripted actions, a cell with drives off, a simulated laboratory, a real cell (`real
NAME` if the location file names its installation). "": an older file of
estimates does not say."""


def physics_of(directory: Directory) -> str:
    """Return name and version of what computes the mechanics of the simulated node, for records;
    empty if no node is simulated, if its laboratory has only one physics, or if it is not installed
    on this computer.

    A laboratory says it by a function `physics(directory, name)` in the module that `sim` names.
    Raises what that function raises: a ValueError for a name that it does not know.
    """
    name = directory.laboratory()
    if not name:
        return ""
    module, _, _ = directory.nodes[name].sim.partition(":")
    try:
        tell = resolve(f"{module}:physics")
    except ImportError:
        return ""
    return str(tell(directory, name))


def same_physics(one: str, other: str) -> bool:
    """Return whether records of these two may be pooled; records that do not say it (empty) count
    as those of the first physics."""
    return (one or FIRST_PHYSICS) == (other or FIRST_PHYSICS)


def verify_imports(directory: Directory, node: str) -> tuple[str, ...]:
    """Import what a node of this host must load; return one line per fault, empty when all imports
    succeed."""
    places = [
        (f"devices.{d.name}.driver", d.driver)
        for d in directory.devices.values()
        if d.node == node and d.driver
    ]
    places += [
        (f"actions.{a.name}.run", a.run) for a in directory.actions.values() if a.node == node
    ]
    places += [
        (f"services.{s.name}.run", s.run)
        for s in directory.services.values()
        if s.node == node and s.run
    ]
    found = [(key, _import_fault(path)) for key, path in places]
    return tuple(f"{directory.source}: {key}: {fault}" for key, fault in found if fault)


def _find_modules_in(folder: Path) -> None:
    """Let every process that reads a location file import the modules beside it.

    The folder comes last, so nothing in it hides an installed module, but before those of other
    location files that this process has read: they may have modules of the same name. A folder that
    belongs to a package is left out: its modules already have a name.
    """
    found = folder.resolve()
    package = (found / "__init__.py").exists() or found == (SHIPPED / CELL).resolve().parent
    own, cells = str(found), directory_file.CELLS
    if package or (own in sys.path and own not in cells):
        return
    cells[:] = [own, *(cell for cell in cells if cell != own)]
    sys.path[:] = [path for path in sys.path if path not in cells] + cells
    importlib.invalidate_caches()


def _import_fault(path: str) -> str:
    try:
        resolve(path)
    except ImportError as fault:
        return str(fault)
    return ""


MOVED = {
    "sim.laboratory": "sim.catching.laboratory",
    "sim.track_laboratory": "sim.track.laboratory",
    "sim.track_plan": "sim.track.plan",
}
"""Modules in location files that were written before petrobot was one package, and where they are
now."""


@cache
def module_name(name: str) -> str:
    """Return the name by which a module of a location file or task file is imported.

    It is the name itself, with one exception: modules that were shipped as `services`, `sim` or
    `coordinator` before petrobot was one package are found under their present name, unless the
    user has such a package.
    """
    top = name.partition(".")[0]
    if top not in ("coordinator", "services", "sim"):
        return name
    try:
        spec = importlib.util.find_spec(top)
    except ValueError:  # a module in sys.modules without a spec: the user has put it there
        return name
    own = spec.origin if spec is not None else None
    if spec is not None and (own is None or not Path(own).samefile(SHIPPED / top / "__init__.py")):
        return name
    _log.warning("%s is an old name; write petrobot.%s", name, name)
    return f"petrobot.{MOVED.get(name, name)}"


def sources(directory: Directory, node: str) -> dict[str, tuple[str, str]]:
    """Return path and digest of the source of each module that the file names for a node, as it is
    found on this host now, without importing it. Modules of petrobot itself are left out, and so is
    what the modules import."""
    paths = [action.run for action in directory.actions.values() if action.node == node]
    paths += [service.run for service in directory.services.values() if service.node == node]
    paths += [device.driver for device in directory.devices.values() if device.node == node]
    found = {}
    for module in sorted({module_name(path.partition(":")[0]) for path in paths if path}):
        # By hand: Python's own finders import the packages above a module.
        places = [Path(folder, *module.split(".")) for folder in sys.path]
        files = (file for place in places for file in (place / "__init__.py", Path(f"{place}.py")))
        with contextlib.suppress(StopIteration, OSError):
            file = next(file for file in files if file.is_file())
            if not module.startswith("petrobot."):
                found[module] = (str(file), hashlib.sha256(file.read_bytes()).hexdigest()[:16])
    return found


def _at(fault: BaseException) -> str:
    """Return file and line of the code that raised an exception while it was imported; empty if no
    such code was found."""
    steps = traceback.walk_tb(fault.__traceback__)
    files = [(frame.f_code.co_filename, line) for frame, line in steps]
    own = [at for at in files if at[0] not in (__file__, importlib.__file__) and at[0][:1] != "<"]
    return f" ({Path(own[-1][0]).name}:{own[-1][1]})" if own else ""


def resolve(path: str) -> Any:
    """Return the object at an import path "module:name". Raises ImportError with what is missing
    and what to do."""
    written, _, attribute = path.partition(":")
    try:
        module = importlib.import_module(module_name(written))
    except ImportError as fault:
        missing = fault.name if isinstance(fault, ModuleNotFoundError) else None
        if missing and not f"{module_name(written)}.".startswith(f"{missing}."):
            text = f"cannot import {written!r}: it imports {missing!r}{_at(fault)}, which is not on"
            raise ImportError(f"{text} this host; install it, or correct the name") from fault
        raise ImportError(
            f"cannot import {written!r} ({fault}){_at(fault)}; put it beside the location file, "
            "or install its package on this host"
        ) from fault
    except KeyboardInterrupt:
        raise
    except BaseException as fault:  # a module may call sys.exit, and its exceptions may be broken
        words, at = f"{traceback.TracebackException(type(fault), fault, None)}", _at(fault)
        if isinstance(fault, SyntaxError) and fault.filename:  # no line of it was executed
            words, at = fault.msg, f" ({Path(fault.filename).name}:{fault.lineno})"
        text = f"importing {written!r} raises {type(fault).__name__}: {words}{at}"
        raise ImportError(f"{text}; correct the module") from fault
    found = getattr(module, attribute, None)
    if not callable(found):
        names = [n for n in vars(module) if not n.startswith("_")]
        near = directory_file.nearest_in(written, attribute, names)
        raise ImportError(f"{written!r} has no callable {attribute!r}{near}")
    return found
