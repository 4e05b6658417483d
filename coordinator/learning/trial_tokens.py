"""Which trial each token of a mission run belongs to.

A trial begins when a token leaves the runs place. A task that works on several tokens at a time has
several trials at once, so what happens must be told to the trial whose token it moves. The engine's
tokens carry no name: in an action place a token is its run. Elsewhere a token of the trial whose
run the firing takes goes first, else the one that came first. Tokens of the initial marking, such
as resources, belong to no trial: a trial borrows them.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Collection, Sequence

from petrobot.coordinator.engine.instructions import Finished, Fired, Marked
from petrobot.coordinator.task import Kind, Status, Task

NOBODY = 0
"""The number of no trial; trials count from 1."""


class TrialTokens:
    """Follows the firings of a mission run. A task without a runs place is one trial."""

    def __init__(self, task: Task) -> None:
        flat = task.flat
        self._net = net = flat.net
        self._runs_place = net.place_index[flat.runs_place] if flat.runs_place else None
        self._actions = {
            net.place_index[p.name] for p in flat.places.values() if p.kind is Kind.ACTION
        }
        named = flat.final_error.names if flat.final_error is not None else frozenset()
        self._fatal = {net.place_index[name] for name in named if name in net.place_index}
        taken = {p for arcs in net.consume for p, _ in arcs}
        self._sinks = set(range(len(net.places))) - taken - self._fatal
        """Places where a token stays for ever, such as a counter of products."""
        self._listening = {net.place_index[p.name] for p in flat.places.values() if p.listen}
        resources = {p.name for p in flat.places.values() if p.kind is Kind.RESOURCE}
        self._settled = self._sinks | self._listening | {net.place_index[p] for p in resources}
        """Places where a token of no trial keeps no trial from its end, as in `final`."""
        stocks = {p.name for p in flat.places.values() if p.kind is Kind.CONTROL}
        filled = {p for arcs in net.produce for p, _ in arcs}
        self._lent = {p for p in filled - {self._runs_place} if net.places[p] not in stocks}
        """Places whose tokens come back. Those of a stock, such as screws, are used up."""
        self._free = [*net.initial]
        """By place: its tokens of no trial."""
        self._waiting: defaultdict[int, deque[int]] = defaultdict(deque)
        """By place: the trials of its other tokens, in the order in which they came."""
        self._entered: Counter[int] = Counter()
        self._runs: dict[str, int] = {}
        self._live: Counter[int] = Counter()
        self._borrowed: defaultdict[int, Counter[int]] = defaultdict(Counter)
        self._strayed: Counter[int] = Counter()
        """By place that is not settled: tokens that a branch of no trial has put there."""
        self.begun = NOBODY if flat.runs_place else 1
        """Number of trials that have begun; the latest one's number."""
        self._home: set[int] = set()
        """Trials that have all their tokens back while a branch of no trial is still busy. One that
        only listens is not: a trial that was over while it answered would have no end."""
        self.back: list[int] = []
        """Trials that ended with the latest firing: every token is back or consumed, also those of
        branches of no trial that do not only listen."""

    def of(self, run: str) -> int:
        """Return the trial of a run; of one that is not known, the latest."""
        return self._runs.get(run, self.begun) or self.begun

    def on_its_way(self, trial: int) -> bool:
        """Return whether a trial still has a token that may move."""
        return self._live[trial] > 0

    def fired(self, fired: Fired) -> int:
        """Follow a firing; return the trial to which it belongs. A firing of several trials, such
        as one that packs three parts, belongs to the latest of them; one that moves no trial's
        token belongs to the latest trial."""
        self.back = []
        own = self._runs_place
        if own is None:
            return self.begun
        index = self._net.transition_index[fired.transition]
        consumed, produced = dict(self._net.consume[index]), dict(self._net.produce[index])
        beside = {self._runs[run] for run in fired.runs if run in self._runs}
        borrowed: list[int] = []
        trials: list[int] = []
        for place in consumed.keys() & produced.keys():  # only read, and runs go on
            name = self._net.places[place]
            taken = sum(run.rpartition("#")[0] == name for run in fired.runs)
            least = min(consumed[place] - taken, produced[place])
            consumed[place] -= least
            produced[place] -= least
            if least and place in self._actions:
                trials += [*self._waiting[place]][:1]
        for place, weight in consumed.items():
            for _ in range(weight):
                owed = place in self._lent and self._free[place] <= self._net.initial[place]
                trial = self._take(place, fired.runs, beside)
                if trial != NOBODY:
                    trials.append(trial)
                elif owed:
                    borrowed.append(place)
        if fired.after[own] < fired.before[own]:
            self.begun += 1
            trials.append(self.begun)
        trial = max(trials, default=NOBODY)
        self._borrowed[trial].update(borrowed)
        touched = {*trials}
        for place, weight in produced.items():
            for _ in range(weight):
                touched.add(self._put(trial, place))
        self._home.update(t for t in touched - {NOBODY} if self._has_all(t))
        if not self._strayed.total() and not any(
            n for p, n in self._borrowed[NOBODY].items() if p not in self._listening
        ):
            self.back = sorted(self._home)
            self._home.clear()
        for done in touched:  # what is kept is as much as is on its way
            if done != NOBODY and self._has_all(done):
                self._borrowed.pop(done, None)
                del self._live[done]
        return trial or self.begun

    def _take(self, place: int, runs: Sequence[str] = (), beside: Collection[int] = ()) -> int:
        """Take a token out of a place: that of one of these runs, or the first one of a trial (of
        those `beside`, if it has one), or one of no trial. Return its trial."""
        waiting, name = self._waiting[place], self._net.places[place]
        known = [run for run in runs if run in self._runs and run.rpartition("#")[0] == name]
        of_runs = [trial for trial in waiting if trial in beside]
        first = next(iter(of_runs or waiting), NOBODY)
        trial = self._runs.pop(known[0]) if known else first
        if trial == NOBODY:
            self._free[place] -= 1
            self._strayed[place] -= self._strayed[place] > 0
        else:
            waiting.remove(trial)
            self._live[trial] -= place not in self._sinks
        return trial

    def marked(self, marked: Marked) -> None:
        """Follow a change of tokens by the operator; those that he adds belong to no trial."""
        for place, (before, after) in enumerate(zip(marked.before, marked.after, strict=True)):
            for _ in range(before - after):
                self._take(place)
            self._free[place] += max(0, after - before)

    def _put(self, trial: int, place: int) -> int:
        """Put a token of a trial into a place; return the trial to which it was owed."""
        if place in self._actions:
            self._entered[place] += 1
            self._runs[f"{self._net.places[place]}#{self._entered[place]}"] = trial
        if place == self._runs_place or self._free[place] < self._net.initial[place]:
            self._free[place] += 1
            for debtor in (trial, *self._borrowed):
                if self._borrowed[debtor][place] > 0:
                    self._borrowed[debtor][place] -= 1
                    return debtor
        elif trial == NOBODY:
            self._free[place] += 1
            self._strayed[place] += place not in self._settled
        else:
            self._waiting[place].append(trial)
            self._live[trial] += place not in self._sinks
        return trial

    def _has_all(self, trial: int) -> bool:
        return not self.on_its_way(trial) and not any(self._borrowed[trial].values())

    def lost(self, finished: Finished) -> set[int]:
        """Return the trials that a mission run has lost which ended in ERROR: those with a token
        where `final_error` looks; if there are none, all that are not back. A task without a runs
        place has lost its one trial."""
        if finished.status is Status.SUCCESS:
            return set()
        if self._runs_place is None:  # its tokens are not followed
            return {self.begun}
        fatal = {trial for place in self._fatal for trial in self._waiting[place]}
        return fatal or {t for t in range(1, self.begun + 1) if not self._has_all(t)}
