"""Faults of a task's description: names that do not exist, arcs without a meaning, kinds that do
not fit. A task with a fault can be neither run nor analysed.

What a sound description may still do wrong is found elsewhere: missing branches and undecided
conflicts by `check`, deadlocks and other properties of the state space by the analysis.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Container, Iterable, Iterator, Mapping
from math import inf, isfinite, prod

from petrobot.coordinator.task.conditions import Expression, Literal, Name, walk
from petrobot.coordinator.task.conditions.regions import Domain, kind_faults
from petrobot.coordinator.task.elements import (
    MOST_TOKENS,
    EarlyEvent,
    End,
    Event,
    EventMemory,
    Executed,
    Input,
    Kind,
    Parameter,
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
from petrobot.coordinator.task.expansion import CircleError, macro_faults
from petrobot.coordinator.task.model import Task
from petrobot.coordinator.task.wording import Fault, few, listed, nearest

_IDENTIFIER = re.compile(r"[^\W\d]\w*\Z")
_RESERVED = frozenset({"and", "or", "not", "true", "false", "none"})
MOST_TRIES = 100
"""Most tries of one place: more are a loop that the task should say."""
MOST_COPIES = 1_000
"""Largest number of copies that `tries` may make of one transition (`expansion`)."""
LONGEST = 1e9
"""Longest time in a task file (s), about 31 years."""
_COST = re.compile(r"(wall|cpu|count|value:[^\W\d]\w*)\Z")


def faults(task: Task) -> tuple[Fault, ...]:
    """Return all faults of the description, in file order; empty for a usable task."""
    found = list(_names(task))
    for primitive in task.primitive_tasks.values():
        found += _primitive_task(primitive)
    for variable in task.variables.values():
        found += _variable(task, variable)
    for event in task.events.values():
        found += _event(task, event)
    found += _net(task, "", _Names(task), task.places, task.transitions, task.errors_to)
    for subnet in task.subnets.values():
        found += _subnet(task, subnet)
    if not found:
        found += _macro_exits(task)  # first: without them the net cannot be made flat
    if not found:
        found += _whole(task)
    return tuple(found)


def condition_domains(task: Task) -> dict[str, Domain]:
    """Return what each name in a transition's condition can be: variables, parameters,
    `place.status` and `place.reason`."""
    domains = {v.name: Domain(v.type.value, v.values) for v in task.variables.values()}
    domains |= {
        name: Domain(VariableType.of(value).value) for name, value in task.parameters.items()
    }
    for place in task.places.values():
        if place.kind is Kind.ACTION:
            domains[f"{place.name}.status"] = Domain("str", tuple(s.value for s in Status))
            domains[f"{place.name}.reason"] = Domain("str")
            domains[f"{place.name}.executed"] = Domain("str", tuple(e.value for e in Executed))
    return domains


def marking_domains(task: Task) -> dict[str, Domain]:
    """Return what each name in `final` can be: the number of tokens of a place."""
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
                    f"{name!r} cannot be a name",
                    "use letters, digits and _, and not a reserved word",
                )
    for name, value in task.parameters.items():
        if not is_plain(value):
            yield Fault(
                f"task.parameters.{name}",
                f"expected a default value, got {value!r}",
                "use a finite number, a text, true or false",
            )
    for name in set(task.variables) & set(task.parameters):
        yield Fault(f"variables.{name}", "a parameter has this name too", "rename one of them")
    for name in set(task.places) & set(task.transitions):
        yield Fault(f"transitions.{name}", "a place has this name too", "rename one of them")


def _primitive_task(p: PrimitiveTask) -> Iterator[Fault]:
    key = f"primitive_tasks.{p.name}"
    if not p.alternatives:
        yield Fault(f"{key}.alternatives", "it has no action", "name at least one action")
    for action, n in Counter(p.alternatives).items():
        if n > 1:
            yield Fault(f"{key}.alternatives", f"{action!r} is listed {n} times", "name it once")
    for name, seconds in (("deadline", p.deadline), ("stop_within", p.stop_within)):
        yield from _time(f"{key}.{name}", seconds)
    if p.target_reliability is not None and not 0 < p.target_reliability <= 1:
        yield Fault(
            f"{key}.target_reliability",
            f"expected a probability, got {p.target_reliability}",
            "give 0 < R <= 1",
        )
    if not _COST.match(p.cost):
        yield Fault(
            f"{key}.cost",
            f"unknown cost measure {p.cost!r}",
            "write wall, cpu, count or value:NAME",
        )
    yield from _estimates(p, f"{key}.estimates")
    for action, cost in p.costs.items():
        if action not in p.alternatives:
            yield Fault(
                f"{key}.costs.{action}",
                f"{action!r} is not an alternative of {p.name}",
                f"its alternatives are {', '.join(p.alternatives)}",
            )
        if not 0 <= cost < inf:
            yield Fault(f"{key}.costs.{action}", f"a cost of {cost}", "give a number of at least 0")


def _estimates(p: PrimitiveTask, key: str) -> Iterator[Fault]:
    for status, e in p.estimates.items():
        if not 0 <= e.share <= 1 or not e.mean >= 0 or not e.cv >= 0:
            yield Fault(
                f"{key}.{status}",
                f"expected a share from 0 to 1 and no negative mean or cv, got share {e.share}, "
                f"mean {e.mean}, cv {e.cv}",
                "correct the numbers",
            )
    total = sum(e.share for e in p.estimates.values())
    if p.estimates and abs(total - 1) > 1e-6:
        yield Fault(key, f"the shares sum to {total:g}", "make them sum to 1")


def _variable(task: Task, v: Variable) -> Iterator[Fault]:
    key = f"variables.{v.name}"
    if not v.type.admits(v.initial):
        yield Fault(
            f"{key}.initial",
            f"expected {v.type}, got {v.initial!r}",
            "change the value or the type",
        )
    if v.values and v.type is not VariableType.STR:
        yield Fault(
            f"{key}.values",
            f"only a variable of type str can list its values, not one of type {v.type}",
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
        text = f"unknown primitive task {e.by!r}" if e.by else "missing, as the event is internal"
        yield Fault(f"{key}.by", text, remedy)
    if e.scope is Scope.EXTERNAL and e.by:
        yield Fault(
            f"{key}.by",
            "a primitive task cannot raise an external event",
            "drop `by` or make it internal",
        )
    if e.scope is Scope.INTERNAL and e.memory is EventMemory.LATCHED:
        text = "an internal event is kept as long as its run is active"
        yield Fault(f"{key}.memory", text, "drop `memory`, or make the event external")
    if e.early is EarlyEvent.KEEP and (e.scope is Scope.INTERNAL or e.memory is EventMemory.PULSE):
        yield Fault(f"{key}.early", "only a latched external event can be kept", "drop `early`")
    if e.mean_wait is not None:
        yield from _time(f"{key}.mean_wait", e.mean_wait)


def _time(key: str, seconds: float) -> Iterator[Fault]:
    if not 0 < seconds <= LONGEST:
        yield Fault(
            key,
            f"expected a time above 0 and at most {LONGEST:g} s, got {seconds:g} s",
            "give a positive number of seconds",
        )


class _Names:
    """What arguments, results and arcs of one net may name beside its own places."""

    def __init__(self, task: Task, subnet: Subnet | None = None) -> None:
        parameters = {} if subnet is None else subnet.parameters
        kinds = parameters.items()
        self.subnets = task.subnets
        self.primitive_tasks = task.primitive_tasks
        self.places = {n for n, kind in kinds if kind is Parameter.PLACE}
        self.outer = set() if subnet is None else set(task.places)
        """Places of the task itself: resources that a place of a subnet may hold."""
        self.written = {*task.variables, *(n for n, k in kinds if k is Parameter.VARIABLE)}
        self.types = {n: VariableType.of(value) for n, value in task.parameters.items()}
        self.types |= {name: variable.type for name, variable in task.variables.items()}
        self.types |= {n: VariableType(k) for n, k in kinds if k in {*VariableType}}
        """Types of what may be read, where they are known."""
        self.values = {name: variable.values for name, variable in task.variables.items()}
        self.read = {*self.written, *task.parameters, *parameters} - self.places


def _net(
    task: Task,
    prefix: str,
    names: _Names,
    places: Mapping[str, Place],
    transitions: Mapping[str, Transition],
    errors_to: str,
) -> Iterator[Fault]:
    for place in places.values():
        key = f"{prefix}places.{place.name}"
        yield from _place(names, key, place)
        yield from _short_forms(task, names, key, place, places)
        if place.subnet in task.subnets and place.kind is Kind.MACRO:
            yield from _arguments_of_macro(names, key, place, places)
    for transition in transitions.values():
        key = f"{prefix}transitions.{transition.name}"
        yield from _arcs(key, transition, places, names)
        yield from _trigger(task, key, transition)
        yield from _sets(names, key, transition)
        yield from _copies(key, transition, places)
    if errors_to:
        yield from _errors_to(f"{prefix}errors.to", errors_to, places, transitions)
    yield from macro_faults(prefix, places, transitions)


def _copies(key: str, t: Transition, places: Mapping[str, Place]) -> Iterator[Fault]:
    tries = [max(1, places[a.place].tries) for a in t.inputs if a.place in places]
    copies = prod(tries)
    if copies > MOST_COPIES and max(tries) <= MOST_TRIES:
        text = f"the `tries` of its input places make {copies} cases of it"
        yield Fault(key, text, f"lower them: {MOST_COPIES} cases are the limit")


def _errors_to(
    key: str, to: str, places: Mapping[str, Place], transitions: Mapping[str, Transition]
) -> Iterator[Fault]:
    if to not in places:
        yield Fault(key, f"{to!r} is not a place{nearest(to, places)}", "declare it in [places]")
    elif places[to].kind is Kind.ACTION and not any(
        a.place == to and a.end is End.ERROR for t in transitions.values() for a in t.inputs
    ):
        remedy = f'add a transition with in = ["{to}:error"]'
        yield Fault(key, f"{to!r} is an action place whose own errors lead nowhere", remedy)


def _sets(names: _Names, key: str, t: Transition) -> Iterator[Fault]:
    for name, expression in t.sets:
        if name not in names.written:
            remedy = f"declare it in [variables]{nearest(name, names.written)}"
            yield Fault(f"{key}.set.{name}", f"{name!r} is not a variable", remedy)
        if not isinstance(expression.tree, Literal | Name):
            yield Fault(
                f"{key}.set.{name}",
                f"{expression.text!r} is neither a literal nor a name",
                "write 'text', 3, true, none, or the name of a variable or parameter",
            )
        elif unknown := sorted(expression.names - names.read):
            remedy = _literals(names.types.get(name, ""), names.values.get(name, ()), unknown[0])
            remedy += nearest(unknown[0], names.read)
            yield Fault(f"{key}.set.{name}", f"{unknown[0]!r} is not a variable", remedy)


def _literals(kind: str, values: Collection[str], text: object) -> str:
    """Say which literals `set` may write into a variable of this type, where it has `text`."""
    if values and text not in values:
        return "write one of " + few([f"\"'{value}'\"" for value in values])
    if kind == VariableType.BOOL:
        return "write true or false"
    if kind in (VariableType.INT, VariableType.FLOAT):
        return f"write {'a whole number' if kind == VariableType.INT else 'a number'}"
    return f"texts stand in quotes: \"'{text}'\""


def _short_forms(
    task: Task, names: _Names, key: str, p: Place, places: Mapping[str, Place]
) -> Iterator[Fault]:
    """Faults in what a place says in short: tries, timeout, listen, holds."""
    runs = p.kind is Kind.ACTION
    given = {
        "tries": p.tries != 1,
        "retry_unknown": p.retry_unknown,
        "timeout": p.timeout is not None,
    }
    for name in (n for n, is_given in given.items() if is_given and not runs):
        yield Fault(f"{key}.{name}", f"a {p.kind} place runs no action", f"drop `{name}`")
    if not 1 <= p.tries <= MOST_TRIES:
        remedy = f"give 1 or more, at most {MOST_TRIES}; for more, lead its error back to the place"
        yield Fault(f"{key}.tries", f"{p.tries} tries", remedy)
    if p.tries > 1 and p.servers is not None:
        text = "the tries of several tokens in one place cannot be told apart"
        yield Fault(f"{key}.tries", text, "drop `servers`, or use several places")
    if p.retry_unknown and p.tries == 1:
        yield Fault(f"{key}.retry_unknown", "there is only one try", "give `tries`")
    if p.timeout is not None and runs:
        primitive = task.primitive_tasks.get(p.task)
        yield from _time(f"{key}.timeout", p.timeout)
        if primitive is not None and p.timeout > primitive.deadline:
            text = f"{p.timeout} s is longer than the deadline of {p.task}, {primitive.deadline} s"
            yield Fault(f"{key}.timeout", text, "give less, or raise the deadline")
    if p.listen and p.kind not in (Kind.ACTION, Kind.PLAIN):
        yield Fault(
            f"{key}.listen", f"a place of kind {p.kind} listens to nothing", "drop `listen`"
        )
    if p.holds and p.kind not in (Kind.ACTION, Kind.PLAIN, Kind.MACRO):
        text = f"a {p.kind} place holds nothing: the operator or another branch may fill it"
        yield Fault(f"{key}.holds", text, "drop `holds`, or leave `kind` out")
    if p.holds and p.kind is Kind.MACRO and not p.subnet:
        yield Fault(f"{key}.holds", "this macro place only shows what is in it", "drop `holds`")
    for resource in p.holds:
        here = places.get(resource) or (task.places.get(resource) if names.outer else None)
        if here is None and resource in names.places:
            continue  # judged when it is bound
        if here is None or here.kind is not Kind.RESOURCE:
            resources = {
                q.name for q in (*task.places.values(), *places.values()) if q.kind is Kind.RESOURCE
            }
            remedy = f'name a place with kind = "resource"{nearest(resource, resources)}'
            if here is not None and here.kind is Kind.PLAIN:
                remedy = f'write kind = "resource" in places.{here.name}, or name such a place'
            yield Fault(f"{key}.holds", f"{resource!r} is not a resource", remedy)


def _arguments_of_macro(
    names: _Names, key: str, p: Place, inside: Iterable[str]
) -> Iterator[Fault]:
    """Faults in what a macro place gives to the parameters of its subnet."""
    subnet = names.subnets[p.subnet]
    parameters, values = (
        subnet.parameters,
        [v for q in subnet.places.values() for v in q.args.values()],
    )
    read = {v.variable for v in values if isinstance(v, Reference)} - names.read
    for name in sorted({*p.args, *parameters}):
        if name in read - {*parameters}:
            continue  # the subnet reads what it does not declare: that is reported there
        if name not in parameters:
            remedy = f"drop it, or declare it in [subnets.{p.subnet}.parameters]"
            yield Fault(f"{key}.args.{name}", f"{p.subnet!r} has no such parameter", remedy)
        elif name not in p.args:
            kind = parameters[name]
            yield Fault(f"{key}.args", f"{name!r} is missing", f"give it; it is of kind {kind}")
        else:
            known = names.written if parameters[name] is Parameter.VARIABLE else names.places
            known = known | set(inside) if parameters[name] is Parameter.PLACE else known
            yield from _argument_of_macro(
                names, f"{key}.args.{name}", parameters[name], p.args[name], known
            )


def _argument_of_macro(
    names: _Names, key: str, kind: Parameter, value: Value, known: set[str]
) -> Iterator[Fault]:
    if kind in (Parameter.PLACE, Parameter.VARIABLE):
        found = value.variable if isinstance(value, Reference) else value
        if isinstance(value, Reference):
            remedy = f"write the name of a {kind} as a text{nearest(found, known)}"
            remedy = f'write "{found}"' if found in known else remedy
            yield Fault(key, f"expected a {kind}, found the value of {found!r}", remedy)
        elif value not in known:
            remedy = f"name one{nearest(str(value), known)}"
            yield Fault(key, f"{value!r} is not a {kind}", remedy)
    elif isinstance(value, Reference):
        if value.variable not in names.read:
            remedy = f"declare it in [variables]{nearest(value.variable, names.read)}"
            yield Fault(key, f"{value.variable!r} is not a variable or parameter", remedy)
        given = names.types.get(value.variable, VariableType.ANY)
        if given is not VariableType.ANY and not VariableType(kind).holds(given):
            text = f"{value.variable} is {given}, and the parameter is {kind}"
            yield Fault(key, text, "change one of the types")
    elif not is_plain(value) or value is None or not VariableType(kind.value).admits(value):
        yield Fault(key, f"{value!r} is not of type {kind}", "change the value or the type")


def _place(names: _Names, key: str, p: Place) -> Iterator[Fault]:
    if not 0 <= p.tokens <= MOST_TOKENS:
        expected = "0 or more tokens" if p.tokens < 0 else f"at most {MOST_TOKENS:,} tokens"
        remedy = "give 0 or more" if p.tokens < 0 else "give fewer"
        yield Fault(f"{key}.tokens", f"expected {expected}, got {p.tokens}", remedy)
    if p.capacity is not None and p.capacity < max(1, p.tokens):
        yield Fault(
            f"{key}.capacity",
            f"expected a capacity of at least {p.tokens or 1}, got {p.capacity}",
            "raise it",
        )
    if p.kind is Kind.ACTION:
        yield from _action_place(names, key, p)
    elif p.task or (p.args and not p.subnet) or p.out or p.servers is not None:
        yield Fault(
            key,
            f"a place of kind {p.kind} cannot run an action",
            "drop task, args, out and servers, or make its kind action",
        )
    if p.kind is Kind.MACRO:
        if p.subnet and p.subnet not in names.subnets:
            remedy = f"name one of [subnets]{nearest(p.subnet, names.subnets)}"
            yield Fault(f"{key}.subnet", f"unknown subnet {p.subnet!r}", remedy)
        if p.tokens or p.capacity is not None:
            yield Fault(
                key, "a macro place cannot hold tokens", "put them into the places inside it"
            )
    elif p.subnet:
        yield Fault(
            f"{key}.subnet",
            f"a place of kind {p.kind} cannot have a subnet",
            "drop `subnet` or make its kind macro",
        )


def _action_place(names: _Names, key: str, p: Place) -> Iterator[Fault]:
    if p.task not in names.primitive_tasks:
        near = nearest(p.task, names.primitive_tasks)
        remedy = f'write task = "..." with one of [primitive_tasks]{near}'
        yield Fault(f"{key}.task", f"unknown primitive task {p.task!r}", remedy)
    if p.servers is not None and p.servers < 1:
        yield Fault(f"{key}.servers", f"{p.servers} servers", "give 1 or more")
    for name, value in p.args.items():
        if isinstance(value, Reference):
            if value.variable in names.places:
                text = f"{value.variable!r} is a place, which has no value"
                yield Fault(f"{key}.args.{name}", text, "name a variable or another parameter")
            elif value.variable not in names.read:
                remedy = f"declare it in [variables]{nearest(value.variable, names.read)}"
                if key.startswith("subnets."):
                    own = f"[{key.partition('.places.')[0]}.parameters]"
                    remedy = f'give its type in {own}: {value.variable} = "str"; or {remedy}'
                yield Fault(
                    f"{key}.args.{name}",
                    f"unknown variable or parameter {value.variable!r}",
                    remedy,
                )
        elif not is_plain(value):
            yield Fault(
                f"{key}.args.{name}",
                f"expected plain data, got {value!r}",
                "use finite numbers, texts, booleans, lists, tables",
            )
    for name, variable in p.out.items():
        if variable not in names.written:
            remedy = f"declare it in [variables]{nearest(variable, names.written)}"
            yield Fault(f"{key}.out.{name}", f"unknown variable {variable!r}", remedy)


def is_plain(value: Value) -> bool:
    """Whether a value is plain data that a task file can hold."""
    if isinstance(value, Mapping):
        return all(isinstance(k, str) and is_plain(v) for k, v in value.items())
    if isinstance(value, list | tuple):
        return all(is_plain(v) for v in value)
    return isinstance(value, bool | int | str) or (isinstance(value, float) and isfinite(value))


def _place_remedy(key: str, name: str, outer: Container[str]) -> str:
    """Return what to do about an arc with a place that its net does not have; `outer` are the
    places of the task, for a transition of a subnet."""
    net = key.partition(".transitions.")[0] if key.startswith("subnets.") else ""
    if name in outer:
        return (
            f'a subnet gets a place of the task as a parameter: write {name} = "place" in '
            f'[{net}.parameters], and {name} = "{name}" in the `args` of its macro places'
        )
    return f"declare it in [{net}.places]" if net else "declare it in [places]"


def _arcs(
    key: str, t: Transition, places: Mapping[str, Place], names: _Names | None = None
) -> Iterator[Fault]:
    parameters, outer = (names.places, names.outer) if names is not None else ((), ())
    ends: list[tuple[str, str, int]] = [("in", a.place, a.weight) for a in t.inputs]
    ends += [("out", a.place, a.weight) for a in t.outputs]
    ends += [("in", i.place, i.threshold) for i in t.inhibitors]
    for side, name, weight in ends:
        if name not in places and name not in parameters:
            yield Fault(
                f"{key}.{side}",
                f"unknown place {name!r}{nearest(name, places) if name not in outer else ''}",
                _place_remedy(key, name, outer),
            )
        if weight < 1:
            yield Fault(
                f"{key}.{side}",
                f"expected a weight of 1 or more for the arc with {name!r}, got {weight}",
                "give 1 or more",
            )
    ends_of = (("in", [a.place for a in t.inputs]), ("out", [a.place for a in t.outputs]))
    for side, listed_places in (*ends_of, ("in", [i.place for i in t.inhibitors])):
        for name, n in Counter(listed_places).items():
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
        remedy = (
            f"write {name}:normal, {name}:error, {name}:preempt=none (its run is stopped then) or "
            f"{name}:going (its run continues)"
        )
        yield Fault(
            key, f"{name!r} is an action place, so its arc must say when it takes the token", remedy
        )
    if place.kind is Kind.MACRO and place.subnet and arc.end not in (End.NORMAL, End.ERROR):
        yield Fault(key, f"{name!r} is a macro place", f"write {name}:normal or {name}:error")
    if place.kind in (Kind.RESOURCE, Kind.CONTROL, Kind.PLAIN) and arc.end is not None:
        yield Fault(key, f"{name!r} runs no action that could end", f"write {name} alone")
    if arc.end is End.PREEMPT and arc.counts is None:
        remedy = f"write {name}:preempt=success, =failure, =error or =none"
        yield Fault(key, f"the arc does not say how a preempted run of {name!r} counts", remedy)
    if arc.end is not End.PREEMPT and arc.counts is not None:
        yield Fault(key, f"only a preempted run counts as {arc.counts}", "drop it")
    if place.kind is Kind.ACTION and place.servers is None and arc.weight > 1:
        yield Fault(
            key,
            f"{name!r} holds one token at most, so {arc.weight} tokens never come together",
            "give the place `servers`",
        )


def _trigger(task: Task, key: str, t: Transition) -> Iterator[Fault]:
    for event in t.events:
        if event not in task.events:
            remedy = f"declare it in [events]{nearest(event, task.events)}"
            yield Fault(f"{key}.event", f"unknown event {event!r}", remedy)
    pulses = [e for e in t.events if e in task.events and is_pulse(task.events[e])]
    if len(pulses) > 1:
        remedy = "two pulses never come together: make one of them latched, or use two transitions"
        yield Fault(f"{key}.event", f"it waits for the pulses {listed(pulses)} at once", remedy)
    if len(set(t.events)) < len(t.events):
        yield Fault(f"{key}.event", "an event is listed twice", "name it once")
    if t.after is not None:
        yield from _time(f"{key}.after", t.after)
    if t.after is not None and t.events:
        remedy = "put the timer on a transition of its own beside this one"
        yield Fault(f"{key}.after", "it waits for an event and for a time", remedy)
    if t.weight is not None and not t.weight > 0:
        yield Fault(
            f"{key}.weight", f"expected a weight above 0, got {t.weight}", "give a positive number"
        )


def is_pulse(event: Event) -> bool:
    """Whether the event disappears as soon as it has occurred."""
    return event.scope is Scope.EXTERNAL and event.memory is EventMemory.PULSE


def _subnet(task: Task, s: Subnet) -> Iterator[Fault]:
    key = f"subnets.{s.name}"
    ports = [("entry", s.entry), ("normal", s.normal)] + ([("error", s.error)] if s.error else [])
    for port, place in ports:
        if place not in s.places:
            remedy = f"name one of its places{nearest(place, s.places)}"
            yield Fault(f"{key}.{port}", f"the subnet has no place {place!r}", remedy)
        elif port != "entry" and s.places[place].kind in (Kind.ACTION, Kind.MACRO):
            yield Fault(
                f"{key}.{port}",
                f"{place!r} is of kind {s.places[place].kind}",
                "end in a place without `kind`",
            )
    for name in set(s.places) & set(s.transitions):
        yield Fault(f"{key}.transitions.{name}", "a place has this name too", "rename one of them")
    for name in (*s.places, *s.transitions):
        if not _IDENTIFIER.match(name):
            yield Fault(f"{key}.{name}", f"{name!r} cannot be a name", "use letters, digits and _")
    for name in sorted({*s.parameters} & {*s.places, *task.variables, *task.parameters}):
        text = f"{name!r} is also a place of the subnet, a variable or a parameter of the task"
        yield Fault(f"{key}.parameters.{name}", text, "rename one of them")
    names = _Names(task, s)
    yield from _net(task, f"{key}.", names, s.places, s.transitions, s.errors_to)


def _whole(task: Task) -> Iterator[Fault]:
    """Find faults that can be judged only when all parts are right: macro places, conditions,
    predicates."""
    try:
        flat = task.flat
    except CircleError as circle:
        yield Fault(circle.key, str(circle), "break the circle")
        return
    domains = condition_domains(flat)
    places = {
        name for net in (task.places, *(s.places for s in task.subnets.values())) for name in net
    }
    seen: set[tuple[str, str]] = set()
    for t in flat.transitions.values():
        key, written = _written(task, t)
        if t.when is not None and not t.expanded_from:
            own = written.when if written is not None else None
            when, meanings = _as_written(own, t.when, t.name, domains)
            for fault in _expression(f"{key}.when", when, meanings, places):
                if (fault.key, fault.text) not in seen:
                    seen.add((fault.key, fault.text))
                    yield fault
        for name, expression in t.sets:
            yield from _value(f"{key}.set.{name}", name, expression, domains)
    if flat is not task:
        yield from _expanded_arcs(task, flat)
    for key, predicate in (("task.final", task.final), ("task.final_error", task.final_error)):
        if predicate is not None:
            yield from _expression(key, predicate, marking_domains(flat))
    if task.runs_place and (
        task.runs_place not in flat.places or flat.places[task.runs_place].kind is not Kind.CONTROL
    ):
        known = [p.name for p in flat.places.values() if p.kind is Kind.CONTROL]
        remedy = f"name one of {listed(known)}{nearest(task.runs_place, known)}"
        yield Fault("task.runs_place", f"expected a control place, got {task.runs_place!r}", remedy)
    for name in task.goal_transitions:
        if name not in flat.transitions:
            remedy = f"name a transition{nearest(name, flat.transitions)}"
            yield Fault("task.goal_transitions", f"unknown transition {name!r}", remedy)


def _macro_exits(task: Task) -> Iterator[Fault]:
    """Arcs `macro:error` need a subnet with an error port."""
    levels = [("", task.places, task.transitions)]
    levels += [(f"subnets.{s.name}.", s.places, s.transitions) for s in task.subnets.values()]
    for prefix, places, transitions in levels:
        for t in transitions.values():
            for arc in t.inputs:
                place = places.get(arc.place)  # None: a parameter of the subnet stands for it
                if (
                    place is not None
                    and place.kind is Kind.MACRO
                    and arc.end is End.ERROR
                    and not task.subnets[place.subnet].error
                ):
                    remedy = f"give subnets.{place.subnet} an `error` place"
                    yield Fault(
                        f"{prefix}transitions.{t.name}.in",
                        f"{arc.place!r} has no error exit",
                        remedy,
                    )


def _expression(
    key: str, expression: Expression, domains: Mapping[str, Domain], places: Collection[str] = ()
) -> Iterator[Fault]:
    unknown = sorted(expression.names - domains.keys())
    remedy = f"it may read {few(sorted(domains)) or 'variables and parameters'}" if unknown else ""
    if tokens := [name for name in unknown if name in places]:
        remedy = f'tokens are tested by arcs: in = ["{tokens[0]}"], or "!{tokens[0]}": it is empty'
    for text in kind_faults(expression, domains):
        yield Fault(key, f"in {expression.text!r}, {text}", remedy)


def _value(
    key: str, name: str, expression: Expression, domains: Mapping[str, Domain]
) -> Iterator[Fault]:
    """A new value that its variable cannot hold."""
    into, tree = domains[name], expression.tree
    if isinstance(tree, Name):
        if not VariableType(into.kind).holds(VariableType(domains[tree.name].kind)):
            text = f"{tree.name} is {domains[tree.name].kind}, {name} is {into.kind}"
            yield Fault(key, text, "change one of the types")
    elif isinstance(tree, Literal):
        if not VariableType(into.kind).admits(tree.value):
            remedy = _literals(into.kind, into.values, tree.value)
            yield Fault(key, f"{tree.value!r} is not of type {into.kind}", remedy)
        elif into.values and tree.value is not None and tree.value not in into.values:
            remedy = _literals(into.kind, into.values, tree.value)
            yield Fault(key, f"{tree.value!r} is not among the `values` of {name}", remedy)


def _expanded_arcs(task: Task, flat: Task) -> Iterator[Fault]:
    """Arcs that are wrong only once parameters and held resources are in place."""
    nets = [task.places, *(s.places for s in task.subnets.values())]
    held = {name for places in nets for p in places.values() for name in p.holds}
    seen: set[tuple[str, str]] = set()
    for t in flat.transitions.values():
        key, _ = _written(task, t)
        for fault in _arcs(key, t, flat.places):
            if (fault.key, fault.text) not in seen:
                seen.add((fault.key, fault.text))
                twice = any(f"{name!r}" in fault.text for name in held)
                remedy = "drop that arc: `holds` makes it" if twice else fault.remedy
                yield Fault(fault.key, fault.text, remedy)


def _written(task: Task, t: Transition) -> tuple[str, Transition | None]:
    """The key in the task file of what a flat transition was made from, and that transition as it
    is written there; None if a place's short form made it."""
    *macros, name = (t.expanded_from or t.name).split(".")
    key, places, transitions = "", task.places, task.transitions
    for macro in macros:
        subnet = task.subnets[places[macro].subnet]
        key, places, transitions = f"subnets.{subnet.name}.", subnet.places, subnet.transitions
    group = "transitions" if name in transitions else "places"
    return f"{key}{group}.{name}", transitions.get(name)


def _as_written(
    written: Expression | None, full: Expression, transition: str, domains: Mapping[str, Domain]
) -> tuple[Expression, Mapping[str, Domain]]:
    """A condition as the subnet of the flat transition writes it, and what each name in it can be:
    its full form has literals instead of parameters, and names with the macro place before them."""
    leaves, full_leaves = (
        [node for node in walk(e.tree) if isinstance(node, Name | Literal)]
        for e in (written or full, full)
    )
    if written is None or len(leaves) != len(full_leaves):
        return full, domains
    prefix = transition[: transition.rfind(".") + 1]
    known = {
        name.removeprefix(prefix): domain
        for name, domain in domains.items()
        if name.startswith(prefix) or "." not in name
    }
    for node, meant in zip(leaves, full_leaves, strict=True):
        if isinstance(node, Name) and isinstance(meant, Literal):
            known[node.name] = Domain(VariableType.of(meant.value).value)
        elif isinstance(node, Name) and isinstance(meant, Name) and meant.name in domains:
            known[node.name] = domains[meant.name]
    return written, known
