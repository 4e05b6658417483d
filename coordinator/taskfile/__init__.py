"""Task files: a task as TOML that people write by hand, and back. The format is described in docs/task-file.md."""

from coordinator.taskfile.errors import TaskFileError
from coordinator.taskfile.reading import load, loads
from coordinator.taskfile.writing import dumps

__all__ = ["TaskFileError", "dumps", "load", "loads"]
