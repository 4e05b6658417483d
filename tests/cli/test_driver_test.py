"""`petrobot test driver`: the driver of a device of the location file, with its device."""

from __future__ import annotations

from pathlib import Path

import pytest

from petrobot.coordinator.cli import main

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
