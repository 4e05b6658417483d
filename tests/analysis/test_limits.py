"""The commands on huge nets: bounded time and memory, Ctrl-C at any moment, results marked as
partial."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
from itertools import count
from pathlib import Path
from typing import Any
from xml.parsers import expat

import pytest

from petrobot.coordinator.analysis import commands, report
from petrobot.coordinator.analysis.commands import analyse_command, convert_command
from petrobot.coordinator.analysis.execution.graph import execute
from petrobot.coordinator.analysis.formats import tree
from petrobot.coordinator.analysis.formats.netfile import NetFile
from petrobot.coordinator.analysis.formats.pnml import write_pnml
from petrobot.coordinator.analysis.limits import OutOfTime, until
from petrobot.coordinator.analysis.net.graph import Mask
from petrobot.coordinator.analysis.net.qualitative import Qualitative, examine
from petrobot.coordinator.analysis.net.space import SearchLimits, Space, explore
from petrobot.coordinator.analysis.report import LATE
from petrobot.coordinator.analysis.time import task_forecast
from petrobot.coordinator.analysis.time.completion import CompletionTime, completion_time
from petrobot.coordinator.analysis.time.gspn import Chain, Gspn
from petrobot.coordinator.cli import loading
from petrobot.coordinator.task.file import load
from petrobot.coordinator.task.net import Net
from tests.analysis.generators import KANBAN_RATES, kanban, philosophers
from tests.waiting import PATIENCE_S, Limit

CATCH = Path(loading.__file__).parents[1] / "tasks" / "catch_ball.toml"
pytestmark = pytest.mark.processes

ROOM = 3 << 30
"""Bytes of address space that a command gets; libraries alone map about one gigabyte."""


def ring(places: int, tokens: int) -> Net:
    """Tokens in a ring: far more than 1e9 markings."""
    names = [f"p{i}" for i in range(places)]
    arcs = {f"t{i}": ({names[i]: 1}, {names[(i + 1) % places]: 1}) for i in range(places)}
    return Net.build({**dict.fromkeys(names, 0), names[0]: tokens}, arcs)


def test_what_is_not_known_in_time_is_no_bad_input() -> None:
    """The file is good: the exit code is that of an answer that is not yes. What was known by then
    is in the answer."""
    path, clock = CATCH.with_name("pick_and_place.toml"), count().__next__
    late = analyse_command(path, limits=SearchLimits(seconds=60, clock=clock))
    assert report.LATE in late.data["notes"] and not late.data["recoveries"]
    clock = count().__next__
    outcome = analyse_command(path, limits=SearchLimits(seconds=20, clock=clock))
    assert outcome.code == 1 and report.LATE in outcome.data["notes"]
    verdicts = {name: v["holds"] for name, v in outcome.data["verdicts"].items()}
    assert verdicts["bounded"] and verdicts["deadlock_free"] and verdicts["quasi_live"]
    assert verdicts["sound"] is None and outcome.data["verdicts"]["sound"]["reason"] == (
        "unknown within the time limit; give more --seconds"
    )


class Brief:
    """A clock on which the time is used up after so many readings."""

    def __init__(self, readings: int) -> None:
        self.left = readings

    def __call__(self) -> float:
        self.left -= 1
        return 0.0 if self.left >= 0 else 10.0


@pytest.mark.parametrize("readings", [10, 100, 250, 600, 2_000, 6_000])
def test_a_what_if_tells_its_verdicts_whenever_the_time_is_used_up(
    readings: int, tmp_path: Path
) -> None:
    """The analysis of each file is a fact, though the numbers to compare came too late."""
    path = tmp_path / "task.toml"
    path.write_text(GRIPS, encoding="utf-8")
    limits = SearchLimits(seconds=5.0, clock=Brief(readings))
    outcome = analyse_command(path, view="gspn", changes=["parts=2"], limits=limits)
    assert "error" not in outcome.data and outcome.data["verdicts"]["bounded"]["holds"]
    assert outcome.data["as_it_is"]["verdicts"]["bounded"]["holds"]
    assert "what if parts=2:" in outcome.text


@pytest.mark.parametrize("late", [False, True])
def test_the_distribution_of_times_is_computed_once_and_its_lack_costs_no_other_number(
    late: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes longer than all the rest together, so it may come too late."""
    path, computed = tmp_path / "task.toml", list[float]()
    path.write_text(GRIPS, encoding="utf-8")

    def counted(chain: Chain, goal: Mask) -> CompletionTime:
        if late:
            raise OutOfTime("distribution of the completion time: unknown within the time limit")
        computed.append(0.0)
        return completion_time(chain, goal)

    monkeypatch.setattr(task_forecast, "completion_time", counted)
    changes = ["grip.error.share=0.05"]
    measures = ["p95=time(0.95)", "p80=time(0.8)"]
    outcome = analyse_command(path, view="gspn", changes=changes, measures=measures)
    _, _, table = outcome.text.partition("what if grip.error.share=0.05:")
    assert outcome.data["forecast"]["mean"] == pytest.approx(3 / 0.95)
    assert "mean" in table and ("90 % quantile" in table) is not late
    assert outcome.text.count("the time was used up") == outcome.data["notes"].count(LATE) == late
    assert len(computed) == (0 if late else 2)  # of each file once, not for each number again
    assert [value is None for value in outcome.data["measures"].values()] == [late, late]
    assert outcome.code == late


