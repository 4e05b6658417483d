"""Deferred verdicts in a campaign: table, estimates and summary hold the final results of runs,
after any interruption."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from msgspec.structs import replace

from petrobot.coordinator.learning.estimates_file import EstimatesFile
from petrobot.coordinator.studies.campaign.conduct import Campaign
from petrobot.coordinator.studies.campaign.observed import ESTIMATES
from petrobot.coordinator.studies.campaign.plan import CampaignPlan, digest
from petrobot.coordinator.studies.campaign.table import TABLE
from tests.run.judged_parts import FOLDER, TRULY
from tests.studies.campaign.conftest import InlinePool

TASK, SERVICES = FOLDER / "sort.toml", FOLDER / "services.toml"
BLOCKS = 3


@pytest.fixture
def plan() -> CampaignPlan:
    """Three blocks of six parts; in each, the first, third and fourth pick are judged bad."""
    digests = {"task": digest(TASK), "services": digest(SERVICES)}
    return CampaignPlan(
        str(TASK), str(SERVICES), runs=6 * BLOCKS, block=6, batch=0, digests=digests, regimes=("",)
    )


def conducted(folder: Path, plan: CampaignPlan, fails_at: int | None = None) -> Campaign:
    """Run the campaign in a folder."""
    campaign = Campaign(folder, plan)
    asyncio.run(campaign.run(InlinePool(plan, fails_at)))
    return campaign


def test_the_table_and_the_estimates_hold_the_verdicts(tmp_path: Path, plan: CampaignPlan) -> None:
    campaign = conducted(tmp_path / "a", plan)
    rows = list(campaign.table.rows())
    assert len(rows) == 6 * BLOCKS
    for row in rows:
        status, cause = TRULY[f"pick#{row.k}"]
        assert row.trial is not None
        assert (row.trial.status, row.trial.cause, row.trial.completed) == (status, cause, True)
        assert row.trial.all_success is (status == "success")
        assert [(run.status, run.cause) for run in row.trial.runs] == [
            (status, cause),
            ("success", ""),
        ]
    campaign.result()
    tallies = EstimatesFile(tmp_path / "a" / ESTIMATES).read().estimates.tallies
    (tally,) = [t for key, t in tallies.items() if key.primitive_task == "pick"]
    assert tally.counts == {
        ("failure", "crooked"): 2 * BLOCKS,
        ("failure", "fell"): BLOCKS,
        ("success", ""): 3 * BLOCKS,
    }
    assert tally.unjudged == {"success": BLOCKS}, "the last pick of each block"
    assert tally.reliability == 0.4


def test_interrupted_and_resumed_it_gives_the_same_table(
    tmp_path: Path, plan: CampaignPlan
) -> None:
    whole = (conducted(tmp_path / "a", plan).folder / TABLE).read_bytes()
    with pytest.raises(KeyboardInterrupt):
        conducted(tmp_path / "b", plan, fails_at=1)
    assert (conducted(tmp_path / "b", replace(plan)).folder / TABLE).read_bytes() == whole
