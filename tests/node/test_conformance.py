"""Drivers that keep the rules pass; each broken rule is named."""

from __future__ import annotations

import ctypes
import itertools
import math
import os
import random
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, ClassVar, cast

import pytest

from petrobot.services import conformance
from petrobot.services.conformance import DriverCheck, check_driver
from petrobot.services.device import Driver, Ports, key
from petrobot.services.node import watchdog
from tests.waiting import Limit


class Axis(Driver):
    """Moves at 0.1 m/s; keeps all rules."""

    period = 0.01
    plugged = True

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.at = self.goal = 0.0
        self.paused = False
        self.cycles = 0

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if not isinstance(body.get("to"), float):
            raise ValueError(f"to: expected metres, got {body.get('to')!r}")
        self.goal = body["to"]

    def step(self, now: float) -> None:
        if not self.plugged:
            raise OSError("no answer")
        self.cycles += 1
        if not self.paused:
            self.at += max(-0.001, min(0.001, self.goal - self.at))

    def state(self) -> Mapping[str, Any]:
        return {"axis": [{"at": self.at}], "cycles": self.cycles, "ready": True}

    def stop(self, now: float) -> None:
        self.goal = self.at

    def stopped(self) -> bool:
        return self.at == self.goal

    def hold(self, now: float) -> str:
        self.paused = True
        return "held"

    def release(self, now: float) -> None:
        self.paused = False


class Obedient(Axis):
    """Leaves the operator's pause to the base class."""

    obeys = ("pause",)
    hold, release = Driver.hold, Driver.release


class Forgets(Obedient):
    """Says that it obeys the pause, and does not."""

    def step(self, now: float) -> None:
        self.at += max(-0.001, min(0.001, self.goal - self.at))


class Ready(Driver):
    """Prepares itself without a constructor of its own."""

    start: float = key(0.0, "m")

    def setup(self) -> None:
        self.made = self.start, self.ports.now, self.speed


COMMANDS = [{"to": 0.2}, {"to": 0.0}]


def checked(kind: type[Axis], **more: Any) -> DriverCheck:
    """Check a driver, in simulated time unless the driver itself waits."""
    how: dict[str, Any] = {"simulated": True}
    if kind in (Waits, ItsThreadKeepsTheLock):  # these need real time
        how = {"seconds": 0.5, "within": 0.05}
    commands = [] if kind is ItsThreadKeepsTheLock else COMMANDS  # each of its steps takes long
    return check_driver(lambda: kind({}, cast(Ports, None)), commands, **how | more)


def test_a_thread_that_computes_is_no_wait() -> None:
    assert checked(ItsThreadComputes).faults == []


def test_a_good_driver_passes() -> None:
    found = checked(Axis)
    assert found.faults == []
    assert found.notes == ["not checked: a pulled cable: give `cable`"]


def test_the_base_class_holds_for_a_driver_that_obeys_paused() -> None:
    assert checked(Obedient).faults == []
    assert checked(Forgets).faults == ["hold: answered 'held', and axis[0].at still changes"]


@pytest.mark.parametrize("far", [0.03, 0.06, 0.12])  # 0.3 to 1.2 s
def test_a_hold_is_tested_however_short_the_movement_is(far: float) -> None:
    there_and_back = [{"to": far}, {"to": 0.0}]
    assert check_driver(Obedient, there_and_back, simulated=True).faults == []
    (fault,) = check_driver(Forgets, there_and_back, simulated=True).faults
    assert fault.startswith(f"hold: answered 'held', and {{'to': {far}}} went on to its end; obey")


class Lasting(Axis):
    """Its device stays where it is, without a driver."""

    obeys = ("dry_run",)
    device = 0.0

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.at = self.goal = self.device

    def step(self, now: float) -> None:
        super().step(now)
        type(self).device = self.at


def test_a_dry_run_that_nothing_shows_is_not_called_tested() -> None:
    class Forgetful(Axis):
        obeys = ("dry_run",)

    found = check_driver(Forgetful, COMMANDS, simulated=True)
    assert found.faults == []
    assert found.notes[0].startswith("not checked: dry_run: a driver that is made again does not")
    found = check_driver(Lasting, COMMANDS, simulated=True)
    assert found.faults == ["dry_run: {'to': 0.2} moves the device: axis[0].at changed"]


