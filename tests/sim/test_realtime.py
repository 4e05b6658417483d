"""The laboratory in wall-clock time, over its sockets; and as a separate process."""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from petrobot.services.comm.calls.caller import Caller, Notice
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.canopen.ports import StreamPort
from petrobot.services.comm.location_file import load
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.comm.protocol.messages import Answer, Call, Command, Hello, Outcome
from petrobot.services.comm.streams.camera import StreamImages
from petrobot.sim.catching.laboratory import CatchingLaboratory
from petrobot.sim.catching.truth import LaboratoryError
from petrobot.sim.realtime import LaboratoryShell, bus_channel, camera_address
from tests.ports import free_ports
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


def services_file(folder: Path, extra: str = "") -> Path:
    cell = REPOSITORY / "services" / "cell.toml"
    sim = "petrobot.sim.catching.laboratory:make_laboratory"
    return laboratory_file(folder, sim, f'cell = "{cell}"\n{extra}')


@pytest.fixture
async def shell(tmp_path: Path) -> AsyncIterator[LaboratoryShell]:
    async with running(services_file(tmp_path)) as started:
        yield started


async def ask(shell: LaboratoryShell, service: str, **arguments: Any) -> Outcome:
    return await call(shell.server.address, service, **arguments)


async def test_world_keeps_pace_with_the_clock(shell: LaboratoryShell) -> None:
    lab, pacemaker = shell.laboratory, shell.pacemaker
    loop = asyncio.get_running_loop()
    began, world, slipped = loop.time(), lab.now, pacemaker.slipped

    def kept_pace() -> bool:
        took = loop.time() - began - (pacemaker.slipped - slipped)
        passed = lab.now - world
        assert passed < took + 2 * TICK  # It is never ahead of the clock.
        return passed > 0.5 and took - passed < 0.3  # On a busy host it catches up.

    await until(kept_pace)


async def test_drives_answer_on_the_bus(
    shell: LaboratoryShell, cell_master: Callable[[], Any]
) -> None:
    port = StreamPort(bus_channel(shell._directory))
    master = cell_master()
    lab = shell.laboratory
    last = [0.0]

    def exchange() -> bool:
        if lab.now > last[0]:
            last[0] = lab.now
            for frame in master.frames(lab.now):
                port.send(frame)
        master.take(port.receive())
        return bool(master.enabled)

    await until(exchange)
    assert isinstance(lab, CatchingLaboratory)
    assert master.position == pytest.approx(lab.plant.q, abs=1e-3)
    port.close()


async def test_images_come_with_their_age_and_stop_when_asked(shell: LaboratoryShell) -> None:
    address = camera_address(shell._directory)
    assert address is not None
    loop = asyncio.get_running_loop()
    camera = StreamImages(*address, loop.time)
    camera.start(25.0)
    images: list[Any] = []

    def look() -> bool:
        image = camera.newest()
        if image is not None:
            images.append((loop.time(), image))
        return len(images) >= 6

    await until(look)
    assert all(0.007 < arrived - image.time < 5.0 for arrived, image in images)
    assert np.diff([image.sequence for _, image in images]).min() >= 1
    assert images[0][1].pixels.shape == (480, 640)
    camera.stop()
    await until(lambda: camera.newest() is None and shell.laboratory.exposures.rate == 0.0)
    camera.close()


async def test_services_are_answered(
    shell: LaboratoryShell, caplog: pytest.LogCaptureFixture
) -> None:
    """Each preparation and each refused call is logged."""
    caplog.set_level(logging.INFO, "petrobot.sim")
    assert (
        await ask(shell, "laboratory_prepare", seed=7, regime="B+miscalibrated", runs=3)
    ).status == "success"
    score = await ask(shell, "laboratory_score")
    assert (score.values["seed"], score.values["regime"], score.values["throws"]) == (
        7,
        "B+miscalibrated",
        [],
    )
    assert (await ask(shell, "laboratory_fault", kind="slow_arm", factor=0.5)).status == "success"
    refused = await ask(shell, "laboratory_prepare", regime="Q")
    assert refused.status == "error" and "must begin with" in refused.text
    told = [record.getMessage() for record in caplog.records if record.name == "petrobot.sim"]
    logged = [text for text in told if not text.endswith("this host is too busy")]
    assert len(logged) == 2 and logged[0].endswith("of laboratory_prepare ended: success")
    assert "of laboratory_prepare ended: error" in logged[1] and refused.text in logged[1]


