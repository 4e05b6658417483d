"""A disk that loses at a power cut what was not synced: bytes of files, names of files and folders,
and renames."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


class Disk:
    """What of a folder would be left. `os.fsync` and `os.fdatasync` tell it what is safe, as POSIX
    promises and no more: of a file its bytes, of a folder the names in it."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._bytes: dict[int, bytes] = {}
        self._names: dict[int, dict[str, int]] = {}
        self._held: dict[int, int] = {}
        """Open files by inode: so no number is given to another file meanwhile."""
        handle = os.open(root, os.O_RDONLY)
        self.synced(handle)
        os.close(handle)

    def synced(self, handle: int) -> None:
        """What belongs to this open file or folder is safe from now on."""
        inode, place = os.fstat(handle).st_ino, Path(f"/proc/self/fd/{handle}")
        if inode not in self._held:
            self._held[inode] = os.dup(handle)
        if place.is_dir():
            self._names[inode] = {entry.name: entry.inode() for entry in os.scandir(place)}
        else:
            self._bytes[inode] = place.read_bytes()

    def left(self, torn: float = 0.0) -> dict[str, bytes]:
        """Files with their bytes, by path in the root. Of what was appended and not synced, `torn`
        is there too (0 to 1)."""
        return dict(self._left(self._root.stat().st_ino, "", torn))

    def _left(self, folder: int, path: str, torn: float) -> Iterator[tuple[str, bytes]]:
        for name, inode in self._names.get(folder, {}).items():
            if inode in self._names:
                yield from self._left(inode, f"{path}{name}/", torn)
                continue
            safe, now = self._bytes.get(inode, b""), self._root / path / name
            if now.is_dir():
                continue  # of what is in it nothing is safe
            if (
                now.is_file()
                and now.stat().st_ino == inode
                and (data := now.read_bytes()).startswith(safe)
            ):
                safe = data[: len(safe) + int(torn * (len(data) - len(safe)))]
            yield f"{path}{name}", safe

    def close(self) -> None:
        """Let the files go."""
        for handle in self._held.values():
            os.close(handle)


@contextmanager
def power_cut(root: Path) -> Iterator[Disk]:
    """The disk that a folder is on, from now on; what is in it already is lost if it is not synced
    again."""
    disk = Disk(root)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", disk.synced)
        patch.setattr(os, "fdatasync", disk.synced)
        try:
            yield disk
        finally:
            disk.close()
