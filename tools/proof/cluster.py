"""A campaign on a Dask cluster of two hosts, whose workers are added and killed, gives the table of
one process to the bit.

The hosts are two network namespaces with a virtual cable between them, so this needs root and
`ip` (iproute2), and the extra `cluster`:

    python -m tools.proof.cluster --runs 96
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from tools.proof.proof import ROOT

from petrobot.coordinator.studies.campaign.table import TABLE

HERE, THERE = "petrobot-here", "petrobot-there"
ADDRESSES = {HERE: "10.77.0.1", THERE: "10.77.0.2"}
PORT = 8786
PATIENCE = 900.0
"""Seconds that the campaign may take."""


def ip(*words: str) -> None:
    """Run a command of iproute2. Raises CalledProcessError."""
    subprocess.run(["ip", *words], check=True)


@contextmanager
def two_hosts() -> Iterator[None]:
    """Two network namespaces with a cable between them."""
    with ExitStack() as undone:
        for host in ADDRESSES:
            ip("netns", "add", host)
            undone.callback(ip, "netns", "delete", host)
        ends = dict(zip(ADDRESSES, ("pb0", "pb1"), strict=True))
        ip("link", "add", "pb0", "netns", HERE, "type", "veth", "peer", "pb1", "netns", THERE)
        for host, address in ADDRESSES.items():
            ip("-n", host, "address", "add", f"{address}/24", "dev", ends[host])
            for end in ("lo", ends[host]):
                ip("-n", host, "link", "set", end, "up")
        yield


class Processes:
    """Processes on the two hosts; all are killed at the end."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.all = folder, list[subprocess.Popen[bytes]]()

    def start(self, host: str, *words: str) -> subprocess.Popen[bytes]:
        """Start a Python module on a host."""
        command = ["ip", "netns", "exec", host, sys.executable, "-m", *words]
        name = self.folder / f"{len(self.all)}.log"
        # Dask's workers are daemons by default, which may not start processes of their own.
        environment = {**os.environ, "DASK_DISTRIBUTED__WORKER__DAEMON": "false"}
        with name.open("wb") as log:
            self.all.append(
                subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)
            )
        return self.all[-1]

    def worker(self, host: str) -> subprocess.Popen[bytes]:
        """Start a worker of one thread, as docs/campaigns.md says."""
        words = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", ADDRESSES[host])
        scheduler = f"tcp://{ADDRESSES[HERE]}:{PORT}"
        folder = ("--local-directory", str(self.folder))
        return self.start(host, "distributed.cli.dask_worker", scheduler, *words, *folder)

    def close(self) -> None:
        """Kill those that are left."""
        for process in self.all:
            process.kill()
            process.wait()


def rows(table: Path) -> int:
    """How many rows a table has."""
    return max(0, table.read_bytes().count(b"\n") - 1) if table.exists() else 0


def measure(campaign: Sequence[str], runs: int) -> bool:
    """Run the campaign in one process and on the cluster; print what happened."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        alone, clustered = folder / "alone", folder / "clustered"
        words = ["petrobot.coordinator", "campaign", *campaign, "--runs", str(runs), "--quiet"]
        begun = time.monotonic()
        subprocess.run(
            [sys.executable, "-m", *words, "--workers", "1", "--out", str(alone)],
            cwd=ROOT,
            check=True,
        )
        print(f"one process: {runs} trials in {time.monotonic() - begun:.0f} s", flush=True)
        with two_hosts():
            processes = Processes(folder)
            try:
                address = ("--host", ADDRESSES[HERE], "--port", str(PORT), "--no-dashboard")
                processes.start(HERE, "distributed.cli.dask_scheduler", *address)
                workers = [processes.worker(HERE), processes.worker(THERE)]
                cluster = ("--cluster", f"tcp://{ADDRESSES[HERE]}:{PORT}", "--out", str(clustered))
                begun = time.monotonic()
                conduct = processes.start(HERE, *words, *cluster)
                acts: list[tuple[float, str, int | str]] = [
                    (0.1, "kill", 1), (0.2, "add", THERE), (0.3, "kill", 0), (0.4, "add", HERE),
                    (0.5, "kill", 2), (0.6, "add", THERE), (0.8, "kill", 3),
                ]  # fmt: skip
                while conduct.poll() is None and time.monotonic() < begun + PATIENCE:
                    done = rows(clustered / TABLE)
                    while acts and done >= acts[0][0] * runs:
                        _, what, which = acts.pop(0)
                        if isinstance(which, int):
                            workers[which].kill()
                        else:
                            workers.append(processes.worker(which))
                        print(f"after {done} rows: {what} worker {which}", flush=True)
                    time.sleep(0.05)
                took = time.monotonic() - begun
                print(f"two hosts: ended with {conduct.poll()} after {took:.0f} s", flush=True)
                if conduct.returncode != 0 or acts:
                    print(*(log.read_text() for log in sorted(folder.glob("*.log"))), sep="\n")
                    return False
            finally:
                processes.close()
        tables = [(each / TABLE).read_bytes() for each in (alone, clustered)]
        for where, table in zip(("one process", "two hosts"), tables, strict=True):
            print(f"{where}: {len(table)} bytes, sha256 {hashlib.sha256(table).hexdigest()[:16]}")
        return tables[0] == tables[1]


def main() -> int:
    """The command; 0 if the tables are the same."""
    parser = argparse.ArgumentParser(prog="python -m tools.proof.cluster", description=__doc__)
    parser.add_argument("--runs", type=int, default=96, help="trials (default: %(default)s)")
    options = parser.parse_args()
    campaign = ("catch_ball", "--block", "2", "--selector", "random", "--seed", "7")
    same = measure(campaign, options.runs)
    print("the same table" if same else "NOT the same table")
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())
