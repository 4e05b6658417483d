"""A campaign as one HTML page: shares, choices and J over the trials, R and C of actions, the
task's own pictures, faults."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from math import isfinite, nan
from typing import Any

import numpy as np
from msgspec import Struct

from petrobot.coordinator.learning.objective import Figures, break_even, pareto
from petrobot.coordinator.learning.statistics import wilson
from petrobot.coordinator.run.timeline import Bar, Timeline
from petrobot.coordinator.studies.campaign.observed import regime_of
from petrobot.coordinator.studies.campaign.plan import CampaignError, CampaignPlan
from petrobot.coordinator.studies.campaign.summary import Summary
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import Trial
from petrobot.coordinator.studies.report import charts
from petrobot.coordinator.studies.report.action_pictures import (
    ACTIONS,
    TRIALS,
    action_pictures,
    add_latencies,
    latency_svg,
    learned_curves,
    objective_curves,
    put,
    trial_pictures,
)
from petrobot.coordinator.studies.report.comparing import Weighting, objective_intervals, objectives
from petrobot.coordinator.studies.report.page import gallery, html_page, section, table, text
from petrobot.coordinator.studies.report.plots import declared
from petrobot.coordinator.studies.report.run_page import gantt_svg
from petrobot.coordinator.task import Status, Task

# --- combinations of actions ---

Combination = tuple[tuple[str, str], ...]
"""(primitive task, action) of each primitive task with alternatives, in the order of the task
file."""


class CombinationFigures(Struct, frozen=True):
    """Figures of one combination of actions. `objective` is the mean J over the primitive tasks
    with alternatives, `task_objective` is J of the whole task."""

    combination: Combination
    trials: int
    goal: float
    objective: float
    task_objective: float
    time: float
    """Mean duration of the completed trials (s)."""
    goal_interval: tuple[float, float] = (0.0, 1.0)
    objective_interval: tuple[float, float] = (nan, nan)
    task_interval: tuple[float, float] = (nan, nan)
    """95 % intervals of the three, the last two for the given rho."""

    def to_plain(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            **dict(self.combination),
            "runs": self.trials,
            "R_goal": round(self.goal, 6),
            "R_goal 95 %": _interval(self.goal_interval),
            "J": round(self.objective, 6),
            "J 95 %": _interval(self.objective_interval),
            "J of the task": round(self.task_objective, 6),
            "J of the task 95 %": _interval(self.task_interval),
            "mean time (s)": round(self.time, 6),
        }


def combination_of(task: Task, row: TrialRow, names: Sequence[str]) -> dict[str, str]:
    """Return the actions of a trial's first runs."""
    out: dict[str, str] = {}
    for run in row.runs:
        name = task.primitive_task_of(run.place).name
        if name in names:
            out.setdefault(name, run.action)
    return out


def by_combination(
    task: Task,
    rows: Iterable[TrialRow],
    planned: Sequence[dict[str, str]] | None = None,
    weighting: Weighting | None = None,
) -> list[CombinationFigures]:
    """Compare the combinations of actions in these rows, all with one rho; the lowest J first.

    `planned`: the combination meant for each row; a trial that ended before all of its runs still
    counts for it. Without it, only trials in which every primitive task ran can be assigned to a
    combination.
    """
    kept = [row for row in rows if row.trial is not None]
    names = [p.name for p in task.primitive_tasks.values() if len(p.alternatives) > 1]
    weighting = weighting or Weighting.of(task, kept)
    groups: dict[Combination, list[TrialRow]] = {}
    for i, row in enumerate(kept):
        chosen = planned[i] if planned is not None else combination_of(task, row, names)
        if all(name in chosen for name in names):
            groups.setdefault(tuple((name, chosen[name]) for name in names), []).append(row)
    return sorted(
        (_judged(task, c, own, weighting) for c, own in groups.items()),
        key=lambda j: (j.objective, j.combination),
    )


