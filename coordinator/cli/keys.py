"""Make the shared key that nodes on several hosts need, and say where to copy it."""

from __future__ import annotations

import argparse
from pathlib import Path

from coordinator.cli import CommandError
from coordinator.cli.loading import add_services_argument, load_directory, services_path

EXAMPLE = "petrobot keys --file cell.key"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "--file", type=Path, default=Path("cell.key"), help="the key file to write (default: %(default)s)"
    )
    add_services_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Write the key; an existing one is never overwritten."""
    from services.comm.security import KeyFileError, new_key, write_key

    directory = load_directory(options.services)
    try:
        write_key(options.file, new_key())
    except KeyFileError as fault:
        raise CommandError(2, str(fault)) from fault
    hosts = ", ".join(sorted({node.host for node in directory.nodes.values()}))
    print(
        f"wrote {options.file}: readable by you alone, never printed, never logged\n"
        f"1. copy it beside services.toml on every host ({hosts}), for example: scp -p {options.file} HOST:FOLDER/\n"
        f"2. name it in {services_path(options.services)}, the same on every host:\n"
        f'   [keys]\n   file = "{options.file.name}"'
    )
    return 0
