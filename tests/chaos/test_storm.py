"""Seeded chaos in real time: every mission run ends with a reason, nothing is executed twice,
nothing is left behind."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.chaos.shuttle_cell import ROOT
from tests.chaos.storm import LEAST_EVENTS, LEAST_MISSIONS, LONGEST

pytestmark = [pytest.mark.processes, pytest.mark.long, pytest.mark.timeout(1500)]
SHORT, LONG = 20.0, 600.0
NAMESPACE = ("unshare", "--user", "--map-root-user", "--net")


def storm(folder: Path, seed: int, seconds: float, *, lo: bool = False) -> dict[str, Any]:
    """Run a storm (tests/chaos/storm.py) and return its result; in a separate network namespace if
    the loopback is taken down."""
    command = [sys.executable, "-m", "tests.chaos.storm", str(seed), str(seconds), str(folder)]
    command = [*NAMESPACE, *command, "--lo"] if lo else command
    done = subprocess.run(
        command,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=seconds + 3 * LONGEST,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    told: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    print(told)
    return told


def judge(told: dict[str, Any]) -> None:
    """Check everything that must hold under any faults."""
    assert told["faults"] == []
    assert told["missions"] >= LEAST_MISSIONS and sum(told["weather"].values()) >= LEAST_EVENTS, (
        "hardly a storm"
    )
    assert set(told["ends"]) <= {"success", "error"}
    assert told["twice"] == [], "an action was executed twice"
    assert told["overlaps"] == [], "two performers for one hand"
    assert told["executed"] <= told["calls"]
    assert told["processes"] == [] and told["sockets"] == {}, "something was left behind"
    leased = sum(
        times for cause, times in told["causes"].items() if cause.startswith("device_leased")
    )
    # A coordinator that disappears without a message keeps its devices for 2 s. Its successor asks
    # ten times a second.
    unheard = told["killed"] + sum(
        told["weather"].get(kind, 0) for kind in ("cut", "delay", "freeze_node")
    )
    assert leased <= 20 * unheard, "coordinators that have left keep devices from those that come"


def namespace_permitted() -> bool:
    """Return whether this user may create a network namespace and configure its loopback."""
    if not shutil.which("unshare") or not shutil.which("ip"):
        return False
    tried = subprocess.run(
        [*NAMESPACE, "ip", "link", "set", "lo", "up"], capture_output=True, check=False
    )
    return tried.returncode == 0


needs_namespace = pytest.mark.skipif(
    not namespace_permitted(),
    reason="no network namespace here: needs unshare and ip, and user namespaces permitted",
)


def test_a_short_storm(tmp_path: Path) -> None:
    judge(storm(tmp_path, 1, SHORT))


@needs_namespace
@pytest.mark.proof
def test_a_storm_that_takes_the_loopback_down(tmp_path: Path) -> None:
    told = storm(tmp_path, 2, 3 * SHORT, lo=True)
    judge(told)
    assert told["weather"]["lo_down"] >= 1


@pytest.mark.proof
def test_ten_minutes_of_storm(tmp_path: Path) -> None:
    lo = namespace_permitted()
    told = storm(tmp_path, 3, LONG, lo=lo)
    judge(told)
    assert told["missions"] >= 50 and told["resumed"] >= 10 and told["calls"] >= 500
