"""Simulation of a GSPN, for chains that are too large to solve; results with confidence intervals.

Up to BLOCK independent replicas are played side by side: one sequence of numpy operations moves all
of them by one firing. Then comes the next block, so a simulation that is stopped early has blocks
in which no replica is missing. The random generator is passed in; the same generator gives the same
result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import sqrt
from statistics import NormalDist

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.coordinator.analysis.limits import overtime
from petrobot.coordinator.analysis.net.graph import Mask
from petrobot.coordinator.analysis.net.pack import Tokens, concession
from petrobot.coordinator.analysis.time.gspn import Gspn, Values
from petrobot.coordinator.task.net import Marking

Stop = Callable[[Tokens], Mask]
"""From tokens of shape (places, replicas) to which replicas have reached their goal, shape
(replicas,)."""
BLOCK = 1000
"""The most replicas that are played side by side."""
REMEMBERED = 1 << 22
"""The most tokens in the markings that a goal remembers: a large net seldom visits one twice."""


class IntervalEstimate(Struct, frozen=True):
    """A simulated number with its confidence interval."""

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, sample: Values, confidence: float) -> IntervalEstimate:
        """Return the normal interval for the mean of independent observations."""
        mean = float(sample.mean())
        if len(sample) < 2:
            return cls(mean, -np.inf, np.inf)
        half = _z(confidence) * float(sample.std(ddof=1)) / sqrt(len(sample))
        return cls(mean, mean - half, mean + half)

    @classmethod
    def share(cls, hits: int, n: int, confidence: float) -> IntervalEstimate:
        """Return the Wilson interval for a probability.

        Unlike the normal interval it stays within 0 and 1 and works for few hits (E. B. Wilson,
        J. Am. Stat. Assoc. 22, 1927).
        """
        z, p = _z(confidence), hits / n
        middle, half = p + z * z / (2 * n), z * sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return cls(
            p,
            (middle - half) / (1 + z * z / n) if hits else 0.0,
            (middle + half) / (1 + z * z / n) if hits < n else 1.0,
        )

    def covers(self, value: float) -> bool:
        """Return whether the interval contains a value."""
        return self.low <= value <= self.high


def _z(confidence: float) -> float:
    return NormalDist().inv_cdf(0.5 + confidence / 2)


class Simulation(Struct, frozen=True):
    """The result of a simulation.

    Throughput (1/s) and mean tokens are per replica, over its observed time. `completed` is None
    without a goal. `complete` is False if the limit of firings, the time limit or Ctrl-C ended the
    simulation early. Then the estimates are those of the blocks that were played to their end, or
    if there is none, of the replicas in the first that were: those that take long are missing.
    """

    replicas: int
    """How many the estimates are of."""
    active: int
    """How many of these were still active when the simulation was stopped."""
    firings: int
    """Those of all replicas that were played."""
    throughput: dict[str, IntervalEstimate]
    mean_tokens: dict[str, IntervalEstimate]
    completed: IntervalEstimate | None
    time: IntervalEstimate | None
    """Mean time to the goal of the replicas that reached it (s)."""
    times: Values
    """The times of these replicas, sorted (s)."""
    complete: bool

    def quantile(self, q: float) -> float:
        """Return a quantile of the time to the goal (s)."""
        return float(np.quantile(self.times, q))


class _Replicas:
    """Replicas of a GSPN as columns of a token matrix, and the firing rule for all of them."""

    def __init__(self, gspn: Gspn, count: int) -> None:
        net = gspn.net
        self.gspn, self.net = gspn, net
        self.delta = np.zeros((len(net.places), len(net.transitions)), dtype=np.int64)
        for t, changes in enumerate(net.compiled.changes):
            for p, change in changes:
                self.delta[p, t] = change
        levels = sorted(set(net.priority), reverse=True)
        self.levels = [
            [t for t, own in enumerate(net.priority) if own == level] for level in levels
        ]
        self.tokens = np.repeat(np.array(net.initial, dtype=np.int64)[:, None], count, axis=1)

    def amounts(self) -> tuple[Values, Mask]:
        """Return (amounts of the enabled transitions, which replicas are in a tangible marking).

        Amounts have the shape (transitions, replicas): rate times busy servers, or weight.
        """
        count = self.tokens.shape[1]
        amount = np.zeros((len(self.net.transitions), count))
        beaten = np.zeros(count, dtype=np.bool_)
        tangible = np.ones(count, dtype=np.bool_)
        for level in self.levels:
            if beaten.all():
                break
            for t in level:
                able = concession(self.net.compiled, self.tokens, t) & ~beaten
                amount[t] = self._amount(t, able)
            some = (amount[level] > 0).any(axis=0)
            if self.net.priority[level[0]] > 0:
                tangible &= ~some
            beaten |= some
        return amount, tangible

    def _amount(self, t: int, able: Mask) -> Values:
        rate, servers = self.gspn.rate[t], self.gspn.servers[t]
        if rate is None:
            return np.asarray(able * self.gspn.weight[t])
        if servers == 1:
            return np.asarray(able * rate)
        tokens = {p: self.tokens[p] for p, _ in self.net.compiled.needs[t]}
        return np.asarray(able * rate * self.gspn.busy_servers(t, tokens))


def simulate(
    gspn: Gspn,
    random: np.random.Generator,
    *,
    replicas: int = 1000,
    horizon: float = np.inf,
    warmup: float = 0.0,
    goal: Stop | None = None,
    lost: Stop | None = None,
    firings: int = 10_000_000,
    confidence: float = 0.95,
    progress: Callable[[int, float], None] | None = None,
) -> Simulation:
    """Play replicas from the initial marking until `horizon` (s), or until they rest in a marking
    of `goal` or `lost`: these end, too, but without having reached the goal.

    All replicas together fire at most `firings` times. Throughput and mean tokens count from
    `warmup` (s) on. Without a horizon a goal is required; replicas that are dead before it count as
    not completed. `progress` is called with (firings, share of replicas still played). The time
    limit of the analysis (`overtime`) or Ctrl-C ends the simulation; its result is then marked as
    not complete. Raises ValueError for a missing horizon or goal.
    """
    if goal is None and not horizon < np.inf:
        raise ValueError("a simulation needs a horizon (s) or a goal")
    sizes = [min(BLOCK, replicas - first) for first in range(0, replicas, BLOCK)]
    played = [_Play(gspn, random, sizes[0], horizon, warmup, goal, lost)]
    fired = 0
    try:
        while True:
            block = played[-1]
            left = replicas - sum(sizes[: len(played)])
            while len(block.alive) and fired + block.fired < firings and not overtime():
                block.step()
                if progress and block.steps % 1000 == 0:
                    progress(fired + block.fired, (left + len(block.alive)) / replicas)
            if len(block.alive) or not left:
                break
            fired += block.fired
            size = sizes[len(played)]
            played.append(_Play(gspn, random, size, horizon, warmup, goal, lost))
        complete = not len(played[-1].alive)
    except KeyboardInterrupt:
        complete = False
    return _result(gspn, played, confidence, complete)


class _Play:
    """A running simulation; `alive` are the replicas still played (the columns of `state`)."""

    def __init__(
        self,
        gspn: Gspn,
        random: np.random.Generator,
        count: int,
        horizon: float,
        warmup: float,
        goal: Stop | None,
        lost: Stop | None,
    ) -> None:
        self.random, self.horizon, self.warmup = random, horizon, warmup
        self.goal, self.lost = goal, lost
        self.state = _Replicas(gspn, count)
        self.count, self.alive = count, np.arange(count)
        self.now = np.zeros(count)
        self.fired = self.steps = 0
        self.fires = np.zeros((len(gspn.net.transitions), count))
        self.area = np.zeros((len(gspn.net.places), count))
        self.observed = np.zeros(count)
        self.reached = np.full(count, np.nan)

    def step(self) -> None:
        """Fire once in every replica that is still played.

        The sojourn time is exponential with the sum of the amounts, and 0 in a vanishing marking.
        The transition is drawn by comparing one uniform number with the cumulative amounts.
        """
        amount, tangible = self.state.amounts()
        open_ = ~self._arrived(tangible)
        if not open_.all():
            self._keep(open_)
            amount, tangible = amount[:, open_], tangible[open_]
        if not len(self.alive):
            return
        total = np.add.accumulate(amount, axis=0)
        whole = total[-1] if len(total) else np.zeros(len(self.alive))
        stay = np.zeros(len(self.alive))
        moving = tangible & (whole > 0)
        stay[moving] = self.random.standard_exponential(int(moving.sum())) / whole[moving]
        stay[whole == 0] = np.inf
        chosen = (total <= self.random.random(len(self.alive)) * whole).sum(axis=0)
        after = self.now[self.alive] + stay
        self._observe(np.minimum(after, self.horizon))
        going = after < self.horizon
        self.now[self.alive] = np.minimum(after, self.horizon)
        if not going.all():
            self._keep(going)
            chosen = chosen[going]
        self.state.tokens += self.state.delta[:, chosen]
        counted = self.now[self.alive] >= self.warmup
        self.fires[chosen[counted], self.alive[counted]] += 1
        self.fired += len(chosen)
        self.steps += 1

    def _observe(self, until: Values) -> None:
        span = np.maximum(0.0, until - np.maximum(self.now[self.alive], self.warmup))
        span = np.where(np.isfinite(span), span, 0.0)
        stays = np.flatnonzero(span)  # most steps take no time
        self.area[:, self.alive[stays]] += self.state.tokens[:, stays] * span[stays]
        self.observed[self.alive[stays]] += span[stays]

    def _arrived(self, tangible: Mask) -> Mask:
        """Return which replicas have ended, and note when they reached the goal."""
        ended = np.zeros(len(self.alive), dtype=np.bool_)
        rests = np.flatnonzero(tangible)
        tokens = self.state.tokens[:, rests]
        if self.goal is not None:
            ended[rests] = self.goal(tokens)
            self.reached[self.alive[ended]] = self.now[self.alive[ended]]
        if self.lost is not None:
            ended[rests] |= self.lost(tokens)
        return ended

    def _keep(self, which: Mask) -> None:
        self.alive = self.alive[which]
        self.state.tokens = self.state.tokens[:, which]


def _result(gspn: Gspn, blocks: list[_Play], confidence: float, complete: bool) -> Simulation:
    """Return the estimates of the blocks that were played to their end, else of the first one."""
    played = [block for block in blocks if not len(block.alive)] or blocks[:1]
    count, active = sum(play.count for play in played), sum(len(play.alive) for play in played)
    observed = np.concatenate([play.observed for play in played])
    seen = observed > 0
    observed = observed[seen]

    def by_replica(parts: list[Values], names: Sequence[str]) -> dict[str, IntervalEstimate]:
        whole = np.concatenate(parts, axis=1)[:, seen]
        each = whole / observed if len(observed) else np.full((len(whole), 1), np.nan)
        return {
            name: IntervalEstimate.of(row, confidence)
            for name, row in zip(names, each, strict=True)
        }

    reached = np.concatenate([play.reached for play in played])
    times = np.sort(reached[~np.isnan(reached)])
    judged = count - active if played[0].goal is not None else 0
    return Simulation(
        count,
        active,
        sum(block.fired for block in blocks),
        by_replica([play.fires for play in played], gspn.net.transitions),
        by_replica([play.area for play in played], gspn.net.places),
        IntervalEstimate.share(len(times), judged, confidence) if judged else None,
        IntervalEstimate.of(times, confidence) if len(times) else None,
        times,
        complete,
    )


def goal_by_marking(predicate: Callable[[Marking], bool]) -> Stop:
    """Return a goal for `simulate` from a predicate. Its answers are remembered by marking."""
    known: dict[bytes, bool] = {}

    def stop(tokens: NDArray[np.int64]) -> Mask:
        columns = np.ascontiguousarray(tokens.T)
        out = np.empty(len(columns), dtype=np.bool_)
        if len(known) * tokens.shape[0] > REMEMBERED:
            known.clear()
        for i, column in enumerate(columns):
            key = column.tobytes()
            if key not in known:
                known[key] = predicate(tuple(column.tolist()))
            out[i] = known[key]
        return out

    return stop
