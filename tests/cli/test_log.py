"""`petrobot log RUN` shows everything that moves or explains a token."""

from __future__ import annotations

import json
import re
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from petrobot.coordinator.cli import main
from petrobot.coordinator.engine import (
    Abort,
    AddTokens,
    Begin,
    Chosen,
    Engine,
    EventOccurred,
    ForceExit,
    Override,
    Pause,
    RaiseEvent,
    RemoveTokens,
    Resume,
    RunRaised,
    RunStarted,
    SetBreakpoints,
    Step,
    Stimulus,
)
from petrobot.coordinator.operator.history import opened
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.recording import EPOCH, JournalStore
from petrobot.coordinator.task.file import loads
from tests.run.test_folder import SERVICES

TASK = """
schema = 1
[task]
name = "desk"
goal = "The parcel is away"
final = "away > 0"
final_error = "lost > 0"
[events]
low = { scope = "external" }
stuck = { scope = "internal", by = "carry" }
press = { scope = "external", memory = "latched", early = "keep" }
[primitive_tasks.carry]
goal = "It is there"
alternatives = ["carry", "push"]
deadline = 9.0
[places]
books = { kind = "control", tokens = 1 }
busy = { kind = "control" }
free = { kind = "control", tokens = 1 }
carrying = { kind = "action", task = "carry", tokens = 1 }
saving = { kind = "control" }
away = { kind = "control" }
lost = { kind = "control" }
[transitions]
save = { in = ["free", "busy"], out = ["saving"], event = "low" }
pressed = { in = ["busy"], out = ["free"], event = "press" }
hindered = { in = ["carrying:going"], out = ["lost"], event = "stuck" }
carried = { in = ["carrying:normal"], out = ["away"] }
failed = { in = ["carrying:error"], out = ["lost"] }
"""

STORY: tuple[tuple[Stimulus, str], ...] = (
    (Begin(), ""),
    (Override("carry", "push"), "operator  carry                operator chose push for carry"),
    (Chosen("carrying#1", "carry"), "started   carrying#1           carry"),
    (EventOccurred("low", "arm"), "event     low                  from arm: nothing waited for it"),
    (RaiseEvent("press"), "event     press                raised by the operator: "
     "kept until a transition takes it"),
    (AddTokens("books", 1), "marked    books                operator put 1 into books  "
     "books:2 free carrying"),
    (RemoveTokens("books", 1), "marked    books                operator took 1 out of books  "
     "books free carrying"),
    (Pause("by ana"), "paused                         by ana"),
    (Resume(), "continued"),
    (SetBreakpoints(("carried",)), "operator                       breakpoints: carried"),
    (SetBreakpoints(), "operator                       breakpoints: none"),
    (Step(), "continued                      for one firing"),
    (RunStarted("carrying#1"), ""),
    (RunRaised("carrying#1", "other"), "event     other                raised by carrying#1"),
    (ForceExit("carried"), "operator  carried              forced by the operator"),
    (Abort("by ben"), "aborted                        by ben"),
)  # fmt: skip


HEADER: dict[str, Any] = {
    "mission": "desk-1", "mode": "realtime", "task": TASK, "services": SERVICES, "seed": 1,
    "services_path": "services.toml", "runs": 1, "parameters": {}, "date": "2026-01-01",
    "devices": {},
}  # fmt: skip


def recorded(folder: Path, begun: float = 0.0) -> Path:
    """Write the journal of the story; another coordinator continues it after its first half."""
    engine = Engine(loads(TASK, "desk.toml"))
    path = folder / "run.journal"
    with closing(JournalWriter(path, HEADER)) as writer:
        store, state = JournalStore(writer, 0.0), engine.initial()
        for i, (stimulus, _) in enumerate(STORY):
            if i == len(STORY) // 2:
                store.record(EPOCH, {"t": i - 0.5, "epoch": 2})
            state, instructions = engine.handle(state, stimulus)
            store.append(begun + i, stimulus, instructions, state)
    return path


