"""A rig for the motion tests: the driver `Arm` on a bus of simulated drives of a simple arm, with
its own clock."""

from __future__ import annotations

import importlib
import math
import threading
import time
import tomllib
from collections import deque
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from petrobot.services.action import Cancelled, CommandRefused, Result, Status, Wait
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.byte_stream import CanHub
from petrobot.services.motion.arm import PERIOD, Arm
from petrobot.services.motion.model import nominal_arm
from petrobot.sim.catching.drives import ArmBus, ratings
from tests.bare_ports import BarePorts

TABLE = tomllib.loads(
    files("petrobot.services.motion").joinpath("puma560.toml").read_text(encoding="utf-8")
)


class LiveHub:
    """A hub, polled by a thread until it is closed. Simulated drives on it live in wall-clock
    time."""

    def __init__(self, hub: CanHub, step: Callable[[float], None] = lambda now: None) -> None:
        self.channel = hub.channel
        self._hub, self._step = hub, step
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._live)
        self._thread.start()

    def _live(self) -> None:
        start = time.monotonic()
        while not self._over.is_set():
            self._hub.poll(0.001)
            self._step(time.monotonic() - start)
        self._hub.close()

    def close(self) -> None:
        self._over.set()
        self._thread.join()


def live_drives(bus: Any, step: Callable[[float], None]) -> LiveHub:
    """Put simulated drives on a hub of their own."""
    hub = CanHub()
    port = hub.port()

    def live(now: float) -> None:
        for frame in port.receive():
            bus.receive(now, frame)
        step(now)
        for frame in bus.drain():
            port.send(frame)

    return LiveHub(hub, live)


def canopen_network(live: LiveHub) -> Iterator[Any]:
    """Yield the network of an independent CANopen master on a hub, and end both."""
    network = importlib.import_module("canopen").Network()
    network.connect(interface="petrobot_stream", channel=live.channel)
    yield network
    for node in network.values():
        if node.id < 3:  # a drive
            node.rpdo[1].stop()
    network.sync.stop()
    network.disconnect()
    live.close()


class SimplePlant:
    """Six uncoupled joints: inertia, gravity on joints 2 and 3, dry and viscous friction,
    brakes."""

    GRAVITY = (0.0, 37.0, 9.0, 0.0, 0.3, 0.0)

    def __init__(self, q: Sequence[float]) -> None:
        self.q = [float(angle) for angle in q]
        self.qd = [0.0] * 6
        self.braked = [True] * 6
        self.tau = [0.0] * 6
        self._inertia = [float(joint["inertia"]) for joint in TABLE["joint"]]
        self._viscous = [joint["viscous"] * joint["gear"] ** 2 for joint in TABLE["joint"]]
        self._dry = [joint["coulomb"] * joint["gear"] for joint in TABLE["joint"]]
        self.factor = 1.0

    def brake(self, joint: int) -> None:
        self.braked[joint] = True
        self.qd[joint] = 0.0

    def release(self, joint: int) -> None:
        self.braked[joint] = False

    def slow_down(self, factor: float) -> None:
        self.factor = factor

    def step(self, dt: float, tau: Sequence[float]) -> None:
        self.tau = list(tau)
        angle = self.q[1], self.q[1] + self.q[2] + math.pi / 2
        load = [
            0.0,
            self.GRAVITY[1] * math.cos(angle[0]),
            self.GRAVITY[2] * math.cos(angle[1]),
            0.0,
            self.GRAVITY[4],
            0.0,
        ]
        for joint in range(6):
            if self.braked[joint]:
                continue
            speed, push = self.qd[joint], tau[joint] - load[joint]
            slip = self._dry[joint]
            drag = slip * math.tanh(speed / 0.01) + self._viscous[joint] * speed
            after = speed + dt * (push - drag) / self._inertia[joint]
            self.q[joint] += 0.5 * dt * (speed + after)
            self.qd[joint] = after


class Wire:
    """Both directions between the arm and its drives. It can be cut, and delivers in the next
    cycle."""

    def __init__(self) -> None:
        self.to_drives: deque[Frame] = deque()
        self.to_arm: list[Frame] = []
        self.cut = False
        self.dead = False
        self.log: list[Frame] | None = None

    def send(self, frame: Frame) -> None:
        if self.dead:
            raise ConnectionError("the bus is dead")
        if self.log is not None:
            self.log.append(frame)
        if not self.cut:
            self.to_drives.append(frame)

    def receive(self) -> Sequence[Frame]:
        if self.dead:
            raise ConnectionError("the bus is dead")
        frames, self.to_arm = self.to_arm, []
        return [] if self.cut else frames

    def close(self) -> None:
        self.dead = True


class Stream:
    """The receiving end of a set-point stream as a node provides it."""

    def __init__(self, rig: Rig, period: float) -> None:
        self._rig, self._period = rig, period
        self._newest: tuple[float, ...] | None = None
        self._came = self._first = -math.inf
        self.count = 0

    def put(self, values: Sequence[float]) -> None:
        if tuple(values) != self._newest:
            self._first = self._rig.now
        self._newest, self._came = tuple(values), self._rig.now
        self.count += 1

    @property
    def held(self) -> float:
        return self._rig.now - self._first

    @property
    def age(self) -> float:
        return self._rig.now - self._came

    @property
    def values(self) -> tuple[float, ...] | None:
        return self._newest if self.age <= 3 * self._period + 1e-9 else None


