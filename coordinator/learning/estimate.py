"""What is known of one primitive action in one context, and of the firings of one transition.

A `Tally` holds counts by status and cause, durations, CPU time, costs and availability. It is
immutable and can be merged: the tally of two sets of runs is the merge of their tallies, so runs of
several machines add up. Reliability R is the relative frequency of SUCCESS among the runs that were
executed, not censored and judged (paper, section 3). An ERROR counts as not successful, also with
`executed = unknown`. An ERROR of a run that never executed lowers only the availability A. A
preempted run that counts `none` is censored: it only shows a least duration of the run. A
run that ended provisionally and has no verdict says how such runs end and what they cost,
but nothing about R.
"""

from __future__ import annotations

from bisect import insort
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from hashlib import blake2b
from math import sqrt
from typing import Any, NamedTuple

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.learning.statistics import EMPTY, Moments, merged, whole, wilson
from petrobot.coordinator.task import Executed, Status

SIZE = 512
"""Runs kept of each action and context. A 90 % quantile is then known to about +-1.3 points of
probability (standard error sqrt(0.9 * 0.1 / 512))."""


class SampledRun(NamedTuple):
    """One run in the sample."""

    priority: int
    seconds: float
    cpu_seconds: float
    """-1 if it was not measured."""
    exit: str
    """How the run ended; see `Observation.exit`."""


class Sample(Struct, frozen=True):
    """A uniform sample of at most `SIZE` runs, sorted by priority. It can be merged: the entries
    with the smallest priorities are kept (bottom-k sampling, E. Cohen and H. Kaplan, PODC 2007)."""

    kept: tuple[SampledRun, ...] = ()

    def adding(self, name: str, seconds: float, cpu_seconds: float | None, exit_: str) -> Sample:
        """Return the sample with one more run. `name` must be unique among all runs."""
        entry = SampledRun(
            _priority(name), seconds, -1.0 if cpu_seconds is None else cpu_seconds, exit_
        )
        if len(self.kept) == SIZE and entry >= self.kept[-1]:
            return self
        grown = list(self.kept)
        insort(grown, entry)
        return Sample(tuple(grown[:SIZE]))

    def merged(self, other: Sample) -> Sample:
        """Return the sample of both sets of runs; a run that is in both is kept once."""
        return Sample(tuple(sorted({*self.kept, *other.kept})[:SIZE]))

    def corrected(self, seconds: float, was: str, now: str) -> Sample:
        """Return the sample with the exit of one run of that duration changed, if the sample holds
        it."""
        for i, entry in enumerate(self.kept):
            if entry.exit == was and entry.seconds == seconds:
                return Sample((*self.kept[:i], entry._replace(exit=now), *self.kept[i + 1 :]))
        return self

    def seconds(self, exits: Iterable[str] | None = None) -> list[float]:
        """Durations (s) of the sampled runs that ended with one of these exits (None: of all)."""
        wanted = None if exits is None else set(exits)
        return [k.seconds for k in self.kept if wanted is None or k.exit in wanted]

    def cpu_seconds(self) -> list[float]:
        """CPU times (s) of the sampled runs for which it was measured."""
        return [k.cpu_seconds for k in self.kept if k.cpu_seconds >= 0]

    def to_plain(self) -> list[list[Any]]:
        """Return the sample as plain data."""
        return [list(k) for k in self.kept]

    @classmethod
    def of_plain(cls, rows: Sequence[Sequence[Any]]) -> Sample:
        """Read what `to_plain` returned. Raises ValueError."""
        kept = []
        for row in rows:
            priority, seconds, cpu, exit_ = row
            kept.append(SampledRun(int(priority), float(seconds), float(cpu), str(exit_)))
        return cls(tuple(sorted(kept)[:SIZE]))


