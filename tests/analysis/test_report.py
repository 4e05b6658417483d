"""Whole analyses and the commands: documented keys, closed forms, pictures, one line for bad
input."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import count, product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import assume, example, given, settings, strategies as st
from msgspec.structs import replace

from petrobot.coordinator.analysis.commands import (
    analyse_command,
    convert_command,
    graph_command,
    simulate_command,
)
from petrobot.coordinator.analysis.formats import read_net
from petrobot.coordinator.analysis.formats.netfile import (
    NetFile,
    NetFileError,
    read_rates,
    unit_rates,
)
from petrobot.coordinator.analysis.formats.pnml import write_pnml
from petrobot.coordinator.analysis.limits import OutOfTime, until
from petrobot.coordinator.analysis.net.picture import graph_svg
from petrobot.coordinator.analysis.net.space import SearchLimits, explore
from petrobot.coordinator.analysis.net.verdict import PropertyVerdict, Witness
from petrobot.coordinator.analysis.report import Analysis, analyse, heat, missing
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.analysis.time.measured import Measured
from petrobot.coordinator.analysis.time.stochastic import stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import forecast
from petrobot.coordinator.task import Estimate, Status, Task
from petrobot.coordinator.task.file import load, loads
from petrobot.coordinator.task.net import Net
from petrobot.coordinator.task.wording import together
from tests.analysis.generators import KANBAN_RATES, kanban, philosophers, queue
from tests.analysis.random_nets import nets
from tests.analysis.test_execution_graph import COMMON, whole_tasks

GOOD = """
schema = 1
[task]
name = "good"
final = "parts == 0"
[primitive_tasks]
look = { goal = "g", alternatives = ["a"], deadline = 5.0 }
[places]
parts = { kind = "control", tokens = 1 }
look = { kind = "action", task = "look" }
[transitions]
next = { in = ["parts"], out = ["look"] }
seen = { in = ["look:normal"], out = [] }
lost = { in = ["look:error"], out = [] }
"""
CATCH = Path(__file__).parents[2] / "coordinator" / "tasks" / "catch_ball.toml"
PROMISED = {
    "net",
    "states",
    "edges",
    "complete",
    "bounded",
    "max_tokens_per_place",
    "max_tokens_in_marking",
    "safe",
    "deadlock",
    "deadlocks",
    "quasi_live",
    "live",
    "reversible",
    "home_states",
}
NUMBERS = {"throughput", "mean_tokens", "residual"}


def test_the_page_says_which_refused_verdicts_change_the_exit_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The table of docs/analysis.md, section 2, against `ok` (analyse) and `objections` (check)."""
    page = (Path(__file__).parents[2] / "docs" / "analysis.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    table = {row[0]: row[-1] for row in rows if row[-1] in ("refused", "-") and len(row) == 4}
    found = analyse(loads(GOOD, "good.toml"))
    verdicts = found.verdicts()
    assert {name.replace("_", " ") for name in verdicts} == set(table) and found.ok
    for name in verdicts:
        refuted = PropertyVerdict(False, "no", Witness((), {}))
        changed = {**verdicts, name: refuted}
        monkeypatch.setattr(Analysis, "verdicts", lambda _, changed=changed: changed)
        refused = table[name.replace("_", " ")] == "refused"
        assert (name in found.objections, not found.ok) == (refused, refused), name


def test_a_net_file_gives_the_documented_keys(tmp_path: Path) -> None:
    path = tmp_path / "kanban.pnml"
    path.write_text(write_pnml(NetFile(kanban(1))), encoding="utf-8")
    plain = analyse_command(path)
    assert plain.code == 0 and set(plain.data) >= PROMISED | NUMBERS
    assert all(plain.data[key] is None for key in NUMBERS)
    data = json.loads(json.dumps(plain.data))
    assert data["net"] == {"places": 16, "transitions": 16, "arcs": 40}
    assert (data["states"], data["edges"], data["home_states"]) == (160, 616, 160)
    assert (data["bounded"], data["safe"], data["deadlock"], data["live"], data["reversible"]) == (
        True,
        True,
        False,
        True,
        True,
    )
    assert (
        data["max_tokens_per_place"] == 1
        and data["deadlocks"] == []
        and data["structure"]["conservative"]
    )
    rates = tmp_path / "rates.toml"
    rates.write_text(
        "[rates]\n" + "".join(f"{k} = {v}\n" for k, v in KANBAN_RATES.items()), encoding="utf-8"
    )
    timed = analyse_command(path, rates=rates)
    assert set(timed.data) >= PROMISED | NUMBERS
    assert timed.data["throughput"]["tin1"] == pytest.approx(0.0925846346333826, abs=1e-12)
    assert analyse_command(path, view="gspn", rates="unit").data["throughput"]["tin1"] > 0
    bare = analyse_command(path, view="gspn")
    assert bare.code == 2 and "--rates" in bare.text


def test_deadlocks_have_replayable_witnesses() -> None:
    found = analyse(philosophers(3))
    data = found.to_json()
    assert data["deadlock"] is True and not found.ok and len(data["deadlocks"]) == 2
    for one in data["deadlocks"]:
        *_, last = philosophers(3).replay(one["firings"])
        assert not philosophers(3).enabled(last)
    assert "NO" in found.text() and "hasleft0" in found.text()


def test_partial_and_unbounded_nets_are_reported_as_such() -> None:
    part = analyse(kanban(3), limits=SearchLimits(states=1000)).to_json()
    assert (
        part["complete"] is False
        and part["live"] is None
        and part["bounded"] is True
        and part["home_states"] is None
    )
    grows = Net.build({"p": 1}, {"t": ({"p": 1}, {"p": 2})})
    data = analyse(
        Gspn.of(grows, {"t": 1.0}), view="gspn", limits=SearchLimits(states=50)
    ).to_json()
    assert (
        data["states"] is None and data["bounded"] is False and data["max_tokens_per_place"] is None
    )
    assert any("simulate instead" in note for note in data["notes"])


@pytest.mark.once
def test_the_catching_task_in_one_analysis() -> None:
    found = analyse(load(CATCH), view="gspn", stages=2)
    data = json.loads(json.dumps(found.to_json()))
    assert set(data) >= PROMISED | NUMBERS | {"recoveries", "forecast"}
    assert (
        data["bounded"]
        and data["live"] is data["reversible"] is False
        and data["sound"]
        and data["deadlock"] is False
    )
    mended = {"live", "proper", "stable", "controllable"}
    refused = {k for k, v in data["verdicts"].items() if v["holds"] is False}
    assert data["execution"]["complete"] and refused == {"safe", *mended}
    assert {k for k, v in data["mended"].items() if v["holds"]} == mended
    fault = next(r for r in data["recoveries"] if r["error_exit"] == "move_failed")
    assert fault["probability"] == pytest.approx(1 - 0.05**4) and fault["goals_lost"] == [1, 1]
    text = found.text()
    assert (
        "stable" in text
        and "controllable" in text
        and "recovered arm_back" in text
        and "P_complete" in text
    )
    assert found.forecast is not None
    assert 0 < max(heat(found.forecast).values()) <= 1
    rest = missing(found.forecast)
    assert sum(share for share, _, _ in rest) == pytest.approx(
        1 - found.forecast.completion_probability, rel=0.02
    )
    assert all(path[-1] == "give_up" for _, _, path in rest)
    assert (
        "sound, but P_complete is 6.31e-07 short of 1" in text
        and "live           NO" in text
        and "if the operator repairs it: yes, from every state" in text
        and "0.99999375  6.16 s" in text
    )


def pair(more: str, part: str = "") -> Task:
    """Two jobs, each a run of `see` and one of `grip` side by side."""
    ends = "success = { share = 0.9, mean = 1.0 }, error = { share = 0.1, mean = 1.0 }"
    primitive = f'{{ goal = "g", deadline = 9.0, estimates = {{ {ends} }} }}'
    text = (
        'schema = 1\n[task]\nname = "t"\nfinal = "jobs == 0 and see == 0"\n'
        f'runs_place = "jobs"\n{part}\n'
        f"[primitive_tasks]\nsee = {primitive}\ngrip = {primitive}\n"
        '[places]\njobs = { kind = "control", tokens = 2 }\nsee = { kind = "action" }\n'
        'grip = { kind = "action" }\nbroken = {}\n[transitions]\n'
        'go = { in = ["jobs", "!see", "!grip", "!broken"], out = ["see", "grip"] }\n'
        'both = { in = ["see:normal", "grip:normal"] }\n'
        'blind = { in = ["see:error", "grip:normal"] }\n'
        'slip = { in = ["see:normal", "grip:error"] }\n'
    )
    return loads(text + more, "pair.toml")


def test_dead_ends_with_one_reason_are_one_line() -> None:
    """They differ only in the jobs that are still to do."""
    lines = [one for one in analyse(pair("")).text().splitlines() if one.startswith("  dead end")]
    assert len(lines) == 1 and "2 x: stuck with see (ended in error) grip" in lines[0]


def test_an_improvement_that_changes_nothing_gains_exactly_nothing() -> None:
    """Every job completes: the rounding of the solution is no gain."""
    both = 'all = { in = ["see:error", "grip:error"] }\n'
    found = analyse(pair(both), view="gspn")
    assert found.forecast is not None
    assert [w.completion_gain for w in found.forecast.worth] == [0.0, 0.0]
    assert found.text().count("error to success: +0 complete") == 2


def test_giving_up_after_a_further_error_is_named_where_only_it_is_left() -> None:
    """After `see` has failed no path leads to `final`, but giving up is one error of `grip` away:
    the words must not say that no end can be reached."""
    give_up = 'all = { in = ["see:error", "grip:error"], out = ["broken"] }\n'
    ways = pair(give_up, 'final_error = "broken == 1"')
    blind = {n: t for n, t in ways.transitions.items() if n != "blind"}
    task = replace(ways, transitions=blind)
    sound = analyse(task).verdicts()["sound"]
    assert sound.holds is False and sound.reason.endswith(
        "no designed end can be reached without a further error or a stop"
    )


def test_a_condition_that_is_assumed_to_hold_explains_a_sure_completion() -> None:
    """The task is stuck with the value `none`, the view assumes that one branch is always taken."""
    text = (
        'schema = 1\n[task]\nname = "t"\nfinal = "jobs == 0 and look == 0"\n'
        '[primitive_tasks]\nlook = { goal = "g", deadline = 9.0, '
        "estimates = { success = { share = 1.0, mean = 1.0 } } }\n"
        '[variables]\nside = { type = "str", values = ["left", "right"] }\n'
        '[places]\njobs = { kind = "control", tokens = 1 }\n'
        'look = { kind = "action", out = { code = "side" } }\n[transitions]\n'
        'go = { in = ["jobs"], out = ["look"] }\nbad = { in = ["look:error"] }\n'
        "left = { in = ['look:normal'], when = \"side == 'left'\" }\n"
    )
    task = loads(text, "look.toml")
    text = " ".join(analyse(task, view="gspn").text().split())
    assert "P_complete is 1, but the task is not sound" in text
    assert "or a condition is assumed to be true)" in text


def test_the_forecast_of_a_task_is_consistent() -> None:
    """Firings per mission, conservation of runs, and the effect of moving probability from ERROR
    to SUCCESS."""
    task = load(CATCH)
    found = forecast(stochastic_view(task, stages=1, timer_stages=1))
    runs = found.firings["start"] + found.firings["no_images"]
    assert runs == pytest.approx(4.0, rel=1e-4)
    assert found.firings["located"] + found.firings["not_located"] == pytest.approx(
        found.firings["start"], rel=1e-9
    )
    assert (
        found.goal_reliability is not None
        and 0 < found.conjunctive_reliability < found.goal_reliability < 1
    )
    assert found.throughput["start"] * found.mission_time == pytest.approx(found.firings["start"])
    assert found.mean_tokens["camera_free"] <= 1 and found.recovery_time is not None
    assert found.recovery_time > 0
    shares = dict.fromkeys(task.net.places, 0.0)
    for one in found.worth:
        shares[one.place] += one.time_share
    assert 0.5 < sum(shares.values()) < 1.0  # waits for events and timers take the rest
    step, primitive = 1e-4, task.primitive_tasks["locate_ball"]
    moved = dict(primitive.estimates)
    moved[Status.SUCCESS] = replace(moved[Status.SUCCESS], share=moved[Status.SUCCESS].share + step)
    moved[Status.ERROR] = replace(moved[Status.ERROR], share=moved[Status.ERROR].share - step)
    better = replace(
        task,
        primitive_tasks={
            **task.primitive_tasks,
            "locate_ball": replace(primitive, estimates=moved),
        },
    )
    after = forecast(stochastic_view(better, stages=1, timer_stages=1))
    goals = sum(w.goal_gain for w in found.worth if w.place == "locate_ball")
    assert after.goal_reliability is not None
    assert (after.goal_reliability - found.goal_reliability) * 4 / step == pytest.approx(
        goals, rel=1e-2
    )


def test_a_faster_action_saves_the_time_that_the_forecast_says() -> None:
    task, factor = load(CATCH), 0.999
    found = forecast(stochastic_view(task, stages=1, timer_stages=1))
    primitive = task.primitive_tasks["return_home"]
    quicker = {s: Estimate(e.share, e.mean * factor, e.cv) for s, e in primitive.estimates.items()}
    other = replace(
        task,
        primitive_tasks={
            **task.primitive_tasks,
            "return_home": replace(primitive, estimates=quicker),
        },
    )
    after = forecast(stochastic_view(other, stages=1, timer_stages=1))
    share = next(w.time_share for w in found.worth if w.place == "return_home")
    assert (found.done.mean - after.done.mean) / found.done.mean / (1 - factor) == pytest.approx(
        share, rel=1e-2
    )


@pytest.mark.once
def test_simulation_and_solution_of_the_catching_task_agree() -> None:
    exact = forecast(stochastic_view(load(CATCH), stages=3, timer_stages=3))
    seen = simulate_command(CATCH, np.random.default_rng(5), replicas=400, stages=3)
    assert seen.code == 0
    mean, low, high = seen.data["time"]
    assert low - (high - low) < exact.done.mean < high + (high - low)
    assert seen.data["quantiles"]["0.9"] == pytest.approx(
        exact.completion_time.quantile(0.9), rel=0.1
    )
    fewer = simulate_command(
        CATCH, np.random.default_rng(5), replicas=200, stages=3, changes=["runs=1"]
    )
    assert fewer.data["time"][0] < mean / 2


def test_simulating_a_net_needs_a_horizon_and_rates(tmp_path: Path) -> None:
    gspn = Gspn.of(queue(5), {"arrive": 0.8, "serve": 1.0})
    path = tmp_path / "queue.pnml"
    path.write_text(write_pnml(NetFile(gspn.net, "queue", gspn)), encoding="utf-8")
    assert simulate_command(path, np.random.default_rng(1)).code == 2
    seen = simulate_command(
        path, np.random.default_rng(1), replicas=200, horizon=300.0, warmup=20.0
    )
    mean, low, high = seen.data["throughput"]["serve"]
    assert low - 0.01 < 0.7289444010755486 < high + 0.01 and mean > 0
    assert "serve" in seen.text


def test_converting_lists_what_is_not_kept(tmp_path: Path) -> None:
    target = tmp_path / "catch.pnml"
    outcome = convert_command(CATCH, target)
    assert outcome.code == 0 and any("events" in what for what in outcome.data["not_kept"])
    assert explore(read_net(target).net).edges == explore(load(CATCH).net).edges
    assert convert_command(target, tmp_path / "catch.net").code == 0
    assert convert_command(target, tmp_path / "catch.xyz").code == 2
    assert convert_command(CATCH, tmp_path / "no" / "where.pnml").code == 2
    chain = convert_command(tmp_path / "catch.pnml", tmp_path / "catch.drn")
    assert chain.code == 2 and "rates" in chain.text


def test_the_picture_of_the_graph_shows_the_witness(tmp_path: Path) -> None:
    path = tmp_path / "philosophers.pnml"
    path.write_text(write_pnml(NetFile(philosophers(3))), encoding="utf-8")
    outcome = graph_command(path)
    root = ElementTree.fromstring(outcome.data["svg"])
    groups = [g.get("class") or "" for g in root.iter("{http://www.w3.org/2000/svg}g")]
    assert sum(g.startswith("m") for g in groups) == 27 and sum("dead" in g for g in groups) == 2
    assert sum(g == "e on" for g in groups) == len(outcome.data["witness"]) == 3
    task = graph_command(CATCH)
    assert "final" in task.data["svg"] and task.data["witness"] == []
    with pytest.raises(ValueError, match="no such edge"):
        graph_svg(explore(philosophers(3)), witness=("done0",))
    cut = graph_svg(explore(philosophers(6)), markings=50)
    assert "50 of 729 markings shown" in cut


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[rates]\nnobody = 1.0", "no transition"),
        ("[rates]\narrive = 1\n[weights]\narrive = 1", "a rate and a weight"),
        ("[servers]\nserve = true", "True servers"),
        ("servers = 2", "expected a table"),
        ("default_rate = 'fast'", "expected a table of numbers"),
        ('{"rates": {"arrive": 1', "rates.toml:1: JSON: Expecting ',' delimiter; write"),
        ("[rates]\narrive = nan", "positive"),
        ("[rates]\narrive = 'fast'", "expected a table of numbers"),
        ("rates = 3", "expected a table of numbers"),
        ("[rate]\narrive = 1", "neither a transition nor a known key"),
        ("[rates", "rates.toml:1: not valid TOML: "),
        ("[rates]\narrive = -1.0\nserve = 1.0", "positive"),
    ],
)
def test_bad_rates_files_say_what_is_wrong(text: str, said: str) -> None:
    with pytest.raises(NetFileError, match=said):
        read_rates(text, "rates.toml", NetFile(queue(2)))


