"""Keys and authorities are replaced host by host: at every step every node reaches every other, and
the coordinator all of them."""

from __future__ import annotations

import asyncio
import itertools
import shutil
import subprocess
from pathlib import Path

import pytest

from petrobot.services.comm.location_file import DirectoryError, parse
from petrobot.services.comm.protocol.security import new_key, write_key
from petrobot.services.comm.tls.certificates import make_certificates
from tests.node.test_processes import CELL, PATIENCE, start_node
from tests.ports import free_ports
from tests.processes import below, kill
from tests.security.test_streams import GuardedOperator
from tests.waiting import beat, until

pytestmark = pytest.mark.processes
PASSES = {
    "shared key": ['file = "old"', 'file = "new"\nalso = "old"', 'file = "new"'],
    "certificates": [
        'certificates = "old"',
        'certificates = "old"\nalso = "new"',
        'certificates = "new"\nalso = "old"',
        'certificates = "new"',
    ],
}
"""Contents of [keys], round by round; a host begins a round when all hosts have finished the
previous one."""


RETRY = 0.1
"""Seconds between attempts."""


class Hosts:
    """Two hosts and the coordinator's, each with a services.toml of its own."""

    def __init__(self, folder: Path, how: str) -> None:
        left, right = free_ports(2)
        self.folder = folder
        self.cell = CELL.format(left=left, right=right)
        self.nodes: dict[str, subprocess.Popen[str]] = {}
        for name in ("old", "new"):
            if how == "certificates":
                make_certificates(folder / name, ["coordinator", "left", "right"])
            else:
                write_key(folder / name, new_key())

    def write(self, host: str, keys: str) -> Path:
        """The services.toml of a host, with its keys beside it."""
        place = self.folder / host
        place.mkdir(exist_ok=True)
        for name in ("old", "new"):
            source = self.folder / name
            if source.is_dir():
                shutil.copytree(source, place / name, dirs_exist_ok=True)
            else:
                shutil.copy2(source, place / name)
        path = place / "services.toml"
        path.write_text(f"{self.cell}[keys]\n{keys}\n")
        return path

    def restart(self, node: str, keys: str) -> None:
        """Restart a node with other keys."""
        self.stop(node)
        process = self.nodes[node] = start_node(node, self.write(node, keys))
        assert process.stdout is not None and "ready" in process.stdout.readline()

    def stop(self, node: str) -> None:
        """End a node, if it runs."""
        process = self.nodes.pop(node, None)
        if process is not None:
            process.terminate()
            process.communicate(timeout=PATIENCE)

    async def works(self, keys: str) -> None:
        """Check that a coordinator with these keys reaches both nodes, and they each other, by a
        call and by a stream of set points."""
        path = await asyncio.to_thread(self.write, "coordinator", keys)
        operator = GuardedOperator(parse(path.read_text(), path))
        try:
            await operator.connect("left", "right")
            # A node retries the other once a second: until then the first calls may fail.
            async with asyncio.timeout(PATIENCE):
                while (await operator.call("relay", a=3)).values.get("sum") != 5:  # node to node
                    await asyncio.sleep(RETRY)
                while not await self._follows(operator):
                    await asyncio.sleep(RETRY)
        finally:
            await operator.close()

    @staticmethod
    async def _follows(operator: GuardedOperator) -> bool:
        """Return whether set points arrive from node to node."""
        following = asyncio.create_task(operator.call("follow", seconds=1.0))
        await operator.call("lead", seconds=0.8)
        return bool((await following).values.get("count"))


@pytest.mark.parametrize(
    "how", ["shared key", pytest.param("certificates", marks=pytest.mark.proof)]
)
async def test_keys_are_replaced_host_by_host_without_an_outage(tmp_path: Path, how: str) -> None:
    hosts = Hosts(tmp_path, how)
    passes = PASSES[how]
    try:
        for node in ("left", "right"):
            await asyncio.to_thread(hosts.restart, node, passes[0])
        await hosts.works(passes[0])
        for before, after in itertools.pairwise(passes):
            await asyncio.to_thread(hosts.restart, "left", after)
            await hosts.works(before)
            await hosts.works(after)
            await asyncio.to_thread(hosts.restart, "right", after)
            await hosts.works(after)
    finally:
        for node in list(hosts.nodes):
            hosts.stop(node)


async def test_new_processes_of_a_node_use_the_keys_that_it_began_with(tmp_path: Path) -> None:
    hosts = Hosts(tmp_path, "shared key")
    keys = PASSES["shared key"][0]
    try:
        for node in ("left", "right"):
            await asyncio.to_thread(hosts.restart, node, keys)
            (tmp_path / node / "old").unlink()
            kill(below(hosts.nodes[node].pid))
        await hosts.works(keys)
    finally:
        for node in list(hosts.nodes):
            hosts.stop(node)


async def test_a_node_logs_why_a_stream_cannot_be_sent(tmp_path: Path) -> None:
    hosts = Hosts(tmp_path, "shared key")
    passes = PASSES["shared key"]
    try:
        await asyncio.to_thread(hosts.restart, "left", passes[2])
        await asyncio.to_thread(hosts.restart, "right", passes[0])
        path = await asyncio.to_thread(hosts.write, "coordinator", passes[1])
        operator = GuardedOperator(parse(path.read_text(), path))
        try:
            await operator.connect("right")
            leading = asyncio.create_task(operator.call("lead", seconds=PATIENCE))
            log = tmp_path / "right" / "right.log"
            says = "stream points: left does not tell where it goes: unreachable"
            await until(lambda: says in log.read_text(), says)
            await beat(2.0)
            leading.cancel()
            await asyncio.gather(leading, return_exceptions=True)
        finally:
            await operator.close()
    finally:
        for node in list(hosts.nodes):
            hosts.stop(node)
    assert log.read_text().count(says) < 4, log.read_text()


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ('also = "old.key"', "keys.also: is accepted beside another key, and there is none"),
        ('file = "a"\ncertificates = "b"', "keys: a shared key and certificates; name one of them"),
    ],
)
def test_an_also_needs_a_key_beside_it(keys: str, says: str) -> None:
    text = CELL.format(left=1001, right=1002) + f"[keys]\n{keys}\n"
    with pytest.raises(DirectoryError, match=says):
        parse(text, Path("services.toml"))


def test_the_hash_does_not_include_keys() -> None:
    """During a replacement hosts name different keys; everything else must still be the same."""
    cell = CELL.format(left=1001, right=1002)
    hashes = {
        parse(cell + keys, Path("services.toml")).hash
        for keys in ("", '[keys]\nfile = "a"\nalso = "b"\n')
    }
    assert len(hashes) == 1
    assert parse(cell.replace("1002", "1003"), Path("services.toml")).hash not in hashes
