"""The processes between a node and its workers.

An action or a driver may fork, start daemons or leave programs running. A worker that dies cannot
clean up after itself, and its node is not the parent of what it started. So each worker has a
keeper: the subreaper (prctl(2)) that becomes the parent of every orphan of the worker, even of one
with a session or process group of its own. The keeper runs no user code. It kills its worker when
the node orders it or dies, kills what is left once the worker has ended, and then ends as the
worker did. So the end of this process says that nothing of the worker runs any more.

To start Python and to import what a worker needs takes some twenty times as long as a fork. So a
node starts one process that does both once, the fork server. It forks a keeper for each order of
its node, and the keeper forks the worker. It runs no user code and holds nothing of a run. If it
ends, the keepers and workers live on, and the node starts another one.

What escapes: a process that user code starts as another user (set-user-ID programs cannot be
signalled), one that hangs in the kernel, and all of them if user code kills the keeper itself.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import resource
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

import msgpack

from petrobot.services.host.parent_death import adopt_orphans, die_with, notify_of_end

KILL_ORDER = signal.SIGUSR2
"""Order of the node: kill the worker and everything that it started."""
NODE_ENDED = signal.SIGUSR1
"""Signal of the kernel: the node has ended."""
_WATCHED = (signal.SIGCHLD, KILL_ORDER, NODE_ENDED)
_IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""The node decides when its children end."""
CLEAN_UP = 1.0
"""Time in which the processes that the worker left must die (s): one that hangs in the kernel must
not hide that the worker has ended."""
LOOK_AGAIN = 0.01
KEPT = "kept"
"""First word in the pipe of a worker, from its keeper: the keeper's process id."""
MOST_PASSED = 4
"""Most descriptors of an order to the fork server: PIPE, DESCRIPTORS, PERMITS, LINK."""
CLONE_PARENT = 0x8000
_CLONE = {"x86_64": 56, "ppc64le": 120}.get(os.uname().machine, 220)
"""Number of the system call clone (syscalls(2)): most 64-bit machines share one table."""
if sys.maxsize < 1 << 32:
    _CLONE = 120
_PYTHON = ctypes.PyDLL(None, use_errno=True)


def keep(worker: int, patience: float) -> int:
    """Wait until the worker has ended, and return its wait status. `patience` is how long it may
    outlive its node (s)."""
    limit: float | None = None
    while True:
        if limit is not None and time.monotonic() >= limit:
            os.kill(worker, signal.SIGKILL)
            limit = None
        with contextlib.suppress(ChildProcessError):
            while ended := os.waitpid(-1, os.WNOHANG):
                if ended[0] == worker:
                    return ended[1]
                if ended[0] == 0:
                    break
        if limit is None:
            number = int(signal.sigwait(_WATCHED))
        else:
            found = signal.sigtimedwait(_WATCHED, max(0.0, limit - time.monotonic()))
            number = found.si_signo if found is not None else int(signal.SIGCHLD)
        if number == KILL_ORDER:
            limit = 0.0
        elif number == NODE_ENDED:
            limit = time.monotonic() + patience


def clean_up() -> None:
    """Kill all descendants of this process. The children of a killed one become children of this
    process, so it is repeated until there are none."""
    until = time.monotonic() + CLEAN_UP
    while time.monotonic() < until:
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        for child in _children(os.getpid()):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(child, signal.SIGKILL)
        signal.sigtimedwait([signal.SIGCHLD], LOOK_AGAIN)


def _children(parent: int) -> list[int]:
    """Return the children of a process, from /proc (its `children` file needs a kernel option;
    `stat` always exists)."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                # The name in parentheses may hold anything; state and parent follow it.
                if int((folder / "stat").read_text().rpartition(")")[2].split()[1]) == parent:
                    found.append(int(folder.name))
    return found


def end_as(status: int) -> NoReturn:
    """End this process as the worker ended: by the same signal or with the same exit code."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [number])
        os.kill(os.getpid(), number)
    os._exit(os.waitstatus_to_exitcode(status) & 0xFF)


def fork_sibling() -> int:
    """Fork this process, which must have one thread. The child is a child of this process's own
    parent (CLONE_PARENT, clone(2)): so the node, not the fork server, is notified of the end of a
    keeper and reaps it, and the kernel notifies the keeper of the node's end. Return 0 in the
    child.

    The C library does not know of this fork: the child must not run user code before it has forked
    in the usual way.
    """
    _PYTHON.PyOS_BeforeFork()
    found = int(_PYTHON.syscall(_CLONE, CLONE_PARENT | int(signal.SIGCHLD), 0, 0, 0, 0))
    if found == 0:
        _PYTHON.PyOS_AfterFork_Child()
        return 0
    _PYTHON.PyOS_AfterFork_Parent()
    if found < 0:
        raise OSError(ctypes.get_errno(), "clone")
    return found


def serve(node: int, orders: socket.socket) -> None:
    """Fork a keeper for each order, until the node closes the socket. An order is one byte, the
    patience (s), and the descriptors PIPE, DESCRIPTORS, PERMITS and, for some, LINK."""
    # Imported here, once for all workers. None of it starts a thread.
    from petrobot.services.worker import process as program

    gc.freeze()  # otherwise the collector of each child writes to all these pages, and copies them
    while True:
        order, passed, _, _ = socket.recv_fds(orders, 1, MOST_PASSED, socket.MSG_CMSG_CLOEXEC)
        if not order:
            return
        # If it cannot fork, the node sees that the pipe has no other end.
        with contextlib.suppress(OSError):
            if not fork_sibling():
                orders.close()
                keep_worker(node, order[0], passed, program.main)
        for descriptor in passed:
            os.close(descriptor)


def keep_worker(
    node: int, patience: float, passed: Sequence[int], program: Callable[[Sequence[int]], None]
) -> NoReturn:
    """Fork the worker, keep it, and end as it did."""
    keeper = os.getpid()
    os.write(passed[0], msgpack.packb([KEPT, keeper]))
    os.setsid()
    signal.pthread_sigmask(signal.SIG_BLOCK, _WATCHED)
    adopt_orphans()
    notify_of_end(node, NODE_ENDED)
    worker = os.fork()
    if worker == 0:
        die_with(keeper)
        os.setsid()  # a signal to the worker's whole process group does not reach its keeper
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _WATCHED)
        program(passed)
        sys.exit()
    for descriptor in passed:
        os.close(descriptor)
    status = keep(worker, patience)
    clean_up()
    end_as(status)


def main(arguments: list[str]) -> None:
    """Entry point of the fork server: `NODE ORDERS [KEPT_OPEN ...]`, a process id and inherited
    descriptors."""
    node, orders, *kept_open = map(int, arguments)
    for descriptor in kept_open:
        os.set_inheritable(descriptor, False)  # not by programs that user code leaves running
    die_with(node)
    for ignored in _IGNORED:
        signal.signal(ignored, signal.SIG_IGN)
    serve(node, socket.socket(fileno=orders))


if __name__ == "__main__":
    main(sys.argv[1:])
