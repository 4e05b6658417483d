"""Checks that a driver keeps the rules of `services.device.Driver`: in a user's test, or as
`petrobot test driver NAME`.

The driver is run with its device, or with a simulation of it: it gets your commands, is stopped and
held in the middle of a movement, closed and made again. Positions are found automatically: they are
the numbers of `state` that a movement changes, and that keep their value at rest (except for
noise).
"""

from __future__ import annotations

import math
import os
import signal
import threading
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial, wraps
from importlib import import_module
from inspect import signature
from itertools import pairwise
from pathlib import Path
from resource import RUSAGE_THREAD, getrusage
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.device import (
    LIMITS,
    Driver,
    QuickStopping,
    fault_of_period,
    faults_of_methods,
    keys_of,
)
from petrobot.services.node.watchdog import Watchdog
from petrobot.services.rehearsal import TestPorts
from petrobot.services.worker.callables import RAISED, describe, from_outside
from petrobot.services.worker.runner import Hung

Command = Mapping[str, Any]
REST, PART = 20, 0.25
"""Steps at rest, which show the numbers that also change then; and the share of a movement after
which it is stopped or held."""
PLAY = 0.01
"""Share of its movement by which a position may change at rest: noise, and the end of settling."""
CREEP = 1e-4
"""Least share of its movement by which a position drifts in a quarter of a check at rest."""
SLOWEST, NOISE = 0.05, 5.0
"""A position counts as moving while it changes by more than this share of its fastest step, and by
more than this multiple of its change at rest."""
LATE_SHARE = 0.02
"""Share of steps that may take longer than the period: a busy computer delays some."""
FAULTS = (*RAISED, KeyboardInterrupt, Hung)
"""What code of a driver may raise, or the watchdog in it. (A KeyboardInterrupt `from_outside` is a
Ctrl-C.)"""
WAIT = 0.03
"""Seconds that a method may wait if the period is shorter."""
BUSY = 0.3
"""Share of its running time that the check may wait for a processor: beyond that also locks of the
system are slow, and a wait tells nothing of the driver."""
ALWAYS = 5, 0.8
"""A method that waits so often, and in this share of its calls, does so on any computer."""
EQUAL = 20, 0.1
"""So does one that waits so often, and always for the same time: without the tenth at each end, its
waits differ by at most this share. A busy computer delays by any time."""
STRETCH = 5.0
"""So many times as long may a wait last in which too few steps are made."""
LEAVING = 2.0
"""Seconds in which the threads and processes of a closed driver must end."""
HELD = 3
"""How often a thread may keep the interpreter: once or twice, the computer itself stood still."""
GROWING = 250
"""Steps of which a state must not grow in each."""
LONGEST_ROW = 32
"""Most numbers of a list that tell where the device is: a longer one is a scan or a history."""
LARGEST_STATE = 100_000
"""Most items and characters of a state: it is sent after each step."""
UNIT = 0.2
"""Greatest ratio of two units: above it, a position short of its goal was clamped."""
TURNS, WRAP = (360.0, 2.0 * math.pi), 0.05
"""A full turn (degrees, rad); an angle that changes by nearly one in a step has wrapped round."""
JUMP = 3.0
"""Multiple of its fastest step by which a position may change at once."""
MEASURED = (
    "if that is measured and no position, name what is one (`positions`, --position), or for a "
    "sensor give no commands"
)
"""Remedy if numbers of the state were taken for positions."""
NAMED = 6
"""Most names of a message."""
STARTING = 2
"""Steps of a movement in which a position may change although `stopped` is still True."""
UNKNOWN: Command = {"no driver knows this command": True}
SLOW, SLOWED = 0.25, 0.5
"""Share of its speed at which a driver is tested, and the greatest share of its usual average speed
that it may then have: acceleration and braking take their usual time."""
ELSEWHERE: Command = dict.fromkeys("xyz", (1e6, 2e6))
"""A workspace that no command ends in."""