def test_rates_may_be_at_the_top_and_incomplete() -> None:
    """A flat table or JSON; transitions not named get 1/s, or keep the rate of the net file."""
    assert read_rates("serve = 2", "r", NetFile(queue(2))).rate == (1.0, 2.0)
    assert read_rates('{"serve": 2.5}', "r", NetFile(queue(2))).rate == (1.0, 2.5)
    known = Gspn.of(queue(2), {"serve": 4.0}, servers={"serve": None})
    changed = read_rates("[weights]\narrive = 3", "r", NetFile(known.net, gspn=known))
    assert changed.rate == (None, 4.0) and changed.weight[0] == 3.0 and changed.servers[1] is None


def test_rates_files() -> None:
    gspn = read_rates(
        "default_rate = 2.0\n[rates]\narrive = 1\n[servers]\nserve = 'infinite'",
        "r",
        NetFile(queue(2)),
    )
    assert gspn.rate == (1.0, 2.0) and gspn.servers == (1, None)
    assert unit_rates(NetFile(queue(2))).rate == (1.0, 1.0)


def test_missing_files_give_one_line(tmp_path: Path) -> None:
    outcome = analyse_command(tmp_path / "missing.pnml")
    assert outcome.code == 2 and "\n" not in outcome.text and "missing.pnml" in outcome.text


