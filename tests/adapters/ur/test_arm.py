"""The driver and its actions on the simulated controller: in simulated time, and over TCP."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any, cast

import pytest

from petrobot import ByteLine, Driver, Ports, check_driver, rehearse
from petrobot.services.adapters.ur import actions
from petrobot.services.adapters.ur.arm import PROGRAM, Arm, chain
from petrobot.services.comm.streams.line import TcpConnection
from petrobot.sim.bus.ur_controller import (
    NORMAL,
    RUNNING,
    ControllerSession,
    UrController,
    UrServer,
)

HOME = [0.0, -1.57, 1.57, -1.57, -1.57, 0.0]
THERE = [0.8, *HOME[1:]]
ENABLE = {"do": "enable"}


class SessionLine(ByteLine):
    """A connection to a controller in this process; a pulled cable closes it."""

    def __init__(self, session: ControllerSession) -> None:
        self.session = session

    def send(self, data: bytes) -> None:
        self.session.receive(data)

    def receive(self) -> bytes:
        if self.session.closed:
            raise ConnectionError("the cable is pulled")
        return self.session.drain()

    def close(self) -> None:
        self.session.closed = True


class UrPorts:
    """Ports of a driver: its connections lead to a controller, whose time is the driver's."""

    def __init__(self, controller: UrController) -> None:
        self.controller, self.now, self.plugged = controller, 0.0, True
        self.lines: list[SessionLine] = []

    def tcp(self, host: str, port: int) -> ByteLine:
        if not self.plugged:
            raise ConnectionError("no cable")
        self.lines.append(SessionLine(self.controller.connect(port)))
        return self.lines[-1]

    def cable(self, plugged: bool) -> None:
        """Pull the cable, or put it back."""
        self.plugged = plugged
        for line in self.lines if not plugged else ():
            line.close()

    def arm(self, **keys: Any) -> SteppedArm:
        """Return a driver."""
        return SteppedArm({"host": "192.168.1.10", **keys}, cast(Ports, self))


class SteppedArm(Arm):
    """The driver; its controller's time passes with its steps."""

    def step(self, now: float) -> None:
        ports = cast(UrPorts, self.ports)
        ports.now = now
        ports.controller.advance(now)
        super().step(now)


