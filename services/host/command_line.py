"""What the command lines of nodes share: the log of a node, and argparse types for numbers that
state their range in the error message.

argparse words a ValueError with the name of the function that raised it. The ArgumentTypeError
raised here is printed as it is: `argument --runs: abc is not a whole number of at least 1`.
"""

from __future__ import annotations

import atexit
import io
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import asyncio
    from argparse import ArgumentParser, ArgumentTypeError
    from collections.abc import Coroutine

OUTPUT_KEPT = 1 << 20
"""Bytes of output that wait for a disk or a terminal; more are lost."""
OUTPUT_WAIT, LAST_OUTPUT = 0.1, 1.0
"""How long a process waits for its output to be written, and at its end (s)."""
LOG_LEVELS = {
    "debug": logging.DEBUG,
    "info": logging.INFO,
    "warning": logging.WARNING,
    "error": logging.ERROR,
}


def add_log_level(parser: ArgumentParser) -> None:
    """Add `--log-level` of a node."""
    parser.add_argument(
        "--log-level",
        choices=LOG_LEVELS,
        default="info",
        help="log records of this level and above, to standard error (default: %(default)s; "
        "debug: also every message)",
    )


class _Output(io.RawIOBase):
    """The file of a standard stream, written in a thread: a hung disk, a stopped terminal (Ctrl-S)
    or a pipe that is not read must stop neither a driver nor an event loop. What finds no room is
    lost: a driver that prints must not end because of that."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._ended = False
        self._begin()
        atexit.register(self._end)

    def _begin(self) -> None:
        self._process = os.getpid()
        self._turn = threading.Condition()
        self._waiting = bytearray()
        self._writing = self._late = False
        self._lost = 0
        self._thread: threading.Thread | None = None

    def fileno(self) -> int:
        return self._number

    def isatty(self) -> bool:
        return os.isatty(self._number)

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:
        if self._process != os.getpid():
            self._begin()  # a fork has no copy of the thread
        given = bytes(data)
        if self._ended:
            with suppress(OSError):
                if not self._late:
                    return os.write(self._number, given)
            return len(given)
        with self._turn:
            if self._waiting and len(self._waiting) + len(given) > OUTPUT_KEPT:
                self._lost += len(given)
                return len(given)
            self._waiting += given
            if self._thread is None:
                self._thread = threading.Thread(target=self._write_all, daemon=True)
                self._thread.start()
            self._turn.notify_all()
        # So nothing is lost if this process crashes next. An output that was late is not waited for
        # again until all has been written.
        if not self._late:
            self._drain(OUTPUT_WAIT)
        return len(given)

    def _end(self) -> None:
        """What comes after this is written at once: Python starts no thread any more, or lets none
        run (it shows the text of SystemExit, and logging closes its files)."""
        self._drain(LAST_OUTPUT)
        self._ended = True

    def _drain(self, limit: float) -> None:
        with self._turn:
            self._late = not self._turn.wait_for(
                lambda: not self._waiting and not self._writing, limit
            )

    def _write_all(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())  # for the main thread
        while True:
            with self._turn:
                self._writing = False
                if not self._waiting:
                    self._late = False
                    self._turn.notify_all()
                    self._turn.wait_for(lambda: self._waiting)
                data, self._waiting, self._writing = self._waiting, bytearray(), True
                if self._lost:
                    data += f"({self._lost} bytes of output found no room and are lost)\n".encode()
                    self._lost = 0
            with suppress(OSError):
                while data:
                    del data[: os.write(self._number, data)]


def write_in_thread(*names: str) -> None:
    """Make these standard streams of this process wait for no disk and no terminal, and raise no
    error if there is no room."""
    for name in names:
        stream = getattr(sys, f"__{name}__")
        if stream is not None and getattr(sys, name) is stream:
            file = io.BufferedWriter(_Output(stream.fileno()))
            kept = {"line_buffering": stream.line_buffering, "write_through": stream.write_through}
            setattr(sys, name, io.TextIOWrapper(file, stream.encoding, stream.errors, **kept))


def add_member_options(parser: ArgumentParser) -> None:
    """Add the options of every process of a cell."""
    parser.add_argument(
        "--services", metavar="FILE", type=Path, default=Path("services.toml"), help="location file"
    )
    parser.add_argument("--lockstep", action="store_true", help="be a member of a lock-step cell")
    parser.add_argument(
        "--await-coordinator",
        type=number(least=0.0),
        default=0.0,
        metavar="S",
        help="lock step: wait so long for a coordinator that died and is resumed (s of wall time)",
    )


def log_to_stderr(level: int = logging.INFO) -> None:
    """Write log records of this level and above to the process's standard error, which is its
    node's log. From now on no print waits for the disk, and a full one raises no error."""
    write_in_thread("stdout", "stderr")
    logging.basicConfig(
        format="%(asctime)s %(levelname)s %(name)s, process %(process)d: %(message)s", level=level
    )
    # A compiler that a kernel needs: it logs each of its steps at DEBUG.
    logging.getLogger("numba").setLevel(max(level, logging.INFO))


