"""A value that cannot be sent ends only the run that made it: never the connection, a worker or
another run."""

from __future__ import annotations

import asyncio
import math
import select
import socket
import threading
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from petrobot.services.action import Result, Status, success
from petrobot.services.comm.calls.caller import PeerLost
from petrobot.services.comm.calls.link import LinkTiming
from petrobot.services.comm.location_file import parse
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.codec import ProtocolError, decode, encode
from petrobot.services.worker.context import checked, checked_result
from petrobot.services.worker.pipe import Pipe
from tests.node.conftest import Bench
from tests.node.test_driver_faults import OneNode
from tests.node.test_kills import LINK
from tests.node.test_processes import PATIENCE, Operator, operator_of
from tests.ports import free_ports
from tests.waiting import Limit

CELL = """\
schema = 1
[nodes.only]
host = "127.0.0.1"
port = {port}
[devices.slide]
node = "only"
driver = "toy_cell.drivers:Slide"
period = 0.02
[streams.points]
to = "slide"
period = 0.02
[services.memory]
node = "only"
[services.sum_service]
node = "only"
run = "toy_cell.actions:add"
[services.serve]
node = "only"
run = "toy_cell.poison:serve"
[services.wait_and_give]
node = "only"
run = "toy_cell.poison:give"
[actions]
give = {{ run = "toy_cell.poison:give", task = "give", node = "only" }}
nap = {{ run = "toy_cell.actions:nap", task = "nap", node = "only" }}
echo = {{ run = "toy_cell.poison:echo", task = "echo", node = "only" }}
"""


def table(*names: str) -> list[str]:
    from toy_cell import poison  # type: ignore[import-not-found]  # tests/node/outside

    return [kind for name in names for kind in getattr(poison, name)]


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OneNode]:
    one = OneNode(tmp_path_factory.mktemp("poison"), CELL.format(port=free_ports(1)[0]))
    one.until_ready()
    yield one
    one.stop()


@pytest.fixture
async def operator(node: OneNode) -> AsyncIterator[Operator]:
    async with operator_of(node.directory, "only", timing=LinkTiming()) as one:
        yield one


async def ends_alone(operator: Operator, service: str, kind: str, cause: str) -> m.Outcome:
    """Check that the run ends with this cause, and that another run and the connection are not
    affected. If the host is so busy that the node does not run for a second, try again."""
    limit = Limit("a try in which the node always runs")
    while True:
        operator.notices.clear()
        innocent = asyncio.create_task(operator.call("nap", None, seconds=0.1))
        end = await operator.call(service, None, kind=kind)
        if {end.cause, (await innocent).cause}.isdisjoint(LINK):
            break
        assert limit.left() and await operator.clients["only"].connected(PATIENCE)
    assert (end.status, end.cause, end.executed) == ("error", cause, "yes"), end
    assert end.text and len(end.text) < 5_000
    told = await innocent
    assert told.status == "success", told
    assert not [notice for notice in operator.notices if isinstance(notice, PeerLost)]
    return end


@pytest.mark.processes
@pytest.mark.parametrize("kind", table("RESULTS"))
async def test_results_of_an_action(operator: Operator, kind: str) -> None:
    end = await ends_alone(operator, "give", kind, "bad_result")
    if kind == "long cause":
        assert (
            "cause: expected at most 255 characters, found 1,234: put long words into the text"
            in end.text
        )


@pytest.mark.processes
@pytest.mark.parametrize("seconds", [math.inf, 1e12])
async def test_a_wait_without_an_end_ends_at_its_deadline(
    operator: Operator, seconds: float
) -> None:
    end = await operator.call("nap", 0.3, seconds=seconds)
    assert (end.status, end.cause) == ("error", "deadline"), end
    assert end.text.startswith("took longer than its deadline of 0.3 s"), end
    assert (await operator.call("nap", None, seconds=0.01)).status == "success"


@pytest.mark.processes
@pytest.mark.parametrize("kind", table("RAISES", "SAYS", "ASKS"))
async def test_exceptions_events_and_calls_of_an_action(operator: Operator, kind: str) -> None:
    await ends_alone(operator, "give", kind, "exception")


@pytest.mark.processes
@pytest.mark.parametrize("kind", table("RESULTS"))
@pytest.mark.parametrize("service", ["serve", "wait_and_give"])
async def test_results_of_a_service(operator: Operator, service: str, kind: str) -> None:
    await ends_alone(operator, service, kind, "bad_result")


