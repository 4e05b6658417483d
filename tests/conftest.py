"""Settings of all tests: property tests judge results, never wall-clock time; no test hangs for ever."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile("petrobot", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.load_profile("petrobot")

PROOF_LIMIT_S = 6 * 3600.0
"""The limit of one test marked `proof` (s); the others have `timeout` of pyproject.toml."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give each long test the limit of the long ones, unless it has a limit of its own."""
    for item in items:
        if item.get_closest_marker("proof") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(PROOF_LIMIT_S))
