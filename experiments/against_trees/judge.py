"""The referee: rules that every mission in the scripted plant must keep, whichever program led it.

It reads only the plant's log and the program's own report, so it is the same for a net, a tree and
a state machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from experiments.against_trees.plant import Entry

STEPS = {
    "locate": "locate",
    "predict": "track",
    "intercept": "move",
    "follow": "follow",
    "empty": "home",
    "reset": "recover",
}
"""The step of an action, by the first word of the action's name."""
DEADLINES = {
    "locate": 8.0,
    "track": 6.0,
    "move": 6.0,
    "follow": 4.0,
    "home": 10.0,
    "recover": 30.0,
}
"""Longest time of a run, by step (s)."""
ATTEMPTS = 4
SLACK = 0.1
"""Longest delay between an event and the required next step (s): links, ticks and the program's own
period."""


class Report(NamedTuple):
    """The report of a program at its end. `crash`: the exception that it raised, or that it never
    ended."""

    caught: int
    gave_up: bool
    crash: str = ""


class Past(NamedTuple):
    """A run as recorded in the log."""

    step: str
    ball: int
    begun: float
    ended: float
    what: str
    caught: float
    """When the ball came into the cup during this run (s); 0 if it did not."""


def step_of(action: str) -> str:
    """Return the step that an action does."""
    return STEPS[action.partition("_")[0]]


def runs_of(entries: Sequence[Entry]) -> tuple[dict[str, list[Past]], list[str]]:
    """Return the runs of each device in order, and the violations of single runs."""
    runs: dict[str, list[Past]] = {"camera": [], "arm": []}
    open_: dict[str, Entry] = {}
    caught: dict[str, float] = {}
    wrong: list[str] = []
    for entry in entries:
        if entry.what == "begin":
            if any(other.device == entry.device for other in open_.values()):
                wrong.append(f"{entry.action} begins while the {entry.device} is busy")
            open_[entry.run] = entry
        elif entry.what == "caught":
            caught[entry.run] = entry.t
        elif (begin := open_.pop(entry.run, None)) is not None:
            step = step_of(entry.action)
            runs[entry.device].append(
                Past(step, entry.ball, begin.t, entry.t, entry.what, caught.get(entry.run, 0.0))
            )
    wrong += [f"{begin.action} still runs at the end" for begin in open_.values()]
    return runs, wrong


def violations(entries: Sequence[Entry], report: Report, balls: int) -> list[str]:
    """Return the violations in a mission of so many balls; empty if there are none."""
    runs, wrong = runs_of(entries)
    if report.crash:
        wrong.append(report.crash)
    both = [*runs["camera"], *runs["arm"]]
    for run in both:
        lasted = run.ended - run.begun
        if lasted > DEADLINES[run.step] + 1.0:
            wrong.append(f"{run.step} lasted {lasted:.1f} s")
        if run.what == "cut" and not run.caught and lasted < DEADLINES[run.step] - SLACK:
            wrong.append(f"{run.step} was cut short")
    located = [run for run in runs["camera"] if run.step == "locate"]
    if len(located) > balls or (len(located) < balls and not report.gave_up):
        wrong.append("another number of balls was located")
    wrong += _camera(runs["camera"], runs["arm"])
    wrong += _arm(runs["arm"])
    wrong += _end(runs["arm"], report)
    return wrong


def _camera(camera: Sequence[Past], arm: Sequence[Past]) -> Iterator[str]:
    """Check that a ball is tracked and met at once after it was located, and only then."""
    for n, run in enumerate(camera):
        after = camera[n + 1] if n + 1 < len(camera) else None
        tracked = after is not None and after.step == "track" and after.ball == run.ball
        if run.step == "locate" and run.what == "success":
            if after is None or not tracked or after.begun > run.ended + SLACK:
                yield "a located ball was not tracked at once"
            if not any(run.ended <= r.begun <= run.ended + SLACK and r.step == "move" for r in arm):
                yield "the arm did not move to a located ball at once"
        elif run.step == "locate" and tracked:
            yield "a ball that was not located was tracked"


def _arm(arm: Sequence[Past]) -> Iterator[str]:
    """Check that each run of the arm is followed by the step that its end requires."""
    failed = 0
    for n, run in enumerate(arm):
        after = arm[n + 1] if n + 1 < len(arm) else None
        failed = failed + 1 if run.step == "recover" and run.what in ("error", "cut") else 0
        wanted = _next(run, failed)
        step = "nothing" if after is None else after.step
        if step not in wanted:
            cause = "the catch" if run.caught else run.what
            yield f"after {run.step} ({cause}) the arm did {step}, not {' or '.join(wanted)}"
        elif run.caught and after is not None and after.begun > run.caught + SLACK:
            yield "the ball was in the cup, and the arm did not go home"


def _next(run: Past, failed: int) -> tuple[str, ...]:
    if run.caught:
        return ("home",)
    if run.what in ("error", "cut"):
        return ("recover",) if failed < ATTEMPTS else ("nothing",)
    return {"move": ("follow",), "follow": ("home",)}.get(run.step, ("move", "nothing"))


def _end(arm: Sequence[Past], report: Report) -> Iterator[str]:
    caught = sum(1 for run in arm if run.caught)
    if not report.crash and report.caught != caught:
        yield f"reports {report.caught} caught of {caught}"
    lost = bool(arm) and arm[-1].step == "recover" and arm[-1].what != "success"
    if not report.crash and report.gave_up != lost:
        yield "reports that the arm is lost, and it is not" if report.gave_up else "hides that"
