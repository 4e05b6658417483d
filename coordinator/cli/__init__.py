"""The `petrobot` command: find the sub-command, run it, and turn every fault into one clear line
and an exit code."""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from msgspec import Struct

from petrobot.services.host.command_line import leave_threads
from petrobot.services.host.emergency_latch import uptime
from petrobot.services.host.toml_text import InputError

EXIT_CODES = """\
exit codes:
    0  the task reached its final marking, or the command did its work and the answer is yes
    1  the task ended in ERROR or was aborted, or the answer is no: analyse refutes or cannot decide
       a property, simulate was cut short, forecast or replay disagrees, the active task refuses an
       operator's command
    2  bad input (check: the task may not run), or nothing was begun because an emergency stop or
       another run holds a device
    3  a node cannot be reached or is not ready, or a device is not known to stand still (estop)
  130  interrupted
  141  the program that reads its output has closed it"""
SHORT_EXIT_CODES = """\
exit codes:
    0  done
    2  bad input
    3  a node cannot be reached or is not ready
  130  interrupted
  141  the program that reads its output has closed it"""


FILE_FAULTS = {
    **dict.fromkeys(
        (errno.ENOSPC, errno.EDQUOT, errno.EFBIG),
        "free some space, or choose a path on another disk",
    ),
    **dict.fromkeys(
        (errno.EROFS, errno.EACCES, errno.EPERM), "choose a path that you may write to"
    ),
    **dict.fromkeys(
        (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST), "choose another path"
    ),
    errno.EIO: "check the disk",
}
"""What to do about a file that cannot be written, by errno(3), unless the command says more."""


class CommandError(InputError):
    """A command cannot continue: its exit code, and the text to print."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(code, text)
        self.exit_code, self.text = code, text

    def __str__(self) -> str:
        return self.text


@contextmanager
def file_of(path: object, remedy: str) -> Iterator[None]:
    """Turn an OSError about a file or folder, such as a full disk, into CommandError."""
    try:
        yield
    except OSError as fault:
        raise CommandError(2, f"{path}: {fault.strerror or fault}; {remedy}") from fault


PIPE_CLOSED = 128 + 13
"""Exit code of a program that SIGPIPE has ended: 1 would say that the answer is no."""


class Subcommand(Struct, frozen=True):
    """One sub-command. Its module is imported only when it is used: quick commands stay quick."""

    name: str
    summary: str
    home: str = ""
    """Where it stands below `coordinator.cli`, as `module:Class` if several share a module; empty
    if it is a module of the command's name."""


COMMANDS = (
    Subcommand("run", "run a task"),
    Subcommand("serve", "the operator's page: draw tasks and start them"),
    Subcommand("resume", "continue a run whose coordinator was killed"),
    Subcommand("watch", "follow the active run"),
    Subcommand(
        "pause",
        "pause the active run; each node reports whether its devices hold",
        "operate:PauseRun",
    ),
    Subcommand("continue", "continue the paused run", "operate:ContinueRun"),
    Subcommand("step", "fire one transition of the run, then pause", "operate:StepRun"),
    Subcommand(
        "break",
        "pause before a transition fires or when a place is entered",
        "operate:SetBreakpoint",
    ),
    Subcommand("token", "add or remove tokens of a control place", "operate:ChangeTokens"),
    Subcommand("raise", "raise an external event by hand", "operate:RaiseByHand"),
    Subcommand(
        "force",
        "take a token out of an action place, even of an active run",
        "operate:ForceTransition",
    ),
    Subcommand(
        "override", "choose the action of a primitive task by hand", "operate:OverrideSelector"
    ),
    Subcommand(
        "remark", "write a remark into the journal of the active run", "operate:WriteRemark"
    ),
    Subcommand("abort", "abort the active run", "operate:AbortRun"),
    Subcommand("estop", "emergency stop: stop all devices through their nodes and their bus"),
    Subcommand("log", "print or export a recorded run"),
    Subcommand("film", "make a film of a recorded lock-step run"),
    Subcommand("campaign", "run a task many times in parallel lock-step cells"),
    Subcommand("report", "write a report of a run or a campaign, or compare two campaigns"),
    Subcommand("forecast", "forecast further runs from measured ones, and compare"),
    Subcommand("learned", "show, merge, freeze or reset what was learned (an estimates file)"),
    Subcommand("replay", "replay a recorded run and compare"),
    Subcommand("check", "check a task before it runs"),
    Subcommand("analyse", "verify a net or task, and forecast its times"),
    Subcommand("simulate", "simulate a net many times with random times and choices"),
    Subcommand("convert", "convert a net from one file format to another"),
    Subcommand("show", "draw a task as SVG"),
    Subcommand("up", "start the nodes that services.toml places on this host"),
    Subcommand("nodes", "show which nodes are up, and what they offer"),
    Subcommand("node", "start one node", "up:StartNode"),
    Subcommand("sim", "start the simulated laboratory", "up:StartLaboratory"),
    Subcommand("calibrate", "calibrate a camera from images of a board"),
    Subcommand("keys", "make the shared key or the certificates that several hosts need"),
    Subcommand("test", "check that a driver keeps the rules of drivers, with its device"),
    Subcommand("new", "write a working robot, or a skeleton of a driver, an action or a task"),
)
PLAIN = (
    *("calibrate", "convert", "film", "keys", "learned", "log", "new", "node", "nodes", "report"),
    *("serve", "show", "sim", "up"),
)
"""Commands that neither run nor judge a task; they use only some of the exit codes."""


