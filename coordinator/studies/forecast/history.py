"""Runs of a campaign as arrays: what each yielded, how long it took, and what ended before it in
its trial."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, Final, NamedTuple

import numpy as np
from msgspec import Struct, field
from msgspec.structs import asdict, replace
from numpy.typing import NDArray

from petrobot.coordinator.analysis.may_run import Cell, devices_of
from petrobot.coordinator.analysis.net.ordinary import contended
from petrobot.coordinator.analysis.time.measured import LATE, is_cause
from petrobot.coordinator.analysis.time.whatif import Change
from petrobot.coordinator.learning.estimate import CENSORED as CENSORED_CAUSE, Tally
from petrobot.coordinator.learning.estimates_file import (
    EstimatesError,
    EstimatesFile,
    FileContents,
    said,
)
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.records import Waited, WaitEnd
from petrobot.coordinator.learning.waits import memory_of
from petrobot.coordinator.studies.campaign.observed import context_of, regime_of
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.task import EarlyEvent, End, EventMemory, Kind, Status, Task, Transition
from petrobot.coordinator.task.conditions import Domain, Expression, equivalent
from petrobot.coordinator.task.validation import condition_domains, marking_domains
from petrobot.services.host.toml_text import InputError

Codes = NDArray[np.int64]
Values = NDArray[np.float64]

CENSORED = -1
"""Status code of a run that was preempted and counts none."""
NONE = 0
"""Outcome and action code of a place where no run has ended in this trial yet."""
CUT = 1
"""Outcome code of a run whose end is unknown: no status, and no transition took its token."""
STATUSES: Final[tuple[Status, ...]] = tuple(Status)


class ForecastError(InputError):
    """A forecast file cannot be made or used; the text says why."""


class RunVocabulary(Struct, frozen=True):
    """Numeric codes of the action places, transitions and actions of a flat task."""

    places: tuple[str, ...]
    transitions: tuple[str, ...]
    actions: tuple[str, ...]
    open: frozenset[str] = frozenset()
    """Places where an event, a timer or a variable decides how an ended run continues. Only there,
    the transition that took the run is part of its outcome; elsewhere it follows from the statuses
    and from what else ended."""
    cutting: frozenset[str] = frozenset()
    """Transitions that preempt as soon as the marking allows it. They cut runs off, so the runs'
    own ends are unknown."""

    @classmethod
    def of(cls, task: Task) -> RunVocabulary:
        """Return the codes of a task."""
        flat = task.flat
        taking = [
            t
            for t in flat.transitions.values()
            if t.events or t.after is not None or reads_variables(flat, t)
        ]
        cutting = [
            t.name
            for t in flat.transitions.values()
            if any(a.end is End.PREEMPT for a in t.inputs) and not is_cause(flat, t)
        ]
        actions = dict.fromkeys(a for p in flat.primitive_tasks.values() for a in p.alternatives)
        places = tuple(p.name for p in flat.places.values() if p.kind is Kind.ACTION)
        undecided = frozenset(
            a.place for t in taking for a in t.inputs if a.end in (End.NORMAL, End.ERROR)
        )
        return cls(places, tuple(flat.transitions), tuple(actions), undecided, frozenset(cutting))

    def outcome(self, status: int, taken: int) -> int:
        """Return one code, above 0, for a status code and the transition that took the token (-1:
        none)."""
        return CUT + (status + 1) * (len(self.transitions) + 1) + taken + 1

    def parts(self, outcome: Codes) -> tuple[Codes, Codes]:
        """Return the status codes and transitions of outcome codes above 0."""
        status, taken = np.divmod(outcome - CUT, len(self.transitions) + 1)
        return status - 1, taken - 1


class Seen(Struct, frozen=True):
    """What ended before in the same trial. Arrays (q places, n columns)."""

    outcome: Codes
    """Outcome of the latest run in each place; NONE if there is none."""
    action: Codes
    took: Values
    """Its duration (s); nan if there is none."""
    visits: Codes
    """Number of runs that ended there."""
    begun: Codes
    """Action of the latest run that began there; it may still be active."""

    @classmethod
    def nothing(cls, q: int, n: int) -> Seen:
        """Return the state in which nothing has ended yet."""
        return cls(
            np.zeros((q, n), np.int64),
            np.zeros((q, n), np.int64),
            np.full((q, n), np.nan),
            np.zeros((q, n), np.int64),
            np.zeros((q, n), np.int64),
        )

    def of(self, which: NDArray[np.bool_] | Codes) -> Seen:
        """Select columns."""
        parts = self.outcome[:, which], self.action[:, which]
        return Seen(*parts, self.took[:, which], self.visits[:, which], self.begun[:, which])

    def note(
        self,
        q: Codes | int,
        columns: Codes | int,
        outcome: Codes | int,
        action: Codes | int,
        took: Values | float,
    ) -> None:
        """Record that runs ended in a place."""
        self.outcome[q, columns] = outcome
        self.action[q, columns] = action
        self.took[q, columns] = took
        self.visits[q, columns] += 1


class Runs(Struct, frozen=True):
    """All runs of some trials: `n` runs, `q` action places."""

    place: Codes
    action: Codes
    """Code of the action, above 0."""
    outcome: Codes
    preempted: NDArray[np.bool_]
    """A transition took its token while it was active."""
    censored: NDArray[np.bool_]
    """Whether it was cut off, so only its least duration is known."""
    took: Values
    """Seconds from the arrival of its token to its end; without what it waited for a device that
    the simulated net lets it wait for."""
    trial: Codes
    """Index of its trial."""
    weight: Values
    """How many runs it stands for: 1, unless shares were changed."""
    seen: Seen

    def of(self, which: NDArray[np.bool_] | Codes) -> Runs:
        """Select runs."""
        columns = asdict(self)
        seen: Seen = columns.pop("seen")
        return Runs(**{name: own[which] for name, own in columns.items()}, seen=seen.of(which))

    def __len__(self) -> int:
        return len(self.place)


class Waits(NamedTuple):
    """The measured waits of a transition for its event or timer."""

    seconds: Values
    trial: Codes
    """Index of the trial of each."""
    came: Values | None = None
    """1 for each wait that its event ended, 0 for the others: the waits are exponential with the
    rate that follows. None: all ended with a firing, and are drawn as they were measured."""


class Training(Struct, frozen=True):
    """The measured trials of a regime."""

    task: Task
    vocabulary: RunVocabulary
    trials: tuple[Trial, ...]
    runs: Runs
    waits: dict[str, Waits]
    """By waiting transition."""
    whole: bool = True
    """True if the trials are those that were run. Otherwise each holds a single run or wait, and
    the result of a whole trial is unknown."""
    devices: Mapping[str, str] = field(default_factory=dict)
    """By action: the device for which its runs may have to wait, because other runs use it."""
    periods: Mapping[str, float] = field(default_factory=dict)
    """By event: the period of the timer that raises it (s)."""
    same: bool = True
    """False if the trials are of an earlier form of the task: they tell of its runs, but not what
    whole trials come to."""
    earlier: Training | None = None
    """The same trials as those of the form that was run, if it is known: they test how well its
    simulated net repeats them."""
    changes: Sequence[Change] = ()
    """Other durations and shares than the trials have; `runs` has them already."""

    @property
    def repeats(self) -> bool:
        """Whether further trials will be as these, apart from other choices."""
        return self.whole and self.same

    @classmethod
    def of(
        cls,
        task: Task,
        trials: Iterable[Trial],
        *,
        whole: bool = True,
        cell: Cell | None = None,
        same: bool = True,
    ) -> Training:
        """Prepare trials. `cell`: the devices for which runs may wait, and the timers. Raises
        ValueError if there are no trials."""
        devices = devices_of(cell) or {}
        kept, vocabulary = tuple(trials), RunVocabulary.of(task)
        if not kept:
            raise ValueError("expected at least one trial to learn from, got none")
        shared = contended(task, devices)
        waiting = {a: device for a, device in devices.items() if device in shared}
        if any(run.waited is None and run.action in waiting for t in kept for run in t.runs):
            waiting = {}  # an older table: the waits are in the durations
        waits: dict[str, list[tuple[Waited, int]]] = {}
        timers = _cutting_timers(task)
        for i, trial in enumerate(kept):
            for wait in (*trial.waits, *(Waited(t, s) for t in timers for s in _waited(t, trial))):
                waits.setdefault(wait.transition, []).append((wait, i))
        for name in _unmeasured(task, waits):
            # Older tables do not have these waits; `event_doubts` names them.
            own = [i for i, trial in enumerate(kept) if any(r.taken == name for r in trial.runs)]
            waits |= {name: [(Waited(name, 0.0, WaitEnd.FIRED), i) for i in own]} if own else {}
        found = {name: _waits(task, name, known) for name, known in waits.items()}
        return cls(
            task,
            vocabulary,
            kept,
            as_arrays(vocabulary, kept, waiting),
            {name: known for name, known in found.items() if known is not None},
            whole,
            waiting,
            cell.periods if cell else {},
            same,
        )


def _unmeasured(task: Task, measured: Iterable[str]) -> list[str]:
    """Return the transitions that preempt when their event and tokens are there, whose waits are
    neither among the measured ones nor declared."""
    flat = task.flat
    return [
        t.name
        for t in flat.transitions.values()
        if t.name not in measured
        and any(flat.events[e].mean_wait is None for e in t.events)
        and any(a.end is End.PREEMPT for a in t.inputs)
        and not is_cause(flat, t)
    ]


def _waits(task: Task, transition: str, known: Sequence[tuple[Waited, int]]) -> Waits | None:
    """Return the waits of a transition; None if its event never came.

    Where a wait was cut, or the event may come before the transition can fire, no single wait can
    be repeated as it was: only the rate of the event is known.
    """
    t = task.flat.transitions.get(transition)
    remembered = None if t is None else memory_of(task.flat, t)
    early = (t is not None and remembered is not None) and (
        remembered[1] is EarlyEvent.KEEP
        or (remembered[0] is EventMemory.LATCHED and any(a.end is not None for a in t.inputs))
    )
    ends = {wait.end for wait, _ in known}
    by_rate = WaitEnd.LATEST not in ends and (early or not ends <= {WaitEnd.FIRED})
    used = [(wait, i) for wait, i in known if by_rate or wait.fired]
    came = np.array([wait.fired or _sets_flag(remembered, wait) for wait, _ in used], np.float64)
    if not came.any():
        return None
    return Waits(
        np.array([wait.seconds for wait, _ in used]),
        np.array([i for _, i in used]),
        came if by_rate else None,
    )


def _sets_flag(remembered: tuple[EventMemory, EarlyEvent] | None, wait: Waited) -> bool:
    """Return whether the event came and waits for the transition."""
    latched = remembered is not None and remembered[0] is EventMemory.LATCHED
    return latched and wait.end is WaitEnd.CAME


def by_regime(
    task: Task, rows: Iterable[TrialRow], cell: Cell | None = None, same: bool = True
) -> dict[str, Training]:
    """Return the training of each regime of a table. `cell`: where the task will run; `same`:
    whether the trials are of the task as it is."""
    trials: dict[str, list[Trial]] = {}
    for row in rows:
        if row.trial is not None:
            trials.setdefault(row.regime, []).append(row.trial)
    return {
        regime: Training.of(task, kept, cell=cell, same=same) for regime, kept in trials.items()
    }


_WORDS = frozenset({
    "goal", "text", "specification", "error_causes", "pictures",  # for people
    "label", "x", "y", "macro", "expanded_from", "error_branch",  # for drawings
    "estimates", "mean_wait", "cost", "costs", "target_reliability",  # no run depends on them
    "holds", "subnets", "errors_to",  # arcs of the flat task say the same
    "held", "expansion", "is_flat",  # how the task was written
})  # fmt: skip
"""Fields of a task's elements that no trial depends on."""
_IN_ANY_ORDER = frozenset({"inputs", "outputs", "inhibitors", "goal_transitions", "sets"})


