"""What the arm's driver is configured with: its table of services.toml, and the numbers of arm and
cell that this names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from petrobot.services.device import Ports, refuse_unknown_keys
from petrobot.services.motion.drive_link import DriveSettings
from petrobot.services.motion.model import (
    ArmModel,
    Cell,
    nominal_arm,
    nominal_cell,
    read_arm,
    read_cell,
)


@dataclass(frozen=True, slots=True)
class Settings:
    """The driver's configuration in services.toml: stream of catch points and its period (s), speed
    (share of the joints' greatest), whether to enable the drives at the start, and files instead of
    the package's own numbers."""

    stream: str = "catch_point"
    stream_period: float = 0.02
    speed: float = 1.0
    enable: bool = True
    model: str = ""
    cell: str = ""

    @classmethod
    def parse(cls, config: Mapping[str, Any]) -> Settings:
        """From the device's table; keys of its ports (interface, channel, ...) are left alone.
        Raises ValueError."""
        refuse_unknown_keys(config, cls.__slots__)
        fields = {name: config[name] for name in cls.__slots__ if name in config}
        for name, value in fields.items():
            kind = type(getattr(_DEFAULTS, name))
            fits = (
                isinstance(value, int | float) and not isinstance(value, bool)
                if kind is float
                else type(value) is kind
            )
            if not fits:
                raise ValueError(
                    f"services.toml: arm: {name} = {value!r}: must be of type {kind.__name__}"
                )
        settings = cls(**fields)
        if not 0.0 < settings.speed <= 1.0:
            raise ValueError(
                f"services.toml: arm: speed = {settings.speed}: must be above 0 and at most 1"
            )
        if not settings.stream_period > 0.0:
            raise ValueError(
                f"services.toml: arm: stream_period = {settings.stream_period}: must be above 0"
            )
        return settings


_DEFAULTS: Final = Settings()


def numbers(settings: Settings, ports: Ports) -> tuple[ArmModel, Cell]:
    """The arm and the cell: the package's own, or those of the files that the settings name."""
    model = read_arm(ports.file(settings.model).decode()) if settings.model else nominal_arm()
    return model, (
        read_cell(ports.file(settings.cell).decode()) if settings.cell else nominal_cell()
    )


def drive_settings(model: ArmModel) -> list[DriveSettings]:
    """What each drive is configured with, base to flange."""
    limits = zip(
        model.lower.tolist(), model.upper.tolist(), model.acceleration.tolist(), strict=True
    )
    return [DriveSettings(lower, upper, acceleration) for lower, upper, acceleration in limits]
