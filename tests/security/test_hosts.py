"""Security between hosts: no listening beyond loopback without a key, local services stay local, no
output shows a secret."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.launch import local_programs
from petrobot.coordinator.operator.run_address import ADDRESS_FILE
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.services.comm.location_file import parse
from petrobot.services.comm.protocol.security import new_key, write_key
from petrobot.services.comm.tls.certificates import make_certificates
from tests.security.arm_cell import ROOT, cell_in
from tests.security.conftest import KEY, Victim
from tests.waiting import Limit, beat

pytestmark = pytest.mark.processes
Start = Callable[..., Victim]
CERTIFICATES = '\n[keys]\ncertificates = "keys"\n'
SHARED = '\n[keys]\nfile = "cell.key"\n'


def run(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Start a module of petrobot as a process."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, check=False, timeout=120
    )


@pytest.mark.parametrize("program", ["services", "sim"])
def test_a_node_does_not_listen_beyond_this_host_without_a_key(
    tmp_path: Path, program: str
) -> None:
    """Exit code 2 and one line with the remedy; with a key the same address is accepted."""
    directory = cell_in(tmp_path)
    node = "motion" if program == "services" else "laboratory"
    port = directory.nodes[node].port
    text = directory.source.read_text().replace(
        f'host = "127.0.0.1"\nport = {port}', f'host = "0.0.0.0"\nport = {port}'
    )
    directory.source.write_text(text)
    arguments = [
        f"petrobot.{program}",
        *([node] if program == "services" else []),
        "--services",
        str(directory.source),
    ]
    done = run(*arguments)
    assert done.returncode == 2
    assert (
        f"{node}: refuses to listen on 0.0.0.0" in done.stderr and "`petrobot keys`" in done.stderr
    )


# --- another host -----------------------------------------------------------------------------


ELSEWHERE = """
import asyncio, json, sys
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client

async def main():
    hello = m.Hello(2, 2, "coordinator", "far", "f1", 1)
    caller, key = Caller("vision", hello, auto_ack=True), bytes.fromhex(sys.argv[3])
    client = Client(sys.argv[1], int(sys.argv[2]), caller, key=key)
    client.start()
    async with asyncio.timeout(60):
        assert await client.connected(60)
        echo, tune = await client.call("echo", {"n": 1}), await client.call("tune", {"n": 1})
    tuned = [tune.status, tune.cause, tune.executed]
    print(json.dumps({"offers": client.caller.offers, "echo": echo.status, "tune": tuned}))
    await client.close()

