"""Continue a run whose coordinator was killed: restore its state from the journal, ask the nodes
for their runs, and execute nothing twice."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from petrobot.coordinator.cli.loading import write_json
from petrobot.coordinator.cli.options import add_log_level_argument, recorded
from petrobot.coordinator.cli.run import (
    add_output_arguments,
    add_page_arguments,
    conduct,
    refuse_stopped,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from petrobot.coordinator.operator.session import RunSession
    from petrobot.coordinator.run.interfaces import Observer
    from petrobot.coordinator.run.journal import Journal
    from petrobot.services.comm.location_file import Directory

EXAMPLE = "petrobot resume last --json out.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run", help="a run's id or folder, or `last`")
    add_output_arguments(parser)
    parser.add_argument(
        "--up",
        action="store_true",
        help="start the nodes of this host again, and stop them after the run (a killed `run --up` "
        "has left none)",
    )
    add_page_arguments(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress in the terminal")
    add_log_level_argument(parser)
    parser.set_defaults(mock=None, keep=None)


def run(options: argparse.Namespace) -> int:
    """Resume."""
    from petrobot.coordinator.run.folder import RESULT

    found = recorded(options.run)
    folder, mode = found.journal.path.parent, found.journal.header["mode"]
    if (result := _result_of(folder / RESULT)) is not None:
        print(
            f"{options.run}: this run has ended already, with status {result['status']}; "
            f"its result is {folder / RESULT}",
            file=sys.stderr,
        )
        if options.json:
            write_json(options.json, result)
        return 0 if result["status"] == "success" else 1

    directory, changed = located(found.directory)
    found = replace(found, directory=directory)
    if mock := found.journal.header.get("mock"):  # the nodes of --up run the same script
        options.mock = Path(mock)
    if mode == "realtime":
        refuse_stopped(directory)
        if changed:
            print(changed, file=sys.stderr)
        if later := later_run(found.journal):
            print(
                f"since {folder.name} was interrupted, {later} has used the same nodes: the "
                "devices may not be as it left them",
                file=sys.stderr,
            )

    def make(observers: Sequence[Observer]) -> RunSession:
        from petrobot.coordinator.operator.prepare import resume

        return resume(found, observers, options.ordered)

    return conduct(make, options, mode)


def located(recorded: Directory) -> tuple[Directory, str]:
    """Return the location file with which a run continues, and a warning if it has changed since
    the run began: then it is that of the beginning. A change of `[keys]` is none, and counts:
    otherwise no run could continue after its nodes had another key."""
    from petrobot.services.comm.location_file import DirectoryError, load

    with contextlib.suppress(DirectoryError, OSError):
        present = load(recorded.source, recorded.dry_run)
        if present.hash == recorded.hash:
            return present, ""
        return recorded, (
            f"{recorded.source} has changed since this run began, and a run continues with the "
            "file of its beginning: if a node refuses it or does not answer, put that one "
            "back and start the nodes again"
        )
    return recorded, ""


def later_run(journal: Journal) -> str:
    """Return the newest real-time run on the same nodes that was active after this one was
    interrupted; empty if there is none."""
    from petrobot.coordinator.run.folder import JOURNAL
    from petrobot.coordinator.run.journal import JournalError, read_header

    own = journal.path
    others = [path for path in own.parent.parent.glob(f"*/{JOURNAL}") if path != own]
    here = _addresses(journal.header)
    changed = {path: path.stat().st_mtime for path in (own, *others)}
    for path in sorted(others, key=lambda path: -changed[path]):
        if changed[path] <= changed[own]:
            break
        with contextlib.suppress(JournalError, OSError, LookupError, ValueError):
            then = read_header(path)
            if then["mode"] == journal.header["mode"] and _addresses(then) & here:
                return path.parent.name
    return ""


def _addresses(header: Mapping[str, Any]) -> set[tuple[str, int]]:
    """Return where the nodes of a run listen. That, not the text of its services.toml, says whether
    two runs use the same nodes: a comment or another cell's table changes nothing."""
    nodes = tomllib.loads(header["services"]).get("nodes", {})
    return {(str(node.get("host")), node.get("port")) for node in nodes.values()}


def _result_of(path: Path) -> dict[str, Any] | None:
    """Return the result that a run has written. None if there is none, or one that is partial or
    lacks its score, which the resumed run then overwrites."""
    from petrobot.coordinator.run.mission import UNSCORED

    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    whole = isinstance(result, dict) and "status" in result and UNSCORED not in result
    return result if whole else None
