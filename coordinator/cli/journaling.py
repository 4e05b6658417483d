"""What `run` and `resume` share about journals: where runs are kept, how many, how durable."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.services.comm.quantities import whole

if TYPE_CHECKING:
    from collections.abc import Mapping

    from petrobot.coordinator.launch import Setting
    from petrobot.coordinator.record.recording import JournalStore
    from petrobot.services.comm.directory import Directory


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
    from petrobot.coordinator.record.runfolder import DEFAULT

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
    from petrobot.coordinator.record.journal import JournalWriter
    from petrobot.coordinator.record.recording import JournalStore, clock_reading
    from petrobot.coordinator.record.runfolder import JOURNAL, header

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
        from petrobot.coordinator.record.runfolder import retain

        for name in retain(options.folder.parent, options.keep):
            print(f"removed the run {name} (--keep {options.keep})", file=sys.stderr)
