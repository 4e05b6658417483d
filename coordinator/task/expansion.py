"""The flat net of a task: short forms are expanded to places, arcs and transitions.

`expand` does the steps in this order (docs/task-file.md, "Short forms"):

1. `[errors]`: an error branch for each action place that has none, net by net;
2. macro places with a subnet: its places and transitions, names prefixed, parameters replaced;
3. `holds`: arcs from and to the resources;
4. `tries`: a counter of the tries, and copies of the outgoing transitions by number of used tries;
5. plain places: `final` requires that they are empty.

All later code (engine, analysis, journal, exports) uses this net only. Added elements have the name
of their origin in `expanded_from`, come after those of the file, and have a name with a dot.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import product
from typing import TYPE_CHECKING

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.task.conditions import Expression, parse, rename
from petrobot.coordinator.task.elements import (
    End,
    Inhibitor,
    Input,
    Kind,
    Output,
    Parameter,
    Place,
    Reference,
    Subnet,
    Transition,
    Value,
)
from petrobot.coordinator.task.wording import Fault, listed, nearest

if TYPE_CHECKING:
    from petrobot.coordinator.task.model import Task

Places = Mapping[str, Place]
Transitions = Mapping[str, Transition]


class CircleError(ValueError):
    """A subnet that contains itself; `key` is that of the macro place in the task file."""

    def __init__(self, inside: tuple[str, ...], place: Place) -> None:
        super().__init__(inside, place)
        self.key = f"subnets.{inside[-1]}.places.{place.name}.subnet"

    def __str__(self) -> str:
        inside, place = self.args
        return f"subnet {place.subnet!r} contains itself by {' > '.join((*inside, place.subnet))}"


def expand(task: Task) -> Task:
    """Return the flat task; the task itself if it has no short forms.

    Raises CircleError on subnets that contain themselves. Other faults are for `validation`, which
    must have found none before the result means anything.
    """
    places, transitions = (
        task.places,
        _with_error_branches(task.places, task.transitions, task.subnets, task.errors_to),
    )
    if any(p.kind is Kind.MACRO for p in places.values()):
        places, transitions = _unfolded(places, transitions, task.subnets)
    else:
        transitions = _with_holding({p.name: p.holds for p in places.values()}, transitions, {})
    copies: dict[str, tuple[str, ...]] = {}
    if any(p.tries > 1 for p in places.values()):
        places, transitions, copies = _with_tries(places, transitions)
    held = {p.name: p.holds for p in places.values() if p.holds}
    places, transitions = _plainly(places), _written_first(transitions)
    final = _with_empty_places(task.final, places)
    if (places, transitions, final) == (task.places, task.transitions, task.final):
        return task
    goals = tuple(c for goal in task.goal_transitions for c in copies.get(goal, (goal,)))
    return replace(
        task,
        places=places,
        transitions=transitions,
        subnets={},
        final=final,
        goal_transitions=goals,
        errors_to="",
        held=held,
    )


# ------------------------------------------------------------------------- default error branches


def with_error_branches(task: Task) -> Task:
    """Return a task that writes the error branches that its `errors_to` adds."""
    added = _with_error_branches(task.places, task.transitions, task.subnets, task.errors_to)
    return task if added is task.transitions else replace(task, transitions=added)


def net_inside(task: Task, place: Place) -> Task:
    """Return the net of a macro place's subnet, with the error branches that its `[errors]`
    adds."""
    subnet = task.subnets[place.subnet]
    places, transitions = subnet.places, subnet.transitions
    inner = replace(task, places=places, transitions=transitions, errors_to=subnet.errors_lead_to)
    return with_error_branches(inner)


def _with_error_branches(
    places: Places, transitions: Transitions, subnets: Mapping[str, Subnet], to: str
) -> Transitions:
    """Return the transitions of one net, with an added error branch to place `to` for each action
    place, and each macro place whose subnet can fail, that has none."""
    if not to:
        return transitions
    handled = {a.place for t in transitions.values() for a in t.inputs if a.end is End.ERROR}
    new: dict[str, Transition] = {}
    for place in places.values():
        subnet = subnets.get(place.subnet)
        can_fail = place.kind is Kind.ACTION or (subnet is not None and bool(subnet.error))
        if can_fail and place.name not in handled and place.name != to:
            name = f"{place.name}.error"
            new[name] = Transition(
                name,
                inputs=(Input(place.name, end=End.ERROR),),
                outputs=(Output(to),),
                macro=place.macro,
                expanded_from=place.name,
            )
    return {**transitions, **new}


# ------------------------------------------------------------------------------------- macro places


class _Scope(Struct, frozen=True):
    """Resolves the names in one net: its own places, the parameters of its subnet, else the names
    of the task."""

    prefix: str
    places: Places
    values: Mapping[str, Value] = field(default_factory=dict)
    """By parameter: the full name of a place, a `Reference`, or a plain value."""

    def place(self, name: str) -> str:
        """Return the full name of a place."""
        if name in self.places:
            return self.prefix + name
        return str(self.values.get(name, name))

    def variable(self, name: str) -> str:
        """Return the full name of a variable."""
        value = self.values.get(name)
        return value.variable if isinstance(value, Reference) else name

    def value(self, value: Value) -> Value:
        """Return the value of an argument: that of the parameter if it refers to one."""
        return self.values.get(value.variable, value) if isinstance(value, Reference) else value

    def expression(self, expression: Expression) -> Expression:
        """Return a condition or value with full names."""
        names = {n: self._text(n) for n in expression.names}
        return rename(expression, {n: text for n, text in names.items() if n != text})

    def _text(self, name: str) -> str:
        if name in self.values:
            value = self.values[name]
            return value.variable if isinstance(value, Reference) else written(value)
        place, dot, attribute = name.rpartition(".")
        return f"{self.place(place)}.{attribute}" if dot else name


def written(value: Value) -> str:
    """Return a plain value as text of a condition. Raises ValueError for values that conditions
    cannot contain."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str) and not ("'" in value and '"' in value):
        return f'"{value}"' if "'" in value else f"'{value}'"
    raise ValueError(f"{value!r} cannot stand in a condition")


