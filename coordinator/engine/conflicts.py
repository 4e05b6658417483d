"""One maximal step: which of the fireable transitions fire together, and how conflicts between them
are decided."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from math import inf

from msgspec import Struct

from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import Claims, Match, eligible_runs, match
from petrobot.coordinator.task import End
from petrobot.coordinator.task.compiled_task import CompiledTransition
from petrobot.coordinator.task.wording import Severity


class Draw(Struct, frozen=True):
    """A conflict that a draw by weight decides."""

    alternatives: tuple[str, ...]
    weights: tuple[float, ...]


def choose_step(
    draft: Draft,
    pulse: str,
    choices: Sequence[str],
    only: Sequence[str] | None,
    *,
    ask: bool,
    keep_ranks: bool,
) -> list[Match] | Draw:
    """Return the transitions that fire together in this marking, in an order in which each can fire
    after those before it.

    `choices` are the outcomes of earlier draws for this step. With `ask`, a conflict that is
    otherwise decided by first come, first served is drawn, too, with weight 0 for its transitions.
    Without `keep_ranks`, the order of older journals applies (`Policy.keep_ranks`).

    Examines the dirty transitions and clears their set.
    """
    fireable = [found for x in _marked(draft, pulse, only) if (found := match(draft, x, pulse))]
    draft.dirty.clear()
    if len(fireable) < 2:
        return fireable
    fireable.sort(key=_rank_and_place)
    return _settle(draft, pulse, fireable, list(choices), ask=ask, keep_ranks=keep_ranks)


def _marked(draft: Draft, pulse: str, only: Sequence[str] | None) -> Iterator[CompiledTransition]:
    """Yield the dirty transitions that the pulse may fire and whose input places hold enough
    tokens: a cheap test before `match`."""
    transitions, marking = draft.compiled.transitions, draft.marking
    for t in sorted(draft.dirty):
        x = transitions[t]
        if x.pulse and (x.pulse != pulse or (only is not None and x.name not in only)):
            continue
        for p, w in x.needs:
            if marking[p] < w:
                break
        else:
            yield x


def _settle(
    draft: Draft, pulse: str, rest: list[Match], choices: list[str], *, ask: bool, keep_ranks: bool
) -> list[Match] | Draw:
    claims, step = Claims(), list[Match]()
    while rest:
        # What does not fit beside the claims is left to the next step, for which the firings of
        # this one mark it again.
        rest = [m for old in rest if (m := match(draft, old.transition, pulse, claims))]
        if not rest:
            break
        head = _first(draft, pulse, rest, claims, keep_ranks)
        rivals = [m for m in _rivals(draft, pulse, head, rest, claims) if _rank(m) == _rank(head)]
        if rivals:
            contest = sorted([head, *rivals], key=_rank_and_place)
            weighed = all(m.transition.weight is not None for m in contest)
            if weighed or ask:
                if not choices:
                    return Draw(
                        tuple(m.transition.name for m in contest),
                        tuple(m.transition.weight or 0.0 if weighed else 0.0 for m in contest),
                    )
                # After each draw the step is built again from its beginning: a state keeps the
                # outcomes, not a half-built step.
                drawn = choices.pop(0)
                head = next((m for m in contest if m.transition.name == drawn), head)
            else:
                head = _first_come(draft, head, contest, rest, claims)
        step.append(head)
        claims.add(head)
        rest = [m for m in rest if m.transition is not head.transition]
    return step


def _first_come(
    draft: Draft, head: Match, contest: list[Match], rest: list[Match], claims: Claims
) -> Match:
    """Return the match that has lacked only the contested tokens for the longest time; at a tie the
    first in the file, with a report."""
    places = draft.compiled.net.places
    over = {places[p] for p, _ in _scarce(draft, rest, claims)}

    def since(m: Match) -> float:
        wait = draft.waits.get(m.transition.name)
        return wait.since if wait is not None and wait.place in over else inf

    longest = min(map(since, contest))
    tied = [m for m in contest if since(m) == longest]
    if len(tied) > 1:
        _report(draft, tied)
    # `head` is the first in the file that does not block another which would not block it.
    return head if head in tied else tied[0]


def _rank(m: Match) -> tuple[int, bool]:
    return m.transition.rank


def _rank_and_place(m: Match) -> tuple[int, bool, int]:
    return (*_rank(m), m.transition.index)


def _first(draft: Draft, pulse: str, rest: list[Match], claims: Claims, keep_ranks: bool) -> Match:
    """Return the first match by rank, unless it would block (by inhibitor or capacity) another one
    that does not block it: then the other one, or what is in conflict with that and of a higher
    rank."""
    head, passed = rest[0], set[int]()  # blocking can go in a circle: none is examined twice
    while True:
        passed.add(head.transition.index)
        rivals = _rivals(draft, pulse, head, rest, claims) if keep_ranks else ()
        above = (m for m in rivals if _rank(m) < _rank(head))
        sooner = (
            m
            for m in rest
            if _bars(draft, pulse, claims, head, m) and not _bars(draft, pulse, claims, m, head)
        )
        others = (m for m in chain(above, sooner) if m.transition.index not in passed)
        other = next(others, None)
        if other is None:
            return head
        head = other


def _bars(draft: Draft, pulse: str, claims: Claims, first: Match, then: Match) -> bool:
    """Return whether `then` could not fire after `first` with the tokens of this marking."""
    taken = claims.copy()
    taken.add(first)
    return match(draft, then.transition, pulse, taken) is None


def _rivals(
    draft: Draft, pulse: str, head: Match, rest: list[Match], claims: Claims
) -> list[Match]:
    """Return the matches that cannot all fire beside `head`: they block each other, or together
    they need more tokens than there are."""
    scarce = _scarce(draft, rest, claims) & _demands(head).keys()
    return [
        m
        for m in rest
        if m.transition is not head.transition
        and (
            scarce & _demands(m).keys()
            or (_bars(draft, pulse, claims, head, m) and _bars(draft, pulse, claims, m, head))
        )
    ]


def _demands(m: Match) -> dict[tuple[int, str], int]:
    """Return how many tokens a match takes, by place and, for action places, by the arc's end."""
    demands = {(p, ""): w for p, w in m.transition.plain}
    demands |= {
        (a.place, a.end.value): a.weight for a in m.transition.actions if a.end is not End.GOING
    }
    return demands


def _scarce(draft: Draft, rest: list[Match], claims: Claims) -> set[tuple[int, str]]:
    """Return the kinds of tokens (as in `_demands`) of which `rest` together needs too many."""
    asked: dict[tuple[int, str], int] = {}
    there: dict[tuple[int, str], int] = {}
    for m in rest:
        for key, weight in _demands(m).items():
            asked[key] = asked.get(key, 0) + weight
        there |= {(p, ""): draft.marking[p] - claims.used.get(p, 0) for p, _ in m.transition.plain}
        for arc in m.transition.actions:
            there[arc.place, arc.end.value] = len(eligible_runs(draft, arc, claims, heard=False))
    return {key for key, weight in asked.items() if weight > there[key]}


def _report(draft: Draft, contest: list[Match]) -> None:
    names = ", ".join(m.transition.name for m in contest)
    text = (
        f"nothing settles the conflict of {names}, which came together; "
        f"{contest[0].transition.name} fires, being first in the file"
    )
    draft.report(Severity.WARNING, "undecided", text, names)
