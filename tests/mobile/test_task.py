"""The task of figure 3: the result of check, its state space, and what happens after each result of
a run."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from petrobot.coordinator.analysis.commands import analyse_command
from petrobot.coordinator.analysis.net.space import SearchLimits
from petrobot.coordinator.task import Scope, Task
from petrobot.coordinator.task.check import check
from petrobot.coordinator.task.file import load
from petrobot.services.comm.location_file import Directory, load as load_directory

ROOT = Path(__file__).parents[2]
PATH = ROOT / "coordinator" / "tasks" / "follow_track.toml"
SERVICES = ROOT / "services" / "mobile" / "track.services.toml"


@pytest.fixture(scope="module")
def task() -> Task:
    """The shipped task."""
    return load(PATH)


@pytest.fixture(scope="module")
def directory() -> Directory:
    """Its location file."""
    return load_directory(SERVICES)


def test_check_finds_nothing(task: Task, directory: Directory) -> None:
    report = check(task, {name: entry.node for name, entry in directory.actions.items()})
    assert report.ok and [f for f in report.findings if f.severity != "note"] == []


def test_every_alternative_is_placed_on_the_node_of_its_device_and_nothing_else_is(
    task: Task, directory: Directory
) -> None:
    wanted = {a: p for p, primitive in task.primitive_tasks.items() for a in primitive.alternatives}
    assert {a.name: a.task for a in directory.actions.values()} == wanted
    assert {a.node for a in directory.actions.values()} == {"vision", "drive"}


def test_all_events_are_internal_and_conflicts_are_settled_by_variables(task: Task) -> None:
    assert all(event.scope is Scope.INTERNAL for event in task.events.values())
    for place in task.places.values():
        for end in ("normal", "error"):
            ways = [
                t
                for t in task.transitions.values()
                if any(
                    a.place == place.name and a.end is not None and a.end.value == end
                    for a in t.inputs
                )
            ]
            assert len(ways) <= 2, "binary choices, as the paper says"
            if len(ways) == 2:
                assert all(
                    t.when is not None and t.priority == 0 and t.weight is None for t in ways
                )


@pytest.mark.once
def test_the_state_space_has_the_required_properties() -> None:
    data = analyse_command(PATH, limits=SearchLimits()).data
    assert data["complete"] and data["states"] < 10_000
    again = data["mended"]  # what holds if the operator repairs what `final_error` leaves
    verdicts = {
        name: verdict["holds"] or (name in again and again[name]["holds"])
        for name, verdict in data["verdicts"].items()
    }
    assert verdicts.pop("safe") is False, "one place holds six attempts"
    assert set(verdicts) >= {
        "bounded",
        "deadlock_free",
        "quasi_live",
        "live",
        "proper",
        "sound",
        "controllable",
    }
    assert all(verdicts.values()), verdicts
    assert (
        data["bounds"]["attempts"] == 6
        and max(v for k, v in data["bounds"].items() if "attempts" not in k) == 1
    )
    recoveries = {r["error_exit"]: r for r in data["recoveries"]}
    assert len(recoveries) >= 9
    lost = {name for name, r in recoveries.items() if not r["possible"]["holds"]}
    assert lost == {"reset_failed"}, "the drives stay off: the task gives up"
    sure = {name for name, r in recoveries.items() if r["almost_sure"]["holds"]}
    assert sure == {"line_lost", "not_found", "watch_lost"}, "all other markings can lead to it"


def test_the_runtime_knows_nothing_of_this_application() -> None:
    """Another robot, another net, another services file: no name of them in coordinator/ (tasks/
    aside) or services/comm."""
    named = {"follow_track", "recover_track", "track_ahead", "petrobot.services.mobile", "rover"}
    for room in (ROOT / "coordinator", ROOT / "services" / "comm"):
        for path in room.rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            assert not [name for name in named if name in text], path
    assert "follow_track" in tomllib.loads(PATH.read_text(encoding="utf-8"))["task"]["name"]
