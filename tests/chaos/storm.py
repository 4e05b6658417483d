"""Mission runs in real time while everything around them breaks: `storm.py SEED SECONDS FOLDER
[--lo]`. Prints one JSON object.

Nodes live under the supervisor of `petrobot up`, each behind a proxy. Each mission run is a process
`petrobot run`. Faults drawn from the seed kill nodes, workers and the coordinator (SIGKILL;
`petrobot resume` then continues the run), freeze nodes and workers (SIGSTOP), cut, delay and repeat
frames, and, in a separate network namespace (`--lo`), take the loopback down. Mission runs follow
one another; each is checked by its journal and by the hands' log. The last one runs without faults.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.cli.options import recorded
from petrobot.coordinator.engine import Finished, Fired, RunRecorded, StartRun
from petrobot.coordinator.launch import local_programs, with_runs
from petrobot.coordinator.run.folder import JOURNAL, RESULT
from petrobot.coordinator.run.journal import JournalError, read_journal
from petrobot.coordinator.run.recording import STIMULUS
from petrobot.coordinator.run.supervisor import Supervisor
from petrobot.coordinator.task import Status
from petrobot.services.comm.location_file import load
from tests.chaos.by_proxy import NODES
from tests.chaos.shuttle_cell import ROOT, TASK, moves, shuttle_services
from tests.ports import free_ports
from tests.processes import children, kill
from tests.waiting import beat

MARK = "PETROBOT_STORM"
"""Environment variable that all processes of a storm have."""
LEAST_MISSIONS, LEAST_EVENTS = 3, 10
"""Fewest mission runs and faults of a storm, however long they take."""
LONGEST = 240.0
"""Seconds after which a mission run counts as hanging."""
RUNS = 24
QUIET = ("--quiet", "--no-page")
KILLS = 4
"""Most kills of the coordinator of one mission run, so that the run can end."""
UNREACHABLE, HANGS = 3, 1000
PATIENCE = 60.0
"""Seconds within which nodes must notice that all clients have disconnected, and processes must
end."""


class FaultSchedule:
    """The faults and their times, all drawn from a seed."""

    def __init__(
        self,
        seed: int,
        supervisor: Supervisor,
        proxy: asyncio.subprocess.Process,
        crash: asyncio.Event,
        lo: bool,
        ports: list[int],
    ) -> None:
        """`crash` is set when the coordinator must be killed; nodes listen at `ports`."""
        self._ports = ports
        self._crashing = crash
        self._draw = np.random.default_rng(seed)
        self._supervisor = supervisor
        self._proxy = proxy
        kinds = [
            "kill_node",
            "kill_worker",
            "freeze_node",
            "freeze_worker",
            "cut",
            "delay",
            "repeat",
            "repeat",
            "crash",
        ]
        self._kinds = [*kinds, "lo_down"] if lo else kinds
        self._frozen: set[int] = set()
        self.seen: Counter[str] = Counter()

    async def blow(self) -> None:
        """Cause faults at random times, until cancelled."""
        try:
            while True:
                await beat(float(self._draw.exponential(0.35)))
                kind = str(self._draw.choice(self._kinds))
                self.seen[kind] += 1
                await getattr(self, f"_{kind}")()
        finally:
            for process in self._frozen:
                _signal(process, signal.SIGCONT)

    async def _kill_node(self) -> None:
        """Kill a node, unless one is still starting: on a busy machine no node would ever be up
        long enough."""
        if all([await _listens(port) for port in self._ports]):
            _signal(self._node(), signal.SIGKILL)

    async def _kill_worker(self) -> None:
        _signal(self._worker(), signal.SIGKILL)

    async def _freeze_node(self) -> None:
        await self._freeze(self._node())

    async def _freeze_worker(self) -> None:
        await self._freeze(self._worker())

    async def _freeze(self, process: int) -> None:
        self._frozen.add(process)
        _signal(process, signal.SIGSTOP)
        await beat(float(self._draw.uniform(0.05, 2.0)))
        _signal(process, signal.SIGCONT)
        self._frozen.discard(process)

    async def _cut(self) -> None:
        await self._order(f"cut {self._draw.integers(2)}")

    async def _delay(self) -> None:
        await self._order(f"delay {self._draw.integers(2)} {self._draw.uniform(0.02, 1.5):.3f}")

    async def _repeat(self) -> None:
        await self._order(f"repeat {self._draw.integers(2)}")

    async def _crash(self) -> None:
        self._crashing.set()

    async def _lo_down(self) -> None:
        _link("down")
        await beat(float(self._draw.uniform(0.1, 2.0)))
        _link("up")

    async def _order(self, line: str) -> None:
        assert self._proxy.stdin is not None
        self._proxy.stdin.write(f"{line}\n".encode())
        await self._proxy.stdin.drain()

    def _node(self) -> int:
        running = self._supervisor.process_ids()
        return int(self._draw.choice(sorted(running.values()))) if running else 0

    def _worker(self) -> int:
        workers = sorted(children(self._node()))
        return int(self._draw.choice(workers)) if workers else 0


class Storm:
    """One cell, many mission runs."""

    def __init__(self, seed: int, folder: Path, lo: bool) -> None:
        self._seed = seed
        self._folder = folder
        self._lo = lo
        self._services = shuttle_services(folder)
        self._directory = load(self._services)
        self._proxied = free_ports(2)
        self._ends: Counter[str] = Counter()
        self._causes: Counter[str] = Counter()
        self._number = self._calls = 0
        self._kills = self._resumes = self._unborn = self._unreachable = self._torn = 0
        self._crash = asyncio.Event()
        self._faults: list[str] = []

    async def pass_over(self, seconds: float) -> dict[str, Any]:
        """Run missions for so long with faults, then one without; return what was observed."""
        pairs = [
            f"{port}:{self._directory.nodes[n].port}"
            for port, n in zip(self._proxied, NODES, strict=True)
        ]
        ports = [self._directory.nodes[name].port for name in NODES]
        command = [sys.executable, "-m", "tests.chaos.proxy", *pairs]
        pipe = asyncio.subprocess.PIPE
        proxy = await asyncio.create_subprocess_exec(*command, cwd=ROOT, stdin=pipe, stdout=pipe)
        assert proxy.stdout is not None and proxy.stdin is not None
        await proxy.stdout.readline()
        try:
            async with Supervisor(
                local_programs(self._directory), self._folder / "logs"
            ) as supervisor:
                weather = FaultSchedule(self._seed, supervisor, proxy, self._crash, self._lo, ports)
                loop = asyncio.get_running_loop()
                before, end = _sockets(supervisor), loop.time() + seconds
                blowing = loop.create_task(weather.blow())
                while loop.time() < end or (self._hardly(weather) and loop.time() < end + LONGEST):
                    await self._mission()
                blowing.cancel()
                await asyncio.gather(blowing, return_exceptions=True)
                await self._calm(supervisor)
                left = await self._left(supervisor, before)
        finally:
            proxy.stdin.close()
            await proxy.wait()
        end = loop.time() + PATIENCE
        while _marked() and loop.time() < end:
            await beat(0.1)
        return self._told(weather, left)

    def _hardly(self, weather: FaultSchedule) -> bool:
        """Return whether too few faults have happened yet: a slow machine needs longer."""
        return (
            sum(self._ends.values()) < LEAST_MISSIONS or sum(weather.seen.values()) < LEAST_EVENTS
        )

    def _told(self, weather: FaultSchedule, sockets: dict[str, int]) -> dict[str, Any]:
        begun = moves(self._folder, "begin")
        return {
            "missions": sum(self._ends.values()),
            "ends": dict(self._ends),
            "killed": self._kills,
            "resumed": self._resumes,
            "unborn": self._unborn,
            "unreachable": self._unreachable,
            "torn": self._torn,
            "calls": self._calls,
            "causes": dict(self._causes),
            "weather": dict(weather.seen),
            "executed": len(begun),
            "twice": [call for call, times in begun.items() if times > 1],
            "overlaps": sorted(moves(self._folder, "overlap")),
            "sockets": sockets,
            "processes": _marked(),
            "faults": self._faults,
        }

    async def _calm(self, supervisor: Supervisor) -> None:
        """Run a mission without faults, once all nodes are up again: if it has no error, no fence
        was left behind."""
        loop = asyncio.get_running_loop()
        end = loop.time() + LONGEST
        self._crash.clear()
        while loop.time() < end:
            if len(supervisor.process_ids()) == len(NODES) and await self._mission():
                return
            await beat(0.2)
        self._faults.append("no calm mission run without error came about")

    async def _left(self, supervisor: Supervisor, before: dict[str, int]) -> dict[str, int]:
        """Return how many more sockets nodes have than at first, after those of former clients had
        time to close."""
        loop = asyncio.get_running_loop()
        end = loop.time() + PATIENCE
        while True:
            more = {
                name: count - before[name]
                for name, count in _sockets(supervisor).items()
                if count > before[name]
            }
            if not more or loop.time() > end:
                return more
            await beat(0.1)

    async def _mission(self) -> bool:
        """Run one mission and check it; return whether all its runs ended well."""
        self._number += 1
        kept = self._folder / "runs" / f"{self._number}"
        common = ["--journal", str(kept), "--services", str(self._services), *QUIET]
        given = ["run", str(TASK), "--runs", str(RUNS), "--seed", str(self._seed), *common]
        loop = asyncio.get_running_loop()
        until, kills = loop.time() + LONGEST, 0
        while (code := await self._life(given, kept, until, mortal=kills < KILLS)) != 0:
            if code == HANGS:
                self._faults.append(f"{kept} hangs")
                return False
            kills += code == -signal.SIGKILL
            if not _stimuli(kept):
                self._unborn += 1
                return False
            if (
                result := next(kept.glob(f"*/{RESULT}"), None)
            ) is not None and code == -signal.SIGKILL:
                code = (
                    0
                    if json.loads(result.read_text(encoding="utf-8"))["status"] == "success"
                    else 1
                )
            if code != -signal.SIGKILL and code != UNREACHABLE:
                break
            self._resumes += 1
            given = ["resume", str(next(kept.iterdir())), *QUIET]
        return self._judge(next(kept.iterdir()), code)

    async def _life(self, given: list[str], kept: Path, until: float, *, mortal: bool) -> int:
        """Run one coordinator process; return its exit code, -9 if it was killed (only after its
        journal has records)."""
        before = _stimuli(kept)
        ports = ",".join(map(str, self._proxied))
        with (self._folder / "coordinator.txt").open("ab") as out:
            command = [sys.executable, "-m", "tests.chaos.by_proxy", ports, *given]
            process = await asyncio.create_subprocess_exec(
                *command, cwd=ROOT, stdout=out, stderr=out
            )
        ending = asyncio.ensure_future(process.wait())
        while (
            not ending.done()
            and _stimuli(kept) == before
            and asyncio.get_running_loop().time() < until
        ):
            await beat(0.02)
        self._crash.clear()
        crashing = asyncio.ensure_future(self._crash.wait())
        left = until - asyncio.get_running_loop().time()
        wanted = {ending, crashing} if mortal else {ending}
        await asyncio.wait(wanted, timeout=max(0.0, left), return_when=asyncio.FIRST_COMPLETED)
        hangs = not ending.done() and not (mortal and crashing.done())
        if not ending.done():
            self._kills += not hangs
            _signal(process.pid, signal.SIGKILL)
        crashing.cancel()
        await asyncio.gather(ending, crashing, return_exceptions=True)
        code = HANGS if hangs else await process.wait()
        self._unreachable += code == UNREACHABLE
        return code

    def _judge(self, folder: Path, code: int) -> bool:
        """Check that the end has a reason, every run one end, every firing is one of the net, and
        the journal replays; return whether all runs ended well."""
        found = recorded(str(folder))
        self._torn += found.journal.torn_bytes > 0
        steps = list(found.steps())
        given = [instruction for step in steps for instruction in step.instructions]
        finished = next((one for one in given if isinstance(one, Finished)), None)
        if finished is None or not (folder / RESULT).exists():
            self._faults.append(f"{folder}: exit code {code} without an end")
            return False
        self._ends[finished.status.value] += 1
        result = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        firings = [one for one in given if isinstance(one, Fired)]
        started = [one.run for one in given if isinstance(one, StartRun)]
        records = [one for one in given if isinstance(one, RunRecorded)]
        self._calls += len(started)
        self._causes.update(f"{r.cause} ({r.executed})" for r in records if r.cause)
        net = with_runs(load_task(str(TASK)), RUNS)[0].flat.net
        markings = [
            tuple(m) for m in net.replay([f.transition for f in firings], firings[0].before)
        ]
        checks = {
            "its end has no reason": bool(finished.reason),
            "its result is another": (result["status"], result["firings"])
            == (finished.status.value, len(firings)),
            "its exit code is another": code == (0 if finished.status is Status.SUCCESS else 1),
            "a firing is none of the net": markings[1:] == [f.after for f in firings],
            "a run was started twice": len(started) == len(set(started)),
            "a run has not one end": sorted(r.run for r in records) == sorted(started),
            "an error has no cause": all(r.cause for r in records if r.status is Status.ERROR),
            "tokens were lost": markings[-1][net.place_index["runs"]] == 0
            or finished.status is Status.ERROR,
        }
        self._faults += [f"{folder}: {text}" for text, holds in checks.items() if not holds]
        # The bell may cancel a run, and on a slow computer it does so in each mission.
        return all(r.status is Status.SUCCESS or r.cause == "cancelled" for r in records)


async def _listens(port: int) -> bool:
    """Return whether a node accepts connections there."""
    with contextlib.suppress(OSError, TimeoutError):
        async with asyncio.timeout(0.5):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.transport.abort()
            return True
    return False


def _signal(process: int, number: signal.Signals) -> None:
    if process:
        kill([process], number)


def _link(state: str) -> None:
    subprocess.run(["ip", "link", "set", "lo", state], check=True)


def _sockets(supervisor: Supervisor) -> dict[str, int]:
    """Return how many sockets each node has open."""
    counts = {}
    for name, process in supervisor.process_ids().items():
        counts[name] = 0
        with contextlib.suppress(OSError):
            for path in Path(f"/proc/{process}/fd").iterdir():
                with contextlib.suppress(OSError):
                    counts[name] += str(path.readlink()).startswith("socket:")
    return counts


def _stimuli(kept: Path) -> int:
    """Return how many stimuli the journal of a mission run has; 0 before it begins."""
    journal = next(kept.glob(f"*/{JOURNAL}"), None)
    try:
        return (
            sum(r.kind == STIMULUS for r in read_journal(journal).records)
            if journal is not None
            else 0
        )
    except JournalError:
        return 0


def _marked() -> list[str]:
    """Return the command lines of the other processes with this storm's mark; none may be left at
    its end."""
    mark, found = f"{MARK}={os.environ.get(MARK, '')}".encode(), []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with contextlib.suppress(OSError):
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    found.append(
                        (entry / "cmdline")
                        .read_bytes()
                        .replace(b"\0", b" ")
                        .decode(errors="replace")
                    )
    return found


def main() -> None:
    """Run one storm."""
    seed, seconds, folder, *options = sys.argv[1:]
    lo = "--lo" in options
    if lo:
        _link("up")
    os.environ[MARK] = f"{os.getpid()}"
    told = asyncio.run(Storm(int(seed), Path(folder), lo).pass_over(float(seconds)))
    print(json.dumps(told))


if __name__ == "__main__":
    main()