@pytest.mark.processes
@pytest.mark.parametrize("kind", table("RAISES"))
@pytest.mark.parametrize("service", ["serve", "wait_and_give"])
async def test_exceptions_of_a_service(operator: Operator, service: str, kind: str) -> None:
    await ends_alone(operator, service, kind, "exception")


def test_many_large_records_at_once() -> None:
    """Each record fits; together they are larger than a pipe's buffer."""
    near, far = socket.socketpair()
    worker, node = Pipe(near), Pipe(far)
    large = bytes(15 << 20)
    for number in range(6):
        worker.post(["large", number, large])
    writing = threading.Thread(target=lambda: flush_all(worker))
    writing.start()
    got: list[list[Any]] = []
    until = time.monotonic() + 60.0
    while len(got) < 6 and time.monotonic() < until:
        select.select([node], [], [], 1.0)
        got += [item for item in node.read() if isinstance(item, list)]
    writing.join(60.0)
    assert [(number, data == large) for _, number, data in got] == [
        (number, True) for number in range(6)
    ]
    worker.close()
    node.close()


def flush_all(pipe: Pipe) -> None:
    """Send everything that waits."""
    until = time.monotonic() + 60.0
    while pipe.unsent and time.monotonic() < until:
        select.select([], [pipe], [], 1.0)
        pipe.flush()


@pytest.mark.processes
@pytest.mark.parametrize(
    ("service", "arguments"),
    [
        ("echo", {"value": bytes(17 << 20)}),
        ("echo", {"value": [[]] * 19_998}),
        ("s" * 256, {}),
        ("\ud800", {}),
    ],
    ids=["large", "many containers", "long name", "half a letter"],
)
async def test_a_call_that_cannot_be_encoded_is_refused_by_the_sender(
    operator: Operator, node: OneNode, service: str, arguments: Any
) -> None:
    client = operator.clients["only"]
    innocent = asyncio.create_task(operator.call("nap", None, seconds=0.1))
    end = await asyncio.wait_for(client.call(service, arguments), 30.0)
    assert (end.status, end.executed) == ("error", "no") and end.cause in (
        "too_large",
        "unencodable",
    ), end
    told = await innocent
    assert told.status == "success", told
    lost = [notice for notice in operator.notices if isinstance(notice, PeerLost)]
    assert not lost, node.log.read_text()[-3000:]


# --- the same rules at both ends --------------------------------------------------------------

LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(st.characters(), max_size=5)
    | st.text(st.characters(categories=["Cs", "Lu"]), max_size=3)
    | st.binary(max_size=5)
    | st.sampled_from(
        [
            np.float32(1.5),
            np.int64(3),
            np.bool_(True),
            np.str_("x"),
            np.zeros(2),
            1j,
            {1},
            object(),
            Status.ERROR,
        ]
    )
)
KEYS = st.text(max_size=4) | st.booleans() | st.integers() | st.none()
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.tuples(inner, inner)
        | st.dictionaries(KEYS, inner, max_size=4)
    ),
    max_leaves=30,
)
CAUSES = (
    st.text(max_size=5)
    | st.integers(250, 260).map("x".__mul__)
    | st.sampled_from(["\ud800", None, 3, ValueError("v")])
)


