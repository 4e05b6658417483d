"""The pick-and-place laboratory as one party: table, parts, trays, camera, and the simulated
hardware of the arm that the location file names."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import cv2
import numpy as np
from msgspec import Struct

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.party import TICK
from petrobot.sim.bus.feetech import STEPS, so101
from petrobot.sim.bus.ur_controller import PORTS, ControllerSession, UrController
from petrobot.sim.catching.truth import LaboratoryError
from petrobot.sim.faults import CAMERA_FAULTS, FaultKinds, FaultPlan
from petrobot.sim.laboratory_party import LaboratoryParty, whole_number
from petrobot.sim.picking.camera import Picture, SceneCamera
from petrobot.sim.picking.gripper import ToolPose
from petrobot.sim.picking.parts import Part
from petrobot.sim.picking.truth import PickingSite, picking_site_of
from petrobot.sim.picking.world import PickingWorld

# --- controllers of the arms ---


class Controller(ABC):
    """An arm with its gripper: its interface to the driver, and to the laboratory."""

    @abstractmethod
    def advance(self, now: float, dt: float) -> None:
        """Let `dt` s pass."""

    @abstractmethod
    def joints(self) -> Sequence[float]:
        """Return the joint angles (rad)."""

    @abstractmethod
    def gap(self) -> float:
        """Return the gap between the fingers by the motor's position (m)."""

    @abstractmethod
    def force(self) -> float:
        """Return the force of the fingers on what stops them (N)."""

    @abstractmethod
    def block(self, gap: float | None) -> None:
        """Let a part stop the fingers at a gap (m); None: no part."""

    def receive(self, now: float, data: bytes) -> bytes:
        """Take bytes of the driver's serial line; return the answer."""
        return b""

    def connect(self, port: int) -> ControllerSession:
        """Accept a connection of the driver. Raises LaboratoryError."""
        raise LaboratoryError("this arm has a serial line, and no TCP port")


class FeetechArm(Controller):
    """Bus servos: the last one turns the gripper's jaw, `gap_per_rad` m for each rad."""

    def __init__(self, numbers: Mapping[str, Any]) -> None:
        """Raises KeyError for a number that is missing."""
        gripper = numbers["gripper"]
        self._lever = float(gripper["gap_per_rad"])
        closed = float(gripper["opening"]) / self._lever
        self.bus = so101([*map(float, numbers["poses"]["rest"]), closed])
        *self._arm, self._jaw = self.bus.servos.values()

    def receive(self, now: float, data: bytes) -> bytes:
        return self.bus.receive(data)

    def advance(self, now: float, dt: float) -> None:
        self.bus.advance(dt)

    def joints(self) -> Sequence[float]:
        return [servo.angle for servo in self._arm]

    def gap(self) -> float:
        return self._jaw.angle * self._lever

    def force(self) -> float:
        """Return the jaw's force (N): the motor's torque over the lever arm."""
        return max(0.0, -self._jaw.torque) / self._lever

    def block(self, gap: float | None) -> None:
        """Stop the jaw at a part; without a part, the fingers meet at 0."""
        angle = max(0.0, gap or 0.0) / self._lever
        self._jaw.low = 2048.0 + angle / (2 * math.pi) * STEPS


class UrArm(Controller):
    """A UR controller, and a gripper on its digital outputs and inputs: output 0 closes it, input 0
    says that it holds something, input 1 that its fingers stand."""

    def __init__(self, numbers: Mapping[str, Any]) -> None:
        """Raises KeyError for a number that is missing."""
        gripper = numbers["gripper"]
        self._opening, self._speed = float(gripper["opening"]), float(gripper["speed"])
        self._force, self._gap = float(gripper["force"]), float(gripper["opening"])
        self.ur = UrController([float(q) for q in numbers["poses"]["rest"]])
        self._stop: float | None = None

    def connect(self, port: int) -> ControllerSession:
        return self.ur.connect(port)

    def advance(self, now: float, dt: float) -> None:
        self.ur.advance(now + dt)
        wish = 0.0 if self.ur.digital_out & 1 else self._opening
        step = self._speed * dt
        before = self._gap
        self._gap += max(-step, min(step, wish - self._gap))
        if self._stop is not None:
            self._gap = max(self._gap, self._stop)
        holds = self._stop is not None and wish < self._gap
        self.ur.digital_in = int(holds) | (self._gap == before) << 1

    def joints(self) -> Sequence[float]:
        return self.ur.q

    def gap(self) -> float:
        return self._gap

    def force(self) -> float:
        """Return the force of the fingers (N) while something stops them."""
        return self._force if self._stop is not None and self.ur.digital_out & 1 else 0.0

    def block(self, gap: float | None) -> None:
        self._stop = gap


