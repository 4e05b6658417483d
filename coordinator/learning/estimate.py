"""What is known of one primitive action in one context: counts by status and cause, durations, CPU
time, costs, availability.

A `Tally` is immutable and merges: the tally of two sets of runs is the merge of their tallies, so
several machines' runs add up. Reliability R is the relative frequency of SUCCESS among the runs
that were executed and not censored (paper, section 3); an ERROR counts as a failure, `executed =
unknown` too; an ERROR that never executed lowers the availability A alone. A preempted run that
counts `none` is censored: it says only that it had lasted so long.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import Any, NamedTuple

from petrobot.coordinator.learning.statistics import (
    EMPTY,
    Moments,
    clopper_pearson,
    merged,
    whole,
    wilson,
)
from petrobot.coordinator.task import Executed, Status

# A bounded uniform sample of runs that merges: the entries with the smallest priorities are kept (bottom-k sampling).

SIZE = 512
"""Runs kept of each action and context: a 90 % quantile is then known to about +-1.3 points of
probability."""


class SampledRun(NamedTuple):
    """One run in the sample."""

    priority: int
    seconds: float
    cpu_seconds: float
    """-1 where it was not measured."""
    exit: str
    """How it ended; see `coordinator.learning.estimate`."""


@dataclass(frozen=True, slots=True)
class Sample:
    """At most `SIZE` runs, in order of their priorities."""

    kept: tuple[SampledRun, ...] = ()

    def adding(self, name: str, seconds: float, cpu_seconds: float | None, exit_: str) -> Sample:
        """With one more run. `name` must not have been used before."""
        entry = SampledRun(
            _priority(name), seconds, -1.0 if cpu_seconds is None else cpu_seconds, exit_
        )
        if len(self.kept) == SIZE and entry >= self.kept[-1]:
            return self
        grown = list(self.kept)
        insort(grown, entry)
        return Sample(tuple(grown[:SIZE]))

    def merged(self, other: Sample) -> Sample:
        """Of both together; a run that is in both is kept once."""
        return Sample(tuple(sorted({*self.kept, *other.kept})[:SIZE]))

    def corrected(self, seconds: float, was: str, now: str) -> Sample:
        """With the exit of one run of that length changed, if the sample holds it."""
        for i, entry in enumerate(self.kept):
            if entry.exit == was and entry.seconds == seconds:
                return Sample((*self.kept[:i], entry._replace(exit=now), *self.kept[i + 1 :]))
        return self

    def seconds(self, exits: Iterable[str] | None = None) -> list[float]:
        """Durations (s) of the kept runs that ended so (None: of all)."""
        wanted = None if exits is None else set(exits)
        return [k.seconds for k in self.kept if wanted is None or k.exit in wanted]

    def cpu_seconds(self) -> list[float]:
        """CPU times (s) of the kept runs that have one."""
        return [k.cpu_seconds for k in self.kept if k.cpu_seconds >= 0]

    def to_plain(self) -> list[list[Any]]:
        """Plain data."""
        return [list(k) for k in self.kept]

    @classmethod
    def of_plain(cls, rows: Sequence[Sequence[Any]]) -> Sample:
        """What `to_plain` gave. Raises ValueError."""
        kept = []
        for row in rows:
            priority, seconds, cpu, exit_ = row
            kept.append(SampledRun(int(priority), float(seconds), float(cpu), str(exit_)))
        return cls(tuple(sorted(kept)[:SIZE]))


def _priority(name: str) -> int:
    """63 bits that look random and depend on the name alone (SQLite and JSON readers hold them
    exactly)."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "big") >> 1


def quantile(numbers: Sequence[float], q: float) -> float:
    """The q-quantile by linear interpolation; nan of an empty sequence."""
    if not numbers:
        return float("nan")
    ordered = sorted(numbers)
    place = q * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


CENSORED = "none"
COUNT = "count"
"""The measure, and the value of a result in which a run reports it."""


@dataclass(frozen=True, slots=True, order=True)
class TallyKey:
    """Whose tally: an action as translation of a primitive task, in a context ("" where contexts
    are not told apart)."""

    primitive_task: str
    action: str
    context: str = ""


