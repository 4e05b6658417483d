"""The client of the operator protocol: what it does when changes are missing."""

from __future__ import annotations

import asyncio
from typing import Any
from unittest.mock import AsyncMock

import aiohttp
import pytest

from petrobot.coordinator.operator.changes import empty_state
from petrobot.coordinator.operator.client import OperatorClient, OperatorError


async def test_missing_changes_are_asked_for_once() -> None:
    """However many deltas follow before the snapshot; with it the client is up to date again."""
    client = OperatorClient("http://127.0.0.1:1", "token", "ana", "secret")
    socket = client._socket = AsyncMock()

    def delta(number: int, parts: int) -> dict[str, Any]:
        changes = [{"kind": "marking", "marking": {"parts": parts}}]
        return {"type": "delta", "first": number, "last": number, "time": 1.0, "changes": changes}

    snapshot = {**empty_state(), "type": "snapshot", "you": "ana 1234"}
    await client._take({**snapshot, "sequence": 3})
    for number in (5, 6, 7):
        await client._take(delta(number, number))
    socket.send_json.assert_awaited_once_with({"type": "resync"})
    assert client.state["marking"] == {}
    await client._take({**snapshot, "sequence": 7})
    await client._take(delta(8, 4))
    assert client.state["marking"] == {"parts": 4}
    await client._take(delta(10, 1))
    assert socket.send_json.await_count == 2


async def test_a_command_to_a_coordinator_that_is_closing_says_so() -> None:
    """`estop` ended in a traceback when its run ended in the same moment."""
    client = OperatorClient("http://127.0.0.1:1", "token", "ana", "secret")
    socket = client._socket = AsyncMock()
    socket.send_json.side_effect = aiohttp.ClientConnectionResetError("closing transport")
    socket.receive.return_value = aiohttp.WSMessage(aiohttp.WSMsgType.CLOSED, None, None)
    client._reader = asyncio.create_task(client._read())
    with pytest.raises(OperatorError, match="closed the connection"):
        await client.command("estop")
