"""Task files: a task as TOML that people write by hand, and back. The format is described in
docs/task-file.md."""

from petrobot.coordinator.taskfile.errors import TaskFileError
from petrobot.coordinator.taskfile.reading import load, loads
from petrobot.coordinator.taskfile.writing import dumps

__all__ = ["TaskFileError", "dumps", "load", "loads"]
