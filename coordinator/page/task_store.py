"""The folders of task files: names, texts, revisions. Shipped files are read-only; a save that
would undo that of another user is refused with both versions."""

from __future__ import annotations

import contextlib
import hashlib
import re
from pathlib import Path

from msgspec import Struct

from petrobot.coordinator.background import RefusedError
from petrobot.coordinator.page.edits import EditError, Rename, edited, parse
from petrobot.services.host.whole_file import make_folder, write_whole

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,63}")
_TASK = re.compile(rb"^\s*(\[\s*task\s*[].]|task\s*(=\s*\{|\.))", re.MULTILINE)
"""What only a task file has: its table `task`."""
LARGEST_FILE = 1024 * 1024


class StoreError(RefusedError):
    """A task file cannot be read or written."""


class Conflict(Exception):  # noqa: N818 - not an error: two people edited the same file
    """The file is not the version that was edited."""

    def __init__(self, theirs: TaskText, yours: str) -> None:
        super().__init__(theirs, yours)
        self.theirs = theirs
        self.yours = yours

    def __str__(self) -> str:
        return f"{self.theirs.name} was changed by another user or program since you opened it"


class TaskText(Struct, frozen=True):
    """One task file as it is on disk."""

    name: str
    text: str
    own: bool = True
    """Whether it is in the user's own folder; a shipped one is saved as a copy there."""

    @property
    def revision(self) -> str:
        """Identifier that changes exactly when the text does."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:16]


class TaskStore:
    """Task files by bare name: those of the user's own folder, made when it is first needed, then
    the shipped ones. Other TOML files of the folder are not offered."""

    def __init__(self, folder: Path, shipped: Path | None = None) -> None:
        self._folder = folder
        self._shipped = shipped

    @property
    def folders(self) -> dict[str, str]:
        """Folders of its files, for work in another process."""
        return {"tasks": str(self._folder), "shipped": str(self._shipped or "")}

    def names(self) -> list[str]:
        """Names of all task files."""
        return sorted(self._own() | self._behind())

    def listed(self) -> list[dict[str, object]]:
        """Return all task files, the user's own first: {name, own, shipped}; one with both is the
        user's copy of a shipped one."""
        own, behind = self._own(), self._behind()
        return [
            {"name": name, "own": name in own, "shipped": name in behind}
            for name in (*sorted(own), *sorted(behind - own))
        ]

    def read(self, name: str) -> TaskText:
        """Return one task file, preferably the user's own. Raises StoreError."""
        path = self._path(name)
        try:
            return TaskText(name, _content(path))
        except FileNotFoundError:
            pass
        if self._shipped is not None:
            with contextlib.suppress(FileNotFoundError):
                return TaskText(name, _content(self._shipped / path.name), own=False)
        raise StoreError(404, f"no task file {name}.toml")

    def _own(self) -> set[str]:
        return _stems(self._folder)

    def _behind(self) -> set[str]:
        return _stems(self._shipped) if self._shipped is not None else set()

    def save(
        self, name: str, base: str | None, document: dict[str, object], renames: list[Rename]
    ) -> TaskText:
        """Write an edited document; `base` is the revision that was edited, None for a new file.

        Only values that differ from those of the file are changed in its text. Raises Conflict,
        StoreError.
        """
        current = self.current(name)
        yours = self.edited_text(current, document, renames)
        if (current.revision if current else None) != base:
            raise Conflict(current or TaskText(name, ""), yours)
        self._write(name, yours)
        return TaskText(name, yours)

    def save_text(self, name: str, base: str | None, text: str) -> TaskText:
        """Write a whole text, for example after resolving a conflict by hand. Raises Conflict,
        StoreError."""
        try:
            parse(text)
            current = self.current(name)
        except EditError as fault:
            raise StoreError(400, str(fault)) from fault
        if (current.revision if current else None) != base:
            raise Conflict(current or TaskText(name, ""), text)
        self._write(name, text)
        return TaskText(name, text)

    def edited_text(
        self, current: TaskText | None, document: dict[str, object], renames: list[Rename]
    ) -> str:
        """Return the text that the file would have. Raises StoreError."""
        try:
            return edited(current.text if current else "", document, renames)
        except EditError as fault:
            raise StoreError(400, str(fault)) from fault

    def current(self, name: str) -> TaskText | None:
        """Return a task file as it is now, None if there is none. Raises StoreError."""
        try:
            return self.read(name)
        except StoreError as fault:
            if fault.status != 404:
                raise
            return None

    def _path(self, name: str) -> Path:
        if not _NAME.fullmatch(name):
            raise StoreError(
                400, "a task's name may have only letters, digits, _ and -, 64 at most"
            )
        return self._folder / f"{name}.toml"

    def _write(self, name: str, text: str) -> None:
        path = self._path(name)
        if len(text.encode()) > LARGEST_FILE:
            raise StoreError(413, f"{name}.toml would be larger than {LARGEST_FILE} bytes")
        try:
            make_folder(self._folder)
            write_whole(path, text)
        except OSError as fault:
            raise StoreError(400, f"{name}.toml cannot be written: {fault}") from fault


def _stems(folder: Path) -> set[str]:
    named = (path for path in folder.glob("*.toml") if _NAME.fullmatch(path.stem))
    return {path.stem for path in named if _is_task(path)}


def _is_task(path: Path) -> bool:
    try:
        return path.stat().st_size > LARGEST_FILE or _TASK.search(path.read_bytes()) is not None
    except OSError:
        return True  # opening it says what is wrong


def _content(path: Path) -> str:
    """Return a task file's text. Raises FileNotFoundError, StoreError."""
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise StoreError(413, f"{path.name} is larger than {LARGEST_FILE} bytes")
        return path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise
    except (OSError, UnicodeDecodeError) as fault:
        raise StoreError(400, f"{path.name} cannot be read: {fault}") from fault
