"""Make the golden journals again: `python -m tests.run.golden.make`. Run it only after an intended
change of the semantics.

Each is a mission run of a shipped task in lock step with scripted actions. The tests compute every
marking and instruction again (tests/run/test_golden.py), so they notice an unintended change of the
semantics.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from petrobot.coordinator.cli.loading import load_task, task_path
from petrobot.coordinator.launch import Setting, lockstep_cell, lockstep_id, with_runs
from petrobot.coordinator.run.folder import header
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.recording import JournalStore
from petrobot.coordinator.task.file import dumps
from petrobot.services.action import Status
from petrobot.services.comm.location_file import parse
from petrobot.services.scripted import ScriptedRun
from tests.run.scripted_cell import scripts, services_text

FOLDER = Path(__file__).parent
GOOD = ScriptedRun(seconds=(0.2, 0.2))
FAULT = ScriptedRun(Status.ERROR, (0.1, 0.1), cause="drive_fault", text="drive 3: following error")
MISSED = ScriptedRun(Status.FAILURE, (0.3, 0.3), cause="missed")
END = [4.0, 2.0, 0.0]
GOES_ON = ScriptedRun(seconds=(3.0, 3.0), values={"at_t": False, "line_end": END})
ENDS_AT_T = ScriptedRun(seconds=(3.0, 3.0), values={"at_t": True, "line_end": END})
FOUND = ScriptedRun(seconds=(2.0, 2.0), values={"recovered": True})
NOT_FOUND = ScriptedRun(Status.FAILURE, (2.5, 2.5), {"recovered": False}, "no_track")
LOST = ScriptedRun(Status.ERROR, (1.0, 1.0), cause="no_line", text="no line to follow for 0.5 s")
UNSEEN = ScriptedRun(Status.ERROR, (4.0, 4.0), cause="no_line", text="the line was lost for 0.8 s")
STORIES: Mapping[str, tuple[str, int, Mapping[str, list[ScriptedRun]]]] = {
    "catch_ball-undisturbed": ("catch_ball", 4, {}),
    "catch_ball-missed-and-recovered": (
        "catch_ball",
        4,
        {
            "catch_ball": [MISSED, GOOD, FAULT, GOOD],
            "move_to_point": [GOOD, FAULT, GOOD, GOOD],
            "recover_arm": [FAULT, GOOD],
        },
    ),
    "catch_ball-given-up": ("catch_ball", 2, {"return_home": [FAULT], "recover_arm": [FAULT]}),
    "follow_track-undisturbed": (
        "follow_track",
        1,
        {
            "follow_track": [GOES_ON, ENDS_AT_T],
            "watch_track": [GOES_ON, ENDS_AT_T],
            "recover_track": [FOUND],
        },
    ),
    "follow_track-lost-and-found": (
        "follow_track",
        1,
        {
            "follow_track": [GOES_ON, GOES_ON, LOST, FAULT, ENDS_AT_T],
            "watch_track": [GOES_ON, UNSEEN, GOES_ON, ENDS_AT_T],
            "recover_track": [NOT_FOUND, FOUND],
            "search_track": [FOUND],
            "stop_at_t": [FAULT, GOOD],
        },
    ),
    "follow_track-given-up": (
        "follow_track",
        1,
        {
            "follow_track": [LOST],
            "watch_track": [GOES_ON],
            "search_track": [NOT_FOUND],
        },
    ),
}
"""Journals by name: task, number of runs, and scripts of its actions."""


def make(name: str, folder: Path) -> Path:
    """Run a story and return its journal."""
    task_name, runs, lines = STORIES[name]
    task, path = load_task(task_name), folder / f"{name}.journal"
    text = services_text(task)
    setting = Setting(task, runs=runs)
    started, tokens = with_runs(task, runs)
    given = {
        "expanded": dumps(started.flat),
        "services_path": "services.toml",
        "seed": setting.seed,
        "runs": tokens,
    }
    source = task_path(task_name).read_text(encoding="utf-8")
    parameters = {
        "parameters": dict(task.parameters),
        "cell": "launched",
        "mock": "",
        "durable": False,
    }
    first = header(lockstep_id(setting), source, text, "lockstep", {**given, **parameters})
    store = JournalStore(JournalWriter(path, first), 0.0)
    cell, party = lockstep_cell(
        parse(text, Path("services.toml")), setting, scripts(task, lines), store=store
    )
    if not cell.run(lambda: party.over, 1_000_000):
        raise RuntimeError(f"{name} does not end")
    store.writer.close()
    return path


def main() -> None:
    """Make all journals."""
    for name in STORIES:
        (FOLDER / f"{name}.journal").unlink(missing_ok=True)
        print(make(name, FOLDER))


if __name__ == "__main__":
    main()