@dataclass(frozen=True, slots=True)
class Observation:
    """How one run ended, as the estimates see it."""

    status: Status | None
    """None: censored."""
    seconds: float
    cause: str = ""
    executed: Executed = Executed.YES
    cpu_seconds: float | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    """Numbers of the run's result, any of which may be a cost measure of its own (images averaged,
    ...)."""
    preempted_by: str | None = None
    """The transition that cancelled it ("" for an abort); None: it ended by itself."""
    waited: float | None = None
    """Seconds that its token was in its place beyond `seconds`: choosing, waiting for the device,
    messages under way."""

    @property
    def exit(self) -> str:
        """`success`, `failure`, `error`; with `:transition` behind it, or `none:transition`, for a
        preempted run."""
        counted = CENSORED if self.status is None else self.status.value
        return counted if self.preempted_by is None else f"{counted}:{self.preempted_by}"


def is_counted(exit_: str) -> bool:
    """Whether runs with this exit count in R."""
    return not exit_.startswith(CENSORED)


@dataclass(frozen=True, slots=True)
class Tally:
    """Sums over runs. All mappings are in sorted order, so equal tallies have equal plain data."""

    counts: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """Runs that count, by (status, cause)."""
    durations: Mapping[str, Moments] = field(default_factory=dict)
    """Seconds of every run that was executed, by exit: censored runs too."""
    cpu: Moments = EMPTY
    """CPU seconds of the runs that count, where they were measured."""
    values: Mapping[str, Moments] = field(default_factory=dict)
    """Numbers of the results of the runs that count."""
    waited: Moments = EMPTY
    """Seconds that tokens spent in the place beyond their runs' own."""
    not_executed: Mapping[str, int] = field(default_factory=dict)
    """Runs that never began, by cause."""
    unknown: int = 0
    """Of the counted ones, those that may or may not have been executed."""
    corrected: int = 0
    """Deferred verdicts that changed a status."""
    changes: int = 0
    """How often it was added to or corrected: the later of two versions has more."""
    sample: Sample = field(default_factory=Sample)

    # --- reading ------------------------------------------------------------------------------

    @property
    def runs(self) -> int:
        """Runs that count in R."""
        return sum(self.counts.values())

    def count(self, status: Status) -> int:
        """Counted runs with this status."""
        return sum(n for (s, _), n in self.counts.items() if s == status)

    @property
    def censored(self) -> int:
        """Preempted runs that count none."""
        return sum(m.n for exit_, m in self.durations.items() if not is_counted(exit_))

    @property
    def exposure(self) -> float:
        """Seconds that runs went on, censored ones too."""
        return sum(m.total for m in self.durations.values())

    @property
    def reliability(self) -> float:
        """R; nan without counted runs."""
        return self.count(Status.SUCCESS) / self.runs if self.runs else float("nan")

    def interval(self, level: float = 0.95, *, exact: bool = False) -> tuple[float, float]:
        """Confidence interval of R: Wilson's, or the exact one of Clopper and Pearson."""
        made = clopper_pearson if exact else wilson
        return made(self.count(Status.SUCCESS), self.runs, level)

    @property
    def availability(self) -> float:
        """A: the share of started runs that were executed at all; 1 without any."""
        executed, missing = self.runs + self.censored, sum(self.not_executed.values())
        return executed / (executed + missing) if executed + missing else 1.0

    @property
    def wall(self) -> Moments:
        """Seconds of the counted runs, whatever their exit."""
        out = EMPTY
        for exit_, moments in self.durations.items():
            out = out.merged(moments) if is_counted(exit_) else out
        return out

    def cost(self, measure: str = "wall") -> Moments:
        """The cost by a measure, over the counted runs: `wall`, `cpu` (s), `count` or `value:NAME`.

        `count` is how many things a run used, as it reports in its value `count` (images averaged,
        tries); one that reports none counts as 1.
        """
        if measure == "wall":
            return self.wall
        if measure == "cpu":
            return self.cpu
        if measure == COUNT:
            said = self.values.get(COUNT, EMPTY)
            silent = self.runs - said.n
            return said.merged(Moments(silent, 1.0, 0.0, 1.0, 1.0)) if silent else said
        kind, _, name = measure.partition(":")
        if kind != "value" or not name:
            raise ValueError(
                f"{measure!r} is no cost measure: write wall, cpu, count or value:NAME"
            )
        return self.values.get(name, EMPTY)

    def quantile(self, q: float, measure: str = "wall") -> float:
        """The q-quantile of durations or CPU times (s) over the kept sample of counted runs; nan
        where there is none."""
        if measure == "cpu":
            return quantile(self.sample.cpu_seconds(), q)
        if measure != "wall":
            raise ValueError(f"quantiles are kept of wall and cpu, not of {measure!r}")
        return quantile(self.sample.seconds(e for e in self.durations if is_counted(e)), q)

    # --- changing -----------------------------------------------------------------------------

    def adding(self, seen: Observation, salt: str = "") -> Tally:
        """With one more run. `salt` names whoever counts, so that samples of several counters do
        not coincide.

        A run that was cancelled before it began says nothing and changes nothing.
        """
        if seen.executed is Executed.NO:
            if seen.status is None or seen.preempted_by is not None:
                return self
            return replace(
                self, not_executed=_more(self.not_executed, seen.cause), changes=self.changes + 1
            )
        exit_ = seen.exit
        durations = _put(
            self.durations, exit_, self.durations.get(exit_, EMPTY).adding(seen.seconds)
        )
        sample = self.sample.adding(f"{salt}/{self.changes}", seen.seconds, seen.cpu_seconds, exit_)
        waited = self.waited if seen.waited is None else self.waited.adding(seen.waited)
        grown = replace(
            self, durations=durations, waited=waited, sample=sample, changes=self.changes + 1
        )
        return grown if seen.status is None else grown._counted(seen, seen.status)

    def _counted(self, seen: Observation, status: Status) -> Tally:
        values = dict(self.values)
        for name, value in seen.values.items():
            values[name] = values.get(name, EMPTY).adding(value)
        return replace(
            self,
            counts=_more(self.counts, (status.value, seen.cause)),
            cpu=self.cpu if seen.cpu_seconds is None else self.cpu.adding(seen.cpu_seconds),
            values=dict(sorted(values.items())) if seen.values else self.values,
            unknown=self.unknown + (seen.executed is Executed.UNKNOWN),
        )

    def correcting(self, was: Observation, status: Status, cause: str = "") -> Tally:
        """With the deferred verdict on a run that was added before: its status is replaced. Raises
        KeyError if none is there."""
        if was.status is None:
            raise KeyError("a censored run has no status to correct")
        before, after = was.exit, replace(was, status=status).exit
        counts = _more(_more(self.counts, (was.status.value, was.cause), -1), (status.value, cause))
        durations = _put(self.durations, before, self.durations[before].without(was.seconds))
        durations = _put(durations, after, durations.get(after, EMPTY).adding(was.seconds))
        return replace(
            self,
            counts=counts,
            durations=durations,
            sample=self.sample.corrected(was.seconds, before, after),
            corrected=self.corrected + (status is not was.status),
            changes=self.changes + 1,
        )

    # --- plain data ---------------------------------------------------------------------------

    def to_plain(self) -> dict[str, Any]:
        """Plain data for JSON and msgpack."""
        return {
            "counts": [[status, cause, n] for (status, cause), n in self.counts.items()],
            "durations": {exit_: m.to_plain() for exit_, m in self.durations.items()},
            "cpu": self.cpu.to_plain(),
            "values": {name: m.to_plain() for name, m in self.values.items()},
            "waited": self.waited.to_plain(),
            "not_executed": dict(self.not_executed),
            "unknown": self.unknown,
            "corrected": self.corrected,
            "changes": self.changes,
            "sample": self.sample.to_plain(),
        }

    @classmethod
    def of_plain(cls, data: Mapping[str, Any]) -> Tally:
        """What `to_plain` gave. Raises ValueError, KeyError or TypeError for anything else.

        Numbers that no sequence of runs could have left (negative ones, more times than runs, ...)
        are refused: merged, they would spoil every figure.
        """
        counts = {
            (str(Status(status)), str(cause)): whole(n, "runs")
            for status, cause, n in data["counts"]
        }
        read = cls(
            counts,
            {str(exit_): Moments.of_plain(m) for exit_, m in data["durations"].items()},
            Moments.of_plain(data["cpu"]),
            {str(name): Moments.of_plain(m) for name, m in data["values"].items()},
            Moments.of_plain(data["waited"]),
            {
                str(cause): whole(n, "runs that never began")
                for cause, n in data["not_executed"].items()
            },
            whole(
                data["unknown"],
                "runs of which it is not known whether they were executed",
                sum(counts.values()),
            ),
            whole(data["corrected"], "corrections"),
            whole(data["changes"], "changes"),
            Sample.of_plain(data["sample"]),
        )
        read._check()
        return read

    def _check(self) -> None:
        """Raise ValueError where the parts do not belong together."""
        for status in Status:
            timed = sum(
                m.n for exit_, m in self.durations.items() if exit_.partition(":")[0] == status
            )
            if timed != self.count(status):
                raise ValueError(
                    f"{self.count(status)} runs ended with {status}, but {timed} such runs "
                    "have a duration"
                )
        executed = self.runs + self.censored
        if sum(m.n for m in self.durations.values()) != executed:
            raise ValueError(f"runs that ended as none of {', '.join(Status)}, nor censored")
        for name, moments in (("cpu", self.cpu), *self.values.items()):
            whole(moments.n, f"numbers called {name}", self.runs)
        whole(self.waited.n, "waits", executed)
        whole(len(self.sample.kept), "runs in the sample", executed)
        least = executed + sum(self.not_executed.values())
        if self.changes < least:
            raise ValueError(f"{self.changes} changes made it, but {least} runs stand in it")
        if any(m.low < 0 for m in (*self.durations.values(), self.cpu, self.waited) if m.n):
            raise ValueError("seconds below 0")


