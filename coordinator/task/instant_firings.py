"""Firings that wait for nothing: whether a task can fire for ever without time passing."""

from __future__ import annotations

from petrobot.coordinator.task.elements import End, Transition
from petrobot.coordinator.task.model import Task


def is_timeless(t: Transition) -> bool:
    """Whether the transition waits neither for an event nor for a time nor for the end of a run."""
    return (
        not t.events
        and t.after is None
        and not any(a.end in (End.NORMAL, End.ERROR) for a in t.inputs)
    )


def endless(task: Task) -> set[str]:
    """Return the transitions of a flat task that might fire for ever without time passing; if there
    are none, every such sequence ends.

    Of the transitions that wait for nothing, those are dropped again and again that drain a place
    which no other of them fills, or that fill a place which inhibits them and which no other of
    them drains: they can fire only finitely often. What none of them changes stays as it is, so
    they are judged once with those that need k tokens there, and once with those that k tokens
    inhibit. The others may fire for ever.
    """
    net = task.net
    changes = dict(zip(net.transitions, net.compiled.changes, strict=True))
    needs = dict(zip(net.transitions, map(dict, net.compiled.needs), strict=True))
    barred = dict(zip(net.transitions, map(dict, net.inhibit), strict=True))

    def repeatable(loose: set[str]) -> set[str]:
        while True:
            filled = {p for t in loose for p, change in changes[t] if change > 0}
            drained = {p for t in loose for p, change in changes[t] if change < 0}
            finite = {
                t
                for t in loose
                for p, change in changes[t]
                if (change < 0 and p not in filled)
                or (change > 0 and p in barred[t] and p not in drained)
            }
            if not finite:
                return loose
            loose = loose - finite

    def split(loose: set[str]) -> set[str]:
        changed = {p for t in loose for p, _ in changes[t]}
        for place, k in sorted({limit for t in loose for limit in barred[t].items()}):
            if place not in changed:
                few = {t for t in loose if needs[t].get(place, 0) < k}
                many = {t for t in loose if barred[t].get(place, k + 1) > k}
                if (rest := repeatable(few) | repeatable(many)) < loose:
                    return rest
        return loose

    loose = repeatable({t.name for t in task.transitions.values() if is_timeless(t)})
    while (rest := split(loose)) < loose:
        loose = repeatable(rest)
    return loose
