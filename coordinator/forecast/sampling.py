"""Draws ends of runs and waits from laws, for many replicas at once, each with its own bootstrap
weights of the throws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from petrobot.coordinator.forecast.history import CUT, Codes, Seen, Values
from petrobot.coordinator.forecast.laws import Context, Law, Laws

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Ends:
    """Drawn ends of runs. Arrays (columns,)."""

    outcome: Codes
    preempted: Mask
    took: Values
    """s; infinite where no run was ever seen to end."""
    beyond: Mask
    """It lasts longer than any run that was seen: its end is an extrapolation."""


class Drawer:
    """`weights` (replicates, throws): how often each training throw counts in each replicate; `of`
    each column's replicate."""

    def __init__(
        self,
        laws: Laws,
        waits: Mapping[str, tuple[Values, Codes]],
        weights: Values,
        random: np.random.Generator,
    ) -> None:
        self._laws, self._waits, self._weights, self._random = laws, waits, weights, random
        self._bounds: dict[object, Values] = {}

    def ends(self, place: int, action: Codes, replicate: Codes, seen: Seen) -> Ends:
        """Ends of runs that begin now in a place, given what had ended before.

        Raises KeyError for an action that was never run there.
        """
        n = len(action)
        out = Ends(np.zeros(n, np.int64), np.zeros(n, np.bool_), np.zeros(n), np.zeros(n, np.bool_))
        for code in np.unique(action):
            top = self._laws.contexts[place, int(code)]
            self._descend(top, np.flatnonzero(action == code), replicate, seen, out)
        return out

    def _descend(
        self, node: Context, columns: Codes, replicate: Codes, seen: Seen, out: Ends
    ) -> None:
        if node.split is None:
            self._draw_leaf(node, columns, replicate, seen, out)
            return
        child = node.split.child(seen.of(columns), len(node.children))
        for c, below in enumerate(node.children):
            own = columns[child == c]
            if len(own):
                self._descend(below, own, replicate, seen, out)

    def _draw_leaf(
        self, leaf: Context, columns: Codes, replicate: Codes, seen: Seen, out: Ends
    ) -> None:
        """First the outcome, then the duration from the outcome's own tree."""
        law = leaf.law
        index = self._draw(leaf.number, law.weight, law.throw, replicate[columns])
        if not leaf.durations and not law.beyond.any():
            out.took[columns] = law.took[index] + _along(law, index, seen.took[:, columns])
            np.clip(out.took, 0.0, None, out=out.took)
            return
        out.outcome[columns], out.preempted[columns] = law.outcome[index], law.preempted[index]
        beyond = law.beyond[index]
        if beyond.any():
            self._draw_beyond(leaf, columns[beyond], replicate, out)
        for code, tree in leaf.durations.items():
            own = columns[law.outcome[index] == code]
            if len(own):
                self._descend(tree, own, replicate, seen, out)

    def _draw_beyond(self, leaf: Context, columns: Codes, replicate: Codes, out: Ends) -> None:
        """Longer than the longest run: at a constant rate, with outcomes in the shares of those
        that were seen."""
        law, seen = leaf.law, np.flatnonzero(~leaf.law.beyond)
        out.beyond[columns] = True
        if not law.rate or not len(seen):
            out.outcome[columns], out.preempted[columns], out.took[columns] = CUT, False, np.inf
            return
        index = seen[
            self._draw(
                (leaf.number, "beyond"), law.weight[seen], law.throw[seen], replicate[columns]
            )
        ]
        out.outcome[columns], out.preempted[columns] = law.outcome[index], law.preempted[index]
        out.took[columns] = law.took.max() - np.log1p(-self._random.random(len(columns))) / law.rate

    def wait(self, transition: str, replicate: Codes) -> Values | None:
        """Waits of a transition (s), one for each column; None if it was never measured."""
        if transition not in self._waits:
            return None
        seconds, throws = self._waits[transition]
        index = self._draw(transition, np.full(len(seconds), 1.0 / len(seconds)), throws, replicate)
        drawn: Values = seconds[index]
        return drawn

    def _draw(self, key: object, weight: Values, throws: Codes, replicate: Codes) -> Codes:
        """A member for each column, by its replicate's weights; by the plain ones where those leave
        none."""
        bounds = self._bounds.get(key)
        if bounds is None:
            each = weight * self._weights[:, throws]
            each = np.where(each.sum(axis=1, keepdims=True) > 0, each, weight)
            bounds = np.cumsum(each, axis=1)
            bounds = bounds / bounds[:, -1:] + np.arange(len(bounds))[:, None]
            self._bounds[key] = bounds
        members = bounds.shape[1]
        at = np.searchsorted(
            bounds.ravel(), replicate + self._random.random(len(replicate)), side="right"
        )
        index: Codes = np.clip(at - replicate * members, 0, members - 1)
        return index

    def chance(self, n: int) -> Values:
        """Uniform numbers."""
        return self._random.random(n)


def _along(law: Law, index: Codes, took: Values) -> Values:
    """What the trend of a law adds to drawn durations, for columns in which other runs took other
    times before."""
    if law.trend is None:
        return np.zeros(len(index))
    now = took[law.trend.place]
    return law.trend.slope * np.where(np.isnan(now), 0.0, now - law.trend.earlier[index])