CONTROLLERS: Final[Mapping[str, Callable[[Mapping[str, Any]], Controller]]] = {
    "feetech": FeetechArm,
    "ur": UrArm,
}


def controller(numbers: Mapping[str, Any]) -> Controller:
    """Return the controller of an arm's file. Raises LaboratoryError, KeyError."""
    name = str(numbers["controller"])
    if name not in CONTROLLERS:
        raise LaboratoryError(
            f"{numbers['name']}: controller: expected {' or '.join(CONTROLLERS)}, found {name!r}"
        )
    return CONTROLLERS[name](numbers)


# --- referee ---

EXCHANGE: Final = 3.0
"""Time that a person needs to change a full tray (s)."""
_LOOK: Final = 0.02
"""Time between two checks (s)."""
_AWAY: Final = 0.12
"""Distance from a tray's middle at which the fingers are safe for the person's hands (m)."""


class _Delivery(Struct):
    """A part that was put into a tray: when (s), and whether the tray was the right one."""

    time: float
    right: bool


class Referee:
    """Watches the world. It also changes full trays, as a person would: it removes their parts and
    puts an empty tray there."""

    def __init__(
        self,
        world: PickingWorld,
        trays: Mapping[str, Any],
        belongs: Mapping[str, str],
        began: float,
    ) -> None:
        self._world, self._trays, self._belongs, self._began = world, trays, belongs, began
        self._due = began
        self._lies: dict[int, str] = {}
        self._deliveries: list[_Delivery] = []
        self._full_since: dict[str, float] = {}
        self._taken: list[tuple[Part, str]] = []
        self._changed = 0
        self._count = len(world.parts)

    def watch(self, now: float, tool: ToolPose) -> None:
        """Check the trays, and change the full ones."""
        if now < self._due - 1e-9:
            return
        self._due += _LOOK
        for name, tray in self._trays.items():
            inside = [part for part in self._world.parts if self._world.inside(part, tray)]
            for part in inside:
                if self._lies.get(part.number) != name:
                    right = self._belongs[part.kind] == name
                    self._deliveries.append(_Delivery(now, right))
                self._lies[part.number] = name
            for part in self._world.parts:
                if self._lies.get(part.number) == name and part not in inside:
                    del self._lies[part.number]
            self._exchange(now, name, tray, inside, tool)

    def _exchange(
        self, now: float, name: str, tray: Mapping[str, Any], inside: list[Part], tool: ToolPose
    ) -> None:
        x, y = tray["position"]
        away = math.hypot(tool.x - x, tool.y - y) > _AWAY
        if len(inside) < len(tray["slots"]) or not away:
            self._full_since.pop(name, None)
        elif now - self._full_since.setdefault(name, now) >= EXCHANGE:
            self._taken += [(part, name) for part in inside]
            self._world.parts = [part for part in self._world.parts if part not in inside]
            self._changed += 1

    def score(self, now: float, cycles: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Return where the parts are, and verdicts on provisional runs.

        `parts`, `in_tray` (the right one), `wrong_tray`, `on_table`, `lost` (fell off); `grips`,
        `slips`, `drops`, `struck`, `table_hits`: how often they happened; `trays_changed`; `time_s`
        since the beginning; `verdicts`: a part was put into its tray during the cycle, or not.
        """
        where = [
            (part, self._lies.get(part.number, "")) for part in self._world.parts
        ] + self._taken
        ends = Counter(
            "lost"
            if part.lost
            else "on_table"
            if not tray
            else "in_tray"
            if tray == self._belongs[part.kind]
            else "wrong_tray"
            for part, tray in where
        )
        return {
            "parts": self._count,
            **{key: ends[key] for key in ("in_tray", "wrong_tray", "on_table", "lost")},
            **self._world.counts,
            "trays_changed": self._changed,
            "time_s": round(now - self._began, 3),
            "verdicts": {
                run["run"]: verdict
                for cycle in cycles
                for run in cycle.get("provisional", ())
                if (verdict := self._verdict(now, cycle)) is not None
            },
        }

    def _verdict(self, now: float, cycle: Mapping[str, Any]) -> dict[str, str] | None:
        begun, ended = now - float(cycle["begun_ago"]), now - float(cycle["ended_ago"])
        came = [d for d in self._deliveries if begun <= d.time <= ended + _LOOK]
        if any(d.right for d in came):
            return {"status": "success", "cause": "", "text": ""}
        cause = "wrong_tray" if came else "not_in_tray"
        return {"status": "failure", "cause": cause, "text": "the referee saw where the part lies"}


# --- the party ---

REGIME: Final = "plain"
"""The default regime."""
_PARTS, _IMAGE, _WORLD, _FAULTS = 0x7061, 0x696D, 0x776F, 0x6661
"""Names of random streams: they keep draws of the same seed separate."""


class PickingLaboratory(LaboratoryParty):
    """The party of the simulated node `name`. `where` returns the party of an endpoint
    (`Directory.party`)."""

    tcp_ports = PORTS
    fault_kinds = FaultKinds(CAMERA_FAULTS, drives=1)

    def __init__(
        self,
        name: str,
        site: PickingSite,
        where: Callable[[str], str],
        *,
        boot: str = "laboratory",
        directory: str = "",
        judges: bool = True,
    ) -> None:
        """`boot`, `directory`: as in services.comm.calls.callee. `judges`: whether the parts that
        the task handles are the simulated ones."""
        super().__init__(name, where, boot, directory)
        self._judges = judges
        cv2.setNumThreads(1)  # one thread: other nodes share the cores
        self._site = site
        self.arm = site.arm()
        self.controller = controller(site.numbers)
        self._camera = SceneCamera(site.camera(), site.settings["table"]["grey"], site.trays)
        self._radius = float(site.settings["arm"]["radius"])
        self._prepare(0, REGIME, None)

    def _prepare(self, seed: int, regime: str, parts: int | None) -> None:
        """Begin a new experiment: new parts on the table, an empty score. The arm keeps its
        pose."""
        self.truth = self._site.truth(regime)
        drawn = self._site.parts(self.truth, np.random.default_rng((seed, _PARTS)), parts)
        self.world = PickingWorld(
            self._site.table, self._site.fingers, drawn, np.random.default_rng((seed, _WORLD))
        )
        self._image_draws = np.random.default_rng((seed, _IMAGE))
        direction = float(np.random.default_rng((seed, _PARTS, 1)).uniform(-math.pi, math.pi))
        self.light = self.truth.light(direction)
        self.faults = FaultPlan(np.random.default_rng((seed, _FAULTS)))
        self.referee = Referee(self.world, self._site.trays, self._site.belongs, self.now)
        self.controller.block(None)

    # The world, for lock step and real time

    def tick(self, now: float) -> None:
        if not self.faults.none:
            self.faults.begin(now)
        if self.exposures.due(now) and not self.faults.image_lost():
            self.exposures.put(now, now + self._site.readout, self.picture())
        controller = self.controller
        controller.advance(now, TICK)
        tool = self.arm.tool(controller.joints())
        force = self.truth.force * controller.force()
        self.world.move(tool, controller.gap(), force, TICK)
        controller.block(None if self.world.held is None else self.world.gap)
        self.referee.watch(now, tool)
        self.now = now + TICK

    def picture(self) -> Picture:
        """Return the camera's image: grey levels, shape (height, width)."""
        links = self.arm.links(self.controller.joints())
        return self._camera.take(
            self.world.parts, links, self._radius, self.light, self._image_draws
        )

    def take_on_serial(self, now: float, device: str, data: bytes) -> bytes:
        return self.controller.receive(now, data)

    def connect(self, device: str, port: int) -> ControllerSession:
        return self.controller.connect(port)

    # Services

    def score(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return `Referee.score` of the trials in `cycles`; nothing about parts that are real."""
        if not self._judges:
            return {}
        return self.referee.score(self.now, arguments.get("cycles") or [])

    def prepare(self, arguments: Mapping[str, Any]) -> None:
        """Lay out new parts: seed=0, regime="plain", parts=None. Raises ValueError (LaboratoryError
        among them)."""
        self._prepare(
            whole_number(arguments, "seed", 0) or 0,
            str(arguments.get("regime", REGIME)),
            whole_number(arguments, "parts", None),
        )

    def make_ready(self, arguments: Mapping[str, Any]) -> None:
        """Check the regime. Raises LaboratoryError."""
        self._site.truth(str(arguments.get("regime", REGIME)))


def make_laboratory(directory: Directory, name: str) -> PickingLaboratory:
    """Return the laboratory of the simulated node `name` of the location file. Raises
    LaboratoryError."""
    site = picking_site_of(directory)
    try:
        return PickingLaboratory(
            name,
            site,
            directory.party,
            boot=f"{name} in lock step",
            directory=directory.hash,
            judges=any(d.config.get("source") == "sim" for d in directory.devices.values()),
        )
    except KeyError as fault:
        raise LaboratoryError(
            f"{directory.source}: key {fault} is missing in the files of [parameters]; the shipped "
            "files show it"
        ) from fault
