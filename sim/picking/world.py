"""The table with its parts, and a gripper over it, which pushes, holds, carries and drops them.

The arm's motion is an input (`PickingWorld.move`); the world computes how far the fingers close
and how hard they press. It knows neither actions nor a clock; all randomness comes from the
generator passed to it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from msgspec import Struct

from petrobot.sim.picking.gripper import FULL_DEPTH, Fingers, ToolPose, close_on
from petrobot.sim.picking.parts import Part, contact, rectangle, within

GRAVITY: Final = 9.81
_LAG: Final = 0.03
"""Time constant of the low pass that gives the tool's acceleration from its positions (s): servos
move in small steps, which the arm's compliance smooths."""
_LOW: Final = 0.0025
"""Height over the table up to which a released part stays as it was held (m)."""
_PLAY: Final = 5e-4
"""How far the fingers open before a part is free (m)."""
_JAM: Final = 0.003
"""How much wider than the gap a part may be and still be wedged between the fingers (m)."""
_TILTED: Final = 0.35
"""Greatest tilt from straight down at which the fingers can close on a part on the table (rad)."""


class Held(NamedTuple):
    """A part between the fingers: its pose in the gripper's frame, its depth between them (m), and
    how firmly it is held."""

    part: Part
    x: float
    y: float
    turn: float
    rise: float
    """Height of the part's bottom over the finger tips (m)."""
    size: float
    firmness: float


class TableTop(Struct):
    """The edges of the table: x from, to, y from, to (m)."""

    x: tuple[float, float]
    y: tuple[float, float]

    def carries(self, part: Part) -> bool:
        """Return whether a part's centre is over the table."""
        return self.x[0] <= part.x <= self.x[1] and self.y[0] <= part.y <= self.y[1]