class Rig(BarePorts):
    """Arm, bus and drives in lock step; it is also the arm's `Ports`."""

    def __init__(
        self,
        start: Sequence[float] | None = None,
        config: Mapping[str, Any] | None = None,
        plant: Any = None,
        drives: Any = None,
    ) -> None:
        self.cycle = 0
        self.events: list[str] = []
        self.wire = Wire()
        self.stream_port = Stream(self, 0.02)
        home = nominal_arm().poses["home"]
        self.plant = (
            plant if plant is not None else SimplePlant(start if start is not None else home)
        )
        self.drives = drives if drives is not None else ArmBus(self.plant, ratings(TABLE))
        self.commanded: list[list[float]] = []
        self.on_step: Callable[[float], None] | None = None
        self.thinking = 0.0
        """Lead of the clock over the start of the cycle (s): the time a cycle takes on a real
        host."""
        self.arm = Arm(config or {}, self)
        self.sync = True

    @property
    def now(self) -> float:
        return self.cycle * PERIOD + self.thinking

    def can(self) -> Wire:
        return self.wire

    def stream(self, name: str) -> Stream:
        assert name == "catch_point"
        return self.stream_port

    def raise_event(self, name: str, **data: Any) -> None:
        self.events.append(name)

    def tick(self, arm_lives: bool = True) -> None:
        """Run one cycle of arm, bus, drives and plant."""
        if arm_lives:
            self.arm.step(self.cycle * PERIOD)
            self.commanded.append(list(self.arm.state()["commanded"]))
        if self.drives is not None:
            self._laboratory()
        self.cycle += 1

    def _laboratory(self) -> None:
        while self.wire.to_drives:
            self.drives.receive(self.now, self.wire.to_drives.popleft())
        for part in range(4):
            now = self.now + part * 0.001
            self.drives.step(now, 0.001)
            if self.on_step is not None:
                self.on_step(now)
        self.wire.to_arm += self.drives.drain()

    def run(self, seconds: float, until: Callable[[], bool] | None = None) -> bool:
        """Run for a time (s), or until a condition holds; return whether it did."""
        for _ in range(round(seconds / PERIOD)):
            if until is not None and until():
                return True
            self.tick()
        return until is None or until()

    def enable(self) -> Rig:
        """Wait until the arm holds with its drives enabled."""
        assert self.run(2.0, lambda: bool(self.arm.state()["enabled"])), self.arm.state()
        return self

    def feed(self, values: Iterable[float]) -> None:
        self.stream_port.put(tuple(values))


@pytest.fixture
def rig() -> Rig:
    """An arm at home, enabled."""
    return Rig().enable()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)


@pytest.fixture
def table() -> dict[str, Any]:
    """puma560.toml as read."""
    return TABLE


@pytest.fixture
def make_plant() -> Callable[[], SimplePlant]:
    """A new simple arm at home."""
    return lambda: SimplePlant(nominal_arm().poses["home"])


@pytest.fixture
def make_rig() -> type[Rig]:
    """Return a function that makes rigs or plays with other settings."""
    return Rig


class FakeRemote:
    """The arm as its actions see it: it accepts commands and publishes its state once per cycle."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.sent: list[Mapping[str, Any]] = []
        self.handled = 0
        self.refused = ""
        self.state: Mapping[str, Any] = rig.arm.state()
        self._published = rig.now

    @property
    def age(self) -> float:
        return self._rig.now - self._published

    def send(self, body: Mapping[str, Any]) -> int:
        self.sent.append(dict(body))
        return len(self.sent)

    def cycle(self) -> None:
        """Do the node's work between two cycles."""
        while self.handled < len(self.sent):
            self.refused = ""
            try:
                self._rig.arm.command(self._rig.now, self.sent[self.handled])
            except ValueError as reason:
                self.refused = str(reason)
            self.handled += 1
        self._rig.tick()
        self.state, self._published = self._rig.arm.state(), self._rig.now


class ArmPlay:
    """Runs an action on a rig; it is also the action's context."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.device = FakeRemote(rig)
        self.run = "test"
        self.verdicts: list[tuple[str, Status, str]] = []

    def verdict(self, run: str, result: Result) -> None:
        """Keep it."""
        self.verdicts.append((run, result.status, result.cause))

    @property
    def now(self) -> float:
        return self.rig.now

    def wait(self, ready: Callable[[], bool], timeout: float | None = None) -> Wait:
        return Wait(ready, None if timeout is None else self.now + timeout)

    def sleep(self, seconds: float) -> Wait:
        return Wait(lambda: False, self.now + seconds)

    async def command(self, body: Mapping[str, Any]) -> None:
        number = self.device.send(body)
        assert await self.wait(lambda: self.device.handled >= number, 1.0)
        if self.device.refused:
            raise CommandRefused(self.device.refused)

    def play(
        self,
        action: Coroutine[Any, Any, Result],
        each: Callable[[ArmPlay], None] | None = None,
        cancel: Callable[[], bool] | None = None,
        most: float = 20.0,
    ) -> Result | None:
        """Run the action to its end; `each` acts as the world in each cycle. Return None if
        `cancel` became true and ended it."""
        wait: Wait = action.send(None)
        until = self.now + most
        while self.now < until:
            if each is not None:
                each(self)
            self.device.cycle()
            if cancel is not None and cancel():
                with pytest.raises(Cancelled):
                    action.throw(Cancelled())
                self.device.cycle()
                return None
            if wait.ready() or (wait.due is not None and self.now >= wait.due - 1e-9):
                try:
                    wait = action.send(None)
                except StopIteration as over:
                    self.device.cycle()
                    result: Result = over.value
                    return result
        raise AssertionError(f"the action did not end in {most} s: {self.device.state}")


@pytest.fixture
def play(rig: Rig) -> ArmPlay:
    """Runs actions on an enabled arm at home."""
    return ArmPlay(rig)


@pytest.fixture
def make_play() -> type[ArmPlay]:
    """Return a function that makes rigs or plays with other settings."""
    return ArmPlay
