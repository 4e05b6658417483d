"""Start the simulated laboratory: `python -m petrobot.sim [--services FILE] [--lockstep]`."""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Sequence
from pathlib import Path

from petrobot.services.comm.location_file import Directory, DirectoryError, load, resolve
from petrobot.services.comm.lockstep.mesh import CellError, run_member
from petrobot.services.comm.protocol.security import KeyFileError, KeyNeededError
from petrobot.services.host.command_line import (
    LOG_LEVELS,
    add_log_level,
    add_member_options,
    log_to_stderr,
)
from petrobot.sim.catching.truth import LaboratoryError
from petrobot.sim.realtime import serve

EXAMPLE = "example:\n  python -m petrobot.sim --services services.toml"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    commands = argparse.ArgumentParser(
        prog="python -m petrobot.sim",
        description="Start the simulated laboratory: the node of services.toml with a key `sim`.",
        epilog=f"{EXAMPLE}\n\nexit codes: 0 ended by SIGTERM, 2 bad services.toml or cell "
        "file, 3 the cell lost a party",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_member_options(commands)
    commands.add_argument("--dry-run", action="store_true", help="serve nodes of a dry run")
    add_log_level(commands)
    return commands


def read(path: Path, dry_run: bool) -> tuple[Directory, str]:
    """Return the location file and the name of its simulated node. Raises DirectoryError."""
    try:
        directory = load(path, dry_run)
    except OSError as fault:
        raise DirectoryError(
            (f"{path}: {fault.strerror}; name the file with --services",)
        ) from fault
    name = directory.laboratory()
    if not name:
        text = (
            'no node is simulated; write sim = "petrobot.sim.catching.laboratory:make_laboratory" '
            "in one [nodes.NAME]"
        )
        raise DirectoryError((f"{path}: {text}",))
    return directory, name


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the laboratory; return the exit code."""
    options = parser().parse_args(arguments)
    log_to_stderr(LOG_LEVELS[options.log_level])
    try:
        directory, name = read(options.services, options.dry_run)
        if options.lockstep:
            laboratory = resolve(directory.nodes[name].sim)(directory, name)
            run_member(directory, name, laboratory, options.await_coordinator)
        else:
            asyncio.run(serve(directory, name))
    except (
        DirectoryError,
        LaboratoryError,
        KeyNeededError,
        KeyFileError,
        ImportError,
        ValueError,
        OSError,
    ) as fault:
        print(f"python -m petrobot.sim: {fault}", file=sys.stderr)
        return 2
    except CellError as fault:
        print(f"python -m petrobot.sim: {fault}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
