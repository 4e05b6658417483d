"""Part (a): which design faults are found before running, within a number of trials, or never.

Before running, the net has `petrobot check`. The tree has what its users have: mypy (strict), ruff,
and py_trees itself when the tree is built and set up. The state machine has mypy and ruff.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from experiments.against_trees.cell import Cell, Make
from experiments.against_trees.faults import FAULTS, apply
from experiments.against_trees.judge import violations
from experiments.against_trees.missions import Mission, Run, net_mission, program_mission
from experiments.against_trees.results import CELL, HERE, PLANT, ROOT, TASK, Line, Results, Size
from petrobot.coordinator.analysis.may_run import BUDGET, may_run
from petrobot.coordinator.operator.task_check import cell_of
from petrobot.coordinator.task.file import TaskFileError, loads
from petrobot.coordinator.task.wording import Severity
from petrobot.services.comm.location_file import load

BALLS = 10
"""Balls of a mission: enough for faults that only later balls show."""
FIRST_SEED = 20_000
SOURCES = {"net": TASK, "tree": HERE / "tree.py", "machine": HERE / "machine.py"}
STYLE = "E501,F401,I001,SIM102"
"""Rules of ruff that the transcription itself breaks: long lines, imports that were needed, an `if`
without its `else`."""
CLASSES = {"tree": "TreeProgram", "machine": "MachineProgram"}


def environment() -> dict[str, str]:
    """Return the environment for commands that have to find this folder's modules."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "src")])}


def petrobot(*arguments: str, fine: tuple[int, ...] = (0,)) -> str:
    """Run a petrobot command. Return what it prints. Raises RuntimeError for another exit code."""
    code = "import sys; from petrobot.coordinator.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        env=environment(),
        cwd=ROOT,
        check=False,
    )
    if done.returncode not in fine:
        raise RuntimeError(f"petrobot {' '.join(arguments)}: {done.stderr}{done.stdout}")
    return done.stdout


def source_of(program: str, fault: int | None) -> str | None:
    """Return a program's text with a design fault (None: the correct one); None if the fault is
    impossible in it."""
    text = SOURCES[program].read_text(encoding="utf-8")
    if fault is None:
        return text
    edits = getattr(FAULTS[fault], program)
    return None if edits is None else apply(text, edits)


# --- before running -------------------------------------------------------------------------------


def checked_net(fault: int | None) -> dict[str, str]:
    """Return the objections of `petrobot check` to the net in the real cell: errors and warnings,
    and every verdict that does not hold. (The command also reads the code of the actions, which is
    the same for all faults.)"""
    text = source_of("net", fault)
    assert text is not None
    try:
        judged = may_run(loads(text), cell_of(load(CELL)), BUDGET)
    except TaskFileError as fault_in_file:
        return {str(fault_in_file): "error"}
    levels = {Severity.ERROR: "error", Severity.WARNING: "warning"}
    told = {
        f"{one.key}: {one.text}": levels[one.severity]
        for one in judged.report.findings
        if one.severity in levels
    }
    if judged.analysis is not None:
        refused = judged.analysis.objections
        told |= {f"{name}: {verdict.reason}": "error" for name, verdict in refused.items()}
        told |= {
            f"{name.replace('_', ' ')} does not hold: {verdict.reason}": "warning"
            for name, verdict in judged.analysis.verdicts().items()
            if not verdict.holds and name not in refused
        }
    return told


def before_net(fault: int) -> Line:
    """Return whether `petrobot check` refuses or warns, and its messages."""
    usual = {text.partition(":")[0] for text in checked_net(None)}
    said = checked_net(fault)
    new = {text: level for text, level in said.items() if text.partition(":")[0] not in usual}
    for level, word in (("error", "refused"), ("warning", "warned")):
        by = [text for text, found in new.items() if found == level]
        if by:
            return {"before": word, "by": by[0]}
    return {"before": "no", "by": ""}