def same_form(ran: Task, now: Task) -> bool:
    """Return whether trials of one task are trials of the other: their flat nets are equal, with
    names, the order of places and transitions, services and parameters. Words, the drawing,
    declared guesses, the order of arcs, and how a condition is written make no difference."""
    before, after = _without_macros(ran.flat), _without_macros(now.flat)
    marking, values = marking_domains(after), condition_domains(after)
    return (
        list(before.places) == list(after.places)
        and list(before.transitions) == list(after.transitions)
        and _alike(before, after, {**marking, **values})
    )


def _without_macros(flat: Task) -> Task:
    return replace(flat, places={n: p for n, p in flat.places.items() if p.kind is not Kind.MACRO})


def _alike(one: Any, other: Any, domains: Mapping[str, Domain]) -> bool:
    if isinstance(one, Expression) and isinstance(other, Expression):
        return equivalent(one, other, domains)
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_alike(one[k], other[k], domains) for k in one)
    if not isinstance(one, Struct) or type(one) is not type(other):
        return bool(one == other)
    pairs = {
        name: (getattr(one, name), getattr(other, name))
        for name in one.__struct_fields__
        if name not in _WORDS
    }
    return all(
        Counter(a) == Counter(b) if name in _IN_ANY_ORDER else _alike(a, b, domains)
        for name, (a, b) in pairs.items()
    )


