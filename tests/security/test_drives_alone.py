"""Drives without a master: all processes of the motion node are killed during a move, and the
drives stop by themselves."""

from __future__ import annotations

import asyncio
import threading
import warnings
from importlib.resources import files
from pathlib import Path

import pytest

from petrobot.coordinator.launch import local_programs
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.services.comm.canopen.cia402 import DriveFault, DriveState, state_of
from tests.processes import below, kill
from tests.security.arm_cell import DRIVES, cell_in, ear_on
from tests.security.test_estop import LIMIT, Cell

pytestmark = pytest.mark.processes
DRIVE_EDS = str(files("petrobot.services.comm.canopen.eds").joinpath("joint_drive.eds"))
STATUSWORD, ERROR_CODE, POSITION = 0x6041, 0x603F, 0x6064


class Bench:
    """A second device on the bus: the canopen package reads the drives by SDO, while no master
    sends SYNC."""

    def __init__(self, channel: str) -> None:
        import canopen

        self._network = canopen.Network()
        self._network.connect(interface="petrobot_stream", channel=channel)
        self._drives = {n: self._network.add_node(n, DRIVE_EDS) for n in DRIVES}

    def read(self, index: int) -> list[int]:
        """Read an object of every drive."""
        return [int(self._drives[n].sdo[index].raw) for n in DRIVES]

    def close(self) -> None:
        """Leave the bus."""
        self._network.disconnect()


def left_alone(channel: str) -> tuple[list[DriveState], list[int], list[int], list[int]]:
    """Return states and error codes once every drive is in FAULT, and the positions at two times,
    0.25 s apart."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a message of the canopen package
        bench = Bench(channel)
        pause = threading.Event()
        try:
            for _ in range(int(LIMIT / 0.05)):
                states = [state_of(word) for word in bench.read(STATUSWORD)]
                if all(state is DriveState.FAULT for state in states):
                    break
                pause.wait(0.05)
            codes = bench.read(ERROR_CODE)
            before = bench.read(POSITION)
            pause.wait(0.25)
            return states, codes, before, bench.read(POSITION)
        finally:
            bench.close()


async def test_drives_stop_by_themselves_when_their_master_is_killed(tmp_path: Path) -> None:
    """kill -9 of the node, its servo process and its worker during a move: the drives lose the
    heartbeat, do a quick stop and brake; nothing moves."""
    directory = cell_in(tmp_path)
    async with Supervisor(
        local_programs(directory), tmp_path / "logs", respawn=False
    ) as supervisor:
        with ear_on(directory) as ear:
            cell = Cell(tmp_path, directory, supervisor, ear)
            try:
                await cell.sweep()
                node = supervisor.process_ids()["motion"]
                kill([node, *below(node)])
                channel = directory.devices["arm"].config["channel"]
                states, codes, before, after = await asyncio.to_thread(left_alone, channel)
            finally:
                if cell.coordinator is not None:
                    cell.coordinator.kill()
                    cell.coordinator.communicate()
    assert states == [DriveState.FAULT] * len(DRIVES)
    assert set(codes) <= {DriveFault.HEARTBEAT, DriveFault.SYNC_LOST}
    assert max(abs(a - b) for a, b in zip(before, after, strict=True)) < 200, "0.2 mrad: they stand"