class DriverCheck(Struct):
    """The findings. `faults` is empty for a driver that keeps the rules."""

    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What was not checked, and why."""
    busy: list[str] = field(default_factory=list)
    """What may be a fault of the driver, or only of this computer, which was too busy to tell."""


def check_driver(
    make: Callable[..., Driver],
    commands: Sequence[Command] = (),
    keys: Mapping[str, Any] | None = None,
    *,
    first: Sequence[Command] = (),
    seconds: float = 5.0,
    within: float = 1.0,
    cable: Callable[[bool], None] | None = None,
    positions: Sequence[str] = (),
    simulated: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> DriverCheck:
    """Check a driver. `make` is its class, or makes a new one each time; `make(speed=0.25)` adds
    this key to the device's table, as `lambda **keys: Axis(keys, ports)` does. `keys` are
    those that the table always has.

    `commands` are two or more that move to different positions, each in at most `seconds`,
    preferably in more than `within`; `first` are those that a new driver needs before them, to
    switch its drives on. The device must stand still `within` s after `stop`. `cable(False)` pulls
    the device's cable, `cable(True)` puts it back. `positions` are the keys of the state that tell
    where the device is; without them, all numbers that the commands change. `simulated`: time
    passes only between two steps, for a driver whose device is simulated by its steps; the check
    then takes milliseconds. A driver that was made with ports None gets ports with a clock,
    `random`, `raise_event` and silent streams. `progress` is told what is tested now: in real time
    the test takes about 40 times as long as a movement.
    """
    import_module("numpy")  # a first draw must not count as a slow step
    clock: Any = _Clock() if simulated else time
    if isinstance(make, type):
        make = partial(_made, make, clock.monotonic)
    make = partial(make, **keys) if keys else make
    make = _with_ports(make, clock.monotonic)
    try:
        check = _Check(make, clock, within, first, positions, progress)
    except (SystemExit, GeneratorExit, KeyboardInterrupt, Hung) as fault:
        if from_outside(fault):
            raise
        return DriverCheck([f"it cannot be made: {describe(fault)}"])
    try:
        check.rules(commands, seconds, cable)
        if isinstance(clock, _Clock):
            check.seeds(clock, commands)
    except _EndError as fault:
        check.fault(str(fault))
    except FAULTS as fault:
        *_, (where, _) = traceback.walk_tb(fault.__traceback__)
        ours = where.f_code.co_filename == __file__ and where.f_code is not _Check.ask.__code__
        if from_outside(fault) or ours:  # no fault of the driver, but a Ctrl-C, or a bug here
            raise
        verb = "hangs:" if isinstance(fault, Hung) else "raised"
        check.fault(f"the driver {verb} {describe(fault)}")
    finally:  # also after Ctrl-C: the device may be moving
        check.end()
    return check.found


def _made(kind: Callable[..., Driver], clock: Callable[[], float], **keys: Any) -> Driver:
    return kind(keys, TestPorts(clock))


def _with_ports(make: Callable[..., Driver], clock: Callable[[], float]) -> Callable[..., Driver]:
    """The same; a driver that was made with ports None gets the clock of the check."""

    @wraps(make)
    def made(**keys: Any) -> Driver:
        driver = make(**keys)
        if faults := faults_of_methods(driver):
            raise ValueError("; ".join(faults))
        TestPorts.of(driver).begin(clock, [], defaultdict(lambda: 1.0))
        return driver

    return made


def check_device(
    directory: Directory,
    name: str,
    commands: Sequence[Command] = (),
    *,
    first: Sequence[Command] = (),
    seconds: float = 5.0,
    within: float = 1.0,
    positions: Sequence[str] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> DriverCheck:
    """Check the driver of a device of a location file, in this process and in real time. Raises
    ValueError when there is none, or when it cannot be made."""
    from petrobot.services.node.drivers import make_driver
    from petrobot.services.node.ports import ProcessPorts

    entry = directory.devices.get(name)
    if entry is None or not entry.driver:
        known = ", ".join(sorted(d.name for d in directory.devices.values() if d.driver))
        raise ValueError(f"no device with a driver of this name; there are: {known or 'none'}")

    def make(**keys: Any) -> Driver:
        ports = ProcessPorts(directory, entry, time.monotonic, {})
        asked = replace(entry, config={**entry.config, **keys})
        driver = make_driver(directory, asked, ports)
        ports.draws.reseed(0)
        return driver

    return check_driver(
        make,
        commands,
        first=first,
        seconds=seconds,
        within=within,
        positions=positions,
        progress=progress,
    )


class _Clock:
    """Simulated time (s) that passes only in `sleep`."""

    def __init__(self) -> None:
        self.passed = 0.0

    def monotonic(self) -> float:
        return self.passed

    def sleep(self, seconds: float) -> None:
        self.passed += seconds


class _EndError(Exception):
    """A fault after which nothing could be judged, such as a movement without an end."""


def _too_long(command: Command, seconds: float) -> _EndError:
    return _EndError(
        f"{dict(command)}: took longer than `seconds` = {seconds:g} s, so nothing more was "
        "checked; give a shorter command, or larger `seconds` (a command that moves it until it is "
        "stopped cannot be checked)"
    )


class _Check:
    """Tests one driver after the other, and collects the faults."""

    def __init__(
        self,
        make: Callable[..., Driver],
        clock: Any,
        within: float,
        first: Sequence[Command],
        positions: Sequence[str],
        progress: Callable[[str], None],
    ) -> None:
        self.make, self.within, self.first, self.positions = make, within, first, positions
        self.progress, self.simulated = progress, isinstance(clock, _Clock)
        self.now: Callable[[], float] = clock.monotonic
        self.sleep: Callable[[float], None] = clock.sleep
        self.found = DriverCheck()
        self.steps = self.late = 0
        self.longest = 0.0
        self.waits: dict[str, list[float]] = {}
        """By method: how long it waited each time that this was too long (s)."""
        self.calls: Counter[str] = Counter()
        """By method: how often it was called."""
        try:
            self.schedule = os.open("/proc/thread-self/schedstat", os.O_RDONLY)
        except FileNotFoundError:  # a kernel without these statistics
            self.schedule = -1
        self.begun = self.scheduled()
        self.threads, self.children = set(threading.enumerate()), set(_children())
        """Threads and processes that are not the driver's."""
        self.libraries = set[threading.Thread]()
        """Threads that were left behind when a driver was closed for the first time that any
        were."""
        self.excepthook, threading.excepthook = threading.excepthook, self.thread_raised
        self.leaves: dict[str, Any] = {}
        """The last state, by path."""
        self.sizes: list[Counter[str]] = []
        """Items and characters of each key of the state, after each step of the present driver."""
        self.watch = Watchdog("test")
        with self.watch:
            self.driver = make()
        self.period = (not fault_of_period(self.driver) and self.driver.period) or 0.01
        self.idle: dict[str, float] = {}
        """By how much each number of the state usually changes in a step at rest."""
        self.fresh = True
        """Whether the driver was made and has not been given a command that moves it."""
        self.refusing = ""
        """Why it refused the last command."""
        self.fastest: dict[str, float] = {}
        """The largest step of each position in the last movement."""
        self.start: dict[str, float] = {}
        """The positions at the beginning of the last `way`."""
        self.measured: tuple[Mapping[str, float], float] = ({}, 0.0)
        """What the `way` between the first two commands returned."""
        self.ready = 0.0
        """The longest time that a new driver needed before it accepted a command (s)."""
        self.unheld: dict[bool, Command] = {}
        """The last command whose movement was held short of its end (False), or answered "held" and
        went on to its end (True)."""

    def fault(self, text: str) -> None:
        if text not in self.found.faults:
            self.found.faults.append(text)

    def note(self, text: str) -> None:
        self.found.notes.append(f"not checked: {text}")

    def numbers(self) -> dict[str, float]:
        """Return the numbers of the state that may tell where the device is, by path. Raises
        _EndError for a state that is not a table of plain data."""
        try:
            state = plain(self.ask(self.driver.state), "state")
        except RAISED as fault:
            raise _EndError(f"state: expected plain data, got {describe(fault)}") from fault
        if not isinstance(state, dict):
            raise _EndError(f"state: expected a table, got {state!r:.60}")
        self.leaves = found = _leaves(state, LONGEST_ROW)
        for name, value in found.items():
            if isinstance(value, float) and math.isnan(value):
                self.fault(f"state: {name} is NaN; what is not known yet is None, or left out")
        self.sizes.append(Counter({key: _size(value) for key, value in state.items()}))
        if self.sizes[-1].total() > LARGEST_STATE:
            self.fault(
                f"state: has more than {LARGEST_STATE:,} items and characters, most of them in "
                f"{self.sizes[-1].most_common(1)[0][0]}: it is sent after each step"
            )
        if missing := [key for key in self.positions if key not in state]:
            self.fault(f"state: no {', '.join(missing)}, which should tell where it is")
        elif self.positions:
            found = _leaves({key: state[key] for key in self.positions})
        return {name: float(value) for name, value in found.items() if _tells(value)}

    def thread_raised(self, raised: threading.ExceptHookArgs) -> None:
        if raised.exc_type is not SystemExit:
            name = raised.thread.name if raised.thread else "of the driver"
            self.fault(f"thread {name}: {raised.exc_type.__name__}: {raised.exc_value}")

    def ask(self, method: Callable[..., Any], *given: Any) -> Any:
        """Call a method that the cycle calls, and note whether it waits: gives up the processor by
        itself (`ru_nvcsw`), and does not only wait for one, as on a busy computer, or for a thread
        that runs and holds the interpreter's lock. `sleep` takes too long if a thread holds the
        lock and does not run."""
        name = getattr(method, "__name__", "a method")
        self.calls[name] += 1
        before, asked = getrusage(RUSAGE_THREAD).ru_nvcsw, method == self.sleep
        begin, used = time.perf_counter(), time.process_time() + self.scheduled()[1]
        try:
            with self.watch:
                return method(*given)
        finally:
            idle = time.perf_counter() - begin - (given[0] if asked else 0.0)
            if idle > max(WAIT, self.period):  # else its cause, which takes long to read, is equal
                idle -= time.process_time() + self.scheduled()[1] - used
                slept = getrusage(RUSAGE_THREAD).ru_nvcsw > before
                if idle > max(WAIT, self.period) and (
                    threading.active_count() > 1 if asked else slept
                ):
                    self.waits.setdefault(name, []).append(idle)

    def scheduled(self) -> tuple[float, float]:
        """Return how long this thread has run, and how long it has waited for a processor (s; 0
        where the system does not tell)."""
        if self.schedule < 0:
            return time.thread_time(), 0.0
        ran, queued, _ = os.pread(self.schedule, 100, 0).split()  # proc(5)
        return 1e-9 * int(ran), 1e-9 * int(queued)

    def step(self) -> dict[str, float]:
        """Make one step and measure its time; return the numbers of the state after it."""
        begin, queued = self.now(), self.scheduled()[1]
        if self.driver.period is not None:
            self.ask(self.driver.step, begin)
        numbers = self.numbers()
        took = self.now() - begin
        own = took - (self.scheduled()[1] - queued)  # the rest other programs took
        self.steps, self.late = self.steps + 1, self.late + (own > self.period)
        self.longest = max(self.longest, own)
        self.ask(self.sleep, max(0.0, self.period - took))
        return numbers

    def run(
        self,
        seconds: float,
        until: Callable[[], bool] = lambda: False,
        positions: Mapping[str, float] | None = None,
    ) -> set[str]:
        """Step for `seconds`; return the positions that changed by more than at rest."""
        begin, drifted, steps = self.numbers(), set[str](), self.stepped(seconds)
        while not until() and (numbers := next(steps, None)) is not None:
            drifted |= _differ(begin, numbers, positions or {}, PLAY)
        return drifted

    def stepped(self, seconds: float) -> Iterator[dict[str, float]]:
        """Step for `seconds`, and on a busy computer until as many steps are made as fit into
        them; yield the numbers of the state after each."""
        started, missing = self.now(), round(seconds / self.period)
        while (lasted := self.now() - started) < seconds or (
            missing > 0 and lasted < STRETCH * seconds
        ):
            missing -= 1
            yield self.step()

    def rules(
        self, commands: Sequence[Command], seconds: float, cable: Callable[[bool], None] | None
    ) -> None:
        """Check all rules that can be checked with this driver, these commands and the cable."""
        self.life()
        if self.driver.period is None:
            self.note("steps, commands and movements: the driver has no `period`")
        else:
            self.refusal()
            for there, back in pairwise([*commands, *commands[:1]] if len(commands) > 1 else ()):
                way = self.move(back, seconds)
                if way and self.run(self.within, self.stopped, way) and not self.stopped():
                    raise _too_long(back, seconds)
                self.rest()  # with its drives on, unlike before
                self.movements(there, back, seconds)
            if len(commands) > 1:
                if len(self.unheld) == 1 and True in self.unheld:  # in every movement
                    self.fault(
                        f"hold: answered 'held', and {dict(self.unheld[True])} went on to its end; "
                        "obey it (`paused`), or if it brakes until then, give longer commands"
                    )
                self.limits(commands[0], commands[1], seconds)
            elif type(self.driver).command is not Driver.command:  # a sensor refuses them all
                self.note("stop and hold during a movement: give two commands, there and back")
            if len(commands) < 2:
                self.grow(seconds)
        if cable is None:
            self.note("a pulled cable: give `cable`")
        else:
            self.cable(cable, commands, seconds)

    def grow(self, seconds: float) -> None:
        """Step so long that `close` sees whether the state of a sensor grows all the time."""
        lasts = 2.2 * GROWING * self.period
        if self.simulated or lasts <= 2.0 * seconds:
            self.progress("the state of a sensor")
            self.run(lasts)

    def life(self) -> None:
        """Make the driver, close it, make it again; stop it twice at rest."""
        if wrong := fault_of_period(self.driver):
            raise _EndError(wrong)
        self.rest()
        self.again("close and a second driver of the same configuration")
        self.stop("stop at rest")

    def rest(self) -> None:
        """Find the numbers that also change at rest: counters, ages, noise."""
        before, changes = self.numbers(), dict[str, list[float]]()
        for _ in range(REST):
            after = self.step()
            for name, value in after.items():
                changes.setdefault(name, []).append(abs(_change(before.get(name, value), value)))
            before = after
        for name, far in changes.items():
            # without the largest: a first answer of the device is a jump
            usual = (sum(far) - max(far)) / len(far)
            self.idle[name] = max(usual, self.idle.get(name, 0.0))

    def again(self, what: str, **keys: Any) -> None:
        """Close the driver and make another one, with further keys."""
        self.progress(what)
        self.close()
        if not self.libraries:  # a library keeps threads of its first user
            self.libraries = set(threading.enumerate()) - self.threads
        try:
            with self.watch:
                self.driver, self.fresh = self.make(**keys), True
            self.run(REST * self.period)
        except RAISED as fault:
            self.fault(f"{what}: {describe(fault)}")

    def refusal(self) -> None:
        try:
            self.ask(self.driver.command, self.now(), UNKNOWN)
        except RAISED:  # the rule: any exception refuses
            return
        self.fault(f"command: accepted {dict(UNKNOWN)}; raise ValueError for what it does not know")

    def movements(self, there: Command, back: Command, seconds: float) -> None:
        """Make one movement to its end, stop one on its way, and hold and release one."""
        self.move(back, seconds, judged=False)
        begin, before = self.numbers(), self.leaves
        self.progress(f"{dict(back)}, then {dict(there)}")
        positions, took = self.way(there, back, seconds)
        if not positions:
            self.unmoved(there, before)
            return
        self.measured = self.measured if self.measured[1] else (positions, took)
        start, ended = self.start, self.numbers()
        far = {n: _change(v, start[n]) for n, v in ended.items() if n in positions.keys() & start}
        fastest = self.fastest
        self.arrived(there, back, positions, seconds)

        def begun() -> None:
            self.move(there, seconds, judged=False)
            self.move(back, PART * took, judged=False)

        if not self.move(back, PART * took, judged=False):
            self.note(f"stop and hold during {dict(back)}: it moves nothing after {dict(there)}")
            return
        left = _differ(begin, self.numbers(), positions, PART)
        self.stop("stop during a movement", positions)
        if left and left.isdisjoint(_differ(begin, self.numbers(), positions, SLOWEST)):
            self.note(
                f"stop during {dict(back)}: it went on to its end in less than {self.within:g} s, "
                "as without a stop; give longer commands"
            )
        begun()
        held = self.holds(back, positions, begin)
        before = self.numbers()
        self.ask(self.driver.release, self.now())
        if held:
            self.follow(back, seconds, before, judged=False)
            self.released(positions, begin, before, fastest)
            begun()
            self.stopped_while_held(positions)
        self.stop("stop", positions)
        self.turned(there, back, seconds, took, far)
        if isinstance(self.driver, QuickStopping):
            begun()
            self.stop("quick_stop during a movement", positions, self.driver.quick_stop)
            self.again("made again after a quick stop")  # it may need its drives switched on
        begun()
        self.remade(positions, seconds)

    def unmoved(self, there: Command, before: Mapping[str, Any]) -> None:
        """Judge a command that moved nothing: it may change the state at once."""
        self.numbers()
        still = {name for name, change in self.idle.items() if not change}
        counts = {n for n, value in before.items() if _tells(value)} - still
        if all(before[n] == self.leaves.get(n) for n in before.keys() - counts):
            text = (
                "no number of state changes on the way: give a command that moves it, or let "
                "`state` tell where it is"
            )
            self.fault(f"{dict(there)}: {text}")
        else:
            self.stands(f"after {dict(there)}")
            self.note(f"stop and hold during {dict(there)}: it changes the state at once")

    def arrived(
        self, there: Command, back: Command, positions: Mapping[str, float], seconds: float
    ) -> None:
        """Judge whether the device stands at the end of a `way`, and where. Raises
        _EndError."""
        moving = self.run(self.within, self.stopped, positions)
        if self.stopped() or not moving:
            self.clamped((there, self.numbers()), (back, self.start), positions)
        if self.stopped():
            self.stands(f"after {dict(there)}", positions)
        else:  # it may be one that runs until it is stopped, as a pump
            before = self.numbers()
            self.stop(f"stop after {dict(there)}", positions)
            if not _differ(before, self.numbers(), positions, PART):
                if moving:
                    raise _too_long(there, seconds)
                text = f"stopped() is still False after {self.within:g} s"
                self.fault(f"after {dict(there)}: {text}")

    def clamped(
        self,
        there: tuple[Command, dict[str, float]],
        back: tuple[Command, dict[str, float]],
        positions: Mapping[str, float],
    ) -> None:
        """Judge whether the device is where two commands say, from both and the positions at their
        ends.

        Nothing says which number of a command is the goal of which position. One at which a
        position is after one of the commands is taken for its goal; then it must be at that of the
        other one too, or have moved by it.
        """
        asked = [_leaves(command) for command, _ in (there, back)]
        misses = dict[tuple[str, str], list[float]]()
        """By position and path in the commands: how far it is from both, as shares of its way."""
        for name in positions:
            first, last = (end.get(name, math.nan) for _, end in (back, there))
            way = last - first
            for path, to in asked[0].items() if abs(way) > PART * positions[name] else ():
                fro = asked[1].get(path, math.nan)
                if _tells(to) and _tells(fro) and to != fro:
                    moved = max(abs(way - to), abs(way + fro)) <= PLAY * abs(way)
                    off = [abs(_change(to, last)), abs(_change(fro, first))]
                    off = [miss / abs(way) for miss in off]
                    misses[name, path] = [0.0] if moved else off
        known = {part for pair, off in misses.items() if max(off) <= PLAY for part in pair}
        for (name, path), off in misses.items():
            if known.isdisjoint((name, path)) and min(off) <= PLAY and max(off) > SLOWEST:
                wrong = int(off[0] <= PLAY)
                command, end = (there, back)[wrong]
                if not asked[1 - wrong][path] and not UNIT < end[name] / asked[wrong][path] < 1.0:
                    continue  # 0 is 0 in any unit
                self.fault(
                    f"{dict(command)}: accepted, and {name} ended at {end[name]:g}; obey {path}, "
                    "or raise ValueError (if something was in its way, give another command)"
                )

    def holds(
        self, back: Command, positions: Mapping[str, float], end: Mapping[str, float]
    ) -> bool:
        """Hold during a movement to `end`. Return whether the driver answered that it is held."""
        self.progress(f"hold during {dict(back)}")
        left = _differ(end, self.numbers(), positions, PART)
        answer = self.ask(self.driver.hold, self.now())
        if answer not in ("held", "cannot hold", "stopped"):
            self.fault(f'hold: expected "held", "cannot hold" or "stopped", got {answer!r}')
        if answer in ("held", "stopped"):
            self.run(self.within)
            if drift := self.drifts(positions):
                self.fault(f"hold: answered {answer!r}, and {_names(drift)} still changes")
                return bool(answer == "held")
        if left and answer == "held":
            self.unheld[left.isdisjoint(_differ(end, self.numbers(), positions, SLOWEST))] = back
        return bool(answer == "held")

    def released(
        self,
        positions: Mapping[str, float],
        begin: Mapping[str, float],
        before: Mapping[str, float],
        fastest: Mapping[str, float],
    ) -> None:
        """Judge a movement that was held and released: it continues to `begin`, and no faster."""
        after = self.numbers()
        arrived = not {n for n in positions if abs(after[n] - begin[n]) > PART * positions[n]}
        if not arrived and not _differ(before, after, positions, PLAY):
            self.fault("release: the movement that was held does not continue")
        jumps = {
            n
            for n, way in positions.items()
            if self.fastest.get(n, 0.0) > max(PART * way, JUMP * fastest.get(n, 0.0))
        }
        if jumps:
            self.fault(f"release: {_names(jumps)} jumps instead of moving on")

    def stopped_while_held(self, positions: Mapping[str, float]) -> None:
        """Hold, stop and release: a movement that was stopped does not continue."""
        self.ask(self.driver.hold, self.now())
        self.stop("stop while it is held", positions)
        before = self.numbers()
        self.ask(self.driver.release, self.now())
        self.run(self.within)
        if _differ(before, self.numbers(), positions, PART):
            self.fault("release: the movement that was held and then stopped continues")

    def remade(self, positions: Mapping[str, float], seconds: float) -> None:
        """Make the driver again during a movement: nothing moves before it has got a command."""
        self.again(what := "made again during a movement")
        self.stop("stop")  # as its node does
        self.run(self.within)
        for needed in self.first:
            self.run(seconds, partial(self.accepts, needed))
        before = self.numbers()
        self.run(self.within)
        if moved := _differ(before, self.numbers(), positions, PART):
            self.fault(f"{what}: {_names(moved)} changes before it has got a command")

    def turned(
        self,
        there: Command,
        back: Command,
        seconds: float,
        took: float,
        far: Mapping[str, float],
    ) -> None:
        """Give a command during the movement of another one: it is refused or obeyed. `far`: how
        far `back` moves it."""
        self.progress(f"{dict(there)} during {dict(back)}")
        self.move(there, seconds, judged=False)
        begin = self.numbers()
        self.move(back, PART * took, judged=False)
        if not self.accepts(there):
            self.stop("stop")
            return
        self.follow(there, 2.0 * seconds, self.numbers(), judged=False)
        ended = self.numbers()
        ways = {n: _change(begin[n], v) for n, v in ended.items() if n in begin and n in far}
        most = max(map(abs, far.values()), default=0.0)
        deaf = {
            n
            for n, way in ways.items()
            if abs(far[n]) > PART * most and abs(way) > abs(way - far[n])
        }
        if deaf:
            self.fault(
                f"{dict(there)}: accepted during {dict(back)}, and {_names(deaf)} moved on as "
                "before; obey it, or raise ValueError"
            )

    def limits(self, there: Command, back: Command, seconds: float) -> None:
        """Check that it obeys those of `speed`, `workspace` and `dry_run` that are in its
        `obeys`."""
        own = keys_of(type(self.driver))
        obeys = [name for name in LIMITS if name in self.driver.obeys and name not in own]
        takes = signature(self.make).parameters.values()
        if not any(one.kind is one.VAR_KEYWORD for one in takes):
            if obeys:
                self.note(f"{', '.join(obeys)}: let `make` take keys of the device's table")
            return
        positions, took = self.measured
        if obeys and not any(positions.values()):
            self.note(f"{', '.join(obeys)}: no number of the state tells where the device is")
            return
        if "speed" in obeys:
            asked = SLOW * self.driver.speed  # its table may have a speed
            self.again(f"speed = {asked:g}", speed=asked)
            most = max(positions, key=positions.__getitem__)
            slow, slowly = self.way(there, back, seconds / SLOW)
            share = slow.get(most, 0.0) / slowly / (positions[most] / took)
            if share > SLOWED:
                self.fault(
                    f"speed = {asked:g}: {dict(there)} moves it at {share:.2f} of its usual speed; "
                    "if the way is too short to reach its usual speed, give commands farther apart"
                )
        if "workspace" in obeys:
            self.again("a workspace far away", workspace=ELSEWHERE)
            self.run(min(seconds, 2.0 * self.ready))
            for command in (there, back):
                before = self.numbers()
                with suppress(ValueError):
                    self.ask(self.driver.command, self.now(), command)
                self.run(took)
                if moved := _differ(before, self.numbers(), positions, PART):
                    self.fault(f"workspace: {dict(command)} moves it far outside: {_names(moved)}")
            self.stop("stop")
        if "dry_run" in obeys:
            places = list[dict[str, float]]()
            for command in (there, back):
                self.again("made again")
                self.move(command, seconds)
                self.again("made again")
                places.append(self.numbers())
            at_there, before = places
            if not _differ(at_there, before, positions, PART):
                self.note(
                    "dry_run: a driver that is made again does not tell where the device is, so "
                    "nothing shows whether it moved; look at the device"
                )
            self.again("dry_run = true", dry_run=True)
            self.move(there, seconds)
            self.again("made again")
            if moved := _differ(before, self.numbers(), positions, PART):
                self.fault(f"dry_run: {dict(there)} moves the device: {_names(moved)} changed")
        self.again("made again")

    def way(
        self, there: Command, back: Command, seconds: float
    ) -> tuple[Mapping[str, float], float]:
        """Move back and there; return how far each position came, and how long it took (s)."""
        self.move(back, seconds, judged=False)  # it may already be there, and only settle
        self.start, begin = self.numbers(), self.now()
        positions = self.move(there, seconds)
        return positions, max(self.period, self.now() - begin - REST * self.period)

    def move(self, command: Command, seconds: float, judged: bool = True) -> Mapping[str, float]:
        """Give a command and step for `seconds`, or until the device stands still again; return how
        far each position moved."""
        if self.fresh:  # a new driver may need time
            begin = self.now()
            for needed in (*self.first, command):
                self.run(seconds, partial(self.accepts, needed))
            self.ready = max(self.ready, self.now() - begin)
        else:  # one that settles slowly may refuse it until then
            self.run(self.within, self.stopped)
            self.accepts(command)
        if self.refusing:
            self.fault(f"{dict(command)}: refused: {self.refusing}")
        judged, self.fresh = judged and not self.fresh, False
        return self.follow(command, seconds, self.numbers(), judged)

    def follow(
        self, command: Command, seconds: float, begin: dict[str, float], judged: bool = True
    ) -> Mapping[str, float]:
        """Step for `seconds`, or until the device stands still again; return how far each position
        has moved since `begin`."""
        before = low = high = shown = begin
        fastest, resting = dict[str, float](), 0
        moved, untrue = set[str](), Counter[str]()
        ways, away = dict[str, float](), set[str]()
        end = self.now() + seconds
        while self.now() < end and resting < REST:
            still = self.stopped()
            newest = self.step()
            after = {  # an angle that wraps round moves on
                name: before[name] + _change(shown[name], value) if name in before else value
                for name, value in newest.items()
            }
            shown = newest
            low = {name: min(value, low.get(name, value)) for name, value in after.items()}
            high = {name: max(value, high.get(name, value)) for name, value in after.items()}
            ways = {n: abs(v - begin[n]) for n, v in after.items() if n in begin and n in before}
            away = {n for n, far in ways.items() if far > 0.5 * (high[n] - low[n])}
            steps = {name: abs(after[name] - before[name]) for name in away}
            fastest |= {n: max(far, fastest.get(n, 0.0)) for n, far in steps.items()}
            changed = {
                name
                for name, far in steps.items()
                if far > max(SLOWEST * fastest[name], NOISE * self.idle.get(name, 0.0))
            }
            before, moved = after, moved | changed
            resting = 0 if changed else resting + 1
            if still:
                untrue.update(changed)
        found = {name: far for name, far in ways.items() if name in moved and name in away}
        # a position that hardly moves only settles
        self.fastest = fastest
        least = SLOWEST * max(found.values(), default=0.0)
        found = {name: far for name, far in found.items() if far >= least}
        # each position by itself: one joint may settle while another only begins
        if judged and (lied := {name for name in found if untrue[name] > STARTING}):
            text = f"stopped: True during {dict(command)}, while {_names(lied)} changed"
            self.fault(text if self.positions else f"{text}; {MEASURED}")
        return found

    def accepts(self, command: Command) -> bool:
        """Give a command; return whether it was accepted."""
        try:
            self.ask(self.driver.command, self.now(), command)
        except RAISED as fault:
            self.refusing = f"{describe(fault)}"
            return False
        self.refusing = ""
        return True

    def stop(
        self,
        what: str,
        positions: Mapping[str, float] | None = None,
        routine: Callable[[float], None] | None = None,
    ) -> None:
        """Stop it twice, by its stop routine or another one."""
        stop = routine or self.driver.stop
        self.progress(what)
        self.ask(stop, self.now())
        try:
            self.ask(stop, self.now())
        except RAISED as fault:
            self.fault(f"{stop.__name__}, a second time: {describe(fault)}")
        self.stands(what, positions)

    def stands(self, what: str, positions: Mapping[str, float] | None = None) -> None:
        """Check that `stopped` is True within the limit, and that no position changes then."""
        self.run(self.within, self.stopped)
        if not self.stopped():
            self.fault(f"{what}: stopped() is still False after {self.within:g} s")
        elif drift := self.drifts(positions or {}):
            self.fault(f"{what}: stopped() is True, and {_names(drift)} still changes")

    def drifts(self, positions: Mapping[str, float]) -> set[str]:
        """Step for a while; return the positions that change by more than at rest, or slowly and
        steadily: what only settles becomes slower."""
        points = [self.numbers(), *self.stepped(max(self.within, REST * self.period))]
        drifted = {n for point in points for n in _differ(points[0], point, positions, PLAY)}
        for name in positions:
            places = [point[name] for point in points[:: max(1, len(points) // 4)] if name in point]
            ways = sorted((_change(before, after) for before, after in pairwise(places)), key=abs)
            least = max(CREEP * positions[name], self.idle.get(name, 0.0))
            if len(ways) > 3 and all(way / ways[-1] > 0.5 for way in ways if abs(way) > least):
                drifted |= {name} if abs(ways[0]) > least else set()
        return drifted

    def stopped(self) -> bool:
        answer = self.ask(self.driver.stopped)
        if answer not in (True, False):
            raise _EndError(f"stopped: expected True or False, got {answer!r:.60}")
        return bool(answer)

    def cable(
        self, cable: Callable[[bool], None], commands: Sequence[Command], seconds: float
    ) -> None:
        """Check that without its cable the driver raises or `stopped` is False, and that with the
        cable it works again: the same driver, or if it raised, a new one."""
        positions: Mapping[str, float] = {}
        if len(commands) > 1:
            positions, took = self.way(commands[0], commands[-1], seconds)
            self.move(commands[-1], PART * took)
        self.plug(cable, False)
        try:
            self.driver.stop(self.now())
            self.run(seconds, lambda: not self.stopped())
            if self.stopped():
                self.fault(f"cable pulled: stopped() is still True after {seconds:g} s")
            self.run(self.within)
            raised = False
        except RAISED:  # the rule: the node then makes a new driver
            raised = True
        self.plug(cable, True)
        if raised:
            self.again("cable put back")
        steps, before, end = dict[str, list[float]](), self.numbers(), self.now() + seconds
        while self.now() < end:
            after = self.step()
            for name in positions.keys() & before.keys() & after.keys():
                steps.setdefault(name, []).append(abs(_change(before[name], after[name])))
            before = after
        # without the two largest: values may vanish and come back
        ways = {name: sum(sorted(far)[:-2]) for name, far in steps.items()}
        if moved := {name for name, way in ways.items() if way > PART * positions[name]}:
            self.fault(f"cable put back: {_names(moved)} changes before it has got a command")
        if not positions:
            if not self.stopped():
                self.fault(f"cable put back: stopped() is still False after {seconds:g} s")
            return
        for needed in (*self.first, commands[0]):
            self.run(seconds, partial(self.accepts, needed))
        if self.refusing:
            self.again("cable put back")
            found = self.move(commands[0], seconds)
        else:
            found = self.follow(commands[0], seconds, before, judged=False)
        if not found:
            self.fault(f"cable put back: {dict(commands[0])} moves nothing")

    def plug(self, cable: Callable[[bool], None], on: bool) -> None:
        """Put the cable back or pull it; a process that this starts is not the driver's."""
        before = set(_children())
        cable(on)
        self.children |= set(_children()) - before

    def close(self) -> None:
        """Close the driver. Its state must not have grown all the time."""
        half = len(self.sizes) // 2
        for name in self.sizes[-1] if half >= GROWING else ():
            first, middle, last = (self.sizes[at][name] for at in (0, half, -1))
            if min(middle - first, last - middle) > half / 2:
                self.fault(
                    f"state: {name} grows all the time, and is sent after each step; keep the "
                    "newest few items"
                )
        self.sizes.clear()
        try:
            with self.watch:
                self.driver.close()
        except (*RAISED, KeyboardInterrupt) as fault:
            if from_outside(fault):
                raise
            self.fault(f"close: {describe(fault)}")

    def seeds(self, clock: _Clock, commands: Sequence[Command]) -> None:
        """Check that two runs are equal, as their seeds are, if both begin with the same state."""
        runs = list[list[dict[str, float]]]()
        for _ in range(2 if isinstance(getattr(self.driver, "ports", None), TestPorts) else 0):
            clock.passed = 0.0
            self.close()
            with self.watch:
                self.driver = self.make()
            run = [self.numbers()]
            for command in (*self.first, *commands):
                self.accepts(command)
                run += [self.step() for _ in range(REST)]
            runs.append(run)
        pairs = [*zip(*runs, strict=True)]
        differ = {name for one, other in pairs for name in one if one[name] != other.get(name)}
        if differ and pairs[0][0] == pairs[0][1]:
            self.fault(
                f"two runs with the same seed differ in {_names(differ)}: draw with ports.random, "
                "and take the time from `now`"
            )

    def end(self) -> None:
        """Stop and close the driver, whatever happened."""
        try:
            with self.watch:
                self.driver.stop(self.now())
        except FAULTS as fault:
            if from_outside(fault):
                raise
            self.fault(f"stop at the end: {describe(fault)}")
        finally:
            with suppress(Hung):  # that was found before
                self.close()
            self.watch.close()
            pairs = zip(self.scheduled(), self.begun, strict=True)
            ran, queued = (now - then for now, then in pairs)
            if self.schedule >= 0:
                os.close(self.schedule)
        end, left = (
            time.monotonic() + LEAVING,
            set(threading.enumerate()) - self.threads - self.libraries,
        )
        for thread in left:
            thread.join(max(0.0, end - time.monotonic()))
        if names := {thread.name for thread in left if thread.is_alive()}:
            self.fault(f"close: leaves a thread behind: {_names(names)}")
        while not self.children.issuperset(running := _children()) and time.monotonic() < end:
            time.sleep(0.05)
        if odd := {number: name for number, name in running.items() if number not in self.children}:
            self.fault(f"close: leaves a process behind: {_names({*odd.values()})}")
            for number in odd:
                os.kill(number, signal.SIGKILL)  # this process might wait for it at its end
        threading.excepthook = self.excepthook
        for name, waits in self.waits.items():
            text = f"{name}: {len(waits)} calls waited, the longest {max(waits):.3f} s"
            why = "no method that the cycle calls may wait; let a thread do it"
            if name == "sleep":
                text = f"a thread of the driver kept the interpreter {len(waits)} times while it"
                text += f" waited, the longest {max(waits):.3f} s"
                why = "its library does not release the lock (GIL); put it into another process"
            if name == "sleep" and len(waits) < HELD:
                continue
            least, most = _middle(waits)
            always = len(waits) >= max(ALWAYS[0], ALWAYS[1] * self.calls[name])
            equal = len(waits) >= EQUAL[0] and most <= (1.0 + EQUAL[1]) * least
            if queued > BUSY * ran and not (always or equal):
                self.found.busy.append(f"{text}, perhaps because this computer is busy")
            else:
                self.fault(f"{text}: {why}")
        if self.late > LATE_SHARE * self.steps:
            self.fault(
                f"step: {self.late} of {self.steps} took longer than the period of "
                f"{self.period:g} s, the longest {self.longest:.3f} s: it must not wait"
            )


def _middle(numbers: Sequence[float]) -> tuple[float, float]:
    """Return the least and the most of them, without the tenth at each end."""
    placed, cut = sorted(numbers), len(numbers) // 10
    return placed[cut], placed[-1 - cut]


def _children() -> dict[int, str]:
    """Return the running processes that this one has started, by number, except helpers of
    `multiprocessing`, which end with it."""
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended
            name, _, rest = (path / "stat").read_text().rpartition(")")  # proc(5)
            state, parent = rest.split()[:2]
            if int(parent) == os.getpid() and state != "Z":
                line = (path / "cmdline").read_bytes()
                if b"resource_tracker" not in line and b"multiprocessing.forkserver" not in line:
                    found[int(path.name)] = name.partition("(")[2]
    return found


def _leaves(data: Mapping[str, Any], most: float = math.inf) -> dict[str, Any]:
    """Return the values in plain data, by path, without those of lists longer than `most`."""
    found: dict[str, Any] = {}

    def add(path: str, value: Any) -> None:
        if type(value) is dict:
            for key, part in value.items():
                add(f"{path}.{key}", part)
        elif type(value) is not list:
            found[path] = value
        elif len(value) <= most:
            for number, part in enumerate(value):
                add(f"{path}[{number}]", part)

    for key, part in data.items():
        add(key, part)
    return found


def _tells(value: Any) -> bool:
    """Whether a value may tell where the device is."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _size(value: Any) -> int:
    """Return the number of items and characters in plain data."""
    if type(value) is dict:
        return len(value) + sum(map(_size, value.values()))
    if type(value) is list:
        return len(value) + sum(map(_size, value))
    return len(value) if isinstance(value, str | bytes) else 0


def _differ(
    before: Mapping[str, float], after: Mapping[str, float], ways: Mapping[str, float], share: float
) -> set[str]:
    """Return the positions that differ by more than a share of their movement."""
    known = (name for name in ways if name in before and name in after)
    return {name for name in known if abs(_change(before[name], after[name])) > share * ways[name]}


def _change(before: float, after: float) -> float:
    """Return by how much a number has changed. An angle may wrap round: 359 degrees are next to
    0."""
    change = after - before
    for turn in TURNS:
        if abs(abs(change) - turn) < WRAP * turn and max(abs(before), abs(after)) <= turn:
            return change - math.copysign(turn, change)
    return change


def _names(found: set[str]) -> str:
    shown, more = sorted(found)[:NAMED], len(found) - NAMED
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