def test_a_measure_that_a_limit_leaves_unknown_costs_no_verdict(tmp_path: Path) -> None:
    """The input is good, so this is not exit code 2; but not every answer is known."""
    path = tmp_path / "task.toml"
    path.write_text(GRIPS, encoding="utf-8")
    limits = SearchLimits(states=8)  # enough for N, too few for the chain
    outcome = analyse_command(path, view="gspn", limits=limits, measures=["p95=time(0.95)"])
    assert outcome.code == 1 and outcome.data["measures"] == {"p95": None}
    assert "deadlock free" in outcome.text and "no forecast: " in outcome.text


GRIPS = """schema = 1
[task]
name = "grips"
final = "parts == 0"
[primitive_tasks.grip]
deadline = 5.0
[primitive_tasks.grip.estimates]
success = { share = 0.9, mean = 1.0, cv = 0.3 }
error = { share = 0.1, mean = 1.0, cv = 0.3 }
[places]
parts = { kind = "control", tokens = 3 }
hand = { kind = "resource", tokens = 1 }
grip = { kind = "action", holds = "hand" }
[transitions]
next = { in = ["parts"], out = ["grip"] }
gripped = { in = ["grip:normal"] }
lost = { in = ["grip:error"], out = ["parts"] }
"""


def stuck_and_unsafe(tokens: int) -> Net:
    """A counter that empties, and a branch that gets stuck at once: a deadlock is near, and the
    last markings are far."""
    arcs = {"put": ({"many": 1}, {"box": 1}), "fall": ({"robot": 1}, {"floor": 1})}
    return Net.build({"many": tokens, "box": 0, "robot": 1, "floor": 0}, arcs)


@pytest.mark.parametrize("readings", [5, 20, 60, 200, 600])
def test_facts_are_told_whenever_the_time_is_used_up(readings: int, tmp_path: Path) -> None:
    """What is found is a fact, whatever is still unknown: tokens in a place, a dead marking."""
    path = tmp_path / "net.pnml"
    path.write_text(write_pnml(NetFile(stuck_and_unsafe(30_000))), encoding="utf-8")
    limits = SearchLimits(seconds=5.0, clock=Brief(readings))
    outcome = analyse_command(path, limits=limits, structure=False)
    assert outcome.code == 1
    assert outcome.data["verdicts"]["safe"]["holds"] is False
    assert all(v["holds"] in (True, False, None) for v in outcome.data["verdicts"].values())
    assert outcome.data["verdicts"]["live"]["holds"] is not True


def test_a_large_file_is_not_read_beyond_the_time(tmp_path: Path) -> None:
    path = tmp_path / "net.pnml"
    path.write_text(write_pnml(NetFile(ring(2_000, 1))), encoding="utf-8")
    outcome = analyse_command(path, limits=SearchLimits(seconds=5.0, clock=Brief(2)))
    assert outcome.code == 1
    assert "the net in the file: unknown within the time limit; give more --seconds" in outcome.text


def test_facts_are_told_if_the_memory_is_used_up() -> None:
    """Verdicts on the whole space need too much; a deadlock among its markings is a fact."""

    def examined(space: Space, *, in_haste: bool = False, **rest: Any) -> Qualitative:
        if not in_haste or len(space) > 11_000:
            raise MemoryError
        return examine(space, in_haste=True)

    found = report._examined(stuck_and_unsafe(30_000), None, notes := list[str](), examined)
    assert notes == [report.FULL]
    assert found.safe.holds is False and found.quasi_live.holds is True
    assert found.live.holds is None and found.bounded.holds is not False