def of_this_form(task: Task, ran: Task | None, rows: Iterable[TrialRow]) -> list[TrialRow]:
    """Return the rows of an earlier form of a task, `ran` if it is known, without the runs that the
    task no longer has: those of other places, or of other actions. The others end by the deadlines
    of the task as it is."""

    def fitted(run: RunEntry) -> RunEntry:
        before = ran is not None and ran.flat.places.get(run.place)
        if ran is None or not before or before.kind is not Kind.ACTION:
            return run
        return ended_within(run, ran.longest_run(run.place), task.longest_run(run.place))

    return [
        row
        if row.trial is None
        else replace(
            row,
            trial=replace(
                row.trial, runs=[fitted(run) for run in row.trial.runs if _has(task.flat, run)]
            ),
        )
        for row in rows
    ]


def ended_within(run: RunEntry, before: float, limit: float) -> RunEntry:
    """Return a run that a place ended after `before` s at the latest, as it is known of a place
    that ends runs after `limit` s. One that was ended earlier would have continued: it is cut
    off. One that took longer ends in ERROR then."""
    late = run.cause == LATE[0] and not run.cancelled
    if late and before < limit:
        return replace(run, status="", cause="", taken="")
    over = (before if late else run.seconds) - limit
    if before == limit or over <= 0.0:
        return run
    took, seconds = max(0.0, run.took - over), max(0.0, run.seconds - over)
    return replace(
        run, took=took, seconds=seconds, status=Status.ERROR.value, cause=LATE[0], taken="",
        cancelled=False,
    )  # fmt: skip


