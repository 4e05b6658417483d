"""The simulated controller satisfies a client that we did not write: `ur_rtde`."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from petrobot.sim.bus.ur_controller import DASHBOARD_PORT, PROGRAM_PORT, RTDE_PORT

HERE = Path(__file__).parent
HOST = f"127.77.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
"""An address of this host on which nothing else, such as this test in another run of the suite, has
UR's fixed ports."""
ROOT = HERE.parents[2]


@pytest.mark.processes
@pytest.mark.skipif(
    importlib.util.find_spec("rtde_receive") is None, reason="ur-rtde is not installed"
)
def test_ur_rtde_reads_the_arm_and_speaks_to_the_dashboard() -> None:
    ports = [str(port) for port in (RTDE_PORT, DASHBOARD_PORT, PROGRAM_PORT)]
    serve = [sys.executable, "-m", "petrobot.sim.bus.ur_controller", HOST, *ports]
    with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True, cwd=ROOT) as controller:
        try:
            assert controller.stdout is not None
            assert controller.stdout.readline().startswith("ready")
            done = subprocess.run(
                [sys.executable, str(HERE / "peer.py"), HOST],
                capture_output=True,
                text=True,
                timeout=120,
            )
            assert done.returncode == 0, done.stderr
        finally:
            controller.kill()
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen["q"] == pytest.approx([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
    assert (seen["mode"], seen["safety"], seen["running"]) == (7, 1, False)
    assert seen["time"] > 0.1 and "RUNNING" in seen["robotmode"]
