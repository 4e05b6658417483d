"""How often forecasts cover: small worlds whose truth is known, forecast again and again.

    python -m tools.proof.coverage [--repetitions 200] [--training 300] [--runs 300]
        [--page FILE]

Each repetition draws training trials and new trials from the same world, forecasts the new ones
from the training, and notes whether each 95 % interval holds: the predictive one the figure of the
new trials, the confidence interval the true figure. The width of an interval is compared with that
of an observer who knows the world: the central 95 % of the figure's error, from 4,000 simulated
repetitions.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray
from tools.proof.proof import ROOT, FigureProof, Result, digest

from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.studies.forecast.choices import choices_of
from petrobot.coordinator.studies.forecast.history import Training
from petrobot.coordinator.studies.forecast.predict import SHARES, TIMES, Request, figures, predict
from petrobot.coordinator.studies.forecast.residual import measured
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import loads

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]
SUCCESS, FAILURE, ERROR = "success", "failure", "error"
LOW, HIGH = 182, 196
"""Least and largest number of 200 repetitions in which a 95 % interval should hold."""
POOLED = (1870, 1930)
WIDEST = 1.25
KNOWN = 4000
"""Repetitions from which the width of the observer's interval is taken."""


# --- worlds -----------------------------------------------------------------------------------


class Column(Struct, frozen=True):
    """The k-th run in one place, over all trials. Arrays (trials,)."""

    place: str
    begun: Values
    took: Values
    failed: Mask
    """It ended with FAILURE."""
    lost: Mask
    """It ended with ERROR."""
    present: Mask
    second: Mask
    """It ran the second action of its primitive task."""
    on: str
    """The transition that consumes the token unless the run ends with ERROR."""


class Drawn(Struct):
    """Trials as columns. A trial is completed unless `given_up`."""

    time: Values
    goal: Mask
    given_up: Mask
    columns: list[Column] = field(default_factory=list)

    @classmethod
    def blank(cls, n: int) -> Drawn:
        """Return trials in which nothing has happened yet."""
        return cls(np.zeros(n), np.ones(n, np.bool_), np.zeros(n, np.bool_))

    def run(
        self,
        place: str,
        took: Values,
        *,
        failed: Mask | None = None,
        lost: Mask | None = None,
        present: Mask | None = None,
        second: Mask | None = None,
        begun: Values | None = None,
        on: str = "",
    ) -> Values:
        """Add a run; return when it ended. Without `begun` it follows the time so far, and the time
        becomes its end."""
        none, n = np.zeros(len(took), np.bool_), len(took)
        here = np.ones(n, np.bool_) if present is None else present
        start = self.time if begun is None else begun
        self.columns.append(
            Column(
                place,
                start.copy(),
                took,
                none if failed is None else failed,
                none if lost is None else lost,
                here,
                none if second is None else second,
                on or f"{place}_on",
            )
        )
        end = start + took
        if begun is None:
            self.time = np.where(here, end, self.time)
        return end

    def all_success(self) -> Mask:
        """Return which trials completed with SUCCESS only."""
        out = ~self.given_up
        for c in self.columns:
            out &= ~(c.present & (c.failed | c.lost))
        return out

    def figures(self, rows: slice | None = None) -> dict[str, float]:
        """Return the figures of these trials."""
        own = slice(None) if rows is None else rows
        times = self.time[own][~self.given_up[own]]
        return {
            "R_goal": float(self.goal[own].mean()),
            "P_complete": float(1.0 - self.given_up[own].mean()),
            "R_conj": float(self.all_success()[own].mean()),
            "mean": float(times.mean()),
            "q90": float(np.quantile(times, 0.9)),
        }

    def trials(self) -> list[Trial]:
        """Return them as a campaign records them."""
        return [self._trial(i) for i in range(len(self.time))]

    def _trial(self, i: int) -> Trial:
        runs = []
        for c in self.columns:
            if c.present[i]:
                status = ERROR if c.lost[i] else FAILURE if c.failed[i] else SUCCESS
                taken = f"{c.place}_lost" if c.lost[i] else c.on
                action = f"{c.place}_{'b' if c.second[i] else 'a'}"
                begun, took = round(float(c.begun[i]), 6), round(float(c.took[i]), 6)
                runs.append(RunEntry(c.place, action, begun, took, status, taken=taken))
        over = not self.given_up[i]
        time = round(float(self.time[i]), 6) if over else None
        runs.sort(key=lambda run: run.begun)
        return Trial(1, 0.0, time, over, int(self.goal[i]), runs=runs)


