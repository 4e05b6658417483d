"""Options that several commands share: parameters of a task, the port of the page, the log level."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli import CommandError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from petrobot.coordinator.task import Task


def parameter_of(task: Task, name: str, text: str) -> Any:
    """The value of a parameter from its text, of the same type as its default. Raises
    CommandError."""
    if name not in task.parameters:
        known = ", ".join(task.parameters) or "none"
        raise CommandError(2, f"{task.name} has no parameter {name!r}; it has: {known}")
    default = task.parameters[name]
    if isinstance(default, bool):
        if text not in ("true", "false"):
            raise CommandError(2, f"parameter {name}: {text!r} is neither true nor false")
        return text == "true"
    try:
        return type(default)(text) if isinstance(default, int | float) else text
    except ValueError as fault:
        raise CommandError(
            2, f"parameter {name}: {text!r} is no {type(default).__name__}"
        ) from fault


def pairs(option: str, texts: list[str]) -> Iterator[tuple[str, str]]:
    """NAME=VALUE as users write it. Raises CommandError."""
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise CommandError(2, f"{option} {text}: write NAME=VALUE")
        yield name, value


# The port of the operator's page: how it is given, and what is said when it cannot be had.


def add_page_port_argument(parser: argparse.ArgumentParser) -> None:
    """`--page-port`."""
    parser.add_argument(
        "--page-port",
        type=_port,
        default=0,
        metavar="PORT",
        help="the page's port (default: a free one)",
    )


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(
            f"{text} is no port: give a number from 1 to 65535, or 0 for a free one"
        )
    return int(text)


@contextmanager
def named_port(port: int) -> Iterator[None]:
    """Around the start of a page. Raises CommandError (2) when its port cannot be had."""
    try:
        yield
    except OSError as fault:
        raise CommandError(
            2, f"port {port}: {fault.strerror or fault}; choose another with --page-port"
        ) from fault


# Logging of the coordinator: one logger per package, to standard error.

LOG_LEVELS = ("debug", "info", "warning", "error")


def add_log_level_argument(parser: argparse.ArgumentParser, default: str = "warning") -> None:
    """`--log-level`."""
    parser.add_argument(
        "--log-level",
        choices=LOG_LEVELS,
        default=default,
        help="what is logged to standard error; info: links to nodes, runs, restarts, refusals "
        "(default: %(default)s)",
    )


class _StandardError(logging.Handler):
    """Writes to standard error as it is now: a progress display may have replaced it."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        print(self.format(record), file=sys.stderr, flush=True)


def log_to_stderr(level: str) -> None:
    """Log what the project's loggers say, from this level on."""
    logger = logging.getLogger("petrobot")
    logger.setLevel(level.upper())
    if not any(isinstance(handler, _StandardError) for handler in logger.handlers):
        handler = _StandardError()
        handler.setFormatter(
            logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s", "%H:%M:%S")
        )
        logger.addHandler(handler)
