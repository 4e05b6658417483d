"""What a campaign is given, and how it is cut into blocks: the same blocks and seeds whoever does
them, however many do.

A block is one mission run with a few trials in a cell of its own. Trial i of a regime has number
`k` in the mission run with seed `seed * SEEDS + block`: so `petrobot run TASK --mode lockstep
--seed (that) --runs (the block's)` repeats it alone.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from petrobot.services.host.json_text import json_text
from petrobot.services.host.whole_file import write_whole

SEEDS = 1_000_000
"""Mission seeds of one campaign seed."""
MANIFEST = "campaign.json"
TABLE = "table.csv"
SCHEMA = 1


class CampaignError(Exception):
    """A campaign cannot begin or go on; the text names file, key and remedy."""


@dataclass(frozen=True)
class CampaignPlan:
    """A campaign. Paths are kept as given; digests tell whether what they name has changed
    since."""

    task: str
    """Path of the task file."""
    services: str
    runs: int
    """Trials in all regimes together."""
    regimes: tuple[str, ...]
    """Values of the task's parameter `regime`; one empty name if it has none."""
    seed: int = 1
    selector: str = "fixed"
    chosen: Mapping[str, str] = field(default_factory=dict)
    """The action of each primitive task that is chosen by hand."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    block: int = 5
    """Trials in one mission run; it changes which trials there are."""
    batch: int = 20
    """Trials between two updates of what is learned; 0: nothing is learned, so nobody waits."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the selector."""
    mock: str = ""
    """File of scripted actions, as of `petrobot run --mock`."""
    digests: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of the files above, by key."""

    def to_plain(self) -> dict[str, Any]:
        """Plain data for manifest and workers."""
        return json.loads(json_text({"schema": SCHEMA, **asdict(self)}))  # type: ignore[no-any-return]

    @classmethod
    def from_plain(cls, data: Mapping[str, Any]) -> CampaignPlan:
        """Back from `to_plain`. Raises CampaignError for another schema."""
        if data.get("schema") != SCHEMA:
            raise CampaignError(
                f"{MANIFEST}: schema {data.get('schema')!r}, this petrobot writes {SCHEMA}"
            )
        given = {key: value for key, value in data.items() if key != "schema"}
        return cls(**{**given, "regimes": tuple(given["regimes"])})

    @property
    def blocks(self) -> list[Block]:
        """All blocks in the order of the table: the regimes take turns."""
        counts = [
            self.runs // len(self.regimes) + (r < self.runs % len(self.regimes))
            for r in range(len(self.regimes))
        ]
        whole: list[tuple[int, int, str, int]] = []
        for r, regime in enumerate(self.regimes):
            for number in range(-(-counts[r] // self.block)):
                whole.append((number, r, regime, min(self.block, counts[r] - number * self.block)))
        out, first = [], 0
        for index, (number, _, regime, count) in enumerate(sorted(whole)):
            out.append(
                Block(
                    index,
                    number,
                    regime,
                    first,
                    number * self.block,
                    count,
                    self.seed * SEEDS + number,
                )
            )
            first += count
        return out

    @property
    def batches(self) -> Iterator[list[Block]]:
        """Blocks whose choices are drawn from one state: `batch` trials or a little more, all of
        them if nothing is learned."""
        blocks, batch = self.blocks, []
        for block in blocks:
            batch.append(block)
            if self.batch and sum(b.count for b in batch) >= self.batch:
                yield batch
                batch = []
        if batch:
            yield batch


@dataclass(frozen=True, slots=True)
class Block:
    """A mission run of a campaign."""

    index: int
    """In the order of the table, from 0."""
    number: int
    """In its regime, from 0: its seed depends on this alone."""
    regime: str
    first: int
    """Trials of the campaign before it."""
    regime_first: int
    """Trials of its regime before it."""
    count: int
    seed: int

    def to_plain(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def digest(path: Path | str) -> str:
    """SHA-256 of a file. Raises CampaignError when it cannot be read."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as fault:
        raise CampaignError(f"{path}: {fault.strerror or fault}") from fault


def write_manifest(folder: Path, plan: CampaignPlan) -> None:
    """Keep the plan beside its table."""
    write_whole(folder / MANIFEST, json_text(plan.to_plain(), indent=2) + "\n")


def read_manifest(folder: Path) -> CampaignPlan:
    """The plan of a campaign's folder. Raises CampaignError."""
    path = folder / MANIFEST
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(data, Mapping):
            raise ValueError(f"a {type(data).__name__} is no plan")
        return CampaignPlan.from_plain(data)
    except (FileNotFoundError, NotADirectoryError) as fault:
        remedy = "give a folder that `petrobot campaign --out FOLDER` wrote"
        raise CampaignError(
            f"{folder} holds no campaign: {MANIFEST} is missing; {remedy}"
        ) from fault
    except OSError as fault:
        raise CampaignError(f"{path}: {fault.strerror or fault}") from fault
    except (KeyError, ValueError, TypeError, AttributeError) as fault:
        said = f"the key {fault} is missing" if isinstance(fault, KeyError) else str(fault)
        raise CampaignError(
            f"{path}: {said}; it is empty, torn or no plan: {_remedy(folder)}"
        ) from fault


def _remedy(folder: Path) -> str:
    """What to do about a manifest that cannot be read."""
    if not (folder / TABLE).exists():
        return f"no run stands in {folder} yet: remove {MANIFEST} and give the command again"
    return (
        f"put it back from a copy, remove {folder} to begin anew, or give another --out "
        f"(what {TABLE} was made with is not known without it)"
    )


def differences(old: CampaignPlan, new: CampaignPlan) -> list[str]:
    """Keys in which two plans differ, but for paths whose files are the same."""
    before, after = old.to_plain(), new.to_plain()
    same_file = {
        key for key in ("task", "services", "mock") if old.digests.get(key) == new.digests.get(key)
    }
    return [key for key in before if key not in same_file and before[key] != after.get(key)]


def identity(plan: CampaignPlan) -> str:
    """A short name of what a campaign runs, the same wherever its files lie: trials of equal
    identity are the same trials."""
    data = plan.to_plain()
    for key in ("task", "services", "mock"):
        data[key] = plan.digests.get(key, "")
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]
