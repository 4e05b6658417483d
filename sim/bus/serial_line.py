"""The far end of a driver's serial line: a pseudo terminal that any program opens as a port."""

from __future__ import annotations

import contextlib
import os
import select
import tty
from collections.abc import Callable
from pathlib import Path


class PtyLine:
    """A pseudo terminal with a link to it at `path`. `poll` answers what comes by `take`; `close`
    is a pulled cable."""

    def __init__(self, path: Path, take: Callable[[bytes], bytes]) -> None:
        """Raises OSError if no link can be made at `path`, or something else than a link is
        there."""
        self.path, self._take = path, take
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink():
            path.unlink()  # left behind by a process that was killed
        # Our own hold of the driver's end keeps the line open while no driver is there.
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        path.symlink_to(os.ttyname(self._far))

    def fileno(self) -> int:
        """Return what `select` waits for."""
        return self._near

    def poll(self, timeout: float = 0.0) -> None:
        """Answer what has come; wait up to `timeout` seconds for something."""
        if not select.select([self._near], [], [], timeout)[0]:
            return
        with contextlib.suppress(BlockingIOError):  # not read: lost, as on a real line
            answer = self._take(os.read(self._near, 65536))
            if answer:
                os.write(self._near, answer)

    def close(self) -> None:
        """Pull the cable: the program that has it open gets an error."""
        self.path.unlink(missing_ok=True)
        os.close(self._far)
        os.close(self._near)
