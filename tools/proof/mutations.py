"""Do the tests notice a fault in the program? Put one fault into a copy of the sources, run the
tests that should fail, and name each fault that no test notices.

    python -m tools.proof.mutations                  all of them, one after the other
    python -m tools.proof.mutations journal sim/     those whose name or file contains a text
    python -m tools.proof.mutations --jobs 2         two copies at once

First the chosen tests run once without any fault. The exit code is 1 if a fault survived. The table
in docs/figures-faults.md is the output of the last run.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from msgspec import Struct

ROOT = Path(__file__).parents[2]
COPIED = (
    *("coordinator", "services", "sim", "src", "tests", "tools", "docs", "examples", "experiments"),
    *("pyproject.toml", "services.toml", "README.md", "CHANGELOG.md", "LICENSE"),
    *("Makefile", "constraints.txt"),
)
LIMIT_S = 1800.0
"""Longest run of the tests of one fault (s). Each test has its own limit, so this one says nothing
about the fault: the machine was too busy."""


class Mutation(Struct, frozen=True):
    """One fault: a text that occurs once in a file, what replaces it, and the tests to run."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


def _m(name: str, file: str, old: str, new: str, *tests: str) -> Mutation:
    return Mutation(name, file, old, new, tests)


ENGINE, RUN, COMM = "coordinator/engine/", "coordinator/run/", "services/comm/"
ANALYSIS, LEARNING = "coordinator/analysis/", "coordinator/learning/"
MUTATIONS = (
    # The four that survived before: issue "Faults first".
    _m(
        "the journal is not synced to the disk",
        RUN + "journal.py",
        "os.fdatasync(self._file)",
        "pass",
        "tests/run",
    ),
    _m(
        "results are acknowledged before the journal is synced",
        RUN + "executor.py",
        "        if not self.store.safe:\n            if self",
        "        while then: then.pop()(now)\n        if not self.store.safe:\n            if self",
        "tests/run",
    ),
    _m(
        "tracking has no floor of its gain",
        LEARNING + "rules.py",
        "gain_floor: float = 0.04",
        "gain_floor: float = 0.0",
        "tests/learning",
    ),
    _m(
        "the forecast ignores inhibitor arcs and capacities",
        ANALYSIS + "net/pack.py",
        "        able &= tokens[p] < k\n",
        "        pass\n",
        "tests/studies/forecast",
    ),
    # Engine.
    _m(
        "a bar admits one token too many",
        ENGINE + "firing.py",
        "claims.change.get(p, 0) < k for",
        "claims.change.get(p, 0) <= k for",
        "tests/engine",
    ),
    _m(
        "ended runs are not taken in the order of their ends",
        ENGINE + "firing.py",
        "runs.sort(key=lambda r: r.ended)",
        "runs.sort(key=lambda r: -r.ended)",
        "tests/engine",
    ),
    _m(
        "a timer outlives the tokens of its transition",
        ENGINE + "firing.py",
        "if arcs_satisfied(draft, x) is None:",
        "if False:",
        "tests/engine",
    ),
    _m(
        "a run that never began counts by its preempt arc",
        ENGINE + "runs.py",
        "return None if counts is Counts.NONE or executed is Executed.NO else",
        "return None if counts is Counts.NONE else",
        "tests/engine",
    ),
    _m(
        "a device is free before its cancelled run has stopped",
        ENGINE + "runs.py",
        "for r in (*active, *draft.stopping.values())",
        "for r in active",
        "tests/engine",
    ),
    _m(
        "a pause does not stop timers",
        ENGINE + "step.py",
        "            draft.emit(HoldRun(run.id))\n    hold_timers(draft)\n",
        "            draft.emit(HoldRun(run.id))\n",
        "tests/engine",
    ),
    _m(
        "a condition without a truth value counts as true",
        ENGINE + "firing.py",
        'draft.report_once(Severity.WARNING, "condition", text, x.name)\n        return False',
        'draft.report_once(Severity.WARNING, "condition", text, x.name)\n        return True',
        "tests/engine",
    ),
    # Run.
    _m(
        "what waits for a sync waits for ever",
        RUN + "executor.py",
        "waited = self._unsafe_since is not None and now >= self._unsafe_since + SYNC_WITHIN",
        "waited = False",
        "tests/run",
    ),
    _m(
        "an order leaves after a sync that began before it",
        RUN + "executor.py",
        "[e for e in effects if e not in behind]",
        "effects + self._effects",
        "tests/run",
    ),
    _m(
        "a stop overtakes the start of its run, which waits for the disk",
        RUN + "executor.py",
        "effect.run in runs or self._needs_sync(effect)",
        "self._needs_sync(effect)",
        "tests/run",
    ),
    _m(
        "an order without a device leaves before it is written",
        RUN + "executor.py",
        " or not self.store.flush()",
        "",
        "tests/run",
    ),
    _m(
        "records count as durable while they are being written",
        RUN + "journal.py",
        "self._written += 1",
        "self._written += 0",
        "tests/run",
    ),
    _m(
        "a restarted node's fences last as long as before",
        RUN + "calls.py",
        "min(fence.until, now + STOP_MARGIN)",
        "fence.until",
        "tests/run",
    ),
    _m(
        "a damaged record of the journal is read",
        RUN + "journal.py",
        "return payload if zlib.crc32(payload) == checksum else None",
        "return payload",
        "tests/run",
    ),
    _m(
        "a replay does not compare instructions",
        RUN + "recording.py",
        'if data["instructions"] != digest(instructions):',
        "if False:",
        "tests/run",
    ),
    _m(
        "an override of the operator is ignored",
        RUN + "executor.py",
        "fixed = self.state.overrides.get(choose.of)",
        "fixed = None",
        "tests/run",
        "tests/cli",
        "tests/operator",
    ),
    # Protocol, calls and streams.
    _m(
        "a node executes a call that was meant for its former process",
        COMM + "calls/callee.py",
        "if self._means_another(call):\n            text",
        "if False:\n            text",
        "tests/comm",
    ),
    _m(
        "a node executes again what it may have forgotten",
        COMM + "calls/callee.py",
        "if call.again and not self._results.gone.complete:",
        "if False:",
        "tests/comm",
    ),
    _m(
        "any caller may acknowledge any result",
        COMM + "calls/callee.py",
        "if stored is not None and stored[1] == peer:",
        "if stored is not None:",
        "tests/comm",
    ),
    _m(
        "a sealed frame may be repeated",
        COMM + "protocol/security.py",
        "self._number += 1",
        "pass",
        "tests/comm",
    ),
    _m(
        "an event is delivered twice",
        COMM + "calls/events.py",
        "new = event.number not in seen",
        "new = True",
        "tests/comm",
    ),
    _m(
        "the delay of a set point on its way does not count as age",
        COMM + "streams/stream.py",
        "return offset - self._best",
        "return 0.0",
        "tests/comm",
    ),
    # Node and worker.
    _m(
        "a run starts although its device is stopped",
        "services/node/node.py",
        "            if key in self._stops or missed:",
        "            if missed:",
        "tests/node/test_lockstep.py",
    ),
    _m(
        "a run of a caller that missed an emergency stop starts",
        "services/node/node.py",
        "            if key in self._stops or missed:",
        "            if key in self._stops:",
        "tests/node/test_lockstep.py",
    ),
    _m(
        "compare-and-set writes whatever the version is",
        "services/node/memory.py",
        "if current != version:",
        "if False:",
        "tests/node/test_memory.py",
        "tests/node/test_inline_service.py",
    ),
    _m(
        "an old set point is followed for ever",
        "services/worker/setpoints.py",
        "return self._values if self.age <= self._limit else None",
        "return self._values",
        "tests/node/test_setpoints.py",
        "tests/node/test_lockstep.py",
        "tests/motion/test_arm.py",
    ),
    # Analysis.
    _m(
        "the compiled net forgets capacities",
        "coordinator/task/net.py",
        "if gain > 0 and limit is not None:",
        "if False:",
        "tests/analysis/test_space.py",
        "tests/engine/test_one_firing_rule.py",
    ),
    _m(
        "chance may push a task out of the set that surely recovers",
        ANALYSIS + "net/graph.py",
        "if leaves.any():",
        "if False:",
        "tests/analysis/test_progress.py",
        "tests/analysis/test_qualitative.py",
    ),
    _m(
        "kappa ignores errors during recovery",
        ANALYSIS + "execution/progress.py",
        "allowed[x.source[self._errors & ~reaching[x.target]]] = False",
        "pass",
        "tests/analysis/test_progress.py",
    ),
    _m(
        "a search that stopped early proves that there is no dead end",
        ANALYSIS + "execution/progress.py",
        'if not self.x.complete:\n            return self._unknown("no fault found so far")',
        'if False:\n            return self._unknown("no fault found so far")',
        "tests/analysis/test_progress.py",
    ),
    # Learning.
    _m(
        "the interval of a reliability is too short",
        LEARNING + "statistics.py",
        "+ z * z / (4 * n * n))\n    return (0.0",
        ")\n    return (0.0",
        "tests/learning/test_objective.py",
        "tests/learning/test_estimate.py",
    ),
    _m(
        "runs that never began count as reliable",
        LEARNING + "batch.py",
        "j = 1.0 - self.availability() * self.reliability()",
        "j = 1.0 - self.reliability()",
        "tests/learning/test_selectors.py",
        "tests/learning/test_objective.py",
    ),
    _m(
        "merged estimates forget the distance of their means",
        LEARNING + "statistics.py",
        "m2 = self.m2 + other.m2 + delta * delta * self.n * other.n / n",
        "m2 = self.m2 + other.m2",
        "tests/learning/test_estimate.py",
    ),
    _m(
        "a selector learns from a run without a verdict",
        LEARNING + "selectors.py",
        "not in self.actions or not outcome.judged:",
        "not in self.actions:",
        "tests/learning/test_late_verdicts.py",
        "tests/learning/test_selectors.py",
    ),
    # Simulated world and drivers.
    _m(
        "a drive whose master is lost runs on",
        "sim/bus/power_drive.py",
        "self.trip(DriveFault.HEARTBEAT)",
        "pass",
        "tests/sim/test_bus.py",
        "tests/sim/test_drive_cycle.py",
        "tests/motion/test_drives.py",
    ),
    _m(
        "a ball keeps its speed while it slides",
        "sim/catching/ball.py",
        "lost = self._sliding * t\n",
        "lost = 0.0 * t\n",
        "tests/sim/test_ball.py",
    ),
    _m(
        "an image leaves before it is exposed",
        "sim/laboratory_party.py",
        "self._waiting[count].ready <= until + _ON_TIME",
        "True",
        "tests/sim/test_laboratory.py",
        "tests/sim/test_world.py",
    ),
    _m(
        "a drive may be configured while it has torque",
        "sim/bus/power_drive.py",
        "if index in self.fixed and self.state in POWERED:",
        "if False:",
        "tests/sim/test_bus.py",
        "tests/sim/test_drive_cycle.py",
        "tests/motion/test_drives.py",
    ),
)


