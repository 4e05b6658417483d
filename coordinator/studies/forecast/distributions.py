"""Distributions of runs: empirical competing risks of (outcome, duration), in contexts that
chi-square tests distinguish.

Contexts are grown as in CHAID (G. V. Kass, Applied Statistics 29 (1980) 119-127): the factor on
which the response depends most significantly splits the runs, again and again, until no test
rejects independence. Factors are what ended before in the same trial: for each action place,
outcome, action and duration of the latest run, and the number of runs. A first tree splits by the
outcome. In each of its leaves, each outcome has a second tree that splits by the duration, so a
strong dependence among durations never hides one among outcomes. Within a context, a duration keeps
its linear trend with an earlier one.

Runs that were cut off are censored: the observed ends get the weights of the Aalen-Johansen
estimate. What the estimate leaves beyond the longest run continues at a constant rate (B. W. Brown,
M. Hollander and R. M. Korwar, in Reliability and Biometry, SIAM 1974), and each draw from there is
marked as an extrapolation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.stats import chi2, chi2_contingency

from petrobot.coordinator.studies.campaign.trials import RunEntry
from petrobot.coordinator.studies.forecast.history import (
    CENSORED,
    CUT,
    NONE,
    Codes,
    Runs,
    RunVocabulary,
    Seen,
    Training,
    Values,
    Waits,
    as_arrays,
    ended_within,
)
from petrobot.coordinator.studies.forecast.whatif import at_deadline, changed

ALPHA = 0.01
"""Significance level of a split, over all factors of a node (Bonferroni)."""
LEAST = 30
"""Least number of runs in a context."""
DEEPEST = 6
OWN = 0.7
"""A factor of the runs' own place is preferred to the best factor if the logarithm of its p-value
is at least this share of the best one's."""
SURE = 3.0
"""Standard errors beyond which a trend within a context counts."""
FEW = 5
"""Least number of ends of an outcome whose share may depend on an earlier choice."""
GROUPS = 6
"""Largest number of classes of an earlier duration that split durations; half as many split
outcomes."""


class EndDistribution(Struct, frozen=True):
    """The ends that were observed in one context. Arrays over its members."""

    outcome: Codes
    preempted: np.ndarray
    took: Values
    weight: Values
    trial: Codes
    trend: Trend | None = None
    """Only for durations: their dependence on an earlier duration, within this context."""

    @property
    def beyond(self) -> np.ndarray:
        """Members that stand for what happens after the longest observed run: their own ends are
        unknown."""
        found: np.ndarray = self.outcome == NONE
        return found

    @property
    def rate(self) -> float:
        """Ends per second beyond the longest run; 0 if no end was observed at all."""
        left, longest = float(self.weight[self.beyond].sum()), float(self.took.max(initial=0.0))
        return -math.log(left) / longest if 0.0 < left < 1.0 and longest > 0.0 else 0.0


class Trend(Struct, frozen=True):
    """A duration that changes by `slope` s for each s of the latest run in `place`; `earlier`: that
    earlier duration for each member (s)."""

    place: int
    slope: float
    earlier: Values


class Split(Struct, frozen=True):
    """The factor that separates the contexts below a node."""

    kind: str
    """outcome, action, visits or took."""
    place: int
    edges: tuple[float, ...] = ()
    """For took: upper limits of its classes (s)."""
    missing: bool = False
    """For took: the first child is for trials in which no such run ended."""
    groups: Mapping[int, int] = field(default_factory=dict)
    """For outcome, action and visits: the child of each code; all other codes belong to the last
    child."""
    p_value: float = 1.0

    def child(self, seen: Seen, count: int) -> Codes:
        """Return the child of each column, from what ended before in all places."""
        if self.kind == "took":
            seconds = seen.took[self.place]
            group = np.searchsorted(np.array(self.edges), np.nan_to_num(seconds), side="right")
            return np.where(np.isnan(seconds), 0, group + self.missing)
        codes = codes_of(seen, self.kind)[self.place]
        out = np.full(len(codes), count - 1)
        for code, group in self.groups.items():
            out[codes == code] = group
        return out


def codes_of(seen: Seen, kind: str) -> Codes:
    """Return the codes (q, n) of a factor."""
    return {"outcome": seen.outcome, "action": seen.action, "visits": seen.visits}[kind]


