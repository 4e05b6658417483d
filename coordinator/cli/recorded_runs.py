"""Recorded runs on the command line: options for where and how runs are kept, and reading one."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from petrobot.coordinator.cli import CommandError
from petrobot.services.host.command_line import whole

if TYPE_CHECKING:
    from petrobot.coordinator.operator.start_from import Recorded


def add_journal_arguments(parser: argparse.ArgumentParser) -> None:
    """Add `--journal`, `--keep` and `--durable`."""
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
    """Return the folder in which to keep this run; None if it is not kept."""
    from petrobot.coordinator.run.folder import DEFAULT

    return options.journal if options.journal is not None or options.mode == "lockstep" else DEFAULT


def tidy(options: argparse.Namespace, folder: Path | None) -> None:
    """Remove the runs beside `folder` that `--keep` says are too old; a run without a result is
    never removed."""
    if options.keep is not None and folder is not None:
        from petrobot.coordinator.run.folder import retain

        for name in retain(folder.parent, options.keep):
            print(f"removed the run {name} (--keep {options.keep})", file=sys.stderr)


def recorded(name: str) -> Recorded:
    """Read the run of this id, folder or `last`, with its task, cell and engine. Raises
    CommandError."""
    from petrobot.coordinator.operator.start_from import read_recorded
    from petrobot.coordinator.run.folder import NoRunError, journal_of
    from petrobot.coordinator.run.journal import JournalError
    from petrobot.coordinator.task.file import TaskFileError
    from petrobot.services.comm.location_file import DirectoryError

    try:
        return read_recorded(journal_of(name))
    except (NoRunError, JournalError, TaskFileError, DirectoryError) as fault:
        raise CommandError(2, str(fault)) from fault
    except (KeyError, OSError) as fault:
        raise CommandError(2, f"{name}: {fault}") from fault
