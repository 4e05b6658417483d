"""Orders to start a run: read or refused; lock-step runs and runs from a recorded point, shown live
and controlled."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from hypothesis import HealthCheck, given, settings, strategies as st

from petrobot.coordinator.cli import main
from petrobot.coordinator.operator import station
from petrobot.coordinator.operator.emergency_stop import CLEAR, STOP, Stopped
from petrobot.coordinator.operator.history import opened
from petrobot.coordinator.operator.observation import TASK_REPORT
from petrobot.coordinator.operator.prepare import RunRequest
from petrobot.coordinator.operator.start_form import read_start, read_start_from, start_form
from petrobot.coordinator.operator.station import Station
from petrobot.coordinator.page.task_store import TaskStore
from petrobot.coordinator.run.folder import JOURNAL, RESULT
from petrobot.coordinator.run.journal import read_journal
from petrobot.coordinator.task.file import loads
from petrobot.services.comm.location_file import parse
from tests.operator.conftest import SCRIPT, SERVICES, TASK, Cell
from tests.waiting import beat, until

pytestmark = pytest.mark.processes

REMARKED = TASK.replace(
    "speed = 0.5",
    'speed = 0.5 # m/s\nquiet = false\nbatch = "A" # which\ncount = 3\nregime = "calm"',
)
MOVING = loads(REMARKED, "moving.toml")


class Simulated(Cell):
    """A station without active nodes, which can only simulate."""

    def __init__(self, folder: Path) -> None:
        path = folder / "services.toml"
        path.write_text(SERVICES.format(1, 2), encoding="utf-8")
        (folder / "script.toml").write_text(SCRIPT, encoding="utf-8")
        self.directory = parse(path.read_text(encoding="utf-8"), path)
        self.nodes = {}
        self.folder = folder
        self.tasks = TaskStore(folder / "tasks")
        self.tasks.save_text("moving", None, TASK)
        self.runs = folder / "runs"
        self.station = Station(
            self.directory, self.tasks, self.runs, folder / "script.toml", folder / "estimates"
        )

    async def simulate(self, **data: Any) -> tuple[str, Mapping[str, Any]]:
        """Start in lock step and wait for the end; return the run's folder and result."""
        answer = await self.say(
            "start", **{"task": "moving", "mode": "lockstep", "pace": 0, **data}
        )
        assert answer["ok"], answer
        result = await self.ended()
        await until(lambda: self.station._going is None)
        return answer["run"], result


@pytest_asyncio.fixture
async def cell(tmp_path: Path) -> AsyncIterator[Simulated]:
    """A station that can only simulate, with an operator who holds the controls."""
    made = Simulated(tmp_path)
    await made.say("take_controls")
    yield made
    await made.station.close()


def records(folder: Path) -> list[tuple[str, Any]]:
    """Return a journal without measured times."""
    found = []
    for record in read_journal(folder / JOURNAL).records:
        if isinstance(record.data.get("stimulus"), dict):
            record.data["stimulus"].pop("cpu_seconds", None)
        found.append((record.kind, record.data))
    return found


# ---- orders
# --------------------------------------------------------------------------------------------


def test_the_form_has_types_defaults_and_the_authors_comments(tmp_path: Path) -> None:
    """Parameters are those that the task file declares, with their comments; only files of the
    folder are offered."""
    (tmp_path / "known.db").touch()
    (tmp_path / "no name.db").touch()
    form = start_form(MOVING, REMARKED, tmp_path)
    assert form["runs"] == {"default": 2, "place": "jobs"}
    assert [(p["name"], p["type"], p["default"], p["text"]) for p in form["parameters"]] == [
        ("speed", "float", 0.5, "m/s"),
        ("quiet", "bool", False, ""),
        ("batch", "str", "A", "which"),
        ("count", "int", 3, ""),
        ("regime", "str", "calm", ""),
    ]
    assert form["learn"]["estimates"] == ["known"] and form["learn"]["contexts"] == ["regime"]
    assert json.loads(json.dumps(form)) == form


