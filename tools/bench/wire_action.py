"""The action that `wire.py` calls in a node's worker process."""

from __future__ import annotations

from typing import Any

from petrobot.services.action import Context, Result, success


def echo(ctx: Context, **values: Any) -> Result:
    """Return the arguments."""
    return success(**values)