class Cell:
    """A controller, a driver in the same process, and their clock."""

    def __init__(self, **keys: Any) -> None:
        self.controller, self.now = UrController(), 0.0
        self.arm = UrPorts(self.controller).arm(**keys)

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Step for so long, or until the condition holds."""
        for _ in range(round(seconds / self.arm.period)):
            self.now += self.arm.period
            self.arm.step(self.now)
            if until():
                return True
        return False

    def enabled(self) -> Cell:
        """Wait until the arm is enabled."""
        self.arm.command(self.now, ENABLE)
        assert self.run(5.0, lambda: bool(self.arm.state()["ready"])), self.arm.state()
        return self

    def go(self, **command: Any) -> bool:
        """Move; return whether the arm arrived."""
        self.arm.command(self.now, {"do": "move", **command})
        return self.run(8.0, lambda: bool(self.arm.state()["at_goal"]))


def test_it_keeps_the_rules_of_drivers() -> None:
    ports = UrPorts(UrController())
    found = check_driver(
        ports.arm,
        [{"do": "move", "joints": THERE}, {"do": "move", "joints": HOME}],
        first=[ENABLE],
        seconds=4.0,
        cable=ports.cable,
        simulated=True,
    )
    assert found.faults == [] and found.notes == []


def test_nothing_moves_before_it_is_enabled() -> None:
    cell = Cell()
    cell.run(2.0)
    with pytest.raises(ValueError, match="the arm is not enabled"):
        cell.arm.command(cell.now, {"do": "move", "joints": THERE})
    assert not cell.controller.program and cell.controller.robot_mode != RUNNING


def test_data_that_arrive_together_are_no_echo_of_the_program() -> None:
    """As of a controller that sends more often, or on a busy computer."""
    cell = Cell()
    cell.controller.robot_mode = RUNNING
    cell.arm.command(cell.now, ENABLE)
    for _ in range(20):
        cell.now += 5 * cell.arm.period
        cell.arm.step(cell.now)
        assert bool(cell.controller.program) or not cell.arm.state()["ready"]
    assert not cell.arm.state()["faults"]


def test_why_it_is_not_enabled_yet_is_said() -> None:
    cell = Cell()
    cell.arm.command(cell.now, ENABLE)
    cell.run(0.1)
    said = "enabling: its drives are off; is it in remote control?"
    assert cell.arm.state()["reason"] == said
    cell.controller.robot_mode = RUNNING
    cell.run(2 * cell.arm.period)
    assert "its program does not run" in cell.arm.state()["reason"]
    cell.controller.protective_stop()
    cell.run(2 * cell.arm.period)
    assert "the controller reports protective_stop" in cell.arm.state()["reason"]


def test_without_a_connection_it_tells_where_it_was() -> None:
    cell = Cell().enabled()
    assert cell.go(joints=THERE)
    ports = cast(UrPorts, cell.arm.ports)
    ports.cable(False)
    cell.run(3.0)
    ports.cable(True)
    cell.run(1.0, lambda: not cell.arm.state()["connected"] and len(ports.lines) > 3)
    assert cell.arm.state()["q"] == pytest.approx(THERE, abs=0.003)


def test_it_moves_as_fast_as_it_may_and_no_faster() -> None:
    cell = Cell(top_speed=0.8).enabled()
    cell.arm.command(cell.now, {"do": "move", "joints": THERE, "speed": 0.5})
    places = [cell.controller.q[0]]
    while cell.now < 12.0 and not cell.arm.state()["at_goal"]:
        cell.run(0.08)
        places.append(cell.controller.q[0])
    speeds = [(b - a) / 0.08 for a, b in pairwise(places)]
    assert 0.39 < max(speeds) < 0.41
    assert cell.controller.q == pytest.approx(THERE, abs=0.003)


def test_a_linear_motion_is_straight() -> None:
    cell = Cell().enabled()
    begin = cell.arm.state()["tool"]
    end = [begin[0] + 0.05, begin[1], begin[2] - 0.15, *begin[3:]]
    cell.arm.command(cell.now, {"do": "linear", "pose": end})
    seen = [begin]
    while cell.now < 12.0 and not cell.arm.state()["at_goal"]:
        cell.run(0.04)
        seen.append(cell.arm.state()["tool"])
    assert cell.arm.state()["at_goal"] and len(seen) > 10
    for x, y, z, *_ in seen:
        share = (begin[2] - z) / 0.15
        assert (x, y) == pytest.approx((begin[0] + 0.05 * share, begin[1]), abs=0.003)


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ({"do": "jump"}, "unknown command 'jump'"),
        ({"do": "move", "joints": [0.0]}, "joints: expected 6 finite numbers"),
        ({"do": "move", "joints": [float("nan")] * 6}, "joints: expected 6 finite numbers"),
        ({"do": "move", "joints": [7.0, *HOME[1:]]}, "base: expected -6.283 to 6.283, found 7.000"),
        ({"do": "move", "joints": HOME, "speed": 0.0}, "speed: expected"),
        ({"do": "linear", "pose": [3.0, 0, 0, 0, 0, 0]}, "the tool cannot pass"),
        ({"do": "output", "bit": 9, "value": True}, "output: expected bit 0 to 7"),
        ({"do": "output", "bit": 1, "value": 1}, "output: expected bit 0 to 7"),
        ({"do": "move", "joints": THERE}, "lies outside the workspace x = ["),
    ],
)
def test_what_it_refuses(command: dict[str, Any], says: str) -> None:
    cell = Cell(workspace={"x": [-0.55, -0.3], "y": [-0.25, 0.0]}).enabled()
    with pytest.raises(ValueError) as fault:
        cell.arm.command(cell.now, command)
    assert says in str(fault.value)
    cell.run(0.3)
    assert cell.controller.q == pytest.approx(HOME, abs=1e-3)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"model": "ur7"}, 'model: expected "ur3e" or "ur5e" or "ur10e", found'),
        ({"host": "robot.lan"}, "host: expected an IP address"),
        ({"top_speed": 9.0}, "top_speed"),
        ({"tool": [1.0]}, "tool: expected 3 finite numbers"),
    ],
)
def test_wrong_keys(keys: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Arm({"host": "127.0.0.1", **keys}, TcpPorts())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("happens", "fault"),
    [
        (UrController.protective_stop, "protective_stop"),
        (UrController.emergency_stop, "emergency_stop"),
        (lambda c: setattr(c, "safety_mode", 13), "safeguard_stop"),  # the enabling device
        (lambda c: setattr(c, "safety_mode", 99), "fault"),  # of a later version
        (lambda c: setattr(c, "program", ""), "program_lost"),
        (lambda c: setattr(c, "robot_mode", 5), "power_off"),
    ],
)
def test_a_stop_of_the_controller_is_a_fault_until_it_is_enabled_again(
    happens: Callable[[UrController], None], fault: str
) -> None:
    cell = Cell().enabled()
    cell.arm.command(cell.now, {"do": "move", "joints": THERE})
    cell.run(0.6)
    happens(cell.controller)
    cell.run(0.5)
    assert list(cell.arm.state()["faults"]) == [fault] and cell.arm.state()["mode"] == "off"
    at = list(cell.controller.q)
    cell.run(2.0)
    assert cell.controller.q == pytest.approx(at, abs=1e-6) and cell.arm.stopped()
    if fault in ("emergency_stop", "safeguard_stop", "fault"):
        cell.controller.safety_mode = NORMAL  # the mushroom button is turned back
    assert cell.enabled().go(joints=THERE)


def test_a_silent_driver_is_stopped_by_the_program() -> None:
    cell = Cell().enabled()
    cell.arm.command(cell.now, {"do": "move", "joints": THERE})
    cell.run(0.6)
    assert abs(cell.controller.qd[0]) > 0.3
    cell.controller.advance(cell.now + 0.5)  # as if the driver's process hung
    assert max(map(abs, cell.controller.qd)) < 1e-6 and cell.controller.q[0] < 0.6


def test_in_a_dry_run_nothing_is_switched_on_or_sent() -> None:
    cell = Cell(dry_run=True).enabled()
    assert cell.go(joints=THERE) and cell.arm.state()["q"] == pytest.approx(THERE)
    assert cell.controller.q == HOME and not cell.controller.program
    assert cell.controller.robot_mode != RUNNING and not cell.controller.inputs


def test_an_emergency_stop_brakes_harder_than_a_stop() -> None:
    ways = []
    for stop in (Arm.stop, Arm.quick_stop):
        cell = Cell().enabled()
        cell.arm.command(cell.now, {"do": "move", "joints": THERE})
        cell.run(0.7)
        begin = cell.controller.q[0]
        stop(cell.arm, cell.now)
        cell.run(1.5)
        assert cell.arm.stopped()
        ways.append(cell.controller.q[0] - begin)
    assert 0.0 < ways[1] < 0.5 * ways[0]


def played(action: Any, cell: Cell, **arguments: Any) -> Any:
    """Return the result of an action; the driver's clock continues from action to action."""

    class Later(Driver):
        period = Arm.period
        __init__ = object.__init__

        def __getattribute__(self, name: str) -> Any:
            if name in ("step", "command", "stop"):
                call = getattr(cell.arm, name)
                return lambda now, *rest: call(begun + now, *rest)
            return (
                object.__getattribute__(self, name) if name == "period" else getattr(cell.arm, name)
            )

    begun = cell.now
    result = rehearse(action, device=Later(), **arguments)
    cell.now = begun + result.seconds + 1.0
    return result.result