MEANT = {
    "start": "'run' or 'up'",
    "stop": "'abort' or 'estop'",
    "status": "'nodes' or 'watch'",
    "version": "'--version'",
}
"""What is probably meant by words that are no commands."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    if argv is not None:
        return _safe_main(list(argv), uptime())
    _open_standard_files()
    code = _safe_main(sys.argv[1:], _begun())
    leave_threads(code)
    return code


def _open_standard_files() -> None:
    """Open what the caller has closed of standard input, output and error (`>&-`): else the next
    files that this process and its children open get their numbers, and with them what is
    printed."""
    while (number := os.open(os.devnull, os.O_RDWR)) < 3:
        os.set_inheritable(number, True)
    os.close(number)
    sys.stdout, sys.stderr = sys.stdout or os.fdopen(1, "w"), sys.stderr or os.fdopen(2, "w")


def _safe_main(arguments: list[str], ordered: float) -> int:
    try:
        code = _main(arguments, ordered)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:  # also while modules are imported: that takes longest
        print("interrupted", file=sys.stderr)
        return 130
    except (BrokenPipeError, InputError, SystemExit) as fault:
        # A command may have made bad input of it, and rich ends the process with 1.
        if not isinstance(fault.__context__ or fault, BrokenPipeError):
            raise
        # The program that reads our output has closed it. Python would try again at exit to write
        # what is left, and report it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED


def _begun() -> float:
    """Return when this process was started (`uptime`): Python may have been frozen before it read
    its first line. A program that was started by `exec` counts from the start of its shell."""
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    return int(fields[19]) / os.sysconf("SC_CLK_TCK")


def _main(arguments: list[str], ordered: float) -> int:
    if arguments[:1] == ["--version"]:
        from importlib.metadata import version  # slower to import than all the rest here

        print(f"petrobot {version('petrobot')}")
        return 0
    known = {command.name: command for command in COMMANDS}
    if not arguments or arguments[0] not in known:
        return _overview(arguments)
    return _dispatch(known[arguments[0]], arguments[1:], ordered)


def _overview(arguments: Sequence[str]) -> int:
    width = max(len(command.name) for command in COMMANDS) + 2
    lines = [f"  {command.name:{width}}{command.summary}" for command in COMMANDS]
    text = "\n".join(
        [
            "usage: petrobot COMMAND ...   (petrobot COMMAND --help shows its options and an "
            "example)",
            "",
            "coordinates real robots with Petri nets: a task is one net, and its actions run on "
            "the nodes of services.toml",
            "",
            *lines,
            "",
            EXIT_CODES,
        ]
    )
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(text)
        return 0
    from petrobot.coordinator.task.wording import nearest

    near = nearest(arguments[0], (command.name for command in COMMANDS))
    if meant := MEANT.get(arguments[0]):
        near = f" (did you mean {meant}?)"
    elif arguments[0].endswith(".toml"):
        near = f" (did you mean 'run {arguments[0]}'?)"
    print(f"petrobot: unknown command {arguments[0]!r}{near}\n\n{text}", file=sys.stderr)
    return 2


class _OptionParser(argparse.ArgumentParser):
    """Tells a wrong option in one line: the usage of a command has up to 20."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; {self.prog} --help shows its options\n")


def _dispatch(command: Subcommand, arguments: Sequence[str], ordered: float) -> int:
    module, _, shared = (command.home or command.name).partition(":")
    found = importlib.import_module(f"petrobot.coordinator.cli.{module}")
    if shared:
        found = getattr(found, shared)()
    codes = SHORT_EXIT_CODES if command.name in PLAIN else EXIT_CODES
    parser = _OptionParser(
        prog=f"petrobot {command.name}",
        description=found.__doc__,
        epilog=f"example:\n  {found.EXAMPLE}\n\n{codes}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    found.add_arguments(parser)
    try:
        options = parser.parse_args(arguments)
    except SystemExit as leaving:
        return int(leaving.code or 0)
    options.ordered, options.parser = ordered, parser
    if level := getattr(options, "log_level", None):
        from petrobot.coordinator.cli.options import log_to_stderr

        log_to_stderr(level)
    try:
        return _run(found.run, options)
    except InputError as fault:
        if isinstance(fault.__cause__, BrokenPipeError):
            raise
        print(f"petrobot {command.name}: {fault}", file=sys.stderr)
        return fault.exit_code


def _run(run: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """Run a command. Files that cannot be used are bad input in every command."""
    try:
        return int(run(options))
    except OSError as fault:
        if fault.errno not in FILE_FAULTS:
            raise
        what = f"{fault.filename}: {fault.strerror}" if fault.filename else str(fault.strerror)
        raise CommandError(2, f"{what}; {FILE_FAULTS[fault.errno]}") from fault
