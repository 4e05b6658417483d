"""What `run` and `resume` share about journals: where runs are kept, how many, how durable."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError
from petrobot.services.host.command_line import whole

if TYPE_CHECKING:
    from collections.abc import Mapping

    from petrobot.coordinator.launch import Setting
    from petrobot.coordinator.run.recording import JournalStore
    from petrobot.services.comm.location_file import Directory


def add_journal_arguments(parser: argparse.ArgumentParser) -> None:
    """`--journal`, `--keep`, `--durable`."""
    parser.add_argument(
        "--journal",
        metavar="FOLDER",
        type=Path,
        help="where runs are kept (default: runs in real time; a run in lock step is kept "
        "only with this option)",
    )
    parser.add_argument(
        "--keep",
        type=whole(),
        metavar="N",
        help="remove the oldest ended runs of that folder beyond N when this one has ended",
    )
    parser.add_argument(
        "--durable",
        action="store_true",
        help="sync the journal before every start, also of actions without a device (costs a "
        "sync each)",
    )


def journal_folder(options: argparse.Namespace) -> Path | None:
    """Where this run is to be kept, None if nowhere."""
    from petrobot.coordinator.run.folder import DEFAULT

    return options.journal if options.journal is not None or options.mode == "lockstep" else DEFAULT


def new_store(
    directory: Directory,
    setting: Setting,
    options: argparse.Namespace,
    folder: Path,
    mission: str,
    origin: float,
    **more: Any,
) -> JournalStore:
    """The journal of a run that begins, in a folder of its own; `more` goes into its header."""
    from petrobot.coordinator.cli.loading import task_path
    from petrobot.coordinator.launch import with_runs
    from petrobot.coordinator.run.folder import JOURNAL, header
    from petrobot.coordinator.run.journal import JournalWriter
    from petrobot.coordinator.run.recording import JournalStore, clock_reading

    services = directory.source.read_text(encoding="utf-8")
    given: Mapping[str, Any] = {
        "services_path": str(directory.source.resolve()),
        "seed": setting.seed,
        "runs": with_runs(setting.task, setting.runs)[1],
        "parameters": {**setting.task.parameters, **setting.parameters},
        "clock": clock_reading(origin),
        "durable": options.durable,
        "mock": str(options.mock.resolve()) if options.mock else "",
        **more,
    }
    first = header(
        mission, task_path(options.task).read_text(encoding="utf-8"), services, options.mode, given
    )
    return JournalStore(JournalWriter(folder / JOURNAL, first), origin, durable=options.durable)


def tidy(options: argparse.Namespace) -> None:
    """Remove what `--keep` says is too old; a run without a result is never removed."""
    if options.keep is not None and options.folder is not None:
        from petrobot.coordinator.run.folder import retain

        for name in retain(options.folder.parent, options.keep):
            print(f"removed the run {name} (--keep {options.keep})", file=sys.stderr)


# What `log`, `replay` and `resume` share: a journal found, read, and its engine built anew from the header.

if TYPE_CHECKING:
    from collections.abc import Iterator

    from petrobot.coordinator.engine import Engine
    from petrobot.coordinator.run.journal import Journal
    from petrobot.coordinator.run.recording import Step
    from petrobot.coordinator.task import Task
    from petrobot.services.comm.location_file import Directory


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
        from petrobot.coordinator.run.recording import replay

        return replay(self.journal, self.engine)


def recorded(name: str) -> Recorded:
    """Read a run's journal and build its task, directory and engine from the texts in its
    header."""
    from petrobot.coordinator.engine import Engine
    from petrobot.coordinator.launch import with_runs
    from petrobot.coordinator.run.folder import NoRunError, journal_of
    from petrobot.coordinator.run.journal import JournalError, read_journal
    from petrobot.coordinator.task.file import TaskFileError, loads
    from petrobot.services.comm.location_file import DirectoryError, parse

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