def _judged(
    task: Task, combination: Combination, rows: Sequence[TrialRow], weighting: Weighting
) -> CombinationFigures:
    found = objectives(task, rows, weighting)
    times = [row.trial.time for row in rows if row.trial is not None and row.trial.time is not None]
    met = [row.trial is not None and row.trial.goals > 0 for row in rows]
    mean = float(np.mean(times)) if times else float("nan")
    return CombinationFigures(
        combination,
        len(rows),
        float(np.mean(met)),
        found["mean"],
        found["task"],
        mean,
        wilson(sum(met), len(met)),
        *objective_intervals(task, rows, weighting),
    )


DIFFERENCES = "Differences, paired"
AHEAD = (DIFFERENCES, TRIALS, ACTIONS)
"""Headings of pictures that come before the tables of actions."""
MOST = 12
"""Largest number of listed combinations."""
WORST = 40
"""Largest number of listed trials that went wrong."""


class CampaignReport:
    """Pictures and page of a campaign. `pictures` holds every picture by file name, with its
    heading."""

    def __init__(
        self, plan: CampaignPlan, task: Task, rows: Sequence[TrialRow], plots: Mapping[str, Any]
    ) -> None:
        self.plan, self.task, self.rows = plan, task, rows
        self.summary = Summary.of(task, rows, options=plan.options)
        self.trials = objective_curves(task, rows)
        self.without = ""
        """Why the probabilities of the choices are missing, if they are."""
        word = "choice probability" if plan.batch else "share of choices"
        try:
            learned_curves(plan, rows, self.trials)
        except CampaignError as fault:
            word, self.without = "share of choices", str(fault)
        self.pictures = trial_pictures(self.trials, word) | action_pictures(
            task, self.summary.estimates
        )
        self._own(plots)
        self._times()
        self._gantt()

    # --- pictures -----------------------------------------------------------------------------

    def _add(self, name: str, heading: str, svg: str) -> None:
        put(self.pictures, name, heading, svg)

    def _own(self, plots: Mapping[str, Any]) -> None:
        scores = [{**row.score, "n": row.n, "regime": row.regime} for row in self.rows]
        for name, svg in declared(plots, scores).items():
            self._add(f"own {name}", "Of the task itself", svg)

    def _times(self) -> None:
        times: dict[str, list[float]] = {}
        latencies: dict[str, list[float]] = {}
        for row in self.rows:
            if row.trial is None:
                continue
            if row.trial.time is not None:
                times.setdefault(row.regime or "time", []).append(row.trial.time)
            for run in row.trial.runs:
                add_latencies(latencies, run.action, run.values)
        if times:
            self._add("times", "Times", charts.histogram("Time of a run of the task", "s", times))
        if latencies:
            self._add("latencies", "Times", latency_svg(latencies))

    def _gantt(self) -> None:
        begun = [row for row in self.rows if row.trial is not None]
        bad = [
            row
            for row in begun
            if row.trial and row.trial.status == Status.ERROR.value and row.block != begun[0].block
        ]
        for name, words, row in (
            *(("gantt", "first cell", row) for row in begun[:1]),
            *(("gantt error", "a cell with an error", row) for row in bad[:1]),
        ):
            cell = timeline_of([one for one in begun if one.block == row.block])
            self._add(name, f"Runs over time: {words}, seed {row.seed}", gantt_svg(cell))

    # --- page ---------------------------------------------------------------------------------

    def html(self, more: Sequence[str]) -> str:
        """Return the page; `more` are further sections, after the figures."""
        plan = self.plan
        lead = f"{len(self.rows)} of {plan.runs} runs, selector {plan.selector}, seed {plan.seed}"
        lead += f", {plan.plant}"
        headings = list(dict.fromkeys(heading for heading, _ in self.pictures.values()))
        parts = [
            f"<h1>{escape(self.task.name)}: campaign</h1>",
            f'<p class="lead">{escape(lead)}</p>',
            section("Results", table(self._results())),
            *more,
            *(section(h, self._gallery(h)) for h in headings if h in AHEAD),
            section("Actions", "".join(self._judged())),
            *(
                section(f"Combinations, regime {r or '-'}", table(rows))
                for r, rows in self._combinations().items()
            ),
            *(section(h, self._gallery(h)) for h in headings if h not in AHEAD),
            section("Ends of runs and their causes", table(self._causes())),
            section("What went wrong, firing by firing", self._worst()),
        ]
        return html_page(f"{self.task.name}: campaign", parts)

    def _gallery(self, heading: str) -> str:
        return gallery(svg for own, svg in self.pictures.values() if own == heading)

    def _results(self) -> list[dict[str, Any]]:
        whole = self.summary.to_plain()
        parts = [*whole["by_regime"].items(), ("all", whole)]
        return [
            {
                "regime": name or "-",
                "runs": part["runs"],
                "R_goal": part["R_goal"],
                "95 %": f"{part['wilson'][0]:.4f} to {part['wilson'][1]:.4f}",
                "P_complete": part["P_complete"],
                "R_conj": part["R_conj"],
                "mean time (s)": part["mean"],
                "90 % of times below (s)": part["q90"],
                **{
                    f"{counted}: {column}": number
                    for counted, sums in part["counts"].items()
                    for column, number in sums.items()
                },
            }
            for name, part in parts
        ]

    def _judged(self) -> list[str]:
        out = []
        for primitive, judged in self.summary.comparisons().items():
            front = {f.action for f in pareto(judged.figures)}
            best = next((f for f in judged.figures if f.action == judged.best), None)
            rows = [_action_row(f, front, best, judged.clear) for f in judged.figures]
            out.append(
                f"<h3>{escape(primitive)} <small>rho = {judged.rho:.4g}</small></h3>{table(rows)}"
            )
        return out

    def _combinations(self) -> dict[str, list[dict[str, Any]]]:
        """Return the best combinations of actions by regime, from trials in which each primitive
        task ran; none if there is only one."""
        found = {}
        for regime in self.summary.by_regime:
            judged = by_combination(self.task, [row for row in self.rows if row.regime == regime])
            if len(judged) > 1:
                found[regime] = [one.to_plain() for one in judged[:MOST]]
        return found

    def _causes(self) -> list[dict[str, Any]]:
        counts: dict[tuple[str, str, str, str, str], int] = {}
        first: dict[tuple[str, str, str, str, str], TrialRow] = {}
        for row in self.rows:
            for run in row.runs:
                key = (row.regime, run.place, run.action, run.status or "none", run.cause)
                counts[key] = counts.get(key, 0) + 1
                first.setdefault(key, row)
        return [
            {
                **dict(zip(("regime", "place", "action", "status", "cause"), key, strict=True)),
                "runs": n,
                "first seen": f"seed {first[key].seed}, run {first[key].k}",
            }
            for key, n in sorted(counts.items())
        ]

    def _worst(self) -> str:
        bad = [
            row
            for row in self.rows
            if row.trial is not None and row.trial.status != Status.SUCCESS.value
        ]
        rows = [
            {
                "n": row.n,
                "regime": row.regime,
                "seed": row.seed,
                "run": row.k,
                "status": row.trial.status,
                "firings": story(row.trial),
            }
            for row in bad[:WORST]
            if row.trial is not None
        ]
        if not rows:
            return "<p>Nothing: every run met its specification.</p>"
        left = f"<p>{len(bad) - WORST} more in the table.</p>" if len(bad) > WORST else ""
        return (
            f"<details open><summary>{len(bad)} runs of the "
            f"task</summary>{table(rows)}{left}</details>"
        )


