"""The digital-input node on the arm's bus (CiA 401): light barrier in the cup and arm-power
chain."""

from __future__ import annotations

import math
from typing import Final

from petrobot.sim.canopen_node import CanopenNode


class DigitalInputs(CanopenNode):
    """Eight inputs in object 6000h:1, sent on change and by the event timer (1800h:5, ms)."""

    BALL: Final = 0x01
    """Light barrier interrupted: something is in the cup."""
    POWER: Final = 0x02
    """Arm-power chain closed."""

    def __init__(self, node: int) -> None:
        super().__init__(node, "digital_inputs.eds")
        self.inputs = self.POWER
        self._sent = -1
        self._due = 0.0

    def put(self, mask: int, on: bool) -> None:
        """Set or clear inputs."""
        self.inputs = self.inputs | mask if on else self.inputs & ~mask

    def before_sending(self) -> None:
        """Show the inputs."""
        if self.values[0x6000, 1] != self.inputs:
            self.values[0x6000, 1] = self.inputs
            self.changed()

    def due(self) -> float:
        """At once while a change is still to be sent."""
        if self.tpdo.synchronous:
            return super().due()
        if self.inputs != self._sent:
            return -math.inf
        return min(super().due(), self._due) if self.values[0x1800, 5] else super().due()

    def advance(self, now: float) -> None:
        """Send on change, and again when the event timer says so."""
        super().advance(now)
        timer = self.values[0x1800, 5] * 1e-3
        if not self.tpdo.synchronous and (
            self.inputs != self._sent or (timer and now >= self._due)
        ):
            before = len(self.outbox)
            self.send_tpdo()
            if len(self.outbox) > before:
                self._sent, self._due = self.inputs, now + timer
