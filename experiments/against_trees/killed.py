"""Part (d): kill -9 of the coordinating process at random moments, with real processes.

The nodes continue. The net is continued by `petrobot resume`; the tree starts again from its
beginning, as py_trees stores nothing, or with what its author wrote to a file after each ball. The
plant's own log, synced before each action continues, is the referee.

`python -m experiments.against_trees.killed LOCATION_FILE [KEPT]` is the process of a tree.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from py_trees.decorators import Repeat

from experiments.against_trees.cell import Cell, play_in_real_time
from experiments.against_trees.faults import Edit, apply
from experiments.against_trees.judge import step_of
from experiments.against_trees.plant import ACTIONS
from experiments.against_trees.results import PLANT, ROOT, TASK, Line, Results, Size, keyed
from experiments.against_trees.tree import TreeProgram
from experiments.against_trees.verified import environment
from petrobot.services.comm.location_file import load
from tests.ports import free_ports

PROGRAMS = ("net", "tree", "tree and file")
BALLS = 3
SLOW = 4.0
"""Factor of the plant's times, compared with lock step."""
SPAN = 6.0
"""The kill comes within this time after the first action (s); about the length of the mission."""
PATIENCE = 240.0
"""Limit of every wait on a busy host (s)."""
ONCE = ("locate", "track", "move", "home")
"""Steps that every ball needs once if nothing fails (a ball caught early needs no wait)."""
ERROR_ON_RESUME = ("intercept_tilted", "follow_and_wait")
"""As in services.toml: the ball has passed when a coordinator resumes."""


# --- the tree's process ---------------------------------------------------------------------------


class KeptTree(TreeProgram):
    """A tree whose author writes to a file how many balls are done."""

    def __init__(self, cell: Cell, balls: int, path: Path) -> None:
        done = json.loads(path.read_text(encoding="utf-8")) if path.exists() else 0
        super().__init__(cell, balls - done)
        self.path, self.done = path, done
        self.left = balls - done
        self.over = self.left == 0

    def tick(self) -> None:
        """Tick the tree, and store how many balls are done."""
        super().tick()
        root = self.tree.root
        assert isinstance(root, Repeat)
        if root.success > 0 and self.done < BALLS - self.left + root.success:
            self.done = BALLS - self.left + root.success
            new = self.path.with_suffix(".new")
            new.write_text(json.dumps(self.done), encoding="utf-8")
            new.replace(self.path)


async def run_tree(services: Path, kept: Path | None) -> None:
    """Run the tree to its end."""
    boot = secrets.token_hex(4)

    def make(cell: Cell, balls: int) -> TreeProgram:
        return TreeProgram(cell, balls) if kept is None else KeptTree(cell, balls, kept)

    program = await play_in_real_time(load(services), make, balls=BALLS, boot=boot)
    if program.gave_up:
        raise SystemExit(1)


# --- one kill -------------------------------------------------------------------------------------


def _write_cell(folder: Path) -> Path:
    """Write the location file of a plant without faults that logs to a file."""
    vision, motion = free_ports(2)
    log = json.dumps(str(folder / "plant.log"))
    edits = [Edit("7331", str(vision)), Edit("7332", str(motion))]
    edits += [
        Edit(f'name = "{name}"', f'name = "{name}"\nlog = {log}', f"devices.{name}")
        for name in ("camera", "arm")
    ]
    for action in ACTIONS:
        more = '\non_resume = "error"' if action in ERROR_ON_RESUME else ""
        more += "\norphan_time = 15.0" if action == "empty_and_home" else ""
        new = f'"{action}", slow = {SLOW}, faults = 0.0 }}{more}'
        edits.append(Edit(f'"{action}" }}', new, f"actions.{action}"))
    path = folder / "plant.toml"
    path.write_text(apply(PLANT.read_text(encoding="utf-8"), tuple(edits)), encoding="utf-8")
    return path


