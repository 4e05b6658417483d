"""Only the intended node may answer: a man in the middle without the key, and a wrong port in a
cell without a key.

The man in the middle is a foreign process: it receives at one node's address and forwards to
another node.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from petrobot.services.comm.protocol.security import new_key, write_key
from tests.node.test_processes import Nodes
from tests.ports import free_ports
from tests.security.conftest import Command

pytestmark = pytest.mark.processes
HOST = "127.0.0.1"
CELL = """\
schema = 1
[nodes.left]
host = "127.0.0.1"
port = {left}
[nodes.right]
host = "127.0.0.1"
port = {right}
[devices.gauge]
node = "left"
driver = "toy_cell.drivers:Slide"
period = 0.02
follow = false
[devices.slide]
node = "right"
driver = "toy_cell.drivers:Slide"
period = 0.02
follow = false
"""
KEYS = '[keys]\nfile = "cell.key"\n'


class Middle:
    """Forwards the bytes of one port to another, and can replay what a server sent in an earlier
    session."""

    def __init__(self, to: int) -> None:
        self.to = to
        self.port = 0
        self.recorded: list[bytes] = []
        """The server's bytes of each session."""
        self.replay: bytes | None = None
        """Bytes that are sent instead of the server's."""
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self) -> None:
        """Listen."""
        self._server = await asyncio.start_server(self._carry, HOST, 0)
        self.port = int(self._server.sockets[0].getsockname()[1])

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        try:  # `stop` may cancel at any line
            if self.replay is None:
                await self._relay(reader, writer)
            else:
                await reader.read(1)
                writer.write(self.replay)
                await reader.read()
        except ConnectionError:
            pass
        finally:
            writer.close()

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection(HOST, self.to)
        number = len(self.recorded)
        self.recorded.append(b"")

        async def answers() -> None:
            while data := await there.read(1 << 16):
                self.recorded[number] += data
                writer.write(data)
            writer.close()

        answering = asyncio.ensure_future(answers())
        try:
            while data := await reader.read(1 << 16):
                back.write(data)
        finally:
            back.close()
            await asyncio.gather(answering, return_exceptions=True)

    async def stop(self) -> None:
        """Close all connections."""
        assert self._server is not None
        self._server.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


class Deceived:
    """Two nodes, and the addresses at which their callers look for them."""

    def __init__(self, folder: Path, keyed: bool, command: Command) -> None:
        self.folder = folder
        self._command = command
        self.keyed = keyed
        left, right = free_ports(2)
        self.ports = {"left": left, "right": right}
        self.text = CELL.format(left=left, right=right) + (KEYS if keyed else "")
        self.middles: list[Middle] = []

    async def between(self, **to: str) -> Path:
        """Write the location file of a caller whose connections to these nodes lead to others;
        return its path."""
        ports = dict(self.ports)
        for node, other in to.items():
            middle = Middle(self.ports[other])
            await middle.start()
            self.middles.append(middle)
            ports[node] = middle.port
        path = self.folder / "believed.toml"
        path.write_text(CELL.format(**ports) + (KEYS if self.keyed else ""))
        return path

    async def estop(self, services: Path) -> tuple[int, dict[str, str]]:
        """Run `petrobot estop`; return its exit code, and by node why it did not answer (empty: it
        did)."""
        options = ["--journal", str(self.folder / "runs"), "--json", "-"]
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv("PETROBOT_STATE", str(self.folder / "state of the caller's host"))
            code, out, err = await self._command("estop", "--services", str(services), *options)
        assert out, err
        return code, {
            one["node"]: one["why"] or "?" * (one["seconds"] is None)
            for one in json.loads(out)["nodes"]
        }


@asynccontextmanager
async def deceived(folder: Path, keyed: bool, command: Command) -> AsyncIterator[Deceived]:
    """Start the two nodes as processes, with a shared key or without."""
    cell = Deceived(folder, keyed, command)
    if keyed:
        write_key(folder / "cell.key", new_key())
    (folder / "services.toml").write_text(cell.text)
    nodes = await asyncio.to_thread(Nodes, folder, "left", "right", text=cell.text)
    try:
        yield cell
    finally:
        for middle in cell.middles:
            await middle.stop()
        nodes.stop()


@pytest.mark.parametrize("keyed", [True, False], ids=["shared key", "no key"])
async def test_estop_names_each_node_that_was_not_reached(
    tmp_path: Path, keyed: bool, command: Command
) -> None:
    """Both addresses lead to one node, both are swapped, or one leads to a wrong node: the exit
    code is never 0, and only nodes that were really reached are reported as stopped."""
    async with deceived(tmp_path, keyed, command) as cell:
        straight = await cell.between(left="left", right="right")
        assert await cell.estop(straight) == (0, {"left": "", "right": ""}), (
            "somebody who only listens changes nothing"
        )
        for ways, missed in (
            ({"left": "left", "right": "left"}, {"right"}),
            ({"left": "right", "right": "left"}, {"left", "right"}),
            ({"left": "right", "right": "right"}, {"left"}),
        ):
            code, told = await cell.estop(await cell.between(**ways))
            assert code == 3 and {node for node, why in told.items() if why} == missed, (ways, told)
            assert all(
                "wrong_node" in told[node] and f"asked for {node}" in told[node] for node in missed
            ), told


async def test_a_replayed_session_stops_no_device(tmp_path: Path, command: Command) -> None:
    """The right node's answers to an earlier `estop` are replayed: their proof is of other
    nonces."""
    async with deceived(tmp_path, True, command) as cell:
        services = await cell.between(left="left", right="right")
        assert (await cell.estop(services))[0] == 0
        for middle in cell.middles:
            middle.replay = middle.recorded[0]
        code, told = await cell.estop(services)
        assert code == 3 and all("wrong_key" in why for why in told.values()), told


async def test_nodes_shows_a_wrong_port(tmp_path: Path, command: Command) -> None:
    """Two ports are swapped in services.toml, without a key: each node is reported as the other,
    and neither as up."""
    async with deceived(tmp_path, False, command) as cell:
        services = await cell.between(left="right", right="left")
        code, out, err = await command("nodes", "--services", str(services), "--json", "-")
        told = json.loads(out)
        assert code == 3, err
        assert "this is right, but the client asked for left" in told["left"]["why"]
        assert "this is left, but the client asked for right" in told["right"]["why"]
