"""What the simulated cell really is: the nominal cell, one installation's random errors, and a
regime's disturbances.

Only the laboratory reads this. A regime name is a regime and any number of disturbances of
`sim/catching/laboratory.toml`, joined by `+` (or a comma): `A`, `B+latency200`, `A+dim+arm50`. With
`@n` behind it, it is another installation: `C@3`, `A+dim@1`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.host import toml_text

Vector = NDArray[np.float64]

LABORATORY_FILE = Path(__file__).with_name("laboratory.toml")


class LaboratoryError(ValueError):
    """A laboratory or cell file, or a regime name, cannot be used; the message names file, key and
    remedy."""


class CameraTruth(Struct, frozen=True):
    """The camera as it is really mounted: a point p (base frame, m) has camera coordinates
    `rotation @ (p - position)`."""

    position: Vector
    """(3,) optical centre in the base frame, m."""
    rotation: Vector
    """(3, 3), rows are the camera's x (right), y (down) and z (forward) axes in the base frame."""
    focal_px: float
    principal_px: tuple[float, float]
    distortion: tuple[float, float, float, float]
    """k1 k2 p1 p2 in OpenCV's order and sense."""


class CupTruth(Struct, frozen=True):
    """The cup as it is really mounted, in the flange frame (frame 6 of the arm)."""

    mouth: Vector
    """(3,) centre of the mouth, m."""
    axis: Vector
    """(3,) unit vector out of the mouth."""
    radius: float
    depth: float
    restitution: float


class TableTruth(Struct, frozen=True):
    """The table as it really stands: top at height `top`, x from `near_edge` to `far_edge`, |y| <=
    `half_width` (m)."""

    top: float
    near_edge: float
    far_edge: float
    half_width: float


class Scatter(Struct, frozen=True):
    """What differs from image to image, frame to frame and ball to ball; the laboratory file
    explains each ([nominal])."""

    image_time_error: float = 0.0
    images_lost: float = 0.0
    frames_lost: float = 0.0
    exposure_factor: float = 1.0
    table_slope: tuple[float, float] = (0.0, 0.0)
    wave_slope: float = 0.0
    wave_length: float = 0.4
    hidden: tuple[float, float] = (0.0, 0.0)
    second_ball: float = 0.0

    @property
    def flat(self) -> bool:
        """Whether the table is even."""
        return self.table_slope == (0.0, 0.0) and self.wave_slope == 0.0


class Truth(Struct, frozen=True):
    """The simulated truth of one regime: everything that services must not know."""

    regime: str
    """As given, for reports."""
    speed: tuple[float, float]
    """Range of the ball's speed at release, m/s."""
    camera: CameraTruth
    cup: CupTruth
    table: TableTruth
    joint_zero: Vector
    """(6,) rad; the arm's true joint angle is the encoder's plus this."""
    light_gradient: tuple[float, float]
    """Relative change of the light from one side of the image to the other, along u and v."""
    vignetting: float
    """Relative loss of light in the corners of the image."""
    light_level: float
    light_drift: float
    light_period: float
    image_latency: float
    """Delay in addition to the camera's own readout (s)."""
    arm_speed: float
    scatter: Scatter
    settings: Mapping[str, Any]
    """The whole laboratory file, for what is not an error: steps, thrower, friction."""

    def light(self, time: float) -> float:
        """Return the relative brightness at `time` (s); 1 is nominal."""
        return self.light_level * (
            1.0 + self.light_drift * float(np.sin(2.0 * np.pi * time / self.light_period))
        )


def read_toml(path: Path) -> dict[str, Any]:
    """Return a TOML file as a dict. Raises LaboratoryError naming the file when it is missing or
    not TOML."""
    try:
        return toml_text.read_toml(path.read_bytes(), str(path))
    except OSError as fault:
        raise LaboratoryError(
            f"{path}: cannot be read ({fault.strerror}); give the path of an existing file"
        ) from fault
    except toml_text.TomlError as fault:
        raise LaboratoryError(str(fault)) from fault


