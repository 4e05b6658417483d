"""Launches the node processes of this host, watches them, and restarts dead ones after growing
pauses."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import functools
import logging
import os
import shutil
import signal
import socket
import stat
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from io import FileIO
from pathlib import Path
from typing import BinaryIO

from msgspec import Struct, field

from petrobot.coordinator.run.journal import JournalError
from petrobot.coordinator.run.realtime import on_disk
from petrobot.services.host.toml_text import InputError
from petrobot.services.host.whole_file import make_folder

_log = logging.getLogger(__package__)

PR_SET_PDEATHSIG = 1  # prctl(2): a child ends with its parent, also when that is killed
FIRST_PAUSE = 0.25
LONGEST_PAUSE = 8.0
# for the last output of an ended program (s); processes that it left running may never stop
# talking
LAST_WORDS = 0.5
READY = b"ready"  # what a program prints when others may use it
LARGEST_LOG = 32 << 20  # of a node (bytes), and as much again in the older part
LOOK_AT_LOG = 1.0  # pause between looks at its size (s)
LOG_HANGS = 1.0  # after this time (s) a node that is ready does not wait for its log
LAST_PART = 1 << 16  # of a log is searched for its last lines (bytes)
STABLE_AFTER = 10.0  # after this uptime (s) a node starts again without a pause


class LaunchError(InputError):
    """A node did not start; the text says which, and what it printed."""

    exit_code = 3


class Program(Struct, frozen=True):
    """One process to keep alive: its name and command line."""

    name: str
    command: Sequence[str]
    first: bool = False
    """Whether others need it: they are started when it is ready."""


class _Child(Struct):
    program: Program
    log: Path
    ready: asyncio.Event = field(default_factory=asyncio.Event)
    process: asyncio.subprocess.Process | None = None
    begun_at: int = 0
    """Position of the newest start in the log (bytes)."""
    starts: int = 0
    log_fault: OSError | None = None
    """Why its log could not be written before it was ready."""
    task: asyncio.Task[None] | None = None


def is_local(host: str) -> bool:
    """Return whether an address belongs to this host: only then can a socket be bound to it."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except OSError:
        return False
    return True


_LIBC = ctypes.CDLL(None)


def _end_with(launcher: int) -> None:
    """End the child, before it becomes the program, if the launcher has ended meanwhile and will
    not send a signal."""
    _LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != launcher:
        os._exit(0)


