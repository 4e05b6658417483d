"""The execution graph against the engine. Random tasks are played with a clock, with other values
and ids than those of the graph; no play leaves the graph. Each dead end is replayed from the
beginning, and the engine reports it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from itertools import cycle

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, event, find, given, settings, strategies as st
from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.analysis.execution.causes import explain, settled
from petrobot.coordinator.analysis.execution.chain import TooLarge, chain_of
from petrobot.coordinator.analysis.execution.graph import ExecutionGraph, TooManyValues, execute
from petrobot.coordinator.analysis.execution.names import Names
from petrobot.coordinator.analysis.execution.progress import Progress, progress_of
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.analysis.time.measured import NoEstimate
from petrobot.coordinator.engine import (
    ArmTimer,
    Begin,
    Choose,
    Chosen,
    Engine,
    EventOccurred,
    Finished,
    Fired,
    Instruction,
    Mode,
    Policy,
    Report,
    RunEnded,
    RunRaised,
    RunStarted,
    State,
    Stimulus,
    StopConfirmed,
    TimerFired,
    VariableChanged,
)
from petrobot.coordinator.engine.firing import DEAD_END
from petrobot.coordinator.engine.state import ACTIVE
from petrobot.coordinator.task import (
    End,
    Estimate,
    Executed,
    Kind,
    Place,
    Scope,
    Status,
    Task,
    Transition,
    Variable,
    VariableType,
)
from petrobot.coordinator.task.conditions import parse
from petrobot.coordinator.task.file import loads
from petrobot.coordinator.task.validation import faults
from tests.analysis.broken import with_button
from tests.engine.test_expansion import LISTEN, SETS, TRIES
from tests.engine.test_properties import DEVICES, tasks

LIMIT = 1_500
"""Stimuli and firings for one graph; random tasks that need more are left out."""
COMMON = settings(
    phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)


def moved(net: Task, **changes: object) -> Task:
    """The task with some places or transitions replaced."""
    made: dict[str, object] = {}
    for key, new in changes.items():
        made[key] = {**getattr(net, key), **{one.name: one for one in new}}  # type: ignore[attr-defined]
    return replace(net, **made)


BODY = """schema = 1
[task]
name = "part"
final = "1 == 2"
[primitive_tasks.p0]
goal = "done"
alternatives = ["x"]
deadline = 2.0
[events.bell]
scope = "external"
[variables.b]
type = "bool"
[places.c0]
kind = "control"
[places.whole]
kind = "macro"
subnet = "part"
[subnets.part]
entry = "move"
normal = "over"
error = "failed"
[subnets.part.places.move]
kind = "action"
task = "p0"
[subnets.part.places.over]
[subnets.part.places.failed]
[subnets.part.transitions.moved]
in = ["move:normal"]
out = ["over"]
[subnets.part.transitions.broken]
in = ["move:error"]
out = ["failed"]
"""
WITH_ARGUMENTS = (
    BODY.replace(
        'subnet = "part"\n', 'subnet = "part"\nargs = { to = "c0", most = 2, seen = "b" }\n'
    )
    .replace('"p0"\n[subnets', '"p0"\nout = { v = "seen" }\n[subnets')
    .replace('out = ["over"]', 'out = ["over", "to"]\nwhen = "seen or n <= most"')
    .replace("[variables.b]", '[variables.n]\ntype = "int"\n[variables.b]')
    .partition("[subnets.part.transitions.broken]")[0]
    + """[subnets.part.errors]
to = "failed"
[subnets.part.parameters]
to = "place"
most = "int"
seen = "variable"
"""
)


@st.composite
def whole_tasks(draw: st.DrawFn) -> Task:
    """Draw a random task with short forms, subnets, both kinds of ends and branches without an
    action.

    A drawn feature that does not fit the task is left out.
    """
    task = draw(tasks())
    for change in draw(st.lists(st.sampled_from(CHANGES), max_size=4, unique=True)):
        changed = draw(changes(task, change))
        if not faults(changed):
            task = changed
            event(change.__name__)
    return task


@st.composite
def changes(draw: st.DrawFn, task: Task, change: Change) -> Task:
    """Draw places and a transition, and change them; the task may have faults then."""
    acting = change not in (plain, given_up, erring) and draw(st.integers(0, 4)) > 0
    suitable = [n for n, p in task.places.items() if (p.kind is Kind.ACTION) is acting]
    place = task.places[draw(st.sampled_from(suitable or sorted(task.places)))]
    transition = task.transitions[draw(st.sampled_from(sorted(task.transitions)))]
    kinds = OTHERS.get(change, Kind)
    fit = [n for n, p in task.places.items() if p.kind in kinds]
    return change(task, place, transition, draw(st.sampled_from(fit or sorted(task.places))))


Change = Callable[[Task, Place, Transition, str], Task]


def plain(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Make a resource or control place a plain one."""
    return moved(task, places=[replace(place, kind=Kind.PLAIN)])