def test_progress_names_what_is_tested() -> None:
    told = list[str]()
    check_driver(Axis, COMMANDS, simulated=True, progress=told.append)
    assert {"stop during a movement", "hold during {'to': 0.0}"} <= set(told)


def test_a_driver_prepares_itself_when_its_keys_are_read() -> None:
    config = {"start": 0.1, "speed": 0.5}
    assert type("Slow", (Ready,), {"obeys": ("speed",)})(config, None).made == (0.1, 0.0, 0.5)


def test_a_driver_without_ports_may_draw_read_a_stream_and_raise_events() -> None:
    class Notices(Axis):
        def setup(self) -> None:
            self.wish, self.made = self.ports.stream("wish"), self.ports.now

        def step(self, now: float) -> None:
            super().step(now)
            if self.ports.random("hum").random() < 0.1 and self.wish.values is None:
                self.ports.raise_event("hum", after=self.ports.now - self.made)

    assert checked(Notices).faults == []
    assert check_driver(Notices, COMMANDS, simulated=True).faults == []


class Ages(Axis):
    """Its state has a number that grows with time, also while it stands, once it has moved."""

    def state(self) -> Mapping[str, Any]:
        return {**super().state(), "age": 0.001 * self.cycles if self.at else 0.0}


def test_the_positions_may_be_named() -> None:
    """Else a number that changes after a command counts as one."""
    assert checked(Ages).faults
    assert checked(Ages, positions=["axis"]).faults == []
    assert "state: no pose" in "; ".join(checked(Ages, positions=["pose"]).faults)


class Settles(Axis):
    """It counts as standing until its first step, and what it bends settles after its last."""

    speed = bent = 0.0

    def step(self, now: float) -> None:
        before = self.at
        super().step(now)
        self.speed = self.at - before
        self.bent += 0.1 * (0.01 * self.at - self.bent)

    def state(self) -> Mapping[str, Any]:
        return {**super().state(), "bent": self.bent}

    def stopped(self) -> bool:
        return not self.speed


def test_an_axis_may_settle_after_the_movement() -> None:
    assert checked(Settles).faults == []


class Brakes(Axis):
    """Needs eight steps to stand still."""

    def stop(self, now: float) -> None:
        self.goal = self.at + max(-0.008, min(0.008, self.goal - self.at))

    def step(self, now: float) -> None:
        braking = abs(self.goal - self.at) < 0.009
        held, self.paused = self.paused, self.paused and not braking
        super().step(now)
        self.paused = held


