"""When the simulated camera exposes, when an image leaves it, and the cameras themselves: each is
built once a process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from petrobot.sim.catching.camera import Picture, PinholeCamera
from petrobot.sim.catching.truth import Truth

_ON_TIME = 1e-9
"""s of rounding."""
_NOISE_FIELD = 0x6361
"""Seed of a camera's noise field: the same one whichever run comes first."""
_BUILT: dict[str, PinholeCamera] = {}


class Exposed(NamedTuple):
    """An image on its way out of the camera: leaves at `ready`, its exposure's middle was at `time`
    (s)."""

    ready: float
    time: float
    sequence: int
    generation: int
    pixels: Picture


class Exposures:
    """The camera's clock. One wish for images at a time."""

    def __init__(self) -> None:
        self.rate = 0.0
        self.generation = 0
        self._next = 0.0
        self._sequence = 0
        self._waiting: list[Exposed] = []

    def want(self, now: float, rate: float, generation: int) -> None:
        """From now on `rate` images a second (0: none); what was exposed for an earlier wish is not
        sent."""
        if rate > 0.0 and self.rate <= 0.0:
            self._next = now
        self.rate, self.generation = rate, generation
        self._waiting.clear()

    def due(self, now: float) -> bool:
        """Whether an exposure has its middle at `now`; its clock goes on whether the image is used
        or not."""
        if self.rate <= 0.0 or now < self._next - _ON_TIME:
            return False
        self._next = max(self._next, now - 1.0 / self.rate) + 1.0 / self.rate
        return True

    def put(self, now: float, ready: float, pixels: Picture) -> None:
        """An image exposed at `now` leaves the camera at `ready` (s); nobody writes to it any
        more."""
        pixels.flags.writeable = False
        self._waiting.append(Exposed(ready, now, self._sequence, self.generation, pixels))
        self._sequence += 1

    def take(self, until: float) -> list[Exposed]:
        """Images that leave up to `until` (s), in order."""
        count = 0
        while count < len(self._waiting) and self._waiting[count].ready <= until + _ON_TIME:
            count += 1
        gone, self._waiting = self._waiting[:count], self._waiting[count:]
        return gone


def camera_of(cell: Mapping[str, Any], truth: Truth, rng: np.random.Generator) -> PinholeCamera:
    """The camera as it hangs in `truth`, its noise chosen by `rng` until the next call.

    Drawing the still scene takes seconds, so cameras are kept; between two calls nothing of the
    last user stays in them.
    """
    true = truth.camera
    view: dict[str, Any] = {
        "position": true.position.tolist(),
        "rotation": true.rotation.tolist(),
        "focal_px": true.focal_px,
        "principal_px": true.principal_px,
        "distortion": true.distortion,
        "table_top": truth.table.top,
        "near_edge": truth.table.near_edge,
        "light_gradient": truth.light_gradient,
        "vignetting": truth.vignetting,
    }
    key = repr((view, [cell[part] for part in ("camera", "table", "ball", "cup")]))
    if key not in _BUILT:
        _BUILT[key] = PinholeCamera(cell, view, np.random.default_rng(_NOISE_FIELD))
    camera = _BUILT[key]
    camera.reseed(rng)
    return camera
