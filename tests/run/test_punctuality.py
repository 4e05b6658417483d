"""When a host counts as too busy: a share of late checks, or one long gap; a single late check is
not reported."""

from __future__ import annotations

import pytest

from petrobot.coordinator.run import realtime
from petrobot.coordinator.run.realtime import LATE, PERIOD, WORST, Punctuality
from petrobot.services.host.emergency_latch import uptime


@pytest.mark.parametrize(
    ("delays", "told"),
    [
        ([], ""),
        ([0.001] * 500, ""),
        ([0.001] * 499 + [2 * LATE], ""),
        ([0.001] * 495 + [2 * LATE] * 6, "more than 20 ms late 6 of 501 times, by 40 ms at most"),
        ([0.001] * 499 + [WORST + 0.01], "more than 20 ms late 1 of 500 times, by 70 ms at most"),
        ([0.001, 20.0], "by 20000 ms at most; what failed may be due to that (its process was sto"),
    ],
)
def test_when_lateness_is_reported(delays: list[float], told: str) -> None:
    seen, due = Punctuality(), 5.0
    for delay in delays:
        now = due + delay
        due = seen.look(due, now)
        assert due == now + PERIOD, "a delay is counted once"
    assert told in seen.remark()
    assert bool(seen.remark()) == bool(told)


def test_a_computer_that_was_suspended_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop's clock stood still, so no check was late."""
    seen = Punctuality()
    monkeypatch.setattr(realtime, "uptime", lambda: uptime() + 3600.0)
    assert seen.remark().startswith("suspended for 3600 s in this run")
