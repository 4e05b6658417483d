"""The laboratory of the mobile robot: floor, rover, drives, sensor and camera as one party, which
answers as hardware would.

The world advances only when something is due: a slot of the rover, a frame, an image. A tick in
between costs almost nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.party import TICK
from petrobot.sim.catching.truth import LaboratoryError
from petrobot.sim.faults import BUS_FAULTS, CAMERA_FAULTS, FaultKinds, FaultPlan
from petrobot.sim.laboratory_party import LaboratoryParty, whole_number
from petrobot.sim.track.camera import Motion, RoverCamera
from petrobot.sim.track.course import FloorPose, Track
from petrobot.sim.track.drives import Echo, ReflectorSensor, RoverBus, look
from petrobot.sim.track.floor import Floor, Picture
from petrobot.sim.track.referee import TrackReferee
from petrobot.sim.track.rover import RoverBody
from petrobot.sim.track.truth import LightTruth, RoverTruth, TrackSite, TrackTruth, track_site_of

# Light over the floor: a slow drift, and the flashes of spectators' cameras.


class Light(NamedTuple):
    """Light on the floor: a factor on the nominal light, and stray light in the lens (grey
    levels)."""

    level: float
    veil: float


class TrackLight:
    """The hall's light from `began` (s) on, for moments in ascending order. Flashes come at random
    (Poisson), drawn by `rng`."""

    def __init__(self, truth: LightTruth, rng: np.random.Generator, began: float) -> None:
        self._truth = truth
        self._rng = rng
        self._began = began
        self._phase = float(rng.uniform(0.0, 2.0 * math.pi))
        self._flash = began, began
        self._next_flash(began)

    def at(self, now: float) -> Light:
        """Return the light at a moment (s)."""
        truth = self._truth
        angle = 2.0 * math.pi * (now - self._began) / truth.period + self._phase
        level = truth.level * (1.0 + truth.drift * math.sin(angle))
        while now >= self._flash[1]:
            self._next_flash(self._flash[1])
        if now >= self._flash[0]:
            return Light(level * truth.flash_gain, truth.flash_veil)
        return Light(level, 0.0)

    def _next_flash(self, after: float) -> None:
        if self._truth.flash_rate <= 0.0:
            self._flash = math.inf, math.inf
            return
        start = after + float(self._rng.exponential(1.0 / self._truth.flash_rate))
        self._flash = start, start + float(self._rng.uniform(*self._truth.flash_duration))


REGIME: Final = "straight"
"""The default regime."""
_SLIP, _LIGHT, _IMAGE, _ECHO, _FAULTS, _FALLEN = 0x736C, 0x6C69, 0x696D, 0x6563, 0x6661, 0x6672
"""Keep draws of the same seed separate."""


class TrackLaboratory(LaboratoryParty):
    """The party of the simulated node `name`. `where` returns the party of an endpoint
    (`Directory.party`)."""

    fault_kinds = FaultKinds(
        keys={
            **CAMERA_FAULTS,
            **BUS_FAULTS,
            "dead_sensor": ("duration",),
            "power": ("duration",),
        },
        drives=2,
    )

    def __init__(
        self,
        name: str,
        site: TrackSite,
        where: Callable[[str], str],
        *,
        seed: int = 0,
        regime: str = REGIME,
        boot: str = "laboratory",
        directory: str = "",
    ) -> None:
        """Raises LaboratoryError for an unknown regime. `boot`, `directory`: as in
        services.comm.calls.callee."""
        super().__init__(name, where, boot, directory)
        cv2.setNumThreads(1)  # Other nodes share the cores.
        self._site = site
        self._floor = Floor()
        self._cameras: dict[str, RoverCamera] = {}
        truth = site.truth(regime)
        self.rover = RoverBody(truth.rover, np.random.default_rng((seed, _SLIP)))
        self._echo_draws = np.random.default_rng((seed, _ECHO))
        self.bus = RoverBus(self.rover, ReflectorSensor(self._measure))
        self._prepare(seed, truth, truth.course.track(seed))

    def _prepare(self, seed: int, truth: TrackTruth, track: Track) -> None:
        """Begin a new experiment: rover at the start, empty score, everything drawn again. Drives
        and counters keep their state."""
        self.truth, self.track = truth, track
        self._floor.paint(track)
        self._camera = self._camera_of(truth)
        self._hall = TrackLight(truth.light, np.random.default_rng((seed, _LIGHT)), self.now)
        self._image_draws = np.random.default_rng((seed, _IMAGE))
        self._echo_draws = np.random.default_rng((seed, _ECHO))
        hangs = (
            np.random.default_rng((seed, _FALLEN)).random(len(track.gaps))
            >= truth.reflector_missing
        )
        self._reflectors = [
            (gap.x, gap.y) for gap, there in zip(track.gaps, hangs, strict=True) if there
        ]
        self.faults = FaultPlan(np.random.default_rng((seed, _FAULTS)))
        self.bus.power(True)
        self.bus.sensor.dead = False
        self.rover.move_to(self.now)
        draws = np.random.default_rng((seed, _SLIP))
        self.rover.place(truth.rover, _put_down(track.start, truth.rover, draws), draws)
        self.referee = TrackReferee(track, seed, truth.regime, self.now, hangs.tolist())
        self._watch_due = self.now

    def _camera_of(self, truth: TrackTruth) -> RoverCamera:
        """Return the camera as it is mounted; cached, since its noise field takes some
        milliseconds."""
        key = repr(truth.camera)
        if key not in self._cameras:
            nominal = self._site.nominal["camera"]
            self._cameras[key] = RoverCamera(
                truth.camera,
                float(nominal["exposure"]),
                (float(nominal["black"]), float(nominal["white"])),
                float(nominal["noise"]),
                float(self._site.settings["camera"]["vignetting"]),
            )
        return self._cameras[key]

    # The world, as lock step and real time drive it

    def tick(self, now: float) -> None:
        if not self.faults.none:
            self._begin_faults(now)
        if self.exposures.due(now):
            self._expose(now)
        self.bus.step(now)
        if now >= self._watch_due - 1e-9:
            self._watch_due += _WATCH
            self.rover.move_to(now)
            if self.referee.watch(now, self.rover.pose, self.rover.speed):
                self.bus.power(False)
        self.now = now + TICK

    def take_on_bus(self, now: float, frames: Sequence[Frame]) -> None:
        for frame in self.faults.passed(frames):
            self.bus.receive(now, frame)

    def take_frames(self) -> Sequence[Frame]:
        return self.faults.passed(self.bus.drain())

    def _expose(self, now: float) -> None:
        if self.faults.image_lost():
            return
        self.exposures.put(now, now + self._site.settings["camera"]["readout"], self.picture(now))

    def picture(self, now: float) -> Picture:
        """Return what the camera sees at the present moment of the world (s): (rows, width) grey
        levels."""
        rover = self.rover
        rover.move_to(now)
        light = self._hall.at(now)
        motion = Motion(rover.x, rover.y, rover.heading, rover.speed, rover.turn)
        return self._camera.take(
            self._floor, motion, self._image_draws, light.level, light.veil, self.truth.light.noise
        )

    def _measure(self, now: float) -> list[Echo]:
        self.rover.move_to(now)
        return look(self.truth.sensor, self.rover.pose, self._reflectors, self._echo_draws)

    # Faults and services

    def _begin_faults(self, now: float) -> None:
        powerless = self.faults.active("power")
        for fault in self.faults.begin(now):
            if fault.kind == "drive_fault":
                self.bus.trip(int(fault.value) - 1)
        if self.faults.active("power") is not powerless:
            self.bus.power(powerless)
        self.bus.sensor.dead = self.faults.active("dead_sensor")

    def score(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return `TrackReferee.score`."""
        return self.referee.score(self.now)

    def prepare(self, arguments: Mapping[str, Any]) -> None:
        """Begin a new experiment: seed=0, regime="straight", elements=None, interruptions=None,
        speed=None; a `speed` (m/s) that no wheel reaches is refused. Raises ValueError
        (LaboratoryError, TrackError among them)."""
        seed = whole_number(arguments, "seed", 0) or 0
        truth = self._site.truth(str(arguments.get("regime", REGIME)))
        _check_speed(arguments.get("speed"), truth.rover)
        elements, interruptions = (
            whole_number(arguments, key, None) for key in ("elements", "interruptions")
        )
        self._prepare(seed, truth, truth.course.track(seed, elements, interruptions))

    def make_ready(self, arguments: Mapping[str, Any]) -> None:
        """Make the camera of a regime. Raises LaboratoryError."""
        self._camera_of(self._site.truth(str(arguments.get("regime", REGIME))))


