"""The heartbeat of a link, without sockets: when it pings, and when the other side counts as
lost."""

from __future__ import annotations

import pytest

from petrobot.services.comm.calls.link import Beat, Heartbeat, LinkTiming
from tests.waiting import Limit


def test_it_pings_and_then_gives_up() -> None:
    heart = Heartbeat(0.0, LinkTiming())
    seen: list[tuple[float, Beat]] = []
    limit = Limit("the loss of the peer", steps=10)
    while (not seen or seen[-1][1] is not Beat.LOST) and limit.left():
        seen.append((heart.due(), heart.advance(heart.due())))
    assert seen == [(0.25, Beat.PING), (0.5, Beat.PING), (0.75, Beat.PING), (1.0, Beat.LOST)]


def test_received_bytes_postpone_the_end() -> None:
    heart = Heartbeat(0.0, LinkTiming())
    for tick in range(1, 40):
        heart.heard = tick * 0.25 - 0.1
        assert heart.advance(heart.due()) is Beat.NOTHING
    assert heart.due() == pytest.approx(10.0)


def test_a_process_that_was_frozen_itself_reads_before_it_gives_the_other_side_up() -> None:
    heart = Heartbeat(0.0, LinkTiming())
    assert heart.advance(5.0) is Beat.PING
    assert heart.due() == pytest.approx(5.25)
    assert heart.advance(5.25) is Beat.LOST
