"""A process of a node: the warm worker that runs the actions of a device (or of none), or the
process of a cyclic driver.

Its keeper (`services/worker/keeper.py`) forks it with the sockets PIPE and DESCRIPTORS, the counter
PERMITS, from which it takes the permit of each call before it begins it, and perhaps a LINK to its
device. The node sends over the pipe what the process is for. A process that makes
its device's driver and finds it cyclic serves only the driver.
"""

from __future__ import annotations

import _locale
import builtins
import contextlib
import logging
import os
import resource
import select
import signal
import socket
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from operator import attrgetter
from pathlib import Path

# Its own name, as in `runner`.
from time import monotonic
from typing import Any, NamedTuple

from msgspec import Struct, field
from msgspec.structs import asdict

from petrobot.services.comm.location_file import Directory, DirectoryError, parse
from petrobot.services.comm.protocol.messages import (
    Call,
    Cancel,
    Command,
    Event,
    Message,
    Outcome,
    Ping,
    Pong,
)
from petrobot.services.device import Driver
from petrobot.services.host.command_line import LAST_THREADS, log_to_stderr
from petrobot.services.host.emergency_latch import latch_of
from petrobot.services.host.parent_death import STOP_ROUTINE, outlive
from petrobot.services.node.drivers import make_driver
from petrobot.services.node.emergency_stops import Guard
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.ports import ProcessPorts
from petrobot.services.scripted import load as load_script
from petrobot.services.worker.callables import log_fault
from petrobot.services.worker.device_process import DeviceLoop, take_priority
from petrobot.services.worker.pipe import Item, NewestLink, Permits, Pipe, keep_from_copies
from petrobot.services.worker.remote import (
    DeviceCommand,
    DeviceError,
    DeviceState,
    RemoteDriver,
)
from petrobot.services.worker.setpoints import Sent, StreamOutlets

LONGEST_PAUSE = 3600.0
"""Longest wait for the next message (s): `poll` takes no infinite one."""
POLL = 0.002
"""Time between checks of a condition for which a run waits (s)."""
SETUP, BORN, READY, FAILED = "setup", "born", "ready", "failed"
WANTED, STREAM_AT, DROPPED = "wanted", "stream_at", "dropped"
OUT_OF_MEMORY = "out_of_memory"
"""Cause of a run that used up the memory of its process."""
LINK_LOST, NO_MEMORY = b"l", b"m"
"""Last words of a process: the driver's process has ended; not even the report of a run fits into
the remaining memory. They are sent over DESCRIPTORS: user code may end its process with any exit
code, and the pipe may be full of what there is no memory to send."""
CHANGED = 92
"""Exit code: a run has changed its process for good."""
CUT_OFF_LIMIT = 5.0
"""Time in which the node must kill a process whose pipe user code has closed (s)."""


_log = logging.getLogger(__name__)
_IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Setup(Struct, frozen=True):
    """First message of the node to a new process."""

    source: str
    """Path of services.toml; `text` is its text as the node read it."""
    text: str
    node: str
    device: str
    """Empty: actions that need none."""
    mock: str = ""
    memory: int = 0
    """Limit of the address space (bytes), 0 for none."""
    tickets: Mapping[str, str] = field(default_factory=dict)
    """The ticket of each stream that this node receives."""
    keys: Sequence[bytes] = ()
    """The shared keys as the node read them at its start. A process that read the file again might
    find another key, or none, and reach no other process."""
    log_level: int = logging.INFO
    """Lowest level that is logged."""

    def items(self) -> Mapping[str, Any]:
        """As plain data."""
        return asdict(self)


class ModuleSetting(NamedTuple):
    """A setting of a module that the code of one run may change for the runs after it."""

    module: str
    read: Callable[[Any], Any]
    write: Callable[[Any, Any], object]
    first: Any = None
    """Its value when the module is imported: a run may be the first to import it."""


