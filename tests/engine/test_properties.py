"""Any stimuli on any task: the journal projects on a firing sequence of the ordinary net, and
nothing is lost or doubled."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from petrobot.coordinator.engine import (
    Abort,
    AddTokens,
    ArmTimer,
    Begin,
    CancelRun,
    Choose,
    Chosen,
    Engine,
    EventOccurred,
    Finished,
    Fired,
    ForceExit,
    Hold,
    Instruction,
    Marked,
    Mode,
    Override,
    Pause,
    Policy,
    RaiseEvent,
    RemoveTokens,
    Report,
    Resume,
    RunEnded,
    RunHeld,
    RunRaised,
    RunRecorded,
    RunStarted,
    SetBreakpoints,
    StartRun,
    State,
    Step,
    Stimulus,
    StopConfirmed,
    StopFailed,
    TimerFired,
    VariableChanged,
    Verdict,
    stimulus_from_plain,
    to_plain,
)
from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import match
from petrobot.coordinator.engine.state import ACTIVE
from petrobot.coordinator.task import (
    Counts,
    EarlyEvent,
    End,
    Event,
    EventMemory,
    Executed,
    Inhibitor,
    Input,
    Kind,
    Output,
    Place,
    PrimitiveTask,
    Reference,
    Scope,
    Start,
    Status,
    Task,
    Transition,
    Variable,
    VariableType,
)
from petrobot.coordinator.task.check import check
from petrobot.coordinator.task.conditions import parse
from petrobot.coordinator.task.file import dumps, loads
from petrobot.coordinator.task.validation import faults

CONDITIONS = (
    "b",
    "not b",
    "n > 2",
    "n <= 2",
    "b and n == 1",
    "n == none",
    "a0.status == 'failure'",
    "a0.reason == 'lost'",
)
DEVICES = {"x": "arm", "y": "camera", "z": "arm"}
EVENTS = {
    "tick": Event("tick", Scope.EXTERNAL, EventMemory.PULSE),
    "flag": Event("flag", Scope.EXTERNAL, EventMemory.LATCHED),
    "kept": Event("kept", Scope.EXTERNAL, EventMemory.LATCHED, EarlyEvent.KEEP),
    "seen": Event("seen", Scope.INTERNAL, by="p0"),
}
VARIABLES = {"b": Variable("b", VariableType.BOOL, False), "n": Variable("n", VariableType.INT, 0)}


@st.composite
def primitive_tasks(draw: st.DrawFn) -> dict[str, PrimitiveTask]:
    """Three primitive tasks with one or two of three actions."""
    return {
        f"p{i}": PrimitiveTask(
            f"p{i}",
            "goal",
            tuple(draw(st.lists(st.sampled_from("xyz"), min_size=1, max_size=2, unique=True))),
            draw(st.sampled_from((0.5, 2.0, 10.0))),
            start=draw(st.sampled_from((Start.WHEN_FREE, Start.WHEN_FREE, Start.AT_ONCE))),
        )
        for i in range(3)
    }


@st.composite
def place_tables(draw: st.DrawFn) -> dict[str, Place]:
    """Action places a0.., and resource and control places c0.."""
    places: dict[str, Place] = {}
    for i in range(draw(st.integers(1, 3))):
        servers = draw(st.sampled_from((None, None, 1, 2)))
        args = {"v": Reference("n")} if draw(st.booleans()) else {}
        out = {"v": draw(st.sampled_from(("b", "n")))} if draw(st.booleans()) else {}
        tokens = draw(st.integers(0, 1))
        task = draw(st.sampled_from(("p0", "p1", "p2")))
        capacity = draw(st.sampled_from((None, None, 2)))
        places[f"a{i}"] = Place(f"a{i}", Kind.ACTION, tokens, capacity, task, args, out, servers)
    for i in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from((Kind.CONTROL, Kind.RESOURCE)))
        places[f"c{i}"] = Place(
            f"c{i}", kind, draw(st.integers(0, 2)), draw(st.sampled_from((None, None, 3)))
        )
    return places


@st.composite
def inputs(draw: st.DrawFn, places: Mapping[str, Place]) -> tuple[Input, ...]:
    """Arcs from one to three places."""
    arcs = []
    for name in draw(
        st.lists(st.sampled_from(sorted(places)), min_size=1, max_size=3, unique=True)
    ):
        weight = draw(st.sampled_from((1, 1, 1, 2)))
        if places[name].kind is not Kind.ACTION:
            arcs.append(Input(name, weight))
            continue
        end = draw(st.sampled_from((End.NORMAL, End.NORMAL, End.ERROR, End.PREEMPT, End.GOING)))
        counts = draw(st.sampled_from(list(Counts))) if end is End.PREEMPT else None
        arcs.append(Input(name, weight if places[name].servers else 1, end, counts))
    return tuple(arcs)


@st.composite
def transitions(draw: st.DrawFn, name: str, places: Mapping[str, Place]) -> Transition:
    """A transition with arcs, event or time, condition, priority and weight."""
    names = sorted(places)
    out = draw(st.lists(st.sampled_from(names), max_size=2, unique=True))
    bars = draw(st.lists(st.sampled_from(names), max_size=1))
    events = draw(
        st.sampled_from(((), (), ("tick",), ("flag",), ("kept",), ("seen",), ("tick", "flag")))
    )
    return Transition(
        name,
        draw(inputs(places)),
        tuple(Output(o, draw(st.sampled_from((1, 1, 2)))) for o in out),
        tuple(Inhibitor(b, draw(st.integers(1, 3))) for b in bars),
        events,
        parse(c) if (c := draw(st.sampled_from((None, None, None, *CONDITIONS)))) else None,
        draw(st.integers(0, 1)),
        draw(st.sampled_from((None, None, 1.0, 3.0))),
        draw(st.sampled_from((None, None, 1.5))) if not events else None,
    )


@st.composite
def tasks(draw: st.DrawFn) -> Task:
    """A consistent task; it need not be a good one."""
    places = draw(place_tables())
    made = {f"t{i}": draw(transitions(f"t{i}", places)) for i in range(draw(st.integers(1, 6)))}
    final = parse(draw(st.sampled_from(("1 == 2", "c0 == 0", "a0 == 0 and c0 > 1"))))
    task = Task(
        "random", places, made, draw(primitive_tasks()), final, events=EVENTS, variables=VARIABLES
    )
    assert faults(task) == ()
    return task


class Journal:
    """Feeds an engine and checks after every stimulus what must always hold."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.engine = Engine(task, DEVICES, Policy(firing_limit=40))
        self.state = self.engine.initial()
        self.marking = self.state.marking
        self.seen: Counter[tuple[str, str]] = Counter()
        self.open: dict[str, Choose] = {}
        self.timers: list[str] = []

    def feed(self, stimulus: Stimulus) -> None:
        """Handle a stimulus and check everything."""
        before = to_plain(self.state)
        state, instructions = self.engine.handle(self.state, stimulus)
        assert to_plain(self.state) == before, "the old state is untouched"
        again = stimulus_from_plain(json.loads(json.dumps(to_plain(stimulus))))
        assert again == stimulus and self.engine.handle(self.state, again) == (
            state,
            instructions,
        ), "deterministic"
        self.state = state
        for instruction in instructions:
            self._project(instruction)
            self._count(instruction)
        assert self.state.marking == self.marking
        self._whole(state)

    def _project(self, instruction: Instruction) -> None:
        net = self.task.net
        if isinstance(instruction, Fired):
            assert instruction.before == self.marking
            self.marking = net.fire(self.marking, net.transition_index[instruction.transition])
            assert instruction.after == self.marking
        if isinstance(instruction, Marked):
            assert (
                instruction.before == self.marking
                and self.task.places[instruction.place].kind is Kind.CONTROL
            )
            changed = [
                i
                for i, (a, b) in enumerate(zip(self.marking, instruction.after, strict=True))
                if a != b
            ]
            assert changed == [net.place_index[instruction.place]] and min(instruction.after) >= 0
            self.marking = instruction.after

    def _count(self, instruction: Instruction) -> None:
        if isinstance(instruction, StartRun | RunRecorded | CancelRun):
            key = (type(instruction).__name__, instruction.run)
            self.seen[key] += 1
            assert self.seen[key] == 1, f"{key} twice"
            if (
                not isinstance(instruction, StartRun)
                and getattr(instruction, "cause", "") != "device_fenced"
            ):
                assert self.seen["StartRun", instruction.run] == 1, "only what was started ends"
        if isinstance(instruction, Choose):
            self.open[instruction.key] = instruction
        if isinstance(instruction, ArmTimer):
            self.timers.append(instruction.key)
        if isinstance(instruction, Finished):
            self.seen["Finished", ""] += 1
            assert self.seen["Finished", ""] == 1

    def _whole(self, state: State) -> None:
        net = self.task.net
        if state.mode in (Mode.RUNNING, Mode.PAUSED, Mode.STEPPING):
            for name, place in self.task.places.items():
                if place.kind is Kind.ACTION:
                    runs = state.tokens.get(name, ())
                    assert len(runs) == state.marking[net.place_index[name]], "one token, one run"
                    going = [r for r in runs if r.phase in ACTIVE] + [
                        r for r in state.stopping.values() if r.place == name
                    ]
                    stuck = sum(r.phase == "stuck" for r in going)
                    assert len(going) - stuck <= place.most_active
        if state.mode is Mode.RUNNING and state.suspended is None:
            draft = Draft(self.engine.compiled, state)
            left = [x.name for x in draft.compiled.transitions if match(draft, x, "")]
            assert not left, "the engine examines again what a change can make fireable"
        holders = [r for r in state.runs() if r.phase in ACTIVE and r.device and not r.at_once]
        holders += [r for r in state.stopping.values() if r.device and not r.at_once]
        assert max(Counter(r.device for r in holders).values(), default=0) <= 1, (
            "one device, one run"
        )

    def stimuli(self) -> list[Stimulus]:
        """Draw stimuli that could arrive now: mostly answers to orders, and some invalid ones."""
        runs = [r for r in self.state.runs() if r.phase in ACTIVE]
        found: list[Stimulus] = [
            RunEnded("a0#99", Status.SUCCESS),
            StopConfirmed("a0#98"),
            TimerFired("t0#77"),
        ]
        for r in runs:
            found += [
                RunEnded(r.id, s, "lost", values={"v": v}) for s in Status for v in (True, 2, None)
            ]
            found += [RunEnded(r.id, Status.SUCCESS, values={"v": v}) for v in (2.5, "left")]
            found.append(RunEnded(r.id, Status.ERROR, "", executed=Executed.NO))
            found += [
                RunRaised(r.id, "seen"),
                RunStarted(r.id),
                RunHeld(r.id, Hold.HELD),
                RunHeld(r.id, Hold.CANNOT),
            ]
            found += [RunEnded(r.id, Status.SUCCESS, deferred=True), Verdict(r.id, Status.FAILURE)]
        for run_id in self.state.stopping:
            found += [StopConfirmed(run_id), RunEnded(run_id, Status.FAILURE), StopFailed(run_id)]
            found += [StopConfirmed(run_id, Executed.NO)]
        found += [
            Chosen(c.key, a) for c in self.open.values() for a in (*c.alternatives, "wrong")
        ] * 2
        found += [TimerFired(key) for key in self.timers[-4:]]
        found += [EventOccurred(e) for e in ("tick", "flag", "kept", "seen", "odd")] * 2
        found += [EventOccurred("flag", "gate", n) for n in (1, 2)]
        return found

    def commands(self) -> list[Stimulus]:
        """Draw commands of the operator, and changes of the global memory."""
        found: list[Stimulus] = [
            Pause(),
            Resume(),
            Resume(),
            Step(),
            Step(),
            SetBreakpoints(),
            RaiseEvent("tick"),
        ]
        found += [
            AddTokens("c0"),
            RemoveTokens("c0"),
            AddTokens("a0"),
            SetBreakpoints(("t0", "a0")),
            Override("a0", "do_a0"),
            ForceExit("t0"),
        ]
        found += [
            ForceExit("t1"),
            VariableChanged("b", True),
            VariableChanged("b", False),
            VariableChanged("b", "odd"),
        ]
        return found + [VariableChanged("n", n) for n in (0, 1, 3)] + [Abort("enough")]


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(tasks(), st.data())
def test_any_stimuli_on_any_task(task: Task, data: st.DataObject) -> None:
    play_anything(task, data)


