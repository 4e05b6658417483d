"""Interrupts code that hangs in a step of a node: in lock step, where it would stop simulated time
for ever, and in the services that a node executes in its own loop, where the node would answer
nobody. There is no other process that could end it.

Code that ends this process would end the command, or the node, without a word. `os._exit` raises
SystemExit there instead, and Python names the line at a crash.

A thread checks the current step of a node. It counts the processor time that the step has used and
the time that it slept. On a busy machine a step that does not hang may take long, but then it does
neither.
"""

from __future__ import annotations

import ctypes
import faulthandler
import logging
import os
import signal
import sys
import threading
import time
import weakref
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from types import FrameType
from typing import NoReturn

from petrobot.services.worker.callables import is_users
from petrobot.services.worker.runner import Execution, Hung

_log = logging.getLogger(__name__)
LIMIT = 10.0
"""Longest processor time or sleep of one step of a node (s): a thousand times that of the slowest
step that was measured."""
COMPILER = "numba"
"""Package that may take longer: it compiles a kernel at its first call, once on each machine."""
LOOK = 0.5
"""Time between checks (s)."""
IDLE = 1e-3
"""Processor time between two checks below which a thread was idle (s)."""
ATTEMPTS, AGAIN = 4, 2.0
"""How often the code is interrupted, and the processor time in between (s), since it may catch the
exception. After that the process ends."""
WAKE = signal.SIGURG
"""Signal that lets a call of the system return, so that the code that waits for it can be
interrupted. By default a process ignores it."""
ENDING = (signal.SIGALRM, signal.SIGVTALRM, signal.SIGPROF)
"""Signals of a process's timers, which end it by default."""
UNWATCHED: AbstractContextManager[None] = nullcontext()
"""Stands for a watchdog where none is needed."""
_exit = os._exit
_raise_in_thread = ctypes.pythonapi.PyThreadState_SetAsyncExc


class Watchdog:
    """Watches the steps of one node: `with watchdog:` is a step. That must be cheap: it is done at
    each tick."""

    def __init__(self, node: str, slow: float = LIMIT) -> None:
        """A step that takes longer than `slow` s is logged."""
        self._node, self._slow = node, slow
        self._logged = False
        self._step = 0
        """Odd during a step."""
        self._thread: threading.Thread | None = None
        self._over = threading.Event()
        self._watched = self._clock = 0
        self._seen, self._used, self._before, self._attempts = 0, 0.0, 0.0, 0

    def __enter__(self) -> None:
        """Note that the node's code is called now, in this thread."""
        if self._thread is None:
            # A weak reference: a cell that is not closed must still be freed with its last user.
            self._thread = threading.Thread(
                target=_look_on, args=(weakref.ref(self), self._over), daemon=True
            )
            self._thread.start()
            # Only the main thread runs handlers; another one is interrupted when its call returns.
            main = threading.current_thread() is threading.main_thread()
            _name_what_ends_the_process()
            if main and signal.getsignal(WAKE) is signal.SIG_DFL:
                signal.signal(WAKE, lambda *_: None)
        self._watched = _steps[os.getpid()] = threading.get_ident()
        # The thread asks for its own clock: asking for that of an ended thread crashes the process.
        self._clock = time.pthread_getcpuclockid(self._watched)
        self._step += 1

    def __exit__(self, *_: object) -> None:
        """Note that the code has returned."""
        self._step += 1
        _steps.clear()

    def close(self) -> None:
        """Stop watching."""
        self._over.set()

    def look(self) -> None:
        """Interrupt the step if it has taken too long."""
        now = _processor_time(self._clock)
        if self._step != self._seen or self._seen % 2 == 0:
            self._seen, self._used, self._attempts = self._step, 0.0, 0
            self._logged = False
        else:
            spent = now - self._before
            # This thread holds the interpreter now, so the other one waits for it, whatever it did
            # before: it slept only if it has used no processor time either.
            self._used += LOOK if spent < IDLE and _sleeps(self._watched) else spent
            if self._slow <= self._used < LIMIT and not self._logged:
                self._logged = True
                where = _described(sys._current_frames().get(self._watched))
                _log.warning(
                    "node %s: %s has not come back for %g s, and meanwhile the node answers no one",
                    self._node,
                    where,
                    self._slow,
                )
            if self._used >= LIMIT:
                self._used, self._attempts = LIMIT - AGAIN, self._attempts + 1
                self._interrupt(self._attempts)
        self._before = now

    def _interrupt(self, attempts: int) -> None:
        frame = sys._current_frames().get(self._watched)
        if _compiles(frame):
            self._used, self._attempts = 0.0, 0
            return
        where = _described(frame)
        text = (
            f"node {self._node}: {where} has not come back for {LIMIT:g} s of processor "
            "time or sleep"
        )
        if attempts > ATTEMPTS:
            _log.critical("%s, and cannot be interrupted; the process ends", text)
            os._exit(3)
        _log.error("%s; it is interrupted", text)
        _raise_in_thread(ctypes.c_ulong(self._watched), ctypes.py_object(Hung))
        # Raised at the thread's next line of Python: that of the signal's handler, if it waits in a
        # call of the system (a sleep, the end of another program).
        signal.pthread_kill(self._watched, WAKE)


_steps: dict[int, int] = {}
"""During a step: the id of its process, and its thread. A copy of the process has another id."""


def _exit_aloud(status: int) -> NoReturn:
    """Stands for `os._exit`."""
    if _steps.get(os.getpid()) == threading.get_ident():
        raise SystemExit(f"it called os._exit({status})")
    _exit(status)


def _name_what_ends_the_process() -> None:
    os._exit = _exit_aloud
    if not faulthandler.is_enabled() and sys.stderr is sys.__stderr__ is not None:
        faulthandler.enable(all_threads=False)
        for number in ENDING:
            if signal.getsignal(number) is signal.SIG_DFL:
                faulthandler.register(number, all_threads=False, chain=True)


def _look_on(watchdog: weakref.ref[Watchdog], over: threading.Event) -> None:
    while not over.wait(LOOK) and (alive := watchdog()) is not None:
        alive.look()
        del alive


def _described(frame: FrameType | None) -> str:
    """Return whose code a stack is in, and at which line."""
    line, whose = "", "its code"
    while frame is not None:
        code = frame.f_code
        if not line and is_users(frame):
            line = f"{code.co_name} ({code.co_filename}:{frame.f_lineno})"
        owner = frame.f_locals.get("self")
        if isinstance(owner, Execution):
            whose = f"action {owner.call.service}, run {owner.call.id},"
            break
        frame = frame.f_back
    return f"{whose} in {line}" if line else whose


def _compiles(frame: FrameType | None) -> bool:
    while frame is not None:
        if str(frame.f_globals.get("__name__")).partition(".")[0] == COMPILER:
            return True
        frame = frame.f_back
    return False


def _processor_time(clock: int) -> float:
    """Return the seconds of processor time that the thread of this clock has used."""
    try:
        return time.clock_gettime(clock)
    except OSError:  # it has ended
        return 0.0


def _sleeps(thread: int) -> bool:
    """Return whether a thread waits for something; False if it is ready to run on a busy
    machine."""
    native = next((t.native_id for t in threading.enumerate() if t.ident == thread), None)
    try:
        return (
            Path(f"/proc/self/task/{native}/stat").read_text().rpartition(")")[2].split()[0] == "S"
        )
    except (OSError, IndexError):
        return False
