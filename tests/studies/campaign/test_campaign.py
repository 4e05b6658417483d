"""A campaign's table is the same for any number of workers, any order of blocks, and any number of
interruptions."""

from __future__ import annotations

import asyncio
import gc
import io
import json
import os
import signal
from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path

import pytest
from msgspec.structs import asdict, replace

from petrobot.coordinator.cli import main
from petrobot.coordinator.cli.campaign import text_of
from petrobot.coordinator.launch import Setting, lockstep_cell
from petrobot.coordinator.learning.estimates_file import EstimatesFile
from petrobot.coordinator.learning.objective import Question, compare
from petrobot.coordinator.studies.campaign.conduct import Campaign, CampaignProgress
from petrobot.coordinator.studies.campaign.observed import regime_of
from petrobot.coordinator.studies.campaign.plan import (
    MANIFEST,
    CampaignError,
    CampaignPlan,
    digest,
    read_manifest,
    regimes_of,
    write_manifest,
)
from petrobot.coordinator.studies.campaign.pool import LocalPool
from petrobot.coordinator.studies.campaign.summary import (
    Summary,
    TrialCounts,
    comparisons,
    result_of,
)
from petrobot.coordinator.studies.campaign.table import (
    TABLE,
    TIMES,
    TrialRow,
    note_block,
    read_table,
    times,
)
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.studies.campaign.worker import serve
from petrobot.coordinator.task import Kind
from tests.processes import alive
from tests.studies.campaign.conftest import SERVICES, TASK, Conduct
from tests.waiting import beat, until


def table(folder: Path) -> bytes:
    """Return the table's bytes."""
    return (folder / TABLE).read_bytes()


def test_costs_that_a_full_disk_has_torn_do_not_end_a_resumed_campaign(
    toy_plan: CampaignPlan, tmp_path: Path
) -> None:
    """They are written without a sync, so any part of them may be lost."""
    cost = {"pid": 7, "cpu_s": 0.5, "wall_s": 1.25, "mission_s": 2.0, "rss_mb": 120.0}
    one, two, three = replace(toy_plan, runs=3, block=1).blocks
    for block in (one, two):
        note_block(tmp_path, block, cost)
    whole = (tmp_path / TIMES).read_bytes()
    for left in range(len(whole)):
        (tmp_path / TIMES).write_bytes(whole[:left])
        assert len(times(tmp_path)) == max(0, whole[:left].count(b"\n") - 1), left
        note_block(tmp_path, three, cost)
        kept = [str(index) for index in range(max(0, whole[:left].count(b"\n") - 1))]
        rows = times(tmp_path)
        assert [row["block"] for row in rows] == [*kept, "2"], left
        assert all(float(row["rss_mb"]) == 120.0 for row in rows), left


def test_a_table_that_is_gone_is_not_begun_again_in_the_middle(
    conduct: Conduct, tmp_path: Path
) -> None:
    """It would be a file without a header and without the blocks before."""
    table = conduct("done").table
    rows = list(table.rows())
    table.append(rows[:1])
    (tmp_path / "done" / TABLE).unlink()
    with pytest.raises(FileNotFoundError, match=TABLE):
        table.append(rows[:1])
    assert not (tmp_path / "done" / TABLE).exists()


def test_blocks_of_any_size_cover_all_trials(toy_plan: CampaignPlan) -> None:
    """Regimes alternate and share their seeds; numbers and seeds depend only on the index."""
    for runs, block in ((1, 4), (7, 3), (12, 5), (20, 1)):
        blocks = replace(toy_plan, runs=runs, block=block).blocks
        assert [b.index for b in blocks] == list(range(len(blocks)))
        assert sum(b.count for b in blocks) == runs
        assert [b.first for b in blocks] == [
            sum(a.count for a in blocks[:i]) for i in range(len(blocks))
        ]
        for regime in ("easy", "rough"):
            own = [b for b in blocks if b.regime == regime]
            assert [b.seed for b in own] == [1_000_000 + i for i in range(len(own))]
    longer = replace(toy_plan, runs=24).blocks
    assert [b.seed for b in longer][:4] == [b.seed for b in toy_plan.blocks][:4]


