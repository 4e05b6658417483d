"""The whole rover cell in lock step: one run to the T, the same again, and through faults."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.launch import Setting, lockstep_mission, lockstep_party
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.task.file import load
from petrobot.services.comm.location_file import load as load_directory
from petrobot.services.comm.lockstep.cell import Delays, LockStepCell

ROOT = Path(__file__).parents[2]
TASK = ROOT / "coordinator" / "tasks" / "follow_track.toml"
SERVICES = ROOT / "services" / "mobile" / "track.services.toml"
LONGEST = 150.0
TICK = 0.004


def run(
    seed: int, regime: str, *, faults: dict[str, Any] | None = None, **use: str
) -> dict[str, Any]:
    """Return a run's result without its wall-clock time, and the results of its actions."""
    directory = load_directory(SERVICES)
    setting = Setting(load(TASK), {"regime": regime}, None, seed, FirstAlternative(use))
    party = CoordinatorParty(directory, lockstep_mission(directory, setting))
    nodes = {node.name: lockstep_party(directory, node) for node in directory.nodes.values()}
    cell = LockStepCell([party, *nodes.values()], Delays(directory.delays()))
    struck = faults is None

    def over() -> bool:
        nonlocal struck
        if not struck and party.mission.begun and party.mission.tally.firings >= 3:
            nodes["laboratory"].serve("laboratory_fault", faults)  # type: ignore[attr-defined]
            struck = True
        return party.over

    cell.run(over, round(LONGEST / TICK))
    result = party.mission.result("lockstep", 0.0)
    ends = [(r.place, str(r.status), r.cause) for r in party.mission.tally.runs]
    return {**result, "ends": ends, "struck": struck}


@pytest.fixture(scope="module")
def usual(shared: Callable[..., Path]) -> dict[str, Any]:
    """A run over straight and arc interruptions."""

    def make(folder: Path) -> None:
        (folder / "usual.json").write_text(json.dumps(run(20500, "mixed")), "utf-8")

    folder = shared("rover-cell", make)
    result: dict[str, Any] = json.loads((folder / "usual.json").read_text("utf-8"))
    return result


def test_a_run_ends_at_the_t(usual: dict[str, Any]) -> None:
    assert usual["status"] == "success" and usual["finished"] and usual["stopped_at_T"]
    assert usual["penalties"] == [] and usual["interruptions"] == usual["recovered"] == 2
    assert usual["rms_mm"] < 10.0 and usual["max_mm"] < 60.0
    assert {
        "finished",
        "stopped_at_T",
        "time_s",
        "penalties",
        "rms_mm",
        "max_mm",
        "interruptions",
        "recovered",
    } <= {*usual}


def test_each_end_of_a_stretch_was_a_choice_by_a_variable(usual: dict[str, Any]) -> None:
    places = [place for place, _, _ in usual["ends"]]
    assert places.count("follow_track") == 3 and places.count("recover_track") == 2
    assert places.count("stop_at_t") == 1 and places.count("watch_track") == 3


def test_a_drive_that_fails_is_reset_and_the_run_continues() -> None:
    result = run(20501, "plain", faults={"kind": "drive_fault", "joint": 1, "after": 4.0})
    assert result["struck"] and ("follow_track", "error", "drive_fault") in result["ends"]
    assert result["status"] == "success" and result["stopped_at_T"] and result["penalties"] == []