class PickingWorld:
    """Parts and fingers, and how they act on each other."""

    def __init__(
        self, table: TableTop, fingers: Fingers, parts: Sequence[Part], rng: np.random.Generator
    ) -> None:
        self.table, self.fingers, self.parts = table, fingers, list(parts)
        self._rng = rng
        self.gap = fingers.opening
        """Gap between the fingers (m)."""
        self.load = 0.0
        """Force with which the fingers press (N)."""
        self.held: Held | None = None
        self.counts = {"grips": 0, "slips": 0, "drops": 0, "struck": 0, "table_hits": 0}
        """Counts of slips, drops and the like, for the referee."""
        self._tool: ToolPose | None = None
        self._smooth, self._speed = [0.0] * 3, [0.0] * 3
        self._sliding = 0.0

    def move(self, tool: ToolPose, wanted: float, force: float, dt: float) -> None:
        """Move the tool to its next pose within `dt` s, and the fingers to a gap of `wanted` m
        unless a part stops them; then they press with `force` (N)."""
        acceleration = self._accelerate(tool, dt)
        before, self._tool = self._tool, tool
        if before is not None and tool.z < 0.0 <= before.z:
            self.counts["table_hits"] += 1
        if self.held is not None:
            self._carry(tool, acceleration, dt)
        wanted = max(0.0, min(wanted, self.fingers.opening))
        if wanted > self.gap + _PLAY:
            self._let_go()
        self.load = 0.0 if self.held is None else max(0.0, force)
        if self.held is None:
            self.gap = wanted
        if self.held is None and self._low(tool):
            self._touch(tool, before)

    def _low(self, tool: ToolPose) -> bool:
        return any(tool.z < part.top and not part.lost for part in self.parts)

    def _accelerate(self, tool: ToolPose, dt: float) -> float:
        """Return the force per mass (m/s^2) that a held part needs: gravity and acceleration."""
        if self._tool is None:
            self._smooth = list(tool[:3])
        share, total = dt / (_LAG + dt), 0.0
        for k in range(3):
            step = share * (tool[k] - self._smooth[k])
            change = share * (step / dt - self._speed[k])
            self._smooth[k] += step
            self._speed[k] += change
            total += (change / dt + (GRAVITY if k == 2 else 0.0)) ** 2
        return math.sqrt(total)

    # Free fingers

    def _touch(self, tool: ToolPose, before: ToolPose | None) -> None:
        """Let the fingers push parts that they touch, and close on what is between them."""
        frame = tool.x, tool.y, tool.turn
        near = [
            part
            for part in self.parts
            if not part.lost
            and tool.z < part.top
            and math.hypot(part.x - tool.x, part.y - tool.y)
            < part.reach + self.gap / 2 + self.fingers.thickness + self.fingers.width
        ]
        for part in near:
            comes_down = before is not None and before.z >= part.top
            if self._push_aside(part, frame) and comes_down:
                self.counts["struck"] += 1
        if tool.tilt > _TILTED:
            return
        for part in sorted(near, key=lambda p: math.hypot(p.x - tool.x, p.y - tool.y)):
            grip = close_on(part, frame, self.gap, self.fingers)
            if grip is None:
                continue
            if grip.size > self.gap + _JAM:
                self._knock(part, frame)
                continue
            depth = min(1.0, (part.top - max(tool.z, part.z)) / FULL_DEPTH)
            self.gap = grip.size
            c, s = math.cos(tool.turn), math.sin(tool.turn)
            dx, dy = part.x - tool.x, part.y - tool.y
            self.held = Held(
                part,
                c * dx + s * dy,
                -s * dx + c * dy,
                part.turn - tool.turn,
                part.z - tool.z,
                grip.size,
                grip.firmness * depth,
            )
            self._sliding = 0.0
            self.counts["grips"] += 1
            break
        self._separate(near)

    def _knock(self, part: Part, frame: tuple[float, float, float]) -> None:
        """Knock a part away along the fingers: they come down on one that is too wide for their
        gap."""
        aside = -math.sin(frame[2]), math.cos(frame[2])
        y = (part.x - frame[0]) * aside[0] + (part.y - frame[1]) * aside[1]
        away = math.copysign(part.reach + self.fingers.width / 2, y) - y
        part.x, part.y = part.x + away * aside[0], part.y + away * aside[1]
        part.turn += float(self._rng.normal(0.0, 0.5))
        self.counts["struck"] += 1

    def _push_aside(self, part: Part, frame: tuple[float, float, float]) -> bool:
        """Push a part out of the fingers' bodies; return whether they touched it."""
        fingers, struck = self.fingers, False
        for side in (-1.0, 1.0):
            away = side * (self.gap + fingers.thickness) / 2
            x = frame[0] + math.cos(frame[2]) * away
            y = frame[1] + math.sin(frame[2]) * away
            if math.hypot(part.x - x, part.y - y) > part.reach + fingers.thickness + fingers.width:
                continue
            body = rectangle(x, y, frame[2], fingers.thickness, fingers.width)
            found = contact(body, part.outline())
            # parts at the finger's inner side are handled by `close_on`
            inner = (
                found is not None
                and (found.normal[0] * math.cos(frame[2]) + found.normal[1] * math.sin(frame[2]))
                * side
                < -0.7
            )
            if found is not None and not inner:
                part.push(found.normal, found.depth, found.point)
                struck = True
        return struck

    def _separate(self, moved: Sequence[Part]) -> None:
        """Push overlapping parts apart, those that were just moved first; a part that leaves the
        table falls."""
        queue = list(moved)
        for _ in range(4 * len(self.parts)):
            if not queue:
                break
            mover = queue.pop(0)
            for part in self.parts:
                if part is mover or part.lost or part.z >= mover.top or mover.z >= part.top:
                    continue
                if math.hypot(part.x - mover.x, part.y - mover.y) >= part.reach + mover.reach:
                    continue
                if self.held is not None and part is self.held.part:
                    continue
                found = contact(mover.outline(), part.outline())
                if found is not None and found.depth > 1e-6:
                    part.push(found.normal, found.depth, found.point)
                    queue.append(part)
        for part in self.parts:
            if not part.lost and not self.table.carries(part) and self._rests(part):
                part.lost = True

    def _rests(self, part: Part) -> bool:
        return self.held is None or self.held.part is not part

    # A part between the fingers

    def _carry(self, tool: ToolPose, needed: float, dt: float) -> None:
        """Move the held part with the fingers; it slips if they cannot give it the acceleration
        `needed` (m/s^2)."""
        held = self.held
        if held is None:
            return
        part = held.part
        capacity = 2.0 * part.friction * self.load * held.firmness
        lifted = part.z > 1e-4
        if lifted or self._sliding > 0.0:
            # without enough friction the part slides; with enough it slows down again
            excess = needed - capacity / part.mass
            self._sliding = max(0.0, self._sliding + excess * dt)
            held = self.held = held._replace(rise=held.rise - self._sliding * dt)
        c, s = math.cos(tool.turn), math.sin(tool.turn)
        part.x = tool.x + c * held.x - s * held.y
        part.y = tool.y + s * held.x + c * held.y
        part.turn = tool.turn + held.turn
        part.z = tool.z + held.rise
        if part.z < 0.0:  # it is on the table while the fingers move further down
            part.z, self.held, self._sliding = 0.0, held._replace(rise=-tool.z), 0.0
        if part.z < max((p.top for p in self.parts if p is not part), default=0.0):
            self._separate([part])
        if part.top <= tool.z + 0.001:
            self.counts["slips"] += 1
            self._fall(part, tool)

    def _let_go(self) -> None:
        if self.held is not None:
            part = self.held.part
            if part.z > _LOW:
                self.counts["drops"] += 1
            self._fall(part, self._tool)

    def _fall(self, part: Part, tool: ToolPose | None) -> None:
        """Let a part fall on the table: the higher the fall, the farther from the point of release
        it comes to rest; a round part rolls on."""
        height, self.held, self.load = part.z, None, 0.0
        if height > _LOW:
            away = (0.6 if part.round else 0.3) * height
            angle = float(self._rng.uniform(0.0, 2.0 * math.pi))
            part.x += away * math.cos(angle) * float(self._rng.uniform(0.3, 1.0))
            part.y += away * math.sin(angle) * float(self._rng.uniform(0.3, 1.0))
            part.turn += float(self._rng.normal(0.0, min(1.0, 10.0 * height)))
        part.z = 0.0
        if not self.table.carries(part):
            part.lost = True
            return
        for other in self.parts:
            if other is part or other.lost:
                continue
            found = contact(other.outline(), part.outline())
            if found is not None:
                part.x += found.normal[0] * found.depth
                part.y += found.normal[1] * found.depth
        self._separate([part])

    def inside(self, part: Part, tray: Mapping[str, Sequence[float]]) -> bool:
        """Return whether a part lies in a tray with its centre."""
        (x, y), (along, across) = tray["position"], tray["size"]
        outline = rectangle(x, y, 0.0, along, across)
        return not part.lost and self._rests(part) and within((part.x, part.y), outline)
