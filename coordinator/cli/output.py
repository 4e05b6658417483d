"""What a run leaves: progress while it goes on, then its result in the terminal, as JSON, beside
its journal and as a report."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli.loading import pictures_of, write_json
from petrobot.services.host.whole_file import write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.run.mission import Mission
    from petrobot.coordinator.run.timeline import Timeline
    from petrobot.coordinator.task import Task


@contextmanager
def progress(options: argparse.Namespace) -> Iterator[Callable[[Mission, float], None] | None]:
    """Shows how far a run is, unless the terminal is to be quiet or takes the JSON."""
    if options.quiet or options.json == "-":
        yield None
        return
    from petrobot.coordinator.cli.progress import live_progress

    with live_progress() as watch:
        yield watch


def give(
    result: dict[str, Any],
    task: Task,
    timeline: Timeline,
    options: argparse.Namespace,
    folder: Path | None,
) -> None:
    """Write the result where it was asked for and beside the journal, print it, leave the
    report."""
    if folder is not None:
        from petrobot.coordinator.run.folder import RESULT

        write_json(str(folder / RESULT), result)
    if options.json:
        write_json(options.json, result)
    if options.json != "-":
        from petrobot.coordinator.cli.progress import print_result

        print_result(result)
        if folder is None and result["status"] != "success":
            print(
                "not kept; with --journal runs, `petrobot log` and `petrobot report` show "
                "what led there",
                file=sys.stderr,
            )
    if options.report is not None:
        from petrobot.coordinator.drawing import draw
        from petrobot.coordinator.studies.report import report_html

        write_json(str(options.report / "result.json"), result)
        page = options.report / "index.html"
        net = draw(task, error_branches=True)
        write_whole(page, report_html(result, timeline, net, pictures_of(task, result)))
        print(f"report: {page}")
