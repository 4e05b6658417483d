"""The operator's commands to the active run: each finds the run, takes the controls, sends one
command, and prints the answer."""

from __future__ import annotations

import argparse
import asyncio
import getpass
import hashlib
import hmac
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import add_json_argument, write_json
from petrobot.coordinator.cli.options import add_runs_argument

if TYPE_CHECKING:
    from petrobot.coordinator.operator.client import OperatorClient
    from petrobot.coordinator.operator.run_address import RunAddress

Answer = dict[str, Any]
BAD_INPUT = frozenset({"bad_data", "unknown", "unknown_command"})
"""Codes of answers to commands that can never succeed as they were given."""
FIRING_WAIT = 2.0
"""How long `step` waits for the firing before it says that it is still to come (s)."""
HOLDS = {
    "held": "holds",
    "cannot_hold": "CANNOT HOLD: its action continues",
    "stopped": "stands still",
    "idle": "runs no action: nothing was asked to hold",
    "lost": "DID NOT ANSWER",
}
"""What a node answers to a pause, in words."""


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that name the run and the operator."""
    parser.add_argument(
        "--run", metavar="RUN", help="a run's id or folder (default: the newest active run)"
    )
    add_runs_argument(parser)
    parser.add_argument(
        "--as",
        dest="name",
        metavar="NAME",
        help="your name as other operators see it (default: your user name)",
    )


@asynccontextmanager
async def connected(
    options: argparse.Namespace,
) -> AsyncIterator[tuple[RunAddress, OperatorClient]]:
    """Connect to the run that the options name. Raises NoRunError, and CommandError (3) if it
    cannot be reached."""
    from petrobot.coordinator.operator.client import OperatorError
    from petrobot.coordinator.operator.run_address import find_address, waiting

    address = find_address(options.run, options.journal)
    try:
        async with connect(address, options.name) as client:
            yield address, client
    except OperatorError as fault:
        if address.run in waiting(options.journal):  # its coordinator has died meanwhile
            find_address(address.run, options.journal)
        raise CommandError(3, f"{address.run}: {fault}") from fault


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


class OperatorCommand:
    """One command to the active run. Its docstring is its help."""

    EXAMPLE = ""
    verb = ""
    """The command as the run's page port knows it."""
    accepted = "done"
    """What is printed when the run has accepted it."""
    needs_controls = True

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the command's options."""
        self.add_own_arguments(parser)
        add_run_arguments(parser)
        if self.needs_controls:
            parser.add_argument(
                "--take",
                metavar="S",
                nargs="?",
                type=float,
                const=30.0,
                help="ask the operator who holds the controls to hand them over, and wait up to "
                "S seconds (default: %(const)g)",
            )
        add_json_argument(parser, "the answer")

    def run(self, options: argparse.Namespace) -> int:
        """Send the command and print its answer. Raises CommandError (1 or 2) if it is refused."""
        self.options = options
        return asyncio.run(self.send())

    async def send(self) -> int:
        """Send the command and print its answer; return the exit code."""
        async with connected(self.options) as (address, client):
            data = self.data(client)
            if self.needs_controls:
                await take_controls(client, self.options.take)
            answer = await client.command(self.verb, data)
            if not answer.get("ok"):
                raise CommandError(
                    2 if answer.get("code") in BAD_INPUT else 1,
                    f"{address.run}: {answer.get('text')}",
                )
            text = await self.text(client, answer)
        self.show({"run": address.run, "verb": self.verb, **answer}, text)
        return self.code(answer)

    def show(self, answer: Answer, text: str) -> None:
        """Print the answer as text, or write it where --json says."""
        if self.options.json:
            write_json(self.options.json, answer)
        if self.options.json != "-":
            print(f"{answer['run']}: {text}")

    def add_own_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments of this command alone."""

    def data(self, client: OperatorClient) -> dict[str, Any]:
        """Return what is sent with the command; the client knows the state of the run."""
        return {}

    async def text(self, client: OperatorClient, answer: Answer) -> str:
        """Return what is printed when the run has accepted it; may add to the answer."""
        return self.accepted

    def code(self, answer: Answer) -> int:
        """Return the exit code of a command that was accepted."""
        return 0


class PauseRun(OperatorCommand):
    """Pause the active run: nothing fires or starts, and each node reports whether its devices
    hold. Exit code 3: a node did not answer, so it could not be paused."""

    EXAMPLE = "petrobot pause"
    verb = "pause"

    async def text(self, client: OperatorClient, answer: Answer) -> str:
        lines = [f"  {node:12} {HOLDS.get(a, a)}" for node, a in answer.get("nodes", {}).items()]
        return "\n".join(
            ["paused; next: `petrobot continue`, or `petrobot step` for one firing", *lines]
        )

    def code(self, answer: Answer) -> int:
        return 3 if "lost" in answer.get("nodes", {}).values() else 0


class ContinueRun(OperatorCommand):
    """Continue the paused run. (`petrobot resume RUN` is for a run whose coordinator was
    killed.)"""

    EXAMPLE = "petrobot continue"
    verb = "resume"
    accepted = "continues"


class StepRun(OperatorCommand):
    """Fire one transition of a paused run, or pause an active one after its next firing."""

    EXAMPLE = "petrobot step"
    verb = "step"
    firings = 0
    """How many the run had before the command."""
    active = False
    """Whether the run was not paused before the command."""

    def data(self, client: OperatorClient) -> dict[str, Any]:
        self.active = client.state["paused"] is None
        self.firings = int(client.state["mission"].get("firings", 0))
        return {}

    async def text(self, client: OperatorClient, answer: Answer) -> str:
        if not await client.until(
            lambda state: state["mission"].get("firings", 0) > self.firings, FIRING_WAIT
        ):
            return "no transition can fire yet; the run will pause after the next firing"
        firing = client.state["firings"][-1]
        answer["firing"] = firing
        told = f"fired {firing['transition']} ({firing['cause']})"
        if self.active:
            told += "; the run was not paused, and is now: `petrobot continue`"
        return told


class SetBreakpoint(OperatorCommand):
    """Pause the active run before a transition fires or when a token enters a place. Without a
    name, list the breakpoints."""

    EXAMPLE = "petrobot break start"
    verb = "breakpoint"

    def add_own_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("element", nargs="?", help="a transition or place of the task")
        parser.add_argument("--off", action="store_true", help="remove this breakpoint")

    async def send(self) -> int:
        """Set or remove a breakpoint, or only list them."""
        if self.options.element is not None:
            return await super().send()
        async with connected(self.options) as (address, client):
            answer: Answer = {"run": address.run, "ok": True}
            text = await self.text(client, answer)
        self.show(answer, text)
        return 0

    def data(self, client: OperatorClient) -> dict[str, Any]:
        task = client.state["task"] or {"places": [], "transitions": []}
        kinds = {one["name"]: kind for kind in ("places", "transitions") for one in task[kind]}
        name = named(kinds, self.options.element.rpartition(".")[2], "place or transition")
        return {"element": f"{kinds[name]}.{name}", "on": not self.options.off}

    async def text(self, client: OperatorClient, answer: Answer) -> str:
        breakpoints = answer["breakpoints"] = client.state["breakpoints"]
        return f"breakpoints: {', '.join(breakpoints)}" if breakpoints else "no breakpoints"


class ChangeTokens(OperatorCommand):
    """Add or remove tokens of a control place: more or fewer runs, another path."""

    EXAMPLE = "petrobot token runs +2"

    def add_own_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("place", help="a control place of the task")
        parser.add_argument("tokens", type=_change, help="how many to add (+2) or to remove (-1)")

    def data(self, client: OperatorClient) -> dict[str, Any]:
        self.verb = "add_tokens" if self.options.tokens > 0 else "remove_tokens"
        place = named(client.state["marking"], self.options.place, "place")
        return {"place": place, "count": abs(self.options.tokens)}

    async def text(self, client: OperatorClient, answer: Answer) -> str:
        answer["tokens"] = client.state["marking"].get(self.options.place)
        return f"{self.options.place} holds {answer['tokens']} tokens"


def _change(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if not value:
        raise argparse.ArgumentTypeError(
            f"expected how many tokens to add or remove, such as +1 or -1, got {text}"
        )
    return value


class RaiseByHand(OperatorCommand):
    """Raise an external event by hand, instead of a sensor."""

    EXAMPLE = "petrobot raise image_tick"
    verb = "raise_event"

    def add_own_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("event", help="an external event of the task")

    def data(self, client: OperatorClient) -> dict[str, Any]:
        external = {
            name: one for name, one in client.state["events"].items() if one["scope"] == "external"
        }
        return {"event": named(external, self.options.event, "external event")}

    async def text(self, client: OperatorClient, answer: Answer) -> str:
        return f"raised {self.options.event}"


class ForceTransition(OperatorCommand):
    """Fire an outgoing transition of an action place, even while its run is active. The run counts
    neither as success nor as failure."""

    EXAMPLE = "petrobot force catch_ball missed"
    verb = "force_exit"

    def add_own_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("place", help="an action place of the task")
        parser.add_argument("exit", help="an outgoing transition of that place")

    def data(self, client: OperatorClient) -> dict[str, Any]:
        arcs = (client.state["task"] or {"arcs": []})["arcs"]
        exits: dict[str, dict[str, None]] = {}
        for arc in arcs:
            if arc["direction"] == "in" and arc.get("end"):
                exits.setdefault(arc["place"], {})[arc["transition"]] = None
        place = named(exits, self.options.place, "action place")
        runs = client.state["runs"].values()
        return {
            "run": next((run["id"] for run in runs if run["place"] == place), ""),
            "transition": named(exits[place], self.options.exit, f"outgoing transition of {place}"),
        }

    async def text(self, client: OperatorClient, answer: Answer) -> str:
        return f"fired {self.options.exit}, and took the token out of {self.options.place}"


class OverrideSelector(OperatorCommand):
    """Choose the action of a primitive task by hand, or let the run choose again."""

    EXAMPLE = "petrobot override track_ball predict_kalman"
    verb = "override_selector"

    def add_own_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("task", help="a primitive task")
        parser.add_argument("action", nargs="?", help="the action to use from now on")
        parser.add_argument("--free", action="store_true", help="let the run choose again")

    def run(self, options: argparse.Namespace) -> int:
        """Send the command. Raises CommandError (2) unless it names one of action and --free."""
        if options.free is (options.action is not None):
            raise CommandError(2, f"name an action for {options.task}, or give --free")
        return super().run(options)

    def data(self, client: OperatorClient) -> dict[str, Any]:
        selectors = client.state["selectors"]
        task = named(selectors, self.options.task, "primitive task")
        if self.options.action is not None:
            offered = {one["action"]: one for one in selectors[task]["alternatives"]}
            named(offered, self.options.action, "alternative")
        return {"primitive_task": task, "action": self.options.action}

    async def text(self, client: OperatorClient, answer: Answer) -> str:
        return f"{self.options.task}: {self.options.action or 'chosen freely again'}"


class WriteRemark(OperatorCommand):
    """Write a remark into the journal of the active run; it changes nothing."""

    EXAMPLE = 'petrobot remark "a visitor touched the table"'
    verb = "remark"
    needs_controls = False

    def add_own_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("text", nargs="+", help="one line of at most 1,000 characters")

    def data(self, client: OperatorClient) -> dict[str, Any]:
        return {"text": " ".join(self.options.text)}


class AbortRun(OperatorCommand):
    """Abort the active run: its actions are cancelled, their devices stop, and it ends in
    ERROR."""

    EXAMPLE = "petrobot abort"
    verb = "abort"
    accepted = "aborted: its actions are being stopped"
