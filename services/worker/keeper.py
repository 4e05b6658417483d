"""The process between a node and one of its workers: it ends everything that user code
left running when the worker ends.

An action or a driver may fork, start daemons or leave programs running. A worker that dies cannot
clean up after itself, and its node is not the parent of what it started. So each worker has a
keeper: the subreaper (prctl(2)) that becomes the parent of every orphan of the worker, even of one
with a session or process group of its own. The keeper runs no user code and imports next to
nothing. It kills its worker when the node orders it or dies, kills what is left once the worker has
ended, and then ends as the worker did. So the end of this process says that nothing of the worker
runs any more.

What escapes: a process that user code starts as another user (set-user-ID programs cannot be
signalled), one that hangs in the kernel, and all of them if user code kills the keeper itself.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import sys
import time
from pathlib import Path

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


def end_as(status: int) -> None:
    """End this process as the worker ended: by the same signal or with the same exit code."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [number])
        os.kill(os.getpid(), number)
    os._exit(os.waitstatus_to_exitcode(status) & 0xFF)


def main(arguments: list[str]) -> None:
    """Entry point of the process: `NODE PATIENCE PIPE DESCRIPTORS LINK PERMITS`, the last four as
    `services.worker` takes them."""
    node, patience, sockets = int(arguments[0]), float(arguments[1]), arguments[2:]
    for ignored in _IGNORED:
        signal.signal(ignored, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_BLOCK, _WATCHED)
    adopt_orphans()
    notify_of_end(node, NODE_ENDED)
    keeper = os.getpid()
    worker = os.fork()
    if worker == 0:
        die_with(keeper)
        os.setsid()  # a signal to the worker's whole process group does not reach its keeper
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _WATCHED)
        # Imported in the worker alone: here it would start threads of libraries before the fork,
        # and take memory.
        from petrobot.services.worker import process as program

        program.main(sockets)
        return
    for number in map(int, sockets):
        if number >= 0:
            os.close(number)
    status = keep(worker, patience)
    clean_up()
    end_as(status)


if __name__ == "__main__":
    main(sys.argv[1:])
