"""`petrobot up --print-unit`: a systemd unit for the nodes of this host."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from configparser import RawConfigParser
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main

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
