"""The laboratory: world, arm, drives, camera and thrower as one party, which answers on bus, camera and wire as hardware would.

At a tick it takes what came, shows the camera the world as it is, and moves the world on by a tick; so a set point acts and
is answered within the tick in which it arrives. Nothing here knows wall-clock time: lock step and real time drive it alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from services.comm.callee import Callee, Offer
from services.comm.canbus import Frame
from services.comm.channels import can_body, image_body, read_can, read_images_wanted
from services.comm.directory import Directory
from services.comm.messages import Call, Executed, Outcome
from services.comm.party import TICK, Envelope
from sim.camera import Picture, PinholeCamera
from sim.drives import DriveBus
from sim.exposures import Exposures, camera_of
from sim.faults import Fault, FaultPlan, read_fault
from sim.oracle import Oracle
from sim.puma import ArmPlant
from sim.puma_model import Frame3
from sim.referee import Referee
from sim.site import CupMount, Site, site_of
from sim.thrower import Thrower
from sim.truth import LaboratoryError, Truth
from sim.world import World

PREPARE, SCORE, FAULT = SERVICES = ("laboratory_prepare", "laboratory_score", "laboratory_fault")
_NOISE, _FAULTS = 0x6361, 0x6661
"""Keep the draws of camera noise and of faults apart from other draws of the same seed."""


class Laboratory:
    """The party of the simulated node `name`. `where` gives the party of an endpoint (`Directory.party`)."""

    def __init__(
        self,
        name: str,
        site: Site,
        where: Callable[[str], str],
        *,
        seed: int = 0,
        regime: str = "A",
        throws: int | None = None,
        boot: str = "laboratory",
        directory: str = "",
    ) -> None:
        """Raises LaboratoryError for a regime that means nothing. `boot`, `directory`: as in services.comm.callee."""
        self.name = name
        self._site = site
        self._where = where
        self.now = 0.0
        """How far the world has gone (s)."""
        offers = {service: Offer(inline=lambda _, call: self.answer(call)) for service in SERVICES}
        self.callee = Callee(name, boot, offers, directory=directory)
        truth = site.truth(regime)
        self._mount = CupMount(site.arm, truth)
        cup = site.cell["cup"]
        load = self._mount.load(truth.settings["cup"]["mass"], cup["radius"], cup["depth"])
        self.plant = ArmPlant(site.arm, site.cell["ball"]["gravity"], site.arm.poses["home"].tolist(), load=load)
        self._home: list[float] = site.arm.poses["home"].tolist()
        self.bus = DriveBus(self.plant, site.drives)
        self.exposures = Exposures()
        self._camera_at: dict[str, str] = {}
        self._bus_ports: list[str] = []
        self._out: list[Envelope] = []
        self._world: World | None = None
        self._prepare(self.now, seed, truth, throws)

    def _prepare(self, now: float, seed: int, truth: Truth, throws: int | None) -> None:
        """A new experiment: ball gone, score empty, everything drawn anew. The arm stays where it is."""
        if self._world is not None:
            self._world.close()
        self.truth = truth
        self._mount = CupMount(self._site.arm, truth)
        self._world = self.world = World(self._site.cell, truth)
        self.thrower = Thrower(self._site.cell, truth, seed, throws)
        self.referee = Referee(seed, truth.regime, Oracle(self._site.arm, truth, self._site.cell), now)
        self._faults = FaultPlan(np.random.default_rng((seed, _FAULTS)))
        self._noise = np.random.default_rng((seed, _NOISE))
        self.bus.power(True)
        self.bus.slow_down(truth.arm_speed)
        self._moves = -1
        self._cup = self._cup_now()

    # The party

    def receive(self, now: float, envelope: Envelope) -> None:
        """Frames, wishes for images, and calls."""
        if envelope.channel == "can":
            self.receive_frames(now, envelope.source, read_can(envelope.body))
        elif envelope.channel == "control":
            wanted = read_images_wanted(envelope.body)
            if wanted is not None:
                self._camera_at = {envelope.source: self._where(envelope.source)}
                self.exposures.want(now, wanted.rate, wanted.generation)
        elif envelope.channel == "call":
            self.callee.receive(now, self._where(envelope.source), envelope.body)

    def advance(self, now: float) -> None:
        """One tick, then what leaves."""
        self.tick(now)
        self._send_frames()
        self._send_images(now)
        self.callee.advance(now)
        for peer, message in self.callee.messages():
            self._out.append(Envelope(peer, self.name, peer, "call", message))

    def drain(self) -> Sequence[Envelope]:
        """What was sent since the last call, in order."""
        out, self._out = self._out, []
        return out

    # What lock step and real time share

    def tick(self, now: float) -> None:
        """Exposure of the world as it is at `now`, then on to `now` + TICK."""
        self._begin_faults(now)
        self._expose(now)
        self._throw(now)
        self._move(now)
        self.now = now + TICK

    # Bus

    def receive_frames(self, now: float, port: str, frames: Sequence[Frame]) -> None:
        """Frames of the endpoint `port`, which from now on gets the bus's."""
        if port not in self._bus_ports:
            self._bus_ports.append(port)
        receive = self.bus.receive
        for frame in self._faults.passed(frames):
            receive(now, frame)

    def take_frames(self) -> Sequence[Frame]:
        """Frames of drives and inputs since the last call."""
        return self._faults.passed(self.bus.drain())

    def _send_frames(self) -> None:
        if not self._bus_ports:
            return
        frames = self.take_frames()
        if frames:
            for port in self._bus_ports:
                self._out.append(Envelope(self._where(port), self.name, port, "can", can_body(frames)))

    # Camera

    def _expose(self, now: float) -> None:
        if not self.exposures.due(now) or self._faults.image_lost():
            return
        ready = now + self.truth.settings["camera"]["readout"] + self.truth.image_latency
        self.exposures.put(now, ready, self._picture(now))

    def draw_scene(self, regime: str) -> None:
        """Draw the still scene of a regime's camera ahead of its first image. Raises LaboratoryError."""
        camera_of(self._site.cell, self._site.truth(regime), self._noise).warm_up()

    def camera(self) -> PinholeCamera:
        """The camera as it hangs in this regime, ready for the next image."""
        return camera_of(self._site.cell, self.truth, self._noise)

    def _picture(self, now: float) -> Picture:
        ball, cup = self.world.ball, self._cup_now()
        ends, radii = self._solid_parts
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cup.rotation(), cup.origin
        return self.camera().render(
            None if ball is None else ball.position,
            (0.0, 0.0, 0.0) if ball is None else ball.velocity,
            ends,
            radii,
            pose,
            self.truth.light(now),
        )

    def _send_images(self, now: float) -> None:
        """An image arrives a tick after it is sent: it is sent a tick early, with the age that it has on arrival."""
        arrival = now + TICK
        for image in self.exposures.take(arrival):
            body = image_body(image.pixels, arrival - image.time, image.sequence, image.generation)
            for device, party in self._camera_at.items():
                self._out.append(Envelope(party, self.name, device, "image", body))

    # World

    def _throw(self, now: float) -> None:
        throw = self.thrower.advance(now, self._ready())
        if throw is not None:
            course = self.world.release(now, throw)
            self.referee.enter(course, self.plant.q)

    def _ready(self) -> bool:
        """Images are taken, the last ball is gone, the cup is empty, the arm stands still at home."""
        if self.exposures.rate <= 0.0 or self.world.ball is not None or self.world.barrier:
            return False
        rules = self.truth.settings["thrower"]
        still, near = rules["still_speed"], rules["home_tolerance"]
        if max(self.plant.qd) >= still or min(self.plant.qd) <= -still:
            return False
        return all(-near < angle - at < near for angle, at in zip(self.plant.q, self._home, strict=True))

    def _move(self, now: float) -> None:
        """The world goes on by a tick, the arm in steps of 1 ms, the ball as finely as it needs."""
        world, bus = self.world, self.bus
        dt = world.fine_dt
        steps = round(TICK / dt)
        if world.ball is None:
            for step in range(steps):
                bus.step(now + step * dt, dt)
            world.idle(now + TICK)
            bus.ball(world.barrier)
            return
        world.begin(now, self._cup_now)
        for step in range(1, steps + 1):
            bus.step(now + (step - 1) * dt, dt)
            if world.fine:
                world.fine_step(now + step * dt, self._cup_now())
        world.end(now + TICK, self._cup_now)
        bus.ball(world.barrier)

    def _cup_now(self) -> Frame3:
        """The cup's frame; the same object as long as the arm does not move."""
        if self.plant.moves != self._moves:
            self._moves = self.plant.moves
            self._cup = self._mount.frame(self.plant.q)
            self._parts: tuple[Any, Any] | None = None
        return self._cup

    @property
    def _solid_parts(self) -> tuple[Any, Any]:
        if self._parts is None:
            self._parts = self._mount.solid_parts(self.plant.q)
        return self._parts

    # Faults and services

    def _begin_faults(self, now: float) -> None:
        if self._faults.none:
            return
        powerless = self._faults.active("arm_power")
        for fault in self._faults.begin(now):
            self._strike(fault)
        if self._faults.active("arm_power") is not powerless:
            self.bus.power(powerless)

    def _strike(self, fault: Fault) -> None:
        if fault.kind == "drive_fault":
            self.bus.trip(int(fault.value) - 1)
        elif fault.kind == "slow_arm":
            self.bus.slow_down(fault.value)

    def answer(self, call: Call) -> Outcome:
        """Answer a call of one of `SERVICES`."""
        try:
            values = self.serve(call.service, call.arguments)
        except (LaboratoryError, ValueError) as fault:
            return Outcome(call.id, "error", {}, "bad_arguments", str(fault), Executed.NO)
        return Outcome(call.id, "success", values)

    def serve(self, service: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Answer one of `SERVICES`. Raises ValueError (LaboratoryError among them) for arguments that cannot be.

        laboratory_prepare(seed=0, regime="A", throws=None): a new experiment, gives nothing; other parameters of the task
        are not the laboratory's business; laboratory_score(cycles=[]): see sim.referee;
        laboratory_fault(kind, after=0, ...): see sim.faults.
        """
        if service == SCORE:
            return self.referee.score(self.now, arguments.get("cycles", ()))
        if service == FAULT:
            rest = {key: value for key, value in arguments.items() if key != "kind"}
            self._faults.add(read_fault(self.now, str(arguments.get("kind", "")), rest))
            return {}
        seed, regime, throws = arguments.get("seed", 0), arguments.get("regime", "A"), arguments.get("throws")
        if type(seed) is not int or seed < 0:
            raise ValueError(f"seed is {seed!r}: give a whole number, 0 or more")
        if throws is not None and (type(throws) is not int or throws < 0):
            raise ValueError(f"throws is {throws!r}: give a whole number, 0 or more, or leave it out")
        self._prepare(self.now, seed, self._site.truth(str(regime)), throws)
        return {}

    def close(self) -> None:
        """End the physics clients."""
        self.world.close()
        self.plant.close()


def make_laboratory(directory: Directory, name: str) -> Laboratory:
    """The laboratory of the simulated node `name` of services.toml. Raises LaboratoryError."""
    boot = f"{name} in lock step"
    return Laboratory(name, site_of(directory), directory.party, boot=boot, directory=directory.hash)