async def test_it_answers_a_status_command(shell: LaboratoryShell) -> None:
    """It answers at once: the client would treat a node that does not answer as frozen."""
    answered: list[Answer] = []

    def hear(_: float, notices: list[Notice]) -> None:
        answered.extend(notice for notice in notices if isinstance(notice, Answer))

    caller = Caller("laboratory", Hello(2, 2, "client", "asking", "a1"))
    client = Client(*shell.server.address, caller, on_notices=hear)
    client.start()
    assert await client.connected(PATIENCE)
    caller.command(client.now(), Command("asking/status", "status"))
    client.flush()
    await until(lambda: bool(answered))
    await client.close()
    assert answered == [
        Answer("asking/status", True, {"answers": {}, "devices": {}, "emergency": []})
    ]


async def test_a_fault_of_the_world_ends_the_shell(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    failing = LaboratoryShell(load(services_file(tmp_path)), "laboratory")

    def fails(now: float) -> None:
        raise RuntimeError("the world came to its end")

    failing.laboratory.tick = fails  # type: ignore[method-assign]
    await failing.start()
    async with asyncio.timeout(PATIENCE):
        await failing.over.wait()
    with pytest.raises(RuntimeError, match="came to its end"):
        await failing.close()
    assert "RuntimeError: the world came to its end" in caplog.text


@pytest.mark.parametrize(
    ("extra", "says"),
    [
        (
            '[devices.other]\nnode = "robot"\ndriver = "no:Where"\ninterface = '
            '"petrobot_stream"\nchannel = "tcp://x:1"',
            "bus",
        ),
        (
            '[devices.other]\nnode = "robot"\ndriver = "no:Where"\nsource = "sim"\naddress = '
            '"127.0.0.1:1"',
            "cameras",
        ),
    ],
)
def test_a_second_bus_or_camera_is_refused(tmp_path: Path, extra: str, says: str) -> None:
    directory = load(services_file(tmp_path, extra))
    with pytest.raises(LaboratoryError, match=says):
        LaboratoryShell(directory, "laboratory")


# Processes


@pytest.mark.processes
@pytest.mark.parametrize("taken", ["node", "bus", "camera"])
def test_an_address_in_use_is_reported_with_file_address_and_remedy(
    tmp_path: Path, taken: str
) -> None:
    """A second laboratory would find all three in use."""
    file = services_file(tmp_path)
    directory = load(file)
    camera = camera_address(directory)
    assert camera is not None
    bus = bus_channel(directory)
    port = {
        "node": directory.nodes["laboratory"].port,
        "bus": int(bus.rpartition(":")[2]),
        "camera": camera[1],
    }[taken]
    with socket.create_server(("127.0.0.1", port)):
        process = program("--services", str(file))
        _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    assert (
        f"python -m petrobot.sim: {file}: " in said
        and str(port) in said
        and "or write another port" in said
    )


@pytest.mark.processes
def test_the_process_says_ready_and_ends_on_sigterm(tmp_path: Path) -> None:
    process = program("--services", str(services_file(tmp_path)))
    assert process.stdout is not None
    try:
        assert any("ready" in line for line in iter(process.stdout.readline, ""))
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.communicate()


@pytest.mark.processes
def test_it_is_a_member_of_a_lock_step_cell(tmp_path: Path) -> None:
    extra = f'[coordinator]\nhost = "127.0.0.1"\nport = {free_ports(1)[0]}'
    text = services_file(tmp_path, extra).read_text()
    lone = text[: text.index("[nodes.robot]")] + text[text.index("[services.laboratory_prepare]") :]
    file = tmp_path / "lone.toml"
    file.write_text(lone)
    directory = load(file)
    process = program("--services", str(file), "--lockstep")
    try:
        assert score_as_member(directory, [Call("1", "laboratory_score")])["regime"] == "A"
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.communicate()


@pytest.mark.processes
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "name the file with --services"),
        ("schema = 1\n[nodes.l]\nhost = '127.0.0.1'\nport = 7999\n", "write sim ="),
        (
            "schema = 1\n[nodes.l]\nhost = '127.0.0.1'\nport = 7999\nsim = "
            "'petrobot.sim.catching.laboratory:make_laboratory'\n",
            "[parameters] cell is missing",
        ),
    ],
)
def test_a_bad_location_file_is_one_clear_error(
    tmp_path: Path, text: str | None, says: str
) -> None:
    file = tmp_path / "services.toml"
    if text is not None:
        file.write_text(text)
    process = program("--services", str(file))
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2 and says in errors and "Traceback" not in errors
