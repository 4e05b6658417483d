"""In real time with real nodes, a start accepts what the command line accepts: runs, seed,
parameters, and learning into a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from petrobot.coordinator.run.folder import JOURNAL
from petrobot.coordinator.run.journal import read_journal
from tests.operator.conftest import Cell

pytestmark = pytest.mark.processes


async def test_a_run_in_real_time_follows_the_whole_order(
    cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The order is in the journal's header and holds in the run, and what was learned is kept for
    the next run."""
    monkeypatch.chdir(tmp_path)  # Estimates are kept in the coordinator's folder.
    learn = {"file": "cell", "selector": "thompson", "contexts": ["speed"]}
    answer = await cell.say(
        "start", task="moving", runs=3, seed=11, parameters={"speed": 2}, learn=learn
    )
    assert answer["ok"], answer
    result = await cell.ended()
    assert (result["status"], result["runs"], result["seed"], result["speed"]) == (
        "success",
        3,
        11,
        2.0,
    )
    assert [f["transition"] for f in cell.state["firings"]].count("begin") == 3
    header = read_journal(cell.runs / answer["run"] / JOURNAL).header
    assert (header["mode"], header["runs"], header["seed"], header["parameters"]) == (
        "realtime",
        3,
        11,
        {"speed": 2.0},
    )
    assert header["learning"]["selector"] == "thompson"
    assert result["learned"]["runs_counted"] >= 3 and result["learned"]["context"] == "speed=2.0"
    assert (tmp_path / "estimates" / "cell.db").exists()
    assert any("thompson" in run["why"] for run in cell.state["ended"] if run["place"] == "look")
    again = await cell.say(
        "start", task="moving", runs=1, learn={**learn, "frozen": True}, parameters={"speed": 2}
    )
    assert again["ok"], again
    assert (await cell.ended())["learned"]["runs_counted"] == 0


async def test_an_invalid_order_leaves_no_run(
    cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is refused before a folder is made or a node is called."""
    monkeypatch.chdir(tmp_path)
    for data in (
        {"runs": 0},
        {"seed": "x"},
        {"learn": {"file": "a", "contexts": ["nothing_known"]}},
        {"learn": {"file": "a", "frozen": True}},
    ):
        answer = await cell.say("start", task="moving", **data)
        assert (answer["ok"], answer["code"]) == (False, "bad_data"), answer
    assert not cell.runs.exists() and not (tmp_path / "estimates").exists()
