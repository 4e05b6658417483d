"""`learned show`: the estimates of actions and how they compare, over all contexts and in each
context, with warnings."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import reduce
from math import inf, isfinite, isnan
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import UNKNOWN, write_json

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from petrobot.coordinator.learning.estimate import Tally
    from petrobot.coordinator.learning.estimates_file import FileContents
    from petrobot.coordinator.learning.objective import Comparison, Figures, Question

Tallies = Mapping[str, "Mapping[str, Tally]"]
"""By action, then by context."""


def show(kept: FileContents, tasks: Sequence[str], options: argparse.Namespace) -> int:
    """Print what is known of the primitive tasks' actions, and write it as JSON."""
    from petrobot.coordinator.learning.objective import compare

    plants = [p for p in sorted(kept.plants, key=kept.rank) if options.plant in (None, p)]
    known = {(task, p): kept.plants[p].of(task, options.context) for task in tasks for p in plants}
    refuse_unknown_context(kept, tasks, options)
    try:
        refuse_unknown_cost(known, options)
        shown = {}
        for task in tasks:
            question, of = asked_question(kept, task, options), {p: known[task, p] for p in plants}
            # A primitive task that ran only in another plant is shown with the numbers of that
            # plant.
            main = kept.plant if of.get(kept.plant) else next((p for p in plants if of[p]), "")
            tallies = of.pop(main, {})
            about = _plain(kept, task, tallies, question, compare(tallies, question), options)
            about["source"] = main
            for row in about["actions"]:
                row["source"] = main
            for plant, others in of.items():
                about["actions"] += [
                    {**_row(others[f.action], question, f), "pareto": None, "source": plant}
                    for f in compare(others, question).figures
                ]
            prior = kept.priors.get(main)
            about["prior"] = None if prior is None else {"source": prior[0], "trials": prior[1]}
            shown[task] = about
        names = () if options.more else sorted({key.task for key in kept.estimates.trials})
        whole = {name: measured_task(kept, name, options) for name in names}
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault
    if options.json:
        told = {"file": str(options.file), "primitive_tasks": shown, "tasks": whole}
        write_json(options.json, told)
    if options.json != "-":
        for task, about in shown.items():
            _print(task, about, options)
        for task, figures in whole.items():
            if figures is not None:
                print(f"{task}: {task_line(figures)}")
        if not shown and not whole:
            print(f"{options.file}: no run has been learned from")
    return 0


def measured_task(
    kept: FileContents, name: str, options: argparse.Namespace
) -> dict[str, Any] | None:
    """Return R_conj, C and J of a whole task as its trials in the plant measured them, as plain
    data; None if the file has none. C is that of the costs by which the runs were judged."""
    from petrobot.coordinator.learning.objective import common_weight, compare, task_figures

    trials = kept.estimates.trials_of(name, options.context)
    asked = {p: kept.question(p) for sums in trials.values() for p in sums.runs}
    compared = {p: compare(kept.estimates.of(p, options.context), q) for p, q in asked.items()}
    measures = {p: q.measure for p, q in asked.items()}
    rho = common_weight(asked.values()) if options.rho is None else options.rho
    found = task_figures(trials, measures, compared, rho)
    if found is not None and options.cost not in (None, *measures.values()):
        found = replace(found, cost=None, rho=None, j=None)  # trials hold costs of one measure
    return None if found is None else found.to_plain()


def task_line(figures: Mapping[str, Any]) -> str:
    """Return R_conj, C and J of measured trials in one line."""
    parts = [
        f"{name} {figures[name]:.3g} ({low:.3g} to {high:.3g})"
        for name in ("R_conj", "C", "J")
        if figures[name] is not None
        for low, high in [figures[f"{name}_interval"]]
    ]
    rho = "" if figures["rho"] is None else f", rho {figures['rho']:.3g}"
    if figures["C"] is None:
        rho = "; these trials do not tell C and J of this cost"
    elif figures["J"] is None:
        rho = "; J needs a --rho, because a primitive task has no measured cost now"
    n, where = figures["trials"], figures["context"]
    trials = f"{n} trial{'s' * (n != 1)} of the task{f' ({where})' if where else ''}"
    return f"{trials}: {', '.join(parts)}{rho}"


