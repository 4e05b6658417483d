"""The power fails at any moment: journal, sync, effect and acknowledgement come in this order, so
nothing runs twice or is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from petrobot.coordinator.engine import Begin, CancelRun, Engine, RunEnded, StartRun
from petrobot.coordinator.engine.stimuli import EventOccurred
from petrobot.coordinator.launch import make_mission, with_runs
from petrobot.coordinator.run.journal import JournalWriter, read_journal
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.run.recording import JournalStore, RecordedStep, replay
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import loads
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import Event
from tests.power_cut import Disk, power_cut
from tests.run import test_resume as resuming
from tests.run.test_resume import CrashError, Laboratory, outcome
from tests.run.toy_arm import TASK, TIDY, WORK, Bench, directory

JOURNAL = "run/run.journal"


def left(disk: Disk, folder: Path, engine: Engine, torn: float = 0.0) -> list[RecordedStep]:
    """Return the steps that a replay computes after a power cut."""
    image = disk.left(torn)
    if JOURNAL not in image:
        return []
    copy = folder / "copy.journal"
    copy.write_bytes(image[JOURNAL])
    return list(replay(read_journal(copy), engine))


def ordered(steps: Iterable[RecordedStep], kind: type) -> set[str]:
    """Return the runs of the instructions of this kind."""
    return {
        i.run
        for step in steps
        for i in step.instructions
        if isinstance(i, kind) and isinstance(i, StartRun | CancelRun)
    }


def ended(steps: Iterable[RecordedStep]) -> set[str]:
    """Return the runs whose end is recorded."""
    return {step.stimulus.run for step in steps if isinstance(step.stimulus, RunEnded)}


def run_of(call: str) -> str:
    """Return the run of a call."""
    return call.rpartition("/")[2]


def watched(caller: Caller, name: str, look: Callable[..., None]) -> None:
    """Make this method of a caller first call `look` with its arguments."""
    method = getattr(caller, name)

    def call(now: float, *given: Any) -> None:
        look(*given)
        method(now, *given)

    setattr(caller, name, call)


@pytest.mark.parametrize(
    ("disk_waits", "bell"), [(None, 10), (0, 10), (2, 10), (9, 10), (2, 0), (9, 0), (9, 5)]
)
def test_calls_and_acknowledgements_are_sent_only_after_their_records_are_on_disk(
    tmp_path: Path, disk_waits: int | None, bell: int
) -> None:
    """With the real store: for each call, cancel and acknowledgement, when it is passed to the
    connection. `disk_waits`: how many tenths of a second a sync in the background takes;
    None: syncs are done at once."""
    seen: list[str] = []
    syncs: list[Callable[[], None]] = []
    with power_cut(tmp_path) as disk:
        store = JournalStore(JournalWriter(tmp_path / JOURNAL, {"mission": "m"}), 0.0)
        bench = Bench(store=store)
        if disk_waits is not None:
            bench.executor.in_background = syncs.append
        places = directory()
        engine = Engine(
            loads(TASK, "toy"), {a.name: a.device for a in places.actions.values() if a.device}
        )

        def steps() -> list[RecordedStep]:
            return left(disk, tmp_path, engine)

        def called(call: m.Call) -> None:
            assert run_of(call.id) in ordered(steps(), StartRun), (
                f"{call.id} is called, its order is not on the disk"
            )
            seen.append(f"call {call.id}")

        def cancelled(call: str, *rest: object) -> None:
            assert run_of(call) in ordered(steps(), CancelRun), (
                f"{call} is cancelled, the order is not on the disk"
            )
            seen.append(f"cancel {call}")

        def acknowledged(call: str) -> None:
            assert run_of(call) in ended(steps()), (
                f"{call} is acknowledged, its end is not on the disk"
            )
            seen.append(f"acknowledge {call}")

        def event(event: Event) -> None:
            there = [s.stimulus.number for s in steps() if isinstance(s.stimulus, EventOccurred)]
            assert event.number in there, "the bell is acknowledged and not on the disk"
            seen.append(f"acknowledge {event.name}")

        for name, look in (("call", called), ("cancel", cancelled), ("acknowledge", acknowledged)):
            watched(bench.caller, name, look)
        watched(bench.caller, "acknowledge_event", event)
        answers: dict[str, list[m.Message]] = {
            WORK: [m.Accept(WORK)],
            TIDY: [m.Accept(TIDY), m.Outcome(TIDY, "success")],
        }
        began = 0
        bench.link(0.0)
        bench.executor.stimulate(0.0, Begin())
        for tick in range(100):
            if tick == bell:
                bench.ring(tick / 10)
            for message in bench.sent(m.Call, m.Cancel):
                if isinstance(message, m.Call):
                    bench.say(tick / 10, *answers[message.id])
                else:
                    bench.say(tick / 10, m.Outcome(WORK, "error", {}, "cancelled"))
            assert len(syncs) <= 1
            if not syncs:
                began = tick
            elif tick >= began + (disk_waits or 0):
                syncs.pop()()
                bench.executor.synced(tick / 10)
            bench.go(tick / 10)
        store.writer.close()
    assert bench.executor.over
    expected = ["acknowledge bell", f"call {TIDY}", f"acknowledge {TIDY}"]
    if bell >= (disk_waits or 0):  # otherwise `work` is stopped before its call may leave
        expected += [f"call {WORK}", f"cancel {WORK}", f"acknowledge {WORK}"]
    assert sorted(seen) == sorted(expected)


class Cellar(Laboratory):
    """The scripted laboratory with a coordinator whose disk loses what was not synced; its nodes
    keep their power."""

    acknowledged: set[str]

    def watch(self, mission: Mission) -> None:
        """Record what is acknowledged."""
        self.acknowledged = set()
        for caller in mission.callers.values():
            watched(caller, "acknowledge", self.acknowledged.add)

    def slow_disk(self, mission: Mission, ticks: int) -> None:
        """Let a sync take so many ticks, while the coordinator goes on."""
        syncs: list[Callable[[], None]] = []
        mission.executor.in_background = syncs.append
        waited = 0

        def disk(now: float) -> None:
            nonlocal waited
            waited = waited + 1 if syncs else 0
            if waited > ticks:
                waited = 0
                syncs.pop()()
                mission.synced(now)

        self.disk = disk


def cut_and_resume(
    task: Task, folder: Path, lives: int, torn: float, expected: Any, ticks: int = 0
) -> None:
    """Cut the power at an operation of the journal, and resume from what is left. `ticks`: how long
    a sync in the background takes; 0: it is done at once."""
    folder.mkdir()
    laboratory = Cellar(task, folder / "run")

    def watched_mission(*given: Any) -> Mission:
        mission = make_mission(*given)
        laboratory.watch(mission)
        mission.executor.store.__dict__["durable"] = True  # the actions of this cell have no device
        if ticks:
            laboratory.slow_disk(mission, ticks)
        return mission

    with power_cut(folder) as disk, pytest.MonkeyPatch.context() as patch:
        patch.setattr(resuming, "make_mission", watched_mission)
        with pytest.raises(CrashError):
            laboratory.begin(lives)
        image = disk.left(torn)
    laboratory.disk = lambda now: None
    where = f"power cut at operation {lives}, {torn:g} of what was not synced, {ticks} ticks"
    journal = folder / JOURNAL
    assert JOURNAL in image, f"{where}: the journal is gone"
    journal.write_bytes(image[JOURNAL])
    steps = list(replay(read_journal(journal), Engine(with_runs(task, resuming.RUNS)[0])))
    began = {run_of(call) for call in laboratory.executed}
    assert began <= ordered(steps, StartRun), f"{where}: executed, and the order is not on the disk"
    assert {run_of(call) for call in laboratory.acknowledged} <= ended(steps), (
        f"{where}: acknowledged and lost"
    )
    assert outcome(laboratory.resume()) == expected, where
    assert set(laboratory.executed.values()) == {1}, (
        f"{where}: executed twice: {laboratory.executed}"
    )


def places(task: Task, folder: Path, ticks: int = 0) -> tuple[Any, int]:
    """Return the outcome without a power cut, and the number of operations at which one can
    happen."""
    laboratory = Cellar(task, folder / f"undisturbed {ticks}")

    def durable(*given: Any) -> Mission:
        mission = make_mission(*given)
        mission.executor.store.__dict__["durable"] = True
        if ticks:
            laboratory.slow_disk(mission, ticks)
        return mission

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resuming, "make_mission", durable)
        mission, store = laboratory.begin(0)
    return outcome(mission), store.operations


TORN = (0.0, 0.5, 1.0)


def test_a_power_cut_anywhere_changes_nothing(catch_ball: Task, tmp_path: Path) -> None:
    """Cuts at twenty operations drawn at random; the proof cuts at all."""
    expected, operations = places(catch_ball, tmp_path)
    drawn = np.random.default_rng(2).choice(np.arange(1, operations), 20, replace=False)
    for number, lives in enumerate(sorted(drawn)):
        cut_and_resume(catch_ball, tmp_path / str(lives), int(lives), TORN[number % 3], expected)


def test_a_power_cut_while_a_slow_disk_syncs_changes_nothing(
    catch_ball: Task, tmp_path: Path
) -> None:
    """The coordinator goes on meanwhile: what it does must wait for the right sync."""
    expected, _ = places(catch_ball, tmp_path)
    for ticks in (1, 7, 40):
        slow, operations = places(catch_ball, tmp_path, ticks)
        assert slow == expected
        drawn = np.random.default_rng(ticks).choice(np.arange(1, operations), 8, replace=False)
        for number, lives in enumerate(sorted(drawn)):
            folder = tmp_path / f"{ticks} {lives}"
            cut_and_resume(catch_ball, folder, int(lives), TORN[number % 3], expected, ticks)


@pytest.mark.proof
def test_a_power_cut_at_every_operation_changes_nothing(catch_ball: Task, tmp_path: Path) -> None:
    """Every append, flush and sync of the journal in turn, with nothing, half and all of what was
    not synced."""
    expected, operations = places(catch_ball, tmp_path)
    for lives in range(1, operations):
        for torn in TORN:
            cut_and_resume(catch_ball, tmp_path / f"{lives} {torn}", lives, torn, expected)
