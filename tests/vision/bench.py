"""A small laboratory for the vision tests: the simulated camera above an analytic rolling ball, and
actions in lock step."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.action import Cancelled, Result, Status, Wait
from petrobot.services.comm.streams.camera import MemoryImages
from petrobot.services.comm.streams.image import Image
from petrobot.services.vision.optics import Optics
from petrobot.sim.catching.camera import PinholeCamera
from petrobot.sim.catching.truth import read_truth
from tests.bare_ports import BarePorts

Array = NDArray[np.float64]
ROOT = Path(__file__).parents[2]
TICK = 0.004
REGIMES = {"A": (0.7, 1.5), "B": (1.5, 2.0), "C": (2.0, 2.5)}


def read_cell() -> dict[str, Any]:
    """The shipped cell."""
    return tomllib.loads((ROOT / "services" / "cell.toml").read_text(encoding="utf-8"))


def nominal_optics(cell: Mapping[str, Any]) -> Optics:
    """Return the camera as designed: `[camera]` of cell.toml."""
    camera = cell["camera"]
    right, down = np.asarray(camera["image_x"], float), np.array([0.0, 0.0, -1.0])
    focal = float(camera["focal_px"])
    k1, k2, p1, p2 = (float(k) for k in camera["distortion"])
    return Optics(
        (focal, focal),
        ((camera["width"] - 1) / 2, (camera["height"] - 1) / 2),
        (k1, k2, p1, p2),
        np.array([right, np.cross(down, right), down]),
        np.asarray(camera["position"], float),
    )


def true_view(cell: Mapping[str, Any], **changes: Any) -> dict[str, Any]:
    """Return the simulated camera's true parameters in the form that PinholeCamera accepts."""
    camera = read_truth(cell, "A").camera
    view = {
        key: getattr(camera, key)
        for key in ("position", "rotation", "focal_px", "principal_px", "distortion")
    }
    return {**view, **changes}


class RolledBall(Struct, frozen=True):
    """A ball that slides, then rolls on a straight line; written from the mechanics, independent of
    services and sim.

    Released at time 0 from `start` towards `aim` (x, y) with `speed`; a hollow ball with spin share
    s settles at (3 + 2 s) / 5.
    """

    start: tuple[float, float]
    aim: tuple[float, float]
    speed: float
    spin: float = 0.85
    rolling: float = 0.0589
    friction: float = 0.20

    @property
    def heading(self) -> Array:
        """Return the unit vector of the motion, shape (2,)."""
        way = np.subtract(self.aim, self.start)
        return np.asarray(way / np.hypot(*way))

    def _phases(self) -> tuple[float, float, float]:
        """Return when sliding ends (s), the path until then (m), and the speed from then on
        (m/s)."""
        settled = self.speed * (3.0 + 2.0 * self.spin) / 5.0
        slide = self.friction * 9.81
        until = (self.speed - settled) / slide
        return until, self.speed * until - 0.5 * slide * until**2, settled

    def way(self, t: float) -> tuple[float, float]:
        """Return path length (m) and speed (m/s) at time t >= 0."""
        until, slid, settled = self._phases()
        if t <= until:
            slide = self.friction * 9.81
            return self.speed * t - 0.5 * slide * t * t, self.speed - slide * t
        rolled = min(t - until, settled / self.rolling)
        return (
            slid + settled * rolled - 0.5 * self.rolling * rolled**2,
            settled - self.rolling * rolled,
        )

    def place(self, t: float) -> Array:
        """(2,) m."""
        return np.asarray(np.asarray(self.start) + self.heading * self.way(t)[0])

    def velocity(self, t: float) -> Array:
        """(2,) m/s."""
        return np.asarray(self.heading * self.way(t)[1])

    def arrival(self, way: float) -> float:
        """Return when it has moved `way` m (s); it must not stop before."""
        until, slid, settled = self._phases()
        under = settled**2 - 2.0 * self.rolling * (way - slid)
        return until + (settled - float(np.sqrt(under))) / self.rolling

    def leaves(self, near_edge: float = 0.62) -> tuple[float, float]:
        """Return time (s) and y (m) at which its centre passes the near edge."""
        way = (near_edge - self.start[0]) / self.heading[0]
        return self.arrival(float(way)), float(self.start[1] + way * self.heading[1])


def draw_ball(rng: np.random.Generator, regime: str = "A") -> RolledBall:
    """Draw a throw of the regime."""
    return RolledBall(
        start=(2.12, float(rng.uniform(-0.3, 0.3))),
        aim=(0.62, float(rng.uniform(-0.3, 0.3))),
        speed=float(rng.uniform(*REGIMES[regime])),
        spin=float(rng.uniform(0.7, 1.0)),
        rolling=0.0589 * float(rng.uniform(0.7, 1.3)),
    )