def asked_question(kept: FileContents, task: str, options: argparse.Namespace) -> Question:
    """Return the question of the options; what they leave out is taken from the file. The file's
    target is for all contexts together, not for one."""
    asked = kept.question(task)
    target = asked.target if options.target is None and options.context is None else options.target
    measure = options.cost or asked.measure
    return replace(
        asked,
        measure=measure,
        declared=asked.declared if measure == asked.measure else (),
        target=target,
        rho=asked.rho if options.rho is None else options.rho,
    )


def refuse_unknown_context(
    kept: FileContents, tasks: Sequence[str], options: argparse.Namespace
) -> None:
    """Raise CommandError for a context in which no action of these primitive tasks was run."""
    if options.context is None:
        return
    known = {c for found in kept.plants.values() for task in tasks for c in found.contexts(task)}
    if options.context not in known:
        there = ", ".join(repr(c) for c in sorted(known)) or "none"
        raise CommandError(
            2,
            f"--context {options.context!r}: {options.file} has no run in it; it has the "
            f"contexts {there}",
        )


def refuse_unknown_cost(known: Mapping[Any, Tallies], options: argparse.Namespace) -> None:
    """Raise CommandError for a cost that no result has: it would be 0 for every action."""
    kind, _, name = (options.cost or "").partition(":")
    tallies = [
        t
        for by_action in known.values()
        for by_context in by_action.values()
        for t in by_context.values()
    ]
    if kind != "value" or not name or any(name in t.values for t in tallies):
        return
    there = (
        ", ".join(f"value:{n}" for n in sorted({n for t in tallies for n in t.values}))
        or "no numbers at all"
    )
    raise CommandError(
        2,
        f"--cost {options.cost}: no result in {options.file} has a number {name!r}; the "
        f"results have: {there}",
    )


# --- plain data -------------------------------------------------------------------------------


def _plain(
    kept: FileContents,
    task: str,
    tallies: Tallies,
    asked: Question,
    judged: Comparison,
    options: argparse.Namespace,
) -> dict[str, Any]:
    from petrobot.coordinator.learning.objective import cost_to_reach, pareto, reliability_for

    rows = [_row(tallies[f.action], asked, f) for f in judged.figures]
    front = {f.action for f in pareto(judged.figures)}
    for row in rows:
        row["pareto"] = row["action"] in front
    about: dict[str, Any] = {
        "cost": asked.measure,
        "target": asked.target,
        "target_unmet": judged.unmet and asked.target is not None,
        "rho": judged.rho,
        "best": judged.best,
        "level_with_best": list(judged.level_with_best),
        "clear": judged.clear,
        "judged_over": list(judged.scenarios),
        "contexts": sorted({c for by_context in tallies.values() for c in by_context}),
        "uncosted": list(judged.uncosted),
        "asked_elsewhere": [_words(q) for q in kept.asked.get(task, ())[1:]],
        "actions": rows,
        "break_even": _break_even(judged),
    }
    if options.target is not None:
        # A target that no lower bound meets is not reached by a mean of a few runs either.
        reached = None if judged.unmet else cost_to_reach(judged.figures, options.target)
        about["to_reach"] = _answer(reached)
    if options.budget is not None:
        about["for_cost"] = _answer(reliability_for(judged.figures, options.budget))
    about["by_context"] = _by_context(tallies, replace(asked, target=None, rho=judged.rho))
    about["selectors"] = _selectors(kept, task)
    return about


