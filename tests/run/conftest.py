"""What the tests of a mission share: the shipped task."""

from __future__ import annotations

import pytest

from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.task import Task


@pytest.fixture
def catch_ball() -> Task:
    """The shipped task."""
    return load_task("catch_ball")
