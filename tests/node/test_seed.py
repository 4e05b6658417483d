"""The mission's seed reaches devices that no action uses."""

from __future__ import annotations

from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from tests.ports import free_ports

BELL = """
from pathlib import Path
from petrobot import Driver, success

class Bell(Driver):
    period = 0.02
    steps = 0

    def step(self, now):
        self.steps += 1
        drawn = self.ports.random("ring").random()
        with Path("drawn").open("a") as file:
            print(drawn, file=file)
        if self.steps % 50 == 0:
            self.ports.raise_event("bell")

async def nod(ctx):
    return success()
"""
CELL = """schema = 1
[nodes.hall]
host = "127.0.0.1"
port = {}
[nodes.door]
host = "127.0.0.1"
port = {}
[devices.bell]
node = "door"
driver = "a_bell:Bell"
[actions.nod]
node = "hall"
run = "a_bell:nod"
"""
TASK = """schema = 1
[task]
name = "answer"
goal = "The bell was answered"
final = "over == 1"
[primitive_tasks]
nod = { goal = "Nodded", alternatives = ["nod"], deadline = 5.0 }
[events.bell]
scope = "external"
mean_wait = 1.0
[places]
waiting = { tokens = 1 }
ready = {}
nod = { kind = "action", task = "nod" }
over = {}
[transitions]
rings = { in = ["waiting"], out = ["ready"], event = "bell" }
rings_again = { in = ["ready"], out = ["nod"], event = "bell" }
done = { in = ["nod:normal"], out = ["over"] }
failed = { in = ["nod:error"], out = ["over"] }
"""


@pytest.mark.processes
@pytest.mark.parametrize("mode", [["--mode", "lockstep"], ["--up"]])
def test_a_device_without_actions_draws_by_the_seed(
    mode: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_bell.py").write_text(BELL)
    (tmp_path / "services.toml").write_text(CELL.format(*free_ports(2)))
    (tmp_path / "answer.toml").write_text(TASK)
    drawn = {}
    for name, seed in (("one", "3"), ("again", "3"), ("another", "4")):
        run = ["run", "answer.toml", *mode, "--seed", seed, "--quiet", "--no-page"]
        assert main(run) == 0
        drawn[name] = set((tmp_path / "drawn").read_text().split())
        (tmp_path / "drawn").unlink()
    assert len(drawn["one"] & drawn["again"]) > 20
    # In real time the device steps before the mission run begins, with seed 0.
    assert len(drawn["another"] - drawn["one"]) > 20
    if mode != ["--up"]:
        assert drawn["one"] == drawn["again"] and not drawn["one"] & drawn["another"]
