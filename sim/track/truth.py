"""What the rover's cell really is: the nominal numbers, one rover's random errors, and a regime's
track and disturbances.

Only the laboratory reads this. A regime name is a kind of track and any number of disturbances of
`sim/track/track.toml`, joined by `+` (or a comma): `straight`, `arcs+drift`, `mixed+flash+slip`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from petrobot.services.comm.location_file import Directory
from petrobot.sim.catching.truth import LaboratoryError, disturbed, read_toml
from petrobot.sim.track.camera import Mount
from petrobot.sim.track.course import Track

LABORATORY_FILE = Path(__file__).with_name("track.toml")


class WheelTruth(Struct, frozen=True):
    """The true values of one wheel and its motor."""

    radius: float
    lag: float


class RoverTruth(Struct, frozen=True):
    """The true values of the rover; sim/track/track.toml and rover.toml explain the numbers."""

    wheels: tuple[WheelTruth, WheelTruth]
    """Left and right."""
    track_width: float
    top_speed: float
    """Greatest speed of a wheel at `nominal_voltage` (rad/s)."""
    nominal_voltage: float
    acceleration: float
    encoder_counts: int
    slip: float
    slip_time: float
    slip_aside: float
    slip_turn: float
    battery: tuple[float, float, float]
    """Voltage at the start (V), its drop (V/s), resistance (ohm)."""
    settings: Mapping[str, float]
    """How it is put down, friction, inertia, brakes, torque, electronics."""


class SensorTruth(Struct, frozen=True):
    """The true values of the retroreflector sensor (m, rad)."""

    forward: float
    below: float
    """How far the sensor is below the reflectors' centres (m)."""
    half_angle: float
    range: float
    fan: float
    bearing_offset: float
    range_offset: float
    bearing_noise: float
    range_noise: float
    step: float
    miss: float
    false: float
    false_range: tuple[float, float]


class LightTruth(Struct, frozen=True):
    """Light over the floor, flashes, and the camera's noise as a factor on the nominal one."""

    level: float
    drift: float
    period: float
    flash_rate: float
    flash_duration: tuple[float, float]
    flash_gain: float
    flash_veil: float
    noise: float


class TrackCourse(Struct, frozen=True):
    """The kind of track that a regime uses."""

    kinds: str
    elements: int
    interruptions: int

    def track(
        self, seed: int, elements: int | None = None, interruptions: int | None = None
    ) -> Track:
        """Return the track of a seed; given numbers replace the regime's. Raises `TrackError`."""
        if self.kinds == "contest":
            return Track.contest()
        return Track.by_seed(
            seed,
            self.elements if elements is None else elements,
            self.interruptions if interruptions is None else interruptions,
            self.kinds,
        )


class TrackTruth(Struct, frozen=True):
    """The simulated truth of one regime."""

    regime: str
    course: TrackCourse
    rover: RoverTruth
    camera: Mount
    sensor: SensorTruth
    light: LightTruth
    reflector_missing: float
    """Probability that a reflector has fallen down."""


class TrackSite(Struct, frozen=True):
    """The two files of the cell."""

    nominal: Mapping[str, Any]
    settings: Mapping[str, Any]
    source: str = "rover.toml"

    def truth(self, regime: str) -> TrackTruth:
        """Return the truth of a regime. Raises LaboratoryError."""
        base, values = disturbed(self.settings, regime)
        errors, nominal = self.settings["installation"], self.nominal
        rng = np.random.default_rng(errors["seed"])
        try:
            return TrackTruth(
                regime,
                TrackCourse(str(base["kinds"]), int(base["elements"]), int(base["interruptions"])),
                _rover(nominal, self.settings["rover"], errors, values, rng),
                _camera(nominal["camera"], errors, values, rng),
                _sensor(nominal, self.settings["sensor"], errors, values, rng),
                _light(values),
                float(values["reflector_missing"]),
            )
        except KeyError as fault:
            raise LaboratoryError(
                f"{LABORATORY_FILE.name} or {self.source}: key {fault} is missing; the "
                "shipped files show it"
            ) from fault


def read_track_site(rover: Path, laboratory: Path = LABORATORY_FILE) -> TrackSite:
    """Return the site of a rover file. Raises LaboratoryError."""
    return TrackSite(read_toml(rover), read_toml(laboratory), str(rover))