_HOOKS = ("excepthook", "unraisablehook", "displayhook")
SETTINGS = (
    ModuleSetting("sys", lambda m: m.getrecursionlimit(), lambda m, v: m.setrecursionlimit(v)),
    ModuleSetting("sys", lambda m: m.getswitchinterval(), lambda m, v: m.setswitchinterval(v)),
    ModuleSetting(
        "sys", lambda m: m.get_int_max_str_digits(), lambda m, v: m.set_int_max_str_digits(v)
    ),
    ModuleSetting(
        "sys", attrgetter(*_HOOKS), lambda m, v: vars(m).update(zip(_HOOKS, v, strict=True))
    ),
    ModuleSetting("threading", attrgetter("excepthook"), lambda m, v: setattr(m, "excepthook", v)),
    ModuleSetting("gc", lambda m: m.isenabled(), lambda m, v: m.enable() if v else m.disable()),
    ModuleSetting("logging", attrgetter("root.manager.disable"), lambda m, v: m.disable(v)),
    ModuleSetting("socket", lambda m: m.getdefaulttimeout(), lambda m, v: m.setdefaulttimeout(v)),
    ModuleSetting("warnings", lambda m: list(m.filters), lambda m, v: _set_filters(v)),
    ModuleSetting("tempfile", attrgetter("tempdir"), lambda m, v: setattr(m, "tempdir", v)),
    ModuleSetting(
        "locale",
        lambda m: m.setlocale(m.LC_ALL),
        lambda m, v: m.setlocale(m.LC_ALL, v),
        _locale.setlocale(_locale.LC_ALL, None),
    ),
    # Of its context only copies are kept, and no copy is equal to another.
    ModuleSetting(
        "decimal",
        lambda m: m.getcontext().copy(),
        lambda m, v: m.setcontext((v or m.DefaultContext).copy()),
    ),
    ModuleSetting(
        "numpy",
        lambda m: m.geterr(),
        lambda m, v: m.seterr(**v),
        {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"},
    ),
)


def _set_filters(filters: Sequence[Any]) -> None:
    warnings.resetwarnings()
    warnings.filters = list(filters)


class Surroundings:
    """What the code of one run may change for the runs after it, so that they would fail. What was
    there is put back; what it has added to the environment or the import path stays: it may have
    prepared something once for its own later runs."""

    LIMITS = tuple(
        getattr(resource, f"RLIMIT_{name}")
        for name in ("AS", "CPU", "DATA", "FSIZE", "NOFILE", "NPROC", "STACK")
    )
    _NOFILE = LIMITS.index(resource.RLIMIT_NOFILE)
    TIMERS = (signal.ITIMER_REAL, signal.ITIMER_VIRTUAL, signal.ITIMER_PROF)
    SIGNALS = (signal.SIGCHLD, signal.SIGPIPE, signal.SIGALRM)

    def __init__(self) -> None:
        """Note how they are now."""
        self._folder = self._here()
        self._mask = os.umask(0)
        os.umask(self._mask)
        self._settings = [
            each.read(sys.modules[each.module]) if each.module in sys.modules else each.first
            for each in SETTINGS
        ]
        self._builtins = dict(vars(builtins))
        self._built_in = list(self._builtins.values())
        self._processors, self._rights = os.sched_getaffinity(0), self._own_rights()
        self._signals = signal.pthread_sigmask(signal.SIG_BLOCK, ())
        self._streams = (sys.stdin, sys.stdout, sys.stderr)
        self._limits = [resource.getrlimit(limit) for limit in self.LIMITS]
        self._files, self._any_file = self._standard_files(), os.open("/", os.O_CLOEXEC)
        self._first_file = self._next_file()
        self._environment, self._path = dict(vars(os.environ)["_data"]), sys.path[:]
        self._handlers = [signal.getsignal(number) for number in self.SIGNALS]

    def restored(self) -> str:
        """Make them so again. Return why that is not possible, empty if it is."""
        os.umask(self._mask)
        sys.stdin, sys.stdout, sys.stderr = self._streams
        if any(stream is not None and stream.closed for stream in self._streams):
            return "it has closed a standard stream"
        try:
            if self._own_rights() != self._rights:
                return "it has changed its user or priority"
            signal.pthread_sigmask(signal.SIG_SETMASK, self._signals)
            if os.sched_getaffinity(0) != self._processors:
                os.sched_setaffinity(0, self._processors)
            for timer in self.TIMERS:
                if signal.getitimer(timer) != (0.0, 0.0):
                    signal.setitimer(timer, 0.0)
            for limit, wanted in zip(self.LIMITS, self._limits, strict=True):
                if resource.getrlimit(limit) != wanted:
                    resource.setrlimit(limit, wanted)
            if self._here() != self._folder:
                os.chdir(self._folder)
            if self._standard_files() != self._files:
                return "it has closed the file of a standard stream"
            if 2 * self._next_file() > self._first_file + self._limits[self._NOFILE][0]:
                return "it has left so many files open that later runs might find no more"
            self._restore_modules()
        except (OSError, TypeError, ValueError) as fault:
            return str(fault)
        return ""

    def _restore_modules(self) -> None:
        # Its dictionary: to decode each variable takes as long as a short run.
        now = vars(os.environ)["_data"]
        if now != self._environment and not self._environment.items() <= now.items():
            os.environb.update(self._environment)
            time.tzset()
        kept = sys.path == self._path or (  # the sets are only made if code has changed it
            isinstance(sys.path, list) and set(self._path) <= set(sys.path)
        )
        if not kept:
            sys.path = self._path[:]
        for number, handler in zip(self.SIGNALS, self._handlers, strict=True):
            if signal.getsignal(number) is not handler:
                signal.signal(number, handler)
        found = sys.modules
        for each, wanted in zip(SETTINGS, self._settings, strict=True):
            module = found.get(each.module)
            if module is not None and each.read(module) != wanted:
                each.write(module, wanted)
        if list(islice(vars(builtins).values(), len(self._built_in))) != self._built_in:
            vars(builtins).update(self._builtins)

    @staticmethod
    def _own_rights() -> tuple[int, ...]:
        return *os.getresuid(), *os.getresgid(), os.getpriority(os.PRIO_PROCESS, 0)

    def _next_file(self) -> int:
        """Return the number of the next file that is opened."""
        number = os.dup(self._any_file)
        os.close(number)
        return number

    @staticmethod
    def _standard_files() -> list[tuple[int, int] | None]:
        found: list[tuple[int, int] | None] = []
        for number in range(3):
            try:
                file = os.fstat(number)
                found.append((file.st_dev, file.st_ino))
            except OSError:  # closed
                found.append(None)
        return found

    @staticmethod
    def _here() -> str:
        try:
            return os.getcwd()  # noqa: PTH109 - each run pays for it
        except OSError:  # it was removed
            return ""


class LinkLostError(Exception):
    """The driver's process has ended."""


class Worker:
    """Runs actions. Orders and reports travel over the node's pipe, device commands and states over
    the link."""

    def __init__(
        self,
        setup: Setup,
        directory: Directory,
        node: Pipe,
        permits: Permits,
        *,
        link: NewestLink | None = None,
        driver: Driver | None = None,
        ports: ProcessPorts | None = None,
        guard: Guard | None = None,
    ) -> None:
        self._node = node
        self._guard = guard
        self._barred = ""
        self._permits = permits
        self._link = link
        self._ports = ports
        self._remote = RemoteDriver(self._post_command, monotonic) if link else None
        actions = {
            a.name: a
            for a in directory.actions.values()
            if (a.node, a.device) == (setup.node, setup.device)
        }
        scripted = load_script(setup.mock) if setup.mock else {}
        reseed = self._remote.reseed if self._remote else None
        if ports is not None:
            reseed = ports.draws.reseed
        self._place = InlineHost(
            actions,
            clock=monotonic,
            driver=driver,
            remote=self._remote,
            streams={s.name: s.period for s in directory.streams.values()},
            substitutes={name: script for name, script in scripted.items() if name in actions},
            reseed=reseed,
            device=setup.device,
        )
        self._place.warm()
        self._one_by_one = not setup.device
        """Whether runs take turns. Actions without a device do: one that blocks or crashes the
        process then ends no other run. The calls behind it have not begun, and the node gives them
        to another worker."""
        self._surroundings = Surroundings()
        self._used = False
        """Whether a run may have changed the surroundings."""
        self._calls: deque[Call] = deque()
        self._spent = False
        """Whether a run used up the memory, so that the next one needs a new process."""
        self._changed = False
        """Whether a run has changed this process for good."""
        self._outlets = StreamOutlets(
            directory, f"{setup.node} {setup.device or 'actions'}", setup.keys
        )
        self._connecting = False
        # Faster than a selector. It also reports an end that user code has closed, which epoll
        # would forget.
        self._ends = select.poll()
        self._ends.register(node, select.POLLIN)
        if link is not None:
            self._ends.register(link, select.POLLIN)

    def await_device(self) -> None:
        """Wait for the first state of the driver at the other end of the link. Raises
        LinkLostError."""
        while self._remote is not None and self._remote.age == float("inf"):
            self._ends.poll()
            if self._link is not None:
                self._read_link(self._link)

    def run(self) -> None:
        """Serve until the node has ended. Exits if the driver fails. Raises LinkLostError."""
        while not self._node.closed:
            pause = self._pause()
            self._ends.poll(None if pause is None else 1e3 * min(pause, LONGEST_PAUSE))
            if self._link is not None:
                self._read_link(self._link)
            now = monotonic()
            for item in self._node.read():
                self._take(now, item)
            if self._ports is not None:
                self._ports.poll()
            now = monotonic()
            if self._guard is not None and now >= self._guard.due:
                self._watch(now, self._guard)
            if self._ports is not None and self._barred:
                self._ports.withhold(self._barred)
            self._advance(now)
            while self._calls and self._may_begin():
                self._advance(monotonic())
            if self._calls:
                self._give_back()
            if self._used and not self._place.runs:
                os.sched_yield()  # first let the node read the report
                self._restore()  # now, so that the next call need not wait for it
            if self._changed and not self._node.unsent and not self._node.closed:
                os._exit(CHANGED)
        self._place.close(monotonic())
        self._outlets.close()

    def _advance(self, now: float) -> None:
        if self._calls and self._may_begin():
            self._begin(now, self._calls.popleft())
        self._place.advance(now)
        if self._place.failed:
            # Sent before the ends of its runs, so that no other run is sent here.
            self._node.post([FAILED, self._place.failed])
            self._report(now)
            sys.exit(1)
        self._report(now)

    def _may_begin(self) -> bool:
        return not (self._spent or self._place.runs)

    def _begin(self, now: float, call: Call) -> None:
        """Begin a call, unless the node has taken it back, or this process cannot be made as it was
        for its first run."""
        self._restore()
        if self._changed:
            self._calls.appendleft(call)
        elif self._permits.take():
            self._used = self._one_by_one
            self._place.take(now, call)
        else:
            self._node.post([DROPPED, [call.id]])

    def _restore(self) -> None:
        """Undo what the last run has changed in this process."""
        if self._used and (why := self._surroundings.restored()) and not self._node.closed:
            _log.warning("a run has changed this process for good: %s", why)
            self._spent = self._changed = True
        self._used = False

    def _give_back(self) -> None:
        """Give back the calls that would have to wait here. Those without a permit were already
        taken back."""
        for _ in self._calls:
            self._permits.take()
        self._node.post([DROPPED, [call.id for call in self._calls]])
        self._calls.clear()

    def _watch(self, now: float, guard: Guard) -> None:
        """Stop device and runs without an order of the node if the node is silent or the latch is
        set."""
        cause, before = guard.look(now), self._barred
        self._barred = cause
        # Repeated while there is a run: it may have begun between a clearing and another stop, both
        # since the last check.
        if cause and (cause != before or self._place.runs):
            self._place.bar(now, cause)

    def _pause(self) -> float | None:
        """Return the time until the next action of this process (s); None: it only waits for
        messages."""
        if self._node.unsent:
            return POLL
        due = self._place.due()
        if self._guard is not None:
            due = self._guard.due if due is None else min(due, self._guard.due)
        pause = None if due is None else max(0.0, due - monotonic())
        busy = self._ports is not None and self._ports.busy
        if self._place.polling or self._connecting or busy:
            return POLL if pause is None else min(pause, POLL)
        return pause

    def _take(self, now: float, item: Item) -> None:
        word = item[0] if isinstance(item, list) else ""
        if self._guard is not None:
            self._guard.heard(now, isinstance(item, Ping | Call))
        if not isinstance(item, list):
            self._take_message(now, item)
        elif word == STREAM_AT:
            self._outlets.found(*item[1:])

    def _take_message(self, now: float, message: Message) -> None:
        if isinstance(message, Call):
            if self._one_by_one:
                self._calls.append(message)
            else:
                self._begin(now, message)
        elif isinstance(message, Cancel | Outcome):
            self._place.take(now, message)
        elif isinstance(message, Command):
            self._place.command(now, message)
        elif isinstance(message, Ping):
            self._node.post(Pong(message.number))

    def _report(self, now: float) -> None:
        for report in self._place.reports():
            if not isinstance(report, Sent):
                self._spent |= isinstance(report, Outcome) and report.cause == OUT_OF_MEMORY
                self._node.report(report)
            elif self._outlets.send(now, report):
                self._node.post([WANTED, report.stream])
        self._connecting = self._place.runs != () and self._outlets.advance()
        for name, data in self._ports.raised() if self._ports else ():
            self._node.post(Event(name, "", 0, data))
        if self._node.unsent:
            self._node.flush()

    def _read_link(self, link: NewestLink) -> None:
        items = link.newest()
        if items is not None and self._remote is not None:
            self._remote.take(DeviceState(*items))
        if link.closed:
            # Without its driver this process is of no use; the node starts both again.
            raise LinkLostError

    def _post_command(self, command: DeviceCommand) -> None:
        assert self._link is not None
        if not self._link.send([command.number, command.verb, dict(command.body)]):
            raise ConnectionError("the driver's process does not take commands")


def _first(node: Pipe) -> Setup:
    while True:
        select.select([node], [], [])
        for items in node.read():
            if isinstance(items, list) and items[0] == SETUP:
                return Setup(**items[1])
        if node.closed:
            sys.exit(0)


def serve(
    node: Pipe, descriptors: socket.socket, link: NewestLink | None, permits: Permits
) -> None:
    """Serve what the node's first message asks for. Errors of the driver are reported to it as
    text."""
    node.post([BORN, os.getpid()])
    setup = _first(node)
    logging.getLogger().setLevel(setup.log_level)
    if link is None and setup.device:
        outlive(os.getppid(), STOP_ROUTINE)
    if setup.memory:
        resource.setrlimit(resource.RLIMIT_AS, (setup.memory, setup.memory))
    try:
        directory = parse(setup.text, Path(setup.source))
        if link is None and setup.device:
            latch = latch_of(directory.source, setup.node)
            ports = ProcessPorts(
                directory,
                directory.devices[setup.device],
                monotonic,
                setup.tickets,
                setup.keys,
                latch.cleared.since(setup.device),
            )
            driver = make_driver(directory, directory.devices[setup.device], ports)
            ports.draws.reseed(0)
            guard = Guard(setup.device, latch)
            if driver.period:
                node.post(
                    [
                        READY,
                        {
                            "period": driver.period,
                            "streams": ports.stream_addresses(),
                            "fifo": take_priority(),
                        },
                    ]
                )
                DeviceLoop(driver, ports, node, descriptors, guard).run()
                return
            worker = Worker(
                setup, directory, node, permits, driver=driver, ports=ports, guard=guard
            )
            streams = ports.stream_addresses()
        else:
            worker, streams = Worker(setup, directory, node, permits, link=link), {}
        worker.await_device()
        node.post([READY, {"period": None, "streams": streams, "fifo": False}])
        worker.run()
    except DeviceError as fault:
        text = f"device {setup.device}: {fault}"
        log_fault(_log, fault.__cause__ or fault, "%s", text)
        node.post([FAILED, text])
        sys.exit(1)
    except (DirectoryError, OSError, ValueError) as fault:
        node.post([FAILED, str(fault)])
        sys.exit(1)


def main(passed: Sequence[int]) -> None:
    """Run the process, after the fork, with the descriptors PIPE, DESCRIPTORS, PERMITS and perhaps
    LINK."""
    for number in _IGNORED:
        # The node decides when its children end. Programs that user code starts do not inherit a
        # handler, as they would inherit SIG_IGN.
        signal.signal(number, lambda *_: None)
    os.register_at_fork(after_in_child=_take_signals)
    log_to_stderr()
    pipe, descriptors = (socket.socket(fileno=number) for number in passed[:2])
    node, permits = Pipe(pipe), Permits(passed[2])
    link = NewestLink(socket.socket(fileno=passed[3])) if len(passed) > 3 else None
    keep_from_copies(descriptors)
    try:
        serve(node, descriptors, link, permits)
    except (LinkLostError, MemoryError) as fault:
        _await_kill(node, link)
        with contextlib.suppress(OSError):  # user code has closed it
            descriptors.send(LINK_LOST if isinstance(fault, LinkLostError) else NO_MEMORY)
        os._exit(1)
    finally:
        _await_kill(node, link)
        # At its end Python waits for every thread that is not a daemon, and some never end.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, LAST_THREADS)


def _await_kill(node: Pipe, link: NewestLink | None) -> None:
    """Wait until the node kills this process, if user code has closed its files. To exit would
    blame the user's code for an exit; so the node says what it saw, the end of the pipe."""
    if node.lost or (link is not None and link.lost):
        with contextlib.suppress(OSError):
            node.close()
        time.sleep(CUT_OFF_LIMIT)


def _take_signals() -> None:
    for number in _IGNORED:
        signal.signal(number, signal.SIG_DFL)
