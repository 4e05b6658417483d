"""Launches the node processes of this host, watches them, and starts dead ones again with a growing pause."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import functools
import os
import signal
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from services.comm.whole_file import make_folder

PR_SET_PDEATHSIG = 1  # prctl(2): a child ends with its parent, also when that is killed
FIRST_PAUSE = 0.25
LONGEST_PAUSE = 8.0
STABLE_AFTER = 10.0  # a node that ran so long (s) starts again without pause


class LaunchError(Exception):
    """A node did not come up: which, and what it printed."""


@dataclass(frozen=True, slots=True)
class Program:
    """One process to keep alive: its name and command line."""

    name: str
    command: Sequence[str]
    first: bool = False
    """Others need it: they are started when it is ready."""


@dataclass
class _Child:
    program: Program
    log: Path
    ready: asyncio.Event = field(default_factory=asyncio.Event)
    process: asyncio.subprocess.Process | None = None
    begun_at: int = 0
    """Where the newest start begins in the log (bytes)."""
    starts: int = 0
    task: asyncio.Task[None] | None = None


def is_local(host: str) -> bool:
    """Whether an address belongs to this host: only then can a socket be bound to it."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except OSError:
        return False
    return True


_LIBC = ctypes.CDLL(None)


def _end_with(launcher: int) -> None:
    """In the child, before it becomes the program: a launcher that ended meanwhile would send no signal any more."""
    _LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != launcher:
        os._exit(0)


class Supervisor:
    """Keeps programs alive. Each writes to its own log and says `ready` in the first line that it prints."""

    def __init__(
        self,
        programs: Sequence[Program],
        logs: Path,
        *,
        respawn: bool = True,
        notice: Callable[[str], None] | None = None,
    ) -> None:
        make_folder(logs)
        self._children = [_Child(program, logs / f"{program.name}.log") for program in programs]
        self._respawn = respawn
        self._notice = notice or (lambda _: None)
        self._stopping = False
        self._over = asyncio.Event()

    async def __aenter__(self) -> Supervisor:
        """Start all programs; raises LaunchError when one does not get ready within 60 s."""
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
                child.task = asyncio.create_task(self._keep(child), name=f"keep {child.program.name}")
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
        """Wait until all programs have ended for good."""
        await asyncio.wait([child.task for child in self._children if child.task])

    def process_ids(self) -> dict[str, int]:
        """Process id of each running program by name."""
        return {c.program.name: c.process.pid for c in self._children if c.process and c.process.returncode is None}

    def starts(self, name: str) -> int:
        """How often a program has been started."""
        return next(c.starts for c in self._children if c.program.name == name)

    async def _until_ready(self, child: _Child, timeout: float) -> None:
        ready = asyncio.create_task(child.ready.wait())
        assert child.task is not None
        done, _ = await asyncio.wait({ready, child.task}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
        if ready in done:
            return
        ready.cancel()
        if child.task in done and isinstance(fault := child.task.exception(), OSError):
            raise fault
        said = child.log.read_bytes()[child.begun_at :] if child.log.exists() else b""
        tail = "\n".join(said.decode(errors="replace").splitlines()[-12:])
        why = "ended" if child.task in done else f"was not ready after {timeout:g} s"
        raise LaunchError(f"node {child.program.name} {why}; its log {child.log} ends with:\n{tail}")

    async def _keep(self, child: _Child) -> None:
        loop, pause = asyncio.get_running_loop(), FIRST_PAUSE
        while not self._stopping:
            started = loop.time()
            await self._run_once(child)
            if self._stopping or not self._respawn or not child.ready.is_set():
                return
            pause = FIRST_PAUSE if loop.time() - started > STABLE_AFTER else min(2 * pause, LONGEST_PAUSE)
            self._notice(f"node {child.program.name} died; starting it again in {pause:g} s")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._over.wait()

    async def _run_once(self, child: _Child) -> None:
        with child.log.open("ab", buffering=0) as log:
            child.begun_at = log.seek(0, os.SEEK_END)
            process = await asyncio.create_subprocess_exec(
                *child.program.command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=log,
                preexec_fn=functools.partial(_end_with, os.getpid()),
            )
            child.process, child.starts = process, child.starts + 1
            if self._stopping:
                _signal(child, signal.SIGTERM)
            assert process.stdout is not None
            fault: OSError | None = None
            async for line in process.stdout:
                fault = fault or self._write(child, log, line)
                if b"ready" in line and fault is None:
                    child.ready.set()
            await process.wait()
            if fault is not None and not child.ready.is_set():
                raise fault

    @staticmethod
    def _write(child: _Child, log: IO[bytes], line: bytes) -> OSError | None:
        """To the log. A node is ended if that cannot be written before it is ready; later the node matters more than its log."""
        try:
            log.write(line)
        except OSError as fault:
            if not child.ready.is_set():
                _signal(child, signal.SIGTERM)
                return OSError(fault.errno, fault.strerror, str(child.log))
        return None


def _signal(child: _Child, number: signal.Signals) -> None:
    if child.process and child.process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            child.process.send_signal(number)
