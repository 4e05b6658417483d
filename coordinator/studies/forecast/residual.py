"""Check a forecast against its own training: simulate trials with the training's choices and
compare them with the training trials."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from scipy.stats import chi2_contingency, rankdata, spearmanr, ttest_ind_from_stats

from petrobot.coordinator.analysis.net.structure import exclusive_places, place_semiflows
from petrobot.coordinator.analysis.time.measured import is_cause
from petrobot.coordinator.learning.propagation import limits_of
from petrobot.coordinator.learning.records import WaitEnd
from petrobot.coordinator.learning.waits import memory_of
from petrobot.coordinator.studies.forecast.direct import FEWEST, holm, missions
from petrobot.coordinator.studies.forecast.history import Codes, Training, Values, reads_variables
from petrobot.coordinator.studies.forecast.net_arrays import Move
from petrobot.coordinator.studies.forecast.play import Choices, Played
from petrobot.coordinator.task import EarlyEvent, EventMemory, Transition
from petrobot.coordinator.task.conditions import equivalent
from petrobot.coordinator.task.validation import condition_domains

LEVEL = 0.01
"""Significance level at which simulated and measured trials differ, over all tests of a regime
(Holm)."""
EXACT = 1e-9
"""Relative spread below which times are equal: a sum of equal durations differs by its rounding
errors, which no test may take for a spread."""
NEGLIGIBLE = 0.02
"""Share of trials that may rest on a guess, or by which a simulated share may miss the measured
one. Less than this moves no forecast share by more than the margin of equivalence."""
TIME, MEAN = "time", "mean time"
OFF_TIME = 0.05
"""The same for mean times (relative) and for shares of trials in classes of the time."""


def measured(training: Training) -> Played:
    """Return measured trials in the form of simulated ones."""
    trials = training.trials
    return Played(
        np.array([t.goals for t in trials], np.int64),
        np.array([t.completed for t in trials], np.bool_),
        np.array([t.all_success for t in trials], np.bool_),
        np.array([np.nan if t.time is None or not t.completed else t.time for t in trials]),
    )


def residuals(training: Training, played: Played) -> list[dict[str, Any]]:
    """Test by chi-square whether measured and simulated trials have the same distributions; returns
    p, Holm's p and the difference.

    Tested are goals, completion, all-SUCCESS, classes of the time, its mean, and for each place the
    transitions by which its runs left it. `off` is the largest difference of two shares; for the
    mean time, the relative difference.
    """
    real = measured(training)
    trials = len(real.goals), len(played.goals)
    tables = {
        "goal": _shares(real.goals > 0, played.goals > 0),
        "complete": _shares(real.completed, played.completed),
        "every run SUCCESS": _shares(real.all_success, played.all_success),
        TIME: _shares(_classes(real.time, real.time), _classes(played.time, real.time)),
    }
    for place, ways in routing(training).items():
        tables[f"ways out of {place}"] = ways_table(ways, played.ways.get(place, {}))
    alone = {name: _p_value(table, trials) for name, table in tables.items()} | {
        MEAN: _same_mean(real.time, played.time)
    }
    off = {name: _off(table, trials) for name, table in tables.items()} | {
        MEAN: _mean_off(real.time, played.time)
    }
    return [
        {"of": name, "p": p, "p_holm": together, "off": round(off[name], 6)}
        for (name, p), together in zip(alone.items(), holm(list(alone.values())), strict=True)
    ]


def _shares(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    kept_one, kept_other = one[~np.isnan(one)], other[~np.isnan(other)]
    levels = np.unique(np.concatenate([kept_one, kept_other]))
    return np.array([[np.sum(x == level) for level in levels] for x in (kept_one, kept_other)])


def _same_mean(one: Values, other: Values) -> float:
    """Welch's test of equal means: classes tell little about a few trials that last very long."""
    kept = [times[~np.isnan(times)] for times in (one, other)]
    if min(map(len, kept)) < 2:
        return 1.0
    means, spreads = [x.mean() for x in kept], [x.std(ddof=1) for x in kept]
    if max(spreads) <= EXACT * means[0]:
        return float(math.isclose(*means, rel_tol=EXACT))
    # not ttest_ind: it warns where the times of one side differ only by rounding
    stats = (
        x
        for mean, sd, times in zip(means, spreads, kept, strict=True)
        for x in (mean, sd, len(times))
    )
    return float(ttest_ind_from_stats(*stats, equal_var=False).pvalue)


