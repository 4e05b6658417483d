"""Asks the nodes of services.toml whether they are up, what they offer, and for the state of their
devices."""

from __future__ import annotations

import asyncio
import secrets
from datetime import UTC, datetime
from typing import Any

from petrobot.coordinator.run.realtime import credentials_of
from petrobot.services.comm.calls.caller import Caller, Notice, PeerLost
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.messages import Answer, Command, Hello
from petrobot.services.comm.protocol.wire import NEWEST_VERSION, OLDEST_VERSION


async def ask_all(directory: Directory, timeout: float) -> dict[str, Any]:
    """Return what each node answers within `timeout` s: address, whether it is up, what it offers,
    and its status, or why there is no answer.

    `status` has the state of the node's `devices`, those in emergency stop in `emergency`, and the
    state of its actions without a device in `general`. With mutual TLS, there is also the date on
    which the node's certificate expires.
    """
    asked = await asyncio.gather(*(_ask(directory, node, timeout) for node in directory.nodes))
    return dict(zip(directory.nodes, asked, strict=True))


async def _ask(directory: Directory, node: str, timeout: float) -> dict[str, Any]:
    entry, name = directory.nodes[node], f"asking-{secrets.token_hex(4)}"
    caller = Caller(
        node,
        Hello(OLDEST_VERSION, NEWEST_VERSION, "client", name, name, 0, directory.hash),
        auto_ack=True,
    )
    told: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
    refused: list[str] = []

    def hear(_: float, notices: list[Notice]) -> None:
        for notice in notices:
            if isinstance(notice, Answer) and not told.done():
                told.set_result(dict(notice.data))
            elif isinstance(notice, PeerLost):
                refused.append(notice.reason)

    proves = credentials_of(directory)
    client = Client(
        entry.host, entry.port, caller, on_notices=hear, key=proves.key, tls=proves.client()
    )
    client.start()
    answer: dict[str, Any] = {
        "address": f"{entry.host}:{entry.port}",
        "up": await client.connected(timeout),
    }
    try:
        if answer["up"]:
            caller.command(client.now(), Command(f"{name}/status", "status"))
            client.flush()
            status = await asyncio.wait_for(told, timeout)
            if (ends := client.certificate_ends) is not None:
                answer["certificate_ends"] = datetime.fromtimestamp(ends, UTC).isoformat()
            answer |= {
                "offers": list(caller.offers),
                "boot": caller.boot,
                "version": NEWEST_VERSION,
                "status": _status(status, node, directory),
            }
        else:
            silent = "connected, but does not answer" if client.answered else "does not answer"
            answer["why"] = refused[-1] if refused else client.trouble or silent
            answer["refuses"] = client.answered and bool(client.trouble)  # it says why not
    except TimeoutError:
        answer |= {
            "up": False,
            "why": f"it welcomed us, but did not say how it is within {timeout:g} s",
        }
    finally:
        await client.close()
    return answer


def _status(status: dict[str, Any], node: str, directory: Directory) -> dict[str, Any]:
    """Return a node's status with only devices under `devices`: a node reports its actions without
    a device there, under its own name."""
    answers, devices = dict(status.get("answers", {})), dict(status.get("devices", {}))
    general = {}
    if node not in directory.devices and node in answers:
        general = {"general": {"answer": answers.pop(node), **devices.pop(node, {})}}
    return {**status, "answers": answers, "devices": devices, **general}
