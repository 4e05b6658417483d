"""Verdicts on a task that is being drawn, for the designer. `python -m coordinator.analysing` reads the task's text.

A process of its own, below all others in priority and with a hard end: a search never takes time from a mission that goes on.
Its ends are counted in processor time, so that what is said of a drawing does not depend on what else the machine does.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import sys
import time
from typing import Any

from services.comm.json_text import json_text

STATES, SECONDS, MEMORY = 50_000, 4.0, 256 << 20
"""What one state space may take: markings, seconds of processor time, bytes."""
HARD_END = 8
"""Seconds of processor time after which the kernel kills the process, whatever it does; what it has said by then counts."""
PATIENCE = 120.0
"""Seconds until one that gets no processor time is given up."""
LONGEST_LINE = 16 << 20
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


async def analyse_apart(text: str, filename: str) -> dict[str, Any]:
    """What `analysed` says, from a process of its own; without the forecast if that takes too long. Raises ValueError."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "coordinator.analysing", filename),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        limit=LONGEST_LINE,
    )
    complaint = b""
    assert process.stdin is not None and process.stdout is not None and process.stderr is not None
    newest = b""
    try:
        process.stdin.write(text.encode())
        process.stdin.close()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE):
                while line := await process.stdout.readline():
                    newest = line
                complaint = await process.stderr.read()
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
        await process.wait()
    if not newest:
        raise ValueError(complaint.decode(errors="replace").strip().rpartition("\n")[2] or "the analysis took too long")
    answer: dict[str, Any] = json.loads(newest)
    return answer


def analysed(text: str, filename: str, view: str = "ordinary") -> dict[str, Any]:
    """{complete, markings, verdicts, notes, heat}; a verdict is {name, words, holds, reason, assumption, witness}.

    With the view `gspn` there is also the forecast: `heat` is the share of the time that each action place takes.
    Raises TaskFileError.
    """
    from coordinator.analysis.report import analyse, heat
    from coordinator.analysis.space import Limits
    from coordinator.taskfile import loads

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
        verdicts.append({"name": f"recovery {recovery.error_exit}", "words": words, **verdict.to_json()})
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


def main() -> int:
    """Read a task on standard input, write what is to be said of it as lines of JSON, the last the fullest."""
    os.nice(LOWER)
    resource.setrlimit(resource.RLIMIT_CPU, (HARD_END, HARD_END))
    try:
        text = sys.stdin.read()
        for view in ("ordinary", "gspn"):  # verdicts first: a forecast may take long
            print(json_text(analysed(text, sys.argv[1], view)), flush=True)
    except (ValueError, ArithmeticError) as fault:
        print(fault, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
