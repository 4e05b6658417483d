"""A node as one sans-I/O state machine, for lock step and real time: its offers, the hosts of its
runs, its memory, timers and calls."""

from __future__ import annotations

import dataclasses
import inspect
import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.services.action import Status
from petrobot.services.comm.calls.callee import (
    DEADLINE,
    ORPHAN,
    Callee,
    Inline,
    Offer,
    Order,
)
from petrobot.services.comm.calls.caller import Caller, Notice
from petrobot.services.comm.calls.events import STOP_EVENT
from petrobot.services.comm.calls.link import LinkTiming
from petrobot.services.comm.calls.peers import NODE
from petrobot.services.comm.location_file import (
    MEMORY,
    MEMORY_CALLS,
    ActionEntry,
    Directory,
    DirectoryError,
    ServiceEntry,
    resolve,
)
from petrobot.services.comm.protocol.messages import (
    COORDINATOR,
    LATCHED,
    LEASE,
    SEED,
    STOPS,
    Answer,
    Call,
    Cancel,
    Command,
    Event,
    Executed,
    Hello,
    Outcome,
    split_boot,
)
from petrobot.services.comm.protocol.wire import NEWEST_VERSION, OLDEST_VERSION
from petrobot.services.device import PICTURE
from petrobot.services.host.emergency_latch import Latch
from petrobot.services.node.emergency_stops import NEVER, EmergencyStops, Write, write_at_once
from petrobot.services.node.inline_host import Host, InlineHost
from petrobot.services.node.memory import GlobalMemory, event_name
from petrobot.services.node.watchdog import UNWATCHED, Watchdog
from petrobot.services.worker.callables import (
    check_arguments,
    describe,
    from_outside,
    log_fault,
)
from petrobot.services.worker.context import Report, RunContext, checked_result, outcome_of
from petrobot.services.worker.remote import CLEAR_EMERGENCY, EMERGENCY_STOP, IN_EMERGENCY
from petrobot.services.worker.runner import Hung, stop_reason
from petrobot.services.worker.setpoints import Outlets, Sent

_log = logging.getLogger(__name__)

SLACK = 1e-6
"""Rounding (s) by which a pulse may be early; without it a period that is not a binary fraction
would cost a whole tick."""


class EventTimers:
    """External pulse events at fixed times: start + k * period, where start is the time of the
    first `advance`. So they do not drift, and load does not move them. Pulses that are missed while
    the process stands still are left out.
    """

    def __init__(self, periods: Mapping[str, float]) -> None:
        self._periods = dict(periods)
        self._next: dict[str, float] = {}
        self._soonest = -math.inf if self._periods else math.inf

    def advance(self, now: float) -> list[str]:
        """Return the names whose pulse is due, in the order of services.toml."""
        fired: list[str] = []
        if now + SLACK < self._soonest:
            return fired
        for name, period in self._periods.items():
            due = self._next.setdefault(name, now + period)
            if now + SLACK < due:
                continue
            self._next[name] = due + period * (1 + math.floor((now + SLACK - due) / period))
            fired.append(name)
        self._soonest = min(self._next.values())
        return fired

    def due(self) -> float | None:
        """Return when the next pulse is due (s), None without timers."""
        return min(self._next.values(), default=None)


def inline_service(
    service: ServiceEntry,
    raised: Callable[[Event], None],
    watch: AbstractContextManager[None] = UNWATCHED,
) -> Inline:
    """Return a service that is a plain function and is answered in the node's loop. Raises
    ImportError if the function cannot be loaded.

    The function gets a context and keyword arguments, like an action; it must not use what waits.
    `raised` is called with its events and with its verdicts on earlier runs. `watch` is entered
    while it is executed.
    """
    function = resolve(service.run)

    def report(told: Report) -> None:
        if isinstance(told, Event):
            raised(replace(told, run=""))  # an external event: a service is not a run

    def answer(now: float, call: Call) -> Outcome:
        context = RunContext(
            Call(call.id, service.name, call.arguments), None, lambda: now, Outlets({}), report
        )
        try:
            check_arguments(function, call.arguments)
        except TypeError as fault:
            return Outcome(
                call.id, Status.ERROR, {}, "bad_arguments", f"{service.name}: {fault}", Executed.NO
            )
        before = time.process_time()
        try:
            with watch:
                result = function(context, **call.arguments)
        except BaseException as fault:  # SystemExit of a service must not end the node
            if from_outside(fault):
                raise
            log_fault(_log, fault, "call %s of service %s raised", call.id, service.name)
            cause = "hung" if issubclass(type(fault), Hung) else "exception"
            return Outcome(call.id, Status.ERROR, {}, cause, describe(fault))
        try:
            outcome = checked_result(call.id, result, "values")
        except ValueError as fault:
            text = f"what it returned cannot be sent: {fault}"
            return Outcome(call.id, Status.ERROR, {}, "bad_result", text)
        return replace(outcome, cpu_seconds=time.process_time() - before)

    return answer


