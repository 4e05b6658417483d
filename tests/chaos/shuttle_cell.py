"""The shuttle's cell: its services.toml on free ports, and reading the hands' log."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from tests.ports import free_ports

ROOT = Path(__file__).parents[2]
TASK = Path(__file__).with_name("shuttle.toml")
SERVICES = """
schema = 1
[nodes.left]
host = "127.0.0.1"
port = {0}
[nodes.right]
host = "127.0.0.1"
port = {1}
[coordinator]
host = "127.0.0.1"
port = {2}
[devices.left_hand]
node = "left"
driver = "tests.chaos.hands:Hand"
[devices.right_hand]
node = "right"
driver = "tests.chaos.hands:Hand"
[timers.bell]
node = "left"
period = 0.11
[actions.left_fetch]
run = "tests.chaos.hands:move"
task = "fetch"
device = "left_hand"
orphan_time = {orphan}
args = {{ log = "{log}", hand = "left", seconds = {fetch} }}
[actions.right_carry]
run = "tests.chaos.hands:move"
task = "carry"
device = "right_hand"
orphan_time = {orphan}
args = {{ log = "{log}", hand = "right", seconds = {carry} }}
[actions.right_tidy]
run = "tests.chaos.hands:move"
task = "tidy"
device = "right_hand"
orphan_time = {orphan}
args = {{ log = "{log}", hand = "right", seconds = 0.02 }}
"""


def shuttle_services(
    folder: Path, *, fetch: float = 0.05, carry: float = 0.1, orphan: float = 1.0
) -> Path:
    """Write a services.toml in this folder; the hands log to `moves.txt` beside it. Action times
    and orphan time in seconds."""
    path = folder / "services.toml"
    text = SERVICES.format(
        *free_ports(3), log=folder / "moves.txt", fetch=fetch, carry=carry, orphan=orphan
    )
    path.write_text(text, encoding="utf-8")
    return path


def moves(folder: Path, what: str) -> Counter[str]:
    """Count in the log, by call id, the lines with this word: `begin`, `end` or `overlap`."""
    path = folder / "moves.txt"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return Counter(line.split()[1] for line in lines if line.startswith(what))
