"""When the simulated camera exposes, when an image leaves it, and the cameras themselves, each
built once per process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from petrobot.sim.catching.camera import Picture, PinholeCamera
from petrobot.sim.catching.truth import Truth

_ON_TIME = 1e-9
"""How much rounding may change a time (s)."""
_NOISE_FIELD = 0x6361
"""Seed of a camera's noise field: the same whichever run comes first."""
_BUILT: dict[str, PinholeCamera] = {}


class Exposed(NamedTuple):
    """An image on its way out of the camera: it leaves at `ready`; `time` is the middle of its
    exposure (s)."""

    ready: float
    time: float
    sequence: int
    generation: int
    pixels: Picture


class Exposures:
    """The camera's clock. One request for images at a time."""

    def __init__(self) -> None:
        self.rate = 0.0
        self.generation = 0
        self._next = 0.0
        self._sequence = 0
        self._waiting: list[Exposed] = []

    def want(self, now: float, rate: float, generation: int) -> None:
        """Take `rate` images per second from now on (0: none); images exposed for an earlier
        request are not sent."""
        if rate > 0.0 and self.rate <= 0.0:
            self._next = now
        self.rate, self.generation = rate, generation
        self._waiting.clear()

    def due(self, now: float) -> bool:
        """Return whether an exposure has its middle at `now`; its clock advances whether the image
        is used or not."""
        if self.rate <= 0.0 or now < self._next - _ON_TIME:
            return False
        self._next = max(self._next, now - 1.0 / self.rate) + 1.0 / self.rate
        return True

    def put(self, now: float, ready: float, pixels: Picture) -> None:
        """Queue an image exposed at `now` that leaves the camera at `ready` (s); it must not be
        written any more."""
        pixels.flags.writeable = False
        self._waiting.append(Exposed(ready, now, self._sequence, self.generation, pixels))
        self._sequence += 1

    def take(self, until: float) -> list[Exposed]:
        """Return the images that leave up to `until` (s), in order."""
        if not self._waiting:
            return []
        count = 0
        while count < len(self._waiting) and self._waiting[count].ready <= until + _ON_TIME:
            count += 1
        gone, self._waiting = self._waiting[:count], self._waiting[count:]
        return gone


def camera_of(cell: Mapping[str, Any], truth: Truth, rng: np.random.Generator) -> PinholeCamera:
    """Return the camera as it is mounted in `truth`; `rng` chooses its noise until the next call.

    Drawing the static scene takes seconds, so cameras are cached; between two calls nothing of the
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
    factor, hidden = truth.scatter.exposure_factor, truth.scatter.hidden
    if factor != 1.0:
        camera_cell = {**cell["camera"], "exposure": factor * cell["camera"]["exposure"]}
        cell = {**cell, "camera": camera_cell}
    if truth.cup.radius != cell["cup"]["radius"]:
        cell = {**cell, "cup": {**cell["cup"], "radius": truth.cup.radius}}
    if hidden[0] < hidden[1]:
        view["hidden"] = hidden
    key = repr((view, [cell[part] for part in ("camera", "table", "ball", "cup")]))
    if key not in _BUILT:
        _BUILT[key] = PinholeCamera(cell, view, np.random.default_rng(_NOISE_FIELD))
    camera = _BUILT[key]
    camera.reseed(rng)
    return camera
