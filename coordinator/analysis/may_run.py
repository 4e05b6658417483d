"""May this task run? The findings on its file and the verdicts on its state space, together.

`petrobot check`, `run`, `campaign` and the page ask here. They differ in what they do with the
answer, not in the question.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.engine import EventOccurred, Phase
from petrobot.coordinator.task import End, Input, Kind, Scope, Status, Task, Transition
from petrobot.coordinator.task.check import CheckReport, Finding, Severity, check, in_file
from petrobot.coordinator.task.check.completeness import (
    EXTERNAL_WAIT,
    UNCOVERED,
    external_waits,
    uncovered_exits,
)
from petrobot.coordinator.task.check.conflicts import idle_weights, lent
from petrobot.coordinator.task.check.findings import subnet_of, subnets_of
from petrobot.coordinator.task.validation import is_pulse
from petrobot.coordinator.task.wording import listed, wrapped

if TYPE_CHECKING:  # the search needs numpy, which a command that only reads the file does without
    from petrobot.coordinator.analysis.execution.graph import ExecutionGraph
    from petrobot.coordinator.analysis.execution.progress import Contest
    from petrobot.coordinator.analysis.net.space import SearchLimits
    from petrobot.coordinator.analysis.net.verdict import PropertyVerdict
    from petrobot.coordinator.analysis.report import Analysis
    from petrobot.coordinator.engine import State


class Cell(Struct, frozen=True):
    """What a location file offers."""

    offers: Mapping[str, str]
    """The node of each action."""
    source: str = "services.toml"
    """The location file."""
    devices: Mapping[str, str] | None = None
    """The device of each action that has one."""
    translates: Mapping[str, str] | None = None
    """The primitive task that each action translates, as its file says; None: not compared."""
    periods: Mapping[str, float] = field(default_factory=dict)
    """The period of each event that a timer raises (s)."""


def devices_of(cell: Cell | None) -> Mapping[str, str] | None:
    """Return the device of each action that has one; None where that is not known."""
    return None if cell is None else cell.devices


def assumed(cell: Cell | None) -> str:
    """Say which cell a judgement assumes."""
    if cell is None or cell.devices is None:
        return "no location file: actions are assumed not to share devices"
    return f"two runs never use one device at a time; the devices are those of {cell.source}"


class Budget(Struct, frozen=True):
    """What a judgement may cost. It is counted in states and not in seconds, so that a task gets
    the same verdict on every machine."""

    markings: int = 100_000
    """The most markings of the ends net; they take about a second."""
    steps: int = 60_000
    """The most stimuli and firings of the engine for the execution graph; they take about four
    seconds. The shipped tasks need less than a third of it."""

    def limits(self) -> SearchLimits:
        """Return the budget as limits of a search."""
        from petrobot.coordinator.analysis.net.space import SearchLimits

        return SearchLimits(states=self.markings)


LEFT_RUNNING = "left-running"
"""Code of the finding that a transition leaves a run behind that should have been preempted."""

LATE = "deadline-too-short"
"""Code of the finding that runs are ended before they succeed, as their place is declared."""

BUDGET = Budget()
"""The budget of `petrobot check`, `run` and the page. `petrobot analyse` has limits of its own."""

WORDS: Mapping[str, str] = {
    "bounded": "Tokens stay bounded",
    "safe": "Never two tokens in a place",
    "deadlock_free": "Never stuck before its end",
    "quasi_live": "Every transition can fire",
    "live": "Every transition can fire again, whatever happened",
    "proper": "Ready for the next mission, whatever happened",
    "reversible": "Can come back to its beginning",
    "one_run_each": "One run at a time in each action place",
    "returned": "Every resource is back at the end",
    "sound": "Can end properly from everywhere",
    "stable": "Comes back to its nominal flow after errors",
    "controllable": "Every error can be recovered from",
}
"""A sentence for each verdict that needs to be true."""


class MayRun(Struct, frozen=True):
    """The answer. `analysis` is None where no search was asked for or the file is inconsistent."""

    task: Task
    report: CheckReport
    analysis: Analysis | None

    @property
    def ok(self) -> bool:
        """Whether nothing found forbids running the task."""
        return self.report.ok and (self.analysis is None or not self.analysis.objections)

    def refusal(self, cell: str = "") -> str:
        """The findings that forbid running the task, in words; empty if there are none. `cell`
        names the location file."""
        if self.report.ok:
            return ""
        found = "\n".join(map(_line, self.report.errors))
        return f"{self.task.name} may not run{f' with {cell}' if cell else ''}:\n{found}"

    def objections(self) -> list[str]:
        """What the state space shows against running the task, a line for each."""
        found = {} if self.analysis is None else self.analysis.objections
        return [
            f"{self.task.name}: {name.replace('_', ' ')}: {verdict.reason}"
            for name, verdict in found.items()
        ]


def may_run(task: Task, cell: Cell | None = None, budget: Budget | None = None) -> MayRun:
    """Judge the task in a cell (None: whether its actions are offered is not examined).

    With a budget the state space is searched as well.
    """
    report = (
        check(task)
        if cell is None
        else check(task, cell.offers, translates=cell.translates, source=cell.source)
    )
    if any(finding.code == "inconsistent" for finding in report.errors):
        return MayRun(task, report, None)
    report = CheckReport(in_file(task, (*report.findings, *_late(task))))
    if budget is None:
        return MayRun(task, report, None)
    analysis = _search(task, budget, devices_of(cell))
    found = (*_left_running(task, analysis), *_with_graph(task, report, analysis).findings)
    report = CheckReport(in_file(task, found))
    return MayRun(task, report, replace(analysis, refused=not report.ok))


def left_to_search(finding: Finding) -> bool:
    """Return whether only a search of the states decides a finding: the arcs alone suggest it."""
    if finding.code == UNCOVERED:
        return finding.severity is Severity.NOTE
    return finding.code in ("unsettled-conflict", "arrival-order", EXTERNAL_WAIT)


def _search(task: Task, budget: Budget, devices: Mapping[str, str] | None) -> Analysis:
    from petrobot.coordinator.analysis.report import analyse

    return analyse(task, limits=budget.limits(), steps=budget.steps, devices=devices)


def _with_graph(task: Task, report: CheckReport, analysis: Analysis) -> CheckReport:
    """Return the findings with what the execution graph shows: retries without a limit, runs that
    stay behind at the end, and conflicts and waits for events in place of those that the arcs
    suggest. Without a complete graph, those stand."""
    if analysis.progress is None or not analysis.progress.x.complete:
        return report
    open_ones = [f for f in report.findings if f.code == UNCOVERED and left_to_search(f)]
    rest = [f for f in report.findings if not left_to_search(f)]
    may_stay = analysis.progress.may_stay
    rest += external_waits(analysis.progress.x.engine.compiled.task, may_stay=may_stay)
    flat = analysis.progress.x.engine.compiled.task
    found = [
        _contest(flat, contest)
        for contest in analysis.progress.contests
        if contest.matters or not _lent(flat, contest)
    ]
    found += map(_retries, analysis.progress.x.retries)
    found += [_left_behind(p, verdict) for p, verdict in analysis.progress.left_behind.items()]
    if (late := analysis.progress.ends_by_error) is not None:
        found.append(_ends_by_error(late))
    found += _lost_pulses(analysis.progress.x)
    found += _awaited_ends(task, analysis.progress.x)
    found += _more_runs(analysis.progress.x)
    found += _uncovered(analysis.progress.x) if open_ones else ()
    errors = [f for f in found if f.severity is Severity.ERROR]
    others = [f for f in found if f.severity is not Severity.ERROR]
    return CheckReport((*errors, *rest, *others))


def _left_running(task: Task, analysis: Analysis) -> Iterator[Finding]:
    """Transitions that leave a net after one of its branches while a run of another branch is still
    there, on the way to what speaks against the task: nothing expects that run any more."""
    if analysis.progress is None:
        return
    x, net = analysis.progress.x, analysis.progress.x.engine.compiled.net
    beside, told = dict[str, list[str]](), set[str]()
    for verdict in analysis.objections.values():
        witness = verdict.witness
        names = witness.firings if witness and witness.steps else ()
        for name, marking in zip(names, [*net.replay(names)][1:], strict=True):
            t = task.flat.transitions[name]
            if name not in beside:
                beside[name] = [
                    p for p in _beside(task, t) if p in x.crowded or _leads_on(task.flat, p)
                ]
            left = [p for p in beside[name] if marking[net.place_index[p]]]
            if left and name not in told:
                told.add(name)
                yield from _each_use(task, t, left)


def _leads_on(flat: Task, place: str) -> bool:
    """Return whether a good end of a place's run moves a token on. One that only takes it away lets
    the run continue beside the others, as is meant."""
    outputs = (o.place for t in flat.exits.get((place, End.NORMAL), ()) for o in t.outputs)
    return any(flat.places[name].kind is not Kind.RESOURCE for name in outputs)


def _beside(task: Task, t: Transition) -> list[str]:
    """Return the action places whose runs a transition should not leave: those of the subnet that
    it leaves, and for an added error exit those that start together with its place."""
    places, out = task.flat.places, {o.place for o in t.outputs}
    use, subnet = subnet_of(task, t.name)
    if subnet is not None:
        if out.isdisjoint({f"{use}{subnet.normal}", f"{use}{subnet.error}"}):
            return []
        return [p.name for p in places.values() if p.task and p.name.startswith(use)]
    started = [{o.place for o in u.outputs} for u in task.flat.transitions.values()]
    started = [some for some in started if t.expanded_from in some] if _is_added(t) else []
    together = set[str]().union(*started)
    return [p for p in places if p in together - {t.expanded_from} and places[p].task]


def _is_added(t: Transition) -> bool:
    """Return whether it is an error exit that was added, or a copy of one for `tries`."""
    return bool(t.expanded_from) and t.name.startswith(f"{t.expanded_from}.error")


def _each_use(task: Task, t: Transition, left: Sequence[str]) -> Iterator[Finding]:
    """The finding that a transition leaves runs, once for each use of its subnet."""
    own, subnet = subnet_of(task, t.name)
    name, places = t.expanded_from or t.name, task.flat.places
    out = [o.place for o in t.outputs if places[o.place].kind is not Kind.RESOURCE]
    uses = [use for use, one in subnets_of(task).items() if one is subnet] or [""]
    parts = (one.removeprefix(own).partition(".") for one in left)
    inner = {name for name, dot, _ in parts if dot}
    for use in uses:
        here, *rest = (f"{use}{one.removeprefix(own)}" for one in (name, *left, *out))
        others, to = rest[: len(left)], ", ".join(f'"{one}"' for one in rest[len(left) :])
        taken = ", ".join(f'"{one}:preempt=none"' for one in others)
        key, text = f"transitions.{here}.in", f"leaves {listed(others)} running"
        remedy = f"add {taken}"
        if _is_added(t):
            key = f"places.{here}"
            text = f"{here}.error, which was added because no transition has {here}:error, {text}"
            remedy = f'add to [transitions] one with in = ["{here}:error", {taken}], out = [{to}]'
        if inner:
            remedy = f"let one take an exit of {listed(inner)} too: no macro place is preempted"
        yield Finding(Severity.ERROR, LEFT_RUNNING, key, text, remedy)


def _uncovered(x: ExecutionGraph) -> Iterator[Finding]:
    """Places whose exits depend on how other runs ended, and from which an ended run can indeed
    never be taken."""
    task = x.engine.compiled.task.flat
    for finding in uncovered_exits(task):
        if finding.code == UNCOVERED and finding.severity is Severity.NOTE:
            place = finding.key.removeprefix("places.")
            ends = (End.NORMAL, End.ERROR)
            takers = [t.name for end in ends for t in task.exits.get((place, end), ())]
            free = x.graph.backward(x.source[x.firing(takers)].tolist())
            if any(
                run.place == place and run.phase is Phase.DONE and not free[i]
                for i, state in enumerate(x.states)
                for run in state.runs()
            ):
                yield replace(finding, severity=Severity.ERROR)


def _lost_pulses(x: ExecutionGraph) -> Iterator[Finding]:
    """Transitions that miss a pulse while another branch holds a token that they need, or while
    the place that listens for it is empty."""
    task, net = x.engine.compiled.task.flat, x.engine.compiled.net

    def ready(state: State, needed: Iterable[Input]) -> bool:
        return all(state.marking[net.place_index[a.place]] >= a.weight for a in needed)

    for t in task.transitions.values():
        pulses = [e for e in t.events if is_pulse(task.events[e])]
        waiting = [u for u in task.transitions.values() if {*pulses} & {*u.events}]
        for arc in t.inputs if pulses else ():
            place, others = arc.place, [a for a in t.inputs if a.place != arc.place]
            away = {a.place for a in others}
            takers = [
                u.name
                for u in task.transitions.values()
                if place in _places(u)
                and place not in {o.place for o in u.outputs}
                and away.isdisjoint(_places(u))
            ]
            lost = takers and (others or task.places[place].listen)
            lost = lost and any(
                ready(state, others) and not any(ready(state, u.inputs) for u in waiting)
                for state in x.states
            )
            if lost:
                text = (
                    f"{pulses[0]} is a pulse: if it comes while {place} is taken (by "
                    f"{listed(takers)}), {t.name} does not fire and the event is lost"
                )
                remedy = 'if it must be served then, write memory = "latched" and early = "keep"'
                key = f"events.{pulses[0]}"
                yield Finding(Severity.NOTE, "lost-pulse", key, text, remedy)


def _more_runs(x: ExecutionGraph) -> Iterator[Finding]:
    """The runs place, if it may come to hold more tokens than at the beginning."""
    task, net = x.engine.compiled.task, x.engine.compiled.net
    p = net.place_index.get(task.runs_place, -1)
    changes = zip(net.transitions, net.compiled.changes, strict=True)
    moved = {t: dict(change)[p] for t, change in changes if p in dict(change)}
    if not any(change > 0 for change in moved.values()):
        return
    most = 0
    edges = zip(x.source[~x.by_hand].tolist(), x.label[~x.by_hand].tolist(), strict=True)
    for source, label in edges:
        held = x.states[source].marking[p]
        for t in x.steps[label].firings:
            held += moved.get(t, 0)
            most = max(most, held)
    if most > net.initial[p]:
        text = (
            f"{task.runs_place} can hold {most} tokens, more than the {net.initial[p]} of the "
            "beginning: a campaign has one row for each of these alone, and forecasts count goals "
            "for each of them"
        )
        remedy = "let what is to be done again wait in another place, or return one token at most"
        yield Finding(Severity.NOTE, "more-runs", "task.runs_place", text, remedy)


def _awaited_ends(task: Task, x: ExecutionGraph) -> Iterator[Finding]:
    """Places that only an external event empties, while nothing but their tokens keeps the task
    from its end: `final` as it is written holds, and asks for nothing there."""
    import numpy as np

    flat, places = x.engine.compiled.task, x.engine.compiled.net.places
    outside = np.array([isinstance(one.stimulus, EventOccurred) for one in x.steps], np.bool_)
    waits = np.zeros(len(x), np.bool_)
    waits[x.source[outside[x.label] & ~x.by_hand]] = True
    waits[x.source[~outside[x.label] & ~x.by_hand]] = False
    found = dict[str, None]()
    waiting = np.flatnonzero(waits & ~x.final).tolist() if task.final != flat.final else ()
    for marking in {x.states[i].marking: None for i in waiting}:
        tokens = dict(zip(places, marking, strict=True))
        if task.final.holds(tokens):
            own = (flat.places[name] for name in tokens if tokens[name])
            found |= {p.name: None for p in own if p.kind is Kind.PLAIN and not p.listen
                      and p.name not in task.final.names}  # fmt: skip
    for name in found:
        takers = [t for t in flat.transitions.values() if name in _places(t)]
        events = {e for t in takers for e in t.events if flat.events[e].scope is Scope.EXTERNAL}
        if not events:  # nothing ever takes its token, or nothing can: `sound` says so
            continue
        text = f"the end needs the event {listed(events)}, as only that empties this place"
        remedy = "write `listen = true` here if it need not come"
        yield Finding(Severity.NOTE, "awaited-end", f"places.{name}", text, remedy)


def _places(t: Transition) -> set[str]:
    return {a.place for a in t.inputs}


def _lent(task: Task, contest: Contest) -> bool:
    """Whether the transitions only compete for tokens that each gives back at once."""
    rivals = [task.transitions[name] for name in contest.transitions]
    return all({*contest.over} <= lent(task, t, u) for t, u in combinations(rivals, 2))


def _contest(task: Task, contest: Contest) -> Finding:
    from petrobot.coordinator.analysis.execution.progress import contend

    first, *others = contest.transitions
    text, key = contend(contest.transitions, contest.over), f"transitions.{first}"
    text += idle_weights(task.transitions[name] for name in contest.transitions)
    remedy = "give one a higher `priority`, each a `weight`, or exclusive conditions"
    who = "the one that has waited longer gets it, or else the first in the file"
    if not contest.matters:
        why = f"{who} ({first}), so that {' and '.join(others)} may have to wait"
        return Finding(Severity.NOTE, "unsettled-conflict", key, text, why)
    told = "; ".join(
        f"{name.replace('_', ' ')}: {reason}" for name, reason in contest.matters.items()
    )
    text = f"{text}; {who}, but if it went the other way: {told}"
    return Finding(Severity.ERROR, "unsettled-conflict", key, text, remedy)


def _left_behind(places: tuple[str, ...], verdict: PropertyVerdict) -> Finding:
    from petrobot.coordinator.analysis.report import path_lines

    what = (
        "a run that ended is" if len(places) == 1 else f"ended runs of {' and '.join(places)} are"
    )
    text = f"the task can end with `final` while {what} still there: {verdict.reason}"
    remedy, inside = "give that end a transition that takes it", any("." in p for p in places)
    if not inside:  # `final` knows the places of the task, not those of its subnets
        empty = " and ".join(f"{place} == 0" for place in places)
        remedy = f"let `final` ask for `{empty}`, and {remedy}"
    key, by = f"places.{places[0]}", path_lines(verdict.witness, "")
    details = (*verdict.details, *by)
    return Finding(Severity.WARNING, "left-behind", key, text, remedy, details=details)


def _ends_by_error(verdict: PropertyVerdict) -> Finding:
    from petrobot.coordinator.analysis.report import path_lines

    remedy = (
        "two transitions may have each other's outputs; or a place outside `final` is never empty "
        "before: let a transition take its token, or write "
        "`listen = true` in a place that waits for events all the time"
    )
    details = tuple(path_lines(verdict.witness, ""))
    key, text = "task.final", verdict.reason
    return Finding(Severity.WARNING, "end-by-error", key, text, remedy, details=details)


def _late(task: Task) -> list[Finding]:
    """Return where runs are ended before they succeed, by what the task declares."""
    found = []
    for place in task.flat.places.values():
        primitive = task.primitive_tasks.get(place.task)
        good = primitive.estimates.get(Status.SUCCESS) if primitive else None
        if primitive is None or good is None or not good.share:
            continue
        if good.mean > (given := task.longest_run(place.name)):
            key = f"primitive_tasks.{primitive.name}.deadline"
            key = f"places.{place.name}.timeout" if place.timeout == given else key
            text = (
                f"runs end in ERROR after {given:g} s (cause `deadline`), but a SUCCESS is "
                f"declared to take {good.mean:g} s on average"
            )
            remedy = "give the runs more time, or correct the estimates"
            found.append(Finding(Severity.WARNING, LATE, key, text, remedy))
    return found


def _retries(names: tuple[str, ...]) -> Finding:
    words = " and ".join(f"`{name}`" for name in names)
    text = f"{words} can be repeated without limit while runs end in ERROR"
    remedy = (
        "a fault that stays keeps the task busy for ever: use `tries`, or take a token of a place "
        "that has only a few"
    )
    return Finding(Severity.NOTE, "endless-retry", f"transitions.{names[0]}", text, remedy)


def _line(finding: Finding) -> str:
    said = wrapped(f"  {finding.key}: {finding.text}", 6)
    return said + (f"\n{wrapped(f'    {finding.remedy}', 6)}" if finding.remedy else "")