def test_columns_come_from_task_and_score(conduct: Conduct) -> None:
    """The table has one row per trial, with the values of the toy's score and of each run."""
    campaign = conduct("a")
    rows = list(campaign.table.rows())
    assert [row.n for row in rows] == list(range(1, 13))
    assert {row.regime for row in rows} == {"easy", "rough"}
    header = table(campaign.folder).split(b"\n")[0].decode().split(",")
    assert {
        "n",
        "regime",
        "seed",
        "chosen.look",
        "look.status",
        "look.cost",
        "parts.x",
        "parts.gripped",
    } <= set(header)
    for row in rows:
        assert row.trial is not None
        assert row.trial.runs[0].place == "look"
        assert row.score["parts.n"] == row.k
        grips = [run for run in row.trial.runs if run.place == "grip"]
        assert all(run.cost == 1.0 for run in grips)  # The cost of grip_soft is its force.
        assert row.trial.goals == sum(run.taken == "gripped" for run in row.trial.runs)
        assert (
            row.trial.time is not None
            and row.trial.time >= sum(run.took for run in row.trial.runs) - 1e-6
        )


def test_a_block_equals_the_mission_run_of_petrobot_run(conduct: Conduct) -> None:
    """Seed and number of a row suffice to repeat its trial alone."""
    campaign = conduct("a")
    block = campaign.plan.blocks[2]
    setting = Setting(campaign.bench.task, {"regime": block.regime}, block.count, block.seed)
    cell, party = lockstep_cell(campaign.bench.directory, setting)
    assert cell.run(lambda: party.over, 100_000)
    rows = [row for row in campaign.table.rows() if row.block == block.index]
    in_table = [run.seconds for row in rows for run in (row.trial.runs if row.trial else ())]
    assert [run.seconds for run in party.mission.tally.runs] == pytest.approx(in_table)
    assert rows[0].mission_s == pytest.approx(party.mission.ended - party.mission.begun)


def test_another_seed_gives_another_table(conduct: Conduct) -> None:
    """The same seed gives the same table."""
    assert table(conduct("a").folder) == table(conduct("b").folder)
    assert table(conduct("a").folder) != table(conduct("c", seed=2).folder)


@pytest.mark.parametrize("fails_at", [0, 1, 3])
def test_interrupted_and_resumed_gives_the_same_table(conduct: Conduct, fails_at: int) -> None:
    """Tried between blocks, and while a block is being written."""
    whole = conduct("whole")
    with pytest.raises(KeyboardInterrupt):
        conduct("part", fails_at=fails_at)
    path = whole.folder.parent / "part" / TABLE
    if path.exists():
        cut = path.read_bytes()
        path.write_bytes(cut + b'99,easy,"half a r')
    resumed = conduct("part")
    assert table(resumed.folder) == table(whole.folder)
    assert resumed.result()["sim_s"] == whole.result()["sim_s"]


@pytest.mark.parametrize("kept", [1, 40, 400, 1500])
def test_a_table_cut_anywhere_is_recovered(conduct: Conduct, kept: int) -> None:
    """Any number of bytes may have reached the disk."""
    whole, other = conduct("whole"), conduct("other")
    (other.folder / TABLE).write_bytes(table(other.folder)[:-kept])
    assert table(conduct("other").folder) == table(whole.folder)


def test_another_campaign_in_the_same_folder_is_refused(conduct: Conduct) -> None:
    """The error lists the keys that differ."""
    conduct("a")
    with pytest.raises(CampaignError, match="seed, selector differ"):
        conduct("a", seed=5, selector="random")


def plan_cut_off(folder: Path, size: int) -> Path:
    """Write a manifest of which only some bytes reached the disk."""
    path = folder / MANIFEST
    path.write_bytes(path.read_bytes()[:size])
    return path


@pytest.mark.parametrize("size", [0, 1, 100])
def test_a_truncated_manifest_is_reported_with_a_remedy(conduct: Conduct, size: int) -> None:
    """Before the first block the remedy is to remove the manifest; with a table, to remove the
    folder. The test follows the remedy."""
    whole = conduct("whole")
    with pytest.raises(KeyboardInterrupt):
        conduct("a", fails_at=0)
    path = plan_cut_off(whole.folder.parent / "a", size)
    with pytest.raises(
        CampaignError,
        match=r"campaign.json: .*empty, incomplete.*remove campaign.json and give the "
        r"command again",
    ):
        conduct("a")
    path.unlink()
    assert table(conduct("a").folder) == table(whole.folder)
    plan_cut_off(path.parent, size)
    with pytest.raises(
        CampaignError, match=r"incomplete.*remove .*a to begin again, or give another --out"
    ):
        conduct("a")


