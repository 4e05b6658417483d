"""The shipped pick-and-place cell for tests: its files, parts, world and images."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from petrobot.sim.catching.truth import read_toml
from petrobot.sim.picking.camera import Picture, SceneCamera
from petrobot.sim.picking.gripper import Fingers, ToolPose
from petrobot.sim.picking.parts import Part
from petrobot.sim.picking.truth import LABORATORY_FILE, PickingSite
from petrobot.sim.picking.world import PickingWorld, TableTop

FILES = Path(__file__).parents[3] / "services" / "picking"
FINGERS = Fingers(0.065, 0.008, 0.014)
DT = 0.004
ABOVE, DOWN = 0.06, 0.006


def site(arm: str = "so101") -> PickingSite:
    """The shipped files with one arm."""
    return PickingSite(
        read_toml(FILES / "cell.toml"),
        read_toml(FILES / f"{arm}.toml"),
        read_toml(LABORATORY_FILE),
    )


@cache
def camera() -> SceneCamera:
    """The camera of the shipped installation."""
    shipped = site()
    return SceneCamera(shipped.camera(), shipped.settings["table"]["grey"], shipped.trays)


def scene(seed: int, regime: str = "plain") -> tuple[list[Part], Picture]:
    """Parts of a seed, and what the camera sees of them."""
    shipped, rng = site(), np.random.default_rng(seed)
    truth = shipped.truth(regime)
    parts = shipped.parts(truth, rng)
    light = truth.light(float(rng.uniform(-3.0, 3.0)))
    return parts, camera().take(parts, [], 0.02, light, rng)


def cube(x: float = 0.0, y: float = 0.0, turn: float = 0.0, **other: float) -> Part:
    """A cube of 20 mm."""
    values = {"mass": 0.02, "friction": 0.4, **other}
    return Part(0, "cube", False, 0.02, 0.02, 0.02, values["mass"], values["friction"], 200.0,
                x, y, turn)  # fmt: skip


def puck(x: float = 0.0, y: float = 0.0, diameter: float = 0.024, **other: float) -> Part:
    """A disc of 20 mm height."""
    values = {"mass": 0.02, "friction": 0.4, **other}
    return Part(1, "puck", True, diameter, diameter, 0.02, values["mass"], values["friction"],
                200.0, x, y)  # fmt: skip


class Crane:
    """Fingers over a table, moved by the test: the world without an arm."""

    def __init__(self, *parts: Part) -> None:
        self.world = PickingWorld(
            TableTop((-0.2, 0.2), (-0.2, 0.2)), FINGERS, parts, np.random.default_rng(1)
        )
        self.pose = [0.0, 0.0, ABOVE, 0.0]
        self.gap = FINGERS.opening
        self.force = 6.0

    def go(self, x: float = 0.0, y: float = 0.0, z: float = ABOVE, seconds: float = 1.0) -> None:
        """Move there along a line, with a smooth beginning and end."""
        begin, count = self.pose[:3], round(seconds / DT)
        for k in range(1, count + 1):
            s = k / count
            share = s * s * (3.0 - 2.0 * s)
            place = [a + share * (b - a) for a, b in zip(begin, (x, y, z), strict=True)]
            self.pose[:3] = place
            self._tick()

    def set_gap(self, gap: float) -> None:
        """Open or close the fingers at 0.1 m/s."""
        step = 0.1 * DT
        for _ in range(round(abs(gap - self.gap) / step)):
            self.gap += step if gap > self.gap else -step
            if self.world.held is not None and gap < self.gap:
                self.gap = self.world.gap
            self._tick()

    def pick(self, x: float = 0.0, y: float = 0.0, closing: float = 0.0) -> bool:
        """Go down, close, lift; return whether something is held."""
        self.go(x, y, ABOVE)
        self.go(x, y, DOWN)
        self.set_gap(closing)
        self.go(x, y, ABOVE)
        return self.world.held is not None

    def _tick(self) -> None:
        x, y, z, turn = self.pose
        self.world.move(ToolPose(x, y, z, turn, 0.0), self.gap, self.force, DT)