def _has(flat: Task, run: RunEntry) -> bool:
    place = flat.places.get(run.place)
    return (
        place is not None
        and place.kind is Kind.ACTION
        and run.action in flat.primitive_task_of(run.place).alternatives
    )


def _cutting_timers(task: Task) -> list[str]:
    """Return timers that preempt beside other runs and wait for nothing but runs: their waits
    follow from the runs that they took."""
    return [
        t.name
        for t in task.flat.transitions.values()
        if t.after is not None
        and not t.events
        and not is_cause(task.flat, t)
        and any(a.end is End.PREEMPT for a in t.inputs)
        and all(a.end in (End.PREEMPT, End.NORMAL, End.ERROR) for a in t.inputs)
    ]


def _waited(timer: str, trial: Trial) -> list[float]:
    """Return the seconds of each firing of a timer, from when the last run that it takes began (or
    ended, if it takes ended ones)."""
    by_place: dict[str, list[RunEntry]] = {}
    for run in trial.runs:
        if run.taken == timer:
            by_place.setdefault(run.place, []).append(run)
    out = []
    for taken in zip(*by_place.values(), strict=False):
        fired = max(run.begun + run.took for run in taken)
        out.append(fired - max(run.begun + (0.0 if run.cancelled else run.took) for run in taken))
    return out


