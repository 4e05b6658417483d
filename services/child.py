"""One child process of a node and the pipe to it, in the node's asyncio loop."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from services.pipe import pipe_pair
from services.worker import Setup

NONE = -1


class Child:
    """A running process of `services.worker`. `heard(items)` gets each list that it sends, `ended()` that it is gone."""

    def __init__(
        self,
        setup: Setup,
        heard: Callable[[list[Any]], None],
        ended: Callable[[], None],
        link: socket.socket | None = None,
    ) -> None:
        """Start it; `link` is the worker's end of the link to its device, closed here. Raises OSError when that fails."""
        self._heard = heard
        self._ended = ended
        self._loop = asyncio.get_running_loop()
        self.pipe, pipe_end = pipe_pair()
        self._descriptors, descriptors_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        passed = [pipe_end, descriptors_end, *([link] if link else [])]
        numbers = [pipe_end.fileno(), descriptors_end.fileno(), link.fileno() if link else NONE]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "services.worker", *map(str, numbers)],
            pass_fds=[end.fileno() for end in passed],
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C in the node's terminal is for the node: it ends its children in order
        )
        for end in passed:
            end.close()
        self.pipe.post([dict(setup.items())])
        self._loop.add_reader(self.pipe.socket, self._read)
        self._gone = False

    @property
    def pid(self) -> int:
        """Its process id."""
        return self.process.pid

    def post(self, items: list[Any]) -> None:
        """Send it a list; what does not fit now is sent when it reads."""
        self.pipe.post(items)
        if self.pipe.unsent and not self.pipe.closed:
            self._loop.add_writer(self.pipe.socket, self._flush)

    def _flush(self) -> None:
        self.pipe.flush()
        if not self.pipe.unsent or self.pipe.closed:
            self._loop.remove_writer(self.pipe.socket)

    def pass_link(self, end: socket.socket, word: str) -> None:
        """Pass it an end of a socket, and tell it so; the end is closed here."""
        with contextlib.suppress(BrokenPipeError):
            socket.send_fds(self._descriptors, [b"."], [end.fileno()])
        end.close()
        self.post([word])

    def kill(self) -> None:
        """End it at once (SIGKILL)."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGKILL)

    def leave(self) -> None:
        """Let it end in good order: its pipe closes, so that it stops its device and leaves."""
        if not self._gone:
            self._forget()

    async def wait(self, timeout: float) -> None:
        """Wait until it has ended; kill it when it has not after `timeout` seconds."""
        until = self._loop.time() + timeout
        while self.process.poll() is None and self._loop.time() < until:
            await asyncio.sleep(0.005)
        if self.process.poll() is None:
            self.kill()
            await asyncio.to_thread(self.process.wait)
        self._close()

    def describe(self) -> str:
        """How it ended, for people."""
        code = self.process.poll()
        if code is None:
            return "it closed its pipe"
        if code >= 0:
            return f"it exited with code {code}"
        name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
        return f"it was ended by {name}"

    def _read(self) -> None:
        for items in self.pipe.read():
            self._heard(items)
        if self.pipe.closed and not self._gone:
            self._forget()
            self._reap(0)

    def _reap(self, tries: int) -> None:
        """Its pipe is closed; it is dead or about to be."""
        if self.process.poll() is None and tries < 100:
            if tries == 20:
                self.kill()
            self._loop.call_later(0.002, self._reap, tries + 1)
            return
        self._close()
        self._ended()

    def _close(self) -> None:
        self._forget()
        self._descriptors.close()

    def _forget(self) -> None:
        """Let the pipe go; nothing is heard any more."""
        self._gone = True
        if self.pipe.socket.fileno() >= 0:
            self._loop.remove_reader(self.pipe.socket)
            self._loop.remove_writer(self.pipe.socket)
        self.pipe.close()
