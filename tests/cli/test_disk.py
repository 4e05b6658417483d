"""Every command that writes files, on a full and on a read-only disk: one line with fault, file and
remedy, exit code 2, and no empty or half-written file."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.run.folder import RESULT
from tests.cli.test_new import on_free_port

pytestmark = pytest.mark.processes
ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "run" / "golden" / "catch_ball-undisturbed.journal"
SIMULATED = "run carrier/carrier.toml --mode lockstep --runs 1 --quiet"
COMMANDS = {
    "keys": "cell.key",
    "keys --tls": "keys",
    "new task mine": "mine.toml",
    "show catch_ball --out net.svg": "net.svg",
    "convert catch_ball net.pnml": "net.pnml",
    "check carrier/carrier.toml --json found.json": "found.json",
    "log run.journal --out log.jsonl": "log.jsonl",
    "report run.journal --out page.html": "page.html",
    "resume ended --json out.json": "out.json",
    "up --services carrier/services.toml": "runs",
    "serve --up --services carrier/services.toml": "runs",
    "campaign carrier/carrier.toml --runs 2 --workers 1 --quiet": "campaigns/carrier",
    f"{SIMULATED} --journal runs": "run.journal",
    f"{SIMULATED} --learn learned.db": "learned.db",
    f"{SIMULATED} --report page": "page/result.json",
    f"{SIMULATED} --json out.json": "out.json",
}
"""Command lines, each with the file that the message must name."""
DISKS = {
    "full": "dd if=/dev/zero of=fill bs=4k 2>/dev/null",
    "read-only": "cd /; mount -o remount,ro {disk}; cd {disk}",
}
LIMIT = 300.0


def _mounts() -> bool:
    """Return whether this machine lets us mount a disk in a namespace."""
    asked = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"]
    try:
        return (
            subprocess.run(asked, capture_output=True, timeout=LIMIT, check=False).returncode == 0
        )
    except OSError:
        return False


def _outcomes(steps: list[str], commands: list[str]) -> list[dict[str, Any]]:
    """Run commands on a disk that these steps make, and return what each printed and left."""
    told = shlex.quote(json.dumps([shlex.split(command) for command in commands]))
    run = f"exec {sys.executable} -B -m tests.cli.on_this_disk {told}"
    given = ["unshare", "-rm", "bash", "-c", " && ".join([*steps, run])]
    done = subprocess.run(
        given,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin:/usr/sbin:/sbin"},
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2_000:]
    found: list[dict[str, Any]] = json.loads(done.stdout.splitlines()[-1])
    return found


def _carrier(folder: Path) -> Path:
    """Return the folder of a new robot, on a port that no other test uses."""
    assert main(["new", "robot", "carrier", "--folder", str(folder)]) == 0
    on_free_port(folder / "carrier")
    return folder / "carrier"


@pytest.mark.parametrize("disk", DISKS)
def test_a_disk_that_cannot_be_written_is_reported_in_one_line(
    disk: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    if not _mounts():
        pytest.skip("this machine gives nobody a mount namespace of his own (unshare -rm)")
    result = shlex.quote(json.dumps({"status": "success"}))
    steps = [
        f"mount -t tmpfs -o size=96k none {tmp_path}",
        f"cd {tmp_path}",
        "mkdir ended",
        f"cp {GOLDEN} run.journal",
        "cp run.journal ended/",
        f"echo {result} > ended/{RESULT}",
        f"cp -r {_carrier(tmp_path_factory.mktemp('robot'))} .",
        DISKS[disk].format(disk=tmp_path) + " || true",
    ]
    found = _outcomes(steps, list(COMMANDS))
    for (command, name), outcome in zip(COMMANDS.items(), found, strict=True):
        said, where = outcome["said"].splitlines(), f"{disk}: petrobot {command}: {outcome}"
        told = [line for line in said if line.startswith(f"petrobot {command.split()[0]}: ")]
        assert "Traceback" not in outcome["said"], where
        assert outcome["code"] == 2 and len(told) == 1 and said[-1] == told[0], where
        assert name in told[0] and "; " in told[0], where
        remedy = told[0].partition("; give ")[2].split()
        assert not remedy or remedy[0] in (*command.split(), "--file", "--out", "--folder"), where
        assert "copy" not in told[0], where
        assert any(
            word in told[0] for word in ("No space left", "Read-only", "is full", "unable to open")
        ), where
        assert [path for path in outcome["left"] if not path.endswith(".log")] == [], where


@pytest.mark.parametrize("room", [12, 24, 64])
def test_estimates_without_room_after_a_run_name_the_resume_that_gives_its_result(
    room: int, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The journal has room, the estimates file has not: SQLite then fails in several ways."""
    if not _mounts():
        pytest.skip("this machine gives nobody a mount namespace of his own (unshare -rm)")
    steps = [
        f"mount -t tmpfs -o size=400k none {tmp_path}",
        f"cd {tmp_path}",
        f"cp -r {_carrier(tmp_path_factory.mktemp('robot'))} .",
        "cd carrier",
        f"(cat /dev/zero > fill 2>/dev/null || true); truncate -s -{room}K fill",
    ]
    command = "run carrier.toml --mode lockstep --journal runs --learn e.db --quiet"
    [outcome] = _outcomes(steps, [command])
    assert outcome["code"] == 2 and "Traceback" not in outcome["said"], outcome
    [said] = outcome["said"].splitlines()
    assert said.startswith("petrobot run: e.db: "), outcome
    assert "give --learn a file that can be written" in said, outcome
    assert "; the run has ended: `petrobot resume runs/" in said, outcome
