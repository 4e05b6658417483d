"""Translates the engine's orders into calls of nodes, and the nodes' replies into stimuli.

A sans-I/O machine; the calls are in its callers. It keeps every device fenced whose last run is not
known to have stopped. After a resume it asks the nodes for the runs that an earlier process gave
them (docs/semantics.md, section 12).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.engine import Instruction, State, Stimulus
from petrobot.coordinator.engine.instructions import (
    ArmTimer,
    CancelRun,
    DisarmTimer,
    HoldRun,
    HoldTimer,
    ReleaseRun,
    ReleaseTimer,
    StartRun,
)
from petrobot.coordinator.engine.stimuli import (
    Hold,
    Pause,
    RunEnded,
    RunHeld,
    RunStarted,
    StopConfirmed,
    StopFailed,
    TimerFired,
)
from petrobot.coordinator.task import Executed, Status
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol import messages
from petrobot.services.comm.protocol.messages import Answer, Call, Command, Outcome
from petrobot.services.comm.protocol.plain import NotPlainError

# Fences: devices that may still move although no run here leads them.

STOP_MARGIN: Final = 2.0
"""Time that a node's stop routine may take after a run's orphan time (s; docs/semantics.md,
cancel)."""
REBOOTED: Final = "rebooted"
FORGOTTEN: Final = "forgotten"
UNSURE: Final = frozenset({"lost", "no_answer", "not_accepted", "refused", REBOOTED, FORGOTTEN})
"""Causes after which a device may still be moving if executed = unknown.

The node has not reported that the run has stopped, or does not know how it ended. Or it is another
process, and the devices of the former one may still be in their stop routines.
"""
FOR_GOOD: Final = math.inf


class Fence(Struct, frozen=True):
    """A device is kept free because of a run, until a time (s) or until its node reports that the
    run has stopped."""

    run: str
    node: str
    until: float


class Fences:
    """By device."""

    def __init__(self) -> None:
        self._fences: dict[str, Fence] = {}

    def __contains__(self, device: str) -> bool:
        return device in self._fences

    def __len__(self) -> int:
        return len(self._fences)

    def __getitem__(self, device: str) -> Fence:
        return self._fences[device]

    def put(self, device: str, run: str, node: str, until: float) -> None:
        """Fence a device."""
        self._fences[device] = Fence(run, node, until)

    def after(self, cause: str, now: float, orphan_time: float | None) -> float:
        """Return until when a device is fenced whose run ended for this cause.

        A node that was lost stops the run by itself after the orphan time. A node that was started
        again, or has forgotten the run, does not execute it any more. A node that is connected and
        does not report that the run has stopped: there is no limit.
        """
        if cause == "no_answer":
            return FOR_GOOD
        return now + STOP_MARGIN + (0.0 if cause in (REBOOTED, FORGOTTEN) else orphan_time or 0.0)

    def lift(self, run: str) -> list[str]:
        """Note that the run has stopped, and return the devices that are free now."""
        devices = [device for device, fence in self._fences.items() if fence.run == run]
        for device in devices:
            del self._fences[device]
        return devices

    def rebooted(self, now: float, node: str) -> None:
        """Note that the node is another process: the runs of the former one ended with it, at the
        latest by the stop routines of its devices."""
        for device, fence in self._fences.items():
            if fence.node == node:
                self._fences[device] = Fence(fence.run, node, min(fence.until, now + STOP_MARGIN))

    def over(self, now: float) -> list[tuple[str, Fence]]:
        """Remove the fences whose time has passed, and return them with their devices."""
        found = [(device, fence) for device, fence in self._fences.items() if fence.until <= now]
        for device, _ in found:
            del self._fences[device]
        return found

    def due(self) -> float | None:
        """Return when the next fence ends, None if only a node can lift one."""
        soonest = min((fence.until for fence in self._fences.values()), default=FOR_GOOD)
        return soonest if soonest < FOR_GOOD else None


# Timers that the engine armed, on the coordinator's clock.


class _Timer(Struct):
    due: float
    held: float | None = None
    """Seconds left while it is held."""


class AfterTimers:
    """By key; times in seconds on the caller's clock."""

    def __init__(self) -> None:
        self._timers: dict[str, _Timer] = {}

    def __contains__(self, key: str) -> bool:
        return key in self._timers

    def __len__(self) -> int:
        return len(self._timers)

    def arm(self, now: float, key: str, seconds: float) -> None:
        """Arm a timer that elapses after `seconds`."""
        self._timers[key] = _Timer(now + seconds)

    def disarm(self, key: str) -> None:
        """Cancel a timer."""
        self._timers.pop(key, None)

    def hold(self, now: float, key: str) -> None:
        """Stop a timer and keep its remaining time."""
        if (timer := self._timers.get(key)) and timer.held is None:
            timer.held = max(0.0, timer.due - now)

    def release(self, now: float, key: str) -> None:
        """Let a timer continue with its remaining time."""
        if (timer := self._timers.get(key)) and timer.held is not None:
            timer.due, timer.held = now + timer.held, None

    def over(self, now: float) -> list[str]:
        """Remove and return the timers that have elapsed, the earliest first; of those that elapse
        together, the one that was armed first."""
        elapsed = {k: t for k, t in self._timers.items() if t.held is None and t.due <= now}
        keys = sorted(elapsed, key=lambda key: elapsed[key].due)
        for key in keys:
            del self._timers[key]
        return keys

    def due(self) -> float | None:
        """Return when the next timer elapses."""
        return min((t.due for t in self._timers.values() if t.held is None), default=None)


