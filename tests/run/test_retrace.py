"""A lock-step run whose whole cell died with its coordinator: it is simulated again from its seed,
compared with the journal, and continued."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from petrobot.coordinator.cli import main
from petrobot.coordinator.operator.history import opened
from petrobot.coordinator.run.folder import JOURNAL, RESULT, SEMANTICS
from petrobot.coordinator.run.journal import JournalWriter, read_journal
from petrobot.coordinator.run.recording import ReplayError, RetracingStore, remarks, unmeasured
from petrobot.coordinator.task import Task, model
from petrobot.coordinator.task.expansion import expand
from petrobot.coordinator.task.file import load, loads
from tests.run.test_folder import SCRIPT, SERVICES

TASK = Path(__file__).parents[1] / "chaos" / "shuttle.toml"


@pytest.fixture
def recorded_run(tmp_path: Path) -> Path:
    """Return the folder of a run that ended."""
    for name, text in (("services.toml", SERVICES), ("mock.toml", SCRIPT)):
        (tmp_path / name).write_text(text)
    given = ["run", str(TASK), "--mode", "lockstep", "--quiet", "--journal", str(tmp_path / "runs")]
    given += ["--services", str(tmp_path / "services.toml"), "--mock", str(tmp_path / "mock.toml")]
    assert main(given) == 0
    [folder] = (tmp_path / "runs").iterdir()
    return folder


def kill_at(folder: Path, records: int) -> dict[str, Any]:
    """Cut the journal after so many records, within the next one, and remove the result; return
    that result."""
    result: dict[str, Any] = json.loads((folder / RESULT).read_text())
    (folder / RESULT).unlink()
    path = folder / JOURNAL
    whole, raw = read_journal(path), path.read_bytes()
    path.unlink()
    writer = JournalWriter(path, dict(whole.header))
    for record in whole.records[:records]:
        writer.append(record.kind, record.data)
    writer.close()
    with path.open("ab") as file:
        file.write(raw[path.stat().st_size :][:5])
    result.pop("wall_s")
    return result


@pytest.mark.parametrize("records", [0, 1, 2, 7, 20, 10_000])
def test_the_resumed_run_is_the_undisturbed_one(recorded_run: Path, records: int) -> None:
    """Result and journal equal those of a run that was not killed, record by record."""
    path = recorded_run / JOURNAL
    before = [(r.kind, r.data) for r in read_journal(path).records]
    expected = kill_at(recorded_run, records)
    assert main(["resume", str(recorded_run), "--quiet", "--no-page"]) == 0
    result = json.loads((recorded_run / RESULT).read_text())
    result.pop("wall_s")
    assert result == expected
    assert len(read_journal(path).records) == len(before)
    assert [r.data["marking"] for r in read_journal(path).records if r.kind == "stimulus"] == [
        data["marking"] for kind, data in before if kind == "stimulus"
    ]
    assert main(["replay", str(recorded_run)]) == 0


def test_a_changed_script_is_noticed(
    recorded_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another script gives another run, which does not overwrite the recorded one."""
    kill_at(recorded_run, 20)
    (recorded_run.parents[1] / "mock.toml").write_text(SCRIPT.replace("0.1", "0.2"))
    assert main(["resume", str(recorded_run), "--quiet", "--no-page"]) == 2
    said = capsys.readouterr().err
    assert "sources or files have changed since" in said and "record " in said
    assert len(read_journal(recorded_run / JOURNAL).records) == 20


def test_what_older_journals_lack_and_measured_times_are_not_compared(tmp_path: Path) -> None:
    path = tmp_path / "run.journal"
    writer = JournalWriter(path, {"mode": "lockstep"})
    writer.append("stage", {"stage": "scored", "values": {"cpu_s": 1.0}})
    writer.append(
        "stimulus", {"t": 1.0, "stimulus": {"kind": "RunEnded", "run": "a#1", "cpu_seconds": 0.25}}
    )
    raised = {"kind": "RunRaised", "run": "b#1", "event": "full"}
    writer.append("stimulus", {"t": 2.0, "stimulus": raised})
    writer.close()
    store = RetracingStore(JournalWriter(path), read_journal(path))
    with pytest.raises(ValueError, match="try again when it has caught up"):
        store.remark(0.0, "ana", "too early")
    store.record("stage", {"stage": "scored", "values": {"cpu_s": 2.0}})
    store.record(
        "stimulus", {"t": 1.0, "stimulus": {"kind": "RunEnded", "run": "a#1", "cpu_seconds": 0.5}}
    )
    store.record("stimulus", {"t": 2.0, "stimulus": {**raised, "number": 7}})
    compared = store.safe
    store.record("stage", {"stage": "other", "values": {}})
    assert (compared, store.safe) == (True, False), (
        "what is there is compared, what comes after it is written"
    )
    store.writer.close()
    again = RetracingStore(JournalWriter(path), read_journal(path))
    with pytest.raises(ReplayError, match="record 1 was stage"):
        again.record("stage", {"stage": "prepared", "values": {}})


