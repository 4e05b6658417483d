"""The processes of a node are forked by its fork server, which may die, hang, or be out of date."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from petrobot.services.comm.protocol.messages import Call, Outcome
from petrobot.services.node import child as children
from petrobot.services.node.child import Child, ForkServer
from petrobot.services.worker.pipe import Item
from petrobot.services.worker.process import READY, Setup
from tests.node.test_processes import PATIENCE, ROOT
from tests.processes import alive, parent
from tests.waiting import until

pytestmark = pytest.mark.processes
TEXT = """\
schema = 1
nodes.left = { host = "127.0.0.1", port = 7001 }
actions.ask = { run = "asked:ask", task = "ask", node = "left" }
actions.linger = { run = "asked:linger", task = "linger", node = "left" }
actions.draw = { run = "asked:draw", task = "draw", node = "left" }
"""
CODE = """\
import os
import random
import threading
import uuid
from pathlib import Path
import numpy as np
from petrobot import success

def ask(ctx):
    return success(setting=os.environ.get("SETTING", ""), folder=str(Path.cwd()))

def linger(ctx):
    threading.Thread(target=threading.Event().wait).start()
    return success()

def draw(ctx):
    return success(python=random.random(), numpy=float(np.random.rand()), uuid=str(uuid.uuid4()))
"""


class Started:
    """A process of a node, and what it reports."""

    def __init__(self, folder: Path) -> None:
        self.ready, self.over = asyncio.Event(), asyncio.Event()
        self.results: list[Outcome] = []
        setup = Setup(str(folder / "services.toml"), TEXT, "left", "")
        self.child = Child(setup, self._hear, lambda child: self.over.set())

    def _hear(self, child: Child, items: list[Item]) -> None:
        self.results += [item for item in items if isinstance(item, Outcome)]
        if any(isinstance(item, list) and item[0] == READY for item in items):
            self.ready.set()

    async def ask(self, action: str = "ask", code: int = 0) -> dict[str, object]:
        """Wait until it is ready, call its action, and end it, with this exit code; return the
        values."""
        async with asyncio.timeout(PATIENCE):
            await self.ready.wait()
            self.child.give(Call("1", action, {}))
            await until(lambda: self.results, "the result")
            assert self.results[0].status == "success", self.results
            self.child.leave()
            await self.over.wait()
        assert self.child.code == code
        return dict(self.results[0].values)


def fork_server() -> ForkServer:
    """The fork server of this process."""
    assert ForkServer._current is not None
    return ForkServer._current


@pytest.fixture
async def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Path]:
    """A location file and the module of its action, and a fork server of their own."""
    (tmp_path / "services.toml").write_text(TEXT)
    (tmp_path / "asked.py").write_text(CODE)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    yield tmp_path
    if ForkServer._current is not None:
        fork_server().kill()


async def test_a_worker_and_its_keeper(folder: Path) -> None:
    """The keeper is a child of this process, so that this process may reap it."""
    started = Started(folder)
    async with asyncio.timeout(PATIENCE):
        await started.ready.wait()
    worker = started.child.pid
    keeper = parent(worker)
    assert parent(keeper) == os.getpid() and keeper != fork_server()._process.pid
    assert (await started.ask())["setting"] == ""
    assert not alive(worker) and not Path(f"/proc/{keeper}").exists()


async def test_a_thread_of_user_code_does_not_keep_its_process(folder: Path) -> None:
    """Python waits for it, but not until the node kills the process 4 s later."""
    await Started(folder).ask("linger", -signal.SIGALRM)


async def test_what_has_ended_leaves_no_zombie(folder: Path) -> None:
    """Nobody may ask how a process ended: a worker whose driver died is not wanted any more."""
    started = Started(folder)
    async with asyncio.timeout(PATIENCE):
        await started.ready.wait()
        keeper = parent(started.child.pid)
        started.child.kill()
        await started.over.wait()
    assert not Path(f"/proc/{keeper}").exists()


async def test_no_two_workers_draw_the_same_numbers(folder: Path) -> None:
    """They are copies of one process, which must not have begun to draw."""
    drawn = [await Started(folder).ask("draw") for _ in range(2)]
    assert drawn[0].keys() == drawn[1].keys()
    assert all(drawn[0][kind] != drawn[1][kind] for kind in drawn[0])


async def test_a_process_has_the_environment_of_its_start(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the fork server was started before the environment or the folder changed."""
    assert (await Started(folder).ask())["setting"] == ""
    first = fork_server()
    (there := folder / "there").mkdir()
    late = Started(folder)
    monkeypatch.setenv("SETTING", "other")
    monkeypatch.chdir(there)
    values = await Started(folder).ask()
    assert values == {"setting": "other", "folder": str(there)} and fork_server() is not first
    assert (await late.ask())["setting"] == "", "the former fork server has an order left"
    await until(lambda: first._process.poll() == 0, "the end of the former fork server")


async def test_another_fork_server_takes_the_place_of_one_that_was_killed(folder: Path) -> None:
    former = Started(folder)
    async with asyncio.timeout(PATIENCE):
        await former.ready.wait()
    os.kill(fork_server()._process.pid, signal.SIGKILL)
    fork_server()._process.wait(PATIENCE)
    assert await Started(folder).ask()
    assert await former.ask(), "what it has forked lives on"


@pytest.mark.parametrize("how", [Child.kill, Child.leave], ids=["kill", "leave"])
async def test_a_child_that_is_not_forked_yet_can_be_ended(
    folder: Path, how: Callable[[Child], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert await Started(folder).ask()
    os.kill(fork_server()._process.pid, signal.SIGSTOP)
    started = Started(folder)
    assert (started.child.pid, started.child.code) == (0, None)
    with monkeypatch.context() as patch:  # the others need their time on a busy host
        patch.setattr(children, "LEAVE_LIMIT", 0.5)
        how(started.child)
        async with asyncio.timeout(PATIENCE):
            await started.over.wait()
    assert started.child.code == -signal.SIGKILL
    assert await Started(folder).ask()


async def test_a_frozen_fork_server_is_replaced(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert await Started(folder).ask()
    frozen = fork_server()
    os.kill(frozen._process.pid, signal.SIGSTOP)
    monkeypatch.setattr(children, "FORK_LIMIT", 0.5)
    started = Started(folder)
    async with asyncio.timeout(PATIENCE):
        await started.over.wait()
    assert started.child.describe() == "it was not forked within 0.5 s"
    monkeypatch.undo()
    assert await Started(folder).ask() and fork_server() is not frozen


async def test_a_fork_server_ends_with_its_node(folder: Path) -> None:
    assert await Started(folder).ask()
    process = fork_server()._process
    fork_server().close()
    await until(lambda: process.poll() == 0, "the end of the fork server")
