"""The `petrobot` command: finds the sub-command, runs it, and turns every fault into one clear line
and an exit code."""

from __future__ import annotations

import argparse
import errno
import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

EXIT_CODES = """\
exit codes: 0 the task reached its final marking (or the command did its work, and its answer is yes),
            1 the task ended in ERROR or was aborted; or the answer is no: analyse refuses a verdict or does not know it,
              simulate was cut short, forecast disagrees, replay differs, a running task refuses an operator's command,
            2 bad input (check: the task may not run), 3 a node is unreachable, 130 interrupted"""


FILE_FAULTS = {
    **dict.fromkeys(
        (errno.ENOSPC, errno.EDQUOT, errno.EFBIG),
        "free some space, or name a place on another disk",
    ),
    **dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), "name a place that you may write to"),
    **dict.fromkeys(
        (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST), "name another place"
    ),
    errno.EIO: "look after the disk",
}
"""What to do about a file that cannot be written, by errno(3), where a command has no better
words."""


class CommandError(Exception):
    """A command cannot go on: what to print and the exit code."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True, slots=True)
class Command:
    """One sub-command; its module is imported only when it is used, so that quick commands stay
    quick."""

    name: str
    summary: str
    module: str = ""
    """Under `coordinator.cli`; empty: that of its name."""


COMMANDS = (
    Command("run", "run a task"),
    Command("serve", "the operator's page: draw tasks and start them"),
    Command("resume", "go on with a run whose coordinator was killed"),
    Command("watch", "follow the run that goes on", "operate.watch"),
    Command("pause", "pause it; every node says whether its devices hold", "operate.pause"),
    Command("continue", "let it go on", "operate.go_on"),
    Command("step", "let it go on for one firing", "operate.step"),
    Command("break", "pause it before a transition or at a place", "operate.breakpoints"),
    Command("token", "put tokens into a control place, or take some out", "operate.tokens"),
    Command("raise", "raise an external event by hand", "operate.events"),
    Command("force", "leave an action place whatever its run does", "operate.force"),
    Command("override", "choose the alternative of a primitive task by hand", "operate.override"),
    Command("abort", "give it up", "operate.abort"),
    Command("estop", "emergency stop, straight to the nodes and their bus"),
    Command("log", "print or export a recorded run"),
    Command("campaign", "run a task many times in parallel lock-step cells"),
    Command("report", "write a report of a run or a campaign, or compare two campaigns"),
    Command("forecast", "forecast further runs from measured ones, and compare"),
    Command("learned", "what was learned: show, merge, freeze, reset an estimates file"),
    Command("replay", "derive a recorded run again and compare"),
    Command("check", "check a task before it runs"),
    Command("analyse", "verify a net or task, and forecast it"),
    Command("simulate", "play a net many times by chance"),
    Command("convert", "read a net in one format, write it in another"),
    Command("show", "draw a task as SVG"),
    Command("up", "launch the nodes that services.toml places on this host"),
    Command("nodes", "who is up, and what it offers"),
    Command("node", "launch one node"),
    Command("sim", "launch the simulated laboratory"),
    Command("calibrate", "calibrate a camera from images of a board"),
    Command("keys", "make the shared key that several hosts need"),
    Command("new", "write the skeleton of an action or a task"),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; gives the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["--version"]:
        from importlib.metadata import version  # takes longer to import than all else here

        print(f"petrobot {version('petrobot')}")
        return 0
    known = {command.name: command for command in COMMANDS}
    if not arguments or arguments[0] not in known:
        return _overview(arguments)
    return _dispatch(known[arguments[0]], arguments[1:])


def _overview(arguments: Sequence[str]) -> int:
    width = max(len(command.name) for command in COMMANDS) + 2
    lines = [f"  {command.name:{width}}{command.summary}" for command in COMMANDS]
    text = "\n".join(
        [
            "usage: petrobot COMMAND ...   (petrobot COMMAND --help shows its options and an "
            "example)",
            "",
            "coordinates real robots with Petri nets: a task is one net, its actions run on "
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
    print(f"petrobot: no command {arguments[0]!r}\n\n{text}", file=sys.stderr)
    return 2


def _dispatch(command: Command, arguments: Sequence[str]) -> int:
    module = importlib.import_module(f"petrobot.coordinator.cli.{command.module or command.name}")
    parser = argparse.ArgumentParser(
        prog=f"petrobot {command.name}",
        description=module.__doc__,
        epilog=f"example:\n  {module.EXAMPLE}\n\n{EXIT_CODES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    try:
        options = parser.parse_args(arguments)
    except SystemExit as leaving:
        return int(leaving.code or 0)
    if level := getattr(options, "log_level", None):
        from petrobot.coordinator.cli.options import log_to_stderr

        log_to_stderr(level)
    try:
        return _run(module.run, options)
    except CommandError as fault:
        print(f"petrobot {command.name}: {fault}", file=sys.stderr)
        return fault.code
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()  # the reader went away; Python would complain once more at exit
        return 1


def _run(run: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """Run a command; keys and files that cannot be used are bad input, whichever command needs
    them."""
    try:
        return int(run(options))
    except OSError as fault:
        if fault.errno not in FILE_FAULTS:
            raise
        what = f"{fault.filename}: {fault.strerror}" if fault.filename else str(fault.strerror)
        raise CommandError(2, f"{what}; {FILE_FAULTS[fault.errno]}") from fault
    except Exception as fault:
        from petrobot.services.comm.protocol.security import KeyFileError, KeyNeededError

        if isinstance(fault, KeyFileError | KeyNeededError):
            raise CommandError(2, str(fault)) from fault
        raise
