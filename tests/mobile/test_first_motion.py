"""The rover's driver keeps the rules of drivers, and obeys `speed`, `workspace` and `dry_run`."""

from __future__ import annotations

from typing import Any

import pytest

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import RPDO1_BASE
from petrobot.services.conformance import DriverCheck, check_driver
from petrobot.services.mobile import driving
from petrobot.services.mobile.rover import Rover
from tests.mobile.conftest import DrawnFloor
from tests.mobile.test_rover import START, enabled, play
from tests.mobile.yard import CYCLE, Yard

RESET = {"do": "reset"}


def yard_with(floor: str = "SSS", **keys: Any) -> Yard:
    """A yard whose rover has these keys in its table."""
    yard = Yard(DrawnFloor(floor), START)
    yard.rover = Rover(keys, yard.ports)
    return yard


def checked() -> DriverCheck:
    """Check the driver in a yard that goes on with each step."""
    yard = yard_with()
    yard.camera = False

    class InYard(Rover):
        """Its world goes on while it steps."""

        def step(self, now: float) -> None:
            super().step(now)
            for part in range(1, 6):
                yard.world(now + part * CYCLE / 5)

    def cable(there: bool) -> None:
        yard.bus.cut = not there

    turns = [{"do": "turn", "to": 1.0}, {"do": "turn", "to": -1.0}]
    return check_driver(
        lambda **keys: InYard(keys, yard.ports),
        turns,
        first=[RESET],
        seconds=3.0,
        cable=cable,
        simulated=True,
    )


def test_it_keeps_the_rules_of_drivers() -> None:
    found = checked()
    assert found.faults == []
    (note,) = found.notes  # its pose begins again with each driver
    assert note.startswith("not checked: dry_run")


def fastest(yard: Yard, command: dict[str, Any], seconds: float) -> float:
    """Repeat a command; return the greatest speed of the body (m/s)."""
    found = 0.0
    for _ in range(round(seconds / 0.1)):
        yard.rover.command(yard.ports.now, command)
        yard.run(0.1)
        found = max(found, yard.body.speed)
    return found


def test_at_a_quarter_of_its_speed_it_drives_a_quarter_as_fast() -> None:
    follow = {"do": "follow", "speed": 0.4}
    usual, slow = (fastest(enabled(yard_with(speed=s)), follow, 1.5) for s in (1.0, 0.25))
    assert slow == pytest.approx(0.25 * usual, rel=0.15)
    wish = {"do": "follow", "speed": 9.0}  # far above what the rover can do
    top = 1.2  # m/s, of its wheels
    assert 0.2 * top < fastest(enabled(yard_with(speed=0.25)), wish, 1.5) < 0.27 * top


def test_it_stands_before_it_leaves_its_workspace_and_goes_no_further() -> None:
    yard = enabled(yard_with(workspace={"x": [-0.2, 1.0], "y": [-1.0, 1.0]}))
    result = play(yard, driving.follow_feed_forward, speed=0.5).result
    assert result.status == "error" and "outside the workspace x = [-0.2, 1], y" in result.text
    yard.run(0.5)
    assert 0.9 < yard.body.x < 1.0 and yard.rover.stopped()
    with pytest.raises(ValueError, match=r"plan: the point x = 1.100, .* outside the workspace"):
        yard.rover.command(yard.ports.now, {"do": "plan", "points": [[0.9, 0.0], [1.1, 0.0]]})


def test_in_a_dry_run_it_reports_its_way_and_no_drive_is_enabled() -> None:
    yard = yard_with(dry_run=True)
    sent: list[Frame] = []
    receive = yard.bus.bus.receive

    def log(now: float, frame: Frame) -> None:
        sent.append(frame)
        receive(now, frame)

    yard.bus.bus.receive = log  # type: ignore[method-assign]
    enabled(yard)
    for _ in range(10):
        yard.rover.command(yard.ports.now, {"do": "turn", "to": 1.0})
        yard.run(0.2)
    assert yard.rover.state()["pose"][2] == pytest.approx(1.0, abs=0.05)
    assert (yard.body.x, yard.body.y, yard.body.heading) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    commands = {f.data for f in sent if RPDO1_BASE < f.id < RPDO1_BASE + 0x7F}
    assert commands == {bytes(len(next(iter(commands))))}, "only `disable voltage`, speed 0"