class ContextNode(Struct):
    """A node of the tree: a distribution, and a split with children unless it is a leaf."""

    ends: EndDistribution
    number: int
    split: Split | None = None
    children: list[ContextNode] = field(default_factory=list)
    durations: dict[int, ContextNode] = field(default_factory=dict)
    """In a leaf of an outcome tree: the tree of the durations of each outcome."""
    chosen: Mapping[int, Codes] = field(default_factory=dict)
    """In a leaf of an outcome tree: the action of the latest run that began before in some other
    places, for each member of `ends`."""

    def leaves(self) -> list[ContextNode]:
        """Return the leaves below this node."""
        if self.split is None:
            return [self]
        return [leaf for child in self.children for leaf in child.leaves()]


def siblings(training: Training, place: str) -> list[str]:
    """Return the places whose runs stand for those of a place that no run entered: those with the
    same primitive task."""
    names, task = training.vocabulary.places, training.task
    entered = {names[q] for q in set(training.runs.place.tolist())}
    wanted = task.primitive_task_of(place).name
    return [p for p in names if p in entered and task.primitive_task_of(p).name == wanted]


def lent_runs(training: Training, place: int) -> Runs:
    """Return runs that stand for those of a place that no run entered, as they end by its own
    deadline. Which transition took a run says nothing about another place: what preempted it cut it
    off there."""
    names, task = training.vocabulary, training.task
    name = names.places[place]
    lenders = siblings(training, name)

    def lent(run: RunEntry) -> RunEntry:
        status = "" if run.cancelled else run.status
        own = replace(run, place=name, taken="", status=status, cancelled=False)
        return ended_within(own, task.longest_run(run.place), task.longest_run(name))

    trials = [
        replace(trial, runs=[lent(run) for run in trial.runs if run.place in lenders])
        for trial in training.trials
    ]
    runs = as_arrays(names, trials, training.devices)
    runs = replace(runs, seen=Seen.nothing(len(names.places), len(runs)))
    return changed(training, runs, training.changes)


class RunDistributions:
    """Outcome probabilities and duration distributions of all actions of one regime:
    `contexts[(place code, action code)]`."""

    def __init__(
        self, training: Training, *, unfold: bool = True, chosen: Sequence[int] = ()
    ) -> None:
        """`chosen`: places whose choices may change outcomes elsewhere."""
        self.vocabulary = training.vocabulary
        self.fired = [trial.fired for trial in training.trials]
        self._chosen = chosen
        self.contexts: dict[tuple[int, int], ContextNode] = {}
        self._numbers = 0
        self.deadlines: dict[int, tuple[float, int]] = {}
        """By place code: the longest time of a run there (s), and the outcome of one that is ended
        then."""
        for place in range(len(self.vocabulary.places)):
            own = training.runs.of(training.runs.place == place)
            deepest = DEEPEST if unfold and len(own) else 0
            own = own if len(own) else lent_runs(training, place)
            for action in sorted(set(own.action.tolist())):
                runs = own.of(own.action == action)
                self.contexts[place, action] = self._grow(runs, deepest, outcomes=True)
            if len(own):
                limit, outcome = at_deadline(training, place, own)
                # measured times may be longer: they include waits, for a device for example
                self.deadlines[place] = max(limit, float(own.took.max())), outcome

    @property
    def count(self) -> int:
        """Number of nodes of all trees."""
        return self._numbers

    def _grow(self, runs: Runs, deepest: int, *, outcomes: bool) -> ContextNode:
        ended = with_weights(runs) if outcomes else runs
        context = ContextNode(
            _distribution(ended, trend=not outcomes and bool(deepest)), self._numbers
        )
        self._numbers += 1
        found = best_split(runs, outcomes=outcomes) if deepest and len(runs) >= 2 * LEAST else None
        if found is not None:
            context.split, child = found
            parts = [runs.of(child == c) for c in range(int(child.max()) + 1)]
            context.children = [self._grow(part, deepest - 1, outcomes=outcomes) for part in parts]
        elif outcomes:
            context.chosen = {q: ended.seen.begun[q] for q in self._chosen}
            deepest = DEEPEST if deepest else 0
            for code in np.unique(ended.outcome[ended.outcome != NONE]):
                context.durations[int(code)] = self._grow(
                    ended.of(ended.outcome == code), deepest, outcomes=False
                )
        return context

    def splits(self) -> list[dict[str, Any]]:
        """Describe all splits: place, action, factor, number of contexts, p-value."""
        names, out = self.vocabulary, []
        for (place, action), top in self.contexts.items():
            stack, outcomes = [top], {top.number}
            while stack:
                node = stack.pop()
                if node.number in outcomes:
                    outcomes |= {child.number for child in node.children}
                if node.split is not None:
                    out.append(
                        {
                            "place": names.places[place],
                            "action": names.actions[action - 1],
                            "of": "outcome" if node.number in outcomes else "duration",
                            "by": f"{node.split.kind} of {names.places[node.split.place]}",
                            "contexts": len(node.children),
                            "runs": len(node.ends.took),
                            "p": node.split.p_value,
                        }
                    )
                stack += [*node.children, *node.durations.values()]
        return out