def test_every_option_of_the_command_line_is_read(tmp_path: Path) -> None:
    """Tried with all fields at once, and with none."""
    assert read_start(MOVING, {}, tmp_path) == RunRequest()
    learn = {
        "file": "mine",
        "selector": "thompson",
        "credit": "task",
        "target": 1,
        "contexts": ["regime", " "],
        "frozen": True,
    }
    given = {"mode": "lockstep", "runs": 7, "seed": 4, "regime": "wild", "pace": 10, "learn": learn}
    order = read_start(MOVING, {**given, "parameters": {"speed": 1, "quiet": True}}, tmp_path)
    assert (order.mode, order.runs, order.seed, order.pace) == ("lockstep", 7, 4, 10.0)
    assert order.parameters == {"speed": 1.0, "quiet": True, "regime": "wild"}
    assert type(order.parameters["speed"]) is float
    assert order.learning is not None and order.learning.path == tmp_path / "mine.db"
    learning = order.learning
    assert (learning.selector, learning.contexts, learning.frozen, learning.credit) == (
        "thompson",
        ("regime",),
        True,
        "task",
    )


BAD = [
    ({"mode": "dream"}, "mode: 'dream' is not one of realtime, lockstep"),
    ({"mode": ["lockstep"]}, "mode"),
    ({"runs": 0}, "runs: 0 is not a whole number from 1"),
    ({"runs": 1.5}, "runs: 1.5"),
    ({"runs": True}, "runs: True"),
    ({"runs": "many"}, "runs: 'many'"),
    ({"runs": 10**9}, "runs"),
    ({"seed": -1}, "seed: -1"),
    ({"seed": 2**63}, "seed"),
    ({"pace": -1}, "pace: -1"),
    ({"pace": "fast"}, "pace: 'fast'"),
    ({"pace": float("nan")}, "pace: nan"),
    ({"parameters": []}, None),
    ({"parameters": [1]}, "parameters: [1] is not a table"),
    ({"parameters": {"sped": 1}}, "no parameter 'sped'; it has: speed"),
    ({"parameters": {"speed": "fast"}}, "parameter speed: 'fast' is not a number"),
    ({"parameters": {"speed": float("inf")}}, "parameter speed: inf"),
    ({"parameters": {"quiet": 1}}, "parameter quiet: 1 is not true or false"),
    ({"parameters": {"count": 2.0}}, "parameter count: 2.0 is not a whole number"),
    ({"parameters": {"count": True}}, "parameter count: True"),
    ({"parameters": {"batch": 3}}, "parameter batch: 3 is not text"),
    ({"learn": "x"}, "learn: expected {file"),
    ({"learn": {}}, "learn.file: None"),
    ({"learn": {"file": "../x"}}, "learn.file: '../x'"),
    ({"learn": {"file": "/etc/passwd"}}, "learn.file"),
    ({"learn": {"file": "a" * 65}}, "learn.file"),
    ({"learn": {"file": ["a"]}}, "learn.file"),
    ({"learn": {"file": "a", "selector": "best"}}, "learn.selector: 'best' is not one of"),
    ({"learn": {"file": "a", "target": 2}}, "learn.target: 2"),
    ({"learn": {"file": "a", "credit": "ball"}}, "learn.credit: 'ball' is not one of action, task"),
    ({"learn": {"file": "a", "contexts": "regime"}}, "learn.contexts"),
    ({"learn": {"file": "a", "frozen": "yes"}}, "learn.frozen: 'yes'"),
    ({"marking": {"jobs": 3}}, "start: unknown 'marking'"),
]


@pytest.mark.parametrize(("data", "word"), BAD)
def test_invalid_orders_are_refused_with_a_clear_message(
    data: dict[str, Any], word: str | None, tmp_path: Path
) -> None:
    """The message names the field, the fault and the remedy."""
    if word is None:
        assert read_start(MOVING, data, tmp_path).parameters == {}
        return
    with pytest.raises(ValueError) as refused:
        read_start(MOVING, data, tmp_path)
    assert word in str(refused.value)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=8,
)
FIELDS = st.sampled_from(
    ["task", "mode", "runs", "seed", "regime", "parameters", "learn", "pace", "from", "odd"]
)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.dictionaries(FIELDS, JSON, max_size=6))
def test_any_input_becomes_an_order_or_a_refusal(data: dict[str, Any], tmp_path: Path) -> None:
    """There is no third outcome; every field has its declared type, and no name leaves its
    folder."""
    try:
        order = read_start(MOVING, data, tmp_path)
    except ValueError:
        pass
    else:
        assert order.runs is None or order.runs >= 1
        assert all(type(v) is type(MOVING.parameters[k]) for k, v in order.parameters.items())
        assert order.learning is None or order.learning.path.parent == tmp_path
    if "from" in data:
        try:
            depart = read_start_from(MOVING, data)
        except ValueError:
            return
        assert depart.start is not None
        assert isinstance(depart.start.run, str) and depart.start.record >= 0


