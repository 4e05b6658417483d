"""Runs actions: a machine that polls their coroutines, cancels them, holds them to their deadlines
and guards their device."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf
from typing import Any, Protocol

from petrobot.services.action import Cancelled, Result, Status
from petrobot.services.comm.location_file import ActionEntry, resolve
from petrobot.services.comm.protocol.messages import Executed
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.worker.callables import (
    check_arguments,
    describe,
    from_outside,
    log_fault,
)
from petrobot.services.worker.context import RunContext, checked_result
from petrobot.services.worker.execution import Execution, Hung, Phase, Returned
from petrobot.services.worker.outlets import Outlets
from petrobot.services.worker.remote import Refusing
from petrobot.services.worker.runs import Answered, Begin, Ended, Hold, Order, Report, Stop

_log = logging.getLogger(__name__)

GRACE = 0.5
"""Seconds that a cancelled action has to clean up and its device to stand still before the stop
routine is called."""
STOP_LIMIT = 2.0
"""Seconds after the stop routine when the run ends although its device is not known to stand still;
the device stays fenced."""
TAKEN_WITHIN = 1.0
"""Seconds that a driver has to take the commands of a run that has returned: until then nobody
knows whether it refuses one."""
_AFTER = (Phase.STOPPING, Phase.SETTLING)


class DeviceControl(Protocol):
    """A device as the runner guards it."""

    @property
    def handle(self) -> Any:
        """What actions see as `ctx.device`."""

    def stop(self, now: float) -> None:
        """Call the stop routine."""

    def stopped(self) -> bool:
        """Whether the device is known to stand still and has taken all commands."""


class Runner:
    """Runs of one place: of one device, at most one at a time (besides those that start at once),
    or of none, any number.

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
        self._actions = actions
        self._clock = clock
        self._device = device
        self._refusing: Refusing | None = device if isinstance(device, Refusing) else None
        self._outlets = Outlets(streams or {})
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
        """Whether there is no run, nothing to report and no fence to look at."""
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
        """The callable of an action, imported once. Raises ImportError."""
        if action not in self._callables:
            self._callables[action] = resolve(self._actions[action].run)
        return self._callables[action]

    def take(self, now: float, order: Order) -> None:
        """Take an order. A run begins at the next `advance`."""
        if isinstance(order, Begin):
            self._begin(order)
        elif isinstance(order, Stop):
            if order.id in self._runs:
                self._stop(now, self._runs[order.id], order.cause, order.text)
        elif isinstance(order, Answered):
            any(run.context.answer(order) for run in self._runs.values() if run.context)
        elif isinstance(order, Hold):
            self._hold(now, order.frozen)

    def reports(self) -> list[Report]:
        """What happened since the last call, in order."""
        if not self._reports:
            return []
        reports, self._reports = self._reports, []
        return reports

    def _report(self, report: Report) -> None:
        self._reports.append(report)

    def due(self) -> float | None:
        """When `advance` has something to do at the latest (s), None if only something that comes
        in can matter."""
        if not self._runs:  # nor is a stream open
            return None
        held = self._held_since is not None
        times = [] if held else [self._outlets.due()]
        times += [run.due() for run in self._runs.values() if not held or run.phase in _AFTER]
        return min((t for t in times if t is not None), default=None)

    def advance(self, now: float) -> None:
        """Do all that is due: begin, go on, stop, end."""
        if self._fenced:
            self._look_at_fence()
        if not self._runs:  # nor is a stream open: a run closes its own when it ends
            return
        held = self._held_since is not None
        for run in list(self._runs.values()):
            if not held and run.phase not in _AFTER:
                self._lead(now, run)
            if run.phase is Phase.STOPPING:
                self._clean_up(now, run)
            if run.phase is Phase.SETTLING:
                self._settle(now, run)
        if not held:
            self._reports += self._outlets.advance(now)

    def commands_taken(self, now: float) -> None:
        """The driver has just been stepped: end the runs that only waited for it to take their last
        commands."""
        for run in [run for run in self._runs.values() if run.phase is Phase.TAKING]:
            self._await_taking(now, run)

    def give_up_all(self, now: float, cause: str, text: str) -> list[Report]:
        """The device is no more: how all runs end, without its stop routine."""
        ends: list[Report] = []
        for identity, run in self._runs.items():
            if fault := run.close():
                _log.warning("run %s did not let itself be closed: %s", identity, fault)
            self._outlets.close(identity)
            executed = Executed.NO if run.phase is Phase.NEW else Executed.UNKNOWN
            took = 0.0 if run.phase is Phase.NEW else now - run.started
            ends.append(Ended(identity, Status.ERROR, {}, cause, text, executed, took, run.cpu))
        self._runs.clear()
        return ends

    # --- begin --------------------------------------------------------------------------------

    def _begin(self, begin: Begin) -> None:
        entry = self._actions.get(begin.action)
        self._look_at_fence()
        if begin.id in self._runs:
            return
        if entry is None:
            self._refuse(begin, "unknown_service", f"no action {begin.action!r} here")
        elif self._fenced and not entry.at_once:
            self._refuse(
                begin, "fenced", "the device is not known to stand still after an earlier run"
            )
        elif busy := self._taken_by(entry):
            self._refuse(begin, "busy", f"the device is taken by run {busy}")
        else:
            self._runs[begin.id] = Execution(begin, entry)

    def _taken_by(self, entry: ActionEntry) -> str:
        if self._device is None:
            return ""
        return next(
            (i for i, run in self._runs.items() if not (entry.at_once and run.phase in _AFTER)), ""
        )

    def _refuse(self, begin: Begin, cause: str, text: str) -> None:
        self._reports.append(Ended(begin.id, Status.ERROR, {}, cause, text, Executed.NO))

    def _drop(self, run: Execution, cause: str, text: str) -> None:
        del self._runs[run.begin.id]
        self._refuse(run.begin, cause, text)

    def _start(self, now: float, run: Execution) -> None:
        begin, entry = run.begin, run.entry
        try:
            function = self.load(begin.action)
            arguments = plain({**entry.args, **begin.arguments}, "arguments")
            check_arguments(function, arguments)
        except ImportError as fault:
            log_fault(_log, fault, "%s cannot be imported", entry.run)
            self._drop(run, "import_failed", f"{entry.run}: {fault}")
            return
        except (TypeError, ValueError) as fault:
            self._drop(run, "bad_arguments", f"{begin.action}: {fault}")
            return
        handle = self._device.handle if self._device else None
        run.context = RunContext(begin, handle, self._clock, self._outlets, self._report)
        run.phase, run.started = Phase.RUNNING, now
        run.sent_before = self._refusing.sent if self._refusing is not None else 0
        run.limit = None if begin.deadline is None else now + begin.deadline
        self._in_action(now, run, lambda: run.call(function, arguments))

    # --- go on --------------------------------------------------------------------------------

    def _look_at_fence(self) -> None:
        if self._fenced and (self._device is None or self._device.stopped()):
            self._fenced = False

    def _lead(self, now: float, run: Execution) -> None:
        if run.phase is Phase.NEW:
            self._start(now, run)
        elif run.limit is not None and now >= run.limit:
            self._stop(now, run, "deadline", f"not over after {run.begin.deadline:g} s")
        elif run.phase is Phase.RUNNING:
            self._in_action(now, run, lambda: run.look(now))
        elif run.phase is Phase.TAKING:
            self._await_taking(now, run)
        elif run.result is not None and now >= run.ready_at - 1e-9:
            self._finish(now, run, run.result)

    def _in_action(self, now: float, run: Execution, step: Callable[[], None]) -> None:
        """Let the action's own code go on, and take what comes of it."""
        try:
            step()
        except Returned as returned:
            self._returned(now, run, returned.value)
        # an action may raise SystemExit or its like: that ends its run, not the others'
        except BaseException as fault:
            if from_outside(fault):
                raise
            run.close()
            if run.phase is not Phase.STOPPING:
                cause = "hung" if isinstance(fault, Hung) else "exception"
                if isinstance(fault, MemoryError):
                    cause = "out_of_memory"
                self._give_up(now, run, cause, self._with_refusal(run, describe(fault)))
                log_fault(_log, fault, "run %s of %s raised", run.begin.id, run.begin.action)
            elif not isinstance(fault, Cancelled):
                log_fault(_log, fault, "run %s raised while it cleaned up", run.begin.id)
                run.note(f"while it cleaned up: {describe(fault)}")
        if run.phase is Phase.STOPPING and run.over:
            run.phase = Phase.SETTLING

    def _returned(self, now: float, run: Execution, returned: Any) -> None:
        if run.phase is Phase.STOPPING:
            return
        if not isinstance(returned, Result):
            name = type(returned).__name__
            self._give_up(
                now, run, "bad_result", f"returned a {name}; return success(), failure() or error()"
            )
            return
        try:
            result = checked_result(run.begin.id, returned)
        except ValueError as fault:
            self._give_up(now, run, "bad_result", self._with_refusal(run, str(fault)))
            return
        if self._virtual and run.entry.compute_time > 0:
            run.phase, run.result, run.ready_at = (
                Phase.COMPUTED,
                result,
                now + run.entry.compute_time,
            )
        else:
            self._finish(now, run, result)

    def _finish(self, now: float, run: Execution, result: Result) -> None:
        """End the run as its action said, as soon as it is known that the driver has refused none
        of its commands."""
        if result.status is Status.ERROR:
            text = self._with_refusal(run, result.text)
            self._end(now, run, replace(result, text=text))
            return
        self._outlets.close(run.begin.id)
        run.phase, run.result, run.ready_at = Phase.TAKING, result, now + TAKEN_WITHIN
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
        """The text of an ERROR, and what the driver refused without the action's looking, or that
        it is silent: that is often the reason."""
        if self._refusing is None:
            return text
        if refusal := self._refusing.refusal(run.sent_before):
            text = f"{text}; the driver refused a command: {refusal}"
        if TAKEN_WITHIN < (age := self._refusing.age) < inf:
            text = f"{text}; the driver has published nothing for {age:.1f} s"
        return text.lstrip("; ")

    # --- end ----------------------------------------------------------------------------------

    @staticmethod
    def _give_up(now: float, run: Execution, cause: str, text: str) -> None:
        """The action broke: nobody leads its device any more, so the stop routine comes at once."""
        run.phase, run.cause, run.text, run.abandoned, run.limit = (
            Phase.SETTLING,
            cause,
            text,
            True,
            now,
        )

    def _stop(self, now: float, run: Execution, cause: str, text: str) -> None:
        if run.phase is Phase.NEW:
            self._drop(run, cause, text)
        elif run.phase not in _AFTER:
            text = self._with_refusal(run, text) if cause == "deadline" else text
            run.cause, run.text, run.result, run.limit = cause, text, None, now + GRACE
            # A held device stands without having been stopped: released, it would go on without its
            # run.
            run.abandoned = self.held
            self._outlets.close(run.begin.id)
            run.phase = Phase.SETTLING if run.over else Phase.STOPPING
            if not run.over:
                self._in_action(now, run, lambda: run.go_on(Cancelled(cause)))

    def _clean_up(self, now: float, run: Execution) -> None:
        assert run.limit is not None
        if now < run.limit:
            self._in_action(now, run, lambda: run.look(now))
            return
        run.phase, run.abandoned = Phase.SETTLING, True
        if fault := run.close():
            run.note(f"did not let itself be closed: {fault}")

    def _settle(self, now: float, run: Execution) -> None:
        """End the run when its device stands still; call the stop routine when its grace is
        over."""
        assert run.limit is not None
        self._outlets.close(run.begin.id)
        failed = Result(Status.ERROR, {}, run.cause, run.text)
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
            self._end(now, run, Result(Status.ERROR, {}, run.cause, run.text))

    def _end(self, now: float, run: Execution, result: Result) -> None:
        identity = run.begin.id
        self._outlets.close(identity)
        del self._runs[identity]
        said = (result.status, result.values, result.cause, result.text, Executed.YES)
        self._reports.append(Ended(identity, *said, now - run.started, run.cpu, result.deferred))

    def _hold(self, now: float, frozen: bool) -> None:
        """Freeze the runs, or let them go on with all their times moved by the pause."""
        if frozen:
            self._held_since = now if self._held_since is None else self._held_since
        elif self._held_since is not None:
            pause, self._held_since = now - self._held_since, None
            for run in self._runs.values():
                if run.phase in (Phase.RUNNING, Phase.COMPUTED):
                    run.postpone(pause)