Draw = Callable[[np.random.Generator, int], Drawn]


class World(Struct, frozen=True, eq=False):
    """A task and the function that draws its trials. `choose`: other choices of the new trials (a
    what-if); `drawn_so`: draws trials with these choices."""

    name: str
    task: Task
    draw: Draw
    choose: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    drawn_so: Draw | None = None
    share: float = 1.0
    """Share of the training trials that chose as the new ones do."""

    @property
    def new(self) -> Draw:
        """Return the function that draws new trials."""
        return self.drawn_so or self.draw


def _task(
    places: Sequence[str], *transitions: tuple[str, str, str], more: Sequence[str] = ()
) -> Task:
    """Return a task with these action places; transitions are (name, inputs, outputs)."""
    lines = [
        'schema = 1\n[task]\nname = "world"\nruns_place = "jobs"\ngoal_transitions = ["reach"]',
        'final = "jobs == 0 and idle == 1"',
        '[places.jobs]\nkind = "control"\ntokens = 1',
        '[places.idle]\nkind = "resource"\ntokens = 1',
        '[places.met]\nkind = "control"',
    ]
    for p in places:
        lines.append(f'[primitive_tasks.{p}]\ngoal = "{p}"\nalternatives = ["{p}_a", "{p}_b"]')
        lines.append(f'deadline = 1e6\n[places.{p}]\nkind = "action"\ntask = "{p}"')
    for name, before, after in (*transitions, ("reach", "met", "idle")):
        quoted = [", ".join(f'"{x}"' for x in side.split()) for side in (before, after)]
        lines.append(f"[transitions.{name}]\nin = [{quoted[0]}]\nout = [{quoted[1]}]")
    return loads("\n".join([*lines, *more]), "world.toml")


def _series(*places: str) -> Task:
    """Return a task of places one after the other; errors end the trial."""
    moves = [("begin", "jobs idle", places[0])]
    for p, after in zip(places, (*places[1:], "met"), strict=True):
        moves += [(f"{p}_on", f"{p}:normal", after), (f"{p}_lost", f"{p}:error", "idle")]
    return _task(places, *moves)


FORK = _task(
    ("a", "b"),
    ("begin", "jobs idle", "a b"),
    ("join", "a:normal b:normal", "met"),
    ("a_lost", "a:error b:normal", "idle"),
    ("b_lost", "b:error a:normal", "idle"),
)
RETRY = _task(
    ("a", "b"),
    ("begin", "jobs idle", "a"),
    ("a_on", "a:normal", "b"),
    ("a_lost", "a:error", "a"),
    ("b_on", "b:normal", "met"),
    ("b_lost", "b:error", "idle"),
)


def sequence(random: np.random.Generator, n: int) -> Drawn:
    """Three independent runs; each may be lost, which ends the trial."""
    out, here = Drawn.blank(n), np.ones(n, np.bool_)
    for place, took in (
        ("a", random.gamma(4.0, 0.5, n)),
        ("b", random.uniform(0.5, 2.5, n)),
        ("c", random.exponential(1.0, n)),
    ):
        lost = here & (random.random(n) < 0.04)
        out.run(place, took, lost=lost, failed=random.random(n) < 0.05, present=here.copy())
        here &= ~lost
    out.goal = here
    return out


