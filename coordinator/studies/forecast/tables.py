"""Forecasts and comparisons as tables for terminals and pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from petrobot.coordinator.studies.forecast.predict import TRIALS
from petrobot.coordinator.studies.forecast.residual import NEGLIGIBLE
from petrobot.coordinator.task.wording import wrapped

WORDS = {
    "R_goal": "R_goal",
    "P_complete": "P_complete",
    "R_conj": "R_conj",
    "mean": "mean time (s)",
    "q90": "90 % quantile (s)",
}
HEAD = (
    "regime",
    "figure",
    "forecast",
    "95 % predictive",
    "measured",
    "p (Holm)",
    "agrees",
    "equivalent",
)


def forecast_text(made: Mapping[str, Any]) -> str:
    """Return a forecast as text for a terminal."""
    lines = [f"{made['task']}: forecast of {made['registered_at']}"]
    for name, said in made["regimes"].items():
        known = (
            f"{said['training_trials']} trials"
            if said["whole"]
            else f"{said['training_runs']} runs of an estimates file"
        )
        known += " of another form of this task" * (not said.get("same", True))
        how = "straight from them" if said["from"] == TRIALS else "by simulating the net"
        lines.append(f"  regime {name or '-'}: {said['runs']} new trials, from {known}, {how}")
        for figure, found in said["figures"].items():
            if found["value"] is not None:
                lines.append(
                    f"    {WORDS[figure]:18}{_digits(found['value'])}  95 %: new trials "
                    f"{_bounds(found['interval'])}, the truth {_bounds(found['confidence'])}"
                )
        lines += _exact_lines(said.get("gspn", {}))
        lines.append(
            f"    product of R's    {said['product']['R_conj']:.4f} as R_conj, if statuses "
            "were independent"
        )
        for found in said["dependence"][:3]:
            if found["p"] < 0.01:
                lines.append(
                    f"    {found['places'][0]} and {found['places'][1]} depend on each "
                    f"other: p = {found['p']:.1e}"
                )
        lines.append(f"    simulated net: {said['contexts']} contexts; {_worst(said)}")
        # else a doubt says it, if the figures come from the simulated net
        if said["endless"] > 0.0005 and (said["endless"] <= NEGLIGIBLE or said["from"] == TRIALS):
            lines.append(f"    note: {said['endless']:.1%} of the simulated trials never end")
        lines += [f"    note: {note}" for note in (*said["notes"], *said["assumptions"])]
        lines += [f"    DOUBTFUL: {doubt}" for doubt in said["doubts"]]
    if "assumed" in made and any("gspn" in said for said in made["regimes"].values()):
        lines.append(
            f"  measured trials include waits for devices; the simulated net and the exact "
            f"solution assume: "
            f"{made['assumed']}"
        )
    return "\n".join(wrapped(line, 8) for line in lines)


def _digits(value: float) -> str:
    """Return a number with four decimals, or with four digits if it is small."""
    return f"{value:.4f}" if value == 0 or abs(value) >= 0.001 else f"{value:.3e}"


def _bounds(interval: Sequence[float]) -> str:
    return f"[{_digits(interval[0])}, {_digits(interval[1])}]"


def _exact_lines(gspn: Mapping[str, Any]) -> list[str]:
    if "markings" not in gspn:
        return [f"    stochastic view: {gspn['why']}"] if gspn else []
    shown = ", ".join(f"{WORDS[k]} {_digits(gspn[k])}" for k in WORDS if gspn.get(k) is not None)
    lines = [f"    stochastic view, {gspn['markings']} markings: {shown}"]
    if gspn.get("P_complete_interval"):
        lines.append(
            f"      its P_complete: 95 % {_bounds(gspn['P_complete_interval'])} from the measured "
            f"shares; relative error of the solution {gspn['P_complete_error']:.0e}"
        )
    return [*lines, *(f"      {note}" for note in gspn.get("notes", ()))]


def _worst(said: Mapping[str, Any]) -> str:
    residual = said["residual"]
    if not residual:
        return "none" if said["whole"] and said.get("same", True) else "no trials to compare with"
    worst = min(residual, key=lambda row: row["p"])
    text = f"smallest p {worst['p']:.2f} ({worst['of']}) against the training trials"
    # the figures do not come from it, so a difference is not a doubt about them
    warning = ", so a forecast by simulation would be doubtful"
    return text + (warning if worst["p_holm"] < 0.01 and said["from"] == TRIALS else "")


def rows_of(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the table of a comparison as texts."""
    return [
        (
            row["regime"] or "-",
            WORDS[row["figure"]],
            _number(row["forecast"]) or "none completes",
            _interval(row["interval"]),
            _number(row["measured"]) or "none completed",
            _p(row),
            {None: "", True: "yes", False: "NO"}[row["agrees"]],
            f"{'yes' if row['equivalent'] else 'no'} (within {_number(row['margin'])})"
            if row["margin"]
            else "",
        )
        for row in found["rows"]
    ]


