"""Checks that a driver keeps the rules of `services.device.Driver`: in a user's test, or as
`petrobot test driver NAME`.

The driver is run beside its device, or beside a simulation of it: it gets your commands, is stopped
and held in the middle of a movement, closed and made again. Positions are found by themselves: they
are the numbers of `state` that change during a movement and not at rest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.device import Driver

Command = Mapping[str, Any]
REST, PART = 20, 0.25
"""Steps at rest that show which numbers change then, too; the part of a movement after which it is
stopped or held."""
LATE_SHARE = 0.02
"""Share of steps that may take longer than the period: a busy computer delays some."""
STARTING = 2
"""Steps of a movement in which `stopped` may still be True."""
UNKNOWN: Command = {"no driver knows this command": True}


@dataclass
class DriverCheck:
    """What was found. `faults` is empty for a driver that keeps the rules."""

    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What was not checked, and why."""


def check_driver(
    make: Callable[[], Driver],
    commands: Sequence[Command] = (),
    *,
    seconds: float = 5.0,
    within: float = 1.0,
    cable: Callable[[bool], None] | None = None,
    simulated: bool = False,
) -> DriverCheck:
    """Check a driver that `make()` makes anew each time.

    `commands` are two or more that lead to different places, each in at most `seconds`, better in
    more than `within`; the device must stand still `within` s after `stop`. `cable(False)` pulls
    the device's cable, `cable(True)` puts it back. `simulated`: time passes only between two steps,
    for a driver whose device is simulated by its steps; the check then takes milliseconds.
    """
    check = _Check(make, _Clock() if simulated else time, within)
    try:
        check.rules(commands, seconds, cable)
    except Exception as fault:
        check.fault(f"the driver raised {type(fault).__name__}: {fault}")
    finally:  # also after Ctrl-C: the device may be moving
        check.end()
    return check.found


def check_device(
    directory: Directory,
    name: str,
    commands: Sequence[Command] = (),
    *,
    seconds: float = 5.0,
    within: float = 1.0,
) -> DriverCheck:
    """Check the driver of a device of a location file, in this process and in real time. Raises
    ValueError when there is none, or when it cannot be made."""
    from petrobot.services.node.drivers import make_driver
    from petrobot.services.node.ports import ProcessPorts

    entry = directory.devices.get(name)
    if entry is None or not entry.driver:
        known = ", ".join(sorted(d.name for d in directory.devices.values() if d.driver))
        raise ValueError(f"no device with a driver of this name; there are: {known or 'none'}")

    def make() -> Driver:
        ports = ProcessPorts(directory, entry, time.monotonic, {})
        driver = make_driver(directory, entry, ports)
        ports.draws.reseed(0)
        return driver

    return check_driver(make, commands, seconds=seconds, within=within)


