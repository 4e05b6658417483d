"""The sets of a task's places, transitions and markings that the verdicts need.

Its ordinary net is `Task.net` (docs/semantics.md, section 8).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from itertools import combinations

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.coordinator.analysis.net.space import BLOCK
from petrobot.coordinator.analysis.net.structure import (
    exclusive_places,
    place_bounds,
    place_semiflows,
)
from petrobot.coordinator.task import End, Kind, Task
from petrobot.coordinator.task.conditions import Expression
from petrobot.coordinator.task.net import Marking


class OrdinaryView(Struct, frozen=True, dict=True):
    """Sets of places, transitions and markings of a task's ordinary net."""

    task: Task

    def _holds(self, predicate: Expression | None, marking: Marking) -> bool:
        return predicate is not None and predicate.holds(
            dict(zip(self.task.net.places, marking, strict=False))
        )

    def is_final(self, marking: Marking) -> bool:
        """Whether the task has ended as designed (further entries of the marking are ignored)."""
        return self._holds(self.task.flat.final, marking)

    def is_final_error(self, marking: Marking) -> bool:
        """Whether the task has given up as designed (further entries are ignored)."""
        return self._holds(self.task.flat.final_error, marking)

    def is_end(self, marking: Marking) -> bool:
        """Whether a dead marking is a designed end of either kind."""
        return self.is_final(marking) or self.is_final_error(marking)

    def where(
        self,
        predicate: Expression | None,
        held: Callable[[int, slice], NDArray[np.int64]],
        markings: int,
    ) -> NDArray[np.bool_]:
        """Return in which of `markings` markings a predicate holds; `held`: the tokens of a place
        in some of them.

        It is evaluated once in each block for each combination of tokens of the places that it
        reads: a task has few of these and up to millions of markings.
        """
        if predicate is None or not predicate.names:
            return np.full(markings, self._holds(predicate, ()))
        names = sorted(predicate.names)
        holds = np.zeros(markings, dtype=np.bool_)
        for start in range(0, markings, BLOCK):
            at = slice(start, start + BLOCK)
            read = np.array([held(self.task.net.place_index[name], at) for name in names])
            found, which = np.unique(read, axis=1, return_inverse=True)
            values = (dict(zip(names, column, strict=True)) for column in found.T.tolist())
            holds[at] = np.array([predicate.holds(some) for some in values])[which.reshape(-1)]
        return holds

    @cached_property
    def error_places(self) -> tuple[int, ...]:
        """Places that only error branches mark, without counters that nothing reads: their tokens
        stay, and change nothing."""
        flat, net = self.task.flat, self.task.net
        read = {net.places[p] for arcs in (*net.consume, *net.inhibit) for p, _ in arcs}
        for end in (flat.final, flat.final_error):
            read |= end.names if end is not None else set()
        names = flat.error_elements & read
        return tuple(i for i, name in enumerate(net.places) if name in names)

    def is_nominal(self, marking: Marking) -> bool:
        """G: no place of an error branch is marked. (No run is ever stopping here: the ordinary net
        has no such state.)"""
        return not any(marking[p] for p in self.error_places)

    @cached_property
    def error_exits(self) -> frozenset[str]:
        """Transitions that take a run which ended with ERROR, or that the task declares as an error
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


def contended(task: Task, devices: Mapping[str, str]) -> frozenset[str]:
    """Return the devices for which runs may have to wait for each other: the place invariants
    exclude neither that several runs of one place are active, nor that two places are marked
    together. `devices` gives the device of each action that has one."""
    if not devices:
        return frozenset()
    flat, net = task.flat, task.flat.net
    flows = place_semiflows(net)
    users: dict[str, list[int]] = {}
    for place, bound in zip(flat.places.values(), place_bounds(net, flows), strict=True):
        if place.kind is Kind.ACTION:
            used = {devices.get(a, "") for a in task.primitive_task_of(place.name).alternatives}
            most = place.most_active if bound is None else min(bound, place.most_active)
            for device in used - {""}:
                users.setdefault(device, []).extend([net.place_index[place.name]] * most)
    never = exclusive_places(net, flows)
    return frozenset(
        device
        for device, places in users.items()
        if any(pair not in never for pair in combinations(sorted(places), 2))
    )
