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
