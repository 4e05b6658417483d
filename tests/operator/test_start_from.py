"""Simulated runs that start from a point of a recorded run: from its first record they repeat it,
from any other they reach an end."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from petrobot.coordinator.cli import main
from petrobot.coordinator.engine import Engine, Phase
from petrobot.coordinator.operator.prepare import RecordedPoint, RunRequest, prepare_from
from petrobot.coordinator.operator.session import RunSession
from petrobot.coordinator.operator.start_from import ENDS, DepartureError, read_recorded
from petrobot.coordinator.run.folder import JOURNAL
from petrobot.coordinator.run.journal import Journal, read_journal
from petrobot.coordinator.run.recording import replay
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import load
from petrobot.services.comm.location_file import Directory, parse
from tests.run.test_folder import SCRIPT, SERVICES

TASK = Path(__file__).parents[1] / "chaos" / "shuttle.toml"


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a cell of one node and a recorded run."""
    folder = tmp_path_factory.mktemp("departure")
    for name, text in (("services.toml", SERVICES), ("mock.toml", SCRIPT)):
        (folder / name).write_text(text)
    given = [
        "run",
        str(TASK),
        "--mode",
        "lockstep",
        "--quiet",
        "--seed",
        "3",
        "--journal",
        str(folder / "runs"),
    ]
    assert (
        main(
            [
                *given,
                "--services",
                str(folder / "services.toml"),
                "--mock",
                str(folder / "mock.toml"),
            ]
        )
        == 0
    )
    return folder


def the_run(cell: Path) -> Path:
    """Return the folder of the first run."""
    return min((cell / "runs").iterdir(), key=lambda p: p.stat().st_mtime)


def parts(cell: Path) -> tuple[Journal, Task, Directory, Engine]:
    """Return the parts of a recorded run."""
    task, directory = load(TASK), parse(SERVICES, cell / "services.toml")
    return read_journal(the_run(cell) / JOURNAL), task, directory, Engine(task)


def simulate(cell: Path, run: Path, seed: int, record: int = 0, **start: Any) -> RunSession:
    """Run from a record of `run` to the end in this process."""
    request = RunRequest(
        "lockstep",
        seed=seed,
        pace=0.0,
        start=RecordedPoint("then", record, **start),
        folder=cell / "runs",
        mock=cell / "mock.toml",
    )
    session = prepare_from(request, read_recorded(run / JOURNAL))
    asyncio.run(asyncio.wait_for(session.lead(), 60.0))
    session.keep_result()
    return session


def plain(journal: Journal) -> list[tuple[str, Any]]:
    """Return the records without their CPU times."""
    for record in journal.records:
        if isinstance(record.data.get("stimulus"), dict):
            record.data["stimulus"].pop("cpu_seconds", None)
    return [(record.kind, record.data) for record in journal.records]


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 2**31))
def test_from_the_first_record_with_the_same_seed_the_run_is_repeated(
    cell: Path, seed: int
) -> None:
    """It is equal record by record, for any seed."""
    then = the_run(cell)
    made = []
    for _ in range(2):
        session = simulate(cell, then, seed)
        assert session.folder is not None
        then = session.folder
        made.append(plain(read_journal(then / JOURNAL)))
        assert session.mission.executor.mission.endswith(f"/{seed}")
    assert made[0] == made[1]


