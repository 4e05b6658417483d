"""Long work on task files and journals, in a process of its own.

`python -m petrobot.coordinator.background` reads orders from standard input. It runs at a low
priority and with a time limit that the kernel enforces, so it never takes time from an active
mission. A thread would: it shares the interpreter with the mission. Its limits are in processor
time, so what else the machine does does not matter.

An order is a line of JSON, {work, given}. The answer is any number of lines of JSON, each a more
complete result than the one before, or one refusal after `!`. An empty line ends the answer.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from petrobot.services.host.json_text import json_text
from petrobot.services.host.parent_death import until_reaped

if TYPE_CHECKING:
    from petrobot.coordinator.analysis.may_run import Cell
    from petrobot.coordinator.analysis.report import Analysis

HARD_END = 8
"""Seconds of processor time after which the kernel kills an analysis; results that it has already
written are used."""
LONGEST = 100
"""The same for all other work; opening a long journal takes a while."""
PATIENCE = 120.0
"""Seconds after which an order is given up, in case the process gets no processor time."""
LONGEST_LINE = 256 << 20
"""The longest line that is read from the process (bytes)."""
LOWER = 10
"""By how much its priority is lowered (nice)."""


class RefusedError(ValueError):
    """The work cannot be done. `status` is the HTTP status of the answer, `more` its further
    keys."""

    def __init__(self, status: int, text: str, more: Mapping[str, Any] | None = None) -> None:
        super().__init__(status, text, more)
        self.status, self.text = status, text
        self.more = dict(more or {})

    def __str__(self) -> str:
        return self.text


class Superseded(RefusedError):  # noqa: N818 - not a fault: the drawing has changed since
    """The same desk sent a newer drawing, so this one gets no answer.

    Status 200: that is normal work, and browsers log every 4xx answer as an error.
    """

    def __init__(self) -> None:
        super().__init__(200, "a newer drawing took its place", {"superseded": True})
        self.args = ()


class BackgroundProcess:
    """A process for long work. It is started with the first order and does one order at a time."""

    def __init__(self) -> None:
        self._turn = asyncio.Lock()
        self._process: asyncio.subprocess.Process | None = None
        self._newest: dict[str, object] = {}
        self._current: object = None

    @property
    def process(self) -> int | None:
        """The id of its process, or None if none is running."""
        process = self._process
        return process.pid if process is not None and process.returncode is None else None

    async def do(self, work: str, given: Mapping[str, Any], desk: str = "") -> bytes:
        """Return the answer as JSON text: the most complete one within the time limit.

        `desk` identifies the page that sends drawings. An earlier order of the same desk is given
        up at once, because only its newest drawing matters. Raises RefusedError.
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
            raise RefusedError(422, f"the {work} took too long or its process was killed")
        if said.startswith(b"!"):
            raise RefusedError(**json.loads(said[1:]))
        return said

    def _refuse_old(self, desk: str, order: object) -> None:
        if desk and self._newest.get(desk) is not order:
            raise Superseded

    def give_up(self, desk: str) -> None:
        """Give up the order of a desk; its process is killed if it is working on it."""
        order = self._newest.pop(desk, None)
        if order is not None and order is self._current:
            self._kill()

    async def close(self) -> None:
        """End the process; an active order is given up."""
        process = self._process
        self._kill()
        if process is not None:
            await until_reaped(process)

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
                # Ctrl-C must reach only the coordinator, which then ends this process.
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
                        # A refusal after a result is ignored: what was found before counts.
                        if not (newest and line.startswith(b"!")):
                            newest = line.rstrip(b"\n")
        finally:
            self._current = None
            if not ended:
                self._kill()
                await until_reaped(process)
        return newest