def nudged(value: Any, share: float) -> Any:
    """Return plain data with every float increased by this share."""
    if isinstance(value, dict):
        return {key: nudged(one, share) for key, one in value.items()}
    if isinstance(value, list):
        return [nudged(one, share) for one in value]
    return value * (1.0 + share) if isinstance(value, float) else value


def recorded_elsewhere(folder: Path, share: float) -> list[tuple[str, Any]]:
    """Cut the run off after 20 records, and change the last digits from the tenth on, as if another
    processor had computed them."""
    kill_at(folder, 20)
    journal = read_journal(folder / JOURNAL)
    (folder / JOURNAL).unlink()
    with closing(JournalWriter(folder / JOURNAL, journal.header)) as writer:
        for record in journal.records:
            data = dict(record.data)
            if record.number >= 10 and record.kind == "stimulus":
                data["stimulus"] = nudged(data["stimulus"], share)
                data["instructions"] += share > 0
            writer.append(record.kind, data)
    return [(record.kind, record.data) for record in journal.records]


def test_a_run_of_another_processor_is_resumed(recorded_run: Path) -> None:
    """Its last digits differ, and the journal still replays afterwards."""
    expected = json.loads((recorded_run / RESULT).read_text())
    before = recorded_elsewhere(recorded_run, 1e-12)
    assert main(["resume", str(recorded_run), "--quiet", "--no-page"]) == 0
    result = json.loads((recorded_run / RESULT).read_text())
    assert {**result, "wall_s": 0} == {**expected, "wall_s": 0}
    after = read_journal(recorded_run / JOURNAL).records
    assert [(r.kind, unmeasured(r.data)) for r in after][: len(before)] == [
        (kind, unmeasured(data)) for kind, data in before
    ]
    assert main(["replay", str(recorded_run)]) == 0


@pytest.mark.parametrize("share", [0.0, 1e-12], ids=["same", "other last digits"])
def test_remarks_keep_their_place_when_a_run_is_derived_again(
    recorded_run: Path, share: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """The engine does not write them again, and they are not lost where records are."""
    recorded_elsewhere(recorded_run, share)
    path = recorded_run / JOURNAL
    journal = read_journal(path)
    path.unlink()
    said = {0: "first", 9: "before", 15: "between", len(journal.records): "last"}
    with closing(JournalWriter(path, journal.header)) as writer:
        for place, record in enumerate((*journal.records, None)):
            if place in said:
                writer.append("remark", {"t": 0.0, "author": "ana", "text": said[place]})
            if record is not None:
                writer.append(record.kind, record.data)
    before = [(r.number, r.text) for r in remarks(read_journal(path))]
    assert [text for _, text in before] == list(said.values())
    assert main(["resume", str(recorded_run), "--quiet", "--no-page"]) == 0
    assert [(r.number, r.text) for r in remarks(read_journal(path))] == before
    assert main(["replay", str(recorded_run)]) == 0
    capsys.readouterr()
    assert main(["log", str(recorded_run)]) == 0
    told = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    numbers = [int(words[0]) for words in told]
    assert numbers == sorted(numbers)
    shown = [(int(words[0]), words[5]) for words in told if words[3] == "remarked"]
    assert shown == before
    assert main(["log", str(recorded_run), "--format", "jsonl"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [
        (line["number"], line["remark"]["text"]) for line in lines if "remark" in line
    ] == before
    records = opened(path, "r")["records"]
    assert [(r["number"], r["text"]) for r in records if "remarked" in r["text"]] == [
        (number, f"ana remarked: {text}") for number, text in before
    ]


def test_a_run_that_differs_by_more_than_last_digits_is_not_overwritten(
    recorded_run: Path,
) -> None:
    recorded_elsewhere(recorded_run, 1e-3)
    there = (recorded_run / JOURNAL).read_bytes()
    assert main(["resume", str(recorded_run), "--quiet", "--no-page"]) == 2
    assert (recorded_run / JOURNAL).read_bytes() == there


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["replay", "RUN"], 1),
        (["log", "RUN"], 2),
        (["log", "RUN", "--format", "xes"], 2),
        (["report", "RUN", "--out", "FOLDER"], 2),
        (["resume", "RUN", "--quiet"], 2),
        (["run", "--from", "RUN:20", "--quiet"], 2),
    ],
)
def test_a_journal_that_does_not_replay_is_bad_input(
    arguments: list[str], code: int, recorded_run: Path, tmp_path: Path
) -> None:
    """Only `replay` was asked whether it does: its answer is no."""
    recorded_elsewhere(recorded_run, 1e-3)
    names = {"RUN": str(recorded_run), "RUN:20": f"{recorded_run}:20", "FOLDER": str(tmp_path)}
    assert main([names.get(word, word) for word in arguments]) == code


