"""kill -9 of the coordinator just before the arm catches, in real time with the whole cell, and
resumed."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from tests.integration.cell_files import services_file
from tests.integration.test_resume_processes import PATIENCE, QUIET, nodes, petrobot, until

pytestmark = [pytest.mark.processes, pytest.mark.proof]
RUNS = 3


@pytest.mark.parametrize("place", ["track_ball", "catch_ball", "return_home"])
def test_killed_during_a_catch_the_task_continues_to_its_end(place: str, tmp_path: Path) -> None:
    """The arm's action is not rejoined, since the ball has passed: it ends in ERROR with a cause,
    or with its stored result. Then the other balls are caught.

    The mission's clock includes the time without a coordinator, so the score has every cycle, also
    those before the kill.
    """
    services = services_file(tmp_path)
    up = nodes(tmp_path)
    runs = tmp_path / "runs"
    try:
        given = [
            "catch_ball",
            "--services",
            str(services),
            "--runs",
            str(RUNS),
            "--journal",
            str(runs),
            "--seed",
            "3",
        ]
        process = petrobot(tmp_path, "run", *given, *QUIET)
        entered = f"{place}#2".encode()
        until(
            lambda: any(entered in path.read_bytes() for path in runs.glob("*/run.journal")),
            process,
        )
        process.send_signal(signal.SIGKILL)
        process.wait()
        [run] = runs.iterdir()
        again = petrobot(tmp_path, "resume", str(run), "--json", str(tmp_path / "out.json"), *QUIET)
        assert again.wait(PATIENCE) == 0, (tmp_path / "resume.txt").read_text()
        assert petrobot(tmp_path, "replay", str(run)).wait(PATIENCE) == 0
    finally:
        up.terminate()
        assert up.wait(PATIENCE) == 0
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["status"] == "success" and result["runs"] == RUNS
    throws = result["throws"]
    print(place, [(t["status"], t["cause"], t["caught"]) for t in throws])
    assert throws and all(t["status"] in ("success", "failure", "error") for t in throws), (
        "a cycle that the referee cannot match"
    )
    assert all(t["cause"] for t in throws if t["status"] == "error")