def _row(by_context: Mapping[str, Tally], asked: Question, f: Figures) -> dict[str, Any]:
    from petrobot.coordinator.learning.estimate import Tally

    whole = reduce(Tally.merged, by_context.values(), Tally())
    cost = whole.cost(asked.measure)
    return {
        "action": f.action,
        "runs": f.runs,
        "R": _number(f.reliability),
        "R_low": f.lower,
        "R_high": f.upper,
        "worst": f.worst,
        "R_over_all_runs": _number(whole.reliability),
        "A": f.availability,
        "C": _number(f.cost),
        "C_low": _number(f.cost_lower),
        "C_high": _number(f.cost_upper),
        "C_declared": _number(asked.declared_cost(f.action)),
        "C_largest": _number(f.largest_cost),
        "scenario": f.scenario,
        "scenarios": list(f.scenarios),
        "J": _number(f.j),
        "J_low": _number(f.j_lower),
        "J_high": _number(f.j_upper),
        "runs_needed": f.needed,
        "runs_there": 0 if f.worst is None else by_context[f.worst].judged,
        "cost_mean": cost.mean if cost.n else None,
        "cost_deviation": cost.deviation,
        **_times(whole),
        "censored": whole.censored,
        "unknown": whole.unknown,
        "corrected": whole.corrected,
        "unjudged": sum(whole.unjudged.values()),
        "causes": {
            f"{status}: {cause or '-'}": n
            for (status, cause), n in whole.counts.items()
            if status != "success"
        },
        "not_executed": dict(whole.not_executed),
    }


def _times(tally: Tally) -> dict[str, Any]:
    return {
        "seconds_mean": tally.wall.mean if tally.wall.n else None,
        "seconds_p50": _number(tally.quantile(0.5)),
        "seconds_p90": _number(tally.quantile(0.9)),
        "cpu_mean": tally.cpu.mean if tally.cpu.n else None,
        "cpu_p90": _number(tally.quantile(0.9, "cpu")),
    }


def _by_context(tallies: Tallies, asked: Question) -> list[dict[str, Any]]:
    """Return each action in each context. J uses the rho of the comparison over all contexts."""
    from petrobot.coordinator.learning.objective import compare

    out = []
    for action, by_context in tallies.items():
        for context, tally in by_context.items():
            (f,) = compare({action: {context: tally}}, asked).figures
            row = {
                "action": action,
                "context": context,
                "runs": f.runs,
                "R": _number(f.reliability),
            }
            row |= {
                "R_low": f.lower,
                "R_high": f.upper,
                "A": f.availability,
                "C": _number(f.cost),
                "C_low": _number(f.cost_lower),
                "C_high": _number(f.cost_upper),
                "C_declared": _number(asked.declared_cost(action)),
                "cost_mean": _number(tally.cost(asked.measure).mean),
                "J": _number(f.j),
                "J_low": _number(f.j_lower),
                "J_high": _number(f.j_upper),
            }
            out.append(row | _times(tally))
    return out


def _selectors(kept: FileContents, task: str) -> dict[str, Any]:
    """Return the selectors' states by name. The name of another plant's selector ends with that
    plant."""
    from petrobot.coordinator.learning.estimates_tables import selector_name

    return {
        name.removesuffix(selector_name("", kept.plant)): {
            "frozen": state["frozen"],
            "contexts": {
                context: dict(zip(state["actions"], learner["p"], strict=True))
                for context, learner in state["learners"].items()
            },
        }
        for (of, name), state in kept.selectors.items()
        # those that only count have no learned probabilities, only equal ones from the beginning
        if of == task and name.split()[0] not in ("fixed", "round_robin")
    }


def _break_even(judged: Comparison) -> list[dict[str, Any]]:
    """Return for each other action the rho at which it would become the best; it is better `above`
    or `below` that rho."""
    from petrobot.coordinator.learning.objective import break_even

    if judged.best is None:
        return []
    best = judged.of(judged.best)
    found = [
        (other, break_even(best, other)) for other in judged.figures if other.action != best.action
    ]
    return [
        {
            "against": other.action,
            "rho": rho,
            "better": "above" if other.cost < best.cost else "below",
        }
        for other, rho in found
        if rho is not None
    ]


def _answer(figures: Figures | None) -> dict[str, Any] | None:
    return (
        None
        if figures is None
        else {"action": figures.action, "R": figures.reliability, "C": figures.cost}
    )


def _number(x: float) -> float | None:
    return x if isfinite(x) else None