def track_site_of(directory: Directory) -> TrackSite:
    """Return the site that the location file names: `[parameters] rover`, and `laboratory` if it is
    not the shipped one."""
    if "rover" not in directory.parameters:
        raise LaboratoryError(
            f'{directory.source}: [parameters] rover is missing; write rover = "rover.toml"'
        )
    laboratory = directory.parameters.get("laboratory")
    return read_track_site(
        directory.file(directory.parameters["rover"]),
        directory.file(laboratory) if laboratory else LABORATORY_FILE,
    )


def _rover(
    nominal: Mapping[str, Any],
    settings: Mapping[str, Any],
    errors: Mapping[str, Any],
    values: Mapping[str, Any],
    rng: np.random.Generator,
) -> RoverTruth:
    rover = nominal["rover"]
    radii = rover["wheel_radius"] * (1.0 + rng.normal(0.0, errors["wheel_radius"], 2))
    radii[0] *= 1.0 + values["wheel_radius_left"]
    lags = rover["wheel_lag"] * (1.0 + rng.normal(0.0, errors["wheel_lag"], 2))
    return RoverTruth(
        wheels=(
            WheelTruth(float(radii[0]), float(lags[0])),
            WheelTruth(float(radii[1]), float(lags[1])),
        ),
        track_width=float(rover["track_width"] * (1.0 + rng.normal(0.0, errors["track_width"]))),
        top_speed=float(rover["top_speed"]),
        nominal_voltage=float(rover["battery_voltage"]),
        acceleration=float(rover["acceleration"]),
        encoder_counts=int(rover["encoder_counts"]),
        slip=float(values["slip"]),
        slip_time=float(settings["slip_time"]),
        slip_aside=float(values["slip_aside"]),
        slip_turn=float(values["slip_turn"]),
        battery=(
            float(values["battery_voltage"]),
            float(values["battery_fall"]),
            float(values["battery_resistance"]),
        ),
        settings=settings,
    )


def _camera(
    nominal: Mapping[str, Any],
    errors: Mapping[str, Any],
    values: Mapping[str, Any],
    rng: np.random.Generator,
) -> Mount:
    pitch, yaw, roll = rng.normal(0.0, errors["camera_angle"], 3)
    du, dv = rng.normal(0.0, errors["camera_principal_px"], 2)
    u, v = nominal["principal_px"]
    return Mount(
        forward=float(nominal["forward"] + rng.normal(0.0, errors["camera_forward"])),
        height=float(nominal["height"] + rng.normal(0.0, errors["camera_height"])),
        pitch=float(nominal["pitch"] + pitch + values["camera_pitch"]),
        yaw=float(yaw + values["camera_yaw"]),
        roll=float(roll),
        focal=float(nominal["focal_px"] * (1.0 + rng.normal(0.0, errors["camera_focal"]))),
        principal=(float(u + du), float(v + dv)),
        width=int(nominal["width"]),
        rows=int(nominal["height_px"]),
    )


def _sensor(
    nominal: Mapping[str, Any],
    settings: Mapping[str, Any],
    errors: Mapping[str, Any],
    values: Mapping[str, Any],
    rng: np.random.Generator,
) -> SensorTruth:
    sensor = nominal["sensor"]
    low, high = settings["false_range"]
    return SensorTruth(
        forward=float(sensor["forward"]),
        below=float(nominal["track"]["reflector_height"] - sensor["height"]),
        half_angle=float(sensor["half_angle"]),
        range=float(sensor["range"]),
        fan=float(sensor["fan"]),
        bearing_offset=float(rng.normal(0.0, errors["sensor_bearing"])),
        range_offset=float(rng.normal(0.0, errors["sensor_range"])),
        bearing_noise=float(sensor["bearing_noise"]),
        range_noise=float(sensor["range_noise"]),
        step=float(settings["step"]),
        miss=float(values["sensor_miss"]),
        false=float(values["sensor_false"]),
        false_range=(float(low), float(high)),
    )


def _light(values: Mapping[str, Any]) -> LightTruth:
    low, high = values["flash_duration"]
    return LightTruth(
        level=float(values["light_level"]),
        drift=float(values["light_drift"]),
        period=float(values["light_period"]),
        flash_rate=float(values["flash_rate"]),
        flash_duration=(float(low), float(high)),
        flash_gain=float(values["flash_gain"]),
        flash_veil=float(values["flash_veil"]),
        noise=float(values["noise"]),
    )
