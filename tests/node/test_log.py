"""The log of a node: its contents at each level, and every exception of the user's code."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from petrobot.services.action import Cancelled, Context, Result, success
from petrobot.services.comm.location_file import parse
from petrobot.services.comm.protocol.plain import NotPlainError
from petrobot.services.worker.callables import CHAIN, LONGEST, log_fault
from petrobot.services.worker.remote import CyclicDriver
from tests.node.conftest import Bench
from tests.node.test_processes import CELL, PATIENCE, Operator, operator_of, start_node
from tests.ports import free_ports

Make = Callable[..., Bench]
BROKEN = """\
broken = {{ run = "toy_cell.actions:broken", task = "sum", node = "left" }}
[services.broken_service]
node = "left"
run = "toy_cell.actions:broken"
"""


def test_an_exception_of_an_action_is_logged_with_its_cause(
    bench: Make, caplog: pytest.LogCaptureFixture
) -> None:
    def grasp(ctx: Context) -> Result:
        try:
            raise KeyError("gripper")
        except KeyError as fault:
            raise ValueError("cannot grasp") from fault

    b = bench(grasp=grasp)
    run = b.begin("grasp")
    b.tick()
    assert b.ended(run).cause == "exception"
    (record,) = [r for r in caplog.records if r.levelno == logging.ERROR]
    said = record.getMessage()
    assert f"run {run} of grasp raised" in said
    first, second = said.split("-- then --")
    assert "KeyError: 'gripper'" in first and 'raise KeyError("gripper")' in first
    assert "ValueError: cannot grasp" in second and "in grasp" in second
    assert "runner.py" not in said, "it begins with the user's own code"


def test_an_exception_while_a_cancelled_action_cleans_up_is_logged(
    bench: Make, caplog: pytest.LogCaptureFixture
) -> None:
    async def hold(ctx: Context) -> Result:
        try:
            await ctx.sleep(10.0)
        except Cancelled:
            raise OSError("the valve does not answer") from None
        return success()

    b = bench(hold=hold, device=True)
    run = b.begin("hold", deadline=0.1)
    b.tick(1.0)
    assert b.ended(run).cause == "deadline"
    assert "OSError: the valve does not answer" in caplog.text and "cleaned up" in caplog.text


class UnreadableError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("not even this")


def _chain(length: int) -> Exception:
    fault: Exception = ValueError("0")
    for number in range(1, length):
        following = ValueError(str(number))
        following.__cause__ = fault
        fault = following
    return fault


def _circle() -> Exception:
    one, other = ValueError("one"), ValueError("other")
    one.__cause__, other.__cause__ = other, one
    return one


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (UnreadableError(), "its message cannot be had: RuntimeError"),
        (ValueError("x" * 10 * LONGEST), f"({10 * LONGEST:,} characters)"),
        (ValueError("100 %s %d"), "ValueError: 100 %s %d"),
        (_chain(3 * CHAIN), f"ValueError: {3 * CHAIN - 1}"),
        (_circle(), "ValueError: one"),
    ],
)
def test_a_strange_exception_is_logged_in_few_words(
    fault: Exception, says: str, caplog: pytest.LogCaptureFixture
) -> None:
    log_fault(logging.getLogger("petrobot.test"), fault, "run %s", "r1")
    assert says in caplog.text and "run r1" in caplog.text and len(caplog.text) < 3 * LONGEST


def test_a_message_of_petrobot_needs_no_lines_of_its_own_code(
    caplog: pytest.LogCaptureFixture,
) -> None:
    driver: Any = SimpleNamespace(stopped=lambda: True, state=lambda: {"at": {1}})
    with pytest.raises(NotPlainError) as raised:
        CyclicDriver(driver).state()
    own = raised.value.with_traceback(raised.tb.tb_next)  # without the line of this test
    log_fault(logging.getLogger("petrobot.test"), own, "it failed")
    told = caplog.text
    assert "a set is not plain data, returned by `state` (test_log.py:" in told
    assert "remote.py" not in told


async def _log_of(folder: Path, level: str, work: Callable[[Operator], Any]) -> str:
    file = folder / "services.toml"
    left, right = free_ports(2)
    file.write_text(CELL.format(left=left, right=right) + BROKEN.format())
    node = start_node("left", file, "--log-level", level)
    try:
        assert node.stdout is not None and "ready" in node.stdout.readline()
        async with operator_of(parse(file.read_text(), file), "left") as operator:
            await work(operator)
    finally:
        node.terminate()
        node.communicate(timeout=PATIENCE)
    assert node.returncode == 0
    return (folder / "left.log").read_text()


async def _call_all(operator: Operator) -> None:
    assert (await operator.call("add", a=2)).values == {"sum": 3}
    for name in ("broken", "broken_service"):
        assert (await operator.call(name)).cause == "exception"
    assert (await operator.call("leave")).cause == "worker_died"
    assert (await operator.command("left", "stop", "slide")).ok


@pytest.mark.processes
async def test_a_node_logs_links_runs_restarts_and_commands(tmp_path: Path) -> None:
    log = await _log_of(tmp_path, "info", _call_all)
    for line in (
        "link of operator (127.0.0.1) is up",
        " of add started",
        " ended: success",
        " ended: error exception ZeroDivisionError",
        "of broken raised",
        "of service broken_service raised",
        "ZeroDivisionError: nothing is divided by nothing",
        'raise ZeroDivisionError("nothing is divided by nothing")',
        "actions: the process of its action died: it exited with code",
        "; starting it again in ",
        "operator orders stop of slide",
        "link of operator (127.0.0.1) is lost: ",
        "node left ends",
    ):
        assert line in log, f"{line!r} is not in:\n{log}"
    assert "DEBUG" not in log


LOUD = """\
import sys