def disturbed(settings: Mapping[str, Any], regime: str) -> tuple[Mapping[str, Any], dict[str, Any]]:
    """Return the table of the regime's base, and the nominal values with its disturbances. `regime`
    is the base and any number of disturbances, joined by `+` (or a comma); `settings` is a
    laboratory file. Raises LaboratoryError for an unknown or contradictory regime."""
    base, *names = (part.strip() for part in regime.replace(",", "+").split("+"))
    regimes, disturbances = settings["regimes"], settings["disturbances"]
    if base in (contests := settings.get("contests", {})):
        base, *more = contests[base].split("+")
        names = more + names
    if base not in regimes:
        known = [*regimes, *contests]
        raise LaboratoryError(
            f"regime {regime!r}: it must begin with one of {', '.join(known)}, such as "
            f"{known[0]!r} or '{known[0]}+{next(iter(disturbances))}'"
        )
    values, set_by = dict(settings["nominal"]), dict[str, str]()
    for name in names:
        if name not in disturbances:
            raise LaboratoryError(
                f"regime {regime!r}: unknown disturbance {name!r}; the disturbances are "
                f"{', '.join(disturbances)}"
            )
        for key, value in disturbances[name].items():
            if key not in values:
                raise LaboratoryError(
                    f"[disturbances.{name}] {key}: unknown key; [nominal] lists the keys"
                )
            if key in set_by:
                raise LaboratoryError(
                    f"regime {regime!r}: {set_by[key]} and {name} both set {key}; keep one of them"
                )
            values[key], set_by[key] = value, name
    return regimes[base], values


def installation_of(regime: str) -> int:
    """Return the number of the installation behind the `@` of a regime name; 0, the shipped one,
    without it. Raises LaboratoryError."""
    _, at, text = regime.partition("@")
    if not at:
        return 0
    if not (text.isascii() and text.isdecimal()):
        raise LaboratoryError(
            f"regime {regime!r}: expected the number of an installation after @, got {text!r}; "
            "write for example 'C@2'"
        )
    return int(text)


def read_truth(
    cell: Mapping[str, Any], regime: str = "A", laboratory: Path = LABORATORY_FILE
) -> Truth:
    """Return the truth of a regime: nominal `cell` (services/cell.toml), the installation's errors,
    the regime's disturbances."""
    settings = read_toml(laboratory)
    try:
        base, values = disturbed(settings, regime.partition("@")[0])
        speed = (float(base["speed"][0]), float(base["speed"][1]))
        errors, number = settings["installation"], installation_of(regime)
        rng = np.random.default_rng(errors["seed"])
        camera, cup = _camera(cell["camera"], errors, values, rng), cell["cup"]
        if number:
            rng = np.random.default_rng((errors["seed"], number))
            others = settings["installations"]
            camera = _calibrated(camera, others, rng)
            settings, cup = _elsewhere(settings, cup, others, rng)
        return Truth(
            regime=regime,
            speed=speed,
            camera=camera,
            cup=_cup(cup, errors, values, rng),
            table=_table(cell["table"], errors, rng),
            joint_zero=rng.normal(0.0, errors["joint_zero"], 6),
            light_gradient=(float(values["light_gradient"][0]), float(values["light_gradient"][1])),
            vignetting=float(values["vignetting"]),
            light_level=float(values["light_level"]),
            light_drift=float(values["light_drift"]),
            light_period=float(values["light_period"]),
            image_latency=float(values["image_latency"]),
            arm_speed=float(values["arm_speed"]),
            scatter=_scatter(values),
            settings=settings,
        )
    except KeyError as fault:
        raise LaboratoryError(
            f"{laboratory} or the cell file: key {fault} is missing; the shipped files show it"
        ) from fault