def same(one: Any, other: Any) -> bool:
    """Return whether both are the same data; NaN equals NaN."""
    if isinstance(one, float) and isinstance(other, float):
        return one == other or (math.isnan(one) and math.isnan(other))
    if isinstance(one, dict) and isinstance(other, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and bool(one == other)


@given(
    VALUES,
    CAUSES,
    st.sampled_from([*Status, "success", "perhaps", 3]),
    st.text(max_size=3) | st.just("\udc00"),
)
@settings(suppress_health_check=[HealthCheck.too_slow], max_examples=400, deadline=None)
def test_a_result_arrives_unchanged_or_is_refused_in_its_worker(
    value: Any, cause: Any, status: Any, text: str
) -> None:
    """Through the pipe of its worker and over the network there are only these two outcomes."""
    try:
        made = checked_result("m/p#1", Result(status, {"value": value}, cause, text))
    except ValueError as fault:
        assert str(fault)
        encode(m.Outcome("m/p#1", "error", {}, "bad_result", str(fault)))
        return
    near, far = socket.socketpair()
    worker, node = Pipe(near), Pipe(far)
    worker.post(m.Outcome("m/p#1", made.status, made.values, made.cause, made.text))
    (ended,) = node.read()
    worker.close()
    node.close()
    assert isinstance(ended, m.Outcome)
    sent = m.Outcome(ended.id, ended.status, ended.values, ended.cause, ended.text)
    got = decode(encode(sent))
    assert isinstance(got, m.Outcome)
    assert same(got.values, dict(made.values)) and (got.cause, got.text, got.status) == (
        made.cause,
        made.text,
        made.status,
    )


@given(VALUES)
@settings(suppress_health_check=[HealthCheck.too_slow], max_examples=200, deadline=None)
def test_a_run_that_returns_anything_ends_once_and_affects_no_other(value: Any) -> None:
    def act(ctx: Any) -> Any:
        return success(value=value)

    async def innocent(ctx: Any) -> Result:
        await ctx.sleep(0.02)
        return success()

    from petrobot.services.comm.location_file import ActionEntry
    from petrobot.services.worker.runner import Runner
    from tests.node.conftest import Clock

    clock = Clock()
    entries = {
        name: ActionEntry(name, "tests:none", "task", "here", "") for name in ("act", "innocent")
    }
    actions = {"act": act, "innocent": innocent}
    bench = Bench(clock, None, Runner(entries, clock=clock, substitutes=actions, virtual=True))
    first, second = bench.begin("act"), bench.begin("innocent")
    bench.tick(0.1)
    assert bench.ended(second).status == "success"
    assert (bench.ended(first).status, bench.ended(first).cause) in {
        ("success", ""),
        ("error", "bad_result"),
    }


NAMES = st.text(max_size=4) | st.integers(250, 260).map("x".__mul__) | st.just("\ud800")
NUMBERS = st.integers() | st.floats() | st.booleans() | st.none() | st.just("1")
MESSAGES = (
    st.builds(m.Call, NAMES, NAMES, st.just({}), NUMBERS, NUMBERS, NAMES, NAMES, NUMBERS)
    | st.builds(
        m.Outcome,
        NAMES,
        NAMES,
        st.just({}),
        NAMES,
        NAMES,
        st.sampled_from([*m.Executed]),
        NUMBERS,
        NUMBERS,
        st.booleans(),
    )
    | st.builds(m.Event, NAMES, NAMES, NUMBERS, VALUES, NAMES)
    | st.builds(m.Feedback, NAMES, NUMBERS, VALUES)
    | st.builds(m.SetPoint, NUMBERS, st.lists(NUMBERS, max_size=3).map(tuple), NUMBERS, NUMBERS)
    | st.builds(m.Subscribe, st.lists(NAMES, max_size=3).map(tuple))
    | st.builds(m.Command, NAMES, NAMES, NAMES, VALUES)
    | st.builds(m.Answer, NAMES, st.booleans(), VALUES)
    | st.builds(m.ResultAck, NAMES, st.lists(NAMES, max_size=3).map(tuple))
    | st.builds(m.StreamOpen, NAMES, NUMBERS, NAMES)
    | st.builds(m.Ping, NUMBERS)
)


@given(MESSAGES)
@settings(suppress_health_check=[HealthCheck.too_slow], max_examples=1_000, deadline=None)
def test_whatever_can_be_encoded_can_be_decoded(message: m.Message) -> None:
    """Sender and receiver use the same table: the receiver accepts everything that the sender
    accepts, unchanged."""
    try:
        body = encode(message)
    except ProtocolError as fault:
        assert fault.code in ("unencodable", "too_large") and fault.text
        return
    again = encode(decode(body))
    assert again == body or decode(again) == decode(body)


def test_whatever_the_worker_accepts_the_coordinator_accepts() -> None:
    checked(m.Event("e" * 255, "a", 1, {"x": bytes(1 << 20)}, "r"))
    with pytest.raises(ValueError, match="name: expected at most 255 characters, found 256"):
        checked(m.Event("e" * 256, "a", 1))


def test_a_location_file_whose_names_are_too_long_is_refused(tmp_path: Path) -> None:
    text = CELL.format(port=7000).replace("nap =", "n" * 300 + " =")
    with pytest.raises(Exception, match="at most 200 characters, found 300"):
        parse(text, tmp_path / "services.toml")