def fork(random: np.random.Generator, n: int) -> Drawn:
    """Two independent branches and their join."""
    return _joined(n, random.lognormal(0.5, 0.5, n), random.gamma(3.0, 0.6, n), random)


def common_cause(random: np.random.Generator, n: int) -> Drawn:
    """Two branches that are slow, and fail, together."""
    hard = random.normal(size=n)
    return _joined(
        n,
        np.exp(0.5 + 0.6 * hard + 0.2 * random.normal(size=n)),
        np.exp(0.4 + 0.6 * hard + 0.3 * random.normal(size=n)),
        random,
        np.where(hard > 1.0, 0.5, 0.03),
    )


def _joined(
    n: int, one: Values, other: Values, random: np.random.Generator, fails: Values | float = 0.1
) -> Drawn:
    out, zero = Drawn.blank(n), np.zeros(n)
    ends = [
        out.run(place, took, failed=random.random(n) < fails, begun=zero, on="join")
        for place, took in (("a", one), ("b", other))
    ]
    out.time = np.maximum(*ends)
    return out


def retries(random: np.random.Generator, n: int) -> Drawn:
    """A loop: each try is lost with probability 0.4."""
    return _retried(random, n, np.full(n, 0.4))


def _retried(random: np.random.Generator, n: int, chance: Values, most: int = 60) -> Drawn:
    out, here = Drawn.blank(n), np.ones(n, np.bool_)
    for k in range(most):
        lost = here & (random.random(n) < chance) & (k < most - 1)
        out.run("a", 0.2 + random.exponential(0.8, n), lost=lost, present=here.copy())
        here = lost
        if not here.any():
            break
    lost = random.random(n) < 0.03
    out.run("b", random.uniform(0.5, 1.0, n), lost=lost)
    out.goal = ~lost
    return out


def heavy_tail(random: np.random.Generator, n: int) -> Drawn:
    """A lognormal duration (sigma 1), then a Pareto one (index 3)."""
    out = Drawn.blank(n)
    out.run("a", random.lognormal(0.0, 1.0, n))
    out.run("b", random.pareto(3.0, n) + 0.2, failed=random.random(n) < 0.1)
    return out


def hidden(random: np.random.Generator, n: int) -> Drawn:
    """Three runs of a trial that is hard for all of them, or for none."""
    out, hard = Drawn.blank(n), random.random(n) < 0.3
    here = np.ones(n, np.bool_)
    for place in "abc":
        lost = here & (random.random(n) < np.where(hard, 0.15, 0.01))
        failed = random.random(n) < np.where(hard, 0.5, 0.05)
        took = np.where(hard, 2.5, 1.0) * random.gamma(5.0, 0.2, n)
        out.run(place, took, lost=lost, failed=failed, present=here.copy())
        here &= ~lost
    out.goal = here
    return out


def queue(random: np.random.Generator, n: int) -> Drawn:
    """Two jobs prepare side by side and then need the same arm, first come, first served."""
    out, zero = Drawn.blank(n), np.zeros(n)
    ready = [
        out.run("a", random.gamma(2.0, 0.7, n), begun=zero),
        out.run("b", random.lognormal(0.2, 0.6, n), begun=zero),
    ]
    use = [random.gamma(3.0, 0.4, n), random.uniform(0.3, 1.5, n)]
    first = ready[0] <= ready[1]
    free = np.where(first, ready[0] + use[0], ready[1] + use[1])
    begun = [np.where(first, ready[0], np.maximum(ready[0], free))]
    begun.append(np.where(first, np.maximum(ready[1], free), ready[1]))
    ends = [out.run(p, u, begun=t) for p, u, t in zip("cd", use, begun, strict=True)]
    out.time = np.maximum(*ends)
    return out