def analysed(
    text: str,
    filename: str,
    cell: Mapping[str, Any] | None = None,
    services: str = "",
    estimates: str = "",
    plant: str = "",
) -> Iterator[dict[str, Any]]:
    """Analyse a task file for the operator's page. `cell` holds the fields of its `Cell`,
    `services` is the path of its location file; `estimates` and `plant` are those of
    `newest_measured`.

    Yield the verdicts, and all `findings` of `petrobot check`, first, then the same with the
    forecast, because that may take long. Raises TaskFileError.
    """
    from msgspec.structs import replace

    from petrobot.coordinator.analysis.may_run import BUDGET, Cell, devices_of
    from petrobot.coordinator.analysis.report import AnalysisRequest, analyse, with_forecast
    from petrobot.coordinator.learning.propagation import newest_measured
    from petrobot.coordinator.operator.task_check import judge_text
    from petrobot.coordinator.task.file import loads

    task = loads(text, filename)
    judgement = judge_text(text, filename, services, cell, search=True)
    more = {"findings": judgement.findings()}
    known = None if cell is None else Cell(**cell)
    limits, devices = BUDGET.limits(), devices_of(known)
    found = judgement.judged.analysis if judgement.judged is not None else None
    if found is None:  # not searched because of other errors: here it was asked for
        found = analyse(task, limits=limits, steps=BUDGET.steps, devices=devices)
    yield _shown(found, known) | more
    measured, source = newest_measured(estimates, task, devices, plant)
    timed = with_forecast(found, task, AnalysisRequest(measured, limits=limits, devices=devices))
    if source and timed.forecast is not None:
        timed = replace(timed, notes=(*timed.notes, source))
    yield _shown(timed, known) | more


def _shown(analysis: Analysis, cell: Cell | None) -> dict[str, Any]:
    """Return {complete, markings, verdicts, notes, heat, figures}; a verdict is {name, words,
    holds, reason, details, assumption, witness, complete}, false ones first. `heat` is the share of
    the time that each action place takes; it needs the forecast."""
    from petrobot.coordinator.analysis.may_run import WORDS, assumed
    from petrobot.coordinator.analysis.report import heat

    space = analysis.qualitative.space
    verdicts = [
        {"name": name, "words": WORDS.get(name, name.replace("_", " ")), **verdict.to_json()}
        for name, verdict in analysis.verdicts().items()
        if name != "safe"  # a task need not be safe: a runs place holds one token per run
    ]
    for recovery in analysis.progress.recoveries if analysis.progress else ():
        verdict = recovery.possible
        words = f"Can recover after {recovery.error_exit}"
        verdicts.append(
            {"name": f"recovery {recovery.error_exit}", "words": words, **verdict.to_json()}
        )
    for shown in verdicts:
        mended = analysis.progress and analysis.progress.mended.get(shown["name"])
        designed = bool(mended and mended.holds) or shown["name"].startswith("recovery ")
        shown["problem"] = shown["holds"] is False and not designed
        if mended and mended.holds:
            shown["reason"] += f"; it holds if {mended.assumption}"
    order = {False: 0, None: 1, True: 2}
    verdicts.sort(key=lambda verdict: order[verdict["holds"]])
    return {
        "complete": space.complete,
        "markings": len(space),
        "verdicts": verdicts,
        "notes": [*analysis.notes, assumed(cell)],
        "heat": {} if analysis.forecast is None else heat(analysis.forecast),
        "figures": analysis.figures(),
    }


def work_of(name: str) -> Callable[..., Any]:
    """Return the function for an order. It takes the given values by name and returns JSON data
    or an iterator of them.

    Only the module that is needed is imported; importing all takes most of a second. Raises
    KeyError.
    """
    if name == "analysis":
        return analysed
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
    """Limit the processor time that the process may use from now on."""
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
    except Exception as fault:
        # The work failed, not this process: it can do the next order.
        yield "!" + json_text(
            {"status": 500, "text": f"{order['work']} failed: {type(fault).__name__}: {fault}"}
        )


if __name__ == "__main__":
    # Imported under its own name, so that `RefusedError` is the class that the work raises; in
    # __main__ it would be a second one.
    from petrobot.coordinator import background

    sys.exit(background.main())
