"""The robotic task model: a whole task as an immutable record, its flat form and its ordinary net.

A task is one interpreted Petri net (paper, sections 2 and 5) together with what its places and
transitions mean. `Task.net` is its ordinary net (docs/semantics.md, section 8): events, conditions,
priorities, weights and times dropped.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

from msgspec import Struct, field

from petrobot.coordinator.task.conditions import Expression
from petrobot.coordinator.task.elements import (
    End,
    Event,
    Input,
    Output,
    Place,
    PrimitiveTask,
    Subnet,
    Transition,
    Value,
    Variable,
)
from petrobot.coordinator.task.expansion import counters, expand
from petrobot.coordinator.task.net import Net


class Task(Struct, frozen=True, dict=True, eq=False):
    """A whole robot task. It never changes; `flat` and `net` are computed once."""

    name: str
    places: Mapping[str, Place]
    transitions: Mapping[str, Transition]
    primitive_tasks: Mapping[str, PrimitiveTask]
    final: Expression
    """Condition on the marking (names are places) under which the task has ended as designed."""
    final_error: Expression | None = None
    """Condition on the marking under which the task ends in ERROR, as designed."""
    goal: str = ""
    """When the task has met its specification, as a sentence for people."""
    goal_transitions: tuple[str, ...] = ()
    """Transitions whose firing means one met goal (R_goal of the forecasts)."""
    runs_place: str = ""
    """Control place whose tokens are the runs that are left to do."""
    parameters: Mapping[str, Value] = field(default_factory=dict)
    """Names and default values of what a user sets for a run. They are read like variables and
    never written."""
    variables: Mapping[str, Variable] = field(default_factory=dict)
    events: Mapping[str, Event] = field(default_factory=dict)
    subnets: Mapping[str, Subnet] = field(default_factory=dict)
    prepare: str = ""
    """Service that is called with the parameters before a mission run; empty: none is called."""
    score: str = ""
    """Service that is called at the end and returns the task's own results; empty: none."""
    text: str = ""
    pictures: str = ""
    """Function ("module:function") that draws pictures of a result for the report, as SVG by title;
    empty: none."""
    services: str = ""
    """Location file that the task is usually run with, relative to the task's own file; empty: the
    one that the command finds."""
    errors_to: str = ""
    """Place that receives the errors of action places without an `error` arc; empty: none."""
    held: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Of a flat task: the resources that a token in each place stands for, as `holds` said."""
    expansion: Task | None = None
    """The flat task as a journal recorded it, which is what ran; None: `expand` makes it."""
    is_flat: bool = False
    """Whether the task was read as a flat one: nothing in it is written in short."""

    def __eq__(self, other: object) -> bool:
        """Two tasks are equal if they say the same, in whatever form they were written."""
        return isinstance(other, Task) and all(
            getattr(self, name) == getattr(other, name)
            for name in self.__struct_fields__
            if name not in ("held", "expansion", "is_flat")
        )

    __hash__ = None  # type: ignore[assignment]

    @cached_property
    def flat(self) -> Task:
        """The task with all that is written in short expanded; itself if nothing is."""
        return self if self.is_flat else self.expansion or expand(self)

    @cached_property
    def net(self) -> Net:
        """The ordinary net of the flat task: places, arcs, inhibitors, capacities and initial
        marking.

        Priorities are left out on purpose. They decide conflicts among transitions whose events
        have occurred; as priorities of the ordinary net they would forbid firings that do happen.
        """
        flat = self.flat
        return Net.build(
            {p.name: p.tokens for p in flat.places.values()},
            {t.name: (_weights(t.inputs), _produced(t)) for t in flat.transitions.values()},
            inhibitors={
                t.name: {i.place: i.threshold for i in t.inhibitors}
                for t in flat.transitions.values()
            },
            capacity={p.name: p.capacity for p in flat.places.values() if p.capacity is not None},
            counters=counters(flat.places),
        )

    @cached_property
    def exits(self) -> Mapping[tuple[str, End], tuple[Transition, ...]]:
        """The transitions that take a token of an action place, by place and end of the run."""
        found: dict[tuple[str, End], dict[str, Transition]] = {}
        for transition in self.transitions.values():
            for arc in transition.inputs:
                if arc.end is not None:
                    found.setdefault((arc.place, arc.end), {})[transition.name] = transition
        return {key: tuple(ways.values()) for key, ways in found.items()}

    @cached_property
    def error_elements(self) -> frozenset[str]:
        """Names of the places and transitions that only error branches reach, with macro places as
        they are."""
        others: dict[str, int] = {}
        """By place: how many transitions feed it that are not known to be of an error branch."""
        takers: dict[str, list[Transition]] = {}
        for transition in self.transitions.values():
            for place in {o.place for o in transition.outputs}:
                others[place] = others.get(place, 0) + 1
            for place in {i.place for i in transition.inputs}:
                takers.setdefault(place, []).append(transition)
        places: set[str] = set()
        transitions: set[str] = set()
        new = [
            t
            for t in self.transitions.values()
            if t.error_branch or any(i.end is End.ERROR for i in t.inputs)
        ]
        # Each transition is looked at once: large nets are shown while a mission is active.
        while new:
            transition = new.pop()
            if transition.name in transitions:
                continue
            transitions.add(transition.name)
            for place in {o.place for o in transition.outputs}:
                others[place] -= 1
                if not others[place] and place in self.places and not self.places[place].tokens:
                    places.add(place)
                    new += takers.get(place, ())
        return frozenset(places | transitions)

    def in_short(self, place: Place) -> str:
        """Return what the short forms of a place of the file declare: a drawing writes it instead
        of the elements that they make."""
        inside = [r for r in self._held_inside(place) if r not in place.holds]
        parts = (
            f"{place.tries} tries" if place.tries > 1 else "",
            f"{place.timeout:g} s" if place.timeout is not None else "",
            f"holds {', '.join(place.holds)}" if place.holds else "",
            f"holds {', '.join(inside)} inside" if inside else "",
            "listens" if place.listen else "",
        )
        return ", ".join(filter(None, parts))

    def _held_inside(self, macro: Place) -> list[str]:
        """Return the resources around a macro place that places of its subnet hold."""
        if not macro.subnet:
            return []
        places = self.subnets[macro.subnet].places
        held = (r for p in places.values() for r in (*p.holds, *self._held_inside(p)))
        return [macro.args.get(r, r) for r in dict.fromkeys(held) if r not in places]

    def primitive_task_of(self, place: str) -> PrimitiveTask:
        """Return the primitive task of an action place of the flat task. Raises KeyError."""
        return self.primitive_tasks[self.flat.places[place].task]

    def longest_run(self, place: str) -> float:
        """Return after how many seconds a run in an action place of the flat task is ended: by the
        deadline of its primitive task, or by the place's shorter `timeout`."""
        timeout = self.flat.places[place].timeout
        deadline = self.primitive_task_of(place).deadline
        return deadline if timeout is None else min(deadline, timeout)

    def initial_variables(self) -> dict[str, Value]:
        """Return variables and parameters before a mission run begins."""
        return {v.name: v.initial for v in self.variables.values()} | dict(self.parameters)


def _weights(arcs: tuple[Input, ...] | tuple[Output, ...]) -> dict[str, int]:
    return {a.place: a.weight for a in arcs}


def _produced(transition: Transition) -> dict[str, int]:
    """Return what a transition produces: outputs, and the tokens that `going` arcs only test."""
    produced = _weights(transition.outputs)
    for arc in transition.inputs:
        if arc.end is End.GOING:
            produced[arc.place] = produced.get(arc.place, 0) + arc.weight
    return produced
