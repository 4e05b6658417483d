"""The supervisor of node processes: they are ready in order, dead ones are restarted after growing
pauses, and none is left running."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import threading
from io import FileIO
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.run import supervisor
from petrobot.coordinator.run.supervisor import LaunchError, Program, Supervisor, older_part
from tests.processes import alive, kill
from tests.waiting import beat, until

pytestmark = pytest.mark.processes
STEADY = "print('ready', flush=True); import signal; signal.pause()"
BRIEF = "print('ready', flush=True)"
STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); " + STEADY
TALKING = """
import os, sys, time
print("ready", flush=True)
for i in range(10**9):
    os.write(1 + i % 2, b"line %d\\n" % i)
    time.sleep(0.001)
"""
FAULTY = "import sys; print('no device at can0', file=sys.stderr); sys.exit(2)"


def program(name: str, source: str, first: bool = False) -> Program:
    """Return a program that runs this Python text."""
    return Program(name, [sys.executable, "-c", source], first)


def deaths(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the log lines about programs that died."""
    return [text for text in caplog.messages if " died: " in text]


async def until_died(caplog: pytest.LogCaptureFixture, count: int) -> None:
    """Wait for so many deaths."""
    async with asyncio.timeout(60.0):
        while len(deaths(caplog)) < count:
            await beat(0.01)