def merge_tallies(one: Tally, other: Tally) -> Tally:
    """The tally of both sets of runs."""
    if not one.changes or not other.changes:
        return one if one.changes else other
    return Tally(
        _summed(one.counts, other.counts),
        merged(one.durations, other.durations),
        one.cpu.merged(other.cpu),
        merged(one.values, other.values),
        one.waited.merged(other.waited),
        _summed(one.not_executed, other.not_executed),
        one.unknown + other.unknown,
        one.corrected + other.corrected,
        one.changes + other.changes,
        one.sample.merged(other.sample),
    )


def _more(counts: Mapping[Any, int], key: Any, by: int = 1) -> dict[Any, int]:
    """Counts with one of them changed; one that comes to 0 is gone."""
    n = counts.get(key, 0) + by
    if n < 0:
        raise KeyError(f"no run was counted as {key}")
    return _put(counts, key, n) if n else _without(counts, key)


def _without(counts: Mapping[Any, int], key: Any) -> dict[Any, int]:
    return {k: v for k, v in counts.items() if k != key}


def _put(entries: Mapping[Any, Any], key: Any, value: Any) -> dict[Any, Any]:
    """Entries with one of them replaced or put where sorting wants it; moments without numbers are
    left out."""
    out = {**entries, key: value}
    if isinstance(value, Moments) and not value.n:
        del out[key]
    return out if key in entries else dict(sorted(out.items()))


