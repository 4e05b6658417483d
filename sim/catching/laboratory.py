"""The catching laboratory: world, arm, drives, camera and thrower as one party, which answers on
bus, camera and wire as hardware would.

In each tick it processes what arrived, exposes the camera to the world as it is, and advances the
world. So a set point acts and is answered within the tick in which it arrives. Nothing here uses
wall-clock time: lock step and real time drive it alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.party import TICK
from petrobot.sim.catching.camera import Picture, PinholeCamera
from petrobot.sim.catching.drives import ArmBus
from petrobot.sim.catching.oracle import Oracle
from petrobot.sim.catching.physics import choose, version
from petrobot.sim.catching.puma import ArmPlant
from petrobot.sim.catching.puma_model import Frame3
from petrobot.sim.catching.referee import CatchReferee
from petrobot.sim.catching.side_view import side_view
from petrobot.sim.catching.site import CupMount, Site, laboratory_file, site_of
from petrobot.sim.catching.thrower import Thrower, draw_throw
from petrobot.sim.catching.truth import LaboratoryError, Truth, read_toml
from petrobot.sim.catching.world import BallWorld, SecondBall
from petrobot.sim.faults import BUS_FAULTS, CAMERA_FAULTS, FaultKinds, FaultPlan
from petrobot.sim.laboratory_party import LaboratoryParty, camera_of, whole_number

_NOISE, _FAULTS, _SCATTER, _SECOND = 0x6361, 0x6661, 0x7363, 0x7362
"""Keep the draws of camera noise, of faults, of scatter and of second balls separate from other
draws of the same seed."""
_SECOND_AFTER = 0.6
"""s; a second ball is released up to so long after the first."""


class CatchingLaboratory(LaboratoryParty):
    """The party of the simulated node `name`. `where` returns the party of an endpoint
    (`Directory.party`)."""

    fault_kinds = FaultKinds(
        keys={
            **CAMERA_FAULTS,
            **BUS_FAULTS,
            "slow_arm": ("factor",),
            "arm_power": ("duration",),
        },
        drives=6,
    )

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
        physics: str = "",
    ) -> None:
        """Raises LaboratoryError for an unknown regime or physics. `boot`, `directory`: as in
        services.comm.calls.callee; `physics`: as for `physics.choose`."""
        super().__init__(name, where, boot, directory)
        self._physics = choose(physics)
        self.physics = version(self._physics)
        self._site = site
        truth = site.truth(regime)
        self._mount = CupMount(site.arm, truth)
        cup = site.cell["cup"]
        load = self._mount.load(truth.settings["cup"]["mass"], cup["radius"], cup["depth"])
        self.plant = ArmPlant(
            site.arm,
            site.cell["ball"]["gravity"],
            site.arm.poses["home"].tolist(),
            load=load,
            physics=self._physics,
        )
        self._home: list[float] = site.arm.poses["home"].tolist()
        self.bus = ArmBus(self.plant, site.drives)
        self._world: BallWorld | None = None
        self._read: dict[str, Truth] = {}
        """By regime, the truth that the coming preparation will use."""
        self._prepare(self.now, seed, truth, throws)

    def _prepare(self, now: float, seed: int, truth: Truth, throws: int | None) -> None:
        """Begin a new experiment: no ball, empty score, everything drawn again. The arm stays where
        it is."""
        if self._world is not None:
            self._world.close()
        self.truth = truth
        self._mount = CupMount(self._site.arm, truth)
        self._arm_dt = float(truth.settings["step"]["arm"])
        self._world = self.world = BallWorld(self._site.cell, truth, self._physics)
        self.thrower = Thrower(self._site.cell, truth, seed, throws)
        self.referee = CatchReferee(
            seed, truth.regime, Oracle(self._site.arm, truth, self._site.cell), now
        )
        self.faults = FaultPlan(np.random.default_rng((seed, _FAULTS)))
        self._noise = np.random.default_rng((seed, _NOISE))
        self._scatter = np.random.default_rng((seed, _SCATTER))
        self._seed = seed
        self._second: SecondBall | None = None
        self._stood = self.plant.q
        self._camera: PinholeCamera | None = None
        self.bus.power(True)
        self.bus.slow_down(truth.arm_speed)
        self._moves = -1
        self._cup = self._cup_now()

    # The world, as lock step and real time drive it

    def tick(self, now: float) -> None:
        self._begin_faults(now)
        self._expose(now)
        self._throw(now)
        self._move(now)
        self.now = now + TICK

    # Bus

    def take_on_bus(self, now: float, frames: Sequence[Frame]) -> None:
        self.bus.receive_cycle(now, self._passed(frames))

    def take_frames(self) -> Sequence[Frame]:
        return self._passed(self.bus.drain())

    def _passed(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Return the frames that neither a fault nor the regime loses."""
        share = self.truth.scatter.frames_lost
        if share > 0.0 and frames:
            kept = self._scatter.random(len(frames)) >= share
            frames = [frame for frame, keep in zip(frames, kept, strict=True) if keep]
        return self.faults.passed(frames)

    # Camera

    def _expose(self, now: float) -> None:
        if not self.exposures.due(now) or self.faults.image_lost():
            return
        scatter, readout = self.truth.scatter, self.truth.settings["camera"]["readout"]
        if scatter.images_lost > 0.0 and self._scatter.random() < scatter.images_lost:
            return
        ready, stated = now + readout + self.truth.image_latency, now
        if scatter.image_time_error > 0.0:  # no image claims to come from the future
            error = scatter.image_time_error * float(self._scatter.standard_normal())
            stated += min(max(error, -readout), readout)
        self.exposures.put(stated, ready, self._picture(now))

    def make_ready(self, arguments: Mapping[str, Any]) -> None:
        """Read a regime's truth, and draw the static scene of its camera, which takes seconds.
        Raises LaboratoryError."""
        regime = str(arguments.get("regime", "A"))
        truth = self._read[regime] = self._site.truth(regime)
        camera_of(self._site.cell, truth, self._noise).warm_up()

    def camera(self) -> PinholeCamera:
        """Return the camera as it is mounted in this regime, ready for the next image."""
        if self._camera is None:
            self._camera = camera_of(self._site.cell, self.truth, self._noise)
        # Other laboratories in this process may have used it since.
        self._camera.reseed(self._noise)
        return self._camera

    def _picture(self, now: float) -> Picture:
        ball, cup = self.world.ball, self._cup_now()
        ends, radii = self._solid_parts
        pose = np.zeros((4, 4))
        pose[:3], pose[3, 3] = np.array(cup).T, 1.0
        return self.camera().render(
            None if ball is None else ball.position,
            (0.0, 0.0, 0.0) if ball is None else ball.velocity,
            ends,
            radii,
            pose,
            self.truth.light(now),
            () if self._second is None else self._second.seen(now),
        )

    def side_view(self) -> str:
        """Return the world as it is now, seen from beside the table (SVG), for `petrobot film`."""
        ball, cup = self.world.ball, self._cup_now()
        balls = [] if ball is None else [ball.position]
        return side_view(self._site.cell, self._solid_parts, cup, balls)

    # World

    def _throw(self, now: float) -> None:
        throw = self.thrower.advance(now, self._ready())
        if throw is not None:
            course = self.world.release(now, throw)
            self.referee.enter(course, self.plant.q)
            self._stood = self.plant.q
            self._second = self._throw_second(now, throw.n)

    def _throw_second(self, now: float, n: int) -> SecondBall | None:
        """Return the ball that rolls beside throw `n`, if the regime has one for it."""
        rng = np.random.default_rng((self._seed, n, _SECOND))
        if rng.random() >= self.truth.scatter.second_ball:
            return None
        throw = draw_throw(int(rng.integers(2**32)), n, self._site.cell, self.truth)
        return SecondBall(
            self.world.model, throw, self.truth, now + float(rng.uniform(0.0, _SECOND_AFTER))
        )

    def _ready(self) -> bool:
        """Return whether images are taken, the last ball is gone, the cup is empty, and the arm
        stands still at home."""
        if self.exposures.rate <= 0.0 or self.world.ball is not None or self.world.barrier:
            return False
        rules = self.truth.settings["thrower"]
        still, near = rules["still_speed"], rules["home_tolerance"]
        if max(self.plant.qd) >= still or min(self.plant.qd) <= -still:
            return False
        return all(
            -near < angle - at < near for angle, at in zip(self.plant.q, self._home, strict=True)
        )

    def _move(self, now: float) -> None:
        """Advance the world by a tick: in fine steps while the ball may touch something, else in
        the steps of the arm."""
        world, bus = self.world, self.bus
        if world.ball is not None:
            world.begin(now, self._cup_now)
        fine = world.fine
        dt = world.fine_dt if fine else self._arm_dt
        for step in range(round(TICK / dt)):
            bus.step(now + step * dt, dt)
            if fine and world.fine:
                world.fine_step(now + (step + 1) * dt, self._cup_now())
        if world.ball is not None:
            if world.course is not None and not world.course.answered:
                world.course.answered = self._has_moved()
            world.end(now + TICK, self._cup_now)
        else:
            world.idle(now + TICK)
        bus.ball(world.barrier)

    def _has_moved(self) -> bool:
        """Return whether the arm has left the place where it stood at the last release."""
        near = self.truth.settings["thrower"]["home_tolerance"]
        return self.plant.q is not self._stood and any(
            abs(angle - stood) > near
            for angle, stood in zip(self.plant.q, self._stood, strict=True)
        )

    def _cup_now(self) -> Frame3:
        """Return the cup's frame; the same object as long as the arm does not move."""
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
        if self.faults.none:
            return
        powerless = self.faults.active("arm_power")
        for fault in self.faults.begin(now):
            if fault.kind == "drive_fault":
                self.bus.trip(int(fault.value) - 1)
            elif fault.kind == "slow_arm":
                self.bus.slow_down(fault.value)
        if self.faults.active("arm_power") is not powerless:
            self.bus.power(powerless)

    def prepare(self, arguments: Mapping[str, Any]) -> None:
        """Begin a new experiment: seed=0, regime="A", throws=None. Raises ValueError."""
        seed, throws = whole_number(arguments, "seed", 0), whole_number(arguments, "throws", None)
        regime = str(arguments.get("regime", "A"))
        truth = self._read.pop(regime, None) or self._site.truth(regime)
        self._prepare(self.now, seed or 0, truth, throws)

    def score(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return `CatchReferee.score` of the trials in `cycles`."""
        score = self.referee.score(self.now, arguments.get("cycles", ()))
        return {**score, "physics": self.physics}

    def close(self) -> None:
        self.world.close()
        self.plant.close()


def make_laboratory(directory: Directory, name: str) -> CatchingLaboratory:
    """Return the laboratory of the simulated node `name` of services.toml. Raises
    LaboratoryError."""
    return CatchingLaboratory(
        name,
        site_of(directory),
        directory.party,
        boot=f"{name} in lock step",
        directory=directory.hash,
        physics=_wanted(directory, name),
    )


def physics(directory: Directory, name: str) -> str:
    """Return name and version of the back end of the simulated node `name` of services.toml, for
    records. Raises LaboratoryError."""
    return version(_wanted(directory, name))


def _wanted(directory: Directory, name: str) -> str:
    """Return the back end that services.toml names, else the one that the laboratory file names,
    else the usual one of this computer."""
    given = directory.nodes[name].physics
    where = f"{directory.source}: [nodes.{name}]"
    if not given:
        file = laboratory_file(directory)
        given, where = str(read_toml(file).get("physics", "")), f"{file}:"
    try:
        return choose(given)
    except LaboratoryError as fault:
        raise LaboratoryError(f"{where} {fault}") from fault