def _action_row(f: Figures, front: set[str], best: Figures | None, clear: bool) -> dict[str, Any]:
    even = break_even(best, f) if best is not None and best.action != f.action else None
    return {
        "action": f.action
        + (" (lowest J)" if clear and best is not None and f.action == best.action else ""),
        "runs": f.runs,
        "R in its hardest regime": f.reliability,
        "95 %": f"{f.lower:.3f} to {f.upper:.3f}",
        "availability": f.availability,
        "C": f.cost,
        "C 95 %": _interval((f.cost_lower, f.cost_upper)),
        "hardest regime": regime_of(f.worst or ""),
        "hardest that meets the target": None if f.scenario is None else regime_of(f.scenario),
        "J": f.j,
        "J 95 %": _interval((f.j_lower, f.j_upper)),
        "not beaten in both R and C": f.action in front,
        "same J as the best at rho": even,
    }


def timeline_of(rows: Sequence[TrialRow]) -> Timeline:
    """Return the runs of a mission run as bars of a timeline."""
    made = Timeline()
    for row in rows:
        for i, run in enumerate(row.runs):
            assert row.trial is not None
            begun = row.trial.begun + run.begun
            key = f"{run.place} of run {row.k}" + (f" ({i})" if i else "")
            status = Status(run.status) if run.status else None
            made.bars[key] = Bar(
                key, run.place, run.action, begun, begun + run.took, status, run.cause, run.text
            )
    return made


