"""The ports of a device, in real time and in lock step alike."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from petrobot.services.comm.location_file import DeviceEntry, Directory, load
from petrobot.services.comm.streams.capture import RecordedImages
from petrobot.services.node.lockstep import LockstepPorts
from petrobot.services.node.ports import ProcessPorts

CELL = """
schema = 1
[nodes.pc]
host = "127.0.0.1"
port = 7392
[devices.eye]
node = "pc"
driver = "any:Eye"
source = "file:balls.avi"
"""


def in_lockstep(directory: Directory, device: DeviceEntry) -> LockstepPorts | ProcessPorts:
    """Return the ports of a device in lock step."""
    return LockstepPorts(directory, device, lambda: 0.0, lambda envelope: None)


def in_real_time(directory: Directory, device: DeviceEntry) -> LockstepPorts | ProcessPorts:
    """Return the ports of a device in real time."""
    return ProcessPorts(directory, device, lambda: 0.0, {})


@pytest.mark.parametrize("make", [in_lockstep, in_real_time])
def test_a_recording_is_found_beside_the_location_file(
    tmp_path: Path, make: Callable[[Directory, DeviceEntry], LockstepPorts | ProcessPorts]
) -> None:
    (tmp_path / "services.toml").write_text(CELL)
    directory = load(tmp_path / "services.toml")
    ports = make(directory, directory.devices["eye"])
    with pytest.raises(ValueError, match=f"no file {tmp_path / 'balls.avi'}; write the path"):
        ports.images()
    (tmp_path / "balls.avi").write_bytes(b"")
    assert isinstance(ports.images(), RecordedImages)
