"""What if: measured runs with other durations and shares. How a change is written is in
`petrobot.coordinator.analysis.time.whatif`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.coordinator.analysis.time.measured import is_cause
from petrobot.coordinator.analysis.time.whatif import Change, in_range, statuses_of
from petrobot.coordinator.studies.forecast.history import (
    CENSORED,
    CUT,
    STATUSES,
    Codes,
    Runs,
    Training,
    Values,
)
from petrobot.coordinator.task import Counts, Status

FEWEST = 30
"""The fewest active runs from which it is taken when an event comes."""


def changed(training: Training, runs: Runs, changes: Sequence[Change]) -> Runs:
    """Return runs in which actions last longer or shorter, or end otherwise more often.

    A run that was cut off is scaled as a successful one is: it would have been active for so long
    at least. What ends a run at its deadline, or an event or timer that preempts it, keeps its
    time: longer runs are ended by it more often. Raises NetFileError.
    """
    task, names = training.task, training.vocabulary
    scale: dict[tuple[int, int, int], float] = {}
    shares: dict[tuple[int, int], dict[Status, Change]] = {}
    for change in changes:
        if len(change.subject) == 1:
            raise change.fault("a trial is forecast for one run token", "change the task file")
        if change.subject[-1] == "cv":
            raise change.fault("a forecast takes durations as measured", "change a mean or a share")
        primitive, actions, statuses = statuses_of(task, change)
        cells = [
            (q, names.actions.index(action) + 1)
            for q, place in enumerate(names.places)
            if task.primitive_task_of(place).name == primitive.name
            for action in actions
        ]
        if runs is training.runs and not any(_of(runs, *cell).any() for cell in cells):
            raise change.fault("no such run was measured", "train with trials that get there")
        for q, action in cells:
            if change.subject[-1] == "share":
                shares.setdefault((q, action), {})[statuses[0]] = change
            for status in statuses if change.subject[-1] == "mean" else ():
                key = q, action, STATUSES.index(status)
                own = runs.took[_ends_so(training, runs, *key)]
                if len(own):
                    mean = float(own.mean()) * scale.get(key, 1.0)
                    scale[key] = scale.get(key, 1.0) * in_range(change, mean) / mean
    weight = runs.weight.copy()
    for (q, action), wanted in shares.items():
        _weigh(training, runs, q, action, wanted, weight)
    return replace(_scaled(training, runs, scale), weight=weight)


def _of(runs: Runs, place: int, action: int) -> NDArray[np.bool_]:
    found: NDArray[np.bool_] = (runs.place == place) & (runs.action == action)
    return found


def _statuses(training: Training, runs: Runs) -> Codes:
    """Return the status code of each run; CENSORED for those that were cut off."""
    status, _ = training.vocabulary.parts(runs.outcome)
    return np.where(runs.censored, CENSORED, status)


def _ends_so(
    training: Training, runs: Runs, place: int, action: int, status: int
) -> NDArray[np.bool_]:
    """Return which runs of an action in a place ended by themselves with a status, in time."""
    own = _of(runs, place, action)
    own &= ~runs.preempted & (_statuses(training, runs) == status)
    if STATUSES[status] is Status.ERROR:
        own &= runs.took < at_deadline(training, place, runs.of(own))[0]
    return own


def at_deadline(training: Training, place: int, runs: Runs) -> tuple[float, int]:
    """Return after how long a run in a place is ended at the latest (s), and its outcome then: the
    usual one of those of its runs that ended with ERROR."""
    names, error = training.vocabulary, STATUSES.index(Status.ERROR)
    ended = runs.outcome[(runs.outcome > CUT) & (names.parts(runs.outcome)[0] == error)]
    outcome = int(np.bincount(ended).argmax()) if len(ended) else names.outcome(error, -1)
    return training.task.longest_run(names.places[place]), outcome


def _weigh(
    training: Training,
    runs: Runs,
    place: int,
    action: int,
    wanted: Mapping[Status, Change],
    weight: Values,
) -> None:
    """Give the runs of an action in a place weights with which statuses have their wanted shares of
    all runs that began. Raises NetFileError."""
    began = _of(runs, place, action)
    if not began.any():
        return
    rest, left = began.copy(), 1.0
    for status, change in wanted.items():
        code = STATUSES.index(status)
        own = _ends_so(training, runs, place, action, code)
        share = in_range(change, old := own.sum() / began.sum())
        if share and not old:
            name = training.vocabulary.places[place]
            raise change.fault(f"no run in {name} ended so: nothing is known of its duration")
        weight[own] = share / old if old else 1.0
        rest &= ~own
        left -= share
        if status is Status.ERROR:
            late = rest & (_statuses(training, runs) == code)
            rest &= ~late
            left -= late.sum() / began.sum()
    if left < -1e-9 or (left > 1e-9 and not rest.any()):
        raise change.fault("the shares of an action do not add up to 1")
    weight[rest] = max(0.0, left) * began.sum() / max(1, rest.sum())


def _scaled(training: Training, runs: Runs, scale: Mapping[tuple[int, int, int], float]) -> Runs:
    """Return the runs with scaled durations, also where others were begun after them: what depends
    on how long a run took, depends on how it compares with the others."""
    names = training.vocabulary
    took, seen, outcome = runs.took.copy(), runs.seen.took.copy(), runs.outcome.copy()
    earlier, _ = names.parts(runs.seen.outcome)
    for (q, action, code), factor in scale.items():
        own = _ends_so(training, runs, q, action, code)
        before = (runs.seen.action[q] == action) & (earlier[q] == code)
        if STATUSES[code] is Status.SUCCESS:
            own |= _of(runs, q, action) & runs.censored
            before |= (runs.seen.action[q] == action) & (earlier[q] == CENSORED)
        if STATUSES[code] is Status.ERROR:
            before &= seen[q] < at_deadline(training, q, runs.of(own))[0]
        took[own] *= factor
        seen[q, before] *= factor
    preempted, censored = runs.preempted.copy(), runs.censored.copy()
    for q, action in {(q, action): None for q, action, _ in scale}:
        cell = np.flatnonzero(_of(runs, q, action))
        ends, times, by = _raced(runs.of(cell), took[cell])
        took[cell], outcome[cell] = times, runs.outcome[cell][ends]
        preempted[cell] = by
        censored[cell] &= ~by
        for limit, at_limit in _timers(training, q):
            late = cell[took[cell] > np.maximum(runs.took[cell], limit)]
            took[late], outcome[late], preempted[late] = limit, at_limit, True
            censored[late] = False
    longer = (took > runs.took) & ~censored & ~preempted
    for q in np.unique(runs.place[longer]).tolist():
        limit, at_limit = at_deadline(training, q, runs.of(runs.place == q))
        late = longer & (runs.place == q) & (took > limit)
        took[late], outcome[late] = limit, at_limit
    ended = replace(runs, took=took, outcome=outcome, preempted=preempted, censored=censored)
    return replace(ended, seen=replace(runs.seen, took=seen))


def _timers(training: Training, place: int) -> list[tuple[float, int]]:
    """Return the timers that preempt the runs of a place: after how long (s), and the outcome."""
    names, flat = training.vocabulary, training.task.flat
    found = []
    for t in flat.transitions.values():
        (arc,) = [a for a in t.inputs if a.place == names.places[place]] or (None,)
        if arc is not None and arc.counts is not None and t.after is not None and is_cause(flat, t):
            none = arc.counts is Counts.NONE
            status = CENSORED if none else STATUSES.index(Status(arc.counts.value))
            found.append((t.after, names.outcome(status, names.transitions.index(t.name))))
    return sorted(found)


def _raced(runs: Runs, took: Values) -> tuple[Codes, Values, NDArray[np.bool_]]:
    """Return how the runs of an action in a place end that take `took`, while the events and timers
    that preempt them come as before: each as another of these runs (its index), when, and whether
    preempted.

    A run shows only which of the two came first. The other is drawn from those that came later
    elsewhere, as if they were independent (Kaplan-Meier), always with the same random numbers.
    """
    n = len(runs)
    by = runs.preempted & ~runs.censored
    ends, times, preempted = np.arange(n), took.copy(), by.copy()
    if not by.any() or by.all():
        return ends, times, preempted
    draws = np.random.default_rng(0).random((2, n))
    event = _Later(runs, by, FEWEST)
    own = _Later(runs, ~by & ~runs.censored)
    for i in range(n):
        if by[i]:
            j, least = own.after(runs.took[i], draws[0, i])
            new = least * took[j] / runs.took[j] if runs.took[j] else took[j]
            earlier = new < runs.took[i]
        else:
            j, new = event.after(runs.took[i], draws[1, i])
            earlier = new < took[i]
        if earlier:
            ends[i], times[i], preempted[i] = j, new, by[j]
    return ends, times, preempted


class _Later:
    """When runs that are still active after some time end in one of several ways.

    Beyond the last end so, or where fewer than `least` runs are active, the tail is exponential.
    """

    def __init__(self, runs: Runs, which: NDArray[np.bool_], least: int = 1) -> None:
        order = np.lexsort((~which, runs.took))
        weight, ended = runs.weight[order], which[order]
        active = np.cumsum(weight[::-1])[::-1]
        stays = np.where(ended & (active > 0.0), 1.0 - weight / np.maximum(active, 1e-300), 1.0)
        known = ended & (np.arange(len(runs), 0, -1) >= least)
        self.runs, self.times = order[known], runs.took[order][known]
        self.left = np.cumprod(stays)[known]
        self.donor = int(order[ended][-1]) if ended.any() else 0
        lasted = float(runs.weight @ runs.took)
        self.rate = float(weight @ ended) / lasted if lasted else 0.0

    def after(self, time: float, draw: float) -> tuple[int, float]:
        """Return the run that ends so, and when; infinity if none does."""
        first = int(np.searchsorted(self.times, time, side="right"))
        now = float(self.left[first - 1]) if first else 1.0
        at = first + int(np.searchsorted(-self.left[first:], -draw * now, side="left"))
        if at < len(self.times):
            return int(self.runs[at]), float(self.times[at])
        known = float(self.left[-1]) / now if len(self.left) and now else 1.0
        since = max(time, float(self.times[-1])) if len(self.times) else time
        wait = -np.log(draw / known) / self.rate if self.rate and 0.0 < draw < known else np.inf
        return self.donor, since + wait
