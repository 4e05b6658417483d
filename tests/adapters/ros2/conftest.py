"""A fake rosbridge in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.waiting import PATIENCE_S

FAKE = Path(__file__).parent / "fake.py"


class FakeProcess:
    """The process of the fake and its controls."""

    def __init__(self, port: int = 0) -> None:
        code = f"import asyncio, runpy; fake = runpy.run_path({str(FAKE)!r}); asyncio.run("
        code += f"fake['Server']().serve(lambda port: print(port, flush=True), {port}))"
        self.process = subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.port = int(self.process.stdout.readline())
        self.url = f"ws://127.0.0.1:{self.port}/"

    def log(self, *operations: str) -> list[dict[str, Any]]:
        """What it has received, of these operations."""
        with urllib.request.urlopen(
            self.url.replace("ws", "http", 1) + "log", timeout=PATIENCE_S
        ) as told:
            return [m for m in json.load(told) if not operations or m["op"] in operations]

    def post(self, verb: str, text: str = "") -> None:
        address = self.url.replace("ws", "http", 1) + verb
        urllib.request.urlopen(address, data=text.encode(), timeout=PATIENCE_S).close()

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture(scope="module")
def process() -> Iterator[FakeProcess]:
    started = FakeProcess()
    yield started
    started.end()


@pytest.fixture
def fake(process: FakeProcess) -> FakeProcess:
    """The fake of this module's tests, as if it had just been started."""
    process.post("reset")
    return process
