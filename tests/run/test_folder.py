"""Folders of runs: how one is found, and how long they are kept."""

from __future__ import annotations

import errno
import json
import os
import time
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.operator.run_address import RunAddress, published
from petrobot.coordinator.run.folder import JOURNAL, RESULT, NoRunError, journal_of, retain
from petrobot.coordinator.run.journal import JournalError, JournalWriter

SERVICES = """
schema = 1
[nodes.robot]
host = "127.0.0.1"
port = 7399
[actions.left_fetch]
run = "petrobot.services.scripted:nothing"
task = "fetch"
node = "robot"
[actions.right_carry]
run = "petrobot.services.scripted:nothing"
task = "carry"
node = "robot"
[actions.right_tidy]
run = "petrobot.services.scripted:nothing"
task = "tidy"
node = "robot"
[timers.bell]
node = "robot"
period = 0.1
"""
SCRIPT = "schema = 1\n" + "".join(
    f"[actions.{name}]\nseconds = 0.1\n" for name in ("left_fetch", "right_carry", "right_tidy")
)


def a_run(folder: Path, name: str, age: int, ended: bool = True) -> Path:
    """Make a run's folder that is so many seconds old."""
    JournalWriter(folder / name / JOURNAL, {}).close()
    paths = [folder / name / JOURNAL]
    if ended:
        paths.append(folder / name / RESULT)
        paths[-1].write_text("{}")
    for path in paths:
        os.utime(path, (1e9 - age, 1e9 - age))
    return folder / name


def test_the_oldest_ended_runs_are_removed_but_never_one_without_result(tmp_path: Path) -> None:
    for name, age in (("a", 50), ("b", 40), ("c", 30), ("d", 20)):
        a_run(tmp_path, name, age)
    a_run(tmp_path, "killed", 100, ended=False)
    assert retain(tmp_path, 2) == ["a", "b"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c", "d", "killed"]
    assert retain(tmp_path, 2) == []


def test_runs_from_before_the_clock_was_set_back_are_older_than_a_new_one(tmp_path: Path) -> None:
    """A clock that was wrong once made its last run the newest for years."""
    far = 1e9 - time.time() - 1e6
    for name, age in (("a", 0), ("b", int(far)), ("c", int(far) - 100)):
        a_run(tmp_path, name, age)
    JournalWriter(tmp_path / "new" / JOURNAL, {}).close()
    assert journal_of("last", tmp_path).parent.name == "new"
    (tmp_path / "new" / RESULT).write_text("{}")
    assert retain(tmp_path, 2) == ["a", "b"]


def test_a_run_in_which_the_clock_is_set_back_is_the_newest_at_its_end(tmp_path: Path) -> None:
    """It was removed at its end by `--keep`, as the oldest."""
    new = JournalWriter(tmp_path / "new" / JOURNAL, {})
    hour = int(1e9 - time.time() - 3600)
    for name, age in (("a", hour + 1), ("b", hour)):
        a_run(tmp_path, name, age)
    new.close()
    (tmp_path / "new" / RESULT).write_text("{}")
    assert journal_of("last", tmp_path).parent.name == "new"
    assert retain(tmp_path, 1) == ["a", "b"]


@pytest.mark.parametrize("name", ["new", "last"])
def test_a_run_is_found_by_id_folder_journal_or_as_the_last(tmp_path: Path, name: str) -> None:
    a_run(tmp_path, "old", 50)
    new = a_run(tmp_path, "new", 10)
    assert journal_of(name, tmp_path) == new / JOURNAL
    assert journal_of(str(new)) == journal_of(str(new / JOURNAL)) == new / JOURNAL
    with pytest.raises(NoRunError, match="new, old"):
        journal_of("other", tmp_path)


def test_keep_limits_the_number_of_runs_in_lock_step_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`petrobot run --journal FOLDER --keep 2`, four times; without `--journal` a lock-step run
    leaves nothing behind."""
    for name, text in (("services.toml", SERVICES), ("mock.toml", SCRIPT)):
        (tmp_path / name).write_text(text)
    task = Path(__file__).parents[1] / "chaos" / "shuttle.toml"
    given = ["run", str(task), "--mode", "lockstep", "--quiet", "--json", "-"]
    given += ["--services", str(tmp_path / "services.toml"), "--mock", str(tmp_path / "mock.toml")]
    runs = tmp_path / "runs"
    assert main(given) == 0
    assert not runs.exists()
    (tmp_path / "file").write_text("")
    assert main([*given, "--journal", str(tmp_path / "file")]) == 2
    for _ in range(4):
        assert main([*given, "--journal", str(runs), "--keep", "2"]) == 0
    assert len(list(runs.glob(f"*/{JOURNAL}"))) == len(list(runs.glob(f"*/{RESULT}"))) == 2
    [oldest, _] = sorted(runs.iterdir())
    assert main(["replay", str(oldest)]) == 0


@pytest.mark.parametrize(("status", "code"), [("success", 0), ("error", 1)])
def test_resume_of_an_ended_run_says_how_it_ended(
    status: str, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A process supervisor restarts `petrobot resume` after every exit: the command says how the
    run ended, and returns 2 if the journal is damaged."""
    golden = Path(__file__).with_name("golden") / "catch_ball-undisturbed.journal"
    run = tmp_path / "run"
    run.mkdir()
    (run / JOURNAL).write_bytes(golden.read_bytes())
    (run / RESULT).write_text(json.dumps({"status": status, "runs": 4}))
    assert main(["resume", str(run), "--json", str(tmp_path / "out.json")]) == code
    assert f"ended already, with status {status}" in capsys.readouterr().err
    assert json.loads((tmp_path / "out.json").read_text()) == {"status": status, "runs": 4}
    (run / JOURNAL).write_bytes(golden.read_bytes()[:100] + b"damaged" + golden.read_bytes()[107:])
    assert main(["resume", str(run)]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_the_end_of_a_run_does_not_depend_on_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk may have become read-only meanwhile: the mission's result must still be told."""

    def unlink(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with published(tmp_path, RunAddress("run", "http://127.0.0.1:1", "token", os.getpid())):
        monkeypatch.setattr(Path, "unlink", unlink)


def test_a_run_that_cannot_have_a_journal_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    opened = os.open

    def open_file(path: Path, flags: int, *mode: int) -> int:
        return full() if flags & os.O_EXCL else opened(path, flags, *mode)

    monkeypatch.setattr(os, "open", open_file)
    with pytest.raises(JournalError, match="No space left on device"):
        JournalWriter(tmp_path / "run" / JOURNAL, {})
    assert not list(tmp_path.iterdir())
