"""Compare what may judge a choice: how the action ended, or whether the task met its goal. In ten
disturbed regimes of the catching cell each is learned, frozen, and compared on fresh balls with the
best fixed combination.

    python -m tools.proof.credit                        everything (days on one core); continues
                                                        where it stopped
    python -m tools.proof.credit --share 0.1 --regimes C+dark15,C+miscalibrated --seeds 2

For each regime all combinations are screened on balls of their own, and the best of them is chosen
on balls of their own again. Every learner learns from scratch, with each credit. Learned and best
combination meet the same fresh balls (paired). The balls that a bandit over all combinations needs
to come within two points of the best are counted in simulation, on the catch rates that the screen
measured. Each campaign has a folder of its own, so an interrupted study continues.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from tools.proof.campaigns import Result, Sizes, campaign, rows_of
from tools.proof.proof import LOCK_STEP, ROOT, FigureProof, digest

from petrobot.coordinator.cli.loading import load_directory, load_task
from petrobot.coordinator.learning.batch import Response
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.selectors import TASK, CombinationSelector
from petrobot.coordinator.studies.campaign.policies import AllCombinations, offered
from petrobot.coordinator.studies.campaign.table import TABLE, TrialRow
from petrobot.coordinator.studies.report.comparing import paired, share_difference

REGIMES = (
    "C+dark15",
    "C+miscalibrated",
    "C+latency400",
    "D+latency200",
    "C+arm30",
    "C+beating",
    "C+blur",
    "C+jitter",
    "C+cup50",
    "D+dropped_images",
)
CREDITS = ("action", "task")
LEARNING, SCREENING, FINAL, FRESH = 1000, 60, 400, 1000
"""Numbers of balls: for one learner, for the screen of each combination, for each finalist, for
judging."""
FINALISTS = 5
MEAN, LOWEST = -0.02, -0.04
"""Floors of the difference in catches to the best fixed combination: of its mean over the learning
seeds, and of the lower 95 % end of that mean, in each regime."""
CLOSE = 0.02
SIMULATED = 200
"""Simulated learners that count the trials to within `CLOSE` of the best."""
SELECTOR = "nikolic_fu_fast"

Actions = Mapping[str, str]


class Study(Struct, frozen=True):
    """The options of a study and what all its parts share."""

    sizes: Sizes
    seeds: int
    selector: str

    def choose(self, actions: Actions) -> str:
        """Return the option that fixes these actions."""
        return ",".join(f"{task}={action}" for task, action in actions.items())


def caught(row: TrialRow) -> bool:
    """Return whether the trial's goal was met."""
    return row.trial is not None and row.trial.goals > 0


def regime_result(study: Study, regime: str) -> Result:
    """Return what was learned in a regime, and how it compares."""
    sizes, task = study.sizes, load_task(study.sizes.task)
    choices = {t: a for t, a in offered(task, load_directory(sizes.services)).items() if len(a) > 1}
    rotation = AllCombinations(choices, {})
    count = int(np.prod([len(a) for a in choices.values()]))
    balls = sizes.of(SCREENING, 4) * count
    campaign(sizes, f"{regime}/screen", balls, 50, regime, "--selector", "round_robin")
    shape = tuple(len(a) for a in choices.values())
    seen = np.zeros((2, *shape))
    for row in rows_of(sizes, f"{regime}/screen"):
        actions = rotation.combination(row.n - 1)
        at = tuple(choices[t].index(actions[t]) for t in choices)
        seen[0][at] += 1
        seen[1][at] += caught(row)
    order = np.argsort(-(seen[1] / np.maximum(seen[0], 1)), axis=None)[:FINALISTS]
    finalists = [
        {t: choices[t][i] for t, i in zip(choices, np.unravel_index(k, shape), strict=True)}
        for k in order
    ]
    rates = [_rate(study, regime, f"final_{i}", c, 51) for i, c in enumerate(finalists)]
    best = finalists[int(np.argmax(rates))]
    found: Result = {"regime": regime, "best": best, "best caught": _fresh(study, regime, best)[0]}
    for credit in CREDITS:
        lines = []
        for seed in range(1, study.seeds + 1):
            name, more = f"{regime}/{credit}_{seed}", ("--selector", study.selector)
            kept = campaign(
                sizes, name, sizes.of(LEARNING, 100), seed, regime, *more, "--credit", credit
            )
            actions = {t: kept["policy"][regime][t]["best"] for t in choices}
            rate, rows = _fresh(study, regime, actions)
            pairs = paired(rows, _fresh(study, regime, best)[1])
            lines.append({"actions": actions, "caught": rate, **share_difference(pairs, caught)})
        found[credit] = lines
        found[f"{credit} mean"], found[f"{credit} lower"] = mean_difference(lines)
    found["trials to within two points"] = trials_needed(seen)
    found["holds"] = found["task mean"] >= MEAN and found["task lower"] >= LOWEST
    return found


