"""Write a file in one piece: after a kill or a power cut there is the old file or the new one,
never a part.

Everything is on the disk when a function returns: the content, then the file's name in its folder,
then the names of new folders. Only then may other parts rely on the file.
"""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path


def write_whole(
    path: Path, content: str | bytes, *, mode: int | None = None, fresh: bool = False
) -> None:
    """Replace the file's content, synced to disk before this returns.

    `mode` is the file's mode (None: that of the existing file, else the default). With `fresh` what
    exists is left as it is; else what is not a regular file (a terminal, a pipe) is written to
    directly. Raises FileExistsError with `fresh`, else OSError; both name the path. No draft is
    left behind.
    """
    path = path.resolve()  # follow a symbolic link, do not replace it
    data = content.encode("utf-8") if isinstance(content, str) else content
    draft = path.with_name(f".{path.name[-200:]}.{os.getpid()}")
    try:
        if not fresh and path.exists() and not path.is_file():
            path.write_bytes(data)
            return
        if mode is None:
            mode = path.stat().st_mode & 0o777 if path.exists() else None
        _write_draft(draft, data, mode)
        try:
            if not (fresh and _linked(draft, path)):
                draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)
        sync_folder(path.parent)  # the new name is on the disk before anything relies on it
    except OSError as fault:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
        # An error while writing names no file, and the name of the draft means nothing to the user.
        raise OSError(fault.errno, fault.strerror or str(fault), str(path)) from fault


def _write_draft(draft: Path, data: bytes, mode: int | None) -> None:
    draft.unlink(missing_ok=True)  # left by a killed process with the same process id
    handle = os.open(
        draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666 if mode is None else 0o600
    )
    with os.fdopen(handle, "wb") as file:
        if mode is not None:
            os.fchmod(file.fileno(), mode)
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _linked(draft: Path, path: Path) -> bool:
    """Link the draft to its name; unlike a rename this fails if the name exists. Return False where
    links are not possible."""
    try:
        os.link(draft, path)
    except FileExistsError:
        raise
    except OSError:
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        return False
    return True


def make_folder(folder: Path) -> None:
    """Make a folder and its parents, their names synced before this returns. Raises OSError."""
    if folder.is_dir():
        return
    make_folder(folder.absolute().parent)
    try:
        folder.mkdir(exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder)) from None
    sync_folder(folder.absolute().parent)


def sync_folder(folder: Path) -> None:
    """Sync the names in a folder to disk. Raises OSError."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