def as_arrays(
    vocabulary: RunVocabulary, trials: Sequence[Trial], waiting: Mapping[str, str]
) -> Runs:
    """Return the runs of trials. `waiting`: by action the device for which its runs may wait."""
    places = {name: i for i, name in enumerate(vocabulary.places)}
    actions = {name: i + 1 for i, name in enumerate(vocabulary.actions)}
    flat = [(i, run) for i, trial in enumerate(trials) for run in trial.runs if run.place in places]
    codes = [_outcome(vocabulary, run) for _, run in flat]
    took = [run.took - (run.waited or 0.0) * (run.action in waiting) for _, run in flat]
    n, q = len(flat), len(places)
    seen = Seen.nothing(q, n)
    begin = 0
    while begin < n:
        end = begin
        while end < n and flat[end][0] == flat[begin][0]:
            end += 1
        for j in range(begin, end):
            for i in _ended_before(flat, j, begin):
                run = flat[i][1]
                seen.note(places[run.place], j, codes[i], actions.get(run.action, 0), took[i])
            if j > begin:
                run = flat[j - 1][1]
                seen.begun[:, j] = seen.begun[:, j - 1]
                seen.begun[places[run.place], j] = actions.get(run.action, 0)
        begin = end
    return Runs(
        np.array([places[run.place] for _, run in flat], np.int64),
        np.array([actions.get(run.action, 0) for _, run in flat], np.int64),
        np.array(codes, np.int64),
        np.array([run.cancelled for _, run in flat], np.bool_),
        np.array([_is_cut_off(vocabulary, run) for _, run in flat], np.bool_),
        np.array(took),
        np.array([i for i, _ in flat], np.int64),
        np.ones(n),
        seen,
    )


def _ended_before(flat: list[tuple[int, RunEntry]], j: int, begin: int) -> list[int]:
    """Return the runs of the same trial, from `begin` on, that ended before run j began, in the
    order of their ends."""
    # 1e-9 s: times are rounded to microseconds, but their sums are not
    came = flat[j][1].begun + 1e-9
    ends = [(run.begun + run.took, i) for i, (_, run) in enumerate(flat[begin:j], begin)]
    return [i for end, i in sorted(ends) if end <= came]


def _outcome(vocabulary: RunVocabulary, run: RunEntry) -> int:
    status = STATUSES.index(Status(run.status)) if run.status else CENSORED
    told = run.taken in vocabulary.transitions and (run.cancelled or run.place in vocabulary.open)
    return vocabulary.outcome(status, vocabulary.transitions.index(run.taken) if told else -1)


def _is_cut_off(vocabulary: RunVocabulary, run: RunEntry) -> bool:
    """Return whether a run was cut off: by a transition that fires as the marking allows, or by
    nothing of the task (an abort, the end of the records)."""
    if run.cancelled and run.taken in vocabulary.transitions:
        return run.taken in vocabulary.cutting
    return not run.status


def known_variables(flat: Task) -> set[str]:
    """Return the names whose values follow from what fired: parameters, and variables that only
    transitions write, out of such names."""
    written: dict[str, set[str]] = {}
    for t in flat.transitions.values():
        for name, value in t.sets:
            written.setdefault(name, set()).update(value.names)
    known = (set(written) | set(flat.parameters)) - {
        v for p in flat.places.values() for v in p.out.values()
    }
    while unsure := {n for n in known if written.get(n, set()) - known}:
        known -= unsure
    return known