def before_programs(program: str) -> dict[int, Line]:
    """Return for each fault the messages of mypy, ruff and (for the tree) py_trees."""
    found: dict[int, Line] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for fault in range(len(FAULTS)):
            text = source_of(program, fault)
            if text is not None:
                (folder / f"fault_{fault:02}.py").write_text(text, encoding="utf-8")
                found[fault] = {"before": "no", "by": ""}
        config = str(ROOT / "pyproject.toml")
        for tool in (
            ["ruff", "check", "--config", config, "--ignore", STYLE, "--output-format", "concise"],
            ["mypy", "--strict", "--config-file", config, "--no-error-summary"],
        ):
            files = sorted(str(path) for path in folder.glob("*.py"))
            done = subprocess.run(
                [sys.executable, "-m", *tool, *files],
                capture_output=True,
                text=True,
                env={**environment(), "MYPYPATH": f"{ROOT / 'src'}:{ROOT}"},
                cwd=ROOT,
                check=False,
            )
            for line in done.stdout.splitlines():
                if "fault_" in line and ": note:" not in line:
                    place, _, said = line.partition("fault_")[2].partition(":")
                    fault = int(place.removesuffix(".py"))
                    found[fault] = {"before": "refused", "by": f"{tool[0]}: {said}"}
    if program == "tree":
        for fault in found:
            if said := _built(fault):
                found[fault] = {"before": "refused", "by": said}
    return found


def _built(fault: int) -> str:
    """Return what py_trees raises when the tree is built and set up; empty if nothing."""
    cell = Cell(load(PLANT), "built", "built", 1)
    try:
        make_of("tree", fault)(cell, BALLS)
    except Exception as said:
        return f"py_trees: {type(said).__name__}: {said}"
    return ""


# --- trials ---------------------------------------------------------------------------------------


def make_of(program: str, fault: int | None) -> Make:
    """Return a function that makes the program with a design fault."""
    text = source_of(program, fault)
    assert text is not None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{program}_{fault}.py"
        path.write_text(text, encoding="utf-8")
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    made: Make = getattr(module, CLASSES[program])
    return made


def runner(program: str, fault: int | None) -> Run:
    """Return a function that runs missions of a program with a design fault. Raises TaskFileError
    for a net that is not a task."""
    directory = load(PLANT)
    if program == "net":
        text = source_of("net", fault)
        assert text is not None
        task = loads(text)
        return lambda balls, seed: net_mission(directory, task, balls, seed)
    make = make_of(program, fault)
    return lambda balls, seed: program_mission(directory, make, balls, seed)


def first_symptom(run: Run, trials: int) -> tuple[int | None, str]:
    """Return the first trial that shows the fault, and how; None if no trial does."""
    for n in range(trials // BALLS):
        mission: Mission = run(BALLS, FIRST_SEED + n)
        wrong = violations(mission.entries, mission.report, BALLS)
        if wrong:
            return (n + 1) * BALLS, wrong[0]
    return None, ""


def measure_one(program: str, fault: int, trials: int, before: dict[str, Any] | None) -> Line:
    """Return how a fault is found in a program. `fault` -1: the correct program."""
    which = None if fault < 0 else fault
    known: Line = {"program": program, "fault": fault, "trials": trials}
    if which is not None and getattr(FAULTS[fault], program) is None:
        return {**known, "before": "cannot be said", "by": "", "trial": None, "symptom": ""}
    if which is not None and program == "net":
        before = before_net(fault)
    try:
        trial, symptom = first_symptom(runner(program, which), trials)
    except TaskFileError as refused:
        trial, symptom = None, str(refused)
    return {**known, **(before or {"before": "no", "by": ""}), "trial": trial, "symptom": symptom}


def measure(results: Results, size: Size, workers: int) -> None:
    """Measure every fault in every program, and the correct programs beside them."""
    jobs: list[tuple[str, tuple[Any, ...]]] = [
        (f"{p}/right", (p, -1, size.trials, None)) for p in SOURCES
    ]
    for program in SOURCES:
        keys = [f"{program}/{fault:02}" for fault in range(len(FAULTS))]
        missing = program != "net" and not all(results.has("verified", key) for key in keys)
        before = before_programs(program) if missing else {}
        jobs += [
            (key, (program, fault, size.trials, before.get(fault)))
            for fault, key in enumerate(keys)
        ]
    results.measure("verified", measure_one, jobs, workers)