asyncio.run(main())
"""


def ip(*arguments: str) -> None:
    """Run a command of ip(8)."""
    subprocess.run(["ip", *arguments], capture_output=True, check=True)


@pytest.fixture
def other_host() -> Iterator[tuple[str, str]]:
    """Make a network namespace that is connected to this one; yield its name, and this host's
    address in it."""
    number = os.getpid() % 200 + 20
    name, here, there = f"pb{os.getpid()}", f"pbh{os.getpid() % 99999}", f"pbn{os.getpid() % 99999}"
    address = f"10.213.{number}.1"
    try:
        ip("netns", "add", name)
    except (OSError, subprocess.CalledProcessError) as fault:
        pytest.skip(f"a second host needs network namespaces (root and ip(8)): {fault}")
    try:
        ip("link", "add", here, "type", "veth", "peer", "name", there, "netns", name)
        ip("addr", "add", f"{address}/24", "dev", here)
        ip("link", "set", here, "up")
        ip("-n", name, "addr", "add", f"10.213.{number}.2/24", "dev", there)
        ip("-n", name, "link", "set", there, "up")
        yield name, address
    finally:
        ip("netns", "del", name)


def test_a_local_service_is_out_of_reach_for_another_host(
    victim: Start, other_host: tuple[str, str]
) -> None:
    """Even with the right key it is neither listed nor called; everything else is served."""
    namespace, address = other_host
    server = victim(key=KEY.hex(), host=address)
    command = [
        sys.executable,
        "-c",
        textwrap.dedent(ELSEWHERE),
        address,
        str(server.port),
        KEY.hex(),
    ]
    far = subprocess.run(
        ["ip", "netns", "exec", namespace, *command],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert far.returncode == 0, far.stderr
    told = json.loads(far.stdout)
    assert told == {
        "offers": ["echo", "big"],
        "echo": "success",
        "tune": ["error", "local_only", "no"],
    }


async def test_on_its_own_host_it_is_in_reach(victim: Start) -> None:
    """The same service for a caller on the same host."""
    server = victim()
    client = server.client()
    client.start()
    async with asyncio.timeout(60.0):
        assert (await client.call("tune", {"n": 1})).values == {"n": 1}
    await client.close()


# --- a whole cell with keys -------------------------------------------------------------------


class Guarded:
    """The arm's cell with a key or certificates, and all its output and files."""

    def __init__(
        self, folder: Path, how: str, capsys: pytest.CaptureFixture[str] | None = None
    ) -> None:
        """`capsys` is for `give`."""
        directory = cell_in(folder, speed=1.0)
        if how == "certificates":
            make_certificates(folder / "keys", ["coordinator", *directory.nodes])
        else:
            write_key(folder / "cell.key", new_key())
        text = directory.source.read_text() + (CERTIFICATES if how == "certificates" else SHARED)
        directory.source.write_text(text)
        self.folder = folder
        self._capsys = capsys
        self.directory = parse(text, directory.source)
        self.said: list[str] = []

    def secrets(self) -> dict[str, str]:
        """Return the secrets that must appear nowhere else, by the file that contains them."""
        found: dict[str, str] = {}
        for path in [*self.folder.glob("cell.key"), *self.folder.glob("keys/*.key")]:
            lines = [line for line in path.read_text().splitlines() if not line.startswith("-----")]
            found |= {
                f"{path.name}:{number}": line
                for number, line in enumerate(lines)
                if len(line) >= 32
            }
        return found

    def petrobot(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command as a process and keep its output."""
        services = ["--services", str(self.directory.source)]
        done = run("petrobot.coordinator", *arguments, *services, cwd=self.folder)
        self.said += [done.stdout, done.stderr]
        return done

    async def give(self, *arguments: str) -> tuple[int, str]:
        """Run a command in this process and keep its output; return its exit code and its
        errors."""
        assert self._capsys is not None
        code = await asyncio.to_thread(main, list(arguments))
        said = self._capsys.readouterr()
        self.said += [said.out, said.err]
        return code, said.err

    async def with_strange_keys(self, *arguments: str) -> tuple[int, str]:
        """Run a command with other keys."""
        own = [*self.folder.glob("cell.key"), *self.folder.glob("keys/c*.*")]
        kept = {path: path.read_bytes() for path in own}
        for path in own:
            path.unlink()
        if (self.folder / "keys").exists():
            make_certificates(self.folder / "keys", ["coordinator"])
        else:
            write_key(self.folder / "cell.key", new_key())
        try:
            return await self.give(*arguments)
        finally:
            for path, data in kept.items():
                path.write_bytes(data)

    def leaks(self, more: dict[str, str]) -> list[str]:
        """Return where a secret appears, as text or bytes, in the output and in every other
        file."""
        outputs = {f"output {n}": said.encode() for n, said in enumerate(self.said)}
        own = {
            path
            for path in self.folder.rglob("*")
            if path.suffix == ".key" or path.name.startswith(ADDRESS_FILE)
        }
        outputs |= {
            str(path): path.read_bytes()
            for path in self.folder.rglob("*")
            if path.is_file() and path not in own
        }
        forms = [
            (name, form)
            for name, secret in (self.secrets() | more).items()
            for form in _forms(secret)
        ]
        return [
            f"{name} in {where}"
            for where, data in outputs.items()
            for name, form in forms
            if form in data
        ]


def _process_list() -> list[str]:
    """Return command lines and environments of every process that we may read."""
    found = []
    for path in [*Path("/proc").glob("[0-9]*/cmdline"), *Path("/proc").glob("[0-9]*/environ")]:
        with contextlib.suppress(OSError):
            found.append(path.read_bytes().decode(errors="replace"))
    return found


def _forms(secret: str) -> list[bytes]:
    raw = [bytes.fromhex(secret)] if re.fullmatch("[0-9a-f]{64}", secret) else []
    return [secret.encode(), *raw, *(repr(one)[2:-1].encode() for one in raw)]


@pytest.mark.parametrize("how", ["shared key", "certificates"])
async def test_a_guarded_cell_works_and_keeps_its_secrets(
    tmp_path: Path,
    how: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nodes, run, log and emergency stop work with keys, and no output, log, journal or report
    shows one."""
    monkeypatch.chdir(tmp_path)
    cell = Guarded(tmp_path, how, capsys)
    token: dict[str, str] = {}

    async def look_for_token(done: asyncio.Future[Any]) -> None:
        limit = Limit("the page's token")
        while not done.done() and not token and limit.left():
            for path in tmp_path.glob(f"runs/*/{ADDRESS_FILE}"):
                token["page token"] = json.loads(path.read_text())["token"]
            await beat(0.01)

    async with Supervisor(local_programs(cell.directory), tmp_path / "logs", respawn=False):
        options = ("--journal", "runs", "--report", "report", "--json", "out.json", "--no-page")
        running = asyncio.ensure_future(
            asyncio.to_thread(cell.petrobot, "run", "sweeping.toml", *options)
        )
        await look_for_token(running)
        cell.said += _process_list()
        done = await running
        assert done.returncode == 0, done.stderr
        assert json.loads((tmp_path / "out.json").read_text())["status"] == "success"
        assert (await cell.give("nodes", "--json", "-"))[0] == 0
        assert (await cell.give("log", "last", "--format", "jsonl"))[0] == 0
        assert (await cell.give("estop", "--json", "-"))[0] == 0
        assert (await cell.give("estop", "--clear"))[0] == 0
        code, why = await cell.with_strange_keys("run", "sweeping.toml", "--no-page", "--quiet")
        assert code == 3 and "motion" in why
        expected = "expected the certificate of" if how == "certificates" else "wrong_key"
        assert expected in why
    assert token["page token"] and cell.secrets()
    assert list(tmp_path.glob("logs/*.log")) and (tmp_path / "report" / "index.html").exists()
    assert cell.leaks(token) == []
    (tmp_path / "logs" / "planted.log").write_text(
        f"the key is {next(iter(cell.secrets().values()))}"
    )
    assert len(cell.leaks(token)) == 1, "this test could not fail"


@pytest.mark.parametrize("command", [("nodes",), ("run", "sweeping.toml", "--no-page", "--quiet")])
def test_a_key_that_others_may_read_stops_every_command_but_the_emergency_stop(
    tmp_path: Path,
    command: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Bad input, reported in one line with the remedy."""
    cell = Guarded(tmp_path, "shared key")
    (tmp_path / "cell.key").chmod(0o644)
    monkeypatch.chdir(tmp_path)
    assert main([*command, "--services", str(cell.directory.source)]) == 2
    assert "chmod 600" in capsys.readouterr().err
