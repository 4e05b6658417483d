"""Which values conditions can meet: kinds of names, and exclusivity and coverage decided by regions
of values.

Conditions only compare. So the values of a name fall into finitely many regions that no condition
tells apart (the literals and the gaps between them), and trying one value of each region for every
name decides a question exactly: the small-model property of equality and of (dense or integer)
order. Names compared with each other share their regions and get as many distinct values in each
gap as there are such names.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from enum import StrEnum
from itertools import pairwise, product
from math import ceil, floor, prod
from typing import Any

from msgspec import Struct

from petrobot.coordinator.task.conditions.language import (
    Compare,
    ConditionFault,
    Expression,
    Literal,
    Name,
    Node,
    Not,
    as_literal,
    is_number,
    walk,
    with_values,
)
from petrobot.coordinator.task.wording import few, nearest

LIMIT = 50_000
"""Assignments that are tried before the answer is `UNKNOWN`."""


class Domain(Struct, frozen=True):
    """What a name can be: kind `bool`, `int`, `float`, `str` or `any`, and the possible values of a
    `str` if they are few."""

    kind: str
    values: tuple[str, ...] = ()
    least: int | None = None
    """Smallest value of an `int`."""


class Certainty(StrEnum):
    """How certain the answer to a question about all values is."""

    PROVED = "proved"
    REFUTED = "refuted"
    UNKNOWN = "unknown"


class Decision(Struct, frozen=True):
    """An answer; when refuted, `witness` are values that show it."""

    answer: Certainty
    witness: Mapping[str, Any] | None = None


def kind_faults(expression: Expression, domains: Mapping[str, Domain]) -> list[str]:
    """Why the condition could never have a truth value: unknown names and operands of the wrong
    kind, with positions."""
    faults: list[str] = []
    kind = _kind(expression.tree, domains, faults)
    if kind not in ("bool", "?"):
        faults.append(f"the whole is a {kind}, neither true nor false")
    return faults


def exclusive(conditions: Sequence[Expression | None], domains: Mapping[str, Domain]) -> Decision:
    """Whether no values make two of the conditions true (None: always true)."""
    return _decide(conditions, domains, lambda truths: sum(truths) >= 2)


def covering(conditions: Sequence[Expression | None], domains: Mapping[str, Domain]) -> Decision:
    """Whether all values make at least one of the conditions true, once every name has been
    written."""
    return _decide(conditions, domains, lambda truths: not any(truths))


def equivalent(one: Expression, other: Expression, domains: Mapping[str, Domain]) -> bool:
    """Return whether two conditions are true for the same values; `none` is one of them, as nothing
    need have been written yet. Above `LIMIT` assignments only equal texts are."""
    if one == other:
        return True
    choices = {n: [*c, None] for n, c in region_values([one, other], domains).items()}
    return prod(len(c) for c in choices.values()) <= LIMIT and all(
        _holds(one, values) == _holds(other, values)
        for some in product(*choices.values())
        for values in [dict(zip(choices, some, strict=True))]
    )


def _decide(
    conditions: Sequence[Expression | None], domains: Mapping[str, Domain], bad: Any
) -> Decision:
    real = [c for c in conditions if c is not None]
    choices = region_values(real, domains)
    if prod(len(c) for c in choices.values()) > LIMIT:
        return Decision(Certainty.UNKNOWN)
    for values in product(*choices.values()):
        assignment = dict(zip(choices, values, strict=True))
        if bad([c is None or _holds(c, assignment) for c in conditions]):
            return Decision(Certainty.REFUTED, assignment)
    return Decision(Certainty.PROVED)


def _holds(condition: Expression, values: Mapping[str, Any]) -> bool:
    try:
        return condition.holds(values)
    except ConditionFault:
        return False


def can_hold(
    condition: Expression,
    values: Mapping[str, Any],
    free: Collection[str],
    domains: Mapping[str, Domain],
) -> bool:
    """Return whether the condition is true for the values, or for some values of the names in
    `free` beside them. Above `LIMIT` combinations it counts as possible."""
    known = {name: values[name] for name in condition.names - set(free) if name in values}
    fixed = with_values(condition, known)
    choices = {n: c for n, c in region_values([fixed], domains).items() if n in free}
    if prod(len(c) for c in choices.values()) > LIMIT:
        return True
    chosen = (dict(zip(choices, some, strict=True)) for some in product(*choices.values()))
    return any(_holds(fixed, some) for some in chosen)


def region_values(
    conditions: Iterable[Expression], domains: Mapping[str, Domain]
) -> dict[str, list[Any]]:
    """Return one value of each region, for each name that the conditions read."""
    comparisons = [n for c in conditions for n in walk(c.tree) if isinstance(n, Compare)]
    names = sorted({name for c in conditions for name in c.names})
    regions: dict[str, list[Any]] = {}
    for group in _groups(names, comparisons):
        literals = _literals(group, comparisons)
        for name in group:
            own = _values(domains.get(name, Domain("any")), literals, len(group))
            regions[name] = own + ([None] if None in literals else [])
    return regions


def _groups(names: Sequence[str], comparisons: Sequence[Compare]) -> list[list[str]]:
    """Names that are compared with each other, directly or by others."""
    group = {n: {n} for n in names}
    for c in comparisons:
        if isinstance(c.left, Name) and isinstance(c.right, Name):
            merged = group[c.left.name] | group[c.right.name]
            for name in merged:
                group[name] = merged
    return [sorted(members) for name, members in group.items() if name == min(members)]


def _literals(group: Sequence[str], comparisons: Sequence[Compare]) -> list[Any]:
    found: list[Any] = []
    for c in comparisons:
        for side, other in ((c.left, c.right), (c.right, c.left)):
            if isinstance(side, Name) and side.name in group and isinstance(other, Literal):
                found.append(other.value)
    return found


def _values(domain: Domain, literals: Sequence[Any], together: int) -> list[Any]:
    """One value of each region of one name, when `together` names share the regions."""
    if domain.kind == "bool":
        return [True, False]
    if domain.kind in ("int", "float"):
        numbers = sorted({n for n in literals if is_number(n)})
        whole = _integers(numbers, domain.least, together)
        return whole if domain.kind == "int" else _between(sorted({*numbers, *whole}), together)
    if domain.kind == "str" and domain.values:
        return list(domain.values)
    texts = sorted({t for t in literals if isinstance(t, str)})
    fresh = (f"other{'' if i == 0 else i}" for i in range(len(texts) + together))
    return texts + [f for f in fresh if f not in texts][:together]


def _integers(numbers: Sequence[float], least: int | None, together: int) -> list[int]:
    """Integers at the literals and up to `together` in each gap beside and between them."""
    found: set[int] = {least} if least is not None else set()
    for n in numbers or [0]:
        found |= {ceil(n) + i for i in range(together + 1)} | {
            floor(n) - i for i in range(together + 1)
        }
    return sorted(n for n in found if least is None or n >= least)


def _between(points: Sequence[float], together: int) -> list[float]:
    """The points and `together` values in each gap beside and between them."""
    found: list[float] = list(points)
    for low, high in pairwise(points):
        found += [low + (high - low) * (i + 1) / (together + 1) for i in range(together)]
    ends = (points[0], points[-1]) if points else (0.0, 0.0)
    found += [ends[0] - 1 - i for i in range(together)] + [ends[1] + 1 + i for i in range(together)]
    return sorted(set(found))


def _kind(node: Node, domains: Mapping[str, Domain], faults: list[str]) -> str:
    """Kind of a node's value: `bool`, `number`, `str`, `none`, `any`, or `?` after a fault."""
    if isinstance(node, Literal):
        return _literal_kind(node.value)
    if isinstance(node, Name):
        if node.name not in domains:
            text = nearest(node.name, domains)
            if any(node.name in domain.values for domain in domains.values()):
                text = f"; a text is written in quotes: '{node.name}'"
            faults.append(f"{node.name!r} is unknown at column {node.at + 1}{text}")
            return "?"
        kind = domains[node.name].kind
        return "number" if kind in ("int", "float") else kind
    if isinstance(node, Compare):
        _compare_kinds(node, domains, faults)
        return "bool"
    for part in (node.operand,) if isinstance(node, Not) else node.operands:
        kind = _kind(part, domains, faults)
        if kind not in ("bool", "?"):
            faults.append(
                f"the operand at column {part.at + 1} is a {kind}, neither true nor false"
            )
    return "bool"


def _compare_kinds(node: Compare, domains: Mapping[str, Domain], faults: list[str]) -> None:
    left, right = _kind(node.left, domains, faults), _kind(node.right, domains, faults)
    if "?" in (left, right):
        return
    where = f"{node.sign} at column {node.at + 1}"
    if node.sign in ("==", "!="):
        if left != right and "none" not in (left, right):
            faults.append(f"{where} compares a {left} with a {right}: they are never equal")
        elif left == right == "any":
            faults.append(f"{where} compares two values of any kind: declare their types")
    elif (left, right) != ("number", "number"):
        faults.append(f"{where} orders a {left} and a {right}: only numbers are ordered")
    for side, other in ((node.left, node.right), (node.right, node.left)):
        if isinstance(side, Name) and isinstance(other, Literal) and isinstance(other.value, str):
            possible = domains[side.name].values
            if possible and other.value not in possible:
                faults.append(
                    f"{side.name!r} is never {as_literal(other.value)} at column "
                    f"{other.at + 1}{nearest(other.value, possible)}; it may be "
                    f"{few([as_literal(value) for value in possible])}"
                )


def _literal_kind(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "bool"
    return "number" if is_number(value) else "str"
