"""One analysis of a net or a task: every verdict and number together, as JSON and as a table for people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from coordinator.analysis.forecast import Forecast, forecast
from coordinator.analysis.gspn import Chain, Gspn
from coordinator.analysis.markov import LongRun, long_run
from coordinator.analysis.ordinary import OrdinaryView
from coordinator.analysis.qualitative import Qualitative, examine
from coordinator.analysis.robot import Recovery, RobotVerdicts, judge, one_run_each
from coordinator.analysis.siphons import PlaceSets, controlled_siphons, minimal_siphons, minimal_traps
from coordinator.analysis.space import EngineName, Limits, explore
from coordinator.analysis.stochastic import Measured, stochastic_view
from coordinator.analysis.structure import (
    Semiflows,
    conflict_sets,
    exclusive_places,
    is_strictly_conservative,
    lyapunov,
    place_semiflows,
    transition_semiflows,
)
from coordinator.analysis.verdict import Verdict
from coordinator.net import Net
from coordinator.task import Kind, Task

SHOWN = 20
"""Entries of a list that the text shows."""


@dataclass(frozen=True)
class Structure:
    """What the arcs alone say, computed when asked for."""

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

    def to_json(self) -> dict[str, Any]:
        """Plain data, places and transitions by name."""
        places, transitions = self.net.places, self.net.transitions
        function = lyapunov(self.net)
        return {
            "p_invariants": [{places[p]: n for p, n in sorted(y.items())} for y in self.place_flows.vectors],
            "t_invariants": [{transitions[t]: n for t, n in sorted(x.items())} for x in self.transition_flows.vectors],
            "invariants_complete": self.place_flows.complete and self.transition_flows.complete,
            "siphons": [sorted(places[p] for p in s) for s in self.siphons.sets],
            "traps": [sorted(places[p] for p in s) for s in self.traps.sets],
            "siphons_complete": self.siphons.complete and self.traps.complete,
            "siphons_controlled": controlled_siphons(self.net),
            "structurally_bounded": function is not None,
            "conservative": function is not None and function.conserved,
            "strictly_conservative": is_strictly_conservative(self.net),
            "lyapunov": {places[p]: n for p, n in sorted(function.weights.items())} if function else None,
            "conflicts": [[transitions[t] for t in group] for group in conflict_sets(self.net)],
            "exclusive_places": sorted([places[p], places[q]] for p, q in exclusive_places(self.net, self.place_flows)),
        }


@dataclass(frozen=True)
class Analysis:
    """The result of `analyse`. For a task `closed` and `robot` judge the net closed by refill and repair."""

    name: str
    net: Net
    qualitative: Qualitative
    closed: Qualitative | None
    robot: RobotVerdicts | None
    structure: Structure
    run: LongRun | None
    forecast: Forecast | None
    notes: tuple[str, ...]
    one_run_each: Verdict | None = None
    """Of a task: whether no action place is entered while its run goes on."""

    @property
    def progress(self) -> Qualitative:
        """Where liveness, properness and home markings are judged: the closed net if there is one."""
        return self.closed or self.qualitative

    @property
    def ok(self) -> bool:
        """Whether nothing speaks against running it: bounded, free from deadlock, one run at a time in an action place."""
        crowded = self.one_run_each is not None and self.one_run_each.holds is not True
        return self.qualitative.bounded.holds is True and self.qualitative.deadlock_free.holds is True and not crowded

    def to_json(self, *, structure: bool = True) -> dict[str, Any]:
        """Plain data with the promised keys: verdicts are true, false or null."""
        q, again, unbounded = self.qualitative, self.progress, self.qualitative.bounded.holds is False
        out: dict[str, Any] = {
            "name": self.name,
            "net": _sizes(self.net),
            "states": None if unbounded else len(q.space),
            "edges": None if unbounded else q.space.edges,
            "complete": q.space.complete,
            "reason": q.space.reason,
            "engine": q.space.engine,
            "bounded": q.bounded.holds,
            "max_tokens_per_place": _largest(q.bounds),
            "max_tokens_in_marking": q.space.most_tokens if q.space.complete else None,
            "bounds": dict(zip(self.net.places, q.bounds, strict=True)),
            "safe": q.safe.holds,
            "deadlock": None if q.deadlock_free.holds is None else not q.deadlock_free.holds,
            "deadlocks": [
                {"marked": list(d.marked), "count": d.count, "emptied": list(d.emptied), **d.witness.to_json()}
                for d in q.deadlocks
            ],
            "dead_markings": q.dead_markings,
            "quasi_live": q.quasi_live.holds,
            "dead_transitions": list(q.dead_transitions),
            "live": again.live.holds,
            "liveness": dict(zip(again.space.net.transitions, again.levels, strict=True)),
            "reversible": again.reversible.holds,
            "home_states": again.home_states,
            "sound": q.sound.holds if q.sound else None,
            "judged_on_closed_net": ["live", "liveness", "reversible", "home_states"] if self.closed else [],
            "verdicts": {name: verdict.to_json() for name, verdict in self.verdicts().items()},
            "notes": list(self.notes),
        }
        out |= {"structure": self.structure.to_json()} if structure else {}
        out |= {"recoveries": [_recovery(r) for r in self.robot.recoveries]} if self.robot else {}
        return out | self._numbers()

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
                "forecast": self.forecast.to_json(),
            }
        return {}

    def figures(self) -> dict[str, float]:
        """The numbers by which two analyses are compared."""
        if self.forecast is not None:
            f = self.forecast
            goal = {} if f.goal_reliability is None else {"R_goal": f.goal_reliability}
            shape = {"90 % quantile of the time (s)": f.law().quantile(0.9)} if f.completion_probability > 0 else {}
            own = {"P_complete": f.completion_probability, **goal, "R_conj": f.conjunctive_reliability}
            return own | {"mean time (s)": f.done.mean} | shape
        if self.run is not None:
            return {f"throughput of {t} (1/s)": x for t, x in self.run.throughput.items()}
        return {"markings": len(self.qualitative.space)}

    def verdicts(self) -> dict[str, Verdict]:
        """All verdicts by name, in robot words where the net is a task."""
        q, again = self.qualitative, self.progress
        out = {"bounded": q.bounded, "safe": q.safe, "deadlock_free": q.deadlock_free, "quasi_live": q.quasi_live}
        out |= {"live": again.live, "proper" if self.closed else "reversible": again.reversible}
        if self.one_run_each is not None:
            out["one_run_each"] = self.one_run_each
        if q.sound is not None:
            out["sound"] = q.sound
        if self.robot is not None:
            out |= {"stable": self.robot.stable, "controllable": self.robot.controllable}
        return out

    def text(self) -> str:
        """A table for people."""
        q = self.qualitative
        size = _sizes(self.net)
        lines = [
            f"{self.name}: {size['places']} places, {size['transitions']} transitions, {size['arcs']} arcs; "
            f"{len(q.space)} markings, {q.space.edges} edges"
            + ("" if q.space.complete else f" (partial: {q.space.reason})"),
            "",
        ]
        for name, verdict in self.verdicts().items():
            lines += _verdict_lines(name, verdict)
        lines += [
            f"  deadlock       {d.count} x: {' '.join(d.witness.firings) or '(initial marking)'}"
            for d in q.deadlocks[:SHOWN]
        ]
        if self.robot is not None:
            lines += ["", "error exits     possible  sure  further errors  run      way back"]
            lines += [_recovery_line(r) for r in self.robot.recoveries]
        assumed = dict.fromkeys(v.assumption for v in self.verdicts().values() if v.holds and v.assumption)
        lines += ["", *(f"These hold for the executed task if {text}." for text in assumed)] if assumed else []
        lines += self._number_lines()
        return "\n".join(lines + [f"note: {note}" for note in self.notes])

    def _number_lines(self) -> list[str]:
        if self.run is not None:
            busiest = sorted(self.run.utilisation.items(), key=lambda one: -one[1])[:SHOWN]
            rows = [f"  {name:24}{self.run.throughput[name]:12.6g} /s {load:10.4g} at work" for name, load in busiest]
            return ["", f"long run (residual {self.run.residual:.1e} /s):", *rows]
        if self.forecast is None:
            return []
        f, done = self.forecast, self.forecast.done
        goal = f"R_goal {f.goal_reliability:.6f}, " if f.goal_reliability is not None else ""
        rows = [
            f"  {w.place}.{w.action}: {100 * w.time_share:.1f} % of the time; error to success: "
            f"{w.completion_gain:+.2e} complete, {w.goal_gain:+.3f} goals"
            for w in f.worth[:SHOWN]
        ]
        return [
            "",
            f"forecast: P_complete {done.probability:.9f}, {goal}R_conj {f.conjunctive_reliability:.6f}",
            f"  time {done.mean:.3f} s, standard deviation {done.variance**0.5:.3f} s; back to the nominal flow within "
            f"{f.recovery_time:.3f} s on average at worst; residual {done.residual:.1e}",
            "worth improving:",
            *rows,
            *(f"assumed: {text}" for text in f.view.assumptions),
        ]


def analyse(
    model: Net | Task | Gspn,
    *,
    name: str = "",
    view: str = "ordinary",
    measured: Measured | None = None,
    stages: int = 8,
    limits: Limits | None = None,
    engine: EngineName = "auto",
) -> Analysis:
    """All verdicts on a net or task; with `view="gspn"` also the numbers of its stochastic view.

    A GSPN gives its long run from the initial marking; a task its forecast. Numbers that cannot be had (a partial space, a
    timeless trap) leave a note instead. `limits` hold for each state space that is explored.
    """
    if isinstance(model, Task):
        return _analyse_task(model, view, measured, stages, limits, engine)
    net = model.net if isinstance(model, Gspn) else model
    space = explore(net, limits=limits, engine=engine)
    notes: list[str] = []
    run = None
    if isinstance(model, Gspn) and view == "gspn":
        try:
            run = long_run(Chain.of(model, space=space))
        except (ValueError, ArithmeticError) as why:
            notes.append(f"no long run: {why}")
    return Analysis(name or "net", net, examine(space), None, None, Structure(net), run, None, tuple(notes))


def _analyse_task(
    task: Task, view: str, measured: Measured | None, stages: int, limits: Limits | None, engine: EngineName
) -> Analysis:
    ordinary, notes = OrdinaryView(task), list[str]()
    space = explore(ordinary.net, limits=limits, engine=engine)
    qualitative = examine(space, final=ordinary.is_end)
    closed = robot = None
    try:
        net = ordinary.closed(space)
        again = explore(net, limits=limits, engine=engine)
        closed, robot = examine(again), judge(again, ordinary.roles(net), space)
    except ValueError as why:
        notes.append(f"live and proper are judged on the open net: {why}")
    numbers = None
    if view == "gspn":
        try:
            numbers = forecast(stochastic_view(task, measured, stages=stages), limits=limits)
        except (ValueError, ArithmeticError) as why:
            notes.append(f"no forecast: {why}")
    single = [p.name for p in task.flat.places.values() if p.kind is Kind.ACTION and p.servers is None]
    alone = one_run_each(space, single)
    whole = Structure(ordinary.net)
    return Analysis(task.name, ordinary.net, qualitative, closed, robot, whole, None, numbers, tuple(notes), alone)


def _sizes(net: Net) -> dict[str, int]:
    arcs = sum(map(len, (*net.consume, *net.produce, *net.inhibit)))
    return {"places": len(net.places), "transitions": len(net.transitions), "arcs": arcs}


def _largest(bounds: tuple[int | None, ...]) -> int | None:
    return None if None in bounds else max((b for b in bounds if b is not None), default=0)


def _recovery(r: Recovery) -> Mapping[str, Any]:
    return {
        "error_exit": r.error_exit,
        "possible": r.possible.to_json(),
        "almost_sure": r.almost_sure.to_json(),
        "kappa": r.kappa,
        "resumed": r.resumed,
        "strategy": list(r.strategy),
    }


def _word(holds: bool | None) -> str:
    return {True: "yes", False: "NO", None: "unknown"}[holds]


def _verdict_lines(name: str, verdict: Verdict) -> list[str]:
    lines = [f"  {name.replace('_', ' '):15}{_word(verdict.holds):8} {verdict.reason}"]
    if verdict.witness is not None:
        firings = " ".join(verdict.witness.firings) or "(initial marking)"
        lines.append(
            f"{'':26}by: {firings}"
            + (f", then again and again: {' '.join(verdict.witness.loop)}" if verdict.witness.loop else "")
        )
    return lines


def _recovery_line(r: Recovery) -> str:
    kappa = "any number" if r.kappa is None else "none" if r.kappa <= 0 else str(r.kappa)
    run = {True: "resumed", False: "lost", None: "-"}[r.resumed]
    back = " ".join(r.strategy) or ("(at once)" if r.possible.holds and r.kappa != -1 else "(no way)")
    return f"  {r.error_exit:14}{_word(r.possible.holds):10}{_word(r.almost_sure.holds):6}{kappa:16}{run:9}{back}"


def heat(analysis: Analysis) -> dict[str, float]:
    """How much of the time each place takes, 0 to 1: for colouring the bottleneck on a drawing."""
    if analysis.forecast is not None:
        shares: dict[str, float] = {}
        for w in analysis.forecast.worth:
            shares[w.place] = shares.get(w.place, 0.0) + w.time_share
        return {place: float(np.clip(share, 0.0, 1.0)) for place, share in shares.items()}
    return dict(analysis.run.occupancy) if analysis.run is not None else {}