def test_the_actions_and_their_causes() -> None:
    cell = Cell()
    assert played(actions.enable, cell).status == "success"
    moved = played(actions.move_joints, cell, joints=THERE)
    assert moved.status == "success" and moved.values["q"] == pytest.approx(THERE, abs=0.003)
    down = [*moved.values["tool"]]
    down[2] -= 0.1
    assert played(actions.move_linear, cell, pose=down).status == "success"
    assert played(actions.move_linear, cell, pose=[3.0, 0, 0, 0, 0, 0]).cause == "command_refused"
    assert played(actions.set_digital_out, cell, bit=2, value=True).status == "success"
    assert cell.controller.digital_out == 4
    assert played(actions.gripper, cell, close=True, holds=1).cause == "empty"
    cell.controller.digital_in = 2
    assert played(actions.gripper, cell, close=True, holds=1).status == "success"
    assert played(actions.move_joints, cell, joints=HOME, timeout=0.2).cause == "late"
    cell.controller.protective_stop()
    stopped = played(actions.move_joints, cell, joints=HOME)
    assert stopped.cause in ("command_refused", "protective_stop")


# Over TCP: the driver never waits, so both ends live in one thread.


class TcpPorts:
    """Ports of a driver with connections of this host."""

    now = 100.0

    def tcp(self, host: str, port: int) -> ByteLine:
        return TcpConnection(host, port)


