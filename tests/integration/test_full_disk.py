"""A disk that becomes full, or a journal that is taken away, during a run: one clear error, no
effect without a record, and a resume that ends the run. And a terminal that takes no output."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import termios
import time
from pathlib import Path
from subprocess import DEVNULL

import pytest

from petrobot.coordinator.run.folder import JOURNAL
from petrobot.coordinator.run.journal import read_journal
from tests.chaos.shuttle_cell import ROOT, TASK, moves, shuttle_services
from tests.integration.test_resume_processes import (
    NEVER_BEGUN,
    PATIENCE,
    QUIET,
    ends_of,
    nodes,
    petrobot,
)

pytestmark = pytest.mark.processes
RUNS = 8
ROOM = 6
"""Limit of each file of the coordinator (kB; ulimit -f, setrlimit(2)). The journal's header alone
has four."""


def test_a_full_disk_ends_the_run_with_a_clear_error_and_loses_nothing(tmp_path: Path) -> None:
    shuttle_services(tmp_path, fetch=0.2, carry=0.2, orphan=60.0)
    runs = tmp_path / "runs"
    given = [
        "run",
        str(TASK),
        "--runs",
        str(RUNS),
        "--services",
        str(tmp_path / "services.toml"),
        "--journal",
        str(runs),
    ]
    # -B: before 3.12.8, Python leaves half of a module's bytecode behind on a full disk
    command = shlex.join([sys.executable, "-B", "-m", "petrobot.coordinator", *given, *QUIET])
    up = nodes(tmp_path)
    try:
        full = ["bash", "-c", f"ulimit -f {ROOM}; exec {command}"]
        done = subprocess.run(
            full, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        assert done.returncode == 1, done.stdout + done.stderr
        assert f"{JOURNAL}: File too large; nothing was sent on the strength of it" in done.stderr
        assert "Traceback" not in done.stderr
        [run] = runs.iterdir()
        assert f"`petrobot resume {run}` continues this run" in done.stderr
        kept = [
            r.data["stimulus"] for r in read_journal(run / JOURNAL).records if r.kind == "stimulus"
        ]
        assert kept, "it was full in the middle of the run"
        resumed = petrobot(
            tmp_path, "resume", str(run), "--json", str(tmp_path / "out.json"), *QUIET
        )
        assert resumed.wait(PATIENCE) == 0, (tmp_path / "resume.txt").read_text()
    finally:
        up.terminate()
        up.wait(PATIENCE)
    assert json.loads((tmp_path / "out.json").read_text())["status"] == "success"
    begun = moves(tmp_path, "begin")
    assert set(begun.values()) == {1} and not moves(tmp_path, "overlap")
    ends, made = ends_of(tmp_path), {call.rpartition("/")[2] for call in begun}
    assert len(ends) == RUNS, "no token lost or doubled"
    for call, end in ends.items():
        # the bell may ring between a run's start and its first step: then the run is reported as
        # not begun
        assert call in made or (end.status, end.executed) in NEVER_BEGUN, end


def test_a_run_whose_journal_is_taken_away_ends_and_resumes_when_it_is_back(tmp_path: Path) -> None:
    shuttle_services(tmp_path, fetch=0.2, carry=0.2, orphan=60.0)
    runs = tmp_path / "runs"
    given = ["--services", str(tmp_path / "services.toml"), "--journal", str(runs), *QUIET]
    command = [sys.executable, "-m", "petrobot.coordinator", "run", str(TASK), "--runs", "24"]
    up = nodes(tmp_path)
    try:
        with subprocess.Popen(
            [*command, *given], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as run:
            until = time.monotonic() + PATIENCE
            while not moves(tmp_path, "end") and time.monotonic() < until:
                time.sleep(0.02)
            [folder] = runs.iterdir()
            (folder / JOURNAL).rename(tmp_path / JOURNAL)
            try:
                _, said = run.communicate(timeout=PATIENCE)
            finally:
                run.kill()
        assert run.returncode == 1, said
        assert f"{JOURNAL}: removed, moved or replaced while its run was active" in said
        assert "Traceback" not in said
        assert not (folder / "result.json").exists()
        (tmp_path / JOURNAL).rename(folder / JOURNAL)
        resumed = petrobot(
            tmp_path, "resume", str(folder), "--json", str(tmp_path / "out.json"), *QUIET
        )
        assert resumed.wait(PATIENCE) == 0, (tmp_path / "resume.txt").read_text()
    finally:
        up.terminate()
        up.wait(PATIENCE)
    assert json.loads((tmp_path / "out.json").read_text())["status"] == "success"
    assert set(moves(tmp_path, "begin").values()) == {1} and not moves(tmp_path, "overlap")


def test_a_stopped_terminal_does_not_stop_the_mission(tmp_path: Path) -> None:
    """Ctrl-S: each write to the terminal waits until Ctrl-Q."""
    shuttle_services(tmp_path, fetch=0.2, carry=0.2, orphan=60.0)
    given = ["run", str(TASK), "--runs", str(RUNS), "--services", str(tmp_path / "services.toml")]
    command = [sys.executable, "-m", "petrobot.coordinator", *given, "--journal", "runs"]
    reader, terminal = os.openpty()
    termios.tcflow(terminal, termios.TCOOFF)
    up = nodes(tmp_path)
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.Popen(command, cwd=tmp_path, env=env, stdout=DEVNULL, stderr=terminal)
    try:
        assert run.wait(PATIENCE) == 0
    finally:
        run.kill()
        up.terminate()
        up.wait(PATIENCE)
        os.close(reader)
        os.close(terminal)
    assert len(ends_of(tmp_path)) == RUNS
