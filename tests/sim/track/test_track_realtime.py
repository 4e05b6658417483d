"""The rover's laboratory on the wall clock: the shell that every laboratory has, and `python -m
petrobot.sim` as a process."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

from petrobot.services.comm.canopen.ports import StreamPort
from petrobot.services.comm.location_file import load
from petrobot.services.comm.protocol.messages import Call
from petrobot.services.comm.streams.camera import StreamImages
from petrobot.sim.catching.truth import LaboratoryError
from petrobot.sim.realtime import LaboratoryShell, bus_channel, camera_address
from petrobot.sim.track.course import Track
from petrobot.sim.track.laboratory import TrackLaboratory
from tests.sim.laboratory_shell import (
    PATIENCE,
    REPOSITORY,
    call,
    laboratory_file,
    program,
    running,
    score_as_member,
    until,
)


def services_file(folder: Path, sim: str = "petrobot.sim.track.laboratory:make_laboratory") -> Path:
    rover = REPOSITORY / "services" / "mobile" / "rover.toml"
    return laboratory_file(folder, sim, f'rover = "{rover}"')


@pytest.fixture
async def shell(tmp_path: Path) -> AsyncIterator[LaboratoryShell]:
    async with running(services_file(tmp_path)) as started:
        yield started


async def test_the_rover_drives_over_the_bus(
    shell: LaboratoryShell, rover_master: Callable[[], Any]
) -> None:
    lab = shell.laboratory
    assert isinstance(lab, TrackLaboratory)
    answer = await call(shell.server.address, "laboratory_prepare", seed=3, regime="plain")
    assert answer.status == "success"
    port = StreamPort(bus_channel(shell._directory))
    master, last = rover_master(), [0.0]

    def exchange() -> None:
        if lab.now - last[0] >= 0.02:
            last[0] = lab.now
            for frame in master.frames():
                port.send(frame)
        master.take(port.receive())

    def enabled() -> bool:
        exchange()
        return bool(master.enabled)

    def far() -> bool:
        exchange()
        return float(lab.referee.score(lab.now)["way_m"]) > 0.2

    await until(enabled)
    master.wanted = [4.0, 4.0]
    await until(far)
    assert master.echoes is not None
    score = (await call(shell.server.address, "laboratory_score")).values
    assert score["way_m"] > 0.2
    assert score["penalties"] == []
    port.close()


async def test_images_come_over_the_wire(shell: LaboratoryShell) -> None:
    address = camera_address(shell._directory)
    assert address is not None
    images = StreamImages(*address, time.monotonic)
    images.start(25.0)
    found: list[Any] = []

    def take() -> bool:
        image = images.newest()
        if image is not None:
            found.append((image, time.monotonic() - image.time))
        return len(found) >= 5

    await until(take)
    images.close()
    assert {image.pixels.shape for image, _ in found} == {(120, 160)}
    assert all(age >= 0.008 for _, age in found)
    assert len({image.sequence for image, _ in found}) == 5


async def test_faults_and_refusals_are_answered(shell: LaboratoryShell) -> None:
    address = shell.server.address
    assert (
        await call(address, "laboratory_fault", kind="dead_sensor", duration=1.0)
    ).status == "success"
    refused = await call(address, "laboratory_prepare", regime="arcs+fog")
    assert (refused.status, refused.cause) == ("error", "bad_arguments")
    assert "'fog'" in refused.text


def test_what_makes_no_laboratory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "odd_laboratory.py").write_text("def make(directory, name):\n    return object()\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(LaboratoryError, match="LaboratoryParty"):
        LaboratoryShell(load(services_file(tmp_path, "odd_laboratory:make")), "laboratory")


@pytest.mark.processes
def test_as_a_process_it_serves_until_sigterm(tmp_path: Path) -> None:
    file = services_file(tmp_path)
    directory = load(file)
    process = program("--services", str(file))
    try:
        assert process.stdout is not None
        assert "ready" in process.stdout.readline()
        prepared = asyncio.run(
            call(directory.address("laboratory"), "laboratory_prepare", seed=2, regime="contest")
        )
        assert prepared.status == "success"
        score = asyncio.run(call(directory.address("laboratory"), "laboratory_score")).values
        assert (score["interruptions"], score["finished"]) == (3, False)
    finally:
        os.kill(process.pid, signal.SIGTERM)
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 0


@pytest.mark.processes
def test_it_is_a_member_of_a_lock_step_cell(tmp_path: Path) -> None:
    file = services_file(tmp_path)
    text = file.read_text()
    port = text.split("[nodes.robot]")[1].split("port = ")[1].split()[0]
    alone = (
        text[: text.index("[nodes.robot]")] + text[text.index("[services.laboratory_prepare]") :]
    )
    file.write_text(f'{alone}[coordinator]\nhost = "127.0.0.1"\nport = {port}\n')
    directory = load(file)
    process = program("--services", str(file), "--lockstep")
    calls = [
        Call("1", "laboratory_prepare", {"seed": 6, "regime": "contest"}),
        Call("2", "laboratory_score"),
    ]
    try:
        score = score_as_member(directory, calls)
        assert score["regime"] == "contest"
        assert score["track"] == Track.contest().plain()
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.communicate()
