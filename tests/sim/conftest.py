"""Fixtures: a laboratory on the bench with a small CANopen master, written for these tests, and a
catcher that knows where each ball will be."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import (
    DataType,
    NmtCommand,
    map_pdo,
    nmt,
    sdo_write_request,
)
from petrobot.services.comm.canopen.cia402 import (
    RECEIVED,
    SENT,
    ObjectIndex,
    OperationMode,
    from_units,
    to_units,
)
from petrobot.sim.catching.laboratory import CatchingLaboratory
from petrobot.sim.catching.physics import BULLET, PORTABLE
from petrobot.sim.catching.puma_model import PumaModel
from petrobot.sim.catching.site import Site, read_site
from tests.sim.laboratory_bench import LaboratoryBench

REPOSITORY = Path(__file__).parents[2]
PARTIES = {"arm": "motion", "camera": "vision"}
CELL_FILE = REPOSITORY / "services" / "cell.toml"


needs_bullet = pytest.mark.skipif(
    find_spec("pybullet") is None, reason="PyBullet is not installed: the portable back end alone"
)


@pytest.fixture(
    scope="session", params=[pytest.param(BULLET, marks=needs_bullet), pytest.param(PORTABLE)]
)
def physics(request: pytest.FixtureRequest) -> str:
    """Each back end of the mechanics; both pass the same tests."""
    name: str = request.param
    return name


@pytest.fixture(scope="session")
def site() -> Site:
    """The shipped site."""
    return read_site(CELL_FILE)


@pytest.fixture(scope="session")
def arm(site: Site) -> PumaModel:
    """The shipped arm."""
    return site.arm


class Master:
    """Configures six drives over SDO, enables them, and moves them along straight joint paths at
    nearly the joint limits."""

    def __init__(self, model: PumaModel, pose: Sequence[float], share: float = 0.9) -> None:
        self._speed, self._acceleration = share * model.speed, share * model.acceleration
        self.target = np.array(pose, dtype=float)
        self.position = np.array(pose, dtype=float)
        self.status = [0] * 6
        self.inputs = 0
        self.emergencies: list[bytes] = []
        self._path: Callable[[float], np.ndarray[Any, Any]] | None = None
        self._began = 0.0
        self._ends = 0.0
        self._setup = self._setup_frames()
        self._word = 0
        self._heard = 0

    def heard(self) -> int:
        """Return the number of answers of drives so far."""
        return self._heard

    @staticmethod
    def _setup_frames() -> list[list[Frame]]:
        groups = [[nmt(NmtCommand.ENTER_PREOPERATIONAL)]]
        for node in range(1, 7):
            transfers = map_pdo(
                ObjectIndex.RPDO1, ObjectIndex.RPDO1_MAPPING, 0x200 + node, 1, RECEIVED
            )
            transfers += map_pdo(
                ObjectIndex.TPDO1, ObjectIndex.TPDO1_MAPPING, 0x180 + node, 1, SENT
            )
            writes = [(t.index, t.sub, t.type.pack(t.value or 0)) for t in transfers]
            writes.append(
                (
                    ObjectIndex.MODE,
                    0,
                    DataType.INTEGER8.pack(OperationMode.CYCLIC_SYNCHRONOUS_POSITION),
                )
            )
            groups.append([sdo_write_request(node, *write) for write in writes])
        u32, u16 = DataType.UNSIGNED32.pack, DataType.UNSIGNED16.pack
        inputs = [
            sdo_write_request(7, 0x1800, 1, u32(0x187)),
            sdo_write_request(7, 0x1800, 5, u16(100)),
        ]
        return [*groups, inputs, [nmt(NmtCommand.START)]]

    def frames(self, now: float) -> list[Frame]:
        """Frames of this tick."""
        if self._setup:
            return self._setup.pop(0)
        if self._path is not None:
            self.target = self._path(now - self._began)
        if all(word & 0x08 for word in self.status):
            self._word = (
                0x00 if self._word == 0x80 else 0x80
            )  # A rising edge of the bit resets a fault.
        else:
            self._word = {0x00: 0x06, 0x80: 0x06, 0x06: 0x07}.get(self._word, 0x0F)
        pack = RECEIVED[0].type.pack, RECEIVED[1].type.pack
        frames = [
            Frame(0x200 + node, pack[0](self._word) + pack[1](to_units(self.target[node - 1])))
            for node in range(1, 7)
        ]
        return [*frames, Frame(0x080, b"")]

    def take(self, frames: Sequence[Frame]) -> None:
        """Frames of drives and inputs."""
        for frame in frames:
            node = frame.id - 0x180
            if 1 <= node <= 6:
                self._heard += 1
                self.status[node - 1] = DataType.UNSIGNED16.unpack(frame.data[:2])
                self.position[node - 1] = from_units(DataType.INTEGER32.unpack(frame.data[2:6]))
            elif node == 7:
                self.inputs = frame.data[0]
            elif 0x81 <= frame.id <= 0x87:
                self.emergencies.append(frame.data)

    @property
    def enabled(self) -> bool:
        """Return whether all drives are in OPERATION ENABLED."""
        return all(word & 0x6F == 0x27 for word in self.status)

    def move(self, now: float, goal: Sequence[float]) -> float:
        """Plan a motion from the current target to `goal`; return its duration (s)."""
        begin, way = self.target.copy(), np.array(goal, dtype=float) - self.target
        size = np.abs(way).clip(1e-9)
        speed, acceleration = (
            float((self._speed / size).min()),
            float((self._acceleration / size).min()),
        )
        ramp = min(speed / acceleration, 1.0 / math.sqrt(acceleration))
        duration = 1.0 / (acceleration * ramp) + ramp

        def path(t: float) -> np.ndarray[Any, Any]:
            t = min(max(t, 0.0), duration)
            if t < ramp:
                share = 0.5 * acceleration * t * t
            elif t > duration - ramp:
                share = 1.0 - 0.5 * acceleration * (duration - t) ** 2
            else:
                share = acceleration * ramp * (t - 0.5 * ramp)
            return np.asarray(begin + share * way)

        self._path, self._began, self._ends = path, now, now + duration
        return duration

    def arrived(self, now: float) -> bool:
        """Return whether the path has ended."""
        return now >= self._ends


class CatchingBench(LaboratoryBench):
    """The catching cell's laboratory and its master."""

    def __init__(self, site: Site, **options: Any) -> None:
        self.lab = CatchingLaboratory(
            "laboratory", site, lambda name: PARTIES.get(name, name), **options
        )
        self.home: list[float] = site.arm.poses["home"].tolist()
        self.master = Master(site.arm, self.home)
        super().__init__(self.lab, self.master, "arm")

    def move(self, goal: Sequence[float]) -> None:
        """Move the arm and wait until it has arrived."""
        self.wait(self.master.move(self.now, goal) + 0.1)

    def catch_one(self) -> dict[str, Any]:
        """Run one whole cycle of a catcher that knows the oracle's catching pose; return the
        throw's row."""
        lab = self.lab
        count = len(lab.referee.score(self.now)["throws"])
        assert self.run(lambda: lab.world.course is not None, 3.0)
        course, verdict = lab.world.course, lab.referee.last
        assert course is not None and verdict is not None
        if verdict.pose is not None:
            self.master.move(self.now, verdict.pose.tolist())
        self.run(lambda: lab.world.barrier or lab.world.course is None, 8.0)
        turned = [
            *self.master.target[:5].tolist(),
            self.master.target[5] + math.copysign(math.pi, -self.master.target[5]),
        ]
        self.move(turned)
        assert self.run(lambda: lab.world.course is None, 3.0), course
        self.move(self.home)
        row: dict[str, Any] = lab.referee.score(self.now)["throws"][count]
        return row