def with_weights(runs: Runs) -> Runs:
    """Return the runs that ended, weighted by the steps of the Aalen-Johansen estimate; the weights
    sum to 1. Each run stands for as many as its weight says.

    The runs that were cut off after the last end stay as members without an outcome (NONE) and
    share the weight that the estimate leaves.
    """
    ordered = runs.of(np.lexsort((runs.censored, runs.took)))
    n, ended = len(runs), ~ordered.censored
    # Kaplan-Meier: an end leaves the share 1 - 1 / (runs still active) of the probability
    active = np.cumsum(ordered.weight[::-1])[::-1]
    share = ordered.weight / np.where(active > 0.0, active, 1.0)
    stays = np.where(ended, 1.0 - share, 1.0)
    left = np.concatenate([[1.0], np.cumprod(stays)])
    last = int(np.flatnonzero(ended)[-1]) + 1 if ended.any() else 0
    beyond = np.arange(n) >= last
    after = float(ordered.weight[last:].sum()) or 1.0
    weight = np.where(beyond, left[last] * ordered.weight / after, -np.diff(left))
    return replace(ordered, weight=weight, outcome=np.where(beyond, NONE, ordered.outcome)).of(
        ended | beyond
    )


def _distribution(runs: Runs, *, trend: bool) -> EndDistribution:
    whole = runs.weight.sum()
    weight = runs.weight / whole if whole else runs.weight
    return EndDistribution(
        runs.outcome, runs.preempted, runs.took, weight, runs.trial, _trend(runs) if trend else None
    )


def _trend(runs: Runs) -> Trend | None:
    """Return the strongest linear dependence on an earlier duration, if it exceeds three standard
    errors."""
    best: Trend | None = None
    strongest, n = SURE, len(runs)
    for place, earlier in enumerate(runs.seen.took):
        if n < LEAST // 2 or np.isnan(earlier).any() or not (np.ptp(earlier) and np.ptp(runs.took)):
            continue
        slope = float(np.cov(earlier, runs.took)[0, 1] / earlier.var(ddof=1))
        left = float(np.var(runs.took - slope * earlier)) * n / (n - 2)
        surety = abs(slope) * float(earlier.std()) * np.sqrt(n / max(left, 1e-18))
        if surety > strongest:
            best, strongest = Trend(place, slope, earlier), float(surety)
    return best


def best_split(runs: Runs, *, outcomes: bool) -> tuple[Split, Codes] | None:
    """Return the most significant split of runs and the child of each run; None if no test rejects
    independence.

    Among factors that explain about as much, one of the runs' own place is preferred. Parallel
    branches advance in step, so in measured trials the visits of one tell as much as the visits of
    the other; in simulated trials the branches drift apart, and only a branch's own visits are
    reliable.
    """
    response = runs.outcome if outcomes else _classes(runs.took)
    groups = GROUPS // 2 if outcomes else GROUPS
    candidates: list[tuple[float, Split, Codes]] = []
    for place in range(len(runs.seen.outcome)):
        for kind in ("outcome", "action", "visits", "took"):
            made = (
                _by_duration(runs, place, groups)
                if kind == "took"
                else _candidate(runs, kind, place)
            )
            if made is not None:
                candidates.append((_log_p(made[1], response), *made))
    if not candidates:
        return None
    best = min(candidates, key=lambda c: c[0])
    place = int(runs.place[0])
    own = min((c for c in candidates if c[1].place == place), key=lambda c: c[0], default=best)
    log_p, split, child = own if own[0] < OWN * best[0] else best
    p = min(1.0, math.exp(log_p) * len(candidates))
    return (replace(split, p_value=p), child) if p < ALPHA else None