def test_the_command_line_repeats_a_recorded_run(cell: Path) -> None:
    """`petrobot run --from RUN` repeats the recorded run in a new folder, which names the
    original."""
    then = the_run(cell)
    out = cell / "again.json"
    given = [
        "run",
        "--from",
        str(then),
        "--quiet",
        "--journal",
        str(cell / "again"),
        "--json",
        str(out),
    ]
    assert main(given) == 0
    [folder] = (cell / "again").iterdir()
    again = read_journal(folder / JOURNAL)
    assert plain(again) == plain(read_journal(then / JOURNAL))
    assert again.header["from"] == {"run": then.name, "record": 0, "time": 0.0, "going": {}}
    before, now = json.loads((then / "result.json").read_text()), json.loads(out.read_text())
    assert now.pop("from") == {"run": then.name, "record": 0, "going": {}}
    assert {k: v for k, v in now.items() if k != "wall_s"} == {
        k: v for k, v in before.items() if k != "wall_s"
    }
    assert main(["replay", str(folder)]) == 0


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_from_any_record_it_reaches_an_end(cell: Path, data: st.DataObject) -> None:
    """The active runs may end in any way; the first marking is that of the record, and the new
    journal replays."""
    journal, task, _, engine = parts(cell)
    last = journal.records[-1].number
    record = data.draw(st.integers(0, last - 1), label="record")
    steps = [step for step in replay(journal, engine) if step.number <= record]
    live = (
        sorted({r.place for r in steps[-1].state.runs() if r.phase is not Phase.DONE})
        if steps
        else []
    )
    going = {place: data.draw(st.sampled_from(ENDS), label=place) for place in live}
    seed = data.draw(st.integers(0, 99), label="seed")
    try:
        session = simulate(cell, the_run(cell), seed, record, going=going)
    except DepartureError:
        assert record > max(r.number for r in journal.records if r.kind == "stimulus")
        return
    assert session.result()["status"] == "success" and session.folder is not None
    made = read_journal(session.folder / JOURNAL)
    assert made.header["from"]["record"] == record
    derived = list(replay(made, Engine(task)))
    begun = next(step for step in derived if step.stimulus.__class__.__name__ == "Begin")
    if steps and going == dict.fromkeys(live, "again"):
        assert begun.state.marking == steps[-1].state.marking


@pytest.mark.parametrize(
    ("more", "word"),
    [
        (["--from", "{run}:99999"], "records 0"),
        (["--from", "{run}:one"], "with a number"),
        (["--from", "{run}:-1"], "with a number"),
        (["--from", "nowhere:1"], "no run"),
        (["--from", "{run}:1", "--runs", "3"], "runs are left"),
        (["--from", "{run}:1", "--learn", "x.db"], "would distort"),
        (["--from", "{run}:1", "--mode", "realtime"], "is not in the recorded state"),
        (["--from", "{run}:1", "--processes", "0"], "one process"),
        (["--from", "{run}:1", "--going", "later"], "for an active run"),
        (["--from", "{run}:1", "--going", "moon=error"], "no run was active"),
        (["--from", "{run}:1", "--going", "error", "--going", "success"], "one END for all"),
        (["--from", "{run}:1", "--set", "speed=3"], "no parameter"),
        (["shuttle", "--from", "{run}:1"], "cannot have a task"),
        (["--going", "again"], "give a task"),
        (["shuttle", "--going", "again"], "--going needs --from"),
    ],
)
def test_invalid_starting_points_are_refused(
    cell: Path, more: list[str], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2 and one clear message; no folder is left behind."""
    folder = cell / "refused"
    given = [text.format(run=the_run(cell)) for text in more]
    assert main(["run", *given, "--quiet", "--journal", str(folder)]) == 2
    assert word in capsys.readouterr().err
    assert not folder.exists()


def test_a_killed_run_from_a_point_is_repeated(cell: Path) -> None:
    """`petrobot resume` knows its starting point."""
    then, kept = the_run(cell), cell / "killed"
    record = next(
        r.number for r in read_journal(then / JOURNAL).records if "RunEnded" in str(r.data)
    )
    assert main(["run", "--from", f"{then}:{record}", "--quiet", "--journal", str(kept)]) == 0
    [folder] = kept.iterdir()
    before = plain(read_journal(folder / JOURNAL))
    (folder / "result.json").unlink()
    whole = read_journal(folder / JOURNAL)
    (folder / JOURNAL).unlink()
    _write(folder / JOURNAL, whole, 5)
    assert main(["resume", str(folder), "--quiet", "--no-page"]) == 0
    assert plain(read_journal(folder / JOURNAL)) == before


def _write(path: Path, whole: Journal, records: int) -> None:
    from petrobot.coordinator.run.journal import JournalWriter

    given: Mapping[str, Any] = dict(whole.header)
    writer = JournalWriter(path, given)
    for record in whole.records[:records]:
        writer.append(record.kind, record.data)
    writer.close()