def started(net: Net, folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """Start a command on the net; the system limits its memory."""
    path = folder / "net.pnml"
    path.write_text(write_pnml(NetFile(net)), encoding="utf-8")
    command, *rest = arguments
    return subprocess.Popen(
        [sys.executable, "-m", "petrobot.coordinator", command, str(path), *rest],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=_limited,
    )


def _limited() -> None:
    """Limit the memory."""
    resource.setrlimit(resource.RLIMIT_AS, (ROOM, ROOM))


def answered(process: subprocess.Popen[str], *, proven: bool = False) -> dict[str, Any]:
    """Return its JSON; the exit code 1 is allowed, because something is unknown."""
    out, complaint = process.communicate(timeout=300)
    assert process.returncode == (0 if proven else 1), complaint
    data: dict[str, Any] = json.loads(out)
    return data


@pytest.mark.parametrize(
    ("net", "deadlock"),
    [
        pytest.param(philosophers(60), True, marks=pytest.mark.proof),
        (kanban(50), False),
        (ring(300, 20), False),
    ],
    ids=["300 places", "1e16", "ring"],
)
def test_a_huge_net_ends_with_a_partial_result(net: Net, deadlock: bool, tmp_path: Path) -> None:
    """Stubborn sets find the one deadlock; siphons with marked traps rule out any in the other
    two."""
    process = started(
        net, tmp_path, "analyse", "--rates", "unit", "--states", "20000", "--json", "-"
    )
    data = answered(process, proven=not deadlock)
    assert (
        data["complete"] is False
        and "limit of 20000 states" in data["reason"]
        and data["bounded"] is True
    )
    assert data["states"] >= 20_000 and data["home_states"] is None
    assert data["throughput"] is None and data["mean_tokens"] is None and data["residual"] is None
    assert any("simulate instead" in note for note in data["notes"])
    assert data["deadlock"] is deadlock and data["live"] is (False if deadlock else None)


class Steps:
    """A clock that advances by a second each time it is read, so a limit in seconds is a number of
    readings."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def many_siphons(places: int) -> Net:
    """Return a net with few markings, but with far more siphons than can be listed."""
    names = [f"p{i}" for i in range(places)]
    arcs = {f"t{i}": ({names[i]: 1}, {names[(i + 1) % places]: 1}) for i in range(places)}
    for i in range(places):
        some = {names[i]: 1, names[i * 7 % places]: 1, names[i * 3 % places]: 1}
        arcs[f"u{i}"] = (some, {names[(i * 11 + 3) % places]: 1})
    return Net.build(dict.fromkeys(names, 0) | {"p0": 1}, arcs)


def test_structure_stops_with_the_time_of_the_analysis(tmp_path: Path) -> None:
    path = tmp_path / "net.pnml"
    path.write_text(write_pnml(NetFile(many_siphons(60))), encoding="utf-8")
    clock = Steps()
    limits = SearchLimits(seconds=300.0, clock=clock)
    found = analyse_command(path, limits=limits)
    assert found.data["complete"] is True and found.data["states"] == 60
    structure = found.data["structure"]
    assert structure["siphons_complete"] is False and structure["siphons_controlled"] is not True
    assert any(
        "siphons" in note and "unknown within the limit" in note for note in found.data["notes"]
    )
    assert clock.now < 400.0


def test_the_execution_graph_ends_with_the_time_of_the_analysis() -> None:
    """It stops at the next look at the clock, and says so; without a deadline it has no clock."""
    task = load(CATCH)
    with until(1.0, lambda: 2.0):
        late = execute(task)
    assert not late.complete and late.reason.startswith("time limit, after 10")
    assert len(late) < len(execute(task))


@pytest.mark.parametrize(("runs", "told"), [(400, True), (1, False)])
def test_a_task_whose_many_runs_are_too_much_is_to_be_tried_with_one(
    tmp_path: Path, runs: int, told: bool
) -> None:
    path = tmp_path / "many.toml"
    text = CATCH.read_text(encoding="utf-8").replace("tokens = 4", f"tokens = {runs}", 1)
    path.write_text(text, encoding="utf-8")
    limits = SearchLimits(seconds=20.0, clock=Steps())
    found = analyse_command(path, view="ordinary", limits=limits)
    note = "with one run more may be known: --what-if runs=1"
    assert (note in found.data["notes"]) == told


def test_a_search_without_limits_of_its_own_keeps_the_memory_of_the_analysis() -> None:
    assert explore(kanban(3), engine="numpy").complete
    with until(1.0, lambda: 0.0, memory=1_000_000):
        space = explore(kanban(3), engine="numpy")
    assert not space.complete and space.reason.startswith("memory limit of 0.9537 MiB, ")


@pytest.mark.parametrize(
    ("limits", "reason", "option"),
    [
        (SearchLimits(states=50), "limit of 50 states", "--states"),
        (
            SearchLimits(seconds=2.0, clock=Steps()),
            "time limit of 2 s, of which searches get a part",
            "--seconds",
        ),
        (
            SearchLimits(memory=100),
            "memory limit of 9.537e-05 MiB, of which searches get a part",
            "--memory",
        ),
    ],
    ids=["states", "time", "memory"],
)
def test_the_limit_that_ended_a_search_is_named_with_its_option(
    limits: SearchLimits, reason: str, option: str, tmp_path: Path
) -> None:
    path = tmp_path / "net.pnml"
    path.write_text(write_pnml(NetFile(kanban(3))), encoding="utf-8")
    found = analyse_command(path, limits=limits)
    assert found.data["reason"] == reason
    assert f"to search further give more {option}" in found.data["notes"]


def test_all_parts_of_an_analysis_share_its_time(tmp_path: Path) -> None:
    """Searches, verdicts and numbers of both analyses of a what-if end within one limit."""
    gspn = Gspn.of(kanban(3), KANBAN_RATES)
    path = tmp_path / "net.pnml"
    path.write_text(write_pnml(NetFile(gspn.net, gspn=gspn)), encoding="utf-8")
    for seconds in (2.0, 20.0, 60.0, 200.0):
        clock = Steps()
        limits = SearchLimits(seconds=seconds, clock=clock)
        found = analyse_command(path, limits=limits, changes=["tin1.rate=2"])
        assert clock.now < seconds + 100.0  # the clock is read once for each block, sweep or branch
        assert found.data["complete"] or "time limit" in found.data["reason"]
        assert found.data["throughput"] is not None or any(
            "time limit" in note for note in found.data["notes"]
        )


@pytest.mark.parametrize("seconds", [3.0, 30.0, 100.0, 300.0, 600.0, 1000.0])
def test_the_forecast_of_a_task_ends_in_time(seconds: float) -> None:
    """Wherever the time limit is reached, there is a result that says what is unknown."""
    clock = Steps()
    limits = SearchLimits(seconds=seconds, clock=clock)
    found = analyse_command(CATCH, view="gspn", limits=limits, changes=["runs=1"])
    assert clock.now < seconds + 100.0
    assert "states" in found.data or "time limit" in found.text
    said = " ".join(found.data.get("notes", ())) + found.text
    assert "forecast" in found.data or "limit" in said


PEAK = """
import resource, subprocess, sys
code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)
print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""
"""Program that runs a command from a small process. Linux counts the parent's memory at the fork in
the child's peak (getrusage(2)), and a test process is large."""