@dataclass
class CameraBench:
    """The simulated camera over a table with at most one ball, in lock step; `drawn` may add arm
    and cup."""

    camera: PinholeCamera
    ball: RolledBall | None = None
    release: float = 0.5
    latency: float = 0.012
    light: Callable[[float], float] = lambda time: 1.0
    gone_after: float = float("inf")
    """When the ball is removed (s after its release)."""
    dead_from: float = float("inf")
    """When the camera stops sending (s)."""
    arm: tuple[Array, Sequence[float]] | None = None
    cup: Array | None = None
    now: float = 0.0
    images: MemoryImages = field(init=False)
    exposures: int = 0

    def __post_init__(self) -> None:
        self.images = MemoryImages(self._control)
        self._rate = 0.0
        self._due = 0.0
        self._sent: list[Image] = []

    def _control(self, rate: float) -> None:
        self._rate, self._due = rate, self.now + TICK

    def picture(self) -> NDArray[np.uint8]:
        """Return an image of the current world."""
        since = self.now - self.release
        ball = velocity = None
        if self.ball is not None and 0.0 <= since < self.gone_after:
            place, speed = self.ball.place(since), self.ball.velocity(since)
            if place[0] > 0.62 and abs(place[1]) < 0.45:
                ball, velocity = [*place, 0.62], [*speed, 0.0]
        points, radii = self.arm if self.arm else (None, ())
        return self.camera.render(
            ball, velocity or (0, 0, 0), points, radii, self.cup, self.light(self.now)
        )

    def advance(self) -> None:
        """Run one tick."""
        self.now = round(self.now + TICK, 9)
        if self._rate > 0.0 and self.now >= self._due - 1e-9 and self.now < self.dead_from:
            self._sent.append(Image(self.picture(), self.now, self.exposures))
            self.exposures += 1
            self._due += 1.0 / self._rate
        while self._sent and self._sent[0].time + self.latency <= self.now + 1e-9:
            self.images.put(self._sent.pop(0))


class BenchPorts(BarePorts):
    """The ports of the camera's driver on the bench."""

    def __init__(self, bench: CameraBench, files: Mapping[str, bytes] | None = None) -> None:
        self._bench = bench
        self._files = files or {}

    @property
    def now(self) -> float:
        return self._bench.now

    def images(self) -> Any:
        return self._bench.images

    def file(self, path: str) -> bytes:
        return self._files[path]


@dataclass
class BenchContext:
    """The context of one run, driven by `run_action`. `published` holds (time, values); values are
    None where they were withdrawn; `verdicts` (run, status, cause)."""

    bench: CameraBench
    device: Any
    run: str = "1"
    published: list[tuple[float, list[float] | None]] = field(default_factory=list)
    verdicts: list[tuple[str, Status, str]] = field(default_factory=list)

    @property
    def now(self) -> float:
        return self.bench.now

    def wait(self, ready: Callable[[], bool], timeout: float | None = None) -> Wait:
        return Wait(ready, None if timeout is None else self.now + timeout)

    def sleep(self, seconds: float) -> Wait:
        return Wait(lambda: False, self.now + seconds)

    def publish(self, stream: str, values: Sequence[float]) -> None:
        assert stream == "catch_point"
        self.published.append((self.now, [float(v) for v in values]))

    def withdraw(self, stream: str) -> None:
        self.published.append((self.now, None))

    def raise_event(self, name: str, **data: Any) -> None:
        raise AssertionError("vision raises no events")

    def verdict(self, run: str, result: Result) -> None:
        self.verdicts.append((run, result.status, result.cause))

    def progress(self, fraction: float, **data: Any) -> None:
        assert 0.0 <= fraction <= 1.0

    async def call(
        self, service: str, /, deadline: float | None = None, **arguments: Any
    ) -> Result:
        raise AssertionError("vision calls no service")

    async def command(
        self, body: Mapping[str, Any], timeout: float = 1.0, *, until: str = ""
    ) -> Mapping[str, Any]:
        raise NotImplementedError

    async def get_versioned(self, name: str, default: Any = None) -> tuple[Any, int]:
        raise NotImplementedError

    async def get(self, name: str, default: Any = None) -> Any:
        raise AssertionError("vision reads no variables")

    async def put(self, name: str, value: Any) -> int:
        raise AssertionError("vision writes no variables")

    async def compare_and_set(self, name: str, version: int, value: Any) -> bool:
        raise AssertionError("vision writes no variables")

    def random(self, purpose: str) -> Any:
        raise AssertionError("vision draws nothing")


def run_action(
    bench: CameraBench,
    action: Coroutine[Any, Any, Result],
    limit: float = 20.0,
    cancel_at: float = float("inf"),
) -> Result:
    """Run an action's coroutine tick by tick, as the lock-step shell does; cancel it at `cancel_at`
    (s)."""
    begin = bench.now
    try:
        wait = action.send(None)
        while bench.now < begin + limit:
            bench.advance()
            if bench.now >= cancel_at:
                action.throw(Cancelled())
                raise AssertionError("a cancelled run went on")
            if wait.ready() or (wait.due is not None and bench.now >= wait.due - 1e-9):
                wait = action.send(None)
    except StopIteration as done:
        result: Result = done.value
        return result
    action.close()
    raise AssertionError(f"the action is still active after {limit} s")