def _priority(name: str) -> int:
    """Return 63 pseudo-random bits that depend only on the name. SQLite and JSON readers hold 63
    bits exactly."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "big") >> 1


def quantile(numbers: Sequence[float], q: float) -> float:
    """Return the q-quantile by linear interpolation; nan for an empty sequence."""
    if not numbers:
        return float("nan")
    ordered = sorted(numbers)
    place = q * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


CENSORED = "none"
COUNT = "count"
"""Name of a cost measure, and of the number in a result that reports it."""


class TallyKey(Struct, frozen=True, order=True):
    """Identifies a tally: primitive task, action, and context ("" if contexts are not
    distinguished)."""

    primitive_task: str
    action: str
    context: str = ""


class Observation(Struct, frozen=True):
    """How one run ended, as the estimates need it."""

    status: Status | None
    """None: censored."""
    seconds: float
    cause: str = ""
    executed: Executed = Executed.YES
    cpu_seconds: float | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    """Numbers of the run's result. Each of them can be a cost measure (images averaged, ...)."""
    preempted_by: str | None = None
    """The transition that preempted the run ("" for an abort); None: it ended by itself."""
    waited: float | None = None
    """Seconds that its token was in the place beyond `seconds`: choosing the action, waiting for
    the device, messages on their way."""
    judged: bool = True
    """False: its status is provisional, and it has no verdict."""

    @property
    def exit(self) -> str:
        """`success`, `failure` or `error`; for a preempted run followed by `:transition`, or
        `none:transition` if it counts none."""
        counted = CENSORED if self.status is None else self.status.value
        return counted if self.preempted_by is None else f"{counted}:{self.preempted_by}"


def is_counted(exit_: str) -> bool:
    """Return whether runs with this exit count in R."""
    return not exit_.startswith(CENSORED)