GENERAL = ""
"""Key of the host of actions that need no device."""
LOOP = "*"
"""Key of the host of services that wait, in the node's own loop."""
STREAM_PREFIX = "stream:"
"""The service that gives a stream's address is named by this and the stream's name."""
SENDERS = frozenset((COORDINATOR, NODE))
"""Roles that may ask for the ticket of a stream: actions on nodes send set points, and a
coordinator may order anything."""
ACCEPT_AFTER = 0.02
"""How long ACCEPT is held back in real time (s): the result of a quick action makes it superfluous.
Less would cost quick actions more timers; people do not notice so little. In lock step it is sent
at once."""
ANSWER_WITHIN = 1.0
"""Time in which the devices must answer an operator's command (s)."""
VERBS = frozenset(
    {"hold", "release", "stop", "status", PICTURE, EMERGENCY_STOP, CLEAR_EMERGENCY, LEASE, SEED}
)
"""Verbs of a COMMAND."""
_OWN_CAUSES = (DEADLINE, ORPHAN, EMERGENCY_STOP)
_WELL_HELD = ("held", "stopped")
MISSED = (
    "an emergency stop was given and cleared after this caller had connected: nothing that began "
    "before it moves a device"
)
"""Why a device is refused to a caller that does not know of a stop."""


class _Commanded(Struct):
    """An operator's command that has not been answered: the answers so far, and the hosts whose
    answers are missing."""

    verb: str
    due: float
    missing: set[str]
    answers: dict[str, str] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)
    note: str = ""
    """A remark for the operator."""
    storing: bool = False
    """Whether it is being written to disk: only then it is answered, however long that takes."""


