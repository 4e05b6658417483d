"""Read what the code of a location file declares, in a separate process, and compare it with the
file.

For `petrobot check`. Importing runs the user's code, so it happens in another process and within
limits: a module that waits for a device, or ends the process, gives one line of text.
"""

from __future__ import annotations

import functools
import json
import math
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from petrobot.services.comm.location_file import MEMORY, Directory
from petrobot.services.comm.location_file.reading import CELLS, Faults, nearest
from petrobot.services.comm.protocol.security import is_loopback

PROGRAM = "petrobot.services.code_reading"
SECONDS = 20.0
"""Processor time that the imports may take (s)."""
BUSY = 3.0
"""Limit of the elapsed time, as a multiple of the processor time: for a busy host, or imports that
sleep."""
ADDRESS_SPACE = 4 << 30
"""Address space that the imports may use (bytes)."""

SLOW = 1.0
"""Seconds between two steps of a driver, or two set points of a stream, above which the unit is
probably mistaken."""

Facts = Mapping[str, Any]
"""What `PROGRAM` reports about one import path."""


def read_code(directory: Directory, seconds: float = SECONDS) -> dict[str, Facts]:
    """Return what is known of each action, service and driver of this host's nodes, by import path.

    A path that cannot be imported, or not within `seconds` of processor time for all paths
    together, has the key `import` with the reason.
    """
    here = {node.name for node in directory.nodes.values() if is_loopback(node.host)}
    actions, services = directory.actions.values(), directory.services.values()
    functions = [(a.node, a.run) for a in actions] + [(s.node, s.run) for s in services]
    asked: dict[str, Any] = {run: None for node, run in functions if node in here and run}
    for device in directory.devices.values():
        if device.node in here and device.driver:
            more = {"dry_run": True} if directory.dry_run else {}
            if asked.get(device.driver) is None:
                asked[device.driver] = {}  # also where an action has the same path
            follows = any(stream.to == device.name for stream in directory.streams.values())
            table = {**device.config, **more}
            asked[device.driver][device.name] = {"table": table, "follows": follows}
    known: dict[str, Facts] = {}
    while left := [[path, config] for path, config in asked.items() if path not in known]:
        told, why = _ask(left, seconds)
        known |= {facts["path"]: facts for facts in told}
        unread = [path for path, _ in left[len(told) :]]
        # The import of the first one ended the process, and would do so again for the others of its
        # module. A new process reads the rest.
        known |= {path: {"import": why} for path in unread if _module(path) == _module(unread[0])}
    return known


def _module(path: str) -> str:
    return path.partition(":")[0]


def _ask(paths: list[Any], seconds: float) -> tuple[list[Facts], str]:
    """Return what a new process reports about the paths until it ends, and why it ended before the
    last one. Code that comes with petrobot does not change while this process runs, so it is read
    once."""
    folders = [folder for folder in sys.path if folder not in CELLS[1:]]  # of other cells
    asked = {"parent": os.getpid(), "sys_path": folders, "paths": paths}
    question = json.dumps(asked, default=str)  # with nan, which a check must name as a node does
    if all(path.startswith("petrobot.") for path, _ in paths):
        return _ask_once(question, seconds)
    return _ask_process(question, seconds)


def _ask_process(question: str, seconds: float) -> tuple[list[Facts], str]:
    process = subprocess.Popen(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}; import runpy; "
         f"runpy.run_module({PROGRAM!r}, run_name='__main__')"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )  # fmt: skip
    resource.prlimit(process.pid, resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    # The limit is one of processor time: on a busy host an import may take several times as long.
    most = math.ceil(seconds)
    resource.prlimit(process.pid, resource.RLIMIT_CPU, (most, most + 1))
    try:
        text, _ = process.communicate(question, timeout=BUSY * seconds)
        why = f"importing it ended the process (exit code {process.returncode})"
        if process.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
            why = f"importing it took longer than {seconds:g} s"
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        text, _ = process.communicate()
        why = f"importing it took longer than {seconds:g} s"
    except BaseException:  # Ctrl-C, which the process does not receive
        if process.returncode is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        raise
    lines = [line for line in text.splitlines() if line.endswith("}")]
    remedy = "a module may define functions and classes, but must do nothing when it is imported"
    return [json.loads(line) for line in lines], f"{why}; {remedy}"


_ask_once = functools.lru_cache(maxsize=8)(_ask_process)


def code_faults(directory: Directory, code: Mapping[str, Facts], text: str) -> tuple[str, ...]:
    """Return one line for each fault, as "FILE:LINE: KEY: what is wrong; remedy". `text` is that
    of the location file."""
    faults, told = Faults(text, str(directory.source)), set[tuple[str, str]]()

    def unread(key: str, path: str) -> None:
        """Report why a path cannot be imported; a fault of its module is reported once."""
        why = code.get(path, {}).get("import", "")
        module = (_module(path), why)
        if why and module not in told:
            faults.add(key, why)
        if why.startswith(("importing", "cannot import")):  # the module, not a name in it
            told.add(module)

    for table in (directory.actions, directory.services):
        for entry in table.values():
            key = f"{'actions' if entry.name in directory.actions else 'services'}.{entry.name}"
            unread(f"{key}.run", entry.run)
            if "classes" in code.get(entry.run, {}):
                text = f"{entry.run!r} is a class; name a function: an action is an `async` one"
                faults.add(f"{key}.run", text)
    for action in directory.actions.values():
        place = code.get(action.run, {}).get("device")
        if place and not action.device:
            where = f"{Path(place[0]).name}:{place[1]}"
            text = f'uses {place[2]} ({where}) and has no device; write device = "..." for node'
            faults.add(f"actions.{action.name}", text)
    for device in directory.devices.values():
        unread(f"devices.{device.name}.driver", device.driver)
        facts = code.get(device.driver, {})
        for key, said in facts.get("keys", {}).get(device.name, ()):
            faults.add(f"devices.{device.name}.{key}", said.removeprefix(f"{key}: "))
    return (*faults.lines, *dict.fromkeys(_streams(directory, code)), *_memory(directory, code))


def _memory(directory: Directory, code: Mapping[str, Facts]) -> Iterator[str]:
    """The first use of a global memory that is on no node."""
    for action in directory.actions.values():
        place = code.get(action.run, {}).get("memory")
        if place and MEMORY not in directory.services:
            remedy = f'write [services.memory] node = "{action.node}" in {directory.source}'
            yield f"{place[0]}:{place[1]}: the global memory is on no node; {remedy}"
            return


def _streams(directory: Directory, code: Mapping[str, Facts]) -> Iterator[str]:
    """Return the streams that the code uses and the location file does not have, or directs to
    another device; each name once."""
    told = set[str]()
    for device in directory.devices.values():
        for name, (file, line) in code.get(device.driver, {}).get("streams", {}).items():
            entry = directory.streams.get(name)
            if entry is None or entry.to != device.name:
                what = "is not declared" if entry is None else f"leads to {entry.to!r}"
                remedy = f'write [streams.{name}] to = "{device.name}" in {directory.source}'
                remedy += nearest(name, directory.streams) if entry is None else ""
                told.add(name)
                yield f"{file}:{line}: the stream {name!r} {what}; {remedy}"
    for path in dict.fromkeys(action.run for action in directory.actions.values()):
        for name, (file, line) in code.get(path, {}).get("streams", {}).items():
            if name not in directory.streams and name not in told:
                hint = nearest(name, directory.streams)
                remedy = f"declare [streams.{name}] in {directory.source}{hint}"
                yield f"{file}:{line}: the stream {name!r} is not declared; {remedy}"
