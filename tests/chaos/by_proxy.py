"""Run `petrobot` with its nodes reached through a proxy: `by_proxy.py LEFT,RIGHT ARGUMENT ...`
connects to these ports.

services.toml, and so its hash, is that of the nodes; only the addresses for connecting differ.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from msgspec.structs import replace

from petrobot.coordinator.cli import main
from petrobot.services.comm import location_file as directory
from petrobot.services.comm.location_file import Directory

NODES = ("left", "right")


def by_proxy(
    parse: Callable[[str, Path], Directory], ports: list[int]
) -> Callable[[str, Path], Directory]:
    """Parse services.toml, and replace the nodes' ports."""

    def moved(text: str, source: Path) -> Directory:
        read = parse(text, source)
        nodes = {
            name: replace(read.nodes[name], port=port)
            for name, port in zip(NODES, ports, strict=True)
        }
        return replace(read, nodes={**read.nodes, **nodes})

    return moved


if __name__ == "__main__":
    proxies = [int(port) for port in sys.argv[1].split(",")]
    setattr(directory, "parse", by_proxy(directory.parse, proxies))  # noqa: B010
    sys.exit(main(sys.argv[2:]))
