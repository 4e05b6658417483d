"""The latch of the emergency stop on disk: a restarted node must not move devices that were
stopped.

It is one small file per node, on the node's own host, with the names of the devices that accept no
commands (`*`: all). The node writes it, and checks it before each run on a device and several times
per second. `petrobot estop` writes it for a node of its own host that does not answer. A file that
cannot be read or understood counts as `*`: in doubt, devices stay stopped.

Beside it another file counts the stops that were cleared, and says when the last one was, and with
which stop each device was last cleared. It stays, so that a caller or a node that was frozen from
before a stop until after it was cleared is still known to have missed it.

The file is in `$PETROBOT_STATE`; else in `.petrobot` beside services.toml; else, if that cannot be
written or is where petrobot is installed, in a folder of the user (`$XDG_STATE_HOME` or
`~/.local/state`). A file in any of these folders counts, and clearing clears all of them.
"""

from __future__ import annotations

import errno
import hashlib
import math
import os
import stat
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from petrobot.services.host.whole_file import make_folder, write_whole

ALL: Final = "*"
STATE: Final = "PETROBOT_STATE"
FOLDER: Final = ".petrobot"
INSTALLED = Path(__file__).parents[2].resolve()
"""Folder of the installed package: the location file of its demo is in it."""


class LatchError(OSError):
    """The latch cannot be written or removed; the text names file and reason."""


class Cleared(NamedTuple):
    """The stops of a node that were cleared."""

    number: int = 0
    at: float = 0.0
    """When the last one was cleared (`uptime`); 0: unknown, or before the last boot."""
    devices: Mapping[str, int] = {}
    """For each device the number of the stop that was last cleared for it."""

    def since(self, device: str) -> float:
        """Return how long ago a stop of the device was cleared, at the least (s); infinity: there
        was none."""
        return uptime() - self.at if device in self.devices else math.inf


class Latch:
    """The latch of one node. `folders` are the possible folders; the first one that is writable is
    written."""

    def __init__(self, node: str, folders: Iterable[Path]) -> None:
        self.paths = tuple(folder / f"{node}.stopped" for folder in folders)
        self._stored: tuple[Path, frozenset[str]] | None = None
        """What this object has stored last, synced to disk."""

    def stopped(self) -> frozenset[str]:
        """Return the names of the stopped devices; with `ALL` among them, all are stopped.

        While there is no latch this costs one failed open per folder.
        """
        return frozenset().union(*(_read(path) for path in self.paths))

    def stop(self, devices: Iterable[str]) -> Path:
        """Add devices to the stopped ones. Return the file, once it is safe on disk. Raises
        LatchError."""
        names = self.stopped() | set(devices)
        # An operator's command repeats its order until the devices stand still.
        if self._stored is not None and self._stored[1] == names == _read(self._stored[0]):
            return self._stored[0]
        path = self._write(".stopped", sorted(names))
        self._stored = path, names
        return path

    def moved_here(self, devices: Iterable[str]) -> set[str]:
        """Return which of these devices another node on this host has stopped: services.toml gave
        them to this node while they were stopped."""
        return set(devices) & set().union(*map(_read, self._of_others()))

    def _of_others(self) -> list[Path]:
        return [
            other
            for path in self.paths
            for other in path.parent.glob("*.stopped")
            if other.name != path.name
        ]

    @property
    def cleared(self) -> Cleared:
        """The stops that were cleared. Files that cannot be read do not count."""
        found = (_cleared(path.with_suffix(".cleared")) for path in self.paths)
        return max(found, key=lambda one: (one.number, one.at))

    def _write(self, suffix: str, lines: list[str]) -> Path:
        """Write a file in the first folder in which that is possible, and return it."""
        faults = []
        for path in (path.with_suffix(suffix) for path in self.paths):
            try:
                _write(path, lines)
            except OSError as fault:
                faults.append(f"{path}: {fault.strerror}")
            else:
                return path
        raise LatchError("; ".join(faults))

    def clear(self, devices: Iterable[str], all_devices: Iterable[str]) -> None:
        """Allow these devices to move again; `ALL` means `all_devices`. Raises
        LatchError, and then nothing is cleared."""
        stopped = self.stopped()
        # A name that is none of them means all: `ALL`, or a device that was renamed while stopped.
        named = set(stopped) if stopped <= set(all_devices) else set(all_devices)
        left = named - set(devices)
        if stopped:  # Counted first: a stop that is not counted must not be cleared.
            before = self.cleared
            number = before.number + 1
            known = {**before.devices, **dict.fromkeys(sorted(named & set(devices)), number)}
            by_device = [f"{device} {last}" for device, last in known.items()]
            self._write(".cleared", [str(number), str(uptime()), *by_device])
        if left:
            self.stop(left)
        moved = {path: _read(path) for path in self._of_others()}
        kept = {path: names - set(devices) for path, names in moved.items() if names & set(devices)}
        for path, names in {**dict.fromkeys(self.paths, left), **kept}.items():
            try:
                if names and path.exists():
                    _write(path, sorted(names))
                else:
                    path.unlink(missing_ok=True)
            except OSError as fault:
                raise LatchError(
                    f"{path}: {fault.strerror}; remove this file by hand once the cell is safe"
                ) from fault

    @property
    def kept(self) -> bool:
        """Return whether it could be written now, according to the permissions."""
        return any(_writable(path.parent) for path in self.paths)


def latch_of(source: Path, node: str) -> Latch:
    """Return the latch of a node whose services.toml is `source`."""
    given = os.environ.get(STATE)
    if given:
        return Latch(node, [Path(given)])
    source = source.resolve()
    home = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    own = home / "petrobot" / hashlib.sha256(str(source).encode()).hexdigest()[:16]
    folders = [source.parent / FOLDER, own]
    return Latch(node, folders[::-1] if source.parent == INSTALLED else folders)


def _read(path: Path) -> frozenset[str]:
    try:
        names = _text(path).split()
    except FileNotFoundError:
        return frozenset()
    except (OSError, ValueError):
        return frozenset({ALL})
    return frozenset(names) or frozenset({ALL})


def _text(path: Path) -> str:
    """Return what is in a file. Raises OSError; a pipe in its place would hang its reader."""
    # `stat` needs no file descriptor: without a free one, a missing file is still missing.
    _must_be_file(path.stat())
    return path.read_text(encoding="utf-8")


def _must_be_file(status: os.stat_result) -> None:
    if not (
        stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)
    ):  # a folder says so itself
        raise OSError(errno.EINVAL, "not a regular file")


def uptime() -> float:
    """How long this host has been up, with the time in which it was suspended (s). It is the same
    for all processes, and does not jump."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def _cleared(path: Path) -> Cleared:
    try:
        number, *lines = _text(path).splitlines()
        at = float(lines[0]) if lines else 0.0
        pairs = (line.split() for line in lines[1:])
        devices = {device: int(last) for device, last in pairs}
        # A time after now is of before the last boot, which was at 0.
        return Cleared(int(number), at if at <= uptime() else 0.0, devices)
    except (OSError, ValueError):
        return Cleared()


def _write(path: Path, names: list[str]) -> None:
    make_folder(path.parent)
    if path.exists():
        _must_be_file(path.stat())
    write_whole(path, "\n".join(names) + "\n")


def _writable(folder: Path) -> bool:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return os.access(folder, os.W_OK | os.X_OK)
