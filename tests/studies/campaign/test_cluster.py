"""A campaign on a dask cluster of separate worker processes, one of which is killed meanwhile."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from petrobot.coordinator.studies.campaign.conduct import Campaign, CampaignProgress
from petrobot.coordinator.studies.campaign.plan import CampaignError, CampaignPlan
from petrobot.coordinator.studies.campaign.pool import ClusterPool
from petrobot.coordinator.studies.campaign.table import TABLE
from tests.studies.campaign.conftest import HERE, Conduct
from tests.waiting import beat

ROOT = HERE.parents[1]
PATIENCE = 60.0


@contextmanager
def process(*arguments: str, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start one process of the cluster; end it on exit."""
    environment = {
        **os.environ,
        "PYTHONPATH": f"{ROOT}:{HERE}",
        "DASK_DISTRIBUTED__WORKER__DAEMON": "false",
    }
    with log.open("wb") as said:
        started = subprocess.Popen(
            [sys.executable, "-m", *arguments], cwd=ROOT, env=environment, stdout=said, stderr=said
        )
    try:
        yield started
    finally:
        started.kill()
        started.wait()


@pytest.mark.processes
def test_a_killed_worker_of_a_real_cluster_changes_nothing(
    conduct: Conduct, tmp_path: Path
) -> None:
    """The scheduler and two workers are separate processes; one worker is killed during a block."""
    pytest.importorskip(
        "distributed", reason="the extra `cluster` (dask.distributed) is not installed"
    )
    alone = conduct("alone", selector="random", runs=30)
    where = tmp_path / "scheduler.json"
    scheduler = (
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
    )
    worker = (
        "distributed.cli.dask_worker",
        "--scheduler-file",
        str(where),
        "--nthreads",
        "1",
        "--no-nanny",
        "--no-dashboard",
    )
    local = ("--local-directory", str(tmp_path))
    with (
        process(*scheduler, "--scheduler-file", str(where), log=tmp_path / "scheduler.log"),
        process(*worker, *local, log=tmp_path / "one.log") as victim,
        process(*worker, *local, log=tmp_path / "two.log"),
    ):
        asyncio.run(_conducted(tmp_path / "cluster", alone.plan, where, victim))
        assert victim.wait() == -signal.SIGKILL
    assert (tmp_path / "cluster" / TABLE).read_bytes() == (alone.folder / TABLE).read_bytes()


async def _conducted(
    folder: Path, plan: CampaignPlan, where: Path, victim: subprocess.Popen[bytes]
) -> None:
    """Run the campaign on the cluster; the victim dies after the second finished block."""
    import json

    loop = asyncio.get_running_loop()
    until = loop.time() + PATIENCE
    # the scheduler creates the file before it writes it
    while not (where.exists() and where.read_text().endswith("}")) and loop.time() < until:
        await beat()
    address = json.loads(where.read_text(encoding="utf-8"))["address"]

    def watch(progress: CampaignProgress) -> None:
        if progress.done == 6:
            victim.kill()

    campaign = Campaign(folder, plan, watch)
    async with ClusterPool(plan, address) as pool:
        await pool.workers(2, PATIENCE)
        assert pool.count == 2
        await campaign.run(pool)


def test_without_dask_the_remedy_is_named(
    monkeypatch: pytest.MonkeyPatch, toy_plan: CampaignPlan
) -> None:
    """The error is one clear line."""
    monkeypatch.setitem(sys.modules, "distributed", None)

    async def enter() -> None:
        async with ClusterPool(toy_plan, "tcp://127.0.0.1:9"):
            pass

    with pytest.raises(CampaignError, match=r"petrobot\[cluster\]"):
        asyncio.run(enter())