def answers(data: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], bool]]:
    """Yield each answer yes or no in the data of an analysis, with its keys."""
    if path == ("recoveries",):
        data = {f"{one['error_exit']} {one['cause']}": one for one in data}
    for key, value in data.items() if isinstance(data, dict) else ():
        if isinstance(value, bool) and "complete" not in key:
            yield (*path, key), value
        yield from answers(value, (*path, key))


@pytest.mark.once
@settings(COMMON, max_examples=6)
@given(st.one_of(nets(), whole_tasks()))
@example(kanban(1))
@example(Net.build({"one": 2, "pair": 0}, {"join": ({"one": 2}, {"pair": 1})}))
def test_an_answer_that_a_limit_leaves_open_is_never_no(model: Net | Task) -> None:
    """Whatever ends an analysis early, what it answers is what the whole analysis answers."""
    limits = SearchLimits(states=3_000)
    whole = analyse(model, limits=limits, steps=3_000)
    open_ = whole.progress is not None and not whole.progress.x.complete
    assume(whole.qualitative.space.complete and not open_ and not whole.unjudged)
    known = dict(answers(whole.to_json()))
    for states, steps, seconds in product((1, 20, 3_000), (1, 20, 3_000), (1.0, 20.0, 1e9)):
        try:
            with until(seconds, count().__next__):
                part = analyse(model, limits=SearchLimits(states=states), steps=steps)
                found = list(answers(part.to_json()))
        except OutOfTime:
            continue
        assert [one for one in found if known[one[0]] is not one[1]] == []