def _off(table: np.ndarray, trials: tuple[int, int]) -> float:
    whole = table.sum(axis=1, keepdims=True)
    if whole.all():
        return float(np.abs(np.diff(table / whole, axis=0)).max())
    return min(1.0, float((whole[:, 0] / trials).max()))  # one side has none: how often the other


def _mean_off(one: Values, other: Values) -> float:
    if np.isnan(one).all() or np.isnan(other).all() or np.nanmean(one) == 0:
        return 0.0
    return float(abs(np.nanmean(other) / np.nanmean(one) - 1.0))


def _p_value(table: np.ndarray, trials: tuple[int, int]) -> float:
    """Return the p-value of equal shares in the two rows, which come from so many trials; 1 if
    there is nothing to compare. If one row is empty, it is that of how often the other is not."""
    count = table.sum(axis=1)
    if not count.all():
        side = int(count[1] > count[0])
        return all_on_one_side(min(max(count), trials[side]), trials[side], trials[1 - side])
    return 1.0 if table.shape[1] == 1 else float(chi2_contingency(table).pvalue)


def all_on_one_side(count: int, here: int, there: int) -> float:
    """Return the probability that so many of equally likely trials are all among those `here`, and
    none among those `there`."""
    return float((here / (here + there)) ** count)


def _classes(times: Values, of: Values) -> Values:
    known = of[~np.isnan(of)]
    if not len(known):
        return np.full(len(times), np.nan)
    # where times are few, a bound is one of them, and a simulated sum may miss it by its rounding
    bounds = np.quantile(known, (0.25, 0.5, 0.75, 0.9)) * (1.0 - EXACT)
    classes = np.searchsorted(bounds, times, side="right").astype(np.float64)
    return np.where(np.isnan(times), np.nan, classes)


def routing(training: Training, choices: Choices | None = None) -> dict[str, dict[str, int]]:
    """Return, by action place, how often each transition took a token from it.

    With `choices`: only in trials all of whose runs could have been chosen so, because only they
    tell how such trials continue.
    """
    out: dict[str, dict[str, int]] = {}
    for i in chosen_so(training, choices):
        for run in training.trials[i].runs:
            if run.taken:
                ways = out.setdefault(run.place, {})
                ways[run.taken] = ways.get(run.taken, 0) + 1
    return {place: dict(sorted(ways.items())) for place, ways in sorted(out.items())}


def chosen_so(training: Training, choices: Choices | None) -> list[int]:
    """Return the indexes of the trials all of whose runs could have been chosen so; of all without
    choices."""
    primitive = training.task.primitive_task_of
    return [
        i
        for i, trial in enumerate(training.trials)
        if choices is None
        or all(
            choices.get(primitive(run.place).name, {run.action: 1.0}).get(run.action, 0.0) > 0
            for run in trial.runs
        )
    ]


def entered(training: Training, choices: Choices | None = None) -> dict[str, int]:
    """Return, by action place, in how many trials a token was taken from it. `choices`: as in
    `routing`."""
    out: dict[str, int] = {}
    for i in chosen_so(training, choices):
        for place in {run.place for run in training.trials[i].runs if run.taken}:
            out[place] = out.get(place, 0) + 1
    return dict(sorted(out.items()))


