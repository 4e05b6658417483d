"""Pipes between a node and its processes: messages, permits, newest states, ends of processes."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
from typing import Any

import pytest

from petrobot.services.comm.protocol.messages import (
    Call,
    Cancel,
    Executed,
    Outcome,
)
from petrobot.services.host.parent_death import until_ended
from petrobot.services.node.inline_host import HOLD, answer_of
from petrobot.services.worker.pipe import (
    MALFORMED,
    NewestLink,
    Permits,
    Pipe,
    link_pair,
    permit_counter,
)
from tests.waiting import Limit


@pytest.mark.parametrize(
    "what",
    [
        Call("r", "act", {"a": [1, {"b": b"x"}]}, 1.5, seed=3),
        Cancel("r", "deadline: late"),
        Outcome("r/1", "success", {"x": 1}),
        HOLD,
        Outcome("r", "error", {}, "lost", "text", Executed.NO, 0.5, 0.1),
        answer_of("c", "held", {"q": [0.0]}),
    ],
)
def test_messages_cross_a_socket(what: Any) -> None:
    near, far = socket.socketpair()
    a, b = Pipe(near), Pipe(far)
    a.post(what)
    assert b.read() == [what]
    a.close()
    assert b.read() == [] and b.closed
    b.close()


@pytest.mark.parametrize("items", [[4, 1], [999, "x"], [True], [7, "r", "success", {}, "", "", 1]])
def test_a_list_that_is_not_a_message_is_read_in_order(items: list[Any]) -> None:
    near, far = socket.socketpair()
    a, b = Pipe(near), Pipe(far)
    a.post(["before"])
    a.post(items)
    first, word = b.read()
    assert first == ["before"] and isinstance(word, list) and word[0] == MALFORMED
    a.close()
    b.close()


def test_a_pipe_buffers_what_does_not_fit() -> None:
    near, far = socket.socketpair()
    a, b = Pipe(near), Pipe(far)
    for n in range(40):
        a.post(["n", n, bytes(100_000)])
    assert bool(a.unsent)
    got: list[int] = []
    limit = Limit("40 items")
    while len(got) < 40 and limit.left():
        got += [items[1] for items in b.read() if isinstance(items, list)]
        a.flush()
    assert (got, a.unsent) == (list(range(40)), False)
    b.close()
    a.post(["1"])
    a.post(["2"])
    assert a.closed
    a.close()


def test_a_bounded_read_leaves_the_rest_to_the_next() -> None:
    """Although the other end writes without end: each read finds more than it may take."""
    near, far = socket.socketpair()
    a, b = Pipe(near), Pipe(far)
    for n in range(40):
        a.post(["n", n, bytes(1000)])
    parts = [b.read(10_000) for _ in range(5)]
    assert [len(part) for part in parts] == [9, 10, 10, 10, 1]
    assert [item[1] for part in parts for item in part if isinstance(item, list)] == list(range(40))
    a.close()
    assert b.read(10_000) == [] and b.ended
    b.close()


def test_last_messages_are_read_although_the_other_end_reads_no_more() -> None:
    near, far = socket.socketpair()
    a, b = Pipe(near), Pipe(far)
    b.post(["last", "words"])
    b.close()
    a.post(["1"])
    assert a.closed and a.read() == [["last", "words"]]
    a.close()


def test_bytes_that_are_not_a_record_are_refused() -> None:
    near, far = socket.socketpair()
    a = Pipe(near)
    far.send(b"\xc1")
    with pytest.raises(ValueError):
        a.read()
    a.close()
    far.close()


def test_each_permit_is_taken_once_also_after_the_end_of_the_worker() -> None:
    descriptor = permit_counter()
    node, worker = Permits(os.dup(descriptor)), Permits(descriptor)
    for _ in range(3):
        node.give()
    assert worker.take()
    worker.close()
    assert [node.take() for _ in range(3)] == [True, True, False]
    node.close()


@pytest.mark.processes
@pytest.mark.parametrize("missing", [False, True])
async def test_the_end_of_a_process_is_noticed_even_if_its_pipe_stays_open(
    missing: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the kernel's notification of the end, and without it (before Linux 5.3)."""
    if missing:
        monkeypatch.delattr(os, "pidfd_open")
    process = subprocess.Popen(
        ["sh", "-c", "sleep 60 & echo $!; exec sleep 60"], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    holder = int(process.stdout.readline())
    waiting = asyncio.create_task(until_ended(process.pid))
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(asyncio.shield(waiting), 0.1)
    process.kill()
    await asyncio.wait_for(waiting, 60.0)
    assert process.wait(60.0) == -signal.SIGKILL
    os.kill(holder, signal.SIGKILL)
    process.stdout.close()


def test_only_the_newest_state_is_kept() -> None:
    near, far = link_pair()
    driver, actions = NewestLink(near), NewestLink(far)
    for n in range(5):
        assert driver.send([n])
    assert actions.newest() == [4] and actions.newest() is None
    assert [actions.send([n]) for n in range(3)] == [True] * 3
    assert driver.read() == [[0], [1], [2]]
    with pytest.raises(ValueError, match="do not fit into one datagram"):
        driver.send([bytes(1 << 20)])
    sent, limit = 0, Limit("a full line", steps=100_000)
    while driver.send([bytes(1000)]) and limit.left():
        sent += 1
    assert (sent > 10, driver.closed) == (True, False), (
        "a reader that stands still must not stop the writer"
    )
    actions.close()
    assert (driver.send([0]), driver.closed) == (False, True)
    driver.close()
