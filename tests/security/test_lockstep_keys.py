"""Security of a lock-step cell: sealed by the shared key; with certificates it runs on one host
only, and says so before it listens."""

from __future__ import annotations

from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.launch import Setting, lockstep_member, lockstep_mission
from petrobot.coordinator.task.file import load as load_task
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.comm.lockstep.mesh import cell_key
from petrobot.services.comm.protocol.security import KeyNeededError, new_key, write_key
from tests.chaos.shuttle_cell import SERVICES, TASK
from tests.ports import free_ports

FAR = "192.0.2.7"  # RFC 5737: an address for documentation


def cell(folder: Path, keys: str, host: str) -> Directory:
    """Return the shuttle's cell with these keys, its right node at `host`."""
    text = SERVICES.format(
        *free_ports(3), log=folder / "moves.txt", fetch=0.1, carry=0.1, orphan=1.0
    )
    head, right = text.split("[nodes.right]")
    text = f"{head}[nodes.right]{right.replace('127.0.0.1', host, 1)}\n[keys]\n{keys}\n"
    path = folder / "services.toml"
    path.write_text(text, encoding="utf-8")
    return parse(text, path)


def test_certificates_do_not_work_between_hosts_in_lock_step(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Members and coordinator refuse, with the member's address and the remedy; the exit code is
    2."""
    directory = cell(tmp_path, 'certificates = "keys"', FAR)
    with pytest.raises(
        KeyNeededError, match=rf"right is at {FAR}: .*file = \"cell.key\" in place of certificates"
    ):
        cell_key(directory)
    setting = Setting(load_task(TASK))
    with pytest.raises(KeyNeededError, match="does not use TLS"):
        lockstep_member(directory, lockstep_mission(directory, setting))
    given = [
        "--services",
        str(directory.source),
        "--mode",
        "lockstep",
        "--processes",
        "0",
        "--join",
        "--quiet",
    ]
    assert main(["run", str(TASK), *given]) == 2
    assert "does not use TLS" in capsys.readouterr().err


def test_certificates_work_on_loopback_and_a_shared_key_everywhere(
    tmp_path: Path,
) -> None:
    assert cell_key(cell(tmp_path, 'certificates = "keys"', "127.0.0.1")) is None
    key = new_key()
    write_key(tmp_path / "cell.key", key)
    assert cell_key(cell(tmp_path, 'file = "cell.key"', FAR)) == key