def test_a_simulation_of_a_task_with_tries_is_compared_with_the_engine(tmp_path: Path) -> None:
    """The engine takes the task as it is written, not with the names that short forms add."""
    path = tmp_path / "tries.toml"
    path.write_text(
        """
schema = 1
[task]
name = "tries"
final = "parts == 0 and lost == 0"
final_error = "lost == 1"
[primitive_tasks.grip]
deadline = 50.0
estimates = { success = { share = 0.5, mean = 1.0 }, error = { share = 0.5, mean = 1.0 } }
[places]
parts = { kind = "control", tokens = 1 }
lost = { }
grip = { kind = "action", tries = 3 }
[transitions]
start = { in = ["parts"], out = ["grip"] }
gripped = { in = ["grip:normal"] }
dropped = { in = ["grip:error"], out = ["lost"] }
""",
        encoding="utf-8",
    )
    found = simulate_command(path, np.random.default_rng(1), replicas=200)
    low, high = found.data["completed"][1:]
    assert low < 1 - 0.5**3 < high
    assert not [note for note in found.data["notes"] if note.startswith(("doubtful", "approx"))]


def test_a_simulation_names_durations_with_too_few_phases(tmp_path: Path) -> None:
    """Of fixed times: an action, and a timer; not one that is hardly ever met."""
    path = tmp_path / "fixed.toml"
    path.write_text(
        """
schema = 1
[task]
name = "fixed"
final = "parts == 0"
runs_place = "parts"
[primitive_tasks.grip]
deadline = 50.0
[primitive_tasks.grip.estimates]
success = { share = 0.999, mean = 1.0, cv = 0.0 }
error = { share = 0.001, mean = 1.0, cv = 0.0 }
[places]
parts = { kind = "control", tokens = 1 }
grip = { kind = "action" }
held = {}
[transitions]
start = { in = ["parts"], out = ["grip"] }
gripped = { in = ["grip:normal"], out = ["held"] }
dropped = { in = ["grip:error"] }
put = { in = ["held"], after = 2.0 }
""",
        encoding="utf-8",
    )
    (note,) = [
        text
        for text in simulate_command(path, np.random.default_rng(1), replicas=100).data["notes"]
        if text.startswith("approximated")
    ]
    assert "the 90 % quantile of put.after, grip.grip.success is off by up to +16 %" in note


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"view": "ordinary", "exact": True}, "--exact: "),
        ({"view": "ordinary", "measure": lambda *_: Measured()}, "the ordinary net has no times"),
    ],
)
def test_convert_ignores_no_option_of_a_task(
    given: dict[str, Any], said: str, tmp_path: Path
) -> None:
    found = convert_command(CATCH, tmp_path / "net.pnml", **given)
    assert found.code == 2 and said in found.text and not (tmp_path / "net.pnml").exists()