from petrobot import Driver, success

class Loud(Driver):
    period = 0.01

    def step(self, now):
        print("step", now, file=sys.stderr)

    def stopped(self):
        return True

async def shout(ctx):
    print("x" * 1_000_000, file=sys.stderr)
    sys.stderr.flush()
    return success()
"""
LOUD_CELL = """\
schema = 1
nodes.left = {{ host = "127.0.0.1", port = {port} }}
devices.loud = {{ node = "left", driver = "loud:Loud" }}
[actions]
shout = {{ run = "loud:shout", device = "loud" }}
alone = {{ run = "loud:shout", node = "left" }}
"""


@pytest.mark.parametrize("hangs", [False, True], ids=["full", "hangs"])
@pytest.mark.processes
async def test_a_log_on_a_disk_that_is_full_or_hangs_ends_no_driver_and_no_action(
    tmp_path: Path, hangs: bool
) -> None:
    """A pipe that nobody reads stands for a hung disk: each write to it waits for ever."""
    (tmp_path / "loud.py").write_text(LOUD)
    log, opened = tmp_path / "left.log", -1
    if hangs:
        os.mkfifo(log)
        opened = os.open(log, os.O_RDWR)
    else:
        log.symlink_to("/dev/full")
    file = tmp_path / "services.toml"
    file.write_text(LOUD_CELL.format(port=free_ports(1)[0]))
    node = start_node("left", file)
    try:
        assert node.stdout is not None and "ready" in node.stdout.readline()
        async with operator_of(parse(file.read_text(), file), "left") as operator:
            for action in ("shout", "alone", "shout"):
                assert (await operator.call(action)).status == "success", action
            status = await operator.command("left", "status", "loud")
            assert status.data["devices"]["loud"]["restarts"] == 0
            assert (await operator.command("left", "emergency_stop")).ok
    finally:
        node.terminate()
        node.communicate(timeout=PATIENCE)
        if hangs:
            os.close(opened)
    assert node.returncode == 0


@pytest.mark.parametrize(("level", "shown"), [("debug", "DEBUG"), ("warning", "")])
@pytest.mark.processes
async def test_the_level_holds_for_the_node_and_its_processes(
    tmp_path: Path, level: str, shown: str
) -> None:
    log = await _log_of(tmp_path, level, _call_all)
    assert ("bytes: Call operator/" in log) == ("from " in log) == (level == "debug")
    assert (" INFO " in log) == (level == "debug") and shown in log
    assert "ZeroDivisionError: nothing is divided by nothing" in log and "starting it again" in log


def test_a_handler_that_raises_ends_no_process() -> None:
    class Broken(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            raise ZeroDivisionError

    log = logging.Logger("apart")
    log.addHandler(Broken())
    log_fault(log, ValueError("x"), "it failed")
