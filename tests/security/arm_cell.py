"""The arm's part of the catching cell for tests of the emergency stop: simulated drives on a bus,
the motion node, and a bus listener."""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from petrobot.services.comm.canopen import cia301 as canopen
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.byte_stream import connect
from petrobot.services.comm.canopen.cia402 import (
    RECEIVED,
    SENT,
    DriveCommand,
    DriveState,
    command_of,
    state_of,
)
from petrobot.services.comm.location_file import Directory, parse
from tests.ports import free_ports

ROOT = Path(__file__).parents[2]
DRIVES = range(1, 7)
SLOW = 0.05
"""Share of the arm's speed, for a move of about ten seconds."""

SERVICES = """\
schema = 1
[nodes.laboratory]
host = "127.0.0.1"
port = {laboratory}
sim = "petrobot.sim.catching.laboratory:make_laboratory"
[nodes.motion]
host = "127.0.0.1"
port = {motion}
[devices.arm]
node = "motion"
driver = "petrobot.services.motion.arm:Arm"
interface = "petrobot_stream"
channel = "tcp://127.0.0.1:{bus}"
stream = "catch_point"
stream_period = 0.02
[streams.catch_point]
to = "arm"
period = 0.02
[actions.sweep]
run = "petrobot.services.motion.actions:empty_and_home"
task = "move"
device = "arm"
args = {{ always = true, speed = {speed}, timeout = 100.0 }}
[actions.ready]
run = "petrobot.services.motion.actions:reset_and_home"
task = "make_ready"
device = "arm"
[services.laboratory_prepare]
node = "laboratory"
[services.laboratory_score]
node = "laboratory"
[services.laboratory_fault]
node = "laboratory"
[parameters]
cell = "{cell}"
"""

TASK = """\
schema = 1
[task]
name = "sweeping"
goal = "the arm has swept as often as asked"
final = "sweeps == 0 and arm_free == 1"
final_error = "out_of_order == 1"
runs_place = "sweeps"
[primitive_tasks]
move = { goal = "swept", alternatives = ["sweep"], deadline = 120.0 }
make_ready = { goal = "enabled, at home", alternatives = ["ready"], deadline = 60.0 }
[places]
sweeps = { kind = "control", tokens = 1 }
arm_free = { kind = "resource", tokens = 1, capacity = 1 }
move = { kind = "action" }
make_ready = { kind = "action" }
out_of_order = { kind = "control", capacity = 1 }
[transitions]
start = { in = ["sweeps", "arm_free"], out = ["move"] }
done = { in = ["move:normal"], out = ["arm_free"] }
failed = { in = ["move:error"], out = ["make_ready"] }
recovered = { in = ["make_ready:normal"], out = ["arm_free"] }
given_up = { in = ["make_ready:error"], out = ["out_of_order"] }
"""


def cell_in(folder: Path, speed: float = SLOW) -> Directory:
    """Write the location file with free ports, and the task `sweeping.toml` beside it."""
    laboratory, motion, bus = free_ports(3)
    path = folder / "services.toml"
    text = SERVICES.format(
        laboratory=laboratory,
        motion=motion,
        bus=bus,
        cell=ROOT / "services" / "cell.toml",
        speed=speed,
    )
    path.write_text(text, encoding="utf-8")
    (folder / "sweeping.toml").write_text(TASK, encoding="utf-8")
    return parse(text, path)


class Ear:
    """Listens on the bus in its own thread, and records commands of the master, states of the
    drives, and their times (monotonic s)."""

    def __init__(self, directory: Directory) -> None:
        self._line = connect(directory.devices["arm"].config["channel"])
        self._over = threading.Event()
        self._changed = threading.Condition()
        self._rpdo, self._tpdo = canopen.pdo_struct(RECEIVED), canopen.pdo_struct(SENT)
        self.commands: dict[int, DriveCommand | None] = {}
        """Newest command to each drive."""
        self.states: dict[int, DriveState] = {}
        self.nmt: dict[int, int] = {}
        """NMT state of each node, as its heartbeat shows it."""
        self.positions: dict[int, int] = {}
        """Joint angles (micro-radians)."""
        self.energised = 0
        """How often a drive has reported since `forget` that it has power."""
        self._origin: dict[int, int] = {}
        self.quick_stop_at: float | None = None
        """When a quick stop was first on the bus since `forget`."""
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def forget(self) -> None:
        """Forget past quick stops, and measure motion from the present position."""
        with self._changed:
            self.quick_stop_at, self.energised = None, 0
            self._origin = dict(self.positions)

    def until(self, holds: Callable[[Ear], bool], timeout: float = 60.0) -> None:
        """Wait until the recorded data fulfil a condition. Raises TimeoutError."""
        with self._changed:
            if not self._changed.wait_for(lambda: holds(self), timeout):
                raise TimeoutError(
                    f"commands {self.commands}, states {self.states}, NMT {self.nmt}"
                )

    def moving(self) -> bool:
        """Return whether the drives are enabled and have moved by 0.02 rad since `forget`."""
        far = [
            abs(self.positions[n] - self._origin.get(n, self.positions[n])) > 20_000
            for n in self.positions
        ]
        return self.all_in(DriveState.OPERATION_ENABLED) and any(far)

    def all_in(self, state: DriveState) -> bool:
        """Return whether all drives are in this state."""
        return [self.states.get(n) for n in DRIVES] == [state] * len(DRIVES)

    def stopped_by_nmt(self) -> bool:
        """Return whether each drive says that NMT has stopped it."""
        return [self.nmt.get(n) for n in DRIVES] == [canopen.NmtState.STOPPED] * len(DRIVES)

    def close(self) -> None:
        """Leave the bus."""
        self._over.set()
        self._thread.join()
        self._line.close()

    def _listen(self) -> None:
        while not self._over.is_set():
            if self._line.pending:
                self._line.flush()
            if not select.select([self._line.sock], [], [], 0.1)[0]:
                continue
            try:
                frames = self._line.read()
            except ConnectionError:
                return
            now = time.monotonic()
            with self._changed:
                for word, _, data in frames:
                    self._take(now, Frame(word, data))
                self._changed.notify_all()

    def _take(self, now: float, frame: Frame) -> None:
        node = frame.id & 0x7F
        base = frame.id - node
        if base == canopen.RPDO1_BASE and node in DRIVES:
            word, _ = self._rpdo.unpack(frame.data)
            self.commands[node] = command_of(word)
            if self.commands[node] is DriveCommand.QUICK_STOP and self.quick_stop_at is None:
                self.quick_stop_at = now
        elif base == canopen.TPDO1_BASE and node in DRIVES:
            status, self.positions[node], _ = self._tpdo.unpack(frame.data)
            self.states[node] = state_of(status)
            self.energised += self.states[node] in (
                DriveState.SWITCHED_ON,
                DriveState.OPERATION_ENABLED,
            )
        elif base == canopen.HEARTBEAT_BASE and frame.data:
            self.nmt[node] = frame.data[0]


@contextmanager
def ear_on(directory: Directory) -> Iterator[Ear]:
    """Return a listener on the cell's bus."""
    ear = Ear(directory)
    try:
        yield ear
    finally:
        ear.close()
