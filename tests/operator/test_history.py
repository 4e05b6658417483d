"""A recorded run as the page's history shows it: what the live page said of the same firings."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from petrobot.coordinator.cli.watch import _line
from petrobot.coordinator.engine import (
    Begin,
    Choose,
    Chosen,
    Engine,
    ForceExit,
    RunEnded,
    StartRun,
    StopConfirmed,
    Verdict,
)
from petrobot.coordinator.operator.history import opened
from petrobot.coordinator.operator.port import Feed
from petrobot.coordinator.operator.run_state import ChangePublisher
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.recording import JournalStore
from petrobot.coordinator.task import Status
from petrobot.coordinator.task.file import loads

JOIN = """
schema = 1
[task]
name = "join"
goal = "Both are done"
final = "done > 0"
[primitive_tasks.look]
goal = "It is seen"
alternatives = ["look"]
deadline = 1.0
[primitive_tasks.move]
goal = "It is there"
alternatives = ["move"]
deadline = 1.0
[places]
looking = { kind = "action", task = "look", tokens = 1 }
moving = { kind = "action", task = "move", tokens = 1 }
done = {}
[transitions]
both = { in = ["looking:normal", "moving:normal"], out = ["done"] }
"""


def test_live_views_and_history_tell_provisional_ends_verdicts_and_preemption(
    tmp_path: Path,
) -> None:
    """In the words of `petrobot log`."""
    task, path, feed = loads(JOIN, "join.toml"), tmp_path / "run.journal", Feed()
    engine, narrator = Engine(task), ChangePublisher(feed, task)
    narrator.begin("m", "lockstep")
    lines, state = list[str](), engine.initial()
    feed.subscribe(lambda change: lines.append(_line(change)))
    store = JournalStore(JournalWriter(path, {"task": JOIN, "mode": "lockstep"}), 0.0)
    for stimulus in (
        Begin(),
        RunEnded("looking#1", Status.SUCCESS, deferred=True),
        Verdict("looking#1", Status.FAILURE, "wrong_bin", "A in B"),
        ForceExit("both"),
        StopConfirmed("moving#1"),
    ):
        narrator.stimulus(0.0, stimulus)
        state, instructions = engine.handle(state, stimulus)
        store.append(0.0, stimulus, instructions, state)
        for instruction in instructions:
            narrator.instruction(0.0, instruction)
        narrator.settled(0.0, state)
    store.writer.close()
    assert feed.state["ended"][0]["deferred"] is False
    live = "\n".join(lines)
    assert "ended    looking#1  provisional SUCCESS" in live
    assert "judged   looking#1  FAILURE, was SUCCESS  wrong_bin: A in B" in live
    told = [record["text"] for record in opened(path, "m")["records"]]
    assert "looking ended: success (provisional)" in told
    assert "verdict on looking#1: failure (wrong_bin: A in B)" in told
    assert "ended    moving#1  -  preempted by both, not counted" in live
    assert "moving has stopped: preempted by both, not counted" in told


def test_history_and_live_page_name_the_action_that_did_not_succeed(tmp_path: Path) -> None:
    """A join takes two runs; its reason is that of the worse one, and so is the action."""
    task, path, feed = loads(JOIN, "join.toml"), tmp_path / "run.journal", Feed()
    engine, narrator = Engine(task), ChangePublisher(feed, task)
    narrator.begin("m", "lockstep")
    writer = JournalWriter(path, {"task": JOIN, "mode": "lockstep"})
    store, state, started = JournalStore(writer, 0.0), engine.initial(), dict[str, str]()
    for stimulus in (
        Begin(),
        RunEnded("looking#1", Status.SUCCESS),
        RunEnded("moving#1", Status.FAILURE, "short", "1 mm short"),
    ):
        narrator.stimulus(0.0, stimulus)
        state, instructions = engine.handle(state, stimulus)
        store.append(0.0, stimulus, instructions, state)
        for instruction in instructions:
            narrator.instruction(0.0, instruction)
            if isinstance(instruction, StartRun):
                started[instruction.run] = instruction.action
        narrator.settled(0.0, state)
    writer.close()
    assert started == {"looking#1": "look", "moving#1": "move"}
    [live] = feed.state["firings"]
    [recorded] = opened(path, "r")["records"][-1]["firings"]
    assert (live["action"], live["reason"]["code"]) == ("move", "short")
    assert recorded == {key: live[key] for key in recorded}


ROUNDS = """
schema = 1
[task]
name = "rounds"
final = "done > 0"
[primitive_tasks.look]
goal = "It is seen"
alternatives = ["look", "glance"]
deadline = 1.0
[places]
looking = { kind = "action", task = "look", tokens = 1 }
seen = { tokens = 1 }
done = {}
[transitions]
again = { in = ["looking:normal"], out = ["looking"], weight = 1.0 }
also = { in = ["looking:normal"], out = ["looking"], weight = 1.0 }
lost = { in = ["looking:error"], out = ["looking"] }
"""


def test_a_long_mission_leaves_nothing_behind_for_its_viewers() -> None:
    """Runs that ended in each way, draws and choices: after them the publisher keeps as much as
    after the first ones."""
    task, feed = loads(ROUNDS, "rounds.toml"), Feed()
    engine, publisher = Engine(task), ChangePublisher(feed, task)
    publisher.begin("m", "lockstep")
    state, waiting, kept = engine.initial(), list[Any]([Begin()]), list[int]()
    ends = itertools.cycle([Status.SUCCESS, Status.ERROR, Status.FAILURE])
    for step in range(300):
        stimulus = waiting.pop(0)
        publisher.stimulus(step, stimulus)
        state, instructions = engine.handle(state, stimulus)
        for instruction in instructions:
            publisher.instruction(step, instruction)
            if isinstance(instruction, Choose):
                waiting.append(Chosen(instruction.key, instruction.alternatives[0], "draw"))
            elif isinstance(instruction, StartRun):
                waiting.append(RunEnded(instruction.run, next(ends), "why", "and how"))
        publisher.settled(step, state)
        kept.append(sum(len(v) for v in vars(publisher).values() if isinstance(v, dict)))
    assert feed.state["mission"]["firings"] > 80
    assert feed.state["firings"][-1]["action"] == "look"
    assert max(kept) == max(kept[:20])