class Clock:
    """Time of both ends: a busy computer delays neither."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    """A clock that only the test advances."""
    return Clock()


@pytest.fixture
def server(clock: Clock) -> Iterator[UrServer]:
    """A controller on free ports."""
    found = UrServer(UrController(robot_mode=RUNNING), ports=(0, 0, 0), clock=clock)
    yield found
    found.close()


def over(server: UrServer) -> Arm:
    """A driver of a server's controller."""
    names = ("rtde_port", "dashboard_port", "program_port")
    keys = dict(zip(names, server.ports, strict=True))
    return Arm({"host": "127.0.0.1", **keys}, TcpPorts())  # type: ignore[arg-type]


def both(arm: Arm, server: UrServer, clock: Clock, until: Callable[[], bool]) -> bool:
    """Let both ends run for 10 s of their time, or until the condition holds."""
    for _ in range(1250):
        clock.now += arm.period
        arm.step(clock.now)
        server.poll(0.0)
        server.poll(0.0)
        if until():
            return True
    return False


def test_over_tcp_it_moves_and_connects_again_after_a_cut(server: UrServer, clock: Clock) -> None:
    arm = over(server)
    try:
        assert both(arm, server, clock, lambda: bool(arm.state()["connected"]))
        for goal in (THERE, HOME):
            arm.command(clock.now, ENABLE)
            assert both(arm, server, clock, lambda: bool(arm.state()["ready"])), arm.state()
            arm.command(clock.now, {"do": "move", "joints": goal})
            assert both(arm, server, clock, lambda: bool(arm.state()["at_goal"])), arm.state()
            server.cut()
            assert both(arm, server, clock, lambda: "link_lost" in arm.state()["faults"])
            assert both(arm, server, clock, lambda: bool(arm.state()["connected"])), arm.state()
            assert not arm.state()["ready"], "it waits for a command"
    finally:
        arm.close()


def test_it_waits_for_a_controller_that_is_not_there(server: UrServer, clock: Clock) -> None:
    arm = over(server)
    server.close()
    for _ in range(400):
        clock.now += 0.02
        arm.step(clock.now)
        time.sleep(0.0005)
    assert not arm.state()["connected"] and arm.stopped()
    arm.command(clock.now, ENABLE)
    arm.step(clock.now + 0.01)
    assert "no connection: 127.0.0.1:" in arm.state()["reason"], arm.state()
    assert "refused" in arm.state()["reason"]
    arm.close()


def test_the_program_reads_the_registers_that_the_driver_writes() -> None:
    assert all(f"read_input_float_register({n})" in PROGRAM for n in range(24, 30))
    assert PROGRAM.startswith("def ") and PROGRAM.endswith("end\n")
    opens = sum(PROGRAM.count(word) for word in ("def ", "while ", "    if "))
    assert PROGRAM.count("end\n") == opens


# --- kinematics ---


@pytest.mark.parametrize(
    ("model", "place"),
    [
        ("ur3e", (-0.45675, -0.22315, 0.0665)),
        ("ur5e", (-0.8172, -0.2329, 0.0628)),
        ("ur10e", (-1.18425, -0.2907, 0.06085)),
    ],
)
def test_stretched_out_the_flange_is_where_the_pendant_shows_it(
    model: str, place: tuple[float, ...]
) -> None:
    """All joints at zero: sums of the lengths (d1 - d5 above, d4 + d6 aside, a2 + a3 out)."""
    pose = chain(model).tool([0.0] * 6)
    assert pose[:3] == pytest.approx(place) and pose[3:] == pytest.approx((math.pi / 2, 0.0, 0.0))
