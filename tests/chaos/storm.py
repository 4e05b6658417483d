"""Mission runs in real time while everything around them breaks: `storm.py SEED SECONDS FOLDER [--lo]`. Prints one JSON object.

Nodes live under the supervisor of `petrobot up`, each behind a proxy. Seeded weather kills nodes and workers (SIGKILL), freezes
them (SIGSTOP), cuts, delays and repeats what goes over the wire, drops the coordinator as a crash would (connections aborted, what
was not written lost), and, in a network namespace of its own (`--lo`), takes the loopback down. Mission runs follow one another,
resumed after each crash; each is judged by its journal and by what the hands noted. Last comes one in calm weather.
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
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coordinator.cli.loading import load_task
from coordinator.cli.replaying import recorded
from coordinator.engine import Fired, RunRecorded, StartRun
from coordinator.journal import JournalWriter
from coordinator.launch import Setting, local_programs, mission_id, realtime_mission, resumed_mission, with_runs
from coordinator.mission import Mission, Stage
from coordinator.realtime import RealtimeMission, UnreachableError
from coordinator.recording import JournalStore, clock_reading
from coordinator.runfolder import JOURNAL, header
from coordinator.supervisor import Supervisor
from coordinator.task import Status
from services.comm.directory import Directory, load
from tests.chaos.shuttle_cell import ROOT, TASK, free_ports, moves, shuttle_services
from tests.waiting import beat

MARK = "PETROBOT_STORM"
"""Environment variable that all processes of a storm carry."""
LONGEST = 90.0
"""Seconds after which a mission run counts as hanging."""
RUNS = 6
NODES = ("left", "right")
CALM = "calm"


class Weather:
    """What breaks, and when: all drawn from a seed."""

    def __init__(
        self, seed: int, supervisor: Supervisor, proxy: asyncio.subprocess.Process, crash: asyncio.Event, lo: bool
    ) -> None:
        """`crash` is set when the coordinator shall die."""
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
        """Break something every now and then, until cancelled."""
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
        node = self._node()
        with contextlib.suppress(OSError):
            children = Path(f"/proc/{node}/task/{node}/children").read_text().split()
            return int(self._draw.choice(children)) if children else 0
        return 0


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
        self._unreachable = self._calls = self._resumes = 0
        self._crash = asyncio.Event()
        self._faults: list[str] = []

    async def pass_over(self, seconds: float) -> dict[str, Any]:
        """Run missions for so long in the storm, then one in calm weather; what was seen."""
        pairs = [f"{port}:{self._directory.nodes[n].port}" for port, n in zip(self._proxied, NODES, strict=True)]
        command = [sys.executable, "-m", "tests.chaos.proxy", *pairs]
        pipe = asyncio.subprocess.PIPE
        proxy = await asyncio.create_subprocess_exec(*command, cwd=ROOT, stdin=pipe, stdout=pipe)
        assert proxy.stdout is not None and proxy.stdin is not None
        await proxy.stdout.readline()
        try:
            async with Supervisor(local_programs(self._directory), self._folder / "logs") as supervisor:
                weather = Weather(self._seed, supervisor, proxy, self._crash, self._lo)
                loop = asyncio.get_running_loop()
                before, end = _sockets(), loop.time() + seconds
                blowing = loop.create_task(weather.blow())
                while loop.time() < end:
                    await self._mission(loop.time())
                blowing.cancel()
                await asyncio.gather(blowing, return_exceptions=True)
                await self._calm(supervisor)
                left = _sockets() - before
        finally:
            proxy.stdin.close()
            await proxy.wait()
        return self._told(weather, left)

    def _told(self, weather: Weather, sockets: int) -> dict[str, Any]:
        begun = moves(self._folder, "begin")
        return {
            "missions": sum(self._ends.values()),
            "ends": dict(self._ends),
            "resumed": self._resumes,
            "unreachable": self._unreachable,
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
        """All nodes are up again: a mission run without any error; then no fence was left behind."""
        loop = asyncio.get_running_loop()
        end = loop.time() + LONGEST
        while loop.time() < end:
            if len(supervisor.process_ids()) == len(NODES) and await self._mission(loop.time(), CALM):
                return
            await beat(0.2)
        self._faults.append("no calm mission run without error came about")

    async def _mission(self, now: float, name: str = "") -> bool:
        """One mission run, judged; True if all its runs ended well."""
        task, mission_name = load_task(str(TASK)), mission_id(load_task(str(TASK)))
        folder = self._folder / "runs" / mission_name
        store = JournalStore(JournalWriter(folder / JOURNAL, self._header(mission_name, now)), now)
        setting = Setting(task, runs=RUNS, seed=self._seed)
        mission, begin = realtime_mission(self._by_proxy(), setting, mission_name, store), None
        until = now + LONGEST
        while not await self._life(mission, begin, until):
            if mission.stage is Stage.CONNECTING and begin is None:
                return False
            mission, begin = self._resumed(folder)
        if mission.stage is not Stage.OVER:
            self._faults.append(f"{mission_name} hangs: {mission.executor.state}")
            return False
        self._judge(mission, folder)
        return name != CALM or all(r.status is Status.SUCCESS for r in mission.tally.runs)

    async def _life(self, mission: Mission, begin: Callable[[float], None] | None, until: float) -> bool:
        """One life of the coordinator: False if it crashed, or its nodes were not there."""
        loop = asyncio.get_running_loop()
        shell = RealtimeMission(mission, self._by_proxy())
        self._crash.clear()
        try:
            await shell.connect(10.0)
        except UnreachableError:
            self._unreachable += 1
            self._drop_journal(mission)
            await shell.close()
            return loop.time() > until
        running, crashing = asyncio.ensure_future(shell.run(begin)), asyncio.ensure_future(self._crash.wait())
        await asyncio.wait({running, crashing}, timeout=until - loop.time(), return_when=asyncio.FIRST_COMPLETED)
        crashed = crashing.done() and not running.done()
        for task in (running, crashing):
            task.cancel()
        await asyncio.gather(running, crashing, return_exceptions=True)
        self._drop_journal(mission)
        if crashed:
            _vanish(shell)
        await shell.close()
        return not crashed

    @staticmethod
    def _drop_journal(mission: Mission) -> None:
        """Let the file go as a dead process does: what was not written is lost, and what is written from now on goes nowhere."""
        store = mission.executor.store
        assert isinstance(store, JournalStore)
        nowhere = os.open(store.writer.path.with_name("lost"), os.O_WRONLY | os.O_CREAT, 0o600)
        os.dup2(nowhere, store.writer._file)
        os.close(nowhere)

    def _resumed(self, folder: Path) -> tuple[Mission, Callable[[float], None]]:
        self._resumes += 1
        found = recorded(str(folder))
        now = asyncio.get_running_loop().time()
        return resumed_mission(self._by_proxy(), found.task, found.engine, found.journal, [], now)

    def _by_proxy(self) -> Directory:
        nodes = self._directory.nodes
        moved = {n: replace(nodes[n], port=port) for n, port in zip(NODES, self._proxied, strict=True)}
        return replace(self._directory, nodes=moved)

    def _header(self, mission: str, now: float) -> dict[str, Any]:
        text, services = TASK.read_text(encoding="utf-8"), self._services.read_text(encoding="utf-8")
        given = {"services_path": str(self._services), "seed": self._seed, "runs": RUNS, "parameters": {}}
        return header(mission, text, services, "realtime", {**given, "clock": clock_reading(now)})

    def _judge(self, mission: Mission, folder: Path) -> None:
        """The end has a reason, every run one end, every firing is one of the net, the journal says the same again."""
        finished = mission.executor.finished
        assert finished is not None
        self._ends[finished.status.value] += 1
        steps = list(recorded(str(folder)).steps())
        given = [instruction for step in steps for instruction in step.instructions]
        firings = [one for one in given if isinstance(one, Fired)]
        started = [one.run for one in given if isinstance(one, StartRun)]
        records = [one for one in given if isinstance(one, RunRecorded)]
        self._calls += len(started)
        self._causes.update(f"{r.cause} ({r.executed})" for r in records if r.cause)
        net = with_runs(load_task(str(TASK)), RUNS)[0].flat.net
        markings = [tuple(m) for m in net.replay([f.transition for f in firings], firings[0].before)]
        checks = {
            "its end has no reason": bool(finished.reason),
            "a firing is none of the net": markings[1:] == [f.after for f in firings],
            "replay gives another state": steps[-1].state == mission.executor.state,
            "a run was started twice": len(started) == len(set(started)),
            "a run has not one end": sorted(r.run for r in records) == sorted(started),
            "an error has no cause": all(r.cause for r in records if r.status is Status.ERROR),
            "tokens were lost": markings[-1][net.place_index["runs"]] == 0 or finished.status is Status.ERROR,
        }
        self._faults += [f"{folder.name}: {text}" for text, holds in checks.items() if not holds]


def _signal(process: int, number: signal.Signals) -> None:
    if process:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, number)


def _vanish(shell: RealtimeMission) -> None:
    """Abort all connections without a word."""
    for client in shell.clients.values():
        if client._link is not None:
            client._link.cut("the coordinator died")


def _link(state: str) -> None:
    subprocess.run(["ip", "link", "set", "lo", state], check=True)


def _sockets() -> int:
    """Sockets that this process has open."""
    count = 0
    for path in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            count += str(path.readlink()).startswith("socket:")
    return count


def _marked() -> list[str]:
    """Command lines of the other processes that carry this storm's mark: none may be left when it is over."""
    mark, found = f"{MARK}={os.environ.get(MARK, '')}".encode(), []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with contextlib.suppress(OSError):
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace"))
    return found


def main() -> None:
    """One storm."""
    seed, seconds, folder, *options = sys.argv[1:]
    lo = "--lo" in options
    if lo:
        _link("up")
    os.environ[MARK] = f"{os.getpid()}"
    told = asyncio.run(Storm(int(seed), Path(folder), lo).pass_over(float(seconds)))
    print(json.dumps(told))


if __name__ == "__main__":
    main()
