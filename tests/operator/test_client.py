"""The client of the operator protocol: what it does when changes are missing."""

from __future__ import annotations

from typing import Any
from unittest.mock import AsyncMock

from petrobot.coordinator.operator.changes import empty_state
from petrobot.coordinator.operator.client import OperatorClient


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