# ---- in lock step, live
# -----------------------------------------------------------------------------------------------


async def test_a_run_in_lock_step_equals_that_of_the_command_line(
    cell: Simulated, tmp_path: Path
) -> None:
    """Journal and result are equal at any pace, watched or not; the run has its own folder."""
    given = [
        "run",
        str(tmp_path / "tasks" / "moving.toml"),
        "--mode",
        "lockstep",
        "--runs",
        "3",
        "--seed",
        "9",
        "--quiet",
    ]
    given += [
        "--services",
        str(tmp_path / "services.toml"),
        "--mock",
        str(tmp_path / "script.toml"),
    ]
    assert await asyncio.to_thread(main, [*given, "--journal", str(tmp_path / "cli")]) == 0
    [expected] = (tmp_path / "cli").iterdir()
    for pace, watched in ((0, False), (0, True), (4, True)):
        stop = cell.station.subscribe(lambda change: None) if watched else None
        run, result = await cell.simulate(runs=3, seed=9, pace=pace)
        assert records(cell.runs / run) == records(expected)
        assert {**result, "wall_s": 0} == {
            **json.loads((expected / RESULT).read_text()),
            "wall_s": 0,
        }
        assert json.loads((cell.runs / run / RESULT).read_text()) == result
        assert cell.state["mission"]["id"] == run and cell.state["mission"]["mode"] == "lockstep"
        assert main(["replay", str(cell.runs / run)]) == 0
        if stop is not None:
            stop()


async def test_a_run_in_lock_step_can_be_controlled(cell: Simulated) -> None:
    """During a pause its clock stops; step, tokens, override, force and abort work as in real
    time."""
    assert (await cell.say("load", task="moving"))["ok"]
    assert (await cell.say("breakpoint", element="transitions.seen", on=True))["ok"]
    answer = await cell.say("start", mode="lockstep", pace=0, runs=4)
    assert answer["ok"], answer
    await until(lambda: cell.state["paused"] is not None)
    run = cell.station._run
    assert run is not None and run.operation is not None
    shell = run.operation.shell
    await until(lambda: cell.state["time"] == shell.now())
    time, fired = cell.state["time"], cell.state["mission"]["firings"]
    for _ in range(20):
        await beat(0.002)
    assert (cell.state["time"], cell.state["mission"]["firings"]) == (time, fired)
    assert (await cell.say("add_tokens", place="jobs"))["ok"]
    assert cell.state["marking"]["jobs"] == 4
    assert (await cell.say("override_selector", primitive_task="look", action="look_twice"))["ok"]
    assert (await cell.say("step"))["ok"]
    await until(
        lambda: cell.state["mission"]["firings"] == fired + 1 and cell.state["paused"] is not None
    )
    assert (await cell.say("breakpoint", element="transitions.seen", on=False))["ok"]
    assert (await cell.say("resume"))["ok"]
    assert (await cell.ended())["status"] == "success"
    assert [f["transition"] for f in cell.state["firings"]].count("begin") == 5
    assert {r["action"] for r in cell.state["ended"] if r["place"] == "look"} == {
        "look_at_table",
        "look_twice",
    }


