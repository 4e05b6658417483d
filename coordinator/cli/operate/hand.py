"""What the operator's commands share: the run is found, the controls are taken, one command is
given, its answer is told."""

from __future__ import annotations

import argparse
import asyncio
import getpass
import hashlib
import hmac
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import write_json

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient
    from petrobot.coordinator.operator.door_file import Door

Answer = dict[str, Any]
BAD_INPUT = frozenset({"bad_data", "unknown", "unknown_command"})
"""Codes of answers that say the command itself makes no sense."""


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Which run."""
    parser.add_argument(
        "--run", metavar="RUN", help="a run's id or folder (default: the newest run that goes on)"
    )
    parser.add_argument(
        "--journal",
        metavar="FOLDER",
        type=Path,
        default=Path("runs"),
        help="where runs are kept (default: %(default)s)",
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which run, who gives the command, and how the answer is written."""
    add_run_arguments(parser)
    parser.add_argument(
        "--as",
        dest="name",
        metavar="NAME",
        help="who you are for the others (default: your user name)",
    )
    parser.add_argument(
        "--take",
        metavar="S",
        nargs="?",
        type=float,
        const=30.0,
        help="ask whoever holds the controls for them, and wait up to S seconds (default: "
        "%(const)g)",
    )
    parser.add_argument(
        "--json", metavar="FILE", help="write the answer as JSON (- for standard output)"
    )


def give(
    options: argparse.Namespace,
    verb: str,
    data: Callable[[OperatorClient], dict[str, Any]] | None = None,
    told: Callable[[OperatorClient, Answer], Awaitable[str]] | None = None,
) -> int:
    """Give one command and tell its answer: 0, 1 when it was refused.

    `data(hand)` is asked for once the snapshot is there; `told(hand, answer)` gives what people are
    told when it was obeyed.
    """
    return asyncio.run(_give(options, verb, data, told))


async def _give(
    options: argparse.Namespace,
    verb: str,
    data: Callable[[OperatorClient], dict[str, Any]] | None,
    told: Callable[[OperatorClient, Answer], Awaitable[str]] | None,
) -> int:
    from petrobot.coordinator.operator.client import OperatorError

    door = find(options)
    try:
        async with connect(door, options.name) as hand:
            given = data(hand) if data is not None else {}
            await take_controls(hand, options.take)
            answer = await hand.command(verb, given)
            if not answer.get("ok"):
                raise CommandError(
                    2 if answer.get("code") in BAD_INPUT else 1, f"{door.run}: {answer.get('text')}"
                )
            text = await told(hand, answer) if told is not None else "done"
    except OperatorError as fault:
        raise CommandError(3, f"{door.run}: {fault}") from fault
    show(options, {"run": door.run, "verb": verb, **answer}, text)
    return 0


def show(options: argparse.Namespace, answer: Mapping[str, Any], text: str) -> None:
    """The answer for people, or where --json says."""
    if options.json:
        write_json(options.json, answer)
    if options.json != "-":
        print(f"{answer['run']}: {text}")


def find(options: argparse.Namespace) -> Door:
    """The door of the run that is meant."""
    from petrobot.coordinator.operator.door_file import find_door
    from petrobot.coordinator.run.folder import NoRunError

    try:
        return find_door(options.run, options.journal)
    except NoRunError as fault:
        raise CommandError(2, str(fault)) from fault


def connect(door: Door, name: str | None) -> OperatorClient:
    """A client of the run. The same name is the same operator at each call: the controls stay his
    for 10 s in between."""
    from petrobot.coordinator.operator.client import OperatorClient

    name = name or user_name()
    secret = hmac.digest(door.token.encode(), f"operator {name}".encode(), hashlib.sha256).hex()
    return OperatorClient(door.url, door.token, name, secret)


def user_name() -> str:
    """Who sits at this terminal."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "operator"


async def take_controls(hand: OperatorClient, wait: float | None) -> None:
    """Take the controls, or ask for them and wait `wait` seconds. Raises CommandError (1) when
    another keeps them."""
    answer = await hand.command("take_controls")
    if answer.get("ok"):
        return
    holder = hand.state["controls"]["holder"]
    if wait is None:
        raise CommandError(1, f"{holder} holds the controls; --take asks for them")
    await hand.command("ask_controls")
    if not await hand.until(lambda state: bool(state["controls"]["holder"] == hand.who), wait):
        raise CommandError(1, f"{holder} did not hand over the controls within {wait:g} s")


def named(known: Mapping[str, Any], name: str, what: str) -> str:
    """A name that the task knows. Raises CommandError (2) with the nearest ones."""
    from petrobot.coordinator.task.wording import nearest

    if name not in known:
        raise CommandError(2, f"no {what} is named {name!r}{nearest(name, list(known))}")
    return name
