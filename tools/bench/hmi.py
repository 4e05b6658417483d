"""Measure what the operator's page costs: per painted update in the browser, and in the
coordinator's own loop.

    python tools/bench/hmi.py [--nodes 100 300] [--seconds 8] [--gate-cpu MS] [--json FILE]

A synthetic net receives 50 updates per second (a firing with its marking, progress of three runs,
one variable) through the real feed and server. Measured in headless Chromium: time of the main
thread per painted update (Chromium's `TaskDuration`), frames per second, gaps in the sequence, and
the time from the change in the server to the painted frame. Measured in the loop: its CPU time and
how late its 50 Hz ticker was, without a client and with five in another process, one of which reads
almost nothing. With `--gate-cpu` the run fails if a painted update costs more, or after a gap.

    python tools/bench/hmi.py --checks 300 [--rounds 3] [--seconds 8] [--json FILE]

A real-time mission over two nodes fires as fast as its actions of 10 ms allow. Another process
gives commands. In every second round, a third process draws: three checks at a time of a net with
so many places, without a pause. Reported are firings per second and the latency of the commands
with and without the drawing, and the ratios of their medians.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

import aiohttp

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from petrobot.coordinator.operator.port import Feed  # noqa: E402 - the bench runs as a file
from petrobot.coordinator.page.server import Page, start_page  # noqa: E402
from tests.operator.conftest import SCRIPT, TASK, Cell  # noqa: E402
from tests.page.conftest import ARGUMENTS, BROWSER  # noqa: E402
from tests.waiting import until  # noqa: E402

RATE = 50
PROBE = """() => {
  const { link } = window.petrobot;
  const probe = { late: [], frames: 0, painted: 0, before: link.deltas, from: performance.now() };
  window.probe = probe;
  const paint = link.painted;
  link.painted = (changed, changes) => {
    paint(changed, changes);
    if (!changes.length) return;
    probe.painted += 1;
    const stamp = link.state.variables.stamp;
    const done = new MessageChannel();
    const now = () => performance.timeOrigin + performance.now();
    done.port1.onmessage = () => probe.late.push(now() - stamp);
    done.port2.postMessage(0); // a task of its own: it runs after this frame was painted
  };
  const frame = () => { probe.frames += 1; requestAnimationFrame(frame); };
  requestAnimationFrame(frame);
}"""
READ = """() => ({ late: probe.late, frames: probe.frames, painted: probe.painted,
  gaps: window.petrobot.link.gaps, seconds: (performance.now() - probe.from) / 1000 })"""


class SyntheticMission:
    """A mission without an engine, for the page's server: rows of action places whose tokens
    circulate."""

    def __init__(self, nodes: int) -> None:
        self.feed = Feed()
        self.number = 0
        self.places = [f"place_{i}" for i in range(nodes // 2)]
        self.feed.replace(
            task=task_of(self.places),
            mission={"id": "bench", "state": "running", "mode": "realtime"},
            marking={name: (i % 3 == 0 and 1) or 0 for i, name in enumerate(self.places)},
        )
        for i in range(3):
            self.start_run(i)

    def start_run(self, i: int) -> None:
        """Start a run that stays active for the whole measurement."""
        run = {
            "id": f"r{i}",
            "place": self.places[i],
            "primitive_task": "t",
            "action": f"action {i}",
            "node": "n",
        }
        self.feed.emit(
            "run_started", run={**run, "why": "", "started": 0.0, "deadline": 99.0, "progress": 0.0}
        )

    def snapshot(self) -> dict[str, Any]:
        """Return the state."""
        return self.feed.snapshot()

    def subscribe(self, receive: Callable[[dict[str, Any]], None]) -> Callable[[], None]:
        """Subscribe to changes."""
        return self.feed.subscribe(receive)

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Refuse every command."""
        return {"ok": False, "code": "bench", "text": "a bench has no commands"}

    def update(self, at: float) -> None:
        """Send one update, as a busy mission would."""
        self.number += 1
        i = self.number % len(self.places)
        after = (i + 1) % len(self.places)
        firing = {
            "number": self.number,
            "transition": f"step_{i}",
            "at": at,
            "cause": "end of a run",
            "error": False,
        }
        self.feed.emit("fired", time=at, firing=firing)
        self.feed.emit("marking", time=at, marking={self.places[i]: 0, self.places[after]: 1})
        for run in range(3):
            self.feed.emit("run_progress", time=at, id=f"r{run}", progress=(at / 20 + run / 3) % 1)
        self.feed.emit("variable", time=at, name="stamp", value=time.time() * 1000)