def test_a_net_file_has_no_estimates(tmp_path: Path) -> None:
    """Neither `analyse` nor `convert` ignores them."""
    path = tmp_path / "queue.net"
    path.write_text("net queue\ntr serve waiting -> free\n", encoding="utf-8")
    for found in (
        analyse_command(path, measure=lambda *_: Measured()),
        convert_command(path, tmp_path / "net.pnml", measure=lambda *_: Measured()),
    ):
        assert found.code == 2 and "this is a net; estimates are of tasks" in found.text


@pytest.mark.parametrize(
    ("measures", "said"),
    [
        (["a=mean", "a=P_complete"], "a: two measures have this name"),
        (["=mean"], "mean: a part is empty"),
        (["a="], "a: a part is empty"),
    ],
)
def test_each_measure_has_a_name_of_its_own(measures: list[str], said: str) -> None:
    found = analyse_command(Path("none.toml"), measures=measures)  # said before the work
    assert found.code == 2 and f"--measure: {said}" in found.text


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\xff\xfe[rates]", "rates.toml: file: 'utf-8' codec"),
        (b'{"serve":' * 100_000, "rates.toml: JSON: nested too deeply"),
        (b"serve = " + b"[" * 100_000, "rates.toml: not valid TOML: nested too deeply"),
        (b"\xef\xbb\xbf[rates]\nserve = 2.0\n", ""),
    ],
)
def test_the_fault_of_a_rates_file_names_the_rates_file(
    content: bytes, said: str, tmp_path: Path
) -> None:
    """One with a byte-order mark is read like any other text."""
    path, rates = tmp_path / "queue.net", tmp_path / "rates.toml"
    path.write_text("net queue\ntr serve waiting -> free\npl waiting (1)\n", encoding="utf-8")
    rates.write_bytes(content)
    found = analyse_command(path, rates=rates)
    assert said in found.text and (found.code == 2) is bool(said)