def _words(asked: Question) -> str:
    """Return a question as command-line options."""
    parts = [f"--cost {asked.measure}"]
    parts += [f"--target {asked.target:g}"] if asked.target is not None else []
    parts += [f"--rho {asked.rho:g}"] if asked.rho is not None else []
    return " ".join(parts)


WIDTH = 110
"""Least width of the lines below a table (characters)."""
LARGEST_WIDTH = 1000

# --- for people -------------------------------------------------------------------------------


def print_table(console: Console, table: Table) -> None:
    """Print a table as wide as it is: a narrow terminal, or a pipe, would cut its numbers."""
    wide = console.options.update(max_width=LARGEST_WIDTH)
    console.width = max(console.width, WIDTH, console.measure(table, options=wide).maximum)
    console.print(table)


def _print(task: str, about: dict[str, Any], options: argparse.Namespace) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console()
    target = "" if about["target"] is None else f", target R {about['target']:g}"
    table = Table(
        title=f"{task} (C: {about['cost']}, rho {about['rho']:.4g}{target})",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.show_edge = table.pad_edge = False
    always_there = all(row["A"] == 1.0 for row in about["actions"])
    several = any(row["source"] for row in about["actions"])
    declared = any(row["C_declared"] is not None for row in about["actions"])
    columns = [
        "action",
        "runs",
        *(["plant"] if several else []),
        "R",
        "R 95 %",
        "C",
        "C 95 %",
        *(["C declared"] if declared else []),
        "J",
        "J 95 %",
        "s p50/p90",
        "cpu ms",
        *([] if always_there else ["A"]),
    ]
    for column in columns:
        table.add_column(column, justify="left" if column == "action" else "right", no_wrap=True)
    for row in about["actions"]:
        own = row["source"] == about["source"]
        clear = own and row["action"] == about["best"] and about["clear"]
        name = row["action"] + (" *" if clear else "")
        table.add_row(*_cells(name, row, several, declared)[: len(columns)])
        if own and len(about["contexts"]) > 1:
            for part in about["by_context"]:
                if part["action"] == row["action"]:
                    cells = _cells(f"  {_named(part['context'])}", part, several, declared)
                    table.add_row(*cells[: len(columns)])
    print_table(console, table)
    for line in [*_warnings(about), *_remarks(about, options)]:
        console.print(f"  {line}", highlight=False)


def _cells(name: str, row: Mapping[str, Any], several: bool, declared: bool) -> list[str]:
    times = f"{_cell(row['seconds_p50'])}/{_cell(row['seconds_p90'])}"
    cpu = None if row["cpu_mean"] is None else 1e3 * row["cpu_mean"]
    interval = f"{row['R_low']:.2f}-{row['R_high']:.2f}"
    known = row["J_low"] is not None and row["J_high"] is not None
    of_j = f"{row['J_low']:.2f}-{row['J_high']:.2f}" if known else None
    costs = [row["C"], _of_cost(row), *([row["C_declared"]] if declared else [])]
    numbers = [row["R"], interval, *costs, row["J"], of_j, times, cpu, row["A"]]
    source = [row.get("source", "") or ("-" if "source" in row else "")] if several else []
    return [name, str(row["runs"]), *source, *map(_cell, numbers)]


def _of_cost(row: Mapping[str, Any]) -> str | None:
    """Return the interval of C; that it is declared, if no run reported a cost."""
    if row["cost_mean"] is None:
        return None if row["C"] is None else "declared"
    known = row["C_low"] is not None and row["C_high"] is not None
    return f"{_cell(row['C_low'])}-{_cell(row['C_high'])}" if known else None


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "-" if value is None or isnan(value) or value in (inf, -inf) else f"{value:.3g}"


def _named(context: str) -> str:
    return context or "(no context)"


def _warnings(about: Mapping[str, Any]) -> list[str]:
    """Return warnings about this table: what its J does not show."""
    own = [row for row in about["actions"] if row["source"] == about["source"]]
    lines, run = [], [row for row in own if row["runs"]]
    if len(own) < len(about["actions"]):
        lines.append(
            f"judged by the runs of plant {about['source'] or UNKNOWN} alone: those of other "
            "plants are never pooled with them"
        )
    if about["prior"] is not None:
        of, trials = about["prior"]["source"] or UNKNOWN, about["prior"]["trials"]
        lines.append(
            f"prior: the selectors also count the runs of plant {of}, as {trials:g} trials of each "
            "action"
        )
    if about["level_with_best"]:
        lines.append(
            f"the lowest J is that of {about['best']}, but the difference may be chance: "
            f"{', '.join(about['level_with_best'])}"
        )
    if about["target_unmet"] and run:
        lines.append(
            f"no action surely reaches R {about['target']:g} in any context: judged without "
            "a target"
        )
    elif about["target"] is not None:
        below = [row["action"] for row in run if not row["scenarios"]]
        lines += [
            f"{action} does not surely reach R {about['target']:g} in any context: no J"
            for action in below
        ]
    if about["target"] is not None:
        lines += [_gate(row, about["target"]) for row in run if not row["scenarios"]]
    over = ", ".join(map(_named, about["judged_over"]))
    if not over and len(run) > 1:
        lines.append(
            "there is no context in which all actions were run: each is judged in its own, "
            "the order says little"
        )
    elif over and len(about["judged_over"]) < len(about["contexts"]):
        lines.append(f"judged over the contexts in which all actions were run: {over}")
    for action in about["uncosted"]:
        lines.append(
            f"{action}: no run reported {about['cost']}, so its cost is taken as 0; give "
            "another --cost, or correct `cost` "
            "in the task file or the name in the action's result"
        )
    lines += [f"elsewhere it was judged by {asked}" for asked in about["asked_elsewhere"]]
    return lines


def _gate(row: Mapping[str, Any], target: float) -> str:
    """What an action lacks to meet the target in its hardest context."""
    from petrobot.coordinator.learning.statistics import wilson

    good, runs = round(row["R"] * row["runs_there"]), row["runs_there"]
    where = f" in {row['worst']}" if row["worst"] else ""
    bound = wilson(good, runs)[0]
    known = f"{row['action']}: {good} of {runs}{where}: lower bound {bound:.3f}"
    if row["runs_needed"] is None:
        return f"{known}; R itself is not above {target:g}"
    return f"{known}; {row['runs_needed']} needed for {target:g} with such a share"


def _remarks(about: Mapping[str, Any], options: argparse.Namespace) -> list[str]:
    lines = []
    for row in (row for row in about["actions"] if row["source"] == about["source"]):
        if options.target is not None or (row["scenarios"] and about["target"] is not None):
            met = ", ".join(map(_named, row["scenarios"])) or "none"
            most = f", where it costs {_cell(row['C_largest'])} at most" if row["scenarios"] else ""
            lines.append(f"{row['action']} meets R {about['target']:g} in: {met}{most}")
        told = [f"{n} {cause}" for cause, n in row["causes"].items()]
        if row["unjudged"]:
            told.append(f"{row['unjudged']} not judged, which do not count in R")
        if told:
            lines.append(f"{row['action']}: {', '.join(told)}")
    lines += [
        f"{b['against']} is better than {about['best']} {b['better']} rho = {b['rho']:.4g}"
        for b in about["break_even"]
    ]
    for key, asked, verb, none in (
        ("to_reach", f"R {options.target}", "costs least with", "is met by no action so far"),
        ("for_cost", f"cost {options.budget}", "buys", "buys nothing known"),
    ):
        if key in about:
            answer = about[key]
            if answer is None:
                lines.append(f"{asked} {none}")
            else:
                said = f"{answer['action']}: R {answer['R']:.3f}, C {answer['C']:.4g}"
                lines.append(f"{asked} {verb} {said}")
    for name, selector in about["selectors"].items():
        for context, p in selector["contexts"].items():
            shares = ", ".join(f"{action} {share:.3f}" for action, share in p.items())
            frozen = " (frozen)" if selector["frozen"] else ""
            lines.append(f"{name}{frozen} {context or 'any context'}: {shares}")
    return lines
