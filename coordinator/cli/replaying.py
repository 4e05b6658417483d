"""What `log`, `replay` and `resume` share: a journal found, read, and its engine built anew from
the header."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from petrobot.coordinator.cli import CommandError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from petrobot.coordinator.engine import Engine
    from petrobot.coordinator.record.journal import Journal
    from petrobot.coordinator.record.recording import Step
    from petrobot.coordinator.task import Task
    from petrobot.services.comm.directory import Directory


HEADER = ("mission", "mode", "task", "services", "services_path", "seed", "runs", "parameters")
"""What a header must say for its run to be derived again."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recorded mission run and what it ran with."""

    journal: Journal
    task: Task
    directory: Directory
    engine: Engine

    def steps(self) -> Iterator[Step]:
        """Every stimulus derived again."""
        from petrobot.coordinator.record.recording import replay

        return replay(self.journal, self.engine)


def recorded(name: str) -> Recorded:
    """Read a run's journal and build its task, directory and engine from the texts in its
    header."""
    from petrobot.coordinator.engine import Engine
    from petrobot.coordinator.launch import with_runs
    from petrobot.coordinator.record.journal import JournalError, read_journal
    from petrobot.coordinator.record.runfolder import NoRunError, journal_of
    from petrobot.coordinator.taskfile import TaskFileError, loads
    from petrobot.services.comm.directory import DirectoryError, parse

    try:
        journal = read_journal(journal_of(name))
        header = journal.header
        for key in HEADER:
            if key not in header:
                raise CommandError(
                    2,
                    f"{journal.path}: its header has no {key!r}; it is no journal of a mission run",
                )
        task, _ = with_runs(loads(header["task"], f"{journal.path} (task)"), header["runs"])
        directory = parse(header["services"], Path(header["services_path"]))
    except (NoRunError, JournalError, TaskFileError, DirectoryError) as fault:
        raise CommandError(2, str(fault)) from fault
    except (KeyError, OSError) as fault:
        raise CommandError(2, f"{name}: {fault}") from fault
    devices = {a.name: a.device for a in directory.actions.values() if a.device}
    return Recorded(journal, task, directory, Engine(task, devices))