def test_a_busy_computer_makes_a_driver_no_slower_than_its_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Time passes without steps; only as many count as fit into the time of a check."""
    passing, calls = conformance._Clock.sleep, itertools.count()

    def sleep(clock: conformance._Clock, seconds: float) -> None:
        passing(clock, seconds + 0.3 * (next(calls) % 5 == 0))

    assert checked(Brakes, within=0.2).faults == []
    monkeypatch.setattr(conformance._Clock, "sleep", sleep)
    assert checked(Brakes, within=0.2, seconds=60.0).faults == []


class NeverStops(Axis):
    def stop(self, now: float) -> None:
        pass


class SaysItStands(Axis):
    def stopped(self) -> bool:
        return True


class RunsOnAfterStop(Axis):
    """It reports that it stands still, but it rolls on."""

    said = False

    def stop(self, now: float) -> None:
        self.said = True

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        super().command(now, body)
        self.said = False

    def stopped(self) -> bool:
        return self.said or super().stopped()


class StopsOnce(Axis):
    ever = 0

    def stop(self, now: float) -> None:
        self.ever += 1
        if self.ever == 2:
            raise RuntimeError("already stopped")
        super().stop(now)


class TakesAll(Axis):
    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if "to" in body:
            super().command(now, body)


class HoldsInWords(Axis):
    def hold(self, now: float) -> str:
        return "held"


class HoldsForGood(Axis):
    def release(self, now: float) -> None:
        pass


class IsShorter(Axis):
    def command(self, now: float, body: Mapping[str, Any]) -> None:
        super().command(now, body)
        if self.goal > 0.15:
            self.goal = self.at
            raise ValueError("to: at most 0.15")


class WrongAnswer(Axis):
    def hold(self, now: float) -> str:
        super().hold(now)
        return "ok"


class Waits(Axis):
    def step(self, now: float) -> None:
        super().step(now)
        time.sleep(0.02)


class StrangeState(Axis):
    def state(self) -> Mapping[str, Any]:
        return {"at": self.at, "port": object()}


class CannotBeMadeAgain(Axis):
    made = 0

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        type(self).made += 1
        if type(self).made > 1:
            raise OSError("port is busy")
        super().__init__(config, ports)


class BreaksOnTheWay(Axis):
    """It raises in the middle of a movement; the device is then stopped and closed."""

    after: ClassVar[list[str]] = []

    def step(self, now: float) -> None:
        if self.at > 0.05:
            raise RuntimeError("motor is hot")
        super().step(now)

    def stop(self, now: float) -> None:
        self.after.append("stop")
        super().stop(now)

    def close(self) -> None:
        self.after.append("close")


class Deaf(Axis):
    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if not isinstance(body.get("to"), float):
            raise ValueError("to")


class IgnoresQuickStop(Axis):
    def quick_stop(self, now: float) -> None:
        """Leave the motion to itself."""


class QuickStopsOnce(Axis):
    def quick_stop(self, now: float) -> None:
        if self.stopped():
            raise RuntimeError("already stopped")
        self.stop(now)


class Backwards(Axis):
    period = -0.01


class WaitsOnce(Axis):
    """A single step of some hundred, which a busy computer could also have delayed."""

    def step(self, now: float) -> None:
        super().step(now)
        if self.cycles == 150:
            time.sleep(0.05)


class WaitsInStop(Axis):
    def stop(self, now: float) -> None:
        super().stop(now)
        time.sleep(0.05)


class IgnoresCommands(Axis):
    """While it moves."""

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        goal, still = self.goal, self.stopped()
        super().command(now, body)
        self.goal = self.goal if still else goal


class Creeps(Axis):
    """While it is held, by 5 mm/s."""

    def step(self, now: float) -> None:
        super().step(now)
        self.at -= 0.00005 if self.paused else 0.0


class Sags(Axis):
    """While it is held, it moves at a hundredth of its speed: too slow to be seen at once."""

    def step(self, now: float) -> None:
        super().step(now)
        self.at += 0.00001 * self.paused


class Clamps(Axis):
    """Goes at most to 0.15 m, and does not say so."""

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        super().command(now, body)
        self.goal = min(0.15, self.goal)


class CatchesUp(Axis):
    """After a hold it is where it would have been without."""

    missed = 0

    def step(self, now: float) -> None:
        self.missed += self.paused
        super().step(now)
        for _ in range(0 if self.paused else self.missed):
            super().step(now)
        self.missed *= self.paused


class GoesOnAfterAStop(Axis):
    """Its stop forgets the movement that is held, and its release does not."""

    kept = 0.0

    def hold(self, now: float) -> str:
        self.kept, self.goal = self.goal, self.at
        return "held"

    def release(self, now: float) -> None:
        self.goal = self.kept


class Grows(Axis):
    def state(self) -> Mapping[str, Any]:
        return {**super().state(), "moves": "." * self.cycles}


class TooLarge(Axis):
    def state(self) -> Mapping[str, Any]:
        return {**super().state(), "image": bytes(100_001)}


class DividesByZero(Axis):
    def state(self) -> Mapping[str, Any]:
        moving = self.at != self.goal
        return {**super().state(), "load": {"mean": 1.0 if moving else math.nan}}


class LeavesAThread(Axis):
    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        threading.Thread(target=time.sleep, args=[60], name="reader", daemon=True).start()


class LeavesAThreadForEachCommand(Axis):
    """The first of them could be one that its library keeps."""

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        super().command(now, body)
        threading.Thread(target=time.sleep, args=[60], name="sender", daemon=True).start()


class HasAListAsState(Axis):
    def state(self) -> Any:
        return [self.at]


class ForgetsItsAnswer(Axis):
    def stopped(self) -> Any:
        super().stopped()


class HidesAMethodLater(Axis):
    def step(self, now: float) -> None:
        super().step(now)
        self.stopped: Any = self.goal is None


class WritesItsPeriod(Axis):
    period: Any = "0.01"


class CannotBeClosed(Axis):
    def close(self) -> None:
        raise OSError("the port is gone")


class LeavesInItsStep(Axis):
    def step(self, now: float) -> None:
        super().step(now)
        sys.exit("the library has had enough")


class InterruptsItsStep(Axis):
    def step(self, now: float) -> None:
        super().step(now)
        raise KeyboardInterrupt


class InterruptsItsEnd(Axis):
    def close(self) -> None:
        raise KeyboardInterrupt


class LeavesWhenMade(Axis):
    def setup(self) -> None:
        sys.exit("no licence")


class EndsTheProcess(Axis):
    def stop(self, now: float) -> None:
        os._exit(0)


class Hangs(Axis):
    how = "stop"

    def stop(self, now: float) -> None:
        if self.how == "stop":
            time.sleep(60.0)
        super().stop(now)

    def close(self) -> None:
        if self.how == "close":
            time.sleep(60.0)


class HangsInClose(Hangs):
    how = "close"


class WithAThread(Axis):
    """Its thread, which must do something, ends when it is closed."""

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.end, self.moved = threading.Event(), threading.Event()
        self.thread = threading.Thread(target=self.work, name="reader", daemon=True)
        self.thread.start()

    def work(self) -> None:
        self.end.wait(60.0)

    def step(self, now: float) -> None:
        super().step(now)
        self.moved.set()

    def close(self) -> None:
        self.end.set()
        self.moved.set()


class WaitsForItsThread(WithAThread):
    def step(self, now: float) -> None:
        super().step(now)
        if self.cycles == 150:
            self.end.wait(0.05)


class ItsThreadComputes(WithAThread):
    """It only takes the interpreter's lock, as every thread."""

    def work(self) -> None:
        limit = Limit("the end of the check")
        while not self.end.wait(0.001) and limit.left():
            sum(range(20_000))


