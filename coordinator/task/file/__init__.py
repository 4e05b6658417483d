"""Task files: a task as TOML that people write by hand, and back. The format is described in
docs/task-file.md."""

from petrobot.coordinator.task.file.reading import TaskFileError, load, loads
from petrobot.coordinator.task.file.writing import dumps

__all__ = ["TaskFileError", "dumps", "load", "loads"]
