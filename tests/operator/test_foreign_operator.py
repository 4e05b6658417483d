"""An operator's client written from docs/operator-protocol.md and RFC 6455 alone, on plain sockets,
follows and steers a real `petrobot serve` through a simulated catch, and ends with the state that
the coordinator has.
"""

from __future__ import annotations

import base64
import json
import os
import re
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.waiting import Limit

ROOT = Path(__file__).parents[2]
PATIENCE = 120.0
"""Longest wait for a condition on a slow machine (s)."""
ENTRIES = {
    "node": "nodes",
    "event": "events",
    "device": "devices",
    "image": "images",
    "report": "reports",
    "selector": "selectors",
}
"""Part of a snapshot in which a change of this kind replaces an entry."""
LISTS = {"fired": ("firings", "firing", 60), "notice": ("notices", "notice", 30)}
WHOLE = {"breakpoints", "paused", "controls", "result"}


class Operator:
    """A WebSocket client without a library, with the state as the protocol page defines it."""

    def __init__(self, host: str, port: int, token: str) -> None:
        self.state: dict[str, Any] = {}
        self.answers: dict[int, dict[str, Any]] = {}
        self.kinds: set[str] = set()
        self._number = 0
        self._rest = b""
        self._socket = socket.create_connection((host, port), timeout=PATIENCE)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [
            "GET /api/live HTTP/1.1",
            f"Host: {host}:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
        ]
        lines += [
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
            f"Authorization: Bearer {token}",
            "",
            "",
        ]
        self._socket.sendall("\r\n".join(lines).encode())
        limit = Limit("the end of the head")
        while b"\r\n\r\n" not in self._rest and limit.left():
            self._more()
        head, self._rest = self._rest.split(b"\r\n\r\n", 1)
        assert head.startswith(b"HTTP/1.1 101"), head
        self.say(type="hello", protocol=1, name="foreign", tab="a secret of its own")

    def _more(self) -> None:
        data = self._socket.recv(1 << 16)
        assert data, "the coordinator closed the connection"
        self._rest += data

    def _take(self, count: int) -> bytes:
        limit = Limit(f"{count} bytes")
        while len(self._rest) < count and limit.left():
            self._more()
        data, self._rest = self._rest[:count], self._rest[count:]
        return data

    def say(self, **message: Any) -> None:
        """Send one text frame, masked as required for clients (RFC 6455, section 5.3)."""
        self._send(0x1, json.dumps(message).encode())

    def _send(self, code: int, body: bytes) -> None:
        mask = os.urandom(4)
        size = (
            bytes([0x80 | len(body)])
            if len(body) < 126
            else bytes([0x80 | 126]) + struct.pack(">H", len(body))
        )
        self._socket.sendall(
            bytes([0x80 | code]) + size + mask + bytes(b ^ mask[i % 4] for i, b in enumerate(body))
        )

    def _hear_text(self) -> str:
        whole, limit = b"", Limit("a whole message")
        while True:
            limit.left()
            first, second = self._take(2)
            size = second & 0x7F
            if size >= 126:
                size = int.from_bytes(self._take(2 if size == 126 else 8), "big")
            body, code = self._take(size), first & 0x0F
            if code == 0x9:
                self._send(0xA, body)
            elif code in (0x0, 0x1):
                whole += body
                if first & 0x80:
                    return whole.decode()
            else:
                raise AssertionError(f"frame {code:#x}: {body!r}")

    def hear(self) -> str:
        """Receive one message, apply it, and return its type."""
        message = json.loads(self._hear_text())
        kind = str(message["type"])
        if kind == "snapshot":
            self.state = {
                key: value for key, value in message.items() if key not in ("type", "protocol")
            }
        elif kind == "delta":
            assert message["first"] == self.state["sequence"] + 1
            self.state |= {"sequence": message["last"], "time": message["time"]}
            for change in message["changes"]:
                self.kinds.add(change["kind"])
                self._change(change)
        elif kind == "answer":
            self.answers[message["id"]] = message
        return kind

    def _change(self, change: dict[str, Any]) -> None:
        kind, state = change["kind"], self.state
        if kind in ("mission", "marking"):
            state[kind] |= change[kind]
        elif kind in LISTS:
            part, key, most = LISTS[kind]
            state[part] = [*state[part], change[key]][-most:]
        elif kind == "run_started":
            state["runs"][change["run"]["id"]] = change["run"]
        elif kind == "run_progress" and change["id"] in state["runs"]:
            state["runs"][change["id"]] |= {
                k: v for k, v in change.items() if k not in ("kind", "id")
            }
        elif kind == "run_ended":
            run = state["runs"].pop(change["id"])
            ended = {key: change[key] for key in ("status", "ended", "reason", "deferred")}
            state["ended"] = [*state["ended"], run | ended][-200:]
        elif kind == "run_judged":
            said = {key: change[key] for key in ("status", "reason")} | {"deferred": False}
            state["ended"] = [
                run | said if run["id"] == change["id"] else run for run in state["ended"]
            ]
        elif kind == "variable":
            state["variables"][change["name"]] = change["value"]
        elif kind in ENTRIES:
            state[ENTRIES[kind]][change["name"]] = change[kind]
        elif kind == "setpoint":
            stream = state["setpoints"].setdefault(change["stream"], {"samples": []})
            stream |= change.get("setpoint", {}) | {
                "samples": [*stream["samples"], *change["samples"]][-300:]
            }
        elif kind in WHOLE:
            state[kind] = change[kind]

    def until(self, holds: Callable[[dict[str, Any]], Any]) -> None:
        """Receive messages until the condition holds."""
        over = time.monotonic() + PATIENCE
        while not (self.state and holds(self.state)):
            assert time.monotonic() < over
            self.hear()

    def order(self, verb: str, **data: Any) -> dict[str, Any]:
        """Give a command and receive messages until its answer."""
        self._number += 1
        self.say(type="command", id=self._number, verb=verb, data=data)
        limit = Limit(f"the answer to {verb}")
        while self._number not in self.answers and limit.left():
            self.hear()
        return self.answers[self._number]

    def resynced(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the state built from changes, and a snapshot requested after them."""
        told = self.state
        self.say(type="resync")
        limit = Limit("the snapshot")
        while self.hear() != "snapshot" and limit.left():
            pass
        assert told is not self.state
        return told, self.state

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


@pytest.fixture
def operator(tmp_path: Path) -> Iterator[Operator]:
    """A client connected to a running `petrobot serve`."""
    command = [
        sys.executable,
        "-m",
        "petrobot.coordinator",
        "serve",
        "--journal",
        str(tmp_path / "runs"),
        "--tasks",
        str(tmp_path),
    ]
    served = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout is not None
        assert select.select([served.stdout], [], [], PATIENCE)[0], "the coordinator prints nothing"
        address = re.search(r"http://([\d.]+):(\d+)/\?token=(\S+)", served.stdout.readline())
        assert address is not None
        made = Operator(address[1], int(address[2]), address[3])
        yield made
        made.close()
    finally:
        served.terminate()
        served.communicate()


@pytest.mark.processes
def test_a_foreign_operator_steers_a_catch_and_sees_what_the_coordinator_sees(
    operator: Operator,
) -> None:
    """It takes the controls, starts, sets a breakpoint and puts tokens into control places only;
    every change is applied as the protocol page says."""
    assert operator.order("pause")["code"] == "not_holder"
    assert operator.order("take_controls")["ok"]
    assert operator.order("load", task="catch_ball")["ok"]
    assert operator.order("breakpoint", element="places.return_home", on=True)["ok"]
    assert operator.order("start", task="catch_ball", mode="lockstep", runs=1, seed=9, pace=1)["ok"]
    operator.until(lambda state: state["paused"])
    assert operator.state["marking"]["return_home"] == 1
    assert operator.order("add_tokens", place="arm_free", count=1)["code"] == "refused"
    assert operator.order("add_tokens", place="runs", count=1)["ok"]
    assert operator.order("breakpoint", element="places.return_home", on=False)["ok"]
    assert operator.order("resume")["ok"]
    operator.until(lambda state: state["mission"]["state"] == "success")
    operator.until(lambda state: state["result"])
    assert [throw["caught"] for throw in operator.state["result"]["throws"]] == [True, True]

    told, now = operator.resynced()
    limit = Limit("a quiet moment")
    while (
        told["sequence"] != now["sequence"] and limit.left()
    ):  # Changes in the meantime are part of the snapshot.
        told, now = operator.resynced()
    assert told == now
    assert {
        "fired",
        "marking",
        "run_started",
        "run_ended",
        "device",
        "image",
        "setpoint",
        "paused",
    } <= operator.kinds
