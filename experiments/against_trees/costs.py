"""The costs of each program: lines, start, time per tick, reaction time, and what it catches in the
simulated laboratory, with the same balls for all."""

from __future__ import annotations

import io
import re
import resource
import subprocess
import sys
import time
import tokenize
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, median

from experiments.against_trees import plant
from experiments.against_trees.cell import play
from experiments.against_trees.judge import Report
from experiments.against_trees.missions import Mission, net_mission, program_mission
from experiments.against_trees.results import CELL, PLANT, PROGRAMS, ROOT, Line, Results, Size
from experiments.against_trees.verified import SOURCES, environment, make_of, runner
from petrobot.coordinator.task.file import load as load_task
from petrobot.services.comm.location_file import load

REGIMES = ("A", "C")
BALLS = 4
FIRST_SEED = 500
STARTS = {
    "net": "from petrobot.coordinator.task.file import load; from petrobot.coordinator.engine "
    f"import Engine; import petrobot.coordinator.run.mission; Engine(load('{SOURCES['net']}'))",
    "tree": "from experiments.against_trees.tree import create_root; create_root(None, 4)",
    "machine": "import experiments.against_trees.machine",
}
"""Code that loads and makes each program, without a cell."""
TREE_PERIODS = (1, 5, 25)
"""Ticks of the cell (4 ms) between two ticks of the tree: 250, 50 and 10 Hz."""
LAYOUT = re.compile(r"(x|y|label|text) = ")


def code_lines(path: Path) -> int:
    """Return the lines of a file that hold code: no comment, blank line or docstring. In a task
    file the picture's coordinates and texts do not count either."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".toml":
        lines = (line.strip() for line in text.splitlines())
        return sum(1 for line in lines if line and line[0] != "#" and not LAYOUT.match(line))
    held: set[int] = set()
    before = tokenize.NEWLINE
    blank = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
             tokenize.ENDMARKER)  # fmt: skip
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        alone = token.type == tokenize.STRING and before in (
            tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT
        )  # fmt: skip
        if token.type not in blank and not alone:
            held.update(range(token.start[0], token.end[0] + 1))
        if token.type not in (tokenize.COMMENT, tokenize.NL):
            before = token.type
    return len(held)


def start_seconds(program: str, times: int = 3) -> float:
    """Return the processor time (s) in which a fresh process has loaded and made the program."""
    found = []
    for _ in range(times):
        begun = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [sys.executable, "-c", STARTS[program]], env=environment(), cwd=ROOT, check=True
        )
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        found.append(ended.ru_utime + ended.ru_stime - begun.ru_utime - begun.ru_stime)
    return median(found)


def reactions(entries: Sequence[plant.Entry]) -> list[float]:
    """Return how long after a ball was located the arm began to move (s)."""
    located = [e.t for e in entries if e.action.startswith("locate") and e.what == "success"]
    moved = [e.t for e in entries if e.action.startswith("intercept") and e.what == "begin"]
    return [min(t for t in moved if t >= at) - at for at in located if any(t >= at for t in moved)]


def costs_of(program: str) -> Line:
    """Return lines, start and reactions of a program."""
    line: Line = {
        "program": program,
        "lines": code_lines(SOURCES[program]),
        "start_s": start_seconds(program),
    }
    if program != "tree":
        entries = runner(program, None)(20, 1).entries
        return {**line, "reaction_s": [mean(reactions(entries))]}
    found = []
    for every in TREE_PERIODS:
        plant.ENTRIES.clear()
        play(load(PLANT), make_of("tree", None), balls=20, seed=1, limit=200.0, every=every)
        found.append(mean(reactions(plant.ENTRIES)))
    return {**line, "reaction_s": found}


def in_laboratory(program: str, regime: str, seed: int) -> Line:
    """Run a mission in the simulated laboratory."""
    directory, begun = load(CELL), time.process_time()
    given = {"regime": regime}
    if program == "net":
        task = load_task(SOURCES["net"])
        mission: Mission = net_mission(directory, task, BALLS, seed, given)
    else:
        mission = program_mission(directory, make_of(program, None), BALLS, seed, given)
    if mission.report.crash:
        raise RuntimeError(f"{program}, seed {seed}: {mission.report.crash}")
    report: Report = mission.report
    return {
        "program": program, "regime": regime, "seed": seed, "thrown": mission.score["thrown"],
        "caught": mission.score["caught"], "counted": report.caught, "seconds": mission.seconds,
        "cpu_s": time.process_time() - begun, "tick_us": _tick_us(mission),
    }  # fmt: skip


def _tick_us(mission: Mission) -> float | None:
    return 1e6 * mission.tick_s / mission.ticks if mission.ticks else None


def measure(results: Results, size: Size, workers: int) -> None:
    """Measure costs, then the laboratory."""
    results.measure("costs", costs_of, [(program, (program,)) for program in PROGRAMS], 1)
    jobs = [
        (f"{regime}/{n:03}/{program}", (program, regime, FIRST_SEED + n))
        for n in range(size.laboratory // BALLS)
        for regime in REGIMES
        for program in PROGRAMS
    ]
    results.measure("laboratory", in_laboratory, jobs, workers)