@pytest.mark.parametrize("text", ["[]", "7", '{"schema": 1}', '{"schema": 1, "regimes": 3}'])
def test_a_manifest_that_is_not_a_plan_is_refused(conduct: Conduct, text: str) -> None:
    """It is refused although it is valid JSON."""
    folder = conduct("a").folder
    (folder / MANIFEST).write_text(text, encoding="utf-8")
    with pytest.raises(CampaignError, match="not a plan"):
        read_manifest(folder)


def test_a_kill_while_the_manifest_is_written_leaves_the_old_one_or_the_new_one(
    conduct: Conduct, toy_plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process may die at any byte: until the file is complete on disk it has another name."""
    folder = conduct("a").folder
    before = (folder / MANIFEST).read_bytes()

    def killed(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", killed)
    with pytest.raises(KeyboardInterrupt):
        write_manifest(folder, replace(toy_plan, seed=9))
    assert (folder / MANIFEST).read_bytes() == before
    monkeypatch.undo()
    write_manifest(folder, replace(toy_plan, seed=9))
    assert read_manifest(folder).seed == 9


def test_files_that_changed_are_refused(conduct: Conduct, tmp_path: Path) -> None:
    """A table belongs to one version of the task file."""
    with pytest.raises(CampaignError, match="has changed"):
        conduct("a", digests={"task": "0" * 64})


def test_a_bad_regime_is_an_error_of_the_campaign(conduct: Conduct) -> None:
    """The error has the cell's message and the seed."""
    with pytest.raises(CampaignError, match="no regime 'steep'"):
        conduct("a", regimes=("steep",))


def test_round_robin_tries_every_combination(conduct: Conduct) -> None:
    """There are three actions to look and two to grip, in each regime."""
    rows = list(conduct("a", selector="round_robin", runs=24).table.rows())
    easy = [row.trial for row in rows if row.regime == "easy"]
    seen = {
        tuple(run.action for run in t.runs if run.place in ("look", "grip"))
        for t in easy
        if t and len(t.runs) > 1
    }
    assert {combination[0] for combination in seen} == {"look_quick", "look_twice", "look_long"}
    assert len(seen) >= 5  # One of the six may not have been tried.


def test_progress_counts_trials(tmp_path: Path, toy_plan: CampaignPlan) -> None:
    """It counts up to the last one; a resumed campaign reports how many it found."""
    from tests.studies.campaign.conftest import InlinePool

    seen: list[CampaignProgress] = []
    campaign = Campaign(tmp_path / "a", toy_plan, seen.append)
    asyncio.run(campaign.run(InlinePool(toy_plan)))
    assert [p.done for p in seen] == [3, 6, 9, 12]
    assert all(p.of == 12 and p.already == 0 for p in seen)


@pytest.mark.processes
def test_workers_in_any_number_and_a_killed_one_change_nothing(
    conduct: Conduct, tmp_path: Path, toy_plan: CampaignPlan
) -> None:
    """After kill -9 of a busy worker another one repeats its block."""
    alone = conduct("alone", selector="random")
    plan = alone.plan

    async def with_workers(name: str, count: int, kill: bool) -> LocalPool:
        campaign = Campaign(tmp_path / name, plan)
        async with LocalPool(plan, count, campaign.folder / "workers.log") as pool:
            going = asyncio.create_task(campaign.run(pool))
            if kill:
                await until(lambda: pool.pids, "a worker of the pool")
                os.kill(pool.pids[0], signal.SIGKILL)
            await going
            return pool

    for count, kill in ((1, False), (3, True)):
        pool = asyncio.run(with_workers(f"by_{count}", count, kill))
        assert pool.lost == kill
        assert table(tmp_path / f"by_{count}") == table(alone.folder)
    assert len(list(read_table(tmp_path / "by_3" / TABLE))) == 12


def test_the_memory_of_a_block_is_freed_before_the_next_one(
    toy_plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker's memory stays constant although a mission contains reference cycles and the garbage
    collector runs at its own times."""
    left: list[int] = []

    def orders() -> Iterator[str]:
        yield json.dumps(toy_plan.to_plain())
        for block in toy_plan.blocks:
            yield json.dumps({"block": asdict(block), "weights": []})
            left.append(gc.collect())

    monkeypatch.setattr(
        gc, "freeze", lambda: None
    )  # A worker keeps this setting; here it would affect all later tests.
    answers = io.StringIO()
    gc.collect()
    gc.disable()
    try:
        serve(orders(), answers)
    finally:
        gc.enable()
    assert len(answers.getvalue().splitlines()) == len(toy_plan.blocks) == len(left)
    assert not any(left)


def test_learning_depends_only_on_batches(conduct: Conduct) -> None:
    """Interrupted within a batch and resumed, it makes the same choices and learns the same."""
    learning = {"selector": "nikolic_fu_fast", "runs": 36, "batch": 12, "options": {"rho": 0.1}}
    whole = conduct("whole", **learning)
    for fails_at in (6, 8, 11):
        with pytest.raises(KeyboardInterrupt):
            conduct(f"part{fails_at}", fails_at=fails_at, **learning)
        resumed = conduct(f"part{fails_at}", **learning)
        assert table(resumed.folder) == table(whole.folder)
        assert resumed.policy.state() == whole.policy.state()
    looks = [
        row.trial.runs[0].action for row in whole.table.rows() if row.trial and row.regime == "easy"
    ]
    assert set(looks[:15]) == {"look_quick", "look_twice", "look_long"}  # first trials of each


def test_learned_choices_can_be_evaluated_again(conduct: Conduct) -> None:
    """They are evaluated by regime, from the result of the learning campaign."""
    import json

    from petrobot.coordinator.studies.campaign.policies import learned_choices

    learnt = conduct("learnt", selector="thompson", runs=60, batch=12)
    (learnt.folder / "result.json").write_text(json.dumps(learnt.result()), encoding="utf-8")
    name = learnt.result()["task"]
    physics = read_manifest(learnt.folder).physics
    best = learned_choices(learnt.folder, name, mock=False, physics=physics)
    with pytest.raises(CampaignError, match=f"it learned in the task {name}, not in other"):
        learned_choices(learnt.folder, "other", mock=False, physics=physics)
    with pytest.raises(CampaignError, match="the new runs have scripted actions"):
        learned_choices(learnt.folder, name, mock=True, physics=physics)
    with pytest.raises(CampaignError, match="the new runs have actions in the physics 'portable'"):
        learned_choices(learnt.folder, name, mock=False, physics="portable")
    assert set(best) == {"easy", "rough"}
    judged = conduct("judged", seed=2, options={"by_regime": best})
    for row in judged.table.rows():
        for run in row.trial.runs if row.trial else ():
            if run.place in best[row.regime]:
                assert run.action == best[row.regime][run.place]


def test_parquet_is_written_if_pyarrow_is_installed(conduct: Conduct) -> None:
    """It has the rows and columns of the CSV file; without pyarrow no file is written."""
    from petrobot.coordinator.studies.campaign.table import write_parquet

    campaign = conduct("a")
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    written = write_parquet(campaign.folder)
    assert written is not None
    table_ = parquet.read_table(written)
    header = table(campaign.folder).split(b"\n")[0].decode().split(",")
    assert table_.column_names == header
    assert table_.column("n").to_pylist() == list(range(1, 13))


def test_an_action_that_cannot_be_loaded_is_bad_input(conduct: Conduct, tmp_path: Path) -> None:
    """The error names the location file and does not look like a lost worker."""
    other = tmp_path / "services.toml"
    other.write_text(
        SERVICES.read_text(encoding="utf-8").replace(
            "toy_actions:prepare", "no_such_module:prepare"
        ),
        encoding="utf-8",
    )
    with pytest.raises(CampaignError, match="no_such_module"):
        conduct("a", services=str(other), digests={"task": digest(TASK), "services": digest(other)})


def test_j_uses_the_given_target_and_rho(conduct: Conduct) -> None:
    """Without them it uses the target of the task file: the cost is that of the hardest regime that
    still reaches it. A target that nobody declared rules nothing."""
    campaign = conduct("a", selector="round_robin", runs=240)
    undeclared, plan = campaign.bench.task, campaign.plan
    result = campaign.result()
    assert result["judged"]["look"]["target"] is None
    assert all(j is not None for j in result["J"]["look"].values())
    assert all(low < high for low, high in result["J_interval"]["look"].values())
    look = replace(undeclared.primitive_tasks["look"], target_reliability=0.9)
    task = replace(undeclared, primitive_tasks={**undeclared.primitive_tasks, "look": look})
    sets = []
    for options in ({}, {"target": 0.3}, {"target": 0.6}, {"target": 0.99}, {"rho": 0.25}):
        summary = Summary.of(task, campaign.table.rows(), options=options)
        result = result_of(campaign.folder, plan, summary, {})
        judged, tallies = result["judged"]["look"], summary.estimates.of("look")
        target = options.get("target", 0.9)
        expected = compare(tallies, Question("wall", target, options.get("rho")))
        assert (judged["cost"], judged["target"], judged["regimes"]) == (
            "wall",
            target,
            ["easy", "rough"],
        )
        assert judged["rho"] == pytest.approx(expected.rho)
        assert result["J"]["look"] == {
            f.action: round(f.j, 6) if isfinite(f.j) else None for f in expected.figures
        }
        inside = {
            a: [c for c, t in by.items() if t.interval()[0] >= target] for a, by in tallies.items()
        }
        assert judged["meet_target"] == {
            a: list(map(regime_of, met)) for a, met in inside.items() if met
        }
        for f in expected.figures:
            assert f.reliability == min(tally.reliability for tally in tallies[f.action].values())
            if f.scenario is not None:
                there = tallies[f.action][f.scenario]
                assert there.reliability == min(
                    tallies[f.action][c].reliability for c in inside[f.action]
                )
                assert f.cost == there.wall.mean
        said = text_of({**result, "chosen": {"look": result["chosen"]["look"]}})
        assert (f"no action surely reaches R {target:g}" in said) == (not judged["meet_target"])
        assert (f"(below R {target:g})" in said) == (0 < len(judged["meet_target"]) < 3)
        sets.append(sorted(map(len, inside.values())))
    assert sets[1] == [2, 2, 2]  # The targets distinguish regimes and actions.
    assert sets[2] not in (sets[1], sets[3])
    assert sets[3] == [0, 0, 0]
    one = comparisons(task, summary.estimates.tallies, "rough")["look"]
    assert one.scenarios == ("regime=rough",)
    assert all(f.admissible for f in one.figures), (
        "in one regime the declared target must exclude no action"
    )


COUNTING = """
schema = 1
[actions.look_quick]
values = { hard = false }
[actions.look_twice]
values = { hard = false, count = 2 }
[actions.look_long]
values = { hard = false, count = 16 }
[actions.grip_soft]
values = { force = 1.0 }
[actions.grip_hard]
values = { force = 4.0 }
"""


def test_a_count_is_a_cost_in_campaigns_and_runs_alike(
    conduct: Conduct, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The task file declares as cost the number of images that a run reports, or 1 if it reports
    none."""
    monkeypatch.chdir(tmp_path)
    text = TASK.read_text(encoding="utf-8").replace('"look_long"]', '"look_long"]\ncost = "count"')
    (task := tmp_path / "fetch.toml").write_text(text, encoding="utf-8")
    (mock := tmp_path / "mock.toml").write_text(COUNTING, encoding="utf-8")
    digests = {
        key: digest(path) for key, path in (("task", task), ("services", SERVICES), ("mock", mock))
    }
    counted = {"look_quick": 1.0, "look_twice": 2.0, "look_long": 16.0}
    campaign = conduct("a", task=str(task), mock=str(mock), digests=digests, selector="round_robin")
    for row in campaign.table.rows():
        assert row.trial is not None
        assert row.trial.runs[0].cost == counted[row.trial.runs[0].action]
    result = campaign.result()
    assert result["judged"]["look"]["cost"] == "count"
    assert result["plant"] == "mock" and "seed 1, mock" in text_of(result)
    assert result["J"]["look"] == {action: count / 16 for action, count in counted.items()}
    told = [
        "run",
        str(task),
        "--services",
        str(SERVICES),
        "--mode",
        "lockstep",
        "--mock",
        str(mock),
        "--quiet",
    ]
    assert main([*told, "--runs", "6", "--learn", "run.db", "--selector", "round_robin"]) == 0
    for path in (Path("run.db"), Path(result["estimates"])):
        kept = EstimatesFile(path).read()
        assert kept.question("look") == Question("count")
        for action, by_context in kept.estimates.of("look").items():
            assert {tally.cost("count").mean for tally in by_context.values()} == {counted[action]}
    learner = (
        EstimatesFile(Path("run.db"))
        .read()
        .states("round_robin")["look"]["learners"]["regime=easy"]
    )
    assert learner["cost"] == [2 * count for count in counted.values()]


@pytest.mark.parametrize("selector", ["random", "round_robin", "ucb1"])
def test_learned_show_uses_the_criteria_of_the_campaign(
    conduct: Conduct, selector: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It uses the cost, target and rho of the estimates file, even if no selector learned with
    them."""
    monkeypatch.chdir(tmp_path)
    options = {"target": 0.6, "rho": 0.2}
    result = conduct("a", selector=selector, runs=120, options=options).result()
    assert main(["learned", "show", result["estimates"], "--json", "shown.json"]) == 0
    shown = json.loads(Path("shown.json").read_text(encoding="utf-8"))["primitive_tasks"]
    assert shown["grip"]["cost"] == "value:force"
    for task, actions in result["J"].items():
        about = shown[task]
        found = {
            row["action"]: None if row["J"] is None else round(row["J"], 6)
            for row in about["actions"]
        }
        assert found == actions
        assert (about["target"], about["rho"]) == (0.6, 0.2)


def test_the_error_of_a_damaged_estimates_file_says_that_it_can_be_made_again(
    conduct: Conduct,
) -> None:
    """The file is derived from the table, but it is not replaced without asking: it may hold
    more."""
    campaign = conduct("a")
    path = Path(campaign.result()["estimates"])
    whole = EstimatesFile(path).read().estimates
    path.write_bytes(b"no database at all, but long enough to be looked at" * 9)
    with pytest.raises(
        CampaignError, match=r"not a database.*If it is removed, the same command makes it again"
    ):
        campaign.result()
    path.unlink()
    campaign.result()
    assert EstimatesFile(path).read().estimates == whole


def test_a_cost_that_no_result_reports_is_mentioned(conduct: Conduct, tmp_path: Path) -> None:
    """Otherwise J would be 1 - R without any notice."""
    task = tmp_path / "fetch.toml"
    task.write_text(
        TASK.read_text(encoding="utf-8").replace("value:force", "value:forse"), encoding="utf-8"
    )
    campaign = conduct(
        "a", task=str(task), runs=24, digests={"task": digest(task), "services": digest(SERVICES)}
    )
    result = campaign.result()
    assert result["judged"]["grip"]["uncosted"] == ["grip_soft"]
    result["chosen"]["grip"]["grip_hard"] = 1  # Primitive tasks without a choice are not printed.
    assert "grip_soft: no run reported value:forse" in text_of(result)


@pytest.mark.processes
async def test_a_child_of_a_dead_worker_does_not_hide_its_death(
    tmp_path: Path, toy_plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The child keeps the worker's input and output open, and ends with it."""
    mark, program = tmp_path / "left", tmp_path / "worker"
    program.write_text(
        f"#!/bin/sh\nread plan\nsleep 3600 &\necho $! > {mark}\nread order\nkill -9 $$\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(program))
    order = {"block": asdict(toy_plan.blocks[0]), "weights": []}
    async with asyncio.timeout(60.0), LocalPool(toy_plan, 1, tmp_path / "log") as pool:
        with pytest.raises(CampaignError, match="3 workers ended"):
            await pool.run(order)
        assert pool.lost == 3
        left = int(mark.read_text())
        while alive(left):
            await beat(0.01)


def test_blocks_that_are_copies_are_warned_of(conduct: Conduct, tmp_path: Path) -> None:
    """Where nothing draws, each seed gives the same runs: the result says so, and names the
    seeds."""
    assert conduct("chance").result()["copies"] == []
    script = tmp_path / "script.toml"
    actions = {
        a
        for p in conduct("names", runs=1).bench.task.primitive_tasks.values()
        for a in p.alternatives
    }
    lines = [f"[actions.{name}]\nseconds = 0.5\n" for name in sorted(actions)]
    script.write_text("schema = 1\n" + "".join(lines), encoding="utf-8")
    result = conduct("copies", mock=str(script), digests={}).result()
    assert len(result["copies"]) == 2 and all(len(seeds) == 2 for seeds in result["copies"])
    assert "copies of each other" in text_of(result) and "never began" not in text_of(result)
    assert "  3 more never began: their mission run" in text_of({**result, "not_begun": 3})


def test_blocks_that_are_equal_by_chance_are_no_copies(conduct: Conduct) -> None:
    """Where trials that begin alike end differently, something draws from the seed. A selector that
    takes another action is no sign of that."""
    task = conduct("names", runs=1).bench.task
    place = next(name for name, p in task.flat.places.items() if p.kind is Kind.ACTION)
    action = task.primitive_task_of(place).alternatives[0]

    def copies(*blocks: tuple[float, ...], chosen: Sequence[str] = ()) -> list[list[int]]:
        rows = []
        for i, block in enumerate(blocks):
            for k, t in enumerate(block, 1):
                run = RunEntry(place, chosen[i] if chosen else action, 0.0, t)
                rows.append(TrialRow(1, "A", 40 + i, k, i, 9.0, Trial(k, 0.0, runs=[run])))
        return Summary.of(task, rows).copies()

    assert copies((1.0,), (1.0,), (2.0,)) == []
    assert copies((1.0, 2.0), (1.0, 2.0), (1.0, 3.0)) == []
    assert copies((1.0, 2.0), (1.0, 2.0)) == [[40, 41]]
    assert copies((1.0,), (1.0,), (2.0,), chosen=(action, action, "other")) == [[40, 41]]


def test_the_summary_adds_up_what_the_score_counts_for_each_trial() -> None:
    """Whole numbers of every trial, by regime and together; no truth values, no numbers of rows, no
    plain results of a task with one trial. A trial that did not begin counts what it counted."""
    rows = [
        TrialRow(
            1, "A", 1, 1, 0, 1.0, Trial(1, 0.0), {"eggs.n": 1, "eggs.laid": 3, "hen.ok": True}
        ),
        TrialRow(2, "A", 1, 2, 0, 1.0, None, {"eggs.n": 2, "eggs.laid": 1, "score.seed": 7}),
        TrialRow(3, "B", 1, 1, 1, 1.0, Trial(1, 0.0), {"eggs.n": 1, "eggs.laid": 5, "eggs.w": 0.5}),
    ]
    whole, by_regime = TrialCounts(), {"A": TrialCounts(), "B": TrialCounts()}
    for row in rows:
        whole.add(row)
        by_regime[row.regime].add(row)
    assert whole.to_plain(False)["counts"] == {"eggs": {"laid": 9}}
    assert by_regime["A"].to_plain(False)["counts"] == {"eggs": {"laid": 4}}
    assert by_regime["B"].to_plain(False)["counts"] == {"eggs": {"laid": 5}}


def test_regimes_may_be_named_in_several_installations() -> None:
    assert regimes_of("A, C+dim@2,B@1-3") == ("A", "C+dim@2", "B@1", "B@2", "B@3")
    assert regimes_of("") == ()
    for text in ("C@3-1", "C@1-x", "C@-2"):
        with pytest.raises(CampaignError, match="from and to, such as C@1-5"):
            regimes_of(text)


def test_with_credit_by_the_task_the_goal_judges_every_choice_of_a_trial(conduct: Conduct) -> None:
    """The learners' sums are those of the table: each action of a trial once, by its goal and its
    duration or the forces of its runs."""
    campaign = conduct("task", runs=24, batch=6, selector="nikolic_fu", options={"credit": "task"})
    policy, task = campaign.policy, campaign.bench.task
    found: dict[tuple[str, str, str], list[float]] = {}
    for row in campaign.table.rows():
        trial = row.trial
        assert trial is not None
        forces = sum(run.values.get("force", 0.0) for run in trial.runs)
        for name, action in {(task.primitive_task_of(r.place).name, r.action) for r in trial.runs}:
            sums = found.setdefault((name, action, row.regime), [0.0, 0.0, 0.0])
            cost = {"look": trial.time or 0.0, "grip": forces}.get(name, 0.0)
            for i, more in enumerate((1.0, float(trial.goals > 0), cost)):
                sums[i] += more
    for name, state in policy.selectors().items():
        assert state["selector"] == "nikolic_fu by task"
        for context, learned in state["learners"].items():
            for i, action in enumerate(state["actions"]):
                expected = found.get((name, action, context.removeprefix("regime=")), [0.0] * 3)
                sums = [learned[part][i] for part in ("runs", "successes", "cost")]
                assert sums == pytest.approx(expected, abs=1e-5), (name, action, context)