def test_what_holds_for_several_names_is_said_once() -> None:
    told = ["a: is slow", "the cell: is known", "b: is slow", "c: is fast", "no name"]
    assert together(told) == ["a, b: is slow", "the cell: is known", "c: is fast", "no name"]


@pytest.mark.parametrize(
    ("out", "said", "time"),
    [("broken", "s; no way back to the nominal flow; residual", None), ("parts", "s; residual", 0)],
)
def test_the_forecast_says_if_there_is_no_way_back(
    tmp_path: Path, out: str, said: str, time: float | None
) -> None:
    """It said "at most 0.000 s", beside "the task can leave its nominal flow for good"."""
    path = tmp_path / "t.toml"
    path.write_text(
        """schema = 1
[task]
name = "t"
final = "parts == 0 and broken == 0"
final_error = "broken == 1"
[primitive_tasks.grip]
deadline = 50.0
estimates = { success = { share = 0.5, mean = 1.0 }, error = { share = 0.5, mean = 1.0 } }
[places]
parts = { kind = "control", tokens = 1 }
broken = {}
grip = { kind = "action" }
[transitions]
start = { in = ["parts"], out = ["grip"] }
gripped = { in = ["grip:normal"] }
dropped = { in = ["grip:error"], out = ["OUT"] }
""".replace("OUT", out),
        encoding="utf-8",
    )
    found = analyse_command(path, view="gspn")
    assert said in found.text
    assert found.data["forecast"]["recovery_time"] == time


def test_a_doubt_names_the_order_of_timers_and_no_conflict_where_there_is_none(
    tmp_path: Path,
) -> None:
    path = tmp_path / "t.toml"
    path.write_text(
        """schema = 1
[task]
name = "t"
final = "long == 1 or short == 1"
[places]
k = { kind = "control", tokens = 1 }
long = { kind = "control" }
short = { kind = "control" }
[transitions]
late = { in = ["k"], out = ["long"], after = 3.0 }
soon = { in = ["k"], out = ["short"], after = 1.0 }
""",
        encoding="utf-8",
    )
    text = " ".join(analyse_command(path, view="gspn").text.split())
    assert "of timers that run together a longer one may elapse before a shorter one" in text
    assert "are drawn" not in text