def test_an_analysis_uses_no_more_memory_than_allowed(tmp_path: Path) -> None:
    """The whole command: interpreter, search, verdicts, chain."""
    gspn = Gspn.of(kanban(4), KANBAN_RATES)
    path = tmp_path / "net.pnml"
    path.write_text(write_pnml(NetFile(gspn.net, gspn=gspn)), encoding="utf-8")
    arguments = ["analyse", str(path), "--memory", "300", "--json", str(tmp_path / "found.json")]
    process = subprocess.run(
        [sys.executable, "-c", PEAK, sys.executable, "-m", "petrobot.coordinator", *arguments],
        capture_output=True,
        text=True,
        timeout=240,
    )
    code, peak = map(int, process.stdout.split())
    assert code in (0, 1)
    assert peak <= 300 << 10  # KiB
    data = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert data["throughput"] is not None or any("memory" in note for note in data["notes"])


def test_a_file_that_is_too_large_for_the_memory_has_a_message(tmp_path: Path) -> None:
    """Where the memory is used up while the file is read, what was read is freed only later."""
    process = started(ring(20_000, 1), tmp_path, "analyse", "--memory", "1", "--seconds", "0")
    out, complaint = process.communicate(timeout=300)
    assert process.returncode == 1, complaint
    assert "the memory was used up; give more --memory, or fewer --states" in out


