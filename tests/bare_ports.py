"""The ports of a driver on a bench that offers it nothing."""

from __future__ import annotations

from typing import Any

import numpy as np


class BarePorts:
    """Refuses every line, bus, camera, stream and file; a bench overrides what it has."""

    def can(self) -> Any:
        raise LookupError("no bus here")

    def serial(self, port: str, baud: int) -> Any:
        raise LookupError("no serial line here")

    def tcp(self, host: str, port: int) -> Any:
        raise LookupError("no TCP here")

    def images(self) -> Any:
        raise LookupError("no camera here")

    def stream(self, name: str) -> Any:
        raise LookupError("no set points here")

    def raise_event(self, name: str, **data: Any) -> None:
        raise LookupError("no task waits for an event here")

    def random(self, purpose: str) -> np.random.Generator:
        """Draws of the device, from a fixed seed."""
        return np.random.default_rng([*purpose.encode()])

    def file(self, path: str) -> bytes:
        raise LookupError("no file is read here")

    def write_file(self, path: str, content: bytes) -> None:
        raise LookupError("no file is written here")
