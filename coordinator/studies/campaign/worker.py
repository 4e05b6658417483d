"""Worker process of a campaign: receives blocks on standard input and writes results to standard
output, one JSON text per line.

Its argument is the process id of its parent: it ends with the parent, even in the middle of a block
or of an action that hangs. The first line is the plan. Everything else that is written to standard
output (by drivers, for example) goes to standard error.
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
    """Run the block in `order` (`block`, `weights`); `plan` as JSON. A CampaignError is returned as
    `fault`."""
    try:
        return run_block(_bench(plan), Block(**order["block"]), order["weights"]) | {
            "pid": os.getpid()
        }
    except CampaignError as fault:
        return {"index": order["block"]["index"], "fault": str(fault)}


def serve(orders: Iterator[str], answers: TextIO) -> None:
    """Answer each order until there are no more; the first line is the plan. Nothing of a block is
    left in memory when the next one begins."""
    plan, settled = next(orders, ""), False
    for line in orders:
        print(json.dumps(answer(plan, json.loads(line))), file=answers, flush=True)
        # The objects of a mission form reference cycles. Without an explicit collection several
        # missions pile up and fragment the heap.
        gc.collect()
        if not settled:
            # Exclude what the first block has loaded from later collections: 2 ms instead of 200.
            settled = True
            gc.freeze()


def main() -> None:
    """Reserve the original standard output for answers, then serve."""
    die_with(int(sys.argv[1]))
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
        os.dup2(2, 1)
        try:
            serve(sys.stdin, answers)
        except KeyboardInterrupt:
            sys.exit(130)


if __name__ == "__main__":
    main()