class _Flat(Struct, frozen=True):
    """The elements expanded so far, by full name."""

    subnets: Mapping[str, Subnet]
    places: dict[str, Place] = field(default_factory=dict)
    transitions: dict[str, Transition] = field(default_factory=dict)
    entered: dict[str, Subnet] = field(default_factory=dict)
    """The subnet of each macro place."""
    holds: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Resources that a token in each place holds. A macro place takes its own once for everything
    inside, which may fork; what its entry or the place of an exit holds comes on top."""


def _unfolded(
    places: Places, transitions: Transitions, subnets: Mapping[str, Subnet]
) -> tuple[Places, Transitions]:
    flat = _Flat(subnets)
    _unfold(flat, _Scope("", places), transitions, ())
    # arcs still name the macro places
    holding = _with_holding(flat.holds, flat.transitions, flat.entered)
    return flat.places, {name: _rewired(t, flat.entered) for name, t in holding.items()}


def _unfold(flat: _Flat, scope: _Scope, transitions: Transitions, inside: tuple[str, ...]) -> None:
    """Add the places and transitions of one net, and those of the macro places in it."""
    for place in scope.places.values():
        name = scope.prefix + place.name
        flat.holds[name] = tuple(scope.place(r) for r in place.holds)
        if place.kind is not Kind.MACRO:
            flat.places[name] = replace(
                place,
                name=name,
                macro=_around(scope.prefix, place.macro),
                args={n: scope.value(v) for n, v in place.args.items()},
                out={n: scope.variable(v) for n, v in place.out.items()},
                holds=flat.holds[name],
            )
        if place.kind is not Kind.MACRO or not place.subnet:
            continue
        if place.subnet in inside:
            raise CircleError(inside, place)
        flat.entered[name] = subnet = flat.subnets[place.subnet]
        inner = _Scope(f"{name}.", subnet.places, _bound(scope, place, subnet))
        own = _with_error_branches(
            subnet.places, subnet.transitions, flat.subnets, subnet.errors_lead_to
        )
        _unfold(flat, inner, own, (*inside, place.subnet))
    for transition in transitions.values():
        flat.transitions[scope.prefix + transition.name] = _in_scope(transition, scope)


def _bound(scope: _Scope, macro: Place, subnet: Subnet) -> dict[str, Value]:
    """Return the values of a subnet's parameters at one macro place."""
    bound: dict[str, Value] = {}
    for name, parameter in subnet.parameters.items():
        given = macro.args[name]
        if parameter is Parameter.PLACE:
            bound[name] = scope.place(given)
        elif parameter is Parameter.VARIABLE:
            bound[name] = Reference(scope.variable(given))
        else:
            bound[name] = scope.value(given)
    return bound


