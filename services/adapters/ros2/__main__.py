"""Offer a task to ROS 2 as an action: a goal starts a run, as an operator would start it.

    petrobot serve --up                                   prints the page's address, with its token
    python -m petrobot.services.adapters.ros2 deliver --page ADDRESS --url ws://ROBOT:9090

This is a client of the operator's protocol (docs/operator-protocol.md) and of rosbridge.

Its type is RunTask.action, beside this file. With another type, give its file with --definition.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import aiohttp

from petrobot.services.adapters.ros2 import definitions
from petrobot.services.adapters.ros2.link import RosbridgeLink, connect

_log = logging.getLogger(__name__)
LOOK = 0.2
"""Time between two checks of the run (s)."""
LATE = 10
"""Checks after the end of the run, before the wait for its result is given up."""
SUCCEEDED, CANCELLED, ABORTED = 4, 5, 6
"""action_msgs/msg/GoalStatus."""
ENDS = ("success", "failure", "error", "aborted", "stopped")
NAME = "ros2"
TYPE = "petrobot_interfaces/action/RunTask"


class OperatorPage:
    """The coordinator's page, over HTTP. Its calls raise OSError when it cannot be reached."""

    def __init__(self, address: str, http: aiohttp.ClientSession) -> None:
        base, _, token = address.partition("/?token=")
        self._base, self._http = base.rstrip("/"), http
        self._headers = {"Authorization": f"Bearer {token}"}

    async def snapshot(self) -> Mapping[str, Any]:
        """Return the state of the mission."""
        return await self._ask("get", "/api/snapshot")

    async def command(self, verb: str, **data: Any) -> Mapping[str, Any]:
        """Give a command; return its answer, {ok, code, text, ...}."""
        body = {"verb": verb, "data": data, "name": NAME}
        return await self._ask("post", "/api/command", json=body)

    async def _ask(self, method: str, path: str, **more: Any) -> Mapping[str, Any]:
        try:
            async with self._http.request(
                method, self._base + path, headers=self._headers, **more
            ) as answer:
                said = await answer.json(content_type=None)
        except (aiohttp.ClientError, TimeoutError, ValueError) as fault:
            raise OSError(f"the page does not answer: {fault or type(fault).__name__}") from fault
        if not isinstance(said, dict):
            raise OSError(f"the page refuses: {said!r:.100}; is its token right?")
        return said