def command(tests: Sequence[str]) -> list[str]:
    """Return the command that runs tests in a copy, up to the first failure."""
    plain = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not proof", "--timeout", "120"]
    return [sys.executable, "-m", "pytest", *plain, *tests]


def fails(copy: Path, tests: Sequence[str]) -> str:
    """Run tests in a copy. Return the first test that fails, empty if all pass. Raises
    TimeoutExpired."""
    # A process that a test starts must find the copy, not the checkout that is installed.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(copy / "src"), str(copy)])}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # each process would compile the copy again
    # pytest's folder is beside the copy: tests that start pytest must not find the copy's settings
    given = [*command(tests), "--basetemp", str(copy.parent / "basetemp")]
    done = subprocess.run(
        given, cwd=copy, env=environment, capture_output=True, text=True, timeout=LIMIT_S
    )
    if done.returncode == 0:
        return ""
    lines = (done.stdout + done.stderr).splitlines()
    named = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    return (named or lines[-1:] or ["no output"])[0].split(" - ")[0]


@contextmanager
def scratch() -> Iterator[Path]:
    """Return a copy of the sources in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="mutated-") as folder:
        copy = Path(folder) / "source"
        copy.mkdir()
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                left_out = shutil.ignore_patterns("__pycache__")
                shutil.copytree(source, copy / name, symlinks=True, ignore=left_out)
            elif source.exists():
                shutil.copy2(source, copy / name)
        yield copy


def judged(mutation: Mutation) -> str:
    """Return the first test that notices a fault, empty if none does. Raises ValueError if the
    source has changed."""
    with scratch() as copy:
        file = copy / mutation.file
        text = file.read_text(encoding="utf-8")
        if text.count(mutation.old) != 1:
            raise ValueError(
                f"{mutation.file}: expected once, found {text.count(mutation.old)} "
                f"times: {mutation.old!r}; adapt tools/proof/mutations.py"
            )
        file.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
        return fails(copy, mutation.tests)


def main() -> int:
    """Judge all chosen faults and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", help="texts in the names or files (default: all)")
    parser.add_argument("--jobs", type=int, default=1, help="copies at once (default: 1)")
    parser.add_argument("--trust", action="store_true", help="skip the run without a fault")
    options = parser.parse_args()
    chosen = [
        m
        for m in MUTATIONS
        if not options.words or any(word in m.name or word in m.file for word in options.words)
    ]
    if not chosen:
        parser.error(f"no fault has one of {', '.join(options.words)} in its name or file")
    tests = sorted({test for m in chosen for test in m.tests})
    if not options.trust:
        with scratch() as copy:
            if broken := fails(copy, tests):
                print(f"the tests fail without any fault: {broken}", file=sys.stderr)
                return 2
    printing, survived = threading.Lock(), []

    def judge(mutation: Mutation) -> None:
        by = judged(mutation)
        with printing:
            print(f"| {mutation.name} | `{mutation.file}` | {by or '**survives**'} |", flush=True)
            if not by:
                survived.append(mutation.name)

    print("| fault | file | noticed by |\n|---|---|---|", flush=True)
    with ThreadPoolExecutor(options.jobs) as pool:
        for done in [pool.submit(judge, mutation) for mutation in chosen]:
            done.result()
    print(f"\n{len(chosen)} faults, {len(survived)} survived")
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main())
