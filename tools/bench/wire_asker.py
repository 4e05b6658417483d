"""The two ends of a contender of `wire.py`, one process each: one asks, as `wire.py` tells it, and
one answers.

No contender shares a process with another: the size of the heap, for example, decides whether each
read of asyncio gets fresh pages from the kernel, and so how long a bare echo takes.
"""

from __future__ import annotations

import gc
import json
import sys
from collections.abc import Callable
from typing import Any

from tools.bench.processes import start
from tools.bench.wire_contenders import Contender

WARM_UP = 200
"""Calls that warm up before the measurement."""


class Asker:
    """A contender, served by one process and asked by another one."""

    def __init__(self, script: str, name: str, pinned: bool, python: str = sys.executable) -> None:
        """`script` may be that of another checkout, run by its own `python`."""
        self._server = start(script, "--serve", name, pinned=pinned, python=python)
        assert self._server.stdout is not None
        self.port = self._server.stdout.readline().strip()
        self._client = start(script, "--ask", name, self.port, pinned=pinned, python=python)
        assert self._client.stdout is not None and self._client.stdin is not None
        self._orders, self._answers = self._client.stdin, self._client.stdout
        self._answer()

    def latencies(self, count: int, size: int, gap: float = 0.0) -> list[float]:
        """As `Contender.latencies`."""
        found: list[float] = self._told("latencies", count, size, gap)
        return found

    def rate(self, count: int, in_flight: int) -> float:
        """As `Contender.rate`."""
        return float(self._told("rate", count, in_flight))

    def close(self) -> None:
        """End both processes."""
        for process in (self._client, self._server):
            process.kill()
            process.communicate()

    def _told(self, *order: Any) -> Any:
        self._orders.write(json.dumps(order) + "\n")
        self._orders.flush()
        return self._answer()

    def _answer(self) -> Any:
        line = self._answers.readline()
        if not line:
            raise RuntimeError(f"{' '.join(map(str, self._client.args))} ended")  # type: ignore[arg-type]
        return json.loads(line)


def ask(contender: Contender, port: int) -> None:
    """Be the process that asks: connect, then measure what standard input orders, a line each,
    until it ends."""
    measures: dict[str, Callable[..., Any]] = {
        "latencies": contender.latencies,
        "rate": contender.rate,
    }
    contender.connect(port)
    contender.latencies(WARM_UP, 0)
    gc.collect()
    gc.freeze()  # keeps the garbage collector from scanning the imported modules during the calls
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        what, *arguments = json.loads(line)
        print(json.dumps(measures[what](*arguments)), flush=True)
    contender.close()
