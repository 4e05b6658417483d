"""Run one block of a campaign: a mission run in a lock-step cell of its own, from plain data to
plain data."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from petrobot.coordinator.engine.instructions import RunRecorded
from petrobot.coordinator.launch import (
    SCRIPTED,
    RequestError,
    Setting,
    load_object,
    lockstep_mission,
    lockstep_party,
)
from petrobot.coordinator.learning.estimate import COUNT
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.run.mission import Mission, MissionError
from petrobot.coordinator.studies.campaign.plan import Block, CampaignError, CampaignPlan, digest
from petrobot.coordinator.studies.campaign.trials import CostOf, TrialLog
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import TaskFileError, load as load_task
from petrobot.services.comm.location_file import (
    DRY_RUN,
    FIRST_PHYSICS,
    Directory,
    DirectoryError,
    load as load_directory,
    same_physics,
)
from petrobot.services.comm.lockstep.cell import CellError, Delays, LockStepCell
from petrobot.services.comm.lockstep.party import TICK, Party

Weights = Mapping[str, Mapping[str, float]]
"""By primitive task: the probability of each action."""
LONGEST_TRIAL = 3600.0
"""Simulated seconds after which a trial counts as endless."""
PLOTS = "plots"
"""Key of a score under which a task declares pictures of its own (docs/campaigns.md)."""


class LoadedPlan(Struct, frozen=True):
    """A plan with its files loaded. All blocks share it; each process loads it once."""

    plan: CampaignPlan
    task: Task
    directory: Directory

    @classmethod
    def of(cls, plan: CampaignPlan) -> LoadedPlan:
        """Load the files of a plan. Raises CampaignError, also if a file has changed since the
        campaign began."""
        for key, said in plan.digests.items():
            path = str(getattr(plan, key))
            if path and digest(path) != said:
                raise CampaignError(
                    f"{path} has changed since the campaign began; restore it, or start a new "
                    "campaign in another folder"
                )
        try:
            task, directory = load_task(Path(plan.task)), load_directory(Path(plan.services))
        except (OSError, TaskFileError, DirectoryError) as fault:
            raise CampaignError(str(fault)) from fault
        if directory.plant(scripted=bool(plan.mock), lockstep=True) == DRY_RUN:
            raise CampaignError(
                f"{directory.source}: dry_run: a campaign measures nothing while drives are off; "
                "leave it out, or give another file with --services"
            )
        return cls(plan, task, directory)


class BlockSelector:
    """Draws actions from probabilities that were fixed before the block. Each draw depends only on
    mission seed, trial and occurrence, so it is the same on any worker."""

    def __init__(self, seed: int, weights: Sequence[Weights]) -> None:
        self._seed, self._weights = seed, weights
        self._counts: dict[tuple[int, str], int] = {}
        self.trial: Callable[[str], int] = lambda run: 1
        """Returns the number of a run's trial, from 1."""

    def choose(
        self,
        task: str,
        run: str,
        alternatives: tuple[str, ...],
        variables: Mapping[str, Any] | None = None,
    ) -> tuple[str, str]:
        """Choose one alternative and say why."""
        k = max(0, min(self.trial(run), len(self._weights)) - 1)
        given = self._weights[k].get(task, {}) if self._weights else {}
        offered = [
            (action, given[action]) for action in alternatives if given.get(action, 0.0) > 0.0
        ]
        if not offered:
            return alternatives[0], "first of the task file"
        # The generator is keyed by (mission seed, trial, occurrence, primitive task): the draw does
        # not depend on how many draws other tasks or trials made before it.
        occurrence = self._counts[k, task] = self._counts.get((k, task), -1) + 1
        if len(offered) == 1:
            return offered[0][0], "fixed by the campaign"
        key = [self._seed, k, occurrence, *task.encode()]
        bounds = np.cumsum([p for _, p in offered])
        draw = np.random.default_rng(key).random() * bounds[-1]
        index = min(int(np.searchsorted(bounds, draw, side="right")), len(offered) - 1)
        return offered[index][0], f"drawn with probability {offered[index][1] / bounds[-1]:.3f}"


