"""The ends net N against the execution graph X: on random tasks every edge of X is a path of N,
every state at rest is a marking of N, and an N without dead ends proves that X has none."""

from __future__ import annotations

import tracemalloc
from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from msgspec.structs import replace

from petrobot.coordinator.analysis.execution.graph import ExecutionGraph, TooManyValues, execute
from petrobot.coordinator.analysis.execution.names import MISSING
from petrobot.coordinator.analysis.net.ends_net import EndsNet, ends_net, judged, kind_of, proven
from petrobot.coordinator.analysis.net.graph import Graph
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.analysis.net.space import JUDGED, SearchLimits, Space, explore
from petrobot.coordinator.analysis.report import analyse
from petrobot.coordinator.engine import Engine, Mode, Phase, Policy, State
from petrobot.coordinator.task import Output, Task
from petrobot.coordinator.task.file import load, loads
from petrobot.coordinator.task.net import Marking
from tests.analysis.broken import TASKS
from tests.analysis.test_execution_graph import COMMON, LIMIT
from tests.analysis.test_progress import STUCK
from tests.engine.conftest import make_task
from tests.engine.test_expansion import LISTEN, SETS, TRIES
from tests.engine.test_properties import DEVICES, tasks


def marking_of(n: EndsNet, x: ExecutionGraph, state: State) -> Marking:
    """Return the marking of N that corresponds to an engine state at rest."""
    net, tokens = n.net, Counter[str]()
    action_places = x.engine.compiled.action_places
    for place, held in zip(n.task.net.places, state.marking, strict=True):
        if place not in action_places:
            tokens[place] = held
    for place in action_places:
        awaited = frozenset().union(*(raised for _, _, raised in n.ended[place]))
        for run in state.tokens.get(place, ()):
            done = run.phase is Phase.DONE
            kind = kind_of(x.names, place, run, run.raised & awaited) if done else None
            tokens[f"{place}.going" if kind is None else n.ended[place][kind]] += 1
        if f"{place}.occupied" in net.place_index:
            stopping = sum(run.place == place for run in state.stopping.values())
            tokens[f"{place}.stopping"] = stopping
            tokens[f"{place}.occupied"] = stopping + len(state.tokens.get(place, ()))
    for name, places in n.values.items():
        tokens[places[x.names.region(name, state.variables.get(name, MISSING))]] = 1
    return tuple(tokens[place] for place in net.places)


def follow(n: EndsNet, space: Space, start: set[int], firings: tuple[str, ...]) -> set[int]:
    """Return the markings that N can reach by the firings of a stimulus, which may itself be an end
    of a run, a stop or a change of a variable."""

    def after(at: set[int], wanted: str | None) -> Iterator[int]:
        for i in at:
            for e in range(space.row[i], space.row[i + 1]):
                name = n.net.transitions[space.label[e]]
                if n.origin.get(name) == wanted:
                    yield int(space.target[e])

    at = start | set(after(start, None))
    for name in firings:
        at = set(after(at, name))
    return at


def n_holds_x(task: Task, devices: dict[str, str], limit: int = LIMIT) -> bool:
    """Compare N with X; return False if one of them is too large."""
    try:
        x = execute(task, limit=limit, engine=Engine(task, devices, Policy(firing_limit=40)))
    except TooManyValues:
        return False
    if not x.complete:
        return False
    n = ends_net(task)
    space = explore(n.net, limits=SearchLimits(states=30_000))
    if not space.complete:
        return False
    running = [i for i, s in enumerate(x.states) if s.mode in (Mode.RUNNING, Mode.FRESH)]
    livelocks = set(x.livelocks)
    known = {space.marking(i): i for i in range(len(space))}
    number = dict[int, int]()
    for i in running:
        marking = marking_of(n, x, x.states[i])
        assert n.projected(marking) == x.states[i].marking
        if i in livelocks:
            continue
        assert marking in known, (n.net.describe(marking), x.firings(i))
        number[i] = known[marking]
    for i, j, label in zip(x.source, x.target, x.label, strict=True):
        if int(i) in number and int(j) in number:
            step = x.steps[label]
            there = follow(n, space, {number[int(i)]}, step.firings)
            assert number[int(j)] in there, (str(step), x.firings(int(i)))
    # A marking of N is dead if no case of a transition of the task can be reached from it.
    fires = np.array([name in n.origin for name in n.net.transitions] or [False])[space.label]
    alive = np.zeros(len(space), dtype=np.bool_)
    alive[space.source[fires]] = True
    alive = Graph(len(space), space.source, space.target).backward(alive)
    for dead in np.flatnonzero(x.dead).tolist():
        # N has no devices: a run may end there although another run holds its device
        if dead in number and not n.left_out and not devices:
            assert not alive[number[dead]], x.firings(dead)
    return True


@pytest.mark.once
@settings(COMMON, max_examples=25)
@given(tasks(), st.data())
def test_every_path_of_the_engine_is_one_of_n(task: Task, data: st.DataObject) -> None:
    assume(n_holds_x(task, data.draw(st.sampled_from(({}, DEVICES)))))


@pytest.mark.parametrize("text", [TRIES, LISTEN, SETS])
def test_every_path_of_the_engine_is_one_of_n_with_short_forms(text: str) -> None:
    assert n_holds_x(loads(text), {}, 20 * LIMIT)