def _around(prefix: str, macro: str) -> str:
    """Return the full name of the innermost macro place around an element: the one it names, else
    the one whose subnet it is in."""
    return prefix + macro if macro else prefix.removesuffix(".")


def _in_scope(t: Transition, scope: _Scope) -> Transition:
    if not scope.prefix:
        return t
    return replace(
        t,
        name=scope.prefix + t.name,
        macro=_around(scope.prefix, t.macro),
        expanded_from=t.expanded_from and scope.prefix + t.expanded_from,
        when=t.when and scope.expression(t.when),
        sets=tuple((scope.variable(n), scope.expression(e)) for n, e in t.sets),
        inputs=tuple(replace(a, place=scope.place(a.place)) for a in t.inputs),
        outputs=tuple(replace(a, place=scope.place(a.place)) for a in t.outputs),
        inhibitors=tuple(replace(a, place=scope.place(a.place)) for a in t.inhibitors),
    )


def _rewired(transition: Transition, entries: Mapping[str, Subnet]) -> Transition:
    """Return the transition with its arcs to and from macro places moved to the subnets' entry and
    exit places. It stays of an error branch: a subnet may fail without an error of an action."""
    after_error = any(a.place in entries and a.end is End.ERROR for a in transition.inputs)
    return replace(
        transition,
        error_branch=transition.error_branch or after_error,
        inputs=tuple(_from(a, entries) for a in transition.inputs),
        outputs=tuple(_to(a, entries) for a in transition.outputs),
    )


def _to(arc: Output, entries: Mapping[str, Subnet]) -> Output:
    while arc.place in entries:
        arc = _into(arc, entries)
    return arc


def _into(arc: Output, entries: Mapping[str, Subnet]) -> Output:
    return replace(arc, place=f"{arc.place}.{entries[arc.place].entry}")


def _from(arc: Input, entries: Mapping[str, Subnet]) -> Input:
    if arc.place not in entries:
        return arc
    subnet = entries[arc.place]
    return replace(
        arc,
        place=f"{arc.place}.{subnet.error if arc.end is End.ERROR else subnet.normal}",
        end=None,
    )


# ---------------------------------------------------------------------------------- held resources


def _with_holding(
    holds: Mapping[str, tuple[str, ...]], transitions: Transitions, entered: Mapping[str, Subnet]
) -> Transitions:
    """Return transitions that take the resources that their output places hold and their input
    places do not, and give back those that only their input places hold. A token that moves between
    two holding places keeps its resources."""
    if not any(holds.values()):
        return transitions
    return {name: _holding(t, holds, entered) for name, t in transitions.items()}


def _holding(
    t: Transition, holds: Mapping[str, tuple[str, ...]], entered: Mapping[str, Subnet]
) -> Transition:
    before, after = Counter[str](), Counter[str]()
    for held, arcs in ((before, t.inputs), (after, t.outputs)):
        for arc in arcs:
            if not (isinstance(arc, Input) and arc.end is End.GOING):
                for place in _places_of(arc, entered):
                    for resource in holds[place]:
                        held[resource] += arc.weight
    take, give = after - before, before - after
    return replace(
        t,
        inputs=(*t.inputs, *(Input(r, n) for r, n in take.items())),
        outputs=(*t.outputs, *(Output(r, n) for r, n in give.items())),
    )