def _p(row: Mapping[str, Any]) -> str:
    return "" if row["p"] is None else f"{row['p']:.3f} ({row['p_holm']:.3f})"


def _number(value: float | None) -> str:
    return "" if value is None else _digits(value)


def _interval(value: Sequence[float] | None) -> str:
    return "" if value is None else f"{value[0]:.4f} to {value[1]:.4f}"


def control_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the table of the product rule as texts."""
    return [
        (
            row["regime"] or "-",
            _number(row["forecast"]),
            _number(row["measured"]),
            f"{row['p']:.1e}",
            "rejected" if row["rejected"] else "not rejected",
        )
        for row in found["negative_control"]
    ]


def agreement_text(found: Mapping[str, Any]) -> str:
    """Return a comparison as text for a terminal."""
    before = "before the runs" if found["registered_before"] else "AFTER the runs had begun"
    lines = [
        f"{found['task']}: forecast of {found['forecast']['registered_at']} ({before}) and "
        f"{found['campaign']['folder']}"
    ]
    lines += _columns([HEAD, *rows_of(found)])
    lines.append("negative control, the product of marginal reliabilities as R_conj:")
    lines += _columns([("regime", "product", "measured", "p", ""), *control_rows(found)])
    for law in found["law"]:
        if law["distance"] is not None:
            verdict = "agrees" if law["agrees"] else "DISAGREES"
            lines.append(
                f"distribution of the time, regime {law['regime'] or '-'}: "
                f"distance {law['distance']}, p = {_p(law)}: {verdict}"
            )
    lines += _disagreeing(found)
    for regime, changes in found["what_if"].items():
        lines.append(f"note: what if, regime {regime or '-'}: {', '.join(changes)}")
    for regime, doubts in found["doubts"].items():
        lines += [
            f"note: registered although doubtful, regime {regime or '-'}: {doubt}"
            for doubt in doubts
        ]
    if not found["same_block"]:
        lines.append(
            "note: the training had another --block, so the first trials of a cell are another "
            "share of all trials"
        )
    if not found["same_task_file"]:
        lines.append("note: the task file has changed between training and these runs")
    lines.append(
        "agrees: no test differs at 1 % (Holm)"
        if found["agrees"]
        else "DISAGREES: at least one test differs at 1 % (Holm)"
    )
    return "\n".join(lines)


def _disagreeing(found: Mapping[str, Any]) -> list[str]:
    """Return a line for each place and action that differs."""
    told = {
        f"outgoing transitions of {row['place']}, regime {row['regime'] or '-'}: ": row
        for row in found["routing"]
    } | {
        f"duration of {row['action']} in {row['place']}, regime {row['regime'] or '-'}: "
        f"distance {row['distance']}, ": row
        for row in found["durations"]
    }
    return [
        f"{what}p = {row['p_holm']:.1e}: DISAGREES"
        for what, row in told.items()
        if row["agrees"] is False
    ]


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  "
        + "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def agreement_markdown(found: Mapping[str, Any]) -> str:
    """Return a comparison as Markdown."""
    before = "before" if found["registered_before"] else "**after**"
    lines = [
        f"Registered {found['forecast']['registered_at']}, {before} the runs (seed "
        f"{found['campaign']['seed']}).",
        "",
    ]
    lines += _markdown([HEAD, *rows_of(found)])
    lines += [
        "",
        "The product of marginal reliabilities as a forecast of R_conj (negative control):",
        "",
    ]
    lines += _markdown([("regime", "product", "measured", "p", "verdict"), *control_rows(found)])
    lines += [
        "",
        "Distribution of the time (Kolmogorov's distance; limit: at 1 % for this test alone):",
        "",
    ]
    laws = [
        (law["regime"] or "-", _number(law["distance"]), _number(law["limit"]))
        for law in found["law"]
    ]
    lines += _markdown([("regime", "distance", "limit"), *laws])
    odd = [f"- {line}" for line in _disagreeing(found)]
    return "\n".join([*lines, *([""] * bool(odd)), *odd]) + "\n"


def _markdown(rows: Sequence[Sequence[str]]) -> list[str]:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return [lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]
