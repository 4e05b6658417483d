"""Pools of workers for a campaign: local processes, or the workers of a dask cluster."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import json
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from petrobot.coordinator.run.supervisor import LAST_WORDS, output_pipe
from petrobot.coordinator.studies.campaign.plan import CampaignError, CampaignPlan
from petrobot.coordinator.studies.campaign.worker import answer
from petrobot.services.host.parent_death import until_ended, until_reaped

RETIRES_AFTER = 200
"""Blocks after which a worker is replaced, so that leaks of a user's action or a native library do
not add up."""
TRIES = 3
"""Workers that a block may take down before the block counts as faulty."""
LONGEST_LINE = 1 << 26
ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)
"""Each worker uses one core; threads of its libraries would only compete with the other workers."""


class WorkerLost(Exception):  # noqa: N818 - what happened
    """A worker process ended while it had a block."""


class _Worker:
    """One worker process and its pipes."""

    def __init__(
        self,
        process: asyncio.subprocess.Process,
        said: asyncio.StreamReader,
        closing: contextlib.AsyncExitStack,
    ) -> None:
        self.process = process
        self.done = 0
        self._said = said
        self._closing = closing

    @classmethod
    async def start(cls, plan: str, log: Path) -> _Worker:
        """Start a process and send it the plan. What it writes beside its answers goes to `log`."""
        command = (
            sys.executable,
            "-m",
            "petrobot.coordinator.studies.campaign.worker",
            str(os.getpid()),
        )
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
            **ONE_THREAD,
        }
        async with contextlib.AsyncExitStack() as closing:
            end, said = await closing.enter_async_context(output_pipe(LONGEST_LINE))
            with log.open("ab") as words:
                process = await asyncio.create_subprocess_exec(
                    *command,
                    stdin=asyncio.subprocess.PIPE,
                    stdout=end,
                    stderr=words,
                    env=environment,
                    start_new_session=True,
                )
            end.close()
            worker = cls(process, said, closing.pop_all())
        await worker._tell(plan)
        return worker

    async def ask(self, order: str) -> dict[str, Any]:
        """Send a block and wait for its result. Raises WorkerLost."""
        await self._tell(order)
        line = await self._line()
        if not line.endswith(b"\n"):
            raise WorkerLost(f"worker {self.process.pid} ended")
        self.done += 1
        return json.loads(line)  # type: ignore[no-any-return]

    async def _line(self) -> bytes:
        """Return its next line; an incomplete line if the process ends. Processes that it has left
        running may keep the pipe open, so the end of the process is watched, too."""
        reading = asyncio.create_task(self._said.readline())
        ended = asyncio.create_task(until_ended(self.process.pid))
        try:
            await asyncio.wait({reading, ended}, return_when=asyncio.FIRST_COMPLETED)
            await asyncio.wait({reading}, timeout=LAST_WORDS)
            return reading.result() if reading.done() else b""
        finally:
            reading.cancel()
            ended.cancel()

    async def _tell(self, line: str) -> None:
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(line.encode() + b"\n")
            await self.process.stdin.drain()
        except (BrokenPipeError, ConnectionResetError) as fault:
            raise WorkerLost(f"worker {self.process.pid} ended") from fault

    async def end(self) -> None:
        """Kill the process if it is still running, and everything that its actions have left in its
        session."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        await until_reaped(self.process)
        await self._closing.aclose()


class LocalPool:
    """`count` local worker processes. A lost worker is replaced and its block run again. Use as an
    async context."""

    def __init__(self, plan: CampaignPlan, count: int, log: Path) -> None:
        self.count = count
        self._log = log
        self.lost = 0
        """Number of workers that ended while they had a block."""
        self._plan = json.dumps(plan.to_plain())
        self._idle: list[_Worker] = []
        self._all: set[_Worker] = set()
        self._room = asyncio.Semaphore(count)

    @property
    def pids(self) -> list[int]:
        """Process ids of the running workers."""
        return [worker.process.pid for worker in self._all]

    async def __aenter__(self) -> LocalPool:
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.gather(*(worker.end() for worker in self._all))

    async def run(self, order: Mapping[str, Any]) -> dict[str, Any]:
        """Run a block as soon as a worker is free. Raises CampaignError."""
        text = json.dumps(order)
        async with self._room:
            for _ in range(TRIES):
                try:
                    return await self._once(text)
                except WorkerLost:
                    self.lost += 1
        what = f"block {order['block']['index']} (seed {order['block']['seed']})"
        raise CampaignError(
            f"{what}: {TRIES} workers ended while they ran it; see the end of their output in "
            f"{self._log}"
        )

    async def _once(self, text: str) -> dict[str, Any]:
        if self._idle:
            worker = self._idle.pop()
        else:
            worker = await _Worker.start(self._plan, self._log)
            self._all.add(worker)
        try:
            answer = await worker.ask(text)
        except BaseException:
            self._all.discard(worker)
            await worker.end()
            raise
        if worker.done >= RETIRES_AFTER:
            self._all.discard(worker)
            await worker.end()
        else:
            self._idle.append(worker)
        return answer


# --- workers of a dask cluster ---


PATIENCE = 30.0
"""Seconds in which a first worker must be available."""
RETRIES = 5
"""How often a block whose worker was lost is given to another worker."""


def dask_distributed() -> Any:
    """Import dask.distributed. Raises CampaignError if it is not installed."""
    try:
        return importlib.import_module("distributed")
    except ImportError as fault:
        raise CampaignError(
            "--cluster needs dask.distributed: pip install 'petrobot[cluster]'"
        ) from fault


class ClusterPool:
    """The workers of a dask scheduler, which runs the blocks of a lost worker again elsewhere.
    petrobot must be installed on each worker, with the files of the campaign at the same paths.

    Use as an async context. Raises CampaignError if dask.distributed is missing or the scheduler
    does not answer.
    """

    def __init__(self, plan: CampaignPlan, address: str) -> None:
        self._plan, self._address = json.dumps(plan.to_plain()), address
        self._client: Any = None
        self.lost = 0
        self.count = 1
        """Threads of all workers, as the scheduler reported them when the campaign began."""

    async def __aenter__(self) -> ClusterPool:
        distributed = dask_distributed()
        try:
            self._client = await distributed.Client(self._address, asynchronous=True, timeout=10)
        except (OSError, TimeoutError, ValueError) as fault:
            raise CampaignError(
                f"--cluster {self._address}: no scheduler answers: {fault}"
            ) from fault
        await self.workers(1, PATIENCE)
        return self

    async def workers(self, least: int, patience: float) -> None:
        """Wait until `least` workers are available, and count them. Raises CampaignError after
        `patience` s."""
        try:
            await self._client.wait_for_workers(least, timeout=patience)
        except TimeoutError as fault:
            raise CampaignError(
                f"--cluster {self._address}: fewer than {least} workers in {patience:g} s"
            ) from fault
        self.count = sum((await self._client.nthreads()).values())

    async def __aexit__(self, *_: object) -> None:
        await self._client.close()

    async def run(self, order: Mapping[str, Any]) -> dict[str, Any]:
        """Run a block. Raises CampaignError."""
        future = self._client.submit(answer, self._plan, dict(order), pure=False, retries=RETRIES)
        try:
            return dict(await future)
        except dask_distributed().KilledWorker as fault:
            raise CampaignError(
                f"block {order['block']['index']} (seed {order['block']['seed']}): {fault}"
            ) from fault
