"""Figures of a campaign's table: shares with intervals, times, choices, estimates, and J of every
action."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field

from petrobot.coordinator.learning.estimate import Tally, TallyKey
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.objective import Comparison, Question, compare, task_figures
from petrobot.coordinator.learning.statistics import wilson
from petrobot.coordinator.studies.campaign.observed import ESTIMATES, add_row, context_of, regime_of
from petrobot.coordinator.studies.campaign.plan import TABLE, CampaignPlan
from petrobot.coordinator.studies.campaign.table import TrialRow, sessions, times
from petrobot.coordinator.task import PrimitiveTask, Task


class TrialCounts(Struct):
    """Counts of trials, of one regime or of all."""

    runs: int = 0
    """Trials that began."""
    not_begun: int = 0
    """Trials that did not begin because the mission run was given up."""
    goals: int = 0
    completed: int = 0
    all_success: int = 0
    times: list[float] = field(default_factory=list)
    """Durations of the completed trials (s)."""
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    """Sums of the whole numbers that the task's score gives for each trial, by table and column:
    of all things counted, not of the first one of each trial."""

    def add(self, row: TrialRow) -> None:
        """Count a trial."""
        self._add_up(row)
        if row.trial is None:
            self.not_begun += 1
            return
        self.runs += 1
        self.goals += row.trial.goals > 0
        self.completed += row.trial.completed
        self.all_success += row.trial.all_success
        if row.trial.completed and row.trial.time is not None:
            self.times.append(row.trial.time)

    def _add_up(self, row: TrialRow) -> None:
        for key, value in row.score.items():
            table, _, column = key.partition(".")
            if type(value) is int and table != "score" and column != "n":
                sums = self.counts.setdefault(table, {})
                sums[column] = sums.get(column, 0) + value

    def to_plain(self, has_goal: bool) -> dict[str, Any]:
        """Return plain data; R_goal is None for a task without goal transitions."""
        met = self.goals if has_goal else self.completed
        low, high = wilson(met, self.runs)
        return {
            "runs": self.runs,
            "not_begun": self.not_begun,
            "R_goal": _share(self.goals, self.runs) if has_goal else None,
            "wilson": [round(low, 6), round(high, 6)],
            "P_complete": _share(self.completed, self.runs),
            "R_conj": _share(self.all_success, self.runs),
            "untimed": self.completed - len(self.times),
            "mean": round(float(np.mean(self.times)), 6) if self.times else None,
            "q90": round(float(np.quantile(self.times, 0.9)), 6) if self.times else None,
            "counts": {table: dict(sums) for table, sums in self.counts.items()},
        }


def _share(part: int, whole: int) -> float | None:
    return round(part / whole, 6) if whole else None


def question_of(
    primitive: PrimitiveTask, options: Mapping[str, Any], declared: bool = True
) -> Question:
    """Return by what the actions of a primitive task are judged: target and rho as in the plan's
    options.

    If the options have no target, the one that the task file declares is used, unless `declared` is
    off.
    """
    target = options.get("target", primitive.target_reliability if declared else None)
    costs = tuple(primitive.costs.items())
    return Question(primitive.cost, target, options.get("rho"), declared=costs)


def comparisons(
    task: Task,
    tallies: Mapping[TallyKey, Tally],
    regime: str | None = None,
    options: Mapping[str, Any] | None = None,
) -> dict[str, Comparison]:
    """Compare, for each primitive task, all alternatives that have runs: over all regimes as
    scenarios, or in one regime.

    `options`: those of the campaign's plan. In one regime, a target counts only if it was given (as
    in `Learning.comparison`).
    """
    out = {}
    for primitive in task.primitive_tasks.values():
        by_action: dict[str, dict[str, Tally]] = {}
        for key, tally in tallies.items():
            if key.primitive_task == primitive.name and (
                regime is None or key.context == context_of(regime)
            ):
                by_action.setdefault(key.action, {})[key.context] = tally
        if by_action:
            ordered = {a: by_action[a] for a in primitive.alternatives if a in by_action}
            out[primitive.name] = compare(
                ordered, question_of(primitive, options or {}, regime is None)
            )
    return out


class Summary(Struct):
    """Everything that is counted in one pass over the rows."""

    task: Task
    whole: TrialCounts = field(default_factory=TrialCounts)
    by_regime: dict[str, TrialCounts] = field(default_factory=dict)
    chosen: dict[str, dict[str, int]] = field(default_factory=dict)
    estimates: Estimates = field(default_factory=Estimates)
    salt: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the campaign's plan: target reliability and rho, if they were given."""
    mission_s: dict[int, float] = field(default_factory=dict)
    seen: dict[int, tuple[str, int, int]] = field(default_factory=dict)
    """By block: its regime, its seed, and a digest of what happened in it so far."""
    after: dict[int, Any] = field(default_factory=dict)
    """What happened after a digest, while nothing else has happened after it."""
    drawn: set[str] = field(default_factory=set)
    """Regimes in which something draws from the seed: after the same runs, different things
    happened."""

    @classmethod
    def of(
        cls,
        task: Task,
        rows: Iterable[TrialRow],
        salt: str = "",
        options: Mapping[str, Any] | None = None,
    ) -> Summary:
        """Summarise the rows of a table. `salt` names the campaign in the estimates; `options` are
        those of its plan."""
        made = cls(task, salt=salt, options=options or {})
        for row in rows:
            made.add(row)
        return made

    def add(self, row: TrialRow) -> None:
        """Count a row."""
        self.whole.add(row)
        self.by_regime.setdefault(row.regime, TrialCounts()).add(row)
        self.mission_s[row.block] = row.mission_s
        self._see(row)
        for run in row.runs:
            primitive = self.task.primitive_task_of(run.place).name
            actions = self.chosen.setdefault(primitive, {})
            actions[run.action] = actions.get(run.action, 0) + 1
        add_row(self.estimates, self.task, row, self.salt)

    def _see(self, row: TrialRow) -> None:
        """Keep what the seed of a block may change: which runs there were, how they ended, when,
        and with which values. Which action was chosen is no sign of a draw of the task."""
        regime, seed, digest = self.seen.get(row.block, (row.regime, row.seed, hash(row.regime)))
        for r in () if row.trial is None else row.trial.runs:
            end = (r.took, r.status, r.cause, *r.values.items())
            if regime not in self.drawn:
                told = [(digest, (r.place, r.begun)), (hash((digest, r.action)), end)]
                if any(self.after.setdefault(one, what) != what for one, what in told):
                    self.drawn.add(regime)
            digest = hash((digest, r.place, r.action, r.begun, end))
        self.seen[row.block] = (regime, seed, digest)

    def copies(self) -> list[list[int]]:
        """Return the seeds of blocks in one regime that are copies of each other. Where something
        draws from the seed, blocks are equal only by chance, as where it draws one of few ends."""
        groups: dict[tuple[str, int], set[int]] = {}
        for regime, seed, digest in self.seen.values():
            if regime not in self.drawn:
                groups.setdefault((regime, digest), set()).add(seed)
        return [sorted(seeds) for seeds in groups.values() if len(seeds) > 1]

    def asked(self) -> dict[str, Question]:
        """Return by what the actions of each primitive task are judged."""
        return {p.name: question_of(p, self.options) for p in self.task.primitive_tasks.values()}

    def comparisons(self) -> dict[str, Comparison]:
        """Compare the actions of each primitive task over all regimes, as the campaign's options
        ask."""
        return comparisons(self.task, self.estimates.tallies, options=self.options)

    def _judged(self, name: str, found: Comparison) -> dict[str, Any]:
        """Return what J of a primitive task is based on: measure, target, rho, regimes, and which
        action meets the target where."""
        asked = question_of(self.task.primitive_tasks[name], self.options)
        return {
            "cost": asked.measure,
            "target": asked.target,
            "rho": round(found.rho, 9),
            "regimes": [regime_of(s) for s in found.scenarios],
            "meet_target": {
                f.action: [regime_of(s) for s in f.scenarios] for f in found.figures if f.admissible
            },
            "uncosted": list(found.uncosted),
            "level_with_best": list(found.level_with_best),
        }

    def task_figures(self) -> dict[str, Any]:
        """Return R_conj, C and J of the whole task with intervals (`objective.task_figures`), in
        the regime in which R_conj is lowest; nothing without trials."""
        rho, trials = self.options.get("rho"), self.estimates.trials_of(self.task.name)
        measures = {name: p.cost for name, p in self.task.primitive_tasks.items()}
        rho = None if rho is None else float(rho)
        found = task_figures(trials, measures, self.comparisons(), rho)
        if found is None:
            return {}
        plain = found.to_plain()
        return {"regime": regime_of(plain.pop("context")), **plain}

    def to_plain(self) -> dict[str, Any]:
        """Return plain data."""
        has_goal, found = bool(self.task.goal_transitions), self.comparisons()
        return {
            **self.whole.to_plain(has_goal),
            "task_figures": self.task_figures(),
            "by_regime": {
                name: counts.to_plain(has_goal) for name, counts in self.by_regime.items()
            },
            "chosen": {
                t: dict(sorted(self.chosen[t].items()))
                for t in self.task.primitive_tasks
                if t in self.chosen
            },
            "J": {
                name: {f.action: _finite(f.j) for f in judged.figures}
                for name, judged in found.items()
            },
            "J_interval": {
                name: {f.action: _bounds(f.j_lower, f.j_upper) for f in judged.figures}
                for name, judged in found.items()
            },
            "judged": {name: self._judged(name, judged) for name, judged in found.items()},
            "sim_s": round(sum(self.mission_s.values()), 6),
            "copies": self.copies(),
        }


