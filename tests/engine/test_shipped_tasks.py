"""The catching task: its state space, its branches, and a mission run to each of its ends."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.engine import (
    AddTokens,
    ArmTimer,
    Begin,
    CancelRun,
    Choose,
    Chosen,
    Engine,
    EventOccurred,
    Finished,
    Instruction,
    RemoveTokens,
    RunEnded,
    RunRecorded,
    StartRun,
    StopConfirmed,
    TimerFired,
)
from petrobot.coordinator.task import Status, Task
from petrobot.coordinator.task.check import Severity, check
from petrobot.coordinator.task.file import load
from petrobot.coordinator.task.net import Marking

PATH = Path(__file__).parents[2] / "coordinator" / "tasks" / "catch_ball.toml"
OK, FAIL, ERR = Status.SUCCESS, Status.FAILURE, Status.ERROR
Script = Callable[[StartRun], Status | None]


@pytest.fixture(scope="module")
def catch() -> Task:
    """The catching task."""
    return load(PATH)


def test_check_finds_nothing_but_one_arrival_order(catch: Task) -> None:
    offers = {a: "node" for p in catch.primitive_tasks.values() for a in p.alternatives}
    report = check(catch, offers)
    assert report.ok and [(f.severity, f.code) for f in report.findings] == [
        (Severity.NOTE, "arrival-order")
    ]


def reachable(task: Task) -> dict[Marking, list[Marking]]:
    """Return all markings with their successors."""
    net = task.net
    found: dict[Marking, list[Marking]] = {}
    fresh = [net.initial]
    while fresh:
        marking = fresh.pop()
        if marking not in found:
            found[marking] = [net.fire(marking, t) for t in net.enabled(marking)]
            fresh += found[marking]
    return found


def test_every_dead_marking_is_final_or_final_error_and_always_reachable(catch: Task) -> None:
    space = reachable(catch)
    names = catch.net.places
    assert len(space) < 1000 and max(map(max, space)) == 4, "bounded"
    ends = [m for m, following in space.items() if not following]
    designed = [m for m in ends if catch.final.holds(dict(zip(names, m, strict=True)))]
    assert catch.final_error is not None
    honest = [m for m in ends if catch.final_error.holds(dict(zip(names, m, strict=True)))]
    assert (
        len(designed) == 1 and set(ends) == {*designed, *honest} and not set(designed) & set(honest)
    )
    before: dict[Marking, list[Marking]] = {m: [] for m in space}
    for marking, following in space.items():
        for m in following:
            before[m].append(marking)
    able, fresh = set[Marking](), [designed[0]]
    while fresh:
        marking = fresh.pop()
        if marking not in able:
            able.add(marking)
            fresh += before[marking]
    stuck = {m for m in space if m not in able}
    out = names.index("arm_out_of_order")
    assert all(m[out] for m in stuck), (
        "every error comes back to the normal flow until the arm is out of order"
    )


def test_all_transitions_can_fire_and_action_places_are_safe(catch: Task) -> None:
    space = reachable(catch)
    fired = {t for m in space for t in catch.net.enabled(m)}
    assert len(fired) == len(catch.net.transitions)
    for name, place in catch.places.items():
        if place.task:
            assert max(m[catch.net.place_index[name]] for m in space) == 1


class Cell:
    """Answers every order at once: events when a transition waits for them, ends of runs by a
    script."""

    def __init__(self, task: Task, script: Script, caught: bool = True, ticks: bool = True) -> None:
        devices = {
            a: p
            for p in ("arm", "camera")
            for t in _of(p)
            for a in task.primitive_tasks[t].alternatives
        }
        self.engine = Engine(task, devices)
        self.state = self.engine.initial()
        self.script, self.caught, self.ticks = script, caught, ticks
        self.all: list[Instruction] = []

    def run(self) -> Finished:
        """Play the task to its end."""
        queue: list[Any] = [Begin({"seed": 7})]
        for _ in range(2000):
            stimulus = queue.pop(0) if queue else self._idle()
            self.state, out = self.engine.handle(self.state, stimulus)
            self.all += out
            for i in out:
                if isinstance(i, Finished):
                    return i
                queue += self._answer(i)
        raise AssertionError("no end")

    def _answer(self, i: Instruction) -> list[Any]:
        if isinstance(i, Choose):
            return [Chosen(i.key, i.alternatives[-1], "test")]
        if isinstance(i, StartRun):
            status = self.script(i)
            if status is None:
                return [EventOccurred("ball_caught", "cup")]
            return [
                RunEnded(i.run, status, "" if status is OK else "test", values={"ball": [1.0, 0.2]})
            ]
        return [StopConfirmed(i.run)] if isinstance(i, CancelRun) else []

    def _idle(self) -> Any:
        if self.ticks:
            return EventOccurred("image_tick")
        return TimerFired([i for i in self.all if isinstance(i, ArmTimer)][-1].key)

    def records(self, place: str) -> list[RunRecorded]:
        """Return the records of the runs of a place."""
        return [i for i in self.all if isinstance(i, RunRecorded) and i.place == place]

    def tokens(self, place: str) -> int:
        """Return the tokens of a place."""
        return self.state.marking[self.engine.compiled.net.place_index[place]]


def _of(device: str) -> tuple[str, ...]:
    camera = ("locate_ball", "track_ball")
    return (
        camera
        if device == "camera"
        else ("move_to_point", "catch_ball", "return_home", "recover_arm")
    )


def test_four_catches(catch: Task) -> None:
    cell = Cell(catch, lambda s: None if s.place == "catch_ball" else OK)
    end = cell.run()
    assert end.status is OK and [r.status for r in cell.records("catch_ball")] == [OK] * 4
    starts = [i for i in cell.all if isinstance(i, StartRun) and i.place == "track_ball"]
    assert starts[0].arguments == {**catch.places["track_ball"].args, "ball": [1.0, 0.2]}


def test_balls_that_pass_use_up_the_runs(catch: Task) -> None:
    cell = Cell(catch, lambda s: FAIL if s.place == "catch_ball" else OK)
    assert cell.run().status is OK and [r.status for r in cell.records("catch_ball")] == [FAIL] * 4


@pytest.mark.parametrize(
    "place", ["locate_ball", "track_ball", "move_to_point", "catch_ball", "return_home"]
)
def test_an_error_anywhere_returns_to_the_normal_flow(catch: Task, place: str) -> None:
    cell = Cell(catch, lambda s: ERR if s.place == place else OK)
    assert cell.run().status is OK
    assert (cell.tokens("attempts"), cell.tokens("failed_attempts"), cell.tokens("arm_free")) == (
        3,
        0,
        1,
    )
    recovered = len(cell.records("recover_arm"))
    assert recovered == (0 if place in ("locate_ball", "track_ball") else 4)


def test_three_further_attempts_then_the_arm_is_given_up(catch: Task) -> None:
    cell = Cell(catch, lambda s: ERR if s.place in ("move_to_point", "recover_arm") else OK)
    end = cell.run()
    assert end.status is ERR and "given up" in end.reason
    assert len(cell.records("recover_arm")) == 4 and cell.tokens("runs") == 3


def test_attempts_are_given_back_after_a_recovery(catch: Task) -> None:
    def script(start: StartRun) -> Status | None:
        number = int(start.run.partition("#")[2])
        if start.place == "recover_arm":
            return OK if number % 3 == 0 else ERR
        return ERR if start.place == "catch_ball" else OK

    cell = Cell(catch, script)
    assert (
        cell.run().status is OK
        and len(cell.records("recover_arm")) == 12
        and cell.tokens("attempts") == 3
    )


def test_a_camera_that_takes_no_images_uses_the_runs_up(catch: Task) -> None:
    cell = Cell(catch, lambda s: OK, ticks=False)
    assert cell.run().status is OK and cell.records("locate_ball") == []


def test_operator_changes_the_number_of_runs(catch: Task) -> None:
    cell = Cell(catch, lambda s: None if s.place == "catch_ball" else OK)
    cell.state, _ = cell.engine.handle(cell.state, Begin())
    cell.state, _ = cell.engine.handle(cell.state, AddTokens("runs", 2))
    cell.state, _ = cell.engine.handle(cell.state, RemoveTokens("runs", 5))
    assert cell.run().status is OK and len(cell.records("catch_ball")) == 1
