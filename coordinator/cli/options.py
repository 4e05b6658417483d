"""Options that several commands share: parameters of a task, the port of the page, the log level,
recorded runs."""

from __future__ import annotations

import argparse
import getpass
import logging
import os
import sys
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from petrobot.coordinator.cli import CommandError
from petrobot.services.host.command_line import whole, write_in_thread

if TYPE_CHECKING:
    from petrobot.coordinator.operator.start_from import Recorded
    from petrobot.coordinator.task import Task


def parameter_of(task: Task, name: str, text: str) -> Any:
    """Return the value of a parameter from its text, in the type of its default. Raises
    CommandError."""
    if name not in task.parameters:
        known = ", ".join(task.parameters) or "none"
        raise CommandError(2, f"task {task.name} has no parameter {name!r}; it has: {known}")
    default = task.parameters[name]
    if isinstance(default, bool):
        if text not in ("true", "false"):
            raise CommandError(2, f"parameter {name}: expected true or false, got {text!r}")
        return text == "true"
    try:
        return type(default)(text) if isinstance(default, int | float) else text
    except ValueError as fault:
        raise CommandError(
            2, f"parameter {name}: expected {type(default).__name__}, got {text!r}"
        ) from fault


def pairs(option: str, texts: Iterable[str], form: str = "NAME=VALUE") -> dict[str, str]:
    """Split texts of the form NAME=VALUE. Raises CommandError, also for a name with two values."""
    found: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise CommandError(2, f"{option} {text}: expected {form}")
        if found.setdefault(name, value) != value:
            raise CommandError(2, f"{option}: {name} is given as {found[name]} and as {value}")
    return found


def parameter_texts(options: argparse.Namespace) -> dict[str, str]:
    """Return the texts of all parameters that `--set` and `--regime` give. Raises CommandError."""
    regime = [] if options.regime is None else [f"regime={options.regime}"]
    return pairs("--set", [*options.set, *regime])


def refuse_idle(
    options: argparse.Namespace,
    why: str,
    *,
    idle: Collection[str] = (),
    heeded: Collection[str] = (),
) -> None:
    """Raise CommandError for an option that was given and would have no effect: one of `idle`, or
    one that is not in `heeded`. (Given means other than its default.) `why` says why it has none,
    and what to do."""
    for action in options.parser._actions:  # parse_args([]) would ask for the arguments without --
        name, default = action.dest, action.default
        given = getattr(options, name, default) != default
        if given and (name in idle or (heeded and name not in heeded)):
            said = "TASK" if name == "task" else f"--{name.replace('_', '-')}"
            raise CommandError(2, f"{said}: {why}")


# The port of the operator's page: its option, and the message when it cannot be used.


def add_page_port_argument(parser: argparse.ArgumentParser) -> None:
    """Add `--page-port`."""
    parser.add_argument(
        "--page-port",
        type=_port,
        default=0,
        metavar="PORT",
        help="port of the page (default: a free one)",
    )


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(
            f"expected a port from 1 to 65535, or 0 for a free one, got {text}"
        )
    return int(text)


@contextmanager
def named_port(port: int) -> Iterator[None]:
    """Turn the OSError of a port that cannot be used into CommandError (2)."""
    try:
        yield
    except OSError as fault:
        # The text of the fault repeats the address.
        why = os.strerror(fault.errno) if fault.errno else str(fault)
        text = f"port {port}: {why}; choose another with --page-port"
        raise CommandError(2, text) from fault


def page_line(url: str) -> str:
    """Return the line with the page's address. In an SSH session there is a second one: how the
    browser of the user's own computer reaches the page."""
    said = os.environ.get("SSH_CONNECTION", "").split()
    if len(said) != 4:
        return f"page: {url}"
    _, _, host, ssh = said
    port = urlsplit(url).port
    other = f" -p {ssh}" if ssh != "22" else ""
    tunnel = f"ssh{other} -L {port}:127.0.0.1:{port} {getpass.getuser()}@{host}"
    return f"page: {url}\non your own computer: run `{tunnel}`, then open the same address there"


# Logging of the coordinator: one logger per package, to standard error.

LOG_LEVELS = ("debug", "info", "warning", "error")


def add_log_level_argument(parser: argparse.ArgumentParser, default: str = "warning") -> None:
    """Add `--log-level`."""
    parser.add_argument(
        "--log-level",
        choices=LOG_LEVELS,
        default=default,
        help="how much is logged to standard error; info: links to nodes, runs, restarts, refusals "
        "(default: %(default)s)",
    )


class _StandardError(logging.Handler):
    """Writes to standard error as it is now: a progress display may have replaced it."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        print(self.format(record), file=sys.stderr, flush=True)


def log_to_stderr(level: str) -> None:
    """Log the records of this level and above to standard error. A terminal that is stopped
    (Ctrl-S) or hangs must not stop a mission, so nothing waits for it."""
    write_in_thread("stderr")
    logger = logging.getLogger("petrobot")
    logger.setLevel(level.upper())
    if not any(isinstance(handler, _StandardError) for handler in logger.handlers):
        handler = _StandardError()
        handler.setFormatter(
            logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s", "%H:%M:%S")
        )
        logger.addHandler(handler)


# --- recorded runs ---


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


def add_runs_argument(parser: argparse.ArgumentParser) -> None:
    """Add the option that names the folder of runs."""
    parser.add_argument(
        "--journal",
        metavar="FOLDER",
        type=Path,
        default=Path("runs"),
        help="where runs are kept (default: %(default)s)",
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
    InputError."""
    from petrobot.coordinator.operator.start_from import read_recorded
    from petrobot.coordinator.run.folder import journal_of

    try:
        return read_recorded(journal_of(name))
    except (KeyError, OSError) as fault:
        raise CommandError(2, f"{name}: {fault}") from fault
