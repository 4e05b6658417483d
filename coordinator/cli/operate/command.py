"""Shared by the operator's commands: find the run, take the controls, give one command, and print
its answer."""

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
    from petrobot.coordinator.operator.run_address import RunAddress

Answer = dict[str, Any]
BAD_INPUT = frozenset({"bad_data", "unknown", "unknown_command"})
"""Codes of answers to commands that can never succeed as they were given."""


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that name the run."""
    parser.add_argument(
        "--run", metavar="RUN", help="a run's id or folder (default: the newest active run)"
    )
    parser.add_argument(
        "--journal",
        metavar="FOLDER",
        type=Path,
        default=Path("runs"),
        help="where runs are kept (default: %(default)s)",
    )


def add_arguments(parser: argparse.ArgumentParser, *, controls: bool = True) -> None:
    """Add the options that name the run and the operator, and say how the answer is printed.

    `controls` tells whether the command needs the controls.
    """
    add_run_arguments(parser)
    parser.add_argument(
        "--as",
        dest="name",
        metavar="NAME",
        help="your name as other operators see it (default: your user name)",
    )
    if controls:
        parser.add_argument(
            "--take",
            metavar="S",
            nargs="?",
            type=float,
            const=30.0,
            help="ask the operator who holds the controls to hand them over, and wait up to "
            "S seconds (default: %(const)g)",
        )
    parser.add_argument(
        "--json", metavar="FILE", help="write the answer as JSON (- for standard output)"
    )


def give(
    options: argparse.Namespace,
    verb: str,
    data: Callable[[OperatorClient], dict[str, Any]] | None = None,
    told: Callable[[OperatorClient, Answer], Awaitable[str]] | None = None,
    code: Callable[[Answer], int] = lambda _: 0,
) -> int:
    """Give one command and print its answer. Return 1 if it was refused, else `code(answer)`.

    `data(client)` makes the command's data once the snapshot has arrived; `told(client, answer)`
    makes the text that is printed when the command was accepted.
    """
    return asyncio.run(_give(options, verb, data, told, code))


async def _give(
    options: argparse.Namespace,
    verb: str,
    data: Callable[[OperatorClient], dict[str, Any]] | None,
    told: Callable[[OperatorClient, Answer], Awaitable[str]] | None,
    code: Callable[[Answer], int],
) -> int:
    from petrobot.coordinator.operator.client import OperatorError
    from petrobot.coordinator.operator.port import FREE

    address = find(options)
    try:
        async with connect(address, options.name) as client:
            given = data(client) if data is not None else {}
            if verb not in FREE:
                await take_controls(client, options.take)
            answer = await client.command(verb, given)
            if not answer.get("ok"):
                raise CommandError(
                    2 if answer.get("code") in BAD_INPUT else 1,
                    f"{address.run}: {answer.get('text')}",
                )
            text = await told(client, answer) if told is not None else "done"
    except OperatorError as fault:
        raise CommandError(3, f"{address.run}: {fault}") from fault
    show(options, {"run": address.run, "verb": verb, **answer}, text)
    return code(answer)


def show(options: argparse.Namespace, answer: Mapping[str, Any], text: str) -> None:
    """Print the answer as text, or write it where --json says."""
    if options.json:
        write_json(options.json, answer)
    if options.json != "-":
        print(f"{answer['run']}: {text}")


def find(options: argparse.Namespace) -> RunAddress:
    """Return the address of the run that the options name."""
    from petrobot.coordinator.operator.run_address import find_address
    from petrobot.coordinator.run.folder import NoRunError

    try:
        return find_address(options.run, options.journal)
    except NoRunError as fault:
        raise CommandError(2, str(fault)) from fault


def connect(address: RunAddress, name: str | None) -> OperatorClient:
    """Return a client of the run. Commands under the same name are of the same operator, who keeps
    the controls for 10 s after each."""
    from petrobot.coordinator.operator.client import OperatorClient

    name = name or user_name()
    secret = hmac.digest(address.token.encode(), f"operator {name}".encode(), hashlib.sha256).hex()
    return OperatorClient(address.url, address.token, name, secret)


def user_name() -> str:
    """The name of the user at this terminal."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "operator"


async def take_controls(client: OperatorClient, wait: float | None) -> None:
    """Take the controls, or ask for them and wait `wait` seconds. Raises CommandError (1) if
    another operator keeps them."""
    answer = await client.command("take_controls")
    if answer.get("ok"):
        return
    holder = client.state["controls"]["holder"]
    if wait is None:
        raise CommandError(1, f"{holder} holds the controls; ask for them with --take")
    await client.command("ask_controls")
    if not await client.until(lambda state: bool(state["controls"]["holder"] == client.who), wait):
        raise CommandError(1, f"{holder} did not hand over the controls within {wait:g} s")


def named(known: Mapping[str, Any], name: str, what: str) -> str:
    """Return a name that is known. Raises CommandError (2), which suggests the nearest name, or
    lists the first ones."""
    from petrobot.coordinator.task.wording import few, nearest

    if name not in known:
        near = nearest(name, list(known)) or f"; known: {few(list(known)) or 'none'}"
        raise CommandError(2, f"no {what} is named {name!r}{near}")
    return name