def run_block(bench: LoadedPlan, block: Block, weights: Sequence[Weights]) -> dict[str, Any]:
    """Run a block. `weights`: for each of its trials, the probabilities of the actions of each
    primitive task.

    Returns `trials` (see Trial.to_plain), `score` (one mapping per trial), `plots`, `mission_s`,
    `cpu_s`, `wall_s` and `rss_mb`. Raises CampaignError.
    """
    cpu, wall = time.process_time(), time.perf_counter()
    selector = BlockSelector(block.seed, weights)
    mission, parties = _cell(bench, block, selector)
    log = TrialLog(bench.task, costs(bench.task, bench.directory))
    mission.executor.observers.append(log)
    selector.trial = log.tokens.of
    coordinator = CoordinatorParty(bench.directory, mission)
    try:
        cell = LockStepCell([coordinator, *parties], Delays(bench.directory.delays()))
        limit = round(LONGEST_TRIAL * block.count / TICK)
        if not cell.run(lambda: coordinator.over, limit):
            raise CampaignError(
                f"seed {block.seed}: not finished after {limit * TICK:.0f} s of simulated time; "
                "repeat it with `petrobot run --mode lockstep --seed` to see where it hangs"
            )
    except (CellError, MissionError) as fault:
        raise CampaignError(
            f"seed {block.seed}, regime {block.regime or 'of the task file'}: {fault}"
        ) from fault
    finally:
        for party in parties:
            close = getattr(party, "close", None)
            if close is not None:
                close()
    physics = mission.score.get("physics", "")
    if physics and not same_physics(bench.plan.physics, physics):
        raise CampaignError(
            f"seed {block.seed}: ran with the physics {physics!r}, the campaign's is "
            f"{bench.plan.physics or FIRST_PHYSICS!r}: trials of different physics are not pooled; "
            "write the same `physics` in services.toml ([nodes.NAME] of the simulated node)"
        )
    return {
        "index": block.index,
        "trials": [trial.to_plain() for trial in log.trials],
        "score": scores(mission.score, block.count),
        PLOTS: dict(mission.score.get(PLOTS, {})),
        "mission_s": round(mission.ended - mission.begun, 6),
        "cpu_s": round(time.process_time() - cpu, 4),
        "wall_s": round(time.perf_counter() - wall, 4),
        "rss_mb": resident_mb(),
    }


def resident_mb() -> float:
    """Return the resident memory of this process (MiB); 0 if the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)


def _cell(bench: LoadedPlan, block: Block, selector: BlockSelector) -> tuple[Mission, list[Party]]:
    plan, directory = bench.plan, bench.directory
    regime = {"regime": block.regime} if block.regime else {}
    setting = Setting(bench.task, {**plan.parameters, **regime}, block.count, block.seed, selector)
    substitutes = load_object(SCRIPTED)(plan.mock) if plan.mock else None
    try:
        parties = [
            lockstep_party(directory, node, substitutes) for node in directory.nodes.values()
        ]
    except RequestError as fault:
        raise CampaignError(str(fault)) from fault
    except (DirectoryError, ImportError, ValueError, OSError) as fault:
        raise CampaignError(f"{plan.services}: {fault}") from fault
    return lockstep_mission(directory, setting), parties


def costs(task: Task, directory: Directory) -> CostOf:
    """Return a function that gives the cost of a run by the measure that its primitive task
    declares. In lock step, CPU time is the compute time declared in services.toml, times what the
    run used (`count` of its result, else 1)."""

    def cost(record: RunRecorded, values: Mapping[str, Any]) -> float | None:
        measure = task.primitive_tasks[record.primitive_task].cost
        if measure == "wall":
            return record.seconds
        used = values.get(COUNT, 1)
        if measure == "cpu":
            entry = directory.actions.get(record.action)
            used = used if isinstance(used, int | float) else 1
            return None if entry is None else entry.compute_time * used
        value = used if measure == COUNT else values.get(measure.partition(":")[2])
        return float(value) if isinstance(value, bool | int | float) else None

    return cost


def scores(score: Mapping[str, Any], count: int) -> list[dict[str, Any]]:
    """Return the task's own results for each trial, as `table.column` from the score's lists of
    rows.

    A row belongs to the trial given by its `run`, or by its `n` if it has no `run`. If no list has
    such rows and there is only one trial, the plain values of the score are its results, as
    `score.name`.
    """
    out: list[dict[str, Any]] = [{} for _ in range(count)]
    tables = {name: rows for name, rows in score.items() if _is_table(rows)}
    for name, rows in tables.items():
        for row in rows:
            k = row["run"] if "run" in row else row.get("n")
            if isinstance(k, int) and 1 <= k <= count and f"{name}.n" not in out[k - 1]:
                out[k - 1] |= {
                    f"{name}.{key}": value for key, value in row.items() if key != "run"
                } | {f"{name}.n": row.get("n")}
    if not tables and count == 1:
        out[0] = {
            f"score.{k}": v
            for k, v in score.items()
            if isinstance(v, bool | int | float | str | None)
        }
    return out


def _is_table(rows: Any) -> bool:
    return (
        isinstance(rows, Sequence)
        and bool(rows)
        and not isinstance(rows, str | bytes)
        and all(isinstance(row, Mapping) and ("run" in row or "n" in row) for row in rows)
    )
