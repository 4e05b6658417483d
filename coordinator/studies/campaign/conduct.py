"""Conduct a campaign: give blocks to a pool of workers, append rows to the table in order, and
learn batch by batch."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, TextIO

from msgspec import Struct
from msgspec.structs import asdict

from petrobot.coordinator.studies.campaign.block import PLOTS, LoadedPlan
from petrobot.coordinator.studies.campaign.observed import write_estimates
from petrobot.coordinator.studies.campaign.plan import (
    MANIFEST,
    TABLE,
    Block,
    CampaignError,
    CampaignPlan,
    differences,
    identity,
    read_manifest,
    write_manifest,
)
from petrobot.coordinator.studies.campaign.policies import ChoicePolicy, policy_of
from petrobot.coordinator.studies.campaign.summary import Summary, result_of
from petrobot.coordinator.studies.campaign.table import (
    CampaignTable,
    TrialRow,
    note_block,
    note_sessions,
    rows_of,
    sessions,
)
from petrobot.services.host.json_text import json_text
from petrobot.services.host.whole_file import make_folder, write_whole

AHEAD = 3
"""Blocks handed out beyond those that the workers are busy with, so that no worker is idle while
the campaign waits for a slow block."""


class BlockPool(Protocol):
    """Anything that runs blocks."""

    count: int
    lost: int

    async def run(self, order: Mapping[str, Any]) -> dict[str, Any]:
        """Run a block and return the result of `run_block`. Raises CampaignError."""


class CampaignProgress(Struct, frozen=True):
    """Progress of a campaign."""

    done: int
    """Trials in the table."""
    of: int
    already: int
    """Trials that were in the table before this session."""
    goals: int
    seconds: float
    """Seconds since this session began (wall clock)."""


Watch = Callable[[CampaignProgress], None]


def open_folder(folder: Path, plan: CampaignPlan) -> None:
    """Create the folder of a campaign, or check that it holds the same campaign. Raises
    CampaignError."""
    try:
        make_folder(folder)
    except OSError as fault:
        raise CampaignError(
            f"{folder}: {fault.strerror or fault}; give --out a folder that can be written"
        ) from fault
    if (folder / TABLE).exists() or (folder / MANIFEST).exists():
        other = differences(read_manifest(folder), plan)
        if other:
            raise CampaignError(
                f"{folder} holds another campaign: {', '.join(other)} differ; give another --out"
            )
    else:
        write_manifest(folder, plan)


class Campaign:
    """One campaign in its folder."""

    def __init__(self, folder: Path, plan: CampaignPlan, watch: Watch | None = None) -> None:
        """Raises CampaignError if files, choices or folder do not fit."""
        self.plan, self.folder = plan, folder
        self.bench = LoadedPlan.of(plan)
        self.policy: ChoicePolicy = policy_of(plan, self.bench.task, self.bench.directory)
        open_folder(folder, plan)
        self.table = CampaignTable(folder, self.bench.task)
        self._watch = watch
        self._goals = self._trials = self._already = 0
        self._began = time.monotonic()
        self._sessions: list[dict[str, str]] = []
        self._session: dict[str, Any] = {}

    @property
    def complete(self) -> bool:
        """Whether the table already holds all trials."""
        blocks = self.plan.blocks
        return self.table.recover(blocks) == len(blocks)

    async def run(self, pool: BlockPool) -> None:
        """Run the missing blocks. If it is interrupted at any point, the next `run` in the same
        folder continues. Raises CampaignError."""
        blocks = self.plan.blocks
        done = self.table.recover(blocks)
        if done == len(blocks) and not self.policy.learns:
            return
        self._sessions = sessions(self.folder)
        self._session = {
            "began_at": datetime.now(UTC).isoformat(timespec="seconds"),
            "workers": pool.count,
            "blocks": 0,
        }
        self._began = time.monotonic()
        self._already = self._trials = sum(block.count for block in blocks[:done])
        if self.policy.learns:
            await self._learn(pool, done)
        else:
            async for _ in self._results(pool, self._orders(blocks[done:])):
                pass

    async def _learn(self, pool: BlockPool, done: int) -> None:
        """Run batch by batch; what is in the table already is learned again from it."""
        before = self.table.rows()
        for batch in self.plan.batches:
            orders = list(self._orders(batch))
            known = list(islice(before, sum(block.count for block in batch if block.index < done)))
            left = iter([order for order in orders if order[0].index >= done])
            fresh = [row async for rows in self._results(pool, left) for row in rows]
            self.policy.update([*known, *fresh])

    def result(self) -> dict[str, Any]:
        """Return the result so far, as the command line writes it, and write the estimates file
        beside the table."""
        name = identity(self.plan)
        summary = Summary.of(self.bench.task, self.table.rows(), name, self.plan.options)
        write_estimates(
            self.folder,
            summary.estimates,
            self.policy.selectors(),
            name,
            summary.asked(),
            self.plan.physics,
            self.plan.plant,
        )
        return result_of(self.folder, self.plan, summary, self.policy.state())

    async def _results(
        self, pool: BlockPool, orders: Iterator[tuple[Block, dict[str, Any]]]
    ) -> AsyncIterator[list[TrialRow]]:
        """Yield the rows of the blocks in order; the rows of a block are in the table before they
        are yielded."""
        active: deque[tuple[Block, asyncio.Task[dict[str, Any]]]] = deque()
        try:
            while True:
                for block, order in islice(orders, pool.count + AHEAD - len(active)):
                    active.append((block, asyncio.create_task(pool.run(order))))
                if not active:
                    return
                block, task = active[0]
                result = await task
                active.popleft()
                yield self._keep(pool, block, result)
        finally:
            for _, task in active:
                task.cancel()
            await asyncio.gather(*(task for _, task in active), return_exceptions=True)

    def _orders(self, blocks: Iterable[Block]) -> Iterator[tuple[Block, dict[str, Any]]]:
        for block in blocks:
            yield block, {"block": asdict(block), "weights": self.policy.weights(block)}

    def _keep(self, pool: BlockPool, block: Block, result: Mapping[str, Any]) -> list[TrialRow]:
        if "fault" in result:
            raise CampaignError(str(result["fault"]))
        rows = rows_of(block, result)
        plots = self.folder / f"{PLOTS}.json"
        if result[PLOTS] and not plots.exists():
            write_whole(plots, json_text(result[PLOTS], indent=2) + "\n")
        note_block(self.folder, block, result)
        self._note_session(pool)
        self.table.append(rows)
        self._trials += len(rows)
        self._goals += sum(1 for row in rows if row.trial is not None and row.trial.goals > 0)
        if self._watch is not None:
            now = time.monotonic() - self._began
            self._watch(
                CampaignProgress(self._trials, self.plan.runs, self._already, self._goals, now)
            )
        return rows

    def _note_session(self, pool: BlockPool) -> None:
        """Write this session so far, so that a session that is killed is recorded, too."""
        self._session["blocks"] += 1
        self._session |= {"wall_s": round(time.monotonic() - self._began, 3), "lost": pool.lost}
        note_sessions(self.folder, [*self._sessions, self._session])


# --- progress in a terminal ---


WIDTH = 30
BEFORE = 0.2
"""Shortest time between two updates (s)."""


def clock(seconds: float) -> str:
    """Return seconds as m:ss or h:mm:ss."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def line(progress: CampaignProgress) -> str:
    """Return the progress line: a bar, trials done, share that met their goal in this session,
    elapsed and remaining time."""
    full = round(WIDTH * progress.done / max(1, progress.of))
    fresh = progress.done - progress.already
    left = progress.seconds / fresh * (progress.of - progress.done) if fresh else 0.0
    met = f"{progress.goals / fresh:.1%} met" if fresh else ""
    bar = "#" * full + "." * (WIDTH - full)
    return (
        f"[{bar}] {progress.done}/{progress.of}  {met}  {clock(progress.seconds)} gone, "
        f"{clock(left)} to go"
    )


class ProgressLine:
    """Writes the progress line to a terminal over the previous one; writes nothing if the output is
    not a terminal."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._shown = -BEFORE
        self._length = 0
        self.wanted = out.isatty()

    def __call__(self, progress: CampaignProgress) -> None:
        """Show the progress, unless the last update is too recent and the campaign is not
        finished."""
        if not self.wanted or (
            progress.seconds - self._shown < BEFORE and progress.done < progress.of
        ):
            return
        self._shown = progress.seconds
        text = line(progress)
        print("\r" + text.ljust(self._length), end="", file=self._out, flush=True)
        self._length = len(text)

    def close(self) -> None:
        """Finish the line."""
        if self._length:
            print(file=self._out, flush=True)
