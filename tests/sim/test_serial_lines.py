"""Serial lines of a laboratory: a pseudo terminal in real time, envelopes in lock step."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.location_file import load
from petrobot.services.comm.lockstep.party import Envelope
from petrobot.services.comm.streams.serial_line import SerialLine, SerialPort
from petrobot.services.node.lockstep import LockstepPorts
from petrobot.sim.bus.serial_line import PtyLine
from petrobot.sim.laboratory_party import LaboratoryParty
from petrobot.sim.realtime import Pacemaker, serial_lines
from tests.waiting import Limit

CELL = """
schema = 1
[nodes.world]
host = "127.0.0.1"
port = 7391
sim = "any:lab"
[nodes.pc]
host = "127.0.0.1"
port = 7392
[devices.arm]
node = "pc"
driver = "any:Arm"
port = "pty:run/arm"
[devices.real]
node = "pc"
driver = "any:Arm"
port = "/dev/ttyUSB0"
"""


class Echo(LaboratoryParty):
    """A world whose serial devices answer in capitals."""

    def tick(self, now: float) -> None:
        self.now = now + 0.004

    def take_on_bus(self, now: float, frames: Sequence[Frame]) -> None:
        """It has no bus."""

    def take_frames(self) -> Sequence[Frame]:
        return ()

    def take_on_serial(self, now: float, device: str, data: bytes) -> bytes:
        return device.encode() + b" " + data.upper()

    def serve(self, service: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        return {}

    def make_ready(self, arguments: Mapping[str, Any]) -> None:
        """Nothing takes long."""

    def close(self) -> None:
        """Nothing is held."""


def echo() -> Echo:
    return Echo("world", lambda endpoint: "pc" if endpoint == "arm" else endpoint, "b", "hash")


def heard(line: SerialLine, size: int) -> bytes:
    got, limit = b"", Limit(f"{size} bytes")
    while len(got) < size and limit.left():
        got += line.receive()
    return got


def test_in_real_time_it_is_a_port_that_can_be_unplugged(tmp_path: Path) -> None:
    (tmp_path / "services.toml").write_text(CELL)
    paths = serial_lines(load(tmp_path / "services.toml"))
    assert paths == {"arm": tmp_path / "run/arm"}
    for _ in range(2):  # pulled, and put back
        pacemaker = Pacemaker(echo(), None, None, paths)
        thread = threading.Thread(target=pacemaker.run)
        thread.start()
        line = SerialPort(str(paths["arm"]), 1_000_000)
        try:
            with pytest.raises(ConnectionError, match="lock"):
                SerialPort(str(paths["arm"]), 1_000_000)  # one program at a time
            line.send(b"hello")
            assert heard(line, 9) == b"arm HELLO"
        finally:
            pacemaker.stop()
            thread.join()
            pacemaker.close()
        with pytest.raises(ConnectionError, match="gone"):
            line.receive()
        with pytest.raises(ConnectionError, match="gone"):
            line.send(b"hello")
        line.close()
        with pytest.raises(ConnectionError, match="run/arm"):
            SerialPort(str(paths["arm"]), 1_000_000)


def test_a_line_that_nobody_reads_does_not_block(tmp_path: Path) -> None:
    far = PtyLine(tmp_path / "line", bytes)
    line = SerialPort(str(tmp_path / "line"), 9600)
    with pytest.raises(ConnectionError, match="accepts no bytes"):
        for _ in range(100):
            line.send(bytes(4096))
    line.close()
    far.close()


def test_in_lock_step_it_is_envelopes(tmp_path: Path) -> None:
    (tmp_path / "services.toml").write_text(CELL)
    directory = load(tmp_path / "services.toml")
    sent: list[Envelope] = []
    ports = LockstepPorts(directory, directory.devices["arm"], lambda: 0.0, sent.append)
    line = ports.serial("pty:run/arm", 1_000_000)
    line.send(b"hel")
    line.send(b"lo")
    ports.flush()
    ports.flush()
    world = echo()
    for envelope in sent:
        world.receive(0.0, envelope)
    world.advance(0.0)
    (answer,) = world.drain()
    assert (answer.party, answer.target) == ("pc", "arm")
    ports.receive(answer)
    assert line.receive() == b"arm HELLO" and line.receive() == b""
