"""`petrobot test driver`: the driver of a device of the location file, with its device."""

from __future__ import annotations

import shutil
import socket
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from petrobot.services.host.emergency_latch import ALL, latch_of

SORTER = Path(__file__).parents[2] / "examples" / "sorter"


def test_a_driver_that_keeps_the_rules(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(SORTER)
    there_and_back = ["--command", '{"to": "belt"}', "--command", '{"to": "home"}']
    assert (
        main(["test", "driver", "arm", *there_and_back, "--within", "0.2", "--seconds", "2"]) == 0
    )
    assert "arm: its driver keeps the rules" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (["nothing"], "no device with a driver of this name; there are: arm, scanner"),
        (["arm", "--command", "[]"], "expected a JSON object, got '[]'"),
        (["arm", "--command", "{to}"], "expected JSON, got '{to}'"),
    ],
)
def test_devices_that_cannot_be_tested(
    given: list[str],
    text: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(SORTER)
    try:
        code = main(["test", "driver", *given])
    except SystemExit as end:
        code = int(str(end.code))
    assert code == 2 and text in capsys.readouterr().err


def test_a_device_that_is_not_there_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    services = tmp_path / "services.toml"
    services.write_text(
        'schema = 1\n[nodes.pc]\nhost = "127.0.0.1"\nport = 7001\n[devices.arm]\nnode = "pc"\n'
        'driver = "petrobot.services.adapters.so101.arm:Arm"\nport = "/dev/no-such-arm"\n'
    )
    assert main(["test", "driver", "arm", "--services", str(services)]) == 2
    told = capsys.readouterr().err
    assert "devices.arm: " in told and "check that it is connected" in told
    assert "Traceback" not in told


@pytest.mark.parametrize("why", ["stopped", "in use", "elsewhere"])
def test_a_device_that_must_not_be_moved_from_here(
    why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is in emergency stop, its node runs, or its node is on another host."""
    shutil.copytree(SORTER, tmp_path, dirs_exist_ok=True)
    services = tmp_path / "services.toml"
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        text = services.read_text().replace("7501", str(port))
        if why == "elsewhere":
            text = text.replace('"127.0.0.1"', '"192.0.2.7"', 1) + '[keys]\nfile = "cell.key"\n'
        services.write_text(text)
        if why == "stopped":
            server.close()
            latch_of(services, "arm_pc").stop([ALL])
        code = main(["test", "driver", "arm", "--services", str(services)])
    told = capsys.readouterr().err
    assert code == 2, told
    expected = {
        "stopped": "run `petrobot estop --clear`",
        "in use": f"node arm_pc runs on 127.0.0.1:{port} and controls arm; end it first",
        "elsewhere": "192.0.2.7: test it there",
    }
    assert expected[why] in told
