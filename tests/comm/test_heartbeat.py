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
    assert seen[:3] == [(0.25, Beat.PING), (0.5, Beat.PING), (0.75, Beat.PING)]
    assert seen[3:] == [(1.0, Beat.NOTHING), (1.0, Beat.LOST)], "sockets are read in between"


def test_received_bytes_postpone_the_end() -> None:
    heart = Heartbeat(0.0, LinkTiming())
    for tick in range(1, 40):
        heart.heard = tick * 0.25 - 0.1
        heart.quiet = 0
        assert heart.advance(heart.due()) is Beat.NOTHING
    assert heart.due() == pytest.approx(10.0)


def test_who_only_hears_is_heard() -> None:
    heart = Heartbeat(0.0, LinkTiming())
    seen = []
    for _ in range(4):
        heart.heard = heart.due()
        seen.append(heart.advance(heart.due()))
        if seen[-1] is Beat.PING:
            heart.quiet = 0
    assert seen == 2 * [Beat.NOTHING, Beat.PING]


@pytest.mark.parametrize(
    "turns",
    [(5.0,), (0.25, 0.95), (0.65, 1.05), (0.25, 0.6, 0.95)],
    ids=["frozen once", "frozen while PONG was on its way", "late twice", "late at each turn"],
)
def test_time_in_which_this_process_did_not_run_is_no_silence_of_the_other_side(
    turns: tuple[float, ...],
) -> None:
    heart = Heartbeat(0.0, LinkTiming())
    late = 0.0
    for now in turns:
        late += now - heart.due()
        assert heart.advance(now) is Beat.PING
    limit = Limit("the loss of the peer", steps=10)
    while heart.advance(heart.due()) is not Beat.LOST and limit.left():
        pass
    assert heart.due() == pytest.approx(1.0 + late)


def test_what_arrived_while_this_process_was_frozen_is_read_before_the_other_side_is_lost() -> None:
    heart = Heartbeat(0.0, LinkTiming())
    for now in (0.25, 0.5, 0.75):
        assert heart.advance(now) is Beat.PING
        heart.quiet = 0
    assert heart.advance(1.5) is Beat.NOTHING
    heart.heard = 1.5
    assert heart.due() == 1.5
    assert heart.advance(1.5) is Beat.NOTHING
    assert heart.due() == 1.75
