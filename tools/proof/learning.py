"""Proofs of learning, of the speed of campaigns and of forecasts, on the catching cell: the
required figures of docs/campaigns.md and docs/forecast.md in full.

    python -m tools.proof.learning                      everything (hours); continues where it
                                                        stopped
    python -m tools.proof.learning learn --share 0.1    a tenth of every size, with the same rules
    python -m tools.proof.learning forecast --regimes A,B,C,B+dim --runs 2000

Every campaign has a folder of its own, so an interrupted proof can continue. Results are written to
`--folder`, tables to `--page`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tools.proof.campaigns import FAST, Result, Sizes, campaign, petrobot, rows_of, speed
from tools.proof.proof import LOCK_STEP, ROOT, FigureProof, digest

from petrobot.coordinator.cli.loading import load_directory, load_task
from petrobot.coordinator.cli.report import compared
from petrobot.coordinator.studies.campaign.policies import AllCombinations, offered
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.report.campaign_page import CombinationFigures, by_combination
from petrobot.coordinator.studies.report.comparing import Weighting
from petrobot.coordinator.task import Task

CLOSE = 0.02
"""Largest J beyond the best fixed combination's."""
FINALISTS = 6

# --- learning ---------------------------------------------------------------------------------


def learn(sizes: Sizes, options: argparse.Namespace) -> Result:
    """Learn from scratch, freeze, and judge on fresh throws beside the best fixed combination and
    the default."""
    task, regime = load_task(sizes.task), options.disturbed
    learned: dict[int, dict[str, str]] = {}
    for seed in range(1, options.seeds + 1):
        found = campaign(
            sizes,
            f"learn_{seed}",
            sizes.of(1000, 100),
            seed,
            regime,
            "--selector",
            options.selector,
        )
        learned[seed] = {name: known["best"] for name, known in found["policy"][regime].items()}
    rows, planned = screened(sizes, task, regime)
    weighting = Weighting.of(task, rows)
    every = by_combination(task, rows, planned, weighting)
    best = best_fixed(sizes, task, regime, every[:FINALISTS], weighting)
    default = {
        p.name: p.alternatives[0] for p in task.primitive_tasks.values() if len(p.alternatives) > 1
    }
    lines = [
        _judged(sizes, seed, actions, best, default, regime) for seed, actions in learned.items()
    ]
    close = all(line["J beyond the best, upper 95 %"] <= CLOSE for line in lines)
    ahead = all(line["J beyond the default, upper 95 %"] < 0 for line in lines)
    return {
        "regime": regime,
        "best": best,
        "default": default,
        "rows": lines,
        "close": close,
        "ahead": ahead,
        "combinations": len(every),
        "J of all": [one.objective for one in every],
        "holds": close and ahead,
    }


def screened(sizes: Sizes, task: Task, regime: str) -> tuple[list[TrialRow], list[dict[str, str]]]:
    """Run throws with all combinations in turn. Return the rows, and the combination planned for
    each."""
    count = 1
    for p in task.primitive_tasks.values():
        count *= len(p.alternatives)
    campaign(sizes, "screen", sizes.of(100, 5) * count, 50, regime, "--selector", "round_robin")
    rotation = AllCombinations(offered(task, load_directory(sizes.services)), {})
    rows = rows_of(sizes, "screen")
    return rows, [rotation.combination(row.n - 1) for row in rows if row.trial is not None]


def best_fixed(
    sizes: Sizes,
    task: Task,
    regime: str,
    finalists: Sequence[CombinationFigures],
    weighting: Weighting,
) -> dict[str, str]:
    """Return the combination with the lowest J. The best few of the screen are compared on more
    throws, none of which the judge uses.

    All J in this proof use one rho, computed from the costs of the first table, in which every
    action was run.
    """
    every: list[TrialRow] = []
    plans: list[dict[str, str]] = []
    for number, one in enumerate(finalists):
        chosen = dict(one.combination)
        judge(sizes, f"final_{number}", chosen, regime, throws=sizes.of(500), seed=51)
        rows = [row for row in rows_of(sizes, f"final_{number}") if row.trial is not None]
        every += rows
        plans += [chosen] * len(rows)
    ranked: list[CombinationFigures] = by_combination(task, every, plans, weighting)
    return dict(ranked[0].combination)


