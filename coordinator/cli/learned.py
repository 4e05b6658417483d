"""Show what was learned, of actions or of a whole task; merge estimates files; freeze, thaw or reset a primitive task."""

from __future__ import annotations

import argparse
from math import inf, isfinite, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coordinator.cli import CommandError
from coordinator.cli.loading import write_json
from coordinator.cli.propagated import show_task
from coordinator.cli.quantities import number, probability

if TYPE_CHECKING:
    from coordinator.experience.estimates_file import EstimatesFile, Kept
    from coordinator.learning.objective import Comparison, Figures

EXAMPLE = "petrobot learned show learned.db --target 0.95\n  petrobot learned merge learned.db other_machine.db"
VERBS = ("show", "task", "merge", "freeze", "thaw", "reset")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("verb", choices=VERBS, help="what to do with the file")
    parser.add_argument("file", type=Path, help="an estimates file, as `run --learn FILE` keeps it")
    parser.add_argument(
        "more", nargs="*", metavar="FILE|TASK", help="merge: files to take in; else: primitive tasks (all)"
    )
    parser.add_argument("--context", metavar="TEXT", help="show: only this context (default: all, as scenarios)")
    parser.add_argument(
        "--cost",
        metavar="MEASURE",
        help="wall, cpu, count or value:NAME (default: what the task declares and was learned by, else wall)",
    )
    parser.add_argument(
        "--target", type=probability, metavar="R", help="target reliability: which scenarios and actions meet it"
    )
    parser.add_argument(
        "--budget", type=number(above=0.0), metavar="C", help="what reliability may be had for this cost at most"
    )
    parser.add_argument(
        "--rho", type=number(least=0.0), metavar="W", help="weight of cost in J (default: 1 / the largest cost)"
    )
    parser.add_argument("--selectors", action="store_true", help="reset: forget selectors' states, keep the estimates")
    parser.add_argument("--json", metavar="FILE", help="write what is shown as JSON (- for standard output)")


def run(options: argparse.Namespace) -> int:
    """Do it."""
    from coordinator.experience.estimates_file import EstimatesError, EstimatesFile

    file = EstimatesFile(options.file)
    try:
        if options.verb == "merge":
            return _merge(file, options)
        if not options.file.exists():
            raise CommandError(2, f"{options.file}: no such file; `petrobot run ... --learn {options.file}` makes it")
        kept = file.read()
        if options.verb == "task":
            return show_task(kept, options)
        _refuse_unknown(kept, options)
        if options.verb == "show":
            return _show(kept, options)
        if options.verb == "reset":
            for task in options.more or [None]:
                file.reset(task, selectors_only=options.selectors)
        else:
            _freeze(file, kept, options)
    except EstimatesError as fault:
        raise CommandError(2, str(fault)) from fault
    print(f"{options.file}: {options.verb} {', '.join(options.more) or 'everything'}: done")
    return 0


def _merge(file: EstimatesFile, options: argparse.Namespace) -> int:
    if not options.more:
        raise CommandError(2, f"merge into {options.file} what? Give one or more other estimates files")
    for other in options.more:
        file.merge(Path(other))
    kept = file.read()
    runs = sum(t.runs + t.censored for t in kept.estimates.tallies.values())
    print(f"{options.file}: {len(options.more)} taken in; {runs} runs known")
    return 0


def _tasks(kept: Kept) -> list[str]:
    return sorted({k.primitive_task for k in kept.estimates.tallies} | {task for task, _ in kept.selectors})


def _refuse_unknown(kept: Kept, options: argparse.Namespace) -> None:
    for task in options.more:
        if task not in _tasks(kept):
            raise CommandError(
                2, f"{options.file} knows no primitive task {task!r}; it knows: {', '.join(_tasks(kept))}"
            )


def _freeze(file: EstimatesFile, kept: Kept, options: argparse.Namespace) -> None:
    for (task, _), state in kept.selectors.items():
        if not options.more or task in options.more:
            file.put_selectors({task: {**state, "frozen": options.verb == "freeze"}})


# --- show --------------------------------------------------------------------------------------------------------------


def _show(kept: Kept, options: argparse.Namespace) -> int:
    from coordinator.learning.objective import Question, compare

    try:
        shown = {}
        for task in options.more or _tasks(kept):
            question = Question(_measure(kept, task, options), options.target, options.rho)
            tallies = kept.estimates.of(task, options.context)
            shown[task] = _plain(kept, task, compare(tallies, question), options)
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault
    if options.json:
        write_json(options.json, {"file": str(options.file), "primitive_tasks": shown})
    if options.json != "-":
        for task, about in shown.items():
            _print(task, about, options)
    return 0


def _measure(kept: Kept, task: str, options: argparse.Namespace) -> str:
    """The cost measure: as given, else the one by which the primitive task was learned."""
    known = (state.get("cost") for (of, _), state in kept.selectors.items() if of == task)
    return str(options.cost or next((measure for measure in known if measure), "wall"))