@pytest.mark.proof
@settings(max_examples=5000, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(tasks(), st.data())
def test_any_stimuli_on_any_task_at_length(task: Task, data: st.DataObject) -> None:
    play_anything(task, data)


def play_anything(task: Task, data: st.DataObject) -> None:
    """Begin, then handle up to 25 stimuli drawn from those that could arrive."""
    journal = Journal(task)
    journal.feed(Begin({}, {"n": 1}))
    for _ in range(data.draw(st.integers(0, 25))):
        possible = journal.stimuli() if data.draw(st.integers(0, 4)) else journal.commands()
        journal.feed(data.draw(st.sampled_from(possible)))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(tasks(), st.data())
def test_what_check_calls_decided_is_never_left_undecided(task: Task, data: st.DataObject) -> None:
    play_without_operator(task, data)


@pytest.mark.proof
@settings(max_examples=5000, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(tasks(), st.data())
def test_what_check_calls_decided_is_never_left_undecided_at_length(
    task: Task, data: st.DataObject
) -> None:
    play_without_operator(task, data)


def play_without_operator(task: Task, data: st.DataObject) -> None:
    """Play stimuli of the world only: during a pause, stimuli collect that would otherwise never
    come together. What can never end does not end, and never can again."""
    unsettled = any(f.code == "unsettled-conflict" for f in check(task).findings)
    engine = Engine(task, DEVICES, Policy(firing_limit=40))
    journal = Journal(task)
    state, instructions = engine.handle(engine.initial(), Begin({}, {"n": 1}))
    for _ in range(data.draw(st.integers(0, 20))):
        if not unsettled:
            assert not [i for i in instructions if isinstance(i, Report) and i.key == "undecided"]
        journal.state = state
        journal.open |= {i.key: i for i in instructions if isinstance(i, Choose)}
        journal.timers += [i.key for i in instructions if isinstance(i, ArmTimer)]
        world: list[Stimulus] = [
            VariableChanged("b", True),
            VariableChanged("b", False),
            VariableChanged("n", 1),
        ]
        never = not engine.can_end(state)
        stimulus = data.draw(st.sampled_from(journal.stimuli() + world))
        state, instructions = engine.handle(state, stimulus)
        ends = [i.reason for i in instructions if isinstance(i, Finished)]
        assert not (never and any(end.startswith(("final", "given up")) for end in ends))
        assert not (never and state.mode is Mode.RUNNING and engine.can_end(state))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(tasks())
def test_written_tasks_read_back_equal(task: Task) -> None:
    text = dumps(task)
    assert loads(text) == task and dumps(loads(text)) == text


TEXTS = st.text(st.characters(codec="utf-8"), max_size=8)
PLAIN: st.SearchStrategy[Any] = st.recursive(
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | TEXTS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=60, deadline=None)
@given(
    TEXTS,
    st.dictionaries(st.sampled_from("uvw"), PLAIN, max_size=3),
    st.dictionaries(TEXTS, PLAIN, max_size=3),
)
def test_any_words_and_plain_values_survive_the_file(
    text: str, parameters: dict[str, Any], args: dict[str, Any]
) -> None:
    argument_is_reference = any(
        isinstance(v, dict) and set(v) == {"var"} and isinstance(v["var"], str)
        for v in args.values()
    )
    places = {"a": Place("a", Kind.ACTION, task="p", args=args, label=text)}
    task = Task(
        "t",
        places,
        {},
        {"p": PrimitiveTask("p", f"goal {text}", ("do",), 1.0)},
        parse("a == 0"),
        text=text,
        parameters=parameters,
    )
    if not argument_is_reference:
        assert loads(dumps(task)) == task