class Tally(Struct, frozen=True):
    """Sums over runs. All mappings are sorted by key, so equal tallies have equal plain data."""

    counts: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """Counted runs, by (status, cause)."""
    durations: Mapping[str, Moments] = field(default_factory=dict)
    """Seconds of every executed run, by exit; includes censored runs."""
    cpu: Moments = EMPTY
    """CPU seconds of the counted runs for which it was measured."""
    values: Mapping[str, Moments] = field(default_factory=dict)
    """Numbers in the results of the counted runs."""
    waited: Moments = EMPTY
    """Seconds that tokens were in the place beyond the duration of their runs."""
    not_executed: Mapping[str, int] = field(default_factory=dict)
    """Runs that never began, by cause."""
    unknown: int = 0
    """Counted runs of which it is unknown whether they were executed."""
    corrected: int = 0
    """Number of deferred verdicts that changed a status."""
    changes: int = 0
    """How often runs were added or corrected. Of two versions of a tally, the later one has
    more."""
    sample: Sample = field(default_factory=Sample)
    unknown_ends: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """Runs in `unknown`, by (exit, cause). Runs from files older than this are in `unknown`
    alone."""
    unjudged: Mapping[str, int] = field(default_factory=dict)
    """Counted runs with a provisional status and no verdict, by that status. In files older
    than this they are not known."""

    # --- reading ------------------------------------------------------------------------------

    @property
    def runs(self) -> int:
        """Number of counted runs."""
        return sum(self.counts.values())

    @property
    def judged(self) -> int:
        """Number of runs that count in R."""
        return self.runs - sum(self.unjudged.values())

    @property
    def successes(self) -> int:
        """Number of these that were a SUCCESS."""
        return self.count(Status.SUCCESS) - self.unjudged.get(Status.SUCCESS.value, 0)

    def count(self, status: Status) -> int:
        """Return the number of counted runs with this status."""
        return sum(n for (s, _), n in self.counts.items() if s == status)

    @property
    def censored(self) -> int:
        """Number of preempted runs that count none."""
        return sum(m.n for exit_, m in self.durations.items() if not is_counted(exit_))

    @property
    def reliability(self) -> float:
        """R; nan if no run counts."""
        return self.successes / self.judged if self.judged else float("nan")

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return Wilson's confidence interval of R."""
        return wilson(self.successes, self.judged, level)

    @property
    def availability(self) -> float:
        """A: the share of started runs that were executed; 1 if none was started."""
        executed, missing = self.runs + self.censored, sum(self.not_executed.values())
        return executed / (executed + missing) if executed + missing else 1.0

    @property
    def wall(self) -> Moments:
        """Seconds of the counted runs, over all exits."""
        out = EMPTY
        for exit_, moments in self.durations.items():
            out = out.merged(moments) if is_counted(exit_) else out
        return out

    def cost(self, measure: str) -> Moments:
        """Return the cost over the counted runs by a measure: `wall`, `cpu` (s), `count` or
        `value:NAME`. Raises ValueError for any other measure.

        `count` is how many things a run used (images averaged, tries), as its result reports it in
        the number `count`; a run that does not report it counts as 1.
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
                f"{measure!r} is not a cost measure; give wall, cpu, count or value:NAME"
            )
        return self.values.get(name, EMPTY)

    def cost_correlation(self, measure: str) -> float:
        """Return the correlation of success and cost over the counted runs: they come from the same
        runs, so the interval of J needs it. For `cpu` it is that of the sample. Of other numbers
        only their sums are known: -1, which makes the interval of J widest."""
        if measure == "wall":
            good = EMPTY
            for exit_, moments in self.durations.items():
                if exit_.partition(":")[0] == Status.SUCCESS:
                    good = good.merged(moments)
            whole_ = self.wall
        elif measure == "cpu":
            good = whole_ = EMPTY
            for run in self.sample.kept:
                if run.cpu_seconds >= 0 and is_counted(run.exit):
                    whole_ = whole_.adding(run.cpu_seconds)
                    if run.exit.partition(":")[0] == Status.SUCCESS:
                        good = good.adding(run.cpu_seconds)
        else:
            return -1.0 if self.cost(measure).m2 > 0 else 0.0
        if not 0 < good.n < whole_.n or whole_.m2 <= 0:
            return 0.0
        share = good.n / whole_.n
        spread = sqrt(share * (1.0 - share) * whole_.m2 / whole_.n)
        return max(-1.0, min(1.0, share * (good.mean - whole_.mean) / spread))

    def quantile(self, q: float, measure: str = "wall") -> float:
        """Return the q-quantile of durations or CPU times (s) over the sampled counted runs; nan
        without any. Raises ValueError for a measure other than `wall` or `cpu`."""
        if measure == "cpu":
            return quantile(self.sample.cpu_seconds(), q)
        if measure != "wall":
            raise ValueError(f"{measure!r} has no quantiles; give wall or cpu")
        return quantile(self.sample.seconds(e for e in self.durations if is_counted(e)), q)

    # --- changing -----------------------------------------------------------------------------

    def adding(self, seen: Observation, salt: str = "") -> Tally:
        """Return the tally with one more run. `salt` names the session that counts, so that the
        samples of several sessions differ.

        A run that was cancelled before it began is not counted.
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
        values, unsure = dict(self.values), seen.executed is Executed.UNKNOWN
        for name, value in seen.values.items():
            values[name] = values.get(name, EMPTY).adding(value)
        return replace(
            self,
            counts=_more(self.counts, (status.value, seen.cause)),
            cpu=self.cpu if seen.cpu_seconds is None else self.cpu.adding(seen.cpu_seconds),
            values=dict(sorted(values.items())) if seen.values else self.values,
            unknown=self.unknown + unsure,
            unknown_ends=_more(self.unknown_ends, (seen.exit, seen.cause))
            if unsure
            else self.unknown_ends,
            unjudged=self.unjudged if seen.judged else _more(self.unjudged, status.value),
        )

    def correcting(self, was: Observation, status: Status, cause: str = "") -> Tally:
        """Return the tally with the status of one run replaced by its deferred verdict. Raises
        KeyError if it holds no such run."""
        if was.status is None:
            raise KeyError("a censored run has no status to correct")
        before, after = was.exit, replace(was, status=status).exit
        counts = _more(_more(self.counts, (was.status.value, was.cause), -1), (status.value, cause))
        ends = self.unknown_ends
        if ends.get((before, was.cause)) and was.executed is Executed.UNKNOWN:
            ends = _more(_more(ends, (before, was.cause), -1), (after, cause))
        durations = _put(self.durations, before, self.durations[before].without(was.seconds))
        durations = _put(durations, after, durations.get(after, EMPTY).adding(was.seconds))
        return replace(
            self,
            counts=counts,
            durations=durations,
            sample=self.sample.corrected(was.seconds, before, after),
            unknown_ends=ends,
            unjudged=_more(self.unjudged, was.status.value, -1)
            if was.status.value in self.unjudged
            else self.unjudged,
            corrected=self.corrected + (status is not was.status),
            changes=self.changes + 1,
        )

    def merged(self, other: Tally) -> Tally:
        """Return the tally of both sets of runs."""
        if not self.changes or not other.changes:
            return self if self.changes else other
        return Tally(
            _summed(self.counts, other.counts),
            merged(self.durations, other.durations),
            self.cpu.merged(other.cpu),
            merged(self.values, other.values),
            self.waited.merged(other.waited),
            _summed(self.not_executed, other.not_executed),
            self.unknown + other.unknown,
            self.corrected + other.corrected,
            self.changes + other.changes,
            self.sample.merged(other.sample),
            _summed(self.unknown_ends, other.unknown_ends),
            _summed(self.unjudged, other.unjudged),
        )

    # --- plain data ---------------------------------------------------------------------------

    def to_plain(self) -> dict[str, Any]:
        """Return the tally as plain data for JSON and msgpack."""
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
            "unknown_ends": [[exit_, cause, n] for (exit_, cause), n in self.unknown_ends.items()],
            "unjudged": dict(self.unjudged),
        }

    @classmethod
    def of_plain(cls, data: Mapping[str, Any]) -> Tally:
        """Read what `to_plain` returned. Raises ValueError, KeyError or TypeError for anything
        else.

        Numbers that no sequence of runs can produce (negative counts, more durations than runs,
        ...) are refused: after a merge they would spoil every figure.
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
            {
                (str(exit_), str(cause)): whole(n, "runs of one exit and cause")
                for exit_, cause, n in data.get("unknown_ends", ())
            },
            {
                Status(status).value: whole(n, "runs without a verdict")
                for status, n in data.get("unjudged", {}).items()
            },
        )
        read._check()
        return read

    def _check(self) -> None:
        """Raise ValueError if the parts contradict each other."""
        for status in Status:
            timed = sum(
                m.n for exit_, m in self.durations.items() if exit_.partition(":")[0] == status
            )
            if timed != self.count(status):
                raise ValueError(
                    f"{self.count(status)} runs ended with {status}, but {timed} such runs "
                    "have a duration"
                )
            open_ = self.unjudged.get(status.value, 0)
            whole(open_, f"runs with {status} and no verdict", self.count(status))
        whole(sum(self.unknown_ends.values()), "runs in unknown_ends", self.unknown)
        for (exit_, cause), n in self.unknown_ends.items():
            word = exit_.partition(":")[0]
            whole(n, f"runs in unknown_ends with {exit_}", self.counts.get((word, cause), 0))
        executed = self.runs + self.censored
        if sum(m.n for m in self.durations.values()) != executed:
            raise ValueError(f"some exits are neither one of {', '.join(Status)} nor censored")
        for name, moments in (("cpu", self.cpu), *self.values.items()):
            whole(moments.n, f"numbers called {name}", self.runs)
        whole(self.waited.n, "waits", executed)
        whole(len(self.sample.kept), "runs in the sample", executed)
        least = executed + sum(self.not_executed.values())
        if self.changes < least:
            raise ValueError(f"{self.changes} changes cannot have counted {least} runs")
        if any(m.low < 0 for m in (*self.durations.values(), self.cpu, self.waited) if m.n):
            raise ValueError("expected seconds from 0, got negative ones")


def _more(counts: Mapping[Any, int], key: Any, by: int = 1) -> dict[Any, int]:
    """Return the counts with one of them changed; a count of 0 is removed. Raises KeyError below
    0."""
    n = counts.get(key, 0) + by
    if n < 0:
        raise KeyError(f"no run was counted as {key}")
    return _put(counts, key, n) if n else {k: v for k, v in counts.items() if k != key}


def _put(entries: Mapping[Any, Any], key: Any, value: Any) -> dict[Any, Any]:
    """Return the entries with one of them replaced or inserted in sorted order; moments without
    numbers are removed."""
    out = {**entries, key: value}
    if isinstance(value, Moments) and not value.n:
        del out[key]
    return out if key in entries else dict(sorted(out.items()))


def _summed(one: Mapping[Any, int], other: Mapping[Any, int]) -> dict[Any, int]:
    return {key: one.get(key, 0) + other.get(key, 0) for key in sorted({*one, *other})}


# --- firings ---


class FiringsKey(Struct, frozen=True, order=True):
    """Identifies the firings of a transition of a task in a context."""

    task: str
    transition: str
    context: str = ""


class Firings(Struct, frozen=True):
    """Number of firings and waiting times of one transition. Immutable; can be merged."""

    fired: int = 0
    waits: Moments = EMPTY
    """Seconds of each wait for an event that ended with a firing (in older sums: since the tokens
    came last)."""
    unfired: Moments = EMPTY
    """Seconds of each wait that did not; unknown, and so empty, in older sums."""
    came: int = 0
    """How many of the unfired ones ended because the event came."""

    @property
    def changes(self) -> int:
        """Number of firings and unfired waits, the version in estimates files."""
        return self.fired + self.unfired.n

    @property
    def exposure(self) -> float:
        """Seconds in which its event could have served it."""
        return self.waits.total + self.unfired.total

    @property
    def occurrences(self) -> int:
        """How often its event came in this time."""
        return self.waits.n + self.came

    def to_plain(self) -> list[Any]:
        """Return the firings as plain data."""
        return [self.fired, self.waits.to_plain(), self.unfired.to_plain(), self.came]

    @classmethod
    def of_plain(cls, data: Sequence[Any]) -> Firings:
        """Read what `to_plain` returned. Raises ValueError or TypeError."""
        fired, waits = whole(data[0], "firings"), Moments.of_plain(data[1])
        whole(waits.n, "waits", fired)
        if len(data) == 2:
            return cls(fired, waits)
        unfired = Moments.of_plain(data[2])
        return cls(fired, waits, unfired, whole(data[3], "events that came", unfired.n))

    def adding(self, waited: float | None = None) -> Firings:
        """Return the firings with one more."""
        waits = self.waits if waited is None else self.waits.adding(waited)
        return replace(self, fired=self.fired + 1, waits=waits)

    def unserved(self, waited: float, came: bool) -> Firings:
        """Return the firings with one more wait that ended without one. `came`: by the event."""
        return replace(self, unfired=self.unfired.adding(waited), came=self.came + came)

    def merged(self, other: Firings) -> Firings:
        """Return the firings of both sets of runs."""
        return Firings(
            self.fired + other.fired,
            self.waits.merged(other.waits),
            self.unfired.merged(other.unfired),
            self.came + other.came,
        )


class TrialsKey(Struct, frozen=True, order=True):
    """Identifies the trials of a task in a context."""

    task: str
    context: str = ""


class TrialSums(Struct, frozen=True):
    """Sums over trials of a whole task. Immutable; can be merged."""

    n: int = 0
    """Trials that have begun and ended."""
    success: int = 0
    """Trials that completed and in which every run was a SUCCESS."""
    goals: int = 0
    """Trials in which a goal transition fired."""
    cost: Moments = EMPTY
    """Cost of a trial: the sum over its runs, those of parallel branches included; only trials all
    of whose runs reported one."""
    good_cost: Moments = EMPTY
    """The same of the trials in which every run was a SUCCESS."""
    runs: Mapping[str, int] = field(default_factory=dict)
    """Number of runs of each primitive task."""

    @property
    def changes(self) -> int:
        """Number of trials, the version in estimates files."""
        return self.n

    def adding(
        self, success: bool, goal: bool, cost: float | None, runs: Iterable[str]
    ) -> TrialSums:
        """Return the sums with one more trial; `cost`: None if a run did not report its own;
        `runs`: the primitive task of each of its runs."""
        counts = Counter(self.runs) + Counter(runs)
        return TrialSums(
            self.n + 1,
            self.success + success,
            self.goals + goal,
            self.cost if cost is None else self.cost.adding(cost),
            self.good_cost if cost is None or not success else self.good_cost.adding(cost),
            dict(sorted(counts.items())),
        )

    def merged(self, other: TrialSums) -> TrialSums:
        """Return the sums of both sets of trials."""
        return TrialSums(
            self.n + other.n,
            self.success + other.success,
            self.goals + other.goals,
            self.cost.merged(other.cost),
            self.good_cost.merged(other.good_cost),
            dict(sorted((Counter(self.runs) + Counter(other.runs)).items())),
        )

    def to_plain(self) -> list[Any]:
        """Return the sums as plain data."""
        costs = [self.cost.to_plain(), self.good_cost.to_plain()]
        return [self.n, self.success, self.goals, *costs, dict(self.runs)]

    @classmethod
    def of_plain(cls, data: Sequence[Any]) -> TrialSums:
        """Read what `to_plain` returned. Raises ValueError or TypeError."""
        n = whole(data[0], "trials")
        success, goals = whole(data[1], "successes", n), whole(data[2], "goals", n)
        cost, good = Moments.of_plain(data[3]), Moments.of_plain(data[4])
        whole(cost.n, "costs", n)
        whole(good.n, "costs of successes", success)
        runs = {str(name): whole(k, f"runs of {name}") for name, k in data[5].items()}
        return cls(n, success, goals, cost, good, dict(sorted(runs.items())))
