"""Tables (Markdown) and pictures of docs/experiment.md, from the results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

from experiments.against_trees.faults import FAULTS
from experiments.against_trees.forecasts import FIGURES, METHODS
from experiments.against_trees.killed import PROGRAMS as KILLED
from experiments.against_trees.learned import BALLS, POLICIES, regret
from experiments.against_trees.results import PROGRAMS, Line, Results
from petrobot.coordinator.studies.report.charts import lines
from petrobot.coordinator.studies.report.page import standalone

MISSING = "-"


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table."""
    found = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in row) + " |" for row in found)


def tables(results: Results) -> str:
    """Return all tables for which there are results."""
    parts = (verified, forecasts, learned, killed, costs, laboratory)
    return "\n\n".join(text for part in parts if (text := part(results)))


# --- (a) ------------------------------------------------------------------------------------------


def word(line: Line) -> str:
    """Return when a fault was found, in a cell of the table."""
    if line["before"] == "cannot be said":
        return "cannot occur"
    if line["before"] != "no":
        return f"**{line['before']}**"
    return "never" if line["trial"] is None else f"trial {line['trial']}"


def verified(results: Results) -> str:
    """Return the faults one by one, and their counts."""
    found = {line["key"]: line for line in results.of("verified")}
    rows = [
        [fault.name, *(word(found[key]) if (key := f"{p}/{n:02}") in found else MISSING
                       for p in PROGRAMS)]
        for n, fault in enumerate(FAULTS)
    ]  # fmt: skip
    if not found:
        return ""
    begins = {
        "cannot occur": "cannot",
        "found before running": "**",
        "found by a trial": "trial",
        "never found": "never",
    }
    counts = [
        [name, *(sum(row[1 + k].startswith(begin) for row in rows) for k in range(3))]
        for name, begin in begins.items()
    ]
    return table(["", *PROGRAMS], counts) + "\n\n" + table(["design fault", *PROGRAMS], rows)


# --- (b) ------------------------------------------------------------------------------------------


def _judged(results: Results) -> list[tuple[Line, Line]]:
    measured = {line["key"]: line for line in results.of("measured")}
    return [
        (line, measured[line["key"]])
        for line in results.of("registered")
        if line["key"] in measured
    ]


def forecasts(results: Results) -> str:
    """Return coverage and error by method, for each figure."""
    pairs = _judged(results)
    if not pairs:
        return ""
    rows = []
    for name in FIGURES:
        for method in METHODS:
            told = [(said[method][name], truth[name]) for said, truth in pairs]
            held = [low <= truth <= high for (_, span), truth in told if span
                    for low, high in [span]]  # fmt: skip
            off = [abs(value - truth) / (1.0 if name == "R_goal" else truth)
                   for (value, _), truth in told if value is not None]  # fmt: skip
            width = [span[1] - span[0] for (_, span), _ in told if span]
            rows.append([
                name, method, len(off), f"{sum(held)} of {len(held)}", f"{mean(width):.3f}",
                f"{100 * median(off):.1f}", f"{100 * max(off):.1f}",
            ])  # fmt: skip
    head = [
        *("figure", "method", "values", "interval held", "its mean width"),
        *("median error (%)", "largest"),
    ]
    each = [
        [said["name"], *(f"{truth[name]:.3f} / " + " / ".join(
            _number(said[method][name][0]) for method in METHODS) for name in FIGURES)]
        for said, truth in pairs
    ]  # fmt: skip
    return table(head, rows) + "\n\n" + table(["change", *FIGURES], each)


def _number(value: float | None) -> str:
    return "refused" if value is None else f"{value:.3f}"


# --- (c) ------------------------------------------------------------------------------------------


def _curves(results: Results) -> dict[str, list[list[float]]]:
    found: dict[str, list[list[float]]] = {}
    for line in results.of("learned"):
        found.setdefault(line["policy"], []).append(regret(line["caught"]))
    return {policy: found[policy] for policy in POLICIES if policy in found}