class _Clock:
    """Time that passes only where somebody sleeps (s)."""

    def __init__(self) -> None:
        self._now = 0.0

    def monotonic(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += seconds


class _Check:
    """One driver after the other, and what is wrong with it."""

    def __init__(
        self,
        make: Callable[[], Driver],
        clock: Any,
        within: float,
    ) -> None:
        self.make, self.within = make, within
        self.now: Callable[[], float] = clock.monotonic
        self.sleep: Callable[[float], None] = clock.sleep
        self.found = DriverCheck()
        self.steps = self.late = 0
        self.longest = 0.0
        self.driver = make()
        self.period = self.driver.period or 0.01
        self.always = set[str]()
        """Numbers of the state that change at rest, too."""

    def fault(self, text: str) -> None:
        if text not in self.found.faults:
            self.found.faults.append(text)

    def note(self, text: str) -> None:
        self.found.notes.append(f"not checked: {text}")

    def numbers(self) -> dict[str, float]:
        """The numbers of the state, by path."""
        try:
            state = plain(self.driver.state(), "state")
        except Exception as fault:
            self.fault(f"state: expected plain data, got {type(fault).__name__}: {fault}")
            return {}
        return dict(_leaves(state, ""))

    def step(self) -> dict[str, float]:
        """One step, its time taken; gives the numbers of the state after it."""
        begin = self.now()
        if self.driver.period is not None:
            self.driver.step(begin)
        numbers = self.numbers()
        took = self.now() - begin
        self.steps, self.late = self.steps + 1, self.late + (took > self.period)
        self.longest = max(self.longest, took)
        self.sleep(max(0.0, self.period - took))
        return numbers

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> set[str]:
        """Step for so long; gives the names of the numbers that changed."""
        before, changed, end = self.numbers(), set[str](), self.now() + seconds
        while self.now() < end and not until():
            after = self.step()
            changed |= {name for name in after if after[name] != before.get(name)}
            before = after
        return changed

    def rules(
        self, commands: Sequence[Command], seconds: float, cable: Callable[[bool], None] | None
    ) -> None:
        """Check all rules that the driver, the commands and the cable let check."""
        self.life()
        if self.driver.period is None:
            self.note("steps, commands and movements: the driver has no `period`")
        else:
            self.refusal()
            for there, back in pairwise([*commands, *commands[:1]] if len(commands) > 1 else ()):
                self.movements(there, back, seconds)
            if len(commands) < 2:
                self.note("stop and hold during a movement: give two commands, there and back")
        if cable is None:
            self.note("a pulled cable: give `cable`")
        else:
            self.cable(cable, seconds)

    def life(self) -> None:
        """Made, closed, made again; stopped at rest, twice."""
        if self.driver.period is not None and not self.driver.period > 0.0:
            self.fault(f"period: expected seconds above 0 or None, got {self.driver.period!r}")
        self.always = self.run(REST * self.period)
        self.again("close and a second driver of the same configuration")
        self.stop("stop at rest")

    def again(self, what: str) -> None:
        """Close the driver and make another one."""
        try:
            self.driver.close()
            self.driver = self.make()
            self.run(REST * self.period)
        except Exception as fault:
            self.fault(f"{what}: {type(fault).__name__}: {fault}")

    def refusal(self) -> None:
        try:
            self.driver.command(self.now(), UNKNOWN)
        except Exception:  # the rule: any exception refuses
            return
        self.fault(f"command: accepted {dict(UNKNOWN)}; raise ValueError for what it does not know")

    def movements(self, there: Command, back: Command, seconds: float) -> None:
        """One to its end, one stopped on its way, one held on its way and released."""
        self.move(back, seconds)
        begin = self.now()
        positions = self.move(there, seconds)
        took = self.now() - begin - REST * self.period
        if not positions:
            self.fault(f"{dict(there)}: no number of state changes: give a command that moves it")
            return
        self.stands(f"after {dict(there)}", positions)
        self.move(back, PART * took)
        self.stop("stop during a movement", positions)
        self.move(there, seconds)
        self.move(back, PART * took)
        answer = self.driver.hold(self.now())
        if answer not in ("held", "cannot hold", "stopped"):
            self.fault(f'hold: expected "held", "cannot hold" or "stopped", got {answer!r}')
        if answer in ("held", "stopped"):
            self.run(self.within)
            if drift := self.run(REST * self.period) & positions:
                self.fault(f"hold: answered {answer!r}, and {_names(drift)} still changes")
        self.driver.release(self.now())
        if answer == "held" and not self.run(seconds) & positions:
            self.fault("release: the movement that was held does not continue")
        self.stop("stop", positions)

    def move(self, command: Command, seconds: float) -> set[str]:
        """Give a command and step for so long, or until it stands again; gives the positions that
        changed."""
        try:
            self.driver.command(self.now(), command)
        except Exception as fault:
            self.fault(f"{dict(command)}: refused: {type(fault).__name__}: {fault}")
        before, positions, resting, untrue = self.numbers(), set[str](), 0, 0
        end = self.now() + seconds
        while self.now() < end and resting < REST:
            still = self.driver.stopped()
            after = self.step()
            changed = {name for name in after if after[name] != before.get(name)} - self.always
            before, positions = after, positions | changed
            resting = 0 if changed else resting + 1
            untrue += bool(still and changed)
        if untrue > STARTING:
            self.fault(f"stopped: True during {dict(command)}, while {_names(positions)} changed")
        return positions

    def stop(self, what: str, positions: set[str] | None = None) -> None:
        """Stop it, twice."""
        self.driver.stop(self.now())
        try:
            self.driver.stop(self.now())
        except Exception as fault:
            self.fault(f"stop, a second time: {type(fault).__name__}: {fault}")
        self.stands(what, positions)

    def stands(self, what: str, positions: set[str] | None = None) -> None:
        """It says that it stands still within the limit, and does."""
        self.run(self.within, self.driver.stopped)
        if not self.driver.stopped():
            self.fault(f"{what}: stopped() is still False after {self.within:g} s")
        elif drift := self.run(REST * self.period) & (positions or set()):
            self.fault(f"{what}: stopped() is True, and {_names(drift)} still changes")

    def cable(self, cable: Callable[[bool], None], seconds: float) -> None:
        """Without its cable a driver raises, or no longer says that it stands; with it, a new one
        works."""
        cable(False)
        try:
            self.driver.stop(self.now())
            self.run(seconds, lambda: not self.driver.stopped())
            if self.driver.stopped():
                self.fault(f"cable pulled: stopped() is still True after {seconds:g} s")
        except Exception:  # the rule: the node then makes a new one
            pass
        cable(True)
        self.again("cable put back")

    def end(self) -> None:
        """Stop and close the driver, whatever happened."""
        try:
            self.driver.stop(self.now())
        except Exception as fault:
            self.fault(f"stop at the end: {type(fault).__name__}: {fault}")
        finally:
            self.driver.close()
        if self.late > LATE_SHARE * self.steps:
            self.fault(
                f"step: {self.late} of {self.steps} took longer than the period of "
                f"{self.period:g} s, the longest {self.longest:.3f} s: it must not wait"
            )


def _leaves(value: Any, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _leaves(part, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list | tuple):
        for number, part in enumerate(value):
            yield from _leaves(part, f"{path}[{number}]")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, float(value)


def _names(found: set[str]) -> str:
    return ", ".join(sorted(found))
