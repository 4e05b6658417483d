"""Address and token with which an active mission run can be controlled: a file in its run folder
that only its owner can read."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from msgspec import Struct
from msgspec.structs import asdict

from petrobot.coordinator.run.folder import DEFAULT, NoRunError, journal_of
from petrobot.services.host.json_text import json_text
from petrobot.services.host.parent_death import state_of
from petrobot.services.host.whole_file import make_folder, write_whole

ADDRESS_FILE = "operator.json"


class RunAddress(Struct, frozen=True):
    """Address of the coordinator of a mission run."""

    run: str
    url: str
    """URL without the token: http://127.0.0.1:PORT."""
    token: str
    process: int
    """Process id of the coordinator."""
    services: str = ""
    """Path of the cell's services.toml."""


@contextmanager
def published(folder: Path, address: RunAddress) -> Iterator[Path]:
    """Keep the address in a run folder as long as the run can be controlled; only its owner may
    read it (mode 600)."""
    path = folder / ADDRESS_FILE
    make_folder(folder)
    write_whole(path, json_text(asdict(address)), mode=0o600)
    try:
        yield path
    finally:
        with contextlib.suppress(OSError):  # the end of a run does not depend on its folder
            path.unlink()


def find_address(name: str | None = None, folder: Path = DEFAULT) -> RunAddress:
    """Return the address of a mission run (None: of the newest active one). Raises
    NoRunError."""
    if name is not None:
        run = journal_of(name, folder).parent
        address = _read(run / ADDRESS_FILE)
        if address is None:
            _refuse_dead(run / ADDRESS_FILE)
            raise NoRunError(
                f"{run.name} is not active, or runs in lock step: only an active run in real time, "
                "or one that the page started, can be watched or controlled"
            )
        return address
    files = _newest_first(folder)
    addresses = [address for path in files if (address := _read(path)) is not None]
    if not addresses:
        for path in files[:1]:
            _refuse_dead(path)
        raise NoRunError(
            f"no run in {folder} can be watched or controlled: none is active, or it runs in lock "
            "step; start one in real time with `petrobot run`, or name its folder with --journal"
        )
    return addresses[0]


def waiting(folder: Path) -> list[str]:
    """Return the runs whose coordinator has died, the newest first: they wait for `resume`."""
    found = _newest_first(folder)
    return [path.parent.name for path in found if _readable(path) and _read(path) is None]


def _refuse_dead(path: Path) -> None:
    """Raise NoRunError if the coordinator of a run has died, else it would have removed the file;
    also if only another user may know."""
    run = path.parent.name
    if _readable(path):
        raise NoRunError(f"{run} was interrupted: `petrobot resume {run}` continues it")
    if path.exists():
        raise NoRunError(f"{run} was started by another user, who alone can watch or control it")


def _readable(path: Path) -> bool:
    return os.access(path, os.R_OK, effective_ids=True)


def _newest_first(folder: Path) -> list[Path]:
    found: list[tuple[float, Path]] = []
    for path in folder.glob(f"*/{ADDRESS_FILE}"):
        with contextlib.suppress(OSError):
            found.append((path.stat().st_mtime, path))
    return [path for _, path in sorted(found, reverse=True)]


def _read(path: Path) -> RunAddress | None:
    """Return the address in a file; None if there is none, or if its coordinator has ended. One
    that was killed keeps its process id until its parent collects it."""
    try:
        address = RunAddress(**json.loads(path.read_text(encoding="utf-8")))
        os.kill(address.process, 0)
    except (OSError, ValueError, TypeError):
        return None
    return None if state_of(address.process) == "Z" else address
