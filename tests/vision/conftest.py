"""Fixtures of the vision tests."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from petrobot.services.vision.camera import Camera
from petrobot.sim.catching.camera import PinholeCamera
from tests.vision.bench import BenchContext, BenchPorts, CameraBench, read_cell, true_view


@pytest.fixture(scope="session")
def cell() -> dict[str, Any]:
    return read_cell()


@pytest.fixture(scope="session")
def pinhole(cell: dict[str, Any]) -> PinholeCamera:
    """The simulated camera with its true pose. Shared, as its background is expensive."""
    camera = PinholeCamera(cell, true_view(cell), np.random.default_rng(7))
    assert camera.background.shape == (480, 640)
    return camera


@pytest.fixture
def bench(pinhole: PinholeCamera) -> CameraBench:
    """A bench whose noise starts from its seed again."""
    pinhole.reseed(np.random.default_rng(11))
    return CameraBench(pinhole)


@pytest.fixture
def context(bench: CameraBench) -> BenchContext:
    """A context with a camera that knows only its shipped calibration."""
    return BenchContext(bench, Camera({"source": "sim"}, BenchPorts(bench)))