class ItsThreadRaises(WithAThread):
    def work(self) -> None:
        self.moved.wait(60.0)
        raise RuntimeError("the reader has lost its line")


class ItsThreadKeepsTheLock(WithAThread):
    def work(self) -> None:
        limit = Limit("the end of the check")
        while not self.end.is_set() and limit.left():
            ctypes.PyDLL(None).usleep(60_000)


class LeavesAProcess(Axis):
    left: ClassVar[list[subprocess.Popen[bytes]]] = []

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.left.append(subprocess.Popen(["sleep", "60"]))


@pytest.fixture
def ends_processes() -> Iterator[None]:
    yield
    for process in LeavesAProcess.left:
        process.wait(60.0)  # the check has killed it


class DrawsByItself(Axis):
    def step(self, now: float) -> None:
        super().step(now)
        self.at += random.gauss(0.0, 1e-5) if self.at != self.goal else 0.0


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        (WaitsOnce, "calls waited, the longest 0."),
        (WaitsInStop, "stop: "),
        (IgnoresCommands, "{'to': 0.2}: accepted during {'to': 0.0}, and axis[0].at moved on"),
        (Creeps, "hold: answered 'held', and axis[0].at still changes"),
        (Sags, "hold: answered 'held', and axis[0].at still changes"),
        (Clamps, "{'to': 0.2}: accepted, and axis[0].at ended at 0.15; obey to, or raise"),
        (CatchesUp, "release: axis[0].at jumps instead of moving on"),
        (GoesOnAfterAStop, "release: the movement that was held and then stopped continues"),
        (Grows, "state: moves grows all the time"),
        (DividesByZero, "state: load.mean is NaN; what is not known yet is None, or left out"),
        (TooLarge, "state: has more than 100,000 items and characters, most of them in image"),
        (LeavesAThread, "close: leaves a thread behind: reader"),
        (LeavesAThreadForEachCommand, "close: leaves a thread behind: sender"),
        (HasAListAsState, "state: expected a table, got [0.0]"),
        (ForgetsItsAnswer, "stopped: expected True or False, got None"),
        (HidesAMethodLater, "TypeError: 'bool' object is not callable"),
        (WritesItsPeriod, "period: expected seconds above 0 or None, found '0.01'"),
        (CannotBeClosed, "close: OSError: the port is gone in close (test_conformance.py:"),
        (LeavesInItsStep, "SystemExit: the library has had enough in step (test_conformance.py:"),
        (InterruptsItsStep, "the driver raised KeyboardInterrupt:  in step (test_conformance.py:"),
        (InterruptsItsEnd, "close: KeyboardInterrupt:  in close (test_conformance.py:"),
        (LeavesWhenMade, "it cannot be made: SystemExit: no licence in setup ("),
        (EndsTheProcess, "SystemExit: it called os._exit(0) in stop (test_conformance.py:"),
        (Hangs, "Hung: did not come back in time"),
        (HangsInClose, "Hung: did not come back in time"),
        pytest.param(
            LeavesAProcess,
            "close: leaves a process behind: sleep",
            marks=pytest.mark.processes,
        ),
        (WaitsForItsThread, "calls waited, the longest 0."),
        (ItsThreadRaises, "thread reader: RuntimeError: the reader has lost its line"),
        (ItsThreadKeepsTheLock, "a thread of the driver kept the interpreter"),
        (DrawsByItself, "two runs with the same seed differ in axis[0].at"),
        (IgnoresQuickStop, "quick_stop during a movement: stopped() is still False after 1 s"),
        (QuickStopsOnce, "quick_stop, a second time: RuntimeError: already stopped"),
        (Backwards, "period: expected seconds above 0 or None, found -0.01"),
        (NeverStops, "stop during a movement: stopped() is still False after 1 s"),
        (
            SaysItStands,
            "stopped: True during {'to': 0.2}, while axis[0].at changed; if that is measured",
        ),
        (RunsOnAfterStop, "stop during a movement: stopped() is True, and axis[0].at still"),
        (StopsOnce, "stop, a second time: RuntimeError: already stopped"),
        (TakesAll, "command: accepted"),
        (HoldsInWords, "hold: answered 'held', and axis[0].at still changes"),
        (HoldsForGood, "release: the movement that was held does not continue"),
        (IsShorter, "{'to': 0.2}: refused: ValueError: to: at most 0.15"),
        (WrongAnswer, 'hold: expected "held", "cannot hold" or "stopped", got \'ok\''),
        (Waits, "took longer than the period of 0.01 s, the longest"),
        (StrangeState, "state: expected plain data"),
        (CannotBeMadeAgain, "close and a second driver of the same configuration: OSError: port"),
        (BreaksOnTheWay, "the driver raised RuntimeError: motor is hot"),
        (Deaf, "{'to': 0.2}: no number of state changes"),
    ],
)
@pytest.mark.usefixtures("ends_processes")
def test_each_broken_rule_is_named(
    kind: type[Axis], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watchdog, "LIMIT", 2.0)
    check = checked(kind)
    # On a very busy computer it cannot be told whose a wait is.
    waiting = kind in (WaitsOnce, WaitsInStop, WaitsForItsThread, ItsThreadKeepsTheLock)
    found = [*check.faults, *(check.busy if waiting else ())]
    assert any(fault in one for one in found), found
    assert kind is not BreaksOnTheWay or BreaksOnTheWay.after[-2:] == ["stop", "close"]