def _wait(until: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE
    while not until():
        if time.monotonic() > end:
            raise TimeoutError(f"{what} took more than {PATIENCE:.0f} s")
        time.sleep(0.02)


def _answers(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1.0).close()
    except OSError:
        return False
    return True


def _start(command: Sequence[str], folder: Path) -> subprocess.Popen[bytes]:
    with (folder / "output.log").open("ab") as out:
        return subprocess.Popen(
            [sys.executable, *command], cwd=ROOT, env=environment(), stdout=out, stderr=out
        )


@contextmanager
def _nodes(services: Path, folder: Path) -> Iterator[None]:
    directory = load(services)
    running = [
        _start(["-m", "petrobot.services", name, "--services", str(services)], folder)
        for name in directory.nodes
    ]
    try:
        for node in directory.nodes:
            port = directory.address(node)[1]
            _wait(lambda port=port: _answers(port), f"the start of {node}")  # type: ignore[misc]
        yield
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait(PATIENCE)


def _commands(program: str, services: Path, folder: Path) -> tuple[list[str], list[str]]:
    """Return the command that begins, and the one that continues."""
    if program != "net":
        kept = [str(folder / "kept.json")] if program == "tree and file" else []
        own = ["-m", "experiments.against_trees.killed", str(services), *kept]
        return own, own
    cli = ["-c", "import sys; from petrobot.coordinator.cli import main; sys.exit(main())"]
    begin = [
        *cli, "run", str(TASK), "--services", str(services), "--runs", str(BALLS), "--no-page",
        "--quiet", "--journal", str(folder / "runs"),
    ]  # fmt: skip
    return begin, [*cli, "resume", "--no-page", "--quiet"]


def measure_one(program: str, number: int, folder: str) -> Line:
    """Kill a mission once (number 0: not at all). Return the referee's findings.

    `twice`: steps begun more than once for a ball; `never`: steps that no run completed. `seconds`
    from the first entry of the log to the last; `down` from the kill to the next run.
    """
    here = Path(folder)
    here.mkdir(parents=True, exist_ok=True)
    for old in (here / "plant.log", here / "kept.json"):
        old.unlink(missing_ok=True)
    services = _write_cell(here)
    log = here / "plant.log"
    begin, again = _commands(program, services, here)
    delay = float(np.random.default_rng([number, PROGRAMS.index(program)]).uniform(0.0, SPAN))
    killed, at = False, 0.0
    with _nodes(services, here):
        first = _start(begin, here)
        _wait(lambda: log.exists() or first.poll() is not None, "the first action")
        if number:
            time.sleep(delay)
            killed, at = first.poll() is None, time.time()
            first.send_signal(signal.SIGKILL)
            first.wait(PATIENCE)
        code = first.wait(PATIENCE)
        if killed:
            if program == "net":
                [run] = [one for one in (here / "runs").iterdir() if one.name != "logs"]
                again = [*again[:3], str(run), *again[3:]]
            code = _start(again, here).wait(PATIENCE)
    entries = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    begun = Counter(step_of(one[2]) for one in entries if one[4] == "begin")
    cups = {one[3] for one in entries if one[4] == "caught"}
    ended = Counter(
        step_of(one[2])
        for one in entries
        if one[4] in ("success", "failure") or (one[4] == "cut" and one[3] in cups)
    )
    after = [one[0] for one in entries if one[0] > at and one[4] == "begin"]
    return {
        "program": program, "number": number, "killed": killed, "delay": delay, "code": code,
        "twice": sum(max(0, begun[step] - BALLS) for step in ONCE),
        "never": sum(max(0, BALLS - ended[step]) for step in ONCE),
        "seconds": entries[-1][0] - entries[0][0],
        "down": after[0] - at if killed and after else None,
    }  # fmt: skip


def measure(results: Results, size: Size, workers: int) -> None:
    """Kill each program so many times. One at a time, since times are measured."""
    jobs = [
        (key, (program, number, str(results.folder / "killed" / key.replace(" ", "-"))))
        for key, program, number in sorted(
            keyed(PROGRAMS, range(size.kills + 1)), key=lambda job: job[2]
        )
    ]  # the programs take turns, so that results are comparable whenever the measurement is stopped
    results.measure("killed", measure_one, jobs, 1)


if __name__ == "__main__":
    files = [Path(name) for name in sys.argv[1:]]
    asyncio.run(run_tree(files[0], files[1] if len(files) > 1 else None))