def result_of(
    folder: Path, plan: CampaignPlan, made: Summary, policy: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the result of a campaign as the command line writes it."""
    summary, task = made.to_plain(), made.task
    held, took = sessions(folder), times(folder)
    wall = sum(float(s["wall_s"]) for s in held)
    core_s = sum(float(s["wall_s"]) * int(s["workers"]) for s in held)
    cpu = sum({int(t["block"]): float(t["cpu_s"]) for t in took}.values())
    sim = summary["sim_s"]
    return {
        "task": task.name,
        "regimes": list(plan.regimes),
        "seed": plan.seed,
        "selector": plan.selector,
        "plant": plan.plant,
        "workers": int(held[-1]["workers"]) if held else 0,
        "rows": str(folder / TABLE),
        "estimates": str(folder / ESTIMATES),
        **summary,
        "runs": plan.runs,
        "begun": summary["runs"],
        "policy": dict(policy),
        "lost_workers": sum(int(s["lost"]) for s in held),
        "wall_s": round(wall, 3),
        "cpu_s": round(cpu, 3),
        "times_real_time_per_core": round(sim / core_s, 3) if core_s else None,
        "times_real_time_per_cpu_s": round(sim / cpu, 3) if cpu else None,
    }


def _finite(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def _bounds(low: float, high: float) -> list[float] | None:
    known = math.isfinite(low) and math.isfinite(high)
    return [round(low, 6), round(high, 6)] if known else None