@pytest.mark.parametrize("kind", [HasAListAsState, StrangeState, ForgetsItsAnswer, WritesItsPeriod])
def test_what_cannot_be_judged_ends_the_check_with_one_fault(kind: type[Axis]) -> None:
    assert len(checked(kind).faults) == 1


class StandsInTheQueue(Axis):
    """Its step takes long, because other programs have the processor."""

    queued = 0.0

    def step(self, now: float) -> None:
        super().step(now)
        begin = time.perf_counter()
        time.sleep(0.02)
        StandsInTheQueue.queued += time.perf_counter() - begin


def test_a_step_is_not_blamed_for_what_other_programs_take(monkeypatch: pytest.MonkeyPatch) -> None:
    def check() -> list[str]:
        made = lambda: StandsInTheQueue({}, cast(Ports, None))  # noqa: E731
        found = check_driver(made, seconds=0.5, within=0.05)
        return [one for one in found.faults if "took longer than the period" in one]

    monkeypatch.setattr(conformance, "LATE_SHARE", 0.5)  # what this computer itself takes
    assert check()
    monkeypatch.setattr(
        conformance._Check,
        "scheduled",
        lambda _: (time.thread_time(), StandsInTheQueue.queued),
    )
    assert check() == []


class Switched(Axis):
    """Its drives must be switched on; what was ordered last is kept by its device."""

    on = False
    ordered: float | None = None

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if body == {"on": True}:
            self.on = True
        elif not self.on:
            raise ValueError("switch it on first")
        else:
            super().command(now, body)
            type(self).ordered = self.goal


