"""One process at a time writes a campaign's folder; the operating system lets go of the lock of one
that was killed."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from petrobot.coordinator.campaign.plan import CampaignError

LOCK = "running.lock"


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold the folder. Raises CampaignError when another process does, or when it cannot be
    written."""
    try:
        file = (folder / LOCK).open("a+", encoding="ascii")
    except OSError as fault:
        raise CampaignError(
            f"{folder}: {fault.strerror or fault}; give --out a folder that can be written"
        ) from fault
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as fault:
            file.seek(0)
            who = file.read().strip() or "?"
            raise CampaignError(
                f"{folder}: process {who} is running this campaign; wait until it has ended, "
                f"or end it (kill {who})"
            ) from fault
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield
