"""Devices that misbehave: half frames, slow answers, wrong checksums, closed lines, restarts. A run
of an action ends in a clear ERROR in time, and when the device behaves again, so does the arm."""

from __future__ import annotations

import base64
import hashlib
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import pytest

from petrobot import (
    ByteLine,
    CommandRefused,
    Context,
    Ports,
    Remote,
    Result,
    error,
    rehearse,
    success,
)
from petrobot.services.adapters.opcua import actions as opcua
from petrobot.services.adapters.ros2 import actions as ros2
from petrobot.services.adapters.ros2.bridge import Bridge
from petrobot.services.adapters.so101 import actions as so101
from petrobot.services.adapters.so101.arm import Arm as So101Arm
from petrobot.services.adapters.ur import actions as ur
from petrobot.services.adapters.ur.arm import Arm as UrArm
from petrobot.sim.bus import feetech
from petrobot.sim.bus.feetech import so101 as servos
from petrobot.sim.bus.ur_controller import RUNNING, UrController
from tests.adapters.opcua.test_session import Cell, await_, complete, done
from tests.adapters.ros2.conftest import FakeProcess
from tests.adapters.ros2.test_actions import Ports as RosPorts
from tests.ports import free_ports
from tests.waiting import PATIENCE_S, Limit

BEGIN, END, SOON = 3.0, 8.0, 9.0
"""When the device misbehaves (s), and by when the run that it disturbs has ended."""


