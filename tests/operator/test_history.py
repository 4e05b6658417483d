"""A recorded run as the page's history shows it: what the live page said of the same firings."""

from __future__ import annotations

from pathlib import Path

from petrobot.coordinator.engine import Begin, Engine, RunEnded, StartRun
from petrobot.coordinator.operator.feed import Feed
from petrobot.coordinator.operator.history import opened
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
