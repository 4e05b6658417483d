"""What if: measured runs with other durations and shares. How a change is written is in
`petrobot.coordinator.analysis.time.whatif`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

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
from petrobot.coordinator.task import Status


def changed(training: Training, runs: Runs, changes: Sequence[Change]) -> Runs:
    """Return runs in which actions last longer or shorter, or end otherwise more often.

    A run that was cut off is scaled as a successful one is: it would have been active for so long
    at least. What an event or a timer preempted, and what was ended at its deadline, keeps its
    time and its share. Raises NetFileError.
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
    longer = (took > runs.took) & ~runs.censored
    for q in np.unique(runs.place[longer]).tolist():
        limit, at_limit = at_deadline(training, q, runs.of(runs.place == q))
        late = longer & (runs.place == q) & (took > limit)
        took[late], outcome[late] = limit, at_limit
    return replace(runs, took=took, outcome=outcome, seen=replace(runs.seen, took=seen))
