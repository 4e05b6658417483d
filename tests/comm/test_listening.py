"""An address that a node cannot listen on: the error has file, key and remedy, and comes before any
device is touched."""

from __future__ import annotations

import errno
import socket
from pathlib import Path

import pytest

from petrobot.services.__main__ import main
from petrobot.services.comm.location_file import Directory, DirectoryError, host_checks, parse
from petrobot.services.comm.location_file.host_checks import (
    cannot_listen,
    claim,
    listening,
)
from petrobot.services.comm.lockstep.cell import CellError
from petrobot.services.comm.lockstep.mesh import Member
from tests.ports import free_ports

PLACES = """\
schema = 1
[nodes.left]
host = "{host}"
port = {port}
[devices.bell]
node = "left"
driver = "tests.comm.test_listening:Rung"
"""


class Rung:
    """A driver that must not be made."""

    def __init__(self, *_: object) -> None:
        raise AssertionError("a device was touched")


def directory_in(folder: Path, host: str, port: int) -> Directory:
    path = folder / "services.toml"
    path.write_text(PLACES.format(host=host, port=port), encoding="utf-8")
    return parse(path.read_text(encoding="utf-8"), path)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (
            OSError(errno.EADDRINUSE, "in use"),
            "nodes.left.port: 7301 is in use on 10.0.0.7: does this node run already",
        ),
        (OSError(errno.EACCES, "denied"), "nodes.left.port: 7301 may not be used by this user"),
        (
            OSError(errno.EADDRNOTAVAIL, "no"),
            "nodes.left.host: 10.0.0.7 is not an address of this host",
        ),
        (
            socket.gaierror(socket.EAI_NONAME, "unknown"),
            "nodes.left.host: 10.0.0.7 is neither an address nor a known name (unknown)",
        ),
        (
            OSError(errno.ENETDOWN, "down"),
            "nodes.left.host: cannot listen on 10.0.0.7:7301: down; correct",
        ),
        (
            OSError("of no number"),
            "nodes.left.host: cannot listen on 10.0.0.7:7301: of no number; correct",
        ),
    ],
)
def test_each_error_names_its_key_and_a_remedy(fault: OSError, said: str) -> None:
    assert cannot_listen("nodes.left", "10.0.0.7", 7301, fault).startswith(said)


def test_a_node_whose_port_is_taken_touches_no_device(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The process that has the port may be moving them."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        directory = directory_in(tmp_path, "127.0.0.1", port)
        assert main(["left", "--services", str(directory.source)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"node left: {directory.source}: nodes.left.port: {port} is in use")
    assert said.count("\n") == 1


def test_an_address_of_another_host_is_an_error_of_host(tmp_path: Path) -> None:
    """192.0.2.0/24 is reserved for documentation (RFC 5737)."""
    directory = directory_in(tmp_path, "192.0.2.1", 7301)
    with pytest.raises(
        DirectoryError,
        match=r"services\.toml: nodes\.left\.host: 192\.0\.2\.1 is not an address of this host",
    ):
        claim(directory, "left")
    with (
        pytest.raises(DirectoryError, match=r"nodes\.left\.port: 7301 is in use"),
        listening(directory, "left"),
    ):
        raise OSError(errno.EADDRINUSE, "in use")


def test_a_free_address_is_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server may listen there, and no other process can claim it until this one gives it up."""
    [port] = free_ports(1)
    directory = directory_in(tmp_path, "127.0.0.1", port)
    monkeypatch.setattr(host_checks, "CLAIM_LIMIT", 0.1)
    with (
        claim(directory, "left"),
        pytest.raises(DirectoryError, match=rf"nodes\.left\.port: {port} is in use"),
    ):
        claim(directory, "left")
    claim(directory, "left").close()
    with socket.create_server(("127.0.0.1", port)) as again:
        assert again.getsockname()[1] == port


@pytest.mark.parametrize(
    ("name", "key"), [("left", "nodes.left.port"), ("coordinator", "coordinator.port")]
)
def test_a_member_of_a_lock_step_cell_gives_the_same_error(name: str, key: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(CellError, match=f"{key}: {port} is in use"):
            Member(name, [], {name: ("127.0.0.1", port)}).open()
