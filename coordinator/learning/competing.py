"""Competing risks: how runs end and when, where some were cut off (O. O. Aalen and S. Johansen,
Scand. J. Statistics 5 (1978)).

The cumulative incidence of cause s is CIF_s(t) = sum over t_i <= t of S(t_i-) d_s,i / n_i, with n_i
the runs still going on and S the probability of none of the causes so far. Cut-off runs count among
the n_i only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from petrobot.coordinator.learning.batch import Array


@dataclass(frozen=True)
class Incidence:
    """One cause: at `times` (s, increasing) its cumulative incidence has grown to `reached`."""

    times: Array
    reached: Array

    @property
    def share(self) -> float:
        """Probability of ending by this cause."""
        return float(self.reached[-1]) if len(self.reached) else 0.0

    @property
    def mean(self) -> float:
        """Mean time to the end, given this cause (s)."""
        return float(self.times @ self._mass())

    @property
    def cv(self) -> float:
        """Standard deviation over mean, given this cause."""
        mean = self.mean
        return sqrt(max(0.0, float(self.times**2 @ self._mass()) - mean**2)) / mean if mean else 0.0

    def _mass(self) -> Array:
        return np.diff(self.reached, prepend=0.0) / self.share


def incidences(times: Sequence[float], causes: Sequence[str | None]) -> dict[str, Incidence]:
    """Cumulative incidence of each cause; None: cut off. `times` in s.

    What is left of S behind the last time (it was cut off) goes to the causes in proportion to what
    they have: more is not known of it.
    """
    at = np.sort(np.asarray(times, dtype=float))
    of = [cause for _, cause in sorted(zip(times, causes, strict=True), key=lambda pair: pair[0])]
    moments, first = np.unique(at, return_index=True)
    going = len(at) - first
    known = sorted({c for c in of if c is not None})
    ended = {c: np.zeros(len(moments)) for c in known}
    for i, cause in zip(np.searchsorted(moments, at).tolist(), of, strict=True):
        if cause is not None:
            ended[cause][i] += 1
    hazard: Array = np.add.reduce([np.zeros(len(moments)), *ended.values()]) / going
    before = np.concatenate([[1.0], np.cumprod(1.0 - hazard)[:-1]]) if len(moments) else np.zeros(0)
    curves = {c: np.cumsum(before * d / going) for c, d in ended.items()}
    whole = sum(float(curve[-1]) for curve in curves.values())
    return {c: Incidence(moments, curve / whole) for c, curve in curves.items()}
