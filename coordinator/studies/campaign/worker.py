"""A campaign's worker process: blocks in on standard input, results out on standard output, one
JSON text a line.

Its argument is its parent's process id: it ends with it, also in the middle of a block or of an
action that hangs. The first line is the plan. Whatever else writes to standard output (drivers do)
goes to standard error.
"""

from __future__ import annotations

import gc
import json
import os
import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, TextIO

from petrobot.coordinator.studies.campaign.block import LoadedPlan, run_block
from petrobot.coordinator.studies.campaign.plan import Block, CampaignError, CampaignPlan
from petrobot.services.host.parent_death import die_with


@lru_cache(maxsize=1)
def _bench(plan: str) -> LoadedPlan:
    return LoadedPlan.of(CampaignPlan.from_plain(json.loads(plan)))


def answer(plan: str, order: Mapping[str, Any]) -> dict[str, Any]:
    """Run the block that `order` holds (`block`, `weights`); `plan` as JSON. A fault of the
    campaign's comes as `fault`."""
    try:
        return run_block(_bench(plan), Block(**order["block"]), order["weights"]) | {
            "pid": os.getpid()
        }
    except CampaignError as fault:
        return {"index": order["block"]["index"], "fault": str(fault)}


def serve(orders: Iterator[str], answers: TextIO) -> None:
    """Answer each order until there is none; the first line is the plan. Nothing of a block is
    there when the next one begins."""
    plan, settled = next(orders, ""), False
    for line in orders:
        print(json.dumps(answer(plan, json.loads(line))), file=answers, flush=True)
        # A mission refers to itself in circles: left to the collector's own time, several pile up
        # and break the heap into pieces
        gc.collect()
        if not settled:
            # what the first block has loaded stays: the collector need not look through it in every
            # later one (2 ms, not 200)
            settled = True
            gc.freeze()


def main() -> None:
    """Keep the way to the parent for answers alone."""
    die_with(int(sys.argv[1]))
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
        os.dup2(2, 1)
        try:
            serve(sys.stdin, answers)
        except KeyboardInterrupt:
            sys.exit(130)


if __name__ == "__main__":
    main()