class Supervisor:
    """Keeps programs alive. Each writes to its own log, and its first printed line contains
    `ready`."""

    def __init__(
        self,
        programs: Sequence[Program],
        logs: Path,
        *,
        respawn: bool = True,
    ) -> None:
        make_folder(logs)
        self._children = [_Child(program, logs / f"{program.name}.log") for program in programs]
        self._respawn = respawn
        self._stopping = False
        self._over = asyncio.Event()

    async def __aenter__(self) -> Supervisor:
        """Start all programs. Raises LaunchError if one is not ready within 60 s."""
        try:
            await self.start()
        except BaseException:
            await self.stop()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop them all."""
        await self.stop()

    async def start(self, timeout: float = 60.0) -> None:
        """Start all programs and wait until each is ready."""
        for first in (True, False):
            group = [child for child in self._children if child.program.first is first]
            for child in group:
                child.task = asyncio.create_task(
                    self._keep(child), name=f"keep {child.program.name}"
                )
            for child in group:
                await self._until_ready(child, timeout)

    async def stop(self) -> None:
        """Ask all to end, and kill those that do not within 5 s."""
        self._stopping = True
        self._over.set()
        for child in self._children:
            _signal(child, signal.SIGTERM)
        waiting = [child.task for child in self._children if child.task]
        if not waiting:
            return
        _, late = await asyncio.wait(waiting, timeout=5.0)
        for child in self._children:
            if child.task in late:
                _signal(child, signal.SIGKILL)
        await asyncio.gather(*waiting, return_exceptions=True)

    async def ended(self) -> None:
        """Wait until all programs have ended and none is restarted."""
        await asyncio.wait([child.task for child in self._children if child.task])

    def process_ids(self) -> dict[str, int]:
        """Process id of each running program by name."""
        return {
            c.program.name: c.process.pid
            for c in self._children
            if c.process and c.process.returncode is None
        }

    def starts(self, name: str) -> int:
        """Return how often a program was started."""
        return next(c.starts for c in self._children if c.program.name == name)

    async def _until_ready(self, child: _Child, timeout: float) -> None:
        ready = asyncio.create_task(child.ready.wait())
        assert child.task is not None
        _log.info("waiting for node %s; its log is %s", child.program.name, child.log)
        done, _ = await asyncio.wait(
            {ready, child.task}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED
        )
        if ready in done:
            _log.info("node %s is ready", child.program.name)
            return
        ready.cancel()
        if child.task in done and isinstance(fault := child.task.exception(), OSError):
            raise fault
        why = "" if child.task in done else f"was not ready after {timeout:g} s"
        raise LaunchError(f"node {child.program.name} {_end_of(child, why)}")

    async def _keep(self, child: _Child) -> None:
        loop, pause = asyncio.get_running_loop(), FIRST_PAUSE
        while not self._stopping:
            started = loop.time()
            try:
                await self._run_once(child)
            except OSError as fault:
                if not child.ready.is_set():
                    raise
                # As when there is no room for another process: that may pass.
                _log.warning("node %s could not be started: %s", child.program.name, fault)
            if self._stopping or not self._respawn or not child.ready.is_set():
                return
            pause = (
                FIRST_PAUSE
                if loop.time() - started > STABLE_AFTER
                else min(2 * pause, LONGEST_PAUSE)
            )
            told = _end_of(child, lines=1)
            _log.warning(
                "node %s died: it %s; starting it again in %g s", child.program.name, told, pause
            )
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._over.wait()

    async def _run_once(self, child: _Child) -> None:
        with _opened(child) as log:
            child.begun_at = log.seek(0, os.SEEK_END)
            async with output_pipe() as (end, output):
                process = await asyncio.create_subprocess_exec(
                    *child.program.command,
                    stdin=asyncio.subprocess.DEVNULL,
                    stdout=end,
                    stderr=log,
                    # Ctrl-C in a terminal is for its whole process group: a node that shared ours
                    # would end before we stop it, and look as if it had died.
                    process_group=0,
                    preexec_fn=functools.partial(_end_with, os.getpid()),
                )
                end.close()
                child.process, child.starts = process, child.starts + 1
                if self._stopping:
                    _signal(child, signal.SIGTERM)
                copying = asyncio.create_task(_copy(child, output, log))
                limiting = asyncio.create_task(_limit(child, log))
                await process.wait()
                await asyncio.wait({copying}, timeout=LAST_WORDS)
                copying.cancel()
                limiting.cancel()
                fault = child.log_fault
                if fault is not None and not child.ready.is_set():
                    raise fault


def _end_of(child: _Child, why: str = "", lines: int = 12) -> str:
    """Return how a program ended, unless `why` says it, and the last lines of its log since it was
    started: one of them stands in the same line."""
    code = child.process.returncode if child.process is not None else None
    if code is not None and code < 0:
        why = f"was ended by a signal ({signal.strsignal(-code)})"
    said = b""
    with contextlib.suppress(OSError), child.log.open("rb") as log:
        log.seek(max(child.begun_at, log.seek(0, os.SEEK_END) - LAST_PART))
        said = log.read()
    tail = said.decode(errors="replace").splitlines()[-lines:]
    told = ("ends with:", *tail) if tail else ("says nothing; start it again",)
    return f"{why or 'ended'}; its log {child.log} {(chr(10) if len(tail) > 1 else ' ').join(told)}"


def _opened(child: _Child) -> FileIO:
    """Open the log of a node. Once the node was ready, it runs without one rather than not at
    all."""
    try:
        make_folder(child.log.parent)
        return FileIO(child.log, "a+")
    except OSError as fault:
        if not child.ready.is_set():
            raise
        why = fault.strerror or fault
        _log.warning(
            "%s: %s; node %s has no log until it starts again", child.log, why, child.program.name
        )
        return FileIO(os.devnull, "a+")


async def _limit(child: _Child, log: FileIO) -> None:
    """Look at the size of a log, and move what is in it to the older part when it is too long."""
    while True:
        await asyncio.sleep(LOOK_AT_LOG)
        status = os.fstat(log.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_size <= LARGEST_LOG:
            continue
        try:
            # Opened again: its writers move the position that they share with `log`. And by its
            # number: a log that was removed must not grow for ever either.
            file = FileIO(f"/proc/self/fd/{log.fileno()}", "r+")
            await asyncio.to_thread(_move, file, older_part(child.log))
            child.begun_at = 0
        except OSError as fault:
            _log.warning("%s: the log is too long and cannot be cut: %s", child.log, fault)


def _move(log: FileIO, older: Path) -> None:
    """Move what is in a log to another file. The log's processes keep it open, so it is copied and
    emptied, not renamed. If the copy finds no room, what was in the log is lost."""
    with log:
        try:
            older.unlink(missing_ok=True)  # first, as that makes room
            with older.open("xb") as copy:
                shutil.copyfileobj(log, copy)
        except OSError as fault:
            _log.warning("%s: %s; older lines of the log are lost", older, fault.strerror or fault)
            with contextlib.suppress(OSError):
                older.unlink(missing_ok=True)
        log.truncate(0)


def older_part(log: Path) -> Path:
    """Return the file with what a node wrote before its log was last emptied."""
    return log.with_name(f"{log.name}.1")


@asynccontextmanager
async def output_pipe(limit: int = 1 << 16) -> AsyncIterator[tuple[BinaryIO, asyncio.StreamReader]]:
    """Return a pipe for the output of a child: the end to pass to it, which must be closed after
    the start, and a reader.

    asyncio's own pipe (`stdout=PIPE`) would belong to the process: `wait` would wait for the end of
    the pipe, and a process that the child left running may hold that open for ever.
    """
    reading, writing = os.pipe()
    reader = asyncio.StreamReader(limit)
    connected = asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(reading, "rb", 0)
    )
    transport, _ = await connected
    with os.fdopen(writing, "wb", 0) as end:
        try:
            yield end, reader
        finally:
            transport.close()


async def _copy(child: _Child, output: asyncio.StreamReader, log: FileIO) -> None:
    """Write what a program prints to its log, and note when it is ready. If the log cannot be
    written before that, the program is ended; later the program matters more than its log."""
    said, told = b"", False
    # Not line by line: a line may be longer than the reader's limit, and if the copying ended then,
    # the pipe would fill and block each later action that prints.
    while part := await output.read(1 << 16):
        writing = on_disk(functools.partial(log.write, part))
        try:
            said = said[1 - len(READY) :] + part  # the word may come in two parts
            if READY in said and not told and child.log_fault is None:
                await asyncio.wait([writing], timeout=LOG_HANGS)
                if not writing.done() or writing.exception() is None:
                    told = True
                    if child.ready.is_set():
                        _log.warning("node %s is ready again", child.program.name)
                    child.ready.set()
            with contextlib.suppress(JournalError):  # the disk hangs: what it was given is lost
                await writing
        except OSError as fault:
            if not child.ready.is_set():
                child.log_fault = child.log_fault or OSError(
                    fault.errno, fault.strerror, str(child.log)
                )
                _signal(child, signal.SIGTERM)
        finally:
            writing.cancel()


def _signal(child: _Child, number: signal.Signals) -> None:
    if child.process and child.process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            child.process.send_signal(number)
