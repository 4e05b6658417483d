"""Light over the floor: a slow drift, and flashes of spectators' cameras."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from petrobot.sim.track_truth import LightTruth


class Light(NamedTuple):
    """What falls on the floor: a factor on the nominal light, and stray light in the lens (grey
    levels)."""

    level: float
    veil: float


class Hall:
    """The hall's light from `began` (s) on; asked for moments that never go back. Flashes come at
    random, with `rng`."""

    def __init__(self, truth: LightTruth, rng: np.random.Generator, began: float) -> None:
        self._truth = truth
        self._rng = rng
        self._began = began
        self._phase = float(rng.uniform(0.0, 2.0 * math.pi))
        self._flash = began, began
        self._next_flash(began)

    def at(self, now: float) -> Light:
        """The light at a moment (s)."""
        truth = self._truth
        angle = 2.0 * math.pi * (now - self._began) / truth.period + self._phase
        level = truth.level * (1.0 + truth.drift * math.sin(angle))
        while now >= self._flash[1]:
            self._next_flash(self._flash[1])
        if now >= self._flash[0]:
            return Light(level * truth.flash_gain, truth.flash_veil)
        return Light(level, 0.0)

    def _next_flash(self, after: float) -> None:
        if self._truth.flash_rate <= 0.0:
            self._flash = math.inf, math.inf
            return
        start = after + float(self._rng.exponential(1.0 / self._truth.flash_rate))
        self._flash = start, start + float(self._rng.uniform(*self._truth.flash_duration))