def story(trial: Trial) -> str:
    """Describe a trial in one line: what ended when and how, and which transition took its
    token."""
    ends = sorted(trial.runs, key=lambda run: run.begun + run.took)
    parts = []
    for run in ends:
        how = (
            (run.status or "preempted").upper() if run.status != Status.SUCCESS.value else "success"
        )
        why = (
            f" ({run.cause}: {run.text})"
            if run.cause and run.text
            else f" ({run.cause})"
            if run.cause
            else ""
        )
        parts.append(
            f"{run.begun + run.took:.2f} s {run.action} {how}{why}, {run.taken or 'not taken'}"
        )
    return "; ".join(parts)


def comparison_section(found: Mapping[str, Any], one: str, other: str) -> str:
    """Return a section that compares two campaigns."""
    shares = [
        {
            "share": name,
            one: row["one"],
            other: row["other"],
            "difference": row["difference"],
            "95 %": _interval(row["interval"]),
            f"only {one}": row["only_one"],
            f"only {other}": row["only_other"],
            "p (McNemar)": row["p"],
        }
        for name, row in found["shares"].items()
    ]
    rest = [
        {
            "figure": name,
            one: row["one"],
            other: row["other"],
            "difference": row["difference"],
            "95 %": _interval(row["interval"]),
        }
        for name, row in [
            *((_objective_name(n), r) for n, r in found["J"].items()),
            ("mean time (s)", found["time"]),
        ]
        if "difference" in row
    ]
    lead = (
        f"<p>{found['pairs']} pairs of trials with equal seeds; {found['left_out']} "
        "trials without a partner.</p>"
    )
    return section(f"{one} against {other}", lead + table(shares) + table(rest))


def _objective_name(name: str) -> str:
    return {"mean": "mean J", "task": "J of the whole task"}.get(name, f"J of {name}")


def _interval(ends: Sequence[float]) -> str:
    return f"{text(ends[0])} to {text(ends[1])}" if all(map(isfinite, ends)) else "-"


def comparison_pictures(
    found: Mapping[str, Any], one: str, other: str
) -> dict[str, tuple[str, str]]:
    """Return a picture of the differences with their intervals."""
    rows = [(name, "", *_ends(row)) for name, row in found["shares"].items()]
    rows += [(_objective_name(name), "", *_ends(row)) for name, row in found["J"].items()]
    svg = charts.intervals(f"{one} minus {other}, 95 % intervals, paired", "difference", rows)
    return {"comparison": (DIFFERENCES, svg)}


def _ends(row: Mapping[str, Any]) -> tuple[float, float, float]:
    return float(row["interval"][0]), float(row["difference"]), float(row["interval"][1])