def _plain(kept: Kept, task: str, judged: Comparison, options: argparse.Namespace) -> dict[str, Any]:
    from coordinator.learning.objective import cost_to_reach, pareto, reliability_for

    rows = [_row(kept, task, f, options) for f in judged.figures]
    front = {f.action for f in pareto(judged.figures)}
    for row in rows:
        row["pareto"] = row["action"] in front
    about: dict[str, Any] = {
        "cost": _measure(kept, task, options),
        "rho": judged.rho,
        "best": judged.best,
        "actions": rows,
    }
    about["break_even"] = _break_even(judged)
    if options.target is not None:
        about["to_reach"] = _answer(cost_to_reach(judged.figures, options.target))
    if options.budget is not None:
        about["for_cost"] = _answer(reliability_for(judged.figures, options.budget))
    about["selectors"] = {
        name: {
            "frozen": state["frozen"],
            "contexts": {
                context: dict(zip(state["actions"], learner["p"], strict=True))
                for context, learner in state["learners"].items()
            },
        }
        for (of, name), state in kept.selectors.items()
        if of == task
    }
    return about


def _row(kept: Kept, task: str, f: Figures, options: argparse.Namespace) -> dict[str, Any]:
    from functools import reduce

    from coordinator.learning.estimate import Tally, merge

    by_context = kept.estimates.of(task, options.context)[f.action]
    whole = reduce(merge, by_context.values(), Tally())
    cost = whole.cost(_measure(kept, task, options))
    return {
        "action": f.action,
        "runs": f.runs,
        "R": _number(f.reliability),
        "R_low": f.lower,
        "R_high": f.upper,
        "A": f.availability,
        "C": _number(f.cost),
        "C_largest": _number(f.largest_cost),
        "scenario": f.scenario,
        "scenarios": list(f.scenarios),
        "J": _number(f.j),
        "cost_mean": cost.mean if cost.n else None,
        "cost_deviation": cost.deviation,
        "seconds_mean": whole.wall.mean if whole.wall.n else None,
        "seconds_p50": _number(whole.quantile(0.5)),
        "seconds_p90": _number(whole.quantile(0.9)),
        "cpu_mean": whole.cpu.mean if whole.cpu.n else None,
        "cpu_p90": _number(whole.quantile(0.9, "cpu")),
        "censored": whole.censored,
        "unknown": whole.unknown,
        "corrected": whole.corrected,
        "causes": {
            f"{status}: {cause or '-'}": n for (status, cause), n in whole.counts.items() if status != "success"
        },
        "not_executed": dict(whole.not_executed),
    }


def _break_even(judged: Comparison) -> list[dict[str, Any]]:
    """rho at which the best action would stop being so, against each other one: `above` or `below` it the other is better."""
    from coordinator.learning.objective import break_even

    if judged.best is None:
        return []
    best = judged.of(judged.best)
    found = [(other, break_even(best, other)) for other in judged.figures if other.action != best.action]
    return [
        {"against": other.action, "rho": rho, "better": "above" if other.cost < best.cost else "below"}
        for other, rho in found
        if rho is not None
    ]


def _answer(figures: Figures | None) -> dict[str, Any] | None:
    return None if figures is None else {"action": figures.action, "R": figures.reliability, "C": figures.cost}


def _number(x: float) -> float | None:
    return x if isfinite(x) else None


def _print(task: str, about: dict[str, Any], options: argparse.Namespace) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(
        title=f"{task} (C: {about['cost']}, rho {about['rho']:.4g})",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.show_edge = table.pad_edge = False
    always_there = all(row["A"] == 1.0 for row in about["actions"])
    columns = ["action", "runs", "R", "R 95 %", "C", "J", "s p50/p90", "cpu ms", *([] if always_there else ["A"])]
    for column in columns:
        table.add_column(column, justify="left" if column == "action" else "right", no_wrap=True)
    for row in about["actions"]:
        name = row["action"] + (" *" if row["action"] == about["best"] else "")
        times = f"{_cell(row['seconds_p50'])}/{_cell(row['seconds_p90'])}"
        cpu = None if row["cpu_mean"] is None else 1e3 * row["cpu_mean"]
        cells = [row["R"], f"{row['R_low']:.2f}-{row['R_high']:.2f}", row["C"], row["J"], times, cpu, row["A"]]
        table.add_row(name, str(row["runs"]), *[_cell(c) for c in cells][: len(columns) - 2])
    console.print(table)
    for line in _remarks(about, options):
        console.print(f"  {line}", highlight=False)


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "-" if value is None or isnan(value) or value in (inf, -inf) else f"{value:.3g}"


def _remarks(about: dict[str, Any], options: argparse.Namespace) -> list[str]:
    lines = []
    for row in about["actions"]:
        if options.target is not None:
            met = ", ".join(s or "(no context)" for s in row["scenarios"]) or "none"
            lines.append(f"{row['action']} meets R {options.target:g} in: {met}")
        if row["causes"]:
            lines.append(f"{row['action']}: " + ", ".join(f"{n} {cause}" for cause, n in row["causes"].items()))
    lines += [
        f"{b['against']} is better than {about['best']} {b['better']} rho = {b['rho']:.4g}" for b in about["break_even"]
    ]
    for key, words in (
        ("to_reach", f"R {options.target} costs least with"),
        ("for_cost", f"cost {options.budget} buys"),
    ):
        if key in about:
            answer = about[key]
            said = (
                "nothing known" if answer is None else f"{answer['action']}: R {answer['R']:.3f}, C {answer['C']:.4g}"
            )
            lines.append(f"{words} {said}")
    for name, selector in about["selectors"].items():
        for context, p in selector["contexts"].items():
            shares = ", ".join(f"{action} {share:.3f}" for action, share in p.items())
            frozen = " (frozen)" if selector["frozen"] else ""
            lines.append(f"{name}{frozen} {context or 'any context'}: {shares}")
    return lines