class BadLine(ByteLine):
    """A line whose far end is spoilt while the time is right for it."""

    def __init__(self, device: BadDevice, take: Callable[[bytes], None], drain: Any) -> None:
        self.device, self._take, self._drain = device, take, drain
        self.closed = False
        self.late: list[tuple[float, bytes]] = []

    def send(self, data: bytes) -> None:
        self._check()
        if not (self.device.bad and self.device.how == "deaf"):
            self._take(data)

    def receive(self) -> bytes:
        self._check()
        data, how, now = self._drain(), self.device.how, self.device.now
        if self.device.bad and data:
            if how == "half":
                data = data[: len(data) // 2]
            elif how == "checksum":
                data = bytes((*data[:-1], data[-1] ^ 0x55))
            elif how == "rubbish":
                data = bytes(number % 251 for number in range(len(data)))
            elif how == "silent":
                data = b""
        wait = 0.5 if self.device.bad and how == "slow" else 0.0
        self.late.append((now + wait, data))
        due = [piece for at, piece in self.late if at <= now]
        self.late = [(at, piece) for at, piece in self.late if at > now]
        return b"".join(due)

    def _check(self) -> None:
        if self.closed or (self.device.bad and self.device.how == "closed"):
            self.closed = True
            raise ConnectionError("the line is closed")

    def close(self) -> None:
        self.closed = True


class BadDevice:
    """Ports of a driver: a device in this process that misbehaves in one way."""

    def __init__(self, how: str) -> None:
        self.how, self.now = how, 0.0

    @property
    def bad(self) -> bool:
        return BEGIN <= self.now < END


class BadServos(BadDevice):
    """Servos of a SO-101."""

    def __init__(self, how: str) -> None:
        super().__init__(how)
        self.bus, self.said = servos(), b""
        self.restarted = False

    def serial(self, port: str, baud: int) -> ByteLine:
        if self.bad and self.how == "closed":
            raise ConnectionError("no such port")
        return BadLine(self, self.take, self.drain)

    def take(self, data: bytes) -> None:
        self.said += self.bus.receive(data)

    def drain(self) -> bytes:
        said, self.said = self.said, b""
        return said

    def advance(self, seconds: float) -> None:
        if self.bad and self.how == "restart" and not self.restarted:
            self.restarted = True
            for servo in self.bus.servos.values():  # their supply was off for a moment
                servo.write(feetech.TORQUE, b"\0")
        self.bus.advance(seconds)


class So101(So101Arm):
    """Its driver: time passes for both ends together."""

    def step(self, now: float) -> None:
        device = cast(BadServos, self.ports)
        device.now = now
        device.advance(self.period)
        super().step(now)


class BadController(BadDevice):
    """A UR controller."""

    def __init__(self, how: str) -> None:
        super().__init__(how)
        self.controller = UrController(robot_mode=RUNNING)
        self.lines: list[BadLine] = []

    def tcp(self, host: str, port: int) -> ByteLine:
        if self.bad and self.how in ("closed", "restart"):
            raise ConnectionError("Connection refused")
        session = self.controller.connect(port)
        self.lines.append(BadLine(self, session.receive, session.drain))
        return self.lines[-1]

    def advance(self, now: float) -> None:
        if self.bad and self.how == "restart":
            at, self.controller = self.controller.q, UrController(self.controller.q)
            self.controller.q, self.controller.now = at, now
            for line in self.lines:
                line.close()
        self.controller.advance(now)


class Ur(UrArm):
    """Its driver: time passes for both ends together."""

    def step(self, now: float) -> None:
        device = cast(BadController, self.ports)
        device.now = now
        device.advance(now)
        super().step(now)


async def disturbed(ctx: Context[Remote], enable: Any, moves: list[Any]) -> Result:
    """Move there and back until a move fails; try again until one succeeds."""
    assert (await enable(ctx)).status == "success"
    failed, late = success(), 0.0
    for move in 20 * moves:
        failed = failed if failed.cause else await move(ctx)
        late = late if late or not failed.cause else ctx.now
    for _ in range(20):
        await ctx.sleep(1.0)
        enabled = await enable(ctx)
        moved = await moves[0](ctx) if enabled.status == "success" else enabled
        if moved.status == "success":
            return success(cause=failed.cause, text=failed.text, late=late, back=ctx.now)
    return error("not_back", f"after {failed.cause}: {failed.text}")


async def ended(action: Awaitable[Result]) -> Result:
    """Return the result of an action; a refusal as a node ends such a run."""
    try:
        return await action
    except CommandRefused as fault:
        return error("command_refused", str(fault))


def told(driver: Any, enable: Any, moves: list[Any]) -> dict[str, Any]:
    async def story(ctx: Context[Remote]) -> Result:
        return await disturbed(ctx, enable, moves)

    played = rehearse(story, device=driver)
    assert played.result.status == "success", played.result
    return dict(played.result.values)


@pytest.mark.parametrize(
    ("how", "causes"),
    [
        ("half", "missing"),
        ("checksum", "missing"),
        ("rubbish", "missing"),
        ("silent", "missing"),
        ("deaf", "missing"),
        ("slow", "missing"),
        ("closed", "missing"),
        ("restart", "power"),
    ],
)
def test_a_so101_that_misbehaves(how: str, causes: str) -> None:
    def move(angle: float) -> Any:
        async def act(ctx: Context[Remote]) -> Result:
            return await ended(so101.move_joints(ctx, joints=[angle, 0, 0, 0, 0], speed=0.3))

        return act

    async def enable(ctx: Context[Remote]) -> Result:
        return await ended(so101.enable(ctx))

    driver = So101({"port": "x"}, cast(Ports, BadServos(how)))
    found = told(driver, enable, [move(0.8), move(-0.8)])
    assert found["cause"] == causes and found["text"], found
    assert found["late"] < SOON and found["back"] < END + 8.0


@pytest.mark.parametrize(
    ("how", "causes"),
    [
        ("half", ("link_lost",)),
        ("rubbish", ("link_lost",)),
        ("silent", ("link_lost",)),
        ("deaf", ("program_lost",)),
        ("slow", ("link_lost", "program_lost")),
        ("closed", ("link_lost",)),
        ("restart", ("link_lost",)),
    ],
)
def test_a_ur_controller_that_misbehaves(how: str, causes: tuple[str, ...]) -> None:
    def move(angle: float) -> Any:
        async def act(ctx: Context[Remote]) -> Result:
            joints = [angle, -1.57, 1.57, -1.57, -1.57, 0.0]
            return await ended(ur.move_joints(ctx, joints=joints, speed=0.3))

        return act

    async def enable(ctx: Context[Remote]) -> Result:
        return await ur.enable(ctx, timeout=4.0)

    driver = Ur({"host": "192.168.1.10"}, cast(Ports, BadController(how)))
    found = told(driver, enable, [move(0.8), move(0.0)])
    assert found["cause"] in causes and found["text"], found
    assert found["late"] < SOON and found["back"] < END + 12.0


# Servers that misbehave, for adapters with sessions of their own.


@contextmanager
def rogue(port: int, how: str) -> Iterator[None]:
    """A server that accepts and is `silent`, sends `rubbish`, is `closed` at once, or is a
    WebSocket that stops in the middle of a frame (`half`)."""
    listener = socket.create_server(("127.0.0.1", port))
    listener.settimeout(0.05)
    over, held = threading.Event(), list[socket.socket]()

    def serve() -> None:
        limit = Limit("the end of the test", 2 * PATIENCE_S)
        while not over.is_set() and limit.left():
            try:
                near, _ = listener.accept()
            except TimeoutError:
                continue
            held.append(near)
            if how == "rubbish":
                near.sendall(bytes(range(256)) * 4)
            elif how == "closed":
                near.close()
            elif how == "half":
                asked = near.recv(4096)
                key = next(w[19:] for w in asked.split(b"\r\n") if w[:18] == b"Sec-WebSocket-Key:")
                whole = hashlib.sha1(key + b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11").digest()
                near.sendall(
                    b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade"
                    b"\r\nSec-WebSocket-Accept: " + base64.b64encode(whole) + b"\r\n\r\n"
                    b"\x81\x7e\x01\x00{"
                )

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        for each in (*held, listener):
            each.close()


def pace(now: float) -> None:
    time.sleep(0.004)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("how", "ended"),
    [
        ("silent", ("link_down", "no")),
        ("rubbish", ("link_down", "no")),
        ("closed", ("link_down", "no")),
        ("half", ("link_lost", "unknown")),
    ],
)
def test_a_rosbridge_that_misbehaves(how: str, ended: tuple[str, str]) -> None:
    def played(bridge: Bridge) -> Result:
        bridge.ports = None  # type: ignore[assignment]
        return rehearse(
            ros2.goal, device=bridge, world=pace, action="/ok", action_type="a/action/B", limit=30.0
        ).result

    (port,) = free_ports(1)
    with rogue(port, how):
        bridge = Bridge({"url": f"ws://127.0.0.1:{port}", "heartbeat": 2.0}, RosPorts())  # type: ignore[arg-type]
        try:
            found = played(bridge)
            assert (found.cause, found.executed) == ended and found.text, found
        except BaseException:
            bridge.close()
            raise
    fake = FakeProcess(port)
    try:
        limit = Limit("a session again")
        while not bridge.connected and limit.left():
            bridge.step(time.monotonic())
            time.sleep(0.01)
        assert played(bridge).status == "success"
    finally:
        bridge.close()
        fake.end()


@pytest.mark.processes
@pytest.mark.parametrize("how", ["silent", "rubbish", "closed"])
def test_an_opcua_server_that_misbehaves(how: str, tmp_path: Path) -> None:
    cell = Cell(tmp_path)
    try:
        with rogue(cell.port, how):
            driver = cell.driver(patience=0.5)
            state = await_(driver, lambda s: s["faults"]["session"] != "no session yet", how)
            assert "trying again" in state["faults"]["session"] and not state["up"]
            played = rehearse(opcua.write, device=driver, world=pace, values={"count": 3})
            # 2 s of it waits for a standstill that nobody can know of
            assert played.result.cause == "command_refused" and played.seconds < 3.0
        driver.patience = PATIENCE_S
        cell.power(True)
        await_(driver, complete, "all values")
        assert done(driver, {"count": 3}) == ""
    finally:
        cell.close()
