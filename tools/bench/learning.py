"""The study of docs/figures-selectors.md: every selector in Bernoulli worlds with known J, 1,000
seeds each.

    python -m tools.bench.learning            the table, less than three minutes on one core
    python -m tools.bench.learning --write    write it to docs/figures-selectors.md, and draw
                                              docs/pictures/learning-*.svg (needs matplotlib)
    python -m tools.bench.learning --long     also a million trials of the schemes of Nikolic and Fu
                                              (about ten minutes)

The worlds use the same rules as mission runs (tests/learning/test_selectors.py compares them bit by
bit).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from petrobot.coordinator.learning.batch import Array
from petrobot.coordinator.learning.rules import NikolicFu, Rule
from petrobot.coordinator.learning.selectors import RULES
from tests.learning.worlds import BanditWorld, PlayedTrials, gapped, play

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "figures-selectors.md"
PICTURES = ROOT / "docs" / "pictures"
SEEDS, TRIALS, AT = 1000, 2000, 500
MARKS = sorted({int(x) for x in np.geomspace(4, TRIALS, 40)} | {AT, TRIALS // 2, TRIALS})
LONG = sorted({int(x) for x in np.geomspace(10, 10**6, 26)})
LONG_SEEDS = 16


def free(gap: float, best: float = 0.9) -> BanditWorld:
    """Return a world of four actions that cost nothing: only their reliability differs."""
    return replace(gapped(gap, best), cost=(0.0,) * 4)


WORLDS = {
    "easy": free(0.4),
    "middle": free(0.2),
    "hard": free(0.05),
    "costs": BanditWorld("costs", (0.95, 0.9, 0.85, 0.6), (4.0, 1.2, 2.0, 3.0)),
    "equal": free(0.0, 0.8),
    "changing": BanditWorld(
        "changing", (0.5, 0.5, 0.5, 0.9), (0.0,) * 4, TRIALS // 2, (0.9, 0.5, 0.5, 0.5)
    ),
}
CONTROLS: dict[str, Rule] = {
    "gain 1/(k+1)^0.6": NikolicFu("power", k0=1.0, exponent=0.6),
    "gain 2/(k+2)": NikolicFu("double", c=2.0, k0=2.0),
}
NOTED: dict[str, Rule] = {
    "gain k^-0.7, even mixing 5n/k": NikolicFu("noted", k0=0.0, exponent=0.7, mixing=5.0)
}


def rules() -> dict[str, Rule]:
    """Return all selectors of the study."""
    return {name: make() for name, make in RULES.items()} | NOTED | CONTROLS


def at(played: PlayedTrials, values: Array, trial: int) -> Array:
    """Return a figure of each seed after so many trials."""
    row: Array = values[list(played.checkpoints).index(trial)]
    return row


def measure(rule: Rule) -> dict[str, dict[str, Any]]:
    """Run one selector in every world. Shares are in [0, 1], regret in J."""
    out: dict[str, dict[str, Any]] = {}
    for number, (name, world) in enumerate(WORLDS.items()):
        played = play(rule, world, TRIALS, SEEDS, np.random.default_rng([7, number]), MARKS)
        p, regret = at(played, played.p_best, AT), at(played, played.regret, AT)
        out[name] = {
            "converged": float(np.mean(p >= 0.95)),
            "right": float(np.mean(p > 0.5)),
            "recent": float(played.recent[played.checkpoints.index(AT)].mean()),
            "regret": float(regret.mean()),
            "curve": played.regret.mean(axis=1).tolist(),
            "before": float(played.recent[played.checkpoints.index(TRIALS // 2)].mean())
            if world.change
            else None,
            "after": float(played.optimal.mean()),
            "end": float(played.regret[-1].mean()),
        }
    return out


# --- the table --------------------------------------------------------------------------------


def table(found: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Return the two tables in Markdown."""
    lines = [
        "After 500 trials, 4 actions, 1,000 seeds. *p*: share of seeds with p >= 0.95 on the "
        "optimum; *ends*: share that ends",
        "on it (p > 0.5; for the bandit rules p is all on their lowest J); *plays*: share of "
        "the last 100 choices that were",
        "optimal; *regret*: mean sum of J above the optimum.",
        "",
        "| selector | easy: p / ends / plays / regret | middle | hard | costs |",
        "|---|---|---|---|---|",
    ]
    for name, worlds in found.items():
        cells = [_cell(worlds[w]) for w in ("easy", "middle", "hard", "costs")]
        lines.append(f"| {_label(name)} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "| selector | equal: regret | changing: optimal before the change / at the end | "
        "changing: regret after 2,000 |",
        "|---|---|---|---|",
    ]
    for name, worlds in found.items():
        change = worlds["changing"]
        both = f"{_percent(change['before'])} / {_percent(change['after'])} %"
        lines.append(
            f"| {_label(name)} | {worlds['equal']['end']:.0f} | {both} | {change['end']:.0f} |"
        )
    return "\n".join(lines)