class Node:
    """All of a node except sockets, processes and the clock.

    A shell passes incoming messages to `callee` and `callers` (one for each peer) and sends their
    outgoing ones. `places` are the hosts by device, `GENERAL` for actions without a device.
    `advance(now)` does all that is due; `due()` says when it is needed next.
    """

    def __init__(
        self,
        directory: Directory,
        name: str,
        *,
        boot: str,
        clock: Callable[[], float],
        places: Mapping[str, Host],
        virtual: bool = False,
        connect: Callable[[str], None] | None = None,
        stream_address: Callable[[str], Mapping[str, Any] | None] | None = None,
        latch: Latch | None = None,
        in_order: Write = write_at_once,
    ) -> None:
        """`connect(peer)` is called before the first call to a peer; `stream_address(stream)` gives
        the address at which this node receives a set-point stream; `latch` keeps an emergency stop
        over a restart, and `in_order` writes it."""
        self.directory = directory
        self.name = name
        self.boot = boot
        self.scripted = False
        """Whether a script (`--mock`) replaces actions of this node."""
        self.code: Mapping[str, str] = {}
        """Digest of the source of each module that it was started with (`sources`)."""
        # In lock step the whole step of the node is watched.
        self._watch = UNWATCHED if virtual else Watchdog(name, LinkTiming().silence)
        services = [s for s in directory.services.values() if s.node == name and s.run]
        waiting = {
            s.name: ActionEntry(s.name, s.run, "", s.node)
            for s in services
            if inspect.iscoroutinefunction(resolve(s.run))
        }
        self.places: dict[str, Host] = {
            **places,
            LOOP: InlineHost(waiting, clock=clock, virtual=virtual, watch=self._watch),
        }
        self.memory = GlobalMemory(self._memory_changed)
        self._connect = connect
        self._stream_address = stream_address
        self.callee = Callee(
            name,
            boot,
            self._offers(waiting),
            directory=directory.hash,
            accept_after=0.0 if virtual else ACCEPT_AFTER,
        )
        self.callers: dict[str, Caller] = {}
        self.sent: list[tuple[str, Sent]] = []
        """Set points that inline hosts sent since the shell looked, with the action that published
        them."""
        self._timers = EventTimers(
            {t.name: t.period for t in directory.timers.values() if t.node == name}
        )
        self._now = 0.0
        self._clock = clock
        self._commands: dict[str, _Commanded] = {}
        self._stops = EmergencyStops(
            [key for key in self.places if key not in (LOOP, GENERAL)],
            latch,
            in_order,
        )
        self._stop_places(0.0, self._stops.at_start())
        self.callee.stops = self._stops.cleared
        if latch is not None:  # lock step knows no time but its own
            self.callee.since_cleared = self._stops.since_cleared

    def _offers(self, waiting: Mapping[str, ActionEntry]) -> dict[str, Offer]:
        offers = {
            a.name: Offer(device=a.device, orphan_time=a.orphan_time, deadline=a.deadline)
            for a in self.directory.actions.values()
            if a.node == self.name
        }
        for service in self.directory.services.values():
            if service.node == self.name:
                scope = "local" if service.local else "network"
                offers.update(self._service_offers(service, scope, service.name in waiting))
        if self._stream_address is not None:
            streams = [s for s in self.directory.streams if self.directory.where(s) == self.name]
            offers.update(
                {stream_service(s): Offer(inline=self._stream_call, roles=SENDERS) for s in streams}
            )
        return offers

    def _service_offers(self, service: ServiceEntry, scope: str, waits: bool) -> dict[str, Offer]:
        if service.name == MEMORY and not service.run:
            return {call: Offer(scope, inline=self._memory_call) for call in MEMORY_CALLS}
        if waits or not service.run:
            return {service.name: Offer(scope)}
        inline: Inline = inline_service(service, self._raise, self._watch)
        return {service.name: Offer(scope, inline=inline)}

    def caller(self, peer: str) -> Caller:
        """Return the caller for a peer; it is made at the first use."""
        if peer not in self.callers:
            self.callers[peer] = Caller(peer, self.hello(), auto_ack=True)
            if self._connect is not None:
                self._connect(peer)
        return self.callers[peer]

    def hello(self) -> Hello:
        """Return the HELLO of this node to a peer."""
        return Hello(
            OLDEST_VERSION, NEWEST_VERSION, "node", self.name, self.boot, 0, self.directory.hash
        )

    def action_of(self, run: str) -> str:
        """Return the action or service of an active run; the node's name if there is none."""
        return self.callee.service_of(run) or self.name

    def _host_of(self, service: str) -> str:
        """Return the key of the host that runs an action or a service."""
        action = self.directory.actions.get(service)
        return LOOP if action is None else action.device or GENERAL

    # --- time ---------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Do all that is due: orders of callers, runs, devices, timers, and their results."""
        self._now = now
        if now >= self._stops.due:
            self._look_for_stops(now)
        self._advance_ends(now)
        self.obey(now, self.callee.orders())
        self._answer_runs(now)
        self.advance_places(now)
        self.settle(now)

    def advance_places(self, now: float) -> bool:
        """Advance only timers, runs and devices, and return whether they reported anything.

        While no message arrives and `ends_quiet` holds, `advance` does no more than this; so a
        shell that knows may call this instead, and `settle` if there were reports.
        """
        self._now = now
        news = False
        for name in self._timers.advance(now):
            self.callee.raise_event(now, name, source=name)
            news = True
        for key, place in self.places.items():
            if place.idle:
                continue
            place.advance(now)
            for report in place.reports():
                self._take_report(now, key, report)
                news = True
        return news

    def take_reports(self, now: float) -> None:
        """Take the reports of runs and devices, and nothing else: for a shell that knows that only
        results of runs arrived."""
        self._now = now
        for key, place in self.places.items():
            if not place.idle:
                for report in place.reports():
                    self._take_report(now, key, report)

    def settle(self, now: float) -> None:
        """Answer runs and commands after `advance_places` returned True."""
        self._answer_runs(now)
        self._answer_commands(now)

    def ends_quiet(self, now: float) -> bool:
        """Return whether no call, no command and no emergency stop is due yet."""
        if self._commands or now >= self.callee.soonest or now >= self._stops.due:
            return False
        for caller in self.callers.values():  # noqa: SIM110 - `all` takes twice as long
            if now >= caller.soonest:
                return False
        return True

    def _advance_ends(self, now: float) -> None:
        """Advance callee and callers that are due; calling `due` keeps their `soonest` up to
        date."""
        ends: tuple[Callee | Caller, ...] = (self.callee, *self.callers.values())
        for end in ends:
            if now >= end.soonest:
                end.advance(now)
                end.due()

    def due(self) -> float | None:
        """Return when `advance` is needed at the latest (s), None if only a message can make it
        necessary. Callee and callers are left out: server and clients have timers of their own."""
        # A plain loop: lists of times cost as much as the rest.
        soonest = self._stops.due
        for command in self._commands.values():
            if not command.storing:
                soonest = min(soonest, command.due)
        due = self._timers.due()
        if due is not None and due < soonest:
            soonest = due
        for place in self.places.values():
            due = place.due()
            if due is not None and due < soonest:
                soonest = due
        return soonest if soonest < NEVER else None

    def close(self, now: float) -> None:
        """Run the stop routines of all devices, and close them."""
        for place in self.places.values():
            place.close(now)

    # --- orders of callers --------------------------------------------------------------------

    def obey(self, now: float, orders: Iterable[Order]) -> None:
        """Carry out what the callee orders."""
        for order in orders:
            if isinstance(order, Call):
                self._start(now, order)
            elif isinstance(order, Cancel):
                cause = order.reason if order.reason in _OWN_CAUSES else "cancelled"
                service = self.callee.service_of(order.id)
                if service is not None:
                    own = cause in (DEADLINE, ORPHAN)
                    text = self.callee.why_stopped(order.id, cause) if own else order.reason
                    stop = Cancel(order.id, stop_reason(cause, text))
                    self.places[self._host_of(service)].take(now, stop)
            else:
                self._command(now, order)

    def _start(self, now: float, call: Call) -> None:
        key = self._host_of(call.service)
        if key not in (LOOP, GENERAL):  # a look opens files; what has no device needs none
            self._look_for_stops(now)
            missed = bool(call.boot) and split_boot(call.boot)[1] != self._stops.cleared
            if key in self._stops or missed:
                _log.info("run %s of %s refused: %s", call.id, call.service, EMERGENCY_STOP)
                text = IN_EMERGENCY if key in self._stops else MISSED
                refused = (self._latched(key), EMERGENCY_STOP, text, Executed.NO)
                self.callee.finish(now, Outcome(call.id, Status.ERROR, *refused))
                return
        _log.info("run %s of %s started", call.id, call.service)
        self.places[key].take(now, call)

    def _command(self, now: float, command: Command) -> None:
        keys = [k for k in self.places if k != LOOP and command.target in ("", k or self.name)]
        if command.verb == SEED:
            keys = [k for k in keys if k in self.directory.without_actions(self.name)]
        quiet = command.verb in ("status", PICTURE, SEED)
        level = logging.DEBUG if quiet else logging.INFO
        peer = self.callee.commander(command.id)
        _log.log(level, "%s orders %s of %s", peer, command.verb, command.target or "all")
        if command.verb not in VERBS:
            self.callee.answer(
                now,
                command.id,
                False,
                {"cause": "unknown_verb", "text": f"no verb {command.verb!r}"},
            )
        elif command.verb == SEED and type(command.data.get(SEED)) is not int:
            text = "data: expected {seed: an integer}"
            self.callee.answer(now, command.id, False, {"cause": "bad_arguments", "text": text})
        elif command.verb == "hold" and self._has_ended(command.data.get("run")):
            self.callee.answer(now, command.id, True, {"answers": {}})
        elif not keys and command.target:
            text = f"{self.name} has no device {command.target!r}"
            self.callee.answer(now, command.id, False, {"cause": "unknown_device", "text": text})
        elif command.verb == LEASE:
            self._look_for_stops(now)
            refused = (self._refused_lease(now, command.id, k) for k in keys if k != GENERAL)
            cause, text = next(filter(None, refused), ("", ""))
            told = {"cause": cause, "text": text} if cause else {}
            self.callee.answer(now, command.id, not cause, told)
        else:
            if command.verb == CLEAR_EMERGENCY:
                self._look_for_stops(now)  # what is cleared unseen would end no run
                self._stops.clear(keys, lambda why: self._cleared(command, keys, why))
                return
            self._pass_on(now, command, keys)
            devices = [key for key in keys if key != GENERAL]
            if command.verb == EMERGENCY_STOP and devices:
                # the devices first, the disk then; both before the answer
                self._commands[command.id].storing = True
                self._stops.stop(devices, lambda why: self._stored(command.id, why))
                self.callee.tell_coordinators(STOP_EVENT)

    def _pass_on(self, now: float, command: Command, keys: Iterable[str], note: str = "") -> None:
        """Give a command to these hosts; it is answered when they have, or with the time."""
        due = now + ANSWER_WITHIN
        self._commands[command.id] = _Commanded(command.verb, due, set(keys), note=note)
        for key in keys:
            self.places[key].command(now, command)

    def _stored(self, id_: str, why: str) -> None:
        """An emergency stop is on disk, or cannot be stored."""
        self._commands[id_].storing, self._commands[id_].note = False, why

    def _cleared(self, command: Command, keys: Iterable[str], why: str) -> None:
        """An emergency stop is cleared on disk, or cannot be."""
        now = self._clock()
        self.callee.stops = self._stops.cleared
        if why:
            note = f"NOT CLEARED: {why}; its devices stay stopped"
            self.callee.answer(now, command.id, False, {"answers": {}, "note": note})
            return
        again = ", ".join(key for key in keys if key in self._stops)
        note = f"NOT CLEARED: {again}: another emergency stop was given meanwhile" if again else ""
        self._pass_on(now, command, [key for key in keys if key not in self._stops], note)

    def _refused_lease(self, now: float, id_: str, device: str) -> tuple[str, str] | None:
        """Give a device to the caller of a command. Return why not: cause and text; None if it has
        it."""
        if device in self._stops:
            return EMERGENCY_STOP, f"{device}: {IN_EMERGENCY}"
        return self.callee.lease(now, id_, device)

    def _has_ended(self, run: object) -> bool:
        """Whether a run that is to be held is not active any more: a hold would catch the next run,
        which would never be released."""
        return isinstance(run, str) and self.callee.service_of(run) is None

    def stopped_in_emergency(self) -> tuple[str, ...]:
        """Devices in emergency stop."""
        return self._stops.names

    def _stop_places(self, now: float, keys: Iterable[str]) -> None:
        for key in keys:
            self.places[key].command(now, Command("", EMERGENCY_STOP))

    def _look_for_stops(self, now: float) -> None:
        """Stop and free what the latch on disk says. If it was set and cleared while this process
        was frozen, the runs of that time end, too: their devices have stopped without them."""
        fresh, freed = self._stops.look(now)
        if fresh or freed:
            self._stop_places(now, (*fresh, *freed))
            self.callee.tell_coordinators(STOP_EVENT)
        for key in freed:
            self.places[key].command(now, Command("", CLEAR_EMERGENCY))
        self.callee.stops = self._stops.cleared

    def _latched(self, device: str) -> dict[str, Any]:
        return {LATCHED: True, STOPS: self._stops.cleared + (device in self._stops)}

    def _answer_commands(self, now: float) -> None:
        if not self._commands:
            return
        for id_, command in list(self._commands.items()):
            if not command.storing and (not command.missing or now >= command.due):
                del self._commands[id_]
                answers = {
                    **command.answers,
                    **{key or self.name: "no answer" for key in command.missing},
                }
                held = command.verb != "hold" or all(a in _WELL_HELD for a in answers.values())
                data: dict[str, Any] = {"answers": answers, "devices": command.data}
                if command.note:
                    data["note"] = command.note
                if command.verb == "status":
                    data["emergency"] = list(self.stopped_in_emergency())
                    data["dry_run"] = self.directory.dry_run
                    data["scripted"] = self.scripted
                    data["code"] = self.code
                    data["events_dropped"] = dict(self.callee.events.dropped)
                self.callee.answer(now, id_, held and not command.missing, data)

    # --- reports of places --------------------------------------------------------------------

    def _take_report(self, now: float, key: str, report: Report) -> None:
        if isinstance(report, Outcome):
            self._end(now, report)
        elif isinstance(report, Call):
            self._ask(now, key, report)
        elif isinstance(report, Sent):
            self.sent.append((self.action_of(report.run), report))
        elif isinstance(report, Event):
            self._raise(report, key)
        elif isinstance(report, Answer):
            if report.id in self._commands:
                command, data = self._commands[report.id], dict(report.data)
                command.missing.discard(key)
                command.answers[key or self.name] = data.pop("answer")
                command.data[key or self.name] = data
        elif isinstance(report, Cancel):
            for caller in self.callers.values():
                caller.cancel(now, report.id, report.reason)
        elif self.callee.service_of(report.id) is not None:
            self.callee.feedback(now, report.id, report.fraction, report.data)

    def _end(self, now: float, end: Outcome) -> None:
        if (service := self.callee.service_of(end.id)) is None:
            return
        if end.cause == EMERGENCY_STOP:
            self._look_for_stops(now)  # this process may have been frozen
            if (device := self._host_of(service)) in self._stops:
                end = replace(end, values=self._latched(device))
        for caller in self.callers.values():
            caller.cancel_children(now, end.id, "its run is over")
        _log.info("run %s ended: %s %s %s", end.id, end.status, end.cause, end.text)
        self.callee.finish(now, end, plain_already=True)  # its host has checked it

    def _raise(self, event: Event, key: str = "") -> None:
        """Send an event of a run to its caller, and any other event to its subscribers: that of a
        device (`key`) or of a service, or a verdict, which goes to the coordinator of the judged
        run. All are kept until acknowledged, so a lost link only delays them."""
        if event.run and self.callee.service_of(event.run) is None:
            return
        source = self.action_of(event.run) if event.run else event.source or key or self.name
        dropped = self.callee.events.dropped
        before = dropped[source]
        self.callee.raise_event(
            self._now, event.name, event.data, source=source, latched=True, run=event.run
        )
        if dropped[source] > before == 0:
            _log.warning(
                "%s raises events faster than they are stored: the oldest are dropped", source
            )

    def _ask(self, now: float, key: str, call: Call) -> None:
        """Call a service for a run."""
        try:
            peer = self.directory.where(call.service)
        except DirectoryError as fault:
            unknown = Outcome(call.id, Status.ERROR, {}, "unknown_service", str(fault))
            self.places[key].take(now, unknown)
            return
        self.caller(peer).call(now, call)

    def _answer_runs(self, now: float) -> None:
        for caller in self.callers.values():
            notices = caller.notices()
            if notices:
                self.take_notices(now, notices)

    def take_notices(self, now: float, notices: Iterable[Notice]) -> None:
        """Give the results of calls to the runs that made them."""
        for notice in notices:
            if isinstance(notice, Outcome):
                # The id of a call that a run makes is that of the run, a slash and a number.
                service = self.callee.service_of(notice.id.rpartition("/")[0])
                if service is not None:
                    self.places[self._host_of(service)].take(now, notice)

    # --- services of the node itself ----------------------------------------------------------

    def _memory_call(self, now: float, call: Call) -> Outcome:
        self._now = now
        result = self.memory.call(call.service, call.arguments)
        executed = Executed.NO if result.status is Status.ERROR else Executed.YES
        return outcome_of(call.id, dataclasses.replace(result, executed=executed))

    def _memory_changed(self, name: str, value: Any, version: int) -> None:
        data = {"name": name, "value": value, "version": version}
        self.callee.raise_event(self._now, event_name(name), data, source=MEMORY, latched=True)

    def _stream_call(self, now: float, call: Call) -> Outcome:
        """Return where a set-point stream is received, and the ticket that opens it."""
        stream = call.service.removeprefix(STREAM_PREFIX)
        address = self._stream_address(stream) if self._stream_address else None
        if address is None:
            text = f"stream {stream!r} is not received at the moment"
            return Outcome(call.id, Status.ERROR, {}, "not_ready", text, Executed.NO)
        return Outcome(call.id, Status.SUCCESS, address)


def stream_service(stream: str) -> str:
    """Return the name of the service that gives a stream's address."""
    return STREAM_PREFIX + stream
