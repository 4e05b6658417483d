"""`petrobot` as it is, but for the way to its nodes: `by_proxy.py LEFT,RIGHT ARGUMENT ...` reaches
them through these ports.

services.toml, and so its hash, is that of the nodes: only the addresses that are connected to are
others.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from petrobot.coordinator.cli import main
from petrobot.services.comm import location_file as directory
from petrobot.services.comm.location_file import Directory

NODES = ("left", "right")


def by_proxy(
    parse: Callable[[str, Path], Directory], ports: list[int]
) -> Callable[[str, Path], Directory]:
    """`parse` with the nodes' ports replaced."""

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