def listening(task: Task, place: Place, transition: Transition, other: str) -> Task:
    return moved(task, places=[replace(place, listen=True)])


def given_up(task: Task, place: Place, transition: Transition, other: str) -> Task:
    return replace(task, final_error=parse(f"{place.name} == 1"))


def writing(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Make a transition set a variable."""
    return moved(task, transitions=[replace(transition, sets=(("n", parse("3")),))])


def copying(task: Task, place: Place, transition: Transition, other: str) -> Task:
    return moved(task, transitions=[replace(transition, sets=(("b", parse("true")),))])


def trying(task: Task, place: Place, transition: Transition, other: str) -> Task:
    tries, unknown = (2, True) if other == "c0" else (3, False)
    return moved(task, places=[replace(place, tries=tries, servers=None, retry_unknown=unknown)])


def timing(task: Task, place: Place, transition: Transition, other: str) -> Task:
    return moved(task, places=[replace(place, timeout=0.1)])


def holding(task: Task, place: Place, transition: Transition, other: str) -> Task:
    return moved(task, places=[replace(place, holds=(other,))])


def erring(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Add an error arc to action places that have none."""
    return replace(task, errors_to=other)


def nesting(task: Task, place: Place, transition: Transition, other: str, text: str = BODY) -> Task:
    """Replace an action place by a subnet with an action in it."""
    body = loads(text)
    whole = replace(body.places["whole"], name=place.name)
    ends = {End.PREEMPT: End.ERROR, End.GOING: End.NORMAL}
    rewired = [
        replace(
            t,
            inputs=tuple(
                replace(a, end=ends.get(a.end, a.end), counts=None, weight=1)
                if a.place == place.name and a.end is not None
                else a
                for a in t.inputs
            ),
            when=t.when if t.when is None or f"{place.name}." not in str(t.when) else None,
        )
        for t in task.transitions.values()
    ]
    final = parse("c0 == 0")
    nested = replace(moved(task, places=[whole], transitions=rewired), final=final)
    return replace(nested, subnets=body.subnets)


def lending(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Replace an action place by a subnet with arguments: a place, a value and a variable."""
    return nesting(task, place, transition, other, WITH_ARGUMENTS)


def asking(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Let a condition ask whether a run was executed."""
    when = parse(f"{place.name}.executed == 'no' or {place.name}.status == 'success'")
    return moved(task, transitions=[replace(transition, when=when)])


def limiting(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Let a condition read a parameter."""
    limited = moved(task, transitions=[replace(transition, when=parse("n < most"))])
    return replace(limited, parameters={"most": 2})


def measuring(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Let an action write a float that a condition reads."""
    return _told(task, place, transition, Variable("f", VariableType.FLOAT, 0.5), "f > 1.5")


def naming(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Let an action write a text that a condition reads."""
    side = Variable("s", VariableType.STR, values=("left", "right"))
    return _told(task, place, transition, side, "s == 'left' or s == none")


def _told(task: Task, place: Place, transition: Transition, new: Variable, when: str) -> Task:
    told = moved(
        task,
        places=[replace(place, out={"v": new.name})],
        transitions=[replace(transition, when=parse(when))],
    )
    return replace(told, variables={**task.variables, new.name: new})


def delaying(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Give all transitions without events timers of several lengths."""
    lengths = zip(task.transitions.values(), cycle((0.5, 2.0, 4.0)), strict=False)
    return moved(task, transitions=[replace(t, after=s) for t, s in lengths if not t.events])


def counting(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """Count the runs of the task and the goals that they met."""
    return replace(task, runs_place=other, goal_transitions=(transition.name,))


def stopping(task: Task, place: Place, transition: Transition, other: str) -> Task:
    """A listening action ends the mission run while it is active."""
    listener = replace(place, listen=True, tokens=1)
    return replace(moved(task, places=[listener]), final=parse("c0 <= 1"))


CHANGES: tuple[Change, ...] = (
    plain,
    listening,
    given_up,
    writing,
    copying,
    trying,
    timing,
    holding,
    erring,
    nesting,
    lending,
    asking,
    limiting,
    measuring,
    naming,
    delaying,
    counting,
    stopping,
)
OTHERS: dict[Change, tuple[Kind, ...]] = {
    holding: (Kind.RESOURCE,),
    erring: (Kind.CONTROL, Kind.PLAIN),
    counting: (Kind.CONTROL,),
}
"""The kinds of place that the last argument can name; any for the others."""


@pytest.mark.parametrize("change", CHANGES)
def test_each_feature_is_drawn(change: Change) -> None:
    """A feature that fits no task would be left out without a word."""
    drawn = tasks().flatmap(lambda task: changes(task, change))
    find(drawn, lambda task: not faults(task), settings=settings(COMMON, phases=[Phase.generate]))


VALUES: dict[VariableType, st.SearchStrategy[object]] = {
    VariableType.BOOL: st.booleans(),
    VariableType.INT: st.integers(-9, 9),
    VariableType.FLOAT: st.floats(-9, 9),
    VariableType.STR: st.sampled_from(("left", "right", "above")),
}


class Player(Struct):
    """The world: answers every instruction, raises events, and lets timers elapse by a clock."""

    engine: Engine
    data: st.DataObject
    now: float = 0.0
    due: dict[str, float] = field(default_factory=dict)
    open: dict[str, Choose] = field(default_factory=dict)

    def heard(self, said: tuple[Instruction, ...]) -> None:
        """Record the instructions of the engine."""
        for one in said:
            if isinstance(one, ArmTimer):
                self.due[one.key] = self.now + one.seconds
            if isinstance(one, Choose):
                self.open[one.key] = one

    def next(self, state: State) -> Stimulus | None:
        """Draw one of the stimuli that can arrive now; None if there is none."""
        if state.suspended is not None and state.suspended.key:
            return Chosen(
                state.suspended.key, self.data.draw(st.sampled_from(state.suspended.alternatives))
            )
        armed = {t.key for t in state.timers.values() if not t.elapsed}
        self.due = {key: due for key, due in self.due.items() if key in armed}
        first = min(self.due.values(), default=None)
        possible = self._possible(state)
        # of timers that elapse together, the one that was armed first
        possible += [TimerFired(key) for key, due in self.due.items() if due == first][:1]
        if not possible:
            return None
        chosen = self.data.draw(st.sampled_from(possible))
        if isinstance(chosen, TimerFired):
            self.now = self.due.pop(chosen.key)
        elif self.data.draw(st.booleans()):  # otherwise it arrives at the same time as the last one
            end = self.now + 1.0 if first is None else first
            self.now += (end - self.now) * self.data.draw(st.sampled_from((0.25, 0.5)))
        return chosen

    def _possible(self, state: State) -> list[Stimulus]:
        found: list[Stimulus] = []
        task = self.engine.task.flat
        for run in state.runs():
            if run.phase in ACTIVE:
                status = self.data.draw(st.sampled_from(list(Status)))
                cause = self.data.draw(st.sampled_from(("", "lost", "elsewhere", "emergency_stop")))
                done = Executed.YES
                if status is Status.ERROR:
                    done = self.data.draw(st.sampled_from(Executed))
                out = {name: self._value(v) for name, v in task.places[run.place].out.items()}
                if status is Status.ERROR and self.data.draw(st.booleans()):
                    out = {}
                found += [RunEnded(run.id, status, cause, "", done, out)] * 3
                found += [RunRaised(run.id, "seen"), RunStarted(run.id)]
            elif run.id in self.open and run.phase == "choosing":
                found += [Chosen(run.id, a) for a in self.open[run.id].alternatives]
        for run_id in state.stopping:
            found += [StopConfirmed(run_id), RunEnded(run_id, Status.SUCCESS)]
        found += [EventOccurred(e.name) for e in task.events.values() if e.scope is Scope.EXTERNAL]
        written = {v for p in task.places.values() for v in p.out.values()}
        written |= {name for t in task.transitions.values() for name, _ in t.sets}
        read = {n for t in task.transitions.values() if t.when for n in t.when.names}
        for name in sorted((set(task.variables) & read) - written):
            found.append(VariableChanged(name, self._value(name)))
        return found

    def _value(self, name: str) -> object:
        return self.data.draw(VALUES[self.engine.task.flat.variables[name].type])


class Path:
    """A play and its path on the graph."""

    def __init__(self, x: ExecutionGraph) -> None:
        self.x = x
        self.undecided = False
        """Whether the order in the file decided a conflict in some play."""
        self.index: dict[Hashable, int] = {}
        for i, (state, orders) in enumerate(zip(x.states, x.orders, strict=True)):
            self.index.setdefault(x.names.key(state, orders), i)
        self.edges = {
            (int(i), int(j), x.steps[n].firings)
            for i, j, n in zip(x.source, x.target, x.label, strict=True)
        }

    def follow(self, player: Player, length: int) -> None:
        """Play and check each step."""
        engine, before = self.x.engine, self.x.engine.initial()
        state, said = engine.handle(before, Begin())
        orders = self.x.names.next_orders(before, frozenset(), state)
        at = self.index[self.x.names.key(state, orders)]
        assert at == 0
        for _ in range(length):
            player.heard(said)
            stimulus = player.next(state)
            if stimulus is None or state.mode is not Mode.RUNNING or at in self.x.livelocks:
                return
            before = state
            state, said = engine.handle(before, stimulus)
            if any(isinstance(i, Report) and i.key == "timeless" for i in said):
                return  # the counter of such firings is not part of a state
            self.undecided |= any(isinstance(i, Report) and i.key == "undecided" for i in said)
            orders = self.x.names.next_orders(before, orders, state)
            there = self.index.get(self.x.names.key(state, orders))
            firings = tuple(i.transition for i in said if isinstance(i, Fired))
            assert there is not None, stimulus
            assert (at == there and not firings) or (at, there, firings) in self.edges, stimulus
            if self.x.dead[at]:
                assert not firings
                assert not any(isinstance(i, Finished) and "dead" not in state.told for i in said)
            at = there


def keys_of(x: ExecutionGraph, names: Names) -> set[Hashable]:
    """Return the states of a graph as other names tell them apart."""
    return {
        (names.key(state, orders), i in x.livelocks)
        for i, (state, orders) in enumerate(zip(x.states, x.orders, strict=True))
    }


def graph_and_engine_agree(task: Task, data: st.DataObject) -> None:
    """Make the graph, follow random plays on it, replay its dead ends, and compare with what the
    engine reports."""
    devices = data.draw(st.sampled_from(({}, DEVICES)))
    engine = Engine(task, devices, Policy(firing_limit=40))
    try:
        x = execute(task, limit=LIMIT, engine=engine)
    except TooManyValues:
        assume(False)
    assume(x.complete)
    event(f"dead ends: {min(int(x.dead.sum()), 3)}")
    path = Path(x)
    for _ in range(4):
        path.follow(Player(engine, data), 25)
    for i in np.flatnonzero(x.dead)[:10]:
        end = settled(x, int(i))
        state = engine.initial()
        for stimulus in x.stimuli(end):
            state, _ = engine.handle(state, stimulus)
        assert state == x.states[end]
        assert explain(x, end)
    leaving = np.bincount(x.source[x.source != x.target], minlength=len(x))
    for i, state in enumerate(x.states):
        reported = DEAD_END in state.told or "dead" in state.told
        if not x.dead[i]:
            assert not reported
        elif not leaving[i] and i not in x.livelocks and state.mode is not Mode.FINISHED:
            assert reported
    asking = Engine(task, devices, Policy(firing_limit=40, ask_undecided=True))
    free = execute(task, limit=LIMIT, engine=asking)
    event(f"conflicts: {min(len(free.contests), 2)}")
    if free.complete:
        served = execute(task, limit=LIMIT, engine=engine, contests=free.contests)
        assert {s.marking for s in served.states} == {s.marking for s in x.states}
        for one, other in ((served.dead, x.dead), (served.final, x.final)):
            assert one.any() == other.any()
        assert served.graph.backward(served.final).all() == x.graph.backward(x.final).all()
        assert {t for step in served.steps for t in step.firings} == {
            t for step in x.steps for t in step.firings
        }
        assert keys_of(served, served.names) == keys_of(x, served.names)
        shared = execute(
            task, limit=LIMIT, engine=engine, contests=free.contests, shared=free.shared
        )
        assert (shared.states, shared.orders) == (served.states, served.orders)
        assert shared.steps == served.steps and np.array_equal(shared.target, served.target)
        if not free.contests:
            assert len(free) == len(served) and not path.undecided


@pytest.mark.once
@settings(COMMON, max_examples=12)
@given(whole_tasks(), st.data())
def test_every_play_of_the_engine_is_a_path(task: Task, data: st.DataObject) -> None:
    graph_and_engine_agree(task, data)


def ends_by_search(x: ExecutionGraph) -> tuple[bool, bool]:
    """Return whether an end can be reached from every state, and whether one with `final` can be
    reached at all. The engine follows every stimulus once more, and a search begins in each state:
    slow, but it shares nothing with the verdict."""
    final, error = x.engine.compiled.task.final, x.engine.compiled.task.final_error
    places = x.engine.compiled.net.places
    calm, good, tired = [set[int]() for _ in x.states], set[int](), set[int]()
    after = [set[int]() for _ in x.states]
    for i, state in enumerate(x.states):
        held = dict(zip(places, state.marking, strict=True))
        if state.mode is Mode.FINISHED and final.holds(held):
            good.add(i)
        elif state.mode is Mode.FINISHED and error is not None and error.holds(held):
            tired.add(i)
        if i in x.livelocks:
            continue
        for cause in x.names.stimuli(state, x.orders[i]):
            _, _, number, _ = x.follow(i, cause)
            after[i].add(number)
            said = cause.stimulus
            if not (isinstance(said, RunEnded) and said.status is Status.ERROR):
                calm[i].add(number)
    everywhere = all(reached(i, after) & good or reached(i, calm) & tired for i in range(len(x)))
    return everywhere, bool(good)


def reached(first: int, after: list[set[int]]) -> set[int]:
    known, todo = {first}, [first]
    while todo:
        new = after[todo.pop()] - known
        known |= new
        todo += new
    return known


def with_ends(task: Task, data: st.DataObject) -> Task:
    """Return the task with an end of each kind, a transition that forgets its tokens and a stop
    button."""
    kept = [p.name for p in task.places.values() if p.kind in (Kind.CONTROL, Kind.RESOURCE)]
    assume(kept)
    draw = data.draw
    first, second = (
        parse(f"{draw(st.sampled_from(kept))} {draw(st.sampled_from(signs))} {least}")
        for signs, least in ((("==", "<=", ">="), draw(st.integers(0, 2))), ((">=",), 2))
    )
    forgets = replace(task.transitions[draw(st.sampled_from(sorted(task.transitions)))], outputs=())
    task = replace(moved(task, transitions=[forgets]), final=first, final_error=second)
    task = with_button(task, draw(st.sampled_from(kept)))
    assume(not faults(task))
    return task


@pytest.mark.once
@settings(COMMON, max_examples=25)
@given(whole_tasks(), st.data())
def test_sound_is_what_a_search_from_every_state_says(task: Task, data: st.DataObject) -> None:
    task = with_ends(task, data)
    try:
        found = progress_of(OrdinaryView(task), 300)
    except TooManyValues:
        assume(False)
    x = found.x
    assume(x.complete)
    everywhere, once = ends_by_search(x)
    event(f"an end from everywhere: {everywhere}, with `final`: {once}, stuck: {x.dead.any()}")
    assert found.sound.holds is (everywhere and once)
    if not everywhere and not x.dead.any() and not x.livelocks:
        assert found.sound.witness is not None and found.sound.details


def partial_refutes_only_what_fails(task: Task, data: st.DataObject) -> None:
    task = with_ends(task, data)
    view, engine = OrdinaryView(task), Engine(task, policy=Policy(firing_limit=40))
    try:
        whole = Progress(execute(task, limit=1_000, engine=engine), view)
        assume(whole.x.complete and len(whole.x) > 10)
        limit = data.draw(st.integers(8, len(whole.x.source) // 2))
        part = Progress(execute(task, limit=limit, engine=engine), view)
    except TooManyValues:
        assume(False)
    assume(not part.x.complete)
    known = whole.verdicts()
    refuted = {name for name, verdict in part.verdicts().items() if verdict.holds is False}
    event(f"refuted: {sorted(refuted)}")
    assert all(known[name].holds is False for name in refuted), refuted
    for i in np.flatnonzero(part.x.dead).tolist():
        state = part.x.engine.initial()
        for stimulus in part.x.stimuli(i):
            state, _ = part.x.engine.handle(state, stimulus)
        assert state == part.x.states[i]


@pytest.mark.once
@settings(COMMON, max_examples=20)
@given(whole_tasks(), st.data())
def test_a_part_of_the_graph_refutes_only_what_fails(task: Task, data: st.DataObject) -> None:
    partial_refutes_only_what_fails(task, data)


@pytest.mark.proof
@settings(COMMON, max_examples=5000)
@given(whole_tasks(), st.data())
def test_a_part_refutes_only_what_fails_at_length(task: Task, data: st.DataObject) -> None:
    partial_refutes_only_what_fails(task, data)


ESTIMATES = {
    Status.SUCCESS: Estimate(0.6, 1.0, 0.5),
    Status.FAILURE: Estimate(0.1, 2.0, 1.5),
    Status.ERROR: Estimate(0.3, 0.5, 0.3),
}


@settings(COMMON, max_examples=20)
@given(whole_tasks())
def test_the_chain_of_a_graph_stops_only_where_the_graph_does(task: Task) -> None:
    """Its probabilities add up to 1."""
    primitives = {
        n: replace(p, estimates=ESTIMATES, deadline=1e6) for n, p in task.primitive_tasks.items()
    }
    events = {n: replace(e, mean_wait=2.0) for n, e in task.events.items()}
    try:
        x = execute(replace(task, primitive_tasks=primitives, events=events), limit=LIMIT)
        assume(x.complete)
        chain = chain_of(x, size=2_000)
    except (TooManyValues, TooLarge, NoEstimate):
        assume(False)
    out = np.bincount(chain.graph.source, chain.probability, minlength=chain.graph.n)
    leaves = np.bincount(chain.graph.source, minlength=chain.graph.n) > 0
    assert np.allclose(out[leaves], 1.0, atol=1e-9)
    assert (chain.probability > 0).all() and (chain.sojourn >= 0).all()
    assert not np.isin(chain.at[~leaves], x.source[x.source != x.target]).any()
    for t in x.engine.compiled.transitions:
        back = chain.back(np.flatnonzero(x.firing([t.name])), x.final)
        assert back is None or 0.0 <= back[0] <= 1.0


@pytest.mark.parametrize("text", [TRIES, LISTEN, SETS])
@settings(COMMON, max_examples=8)
@given(data=st.data())
def test_every_play_of_the_engine_is_a_path_with_short_forms(
    text: str, data: st.DataObject
) -> None:
    graph_and_engine_agree(loads(text), data)


@pytest.mark.proof
@settings(COMMON, max_examples=5000)
@given(whole_tasks(), st.data())
def test_every_play_of_the_engine_is_a_path_at_length(task: Task, data: st.DataObject) -> None:
    graph_and_engine_agree(task, data)


def philosophers(n: int, steps: int) -> Task:
    """Return a task in which each of n arms makes some steps, then takes its own fork, and later
    that of the next arm: all arms may wait for each other."""
    places, lines = list[str](), list[str]()
    for i in range(n):
        chain = [f"s{i}_{k}" for k in range(steps)] + [f"left{i}", f"right{i}"]
        places += [f'fork{i} = {{ kind = "resource", tokens = 1 }}', f"todo{i} = {{ tokens = 1 }}"]
        places += [f'over{i} = {{ kind = "control" }}', f"ready{i} = {{}}", f"half{i} = {{}}"]
        places += [f'{name} = {{ kind = "action", task = "move" }}' for name in chain]
        after = [*chain[1:steps], f"ready{i}", f"half{i}", f"over{i}"]
        forks = f"fork{i}", f"fork{(i + 1) % n}"
        for name, to in zip(chain, after, strict=True):
            out = [to, *forks] if to == f"over{i}" else [to]
            lines.append(f'{name}_n = {{ in = ["{name}:normal"], out = {out} }}')
            lines.append(f'{name}_x = {{ in = ["{name}:error"], out = ["{name}"] }}')
        lines.append(f'go{i} = {{ in = ["todo{i}"], out = ["s{i}_0"] }}')
        lines.append(f'take{i} = {{ in = ["ready{i}", "{forks[0]}"], out = ["left{i}"] }}')
        lines.append(f'both{i} = {{ in = ["half{i}", "{forks[1]}"], out = ["right{i}"] }}')
    final = " and ".join(f"over{i} == 1" for i in range(n))
    text = f'schema = 1\n[task]\nname = "forks"\nfinal = "{final}"\n[primitive_tasks]\n'
    text += "move = { deadline = 9.0 }\n[places]\n" + "\n".join(places)
    return loads(text + "\n[transitions]\n" + "\n".join(lines))


def test_a_dead_end_far_behind_many_states_is_found() -> None:
    """Eight arms take their first forks at the same time, after 24 steps. Neither breadth
    first nor plays that draw each stimulus by chance come there within this limit."""
    task = philosophers(8, 2)
    x = execute(task, limit=20_000, engine=Engine(task, policy=Policy(ask_undecided=True)))
    assert not x.complete and x.dead.any()
    assert len(x.path(int(np.flatnonzero(x.dead)[0]))) >= 20
