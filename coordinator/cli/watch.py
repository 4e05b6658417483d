"""Follow the active run until it ends: firings, starts and ends of actions, variables,
operators' commands."""

from __future__ import annotations

import argparse
import asyncio
import io
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.operate import add_run_arguments, connected
from petrobot.services.host.json_text import json_text, without_controls
from petrobot.services.host.whole_file import write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient

EXAMPLE = "petrobot watch --json - | jq .kind"
ENDED = {"success": 0, "failure": 1, "error": 1, "aborted": 1, "stopped": 1}
"""Exit code for each state in which a run ends."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_run_arguments(parser)
    parser.add_argument(
        "--json", metavar="FILE", help="write each change as a line of JSON (- for standard output)"
    )


def run(options: argparse.Namespace) -> int:
    """Watch. Return 0 if the run ends in success, 1 if it ends otherwise."""
    if options.json in (None, "-"):
        return asyncio.run(_watch(options, sys.stdout))
    path, lines = Path(options.json), io.StringIO()
    try:
        # Opened before connecting, so that a file that cannot be written is reported at once.
        with path.open("a", encoding="utf-8") as file:
            if not path.is_file():  # a pipe or a terminal: every line at once
                return asyncio.run(_watch(options, file))
        try:
            return asyncio.run(_watch(options, lines))
        finally:
            write_whole(path, lines.getvalue())
    except OSError as fault:
        raise CommandError(2, f"{options.json}: {fault.strerror or fault}") from fault


async def _watch(options: argparse.Namespace, out: TextIO) -> int:
    async with connected(options) as (_, client):
        return await _follow(client, out, plain=not options.json)


async def _follow(client: OperatorClient, out: TextIO, plain: bool) -> int:
    _write(
        out, _snapshot(client.state) if plain else json_text({"kind": "snapshot", **client.state})
    )
    async for change in client.changes():
        text = _line(change) if plain else json_text(change)
        if text:
            _write(out, text)
        state = client.state["mission"]["state"]
        if state in ENDED and change["kind"] in ("mission", "reset"):
            return ENDED[state]
    return ENDED.get(client.state["mission"]["state"], 3)


def _write(out: TextIO, text: str) -> None:
    out.write(text + "\n")
    out.flush()


def _snapshot(state: Mapping[str, Any]) -> str:
    mission, controls, paused = state["mission"], state["controls"], state["paused"]
    tokens = ", ".join(f"{place} {n}" for place, n in state["marking"].items() if n)
    how = mission["state"] if paused is None else f"paused ({paused['reason']})"
    known = ", ".join(
        f"{n} = {json_text(v)}" for n, v in state["variables"].items() if "." not in n
    )
    name = f"{mission['id']} ({mission['plant']})" if mission.get("plant") else mission["id"]
    return f"{name}: {how}; controls: {controls['holder'] or 'no operator'}; tokens: {tokens}" + (
        f"; variables: {known}" if known else ""
    )


def _line(change: Mapping[str, Any]) -> str:
    """Describe a change in words; empty for changes that people need not read."""
    words = _WORDS.get(change["kind"])
    said = words(change) if words is not None else ""
    return f"{change.get('time', 0.0):10.3f} s  {without_controls(said)}" if said else ""


def _ended(change: Mapping[str, Any]) -> str:
    status = "provisional " * change.get("deferred", False) + str(change["status"]).upper()
    status = "-" if status == "NONE" else status  # as in `petrobot log`
    return f"ended    {change['id']}  {status}{_why(change)}"


def _judged(change: Mapping[str, Any]) -> str:
    status = f"{str(change['status']).upper()}, was {str(change['was']).upper()}"
    return f"judged   {change['id']}  {status}{_why(change)}"


def _why(change: Mapping[str, Any]) -> str:
    reason = change.get("reason") or {}
    why = ": ".join(filter(None, (reason.get("code"), reason.get("text"))))
    return f"  {why}" if why else ""


def _paused(change: Mapping[str, Any]) -> str:
    paused = change["paused"]
    if paused is None:
        return "continued"
    nodes = ", ".join(f"{node} {answer}" for node, answer in paused["nodes"].items())
    return f"paused   {paused['reason']}" + (f" ({nodes})" if nodes else "")


def _mission(change: Mapping[str, Any]) -> str:
    state, reason = change["mission"].get("state", ""), change["mission"].get("reason", "")
    if not state or reason.startswith(f"{state}:"):
        return f"mission  {reason}" if state else ""
    return f"mission  {state}" + (f": {reason}" if reason else "")


_WORDS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "fired": lambda c: f"fired    {c['firing']['transition']}  ({c['firing']['cause']})",
    "run_started": lambda c: (
        f"started  {c['run']['id']}  {c['run']['action']} on {c['run']['node'] or 'no node'}"
    ),
    "run_ended": _ended,
    "run_judged": _judged,
    # `PLACE.status` and the like are in the line about the run's end.
    "variable": lambda c: (
        "" if "." in c["name"] else f"variable {c['name']} = {json_text(c['value'])}"
    ),
    "command": lambda c: f"command  {c['text']}",
    "paused": _paused,
    "mission": _mission,
    "notice": lambda c: f"{c['notice']['level']:8} {c['notice']['text']}",
    "controls": lambda c: f"controls {c['controls']['holder'] or 'free'}",
    "breakpoints": lambda c: f"breaks   {', '.join(c['breakpoints']) or 'none'}",
    "selector": lambda c: f"selector {c['name']}: {c['selector'].get('override') or 'free choice'}",
    "node": lambda c: (
        f"node     {c['name']} {c['node']['state']} {c['node'].get('text', '')}".rstrip()
    ),
}
