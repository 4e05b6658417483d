"""Real processes: a node that forgot a run, because of other clients' calls, does not run it again
for a resumed coordinator."""

from __future__ import annotations

import asyncio
import itertools
import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from petrobot.coordinator.run.folder import JOURNAL
from petrobot.coordinator.run.journal import MAGIC, PREFIX, read_journal
from petrobot.coordinator.task import Executed, Status
from petrobot.services.comm.calls.callee import Retention
from petrobot.services.comm.calls.caller import Caller, Notice
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.location_file import load
from petrobot.services.comm.protocol.messages import Call, Hello, Outcome
from tests.chaos.shuttle_cell import TASK, moves, shuttle_services
from tests.integration.test_resume_processes import (
    NEVER_BEGUN,
    PATIENCE,
    QUIET,
    ends_of,
    nodes,
    petrobot,
    until,
)

pytestmark = pytest.mark.processes
RUNS = 4
BATCH = 1_500
"""Calls in progress at once: more than the results that a node keeps, so that it drops those of the
mission run."""


async def _flood(node: str, port: int, ids: Callable[[int], str], calls: int) -> None:
    """Make so many calls as another client; each is answered."""
    over, left = asyncio.Event(), 0

    def count(_: float, notices: list[Notice]) -> None:
        nonlocal left
        left -= sum(isinstance(notice, Outcome) for notice in notices)
        if left <= 0:
            over.set()

    caller = Caller(node, Hello(2, 2, "client", "flood", "f1"), auto_ack=True)
    client = Client("127.0.0.1", port, caller, on_notices=count)
    client.start()
    assert await client.connected(PATIENCE)
    numbers = iter(range(1, calls + 1))
    while batch := list(itertools.islice(numbers, BATCH)):
        left = len(batch)
        over.clear()
        for number in batch:
            caller.call(client.now(), Call(ids(number), "nowhere"))
        client.flush()
        async with asyncio.timeout(PATIENCE):
            await over.wait()
    await client.close()


def _without_accepts(path: Path) -> None:
    """Cut the journal before the node's first message, as if the kill came between a call and its
    ACCEPT."""
    offset, raw = len(MAGIC), path.read_bytes()
    for record in [None, *read_journal(path).records]:
        if record is not None and record.data.get("stimulus", {}).get("kind") == "RunStarted":
            path.write_bytes(raw[:offset])
            return
        offset += PREFIX.size + PREFIX.unpack_from(raw, offset)[0]
    # the real kill came between the two


@pytest.mark.parametrize("accepted", [True, False], ids=["accepted", "accept lost"])
@pytest.mark.parametrize(
    ("ids", "calls"),
    [
        pytest.param(lambda n: f"flood/{n}", 3_000, id="results"),
        pytest.param(lambda n: f"flood/{n}", 202_500, id="counted ids", marks=pytest.mark.proof),
        pytest.param(
            lambda n: f"{n} flood",
            Retention().id_groups + 2_500,
            id="ids without order",
            marks=pytest.mark.proof,
        ),
    ],
)
def test_a_run_that_its_node_has_forgotten_is_not_run_again(
    tmp_path: Path, ids: Callable[[int], str], calls: int, accepted: bool
) -> None:
    # The first fetch is still active when the kill is late on a busy host.
    services = shuttle_services(tmp_path, fetch=2.0, carry=0.4, orphan=60.0)
    runs = tmp_path / "runs"
    up = nodes(tmp_path)
    try:
        given = ["--services", str(services), "--runs", str(RUNS), "--journal", str(runs)]
        process = petrobot(tmp_path, "run", str(TASK), *given, *QUIET)
        until(lambda: len(moves(tmp_path, "begin")) >= 2, process)
        process.send_signal(signal.SIGKILL)
        assert process.wait(PATIENCE) == -signal.SIGKILL
        [run] = runs.iterdir()
        if not accepted:
            _without_accepts(run / JOURNAL)
        active = set(moves(tmp_path, "begin"))
        until(
            lambda: (
                moves(tmp_path, "end").keys()
                >= {call for call in active if "tidy" not in call and "carry" not in call}
            )
        )
        for node in load(services).nodes.values():
            asyncio.run(_flood(node.name, node.port, ids, calls))
        resumed = petrobot(
            tmp_path, "resume", str(run), "--json", str(tmp_path / "out.json"), *QUIET
        )
        assert resumed.wait(PATIENCE) == 0, (tmp_path / "resume.txt").read_text()
    finally:
        up.terminate()
        up.wait(PATIENCE)
    assert json.loads((tmp_path / "out.json").read_text())["status"] == "success"
    begun = moves(tmp_path, "begin")
    assert set(begun.values()) == {1}, "executed twice"
    assert not moves(tmp_path, "overlap")
    ends = ends_of(tmp_path)
    assert len(ends) == RUNS, "no token lost or doubled"
    made = {call.rpartition("/")[2] for call in begun}
    forgotten = [end for end in ends.values() if end.cause == "forgotten"]
    assert forgotten, "the flood did what it was to do"
    assert {(end.status, end.executed) for end in forgotten} <= {
        (Status.ERROR, Executed.UNKNOWN),
        (Status.SUCCESS, Executed.UNKNOWN),
    }, "the second if the bell had preempted it"
    for name, end in ends.items():
        assert name in made or (end.status, end.executed) in NEVER_BEGUN, end