def _rate(study: Study, regime: str, name: str, actions: Actions, seed: int) -> float:
    balls, given = study.sizes.of(FINAL), study.choose(actions)
    kept = campaign(study.sizes, f"{regime}/{name}", balls, seed, regime, "--choose", given)
    return float(kept["R_goal"])


def _fresh(study: Study, regime: str, actions: Actions) -> tuple[float, list[TrialRow]]:
    """Return the share of fresh balls that a combination catches, and the trials; equal
    combinations share them."""
    name = f"{regime}/fresh_{'_'.join(actions.values())}"
    given = study.choose(actions)
    kept = campaign(study.sizes, name, study.sizes.of(FRESH), 60, regime, "--choose", given)
    return float(kept["R_goal"]), rows_of(study.sizes, name)


def mean_difference(lines: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Return the mean difference of the learners and its lower 95 % end.

    All learners of a regime meet the same balls, so their paired errors are taken as fully
    dependent (half-widths averaged), and the scatter of the learners themselves is added as
    independent.
    """
    d = np.array([line["difference"] for line in lines])
    half = float(np.mean([line["difference"] - line["interval"][0] for line in lines]))
    scatter = 1.96 * float(d.std(ddof=1)) / np.sqrt(len(d)) if len(d) > 1 else 0.0
    return float(d.mean()), float(d.mean() - np.hypot(half, scatter))


def trials_needed(seen: np.ndarray[Any, Any], most: int = 2000) -> dict[str, int | None]:
    """Return after how many trials half and nine tenths of simulated learners choose a combination
    within two points of the best, and still do so at the end; None if not within `most`.

    `seen`: trials and catches of each combination, shape (2, ...); the rates are drawn from their
    posterior distributions, so that the scatter of the screen is not mistaken for a difference.
    `task credit` is the rule of `--credit task`; `plain bandit` is UCB1 over combinations without a
    prior.
    """
    rng, shape = np.random.default_rng(7), seen.shape[1:]
    rates = rng.beta(seen[1] + 0.5, seen[0] - seen[1] + 0.5, (SIMULATED, *shape))
    flat = rates.reshape(SIMULATED, -1)
    out: dict[str, int | None] = {}
    for label, rule, with_prior in (
        ("task credit", "nikolic_fu_fast", True),
        ("plain bandit", "ucb1", False),
    ):
        names = {str(axis): [f"{axis}.{i}" for i in range(n)] for axis, n in enumerate(shape)}
        play = CombinationSelector(rule, names, Question(), TASK).selector.rule
        batch = play.begin(SIMULATED, flat.shape[1], 0.0)
        batch.shape = shape if with_prior else ()
        offered_, rows = np.ones(flat.shape, dtype=bool), np.arange(SIMULATED)
        since = np.ones(SIMULATED)
        for trial in range(1, most + 1):
            action = play.choose(batch, offered_, rng.random(flat.shape))
            batch.choosing(action)
            met = (rng.random(SIMULATED) < flat[rows, action]).astype(float)
            whole = Response(action, met, np.ones(SIMULATED), np.ones(SIMULATED, dtype=bool))
            play.learn(batch, whole)
            behind = flat.max(axis=1) - flat[rows, batch.p.argmax(axis=1)] > CLOSE
            since[behind] = trial + 1
        for share in (0.5, 0.9):
            needed = int(np.quantile(since, share, method="higher"))
            out[f"{label}, {share:.0%} of learners"] = None if needed > most else needed
    return out


def page(results: Sequence[Result], study: Study, command: str) -> str:
    """Return the table, with the command that makes it again."""
    lines = [
        "# What judges a choice: figures",
        "",
        f"`{command}`",
        "",
        f"Learned from {study.sizes.of(LEARNING, 100)} balls, {study.seeds} learning seeds, "
        f"`{study.selector}`; judged on",
        f"{study.sizes.of(FRESH)} fresh balls, paired with the best fixed combination. Points of",
        "catches below (-) or above it, and the lower 95 % end.",
        "",
        "| regime | best caught | credit action | credit task | holds | "
        "trials to within 2 points, 90 % |",
        "|---|---|---|---|---|---|",
    ]
    for found in results:
        needed = found["trials to within two points"]
        cells = [
            found["regime"],
            f"{100 * found['best caught']:.1f} %",
            *(
                f"{100 * found[f'{c} mean']:+.1f} (> {100 * found[f'{c} lower']:.1f})"
                for c in CREDITS
            ),
            "yes" if found["holds"] else "**no**",
            ", ".join(
                f"{label} {needed[f'{label}, 90% of learners'] or 'over 2,000'}"
                for label in ("task credit", "plain bandit")
            ),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def measured(options: argparse.Namespace) -> list[Result]:
    """Study the regimes one after the other, and store each result."""
    results = []
    for regime in options.regimes.split(","):
        folder = options.folder / f"{options.share:g}"
        study = Study(
            Sizes(options.share, options.workers, folder), options.seeds, options.selector
        )
        (folder / regime).mkdir(parents=True, exist_ok=True)
        found = regime_result(study, regime)
        text = json.dumps(found, indent=2)
        (folder / regime / "result.json").write_text(text, encoding="utf-8")
        print(page([found], study, "").splitlines()[-1], flush=True)
        results.append(found)
    return results


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    made = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--share", type=float, default=1.0, metavar="X", help="of every number")
    made.add_argument("--regimes", default=",".join(REGIMES))
    made.add_argument("--seeds", type=int, default=3, help="learners of each credit (%(default)s)")
    made.add_argument("--selector", default=SELECTOR)
    made.add_argument("--workers", type=int, default=2, metavar="K")
    made.add_argument("--folder", type=Path, default=ROOT / "reports" / "proof" / "credit")
    made.add_argument("--page", type=Path, metavar="FILE", help="write the table here, too")
    return made


def proofs() -> list[FigureProof]:
    """Return a proof for each regime, which takes an hour or two of one core."""
    return [
        FigureProof(
            f"credit, {regime}",
            "What judges a choice, lock step",
            partial(_line, regime),
            lambda result: bool(result["all that was promised"]),
            f"task credit: mean > {100 * MEAN:g}, lower end > {100 * LOWEST:g}",
            (*LOCK_STEP, "coordinator/learning", "coordinator/studies"),
            sample=partial(_sample, regime),
        )
        for regime in REGIMES
    ]


def _line(regime: str) -> Result:
    """Study a regime in full size; differences in points of catches."""
    found = measured(parser().parse_args(["--regimes", regime]))[0]
    needed = found["trials to within two points"]
    return {
        "all that was promised": found["holds"],
        "best caught (%)": round(100 * found["best caught"], 1),
        **{
            f"{credit}: {which}": round(100 * found[f"{credit} {key}"], 1)
            for credit in CREDITS
            for which, key in (("mean", "mean"), ("lower end", "lower"))
        },
        **{
            f"trials to within 2 points, {label}": needed[f"{label}, 90% of learners"]
            for label in ("task credit", "plain bandit")
        },
    }


def _sample(regime: str) -> str:
    """Learn with each credit from a few balls; return a digest of all trials."""
    with tempfile.TemporaryDirectory() as folder:
        sizes = Sizes(0.01, 1, Path(folder))
        for credit in CREDITS:
            more = ("--selector", SELECTOR, "--credit", credit)
            campaign(sizes, credit, sizes.of(LEARNING), 1, regime, *more)
        return digest([(Path(folder) / credit / TABLE).read_text("utf-8") for credit in CREDITS])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study and write the table."""
    options = parser().parse_args(argv)
    results = measured(options)
    study = Study(
        Sizes(options.share, options.workers, options.folder), options.seeds, options.selector
    )
    given = sys.argv[1:] if argv is None else list(argv)
    text = page(results, study, " ".join(["python -m tools.proof.credit", *given]))
    print(text)
    if options.page is not None:
        options.page.write_text(text, encoding="utf-8")
    return 0 if all(found["holds"] for found in results) else 1


if __name__ == "__main__":
    sys.exit(main())
