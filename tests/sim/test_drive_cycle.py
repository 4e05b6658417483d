"""A drive's fast path through a cycle against the steps of the base class: the same frames for any
sequence of the master."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from petrobot.services.comm.canopen import cia301 as canopen
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import (
    DataType,
    NmtCommand,
    NmtState,
    SdoClient,
    Transfer,
)
from petrobot.services.comm.canopen.cia402 import (
    RECEIVED,
    SENT,
    DriveCommand,
    DriveFault,
    ObjectIndex,
    to_units,
)
from petrobot.sim.catching import drives
from petrobot.sim.catching.drives import ArmBus, DriveRating, ServoDrive
from tests.sim.test_bus import ENABLING
from tests.waiting import Limit

CYCLE = 0.004
RPDO = canopen.pdo_struct(RECEIVED)
READ = (
    (ObjectIndex.STATUSWORD, DataType.UNSIGNED16),
    (ObjectIndex.POSITION, DataType.INTEGER32),
    (ObjectIndex.VELOCITY, DataType.INTEGER32),
)


class Joints:
    """Six joints that behave like flywheels with some friction."""

    def __init__(self) -> None:
        self.q, self.qd, self.braked = [0.0] * 6, [0.0] * 6, [True] * 6

    def brake(self, joint: int) -> None:
        self.braked[joint], self.qd[joint] = True, 0.0

    def release(self, joint: int) -> None:
        self.braked[joint] = False

    def slow_down(self, factor: float) -> None:
        """Ignore the slow-down: flywheels have none."""

    def step(self, dt: float, tau: Any) -> None:
        for joint, torque in enumerate(tau):
            if not self.braked[joint]:
                self.qd[joint] += dt * (torque - 3.0 * self.qd[joint])
                self.q[joint] += dt * self.qd[joint]


class StepByStep(ServoDrive):
    """A drive that never uses the fast path."""

    def after_configuring(self) -> None:
        super().after_configuring()
        self._usual = False


class CycleBench:
    """A bus with one kind of drive, and the frames that they sent."""

    def __init__(self, kind: type[ServoDrive], monkeypatch: pytest.MonkeyPatch) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(drives, "ServoDrive", kind)
            self.bus = ArmBus(Joints(), [DriveRating(40.0, 2.0, 1.0)] * 6)
        self.now, self.sent, self.targets = 0.0, list[Frame](), [0.0] * 6
        for node in range(1, 7):
            self.configure(node)
        self.bus.receive(self.now, canopen.nmt(NmtCommand.START))

    def configure(self, node: int) -> None:
        one, other = canopen.RPDO1_BASE + node, canopen.TPDO1_BASE + node
        transfers = [
            Transfer(ObjectIndex.MODE, 0, DataType.INTEGER8, 8),
            Transfer(ObjectIndex.SYNC_PERIOD, 0, DataType.UNSIGNED32, 4000),
            *canopen.map_pdo(ObjectIndex.RPDO1, ObjectIndex.RPDO1_MAPPING, one, 1, RECEIVED),
            *canopen.map_pdo(ObjectIndex.TPDO1, ObjectIndex.TPDO1_MAPPING, other, 1, SENT),
        ]
        self.transfer(node, *transfers)

    def transfer(self, node: int, *transfers: Transfer) -> None:
        client = SdoClient(node)
        client.begin(transfers)
        limit = Limit("the transfer", steps=1000)
        while client.busy and limit.left():
            for frame in client.advance(self.now):
                self.bus.receive(self.now, frame)
            for frame in self.bus.drain():
                self.sent.append(frame)
                client.receive(frame)
        assert not client.failure

    def cycle(self, word: int, odd: int | None, asks: bool) -> None:
        """Run a cycle with this controlword (the `odd` drive gets another one); a client may read
        objects after it."""
        frames = [
            Frame(
                canopen.RPDO1_BASE + 1 + k, RPDO.pack(0x6 if k == odd else word, to_units(target))
            )
            for k, target in enumerate(self.targets)
        ]
        self.bus.receive_cycle(self.now, [*frames, canopen.SYNC])
        for part in range(2):
            self.bus.step(self.now + 0.002 * part, 0.002)
        self.sent += self.bus.drain()
        if asks:
            for index, kind in READ:
                self.transfer(2, Transfer(index, 0, kind))
        self.now += CYCLE

    def happen(self, what: str, number: int) -> None:
        if what == "aim":
            self.targets = [target + 1e-3 * (number - 10) for target in self.targets]
        elif what == "trip":
            self.bus.trip(number % 6, DriveFault.OVERHEATED)
        elif what == "power":
            self.bus.power(number % 2 == 0)
        elif what == "slow":
            self.bus.slow_down(0.05 * (1 + number % 20))
        elif what == "stop":
            command = NmtCommand.ENTER_PREOPERATIONAL if number % 2 else NmtCommand.START
            self.bus.receive(self.now, canopen.nmt(command))
        elif what == "silence":
            self.now += 0.003 * number
        elif what == "asynchronous":
            self.transfer(
                1 + number % 6,
                Transfer(ObjectIndex.TPDO1, 2, DataType.UNSIGNED8, 255 if number % 2 else 1),
            )


happenings = st.tuples(
    st.sampled_from(
        ["aim"] * 6 + ["trip", "power", "slow", "stop", "silence", "asynchronous", "order", "rest"]
    ),
    st.integers(0, 20),
    st.booleans(),
)


@settings(max_examples=60, deadline=None)
@given(course=st.lists(happenings, min_size=1, max_size=40))
def test_the_fast_path_sends_the_same_frames_as_the_steps(
    course: list[tuple[str, int, bool]],
) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        benches = [CycleBench(kind, monkeypatch) for kind in (ServoDrive, StepByStep)]
    quick = 0
    for bench in benches:
        for word in ENABLING * 2:
            bench.cycle(word, None, False)
        for what, number, asks in course:
            bench.happen(what, number)
            word = (
                DriveCommand.ENABLE_OPERATION,
                DriveCommand.QUICK_STOP,
                DriveCommand.FAULT_RESET,
            )[number % 3 if what == "order" else 0].word
            bench.cycle(word, number % 6 if what == "order" and number > 15 else None, asks)
            quick += bench is benches[0] and bench.bus.drives[0]._said is not None
    assert benches[0].sent == benches[1].sent
    assert benches[0].bus.plant.q == benches[1].bus.plant.q
    assert all(drive._said is None for drive in benches[1].bus.drives)
    assert quick or any(what != "aim" for what, _, _ in course), "the fast path was never used"


def test_a_bench_with_the_fast_drives_uses_the_fast_path() -> None:
    """Otherwise the comparison above would compare the slow path with itself."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        bench = CycleBench(ServoDrive, monkeypatch)
    for word in ENABLING + [ENABLING[-1]] * 5:
        bench.happen("aim", 11)
        bench.cycle(word, None, False)
    assert all(drive._said is not None for drive in bench.bus.drives)
    assert bench.bus.drives[0].nmt is NmtState.OPERATIONAL
