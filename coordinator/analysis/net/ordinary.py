"""The ordinary view of a task: its net with the sets that the qualitative verdicts need, and the
net closed by a refill.

The net is `Task.net` (docs/semantics.md, section 8). A task ends, so liveness and properness are
judged on the closed net: in exactly the final markings *refill* puts the initial marking back; in
the markings of `final_error`, an honest end with something out of order, *repair* does so, which
stands for a person who mends it and starts again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from petrobot.coordinator.analysis.net.robot import Roles
from petrobot.coordinator.analysis.net.space import Space
from petrobot.coordinator.task import End, Kind, Task
from petrobot.coordinator.task.conditions import Expression
from petrobot.coordinator.task.net import Arcs, Marking, Net

REFILL, REPAIR = "refill", "repair"
CLOSINGS = 1_000
"""Final markings that a net is closed from at most."""


@dataclass(frozen=True)
class OrdinaryView:
    """A task as an ordinary net. With `operator`, control places that declare a capacity can be
    filled and emptied."""

    task: Task
    operator: bool = False

    @cached_property
    def net(self) -> Net:
        """The ordinary net, with `put.PLACE` and `take.PLACE` for the operator's hand if asked
        for."""
        net = self.task.net
        return _with_operator(net, self._open_to_operator) if self.operator else net

    @cached_property
    def _open_to_operator(self) -> tuple[int, ...]:
        places = self.task.flat.places.values()
        return tuple(
            i for i, p in enumerate(places) if p.kind is Kind.CONTROL and p.capacity is not None
        )

    def _holds(self, predicate: Expression | None, marking: Marking) -> bool:
        return predicate is not None and predicate.holds(
            dict(zip(self.task.net.places, marking, strict=False))
        )

    def is_final(self, marking: Marking) -> bool:
        """Whether the task has ended as designed (further entries of the marking are ignored)."""
        return self._holds(self.task.flat.final, marking)

    def is_final_error(self, marking: Marking) -> bool:
        """Whether the task has given up honestly."""
        return self._holds(self.task.flat.final_error, marking)

    def is_end(self, marking: Marking) -> bool:
        """Whether a dead marking is a designed end of either kind."""
        return self.is_final(marking) or self.is_final_error(marking)

    @cached_property
    def error_places(self) -> tuple[int, ...]:
        """Places that only error branches mark."""
        names = self.task.flat.error_elements
        return tuple(i for i, name in enumerate(self.task.net.places) if name in names)

    def is_nominal(self, marking: Marking) -> bool:
        """G: no place of an error branch is marked. (No run is ever stopping here: the ordinary net
        has no such state.)"""
        return not any(marking[p] for p in self.error_places)

    @cached_property
    def error_exits(self) -> frozenset[str]:
        """Transitions that take a run which ended with ERROR, or that are said to begin an error
        branch."""
        transitions = self.task.flat.transitions.values()
        return frozenset(t.name for t in transitions if any(a.end is End.ERROR for a in t.inputs))

    @cached_property
    def starts(self) -> dict[str, frozenset[str]]:
        """By action place, the transitions that start a run there."""
        flat = self.task.flat
        return {
            p.name: frozenset(
                t.name
                for t in flat.transitions.values()
                if any(o.place == p.name for o in t.outputs)
            )
            for p in flat.places.values()
            if p.kind is Kind.ACTION
        }

    @cached_property
    def controllable(self) -> frozenset[str]:
        """T_c: transitions that begin runs from resources and control places alone, and the
        operator's hand."""
        flat = self.task.flat
        starting = frozenset().union(*self.starts.values())
        kinds = {p.name: p.kind for p in flat.places.values()}
        free = {
            t.name
            for t in flat.transitions.values()
            if t.name in starting and not any(kinds[a.place] is Kind.ACTION for a in t.inputs)
        }
        operator = set(self.net.transitions) - set(self.task.net.transitions)
        return frozenset(free | operator)

    def roles(self, closed: Net) -> Roles:
        """The parts that transitions and markings play in the closed net."""
        runs, net = self.task.runs_place, self.task.net
        place = net.place_index[runs] if runs else -1
        takes = frozenset(
            name
            for t, name in enumerate(net.transitions)
            if dict(net.consume[t]).get(place, 0) > dict(net.produce[t]).get(place, 0)
        )
        return Roles(
            self.is_nominal,
            self.error_exits,
            self.controllable,
            self.starts,
            takes,
            frozenset(self.task.goal_transitions),
            frozenset(closed.transitions) - frozenset(self.net.transitions),
        )

    def closed(self, space: Space) -> Net:
        """The net closed by refill and repair, from the complete space of the open one. Raises
        ValueError if it cannot be."""
        if not space.complete:
            raise ValueError(
                f"the closed net needs all final markings; the search stopped: {space.reason}"
            )
        ends = [
            (kind, space.marking(int(i)))
            for kind, predicate in ((REFILL, self.is_final), (REPAIR, self._only_final_error))
            for i in np.flatnonzero(space.where(predicate))
        ]
        if not ends:
            raise ValueError(
                "no final marking is reachable, so there is nothing to close the net from"
            )
        if len(ends) > CLOSINGS:
            raise ValueError(
                f"{len(ends)} final markings are reachable; at most {CLOSINGS} can be "
                "closed: narrow `final`"
            )
        return closed_net(self.net, ends)

    def _only_final_error(self, marking: Marking) -> bool:
        return self.is_final_error(marking) and not self.is_final(marking)


def closed_net(net: Net, ends: list[tuple[str, Marking]]) -> Net:
    """The net with one transition (a name and the exact marking it fires in) for each end, leading
    to the initial marking."""
    names = list(_numbered([name for name, _ in ends], set(net.transitions)))
    start: Arcs = tuple((p, n) for p, n in enumerate(net.initial) if n)
    exact = [
        (
            tuple((p, n) for p, n in enumerate(end) if n),
            tuple((p, n + 1) for p, n in enumerate(end)),
        )
        for _, end in ends
    ]
    return replace(
        net,
        transitions=(*net.transitions, *names),
        consume=(*net.consume, *(need for need, _ in exact)),
        produce=(*net.produce, *(start for _ in ends)),
        inhibit=(*net.inhibit, *(below for _, below in exact)),
        priority=(*net.priority, *(0 for _ in ends)),
    )


def _numbered(names: list[str], taken: set[str]) -> Iterator[str]:
    """The names, with a number behind those that stand there more than once or are taken."""
    many = {name for name in names if names.count(name) > 1 or name in taken}
    for i, name in enumerate(names, 1):
        yield f"{name} {i}" if name in many else name


def _with_operator(net: Net, places: tuple[int, ...]) -> Net:
    count = len(places)
    return replace(
        net,
        transitions=(
            *net.transitions,
            *(f"put.{net.places[p]}" for p in places),
            *(f"take.{net.places[p]}" for p in places),
        ),
        consume=(*net.consume, *(() for _ in places), *(((p, 1),) for p in places)),
        produce=(*net.produce, *(((p, 1),) for p in places), *(() for _ in places)),
        inhibit=(*net.inhibit, *(() for _ in range(2 * count))),
        priority=(*net.priority, *(0 for _ in range(2 * count))),
    )
