"""The far ends of drivers' lines: a pseudo terminal that any program opens as a serial port, and a
server of TCP connections."""

from __future__ import annotations

import contextlib
import os
import select
import selectors
import socket
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any

from petrobot.sim.laboratory_party import TcpSession


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
        with contextlib.suppress(BlockingIOError):  # no reader: lost, as on a real line
            answer = self._take(os.read(self._near, 65536))
            if answer:
                os.write(self._near, answer)

    def close(self) -> None:
        """Pull the cable: the program that has it open gets an error."""
        self.path.unlink(missing_ok=True)
        os.close(self._far)
        os.close(self._near)


class TcpServer:
    """Serves the connections of drivers to robots. Call `poll` often; `cut` cuts them all."""

    def __init__(self) -> None:
        self._selector = selectors.EpollSelector()
        self._listeners: list[socket.socket] = []
        self._sessions: dict[socket.socket, TcpSession] = {}

    def listen(self, address: tuple[str, int] | Path, accept: Callable[[], TcpSession]) -> int:
        """Accept connections at an address, or at a Unix socket; `accept` returns the robot's end
        of each. Return the port. Raises OSError."""
        if isinstance(address, Path):
            address.parent.mkdir(parents=True, exist_ok=True)
            address.unlink(missing_ok=True)  # left behind by a process that was killed
            listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            listener.bind(str(address))
            listener.listen()
        else:
            listener = socket.create_server(address)
        listener.setblocking(False)
        self._listeners.append(listener)
        self._selector.register(listener, selectors.EVENT_READ, accept)
        return 0 if isinstance(address, Path) else int(listener.getsockname()[1])

    def fileno(self) -> int:
        """Return what `select` waits for."""
        return self._selector.fileno()

    def poll(self, timeout: float = 0.0) -> None:
        """Take what has come, and answer; wait up to `timeout` seconds for something."""
        for key, _ in self._selector.select(timeout):
            near: Any = key.fileobj
            if key.data is not None:
                near, _ = near.accept()
                near.setblocking(False)
                if near.family != socket.AF_UNIX:
                    near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._sessions[near] = key.data()
                self._selector.register(near, selectors.EVENT_READ)
                continue
            try:
                data = near.recv(65536)
            except OSError:
                data = b""
            self._sessions[near].closed |= not data
            if data:
                self._sessions[near].receive(data)
        self.flush()

    def flush(self) -> None:
        """Send what the robots have to say; drop the connections that are closed."""
        for near, session in list(self._sessions.items()):
            try:
                near.sendall(session.drain())
            except OSError:  # gone, or it does not read
                session.closed = True
            if session.closed:
                self._drop(near)

    def _drop(self, near: socket.socket) -> None:
        self._selector.unregister(near)
        self._sessions.pop(near).closed = True
        near.close()

    def cut(self) -> None:
        """Cut all connections; new ones are accepted."""
        for near in list(self._sessions):
            self._drop(near)

    def close(self) -> None:
        """Cut all connections, and stop listening."""
        self.cut()
        for listener in self._listeners:
            if listener.family == socket.AF_UNIX:
                Path(listener.getsockname()).unlink(missing_ok=True)
            listener.close()
        self._listeners.clear()
        self._selector.close()
