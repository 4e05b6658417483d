"""Launches one node of services.toml on this host: `python -m petrobot.services NAME [--services
FILE]`."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from petrobot.services.comm.location_file import (
    Directory,
    DirectoryError,
    load,
    verify_imports,
)
from petrobot.services.comm.location_file.reading import nearest
from petrobot.services.comm.protocol.security import KeyFileError, KeyNeededError
from petrobot.services.host.command_line import (
    LOG_LEVELS,
    add_log_level,
    add_member_options,
    leave_threads,
    log_to_stderr,
)
from petrobot.services.host.parent_death import die_with, wanted_with_parent
from petrobot.services.node.realtime import serve
from petrobot.services.scripted import ScriptError, load as load_script

EXAMPLE = "example:\n  python -m petrobot.services vision --services services.toml"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    commands = argparse.ArgumentParser(
        prog="python -m petrobot.services",
        description=__doc__,
        epilog=f"{EXAMPLE}\n\nexit codes: 0 ended by SIGTERM, 2 bad services.toml or device, "
        "3 the cell lost a party",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands.add_argument("name", help="the node's name in services.toml")
    add_member_options(commands)
    commands.add_argument(
        "--mock", metavar="FILE", default="", help="replace the actions that this file scripts"
    )
    commands.add_argument("--dry-run", action="store_true", help="keep all drives off")
    add_log_level(commands)
    return commands


def read(path: Path, name: str, dry_run: bool) -> tuple[Directory, str]:
    """The location file and its text. Raises DirectoryError when it is bad or this node cannot run
    here."""
    try:
        directory = load(path, dry_run)
        text = directory.text
    except OSError as fault:
        raise DirectoryError(
            (f"{path}: {fault.strerror}; name the file with --services",)
        ) from fault
    if name not in directory.nodes:
        raise DirectoryError(
            (f"{path}: no node is named {name!r}{nearest(name, directory.nodes)}",)
        )
    if directory.nodes[name].sim:
        raise DirectoryError(
            (
                f"{path}: {name!r} is the simulated laboratory; launch it with python -m "
                "petrobot.sim",
            )
        )
    faults = verify_imports(directory, name)
    if faults:
        raise DirectoryError(faults)
    return directory, text


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node; gives the exit code."""
    options = parser().parse_args(arguments)
    log_to_stderr(LOG_LEVELS[options.log_level])
    try:
        directory, text = read(options.services, options.name, options.dry_run)
        if options.mock:
            load_script(options.mock)
        if options.lockstep:
            return _run_in_lockstep(directory, options)
        memory = directory.nodes[options.name].worker_memory_mb << 20
        asyncio.run(serve(directory, options.name, text, mock=options.mock, memory=memory))
    except (DirectoryError, ScriptError, KeyNeededError, KeyFileError, OSError) as fault:
        print(f"node {options.name}: {fault}", file=sys.stderr)
        return 2
    return 0


def _run_in_lockstep(directory: Directory, options: argparse.Namespace) -> int:
    # Imported here: a node in real time starts in half the time without numpy.
    from petrobot.services.comm.lockstep.cell import CellError
    from petrobot.services.comm.lockstep.mesh import run_member
    from petrobot.services.node.lockstep import LockstepNode

    if wanted_with_parent():
        die_with(os.getppid())
    substitutes = load_script(options.mock) if options.mock else None
    try:
        party = LockstepNode(directory, options.name, substitutes=substitutes)
        run_member(directory, options.name, party, options.await_coordinator)
    except CellError as fault:
        print(f"node {options.name}: {fault}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    code = main()
    leave_threads(code)
    sys.exit(code)
