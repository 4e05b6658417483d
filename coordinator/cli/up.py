"""Start the nodes that services.toml places on this host, and restart those that die, until
Ctrl-C."""

from __future__ import annotations

import argparse
import asyncio
import getpass
import ipaddress
import os
import re
import signal
import socket
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import (
    add_dry_run_argument,
    add_mock_argument,
    add_services_argument,
    load_directory,
    refuse_misplaced,
    refuse_script,
    services_path,
)
from petrobot.coordinator.cli.options import add_log_level_argument, refuse_idle
from petrobot.coordinator.run.folder import NODE_LOGS
from petrobot.services.comm.protocol.security import is_loopback
from petrobot.services.host.command_line import done_before, number

if TYPE_CHECKING:
    from petrobot.services.comm.location_file import Directory

EXAMPLE = "petrobot up --services services.toml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_services_argument(parser)
    parser.add_argument(
        "--logs",
        type=Path,
        default=NODE_LOGS,
        help="folder of the nodes' logs (default: %(default)s)",
    )
    parser.add_argument(
        "--lockstep",
        action="store_true",
        help="start them as members of a lock-step cell, for one `petrobot run --join`",
    )
    parser.add_argument(
        "--await-coordinator",
        type=number(least=0.0),
        default=600.0,
        metavar="S",
        help="lock step: how long to wait for a coordinator that died to be resumed (default: "
        "%(default)g s of wall time)",
    )
    add_mock_argument(parser)
    add_dry_run_argument(parser)
    parser.add_argument("--no-respawn", action="store_true", help="do not restart a node that died")
    parser.add_argument(
        "--print-unit",
        action="store_true",
        help="only print a systemd unit that runs this command when the host starts",
    )
    add_log_level_argument(parser, "info")


def run(options: argparse.Namespace) -> int:
    """Start the nodes and watch them."""
    if options.print_unit:
        why = "not written into the unit; leave it out, and edit the unit's ExecStart"
        heeded = {"print_unit", "services", "logs", "dry_run"}
        refuse_idle(options, why, heeded=heeded)
    if not options.lockstep:
        why = "needs --lockstep: in real time, nodes wait for a coordinator without a limit"
        refuse_idle(options, why, idle={"await_coordinator"})
    directory = load_directory(options.services, options.dry_run)
    refuse_misplaced(directory, scripted=options.mock is not None)
    refuse_script(options.mock, directory)
    if options.print_unit:
        print(unit(directory, options.logs), end="")
        return 0
    return asyncio.run(_up(directory, options))


UNIT = """\
[Unit]
Description=petrobot nodes of {services}
Wants=network-online.target
After=network-online.target
# A device may be plugged in late: try again, however often the nodes have failed.
StartLimitIntervalSec=0

[Service]
User={user}
WorkingDirectory={folder}
ExecStart={command}
Restart=on-failure
RestartSec=1
# petrobot stops its nodes itself, devices first; what is left is killed.
KillMode=mixed
TimeoutStopSec=10
# If the kernel kills a worker because memory is short, its node starts another one.
OOMPolicy=continue
# Real-time priority for threads that ask for it (docs/deploy.md):
#LimitRTPRIO=50
#LimitMEMLOCK=infinity

[Install]
WantedBy=multi-user.target
"""


def unit(directory: Directory, logs: Path) -> str:
    """Return a systemd unit that starts this host's nodes, with absolute paths."""
    services = directory.source.resolve()
    program = Path(sys.executable).with_name("petrobot")
    # In a command "$" begins a variable; in all of a unit "%" begins a specifier.
    program_, services_, logs_ = (
        '"' + re.sub(r'(["\\])', r"\\\1", str(path)).replace("$", "$$") + '"'
        for path in (program, services, logs.absolute())
    )
    command = f"{program_} up --services {services_} --logs {logs_}"
    return UNIT.format(
        services=str(services).replace("%", "%%"),
        folder=str(services.parent).replace("%", "%%"),
        command=(command + " --dry-run" * directory.dry_run).replace("%", "%%"),
        user=getpass.getuser(),
    )


async def _up(directory: Directory, options: argparse.Namespace) -> int:
    from petrobot.coordinator.launch import local_programs
    from petrobot.coordinator.run.supervisor import Supervisor

    programs = local_programs(
        directory,
        lockstep=options.lockstep,
        mock=options.mock,
        awaited=options.await_coordinator,
        log_level=options.log_level,
    )
    if not programs:
        raise CommandError(2, f"{directory.source}: none of its nodes has an address of this host")
    stop = asyncio.Event()
    for each in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(each, stop.set)
    respawn = not (
        options.no_respawn or options.lockstep
    )  # a member of a lock-step cell that died cannot join it again
    supervisor = Supervisor(programs, options.logs, respawn=respawn)
    async with AsyncExitStack() as nodes:
        if not await done_before(stop, nodes.enter_async_context(supervisor)):
            return 0
        for name, process in supervisor.process_ids().items():
            node = directory.nodes[name]
            print(f"{name:12} ready on {node.host}:{node.port} (process {process})", flush=True)
            if note := only_here(node.host):
                print(f"{'':12} {note}", flush=True)
        print("Ctrl-C stops them all", flush=True)
        # Members of a lock-step cell end by themselves.
        await done_before(stop, supervisor.ended() if options.lockstep else stop.wait())
    return 0


def only_here(host: str) -> str:
    """Return a note if an address that is meant for other hosts leads each of them to itself: a
    host's own name in Debian's /etc/hosts, or 0.0.0.0; else empty."""
    if is_loopback(host):
        return ""
    try:
        known = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError:  # the name server has just gone away: the nodes listen all the same
        return ""
    found = [ipaddress.ip_address(str(at[0]).partition("%")[0]) for *_, at in known]
    if not all(address.is_loopback or address.is_unspecified for address in found):
        return ""
    own = f"{host} stands for {found[0]} here"
    why = own if found[0].is_loopback else f"{host} is not the address of one host"
    text = f"other hosts cannot reach it: {why}; write the address of this host into services.toml"
    return f"{text}, or correct /etc/hosts" if found[0].is_loopback else text


# --- one node, or the laboratory ---


class StartNode:
    """Start one node of services.toml on this host (as python -m petrobot.services NAME does)."""

    EXAMPLE = "petrobot node vision --services services.toml"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the command's options."""
        parser.add_argument("name", help="the node's name in services.toml")
        add_services_argument(parser)
        add_log_level_argument(parser, "info")

    def run(self, options: argparse.Namespace) -> int:
        """Become the node."""
        _become("petrobot.services", options, options.name)


class StartLaboratory:
    """Start the simulated laboratory on this host (as python -m petrobot.sim does)."""

    EXAMPLE = "petrobot sim --services services.toml"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the command's options."""
        add_services_argument(parser)
        add_log_level_argument(parser, "info")

    def run(self, options: argparse.Namespace) -> int:
        """Become the laboratory."""
        _become("petrobot.sim", options)


def _become(module: str, options: argparse.Namespace, *names: str) -> NoReturn:
    """Replace this process by `python -m module names`. A child process would survive when its
    parent is killed."""
    services = str(services_path(options.services))
    given = [*names, "--services", services, "--log-level", options.log_level]
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *given])
