"""`petrobot up`: its systemd unit for the nodes of this host, and what it says of their address."""

from __future__ import annotations

import shlex
import shutil
import socket
import subprocess
import sys
import threading
from configparser import RawConfigParser
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator import launch
from petrobot.coordinator.cli import main
from petrobot.coordinator.cli.up import only_here
from petrobot.coordinator.launch import local_programs
from petrobot.services.comm.location_file import parse

SERVICES = 'schema = 1\n[nodes.left]\nhost = "127.0.0.1"\nport = 4901\n'


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    """A location file in a folder whose name needs quotes."""
    folder = tmp_path / 'my "robot" 100% $HOME a\\b'
    folder.mkdir()
    (folder / "services.toml").write_text(SERVICES, encoding="utf-8")
    return folder


def test_the_unit_has_absolute_paths(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["up", "--services", str(cell / "services.toml"), "--print-unit"]) == 0
    unit = RawConfigParser()
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read_string(capsys.readouterr().out)
    folder = str(cell).replace("%", "%%")
    assert unit["Service"]["WorkingDirectory"] == folder
    program = Path(sys.executable).with_name("petrobot")
    command = shlex.split(unit["Service"]["ExecStart"].replace("$$", "$"))
    assert command[:5] == [str(program), "up", "--services", f"{folder}/services.toml", "--logs"]
    assert command[5].startswith("/") and "$HOME" not in unit["Service"]["ExecStart"].replace(
        "$$HOME", ""
    )


@pytest.mark.processes
@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd-analyze is not there")
def test_systemd_accepts_the_unit(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["up", "--services", str(cell / "services.toml"), "--print-unit"])
    unit = cell / "petrobot.service"
    unit.write_text(capsys.readouterr().out, encoding="utf-8")
    command = ["systemd-analyze", "verify", "--man=no", str(unit)]
    said = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert not [line for line in said.stderr.splitlines() if "petrobot.service" in line], said


@pytest.mark.parametrize(
    ("host", "addresses", "said"),
    [
        ("robot", ["127.0.1.1"], "other hosts cannot reach it: robot stands for 127.0.1.1 here; "),
        ("0.0.0.0", ["0.0.0.0"], "other hosts cannot reach it: 0.0.0.0 is not the address of one"),
        ("robot", ["127.0.1.1", "192.0.2.7"], ""),
        ("robot", ["fe80::7"], ""),
        ("robot", [], ""),
        ("localhost", ["127.0.0.1"], ""),
        ("127.0.1.1", ["127.0.1.1"], ""),
    ],
)
def test_a_name_that_only_this_host_knows_as_loopback(
    host: str, addresses: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Debian and Ubuntu write 127.0.1.1 and the host's own name into /etc/hosts. A name server that
    is gone by now ends nothing: the nodes are ready."""
    known = socket.getaddrinfo

    def look_up(name: str, *rest: Any, **more: Any) -> list[Any]:
        if not addresses:
            raise socket.gaierror(socket.EAI_AGAIN, "no answer")
        return [one for at in addresses for one in known(at, *rest, **more)]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    assert only_here(host).startswith(said) and bool(only_here(host)) is bool(said)


def test_hosts_are_looked_up_at_the_same_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a name server each lookup takes ten seconds; `up` made them in turn."""
    names = ("vision", "arm", "base")
    nodes = "".join(f'{n} = {{ host = "{n}.example", port = 4901 }}\n' for n in names)
    directory = parse(f"schema = 1\n[nodes]\n{nodes}", tmp_path / "services.toml")
    together = threading.Barrier(len(names))

    def look_up(host: str) -> bool:
        together.wait(60.0)
        return host == "arm.example"

    monkeypatch.setattr(launch, "is_local", look_up)
    assert [program.name for program in local_programs(directory)] == ["arm"]
