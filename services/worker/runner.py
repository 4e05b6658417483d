"""Runs actions: a sans-I/O machine that polls their coroutines, cancels them, and guards their
device."""

from __future__ import annotations

import inspect
import logging
import math
import os
import sys
import warnings
from collections.abc import Callable, Coroutine, Mapping
from enum import Enum, auto
from math import inf

# Its own name: a test's clock that an action leaves in `time` must not reach later runs.
from time import process_time
from typing import Any, Protocol

from msgspec import Struct
from msgspec.structs import replace

from petrobot.services.action import Cancelled, CommandRefused, Status, Wait
from petrobot.services.comm.location_file import ActionEntry, resolve
from petrobot.services.comm.protocol.messages import Call, Cancel, Command, Executed, Outcome
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.host.command_line import reopen_outputs
from petrobot.services.worker.callables import (
    check_arguments,
    describe,
    from_outside,
    log_fault,
    where,
    words_of,
)
from petrobot.services.worker.context import Report, RunContext, checked_result, never
from petrobot.services.worker.remote import Refusing
from petrobot.services.worker.setpoints import Outlets

_log = logging.getLogger(__name__)

GRACE = 0.5
"""Time in which a cancelled action must clean up and its device must stand still (s); after that
the stop routine is called."""
STOP_LIMIT = 2.0
"""Time after the stop routine at which the run ends even if its device is not known to stand still
(s); the device then stays fenced."""
TAKEN_WITHIN = 1.0
"""Time in which a driver must handle the last commands of a run that has returned (s): only then is
it known whether it refuses one."""
Order = Call | Cancel | Outcome | Command
"""Orders to a runner. Call: begin this run. Cancel: stop it, with a reason made by `stop_reason`.
Outcome: the result of a call that a run made. Command: `hold` or `release` all runs."""


def stop_reason(cause: str, text: str) -> str:
    """Return the reason of a CANCEL inside a node: the cause with which the run ends, and a
    text."""
    return f"{cause}: {text}"


STEPS = 10_000
"""How often a coroutine may continue without time passing before it counts as an endless loop."""


class ActionPhase(Enum):
    """Stage of a run between its begin and its end."""

    NEW = auto()
    RUNNING = auto()
    COMPUTED = auto()
    """Its result waits for the declared computing time."""
    TAKING = auto()
    """Its result waits until the driver has handled all commands: it may refuse one."""
    STOPPING = auto()
    """Its coroutine cleans up after a cancel."""
    SETTLING = auto()
    """Its coroutine has ended; its device must come to a standstill."""


# Looked up once: in CPython 3.11 it takes five times as long as any other class attribute.
NEW, RUNNING, COMPUTED, TAKING, STOPPING, SETTLING = ActionPhase


class Hung(BaseException):
    """Raised by a watchdog in code that has not returned for too long."""

    def __str__(self) -> str:
        return (
            "did not come back in time; an action waits with ctx.wait or ctx.sleep, and "
            "loops that do not end are faults"
        )


class Returned(Exception):  # noqa: N818 - not an error
    """The action has ended; `value` is what it returned."""

    def __init__(self, value: Any) -> None:
        super().__init__(value)
        self.value = value