def test_the_log_shows_all_that_moves_or_explains_a_token(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recorded(tmp_path)
    assert main(["log", str(path)]) == 0
    shown = capsys.readouterr().out.splitlines()
    for i, (stimulus, line) in enumerate(STORY):
        at = [one[20:] for one in shown if one[5:20].strip() == f"{i:.3f} s"]
        assert line == "" or line in at, (stimulus, at)
    [resumed] = [one for one in shown if "another coordinator" in one]
    assert resumed[5:] == (
        f"{7.5:11.3f} s  resumed   {'':20} another coordinator continues the run (epoch 2)"
    )


def test_equal_events_one_after_the_other_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of ten minutes without a coordinator come when it is back. Another line ends the
    count, as does the end of the log."""
    engine = Engine(loads(TASK, "desk.toml"))
    press, low = EventOccurred("press", "button"), EventOccurred("low", "arm")
    path = tmp_path / "run.journal"
    with closing(JournalWriter(path, HEADER)) as writer:
        store, state = JournalStore(writer, 0.0), engine.initial()
        story: tuple[Stimulus, ...] = (Begin(), *[press] * 90, low, low, press, press, press)
        for i, stimulus in enumerate(story):
            state, instructions = engine.handle(state, stimulus)
            store.append(i, stimulus, instructions, state)
    assert main(["log", str(path)]) == 0
    shown = [line[20:] for line in capsys.readouterr().out.splitlines() if line[0] == " "]
    kept = "event     press                from button: kept until a transition takes it"
    assert shown[-6:] == [
        kept,
        "the same 89 times more, until 90.000 s",
        "event     low                  from arm: nothing waited for it",
        "the same 1 times more, until 92.000 s",
        kept,
        "the same 2 times more, until 95.000 s",
    ]


def test_an_event_that_is_delivered_again_is_not_shown_as_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The node delivers again what a coordinator that was killed may not have received."""
    engine = Engine(loads(TASK, "desk.toml"))
    press, path = EventOccurred("press", "button", 1), tmp_path / "run.journal"
    with closing(JournalWriter(path, HEADER)) as writer:
        store, state = JournalStore(writer, 0.0), engine.initial()
        story: tuple[Stimulus, ...] = (Begin(), press, press, replace(press, number=2))
        for i, stimulus in enumerate(story):
            state, instructions = engine.handle(state, stimulus)
            store.append(i, stimulus, instructions, state)
    assert main(["log", str(path)]) == 0
    shown = [line[47:] for line in capsys.readouterr().out.splitlines() if "press" in line]
    kept = "from button: kept until a transition takes it"
    assert [line.strip() for line in shown] == [kept, "from button: delivered again, ignored", kept]
    assert main(["log", str(path), "--format", "jsonl"]) == 0
    lines = map(json.loads, capsys.readouterr().out.splitlines()[1:])
    assert [line.get("repeated", False) for line in lines] == [False, False, True, False]


def test_an_event_of_a_run_that_is_delivered_again_fires_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A transition that leaves the run active has consumed it already."""
    engine = Engine(loads(TASK, "desk.toml"))
    stuck, path = RunRaised("carrying#1", "stuck", 1), tmp_path / "run.journal"
    with closing(JournalWriter(path, HEADER)) as writer:
        store, state = JournalStore(writer, 0.0), engine.initial()
        begin: tuple[Stimulus, ...] = (Begin(), Chosen("carrying#1", "carry"))
        for i, stimulus in enumerate((*begin, stuck, stuck, replace(stuck, number=2), stuck)):
            state, instructions = engine.handle(state, stimulus)
            store.append(i, stimulus, instructions, state)
    assert main(["log", str(path)]) == 0
    shown = capsys.readouterr().out
    assert shown.count("fired     hindered") == 2
    assert shown.count("raised by carrying#1: delivered again, ignored") == 2


def test_a_report_has_the_times_of_the_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The journal's clock begins before the run: the nodes connect, and the cell is prepared."""
    path, page = recorded(tmp_path, begun=2.0), tmp_path / "page.html"
    assert main(["log", str(path)]) == 0
    [fired] = [one for one in capsys.readouterr().out.splitlines() if " fired " in one]
    assert main(["report", str(path), "--out", str(page)]) == 0
    cell = re.search(r"<td>([\d.]*) s</td><td>carried<", page.read_text(encoding="utf-8"))
    assert cell is not None
    assert float(cell[1]) == float(fired[5:16]) == 16.0


def test_the_page_tells_the_same_of_events_and_resumes(tmp_path: Path) -> None:
    texts = [record["text"] for record in opened(recorded(tmp_path), "r")["records"]]
    assert {
        "event low: nothing waited for it",
        "another coordinator continues the run (epoch 2)",
    } <= set(texts)