async def test_a_killed_program_is_restarted_and_all_end_with_the_supervisor(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Supervisor([program("a", STEADY), program("b", STEADY)], tmp_path) as keeper:
        before = keeper.process_ids()
        os.kill(before["a"], signal.SIGKILL)
        await until_died(caplog, 1)
        async with asyncio.timeout(60.0):
            while keeper.process_ids().get("a", before["a"]) == before["a"]:
                await beat(0.01)
        assert (keeper.starts("a"), keeper.starts("b")) == (2, 1)
        assert keeper.process_ids()["b"] == before["b"]
        async with asyncio.timeout(60.0):
            while "node a is ready again" not in caplog.messages:
                await beat(0.01)
        assert "node b is ready again" not in caplog.messages
        last = list(keeper.process_ids().values())
    assert not any(map(alive, last))


async def test_a_program_that_keeps_dying_is_restarted_after_growing_pauses(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The pause doubles with each early death, so that a broken node does not use up the host's
    processor."""
    async with Supervisor([program("a", BRIEF)], tmp_path):
        await until_died(caplog, 3)
    pauses = [float(text.rpartition(" in ")[2].removesuffix(" s")) for text in deaths(caplog)[:3]]
    assert pauses == [0.5, 1.0, 2.0]


async def test_without_respawn_no_program_is_restarted_and_the_end_of_all_is_noticed(
    tmp_path: Path,
) -> None:
    """So it is for members of a lock-step cell."""
    async with Supervisor(
        [program("a", BRIEF), program("b", BRIEF)], tmp_path, respawn=False
    ) as keeper:
        async with asyncio.timeout(60.0):
            await keeper.ended()
        assert keeper.process_ids() == {} and keeper.starts("a") == 1


async def test_a_program_that_does_not_start_is_named_with_the_end_of_its_log(
    tmp_path: Path,
) -> None:
    with pytest.raises(
        LaunchError, match=r"node a ended; its log .*a\.log ends with: no device at can0"
    ):
        await Supervisor([program("a", FAULTY), program("b", STEADY)], tmp_path).__aenter__()
    with pytest.raises(LaunchError) as again:
        await Supervisor([program("a", FAULTY)], tmp_path).__aenter__()
    assert str(again.value).count("no device at can0") == 1, (
        "what an earlier start left in the log is not its end"
    )
    killed = program("k", "import os; os.kill(os.getpid(), 9)")
    says = r"node k was ended by a signal \(Killed\); its log .*k\.log says nothing; start it again"
    with pytest.raises(LaunchError, match=says):
        await Supervisor([killed], tmp_path).__aenter__()


async def test_why_a_program_does_not_start_again_stands_in_the_line_that_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Only its log said it: a node whose key became unreadable was started again for ever."""
    (tmp_path / "first").touch()
    once = f"import os; os.path.exists({str(tmp_path / 'first')!r}) or exit('k: no key'); "
    again = program("a", once + STEADY)
    async with Supervisor([again], tmp_path) as keeper:
        (tmp_path / "first").unlink()
        os.kill(keeper.process_ids()["a"], signal.SIGKILL)
        await until_died(caplog, 2)
    killed, ended = deaths(caplog)[:2]
    assert "node a died: it was ended by a signal (Killed); its log " in killed
    assert "node a died: it ended; its log " in ended and "a.log ends with: k: no key; " in ended


async def test_ctrl_c_does_not_reach_the_nodes_before_the_launcher_stops_them(
    tmp_path: Path,
) -> None:
    """Ctrl-C sends SIGINT to the launcher's process group; nodes are not in it, else they would end
    at once and be reported as dead."""
    async with Supervisor([program("a", STEADY)], tmp_path) as keeper:
        assert os.getpgid(keeper.process_ids()["a"]) != os.getpgid(0)


async def test_programs_that_others_need_are_ready_first(tmp_path: Path) -> None:
    """The laboratory's bus must exist before the node that opens it starts."""
    mark = tmp_path / "there"
    first = program("sim", f"open({str(mark)!r}, 'w').close(); " + STEADY, first=True)
    second = program("node", f"import os; assert os.path.exists({str(mark)!r}); " + STEADY)
    async with Supervisor([second, first], tmp_path / "logs") as keeper:
        assert set(keeper.process_ids()) == {"sim", "node"}


async def test_a_program_that_does_not_end_when_asked_is_killed(tmp_path: Path) -> None:
    async with Supervisor([program("a", STUBBORN)], tmp_path) as keeper:
        process = keeper.process_ids()["a"]
    assert not alive(process)


async def test_a_child_process_left_running_does_not_hide_its_parents_death(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its child process keeps its output open, and continues to write."""
    talker = "while echo alive; do sleep 0.05; done"
    leaver = (
        f"import subprocess; print(subprocess.Popen(['sh', '-c', {talker!r}]).pid, "
        f"flush=True); {STEADY}"
    )
    try:
        async with Supervisor([program("a", leaver)], tmp_path) as keeper:
            os.kill(keeper.process_ids()["a"], signal.SIGKILL)
            await until_died(caplog, 1)
            await until(lambda: keeper.starts("a") > 1 and keeper.process_ids(), "another start")
            assert alive(keeper.process_ids()["a"])
    finally:
        lines = (tmp_path / "a.log").read_text().splitlines()
        kill(int(line) for line in lines if line.isdigit())


async def test_a_long_line_does_not_end_the_copying_of_what_a_program_prints(
    tmp_path: Path,
) -> None:
    """If it did, the pipe would fill, and whatever prints later would block for ever."""
    said = "print('x' * (1 << 20), flush=True); " * 2
    async with Supervisor([program("a", f"{said}{STEADY}")], tmp_path):  # until it is ready
        assert (tmp_path / "a.log").stat().st_size > 2 << 20


async def test_a_log_whose_disk_hangs_stops_no_event_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The supervisor of `run --up` shares its loop with the mission. A node is ready all the
    same."""
    answers, hung = threading.Event(), threading.Event()

    class Hung(FileIO):
        def write(self, data: Any, /) -> int:
            if b"ready" in data:
                hung.set()
                assert answers.wait(60.0)
            return super().write(data)

    monkeypatch.setattr(supervisor, "FileIO", Hung)
    async with Supervisor([program("a", TALKING)], tmp_path):
        assert hung.is_set() and not answers.is_set()
        answers.set()
        await until(lambda: b"line " in (tmp_path / "a.log").read_bytes(), "what it wrote then")


@pytest.fixture
def short_logs(monkeypatch: pytest.MonkeyPatch) -> int:
    """Logs are cut at 2 kB, within a few lines; returns that limit (bytes)."""
    monkeypatch.setattr(supervisor, "LARGEST_LOG", 2000)
    monkeypatch.setattr(supervisor, "LOOK_AT_LOG", 0.01)
    return 2000


async def test_the_log_of_a_program_that_runs_for_long_has_a_limit(
    tmp_path: Path, short_logs: int
) -> None:
    log = tmp_path / "a.log"
    async with Supervisor([program("a", TALKING)], tmp_path) as keeper:
        for _ in range(3):
            await until(lambda: log.stat().st_size > short_logs // 2, "a long log")
            await until(lambda: log.stat().st_size < short_logs // 2, "a log that was emptied")
        older = older_part(log).read_text()
        await until(lambda: log.stat().st_size > 100, "further lines")
        assert keeper.starts("a") == 1
    assert older.count("line ") > 0 and "\0" not in older + log.read_text()
    # A part that is being moved at the end of the program is moved to the end.
    await until(lambda: sorted(tmp_path.iterdir()) == [log, older_part(log)], "both parts alone")


async def test_a_log_without_room_for_its_older_part_loses_lines_and_ends_nothing(
    tmp_path: Path, short_logs: int, caplog: pytest.LogCaptureFixture
) -> None:
    log = tmp_path / "a.log"
    older_part(log).mkdir()  # as if the disk was full: it cannot be written
    async with Supervisor([program("a", TALKING)], tmp_path) as keeper:
        await until(lambda: "older lines of the log are lost" in caplog.text, "the warning")
        await until(lambda: log.stat().st_size < short_logs, "a log that was emptied")
        assert keeper.starts("a") == 1


async def test_a_log_that_was_removed_does_not_grow_for_ever(
    tmp_path: Path, short_logs: int
) -> None:
    log = tmp_path / "a.log"
    async with Supervisor([program("a", TALKING)], tmp_path):
        await until(log.exists, "the log")
        with log.open("rb") as removed:
            log.unlink()
            for _ in range(3):
                await until(lambda: os.fstat(removed.fileno()).st_size > 1000, "a long log")
                await until(lambda: os.fstat(removed.fileno()).st_size < 1000, "an emptied one")


@pytest.mark.parametrize("barred", [False, True])
async def test_a_program_is_restarted_although_the_folder_of_its_log_is_gone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, barred: bool
) -> None:
    logs = tmp_path / "logs"
    async with Supervisor([program("a", STEADY)], logs) as keeper:
        (logs / "a.log").unlink()
        logs.rmdir()
        if barred:
            logs.touch()
        os.kill(keeper.process_ids()["a"], signal.SIGKILL)
        await until(lambda: "node a is ready again" in caplog.messages, "another start")
    assert ("has no log until it starts again" in caplog.text) == barred == (not logs.is_dir())


async def test_a_program_that_cannot_be_started_for_a_while_is_tried_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So it is when the host has no room for another process."""

    async def refuse(*_: object, **__: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    async with Supervisor([program("a", STEADY)], tmp_path) as keeper:
        monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse)
        os.kill(keeper.process_ids()["a"], signal.SIGKILL)
        await until(lambda: "node a could not be started" in caplog.text, "a failed start")
        monkeypatch.undo()
        await until(lambda: "node a is ready again" in caplog.messages, "another start")