def rotation_from_vector(vector: Vector) -> Vector:
    """Return the rotation (3, 3) about `vector` (3,) by its length in rad (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = np.asarray(vector, dtype=float) / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Vector = np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)
    return turned


def _camera(
    nominal: Mapping[str, Any],
    errors: Mapping[str, Any],
    values: Mapping[str, Any],
    rng: np.random.Generator,
) -> CameraTruth:
    position = np.asarray(nominal["position"], dtype=float) + rng.normal(
        0.0, errors["camera_position"], 3
    )
    turn = rng.normal(0.0, errors["camera_rotation"], 3)
    focal = nominal["focal_px"] * (1.0 + rng.normal(0.0, errors["camera_focal"]))
    centre = (nominal["width"] - 1) / 2.0, (nominal["height"] - 1) / 2.0
    dx, dy = rng.normal(0.0, errors["camera_principal_px"], 2)
    k1, k2, p1, p2 = np.asarray(nominal["distortion"]) * (
        1.0 + rng.normal(0.0, errors["camera_distortion"], 4)
    )
    right, forward = np.asarray(nominal["image_x"], dtype=float), np.array([0.0, 0.0, -1.0])
    looks_down = np.array([right, np.cross(forward, right), forward])
    later = rotation_from_vector(np.asarray(values["camera_turn"], dtype=float))
    return CameraTruth(
        position=position + np.asarray(values["camera_shift"], dtype=float),
        rotation=later @ rotation_from_vector(turn) @ looks_down,
        focal_px=float(focal),
        principal_px=(centre[0] + float(dx), centre[1] + float(dy)),
        distortion=(float(k1), float(k2), float(p1), float(p2)),
    )


def _calibrated(
    camera: CameraTruth, left: Mapping[str, Any], rng: np.random.Generator
) -> CameraTruth:
    """Return the camera of another installation, as its own calibration would find it: the shipped
    one with the errors that a calibration leaves."""
    turn = rotation_from_vector(rng.normal(0.0, left["camera_rotation"], 3))
    dx, dy = rng.normal(0.0, left["camera_principal_px"], 2)
    k1, k2, p1, p2 = np.asarray(camera.distortion) * (
        1.0 + rng.normal(0.0, left["camera_distortion"], 4)
    )
    return CameraTruth(
        position=camera.position + rng.normal(0.0, left["camera_position"], 3),
        rotation=turn @ camera.rotation,
        focal_px=camera.focal_px * (1.0 + float(rng.normal(0.0, left["camera_focal"]))),
        principal_px=(camera.principal_px[0] + float(dx), camera.principal_px[1] + float(dy)),
        distortion=(float(k1), float(k2), float(p1), float(p2)),
    )


def _elsewhere(
    settings: Mapping[str, Any],
    cup: Mapping[str, Any],
    ranges: Mapping[str, Any],
    rng: np.random.Generator,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return settings and cup of another installation: friction of the
    table, least spin of the throws, size and restitution of the cup are drawn."""
    friction, spin, radius, restitution = (
        float(rng.uniform(*ranges[key]))
        for key in ("friction", "least_spin", "cup_radius", "cup_restitution")
    )
    ball = {**settings["ball"], "friction": friction, "spin": [spin, settings["ball"]["spin"][1]]}
    return {**settings, "ball": ball}, {**cup, "radius": radius, "restitution": restitution}


def _cup(
    nominal: Mapping[str, Any],
    errors: Mapping[str, Any],
    values: Mapping[str, Any],
    rng: np.random.Generator,
) -> CupTruth:
    axis = np.asarray(nominal["axis"], dtype=float)
    mouth = np.asarray(nominal["mouth"], dtype=float) + rng.normal(0.0, errors["cup_mouth"], 3)
    restitution = float(values["cup_restitution"])
    return CupTruth(
        mouth=mouth + np.asarray(values["cup_shift"], dtype=float),
        axis=axis / np.linalg.norm(axis),
        radius=float(values["cup_radius"])
        if values.get("cup_radius", -1.0) > 0.0
        else float(nominal["radius"]),
        depth=float(nominal["depth"]),
        restitution=restitution if restitution >= 0.0 else float(nominal["restitution"]),
    )


def _scatter(values: Mapping[str, Any]) -> Scatter:
    """Return what scatters; a laboratory file that is older than these keys has none of it."""
    given: dict[str, Any] = {
        key: tuple(values[key]) if isinstance(values[key], list) else float(values[key])
        for key in Scatter.__struct_fields__
        if key in values
    }
    return Scatter(**given)


def _table(
    nominal: Mapping[str, Any], errors: Mapping[str, Any], rng: np.random.Generator
) -> TableTruth:
    near = nominal["near_edge"] + rng.normal(0.0, errors["table_edge"])
    return TableTruth(
        top=float(nominal["top"] + rng.normal(0.0, errors["table_top"])),
        near_edge=float(near),
        far_edge=float(near + nominal["length"]),
        half_width=float(nominal["width"]) / 2.0,
    )
