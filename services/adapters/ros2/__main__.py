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
import secrets
import signal
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from petrobot import OperatorClient, OperatorError, SessionThread
from petrobot.services.adapters.ros2 import messages
from petrobot.services.adapters.ros2.bridge import serve
from petrobot.services.adapters.ros2.messages import Message

_log = logging.getLogger(__name__)
LOOK = 0.2
"""Least time between two messages of feedback (s)."""
RESULT = 30.0
"""Longest wait for the begin of a run, and after its end for its result (s): on a busy host either
may take seconds, and a goal must not end while its run moves."""
SUCCEEDED, CANCELLED, ABORTED = 4, 5, 6
"""action_msgs/msg/GoalStatus."""
ENDS = ("success", "failure", "error", "aborted", "stopped")
NAME = "ros2"
PAGE = "address that `petrobot serve` prints, http://.../?token=... (or PETROBOT_PAGE)"
TYPE = "petrobot_interfaces/action/RunTask"


class OfferedTask:
    """One task as one action server; one goal at a time."""

    def __init__(
        self,
        link: SessionThread,
        connect: Callable[[], OperatorClient],
        options: argparse.Namespace,
    ) -> None:
        """`connect` makes a client of the page, for each goal another one."""
        self._link, self._connect, self._options = link, connect, options
        self._fields: messages.Definitions = {}
        if options.definition is not None:
            text = options.definition.read_text(encoding="utf-8")
            self._fields = messages.read(options.type, text, str(options.definition))
        self._goal = ""
        """Id of the active goal."""
        self._why = ""
        """Why the run must be aborted: "cancelled" by the goal's client, or "lost" with the
        link."""
        self._ending = False
        """Whether this process must end: it waits for no operator."""
        self._runs = set[asyncio.Task[None]]()

    async def serve(self, stop: asyncio.Event) -> None:
        """Serve goals until `stop`; then abort the active one."""
        action, why = {"action": self._options.action}, ""
        while not stop.is_set():
            for kind, item in self._link.news():
                if kind == "up":
                    self._link.send(
                        {"op": "advertise_action", **action, "type": self._options.type}
                    )
                    print(f"{self._options.action} is offered", flush=True)
                    why = ""
                elif kind == "down":
                    self._why = "lost"
                    if item != why:  # not at each attempt
                        print(f"no connection to rosbridge: {item}", file=sys.stderr, flush=True)
                    why = item
                elif kind == "message" and item.get("action") == self._options.action:
                    self._take(item)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), 0.02)
        self._why, self._ending = "lost", True
        await asyncio.gather(*self._runs)
        self._link.send({"op": "unadvertise_action", **action})

    def _take(self, message: Message) -> None:
        goal = message.get("id")
        if message["op"] == "cancel_action_goal" and goal == self._goal:
            self._why = "cancelled"
        elif message["op"] == "send_action_goal" and isinstance(goal, str) and goal:
            if goal == self._goal:
                return  # sent twice: an answer would end the goal, while its run continues
            if self._goal:
                self._result(goal, ABORTED, "refused", "a run of this task is active")
                return
            self._goal, self._why = goal, ""
            run = asyncio.create_task(self._run(goal, message.get("args")))
            self._runs.add(run)
            run.add_done_callback(self._runs.discard)

    async def _run(self, goal: str, args: Any) -> None:
        """Start a run, follow it to its end, and report to ROS 2."""
        state = "refused"
        try:
            start = self._wanted(args)
            async with self._connect() as page:
                state = "unknown"  # from here on it may move, whatever happens to this connection
                answer = await _ordered(page, "start", start)
                if not answer.get("ok"):
                    state = "refused"
                    raise ValueError(str(answer.get("text")))
                ended = await self._follow(goal, page, str(answer["run"]))
        except (OperatorError, ValueError) as fault:
            ended = ABORTED, state, str(fault), ""
        except Exception as fault:  # answer at once, so that the client does not wait for ever
            _log.exception("goal %s", goal)
            ended = ABORTED, state, f"{type(fault).__name__}: {fault}", ""
        self._goal = ""
        self._result(goal, *ended)

    def _wanted(self, args: Any) -> Message:
        """Return the start that a goal wants. Raises ValueError."""
        if not isinstance(args, dict):
            raise ValueError(f"expected a goal with fields, found {args!r:.60}")
        parameters = {k: v for k, v in args.items() if k not in ("parameters", "runs", "seed")}
        text = args.get("parameters") or "{}"
        try:
            given = json.loads(text)
        except (ValueError, TypeError, RecursionError):
            given = None
        if not isinstance(given, dict):
            raise ValueError(f"parameters: expected the text of a JSON object, found {text!r:.60}")
        start = {"task": self._options.task, "mode": self._options.mode}
        start |= {"parameters": {**parameters, **given}}
        return start | {name: args[name] for name in ("runs", "seed") if args.get(name)}

    async def _follow(self, goal: str, page: OperatorClient, run: str) -> tuple[int, str, str, str]:
        """Send the feedback of a run until it ends, and abort it if it must not continue. Return
        status, state, reason and result."""

        def is_active(state: Mapping[str, Any]) -> bool:
            return state["mission"]["id"] == run and state["mission"]["state"] not in ENDS

        told: Message = {}
        asked = ""
        await page.until(lambda state: state["mission"]["id"] == run, RESULT)
        while is_active(page.state):
            marking, runs = page.state["marking"], page.state["runs"]
            feedback = {
                "places": [place for place, tokens in marking.items() if tokens],
                "tokens": [tokens for tokens in marking.values() if tokens],
                "active": [active["action"] for active in runs.values()],
            }
            if feedback != told:
                told = feedback
                self._tell("action_feedback", goal, "Feedback", feedback)
            if self._why and page.state["mission"]["state"] != "stopping":
                answer = await _ordered(page, "abort", {})
                if not answer.get("ok"):
                    asked = await self._abort_later(page, run, str(answer.get("text")), asked)
            await page.until(lambda state: not is_active(state), LOOK)
            if page.over:
                raise OperatorError(page.over)
        await page.until(lambda state: state["result"] is not None, RESULT)
        mission = page.state["mission"]
        if mission["id"] != run:
            raise OperatorError(f"{run} has ended; it is unknown how, since another run began")
        # ROS 2 knows `cancelled` only after its client's cancel, not after an operator's abort.
        failed = CANCELLED if self._why == "cancelled" else ABORTED
        status = SUCCEEDED if mission["state"] == "success" else failed
        text = json.dumps(page.state["result"], allow_nan=False)
        return status, mission["state"], str(mission.get("reason") or ""), text

    async def _abort_later(self, page: OperatorClient, run: str, text: str, asked: str) -> str:
        """Ask the operator who keeps the run from being aborted for the controls, and say so once:
        `asked` is what was said before; return what is said now. Raises OperatorError if this
        process ends: then the run is the operator's."""
        why = f"{run} must be aborted ({self._why}), but {text}"
        if self._ending:
            raise OperatorError(f"{why}; it continues")
        if why != asked:
            await page.command("ask_controls")
            print(f"{why}; asked for them", file=sys.stderr, flush=True)
        return why

    def _result(self, goal: str, status: int, state: str, reason: str, result: str = "") -> None:
        values = {"state": state, "reason": reason, "result": result}
        # `result: true` also for an abort: else rosbridge drops the values
        self._tell("action_result", goal, "Result", values, status=status, result=True)

    def _tell(self, op: str, goal: str, part: str, values: Message, **more: Any) -> None:
        known = self._fields.get(f"{self._options.type}.{part}", values)
        values = {name: value for name, value in values.items() if name in known}
        self._link.send(
            {"op": op, "action": self._options.action, "id": goal, "values": values, **more}
        )