def _label(name: str) -> str:
    return f"`{name}`" if name in RULES else f"*{name}*"


def _percent(share: float) -> str:
    return f"{100 * share:.1f}".removesuffix(".0")


def _cell(figures: dict[str, Any]) -> str:
    shares = " / ".join(_percent(figures[k]) for k in ("converged", "right", "recent"))
    return f"{shares} % / {figures['regret']:.0f}"


# --- a million trials -------------------------------------------------------------------------


def long_run(rule: Rule, world: BanditWorld) -> dict[str, Any]:
    """Return 1 - p* and the smallest number of tries of any action, by trial."""
    tries: list[float] = []

    def watch(t: int, batch: Any, action: Any) -> None:
        if t + 1 in LONG:
            tries.append(float(np.median(batch.tries.min(axis=1))))

    played = play(rule, world, LONG[-1], LONG_SEEDS, np.random.default_rng(11), LONG, watch)
    left = 1.0 - played.p_best
    return {
        "trials": LONG,
        "median": np.median(left, axis=1).tolist(),
        "worst": left.max(axis=1).tolist(),
        "stuck": float(np.mean(left[-1] > 0.5)),
        "least_tries": tries,
    }


LONG_RULES: dict[str, Rule] = {
    "nikolic_fu": RULES["nikolic_fu"](),
    "nikolic_fu_fast": RULES["nikolic_fu_fast"](),
    "gain 1/(k+1)^0.6": CONTROLS["gain 1/(k+1)^0.6"],
}


# --- pictures ---------------------------------------------------------------------------------


def draw(found: dict[str, dict[str, dict[str, Any]]], long: dict[str, Any] | None) -> None:
    """Draw regret by trial, regret by gap, and the million trials."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update(
        {"svg.hashsalt": "petrobot", "font.size": 9, "axes.spines.top": False}
    )
    _draw_regret(found)
    _draw_gaps()
    if long is not None:
        _draw_long(long)


def _save(figure: Any, name: str) -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.savefig(PICTURES / name, metadata={"Date": None})


def _draw_regret(found: dict[str, dict[str, dict[str, Any]]]) -> None:
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(10, 7))
    shown = [n for n in found if n not in ("fixed", "round_robin")]
    for ax, world in zip(axes.flat, ("easy", "middle", "hard", "changing"), strict=True):
        for i, name in enumerate(shown):
            style = "--" if name not in RULES else "-"
            ax.plot(
                MARKS, found[name][world]["curve"], style, color=f"C{i % 10}", label=name, lw=1.2
            )
        ax.set(
            title=f"{world}: gap {WORLDS[world].gap:.2g}",
            xlabel="trial",
            ylabel="cumulative regret (J)",
        )
    axes[1, 1].legend(fontsize=7, loc="upper left")
    _save(figure, "learning-regret.svg")


def _draw_gaps() -> None:
    """Draw the paper's claim: where learning is slow, the loss is small."""
    from matplotlib import pyplot as plt

    gaps = [0.0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5]
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6))
    for name in ("nikolic_fu", "nikolic_fu_fast", "thompson"):
        played = [
            play(RULES[name](), free(g), AT, SEEDS, np.random.default_rng([8, i]))
            for i, g in enumerate(gaps)
        ]
        left.plot(gaps, [float(p.regret[-1].mean()) for p in played], "o-", label=name)
        simple = [g * float(np.mean(1 - p.p_best[-1])) for g, p in zip(gaps, played, strict=True)]
        right.plot(gaps, simple, "o-", label=name)
    left.set(
        xlabel="gap of J between best and others", ylabel=f"cumulative regret after {AT} trials (J)"
    )
    right.set(
        xlabel="gap of J between best and others",
        ylabel=f"simple regret after {AT} trials (J a trial)",
    )
    left.legend()
    _save(figure, "learning-gaps.svg")


