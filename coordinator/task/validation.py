"""What every task must satisfy before anything is done with it: names that exist, arcs that mean
something, kinds that fit.

These are faults of the description. What a sound description may still do wrong (missing branches,
conflicts that nothing settles) is for `check`; what its state space does is for the analysis.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from math import isfinite

from petrobot.coordinator.task.conditions import Expression
from petrobot.coordinator.task.conditions.regions import Domain, kind_faults
from petrobot.coordinator.task.elements import (
    Early,
    End,
    Event,
    Input,
    Kind,
    Memory,
    Place,
    PrimitiveTask,
    Reference,
    Scope,
    Status,
    Subnet,
    Transition,
    Value,
    Variable,
    VariableType,
)
from petrobot.coordinator.task.macros import CircleError, macro_faults
from petrobot.coordinator.task.model import Task
from petrobot.coordinator.task.wording import Fault, listed, nearest

_IDENTIFIER = re.compile(r"[^\W\d]\w*\Z")
_RESERVED = frozenset({"and", "or", "not", "true", "false", "none"})
_COST = re.compile(r"(wall|cpu|count|value:[^\W\d]\w*)\Z")


def faults(task: Task) -> tuple[Fault, ...]:
    """Everything that makes the task meaningless, in file order; empty for a usable task."""
    found = list(_names(task))
    for primitive in task.primitive_tasks.values():
        found += _primitive_task(primitive)
    for variable in task.variables.values():
        found += _variable(task, variable)
    for event in task.events.values():
        found += _event(task, event)
    found += _net(task, "", task.places, task.transitions)
    for subnet in task.subnets.values():
        found += _subnet(task, subnet)
    if not found:
        found += _whole(task)
    return tuple(found)


def condition_domains(task: Task) -> dict[str, Domain]:
    """What the names in transitions' conditions can be: variables, parameters, `place.status` and
    `place.reason`."""
    domains = {v.name: Domain(v.type.value, v.values) for v in task.variables.values()}
    domains |= {
        name: Domain(VariableType.of(value).value) for name, value in task.parameters.items()
    }
    for place in task.places.values():
        if place.kind is Kind.ACTION:
            domains[f"{place.name}.status"] = Domain("str", tuple(s.value for s in Status))
            domains[f"{place.name}.reason"] = Domain("str")
    return domains


def marking_domains(task: Task) -> dict[str, Domain]:
    """What the names in `final` can be: the tokens of places."""
    return {name: Domain("int", least=0) for name in task.places}


def _names(task: Task) -> Iterator[Fault]:
    groups: list[tuple[str, Iterable[str]]] = [
        ("primitive_tasks", task.primitive_tasks),
        ("variables", task.variables),
        ("task.parameters", task.parameters),
        ("events", task.events),
        ("places", task.places),
        ("transitions", task.transitions),
        ("subnets", task.subnets),
    ]
    for group, names in groups:
        for name in names:
            if not _IDENTIFIER.match(name) or name in _RESERVED:
                yield Fault(
                    f"{group}.{name}",
                    f"{name!r} is no name",
                    "use letters, digits and _, and no reserved word",
                )
    for name, value in task.parameters.items():
        if not is_plain(value):
            yield Fault(
                f"task.parameters.{name}",
                f"{value!r} is no default value",
                "use a finite number, text, ...",
            )
    for name in set(task.variables) & set(task.parameters):
        yield Fault(f"variables.{name}", "a parameter has this name too", "rename one of them")
    for name in set(task.places) & set(task.transitions):
        yield Fault(f"transitions.{name}", "a place has this name too", "rename one of them")


def _primitive_task(p: PrimitiveTask) -> Iterator[Fault]:
    key = f"primitive_tasks.{p.name}"
    if not p.goal:
        yield Fault(
            f"{key}.goal", "it has no goal", "say in one sentence what is reached when it succeeds"
        )
    if not p.alternatives:
        yield Fault(f"{key}.alternatives", "no action translates it", "name at least one action")
    for action, n in Counter(p.alternatives).items():
        if n > 1:
            yield Fault(f"{key}.alternatives", f"{action!r} stands there {n} times", "name it once")
    for name, seconds in (("deadline", p.deadline), ("stop_within", p.stop_within)):
        if not seconds > 0:
            yield Fault(
                f"{key}.{name}",
                f"{seconds} s is no time to do anything in",
                "give a positive number of seconds",
            )
    if not 0 < p.target_reliability <= 1:
        yield Fault(
            f"{key}.target_reliability",
            f"{p.target_reliability} is no probability",
            "give 0 < R <= 1",
        )
    if not _COST.match(p.cost):
        yield Fault(
            f"{key}.cost", f"{p.cost!r} is no cost measure", "write wall, cpu, count or value:NAME"
        )
    yield from _estimates(p, f"{key}.estimates")


def _estimates(p: PrimitiveTask, key: str) -> Iterator[Fault]:
    for status, e in p.estimates.items():
        if not 0 <= e.share <= 1 or not e.mean >= 0 or not e.cv >= 0:
            yield Fault(
                f"{key}.{status}",
                "a share lies in 0 to 1, mean and cv are not negative",
                "correct the numbers",
            )
    total = sum(e.share for e in p.estimates.values())
    if p.estimates and abs(total - 1) > 1e-6:
        yield Fault(key, f"the shares sum to {total:g}", "make them sum to 1")


def _variable(task: Task, v: Variable) -> Iterator[Fault]:
    key = f"variables.{v.name}"
    if not v.type.admits(v.initial):
        yield Fault(
            f"{key}.initial", f"{v.initial!r} is no {v.type}", "change the value or the type"
        )
    if v.values and v.type is not VariableType.STR:
        yield Fault(
            f"{key}.values",
            f"a {v.type} has no list of values",
            "drop `values` or make the type str",
        )
    elif v.values and v.initial is not None and v.initial not in v.values:
        yield Fault(
            f"{key}.initial",
            f"{v.initial!r} is not among `values`",
            f"use one of {listed(v.values)}",
        )


def _event(task: Task, e: Event) -> Iterator[Fault]:
    key = f"events.{e.name}"
    if e.scope is Scope.INTERNAL and e.by not in task.primitive_tasks:
        remedy = f"`by` names the one that raises it{nearest(e.by, task.primitive_tasks)}"
        yield Fault(f"{key}.by", f"{e.by!r} is no primitive task", remedy)
    if e.scope is Scope.EXTERNAL and e.by:
        yield Fault(
            f"{key}.by",
            "an external event is raised by no primitive task",
            "drop `by` or make it internal",
        )
    if e.early is Early.KEEP and (e.scope is Scope.INTERNAL or e.memory is Memory.PULSE):
        yield Fault(f"{key}.early", "only a latched external event can be kept", "drop `early`")
    if e.mean_wait is not None and not e.mean_wait > 0:
        yield Fault(
            f"{key}.mean_wait",
            f"{e.mean_wait} s is no mean time",
            "give a positive number of seconds",
        )


def _net(
    task: Task, prefix: str, places: Mapping[str, Place], transitions: Mapping[str, Transition]
) -> Iterator[Fault]:
    for place in places.values():
        yield from _place(task, f"{prefix}places.{place.name}", place)
    for transition in transitions.values():
        key = f"{prefix}transitions.{transition.name}"
        yield from _arcs(key, transition, places)
        yield from _trigger(task, key, transition)
    yield from macro_faults(prefix, places, transitions)


def _place(task: Task, key: str, p: Place) -> Iterator[Fault]:
    if p.tokens < 0:
        yield Fault(f"{key}.tokens", f"{p.tokens} tokens", "give 0 or more")
    if p.capacity is not None and p.capacity < max(1, p.tokens):
        yield Fault(
            f"{key}.capacity",
            f"a capacity of {p.capacity} holds no {p.tokens or 1} tokens",
            "raise it",
        )
    if p.kind is Kind.ACTION:
        yield from _action_place(task, key, p)
    elif p.task or p.args or p.out or p.servers is not None:
        yield Fault(
            key,
            f"a {p.kind} place runs no action",
            "drop task, args, out and servers, or make its kind action",
        )
    if p.kind is Kind.MACRO:
        if p.subnet and p.subnet not in task.subnets:
            remedy = f"name one of [subnets]{nearest(p.subnet, task.subnets)}"
            yield Fault(f"{key}.subnet", f"{p.subnet!r} is no subnet", remedy)
        if p.tokens or p.capacity is not None:
            yield Fault(
                key,
                "a macro place holds no tokens of its own",
                "put them into the places inside it",
            )
    elif p.subnet:
        yield Fault(
            f"{key}.subnet",
            f"a {p.kind} place stands for no subnet",
            "drop `subnet` or make its kind macro",
        )


def _action_place(task: Task, key: str, p: Place) -> Iterator[Fault]:
    if p.task not in task.primitive_tasks:
        remedy = f"name one of [primitive_tasks]{nearest(p.task, task.primitive_tasks)}"
        yield Fault(f"{key}.task", f"{p.task!r} is no primitive task", remedy)
    if p.servers is not None and p.servers < 1:
        yield Fault(f"{key}.servers", f"{p.servers} servers", "give 1 or more")
    known = {**task.variables, **task.parameters}
    for name, value in p.args.items():
        if isinstance(value, Reference):
            if value.variable not in known:
                remedy = f"declare it in [variables]{nearest(value.variable, known)}"
                yield Fault(
                    f"{key}.args.{name}",
                    f"{value.variable!r} is no variable and no parameter",
                    remedy,
                )
        elif not is_plain(value):
            yield Fault(
                f"{key}.args.{name}",
                f"{value!r} is no plain value",
                "use finite numbers, texts, booleans, lists, tables",
            )
    for name, variable in p.out.items():
        if variable not in task.variables:
            remedy = f"declare it in [variables]{nearest(variable, task.variables)}"
            yield Fault(f"{key}.out.{name}", f"{variable!r} is no variable", remedy)


def is_plain(value: Value) -> bool:
    """Whether a value is plain data that a task file can hold."""
    if isinstance(value, Mapping):
        return all(isinstance(k, str) and is_plain(v) for k, v in value.items())
    if isinstance(value, list | tuple):
        return all(is_plain(v) for v in value)
    return isinstance(value, bool | int | str) or (isinstance(value, float) and isfinite(value))


def _arcs(key: str, t: Transition, places: Mapping[str, Place]) -> Iterator[Fault]:
    ends: list[tuple[str, str, int]] = [("in", a.place, a.weight) for a in t.inputs]
    ends += [("out", a.place, a.weight) for a in t.outputs]
    ends += [("in", i.place, i.threshold) for i in t.inhibitors]
    for side, name, weight in ends:
        if name not in places:
            yield Fault(
                f"{key}.{side}",
                f"{name!r} is no place{nearest(name, places)}",
                "declare it in [places]",
            )
        if weight < 1:
            yield Fault(f"{key}.{side}", f"an arc of weight {weight} to {name!r}", "give 1 or more")
    named = (("in", [a.place for a in t.inputs]), ("out", [a.place for a in t.outputs]))
    for side, names in (*named, ("in", [i.place for i in t.inhibitors])):
        for name, n in Counter(names).items():
            if n > 1:
                yield Fault(
                    f"{key}.{side}",
                    f"{n} arcs with {name!r}",
                    f"write one arc, {name}*{n} for its weight",
                )
    for arc in t.inputs:
        if arc.place in places:
            yield from _input(f"{key}.in", arc, places[arc.place])
    for inhibitor in t.inhibitors:
        if inhibitor.place in places and places[inhibitor.place].kind is Kind.MACRO:
            remedy = "let the subnet's transitions keep a control place beside it"
            yield Fault(
                f"{key}.in", f"an inhibitor arc from the macro place {inhibitor.place!r}", remedy
            )


def _input(key: str, arc: Input, place: Place) -> Iterator[Fault]:
    name = arc.place
    if place.kind is Kind.ACTION and arc.end is None:
        remedy = f"write {name}:normal, {name}:error, {name}:preempt=COUNTS or {name}:going"
        yield Fault(
            key, f"{name!r} is an action place, so its arc says when it takes the token", remedy
        )
    if place.kind is Kind.MACRO and place.subnet and arc.end not in (End.NORMAL, End.ERROR):
        yield Fault(key, f"{name!r} is a macro place", f"write {name}:normal or {name}:error")
    if place.kind in (Kind.RESOURCE, Kind.CONTROL) and arc.end is not None:
        yield Fault(key, f"{name!r} runs no action that could end", f"write {name} alone")
    if arc.end is End.PREEMPT and arc.counts is None:
        remedy = f"write {name}:preempt=success, =failure, =error or =none"
        yield Fault(key, f"how does a preempted run of {name!r} count", remedy)
    if arc.end is not End.PREEMPT and arc.counts is not None:
        yield Fault(key, f"only a preempted run counts as {arc.counts}", "drop it")
    if place.kind is Kind.ACTION and place.servers is None and arc.weight > 1:
        yield Fault(
            key,
            f"{name!r} is 1-safe, so {arc.weight} tokens never come together",
            "give the place `servers`",
        )


def _trigger(task: Task, key: str, t: Transition) -> Iterator[Fault]:
    for event in t.events:
        if event not in task.events:
            remedy = f"declare it in [events]{nearest(event, task.events)}"
            yield Fault(f"{key}.event", f"{event!r} is no declared event", remedy)
    pulses = [e for e in t.events if e in task.events and is_pulse(task.events[e])]
    if len(pulses) > 1:
        remedy = "two pulses never come together: make one of them latched, or use two transitions"
        yield Fault(f"{key}.event", f"it waits for the pulses {listed(pulses)} at once", remedy)
    if len(set(t.events)) < len(t.events):
        yield Fault(f"{key}.event", "an event stands there twice", "name it once")
    if t.after is not None and not t.after > 0:
        yield Fault(
            f"{key}.after", f"{t.after} s is no waiting time", "give a positive number of seconds"
        )
    if t.after is not None and t.events:
        remedy = "put the timer on a transition of its own beside this one"
        yield Fault(f"{key}.after", "it waits for an event and for a time", remedy)
    if t.weight is not None and not t.weight > 0:
        yield Fault(f"{key}.weight", f"{t.weight} is no weight", "give a positive number")


def is_pulse(event: Event) -> bool:
    """Whether the event is gone as soon as it has come."""
    return event.scope is Scope.EXTERNAL and event.memory is Memory.PULSE


def _subnet(task: Task, s: Subnet) -> Iterator[Fault]:
    key = f"subnets.{s.name}"
    ports = [("entry", s.entry), ("normal", s.normal)] + ([("error", s.error)] if s.error else [])
    for port, place in ports:
        if place not in s.places:
            remedy = f"name one of its places{nearest(place, s.places)}"
            yield Fault(f"{key}.{port}", f"{place!r} is no place of the subnet", remedy)
        elif port != "entry" and s.places[place].kind not in (Kind.CONTROL, Kind.RESOURCE):
            yield Fault(
                f"{key}.{port}",
                f"{place!r} is a {s.places[place].kind} place",
                "end in a control place",
            )
    for name in set(s.places) & set(s.transitions):
        yield Fault(f"{key}.transitions.{name}", "a place has this name too", "rename one of them")
    for name in (*s.places, *s.transitions):
        if not _IDENTIFIER.match(name):
            yield Fault(f"{key}.{name}", f"{name!r} is no name", "use letters, digits and _")
    yield from _net(task, f"{key}.", s.places, s.transitions)


def _whole(task: Task) -> Iterator[Fault]:
    """What can be judged only when the parts are right: expansion, conditions, predicates."""
    try:
        flat = task.flat
    except CircleError as circle:
        yield Fault(circle.key, str(circle), "break the circle")
        return
    yield from _macro_exits(task)
    domains = condition_domains(flat)
    for t in flat.transitions.values():
        if t.when is not None:
            yield from _expression(_written_key(task, t.name), t.when, domains)
    for key, predicate in (("task.final", task.final), ("task.final_error", task.final_error)):
        if predicate is not None:
            yield from _expression(key, predicate, marking_domains(flat))
    if task.runs_place and (
        task.runs_place not in flat.places or flat.places[task.runs_place].kind is not Kind.CONTROL
    ):
        known = [p.name for p in flat.places.values() if p.kind is Kind.CONTROL]
        remedy = f"name one of {listed(known)}{nearest(task.runs_place, known)}"
        yield Fault("task.runs_place", f"{task.runs_place!r} is no control place", remedy)
    for name in task.goal_transitions:
        if name not in flat.transitions:
            remedy = f"name a transition{nearest(name, flat.transitions)}"
            yield Fault("task.goal_transitions", f"{name!r} is no transition", remedy)


def _macro_exits(task: Task) -> Iterator[Fault]:
    """Arcs `macro:error` need a subnet with an error port."""
    levels = [("", task.places, task.transitions)]
    levels += [(f"subnets.{s.name}.", s.places, s.transitions) for s in task.subnets.values()]
    for prefix, places, transitions in levels:
        for t in transitions.values():
            for arc in t.inputs:
                place = places[arc.place]
                if (
                    place.kind is Kind.MACRO
                    and arc.end is End.ERROR
                    and not task.subnets[place.subnet].error
                ):
                    remedy = f"give subnets.{place.subnet} an `error` place"
                    yield Fault(
                        f"{prefix}transitions.{t.name}.in",
                        f"{arc.place!r} has no error exit",
                        remedy,
                    )


def _expression(key: str, expression: Expression, domains: Mapping[str, Domain]) -> Iterator[Fault]:
    for text in kind_faults(expression, domains):
        yield Fault(key, f"in {expression.text!r}, {text}", "")


def _written_key(task: Task, flat_name: str) -> str:
    """The key in the task file of a flat transition's condition: that of the subnet in which it is
    written."""
    *macros, name = flat_name.split(".")
    key, places = "", task.places
    for macro in macros:
        subnet = task.subnets[places[macro].subnet]
        key, places = f"subnets.{subnet.name}.", subnet.places
    return f"{key}transitions.{name}.when"