QUEUE = _task(
    ("a", "b", "c", "d"),
    ("begin", "jobs idle", "a b"),
    ("a_on", "a:normal arm", "c"),
    ("b_on", "b:normal arm", "d"),
    ("c_on", "c:normal", "arm c_over"),
    ("d_on", "d:normal", "arm d_over"),
    ("both", "c_over d_over", "met"),
    more=(
        '[places.arm]\nkind = "resource"\ntokens = 1',
        '[places.c_over]\nkind = "control"\n[places.d_over]\nkind = "control"',
        '[places.gone]\nkind = "control"',
        *(f'[transitions.{p}_lost]\nin = ["{p}:error"]\nout = ["gone"]' for p in "abcd"),
    ),
)


def race(random: np.random.Generator, n: int) -> Drawn:
    """A run waits for a signal until its deadline of 2 s; if it comes later, the trial takes the
    longer path."""
    out, wait = Drawn.blank(n), random.exponential(1.2, n)
    late = wait > 2.0
    out.run("a", np.minimum(wait, 2.0), lost=late)
    out.run("b", random.gamma(4.0, 0.2, n))
    out.run("c", random.uniform(1.0, 4.0, n), present=late)
    out.goal = ~late
    return out


def drift(random: np.random.Generator, n: int) -> Drawn:
    """Five runs while the light changes as a random walk: all depend on it."""
    out, light, goal = Drawn.blank(n), random.normal(0.0, 0.3, n), np.ones(n, np.bool_)
    for _ in range(5):
        failed = random.random(n) < 1.0 / (1.0 + np.exp(2.5 - 2.0 * light))
        out.run("a", np.exp(light) * random.gamma(6.0, 0.1, n), failed=failed)
        light, goal = light + random.normal(0.0, 0.3, n), goal & ~failed
    out.goal = goal
    return out


def mixed(random: np.random.Generator, n: int) -> Drawn:
    """Tries with a common difficulty, two branches that share it, a long-tailed end, and trials
    that are given up."""
    hard = random.normal(size=n)
    out = _retried(random, n, 1.0 / (1.0 + np.exp(1.5 - hard)), 6)
    begun = out.time.copy()
    ends = [
        out.run("c", np.exp(0.3 * hard + 0.3 * random.normal(size=n)), begun=begun),
        out.run("d", np.exp(0.4 * hard) * random.gamma(3.0, 0.3, n), begun=begun),
    ]
    out.time = np.maximum(*ends)
    out.given_up = random.random(n) < np.where(hard > 1.3, 0.2, 0.01)
    out.goal &= ~out.given_up
    out.run("e", random.lognormal(-0.5, 1.0, n), lost=out.given_up, failed=random.random(n) < 0.04)
    return out


def _two_actions(random: np.random.Generator, n: int, second: Mask) -> Drawn:
    """A hidden difficulty; the first place runs one of two actions, the other one is slower."""
    out, hard = Drawn.blank(n), random.normal(size=n)
    failed = random.random(n) < np.where(second, 0.05, np.where(hard > 0, 0.4, 0.05))
    out.run("a", np.exp(0.4 * hard) * (1.0 + 0.5 * second), failed=failed, second=second)
    out.run("b", np.exp(0.4 * hard) * random.gamma(4.0, 0.3, n) * (1.0 + failed))
    out.goal = ~failed
    return out


def half_each(random: np.random.Generator, n: int) -> Drawn:
    """Both actions equally likely."""
    return _two_actions(random, n, random.random(n) < 0.5)


def second_only(random: np.random.Generator, n: int) -> Drawn:
    """Only the second action."""
    return _two_actions(random, n, np.ones(n, np.bool_))


@cache
def worlds() -> tuple[World, ...]:
    """The worlds that the method was developed with."""
    two, three = _series("a", "b"), _series("a", "b", "c")
    return (
        World("sequence", three, sequence),
        World("fork and join, independent", FORK, fork),
        World("fork and join, common cause", FORK, common_cause),
        World("loop with retries", RETRY, retries),
        World("heavy tail", two, heavy_tail),
        World("hidden correlation", three, hidden),
        World("queue for a resource", QUEUE, queue),
        World("race with a time-out", three, race),
        World("drift within a trial", _series("a"), drift),
        World("all together", _series("a", "b", "c", "d", "e"), mixed),
    )