class Execution(Struct, eq=False):
    """State of one run; times in seconds on the cell's clock."""

    call: Call
    entry: ActionEntry
    phase: ActionPhase = NEW
    context: RunContext | None = None
    coroutine: Coroutine[Wait, bool | None, Any] | None = None
    wait: Wait | None = None
    started: float = 0.0
    limit: float | None = None
    """When the phase ends at the latest."""
    ready_at: float = 0.0
    """When its computed result is reported, or is given up because the driver handles no
    commands."""
    sent_before: int = 0
    """Number of the last command that was sent to its device before it began."""
    cpu: float = 0.0
    result: Outcome | None = None
    cause: str = ""
    text: str = ""
    abandoned: bool = False
    """Whether the action could not bring its device to a safe state: standing still is not enough
    then."""
    stop_called: bool = False
    unawaited: str = ""
    """What its code has called and dropped without `await`: it never ran."""

    @property
    def over(self) -> bool:
        """Whether the action's own code has nothing more to do."""
        return self.coroutine is None

    @property
    def polls(self) -> bool:
        """Whether it waits for more than time."""
        waits = self.wait is not None and self.wait.ready is not never
        return waits or self.phase in (SETTLING, TAKING)

    def due(self) -> float | None:
        """When it must be looked at although nothing arrives (s)."""
        if self.phase is NEW:
            return -math.inf
        times = [self.limit, self.wait.due if self.wait else None]
        if self.phase in (COMPUTED, TAKING):
            times.append(self.ready_at)
        return min((t for t in times if t is not None), default=None)

    def begin(self, function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
        """Call the action up to its first wait. Raises Returned if it ends, otherwise whatever it
        raises."""
        returned = self._timed(function, self.context, **arguments)
        if not inspect.iscoroutine(returned):
            raise Returned(returned)
        self.coroutine = returned
        self.go_on(None)

    def look(self, now: float) -> None:
        """Continue if its wait is fulfilled or has timed out. Raises as `begin` does."""
        if self.wait is None:
            return
        try:
            ready = self.wait.ready()
        except Exception as fault:
            self.go_on(fault)
            return
        if ready or (self.wait.due is not None and now >= self.wait.due):
            self.go_on(ready)

    def go_on(self, verdict: bool | BaseException | None) -> None:
        """Tell its wait the verdict (or raise it there), and run until it waits for something that
        is not there yet.

        Raises as `begin` does.
        """
        for _ in range(STEPS):
            self.wait = self._resume(verdict)
            if not self.wait.ready():
                return
            verdict = True
        raise RuntimeError(f"went on {STEPS} times without time passing")

    def _resume(self, verdict: bool | BaseException | None) -> Wait:
        coroutine = self.coroutine
        assert coroutine is not None
        for _ in range(STEPS):
            try:
                if isinstance(verdict, BaseException):
                    wait: Any = self._timed(coroutine.throw, verdict)
                else:
                    wait = self._timed(coroutine.send, verdict)
            except StopIteration as returned:
                self.coroutine = self.wait = None
                raise Returned(returned.value) from None
            if isinstance(wait, Wait):
                return wait
            verdict = TypeError(
                f"awaits a {type(wait).__name__}; an action awaits only what its context gives it"
            )
        raise RuntimeError("awaits only what its context did not give it")

    def close(self) -> str:
        """End the coroutine. Return what it raised instead of ending; empty if it ended."""
        coroutine, self.coroutine, self.wait = self.coroutine, None, None
        try:
            if coroutine is not None:
                coroutine.close()
        except BaseException as fault:
            if from_outside(fault):
                raise
            return describe(fault)
        return ""

    def note(self, text: str) -> None:
        """Add to the text of its end."""
        self.text = f"{self.text}; {text}" if self.text else text

    def postpone(self, pause: float) -> None:
        """Shift all its times by an operator's pause."""
        self.started += pause
        self.ready_at += pause
        self.limit = None if self.limit is None else self.limit + pause
        if self.context is not None:
            self.context.held += pause
        if self.wait is not None and self.wait.due is not None:
            self.wait.due += pause

    def _timed(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Any:
        global _active
        before, earlier, _active = process_time(), _active, self
        try:
            return function(*arguments, **named)
        finally:
            if _forked:
                os._exit(0)
            _active = earlier
            reopen_outputs()
            self.cpu += process_time() - before


_active: Execution | None = None
"""The run whose code is running now."""
_forked = False
"""Whether an action has forked this process: the run is its parent's."""


def _note_fork() -> None:
    global _forked
    _forked = _active is not None


os.register_at_fork(after_in_child=_note_fork)


def _watch_unawaited() -> None:
    """Note for a run what it calls without `await`. Python only warns of that, once for each line,
    and the run would end with SUCCESS although nothing was done."""
    if sys.unraisablehook is not _note_unawaited:
        global _usual_hook
        _usual_hook, sys.unraisablehook = sys.unraisablehook, _note_unawaited
    # As an error it is raised where the coroutine is dropped: no code can catch it there.
    warnings.filterwarnings("error", "coroutine .* was never awaited", RuntimeWarning)


def _note_unawaited(raised: sys.UnraisableHookArgs) -> None:
    fault = raised.exc_value
    if _active is not None and isinstance(fault, RuntimeWarning) and "awaited" in str(fault):
        # It is dropped where it was called, unless it was kept in a variable.
        _active.unawaited = f"{fault}{where(sys._getframe(1))}"
    else:
        _usual_hook(raised)


_usual_hook: Callable[[sys.UnraisableHookArgs], Any] = sys.__unraisablehook__


_AFTER = (STOPPING, SETTLING)


class DeviceControl(Protocol):
    """A device as the runner guards it."""

    @property
    def handle(self) -> Any:
        """What actions see as `ctx.device`."""

    def stop(self, now: float) -> None:
        """Call the stop routine."""

    def stopped(self) -> bool:
        """Return whether the device is known to stand still and has handled all commands."""


class Runner:
    """Runs of one place: of one device, at most one at a time (except those that start at once);
    without a device, any number.

    Orders come in by `take`, reports go out by `reports`; in between `advance(now)` does what is
    due. `clock` is what `ctx.now` reads. `substitutes` replace actions by other callables. With
    `virtual` the declared computing time passes. With `fenced` no run begins before the device is
    known to stand still.
    """

    def __init__(
        self,
        actions: Mapping[str, ActionEntry],
        *,
        clock: Callable[[], float],
        device: DeviceControl | None = None,
        streams: Mapping[str, float] | None = None,
        substitutes: Mapping[str, Callable[..., Any]] | None = None,
        virtual: bool = False,
        fenced: bool = False,
    ) -> None:
        _watch_unawaited()
        self._actions = actions
        self._clock = clock
        self._device = device
        self._refusing: Refusing | None = device if isinstance(device, Refusing) else None
        self._outlets = Outlets({} if streams is None else streams)
        self._callables: dict[str, Callable[..., Any]] = dict(substitutes or {})
        self._virtual = virtual
        self._runs: dict[str, Execution] = {}
        self._reports: list[Report] = []
        self._fenced = fenced
        self._held_since: float | None = None

    @property
    def runs(self) -> tuple[str, ...]:
        """Ids of the runs that have not ended."""
        return tuple(self._runs)

    @property
    def polling(self) -> bool:
        """Whether a run waits for more than time, so that `advance` must be called often."""
        return any(run.polls for run in self._runs.values())

    @property
    def idle(self) -> bool:
        """Whether it has no run, nothing to report and no fence to check."""
        return not (self._runs or self._reports or self._fenced)

    @property
    def held(self) -> bool:
        """Whether the operator holds the runs."""
        return self._held_since is not None

    @property
    def fenced(self) -> bool:
        """Whether the device is not known to stand still after a run that had to be given up."""
        return self._fenced

    def load(self, action: str) -> Callable[..., Any]:
        """Return the callable of an action, imported once. Raises ImportError."""
        if action not in self._callables:
            self._callables[action] = resolve(self._actions[action].run)
        return self._callables[action]

    def take(self, now: float, order: Order) -> None:
        """Take an order. A run begins at the next `advance`."""
        if isinstance(order, Call):
            self._begin(order)
        elif isinstance(order, Cancel):
            if order.id in self._runs:
                cause, _, text = order.reason.partition(": ")
                self._stop(now, self._runs[order.id], cause or "cancelled", text)
        elif isinstance(order, Outcome):
            any(run.context.answer(order) for run in self._runs.values() if run.context)
        elif order.verb in ("hold", "release"):
            self._hold(now, order.verb == "hold")

    def reports(self) -> list[Report]:
        """Return what happened since the last call, in order."""
        if not self._reports:
            return []
        reports, self._reports = self._reports, []
        return reports

    def _report(self, report: Report) -> None:
        self._reports.append(report)

    def due(self) -> float | None:
        """When `advance` has something to do at the latest (s); None: not before a message
        arrives."""
        if not self._runs:  # nor is a stream open
            return None
        held = self._held_since is not None
        times = [] if held else [self._outlets.due()]
        times += [run.due() for run in self._runs.values() if not held or run.phase in _AFTER]
        return min((t for t in times if t is not None), default=None)

    def advance(self, now: float) -> None:
        """Do all that is due: begin, continue, stop and end runs."""
        if self._fenced:
            self._look_at_fence()
        if not self._runs:  # nor is a stream open: a run closes its own when it ends
            return
        held = self._held_since is not None
        for run in list(self._runs.values()):
            if not held and run.phase not in _AFTER:
                self._lead(now, run)
            if run.phase is STOPPING:
                self._clean_up(now, run)
            if run.phase is SETTLING:
                self._settle(now, run)
        if not held:
            self._reports += self._outlets.advance(now)

    def commands_taken(self, now: float) -> None:
        """End the runs that only waited for the driver, which was just stepped, to handle their
        last commands."""
        for run in list(self._runs.values()):
            if run.phase is TAKING:
                self._await_taking(now, run)

    def give_up_all(self, now: float, text: str) -> list[Report]:
        """Return how all runs end when their device has failed; its stop routine is not called."""
        ends: list[Report] = []
        for identity, run in self._runs.items():
            if fault := run.close():
                _log.warning("run %s did not let itself be closed: %s", identity, fault)
            self._outlets.close(identity)
            executed = Executed.NO if run.phase is NEW else Executed.UNKNOWN
            took = 0.0 if run.phase is NEW else now - run.started
            died = Outcome(identity, Status.ERROR, {}, "device_died", text, executed, took, run.cpu)
            ends.append(died)
        self._runs.clear()
        return ends

    # --- begin --------------------------------------------------------------------------------

    def _begin(self, call: Call) -> None:
        entry = self._actions.get(call.service)
        self._look_at_fence()
        if call.id in self._runs:
            return
        if entry is None:
            self._refuse(call, "unknown_service", f"no action {call.service!r} here")
        elif self._fenced and not entry.at_once:
            self._refuse(
                call, "fenced", "the device is not known to stand still after an earlier run"
            )
        elif busy := self._taken_by(entry):
            self._refuse(call, "busy", f"the device is taken by run {busy}")
        else:
            self._runs[call.id] = Execution(call, entry)

    def _taken_by(self, entry: ActionEntry) -> str:
        if self._device is None:
            return ""
        return next(
            (i for i, run in self._runs.items() if not (entry.at_once and run.phase in _AFTER)), ""
        )

    def _refuse(self, call: Call, cause: str, text: str) -> None:
        self._reports.append(Outcome(call.id, Status.ERROR, {}, cause, text, Executed.NO))

    def _drop(self, run: Execution, cause: str, text: str) -> None:
        del self._runs[run.call.id]
        self._refuse(run.call, cause, text)

    def _start(self, now: float, run: Execution) -> None:
        call, entry = run.call, run.entry
        try:
            function = self.load(call.service)
            arguments = plain({**entry.args, **call.arguments}, "arguments")
            check_arguments(function, arguments)
        except ImportError as fault:
            log_fault(_log, fault, "%s cannot be imported", entry.run)
            self._drop(run, "import_failed", f"{entry.run}: {fault}")
            return
        except (TypeError, ValueError) as fault:
            self._drop(run, "bad_arguments", f"{call.service}: {fault}")
            return
        handle = self._device.handle if self._device else None
        run.context = RunContext(call, handle, self._clock, self._outlets, self._report)
        run.phase, run.started = RUNNING, now
        run.sent_before = self._refusing.sent if self._refusing is not None else 0
        self._in_action(now, run, run.begin, function, arguments)

    # --- continue -----------------------------------------------------------------------------

    def _look_at_fence(self) -> None:
        if self._fenced and (self._device is None or self._device.stopped()):
            self._fenced = False

    def _lead(self, now: float, run: Execution) -> None:
        if run.phase is NEW:
            self._start(now, run)
        elif run.phase is RUNNING:
            self._in_action(now, run, run.look, now)
        elif run.phase is TAKING:
            self._await_taking(now, run)
        elif run.result is not None and now >= run.ready_at - 1e-9:
            self._finish(now, run, run.result)

    def _in_action(
        self, now: float, run: Execution, step: Callable[..., None], *arguments: Any
    ) -> None:
        """Let the action's code continue by a step of its run, and handle its result."""
        try:
            step(*arguments)
        except Returned as returned:
            self._returned(now, run, returned.value)
        # an action may raise SystemExit or its like: that ends its run, not the others'
        except BaseException as fault:
            if from_outside(fault):
                raise
            run.close()
            kind = type(fault)  # not `isinstance`: that asks the exception, which may raise
            if run.phase is not STOPPING:
                cause = "hung" if issubclass(kind, Hung) else "exception"
                if issubclass(kind, MemoryError):
                    cause = "out_of_memory"
                words = f"{describe(fault)}{self._hint(fault)}"
                if issubclass(kind, CommandRefused):
                    cause, words = "command_refused", words_of(fault)
                self._give_up(now, run, cause, self._with_refusal(run, words))
                log_fault(_log, fault, "run %s of %s raised", run.call.id, run.call.service)
            elif not issubclass(kind, Cancelled):
                log_fault(_log, fault, "run %s raised while it cleaned up", run.call.id)
                run.note(f"while it cleaned up: {describe(fault)}")
        if run.phase is STOPPING and run.over:
            run.phase = SETTLING

    def _hint(self, fault: BaseException) -> str:
        """Return what to do about an attribute that `ctx.device` does not have."""
        if not issubclass(type(fault), AttributeError):
            return ""
        owner = vars(AttributeError)["obj"].__get__(fault)  # not what a subclass calls `obj`
        if owner is not None and owner is self._refusing:
            remedy = "write `await ctx.command({...})`, or read `ctx.device.state`"
            return f"; its driver runs in another process: {remedy}"
        return ""

    def _returned(self, now: float, run: Execution, returned: Any) -> None:
        if run.phase is STOPPING:
            return
        try:
            result = checked_result(run.call.id, returned)
        except ValueError as fault:
            self._give_up(now, run, "bad_result", self._with_refusal(run, str(fault)))
            return
        if run.unawaited and result.status is not Status.ERROR:
            text = f"{run.unawaited}: it did nothing; write `await` before the call"
            self._give_up(now, run, "exception", self._with_refusal(run, text))
            return
        if self._virtual and run.entry.compute_time > 0:
            run.phase, run.result, run.ready_at = (
                COMPUTED,
                result,
                now + run.entry.compute_time,
            )
        else:
            self._finish(now, run, result)

    def _finish(self, now: float, run: Execution, result: Outcome) -> None:
        """End the run with its action's result, as soon as it is known that the driver refused none
        of its commands."""
        if self._refusing is None:
            self._end(now, run, result)
        elif result.status is Status.ERROR:
            text = self._with_refusal(run, result.text)
            self._end(now, run, replace(result, text=text))
        else:
            self._outlets.close(run.call.id)
            run.phase, run.result, run.ready_at = TAKING, result, now + TAKEN_WITHIN
            self._await_taking(now, run)

    def _await_taking(self, now: float, run: Execution) -> None:
        refusal = self._refusing.refusal(run.sent_before) if self._refusing is not None else ""
        if refusal:
            text = f"the driver refused a command, and the action did not look at that: {refusal}"
            self._give_up(now, run, "command_refused", text)
        elif refusal is None and now >= run.ready_at - 1e-9:
            text = (
                "the action returned, but the driver did not take its last command "
                f"within {TAKEN_WITHIN:g} s"
            )
            self._give_up(now, run, "command_not_taken", text)
        elif refusal == "" and run.result is not None:
            self._end(now, run, run.result)

    def _with_refusal(self, run: Execution, text: str) -> str:
        """Return the text of an ERROR with a refusal of the driver that the action did not read, or
        the driver's silence: that is often the reason."""
        if self._refusing is None:
            return text
        if refusal := self._refusing.refusal(run.sent_before):
            text = f"{text}; the driver refused a command: {refusal}"
        if TAKEN_WITHIN < (age := self._refusing.age) < inf:
            silent = f"the driver has published nothing for {age:.1f} s"
            text = f"{text}; {silent} (does it block, or is its `period` not in seconds?)"
        return text.lstrip("; ")

    # --- end ----------------------------------------------------------------------------------

    @staticmethod
    def _give_up(now: float, run: Execution, cause: str, text: str) -> None:
        """Handle an action that raised: its device is not controlled any more, so the stop routine
        is called at once."""
        run.phase, run.cause, run.text, run.abandoned, run.limit = (
            SETTLING,
            cause,
            text,
            True,
            now,
        )

    def _stop(self, now: float, run: Execution, cause: str, text: str) -> None:
        if run.phase is NEW:
            self._drop(run, cause, text)
        elif run.phase not in _AFTER:
            text = self._with_refusal(run, text) if cause == "deadline" else text
            run.cause, run.text, run.result, run.limit = cause, text, None, now + GRACE
            # A held device stands without having been stopped: when released, it would continue its
            # motion without its run.
            run.abandoned = self.held
            self._outlets.close(run.call.id)
            run.phase = SETTLING if run.over else STOPPING
            if not run.over:
                self._in_action(now, run, run.go_on, Cancelled(cause))

    def _clean_up(self, now: float, run: Execution) -> None:
        assert run.limit is not None
        if now < run.limit:
            self._in_action(now, run, run.look, now)
            return
        run.phase, run.abandoned = SETTLING, True
        if fault := run.close():
            run.note(f"did not let itself be closed: {fault}")

    def _settle(self, now: float, run: Execution) -> None:
        """End the run when its device stands still; call the stop routine when its grace is
        over."""
        assert run.limit is not None
        self._outlets.close(run.call.id)
        failed = Outcome(run.call.id, Status.ERROR, {}, run.cause, run.text)
        if self._device is None or (
            self._device.stopped() and (run.stop_called or not run.abandoned)
        ):
            self._end(now, run, failed)
        elif now < run.limit:
            return
        elif not run.stop_called:
            run.stop_called, run.limit = True, now + STOP_LIMIT
            self._device.stop(now)
        else:
            self._fenced = True
            run.note("the device is not known to stand still")
            self._end(now, run, replace(failed, text=run.text))

    def _end(self, now: float, run: Execution, result: Outcome) -> None:
        identity = run.call.id
        self._outlets.close(identity)
        del self._runs[identity]
        # Not `now`: the action may have blocked since this step began.
        took = self._clock() - run.started
        self._reports.append(replace(result, seconds=took, cpu_seconds=run.cpu))

    def _hold(self, now: float, frozen: bool) -> None:
        """Freeze the runs, or let them continue with all their times shifted by the pause."""
        if frozen:
            self._held_since = now if self._held_since is None else self._held_since
        elif self._held_since is not None:
            pause, self._held_since = now - self._held_since, None
            for run in self._runs.values():
                if run.phase in (RUNNING, COMPUTED):
                    run.postpone(pause)
