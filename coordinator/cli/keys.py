"""Make a shared key, or certificates (--tls), so that several hosts trust each other. The output
says where to copy them, and how to replace older ones without an outage."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import add_services_argument, load_directory
from petrobot.coordinator.cli.options import refuse_idle
from petrobot.services.comm.protocol.messages import COORDINATOR

if TYPE_CHECKING:
    from petrobot.services.comm.location_file import Directory

EXAMPLE = "petrobot keys --tls"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "--file",
        type=Path,
        default=Path("cell.key"),
        help="file to write the shared key to (default: %(default)s)",
    )
    parser.add_argument(
        "--tls",
        type=Path,
        metavar="FOLDER",
        nargs="?",
        const=Path("keys"),
        help="make certificates for mutual TLS in this folder (default: %(const)s) instead; TLS "
        "also encrypts",
    )
    add_services_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Write the key or the certificates. Existing files are kept, except certificates that expire
    within 30 days."""
    if options.tls is not None:
        why = "it is for the shared key, and --tls makes certificates; leave one out"
        refuse_idle(options, why, idle={"file"})
    directory = load_directory(options.services)
    print(
        _certificates(directory, options.tls)
        if options.tls is not None
        else _shared_key(directory, options.file)
    )
    return 0


def _shared_key(directory: Directory, file: Path) -> str:
    from petrobot.services.comm.protocol.security import new_key, write_key

    write_key(file, new_key())
    hosts = ", ".join(sorted({node.host for node in directory.nodes.values()}))
    return (
        f"wrote {file}: only you can read it; it is never printed or logged\n"
        f"1. copy it beside services.toml on every host ({hosts}), for example: scp -p "
        f"{file} HOST:FOLDER/\n"
        f"2. name it in {directory.source}, the same on every host:\n"
        f'   [keys]\n   file = "{file.name}"' + _instead(directory, "file", file.name)
    )


def _instead(directory: Directory, kind: str, new: str) -> str:
    """Describe how to replace the key that services.toml names now, host by host. Empty if it names
    none of this kind, or already this one."""
    old = directory.keys.get(kind, new)
    if old == new:
        return ""
    both = [f'{kind} = "{new}", also = "{old}"']
    # No host may show a certificate of the new authority before all hosts accept that authority.
    if kind == "certificates":
        both.insert(0, f'{kind} = "{old}", also = "{new}"')
    passes = [*both, f'{kind} = "{new}" alone']
    lines = [
        f"to replace {old}, make {len(passes)} rounds; in each round change one host after the "
        "other and restart its nodes:"
    ]
    lines += [f"   round {number}: [keys] {keys}" for number, keys in enumerate(passes, 1)]
    return "\n" + "\n".join([*lines, f"then remove {old} from every host"])


def _certificates(directory: Directory, folder: Path) -> str:
    try:
        from petrobot.services.comm.tls.certificates import CA_KEY, make_certificates
    except ImportError as fault:
        text = (
            "making certificates needs the package cryptography: pip install "
            f"'petrobot[tls]' ({fault})"
        )
        raise CommandError(2, text) from fault
    from petrobot.services.comm.tls.credentials import CA_FILE

    written = make_certificates(folder, [COORDINATOR, *directory.nodes])
    by_host: dict[str, list[str]] = {}
    for node in directory.nodes.values():
        by_host.setdefault(node.host, []).append(node.name)
    copies = [
        f"   {host}: {', '.join([CA_FILE, *(f'{name}.pem, {name}.key' for name in names)])}"
        for host, names in sorted(by_host.items())
    ]
    return "\n".join(
        [
            f"wrote {', '.join(written)} in {folder}"
            if written
            else f"{folder} has a certificate for every node already",
            f"1. copy into a folder {folder.name}/ beside services.toml (scp -p keeps keys "
            "unreadable for others), on",
            *copies,
            "   the coordinator's host, and wherever `petrobot estop` is to work: "
            f"{CA_FILE}, {COORDINATOR}.pem, "
            f"{COORDINATOR}.key",
            f"2. keep {CA_KEY} here alone: who has it can make certificates; it is needed "
            "when a node is added, and when",
            "   certificates end: run this again in their last 30 days (petrobot nodes and "
            "each node's start say so)",
            f"3. name the folder in {directory.source}, the same on every host:",
            f'   [keys]\n   certificates = "{folder.name}"',
        ]
    ) + _instead(directory, "certificates", folder.name)