def what_if() -> World:
    """New trials with one action, from trials that chose it every second time."""
    return World(
        "what if: the other action",
        _series("a", "b"),
        half_each,
        {"a": {"a_b": 1.0}},
        second_only,
        0.5,
    )


# --- worlds set aside: used only after the method was fixed ---------------------------------------


def jam(random: np.random.Generator, n: int) -> Drawn:
    """One trial in fifty takes fifteen times as long."""
    out = Drawn.blank(n)
    jammed = random.random(n) < 0.02
    out.run("a", random.gamma(5.0, 0.2, n) * np.where(jammed, 15.0, 1.0), failed=jammed)
    out.goal = ~jammed
    return out


def two_ways(random: np.random.Generator, n: int) -> Drawn:
    """Nine trials of ten are short: the 90 % quantile lies at the edge of a gap."""
    out = Drawn.blank(n)
    slow = random.random(n) < 0.12
    out.run("a", np.where(slow, random.uniform(5.0, 6.0, n), random.uniform(0.5, 1.5, n)))
    return out


def frail_retries(random: np.random.Generator, n: int) -> Drawn:
    """A loop whose chance differs from trial to trial."""
    return _retried(random, n, random.beta(2.0, 2.5, n))


def weibull(random: np.random.Generator, n: int) -> Drawn:
    """Two branches with long-tailed durations (shape 0.7)."""
    return _joined(n, random.weibull(0.7, n), 0.8 * random.weibull(0.7, n), random, 0.02)


def chain(random: np.random.Generator, n: int) -> Drawn:
    """Six runs, each fails more often, and takes longer, after a failure; times are whole ticks of
    50 ms."""
    out, bad, any_bad = Drawn.blank(n), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    for _ in range(6):
        bad = random.random(n) < np.where(bad, 0.6, 0.08)
        took = np.ceil(random.gamma(3.0, 0.2, n) * (1.0 + 1.5 * bad) * 20.0) / 20.0
        out.run("a", took, failed=bad)
        any_bad |= bad
    out.goal = ~any_bad
    return out


@cache
def aside() -> tuple[World, ...]:
    """Worlds that the method was not developed with."""
    one = _series("a")
    return (
        World("rare jam", one, jam),
        World("gap at the quantile", one, two_ways),
        World("retries, frail", RETRY, frail_retries),
        World("fork, Weibull 0.7", FORK, weibull),
        World("chain of ticks", one, chain),
    )


# --- the experiment ---------------------------------------------------------------------------