class KeepsItsOrder(Switched):
    """Switched on, it goes on with what the driver before it was given."""

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        super().command(now, body)
        if "on" in body and self.ordered is not None:
            self.goal = self.ordered


def test_a_new_driver_does_not_go_on_with_the_orders_of_the_one_before() -> None:
    assert checked(Switched, first=[{"on": True}]).faults == []
    fault = "made again during a movement: axis[0].at changes before it has got a command"
    assert fault in checked(KeepsItsOrder, first=[{"on": True}]).faults


class Pump(Axis):
    """It has no position and runs until it is stopped."""

    def step(self, now: float) -> None:
        goal = 0.0 if self.paused else self.goal
        self.at += max(-0.01, min(0.01, goal - self.at))

    def stop(self, now: float) -> None:
        self.goal = 0.0

    def stopped(self) -> bool:
        return self.at == 0.0


class NeverArrives(Axis):
    """Stands, and says that it does not."""

    def stopped(self) -> bool:
        return False


class Outputs(Axis):
    """It switches at once, and nothing moves."""

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        super().command(now, body)
        self.at = self.goal


class RefusesWhileItMoves(Axis):
    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if not self.stopped():
            raise ValueError("it moves")
        super().command(now, body)


class Turntable(Axis):
    """Commanded in other units than those of its state; it settles slowly."""

    def step(self, now: float) -> None:
        way = 0.1 * (self.goal - self.at)
        self.at += 0.0 if self.paused or abs(way) < 1e-9 else way

    def state(self) -> Mapping[str, Any]:
        return {"degrees": math.degrees(self.at), "cosine": math.cos(self.at)}

    def stopped(self) -> bool:
        return self.paused or abs(self.goal - self.at) < 1e-4


class Remembers(Axis):
    """Its state has its last 200 positions."""

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.past = deque[float](maxlen=200)

    def step(self, now: float) -> None:
        super().step(now)
        self.past.append(self.at)

    def state(self) -> Mapping[str, Any]:
        return {**super().state(), "past": [*self.past]}


@pytest.mark.parametrize("commands", [[{"to": 0.8}, {"to": 0.0}], [{"to": 0.0}, {"to": 0.8}]])
def test_a_movement_that_is_slow_is_not_the_drivers_fault(
    commands: list[dict[str, float]],
) -> None:
    """Its consequences are not reported as faults of their own."""
    found = check_driver(Obedient, commands, simulated=True)
    assert len(found.faults) == 1
    assert "took longer than `seconds` = 5 s" in found.faults[0]
    assert check_driver(Obedient, commands, seconds=9.0, simulated=True).faults == []
    assert "stopped() is still False after 1 s" in checked(NeverArrives).faults[-1]


@pytest.mark.parametrize(
    ("kind", "notes"),
    [(Pump, "it moves nothing after"), (Outputs, "it changes the state at once"),
     (RefusesWhileItMoves, ""), (Remembers, ""), (Turntable, "")],
)  # fmt: skip
def test_unusual_drivers_that_keep_the_rules_pass(kind: type[Axis], notes: str) -> None:
    found = checked(kind)
    assert found.faults == [] and notes in "; ".join(found.notes)


class Unplugged(Axis):
    """Its step raises while the cable is unplugged."""


class NoticesNothing(Axis):
    """It reports that it stands still, whatever happens to its cable."""

    def step(self, now: float) -> None:
        type(self).plugged = True
        super().step(now)


class Survives(Axis):
    """It does not raise without its cable, and works with it again."""

    def step(self, now: float) -> None:
        if self.plugged:
            super().step(now)

    def stopped(self) -> bool:
        return self.plugged and super().stopped()


class StaysAway(Survives):
    """It accepts commands after its cable was pulled, but it is lost for good."""

    lost = False

    def step(self, now: float) -> None:
        self.lost = self.lost or not self.plugged
        if not self.lost:
            super().step(now)


class KnowsThatItIsLost(StaysAway):
    """And its state is never again that of a device that stands still."""

    def stopped(self) -> bool:
        return not self.lost and super().stopped()


class MovesByItself(Survives):
    """With its cable again it goes on with the last command."""

    def stop(self, now: float) -> None:
        if self.plugged:
            super().stop(now)