LARGEST = 10**9
"""Largest whole number of an option that does not say otherwise: numpy, the kernel and `islice`
refuse those of more than 64 bits."""
MOST_RUNS = 1_000_000
"""Largest number of runs that one command may ask for."""
LARGEST_SEED = 2**63 - 1
"""As a signed 64-bit number carries it."""


def _refusal(text: str) -> ArgumentTypeError:
    from argparse import ArgumentTypeError  # here, because workers need only `log_to_stderr`

    return ArgumentTypeError(text)


def whole(least: int = 1, most: int = LARGEST) -> Callable[[str], int]:
    """Return the type of an option that takes a whole number of at least `least`, at most
    `most`."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise _refusal(f"{text} is not a whole number of at least {least}")
        if value > most:
            raise _refusal(f"{text} is more than the largest number, {most}")
        return value

    return read


def number(
    *, above: float | None = None, least: float | None = None, most: float | None = None
) -> Callable[[str], float]:
    """Return the type of an option that takes a finite number: more than `above`, at least `least`,
    at most `most`."""
    bounds = (("more than", above), ("at least", least), ("at most", most))
    asked = " and ".join(f"{words} {bound:g}" for words, bound in bounds if bound is not None)

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        low = (above is None or value > above) and (least is None or value >= least)
        if not (isfinite(value) and low and (most is None or value <= most)):
            raise _refusal(
                f"{text} is not a number of {asked}" if asked else f"{text} is not a finite number"
            )
        return value

    return read


def probability(text: str) -> float:
    """Read a probability that is to be reached: more than 0, at most 1."""
    return number(above=0.0, most=1.0)(text)


def reopen_outputs() -> None:
    """Open the standard output and error again if code of users has closed them: others may print.
    Python keeps their files open."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name, None)
        encoding = None
        try:
            if stream is None or not stream.closed:
                continue
            encoding = stream.encoding
        except (AttributeError, ValueError):  # no stream, or one without its buffer
            pass
        with suppress(OSError):
            again = open(number, "w", buffering=1, encoding=encoding, closefd=False)  # noqa: SIM115
            setattr(sys, name, again)


LAST_THREADS = 0.5
"""How long a process that has finished waits for threads that code of users has left running
(s)."""


async def done_before(over: asyncio.Event, work: Coroutine[Any, Any, object]) -> bool:
    """Do the work; when `over` is set first, cancel it. Return whether it was done."""
    import asyncio  # here, because the processes of drivers import this module

    working, ending = asyncio.ensure_future(work), asyncio.ensure_future(over.wait())
    try:
        await asyncio.wait({working, ending}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        ending.cancel()
        working.cancel()
        await asyncio.wait({working})
    if working.cancelled():
        return False
    working.result()  # raises what it raised
    return True


def leave_threads(code: int) -> None:
    """End this process with the exit code if threads are left that Python would wait for at its
    end: some never end."""
    until = time.monotonic() + LAST_THREADS
    left = [thread for thread in threading.enumerate() if not thread.daemon]
    for thread in left:
        if thread is not threading.current_thread():
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                sys.stdout.flush()
                os._exit(code)