def test_bounds_use_the_names_of_the_task() -> None:
    """N shows a leak by a pump, and the task's own net can repeat its firings."""
    task = load(TASKS / "catch_ball.toml")
    twice = (Output("arm_free"), Output("camera_free"), Output("runs", 2))
    leaking = replace(task.transitions["not_located"], outputs=twice)
    leaking_task = replace(task, transitions={**task.transitions, "not_located": leaking})
    leak = analyse(leaking_task, limits=SearchLimits(states=3000)).verdicts()["bounded"]
    assert leak.holds is False and leak.witness is not None and "runs" in leak.reason
    net, runs = leaking_task.net, leaking_task.net.place_index["runs"]
    *_, before = net.replay(leak.witness.firings)
    *_, after = net.replay(leak.witness.loop, before)
    assert after[runs] > before[runs]
    part = analyse(task, limits=SearchLimits(states=50)).to_json()
    whole = analyse(task).to_json()
    assert part["bounded"]
    assert whole["max_tokens_in_marking"] == explore(task.net).most_tokens
    assert all(part["bounds"][p] >= most for p, most in whole["bounds"].items())


def test_n_proves_what_an_incomplete_execution_graph_cannot() -> None:
    task = load(TASKS / "catch_ball.toml")
    verdicts = analyse(task, steps=50).verdicts()
    shown = {name for name, verdict in verdicts.items() if "ends net" in verdict.reason}
    assert shown == {"deadlock_free", "one_run_each", "returned"}
    assert all(verdicts[name].holds for name in shown) and verdicts["sound"].holds is None


def test_verdicts_of_a_net_of_many_places_take_the_memory_that_the_search_left() -> None:
    """A search stops where the verdicts need the rest of the memory. A column of tokens for each
    place would take many times that: a task has a hundred places, and a marking of it 30 bytes."""
    steps = range(20)
    net = {f"end{i}": {"in": f"do{i}:normal", "out": f"do{i + 1}"} for i in steps}
    net |= {f"lost{i}": {"in": f"do{i}:error", "out": "go"} for i in steps}
    places = "".join(f" do{i}!3" for i in steps)
    net["begin"] = {"in": "go", "out": "do0"}
    task = make_task(f"go=3 do20{places}", net, final="do20 == 3")
    n = ends_net(task)
    space = explore(n.net)
    arrays = (space.words, space.row, space.target, space.label)
    engine = sum(array.nbytes for array in arrays)
    tracemalloc.start()
    found = judged(n, space)
    shown = proven(n, space, OrdinaryView(task))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(space) > 15_000 and len(n.net.places) > 60
    assert found.most == 3 and shown["deadlock_free"].holds
    assert engine + peak < JUDGED * engine


@pytest.mark.parametrize("what", STUCK)
def test_n_keeps_how_a_run_ended(what: str) -> None:
    """For tasks that get stuck with an ended run, N gets stuck too, though the ordinary net may
    not. So N proves nothing about them."""
    task = STUCK[what].task
    n = ends_net(task)
    assert "deadlock_free" not in proven(n, explore(n.net), OrdinaryView(task))


@pytest.mark.proof
@settings(COMMON, max_examples=1000)
@given(tasks(), st.data())
def test_every_path_of_the_engine_is_one_of_n_at_length(task: Task, data: st.DataObject) -> None:
    assume(n_holds_x(task, data.draw(st.sampled_from(({}, DEVICES)))))


GLANCES = """
schema = 1
[task]
name = "glances"
final = "left == 0 and right == 0 and seen >= 0"
[primitive_tasks]
carry = { goal = "carried", deadline = 9.0 }
film = { goal = "filmed", deadline = 9.0 }
[events]
motion = { by = "film" }
[places]
left = { kind = "control", tokens = 3 }
right = { kind = "control", tokens = 3 }
carry_left = { kind = "action", task = "carry", servers = 3 }
carry_right = { kind = "action", task = "carry", servers = 3 }
film = { kind = "action", tokens = 1, listen = true }
seen = { listen = true }
[transitions]
l = { in = ["left"], out = ["carry_left"] }
r = { in = ["right"], out = ["carry_right"] }
l_done = { in = ["carry_left:normal"] }
r_done = { in = ["carry_right:normal"] }
l_lost = { in = ["carry_left:error"], out = ["left"] }
r_lost = { in = ["carry_right:error"], out = ["right"] }
glance = { in = ["film:going"], out = ["seen"], event = "motion" }
filmed = { in = ["film:normal"], out = ["film"] }
blind = { in = ["film:error"], out = ["film"] }
"""


@pytest.mark.parametrize(
    ("more", "steps", "bounded"),
    [
        ('note = { in = ["seen"] }\n', 20, None),
        ('note = { in = ["seen"] }\n', 5_000, True),
        ("", 200, False),
        ('note = { in = ["seen", "!seen*4"] }\n', 20, None),
        ('both = { in = ["seen*2"] }\n', 20, None),
        ('more = { in = ["seen*3"], out = ["left"] }\n', 3_000, False),  # its runs queue
    ],
)
def test_a_task_grows_only_if_the_engine_shows_it(
    more: str, steps: int, bounded: bool | None
) -> None:
    """In the ends net `note` may wait for ever; the engine fires it at once."""
    found = analyse(loads(GLANCES + more, "t.toml"), steps=steps)
    assert found.qualitative.bounded.holds is False
    said = found.verdicts()["bounded"]
    assert said.holds is bounded and found.to_json()["bounded"] is bounded
    assert ("bounded" in found.objections) == (bounded is False)
    if bounded is False:
        assert said.witness is not None and said.witness.loop
        assert "can grow without bound" in said.reason


def test_growth_that_an_end_may_stop_is_unknown() -> None:
    """How far a place can grow that the end compares with another place, no repetition shows."""
    text = GLANCES.replace("seen >= 0", "seen >= right")
    found = analyse(loads(text, "t.toml"), steps=200)
    assert found.verdicts()["bounded"].holds is None and "bounded" not in found.objections
