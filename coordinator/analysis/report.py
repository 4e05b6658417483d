"""One analysis of a net or a task: all verdicts and numbers, as JSON and as text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from math import isnan, sqrt
from typing import Any

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.analysis.execution.chain import MissionFigures, played
from petrobot.coordinator.analysis.execution.graph import (
    STEPS,
    ExecutionGraph,
    Shared,
    TooManyValues,
    in_words,
)
from petrobot.coordinator.analysis.execution.progress import (
    NAMES,
    Odds,
    Progress,
    Recovery,
    progress_of,
)
from petrobot.coordinator.analysis.limits import OUT_OF_MEMORY, OutOfTime, overtime
from petrobot.coordinator.analysis.net.coverability import Coverability, coverability, find_pump
from petrobot.coordinator.analysis.net.deadlocks import (
    PlaceSets,
    controlled_siphons,
    minimal_siphons,
    minimal_traps,
)
from petrobot.coordinator.analysis.net.ends_net import EndsNet, ends_net, judged, proven
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.analysis.net.qualitative import Qualitative, examine
from petrobot.coordinator.analysis.net.space import INTERRUPTED, LOOK, SearchLimits, Space, explore
from petrobot.coordinator.analysis.net.structure import (
    Lyapunov,
    Semiflows,
    conflict_sets,
    exclusive_places,
    is_strictly_conservative,
    lyapunov,
    place_bounds,
    place_semiflows,
    transition_semiflows,
)
from petrobot.coordinator.analysis.net.verdict import PropertyVerdict, Witness
from petrobot.coordinator.analysis.time.gspn import Chain, Gspn
from petrobot.coordinator.analysis.time.markov import LongRun, long_run
from petrobot.coordinator.analysis.time.measured import Measured
from petrobot.coordinator.analysis.time.stochastic import STAGES, stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import (
    GOALS,
    MATTERS,
    TIME,
    Forecast,
    forecast,
)
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.net import Marking, Net
from petrobot.coordinator.task.wording import COLUMNS, few, together, wrapped


class StructureReport(Struct, frozen=True, dict=True):
    """Structural properties of a net, computed on first access: invariants, siphons, traps."""

    net: Net

    @cached_property
    def place_flows(self) -> Semiflows:
        """P-semiflows."""
        return place_semiflows(self.net)

    @cached_property
    def transition_flows(self) -> Semiflows:
        """T-semiflows."""
        return transition_semiflows(self.net)

    @cached_property
    def siphons(self) -> PlaceSets:
        """Minimal siphons."""
        return minimal_siphons(self.net)

    @cached_property
    def traps(self) -> PlaceSets:
        """Minimal traps."""
        return minimal_traps(self.net)

    @cached_property
    def function(self) -> Lyapunov:
        """Whether the net is bounded from every marking, and conservative."""
        return lyapunov(self.net)

    def gaps(self) -> list[str]:
        """Return what was not found in full, in words."""
        parts = {
            "place invariants": self.place_flows.complete,
            "transition invariants": self.transition_flows.complete,
            "siphons": self.siphons.complete,
            "traps": self.traps.complete,
        }
        listed = [
            f"{part}: those found; whether there are more is unknown within the limit"
            for part, complete in parts.items()
            if not complete
        ]
        judged = {
            "structurally bounded": self.function.bounded,
            "conservative": self.function.conservative,
        }
        open_ = [what for what, holds in judged.items() if holds is None]
        return [*listed, *(f"{what}: unknown within the limit" for what in open_)]

    def to_json(self) -> dict[str, Any]:
        """Return plain data, with places and transitions by name."""
        places, transitions = self.net.places, self.net.transitions
        return {
            "p_invariants": [
                {places[p]: n for p, n in sorted(y.items())} for y in self.place_flows.vectors
            ],
            "t_invariants": [
                {transitions[t]: n for t, n in sorted(x.items())}
                for x in self.transition_flows.vectors
            ],
            "invariants_complete": self.place_flows.complete and self.transition_flows.complete,
            "siphons": [sorted(places[p] for p in s) for s in self.siphons.sets],
            "traps": [sorted(places[p] for p in s) for s in self.traps.sets],
            "siphons_complete": self.siphons.complete and self.traps.complete,
            "siphons_controlled": controlled_siphons(self.net, found=self.siphons),
            "structurally_bounded": self.function.bounded,
            "conservative": self.function.conservative,
            "strictly_conservative": is_strictly_conservative(self.net),
            "lyapunov": {places[p]: n for p, n in sorted(self.function.weights.items())}
            if self.function.weights is not None
            else None,
            "conflicts": [[transitions[t] for t in group] for group in conflict_sets(self.net)],
            "exclusive_places": sorted(
                [places[p], places[q]] for p, q in exclusive_places(self.net, self.place_flows)
            ),
        }


CERTAIN = 1e-9
"""A probability of completion that differs from 1 by less than this counts as 1."""
BY_HAND = 20_000
"""The most stimuli and firings with the operator's tokens: as many as `petrobot check` tries."""
MORE = "with more the same may happen, which was not searched to its end"
"""What a fault with fewer runs means for the task."""
FEWER = 2
"""The most runs with which a task is searched whose execution graph is too large."""
SHOWN = 20
"""The most entries of a list that the text shows."""
VERDICT = 26
"""Columns before the reason of a verdict in the text."""