def durations(
    training: Training, choices: Choices | None = None
) -> dict[tuple[str, str], tuple[Values, Codes]]:
    """Return, by place and action, how long its runs took that ended by themselves, and the mission
    run of each: one number per trial, the mean of its runs, because they may depend on each other.
    Waits for a device are left out. `choices`: as in `routing`."""
    mission, out = missions(training), dict[tuple[str, str], tuple[list[float], list[int]]]()
    for i in chosen_so(training, choices):
        took: dict[tuple[str, str], list[float]] = {}
        for run in training.trials[i].runs:
            if run.status and not run.cancelled:
                took.setdefault((run.place, run.action), []).append(run.took - (run.waited or 0.0))
        for key, seconds in took.items():
            times, number = out.setdefault(key, ([], []))
            times.append(sum(seconds) / len(seconds))
            number.append(int(mission[i]))
    # The difference of two times of the table has an error of up to 1 us.
    return {
        key: (np.round(times, 4), np.array(number)) for key, (times, number) in sorted(out.items())
    }


def ways_table(before: Mapping[str, int], after: Mapping[str, int]) -> np.ndarray:
    """Return the contingency table (2, ways) of two counts of outgoing transitions of a place."""
    ways = sorted({*before, *after})
    return np.array([[counts.get(way, 0) for way in ways] for counts in (before, after)])


ORDER_LEVEL = 3e-4
"""Significance level, after Holm, at which trials depend on their order: a forecast that is refused
without a reason counts as a miss, so this must not happen once in 3,000 forecasts."""
ORDER = 0.1
"""Rank correlation from which such a dependence matters."""


RARE = 5
"""Number of trials from which a branch is no longer rare. The interval of the mean holds in 97 % of
cases where three trials of a long branch are expected, but in 86 % where two are (300 trials, 50
times as long): often none comes. Five are seen then in only one of 20 cases."""


LIKELY = 0.05
"""p-value of the asymptotic test above which no permutations are drawn."""
PERMUTATIONS = 20_000
AT_ONCE = 500
"""Most permutations that are drawn at once, before the check whether more can matter."""
VALUES = 2_000_000
"""Most values of the permutations that are drawn at once (16 MB)."""


