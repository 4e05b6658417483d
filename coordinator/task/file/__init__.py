"""Task files: a task as TOML that people write by hand, and back. The format is described in
docs/task-file.md."""

from petrobot.coordinator.task.file.errors import TaskFileError
from petrobot.coordinator.task.file.reading import load, loads
from petrobot.coordinator.task.file.writing import dumps

__all__ = ["TaskFileError", "dumps", "load", "loads"]