def learned(results: Results) -> str:
    """Return the regret of each policy at the end."""
    rows = []
    for policy, curves in _curves(results).items():
        ends = [curve[-1] for curve in curves]
        trials = BALLS * len(curves[0])
        span = f"{min(ends):.0f} to {max(ends):.0f}"
        rows.append(
            [policy, len(ends), trials, f"{mean(ends):.0f}", span, f"{mean(ends) / trials:.3f}"]
        )
    head = ["policy", "seeds", "trials", "regret (balls)", "from, to", "per trial"]
    return table(head, rows) if rows else ""


# --- (d) ------------------------------------------------------------------------------------------


def killed(results: Results) -> str:
    """Return the results of the missions that were killed."""
    rows = []
    for program in KILLED:
        own = [line for line in results.of("killed") if line["program"] == program]
        usual = [line["seconds"] for line in own if line["number"] == 0]
        hit = [line for line in own if line["killed"]]
        if not hit or not usual:
            continue
        lost = [line["seconds"] - usual[0] for line in hit]
        down = [line["down"] for line in hit if line["down"] is not None]
        rows.append([
            program, len(hit), sum(line["code"] == 0 for line in hit),
            sum(line["twice"] for line in hit), sum(line["twice"] > 0 for line in hit),
            sum(line["never"] for line in hit), f"{median(lost):.1f}",
            f"{median(down):.1f}" if down else MISSING,
        ])  # fmt: skip
    head = ["program", "kills", "reached its end", "steps done twice", "in missions",
            "steps never done", "s lost (median)", "s until the next action"]  # fmt: skip
    return table(head, rows) if rows else ""


# --- costs ----------------------------------------------------------------------------------------


def costs(results: Results) -> str:
    """Return what each program costs."""
    found = {line["program"]: line for line in results.of("costs")}
    rows = [
        [p, found[p]["lines"], f"{found[p]['start_s']:.2f}",
         ", ".join(f"{1000 * one:.1f}" for one in found[p]["reaction_s"])]
        for p in PROGRAMS if p in found
    ]  # fmt: skip
    head = ["program", "lines of code", "start (CPU s)", "located to moving (ms)"]
    return table(head, rows) if rows else ""


def laboratory(results: Results) -> str:
    """Return what each program caught of the same balls."""
    by: dict[tuple[str, str], list[Any]] = {}
    for line in results.of("laboratory"):
        by.setdefault((line["regime"], line["program"]), []).append(line)
    rows = []
    for (regime, program), own in sorted(by.items()):
        ticks = [line["tick_us"] for line in own if line["tick_us"] is not None]
        rows.append([
            regime, program, sum(line["thrown"] for line in own),
            sum(line["caught"] for line in own), sum(line["counted"] for line in own),
            f"{mean(line['seconds'] for line in own):.2f}",
            f"{mean(line['cpu_s'] for line in own):.2f}",
            f"{median(ticks):.0f}" if ticks else MISSING,
        ])  # fmt: skip
    head = ["regime", "program", "balls", "caught", "as counted by the program",
            "simulated s a mission", "CPU s a mission", "us a tick"]  # fmt: skip
    return table(head, rows) if rows else ""


# --- pictures -------------------------------------------------------------------------------------


def draw(results: Results, folder: Path) -> None:
    """Draw the regret over the trials."""
    folder.mkdir(parents=True, exist_ok=True)
    curves = _curves(results)
    if curves:
        drawn = {
            policy: [
                (float(BALLS * (k + 1)), mean(curve[k] for curve in own))
                for k in range(len(own[0]))
            ]
            for policy, own in curves.items()
        }
        title = "Regret while the disturbance switches every 100 trials"
        y_label = "balls not caught that the best choice catches"
        svg = lines(title, "trial", y_label, drawn)
        path = folder / "experiment-regret.svg"
        path.write_text(standalone(svg), encoding="utf-8")
