"""Small nets in a short notation, and a player that feeds them stimuli and remembers what came
out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
from msgspec.structs import replace

from petrobot.coordinator.engine import (
    Begin,
    Engine,
    Finished,
    Fired,
    Instruction,
    Policy,
    Report,
    StartRun,
    State,
    Stimulus,
)
from petrobot.coordinator.task import (
    EarlyEvent,
    Event,
    EventMemory,
    Input,
    Kind,
    Place,
    PrimitiveTask,
    Scope,
    Start,
    Task,
    Transition,
    Value,
    Variable,
    VariableType,
)
from petrobot.coordinator.task.conditions import parse
from petrobot.coordinator.task.file.reading import read_input, read_output


def make_task(
    places: str,
    transitions: Mapping[str, Mapping[str, Any]],
    events: str = "",
    variables: Mapping[str, Value] | None = None,
    values: Mapping[str, tuple[str, ...]] | None = None,
    alternatives: Mapping[str, tuple[str, ...]] | None = None,
    args: Mapping[str, Mapping[str, Value]] | None = None,
    out: Mapping[str, Mapping[str, str]] | None = None,
    at_once: tuple[str, ...] = (),
    **rest: Any,
) -> Task:
    """A task from words.

    Places: `a!` action, `a!2` action with 2 servers, `r~` resource, `p.` plain, `c` control; `=N`
    tokens, `/N` capacity. Each action place x runs the primitive task x with the action do_x.
    Events: `e` pulse, `e*` latched, `e+` latched and kept, `e<x` internal to x.
    """
    read_places = {p.name: p for p in map(_place, places.split())}
    for name, mapping in (args or {}).items():
        read_places[name] = replace(read_places[name], args=mapping)
    for name, results in (out or {}).items():
        read_places[name] = replace(read_places[name], out=results)
    primitives = {
        p.task: PrimitiveTask(
            p.task,
            "goal",
            (alternatives or {}).get(p.task, (f"do_{p.task}",)),
            10.0,
            start=Start.AT_ONCE if p.task in at_once else Start.WHEN_FREE,
        )
        for p in read_places.values()
        if p.kind is Kind.ACTION
    }
    return Task(
        name="net",
        places=read_places,
        transitions={n: _transition(n, t) for n, t in transitions.items()},
        primitive_tasks=primitives,
        final=parse(rest.pop("final", "1 == 2")),
        events={e.name: e for e in map(_event, events.split())},
        variables={
            n: Variable(n, VariableType.of(v), v, (values or {}).get(n, ()))
            for n, v in (variables or {}).items()
        },
        **rest,
    )


def _place(word: str) -> Place:
    word, _, room = word.partition("/")
    name, _, tokens = word.partition("=")
    if "!" in name:
        name, _, servers = name.partition("!")
        capacity, k = int(room) if room else None, int(servers) if servers else None
        return Place(name, Kind.ACTION, int(tokens or 0), capacity, task=name, servers=k)
    kind = {"~": Kind.RESOURCE, ".": Kind.PLAIN}.get(name[-1], Kind.CONTROL)
    return Place(name.rstrip("~."), kind, int(tokens or 0), int(room) if room else None)


def _event(word: str) -> Event:
    if "<" in word:
        name, _, by = word.partition("<")
        return Event(name, Scope.INTERNAL, by=by)
    memory = EventMemory.PULSE if word.isidentifier() else EventMemory.LATCHED
    return Event(
        word.rstrip("*+"),
        Scope.EXTERNAL,
        memory,
        EarlyEvent.KEEP if word.endswith("+") else EarlyEvent.DROP,
    )


def _transition(name: str, given: Mapping[str, Any]) -> Transition:
    fields = dict(given)
    arcs = [read_input(a) for a in fields.pop("in", "").split()]
    events = fields.pop("event", "").split()
    when = fields.pop("when", None)
    return Transition(
        name,
        inputs=tuple(a for a in arcs if isinstance(a, Input)),
        inhibitors=tuple(a for a in arcs if not isinstance(a, Input)),
        outputs=tuple(read_output(a) for a in fields.pop("out", "").split()),
        events=tuple(events),
        when=parse(when) if when else None,
        **fields,
    )


class Play:
    """A mission run being played. Calling it handles stimuli and gives the instructions of the last
    one."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.state: State = engine.initial()
        self.all: list[Instruction] = []

    def __call__(self, *stimuli: Stimulus) -> list[Instruction]:
        last: tuple[Instruction, ...] = ()
        for stimulus in stimuli:
            self.state, last = self.engine.handle(self.state, stimulus)
            self.all += last
        return list(last)

    @property
    def marked(self) -> dict[str, int]:
        """Tokens by marked place."""
        names = self.engine.compiled.net.places
        return {n: k for n, k in zip(names, self.state.marking, strict=True) if k}

    @property
    def fired(self) -> list[str]:
        """Transitions fired so far."""
        return [i.transition for i in self.all if isinstance(i, Fired)]

    @property
    def started(self) -> list[str]:
        """Runs started so far."""
        return [i.run for i in self.all if isinstance(i, StartRun)]

    @property
    def reports(self) -> list[str]:
        """Keys of all reports so far, but for that of a dead marking, in which most small nets
        end."""
        return [i.key for i in self.all if isinstance(i, Report) and i.key != "dead"]

    @property
    def finished(self) -> Finished | None:
        """The end, if it has come."""
        return next((i for i in self.all if isinstance(i, Finished)), None)

    def of(self, kind: type) -> list[Any]:
        """All instructions of a kind so far."""
        return [i for i in self.all if isinstance(i, kind)]


@pytest.fixture
def task() -> Callable[..., Task]:
    """Makes tasks from words."""
    return make_task


@pytest.fixture
def play() -> Callable[..., Play]:
    """Makes a task from words and begins it (`begin=False`: not yet)."""

    def begin(
        *args: Any,
        devices: Mapping[str, str] | None = None,
        policy: Policy | None = None,
        begin: bool = True,
        **kwargs: Any,
    ) -> Play:
        player = Play(
            Engine(make_task(*args, **kwargs), devices, policy or Policy(end_when_dead=False))
        )
        if begin:
            player(Begin())
        return player

    return begin