class Analysis(Struct, frozen=True, dict=True):
    """The result of `analyse`. For a task, `net` is its ordinary net, `progress` judges its
    execution graph, and `qualitative` has the bounds that its ends net N gives."""

    name: str
    net: Net
    qualitative: Qualitative
    progress: Progress | None
    structure: StructureReport
    run: LongRun | None
    forecast: Forecast | None
    notes: tuple[str, ...]
    unjudged: str = ""
    """Tasks only: why there is no execution graph; empty if there is one."""
    steps: int = STEPS
    """The most stimuli and firings for the execution graph."""
    interrupted: bool = False
    """Whether Ctrl-C ended the analysis before everything was computed."""
    proven: Mapping[str, PropertyVerdict] = field(default_factory=dict)
    """Tasks only: what N proves of progress, where the execution graph is not complete."""
    ends: EndsNet | None = None
    """Tasks only: N."""
    doubts: tuple[str, ...] = ()
    """Why the figures of `forecast` are not those of the executed task; empty if nothing speaks
    against them."""
    exact: MissionFigures | None = None
    """Figures of missions with exact times, if those of `forecast` are doubtful because of its few
    phases."""
    missions: MissionFigures | None = None
    """Missions with exact times, if some could be played."""
    refused: bool = False
    """Whether the task may not run for a reason beyond these verdicts (`may_run`)."""
    fewer: Mapping[int, Analysis] = field(default_factory=dict)
    """Tasks only: by number of runs, the analyses with fewer of them, where the execution graph is
    not complete."""

    @cached_property
    def by_hand(self) -> list[PropertyVerdict]:
        """What only the operator's tokens make possible, searched up to BY_HAND stimuli and
        firings."""
        return self.progress.by_hand(min(self.steps // 3, BY_HAND)) if self.progress else []

    @cached_property
    def told(self) -> tuple[str, ...]:
        """The notes, with one if the time was used up before the error exits were judged."""
        p = self.progress
        waiting = p is not None and p.x.complete and p.view.error_exits and not p.recoveries
        late = (LATE,) if waiting and overtime() else ()
        return tuple(dict.fromkeys((*self.notes, *late, *self.with_fewer)))

    @cached_property
    def with_fewer(self) -> list[str]:
        """What is known of the task with fewer runs, in sentences."""
        told = []
        for runs, one in self.fewer.items():
            head = f"with {runs} run{'s' * (runs > 1)}"
            for name, verdict in [*one.objections.items()][:1]:  # others often follow from it
                steps = verdict.witness.steps if verdict.witness else ()
                by = (f"by: {'; '.join(in_words(steps))}",) * bool(steps)
                fault = f"{head}: not {_plain(name)}: {verdict.reason}"
                told.append("; ".join((fault, MORE, *verdict.details, *by)))
            verdicts = one.verdicts().items()
            open_ = [_plain(name) for name, v in verdicts if v.holds is None]
            if not one.objections:
                shown = [_plain(name) for name, v in verdicts if v.holds and name != "safe"]
                known = f"{head}: proved: {', '.join(shown) or 'nothing'}"
                told.append(f"{known}; unknown: {', '.join(open_)}" if open_ else known)
        return told

    @property
    def ok(self) -> bool:
        """Whether it is known that nothing speaks against running the task. It is not known if time
        or memory was used up before a verdict."""
        named = self.verdicts()
        known = ("bounded", "deadlock_free", "one_run_each")
        judged = self.progress is not None and self.progress.x.complete
        stopped = judged or {LATE, FULL}.intersection(self.notes)
        open_ = stopped and any(verdict.holds is None for verdict in named.values())
        return not (self.objections or open_) and all(named[n].holds for n in known if n in named)

    @cached_property
    def odds(self) -> Odds:
        """Probability and mean time of each way back; none for a task that may not run."""
        if self.refused or self.objections or self.progress is None:
            return Odds({}, 0, (), "the task may not run")
        return self.progress.odds

    @property
    def objections(self) -> dict[str, PropertyVerdict]:
        """Known reasons against running the task, by the name of the verdict.

        It grows without bound, deadlocks, starts a run in a place that is still active, cannot
        reach its end, is still active at its end, or loses a resource. A transition that can never
        fire is not an objection.
        """
        named = self.verdicts()
        against: dict[str, PropertyVerdict] = {
            name: named[name]
            for name in ("bounded", "deadlock_free", "one_run_each", "returned")
            if name in named
        }
        if "sound" in named and named["sound"].witness is not None:
            against["sound"] = named["sound"]
        return {name: verdict for name, verdict in against.items() if verdict.holds is False}

    def to_json(self, *, structure: bool = True) -> dict[str, Any]:
        """Return plain data with documented keys; verdicts are true, false or null."""
        q = self.qualitative
        unbounded = q.bounded.holds is False
        named = self.verdicts()
        back = named.get("proper", q.reversible)
        stuck: list[dict[str, Any]] = [
            {
                "marked": list(d.marked),
                "count": d.count,
                "emptied": list(d.emptied),
                **d.witness.to_json(),
            }
            for d in q.deadlocks
        ]
        levels, home = q.levels, q.home_states
        free = named["deadlock_free"].holds
        if self.progress is not None:
            levels, home = self.progress.levels, self.progress.home_states
            stuck = [
                {
                    "marked": list(d.witness.marking),
                    "count": d.count,
                    "reason": d.verdict.reason,
                    "details": list(d.verdict.details),
                    **d.witness.to_json(),
                }
                for d in (self.progress.dead_ends if free is False else ())
            ]
        out: dict[str, Any] = {
            "name": self.name,
            "net": _sizes(self.net),
            "states": None if unbounded else len(q.space),
            "edges": None if unbounded else q.space.edges,
            "complete": q.space.complete and not self.interrupted,
            "reason": q.space.reason or (INTERRUPTED if self.interrupted else ""),
            "engine": q.space.engine,
            "bounded": named["bounded"].holds,
            "max_tokens_per_place": q.most,
            "max_tokens_in_marking": self._most_in_marking(),
            "bounds": dict(zip(self.net.places, q.bounds, strict=True)),
            "safe": q.safe.holds,
            "deadlock": None if free is None else not free,
            "deadlocks": stuck,
            "dead_markings": sum(one["count"] for one in stuck)
            if self.progress
            else q.dead_markings,
            "quasi_live": named["quasi_live"].holds,
            "dead_transitions": [
                t for t, level in zip(self.net.transitions, levels, strict=True) if level == 0
            ],
            "live": named["live"].holds,
            "liveness": dict(zip(self.net.transitions, levels, strict=True)),
            "reversible": back.holds,
            "home_states": home,
            "sound": named["sound"].holds if "sound" in named else None,
            "execution": self.progress.size() if self.progress else None,
            "verdicts": {name: verdict.to_json() for name, verdict in named.items()},
            "notes": [*self.told, *map(_by_hand, self.by_hand)],
        }
        if structure:
            out["structure"] = self.structure.to_json()
            out["notes"] += self.structure.gaps()
        if self.progress is not None:
            out["recoveries"] = [_recovery(r, self.odds) for r in self.progress.recoveries]
            out["no_probability"] = self.odds.missing
            out["mended"] = {n: v.to_json() for n, v in self.progress.mended.items()}
        return out | self._numbers()

    def _most_in_marking(self) -> int | None:
        space = self.qualitative.space
        if not space.complete:
            return None
        if self.ends is None:
            return space.most_tokens
        held = np.zeros(len(space), dtype=np.int64)
        for p in range(len(self.ends.parts)):
            held += self.ends.held(space, p)
        return int(held.max())

    def _numbers(self) -> dict[str, Any]:
        if self.run is not None:
            return {
                "throughput": self.run.throughput,
                "mean_tokens": self.run.mean_tokens,
                "utilisation": self.run.utilisation,
                "residual": self.run.residual,
            }
        if self.forecast is not None:
            return {
                "throughput": self.forecast.throughput,
                "mean_tokens": self.forecast.mean_tokens,
                "residual": self.forecast.done.residual,
                "forecast": self.forecast.to_json()
                | {
                    "doubts": list(self.doubts),
                    "exact": self.exact and {"missions": self.exact.missions} | self.exact.figures,
                },
            }
        return {"throughput": None, "mean_tokens": None, "residual": None}

    def figures(self) -> dict[str, float]:
        """Return the numbers by which two analyses are compared."""
        if self.forecast is not None:
            f = self.forecast
            late = f.quantiles(0.9)
            shape = {"90 % quantile of the time (s)": late["0.9"]} if late else {}
            return f.figures | shape
        if self.run is not None:
            return {f"throughput of {t} (1/s)": x for t, x in self.run.throughput.items()}
        return {"markings": len(self.qualitative.space)}

    def verdicts(self) -> dict[str, PropertyVerdict]:
        """Return all verdicts by name. For a task those of progress come from the execution
        graph."""
        q = self.qualitative
        out = {"bounded": q.bounded, "safe": q.safe}
        if self.progress is not None and self.progress.x.complete and q.bounded.holds is not True:
            finite = f"the task rests in {len(self.progress.x)} states only"
            out["bounded"] = PropertyVerdict(True, finite)
        elif self.progress is not None and q.bounded.holds is False:
            out["bounded"] = _growing(self.progress.x)
        if self.progress is None and not self.unjudged:
            return out | {
                "deadlock_free": q.deadlock_free,
                "quasi_live": q.quasi_live,
                "live": q.live,
                "reversible": q.reversible,
            }
        if self.progress is None:
            unknown = PropertyVerdict(None, f"unknown: {self.unjudged}", complete=False)
            judged = dict.fromkeys(NAMES, unknown)
        else:
            judged = self.progress.verdicts()
        return out | {
            name: one if one.holds is not None else self.proven.get(name, one)
            for name, one in judged.items()
        }

    def text(self) -> str:
        """Return the analysis as text for the terminal."""
        q = self.qualitative
        size = _sizes(self.net)
        lines = [
            f"{self.name}: {size['places']} places, {size['transitions']} transitions, "
            f"{size['arcs']} arcs; "
            f"{len(q.space)} markings, {q.space.edges} edges"
            + (" with the ends of runs" if self.ends is not None else "")
            + ("" if q.space.complete else f" (partial: {q.space.reason})")
        ]
        lines += [f"executed: {self.progress.size_text()}", ""] if self.progress else [""]
        told = list[Witness]()
        for name, verdict in self.verdicts().items():
            lines += _verdict_lines(name, verdict, told)
            if self.progress is not None and name in self.progress.mended:
                lines.append(_mended_line(self.progress.mended[name]))
        if self.progress is None:
            lines += [
                f"  deadlock       {d.count} x: "
                f"{' '.join(d.witness.firings) or '(initial marking)'}"
                for d in q.deadlocks[:SHOWN]
            ]
        else:
            stuck = self.verdicts()["deadlock_free"].holds is False
            ends = self.progress.dead_ends if stuck else ()
            several = len(ends) > 1 or any(d.count > 1 for d in ends)
            counts = Counter[str]()
            for end in ends:
                counts[end.verdict.reason] += end.count
            lines += [
                f"  dead end       {n} x: {reason}"
                for reason, n in list(counts.items())[:SHOWN]
                if several
            ]
            lines += _recovery_lines(self.progress.recoveries, self.odds)
        assumed = dict.fromkeys(  # a net of another tool is not executed
            v.assumption
            for v in self.verdicts().values()
            if v.holds and v.assumption and self.ends is not None
        )
        # Where some verdicts are proved on the ends net, those of the graph may assume more.
        most = [text for text in assumed if sum(a.startswith(text) for a in assumed) == 1]
        lines += ["", *(f"These hold for the executed task if {text}." for text in most)] * any(
            most
        )
        lines += self._number_lines()
        lines += [f"note: {note}" for note in self.told]
        lines += ["note: only if the operator moves tokens:"] if self.by_hand else []
        for verdict in self.by_hand:
            lines += [f"  {verdict.reason}", *(f"    {line}" for line in verdict.details)]
            lines += path_lines(verdict.witness, "    ")
        return "\n".join(wrapped(line, len(line) - len(line.lstrip()) + 4) for line in lines)

    def _number_lines(self) -> list[str]:
        if self.run is not None:
            busiest = sorted(self.run.utilisation.items(), key=lambda one: -one[1])[:SHOWN]
            rows = [
                f"  {name:24} {self.run.throughput[name]:12.6g} /s {load:10.4g} busy"
                for name, load in busiest
            ]
            return ["", f"long run (residual {self.run.residual:.1e} /s):", *rows]
        if self.forecast is None:
            return []
        f, done = self.forecast, self.forecast.done
        shown = {n: value for n, value in f.told.items() if n in ("R_goal", GOALS)}
        goal = f"{_figures(shown)}, " if shown else ""
        rows = [
            f"  {w.place}.{w.action}: 1 % shorter saves {w.time_share:.3f} % of the time; error to "
            f"success: {w.completion_gain:+.3g} complete, {w.goal_gain:+.3g} goals"
            for w in f.worth[:SHOWN]
            if w.time_share >= LEAST_SHARE
            or abs(w.completion_gain) >= AGREE
            or w.goal_gain >= AGREE
        ]
        back = "no way back to the nominal flow; " if f.recovery_time is None else ""
        if f.recovery_time:
            back = f"mean time back to the nominal flow at most {f.recovery_time:.3f} s; "
        time = (
            f"  time {done.mean:.3f} s, standard deviation {done.variance**0.5:.3f} s; {back}"
            f"residual {done.residual:.1e}"
        )
        never = "  no run ever reaches `final`, so there is no mean time"
        several = f" of a mission run of {f.trials} trials" if f.trials > 1 else ""
        head = f"forecast{several}: "
        rare = 0 < done.probability < RARE
        small = f" (relative error at most {f.completion_error:.0e})" if rare else ""
        exact = self.exact.figures if self.exact else {}
        names = {} if GOALS in f.told else {GOALS: "R_goal"}
        told = ", ".join(
            f"{names.get(n, n)} {mean:.6g} +- {error:.2g}" for n, (mean, error) in exact.items()
        )
        return [
            "",
            *([f"{head}{told} (mean and standard error with exact times)"] if told else []),
            f"{'with few phases: ' if told else head}P_complete {_share(done.probability, 9)}"
            f"{small}, {goal}R_conj {_share(f.conjunctive_reliability)}",
            time if done.probability else never,
            *([f"  one trial: {_figures(f.one_trial.told)}"] if several or f.returning else []),
            *(f"  {text}" for text in f.later),
            *(f"doubtful: {text}" for text in self.doubts),
            *_missing_lines(self),
            *(["worth improving:", *rows] if done.probability else []),
            *(f"approximated: {text}" for text in f.approximations),
            *(f"{source}: {', '.join(names)}" for source, names in f.view.numbers.items()),
            *(f"assumed: {text}" for text in together(f.view.assumptions)),
        ]


class AnalysisRequest(Struct, frozen=True):
    """How a task is analysed; `analyse` explains the fields."""

    measured: Measured | None = None
    stages: int = 8
    limits: SearchLimits | None = None
    steps: int = STEPS
    devices: Mapping[str, str] | None = None


def analyse(
    model: Net | Task | Gspn,
    *,
    name: str = "",
    view: str = "ordinary",
    measured: Measured | None = None,
    stages: int = 8,
    limits: SearchLimits | None = None,
    ordinary: Net | None = None,
    steps: int = STEPS,
    devices: Mapping[str, str] | None = None,
) -> Analysis:
    """Return all verdicts on a net or task; with `view="gspn"` also the numbers over time.

    A GSPN yields its long run from the initial marking, a task its forecast. Numbers that cannot be
    computed (incomplete space, timeless trap) leave a note instead. `limits` apply to each state
    space that is explored. `ordinary` is the net for the qualitative verdicts on a GSPN, if it is
    not the GSPN's own net because the rates and priorities came from another file. `steps` limits
    the execution graph of a task, in stimuli and firings; `devices` gives the device of each of its
    actions that has one.
    """
    if isinstance(model, Task):
        request = AnalysisRequest(measured, stages, limits, steps, devices)
        return _analyse_task(model, view, request)
    net = ordinary or (model.net if isinstance(model, Gspn) else model)
    notes: list[str] = []
    found = _examined(net, limits, notes)
    run = None
    if isinstance(model, Gspn) and view == "gspn" and not notes:
        run = _long_run(model, found.space, limits, notes)
    stopped = bool(notes) and notes[-1] == CUT
    return Analysis(
        name or "net",
        net,
        found,
        None,
        StructureReport(net),
        run,
        None,
        tuple(notes),
        interrupted=stopped,
    )


ENDLESS = "the net is unbounded"
FULL = (
    "the memory was used up: what was found by then holds, the rest is unknown; give more --memory"
)
LATE = (
    "the time was used up: what was found by then holds, the rest is unknown; give more --seconds"
)
CUT = "Ctrl-C: a partial result, from what had been found by then"
STOPPED = {INTERRUPTED: CUT, "memory limit": FULL, "time limit": LATE}
"""What ended an analysis before its end, and the note that says so."""


def _search(net: Net, limits: SearchLimits | None, found: list[Space]) -> Coverability | None:
    """Append the space within the limits to `found`, and before it the first part of a large one.

    A net that is proven unbounded is searched only up to LOOK markings.
    """
    limits, cover = limits or SearchLimits(), None
    if limits.states is None or limits.states > LOOK:
        first = explore(net, limits=replace(limits, states=LOOK))
        found.append(first)
        if first.complete or len(first) < LOOK:
            return None
        proven = place_bounds(net)
        cover = coverability(net, bounds=proven) if None in proven else None
        open_ = cover is not None and cover.bounded is None and find_pump(first) is not None
        if cover is not None and (cover.bounded is False or open_):
            found.append(replace(first, reason=ENDLESS))
            return cover
    found.append(explore(net, limits=limits))
    return cover


def _examined(
    net: Net,
    limits: SearchLimits | None,
    notes: list[str],
    judge: Callable[..., Qualitative] = examine,
) -> Qualitative:
    """Return all verdicts by `judge`. After Ctrl-C, or if time or memory is used up, add a note and
    return those that what was found by then proves."""
    found, reason = list[Space](), INTERRUPTED
    try:
        cover = _search(net, limits, found)
        if found[-1].reason != INTERRUPTED:
            return judge(found[-1], cover=cover)
    except KeyboardInterrupt:
        pass
    except OUT_OF_MEMORY:
        reason = "memory limit"
    except OutOfTime:
        reason = "time limit"
    notes.append(STOPPED[reason])
    while found:
        try:
            return judge(replace(found[-1], reason=reason), in_haste=True)
        except OUT_OF_MEMORY:
            found.pop()
    start = explore(net, limits=SearchLimits(states=1), engine="integers")
    return judge(replace(start, complete=False, reason=reason), in_haste=True)


def _long_run(
    model: Gspn, space: Space, limits: SearchLimits | None, notes: list[str]
) -> LongRun | None:
    try:
        if model.net != space.net:
            space = explore(model.net, limits=limits)
        if space.reason != INTERRUPTED:
            return long_run(Chain.of(model, space=space))
    except (ValueError, ArithmeticError, *OUT_OF_MEMORY) as why:
        notes.append(f"no long run: {_why(why)}")
        return None
    except KeyboardInterrupt:
        pass
    notes.append(CUT)
    return None


def _analyse_task(
    task: Task, view: str, asked: AnalysisRequest, shared: Shared | None = None
) -> Analysis:
    """Analyse a task. `shared` is that of the same task with more runs; None: it is the first, so
    that fewer runs may be tried, too."""
    fewer, shared, steps = shared is None, shared or Shared(), asked.steps
    ordinary, n, notes = OrdinaryView(task), ends_net(task), list[str]()
    found = _examined(n.net, asked.limits, notes, partial(judged, n))
    progress = None
    shown: Mapping[str, PropertyVerdict] = {}
    why = "the analysis was stopped before"
    try:
        if not notes:
            # An unbounded net seldom has a finite execution graph, but its dead ends may be near.
            most = steps if found.bounded.holds is not False else min(steps, LOOK)
            try:
                progress = progress_of(ordinary, most, asked.measured, asked.devices, shared)
                x = progress.x
                if most < steps and not x.complete and x.growth is None:
                    progress = progress_of(ordinary, steps, asked.measured, asked.devices, shared)
                notes += progress.notes
            except TooManyValues as fault:
                why = str(fault)
            if progress is None or not progress.x.complete:
                if progress is not None:
                    progress.verdicts()  # what it refutes, before proofs use up the time
                shown = proven(n, found.space, ordinary)
    except KeyboardInterrupt:
        notes.append(CUT)
    except (*OUT_OF_MEMORY, OutOfTime) as fault:  # what is known by now stays known
        notes.append(LATE if isinstance(fault, OutOfTime) else FULL)
        why = notes[-1]
    judgement = Analysis(
        task.name,
        task.net,
        found,
        progress,
        StructureReport(n.net),
        None,
        None,
        tuple(notes),
        "" if progress is not None else why,
        steps,
        CUT in notes,
        shown,
        n,
    )
    if fewer and not (judgement.interrupted or judgement.objections):
        smaller = _with_fewer_runs(task, progress, asked, shared)
        judgement = replace(judgement, fewer=smaller)
        runs = task.places.get(task.runs_place)  # None of them was asked where no time was left.
        complete = progress is not None and progress.x.complete
        if runs is not None and runs.tokens > 1 and not smaller and not complete:
            note = f"with one run more may be known: --what-if {runs.name}=1"
            judgement = replace(judgement, notes=(*judgement.notes, note))
    if view != "gspn" or judgement.interrupted:
        return judgement
    return with_forecast(judgement, task, asked)


def _with_fewer_runs(
    task: Task, progress: Progress | None, asked: AnalysisRequest, shared: Shared
) -> dict[int, Analysis]:
    """Return the analyses of a task with one run, then two, up to a fault or a graph that is too
    large, within the same limits; empty if its own graph is complete or it does not count runs."""
    found, place = dict[int, Analysis](), task.places.get(task.runs_place)
    if place is None or overtime() or (progress is not None and progress.x.complete):
        return found
    for runs in range(1, min(place.tokens, FEWER + 1)):
        places = {**task.places, place.name: replace(place, tokens=runs)}
        smaller = replace(task, places=places)
        one = _analyse_task(smaller, "", replace(asked, measured=None), shared)
        found[runs] = one
        if one.objections or one.progress is None or not one.progress.x.complete:
            break
    return found


def with_forecast(found: Analysis, task: Task, asked: AnalysisRequest) -> Analysis:
    """Return the analysis of a task with its forecast, as `analyse` with `view="gspn"` does, and
    without searching again."""
    notes, doubts = list(found.notes), list[str]()
    numbers = exact = missions = None
    try:
        numbers = _forecast(task, asked, notes)
        if numbers is not None:
            doubts, exact, missions = _doubts(numbers, found.progress, asked, notes)
    except KeyboardInterrupt:
        notes.append(CUT)
    return replace(
        found,
        forecast=numbers,
        notes=tuple(notes),
        interrupted=CUT in notes,
        doubts=tuple(doubts),
        exact=exact,
        missions=missions,
    )


def _forecast(task: Task, asked: AnalysisRequest, notes: list[str]) -> Forecast | None:
    try:
        view = stochastic_view(task, asked.measured, stages=asked.stages, devices=asked.devices)
        found = forecast(view, limits=asked.limits)
        _ = found.worth, found.recovery_time, found.throughput, found.mean_tokens
    except (ValueError, ArithmeticError, *OUT_OF_MEMORY) as why:
        if INTERRUPTED in str(why):
            raise KeyboardInterrupt from why
        runs = task.places.get(task.runs_place)
        one = f"; try --what-if {runs.name}=1" if runs is not None and runs.tokens > 1 else ""
        notes.append(f"no forecast: {_why(why)}{one}")
        return None
    return found


LEAST_SHARE = 5e-4
"""Least share of the time from which an action is worth improving: less is printed as 0.000 %."""
RARE = 1e-3
"""Shares below it are printed with six digits: six decimals would hide them."""
AGREE = 1e-6
"""Relative difference up to which a figure of two models counts as the same: both are solved to
about 1e-12."""


def _doubts(
    found: Forecast, progress: Progress | None, asked: AnalysisRequest, notes: list[str]
) -> tuple[list[str], MissionFigures | None, MissionFigures | None]:
    """Compare a forecast with the execution graph as a Markov chain, which follows the engine in
    everything but durations, and with missions played on it, whose durations are not divided into
    phases. Return which figures differ and what only one side assumes, those missions if they are
    among them, and those missions in any case; add a note where one of the two comparisons cannot
    be made.
    """
    doubts, failed = list(found.view.doubts), dict[str, str]()
    exact, missions = list[MissionFigures](), list[MissionFigures]()
    there: Mapping[str, Callable[[Progress], list[str]]] = {
        "the execution graph": partial(_as_chain, found, asked),
        "missions with exact times": partial(_as_played, found, asked, exact, missions),
    }
    for what, compared in there.items():
        try:
            if progress is None or not progress.x.complete:
                raise ValueError("the execution graph is not complete")
            doubts += compared(progress)
        except (ValueError, ArithmeticError, *OUT_OF_MEMORY) as why:
            if INTERRUPTED in str(why):
                raise KeyboardInterrupt from why
            failed.setdefault(_why(why), what)
    notes += [f"the forecast was not compared with {there}: {why}" for why, there in failed.items()]
    return doubts, next(iter(exact), None), next(iter(missions), None)


def _apart(one: float, other: float) -> tuple[str, str]:
    """Return two numbers with equally many digits: at least six, and enough to distinguish them."""
    texts = ((f"{one:#.{n}g}", f"{other:#.{n}g}") for n in range(6, 18))
    return next((pair for pair in texts if pair[0] != pair[1]), (f"{one:g}", f"{other:g}"))


def _as_chain(found: Forecast, asked: AnalysisRequest, progress: Progress) -> list[str]:
    """Return which figures the execution graph has otherwise. Both get as many phases for a
    duration as the chain can have, so only what they say about the order of events can differ.
    Raises ValueError."""
    view = found.view
    if isinstance(chain := progress.chain, str):
        raise ValueError(chain)
    few = chain.stages
    if (few, few) != (asked.stages, STAGES):
        same = stochastic_view(
            view.task, asked.measured, stages=few, timer_stages=few, devices=asked.devices
        )
        found = forecast(same, limits=asked.limits)
    exact = chain.figures
    off = [
        "{} {} here, {} there".format(name, *_apart(value, exact[name]))
        for name, value in found.figures.items()
        if abs(value - exact[name]) > AGREE * max(abs(value), abs(exact[name]))
    ]
    if not off:
        return []
    # What both assume explains no difference.
    ours = together(a for a in view.assumptions if a not in chain.assumptions)
    if sum(t.after is not None for t in view.task.flat.transitions.values()) > 1:
        ours.append("of timers that run together a longer one may elapse before a shorter one")
    if progress.free is not None or not ours:
        ours.append("conflicts that neither priority nor weight decides are drawn")
    theirs = together(a for a in chain.assumptions if a not in view.assumptions)
    there = f"; there: {'; '.join(theirs)}" if theirs else ""
    return [
        f"the execution graph has other figures (both with at most {few} "
        f"phase{'s' * (few > 1)} for a duration): {', '.join(off)}. "
        f"Assumed here: {'; '.join(ours)}{there}"
    ]


def _as_played(
    found: Forecast,
    asked: AnalysisRequest,
    exact: list[MissionFigures],
    missions: list[MissionFigures],
    progress: Progress,
) -> list[str]:
    """Return which figures missions with exact times have otherwise, if by more than MATTERS and
    five standard errors, and the execution graph as a chain does not tell them right either: what
    phases do. Then append those missions to `exact`, and in any case to `missions`. Raises
    NoEstimate, TooLarge and OutOfTime."""
    plays, off, chain = played(progress.x, asked.measured), list[str](), progress.chain
    missions.append(plays)
    for name, value in found.figures.items():
        mean, error = plays.figures[name]
        if 0 < value < 1 and name != TIME:  # a share near 1 may have no miss in so few missions
            error = max(error, sqrt(value * (1 - value) / plays.missions))
        known = (value,) if isinstance(chain, str) else (value, chain.figures[name])
        if all(abs(one - mean) > max(5 * error, MATTERS * abs(mean)) for one in known):
            off.append(f"{name} {value:.6g} here, {mean:.6g} there (standard error {error:.2g})")
    if not off:
        return []
    exact.append(plays)
    return [
        f"{plays.missions} missions of the execution graph with exact times have other figures: "
        f"{', '.join(off)}. Here a timer or a duration has at most {asked.stages} phases"
    ]


def _growing(x: ExecutionGraph) -> PropertyVerdict:
    """Return that the task is unbounded if the engine has shown it. In its ends net transitions may
    wait although they can fire, so that tokens pile up which the engine takes at once."""
    if x.growth is None:
        text = "unknown: the ends net is unbounded, but no path was found that adds tokens for ever"
        return PropertyVerdict(None, text, complete=False)
    first, last = x.growth
    before, after = x.marked(first), x.marked(last)
    grows = few([p for p, n in after.items() if n > before.get(p, 0)])
    again = x.firings(last)[len(x.firings(first)) :]
    text = f"{grows} can grow without bound: {' '.join(again)} can be repeated for ever"
    return PropertyVerdict(False, text, Witness(x.firings(first), before, again))


def _figures(figures: Mapping[str, float]) -> str:
    known = {name: value for name, value in figures.items() if not isnan(value)}
    return ", ".join(f"{name} {_share(value)}" for name, value in known.items())


def _share(value: float, decimals: int = 6) -> str:
    return f"{value:.{decimals}f}" if not 0 < value < RARE else f"{value:.6g}"


def _why(error: Exception) -> str:
    """Return why something stayed unknown."""
    used_up = "the memory was used up; give more --memory, or simulate instead"
    return used_up if isinstance(error, OUT_OF_MEMORY) else str(error)


def missing(forecast: Forecast) -> list[tuple[float, Marking, tuple[str, ...]]]:
    """Return where a task ends without `final`: states that cover 99 % of 1 - P_complete, each with
    its probability, its marking and the firings of a shortest path, most probable first."""
    chain, view = forecast.chain, forecast.view
    ends = ~forecast.transient & ~forecast.done.goal
    into = forecast.transient[chain.source] & ends[chain.target]
    mass = np.bincount(chain.target[into], weights=forecast.flow[into], minlength=chain.n)
    found: dict[Marking, tuple[float, int]] = {}
    for i in np.flatnonzero(mass).tolist():
        marking = view.projected(chain.space.marking(i))
        share, first = found.get(marking, (0.0, i))
        found[marking] = (share + float(mass[i]), first)
    out, left = list[tuple[float, Marking, tuple[str, ...]]](), 0.99 * float(mass.sum())
    for marking, (share, i) in sorted(found.items(), key=lambda one: -one[1][0]):
        if left <= 0:
            break
        left -= share
        names = (view.origin.get(name) for name in chain.space.path(i))
        out.append((share, marking, tuple(name for name in names if name)))
    return out


def _missing_lines(found: Analysis) -> list[str]:
    """Say where the forecast and the verdict "sound" part: what completes with a probability below
    1 ends somewhere else, or the numbers leave out what is not sound."""
    sound = found.verdicts().get("sound")
    if found.forecast is None or sound is None or sound.holds is None:
        return []
    short = 1.0 - found.forecast.completion_probability
    if not sound.holds and short <= CERTAIN:
        return [
            "P_complete is 1, but the task is not sound: by its numbers, what leads to a state "
            "without an end never happens (a status has the share 0, a time comes first, or a "
            "condition is assumed to be true)"
        ]
    if short <= CERTAIN or not sound.holds:
        return []
    less = f"{short:.3g} short of 1" if short < 0.5 else f"only {1 - short:.3g}"
    lines = [
        f"sound, but P_complete is {less}: an end can always be reached, and not "
        "every end is `final`. The rest of the probability goes to:"
    ]
    net, rest = found.forecast.view.task.net, missing(found.forecast)
    lines += [
        f"  {share:.3g}  {net.describe(marking)}  by: {' '.join(path) or '(initial marking)'}"
        for share, marking, path in rest[:SHOWN]
    ]
    if more := rest[SHOWN:]:
        lines.append(f"  {sum(share for share, _, _ in more):.3g}  {len(more)} more states")
    return lines


def _sizes(net: Net) -> dict[str, int]:
    arcs = sum(map(len, (*net.consume, *net.produce, *net.inhibit)))
    return {"places": len(net.places), "transitions": len(net.transitions), "arcs": arcs}


def _recovery(r: Recovery, odds: Odds) -> Mapping[str, Any]:
    p, time = odds.by_exit.get(r.name, (None, None))
    return {
        "error_exit": r.error_exit,
        "cause": r.cause,
        "possible": r.possible.to_json(),
        "almost_sure": r.almost_sure.to_json(),
        "kappa": r.kappa,
        "while_another_is_handled": not r.alone,
        "probability": p,
        "mean_time": time if p else None,
        "goals_lost": r.lost,
        "strategy": list(r.strategy),
    }


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _word(holds: bool | None) -> str:
    return {True: "yes", False: "NO", None: "unknown"}[holds]


def _by_hand(verdict: PropertyVerdict) -> str:
    """Return in one line what only the operator's tokens make possible."""
    by = (f"by: {'; '.join(in_words(verdict.witness.steps))}",) if verdict.witness else ()
    return "; ".join(
        (f"only if the operator moves tokens: {verdict.reason}", *verdict.details, *by)
    )


def path_lines(witness: Witness | None, indent: str) -> list[str]:
    """Return the path to what a verdict found, a step in each line; of a long one the beginning and
    the end."""
    if witness is None:
        return []
    steps = in_words(witness.steps) or [" ".join(witness.firings) or "(initial marking)"]
    steps += [f"then again and again: {' '.join(witness.loop)}"] if witness.loop else []
    return [f"{indent}{'by: ' if not i else '    '}{step}" for i, step in enumerate(steps)]


def _verdict_lines(name: str, verdict: PropertyVerdict, told: list[Witness]) -> list[str]:
    """Return a verdict with its details and the firings that lead there, unless they are those of
    one of the verdicts before it: `told`."""
    head = f"  {name.replace('_', ' '):15}{_word(verdict.holds):9} {verdict.reason}"
    lines, indent = wrapped(head, VERDICT).split("\n"), " " * VERDICT
    for line in verdict.details:
        lines += wrapped(indent + line, VERDICT + 4).split("\n")
    if verdict.witness is None or verdict.witness in told:
        return lines
    told.append(verdict.witness)
    loop = verdict.witness.loop
    by = f"by: {' '.join(verdict.witness.firings) or '(initial marking)'}"
    by += f", then repeatedly: {' '.join(loop)}" if loop else ""
    return lines + wrapped(indent + by, VERDICT + 4).split("\n")


def _mended_line(verdict: PropertyVerdict) -> str:
    return f"{'':{VERDICT}}if the operator repairs it: {_word(verdict.holds)}, {verdict.reason}"


def _recovery_lines(found: Sequence[Recovery], odds: Odds) -> list[str]:
    """Return the way back from each error exit; those that fire only while another error is
    handled come last."""
    if not found:
        return []
    wide = max(14, *(len(r.name) for r in found))
    heads = ("back", "sure", "probability", "mean time", "further errors", "goals lost", "way back")
    lines = ["", f"{'error exits':{wide + 2}}{_columns(heads)}"]
    for alone, title in ((True, ""), (False, "only while another error is being handled:")):
        rows = [r for r in found if r.alone is alone]
        lines += [title] if rows and title else []
        for r in rows:
            lines += _recovery_row(f"  {r.name:{wide}}", r, odds)
    if odds.missing:
        return [*lines, f"  no probability: {odds.missing}"]
    if never := [r.name for r in found if r.name not in odds.by_exit]:
        lines.append(f"  no probability: by these numbers never taken: {', '.join(never)}")
    told = [text for text in odds.assumptions if not text.endswith(", not measured")]
    if len(told) < len(odds.assumptions):
        told.append("durations and shares as the task file declares them, where not measured")
    return [
        *lines,
        "  probability and mean time: a Markov chain on the execution graph, with at most "
        f"{odds.stages} phase{'s' * (odds.stages > 1)} for a duration",
        *(f"  assumed: {text}" for text in together(told)),
    ]


def _columns(texts: Sequence[str]) -> str:
    widths = (5, 5, 11, 9, 16, 10, 0)
    return "".join(f" {text:{w}}" for text, w in zip(texts, widths, strict=True)).rstrip()


def _recovery_row(name: str, r: Recovery, odds: Odds) -> list[str]:
    """Return the line of an error exit; a path that is too long for it has lines of its own."""
    named = {None: "any number", -1: "not recoverable", 0: "none"}
    if r.possible.holds:
        named[-1] = "none for certain"
    p, time = odds.by_exit.get(r.name, (None, None))
    path = " ".join(r.strategy) or ("(immediate)" if r.possible.holds and r.kappa != -1 else "-")
    row = (
        "some" if r.possible.holds is False and r.strategy else _word(r.possible.holds),
        _word(r.almost_sure.holds),
        "-" if p is None else _probability(p),
        "-" if not p else f"{time:.3g} s",
        named.get(r.kappa, str(r.kappa)),
        "-" if r.lost is None else " to ".join(str(n) for n in dict.fromkeys(r.lost)),
    )
    line = name + _columns((*row, path))
    why = [line for text in r.possible.details for line in wrapped(f"{'':8}{text}", 12).split("\n")]
    if len(line) <= COLUMNS:
        return [line, *why]
    return [name + _columns((*row, "")), f"{'':8}way back: {path}", *why]


def _probability(p: float) -> str:
    """Return a probability with eight digits, or by how little it is short of 1."""
    if 0 < 1 - p < 1e-13:
        return "1"  # what is missing is rounding
    return f"1 - {1 - p:.1e}" if 0 < 1 - p < 5e-8 else f"{p:.8f}" if p % 1 else f"{p:.0f}"


def heat(found: Forecast) -> dict[str, float]:
    """Return what a shorter time in each place saves of the whole (1: as much), 0 to 1, to colour a
    drawing."""
    shares: dict[str, float] = {}
    for w in found.worth:
        shares[w.place] = shares.get(w.place, 0.0) + w.time_share
    return {place: float(np.clip(share, 0.0, 1.0)) for place, share in shares.items()}
