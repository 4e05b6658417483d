"""A whole cycle of the master's frames processed at once gives the same answers as frame by frame,
also while drives are idle."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from petrobot.services.comm.canopen import cia301 as canopen
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import NmtCommand, NmtState
from petrobot.services.comm.canopen.cia402 import RECEIVED, DriveCommand, to_units
from petrobot.sim.catching.drives import ArmBus
from petrobot.sim.catching.puma import ArmPlant
from petrobot.sim.catching.site import Site

CYCLE, STEP = 0.004, 0.002
RPDO = canopen.pdo_struct(RECEIVED)
ENABLING = [
    DriveCommand.SHUTDOWN.word,
    DriveCommand.SWITCH_ON.word,
    DriveCommand.ENABLE_OPERATION.word,
]

DEEDS = st.one_of(
    st.builds(lambda to: ("aim", to), st.floats(-0.05, 0.05)),
    st.builds(lambda word: ("word", word), st.sampled_from([*ENABLING, 0x02, 0x00, 0x80])),
    st.builds(lambda on: ("power", on), st.booleans()),
    st.builds(lambda joint: ("trip", joint), st.integers(0, 5)),
    st.builds(lambda share: ("slow", share), st.floats(0.1, 1.0)),
    st.just(("beat", 0)),
    st.just(("read", 0)),
    st.just(("ball", True)),
)


class Twin:
    """An arm on its bus, with the master's frames."""

    def __init__(self, site: Site) -> None:
        self.home = site.arm.poses["home"].tolist()
        self.plant = ArmPlant(site.arm, 9.81, self.home)
        self.bus = ArmBus(self.plant, site.drives)
        self.bus.receive(0.0, canopen.nmt(NmtCommand.START))

    def cycle(self, now: float, frames: tuple[Frame, ...], at_once: bool) -> list[Frame]:
        if at_once:
            self.bus.receive_cycle(now, frames)
        else:
            for frame in frames:
                self.bus.receive(now, frame)
        for step in range(round(CYCLE / STEP)):
            self.bus.step(now + step * STEP, STEP)
        return self.bus.drain()

    def suffer(self, deed: str, value: float) -> None:
        """Cause an event in the laboratory, not on the bus."""
        if deed == "power":
            self.bus.power(bool(value))
        elif deed == "trip":
            self.bus.trip(int(value))
        elif deed == "slow":
            self.bus.slow_down(value)
        elif deed == "ball":
            self.bus.ball(bool(value))


@pytest.fixture
def twins(site: Site) -> Callable[[], tuple[Twin, Twin]]:
    return lambda: (Twin(site), Twin(site))


def _extra(deed: str) -> tuple[Frame, ...]:
    if deed == "beat":
        return (canopen.heartbeat(0x7F, NmtState.OPERATIONAL),)
    return (canopen.sdo_read_request(3, 0x6064, 0),) if deed == "read" else ()


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(st.tuples(DEEDS, st.integers(1, 25)), min_size=1, max_size=8))
def test_a_cycle_at_once_equals_the_cycle_frame_by_frame(
    twins: Callable[[], tuple[Twin, Twin]], deeds: list[tuple[tuple[str, float], int]]
) -> None:
    one, other = twins()
    goal, word, tick, rested = 0.0, ENABLING[-1], 0, 0
    words = ENABLING + [word] * 30
    for (deed, value), cycles in [(("aim", 0.0), len(words)), *deeds]:
        goal = value if deed == "aim" else goal
        word = int(value) if deed == "word" else word
        one.suffer(deed, value)
        other.suffer(deed, value)
        for cycle in range(cycles):
            says = words[tick] if tick < len(words) else word
            targets = [to_units(angle + goal) for angle in one.home]
            drives = tuple(
                Frame(canopen.RPDO1_BASE + 1 + k, RPDO.pack(says, at))
                for k, at in enumerate(targets)
            )
            frames = (*(_extra(deed) if cycle == 0 else ()), *drives, canopen.SYNC)
            now, tick = tick * CYCLE, tick + 1
            assert one.cycle(now, frames, True) == other.cycle(now, frames, False)
            rested += not any(one.plant.qd)
        assert one.plant.q == other.plant.q
    assert rested > 20
    one.plant.close()
    other.plant.close()