def _rank_test(one: Values, other: Values) -> tuple[float, float]:
    """Return Spearman's rank correlation and its p-value. Where the asymptotic one is small it is
    found by permutations, because two rare events that happen to be neighbours are no dependence.

    No more are drawn once so many were beyond that no p-value below `ORDER_LEVEL` is possible
    (Besag and Clifford, Biometrika 78, 1991). Holm's factors of smaller p-values stay the same.
    """
    test = spearmanr(one, other)
    if test.pvalue > LIKELY:
        return float(test.statistic), float(test.pvalue)
    random, a, b = np.random.default_rng(0), _scores(one), _scores(other)
    least, beyond, drawn = abs(float(a @ b)) - 1e-9, 0, 0
    while drawn < PERMUTATIONS and (beyond + 1) / (PERMUTATIONS + 1) < ORDER_LEVEL:
        count = max(1, min(AT_ONCE, VALUES // len(b), PERMUTATIONS - drawn))
        mixed = random.permuted(np.broadcast_to(b, (count, len(b))), axis=1)
        beyond += int(np.sum(np.abs(mixed @ a) >= least))
        drawn += count
    return float(test.statistic), (beyond + 1) / (drawn + 1)


def _scores(values: Values) -> Values:
    ranks = rankdata(values) - (len(values) + 1) / 2
    return np.asarray(ranks / np.sqrt(ranks @ ranks))


def _means(values: Values, unit: Codes) -> Values:
    _, number = np.unique(unit, return_inverse=True)
    if not len(values) or number.max() + 1 < FEWEST:
        return values
    return np.asarray(np.bincount(number, values) / np.bincount(number))


def overlapping(training: Training) -> int:
    """Return how many trials began before an earlier one of their mission run had ended, where
    these are more than a negligible part; else 0."""
    if not training.whole:
        return 0
    count, end, before = 0, 0.0, -1
    for trial, mission in zip(training.trials, missions(training), strict=True):
        end, before = (end if mission == before else 0.0), mission
        count += trial.begun < end - EXACT
        end = max(end, trial.begun + (trial.time or 0.0))
    return count if count > NEGLIGIBLE * len(training.trials) else 0


def order_doubts(training: Training) -> list[str]:
    """Return in words whether trials depend on their order: a trend, a dependence of each trial on
    the one before (rank correlations, Holm), or trials at the same time. All forecasts assume that
    trials are independent and alike."""
    if not training.whole:
        return []
    if both := overlapping(training):
        return [
            f"{both} of the training's {len(training.trials)} trials began before an earlier one "
            "had ended: their times contain waits for each other, so they hold for as many runs at "
            "a time, and the stochastic view, which has one, does not show them; without "
            "`runs_place` a trial is the whole mission, which has no such waits"
        ]
    real, found, mission = measured(training), [], missions(training)
    done = ~np.isnan(real.time)
    for name, each, own in (
        ("time", real.time[done], mission[done]),
        ("goal", (real.goals > 0).astype(np.float64), mission),
    ):
        # Trials of one mission run may be alike; that is a design effect, not an order.
        values = _means(each, own)
        if len(values) < 20 or not np.ptp(values):  # `std` of a constant may be 1e-18
            continue
        order = np.arange(len(values), dtype=np.float64)
        tests = [("changes with the order of the trials", order, values)]
        if np.ptp(values[1:]) and np.ptp(values[:-1]):
            tests.append(("depends on the trial before", values[:-1], values[1:]))
        for words, one, other in tests:
            found.append((f"{name} {words}", *_rank_test(one, other)))
    together = holm([p for _, _, p in found])
    return [
        f"the training's {words} (rank correlation {r:+.2f}, p = {p:.1e}), but a forecast assumes "
        "that trials are independent and alike; train again in a steady state"
        for (words, r, _), p in zip(found, together, strict=True)
        if p < ORDER_LEVEL and abs(r) > ORDER
    ]


def rare_doubts(
    training: Training, weights: Values, figures: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Return in words whether mean or quantile of the time rest on a few trials of a rare branch:
    those that entered a place, or whose run left it by a certain transition."""
    time = measured(training).time
    kept = ~np.isnan(time) & (weights > 0)
    if not training.repeats or not kept.any():
        return []
    groups: dict[frozenset[int], str] = {}
    for name, members in _branches(training).items():
        own = frozenset(i for i in members if kept[i])
        if 0 < len(own) < RARE and len(own) < kept.sum():
            groups.setdefault(own, name)  # places come first
    mean, late = float(np.average(time[kept], weights=weights[kept])), figures["q90"]["confidence"]
    found = []
    for own, name in groups.items():
        rest = kept.copy()
        rest[list(own)] = False
        without = float(np.average(time[rest], weights=weights[rest]))
        share = abs(mean - without) / mean if mean > 0.0 else 0.0
        told = f"the mean time ({mean:.4g} s, {without:.4g} s without them)"
        longest = (1.0 + OFF_TIME) * time[rest].max()
        reached = late is not None and min(late[1], time[list(own)].max()) > longest
        on = [told] * (share > OFF_TIME) + ["the 90 % quantile"] * bool(reached)
        if on:
            found.append((share, len(own), name, " and ".join(on)))
    # Branches that follow each other have nearly the same trials: the first says it for all.
    return [
        f"{on} rests on {few} of the training's {kept.sum()} trials, those with {name}: so few do "
        "not tell how often such trials come; train with more"
        for _, few, name, on in sorted(found, reverse=True)[:1]
    ]


def _branches(training: Training) -> dict[str, set[int]]:
    """Return the trials that entered each action place, and then those of each transition that took
    a run."""
    places, taken = dict[str, set[int]](), dict[str, set[int]]()
    for i, trial in enumerate(training.trials):
        for run in trial.runs:
            places.setdefault(f"a run in {run.place}", set()).add(i)
            if run.taken:
                taken.setdefault(run.taken, set()).add(i)
    return places | taken


def event_doubts(training: Training) -> list[str]:
    """Return in words which events the simulated net cannot follow: where no single wait can be
    repeated, it knows the rate of one event for each transition. Where waits were measured, each
    transition has its own, which matters if they share an event; the training trials show how much,
    if they can be compared."""
    flat = training.task.flat
    never = exclusive_places(flat.net, place_semiflows(flat.net))
    place = flat.net.place_index
    cut = {w.transition for trial in training.trials for w in trial.waits if w.end is WaitEnd.CUT}
    seen = {w.transition for trial in training.trials for w in trial.waits}
    out, together = list[str](), dict[str, dict[str, None]]()
    for t in flat.transitions.values():
        remembered = memory_of(flat, t)
        if t.name in cut and remembered is None and len(t.events) > 1:
            out.append(
                f"{t.name} waits for several events, and its waits were interrupted: which of them "
                "had come by then is not known"
            )
        known = training.waits.get(t.name)
        if known is not None and t.events and t.name not in seen:
            out.append(
                f"{t.name}: how long it waits for {' and '.join(t.events)} was not measured; taken "
                "to be no time; run a campaign again, or declare mean_wait"
            )
        by_rate = known is not None and known.came is not None
        if remembered is None or (training.repeats and not by_rate):
            continue
        memory, early = remembered
        for u in flat.transitions.values():
            apart = (early is EarlyEvent.DROP or not by_rate) and any(
                tuple(sorted((place[a.place], place[b.place]))) in never
                for a in t.inputs
                for b in u.inputs
            )
            if (
                u is not t
                and {*t.events} & {*u.events}
                and not apart
                and not (by_rate and _by_rate(training, u))
            ):
                together.setdefault(t.events[0], {}).update({t.name: None, u.name: None})
        if by_rate and memory is EventMemory.LATCHED and reads_variables(flat, t):
            out.append(
                f"{t.name} waits for a latched event and reads variables, which the simulated net "
                "does not know"
            )
    for event, waiting in together.items():
        *some, last = waiting
        out.append(
            f"{', '.join(some)} and {last} wait for one event, {event}, maybe together: the "
            "simulated net lets it come for each of them by itself"
        )
    return out


def _by_rate(training: Training, t: Transition) -> bool:
    """Return whether the simulated net lets one event come for this transition and others."""
    flat, waits = training.task.flat, training.waits.get(t.name)
    alone = memory_of(flat, t) is not None and not is_cause(flat, t)
    return alone and (waits is None or waits.came is not None)


def condition_doubts(training: Training, moves: Iterable[Move]) -> list[str]:
    """Return in words which conditions an estimates file leaves open: it does not contain by which
    transitions runs left their places."""
    if training.whole:
        return []
    flat = training.task.flat
    return [
        f"{m.name}: an estimates file does not tell how often its condition holds, so it is taken "
        "to hold always; give a campaign's folder"
        for m in moves
        if m.allowed is None and reads_variables(flat, flat.transitions[m.name])
    ]


def branch_doubts(training: Training, moves: Iterable[Move], others: Iterable[str]) -> list[str]:
    """Return in words which branches that variables decide may be taken more or less often than in
    the trials: their condition is another one, or runs of `others`, primitive tasks with other
    choices or shares, write what it reads."""
    flat, out = training.task.flat, list[str]()
    ran = training.earlier.task.flat if training.earlier is not None else flat
    places = flat.places.values()
    written = {v for p in places if p.task in set(others) for v in p.out.values()}
    while more := {
        name
        for t in flat.transitions.values()
        for name, value in t.sets
        if name not in written and value.names & written
    }:
        written |= more
    for m in moves:
        when, before = m.transition.when, ran.transitions.get(m.name)
        if when is None or m.allowed is not None or m.known is not None:
            continue
        old = None if before is None else before.when  # what the trials tell is that of this one
        if old is None or not equivalent(old, when, condition_domains(flat)):
            out.append(
                f"{m.name}: the trials had another condition there, so how often this one holds is "
                "not known; train with trials of this form"
            )
        elif m.open_ and (read := sorted(when.names & written)):
            out.append(
                f"{m.name}: its condition reads {', '.join(read)}, which other choices or shares "
                "may change, but it is taken to hold as often as in the trials; train with trials "
                "that choose so"
            )
    return out


def parallel_doubts(training: Training) -> list[str]:
    """Return in words which places may run at the same time, if the training is an estimates file:
    it does not tell whether their runs depend on each other, on which the time of a join rests."""
    if training.whole:
        return []
    net, names = training.task.flat.net, training.vocabulary.places
    never = exclusive_places(net, place_semiflows(net))
    entered = sorted(net.place_index[names[q]] for q in set(training.runs.place.tolist()))
    several = {p for p in entered if training.task.flat.places[net.places[p]].most_active > 1}
    together = [
        (p, q)
        for p, q in combinations_with_replacement(entered, 2)
        if (p, q) not in never and (p != q or p in several)
    ]
    others = len(together) - 1
    more = f" (as {others} more pair{'s' * (others > 1)} of places)" * (others > 0)
    return [
        (f"several runs of {net.places[p]}" if p == q else f"{net.places[p]} and {net.places[q]}")
        + f" may be active at the same time{more}, and an estimates file does not tell whether "
        "they are slow, or fail, together; give a campaign's folder"
        for p, q in together[:1]
    ]


def limit_doubts(training: Training) -> list[str]:
    """Return in words which places end runs of one primitive task after different times, if the
    training is an estimates file, which counts them together."""
    if training.whole:
        return []
    flat = training.task.flat
    return [
        f"{' and '.join(p for p in training.vocabulary.places if flat.places[p].task == primitive)}"
        f" end runs of {primitive} after different times ({', '.join(f'{s:g} s' for s in limits)}),"
        " and an estimates file counts these runs together; give a campaign's folder"
        for primitive in flat.primitive_tasks
        if len(limits := sorted(limits_of(flat, primitive))) > 1
    ]


def doubts(residual: Sequence[Mapping[str, Any]], played: Played, trials: int) -> list[str]:
    """Return in words why a forecast is doubtful; empty if it is not. `trials`: number of trials
    simulated for the forecast.

    Simulated trials must differ by more than chance and by more than what matters: with many
    trials, a significant difference alone means little.
    """
    out = [
        "simulated trials with the training's own choices differ from the measured ones: "
        f"{row['of']}, off by {row['off']:.1%} (p = {row['p_holm']:.1e}); a campaign that chooses "
        "as the new trials will (`campaign --learned`) is forecast without them"
        for row in residual
        if row["p_holm"] < LEVEL
        and row["off"] > (OFF_TIME if row["of"] in (TIME, MEAN) else NEGLIGIBLE)
    ]
    kinds: list[tuple[Mapping[str, int], str]] = [
        (
            played.beyond,
            "in {share} of the simulated trials a run in {name} lasts longer than any measured "
            "one, so its end is a guess; train with runs that are not cut off so early",
        ),
        (
            played.astray,
            "in {share} of the simulated trials {name} comes when the marking does not allow it: "
            "when a run is preempted depends on more than the run",
        ),
        (
            played.guessed,
            "in {share} of the simulated trials nothing tells which fires, {name}: variables "
            "decide, and no training trial came there; train with trials of this form",
        ),
        (
            played.barred,
            "{share} of the simulated trials stop where only {name} could continue, but it starts "
            "a run in a place that no training run entered; train with more trials",
        ),
    ]
    out += [
        text.format(share=f"{n / trials:.1%}", name=name)
        for counted, text in kinds
        for name, n in sorted(counted.items())
        if n > NEGLIGIBLE * trials
    ]
    if played.endless > NEGLIGIBLE * trials:
        out.append(
            f"{played.endless / trials:.1%} of the simulated trials never end; branches that "
            "wait for each other need more training trials, so that contexts can be "
            "distinguished"
        )
    return out