def _put_down(start: FloorPose, rover: RoverTruth, draws: np.random.Generator) -> FloorPose:
    """Return where a hand puts the rover that is to stand at `start`."""
    dx, dy, turn = draws.standard_normal(3).tolist()
    aside, heading = rover.settings["placed"], rover.settings["placed_heading"]
    return FloorPose(start.x + aside * dx, start.y + aside * dy, start.heading + heading * turn)


def _check_speed(speed: object, rover: RoverTruth) -> None:
    """Raise LaboratoryError for a speed (m/s) that the rover cannot have."""
    most = round(rover.top_speed * min(wheel.radius for wheel in rover.wheels), 1)
    if speed is not None and not (isinstance(speed, int | float) and 0.0 < speed <= most):
        raise LaboratoryError(
            f"speed: expected a number above 0 and at most {most} m/s, the top speed of the "
            f"wheels, got {speed!r}"
        )


_WATCH: Final = 0.02
"""Time between two looks of the referee (s): 1 cm at 0.5 m/s."""


def make_laboratory(directory: Directory, name: str) -> TrackLaboratory:
    """Return the laboratory of the simulated node `name` of the location file. Raises
    LaboratoryError."""
    boot = f"{name} in lock step"
    return TrackLaboratory(
        name, track_site_of(directory), directory.party, boot=boot, directory=directory.hash
    )
