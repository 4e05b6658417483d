"""Campaigns on many machines: blocks as tasks of dask.distributed, which does those of a lost
worker again elsewhere."""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping
from typing import Any

from petrobot.coordinator.studies.campaign.plan import CampaignError, Plan
from petrobot.coordinator.studies.campaign.worker import answer

PATIENCE = 30.0
"""s in which a first worker has to be there."""
RETRIES = 5
"""Times that a block whose worker was lost is given to another one."""


def dask_distributed() -> Any:
    """The module. Raises CampaignError when it is not installed."""
    try:
        return importlib.import_module("distributed")
    except ImportError as fault:
        raise CampaignError(
            "--cluster needs dask.distributed: pip install 'petrobot[cluster]'"
        ) from fault


class ClusterPool:
    """The workers of a dask scheduler; each has petrobot installed and the campaign's files at the
    same paths.

    Use as an async context. Raises CampaignError when dask.distributed is missing or the scheduler
    does not answer.
    """

    def __init__(self, plan: Plan, address: str) -> None:
        self._plan, self._address = json.dumps(plan.to_plain()), address
        self._client: Any = None
        self.lost = 0
        self.count = 1
        """Threads of all workers, as the scheduler told when the campaign began."""

    async def __aenter__(self) -> ClusterPool:
        distributed = dask_distributed()
        try:
            self._client = await distributed.Client(self._address, asynchronous=True, timeout=10)
        except (OSError, TimeoutError, ValueError) as fault:
            raise CampaignError(
                f"--cluster {self._address}: no scheduler answers: {fault}"
            ) from fault
        await self.workers(1, PATIENCE)
        return self

    async def workers(self, least: int, patience: float) -> None:
        """Wait until so many workers are there, and count them. Raises CampaignError after
        `patience` s."""
        try:
            await self._client.wait_for_workers(least, timeout=patience)
        except TimeoutError as fault:
            raise CampaignError(
                f"--cluster {self._address}: fewer than {least} workers in {patience:g} s"
            ) from fault
        self.count = sum((await self._client.nthreads()).values())

    async def __aexit__(self, *_: object) -> None:
        await self._client.close()

    async def run(self, order: Mapping[str, Any]) -> dict[str, Any]:
        """Have a block done. Raises CampaignError."""
        future = self._client.submit(answer, self._plan, dict(order), pure=False, retries=RETRIES)
        try:
            return dict(await future)
        except dask_distributed().KilledWorker as fault:
            raise CampaignError(
                f"block {order['block']['index']} (seed {order['block']['seed']}): {fault}"
            ) from fault
