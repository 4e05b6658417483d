"""Whether a task fits the code of its actions: arguments, results, causes of errors, events, and
what an action does that would fail only when it runs.

The code itself is read by `services.comm.location_file.code`, which gives plain data by action.
Actions of other hosts are not known here and are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

from petrobot.coordinator.task import (
    End,
    Place,
    PrimitiveTask,
    Reference,
    Scope,
    Start,
    Task,
    VariableType,
)
from petrobot.coordinator.task.check.findings import Finding
from petrobot.coordinator.task.conditions import Compare, Literal, Name, walk
from petrobot.coordinator.task.wording import Severity, few, listed, nearest

Code = Mapping[str, Mapping[str, Any]]
"""By action: what `services.code_reading` found in it, and as `device` the same of its driver."""
RUNTIME = (
    *("bad_arguments", "bad_result", "busy", "cancelled", "command_not_taken", "command_refused"),
    *("crashed", "deadline", "device_died", "device_fenced", "device_leased"),
    *("device_needs_coordinator", "device_overtaken", "emergency_stop", "exception", "fenced"),
    *("forgotten", "hung", "id_taken", "import_failed", "local_only", "lost", "no_answer"),
    *("node_lost", "node_silent", "not_accepted", "not_for_role", "not_ready", "not_welcome"),
    *("old_epoch", "orphan", "out_of_memory", "rebooted", "refused", "resumed", "stopped"),
    *("too_large", "too_many_events", "unencodable", "unknown_service", "unreachable"),
    *("worker_died",),
)
"""Causes that the runtime gives to runs of any action."""
_FITS: Mapping[str, tuple[type, ...]] = {
    "bool": (bool,),
    "int": (int,),
    "float": (int, float),
    "str": (str,),
    "list": (list, tuple),
    "dict": (dict,),
}


def code_findings(
    task: Task,
    code: Code,
    args: Mapping[str, Mapping[str, Any]],
    services: Mapping[str, Mapping[str, Any]],
    drivers: Collection[Mapping[str, Any]] = (),
    raised: Collection[str] = (),
    timers: Mapping[str, str] = MappingProxyType({}),
) -> Iterator[Finding]:
    """What does not fit. `args` are the arguments of each action in the location file, `services`
    what is known of each other service that it offers, `drivers` what is known of the drivers of
    all its devices, `raised` the events that it is known to raise, and `timers` where it declares
    each timer."""
    given = {"prepare": {*task.parameters, "seed", "runs"}, "score": {"cycles"}}
    for key, service in (("prepare", task.prepare), ("score", task.score)):
        if service and service not in services:
            text = f"there is no service {service!r}{nearest(service, services)}"
            remedy = f"declare [services.{service}] in the location file, or drop the key"
            if service in args:
                text = f"{service!r} is an action, and not a service"
                remedy = f"move it to [services.{service}] in the location file, or drop the key"
            yield Finding(Severity.ERROR, "no-service", f"task.{key}", text, remedy)
        elif text := _called(key, service, services.get(service, {}), given[key]):
            remedy = f"write its parameters as `ctx, *, {listed(given[key])}`"
            yield Finding(Severity.ERROR, "code", f"task.{key}", text, remedy)
    placed = {p.task: None for p in task.flat.places.values() if p.task}
    used = dict.fromkeys(
        a for name in placed for a in task.primitive_tasks[name].alternatives if a in code
    )
    # First what the code itself does wrong: what follows may follow from it.
    actions = [code[action] for action in used]
    for kind, severity in (("faults", Severity.ERROR), ("doubtful", Severity.WARNING)):
        found = {tuple(one) for facts in (*actions, *drivers) for one in facts.get(kind, ())}
        for file, line, text in sorted(found):
            yield Finding(severity, "code", f"{file}:{line}", text)
    yield from argument_findings(task, code, args)
    for place in task.flat.places.values():
        if place.task:
            primitive = task.primitive_tasks[place.task]
            known = [a for a in primitive.alternatives if a in code]
            if known and len(known) == len(primitive.alternatives):
                yield from _values(place, [code[a] for a in known])
            for action in known:
                yield from _kinds(task, place, action, code[action])
    for primitive in task.primitive_tasks.values():
        yield from _causes(primitive, code)
        yield from _reasons(task, primitive, code)
        yield from _too_long(primitive, code)
        yield from _costs(primitive, code)
    if code.keys() >= args.keys():
        yield from _never_written(used, code, services.values())
    yield from _unraised(task, code)
    by_drivers = {*timers, *(name for facts in drivers for name in facts.get("events", ()))}
    for action in used:
        yield from _events(task, action, code[action], by_drivers)
        yield from _unknown_services(code[action], {*services, *args})
    yield from dict.fromkeys(f for action in used for f in _unknown_states(code[action]))
    yield from _undeclared(task, drivers, raised, timers)


def _unknown_states(facts: Mapping[str, Any]) -> Iterator[Finding]:
    """What an action reads of its device's state, and the driver's `state` does not return; and
    what it uses of the device itself that is not there."""
    device: Mapping[str, Any] = facts.get("device") or {}
    known, members = device.get("state"), device.get("members")
    for name, (file, line) in facts.get("uses", {}).items():
        if members is not None and name not in members:
            driver = device["classes"][0].partition(":")[2]
            text = f"`ctx.device` has no {name!r}{nearest(name, members)}"
            remedy = f"write it in {driver}, or correct the name"
            if known is not None:
                remedy = (
                    f"{driver} runs in another process: write `await ctx.command({{...}})`, or "
                )
                remedy += "read `ctx.device.state`"
            yield Finding(Severity.ERROR, "code", f"{file}:{line}", text, remedy)
    for name, (file, line) in facts.get("reads", {}).items():
        if known is not None and name not in known:
            driver = device["classes"][0].partition(":")[2]
            text = f"the state of {driver} has no {name!r}{nearest(name, known)}"
            remedy = f"its `state` returns {listed(known) or 'nothing'}"
            yield Finding(Severity.ERROR, "code", f"{file}:{line}", text, remedy)


def _called(key: str, name: str, facts: Mapping[str, Any], given: Collection[str]) -> str:
    """Return why `prepare` or `score` cannot be called with its arguments; empty if it can, or if
    its parameters are not known."""
    if "parameters" not in facts:
        return ""
    unknown = [] if facts["open"] else sorted({*given} - {*facts["parameters"]})
    missing = sorted({*facts["required"]} - {*given})
    if not unknown and not missing:
        return ""
    said = [f"does not take {listed(unknown)}"] if unknown else []
    said += [f"needs {listed(missing)}, which `{key}` does not give"] if missing else []
    return f"{name!r} {' and '.join(said)}"


def _too_long(primitive: PrimitiveTask, code: Code) -> Iterator[Finding]:
    """Constant times for which an action sleeps or waits until after its deadline."""
    for action in primitive.alternatives:
        for seconds, file, line, call in sorted(code.get(action, {}).get("lasts", ())):
            if seconds > primitive.deadline:
                text = f"`{call}` lasts {seconds:g} s, longer than the deadline of {primitive.name}"
                text += f" ({primitive.deadline:g} s)"
                remedy = "give less time here, or a later deadline"
                yield Finding(Severity.WARNING, "code", f"{file}:{line}", text, remedy)


def _unknown_services(facts: Mapping[str, Any], known: Collection[str]) -> Iterator[Finding]:
    """Services that an action calls and no node offers."""
    for name, (file, line) in facts.get("calls", {}).items():
        if name not in known:
            text = f"there is no service {name!r}{nearest(name, known)}"
            remedy = f"declare [services.{name}] in the location file"
            yield Finding(Severity.WARNING, "code", f"{file}:{line}", text, remedy)


def _never_written(
    used: Iterable[str], code: Code, others: Iterable[Mapping[str, Any]]
) -> Iterator[Finding]:
    """Variables of the global memory that an action reads and no action or service writes: only if
    the code of all of them is known."""
    every = [*code.values(), *others]
    if any(facts.get("any_put", True) for facts in every):
        return
    put = {name for facts in every for name in facts["puts"]}
    for action in used:
        for name, (file, line) in code[action]["gets"].items():
            if name not in put:
                text = f"no action or service writes {name!r}{nearest(name, put)}, so it is None"
                remedy = f"write it with `ctx.put({name!r}, ...)`, or give a default here"
                yield Finding(Severity.WARNING, "code", f"{file}:{line}", text, remedy)


def argument_findings(
    task: Task, code: Code, args: Mapping[str, Mapping[str, Any]]
) -> Iterator[Finding]:
    """Arguments of places that their actions do not have or that do not fit, and those that are
    missing."""
    flat = task.flat
    types = {name: VariableType.of(value) for name, value in task.parameters.items()}
    types |= {variable.name: variable.type for variable in flat.variables.values()}
    for place in flat.places.values():
        for action in task.primitive_tasks[place.task].alternatives if place.task else ():
            if action in code:
                yield from _arguments(place, action, code[action], args.get(action, {}), types)


def given_findings(
    code: Code, args: Mapping[str, Mapping[str, Any]], where: Callable[[str], str]
) -> Iterator[Finding]:
    """Arguments and devices of actions in the location file that do not fit; `where` returns a key
    of that file with file and line."""
    for action in sorted(args.keys() & code.keys()):
        wants, classes = code[action].get("wants"), code[action]["device"].get("classes")
        if wants and classes and wants[1] not in classes:
            text = f"its `ctx` is a Context[{wants[0]}], and the device's driver is"
            text += f" {classes[0].partition(':')[2]}"
            remedy = "correct the device, or the annotation"
            key = where(f"actions.{action}.device")
            yield Finding(Severity.WARNING, "code", key, text, remedy)
        known = code[action].get("parameters", {})
        for name, value in args[action].items():
            if name in known and not _fits(value, known[name]):
                key = where(f"actions.{action}.args.{name}")
                yield _unlike(key, action, name, known[name], f"{value!r}")


def occupied(task: Task, devices: Mapping[str, str]) -> Iterator[Finding]:
    """Places that listen from the beginning with a device that other places wait for; `devices` by
    action."""
    users: dict[str, set[str]] = {}
    arcs = [arc for t in task.flat.transitions.values() for arc in t.inputs]
    preempted = {arc.place for arc in arcs if arc.end is End.PREEMPT}
    for place in task.flat.places.values():
        if place.task:
            for action in task.primitive_tasks[place.task].alternatives:
                users.setdefault(devices.get(action, ""), set()).add(place.name)
    for device, names in users.items():
        for name in sorted(names) if device else ():
            waiting = sorted(
                other
                for other in names - {name}
                if task.primitive_tasks[task.flat.places[other].task].start is not Start.AT_ONCE
            )
            place = task.flat.places[name]
            if place.listen and place.tokens and waiting and name not in preempted:
                text = f"it listens, and its run keeps {device} until it ends"
                text += f": {few(waiting)} {'wait' if len(waiting) > 1 else 'waits'} for it"
                remedy = "let the listening action use a device of its own, or none"
                yield Finding(Severity.WARNING, "occupied", f"places.{name}", text, remedy)


def _arguments(
    place: Place,
    action: str,
    facts: Mapping[str, Any],
    given: Mapping[str, Any],
    types: Mapping[str, VariableType],
) -> Iterator[Finding]:
    if "parameters" not in facts:
        return
    key, known = f"places.{place.name}.args", facts["parameters"]
    for name, value in place.args.items():
        if name not in known:
            if not facts["open"]:
                text = f"the action {action!r} has no argument {name!r}{nearest(name, known)}"
                remedy = f"it has: {listed(known)}" if known else "it has none: drop this"
                yield Finding(Severity.ERROR, "code", f"{key}.{name}", text, remedy)
        elif isinstance(value, Reference):
            kind = types.get(value.variable, VariableType.ANY)
            if not _may_be(kind, known[name]):
                found = f"{value.variable}, which is {kind}"
                yield _unlike(f"{key}.{name}", action, name, known[name], found)
        elif not _fits(value, known[name]):
            yield _unlike(f"{key}.{name}", action, name, known[name], f"{value!r}")
    misnamed = not facts["open"] and not {*place.args} <= {*known}
    for name in facts["required"] if not misnamed else ():
        if name not in place.args and name not in given:
            text = f"the action {action!r} needs the argument {name!r}"
            remedy = f"give args = {{ {name} = ... }} here or in [actions.{action}]"
            yield Finding(Severity.ERROR, "code", key, text, remedy)


def _unlike(key: str, action: str, name: str, kind: str, found: str) -> Finding:
    text = f"the action {action!r} expects {name}: {kind}, found {found}"
    remedy = "correct the value, or the annotation"
    return Finding(Severity.WARNING, "code", key, text, remedy)


def _may_be(given: str, wanted: str) -> bool:
    """Return whether a value of the one type may be one of the other; a number may be a whole
    one."""
    numbers = ("int", "float")
    known = given in _FITS and wanted in _FITS
    return not known or given == wanted or (given in numbers and wanted in numbers)


def _fits(value: Any, kind: str) -> bool:
    if kind not in _FITS or value is None:
        return True
    return isinstance(value, _FITS[kind]) and (kind == "bool" or not isinstance(value, bool))


def _values(place: Place, facts: list[Mapping[str, Any]]) -> Iterator[Finding]:
    """Values that `out` waits for, and no action returns."""
    if not all(f.get("complete") for f in facts):
        return
    known = sorted({value for f in facts for value in f["values"]})
    for name, variable in place.out.items():
        if name not in known:
            text = f"no action of {place.task} returns a value {name!r}"
            remedy = f"return it (success({name}=...)), or {variable} is never written"
            if known:
                text += f", but {listed(known)}{nearest(name, known)}"
                meant = variable if variable in known else known[0]
                remedy = f'write {meant} = "{variable}", or return it (success({name}=...))'
            yield Finding(Severity.ERROR, "code", f"places.{place.name}.out.{name}", text, remedy)


def _kinds(task: Task, place: Place, action: str, facts: Mapping[str, Any]) -> Iterator[Finding]:
    """Values of results that `out` writes to a variable of another type."""
    for name, variable in place.out.items():
        wanted = task.flat.variables[variable].type
        for kind, (file, line) in facts.get("values", {}).get(name, {}).items():
            if not _may_be(kind, wanted) and wanted is not VariableType.ANY:
                text = f"{action!r} gives {name} as {kind} ({file}:{line}), and the variable "
                key = f"places.{place.name}.out.{name}"
                text += f"{variable} is {wanted}"
                remedy = "change one of the types"
                yield Finding(Severity.WARNING, "code", key, text, remedy)


def _causes(primitive: PrimitiveTask, code: Code) -> Iterator[Finding]:
    """Declared causes that no action can give, and causes that are not declared."""
    facts = [code[a] for a in primitive.alternatives if "causes" in code.get(a, {})]
    if not primitive.error_causes or len(facts) < len(primitive.alternatives):
        return
    key = f"primitive_tasks.{primitive.name}.error_causes"
    possible = {cause for f in facts for cause in f["causes"]}
    # A cause held in a variable often comes from the driver.
    open_ones = [f for f in facts if not f["complete"]]
    said = possible | {w for f in open_ones for w in (*f["words"], *f["device"].get("words", ()))}
    for cause in primitive.error_causes:
        if cause not in said and cause not in RUNTIME:
            text = f"no action of {primitive.name} returns the error {cause!r}"
            remedy = f"drop it{nearest(cause, sorted(possible))}"
            yield Finding(Severity.WARNING, "code", f"{key}.{cause}", text, remedy)
    if undeclared := sorted(possible - {*primitive.error_causes}):
        text = f"its actions also return {listed(undeclared)}"
        remedy = "declare each with a sentence for people"
        yield Finding(Severity.WARNING, "code", key, text, remedy)


def _reasons(task: Task, primitive: PrimitiveTask, code: Code) -> Iterator[Finding]:
    """Conditions that compare the cause of a run with one that no action can give."""
    facts = [code[a] for a in primitive.alternatives if "causes" in code.get(a, {})]
    if len(facts) < len(primitive.alternatives):
        return
    said = {w for f in facts for w in (*f["words"], *f.get("device", {}).get("words", ()))}
    said |= {*primitive.error_causes, *(cause for f in facts for cause in f["causes"])}
    nets = [("", task.flat.places, task.transitions)]
    nets += [(f"subnets.{s.name}.", s.places, s.transitions) for s in task.subnets.values()]
    for prefix, places, t in ((net[0], net[1], t) for net in nets for t in net[2].values()):
        reasons = {f"{p.name}.reason" for p in places.values() if p.task == primitive.name}
        for node in walk(t.when.tree) if t.when is not None else ():
            sides = {node.left, node.right} if isinstance(node, Compare) else set()
            names = {one.name for one in sides if isinstance(one, Name)}
            causes = {one.value for one in sides if isinstance(one, Literal)}
            for cause in causes - said - {*RUNTIME} if names & reasons else ():
                if not isinstance(cause, str) or not cause.isidentifier():
                    continue
                hint = nearest(cause, sorted({c for f in facts for c in f["causes"]}))
                if hint or all(f["complete"] for f in facts):
                    text = f"no action of {primitive.name} ends with the cause {cause!r}{hint}"
                    remedy = "correct it, or let the action return it"
                    key = f"{prefix}transitions.{t.name}.when"
                    yield Finding(Severity.WARNING, "code", key, text, remedy)


def _costs(primitive: PrimitiveTask, code: Code) -> Iterator[Finding]:
    """The value of the result that is the cost, where an action never returns it."""
    kind, _, name = primitive.cost.partition(":")
    for action in primitive.alternatives if kind == "value" else ():
        facts = code.get(action, {})
        known = sorted(facts.get("values", ()))
        if facts.get("complete") and name not in known:
            text = f"the action {action!r} returns no value {name!r}{nearest(name, known)}"
            remedy = f"return it (success({name}=...)), or write another cost"
            key = f"primitive_tasks.{primitive.name}.cost"
            yield Finding(Severity.WARNING, "code", key, text, remedy)


def _unraised(task: Task, code: Code) -> Iterator[Finding]:
    """Internal events that a transition waits for, and no action of their primitive task raises: an
    external event does not become internal by its declaration."""
    awaited = {name for t in task.flat.transitions.values() for name in t.events}
    for name in sorted(awaited):
        event = task.events[name]
        if event.scope is not Scope.INTERNAL:
            continue
        alternatives = task.primitive_tasks[event.by].alternatives
        facts = {a: code[a] for a in alternatives if "events" in code.get(a, {})}
        silent = [a for a, f in facts.items() if name not in f["events"] and not f["any_event"]]
        if silent:
            none = len(silent) == len(alternatives)
            text = f"{listed(silent)} of {event.by} never raises {name!r}, for which the task waits"
            remedy = f'call ctx.raise_event("{name}") there, or write scope = "external"'
            severity = Severity.ERROR if none else Severity.WARNING
            yield Finding(severity, "code", f"events.{name}.by", text, remedy)


def _undeclared(
    task: Task,
    drivers: Iterable[Mapping[str, Any]],
    raised: Collection[str],
    timers: Mapping[str, str],
) -> Iterator[Finding]:
    """Events that a driver or a timer raises and the task does not have, while the task has one
    that nothing raises. Otherwise they are those of other tasks."""
    silent = [e.name for e in task.events.values()
              if e.scope is Scope.EXTERNAL and e.name not in raised]  # fmt: skip
    sources = {name: ("driver", f"{place[0]}:{place[1]}") for driver in drivers
               for name, place in driver.get("events", {}).items()}  # fmt: skip
    sources |= {name: ("timer", place) for name, place in timers.items()}
    for name, (source, place) in sorted(sources.items()) if silent else ():
        if name not in task.events:
            hint = nearest(name, silent)
            text = f"a {source} raises the event {name!r}, which the task does not declare{hint}"
            text += "" if hint else f", and nothing raises {listed(silent)}"
            remedy = f"correct the name, or declare [events.{name}]"
            severity = Severity.WARNING if hint else Severity.NOTE
            yield Finding(severity, "code", place, text, remedy)


def _events(
    task: Task, action: str, facts: Mapping[str, Any], outside: Collection[str]
) -> Iterator[Finding]:
    """Internal events that the action raises and the task does not know as such. `outside`: what
    drivers and timers raise."""
    raisers = {p.name for p in task.primitive_tasks.values() if action in p.alternatives}
    by = "by = " + " or ".join(f'"{name}"' for name in sorted(raisers))
    own = f"let the action raise an event of another name, declared with {by}"
    for name, (file, line) in facts.get("events", {}).items():
        event = task.events.get(name)
        text = f"{action!r} raises the event {name!r}, "
        if event is None:
            text += f"which the task does not declare{nearest(name, task.events)}"
            remedy = f"declare [events.{name}] {by}"
        elif event.scope is not Scope.INTERNAL:
            text += "which is external: only a driver (`self.ports.raise_event`), a timer or the "
            text, remedy = text + "operator raises it", own
            if name not in outside:
                remedy += f'; or, if only the action raises it, write scope = "internal" and {by}'
        elif event.by not in raisers:
            text, remedy = f"{text}which is internal to {event.by}", f"write {by}, or {own}"
        else:
            continue
        yield Finding(Severity.WARNING, "code", f"{file}:{line}", text, remedy)
