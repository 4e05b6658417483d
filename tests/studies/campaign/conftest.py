"""Fixtures of the campaign tests: the toy cell's files, and its campaigns in this process."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from petrobot.coordinator.studies.campaign.block import LoadedPlan
from petrobot.coordinator.studies.campaign.conduct import Campaign
from petrobot.coordinator.studies.campaign.plan import CampaignPlan, digest
from petrobot.coordinator.studies.campaign.worker import answer

HERE = Path(__file__).parent
TASK, SERVICES = HERE / "toy" / "fetch.toml", HERE / "toy" / "services.toml"


class InlinePool:
    """Runs blocks one after the other in this process; interrupted after `fails_at` blocks."""

    def __init__(self, plan: CampaignPlan, fails_at: int | None = None) -> None:
        import json

        self.count, self.lost, self.done = 1, 0, 0
        self._plan, self._fails_at = json.dumps(plan.to_plain()), fails_at

    async def run(self, order: Mapping[str, Any]) -> dict[str, Any]:
        """Run a block."""
        if self._fails_at is not None and self.done >= self._fails_at:
            raise KeyboardInterrupt
        self.done += 1
        return answer(self._plan, order)


@pytest.fixture(autouse=True)
def _toy_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let workers and this process import the toy's actions."""
    monkeypatch.syspath_prepend(str(HERE))


@pytest.fixture
def toy_plan() -> CampaignPlan:
    """A plan of twelve trials in two regimes, in blocks of three."""
    return CampaignPlan(
        str(TASK),
        str(SERVICES),
        runs=12,
        regimes=("easy", "rough"),
        block=3,
        batch=0,
        digests={"task": digest(TASK), "services": digest(SERVICES)},
    )


@pytest.fixture
def bench(toy_plan: CampaignPlan) -> LoadedPlan:
    """The toy's files."""
    return LoadedPlan.of(toy_plan)


Conduct = Callable[..., Campaign]


@pytest.fixture
def conduct(tmp_path: Path, toy_plan: CampaignPlan) -> Iterator[Conduct]:
    """Return a function that runs a campaign of the toy in a folder of tmp_path, with changes to
    the plan's fields."""

    def run(name: str, fails_at: int | None = None, **changes: Any) -> Campaign:
        plan = replace(toy_plan, **changes)
        campaign = Campaign(tmp_path / name, plan)
        asyncio.run(campaign.run(InlinePool(plan, fails_at)))
        return campaign

    yield run