def _draw_long(long: dict[str, Any]) -> None:
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8))
    for i, (name, run) in enumerate(long.items()):
        left.loglog(
            run["trials"], np.maximum(run["median"], 1e-16), color=f"C{i}", label=f"{name}, median"
        )
        left.loglog(
            run["trials"], np.maximum(run["worst"], 1e-16), ":", color=f"C{i}", label="worst seed"
        )
        right.semilogx(run["trials"], run["least_tries"], color=f"C{i}", label=name)
    left.set(xlabel="trial", ylabel="1 - p of the optimum", ylim=(1e-9, 2))
    right.set(xlabel="trial", ylabel="tries of the least tried action (median)")
    left.legend(fontsize=7)
    right.legend(fontsize=7)
    _save(figure, "learning-million.svg")


# --- the command ------------------------------------------------------------------------------


def write_page(text: str, long: dict[str, Any] | None) -> None:
    """Put the tables between their marks in docs/figures-selectors.md."""
    page = PAGE.read_text(encoding="utf-8")
    page = _between(page, "convergence", text)
    if long is not None:
        rows = [
            f"| `{name}` | {run['median'][-1]:.1e} | {run['worst'][-1]:.1e} | "
            f"{100 * run['stuck']:.0f} % | "
            f"{run['least_tries'][-1]:.0f} |"
            for name, run in long.items()
        ]
        head = (
            "| after 1,000,000 trials, 16 seeds | 1 - p*, median | worst seed | still at "
            "a wrong action | least tried action |"
        )
        page = _between(page, "million", "\n".join([head, "|---|---|---|---|---|", *rows]))
    PAGE.write_text(page, encoding="utf-8")


def _between(page: str, mark: str, text: str) -> str:
    begin, end = f"<!-- {mark} -->", f"<!-- /{mark} -->"
    head, _, rest = page.partition(begin)
    return f"{head}{begin}\n{text}\n{end}{rest.partition(end)[2]}"


def main() -> None:
    """Measure, print, and on request write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--write", action="store_true", help="write docs/figures-selectors.md and the pictures"
    )
    parser.add_argument("--long", action="store_true", help="play a million trials too")
    parser.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help="keep all figures here; what is there is not measured again",
    )
    options = parser.parse_args()
    begun = time.process_time()
    kept = (
        json.loads(options.json.read_text(encoding="utf-8"))
        if options.json and options.json.exists()
        else {}
    )
    kept["worlds"] = kept.get("worlds") or {name: measure(rule) for name, rule in rules().items()}
    if options.long:
        kept["long"] = kept.get("long") or {
            name: long_run(rule, free(0.4)) for name, rule in LONG_RULES.items()
        }
    if options.json:
        options.json.write_text(json.dumps(kept), encoding="utf-8")
    print(table(kept["worlds"]))
    print(f"\n{time.process_time() - begun:.0f} s of CPU")
    if options.write:
        draw(kept["worlds"], kept.get("long"))
        write_page(table(kept["worlds"]), kept.get("long"))


if __name__ == "__main__":
    main()