class OfferedTask:
    """One task as one action server; one goal at a time."""

    def __init__(
        self, link: RosbridgeLink, page: OperatorPage, options: argparse.Namespace
    ) -> None:
        self._link, self._page, self._options = link, page, options
        self._fields: Mapping[str, Mapping[str, Any]] = {}
        if options.definition is not None:
            text = options.definition.read_text(encoding="utf-8")
            self._fields = definitions.read(options.type, text, str(options.definition))
        self._goal = ""
        """Id of the active goal."""
        self._why = ""
        """Why the run must be aborted: "cancelled" by the goal's client, or "lost" with the
        link."""
        self._runs = set[asyncio.Task[None]]()

    async def serve(self, stop: asyncio.Event) -> None:
        """Serve goals until `stop`; then abort the active one."""
        action = {"action": self._options.action}
        while not stop.is_set():
            for kind, item in self._link.news():
                if kind == "up":
                    self._send({"op": "advertise_action", **action, "type": self._options.type})
                    print(f"{self._options.action} is offered", flush=True)
                elif kind == "down":
                    self._why = "lost"
                    print(f"no connection to rosbridge: {item}", file=sys.stderr, flush=True)
                elif kind == "message" and item.get("action") == self._options.action:
                    self._take(item)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), 0.02)
        self._why = "lost"
        await asyncio.gather(*self._runs)
        self._send({"op": "unadvertise_action", **action})

    def _take(self, message: Mapping[str, Any]) -> None:
        goal = message.get("id")
        if message["op"] == "cancel_action_goal" and goal == self._goal:
            self._why = "cancelled"
        elif message["op"] == "send_action_goal" and isinstance(goal, str):
            if self._goal:
                self._result(goal, ABORTED, "refused", "a run of this task is active")
                return
            self._goal, self._why = goal, ""
            run = asyncio.create_task(self._run(goal, message.get("args")))
            self._runs.add(run)
            run.add_done_callback(self._runs.discard)

    async def _run(self, goal: str, args: Any) -> None:
        """Start a run, follow it to its end, and report to ROS 2."""
        try:
            await self._follow(goal, await self._start(args))
        except (OSError, ValueError) as fault:
            self._result(goal, ABORTED, "refused", str(fault))
        except Exception as fault:  # answer at once, so that the client does not wait for ever
            _log.exception("goal %s", goal)
            self._result(goal, ABORTED, "refused", f"{type(fault).__name__}: {fault}")
        finally:
            self._goal = ""
            with contextlib.suppress(OSError):
                await self._page.command("release_controls")

    async def _start(self, args: Any) -> str:
        if not isinstance(args, dict):
            raise ValueError(f"expected a goal with fields, found {args!r:.60}")
        parameters = {k: v for k, v in args.items() if k not in ("parameters", "runs", "seed")}
        given = json.loads(args.get("parameters") or "{}")
        if not isinstance(given, dict):
            raise ValueError(f"parameters: expected a JSON object, found {given!r:.60}")
        counts = {k: args[k] for k in ("runs", "seed") if args.get(k)}
        for verb, data in (
            ("take_controls", {}),
            (
                "start",
                {
                    "task": self._options.task,
                    "mode": self._options.mode,
                    "parameters": {**parameters, **given},
                    **counts,
                },
            ),
        ):
            answer = await self._page.command(verb, **data)
            if not answer.get("ok"):
                raise ValueError(f"{verb}: {answer.get('text')}")
        return str(answer["run"])

    async def _follow(self, goal: str, run: str) -> None:
        told: dict[str, Any] = {}
        looks = 0
        while True:
            seen = await self._page.snapshot()
            if seen["mission"]["id"] == run and seen["mission"]["state"] in ENDS:
                looks += 1  # the result comes shortly after the end
                if seen["result"] is not None or looks > LATE:
                    break
            feedback = {
                "places": [place for place, tokens in seen["marking"].items() if tokens],
                "tokens": [tokens for tokens in seen["marking"].values() if tokens],
                "active": [active["action"] for active in seen["runs"].values()],
            }
            if feedback != told:
                told = feedback
                self._tell("action_feedback", goal, "Feedback", feedback)
            if self._why and seen["mission"]["state"] != "stopping":
                await self._page.command("take_controls")
                await self._page.command("abort")
            await asyncio.sleep(LOOK)
        state = seen["mission"]["state"]
        # ROS 2 knows `cancelled` only after its client's cancel, not after an operator's abort.
        failed = CANCELLED if self._why == "cancelled" else ABORTED
        status = SUCCEEDED if state == "success" else failed
        text = json.dumps(seen["result"], allow_nan=False)
        self._result(goal, status, state, str(seen["mission"].get("reason") or ""), text)

    def _result(self, goal: str, status: int, state: str, reason: str, result: str = "") -> None:
        values = {"state": state, "reason": reason, "result": result}
        # `result: true` also for an abort: else rosbridge drops the values
        self._tell("action_result", goal, "Result", values, status=status, result=True)

    def _tell(self, op: str, goal: str, part: str, values: dict[str, Any], **more: Any) -> None:
        known = self._fields.get(f"{self._options.type}.{part}", values)
        values = {name: value for name, value in values.items() if name in known}
        self._send({"op": op, "action": self._options.action, "id": goal, "values": values, **more})

    def _send(self, message: dict[str, Any]) -> None:
        if self._link.up:
            self._link.send(message)


async def main(arguments: list[str]) -> int:
    """Read the options and serve."""
    parser = argparse.ArgumentParser(prog="python -m petrobot.services.adapters.ros2")
    parser.description = "Offer a task to ROS 2 as an action."
    parser.add_argument("task", help="name of a task that the page offers")
    parser.add_argument(
        "--page",
        default=os.environ.get("PETROBOT_PAGE"),
        help="address that `petrobot serve` prints, with its token (PETROBOT_PAGE)",
    )
    parser.add_argument("--url", default="ws://127.0.0.1:9090", help="rosbridge (%(default)s)")
    parser.add_argument("--action", help="name of the action (/TASK)")
    parser.add_argument("--type", default=TYPE, help="type of the action (%(default)s)")
    parser.add_argument("--definition", type=Path, help="its .action file, if it is another one")
    parser.add_argument("--mode", default="realtime", choices=("realtime", "lockstep"))
    options = parser.parse_args(arguments)
    options.action = options.action or f"/{options.task}"
    if not options.page or "/?token=" not in options.page:
        parser.error(
            "--page: expected the address that `petrobot serve` prints, http://.../?token="
        )
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    timeout = aiohttp.ClientTimeout(10.0)
    async with aiohttp.ClientSession(trust_env=False, timeout=timeout) as http:
        link = connect(options.url, 10.0)
        try:
            await OfferedTask(link, OperatorPage(options.page, http), options).serve(stop)
        except (OSError, ValueError) as fault:
            print(fault, file=sys.stderr)
            return 2
        finally:
            link.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(asyncio.run(main(sys.argv[1:])))