def known_widths(world: World, training: int, runs: int) -> dict[str, dict[str, float]]:
    """Return the widths of the central 95 % of the errors of each time, for the new trials and for
    the truth."""
    random = np.random.default_rng(99)
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in TIMES}
    at_once = 100
    truth = figures_of(world)
    for _ in range(KNOWN // at_once):
        old, new = world.new(random, at_once * training), world.new(random, at_once * runs)
        for i in range(at_once):
            one = old.figures(slice(i * training, (i + 1) * training))
            other = new.figures(slice(i * runs, (i + 1) * runs))
            for name in TIMES:
                errors[name].append((other[name] - one[name], one[name] - truth[name]))
    return {
        name: dict(
            zip(
                ("interval", "confidence"),
                (float(x) for x in np.diff(np.quantile(found, (0.025, 0.975), axis=0), axis=0)[0]),
                strict=True,
            )
        )
        for name, found in errors.items()
    }


@cache
def figures_of(world: World) -> dict[str, float]:
    """Return the true figures, from a million trials."""
    return world.new(np.random.default_rng(98), 1_000_000).figures()


def covered(
    world: World, repetitions: int, training: int = 300, runs: int = 300, seed: int = 1
) -> dict[str, Any]:
    """Return how many repetitions each interval of each figure covers, the mean widths of the times
    as multiples of the observer's, and how many forecasts were refused or doubtful."""
    truth = figures_of(world)
    widths = known_widths(world, round(training * world.share), runs)
    hits = {name: {"interval": 0, "confidence": 0} for name in (*SHARES, *TIMES)}
    wide = {name: {"interval": 0.0, "confidence": 0.0} for name in TIMES}
    missed = 0
    for k in range(repetitions):
        random = np.random.default_rng([seed, k])
        known = Training.of(world.task, world.draw(random, training).trials())
        asked = {**choices_of(known), **world.choose}
        try:
            made = predict(known, Request(runs, asked, k, replicates=40, point=4000, net=False))
        except ValueError:
            missed += 1
            continue
        if made["doubts"]:
            missed += 1
            continue
        new = figures(measured(Training.of(world.task, world.new(random, runs).trials())))
        for name, found in made["figures"].items():
            for kind, value in (("interval", new[name]), ("confidence", truth[name])):
                low, high = found[kind]
                hits[name][kind] += low - 1e-6 <= value <= high + 1e-6
                if name in TIMES:
                    wide[name][kind] += (high - low) / widths[name][kind] / repetitions
    return {"world": world.name, "hits": hits, "widths": wide, "missed": missed}


HEAD = (
    "world",
    *(*TIMES, *SHARES),
    *(f"width, {name}" for name in TIMES),
    "refused or doubtful",
)
KINDS = ("interval", "confidence")
PAGE = """# Forecasts: how often their intervals cover

`python -m tools.proof.coverage --page docs/figures-forecast.md` writes this page
(`tools/proof/coverage.py` defines the worlds). In each of {repetitions} repetitions, {training}
training trials and {runs} new trials of a world are drawn, the new ones are forecast from the
training, and each 95 % interval is tested. Two numbers in a cell: how often the predictive interval
held the figure of the new trials, and how often the confidence interval held the true figure.
Widths are multiples of the central 95 % of the figure's error for an observer who knows the world.

Promised, for 200 repetitions: mean and q90 {low} to {high} (one world may miss), {pooled} of 2,000
in all; shares at least at their rate, 190, less chance (2.6 standard errors: 182), and more where
they are 0 or 1; widths at most {widest}. {verdict}

{table}
Worlds that were kept aside while the method was developed, whatever came out:

{aside}"""


def row_of(found: Mapping[str, Any]) -> list[str]:
    """Return a result as a row of the table."""
    hits, wide = found["hits"], found["widths"]
    return [
        str(found["world"]),
        *(", ".join(str(hits[name][kind]) for kind in KINDS) for name in (*TIMES, *SHARES)),
        *(", ".join(f"{wide[name][kind]:.2f}" for kind in KINDS) for name in TIMES),
        str(found["missed"]),
    ]


def table(found: Sequence[Mapping[str, Any]]) -> str:
    """Return the results as Markdown, with the sums over all worlds."""
    whole = {
        name: {kind: sum(f["hits"][name][kind] for f in found) for kind in KINDS}
        for name in (*TIMES, *SHARES)
    }
    sums = [", ".join(str(whole[name][kind]) for kind in KINDS) for name in (*TIMES, *SHARES)]
    rows = [HEAD, ["---"] * len(HEAD), *(row_of(f) for f in found)]
    rows.append(["all", *sums, "", "", str(sum(f["missed"] for f in found))])
    return "".join("| " + " | ".join(r) + " |\n" for r in rows)


def verdict(found: Sequence[Mapping[str, Any]], repetitions: int) -> list[str]:
    """Return which goals of the table do not hold, for 200 repetitions or scaled from them."""
    scale, out = repetitions / 200.0, []
    for kind in KINDS:
        for name in TIMES:
            counts = {f["world"]: f["hits"][name][kind] for f in found}
            off = [w for w, n in counts.items() if not LOW * scale <= n <= HIGH * scale]
            if len(off) > 1:
                out.append(f"{name} ({kind}): {', '.join(off)} outside {LOW} to {HIGH} of 200")
            whole = sum(counts.values()) / len(counts) * 10 / scale
            if not POOLED[0] <= whole <= POOLED[1]:
                out.append(f"{name} ({kind}): pooled {whole:.0f} of 2,000")
            out += [
                f"{name} ({kind}): {f['world']} {f['widths'][name][kind]:.2f} times as wide"
                for f in found
                if f["widths"][name][kind] > WIDEST
            ]
        # at least the nominal rate: not below it by more than chance (2.6 standard errors)
        least = repetitions * 0.95 - 2.6 * np.sqrt(repetitions * 0.95 * 0.05)
        out += [
            f"{name} ({kind}): {f['world']} {f['hits'][name][kind]} of {repetitions}"
            for f in found
            for name in SHARES
            if f["hits"][name][kind] < least
        ]
    return out


def experiment(options: argparse.Namespace) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Run it on all worlds, print a row for each, and write the page; return the results of the
    first ten worlds, and of those that were set aside."""
    found: list[list[dict[str, Any]]] = []
    for group in ((*worlds(), what_if()), aside()):
        found.append([])
        for world in group:
            one = covered(world, options.repetitions, options.training, options.runs, options.seed)
            found[-1].append(one)
            print("  ".join(row_of(one)), flush=True)
    faults = verdict(found[0][:-1], options.repetitions)
    print("\n".join(faults) or "all that is promised holds")
    if options.page is not None:
        text = PAGE.format(
            repetitions=options.repetitions,
            training=options.training,
            runs=options.runs,
            low=LOW,
            high=HIGH,
            pooled=" to ".join(f"{n:,}" for n in POOLED),
            widest=WIDEST,
            verdict="All of it holds." if not faults else f"Not held: {'; '.join(faults)}.",
            table=table(found[0]),
            aside=table(found[1]),
        )
        options.page.write_text(text, encoding="utf-8")
    return found[0][:-1], found[1]


def proofs() -> list[FigureProof]:
    """The table, in full."""

    def measure() -> Result:
        found, _ = experiment(parser().parse_args(["--page", str(ROOT / PAGE_FILE)]))
        return {
            "faults": len(verdict(found, 200)),
            **{
                f"{name}, {word}": sum(f["hits"][name][kind] for f in found)
                for name in TIMES
                for word, kind in zip(("new trials", "truth"), KINDS, strict=True)
            },
            "refused or doubtful": sum(f["missed"] for f in found),
        }

    def sample() -> str:
        return digest(experiment(parser().parse_args(["--repetitions", "2"])))

    return [
        FigureProof(
            "coverage of forecasts",
            "Forecasts, simulated worlds",
            measure,
            lambda result: result["faults"] == 0,
            f"95 % intervals hold in {LOW} to {HIGH} of 200 on ten worlds, {POOLED[0]} to "
            f"{POOLED[1]} of 2,000 in all, <= {WIDEST} x as wide as an observer's",
            ("coordinator/studies/forecast", "tools/proof/coverage.py"),
            sample=sample,
        )
    ]


PAGE_FILE = "docs/figures-forecast.md"


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    out = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    out.add_argument("--repetitions", type=int, default=200, metavar="N")
    out.add_argument("--training", type=int, default=300, metavar="N", help="training trials")
    out.add_argument("--runs", type=int, default=300, metavar="N", help="new trials")
    out.add_argument("--seed", type=int, default=1, metavar="S")
    out.add_argument("--page", type=Path, metavar="FILE", help="write the tables as Markdown")
    return out


def main() -> int:
    """Print the tables; exit code 1 if a goal does not hold."""
    options = parser().parse_args()
    found, _ = experiment(options)
    return 1 if verdict(found, options.repetitions) else 0


if __name__ == "__main__":
    sys.exit(main())