@pytest.mark.parametrize(
    ("kind", "faults"),
    [
        (Unplugged, []),
        (Survives, []),
        (NoticesNothing, ["cable pulled: stopped() is still True after 5 s"]),
        (StaysAway, ["cable put back: {'to': 0.2} moves nothing"]),
        (MovesByItself, ["cable put back: axis[0].at changes before it has got a command"]),
    ],
)
def test_a_cable_that_is_pulled_and_put_back(kind: type[Axis], faults: list[str]) -> None:

    def cable(there: bool) -> None:
        kind.plugged = there

    found = checked(kind, cable=cable)
    assert found.faults == faults and not found.notes


@pytest.mark.parametrize(
    ("kind", "faults"),
    [
        (Survives, []),
        (KnowsThatItIsLost, ["cable put back: stopped() is still False after 5 s"]),
    ],
)
def test_the_cable_of_a_driver_that_gets_no_commands(kind: type[Axis], faults: list[str]) -> None:

    def cable(there: bool) -> None:
        kind.plugged = there

    made = partial(kind, {}, cast(Ports, None))
    assert check_driver(made, cable=cable, simulated=True).faults == faults


class Button(Driver):
    """A sensor, which has no movement that could be stopped or held."""

    period = 0.1


def test_a_sensor_is_asked_for_no_commands() -> None:
    asked = "give two commands, there and back"
    for kind, wanted in ((Button, False), (Axis, True)):
        made = partial(kind, {}, cast(Ports, None))
        found = check_driver(made, simulated=True)
        assert found.faults == [] and (asked in "; ".join(found.notes)) is wanted


def test_a_driver_without_cycles_has_no_movements_to_check() -> None:
    found = check_driver(lambda: Driver({}, cast(Ports, None)), simulated=True)
    assert found.faults == [] and "has no `period`" in found.notes[0]


class Gripper(Driver):
    """Its state has no number: nothing tells where it is."""

    period = 0.02
    obeys = ("speed", "dry_run")
    left = 0.0
    shut = False

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if body.get("do") not in ("close", "open"):
            raise ValueError(f"do: expected close or open, got {body.get('do')!r}")
        self.left, self.shut = 0.3 / self.speed, body["do"] == "close" and not self.dry_run

    def step(self, now: float) -> None:
        self.left = max(0.0, self.left - self.period)

    def state(self) -> Mapping[str, Any]:
        return {"shut": self.shut}

    def stop(self, now: float) -> None:
        self.left = 0.0

    def stopped(self) -> bool:
        return self.left == 0.0


def test_without_a_position_nothing_measures_its_limits() -> None:
    found = check_driver(Gripper, [{"do": "open"}, {"do": "close"}], simulated=True)
    assert "not checked: speed, dry_run: no number of the state tells where the device is" in (
        found.notes
    )
    assert not [text for text in found.faults if "raised" in text], found


class SpeedyAxis(Axis):
    """It says that it obeys `speed`."""

    obeys = ("speed",)


def test_a_bug_of_the_check_is_not_a_fault_of_the_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conformance, "SLOW", 0.0)
    with pytest.raises(ZeroDivisionError):
        check_driver(SpeedyAxis, [{"to": 0.1}, {"to": 0.2}], simulated=True)


def test_keys_of_the_table_may_be_given() -> None:
    """As the location file has them; the tests of `speed` add theirs."""

    class Far(SpeedyAxis):
        reach: float = key(0.0, "m")

        def setup(self) -> None:
            made.append((self.reach, self.speed))

    made: list[tuple[float, float]] = []
    check_driver(Far, [{"to": 0.1}, {"to": 0.2}], {"reach": 2.0}, simulated=True)
    assert {reach for reach, _ in made} == {2.0} and {speed for _, speed in made} >= {1.0, 0.25}


class Wraps(Driver):
    """A turntable (degrees, or rad) whose angle wraps round, with a noisy encoder."""

    period = 0.01
    obeys = ("pause",)
    turn, low = 360.0, 0.0

    def setup(self) -> None:
        self.angle, self.goal = 0.0, 0.0

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if set(body) != {"to"}:
            raise ValueError("to: expected an angle")
        self.goal = float(body["to"])

    def step(self, now: float) -> None:
        off = self.goal - self.angle
        off -= self.turn * round(off / self.turn)
        if not self.paused:
            self.angle += max(-self.turn / 400, min(self.turn / 400, off))
            self.angle -= self.turn * (self.angle >= self.turn + self.low)
            self.angle += self.turn * (self.angle < self.low)

    def state(self) -> Mapping[str, Any]:
        noise = float(self.ports.random("encoder").normal(0.0, 1e-5 * self.turn))
        return {"angle": (self.angle + noise - self.low) % self.turn + self.low}

    def stop(self, now: float) -> None:
        self.goal = self.angle

    def stopped(self) -> bool:
        off = abs(self.goal - self.angle)
        return min(off, abs(off - self.turn)) < 1e-9


