"""Settings of all tests: property tests judge results, never wall-clock time."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

settings.register_profile("petrobot", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.load_profile("petrobot")