def judge(
    sizes: Sizes,
    name: str,
    chosen: Mapping[str, str],
    regime: str,
    throws: int | None = None,
    seed: int = 60,
) -> Result:
    """Run a fixed combination on fresh throws."""
    text = ",".join(f"{task}={action}" for task, action in chosen.items())
    return campaign(sizes, name, throws or sizes.of(2000), seed, regime, "--choose", text)


def fresh(sizes: Sizes, actions: Mapping[str, str], regime: str) -> Path:
    """Return the folder of a combination's throws with the judge's seeds; equal combinations share
    it."""
    name = "judged_" + "_".join(actions.values())
    judge(sizes, name, actions, regime)
    return sizes.folder / name


def _judged(
    sizes: Sizes,
    seed: int,
    actions: Mapping[str, str],
    best: Mapping[str, str],
    default: Mapping[str, str],
    regime: str,
) -> Result:
    own, rho_of = fresh(sizes, actions, regime), sizes.folder / "screen"
    to_best = compared(own, fresh(sizes, best, regime), rho_of)
    to_default = compared(own, fresh(sizes, default, regime), rho_of)
    return {
        "learning seed": seed,
        **actions,
        "is the best": dict(actions) == dict(best),
        "J": to_best["J"]["mean"]["one"],
        "J of the best": to_best["J"]["mean"]["other"],
        "J beyond the best, upper 95 %": to_best["J"]["mean"]["upper_95"],
        "J of the default": to_default["J"]["mean"]["other"],
        "J beyond the default, upper 95 %": to_default["J"]["mean"]["upper_95"],
        "J of the task beyond the best": to_best["J"]["task"]["difference"],
        "R_goal": to_best["shares"]["R_goal"]["one"],
        "R_goal of the best": to_best["shares"]["R_goal"]["other"],
        "R_goal of the default": to_default["shares"]["R_goal"]["other"],
        **{name: share["one"] for name, share in to_best["shares"].items() if "." in name},
        "p (McNemar) to the default": to_default["shares"]["R_goal"]["p"],
    }


# --- forecasts --------------------------------------------------------------------------------


def forecast(sizes: Sizes, options: argparse.Namespace) -> Result:
    """Train, register, run, compare; regimes with the same seeds."""
    regimes = options.regimes
    count = len(regimes.split(","))
    campaign(sizes, "train", sizes.of(options.training) * count, 70, regimes)
    registered = sizes.folder / "registered.json"
    if not registered.exists():
        runs = str(sizes.of(options.runs))
        petrobot(
            "forecast",
            sizes.task,
            "--estimates",
            str(sizes.folder / "train"),
            "--runs",
            runs,
            "--out",
            str(registered),
        )
    campaign(sizes, "new", sizes.of(options.runs) * count, 71, regimes)
    page, numbers = sizes.folder / "forecast.md", sizes.folder / "agreement.json"
    told = (
        "--compare",
        str(registered),
        str(sizes.folder / "new"),
        "--markdown",
        str(page),
        "--json",
        str(numbers),
    )
    petrobot("forecast", *told, codes=(0, 1))
    found: Result = json.loads(numbers.read_text(encoding="utf-8"))
    right = found["agrees"] and found["equivalent"] and found["registered_before"]
    holds = right and bool(found["product_rejected"])
    return {**found, "page": page.read_text(encoding="utf-8"), "holds": holds}


# --- page -------------------------------------------------------------------------------------


def page(results: Mapping[str, Result], sizes: Sizes) -> str:
    """Return the tables, with the command that makes them again."""
    lines = [f"# Learning and forecasting, {sizes.task}: figures", ""]
    lines += [
        "What learning and forecasts achieve on the simulated cell. The terms are explained in",
        "[campaigns.md](campaigns.md) and [forecast.md](forecast.md).",
        "",
    ]
    if "learn" in results:
        found = results["learn"]
        lines += [
            f"## Learned, frozen, judged on fresh throws of {found['regime']}",
            "",
            f"`{found['command']}`",
            "",
        ]
        lines += [_told(found), ""]
        lines += [*_turned(found["rows"]), ""]
    if "speed" in results:
        found = {k: v for k, v in results["speed"].items() if k not in ("holds", "command")}
        lines += ["## Speed, memory, interruption", "", f"`{results['speed']['command']}`", ""]
        lines += [_verdict(results["speed"]), "", *_turned([found]), ""]
    if "forecast" in results:
        found = results["forecast"]
        rejected = ", ".join(found["product_rejected"]) or "no regime"
        lines += [
            "## Forecast and measurement",
            "",
            f"`{found['command']}`",
            "",
            _verdict(found),
            "",
            found["page"],
        ]
        lines += [f"The product rule is rejected in {rejected}.", ""]
    return "\n".join(lines)


