"""The plan of a campaign, and its division into blocks. Blocks and seeds depend only on the plan,
not on the number of workers.

A block is one mission run of a few trials in its own cell. Its mission seed is `seed * SEEDS +
block`, and a trial has number `k` in it. So `petrobot run TASK --mode lockstep --seed (mission
seed) --runs (trials of the block)` repeats a block alone.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from msgspec import Struct, field
from msgspec.structs import asdict

from petrobot.services.comm.location_file import MOCK, SIMULATED, same_physics
from petrobot.services.host.json_text import json_text
from petrobot.services.host.toml_text import InputError
from petrobot.services.host.whole_file import write_whole

SEEDS = 1_000_000
"""Mission seeds reserved for each campaign seed."""
MANIFEST = "campaign.json"
TABLE = "table.csv"
TASK_COPY = "task.toml"
SCHEMA = 1


class CampaignError(InputError):
    """A campaign cannot begin or continue; the text names file, key and remedy."""


class CampaignPlan(Struct, frozen=True):
    """A campaign. Paths are kept as given; digests tell whether the files have changed since it
    began."""

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
    """Actions that the user fixed, by primitive task."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    block: int = 5
    """Trials in one mission run; it influences the trials themselves."""
    batch: int = 20
    """Trials between two updates of what is learned; 0: nothing is learned, so no block waits for
    another."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the selector."""
    mock: str = ""
    """Path of a file of scripted actions, as for `petrobot run --mock`."""
    digests: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of the files above, by key."""
    physics: str = ""
    """Name and version of the simulated laboratory's physics; empty: it has only one, or the
    campaign is older than this key."""

    def to_plain(self) -> dict[str, Any]:
        """Return plain data for manifest and workers."""
        plain: dict[str, Any] = json.loads(json_text({"schema": SCHEMA, **asdict(self)}))
        return plain

    @classmethod
    def from_plain(cls, data: Mapping[str, Any]) -> CampaignPlan:
        """Read what `to_plain` returned. Raises CampaignError for another schema."""
        if data.get("schema") != SCHEMA:
            raise CampaignError(
                f"{MANIFEST}: schema: expected {SCHEMA}, got {data.get('schema')!r}"
            )
        given = {key: value for key, value in data.items() if key != "schema"}
        return cls(**{**given, "regimes": tuple(given["regimes"])})

    @property
    def plant(self) -> str:
        """Where its trials take place (`Directory.plant`)."""
        return MOCK if self.mock else SIMULATED

    @property
    def blocks(self) -> list[Block]:
        """All blocks in the order of the table: the regimes alternate."""
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
        """Blocks whose choices are drawn from the same state: `batch` trials or slightly more; all
        blocks if nothing is learned."""
        blocks, batch = self.blocks, []
        for block in blocks:
            batch.append(block)
            if self.batch and sum(b.count for b in batch) >= self.batch:
                yield batch
                batch = []
        if batch:
            yield batch


class Block(Struct, frozen=True):
    """One mission run of a campaign."""

    index: int
    """Index in the order of the table, from 0."""
    number: int
    """Index within its regime, from 0; the mission seed depends only on this."""
    regime: str
    first: int
    """Number of trials of the campaign before this block."""
    regime_first: int
    """Number of trials of its regime before this block."""
    count: int
    seed: int


def regimes_of(text: str) -> tuple[str, ...]:
    """Return the regimes of a comma-separated list. `C@1-5` stands for C@1, C@2, ..., C@5: one
    regime in five installations of a laboratory. Raises CampaignError."""
    found: list[str] = []
    for name in filter(None, (part.strip() for part in text.split(","))):
        regime, at, number = name.partition("@")
        first, dash, last = number.partition("-")
        if not (at and dash):
            found.append(name)
            continue
        if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last)):
            raise CampaignError(
                f"regime {name}: expected installations from and to, such as {regime}@1-5, got "
                f"{number!r}"
            )
        found += [f"{regime}@{n}" for n in range(int(first), int(last) + 1)]
    return tuple(found)


def digest(path: Path | str) -> str:
    """Return the SHA-256 of a file. Raises CampaignError if it cannot be read."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as fault:
        raise CampaignError(f"{path}: {fault.strerror or fault}") from fault


def write_manifest(folder: Path, plan: CampaignPlan) -> None:
    """Write the plan and a copy of the task file beside its table. Raises OSError."""
    write_whole(folder / TASK_COPY, Path(plan.task).read_text(encoding="utf-8"))
    write_whole(folder / MANIFEST, json_text(plan.to_plain(), indent=2) + "\n")


def read_manifest(folder: Path) -> CampaignPlan:
    """Read the plan from a campaign's folder. Raises CampaignError."""
    path = folder / MANIFEST
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(data, Mapping):
            raise ValueError(f"expected a JSON object, got a {type(data).__name__}")
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
            f"{path}: {said}; it is empty, incomplete or not a plan: {_remedy(folder)}"
        ) from fault


def _remedy(folder: Path) -> str:
    """Say what to do about a manifest that cannot be read."""
    if not (folder / TABLE).exists():
        return f"{folder} holds no run yet: remove {MANIFEST} and give the command again"
    return (
        f"restore it from a copy, remove {folder} to begin again, or give another --out "
        f"(without it nothing tells how {TABLE} was made)"
    )


def differences(old: CampaignPlan, new: CampaignPlan) -> list[str]:
    """Return the keys in which two plans differ, except paths of files with the same contents."""
    before, after = old.to_plain(), new.to_plain()
    same = {
        key for key in ("task", "services", "mock") if old.digests.get(key) == new.digests.get(key)
    }
    if same_physics(old.physics, new.physics):
        same.add("physics")
    return [key for key in before if key not in same and before[key] != after.get(key)]


def identity(plan: CampaignPlan) -> str:
    """Return a short hash of what a campaign runs, independent of paths: trials of campaigns with
    equal identity are the same trials."""
    data = plan.to_plain()
    for key in ("task", "services", "mock"):
        data[key] = plan.digests.get(key, "")
    if same_physics(plan.physics, ""):
        del data["physics"]  # so campaigns that are older than this key keep their identity
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]