def _summed(one: Mapping[Any, int], other: Mapping[Any, int]) -> dict[Any, int]:
    return {key: one.get(key, 0) + other.get(key, 0) for key in sorted({*one, *other})}


# --- firings ---


@dataclass(frozen=True, slots=True, order=True)
class FiringsKey:
    """A transition of a task, in a context."""

    task: str
    transition: str
    context: str = ""


@dataclass(frozen=True, slots=True)
class Firings:
    """Firings of one transition. Immutable, mergeable."""

    fired: int = 0
    waits: Moments = EMPTY
    """Seconds from the marking that enabled it to each firing."""

    def to_plain(self) -> list[Any]:
        """Plain data."""
        return [self.fired, self.waits.to_plain()]

    @classmethod
    def of_plain(cls, data: Sequence[Any]) -> Firings:
        """What `to_plain` gave. Raises ValueError or TypeError."""
        fired, waits = whole(data[0], "firings"), Moments.of_plain(data[1])
        whole(waits.n, "waits", fired)
        return cls(fired, waits)

    def adding(self, waited: float | None = None) -> Firings:
        """With one more firing."""
        return Firings(self.fired + 1, self.waits if waited is None else self.waits.adding(waited))


def merge_firings(one: Firings, other: Firings) -> Firings:
    """Of both sets of firings."""
    return Firings(one.fired + other.fired, one.waits.merged(other.waits))