def reads_variables(flat: Task, t: Transition) -> bool:
    """Return whether a transition's condition reads more than the statuses of the runs that it
    takes, and than known variables alone."""
    statuses = {f"{a.place}.status" for a in t.inputs if a.end is not None}
    return (
        t.when is not None
        and not t.when.names <= statuses
        and not t.when.names <= known_variables(flat)
    )


# --- training from an estimates file ---

# It holds only sums and samples of runs, so each run stands alone, without what ended before it.


def read_estimates(path: Path, plant: str | None = None) -> FileContents:
    """Read an estimates file. Raises ForecastError, also if it holds runs of several plants and
    none is named: they are never pooled."""
    try:
        kept = EstimatesFile(path).read(plant) if path.exists() else None
    except EstimatesError as fault:
        raise ForecastError(str(fault)) from fault
    known = [] if kept is None else [p for p, found in kept.plants.items() if found.tallies]
    if kept is None or not known:
        raise ForecastError(
            f"{path} holds no estimates; give a campaign's folder or a file that `run "
            "--learn` wrote"
        )
    names = ", ".join(said(p) for p in sorted(known))
    if plant is None and len(known) > 1:
        raise ForecastError(
            f"{path} holds runs of several plants, which are never pooled: {names}; choose one "
            "with --plant"
        )
    if plant is None:  # a plant whose runs were reset may have left the state of a selector
        return replace(kept, plant=known[0])
    if plant not in known:
        raise ForecastError(f"{path}: --plant {plant}: expected one of: {names}")
    return kept


def trainings_of(task: Task, estimates: Estimates, cell: Cell | None = None) -> dict[str, Training]:
    """Return the training of each regime in an estimates file. `cell`: where the task will run."""
    regimes = sorted({regime_of(key.context) for key in estimates.tallies})
    return {
        regime: Training.of(task, _trials(task, estimates, regime), whole=False, cell=cell)
        for regime in regimes
    }


def _trials(task: Task, estimates: Estimates, regime: str) -> list[Trial]:
    """Return one trial for each run of the samples, as often as it stands for a counted run."""
    flat, context = task.flat, context_of(regime)
    out: list[Trial] = []
    for place in flat.places.values():
        if place.kind is not Kind.ACTION:
            continue
        for key, tally in estimates.tallies.items():
            if (key.primitive_task, key.context) == (place.task, context):
                out += [
                    Trial(1, 0.0, runs=[run])
                    for run in _runs_of_sums(place.name, key.action, tally)
                ]
    for where, flow in estimates.flows.items():
        if (where.task, where.context) != (task.name, context) or not flow.occurrences:
            continue
        if not flow.unfired.n:
            out.append(Trial(1, 0.0, waits=[Waited(where.transition, flow.waits.mean)]))
            continue
        wait = Waited(where.transition, flow.exposure / flow.occurrences, WaitEnd.FIRED)
        out += [Trial(1, 0.0, waits=[wait]) for _ in range(flow.occurrences)]
        out.append(Trial(1, 0.0, waits=[Waited(where.transition, 0.0, WaitEnd.CUT)]))
    return out


def _runs_of_sums(place: str, action: str, tally: Tally) -> list[RunEntry]:
    """Return runs with the counts of the tally and the durations of its sample, repeated as needed;
    the mean if an exit has no sampled run. They are scaled to the mean of all runs: that of 512
    sampled ones is by itself off by some per cent, which no interval of all runs contains."""
    out: list[RunEntry] = []
    for exit_, moments in tally.durations.items():
        counted, _, transition = exit_.partition(":")
        seconds = tally.sample.seconds([exit_]) or [moments.mean]
        scale = moments.mean / fmean(seconds) if any(seconds) else 1.0
        status = "" if counted == CENSORED_CAUSE else counted
        for i in range(moments.n):
            took = scale * seconds[i % len(seconds)]
            out.append(
                RunEntry(
                    place,
                    action,
                    0.0,
                    took,
                    status,
                    taken=transition,
                    cancelled=bool(transition),
                    waited=0.0,
                )
            )
    return out
