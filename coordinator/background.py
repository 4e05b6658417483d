"""Long work on task files and journals, in a process of its own: `python -m
petrobot.coordinator.background` reads orders.

A process below all others in priority and with a hard end: nothing that is asked of a drawing takes
time from a mission that is running. A thread would: it shares the interpreter with the mission, and
then each turn of the loop waits for it. Ends are counted in processor time, so that what is said of
a drawing does not depend on what else the machine does.

An order is a line of JSON, {work, given}. The answers are lines of JSON text: any number of
results, each fuller than the one before, or one refusal behind `!`; an empty line ends them.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from petrobot.services.host.json_text import json_text

STATES, SECONDS, MEMORY = 50_000, 4.0, 256 << 20
"""What one state space may take: markings, seconds of processor time, bytes."""
HARD_END = 8
"""Seconds of processor time after which the kernel kills an analysis, whatever it does; what it has
said by then counts."""
LONGEST = 100
"""The same for all other work: opening a long journal takes a while."""
PATIENCE = 120.0
"""Seconds until one that gets no processor time is given up."""
LONGEST_LINE = 256 << 20
LOWER = 10
"""How much below others it runs (nice)."""
WORDS = {
    "bounded": "Tokens stay bounded",
    "safe": "Never two tokens in a place",
    "deadlock_free": "Never stuck before its end",
    "quasi_live": "Every transition can fire",
    "live": "Every transition can fire again, whatever happened",
    "proper": "Ready for the next mission, whatever happened",
    "reversible": "Can come back to its beginning",
    "one_run_each": "One run at a time in each action place",
    "returned": "Every resource is back at the end",
    "sound": "Can end properly from everywhere",
    "stable": "Comes back to its nominal flow after errors",
    "controllable": "Every error can be recovered from",
}


class RefusedError(ValueError):
    """The work cannot be done, and why; `status` is the HTTP status to answer with, `more` further
    parts of the answer."""

    def __init__(self, status: int, text: str, more: Mapping[str, Any] | None = None) -> None:
        super().__init__(text)
        self.status = status
        self.more = dict(more or {})


class Superseded(RefusedError):  # noqa: N818 - no fault: whoever asked has drawn on
    """A newer drawing came from the same desk, so nothing is said of this one."""

    def __init__(self) -> None:
        super().__init__(409, "a newer drawing took its place")


class Apart:
    """One process for long work, started with the first order; one order at a time, the others wait
    their turn."""

    def __init__(self) -> None:
        self._turn = asyncio.Lock()
        self._process: asyncio.subprocess.Process | None = None
        self._newest: dict[str, object] = {}
        self._current: object = None

    @property
    def process(self) -> int | None:
        """The id of its process, while there is one."""
        process = self._process
        return process.pid if process is not None and process.returncode is None else None

    async def do(self, work: str, given: Mapping[str, Any], desk: str = "") -> bytes:
        """The answer as JSON text, the fullest that there was in time. Raises RefusedError.

        An order of the same `desk` that came before is given up at once: only the newest drawing on
        a desk matters.
        """
        order = object()
        if desk:
            self.give_up(desk)
            self._newest[desk] = order
        try:
            async with self._turn:
                self._refuse_old(desk, order)
                self._current = order
                said = await self._carry_out(work, given)
            self._refuse_old(desk, order)
        finally:
            if self._newest.get(desk) is order:
                del self._newest[desk]
        if not said:
            raise RefusedError(422, f"the {work} took too long, or its process was killed")
        if said.startswith(b"!"):
            raise RefusedError(**json.loads(said[1:]))
        return said

    def _refuse_old(self, desk: str, order: object) -> None:
        if desk and self._newest.get(desk) is not order:
            raise Superseded

    def give_up(self, desk: str) -> None:
        """Whatever was asked from that desk is not wanted any more."""
        order = self._newest.pop(desk, None)
        if order is not None and order is self._current:
            self._kill()

    async def close(self) -> None:
        """End the process; what it does just then is given up."""
        process = self._process
        self._kill()
        if process is not None:
            await process.wait()

    def _kill(self) -> None:
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()

    async def _carry_out(self, work: str, given: Mapping[str, Any]) -> bytes:
        process = self._process
        if process is None or process.returncode is not None:
            process = self._process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "petrobot.coordinator.background"),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                limit=LONGEST_LINE,
                # Ctrl-C is for the coordinator, which ends it in good order
                start_new_session=True,
            )
        assert process.stdin is not None and process.stdout is not None
        newest, ended = b"", False
        try:
            process.stdin.write(json_text({"work": work, "given": given}).encode() + b"\n")
            with contextlib.suppress(TimeoutError, ConnectionError):
                async with asyncio.timeout(PATIENCE):
                    while line := await process.stdout.readline():
                        if line == b"\n":
                            ended = True
                            break
                        if not (
                            newest and line.startswith(b"!")
                        ):  # what was found before it failed counts
                            newest = line.rstrip(b"\n")
        finally:
            self._current = None
            if not ended:
                self._kill()
                await process.wait()
        return newest


async def analyse_apart(text: str, filename: str) -> dict[str, Any]:
    """What `analysed` says, from a process of its own; without the forecast if that takes too long.
    Raises ValueError."""
    apart = Apart()
    try:
        answer: dict[str, Any] = json.loads(
            await apart.do("analysis", {"text": text, "filename": filename})
        )
    finally:
        await apart.close()
    return answer


def analysed(text: str, filename: str, view: str = "ordinary") -> dict[str, Any]:
    """{complete, markings, verdicts, notes, heat}; a verdict is {name, words, holds, reason,
    assumption, witness}.

    With the view `gspn` there is also the forecast: `heat` is the share of the time that each
    action place takes. Raises TaskFileError.
    """
    from petrobot.coordinator.analysis.net.space import Limits
    from petrobot.coordinator.analysis.report import analyse, heat
    from petrobot.coordinator.task.file import loads

    limits = Limits(states=STATES, seconds=SECONDS, memory=MEMORY, clock=time.process_time)
    analysis = analyse(loads(text, filename), view=view, limits=limits)
    space = analysis.qualitative.space
    verdicts = [
        {"name": name, "words": WORDS.get(name, name.replace("_", " ")), **verdict.to_json()}
        for name, verdict in analysis.verdicts().items()
        if name != "safe"  # several tokens are several runs to do: a task need not be safe
    ]
    for recovery in analysis.robot.recoveries if analysis.robot else ():
        verdict = recovery.possible
        words = f"A way back after {recovery.error_exit}"
        verdicts.append(
            {"name": f"recovery {recovery.error_exit}", "words": words, **verdict.to_json()}
        )
    order = {False: 0, None: 1, True: 2}
    verdicts.sort(key=lambda verdict: order[verdict["holds"]])
    return {
        "complete": space.complete,
        "markings": len(space),
        "verdicts": verdicts,
        "notes": list(analysis.notes),
        "heat": heat(analysis),
        "figures": analysis.figures(),
    }


def _analysis(text: str, filename: str) -> Iterator[dict[str, Any]]:
    for view in ("ordinary", "gspn"):  # verdicts first: a forecast may take long
        yield analysed(text, filename, view)


def work_of(name: str) -> Callable[..., Any]:
    """What carries out an order: it takes what is given by name, and returns JSON data or an
    iterator of such.

    Only the room that is needed is imported: all of them would take most of a second. Raises
    KeyError.
    """
    if name == "analysis":
        return _analysis
    if name == "form":
        from petrobot.coordinator.operator import start_form

        return start_form.WORKS[name]
    if name in ("run", "runs"):
        from petrobot.coordinator.operator import history as journals

        return journals.WORKS[name]
    from petrobot.coordinator.page import task_work as verdicts

    return verdicts.WORKS[name]


def main() -> int:
    """Carry out orders from standard input until it ends."""
    os.nice(LOWER)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for line in sys.stdin.buffer:
        order = json.loads(line)
        _limit(HARD_END if order["work"] == "analysis" else LONGEST)
        for said in _said(order):
            sys.stdout.buffer.write(said.encode() + b"\n")
            sys.stdout.buffer.flush()
        sys.stdout.buffer.write(b"\n")
        sys.stdout.buffer.flush()
    return 0


def _limit(seconds: int) -> None:
    """From now on the process may take so much processor time."""
    spent = resource.getrusage(resource.RUSAGE_SELF)
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(
        resource.RLIMIT_CPU, (int(spent.ru_utime + spent.ru_stime) + 1 + seconds, hard)
    )


def _said(order: Mapping[str, Any]) -> Iterator[str]:
    try:
        result = work_of(order["work"])(**order["given"])
        for value in result if isinstance(result, Iterator) else (result,):
            yield json_text(value)
    except RefusedError as refusal:
        yield "!" + json_text(
            {"status": refusal.status, "text": str(refusal), "more": refusal.more}
        )
    except (ValueError, ArithmeticError) as fault:
        yield "!" + json_text({"status": 422, "text": str(fault)})
    except (
        Exception
    ) as fault:  # of the work, not of this process: the next order is carried out again
        yield "!" + json_text(
            {"status": 500, "text": f"{order['work']} failed: {type(fault).__name__}: {fault}"}
        )


if __name__ == "__main__":
    from petrobot.coordinator import background as analysing

    sys.exit(analysing.main())
