"""The output of a run: its progress in the terminal, then its result there, as JSON and as a
report."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from petrobot.coordinator.cli.loading import pictures_of, write_json
from petrobot.services.host.command_line import reopen_outputs
from petrobot.services.host.json_text import without_controls
from petrobot.services.host.whole_file import write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.operator.session import RunSession
    from petrobot.coordinator.run.mission import Mission
    from petrobot.coordinator.run.timeline import Timeline

COLOURS = {"success": "green", "failure": "yellow", "error": "red"}
REFRESH = 0.1
NOTE = 60.0
"""Wall time between two lines about an active run where no line can be refreshed (s)."""
LONGEST_TABLE = 24
WIDEST_TABLE = 9
"""Most columns of a table in the terminal; --json and the report show wider ones."""
LAST_ERRORS, LAST_FAILURE, MISSED = "last_errors", "last_failure", "missed_goals"
"""Keys of runs in a result (`Mission.result`). They are printed as lines, not as a table."""


@contextmanager
def progress(options: argparse.Namespace) -> Iterator[Callable[[Mission, float], None] | None]:
    """Show the progress of a run, unless --quiet is given or the JSON goes to the terminal."""
    if options.quiet or options.json == "-":
        yield None
        return
    with live_progress() as watch:
        yield watch


@contextmanager
def kept_streams(apart: bool) -> Iterator[None]:
    """Give back the standard output and error that code of users has closed or replaced: in lock
    step it runs in this process, and the result is still to be printed. `apart`: what it prints
    goes to standard error, since a program reads the output."""
    streams, copies = (sys.stdout, sys.stderr), dict[int, int]()
    for number in (1, 2):
        with suppress(OSError):  # closed from the start
            copies[number] = os.dup(number)
    try:
        if apart:
            sys.stdout.flush()
            sys.stdout = sys.stderr
            os.dup2(2, 1)
        yield
    finally:
        for number, copy in copies.items():
            os.dup2(copy, number)
            os.close(copy)
        sys.stdout, sys.stderr = streams
        reopen_outputs()


@contextmanager
def live_progress() -> Iterator[Callable[[Mission, float], None]]:
    """Show a line about the active run, at most every 0.1 s of wall time; calls in between do
    nothing. Without a terminal it cannot be refreshed: then print one each minute."""
    console, shown = Console(stderr=True), time.monotonic()
    pause = REFRESH if console.is_terminal else NOTE
    with Live(Text("connecting"), console=console, auto_refresh=False, transient=True) as live:

        def watch(mission: Mission, now: float) -> None:
            nonlocal shown
            wall = time.monotonic()
            if wall - shown >= pause and not getattr(sys.stderr, "closed", False):
                shown = wall
                line = _line(mission, now)
                if console.is_terminal:
                    live.update(line, refresh=True)
                else:
                    print(f"still active: {line.plain.strip()}", file=sys.stderr, flush=True)

        yield watch


def _line(mission: Mission, now: float) -> Text:
    tally = mission.tally
    text = Text()
    text.append(f"{now - mission.begun:7.1f} s  " if mission.begun else "", style="dim")
    done = sum(cycle.ended is not None for cycle in tally.cycles)
    text.append(f"run {tally.begun} of {mission.runs}  ", style="bold")
    for cycle in tally.cycles[max(0, done - 20) : done]:
        text.append("\u25cf", style=COLOURS[cycle.status.value])
    going = sorted({run.place for run in mission.executor.state.runs()})
    text.append("  " + (" + ".join(going) if going else mission.stage.value))
    if mission.lost:
        text.append(f"  away: {', '.join(mission.lost)}", style="red")
    return text


def print_result(result: Mapping[str, Any]) -> None:
    """Print a result: lists of rows as tables, everything else as one line each."""
    console = Console()
    for key, value in result.items():
        if (
            key not in (LAST_ERRORS, MISSED)
            and isinstance(value, list)
            and value
            and all(isinstance(row, Mapping) for row in value)
            and len(value[0]) <= WIDEST_TABLE
        ):
            console.print(_table(key, value))
    plain = Table.grid(padding=(0, 2))
    for key, value in result.items():
        if key == "sim_s" and result.get("mode") == "realtime":
            continue  # nothing was simulated; --json has it
        if isinstance(value, bool | int | float | str):
            plain.add_row(Text(key, style="dim"), _cell(key, value))
        elif key == LAST_ERRORS:
            for row in value:
                plain.add_row(Text("error", style="dim"), Text(_error(row), style=COLOURS["error"]))
        elif key == MISSED:
            for row in value:
                line = f"{row['goals']} goal{'s' * (row['goals'] != 1)}: {_error(row)}"
                plain.add_row(Text("missed", style="dim"), Text(line, style=COLOURS["failure"]))
        elif key == LAST_FAILURE:
            told = Text(_error(value), style=COLOURS["failure"])
            plain.add_row(Text("failure", style="dim"), told)
    console.print(plain)


def _error(row: Mapping[str, Any]) -> str:
    """Describe one action that ended in ERROR or FAILURE in one line."""
    place = f" on {row['node']}" if row["node"] else ""
    why = without_controls(": ".join(filter(None, (row["cause"], row["text"]))))
    return (
        f"{row['run']}, {row['action'] or 'no action'}{place} for "
        f"{row['primitive_task']}: {why or 'no reason given'}"
    )


def _table(title: str, rows: list[Mapping[str, Any]]) -> Table:
    left_out = max(0, len(rows) - LONGEST_TABLE)
    table = Table(
        title=title,
        title_justify="left",
        caption=f"{left_out} more in --json" if left_out else None,
    )
    columns = list(dict.fromkeys(key for row in rows for key in row))
    for column in columns:
        numeric = all(isinstance(row.get(column), int | float | None) for row in rows)
        table.add_column(column, justify="right" if numeric else "left")
    for row in rows[:LONGEST_TABLE]:
        table.add_row(*(_cell(column, row.get(column)) for column in columns))
    return table


def _cell(key: str, value: Any) -> Text:
    if value is None:
        return Text("-", style="dim")
    if isinstance(value, bool):
        return Text("yes" if value else "no")
    if isinstance(value, float):
        return Text(f"{value:.4g}")
    return Text(
        without_controls(str(value)), style=COLOURS.get(str(value), "") if key == "status" else ""
    )


def _remarks(session: RunSession, result: Mapping[str, Any]) -> Iterator[str]:
    """Say where to look for the reasons of errors, and what exit code 0 does not say."""
    success = result["status"] == "success"
    if session.folder is None and (not success or LAST_ERRORS in result):
        yield (
            "not kept; with --journal runs, `petrobot log` and `petrobot report` show what led "
            "there"
        )
    elif LAST_ERRORS in result:
        yield f"what led to the errors: petrobot log {session.folder}"
    met, _, wanted = result.get("goals", "").partition(" of ")
    if success and wanted and int(met) < int(wanted):
        yield (
            f"only {result['goals']} goals were met; the exit code is 0 because the task reached "
            "its final marking"
        )


def give(session: RunSession, options: argparse.Namespace, timeline: Timeline | None) -> None:
    """Print the result, write it beside the journal and where --json says, and write the report."""
    result = session.result()
    if options.json != "-":
        print_result(result)
        for line in _remarks(session, result):
            print(line, file=sys.stderr)
    if options.json:  # first: the run's folder may have become one that cannot be written
        write_json(options.json, result)
    session.keep_result()
    if timeline is not None:
        from petrobot.coordinator.drawing import draw
        from petrobot.coordinator.studies.report import report_html

        task = session.mission.executor.task
        write_json(str(options.report / "result.json"), result, "--report a folder")
        page = options.report / "index.html"
        net = draw(task, error_branches=True)
        write_whole(page, report_html(result, timeline, net, pictures_of(task, result)))
        print(f"report: {page}")
