"""How punctual the coordinator's own event loop is: its host's load, seen by one who only wants to
wake up in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

PERIOD: Final = 0.05
"""Seconds between looks."""
LATE: Final = 0.02
"""Seconds of delay from which a look counts as late: a period of a set-point stream at 50 Hz."""
SHARE: Final = 0.01
"""Share of late looks from which the host counts as too busy for a run in real time,"""
WORST: Final = 3 * LATE
"""and a single delay (s) from which it does: so long a gap takes a set point of such a stream out
of force."""


@dataclass
class Punctuality:
    """Counts looks that were to happen every `PERIOD` seconds; a machine without clock."""

    looks: int = 0
    late: int = 0
    worst: float = 0.0
    """The longest delay (s)."""

    def look(self, due: float, now: float) -> float:
        """Take in that the look that was due came now; gives when the next one is due (s)."""
        self.looks += 1
        self.late += now - due > LATE
        self.worst = max(self.worst, now - due)
        return now + PERIOD

    def remark(self) -> str:
        """What to say of it: empty if the host was not too busy."""
        if self.worst < WORST and self.late <= SHARE * self.looks:
            return ""
        return (
            f"too busy for real time: the coordinator woke up more than {1e3 * LATE:g} ms "
            f"late {self.late} of {self.looks} times, "
            f"by {1e3 * self.worst:.0f} ms at most; what failed may be due to that"
        )
