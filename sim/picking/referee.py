"""The referee: finds out where each part really is, for the score of a run and verdicts on
provisional results."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from petrobot.sim.picking.arm import ToolPose
from petrobot.sim.picking.parts import Part
from petrobot.sim.picking.world import PickingWorld

EXCHANGE: Final = 3.0
"""Time that a person needs to change a full tray (s)."""
_LOOK: Final = 0.02
"""Time between two checks (s)."""
_AWAY: Final = 0.12
"""Distance from a tray's middle at which the fingers are safe for the person's hands (m)."""


@dataclass(slots=True)
class _Delivery:
    """A part that was put into a tray: when (s), and whether the tray was the right one."""

    time: float
    right: bool


class Referee:
    """Watches the world. It also changes full trays, as a person would: it removes their parts and
    puts an empty tray there."""

    def __init__(
        self,
        world: PickingWorld,
        trays: Mapping[str, Any],
        belongs: Mapping[str, str],
        began: float,
    ) -> None:
        self._world, self._trays, self._belongs, self._began = world, trays, belongs, began
        self._due = began
        self._lies: dict[int, str] = {}
        self._deliveries: list[_Delivery] = []
        self._full_since: dict[str, float] = {}
        self._taken: list[tuple[Part, str]] = []
        self._changed = 0
        self._count = len(world.parts)

    def watch(self, now: float, tool: ToolPose) -> None:
        """Check the trays, and change the full ones."""
        if now < self._due - 1e-9:
            return
        self._due += _LOOK
        for name, tray in self._trays.items():
            inside = [part for part in self._world.parts if self._world.inside(part, tray)]
            for part in inside:
                if self._lies.get(part.number) != name:
                    right = self._belongs[part.kind] == name
                    self._deliveries.append(_Delivery(now, right))
                self._lies[part.number] = name
            for part in self._world.parts:
                if self._lies.get(part.number) == name and part not in inside:
                    del self._lies[part.number]
            self._exchange(now, name, tray, inside, tool)

    def _exchange(
        self, now: float, name: str, tray: Mapping[str, Any], inside: list[Part], tool: ToolPose
    ) -> None:
        x, y = tray["position"]
        away = math.hypot(tool.x - x, tool.y - y) > _AWAY
        if len(inside) < len(tray["slots"]) or not away:
            self._full_since.pop(name, None)
        elif now - self._full_since.setdefault(name, now) >= EXCHANGE:
            self._taken += [(part, name) for part in inside]
            self._world.parts = [part for part in self._world.parts if part not in inside]
            self._changed += 1

    def score(self, now: float, cycles: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Return where the parts are, and verdicts on provisional runs.

        `parts`, `in_tray` (the right one), `wrong_tray`, `on_table`, `lost` (fell off); `grips`,
        `slips`, `drops`, `struck`, `table_hits`: how often they happened; `trays_changed`; `time_s`
        since the beginning; `verdicts`: a part was put into its tray during the cycle, or not.
        """
        where = [
            (part, self._lies.get(part.number, "")) for part in self._world.parts
        ] + self._taken
        ends = Counter(
            "lost"
            if part.lost
            else "on_table"
            if not tray
            else "in_tray"
            if tray == self._belongs[part.kind]
            else "wrong_tray"
            for part, tray in where
        )
        return {
            "parts": self._count,
            **{key: ends[key] for key in ("in_tray", "wrong_tray", "on_table", "lost")},
            **self._world.counts,
            "trays_changed": self._changed,
            "time_s": round(now - self._began, 3),
            "verdicts": {
                run["run"]: verdict
                for cycle in cycles
                for run in cycle.get("provisional", ())
                if (verdict := self._verdict(now, cycle)) is not None
            },
        }

    def _verdict(self, now: float, cycle: Mapping[str, Any]) -> dict[str, str] | None:
        begun, ended = now - float(cycle["begun_ago"]), now - float(cycle["ended_ago"])
        came = [d for d in self._deliveries if begun <= d.time <= ended + _LOOK]
        if any(d.right for d in came):
            return {"status": "success", "cause": "", "text": ""}
        cause = "wrong_tray" if came else "not_in_tray"
        return {"status": "failure", "cause": cause, "text": "the referee saw where the part lies"}