def task_of(places: list[str]) -> dict[str, Any]:
    """Return a task whose drawing has places and transitions in rows of ten."""

    def at(i: int) -> dict[str, int]:
        return {"x": 80 + (i % 10) * 200, "y": 80 + (i // 10) * 130}

    drawn = [
        {"name": n, "kind": "action", "label": "", "in_macro": "", "error": False, **at(i)}
        for i, n in enumerate(places)
    ]
    steps: list[dict[str, Any]] = [
        {
            "name": f"step_{i}",
            "label": "",
            "in_macro": "",
            "events": [],
            "when": "",
            "after": None,
            "error": False,
        }
        | {"x": at(i)["x"] + 100, "y": at(i)["y"]}
        for i in range(len(places))
    ]
    arcs = []
    for i, name in enumerate(places):
        following = places[(i + 1) % len(places)]
        arcs.append(
            {
                "place": name,
                "transition": f"step_{i}",
                "direction": "in",
                "weight": 1,
                "end": "normal",
            }
        )
        arcs.append(
            {"place": following, "transition": f"step_{i}", "direction": "out", "weight": 1}
        )
    general = {
        "name": "bench",
        "primitive_tasks": {},
        "events": {},
        "parameters": {},
        "runs_place": "",
    }
    return {**general, "places": drawn, "transitions": steps, "arcs": arcs}


async def ticking(mission: SyntheticMission, seconds: float) -> dict[str, float]:
    """Feed updates for so long. Return the loop's share of CPU time, and how late its ticks were
    (ms)."""
    loop = asyncio.get_running_loop()
    begun, cpu = loop.time(), time.thread_time()
    late: list[float] = []
    for n in range(int(seconds * RATE)):
        due = begun + n / RATE
        await asyncio.sleep(max(0.0, due - loop.time()))
        late.append((loop.time() - due) * 1000)
        mission.update(n / RATE)
    late.sort()
    spent = time.thread_time() - cpu
    return {
        "cpu_share": spent / (loop.time() - begun),
        "late_p50_ms": statistics.median(late),
        "late_p99_ms": late[int(len(late) * 0.99)],
    }


async def in_browser(page: Page, mission: SyntheticMission, seconds: float) -> dict[str, float]:
    """Measure the page in headless Chromium."""
    from playwright.async_api import async_playwright

    async with async_playwright() as driver:
        browser = await driver.chromium.launch(executable_path=str(BROWSER), args=ARGUMENTS)
        tab = await browser.new_page(viewport={"width": 1440, "height": 900})
        await tab.goto(page.url)
        await tab.wait_for_selector(".net .transition")
        await ticking(mission, 1.0)
        session = await tab.context.new_cdp_session(tab)
        await session.send(
            "Performance.enable", {"timeDomain": "threadTicks"}
        )  # CPU time of the thread, not the clock
        await tab.evaluate(PROBE)
        before = await busy(session)
        await ticking(mission, seconds)
        after = await busy(session)
        seen = await tab.evaluate(READ)
        await browser.close()
    late = sorted(seen["late"])
    return {
        "cpu_ms_per_update": (after - before) * 1000 / max(1, seen["painted"]),
        "frames_per_s": seen["frames"] / seen["seconds"],
        "painted_per_s": seen["painted"] / seen["seconds"],
        "gaps": seen["gaps"],
        "server_to_paint_p50_ms": statistics.median(late),
        "server_to_paint_p95_ms": late[int(len(late) * 0.95)],
    }


async def busy(session: Any) -> float:
    """Return the CPU seconds of the page's main thread."""
    metrics = (await session.send("Performance.getMetrics"))["metrics"]
    return float(next(m["value"] for m in metrics if m["name"] == "TaskDuration"))


async def crowd(url: str, token: str) -> None:
    """Five clients, the last of which takes a message every two seconds; runs in a process of its
    own."""
    headers = {"Authorization": f"Bearer {token}"}
    async with aiohttp.ClientSession(headers=headers) as http:
        sockets = [await http.ws_connect(url, max_msg_size=0) for _ in range(5)]
        for i, socket in enumerate(sockets):
            await socket.send_json({"type": "hello", "protocol": 1, "name": "bench", "tab": str(i)})
        print("ready", flush=True)
        await asyncio.gather(*(read(s, 2.0 if i == 4 else 0.0) for i, s in enumerate(sockets)))


async def read(socket: aiohttp.ClientWebSocketResponse, pause: float) -> None:
    """Receive messages until the server ends."""
    async for _ in socket:
        if pause:
            await asyncio.sleep(pause)


async def with_crowd(
    page: Page, measure: Callable[[], Awaitable[dict[str, float]]]
) -> dict[str, float]:
    """Measure while five clients are connected from another process."""
    url = page.url.partition("?")[0] + "api/live"
    process = await asyncio.create_subprocess_exec(
        sys.executable, __file__, "--crowd", url, page.token, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    await process.stdout.readline()
    try:
        return await measure()
    finally:
        process.kill()
        await process.wait()


# --- a mission while a designer draws ---------------------------------------------------------


def drawing(places: int) -> dict[str, Any]:
    """Return the document of a chain of action places, each with an error branch."""
    document: dict[str, Any] = {
        "schema": 1,
        "task": {"name": "drawn", "final": "done > 0"},
        "primitive_tasks": {
            "look": {"goal": "seen", "alternatives": ["look_at_table"], "deadline": 5.0}
        },
        "places": {"done": {"kind": "control"}},
        "transitions": {},
    }
    for i in range(places):
        then = f"p{i + 1}" if i + 1 < places else "done"
        document["places"][f"p{i}"] = {"kind": "action", "task": "look"} | (
            {} if i else {"tokens": 1}
        )
        document["transitions"][f"t{i}"] = {"in": [f"p{i}:normal"], "out": [then]}
        document["transitions"][f"e{i}"] = {"in": [f"p{i}:error"], "out": [then]}
    return document


async def draw(url: str, token: str, places: int) -> None:
    """Check three drawings at a time without end, in a process of its own."""
    document = drawing(places)
    async with aiohttp.ClientSession(url, headers={"Authorization": f"Bearer {token}"}) as http:

        async def hand(name: str) -> None:
            for turn in itertools.count():
                body = {
                    "name": name,
                    "document": {**document, "task": {**document["task"], "text": f"turn {turn}"}},
                }
                async with http.post("/api/check", json=body) as answer:
                    assert answer.status == 200, await answer.text()
                print(name, flush=True)

        await asyncio.gather(*(hand(f"drawn_{i}") for i in range(3)))


async def give(url: str, token: str, seconds: float) -> None:
    """Give a command every 50 ms and print how long each took (ms), in a process of its own."""
    late = []
    async with aiohttp.ClientSession(url, headers={"Authorization": f"Bearer {token}"}) as http:
        until = time.perf_counter() + seconds
        while time.perf_counter() < until:
            begun = time.perf_counter()
            async with http.post(
                "/api/command", json={"verb": "ask_controls", "name": "asker"}
            ) as answer:
                assert answer.status == 200, await answer.text()
            late.append((time.perf_counter() - begun) * 1000)
            await asyncio.sleep(0.05)
    print(json.dumps(late))


async def beside(
    page: Page, state: Mapping[str, Any], seconds: float, places: int
) -> dict[str, float]:
    """Measure firings per second and latencies for so long, while a designer draws unless `places`
    is 0."""
    arguments = [sys.executable, __file__]
    drawer = None
    if places:
        drawer = await asyncio.create_subprocess_exec(
            *arguments, "--draw", page.base, page.token, str(places), stdout=subprocess.PIPE
        )
        assert drawer.stdout is not None
        await asyncio.wait_for(drawer.stdout.readline(), 300)  # starts with its first answer
    asker = await asyncio.create_subprocess_exec(
        *arguments, "--give", page.base, page.token, str(seconds), stdout=subprocess.PIPE
    )
    begun, firings = time.perf_counter(), mission_of(state)["firings"]
    said, _ = await asyncio.wait_for(asker.communicate(), seconds + 120)
    rate = (mission_of(state)["firings"] - firings) / (time.perf_counter() - begun)
    checks = 0
    if drawer is not None:
        drawer.kill()
        rest, _ = await drawer.communicate()
        checks = rest.count(b"\n")
    late = sorted(json.loads(said))
    worst = {"command_p99_ms": late[int(len(late) * 0.99)], "command_worst_ms": late[-1]}
    return {
        "firings_per_s": rate,
        "command_p50_ms": statistics.median(late),
        **worst,
        "checks": checks,
    }


def mission_of(state: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the mission's part of the snapshot, which must say that it is active."""
    mission: Mapping[str, Any] = state["mission"]
    assert mission["state"] == "running", mission
    return mission


async def with_checks(places: int, seconds: float, rounds: int) -> dict[str, Any]:
    """Measure a mission with and without a designer who draws, in turns."""
    with tempfile.TemporaryDirectory() as folder:
        cell = Cell(Path(folder), SCRIPT.replace("seconds = 0.05", "seconds = 0.01"))
        for node in cell.nodes.values():
            await node.start()
        text = TASK.replace("tokens = 2\ncapacity = 9", "tokens = 1000000")
        cell.tasks.save_text("moving", cell.tasks.read("moving").revision, text)
        await cell.station.look()
        await cell.say("take_controls")
        page = await start_page(cell.station, tasks_folder=Path(folder) / "tasks")
        assert (await cell.say("start", task="moving"))["ok"]
        await until(lambda: cell.state["mission"]["firings"] > 100)
        turns: dict[str, list[dict[str, float]]] = {"alone": [], "checks": []}
        for _ in range(rounds):
            turns["alone"].append(await beside(page, cell.state, seconds, 0))
            turns["checks"].append(await beside(page, cell.state, seconds, places))
        begun = time.perf_counter()
        await cell.say("estop")
        stopped = (time.perf_counter() - begun) * 1000
        await page.close()
        await cell.station.close()
        for node in cell.nodes.values():
            await node.close()
    medians = {
        turn: {key: statistics.median(one[key] for one in many) for key in many[0]}
        for turn, many in turns.items()
    }
    ratios = {
        key: medians["checks"][key] / medians["alone"][key] for key in list(medians["alone"])[:3]
    }
    return {
        "places": places,
        "medians": medians,
        "ratios": ratios,
        "estop_ms": stopped,
        "turns": turns,
    }


async def measured(nodes: int, seconds: float) -> dict[str, Any]:
    """Measure all figures for one size of net."""
    mission = SyntheticMission(nodes)
    page = await start_page(mission, tasks_folder=Path(tempfile.gettempdir()))
    alone = await ticking(mission, seconds)
    five = await with_crowd(page, lambda: ticking(mission, seconds))
    browser = await in_browser(page, mission, seconds)
    await page.close()
    share = five["cpu_share"] - alone["cpu_share"]
    return {
        "nodes": nodes,
        "browser": browser,
        "loop_alone": alone,
        "loop_five_clients": five,
        "clients_cpu_share": share,
    }


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nodes", type=int, nargs="+", default=[100, 300])
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument(
        "--gate-cpu", type=float, help="fail when a painted update costs more ms, or at a gap"
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--checks",
        type=int,
        metavar="PLACES",
        help="a mission beside checks of a net of so many places",
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--crowd", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--draw", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--give", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.draw:
        asyncio.run(draw(options.draw[0], options.draw[1], int(options.draw[2])))
        return 0
    if options.give:
        asyncio.run(give(options.give[0], options.give[1], float(options.give[2])))
        return 0
    if options.checks:
        text = json.dumps(
            asyncio.run(with_checks(options.checks, options.seconds, options.rounds)), indent=2
        )
        print(text)
        if options.json:
            options.json.write_text(text, encoding="utf-8")
        return 0
    if options.crowd:
        asyncio.run(crowd(*options.crowd))
        return 0
    results = [asyncio.run(measured(nodes, options.seconds)) for nodes in options.nodes]
    text = json.dumps(results, indent=2)
    print(text)
    if options.json:
        options.json.write_text(text)
    if options.gate_cpu is None:
        return 0
    bad = [
        r
        for r in results
        if r["browser"]["gaps"] or r["browser"]["cpu_ms_per_update"] > options.gate_cpu
    ]
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