def test_a_journal_of_a_newer_petrobot_is_refused(
    recorded_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its semantics are not known here: a replay would report differences that are not faults."""
    journal = read_journal(recorded_run / JOURNAL)
    assert journal.header["semantics"] == SEMANTICS
    newer = tmp_path / "run.journal"
    with closing(JournalWriter(newer, {**journal.header, "semantics": SEMANTICS + 1})) as writer:
        for record in journal.records:
            writer.append(record.kind, record.data)
    assert main(["replay", str(newer)]) == 2
    said = capsys.readouterr().err
    assert f"semantics: expected at most {SEMANTICS}, found {SEMANTICS + 1}" in said
    assert "Traceback" not in said


SORTER = Path(__file__).parents[2] / "examples" / "sorter"
SLIPS = """
schema = 1
[[actions.grip]]
status = "error"
cause = "slipped"
[[actions.grip]]
[actions.scan]
values = { code = "left" }
[actions.move]
"""


def fewer_tries(task: Task) -> Task:
    """Return the sorter's task as a petrobot would expand it that gives up after the first try."""
    places = {name: replace(place, tries=1) for name, place in task.places.items()}
    return expand(replace(task, places=places))


@pytest.mark.parametrize("resumed", [False, True])
def test_a_run_keeps_the_expansion_of_its_short_forms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resumed: bool
) -> None:
    """The header has the expanded task, so a petrobot that expands short forms in another way
    replays and resumes the run unchanged. Only a journal without the expanded task is expanded
    again."""
    (tmp_path / "mock.toml").write_text(SLIPS)
    given = ["run", str(SORTER / "sort.toml"), "--mode", "lockstep", "--quiet", "--runs", "3"]
    given += ["--journal", str(tmp_path / "runs"), "--mock", str(tmp_path / "mock.toml")]
    assert main(given) == 0
    [folder] = (tmp_path / "runs").iterdir()
    header = dict(read_journal(folder / JOURNAL).header)
    recorded, now = loads(header["expanded"], flat=True), load(SORTER / "sort.toml").flat
    assert recorded.flat is recorded and recorded.places["parts"].tokens == 3
    assert recorded.transitions == now.transitions and recorded.final == now.final
    assert {**recorded.places, "parts": now.places["parts"]} == now.places

    monkeypatch.setattr(model, "expand", fewer_tries)
    if resumed:
        expected = kill_at(folder, 7)
        assert main(["resume", str(folder), "--quiet", "--no-page"]) == 0
        result = json.loads((folder / RESULT).read_text())
        result.pop("wall_s")
        assert result == expected
    assert main(["replay", str(folder)]) == 0

    whole = read_journal(folder / JOURNAL)
    del header["expanded"]
    (folder / JOURNAL).unlink()
    with closing(JournalWriter(folder / JOURNAL, header)) as writer:
        for record in whole.records:
            writer.append(record.kind, record.data)
    assert main(["replay", str(folder)]) == 1