def test_memory_that_python_cannot_unwind_has_the_same_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """CPython loses a MemoryError if there is no memory to unwind its frames."""

    def lost(path: Path) -> NetFile:
        raise SystemError("error return without exception set")

    path = tmp_path / "net.pnml"
    monkeypatch.setattr(commands, "open_model", lost)
    assert "the memory was used up; give more --memory" in analyse_command(path).text
    assert "the memory was used up" in convert_command(path, tmp_path / "net.net").text


def test_memory_that_the_xml_parser_lacks_is_no_fault_of_the_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the memory of expat itself is used up, it reports an error of the XML."""

    class Full:
        def Parse(self, text: str, final: bool) -> None:  # noqa: N802 - the name in expat
            error = expat.ExpatError("out of memory: line 3, column 7")
            error.code, error.lineno = expat.errors.codes[expat.errors.XML_ERROR_NO_MEMORY], 3
            raise error

    monkeypatch.setattr(expat, "ParserCreate", lambda **_: Full())
    with pytest.raises(MemoryError):
        tree.parse_tree("<pnml/>", "net.pnml")


def test_a_net_that_cannot_be_solved_can_be_simulated(tmp_path: Path) -> None:
    arguments = ("simulate", "--rates", "unit", "--replicas", "20", "--horizon", "2", "--json", "-")
    process = started(ring(300, 20), tmp_path, *arguments)
    out, complaint = process.communicate(timeout=300)
    assert process.returncode == 0, complaint
    data = json.loads(out)
    assert (
        data["complete"]
        and data["firings"] > 20
        and sum(x[0] for x in data["mean_tokens"].values()) == pytest.approx(20)
    )


@pytest.mark.parametrize(
    "net", [philosophers(60), kanban(6)], ids=["300 places", "11 million markings"]
)
@pytest.mark.parametrize("share", [0.2, pytest.param(1.0, marks=pytest.mark.proof)])
def test_ctrl_c_keeps_what_was_found(net: Net, share: float, tmp_path: Path) -> None:
    """Interrupted twice after the search has begun, at given processor times."""
    analyse = ("analyse", "--rates", "unit", "--json", "-")
    before = _start_up(tmp_path, *analyse)
    process = started(net, tmp_path, *analyse)
    _interrupt_after(process, before + share)
    data = answered(process)
    assert (
        data["complete"] is False
        and data["reason"] == "interrupted"
        and any("Ctrl-C" in n for n in data["notes"])
    )
    assert data["states"] >= 1 and data["live"] is not True and data["throughput"] is None


def test_ctrl_c_ends_a_simulation_with_its_intervals(tmp_path: Path) -> None:
    arguments = (
        "simulate",
        "--rates",
        "unit",
        "--horizon",
        "1e6",
        "--replicas",
        "100",
        "--json",
        "-",
    )
    before = _start_up(tmp_path, "simulate", "--rates", "unit", "--horizon", "1")
    process = started(kanban(5), tmp_path, *arguments)
    _interrupt_after(process, before + 0.4)
    data = answered(process)
    assert data["complete"] is False and data["firings"] > 0 and data["throughput"]["tin1"][0] > 0


def _start_up(folder: Path, *arguments: str) -> float:
    """Return the processor time of a command on a small net (s); a slow machine imports long."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    started(ring(3, 1), folder, *arguments).communicate(timeout=300)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _interrupt_after(process: subprocess.Popen[str], seconds: float) -> None:
    """Send Ctrl-C as soon as the process has used that much processor time."""
    ticks, statistics = os.sysconf("SC_CLK_TCK"), Path(f"/proc/{process.pid}/stat")
    limit = Limit(f"{seconds} s of processor time", 4 * PATIENCE_S)
    while process.poll() is None and limit.left():
        fields = statistics.read_text().rpartition(")")[2].split()
        if (int(fields[11]) + int(fields[12])) / ticks >= seconds:
            process.send_signal(signal.SIGINT)
            return
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=0.05)