async def test_an_emergency_stop_in_a_simulated_run_also_stops_the_real_devices(
    cell: Simulated, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An operator who presses it means everything: the run ends, and the real devices are ordered
    to stop as well."""
    orders: list[str] = []

    async def order_all(directory: Any, verb: str) -> list[Any]:
        orders.append(verb)
        return []

    monkeypatch.setattr(station, "order_all", order_all)
    await cell.say("start", task="moving", mode="lockstep", pace=0.01, runs=9)
    await until(lambda: cell.state["mission"]["state"] == "running")
    assert (await cell.station.command("ben", "estop", {}))["ok"]
    assert cell.state["mission"]["state"] == "stopped"
    assert (await cell.ended())["status"] == "error"
    await until(lambda: cell.station._going is None)
    assert cell.state["mission"] == {
        **cell.state["mission"],
        "state": "stopped",
        "reason": "emergency stop by ben",
    }
    assert (await cell.say("start", task="moving", mode="lockstep"))["code"] == "stopped"
    assert (await cell.station.command("ben", "clear_estop", {}))["code"] == "not_holder"
    assert (await cell.say("clear_estop"))["ok"]
    assert orders == [STOP, CLEAR]
    assert cell.state["mission"]["state"] == "idle"


async def test_a_stop_while_a_run_is_prepared_is_shown_and_nothing_starts(
    cell: Simulated, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also in lock step, where no node would refuse the run."""

    async def order_all(directory: Any, verb: str) -> list[Any]:
        return []

    monkeypatch.setattr(station, "order_all", order_all)
    answer, stop = await asyncio.gather(
        cell.say("start", task="moving", mode="lockstep"), cell.say("estop")
    )
    assert stop["ok"] and answer["code"] == "stopped"
    assert cell.state["mission"]["state"] == "stopped"
    assert not list(cell.runs.glob("*"))


async def test_a_stop_that_a_node_did_not_clear_is_still_shown(
    cell: Simulated, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its devices are still stopped: nothing starts, and the stop can be cleared again."""
    seconds: list[float | None] = [0.1, None, 0.1]

    async def order_all(directory: Any, verb: str) -> list[Stopped]:
        return [Stopped("arm", seconds=seconds.pop(0), why="connection refused")]

    monkeypatch.setattr(station, "order_all", order_all)
    assert (await cell.say("estop"))["ok"]
    answer = await cell.say("clear_estop")
    assert not answer["ok"] and "connection refused" in answer["text"]
    assert cell.state["mission"]["state"] == "stopped"
    assert (await cell.say("start", task="moving", mode="lockstep"))["code"] == "stopped"
    assert (await cell.say("clear_estop"))["ok"]
    assert cell.state["mission"]["state"] == "idle"
    assert (await cell.simulate(runs=1))[1]["status"] == "success"


async def test_a_stop_from_before_this_coordinator_is_shown(
    cell: Simulated, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The nodes report it. It is not set again by an answer that is older than its end."""
    about: dict[str, Any] = {"up": True, "address": "here", "offers": ()}
    cleared = asyncio.Event()

    async def ask_all(directory: Any, patience: float) -> dict[str, Any]:
        if cell.station._stopped:
            await cleared.wait()
        stopped = {"arm": {"emergency": ["gripper"]}, "vision": {}}
        return {node: {**about, "status": status} for node, status in stopped.items()}

    async def order_all(directory: Any, verb: str) -> list[Any]:
        return []

    monkeypatch.setattr(station, "ask_all", ask_all)
    monkeypatch.setattr(station, "order_all", order_all)
    await cell.station.look()
    assert cell.state["mission"]["state"] == "stopped"
    assert cell.state["mission"]["reason"] == "an emergency stop holds gripper"
    assert (await cell.say("load", task="moving"))["ok"]
    assert cell.state["mission"]["state"] == "stopped", "the button that clears it stays"
    assert (await cell.say("start", task="moving", mode="lockstep"))["code"] == "stopped"
    asked = asyncio.create_task(cell.station.look())
    await asyncio.sleep(0)
    assert (await cell.say("clear_estop"))["ok"]
    cleared.set()
    await asked
    assert cell.state["mission"]["state"] == "idle"


async def test_a_run_in_lock_step_learns(cell: Simulated, tmp_path: Path) -> None:
    """It writes to the named estimates file; a second run starts with what the first one learned,
    and a frozen one adds nothing."""
    learn = {"file": "mine", "selector": "thompson"}
    _, first = await cell.simulate(runs=6, learn=learn)
    learned = dict(first["learned"])
    assert sum(learned.pop("probabilities")["look"].values()) == pytest.approx(1.0, abs=1e-3)
    assert learned == {
        "file": str(tmp_path / "estimates" / "mine.db"),
        "selector": "thompson",
        "context": "",
        "runs_counted": 12,
    }
    assert {a["action"] for a in cell.state["selectors"]["look"]["alternatives"] if "j" in a}
    reports = cell.state["reports"]
    assert {r["y"] for r in reports.values() if r["kind"] == "curve"} == {"probability", "J"}
    told = reports[TASK_REPORT]
    assert told["title"] == "The task so far" and told["text"].startswith("6 trials: ")
    assert "R (every run a success)" in told["text"] and "J " in told["text"]
    assert (await cell.station.form("moving"))["learn"]["estimates"] == ["mine"]
    _, second = await cell.simulate(runs=1, learn={**learn, "frozen": True})
    assert second["learned"]["runs_counted"] == 0
    refused = await cell.say(
        "start", task="moving", mode="lockstep", learn={"file": "none_yet", "frozen": True}
    )
    assert not refused["ok"] and "nothing was learned" in refused["text"]
    (tmp_path / "estimates" / "broken.db").write_text("no database")
    refused = await cell.say("start", task="moving", mode="lockstep", learn={"file": "broken"})
    assert not refused["ok"] and "broken.db" in refused["text"]
    assert not [p for p in cell.runs.iterdir() if not (p / RESULT).exists()], (
        "a refused start leaves no run"
    )


# ---- from a recorded point


async def test_a_run_from_a_point_is_shown_live_and_names_its_origin(
    cell: Simulated,
) -> None:
    """From the first record it repeats the run; from the middle it starts in the marking of the
    recorded run and reaches an end."""
    run, _ = await cell.simulate(runs=3, seed=5)
    again, _ = await cell.simulate(**{"from": {"run": run, "record": 0}})
    assert records(cell.runs / again) == records(cell.runs / run)
    history = await asyncio.to_thread(opened, cell.runs / run / JOURNAL, run)
    for record in history["records"][:-1]:
        going = dict.fromkeys(record["going"], "error:lost")
        made, result = await cell.simulate(
            **{"from": {"run": run, "record": record["number"], "going": going}}
        )
        header = read_journal(cell.runs / made / JOURNAL).header
        assert (header["from"]["run"], header["from"]["record"]) == (run, record["number"])
        assert header["from"]["going"] == going
        assert cell.state["mission"]["from"] == {"run": run, "record": record["number"]}
        assert result["status"] == "success"


@pytest.mark.parametrize(
    ("source", "word"),
    [
        ("last", "no run"),
        ({}, "no run"),
        ({"run": "../runs"}, "no run"),
        ({"run": "nothing"}, "no run"),
        ({"run": "RUN", "record": -1}, "from.record: -1"),
        ({"run": "RUN", "record": "1"}, "from.record: '1'"),
        ({"run": "RUN", "record": 10**6}, "records 0"),
        ({"run": "RUN", "record": 0, "going": 3}, "from.going: 3"),
        ({"run": "RUN", "record": 0, "going": {"moon": "error"}}, "no run was active in 'moon'"),
        ({"run": "RUN", "record": 0, "going": "sometimes"}, "'sometimes'"),
    ],
)
async def test_an_invalid_point_is_refused(cell: Simulated, source: Any, word: str) -> None:
    """Every kind of fault is refused, and the station stays usable."""
    run, _ = await cell.simulate()
    if isinstance(source, dict) and source.get("run") == "RUN":
        source = {**source, "run": run}
    answer = await cell.say("start", **{"from": source})
    assert not answer["ok"] and word in answer["text"], answer
    for more in (
        {"runs": 3},
        {"learn": {"file": "x"}},
        {"mode": "realtime"},
        {"seed": -1},
        {"parameters": {"sped": 1}},
    ):
        assert not (await cell.say("start", **{"from": {"run": run, "record": 0}, **more}))["ok"]
    assert len(list(cell.runs.iterdir())) == 1
    await cell.simulate()


async def test_a_damaged_journal_is_reported(cell: Simulated) -> None:
    """The station answers that the journal cannot be read, and stays usable."""
    run, _ = await cell.simulate()
    raw = bytearray((cell.runs / run / JOURNAL).read_bytes())
    raw[len(raw) // 2] ^= 0xFF
    (cell.runs / run / JOURNAL).write_bytes(raw)
    answer = await cell.say("start", **{"from": {"run": run, "record": 1}})
    assert not answer["ok"] and "damaged" in answer["text"]


IMPORTS = """\
import asyncio, sys
from pathlib import Path
from petrobot.coordinator.operator.station import Station
from petrobot.coordinator.page.task_store import TaskStore
from petrobot.services.comm.location_file import load

async def main(folder):
    station = Station(load(folder / "services.toml"), TaskStore(folder, None), folder)
    print("scipy.special" in sys.modules)
    await station.close()

asyncio.run(main(Path(sys.argv[1])))
"""


@pytest.mark.processes
def test_what_a_run_imports_is_there_before_the_first_client(tmp_path: Path) -> None:
    """Else the page is silent at the first start: on a busy host for longer than its clients
    wait."""
    (tmp_path / "services.toml").write_text(
        'schema = 1\nnodes.left = { host = "127.0.0.1", port = 7301 }\n'
    )
    command = [sys.executable, "-c", IMPORTS, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "True\n"
