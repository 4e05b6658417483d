"""End a child process when its parent ends: the kernel does it (prctl(2), PR_SET_PDEATHSIG), so no
code of the child has to run.

A child without a device is killed at once. A child that owns a device gets the time for its stop
routine, which begins when the pipe to the parent closes. But a driver or action that hangs never
looks at a pipe, and one that hangs in C code holds the interpreter lock, so neither a signal
handler nor a thread of Python runs. For such a child the C library's own `alarm(2)` is installed as
the signal handler: a handler is called with the signal's number, and `alarm` takes seconds. SIGQUIT
is 3, so 3 s after the parent's end SIGALRM kills the child, whatever it is doing. SIGUSR1 is 10:
the time of a node, which first ends its own children.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the keeper process beside each worker does not need asyncio
    from asyncio.subprocess import Process

PR_SET_PDEATHSIG, PR_GET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 2, 36
STOP_ROUTINE = signal.SIGQUIT
"""The signal's number is how many seconds a process with a device may live on without its node: the
limit of 2 s for a stop routine, and a margin."""
GOOD_ORDER = signal.SIGUSR1
"""The signal's number is how many seconds a node may take to close in an orderly way after its
launcher is gone."""

LOOK_AGAIN = 0.02
"""Seconds between checks of a process, where the kernel does not report its end."""

_LIBC = ctypes.CDLL(None, use_errno=True)


def die_with(parent: int) -> None:
    """Have this process killed when the parent ends, even while it is stopped or hangs in an
    action."""
    _ask(signal.SIGKILL)
    _still_there(parent)


def outlive(parent: int, by: signal.Signals) -> None:
    """Have this process killed so many seconds after the parent as the number of `by` (STOP_ROUTINE
    or GOOD_ORDER)."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    _LIBC.signal.restype = ctypes.c_void_p
    _LIBC.signal.argtypes = (ctypes.c_int, ctypes.c_void_p)
    _LIBC.signal(by, ctypes.cast(_LIBC.alarm, ctypes.c_void_p))
    _ask(by)
    _still_there(parent)


def notify_of_end(parent: int, by: signal.Signals) -> None:
    """Have the kernel send this signal when the parent ends."""
    _ask(by)
    _still_there(parent)


def adopt_orphans() -> None:
    """Become the parent of every descendant whose own parent ends (PR_SET_CHILD_SUBREAPER)."""
    if _LIBC.prctl(PR_SET_CHILD_SUBREAPER, 1) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_CHILD_SUBREAPER)")


async def until_ended(process: int) -> None:
    """Wait until a child process has ended. It need not be reaped yet; it is left for `wait`.

    The closed end of a pipe would not show it: a process that the child left running may hold the
    pipe open.
    """
    import asyncio

    loop = asyncio.get_running_loop()
    try:
        number = os.pidfd_open(process)
    except ProcessLookupError:
        return
    except (AttributeError, OSError):  # a kernel before 5.3, or a sandbox that does not permit it
        while state_of(process) not in ("", "Z"):
            await asyncio.sleep(LOOK_AGAIN)
        return
    ended = asyncio.Event()
    loop.add_reader(number, ended.set)
    try:
        await ended.wait()
    finally:
        loop.remove_reader(number)
        os.close(number)


async def until_reaped(process: Process) -> None:
    """Wait for a child process that was killed; drop what it has not read of its input.

    Its broken pipe is noticed here: CPython before 3.11.5 would log a traceback about it later.
    """
    assert process.stdin is not None
    if not process.stdin.is_closing():
        process.stdin.transport.abort()
    with contextlib.suppress(ConnectionError):
        await process.stdin.wait_closed()
    await process.wait()


def state_of(process: int) -> str:
    """Return the state of a process as `ps` shows it (R: it runs, Z: it has ended, T: a signal has
    stopped it); empty if there is none."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def wanted_with_parent() -> bool:
    """Return whether the launcher of this process wants it to end together with itself
    (PR_SET_PDEATHSIG survives exec)."""
    number = ctypes.c_int()
    _LIBC.prctl(PR_GET_PDEATHSIG, ctypes.byref(number))
    return number.value != 0


def _ask(number: signal.Signals) -> None:
    if _LIBC.prctl(PR_SET_PDEATHSIG, int(number)) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")


def _still_there(parent: int) -> None:
    """Exit if the parent ended before the kernel was asked: then no signal would come."""
    if os.getppid() != parent:
        sys.exit(0)