def _places_of(arc: Input | Output, entered: Mapping[str, Subnet]) -> Iterator[str]:
    """Yield the places in which the arc's token is, from outside to inside: a macro place, and in
    its subnet the place of the entry or of the exit."""
    yield arc.place
    while arc.place in entered:
        arc = _from(arc, entered) if isinstance(arc, Input) else _into(arc, entered)
        yield arc.place


# ------------------------------------------------------------------------------------------- tries


_COUNTERS = ("left", "used")


def counters(flat: Places) -> frozenset[str]:
    """Return the places of a flat task that count tries."""
    owned = ((name, *name.rpartition(".")[::2]) for name in flat)
    return frozenset(
        name
        for name, owner, suffix in owned
        if suffix in _COUNTERS and owner in flat and flat[owner].kind is Kind.ACTION
    )


def _with_tries(
    places: Places, transitions: Transitions
) -> tuple[Places, Transitions, dict[str, tuple[str, ...]]]:
    """Count the tries of a place in `p.left` and `p.used`, and give the used ones back at every
    outgoing transition.

    Each outgoing transition becomes one copy for each number of used tries, of which exactly one
    can fire: so the net stays bounded and needs no reset arcs. Also return the names of the copies
    by original transition.
    """
    again = {p.name: p for p in places.values() if p.tries > 1}
    new_places: dict[str, Place] = {}
    retries: dict[str, Transition] = {}
    for p in again.values():
        for suffix, tokens in zip(_COUNTERS, (p.tries - 1, 0), strict=True):
            new_places[f"{p.name}.{suffix}"] = Place(
                f"{p.name}.{suffix}",
                Kind.RESOURCE,
                tokens,
                capacity=p.tries - 1,
                macro=p.macro,
                expanded_from=p.name,
            )
        retries[f"{p.name}.retry"] = Transition(
            f"{p.name}.retry",
            inputs=(Input(p.name, end=End.ERROR), Input(f"{p.name}.left")),
            outputs=(Output(f"{p.name}.used"), Output(p.name)),
            when=parse(_may_retry(p)),
            macro=p.macro,
            expanded_from=p.name,
        )
    written_ones: dict[str, Transition] = {}
    copies: dict[str, Transition] = {}
    names: dict[str, tuple[str, ...]] = {}
    for t in transitions.values():
        first, *others = _copies(t, again)
        written_ones[first.name] = first
        copies |= {c.name: c for c in others}
        names[t.name] = (first.name, *(c.name for c in others))
    return {**places, **new_places}, {**written_ones, **retries, **copies}, names


def _may_retry(p: Place) -> str:
    """Return the condition under which an ERROR leads to another try."""
    known = "" if p.retry_unknown else f" and {p.name}.executed != 'unknown'"
    return f"{p.name}.reason != 'emergency_stop'{known}"


def _copies(t: Transition, again: Mapping[str, Place]) -> Iterator[Transition]:
    """Return the copies of a transition, one for each number of used tries of each such place from
    which it takes a run; the first one keeps its name."""
    taken = [a for a in t.inputs if a.place in again and a.end is not End.GOING]
    for number, used in enumerate(product(*(range(again[a.place].tries) for a in taken))):
        copy = t
        for arc, n in zip(taken, used, strict=True):
            copy = _returning(copy, again[arc.place], arc, n)
        if number:
            name = f"{t.name}.{'_'.join(map(str, used))}"
            copy = replace(copy, name=name, expanded_from=t.expanded_from or t.name)
        yield copy


def _returning(t: Transition, p: Place, arc: Input, used: int) -> Transition:
    """Return the transition that takes a run of p after so many used tries and gives them back."""
    counter, last = f"{p.name}.used", used == p.tries - 1
    if used:
        t = replace(
            t,
            inputs=(*t.inputs, Input(counter, used)),
            outputs=(*t.outputs, Output(f"{p.name}.left", used)),
        )
    if last:
        return t
    t = replace(t, inhibitors=(*t.inhibitors, Inhibitor(counter, used + 1)))
    if arc.end is End.ERROR:
        refused = f"not ({_may_retry(p)})"
        t = replace(t, when=parse(refused if t.when is None else f"({t.when.text}) and {refused}"))
    return t


