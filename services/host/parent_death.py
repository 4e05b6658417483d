"""A child ends with its parent: the kernel sees to it (prctl(2), PR_SET_PDEATHSIG), so that nothing
here has to run for it.

What has no device is killed at once. What owns a device gets the time of its stop routine, which
begins when the pipe to the parent ends; but a driver or an action that hangs never looks at a pipe,
and one that hangs in C holds the interpreter, so that no handler and no thread of Python runs
either. For such a process the kernel's signal is handled by the C library's own `alarm(2)`: a
handler is called with the number of its signal, `alarm` with seconds. SIGQUIT is 3, so 3 s after
the parent's end SIGALRM ends the process, whatever it is doing. SIGUSR1 is 10, the time of a node
that ends its own children first.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from pathlib import Path

PR_SET_PDEATHSIG, PR_GET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 2, 36
STOP_ROUTINE = signal.SIGQUIT
"""Its number is how many seconds a process with a device may go on without its node: the stop limit
of 2 s, and a margin."""
GOOD_ORDER = signal.SIGUSR1
"""Its number is how many seconds a node may take to end in good order once its launcher is gone."""

LOOK_AGAIN = 0.02
"""Seconds between looks at a process, where the kernel does not tell of its end."""

_LIBC = ctypes.CDLL(None, use_errno=True)


def die_with(parent: int) -> None:
    """Be killed at the very moment the parent ends, also while stopped, or in the middle of an
    action that hangs."""
    _ask(signal.SIGKILL)
    _still_there(parent)


def outlive(parent: int, by: signal.Signals) -> None:
    """Be ended so many seconds after the parent as `by` (STOP_ROUTINE or GOOD_ORDER) has for its
    number, and not later."""
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
    """Wait until a child of this process has ended. It need not have been waited for (it is left
    for that).

    The end of a pipe to a process is no sign of its end: a process that it has left running may
    hold the other end.
    """
    # here, not above: a worker's keeper needs nothing of it, and there is one beside each worker
    import asyncio

    loop = asyncio.get_running_loop()
    try:
        number = os.pidfd_open(process)
    except ProcessLookupError:
        return
    except (AttributeError, OSError):  # a kernel before 5.3, or a sandbox that does not permit it
        while _runs(process):
            await asyncio.sleep(LOOK_AGAIN)
        return
    ended = asyncio.Event()
    loop.add_reader(number, ended.set)
    try:
        await ended.wait()
    finally:
        loop.remove_reader(number)
        os.close(number)


def _runs(process: int) -> bool:
    """Whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wanted_with_parent() -> bool:
    """Whether whoever launched this process wants it to end with itself (PR_SET_PDEATHSIG outlives
    exec)."""
    number = ctypes.c_int()
    _LIBC.prctl(PR_GET_PDEATHSIG, ctypes.byref(number))
    return number.value != 0


def _ask(number: signal.Signals) -> None:
    if _LIBC.prctl(PR_SET_PDEATHSIG, int(number)) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")


def _still_there(parent: int) -> None:
    """The parent may have ended before the kernel was asked: then no signal comes any more."""
    if os.getppid() != parent:
        sys.exit(0)
