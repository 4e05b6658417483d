"""The pick-and-place laboratory as one party: table, parts, trays, camera, and the simulated
hardware of the arm that the location file names."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import cv2
import numpy as np

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.party import TICK
from petrobot.sim.bus.ur_controller import PORTS, ControllerSession
from petrobot.sim.catching.truth import LaboratoryError
from petrobot.sim.faults import CAMERA_FAULTS, FaultKinds, FaultPlan
from petrobot.sim.laboratory_party import LaboratoryParty, whole_number
from petrobot.sim.picking.camera import Picture, SceneCamera
from petrobot.sim.picking.controllers import controller
from petrobot.sim.picking.referee import Referee
from petrobot.sim.picking.truth import PickingSite, picking_site_of
from petrobot.sim.picking.world import PickingWorld

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
    ) -> None:
        """`boot`, `directory`: as in services.comm.calls.callee."""
        super().__init__(name, where, boot, directory)
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
        """Return `Referee.score` of the trials in `cycles`."""
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
    boot = f"{name} in lock step"
    site = picking_site_of(directory)
    try:
        return PickingLaboratory(name, site, directory.party, boot=boot, directory=directory.hash)
    except KeyError as fault:
        raise LaboratoryError(
            f"{directory.source}: key {fault} is missing in the files of [parameters]; the shipped "
            "files show it"
        ) from fault