def _told(found: Mapping[str, Any]) -> str:
    """Describe the table of learning in words."""
    all_j = found["J of all"]
    close, ahead = ("holds" if found[one] else "**does not hold**" for one in ("close", "ahead"))
    furthest = max(row["J beyond the best, upper 95 %"] for row in found["rows"])
    beyond = found["rows"][0]["J of the default"] - found["rows"][0]["J of the best"]
    return (
        "- Best fixed combination, chosen on other throws:\n"
        f"  {', '.join(found['best'].values())}.\n"
        f"- Default: {', '.join(found['default'].values())}.\n"
        f"- J at most {CLOSE} above that of the best fixed combination: {close} (at most "
        f"{furthest:.4f}).\n"
        f"- J below that of the default: {ahead} (the default is {beyond:.4f} above the best).\n"
        f"- Choosing without knowledge: the {found['combinations']} combinations have J "
        f"from {min(all_j):.3f} to {max(all_j):.3f}, {sum(all_j) / len(all_j):.3f} on average\n"
        "  (100 throws each, taking turns)."
    )


def _verdict(found: Mapping[str, Any]) -> str:
    return "The floor holds." if found["holds"] else "**The floor does not hold.**"


def _turned(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a table with a column for each record."""
    names = list(rows[0])
    head = (
        "| "
        + " | ".join(["", *(str(i + 1) if len(rows) > 1 else "measured" for i in range(len(rows)))])
        + " |"
    )
    return [
        head,
        "|" + "---|" * (len(rows) + 1),
        *("| " + " | ".join([n, *(_text(r[n]) for r in rows)]) + " |" for n in names),
    ]


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


STEPS: Mapping[str, Callable[[Sizes, argparse.Namespace], Result]] = {
    "learn": learn,
    "speed": speed,
    "forecast": forecast,
}
CHAPTER = "Learning and forecasting, lock step"
SOURCES = (*LOCK_STEP, "coordinator/learning", "coordinator/studies")
FULL = ROOT / "reports" / "proof" / "learning"


def proofs() -> list[FigureProof]:
    """Return the three proofs for `make proof`, in full size."""
    options = parser().parse_args([])
    floors = {
        "learn": (
            "learned, frozen, judged",
            f"J within {CLOSE} of the best fixed combination, below the default's",
            _learn_line,
        ),
        "speed": (
            "campaign",
            f">= {FAST:g}x real time a core, flat memory, same table when killed",
            _speed_line,
        ),
        "forecast": (
            "forecast",
            "no disagreement at 1 % after Holm, equivalent, product rejected",
            _forecast_line,
        ),
    }
    return [
        FigureProof(
            name=name,
            chapter=CHAPTER,
            measure=lambda step=step, line=line: line(_kept(step, options)),  # type: ignore[misc]
            holds=lambda result: bool(result["all that was promised"]),
            floor=floor,
            sources=SOURCES,
            alone=step == "speed",
            sample=None if step == "speed" else partial(_sample, step),
        )
        for step, (name, floor, line) in floors.items()
    ]


def _kept(step: str, options: argparse.Namespace) -> Result:
    """Measure a step in full size, and store its result for the page."""
    sizes = Sizes(1.0, options.workers, FULL)
    sizes.folder.mkdir(parents=True, exist_ok=True)
    result = STEPS[step](sizes, options) | {"command": _command([step])}
    (sizes.folder / f"{step}.json").write_text(json.dumps(result, indent=2), encoding="utf-8")
    return result


def _sample(step: str) -> str:
    """Measure a step with one learning seed and a hundredth of the throws; return a digest of its
    numbers."""
    with tempfile.TemporaryDirectory() as folder:
        sizes = Sizes(0.01, 1, Path(folder))
        found = STEPS[step](sizes, parser().parse_args(["--seeds", "1"]))
    return digest([found.get(name) for name in ("rows", "J of all", "law")])


def _command(argv: Sequence[str]) -> str:
    return " ".join(["python -m tools.proof.learning", *argv])


def _learn_line(found: Result) -> Result:
    return {
        "all that was promised": found["holds"],
        "regime": found["regime"],
        "learning seeds": len(found["rows"]),
        "largest J beyond the best (upper 95 %)": max(
            row["J beyond the best, upper 95 %"] for row in found["rows"]
        ),
        "largest J beyond the default (upper 95 %)": max(
            row["J beyond the default, upper 95 %"] for row in found["rows"]
        ),
    }


def _speed_line(found: Result) -> Result:
    said = {k: v for k, v in found.items() if k not in ("holds", "command")}
    return {"all that was promised": found["holds"], **said}


def _forecast_line(found: Result) -> Result:
    least = min(row["p_holm"] for row in found["rows"] if row["p_holm"] is not None)
    rejected = ", ".join(found["product_rejected"]) or "none"
    return {
        "all that was promised": found["holds"],
        "least p after Holm": round(least, 4),
        "equivalent": found["equivalent"],
        "product rejected": rejected,
    }


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    made = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument(
        "steps", nargs="*", metavar="STEP", help=f"of {', '.join(STEPS)} (default: all)"
    )
    made.add_argument(
        "--share",
        type=float,
        default=1.0,
        metavar="X",
        help="of every number of throws (%(default)s)",
    )
    made.add_argument("--workers", type=int, default=2, metavar="K")
    made.add_argument("--folder", type=Path, default=FULL, metavar="FOLDER")
    made.add_argument("--task", default="catch_ball", metavar="TASK", help="(%(default)s)")
    made.add_argument(
        "--services", type=Path, metavar="FILE", help="its location file (the shipped one)"
    )
    made.add_argument(
        "--page", type=Path, metavar="FILE", help="docs/figures-learning.md in the full proof"
    )
    made.add_argument(
        "--disturbed",
        default="C+beating",
        metavar="REGIME",
        help="in which is learned (%(default)s)",
    )
    made.add_argument("--selector", default="nikolic_fu_fast", metavar="NAME")
    made.add_argument(
        "--seeds", type=int, default=5, metavar="N", help="learning seeds (%(default)s)"
    )
    made.add_argument(
        "--regimes",
        default="A,B,C,C+beating",
        metavar="A,B",
        help="that are forecast (%(default)s)",
    )
    made.add_argument(
        "--training", type=int, default=2000, metavar="N", help="throws a regime (%(default)s)"
    )
    made.add_argument(
        "--runs", type=int, default=1000, metavar="N", help="new throws a regime (%(default)s)"
    )
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the given steps. Return 1 if a floor does not hold."""
    options = parser().parse_args(argv)
    unknown = [step for step in options.steps if step not in STEPS]
    if unknown:
        parser().error(f"no step {unknown[0]}: {', '.join(STEPS)}")
    sizes = Sizes(options.share, options.workers, options.folder, options.task, options.services)
    sizes.folder.mkdir(parents=True, exist_ok=True)
    results: dict[str, Result] = {}
    for name in options.steps or STEPS:
        print(f"{name} ...", flush=True)
        results[name] = STEPS[name](sizes, options) | {"command": _command(argv or sys.argv[1:])}
        (sizes.folder / f"{name}.json").write_text(
            json.dumps(results[name], indent=2), encoding="utf-8"
        )
        print(f"{name}: {'holds' if results[name]['holds'] else 'DOES NOT HOLD'}", flush=True)
    full = sizes.share == 1 and options.task == "catch_ball"
    written = options.page or (
        ROOT / "docs" / "figures-learning.md" if full else sizes.folder / "figures.md"
    )
    kept = {
        n: json.loads(path.read_text(encoding="utf-8"))
        for n in STEPS
        if (path := sizes.folder / f"{n}.json").exists()
    }
    written.write_text(page(kept, sizes), encoding="utf-8")
    print(f"tables: {written}")
    return 0 if all(found["holds"] for found in results.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