# ------------------------------------------------------------------------------------ plain places


def _written_first(transitions: Transitions) -> Transitions:
    """Put added elements after those of the file, because the order decides conflicts as the last
    rule."""
    made = {name: t for name, t in transitions.items() if t.expanded_from}
    return {**{name: t for name, t in transitions.items() if name not in made}, **made}


def _plainly(places: Places) -> Places:
    """Return the places without the short forms that were expanded."""
    if not any(p.holds or p.tries > 1 for p in places.values()):
        return places
    return {name: replace(p, holds=(), tries=1) for name, p in places.items()}


def _with_empty_places(final: Expression, places: Places) -> Expression:
    """Return `final`, extended so that plain places which it does not name are empty."""
    empty = [
        f"{p.name} == 0"
        for p in places.values()
        if p.kind is Kind.PLAIN and not p.listen and p.name not in final.names
    ]
    return parse(" and ".join([f"({final.text})", *empty])) if empty else final


# --- macro places that only group ---
# Macro places that only group: which part of a net is drawn within which, and what keeps a group
# from being one place.
#
# A macro place has places at its border and transitions at most inside, so that it can be drawn
# wherever a place can: each transition within it has all its places within it (or within macro
# places inside it).


def macros_around(macro: str, places: Mapping[str, Place]) -> Iterator[str]:
    """The macro places around something that names `macro`, innermost first; ends at a name that is
    unknown or came before."""
    seen: set[str] = set()
    while macro and macro not in seen:
        seen.add(macro)
        yield macro
        macro = places[macro].macro if macro in places else ""


def macro_faults(
    prefix: str, places: Mapping[str, Place], transitions: Mapping[str, Transition]
) -> Iterator[Fault]:
    """What is wrong with the groups of one net, whose keys begin with `prefix`."""
    groups = [p.name for p in places.values() if p.kind is Kind.MACRO and not p.subnet]
    wrong = False
    for kind, elements in (("places", places), ("transitions", transitions)):
        for element in elements.values():
            if element.macro and element.macro not in groups:
                wrong = True
                remedy = (
                    f"name a macro place without subnet{nearest(element.macro, groups)}, "
                    "or drop the key"
                )
                yield Fault(
                    f"{prefix}{kind}.{element.name}.macro",
                    f"{element.macro!r} groups nothing",
                    remedy,
                )
    for name in groups:
        if name in _above(places[name], places):
            wrong = True
            yield Fault(
                f"{prefix}places.{name}.macro", f"{name!r} lies within itself", "break the circle"
            )
    if not wrong:
        for transition in transitions.values():
            yield from _border(f"{prefix}transitions.{transition.name}", transition, places)


def _above(element: Place | Transition, places: Mapping[str, Place]) -> list[str]:
    return list(macros_around(element.macro, places))


def _border(key: str, t: Transition, places: Mapping[str, Place]) -> Iterator[Fault]:
    joined = [
        *(a.place for a in t.inputs),
        *(a.place for a in t.outputs),
        *(a.place for a in t.inhibitors),
    ]
    for name in joined:
        place = places.get(name)
        if place is not None and place.kind is Kind.MACRO and not place.subnet:
            yield Fault(
                key,
                f"an arc with the macro place {name!r}, which only shows what is in it",
                "name a place in it",
            )
    outside = [
        n for n in joined if n in places and t.macro and t.macro not in _above(places[n], places)
    ]
    if outside:
        what = (
            f"it stands in the macro place {t.macro!r}, but {listed(outside)} "
            f"{'do' if len(outside) > 1 else 'does'} not"
        )
        yield Fault(f"{key}.macro", what, "take it out of the macro place, or put them in too")
