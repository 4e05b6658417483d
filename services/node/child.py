"""One child process of a node and the pipe to it, in the node's asyncio loop.

A child counts as ended when its process has ended, not when its pipe has: what user code leaves
running may hold the pipe open, and user code may close it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import ClassVar

from petrobot.services.comm.protocol.messages import Call
from petrobot.services.host.parent_death import STOP_ROUTINE, state_of, until_ended
from petrobot.services.worker.keeper import KEPT, KILL_ORDER
from petrobot.services.worker.pipe import Item, Permits, permit_counter, pipe_pair
from petrobot.services.worker.process import BORN, SETUP, Setup

_log = logging.getLogger(__name__)

LEAVE_LIMIT = 4.0
"""Time in which a process must end by itself (s)."""
FORK_LIMIT = 20.0
"""Time in which its keeper must have been forked (s)."""
PIPE_LIMIT = 0.5
"""Time after the end of its pipe at which a process is killed (s): the node can reach it no
more."""
CUT_OFF = "its code closed files that it had not opened, among them its pipe; it was killed"
TURN = 1 << 14
"""Most bytes that are read of a process in one turn of the loop. A process that writes without end
would otherwise keep the node from all else: from heartbeats, devices and an emergency stop."""


class ForkServer:
    """The process that forks the keepers of this process's children (`services/worker/keeper.py`).
    It has the working directory, environment and output of its start, so another one takes its
    place when one of these has changed, and also when it has ended or does not read."""

    kept_open: ClassVar[tuple[int, ...]] = ()
    """Descriptors that it and all that it forks keep open until they end."""
    _current: ClassVar[ForkServer | None] = None
    _former: ClassVar[list[ForkServer]] = []
    """Those that take no more orders and have perhaps not ended."""

    def __init__(self, surroundings: object) -> None:
        """Start it. Raises OSError."""
        self._surroundings = surroundings
        self._orders, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._orders.setblocking(False)
        with there:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "petrobot.services.worker.keeper",
                    *map(str, (os.getpid(), there.fileno(), *self.kept_open)),
                ],
                pass_fds=[there.fileno(), *self.kept_open],
                stdin=subprocess.DEVNULL,
                # a Ctrl-C in the node's terminal is for the node: it ends its children in order
                start_new_session=True,
            )

    @classmethod
    def order(cls, patience: int, passed: Sequence[int]) -> ForkServer:
        """Order a keeper and its worker, and return who forks them. Raises OSError."""
        cls._former = [one for one in cls._former if one._process.poll() is None]
        surroundings = _surroundings()
        if cls._current is not None and cls._current._surroundings != surroundings:
            cls._current.close()
        while True:
            known, cls._current = cls._current, cls._current or cls(surroundings)
            try:
                socket.send_fds(cls._current._orders, [bytes([patience])], passed)
            except OSError:
                cls._current.kill()
                if known is None:
                    raise
            else:
                return cls._current

    def close(self) -> None:
        """Give it no more orders; it exits after it has forked for the last one."""
        self._orders.close()
        if ForkServer._current is self:
            ForkServer._current = None
            ForkServer._former.append(self)

    def kill(self) -> None:
        """Kill it, as it does not fork. What it has forked lives on."""
        self.close()
        self._process.kill()


def _surroundings() -> object:
    """Return what a process inherits at its start and may differ at a later one."""
    outputs = []
    for number in (1, 2):
        with contextlib.suppress(OSError):
            found = os.fstat(number)
            outputs.append((found.st_dev, found.st_ino))
    folder = ""
    with contextlib.suppress(OSError):
        folder = os.getcwd()  # noqa: PTH109 - a Path of a removed folder raises the same
    return folder, dict(os.environ), outputs


class Child:
    """A running process of `services.worker` under its keeper. `heard(child, received)` is called
    with the items that arrived together; `ended(child)` is called once, when the process and
    everything that it started have ended."""

    def __init__(
        self,
        setup: Setup,
        heard: Callable[[Child, list[Item]], None],
        ended: Callable[[Child], None],
        link: socket.socket | None = None,
    ) -> None:
        """Start the process. `link` is the worker's end of the link to its device; it is closed
        here. Raises OSError if the process cannot be started."""
        self._heard = heard
        self._ended = ended
        self._loop = asyncio.get_running_loop()
        self._logs = _log.isEnabledFor(logging.DEBUG)
        self.last_word = b""
        """What its process reported as it ended: LINK_LOST, NO_MEMORY, or empty."""
        self.pipe, pipe_end = pipe_pair()
        self._descriptors, descriptors_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        counter = permit_counter()
        # Only what owns a device has something to do after the node's end: its stop routine.
        patience = int(STOP_ROUTINE) if setup.device and link is None else 0
        ends = [pipe_end, descriptors_end, *([link] if link else [])]
        numbers = [end.fileno() for end in ends]
        try:
            self._fork_server = ForkServer.order(patience, [*numbers[:2], counter, *numbers[2:]])
        except OSError:
            self.pipe.close()
            self._descriptors.close()
            os.close(counter)
            raise
        finally:
            for end in ends:
                end.close()
        self._permits = Permits(counter)
        self._keeper = self._worker = 0
        self._code: int | None = None
        self._forked = asyncio.Event()
        """Set once the keeper has told its process id, or has ended before that."""
        self._killed = ""
        self._leaves = self._let_go = False
        self._limits: list[asyncio.TimerHandle] = []
        self._limit(FORK_LIMIT, self._require_keeper)
        self.pipe.post([SETUP, dict(setup.items())])
        self._loop.add_reader(self.pipe.socket, self._read)
        self._watch = self._loop.create_task(self._wait_for_end())

    @property
    def pid(self) -> int:
        """Process id of the worker; until the worker has reported it, that of its keeper; 0 before
        that."""
        return self._worker or self._keeper

    @property
    def closed(self) -> bool:
        """Whether its pipe has ended, so that it receives no orders."""
        return self.pipe.closed

    @property
    def code(self) -> int | None:
        """Its exit code; minus the signal number if a signal ended it; None while it runs."""
        if self._code is None and self._keeper:
            ended, status = os.waitpid(self._keeper, os.WNOHANG)
            if ended:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code

    def give(self, call: Call) -> None:
        """Send a call, with the permit to begin it."""
        self._permits.give()
        self.post(call)

    def take_back(self) -> int:
        """Take back the permits of the calls that it has not begun, and return how many these are:
        the last ones that it was given. Also works after its end."""
        count = 0
        while self._permits.take():
            count += 1
        return count

    def not_begun(self) -> int:
        """Return how many calls it has not begun: the last ones that it was given."""
        return self._permits.left()

    @property
    def unsent(self) -> bool:
        """Whether something waits until it reads."""
        return self.pipe.unsent

    @property
    def frozen(self) -> bool:
        """Whether a signal has stopped its process, so that no code executes in it."""
        return state_of(self.pid) == "T"

    def post(self, item: Item) -> None:
        """Send an item; what does not fit into the pipe now is sent when the process reads."""
        if self._logs:
            _log.debug("to %d: %s", self._worker, _named(item))
        if not self.pipe.post(item):
            self._loop.add_writer(self.pipe.socket, self._flush)

    def _flush(self) -> None:
        self.pipe.flush()
        if not self.pipe.unsent or self.pipe.closed:
            self._loop.remove_writer(self.pipe.socket)

    def pass_link(self, end: socket.socket, word: str) -> None:
        """Pass one end of a socket, then send `word`; the end is closed here."""
        with contextlib.suppress(OSError):
            socket.send_fds(self._descriptors, [b"."], [end.fileno()])
        end.close()
        self.post([word])

    def kill(self, why: str = "") -> None:
        """Kill it at once, with everything that it started. One that hangs in the kernel does not
        end, and neither does its keeper: its device must not get a second driver."""
        if self.code is None:
            self._killed = self._killed or why
            if self._keeper:
                os.kill(self._keeper, KILL_ORDER)
                os.kill(self._keeper, signal.SIGCONT)  # it may be frozen
            else:
                self._fork_server.kill()

    def _require_keeper(self) -> None:
        if not self._keeper:
            self.kill(f"it was not forked within {FORK_LIMIT:g} s")

    def leave(self) -> None:
        """Close its pipe, so that it stops its device and exits. It is killed after
        `LEAVE_LIMIT`."""
        if not self._let_go:
            self._leaves = True
            if self._keeper:
                self._close_pipe()
            self._limit(LEAVE_LIMIT, self.kill)

    async def wait(self) -> None:
        """Wait until the process has ended."""
        await self._watch

    def describe(self) -> str:
        """Return how it ended, in words."""
        code = self.code
        if code is None or (self._killed and code == -signal.SIGKILL):
            return self._killed or CUT_OFF
        # Otherwise it had ended by itself before it could be killed.
        if code >= 0:
            return f"it exited with code {code}"
        name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
        return f"it was ended by {name}"

    def _limit(self, seconds: float, act: Callable[[], None]) -> None:
        self._limits.append(self._loop.call_later(seconds, act))

    def _read(self, most: int | None = TURN) -> None:
        try:
            received = self.pipe.read(most)
        except ValueError:
            received = []
            self._close_pipe()
            self.kill("it wrote data into its pipe that is not a message, and was killed")
        while not self._worker and received and isinstance(received[0], list):
            word, number = received[0][:2]
            if word == KEPT and not self._keeper:
                self._keeper = number
                self._forked.set()
            elif word == BORN:
                self._worker = number
            else:
                break
            del received[0]
        if self._leaves and self._keeper and not self._let_go:
            self._close_pipe()
        elif received:
            if self._logs:
                named = ", ".join(map(_named, received))
                _log.debug("from %d: %s", self._worker, named)
            self._heard(self, received)
        # Not `closed`: that may also come from a message that could not be sent, while what the
        # process sent before its end still waits to be read.
        if self.pipe.ended and not self._let_go:
            self._close_pipe()
            self._forked.set()
            self._limit(PIPE_LIMIT, lambda: self.kill(CUT_OFF))

    async def _wait_for_end(self) -> None:
        await self._forked.wait()
        if self._keeper:
            await until_ended(self._keeper)
            self._code = self.code  # so it is reaped, even if no caller asks for it
        else:
            self._code = -signal.SIGKILL
            self._killed = self._killed or "its fork server ended, or could not fork it"
        for limit in self._limits:
            limit.cancel()
        if not self._let_go:
            self._read(None)  # all that it sent last
            self._close_pipe()
        for limit in self._limits:
            limit.cancel()
        if self._worker:
            # The worker ends before its keeper, unless the keeper was killed: then the kernel kills
            # the worker now.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LEAVE_LIMIT):
                    await until_ended(self._worker)
        with contextlib.suppress(OSError):  # it said nothing
            self.last_word = self._descriptors.recv(1, socket.MSG_DONTWAIT)
        self._descriptors.close()
        self._ended(self)
        self._permits.close()

    def _close_pipe(self) -> None:
        if not self._let_go:
            self._let_go = True
            self._loop.remove_reader(self.pipe.socket)
            self._loop.remove_writer(self.pipe.socket)
            self.pipe.close()


def _named(item: Item) -> str:
    """Return kind and id of an item for the log: the rest may hold tickets."""
    if isinstance(item, list):
        return str(item[:2])
    return f"{type(item).__name__} {getattr(item, 'id', '')}"