@pytest.fixture
def bench(site: Site, physics: str) -> Iterator[Callable[..., CatchingBench]]:
    """Return a function that makes benches; options as for Laboratory."""
    made: list[CatchingBench] = []

    def make(**options: Any) -> CatchingBench:
        made.append(CatchingBench(site, **{"physics": physics, **options}))
        return made[-1]

    yield make
    for one in made:
        one.lab.close()


@pytest.fixture
def cell_master(site: Site) -> Callable[[], Master]:
    """Return a function that makes masters for the shipped arm at home."""
    return lambda: Master(site.arm, site.arm.poses["home"].tolist())


def run_digests(seed: int, regime: str, physics: str, prepared_before: bool = False) -> list[str]:
    """Return digests of the score, of all images and of the arm's end position after a throw."""
    made = CatchingBench(
        read_site(CELL_FILE),
        seed=77 if prepared_before else seed,
        regime="A" if prepared_before else regime,
        physics=physics,
    )
    made.call("laboratory_prepare", seed=seed, regime=regime)
    made.enable()
    made.want_images(5.0)
    rows = [made.catch_one()]
    pixels = hashlib.sha256()
    for arrived, body in made.images:
        pixels.update(repr((arrived, body["age"], body["sequence"])).encode())
        pixels.update(body["pixels"].tobytes())
    made.lab.close()
    told = (
        json.dumps(made.lab.referee.score(made.now))
        + json.dumps(rows)
        + repr(made.master.position.tolist())
    )
    return [hashlib.sha256(told.encode()).hexdigest(), pixels.hexdigest()]


@pytest.fixture
def digests() -> Callable[..., list[str]]:
    """`run_digests`."""
    return run_digests


if __name__ == "__main__":  # a new process for comparison
    print("\n".join(run_digests(int(sys.argv[1]), sys.argv[2], sys.argv[3])))