async def _ordered(page: OperatorClient, verb: str, data: Message) -> Message:
    """Give a command, and keep the controls no longer: an operator may want to pause the run."""
    answer = await page.command("take_controls")
    if answer.get("ok"):
        answer = await page.command(verb, data)
        await page.command("release_controls")
    return answer


async def main(arguments: list[str]) -> int:
    """Read the options and serve."""
    parser = argparse.ArgumentParser(prog="python -m petrobot.services.adapters.ros2")
    parser.description = "Offer a task to ROS 2 as an action."
    parser.add_argument("task", help="name of a task that the page offers")
    parser.add_argument("--page", default=os.environ.get("PETROBOT_PAGE"), help=PAGE)
    parser.add_argument("--url", default="ws://127.0.0.1:9090", help="rosbridge (%(default)s)")
    parser.add_argument("--action", help="name of the action (/TASK)")
    parser.add_argument("--type", default=TYPE, help="type of the action (%(default)s)")
    parser.add_argument("--definition", type=Path, help="its .action file, if it is another one")
    parser.add_argument("--mode", default="realtime", choices=("realtime", "lockstep"))
    options = parser.parse_args(arguments)
    options.action = options.action or f"/{options.task}"
    if not options.page or "/?token=" not in options.page:
        parser.error(f"--page: expected the {PAGE}")
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    address, _, token = options.page.partition("/?token=")
    connect = partial(OperatorClient, address, token, NAME, secrets.token_hex())
    link = SessionThread(partial(serve, options.url, 10.0))
    try:
        await OfferedTask(link, connect, options).serve(stop)
    except (OSError, ValueError) as fault:
        print(fault, file=sys.stderr)
        return 2
    finally:
        link.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(asyncio.run(main(sys.argv[1:])))