class WrapsRadians(Wraps):
    turn, low = 2.0 * math.pi, -math.pi


class WrapsAndDoesNotHold(Wraps):
    def hold(self, now: float) -> str:
        return "held"


class Belt(Axis):
    """Moves by a distance: `to`."""

    def stopped(self) -> bool:
        return abs(self.at - self.goal) < 1e-9

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        super().command(now, body)
        self.goal = self.at + body["to"]


class Slow(Axis):
    """Approaches its goal ever more slowly, and refuses commands until it is there."""

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if not self.stopped() and body != conformance.UNKNOWN:
            raise ValueError("it moves")
        super().command(now, body)

    def step(self, now: float) -> None:
        if not self.paused:
            far = self.goal - self.at
            self.at += max(-0.002, min(0.002, 0.05 * far)) if abs(far) > 1e-5 else far


class SlowAndDeaf(Slow):
    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if self.stopped() or body == conformance.UNKNOWN:
            super().command(now, body)


class GoesOn(Axis):
    """Its stop does nothing, which a short movement hides."""

    def stop(self, now: float) -> None:
        pass


@pytest.mark.parametrize(
    ("kind", "commands", "found"),
    [
        (Wraps, ({"to": 350.0}, {"to": 170.0}), ""),
        (Wraps, ({"to": 0.0}, {"to": 120.0}), ""),
        (WrapsRadians, ({"to": 3.0}, {"to": -3.0}), ""),
        (WrapsAndDoesNotHold, ({"to": 350.0}, {"to": 170.0}), "hold: answered 'held', and angle"),
        (Belt, ({"to": 0.4}, {"to": -0.4}), ""),
        (Slow, ({"to": 0.4}, {"to": 0.0}), ""),
        (SlowAndDeaf, ({"to": 0.4}, {"to": 0.0}), "accepted during {'to': 0.0}, and axis"),
        (GoesOn, ({"to": 0.1}, {"to": 0.02}), "not checked: stop during {'to': 0.1}: it went on"),
    ],
)
def test_devices_that_people_have(
    kind: type[Driver], commands: tuple[Mapping[str, Any], ...], found: str
) -> None:
    """Angles that wrap round, distances instead of places, ends that are approached slowly."""
    check = check_driver(kind, commands, simulated=True)
    told = check.faults + [text for text in check.notes if "stop during" in text]
    assert any(found in text for text in told) if found else told == [], check


def test_a_sensor_is_watched_until_its_state_has_grown() -> None:
    class Sensor(Driver):
        period = 0.01

        def setup(self) -> None:
            self.past: list[float] = []

        def step(self, now: float) -> None:
            self.past.append(now)

        def state(self) -> Mapping[str, Any]:
            return {"past": list(self.past)}

    (fault,) = check_driver(Sensor, simulated=True).faults
    assert fault.startswith("state: past grows all the time")


def test_a_stop_that_always_waits_is_told_on_a_busy_computer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Waits(Axis):
        def stop(self, now: float) -> None:
            time.sleep(0.1)
            super().stop(now)

    monkeypatch.setattr(conformance, "BUSY", -1.0)
    found = check_driver(Waits, [{"to": 0.1}, {"to": 0.0}], simulated=True)
    (fault,) = found.faults
    assert fault.startswith("stop: ") and "calls waited" in fault


def test_a_step_that_waits_now_and_then_is_told_on_a_busy_computer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As one whose library sends a question now and then, and waits for the answer."""

    class Waits(Axis):
        def step(self, now: float) -> None:
            super().step(now)
            if self.cycles % 100 == 0:
                time.sleep(0.1)

    monkeypatch.setattr(conformance, "BUSY", -1.0)
    found = check_driver(Waits, [{"to": 0.1}, {"to": 0.0}], simulated=True)
    (fault,) = found.faults
    assert fault.startswith("step: ") and "calls waited" in fault