def _classes(took: Values) -> Codes:
    """Return durations in four classes of about equal size."""
    return np.searchsorted(np.quantile(took, (0.25, 0.5, 0.75)), took, side="right")


def _candidate(runs: Runs, kind: str, place: int) -> tuple[Split, Codes] | None:
    codes = codes_of(runs.seen, kind)[place]
    found, counts = np.unique(codes, return_counts=True)
    large = [int(c) for c, n in zip(found, counts, strict=True) if n >= LEAST]
    if len(found) - len(large) and len(codes) - counts[counts >= LEAST].sum() < LEAST and large:
        # Too few runs for a class of their own join the largest frequent number of visits: a fourth
        # visit resembles a third one more than a first one. Codes without an order join the
        # smallest of the large classes.
        large.remove(
            max(large) if kind == "visits" else min(large, key=lambda c: int(counts[found == c][0]))
        )
    groups = {code: i for i, code in enumerate(large)}
    rest = bool(len(found) > len(large))
    if len(groups) + rest < 2:
        return None
    split = Split(kind, place, groups=groups)
    return split, split.child(runs.seen, len(groups) + rest)


def _by_duration(runs: Runs, place: int, most: int) -> tuple[Split, Codes] | None:
    seconds = runs.seen.took[place]
    known = ~np.isnan(seconds)
    if known.sum() < 2 * LEAST or 0 < (~known).sum() < LEAST:
        return None
    groups = int(min(most, known.sum() // LEAST))
    edges = np.unique(np.quantile(seconds[known], np.arange(1, groups) / groups))
    missing = not bool(known.all())
    split = Split("took", place, tuple(float(e) for e in edges), missing)
    child = split.child(runs.seen, 0)
    counts = np.bincount(child, minlength=len(edges) + 1 + missing)
    return (split, child) if len(counts) > 1 and counts.min() >= LEAST // 2 else None


def _log_p(child: Codes, response: Codes) -> float:
    """Return the logarithm of the p-value of the chi-square test of independence; 0 if one of the
    codes does not vary."""
    table = crossed(child, response)
    if min(table.shape) < 2:
        return 0.0
    test = chi2_contingency(table)
    return float(chi2.logsf(test.statistic, test.dof))


def crossed(one: Codes, other: Codes) -> np.ndarray:
    """Return the contingency table of two codes, for the codes that occur."""
    _, a = np.unique(one, return_inverse=True)
    _, b = np.unique(other, return_inverse=True)
    table = np.zeros((a.max() + 1, b.max() + 1), np.int64)
    np.add.at(table, (a, b), 1)
    return table


def dependences(training: Training) -> list[dict[str, Any]]:
    """Test by chi-square the statuses of two places within one trial (first runs), the most
    significant pair first."""
    vocabulary, runs = training.vocabulary, training.runs
    status = first_statuses(vocabulary, runs, len(training.trials))
    out = []
    for i, one in enumerate(vocabulary.places):
        for j in range(i + 1, len(vocabulary.places)):
            both = (status[i] >= 0) & (status[j] >= 0)
            table = (
                crossed(status[i][both], status[j][both])
                if both.any()
                else np.zeros((1, 1), np.int64)
            )
            if min(table.shape) < 2:
                continue
            p = float(chi2_contingency(table).pvalue)
            out.append({"places": [one, vocabulary.places[j]], "trials": int(both.sum()), "p": p})
    return sorted(out, key=lambda d: float(d["p"]))


def first_statuses(vocabulary: RunVocabulary, runs: Runs, trials: int) -> Codes:
    """Return the status code of the first run in each place of each trial, (q, trials); CENSORED -
    1 if there is none."""
    out = np.full((len(vocabulary.places), trials), CENSORED - 1)
    status, _ = vocabulary.parts(runs.outcome)
    for i in range(len(runs) - 1, -1, -1):
        out[runs.place[i], runs.trial[i]] = status[i]
    return out


# --- drawing ends of runs and waits ---

Mask = NDArray[np.bool_]
Ratios = Mapping[tuple[int, int, int, int], Mapping[int, Values]]
"""By place, action, earlier place and choice there: what multiplies the share of each outcome, for
each replicate."""


class Ends(Struct, frozen=True):
    """Drawn ends of runs. Arrays (columns,)."""

    outcome: Codes
    preempted: Mask
    took: Values
    """Duration (s); infinite if no run was ever observed to end."""
    beyond: Mask
    """The run lasts longer than any observed one: its end is an extrapolation."""


FEWEST_WAYS = 30
"""Least number of firings from which the way that tokens take depends on how many came before."""
Branches = Mapping[tuple[int, ...], Values]
"""How often each alternative fired (replicates, alternatives), by (the one that fired before, or
-1; its number in the trial, from 0), by the first of these alone, and by ()."""


class Drawer:
    """Draws ends of runs and waits, for many replicates at once, each with its own bootstrap
    weights of the trials.

    `weights` (replicates, trials): how often each training trial counts in each replicate.
    """

    def __init__(
        self,
        runs: RunDistributions,
        waits: Mapping[str, Waits],
        weights: Values,
        random: np.random.Generator,
    ) -> None:
        self._runs, self._waits, self._weights, self._random = runs, waits, weights, random
        self._bounds: dict[object, Values] = {}
        self._ratios: dict[tuple[int, int, int, int], Mapping[int, Values]] = {}

    def ends(self, place: int, action: Codes, replicate: Codes, seen: Seen) -> Ends:
        """Draw the ends of runs that begin now in a place, given what ended before.

        Raises KeyError for an action that was never run there.
        """
        n = len(action)
        out = Ends(np.zeros(n, np.int64), np.zeros(n, np.bool_), np.zeros(n), np.zeros(n, np.bool_))
        for code in np.unique(action):
            top, own = self._runs.contexts[place, int(code)], np.flatnonzero(action == code)
            for columns, ratios in self._by_choice(place, int(code), top, own, seen):
                self._descend(top, columns, replicate, seen, out, ratios)
        if out.beyond.any():  # the extrapolation knows no deadline
            longest, outcome = self._runs.deadlines[place]
            late = out.beyond & np.isfinite(out.took) & (out.took > longest)
            out.took[late], out.outcome[late], out.preempted[late] = longest, outcome, False
        return out

    def _by_choice(
        self, place: int, action: int, top: ContextNode, columns: Codes, seen: Seen
    ) -> Iterator[tuple[Codes, Ratios]]:
        """Yield columns with the same choices in the earlier places that may change outcomes, and
        by how much each multiplies them."""
        earlier = [q for q in top.leaves()[0].chosen if q != place]
        if not earlier:
            yield columns, {}
            return
        now = seen.begun[np.array(earlier)][:, columns]
        choices, kind = np.unique(now, axis=1, return_inverse=True)
        for i, choice in enumerate(choices.T.tolist()):
            keys = [(place, action, *pair) for pair in zip(earlier, choice, strict=True)]
            for key in keys:
                if key not in self._ratios:
                    self._ratios[key] = self._ratios_of(top, *key[2:])
            yield columns[kind.ravel() == i], {key: self._ratios[key] for key in keys}

    def _ratios_of(self, top: ContextNode, earlier: int, choice: int) -> Mapping[int, Values]:
        """Return by how much an earlier choice multiplies the share of each outcome, beside what
        the contexts tell, for each replicate.

        It is the ratio of observed and expected ends, shrunk towards 1 as James and Stein do
        (1961): the contexts split only where a test is sure, and several choices at once would
        otherwise be forecast as if none of them mattered.
        """
        even = np.ones((1, self._weights.shape[1]))
        leaves = [(leaf.ends, leaf.chosen[earlier]) for leaf in top.leaves()]
        codes, counts = np.unique(
            np.concatenate([ends.outcome[~ends.beyond] for ends, _ in leaves]), return_counts=True
        )
        actions = np.unique(np.concatenate([chosen for _, chosen in leaves])).tolist()
        out = {}
        for code in codes[counts >= FEW].tolist():
            square = 0.0
            for action in actions:
                seen, due, n = (v[0] for v in _ends_and_expected(leaves, even, action, code))
                square += float((seen - due) ** 2 / max(due * (1.0 - due / max(n, 1.0)), 1e-9))
            # of m choices m - 1 are free, and Stein's estimate of m - 1 means takes m - 3
            surely = max(0.0, 1.0 - max(0, len(actions) - 3) / max(square, 1e-9))
            seen, due, _ = _ends_and_expected(leaves, self._weights, choice, code)
            out[code] = 1.0 + surely * (seen / np.where(due > 0.0, due, seen + 1e-9) - 1.0)
        return out

    def _descend(
        self,
        node: ContextNode,
        columns: Codes,
        replicate: Codes,
        seen: Seen,
        out: Ends,
        ratios: Ratios,
    ) -> None:
        if node.split is None:
            self._draw_leaf(node, columns, replicate, seen, out, ratios)
            return
        child = node.split.child(seen.of(columns), len(node.children))
        for c, below in enumerate(node.children):
            own = columns[child == c]
            if len(own):
                self._descend(below, own, replicate, seen, out, ratios)

    def _draw_leaf(
        self,
        leaf: ContextNode,
        columns: Codes,
        replicate: Codes,
        seen: Seen,
        out: Ends,
        ratios: Ratios,
    ) -> None:
        """Draw first the outcome, then the duration from the tree of that outcome."""
        ends = leaf.ends
        by_outcome = ratios if leaf.durations else {}  # a tree of durations has one outcome
        key = (leaf.number, *by_outcome)
        index = self._draw(
            key, ends.weight, ends.trial, replicate[columns], ends.outcome, by_outcome
        )
        if not leaf.durations and not ends.beyond.any():
            out.took[columns] = ends.took[index] + _along(ends, index, seen.took[:, columns])
            np.clip(out.took, 0.0, None, out=out.took)
            return
        out.outcome[columns], out.preempted[columns] = ends.outcome[index], ends.preempted[index]
        beyond = ends.beyond[index]
        if beyond.any():
            self._draw_beyond(leaf, columns[beyond], replicate, out)
        for code, tree in leaf.durations.items():
            own = columns[ends.outcome[index] == code]
            if len(own):
                self._descend(tree, own, replicate, seen, out, ratios)

    def _draw_beyond(self, leaf: ContextNode, columns: Codes, replicate: Codes, out: Ends) -> None:
        """Draw an end later than the longest run: at a constant rate, with outcomes in the observed
        shares."""
        ends, seen = leaf.ends, np.flatnonzero(~leaf.ends.beyond)
        out.beyond[columns] = True
        if not ends.rate or not len(seen):
            out.outcome[columns], out.preempted[columns], out.took[columns] = CUT, False, np.inf
            return
        index = seen[
            self._draw(
                (leaf.number, "beyond"), ends.weight[seen], ends.trial[seen], replicate[columns]
            )
        ]
        out.outcome[columns], out.preempted[columns] = ends.outcome[index], ends.preempted[index]
        out.took[columns] = (
            ends.took.max() - np.log1p(-self._random.random(len(columns))) / ends.rate
        )

    def wait(self, transitions: Sequence[str], replicate: Codes) -> Values | None:
        """Draw the wait of a transition (s) for each column, or of several for one event of which
        the rate is known; None if it was never measured."""
        known = [self._waits[name] for name in transitions if name in self._waits]
        if not known:
            return None
        transition, (seconds, trials, came) = transitions[0], known[0]
        if came is not None:
            mean = self._mean_waits(tuple(transitions), known)[replicate]
            return -mean * np.log1p(-self.chance(len(replicate)))
        index = self._draw(transition, np.full(len(seconds), 1.0 / len(seconds)), trials, replicate)
        drawn: Values = seconds[index]
        return drawn

    def measured(self, transition: str) -> bool:
        """Return whether waits of the transition were measured."""
        return transition in self._waits

    def as_measured(self, transition: str) -> bool:
        """Return whether waits of the transition are drawn as they were measured: since it could
        fire, not since its event could come."""
        return transition in self._waits and self._waits[transition].came is None

    def _mean_waits(self, key: tuple[str, ...], known: Sequence[Waits]) -> Values:
        """Return the exposure over the occurrences by replicate; over all trials if the event never
        came in those of the replicate."""
        if key not in self._bounds:
            seconds = np.concatenate([waits.seconds for waits in known])
            trials = np.concatenate([waits.trial for waits in known])
            came = np.concatenate([waits.came for waits in known if waits.came is not None])
            each = self._weights[:, trials]
            often = each @ came
            mean = each @ seconds / np.where(often > 0, often, 1.0)
            self._bounds[key] = np.where(often > 0, mean, seconds.sum() / came.sum())
        return self._bounds[key]

    def _draw(
        self,
        key: object,
        weight: Values,
        trials: Codes,
        replicate: Codes,
        outcome: Codes | None = None,
        ratios: Ratios | None = None,
    ) -> Codes:
        """Draw a member for each column by the weights of its replicate; by the plain weights if
        the replicate leaves none. `ratios` multiply the weights of outcomes."""
        bounds = self._bounds.get(key)
        if bounds is None:
            each = weight * self._weights[:, trials]
            for by_outcome in (ratios or {}).values():
                for code, ratio in by_outcome.items():
                    each[:, outcome == code] *= ratio[:, None]
            each = np.where(each.sum(axis=1, keepdims=True) > 0, each, weight)
            bounds = np.cumsum(each, axis=1)
            # Row b of cumulated weights is shifted to (b, b + 1], so that one searchsorted over all
            # rows draws for all replicates at once.
            bounds = bounds / bounds[:, -1:] + np.arange(len(bounds))[:, None]
            self._bounds[key] = bounds
        members = bounds.shape[1]
        at = np.searchsorted(
            bounds.ravel(), replicate + self._random.random(len(replicate)), side="right"
        )
        index: Codes = np.clip(at - replicate * members, 0, members - 1)
        return index

    def branches(self, members: Sequence[str]) -> Branches:
        """Return what the trials tell of the way that tokens take where several transitions are
        alternatives."""
        found = dict[tuple[int, ...], list[tuple[int, int]]]()
        number = {name: i for i, name in enumerate(members)}
        for trial, fired in enumerate(self._runs.fired):
            # `fired` has the order of the first firings; repeated ones are taken to come together
            ways = [number[t] for t, n in fired.items() if t in number for _ in range(n)]
            for k, way in enumerate(ways):
                before = ways[k - 1] if k else -1
                for context in ((), (before,), (before, k)):
                    found.setdefault(context, []).append((trial, way))
        return {
            context: self._shares(np.array(told).T, len(members))
            for context, told in found.items()
            if len(context) < 2 or len(told) >= FEWEST_WAYS
        }

    def _shares(self, told: Codes, members: int) -> Values:
        """Return the share of each member by replicate, from (trials, ways) of its firings."""
        trials, ways = told
        each = self._weights[:, trials]
        each = np.where(each.sum(axis=1, keepdims=True) > 0, each, 1.0)
        return np.stack([each[:, ways == i].sum(axis=1) for i in range(members)], axis=1)

    def chance(self, n: int) -> Values:
        """Return uniform numbers."""
        return self._random.random(n)


def _ends_and_expected(
    leaves: Sequence[tuple[EndDistribution, Codes]], weights: Values, choice: int, outcome: int
) -> tuple[Values, Values, Values]:
    """Return how many runs after a choice ended with an outcome, how many would have if the choice
    did not matter in their contexts, and how many there are, by replicate."""
    seen = due = runs = np.zeros(len(weights))
    for ends, chosen in leaves:
        each = weights[:, ends.trial] * ~ends.beyond
        whole, so = each.sum(axis=1), ends.outcome == outcome
        own = each[:, chosen == choice].sum(axis=1)
        seen = seen + each[:, so & (chosen == choice)].sum(axis=1)
        due = due + own * each[:, so].sum(axis=1) / np.where(whole > 0, whole, 1.0)
        runs = runs + own
    return seen, due, runs


def _along(ends: EndDistribution, index: Codes, took: Values) -> Values:
    """Return what the trend adds to drawn durations, for columns whose earlier run had another
    duration than the member's."""
    if ends.trend is None:
        return np.zeros(len(index))
    now = took[ends.trend.place]
    return ends.trend.slope * np.where(np.isnan(now), 0.0, now - ends.trend.earlier[index])