ESCALATION: Final = 3.0
"""Longest time that a node needs for the stop routine and the kill of a worker, after the run's own
time to stop (s)."""
RESUMED: Final = "resumed"
NO_BOOT: Final = "unknown"
"""Never the boot of a node: boots are hexadecimal numbers."""
_GIVEN_UP: Final = UNSURE | {RESUMED, "unreachable"}
"""Causes with which this side ends a run without a report of its node."""
_TIMERS: Final = (ArmTimer, DisarmTimer, HoldTimer, ReleaseTimer)


class Flight(Struct):
    """A run that was handed to a node (or waits for its device's fence); `begun` is when the engine
    ordered it (s)."""

    start: StartRun
    node: str
    device: str
    begun: float
    waits: bool = False
    """For the fence of its device."""
    cancelled: bool = False
    boot: str = ""
    """The boot of its node that an earlier process may have called already; empty: no process
    has."""
    abandon: bool = False
    """If its node reports that it is still active, it is ended here: its action's `on_resume` is
    `error`."""

    @property
    def if_unsent(self) -> Executed:
        """Whether it was executed, if this process never sends it."""
        return Executed.UNKNOWN if self.boot else Executed.NO


class Dispatch:
    """Hands runs to nodes. `callers` has one caller for each node of the directory; call ids are
    `mission/run`."""

    def __init__(
        self, directory: Directory, callers: Mapping[str, Caller], mission: str, seed: int
    ) -> None:
        self.directory = directory
        self.callers = callers
        self.flights: dict[str, Flight] = {}
        self._mission = mission
        self._seed = seed
        self._fences = Fences()
        self._parting: dict[str, Flight] = {}
        """Runs that this side has finished or is stopping, and whose node has not reported that
        they stopped."""
        self._timers = AfterTimers()
        self._commands: dict[str, str] = {}
        self._command_count = 0
        self._boots: dict[str, str] = {}
        self._kept: dict[str, Sequence[str]] = {}
        """By node: runs that it still knew when it welcomed us and that have not been handled
        yet."""
        self._earlier: dict[str, tuple[StartRun, str]] = {}
        """Runs that an earlier process started, with the boot of their node as it was then."""
        self._accepted: set[str] = set()
        """Runs that their node had accepted in an earlier process."""
        self._settled: dict[str, bool] = {}
        """Runs that ended in an earlier process, and whether their node reported that."""
        self._orders: Mapping[type, Callable[[float, Any], list[Stimulus]]] = {
            StartRun: self._start,
            CancelRun: self._cancel,
            HoldRun: lambda now, order: self._command(now, order.run, "hold"),
            ReleaseRun: self._release,
            **dict.fromkeys(_TIMERS, self._timer),
        }

    def carries_out(self, instruction: Instruction) -> bool:
        """Whether it is an order for this room."""
        return type(instruction) in self._orders

    def carry_out(self, now: float, order: Instruction) -> list[Stimulus]:
        """Carry out an order, and return the stimuli that follow at once."""
        return self._orders[type(order)](now, order)

    def moves_hardware(self, order: Instruction) -> bool:
        """Return whether the order reaches a device."""
        if isinstance(order, StartRun):
            entry = self.directory.actions.get(order.action)
            return entry is not None and bool(entry.device)
        if isinstance(order, CancelRun | HoldRun | ReleaseRun):
            flight = self.flights.get(order.run)
            return flight is not None and bool(flight.device)
        return False

    def call_id(self, run: str) -> str:
        """Return the id of a run's call, which is never used again."""
        return f"{self._mission}/{run}"

    def run_of(self, call: str) -> str | None:
        """Return the active run of a call; None if there is none."""
        run = call.removeprefix(self._mission + "/")
        return run if run in self.flights else None

    @property
    def asked(self) -> bool:
        """Return whether a node's answer to a hold is missing."""
        return bool(self._commands)

    # --- orders -------------------------------------------------------------------------------

    def _start(self, now: float, start: StartRun) -> list[Stimulus]:
        entry = self.directory.actions.get(start.action)
        if entry is None:
            text = f"{self.directory.source}: no node offers {start.action}"
            return [RunEnded(start.run, Status.ERROR, "not_offered", text, Executed.NO)]
        flight = self.flights[start.run] = Flight(start, entry.node, entry.device, now)
        if entry.device in self._fences and not entry.at_once:
            flight.waits = True
            return []
        return self._call(now, flight)

    def _call(self, now: float, flight: Flight) -> list[Stimulus]:
        """Call the action of a run. Return its end if its arguments cannot be sent."""
        flight.waits = False
        start, boot = flight.start, flight.boot
        arguments = {**self.directory.actions[start.action].args, **start.arguments}
        call = Call(
            self.call_id(start.run),
            start.action,
            arguments,
            start.deadline,
            boot=boot,
            seed=self._seed,
        )
        try:
            self.callers[flight.node].call(now, replace(call, again=bool(boot)))
        except NotPlainError as fault:
            del self.flights[start.run]
            return [
                RunEnded(start.run, Status.ERROR, "bad_arguments", str(fault), flight.if_unsent)
            ]
        return []

    def _cancel(self, now: float, cancel: CancelRun) -> list[Stimulus]:
        flight = self.flights.get(cancel.run)
        if flight is None or flight.waits:
            self.flights.pop(cancel.run, None)
            return [StopConfirmed(cancel.run, Executed.NO if flight is None else flight.if_unsent)]
        flight.cancelled = True
        within = cancel.within + ESCALATION
        self.callers[flight.node].cancel(now, self.call_id(cancel.run), cancel.reason, within)
        return []

    def _release(self, now: float, release: ReleaseRun) -> list[Stimulus]:
        flight = self.flights.get(release.run)
        # The answer to a hold that comes after its release holds nothing any more.
        self._commands = {key: run for key, run in self._commands.items() if run != release.run}
        if flight is not None:
            self.callers[flight.node].release(now, self.call_id(release.run))
        return self._command(now, release.run, "release")

    def _command(self, now: float, run: str, verb: str) -> list[Stimulus]:
        flight = self.flights.get(run)
        if flight is None:
            return []
        self._command_count += 1
        epoch = self.callers[flight.node].hello.epoch  # a resumed run counts from 1 again
        key = f"{self._mission}/{epoch}/{verb}#{self._command_count}"
        if verb == "hold":
            self._commands[key] = run
        self.callers[flight.node].command(
            now, Command(key, verb, flight.device, {"run": self.call_id(run)})
        )
        return []

    def _timer(
        self, now: float, order: ArmTimer | DisarmTimer | HoldTimer | ReleaseTimer
    ) -> list[Stimulus]:
        if isinstance(order, ArmTimer):
            self._timers.arm(now, order.key, order.seconds)
        elif isinstance(order, DisarmTimer):
            self._timers.disarm(order.key)
        elif isinstance(order, HoldTimer):
            self._timers.hold(now, order.key)
        else:
            self._timers.release(now, order.key)
        return []

    # --- what nodes say -----------------------------------------------------------------------

    def accepted(self, now: float, call: str) -> list[Stimulus]:
        """Note that the node accepted a call, or reports that its run is active."""
        run = self.run_of(call)
        if run is None:
            return []
        return self._abandon(now, run) if self.flights[run].abandon else [RunStarted(run)]

    def ended(self, now: float, outcome: Outcome) -> list[Stimulus]:
        """Handle the end of a call, reported by its node or decided by this side."""
        run = self.run_of(outcome.id)
        if run is None:
            return self.late(now, outcome) if self._parted(outcome) else []
        flight = self.flights.pop(run)
        if outcome.cause not in UNSURE or Executed(outcome.executed) is not Executed.UNKNOWN:
            return [_run_ended(run, outcome)]
        if flight.device:
            orphan_time = self.directory.actions[flight.start.action].orphan_time
            until = self._fences.after(outcome.cause, now, orphan_time)
            self._fences.put(flight.device, run, flight.node, until)
            self._parting[run] = flight
        if not flight.cancelled:
            return [_run_ended(run, outcome)]
        if outcome.cause == "no_answer":
            return [
                StopFailed(
                    run, f"{outcome.text}, neither by its stop routine nor by the end of its worker"
                )
            ]
        return [] if flight.device else [_run_ended(run, outcome)]

    def _parted(self, outcome: Outcome) -> bool:
        """Return whether this is a node's report, not a decision of this side, that a run which was
        given up here has ended."""
        return (
            outcome.id.removeprefix(self._mission + "/") in self._parting
            and outcome.cause not in _GIVEN_UP
        )

    def late(self, now: float, outcome: Outcome) -> list[Stimulus]:
        """Handle a node's report on a run that has already ended here: it is recorded, moves no
        token, and frees the device."""
        run = outcome.id.removeprefix(self._mission + "/")
        if run == outcome.id or "#" not in run:
            return []
        self._parting.pop(run, None)
        stimuli: list[Stimulus] = [_run_ended(run, outcome)]
        for device in self._fences.lift(run):
            stimuli += self._go_on(now, device)
        return stimuli

    def answered(self, now: float, answer: Answer) -> list[Stimulus]:
        """Handle the answer to a hold. A node that does not answer has not said that its device
        cannot hold."""
        run = self._commands.pop(answer.id, None)
        flight = self.flights.get(run) if run is not None else None
        if run is None or flight is None or (not answer.ok and "cause" in answer.data):
            return []
        said = str(answer.data.get("answers", {}).get(flight.device or flight.node, "")).replace(
            " ", "_"
        )
        known = {Hold.HELD.value: Hold.HELD, Hold.STOPPED.value: Hold.STOPPED}
        held = known.get(said, Hold.CANNOT) if answer.ok else Hold.CANNOT
        if held is Hold.HELD:
            self.callers[flight.node].hold(now, self.call_id(run))
        return [RunHeld(run, held)]

    def back(self, now: float, node: str, boot: str, runs: Sequence[str]) -> None:
        """Handle a node's WELCOME; `runs` are the ids that it still knows."""
        if self._boots.get(node, boot) != boot:
            self._fences.rebooted(now, node)
        self._boots[node] = boot
        self._kept[node] = runs

    # --- time ---------------------------------------------------------------------------------

    def advance(self, now: float) -> list[Stimulus]:
        """Handle what has elapsed: timers, fences, and the patience of runs that wait for one."""
        stimuli: list[Stimulus] = [TimerFired(key) for key in self._timers.over(now)]
        for device, fence in self._fences.over(now):
            flight = self._parting.pop(fence.run, None)
            if flight is not None and flight.cancelled:
                stimuli.append(StopConfirmed(fence.run, Executed.UNKNOWN))
            stimuli += self._go_on(now, device)
        for run, flight in [
            (r, f) for r, f in self.flights.items() if f.waits and now >= f.begun + f.start.deadline
        ]:
            del self.flights[run]
            text = (
                f"{flight.device} is not known to stand still after "
                f"{self._fences[flight.device].run}"
            )
            stimuli.append(RunEnded(run, Status.ERROR, "device_fenced", text, flight.if_unsent))
        return stimuli

    def _go_on(self, now: float, device: str) -> list[Stimulus]:
        """Start the run that waited for a device which is free now."""
        waiting = [f for f in self.flights.values() if f.waits and f.device == device]
        return [stimulus for flight in waiting for stimulus in self._call(now, flight)]

    @property
    def idle(self) -> bool:
        """Whether time alone changes nothing: there is no timer and no fence (so no run waits for
        one)."""
        return not self._timers and not self._fences

    def due(self) -> float | None:
        """Return when `advance` is needed next."""
        times = [self._timers.due(), self._fences.due()]
        times += [
            flight.begun + flight.start.deadline for flight in self.flights.values() if flight.waits
        ]
        return min((t for t in times if t is not None), default=None)

    # --- after a resume -----------------------------------------------------------------------

    def replay(
        self,
        now: float,
        stimulus: Stimulus,
        instructions: Iterable[Instruction],
        boots: Mapping[str, str],
    ) -> None:
        """Replay a step that an earlier process took at `now`: its timers and fences still
        count."""
        self._boots.update(boots)
        if isinstance(stimulus, TimerFired):
            self._timers.disarm(stimulus.key)
        elif isinstance(stimulus, RunStarted):
            self._accepted.add(stimulus.run)
        elif isinstance(stimulus, RunEnded | StopConfirmed):
            self._replay_end(now, stimulus)
        elif isinstance(stimulus, StopFailed):
            self._replay_fence(now, stimulus.run, "no_answer")
        for instruction in instructions:
            if isinstance(instruction, _TIMERS):
                self.carry_out(now, instruction)
            elif isinstance(instruction, StartRun):
                entry = self.directory.actions.get(instruction.action)
                self._earlier[instruction.run] = (
                    instruction,
                    boots.get(entry.node, "") if entry else "",
                )

    def _replay_end(self, now: float, end: RunEnded | StopConfirmed) -> None:
        cause = end.cause if isinstance(end, RunEnded) else ""
        unsure = isinstance(end, RunEnded) and cause in UNSURE and end.executed is Executed.UNKNOWN
        self._settled[end.run] = cause not in _GIVEN_UP
        self._parting.pop(end.run, None)
        self._fences.lift(end.run)
        if unsure:
            self._replay_fence(now, end.run, cause)

    def _replay_fence(self, now: float, run: str, cause: str) -> None:
        start, _ = self._earlier.get(run, (None, ""))
        entry = self.directory.actions.get(start.action) if start is not None else None
        if start is not None and entry is not None and entry.device:
            self._parting[run] = Flight(
                start, entry.node, entry.device, now, cancelled=cause == "no_answer"
            )
            self._fences.put(
                entry.device, run, entry.node, self._fences.after(cause, now, entry.orphan_time)
            )

    def adopt(self, now: float, orders: Iterable[Instruction], state: State) -> list[Stimulus]:
        """Carry out again the orders that an earlier process left open, and handle what the nodes
        still keep of its runs."""
        stimuli = self.advance(now)
        for order in orders:
            if isinstance(order, StartRun):
                stimuli += self._rejoin(now, order)
            elif isinstance(order, CancelRun):
                stimuli += self._cancel_again(now, order, state)
            elif self.carries_out(order) and not (
                isinstance(order, ArmTimer | HoldTimer) and order.key in self._timers
            ):
                stimuli += self.carry_out(now, order)
        for node in list(self._kept):
            self.settle(now, node)
        return stimuli

    def settle(self, now: float, node: str) -> None:
        """Of the runs that a node keeps for this mission run, stop those that are not needed, and
        let it forget the others."""
        caller = self.callers[node]
        for id_ in self._kept.pop(node, ()):
            run = id_.removeprefix(self._mission + "/")
            if run == id_ or "#" not in run or run in self.flights:
                continue
            if self._settled.get(run, False):
                caller.acknowledge(now, id_)
            elif run in self._settled or run in self._parting or run not in self._earlier:
                caller.disown(now, id_)

    def _rejoin(self, now: float, start: StartRun) -> list[Stimulus]:
        """Ask for a run under its old id: the node continues it or returns its stored result;
        another boot answers unknown."""
        entry = self.directory.actions.get(start.action)
        if entry is None:
            return self._start(now, start)
        stimuli = self._ask_again(now, start)
        if start.run in self.flights:
            self.flights[start.run].abandon = entry.on_resume == "error"
            if entry.on_resume == "ask":
                stimuli.append(
                    Pause(f"{start.action} was active when the coordinator ended: continue it?")
                )
        return stimuli

    def _ask_again(self, now: float, start: StartRun, stopping: bool = False) -> list[Stimulus]:
        """Call a run again that an earlier process may have called. A run that its node had
        accepted and neither executes nor keeps was forgotten there: it ends without a call."""
        entry = self.directory.actions[start.action]
        present, id_ = self.callers[entry.node].boot, self.call_id(start.run)
        known = id_ in self._kept.get(entry.node, ())
        boot = present if known else self._earlier.get(start.run, (start, ""))[1]
        flight = Flight(
            start, entry.node, entry.device, now, cancelled=stopping, boot=boot or NO_BOOT
        )
        self.flights[start.run] = flight
        if not known and boot == present and start.run in self._accepted:
            text = f"{entry.node} had accepted it and keeps neither the run nor its result any more"
            return self.ended(
                now, Outcome(id_, Status.ERROR, {}, FORGOTTEN, text, messages.Executed.UNKNOWN)
            )
        if entry.device in self._fences and not entry.at_once and not known:
            flight.waits = True
            return []
        return self._call(now, flight)

    def _abandon(self, now: float, run: str) -> list[Stimulus]:
        flight = self.flights.pop(run)
        self.callers[flight.node].cancel(now, self.call_id(run), RESUMED)
        if flight.device:
            self._parting[run] = flight
            self._fences.put(flight.device, run, flight.node, FOR_GOOD)
        text = (
            f"the coordinator ended while it went on, and {flight.start.action} is not to "
            "be rejoined"
        )
        return [RunEnded(run, Status.ERROR, RESUMED, text, Executed.YES)]

    def _cancel_again(self, now: float, cancel: CancelRun, state: State) -> list[Stimulus]:
        run = state.run(cancel.run)
        if run is None or run.action not in self.directory.actions:
            return self._cancel(now, cancel)
        primitive = self._earlier[run.id][0].primitive_task if run.id in self._earlier else ""
        # Asked for under its old id only to receive its end.
        start = StartRun(run.id, run.place, primitive, run.action, run.arguments, cancel.within)
        stimuli = self._ask_again(now, start, stopping=True)
        return self._cancel(now, cancel) if run.id in self.flights else stimuli


def _run_ended(run: str, outcome: Outcome) -> RunEnded:
    return RunEnded(
        run,
        Status(outcome.status),
        outcome.cause,
        outcome.text,
        Executed(outcome.executed),
        dict(outcome.values),
        outcome.seconds,
        outcome.deferred and Executed(outcome.executed) is Executed.YES,
        outcome.cpu_seconds or None,
    )
