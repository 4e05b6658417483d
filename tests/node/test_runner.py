"""Runs of actions: how each can end, what a cancel does, when the device is stopped, and that every
run ends exactly once."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from petrobot.services.action import CallFailed, Cancelled, Context, Result, error, failure, success
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.comm.protocol.messages import (
    Call,
    Cancel,
    Event,
    Executed,
    Feedback,
    Outcome,
)
from petrobot.services.node.inline_host import HOLD, RELEASE
from petrobot.services.worker.runner import GRACE, STOP_LIMIT, Runner
from petrobot.services.worker.setpoints import Sent
from tests.node.conftest import Bench, Clock, Device

Make = Callable[..., Bench]


def doubled(ctx: Context, *, x: int = 1) -> Result:
    return success(y=2 * x, text="é", raw=b"\0", rows=np.float64(1.5))


async def naps(ctx: Context, *, seconds: float = 0.1) -> Result:
    await ctx.sleep(seconds)
    return success(now=ctx.now)


async def forever(ctx: Context) -> Result:
    while True:
        await ctx.sleep(0.01)


def raises(ctx: Context) -> Result:
    results: dict[str, Result] = {}
    return results["missing"]


async def raises_later(ctx: Context) -> Result:
    await ctx.sleep(0.02)
    raise ConnectionError("the bus is gone")


class Foreign:
    """An awaitable of another framework."""

    def __await__(self) -> Generator[object, None, None]:
        yield self


async def awaits_foreign(ctx: Context) -> Result:
    await Foreign()
    return success()


async def forgets_await(ctx: Context) -> Result:
    naps(ctx)  # type: ignore[unused-coroutine]
    await ctx.sleep(0.02)
    return success()


async def forgets_await_and_fails(ctx: Context) -> Result:
    ctx.put("part", 3)  # type: ignore[unused-coroutine]
    return error("lost")


async def spins(ctx: Context) -> Result:
    while True:
        await ctx.wait(lambda: True)


async def bad_wait(ctx: Context) -> Result:
    await ctx.wait(lambda: 1 / 0 > 0)
    return success()


def leaves(ctx: Context) -> Result:
    raise SystemExit(3)


async def cancels_itself(ctx: Context) -> Result:
    raise Cancelled


ENDINGS: list[tuple[Any, dict[str, Any], str, str, str, str]] = [
    (doubled, {"x": 4}, "success", "", "", "yes"),
    (lambda ctx: failure("dark", "too dark", light=0.1), {}, "failure", "dark", "too dark", "yes"),
    (lambda ctx: error("lost"), {}, "error", "lost", "", "yes"),
    (lambda ctx: error(None), {}, "error", "", "", "yes"),  # type: ignore[arg-type]
    (naps, {}, "success", "", "", "yes"),
    (raises, {}, "error", "exception", "KeyError: 'missing' in raises (test_runner.py:", "yes"),
    (
        raises_later,
        {},
        "error",
        "exception",
        "ConnectionError: the bus is gone in raises_later",
        "yes",
    ),
    (
        awaits_foreign,
        {},
        "error",
        "exception",
        "awaits a Foreign; an action awaits only what its context gives it",
        "yes",
    ),
    (
        forgets_await,
        {},
        "error",
        "exception",
        "coroutine 'naps' was never awaited in forgets_await (test_runner.py:",
        "yes",
    ),
    (forgets_await_and_fails, {}, "error", "lost", "", "yes"),
    (spins, {}, "error", "exception", "times without time passing", "yes"),
    (bad_wait, {}, "error", "exception", "ZeroDivisionError", "yes"),
    (leaves, {}, "error", "exception", "SystemExit: 3", "yes"),
    (cancels_itself, {}, "error", "exception", "Cancelled", "yes"),
    (
        lambda ctx: 3,
        {},
        "error",
        "bad_result",
        "returned a int; return success(), failure() or error()",
        "yes",
    ),
    (
        lambda ctx: success(x=object()),
        {},
        "error",
        "bad_result",
        "result.x: a object is not plain data",
        "yes",
    ),
    (doubled, {"z": 4}, "error", "bad_arguments", "takes no argument 'z'; it takes: x", "no"),
    (lambda ctx, *, x: success(), {}, "error", "bad_arguments", "needs the argument 'x'", "no"),
    (
        doubled,
        {"x": object()},
        "error",
        "bad_arguments",
        "arguments.x: a object is not plain data",
        "no",
    ),
]


@pytest.mark.parametrize("device", [False, True])
@pytest.mark.parametrize(("action", "arguments", "status", "cause", "text", "executed"), ENDINGS)
def test_every_kind_of_end(
    bench: Make,
    device: bool,
    action: Any,
    arguments: dict[str, Any],
    status: str,
    cause: str,
    text: str,
    executed: str,
) -> None:
    b = bench(act=action, device=device or None)
    run = b.begin("act", **arguments)
    b.tick(3.0)
    end = b.ended(run)
    assert (end.status, end.cause, end.executed) == (status, cause, executed)
    assert text in end.text
    assert b.runner.runs == () and b.runner.due() is None
    if device:
        assert bool(b.device and b.device.stops) == (cause in ("exception", "bad_result"))


def test_a_forgotten_await_is_found_in_each_run(bench: Make) -> None:
    """Python warns only of the first at a line."""
    b = bench(act=forgets_await, good=naps)
    for _ in range(3):
        run, good = b.begin("act"), b.begin("good")
        b.tick(1.0)
        assert (b.ended(run).cause, b.ended(good).status) == ("exception", "success")


def test_results_are_plain_copies(bench: Make) -> None:
    shared = {"list": [1]}
    b = bench(act=lambda ctx, *, d: success(d=d, t=(1, np.int64(2))))
    run = b.begin("act", d=shared)
    b.tick()
    values = b.ended(run).values
    shared["list"].append(2)
    assert values == {"d": {"list": [1]}, "t": [1, 2]} and type(values["t"][1]) is int


def test_a_run_begins_at_advance_and_takes_simulated_time(bench: Make) -> None:
    b = bench(act=naps, virtual=True)
    run = b.begin("act", seconds=0.1)
    assert b.seen == [] and b.runner.due() == float("-inf")
    b.tick(1.0)
    assert b.ended(run).seconds == pytest.approx(0.1) and b.ended(run).values[
        "now"
    ] == pytest.approx(0.1)


@pytest.mark.parametrize(("virtual", "takes"), [(True, 0.05), (False, 0.0)])
def test_declared_computing_time_passes_in_lock_step_only(
    bench: Make, virtual: bool, takes: float
) -> None:
    b = bench(act=doubled, virtual=virtual, limits={"act": {"compute_time": 0.05}})
    run = b.begin("act")
    b.tick(1.0)
    assert b.ended(run).seconds == pytest.approx(takes, abs=TICK)


def test_cpu_time_is_that_of_the_action(bench: Make) -> None:
    b = bench(act=lambda ctx: success(n=sum(range(300_000))))
    run = b.begin("act")
    b.tick()
    assert 0.0005 < b.ended(run).cpu_seconds < 5.0


# --- cancel and deadline ----------------------------------------------------------------------


@pytest.mark.parametrize("why", ["cancelled", "deadline"])
def test_a_cancelled_action_cleans_up_and_its_device_comes_to_rest(bench: Make, why: str) -> None:
    log: list[str] = []

    async def moves(ctx: Context) -> Result:
        ctx.device.moving = True
        try:
            await forever(ctx)
        except Cancelled:
            log.append("brake")
            await ctx.sleep(0.05)
            ctx.device.moving = False
            raise
        return success()

    b = bench(act=moves, device=True)
    run = b.begin("act", 0.2 if why == "deadline" else None)
    b.tick(0.2)
    if why == "cancelled":
        b.take(Cancel(run))
    b.tick(1.0)
    end = b.ended(run)
    assert (end.status, end.cause, end.executed, log) == ("error", why, "yes", ["brake"])
    assert end.seconds == pytest.approx(0.25, abs=2 * TICK)
    assert b.device is not None and b.device.stops == []


@pytest.mark.parametrize("halting", [0.1, None])
def test_an_action_that_ignores_the_cancel_has_its_device_stopped(
    bench: Make, halting: float | None
) -> None:
    async def stubborn(ctx: Context) -> Result:
        ctx.device.moving = True
        while True:
            try:
                await ctx.sleep(10.0)
            except Cancelled:
                continue

    b = bench(act=stubborn, other=doubled, device=Device(Clock(), halting))
    run = b.begin("act")
    b.tick(0.1)
    b.take(Cancel(run, "cancelled: operator"))
    b.tick(GRACE / 2)
    assert b.device is not None and b.device.stops == [] and b.runner.runs == (run,)
    refused = b.begin("other")
    b.tick(GRACE + STOP_LIMIT)
    assert b.device.stops == [pytest.approx(0.1 + GRACE, abs=2 * TICK)]
    assert b.ended(refused).cause == "busy" and b.ended(refused).executed == "no"
    assert b.ended(run).cause == "cancelled" and "operator" in b.ended(run).text
    assert b.runner.fenced == (halting is None)
    later = b.begin("other")
    b.tick(0.1)
    assert b.ended(later).cause == ("fenced" if halting is None else "")
    b.device.moving = False
    b.tick()
    last = b.begin("other")
    b.tick()
    assert not b.runner.fenced and b.ended(last).status == "success"


def test_a_run_cancelled_before_it_began_was_not_executed(bench: Make) -> None:
    b = bench(act=doubled)
    run = b.begin("act")
    b.take(Cancel(run))
    b.tick(1.0)
    assert (b.ended(run).cause, b.ended(run).executed) == ("cancelled", "no")


def test_a_result_after_the_cancel_does_not_count(bench: Make) -> None:
    async def finishes(ctx: Context) -> Result:
        try:
            await ctx.sleep(9.0)
        except Cancelled:
            return success(done=True)
        return success()

    b = bench(act=finishes)
    run = b.begin("act")
    b.tick(0.1)
    b.take(Cancel(run))
    b.tick()
    assert (b.ended(run).status, b.ended(run).cause, b.ended(run).values) == (
        "error",
        "cancelled",
        {},
    )


def test_declared_computing_is_cancelled_too(bench: Make) -> None:
    b = bench(act=doubled, limits={"act": {"compute_time": 5.0}})
    run = b.begin("act", 1.0)
    b.tick(2.0)
    assert b.ended(run).cause == "deadline" and b.ended(run).seconds == pytest.approx(1.0, abs=TICK)


def test_a_run_without_waiting_starts_beside_a_stopping_one(bench: Make) -> None:
    async def slow(ctx: Context) -> Result:
        try:
            await ctx.sleep(9.0)
        finally:
            await ctx.sleep(0.3)
        return success()

    b = bench(act=slow, hold=doubled, device=True, limits={"hold": {"at_once": True}})
    run, early = b.begin("act"), b.begin("hold")
    b.tick(0.1)
    assert b.ended(early).cause == "busy"
    b.take(Cancel(run))
    hold = b.begin("hold")
    b.tick()
    assert b.ended(hold).status == "success" and b.runner.runs == (run,)


@settings(max_examples=60, deadline=None)
@given(
    cancels=st.lists(st.tuples(st.integers(0, 60), st.integers(0, 5)), max_size=6),
    begins=st.lists(
        st.tuples(st.integers(0, 60), st.sampled_from(["wait", "stubborn", "raise", "quick"])),
        max_size=6,
    ),
    halting=st.sampled_from([0.0, 0.2, None]),
)
def test_never_two_runs_on_a_device_and_each_ends_once(
    cancels: list[tuple[int, int]], begins: list[tuple[int, str]], halting: float | None
) -> None:
    active: list[str] = []

    def action(kind: str) -> Any:
        async def body(ctx: Context) -> Result:
            active.append(ctx.run)
            assert len(active) == 1, "two runs in their own code at once"
            try:
                ctx.device.moving = kind == "stubborn"
                for _ in range(4):
                    try:
                        await ctx.sleep(0.02)
                    except Cancelled:
                        if kind != "stubborn":
                            raise
                if kind == "raise":
                    raise ValueError(kind)
                return success() if kind == "quick" else await forever(ctx)
            finally:
                active.remove(ctx.run)

        return body

    clock = Clock()
    device = Device(clock, halting)
    entries = {k: action(k) for k in ("wait", "stubborn", "raise", "quick")}
    runner = Runner(
        {k: _entry(k) for k in entries},
        clock=clock,
        device=device,
        substitutes=entries,
        virtual=True,
    )
    ended: list[str] = []
    for tick in range(60 + int((GRACE + STOP_LIMIT + 0.5) / TICK)):
        clock.now = tick * TICK
        for n, (at, kind) in enumerate(begins):
            if at == tick:
                runner.take(clock.now, Call(f"run{n}", kind))
            elif tick == at + round(0.3 / TICK):  # its deadline, which its node watches
                runner.take(clock.now, Cancel(f"run{n}", "deadline: late"))
        for at, n in cancels:
            if at == tick:
                runner.take(clock.now, Cancel(f"run{n}"))
        runner.advance(clock.now)
        ended += [r.id for r in runner.reports() if isinstance(r, Outcome)]
    runner.advance(clock.now + GRACE + STOP_LIMIT)
    runner.advance(clock.now + 2 * (GRACE + STOP_LIMIT))
    ended += [r.id for r in runner.reports() if isinstance(r, Outcome)]
    assert sorted(ended) == sorted(f"run{n}" for n in range(len(begins)))
    assert active == []


def _entry(name: str) -> Any:
    from petrobot.services.comm.location_file import ActionEntry

    return ActionEntry(name, "tests:none", "task", "here", "it")


@settings(max_examples=40, deadline=None)
@given(at=st.integers(0, 25), steps=st.integers(1, 6))
def test_a_cancel_is_raised_once_at_whichever_wait(at: int, steps: int) -> None:
    reached: list[int] = []
    thrown: list[int] = []

    async def walk(ctx: Context) -> Result:
        for step in range(steps):
            reached.append(step)
            try:
                await ctx.sleep(4 * TICK)
            except Cancelled:
                thrown.append(step)
                raise
        return success(steps=steps)

    clock = Clock()
    runner = Runner({"walk": _entry("walk")}, clock=clock, substitutes={"walk": walk}, virtual=True)
    runner.take(0.0, Call("r", "walk"))
    ends: list[Outcome] = []
    for tick in range(40):
        clock.now = tick * TICK
        if tick == at:
            runner.take(clock.now, Cancel("r"))
        runner.advance(clock.now)
        ends += [r for r in runner.reports() if isinstance(r, Outcome)]
    (end,) = ends
    if end.status == "success":
        assert thrown == [] and len(reached) == steps and at > 4 * steps
    else:
        assert end.cause == "cancelled" and thrown == reached[-1:]


# --- calls, streams, events -------------------------------------------------------------------


def test_calls_go_out_with_child_ids_and_come_back(bench: Make) -> None:
    async def calls(ctx: Context) -> Result:
        first = await ctx.call("add", 2.0, a=1)
        second = await ctx.call("add", a=first.values["sum"])
        return success(sum=second.values["sum"])

    b = bench(act=calls)
    run = b.begin("act", seed=7)
    (asked,) = b.tick()
    assert asked == Call(f"{run}/1", "add", {"a": 1}, 2.0, parent=run, seed=7)
    b.answer(f"{run}/1", sum=2)
    (asked,) = b.tick()
    assert asked == Call(f"{run}/2", "add", {"a": 2}, parent=run, seed=7)
    b.answer(f"{run}/2", sum=3)
    b.tick()
    assert b.ended(run).values == {"sum": 3}


def test_the_result_of_a_call_is_its_outcome_in_every_field(bench: Make) -> None:
    """An action that passes it on says what the far side said, also what was executed; whether it
    is provisional concerns the far run alone."""

    async def passes_on(ctx: Context) -> Result:
        return await ctx.call("far")

    b = bench(act=passes_on)
    run = b.begin("act")
    b.tick()
    far = Outcome(f"{run}/1", "error", {"n": 1}, "lost", "no link", Executed.UNKNOWN, deferred=True)
    b.take(far)
    b.tick()
    end = b.ended(run)
    assert replace(end, id=far.id, seconds=0.0, cpu_seconds=0.0) == replace(far, deferred=False)


def test_open_calls_are_dropped_with_their_run(bench: Make) -> None:
    async def calls(ctx: Context) -> Result:
        return await ctx.call("endless")

    b = bench(act=calls)
    run = b.begin("act")
    b.tick(0.1)
    b.take(Cancel(run))
    assert Cancel(f"{run}/1", "its run no longer waits") in b.tick()
    b.answer(f"{run}/1")
    assert b.tick(0.1) == [] and b.ended(run).cause == "cancelled"


def test_the_global_memory_through_the_context(bench: Make) -> None:
    async def remembers(ctx: Context) -> Result:
        version = await ctx.put("light", 0.5)
        swapped = await ctx.compare_and_set("light", version, 0.6)
        late = await ctx.compare_and_set("light", version, 0.7)
        return success(version=version, swapped=swapped, late=late, value=await ctx.get("light"))

    b = bench(act=remembers)
    run = b.begin("act")
    replies: list[tuple[str, dict[str, Any]]] = [
        ("success", {"version": 3}),
        ("success", {"version": 4}),
        ("failure", {"version": 4, "value": 0.6}),
        ("success", {"version": 4, "value": 0.6}),
    ]
    for n, (status, values) in enumerate(replies, 1):
        b.tick()
        b.answer(f"{run}/{n}", status, **values)
    b.tick()
    assert b.ended(run).values == {"version": 3, "swapped": True, "late": False, "value": 0.6}


def test_a_dead_memory_is_an_exception_of_the_action(bench: Make) -> None:
    caught: list[Result] = []

    async def remembers(ctx: Context) -> Result:
        try:
            await ctx.get("light")
        except CallFailed as fault:
            caught.append(fault.result)
            raise
        return success()

    b = bench(act=remembers)
    run = b.begin("act")
    b.tick()
    b.answer(f"{run}/1", "error")
    b.tick()
    assert b.ended(run).cause == "exception" and "CallFailed: memory.get" in b.ended(run).text
    assert caught[0].status == "error"


def test_set_points_are_paced_repeated_and_end_with_their_run(bench: Make) -> None:
    async def streams(ctx: Context) -> Result:
        for n in range(5):
            ctx.publish("points", [float(n)])
            await ctx.sleep(TICK)
        await ctx.sleep(0.1)
        ctx.withdraw("points")
        await ctx.sleep(0.1)
        ctx.publish("points", [9.0])
        await ctx.sleep(0.05)
        return success()

    b = bench(act=streams)
    run = b.begin("act")
    sent: list[tuple[float, Sent]] = []
    for _ in range(100):
        sent += [(b.clock.now, r) for r in b.tick() if isinstance(r, Sent)]
        b.clock.now += TICK
    first = [(t, s) for t, s in sent if s.values != (9.0,)]
    assert [t for t, _ in first] == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08, 0.1], abs=1e-9)
    assert [s.values[0] for _, s in first] == [0.0, 4.0, 4.0, 4.0, 4.0, 4.0]
    assert [s.elapsed for _, s in first][1:] == pytest.approx(
        [0.004 + 0.02 * k for k in range(5)], abs=1e-9
    )
    last = [t for t, s in sent if s.values == (9.0,)]
    assert len(last) in (3, 4) and max(last) <= b.ended(run).seconds + 1e-9


@pytest.mark.parametrize(
    ("stream", "values"), [("nowhere", [1.0]), ("points", [float("nan")]), ("points", ["x"])]
)
def test_a_bad_set_point_is_the_actions_fault(bench: Make, stream: str, values: list[Any]) -> None:
    async def streams(ctx: Context) -> Result:
        ctx.publish(stream, values)
        return success()

    b = bench(act=streams)
    run = b.begin("act")
    b.tick()
    assert b.ended(run).cause == "exception" and "ValueError" in b.ended(run).text


def test_events_and_progress(bench: Make) -> None:
    async def tells(ctx: Context) -> Result:
        ctx.raise_event("contact", force=np.float64(2.0))
        ctx.progress(1.7, seen=3)
        await ctx.sleep(0.1)
        return success()

    b = bench(act=tells)
    run = b.begin("act")
    assert b.tick() == [
        Event("contact", "act", 0, {"force": 2.0}, run),
        Feedback(run, 1.0, {"seen": 3}),
    ]


def test_random_draws_are_keyed_by_seed_run_and_purpose(bench: Make) -> None:
    def draws(ctx: Context) -> Result:
        a, again, other = ctx.random("a"), ctx.random("a"), ctx.random("b")
        return success(a=a.random(), again=again.random(), other=other.random())

    def values(seed: int, run: int) -> Any:
        b = bench(act=draws)
        b.begun = run
        identity = b.begin("act", seed=seed)
        b.tick()
        return b.ended(identity).values

    assert values(1, 0) == values(1, 0)
    numbers = [x for v in (values(1, 0), values(2, 0), values(1, 1)) for x in v.values()]
    assert len(set(numbers)) == 9


# --- operator's pause -------------------------------------------------------------------------


def test_a_held_run_pauses_and_its_times_are_shifted(bench: Make) -> None:
    steps: list[float] = []

    async def walks(ctx: Context) -> Result:
        for _ in range(10):
            steps.append(ctx.now)
            await ctx.sleep(0.1)
        return success()

    b = bench(act=walks)
    run = b.begin("act")
    b.tick(0.5)
    b.take(HOLD)
    before = len(steps)
    b.tick(5.0)
    assert len(steps) == before and b.runner.due() is None
    b.take(RELEASE)
    b.tick(1.0)
    assert b.ended(run).status == "success" and b.ended(run).seconds == pytest.approx(1.0, abs=0.05)


def test_a_held_run_can_be_cancelled(bench: Make) -> None:
    b = bench(act=forever)
    run = b.begin("act")
    b.tick(0.1)
    b.take(HOLD)
    b.take(Cancel(run))
    b.tick()
    assert b.ended(run).cause == "cancelled"


@pytest.mark.processes
@pytest.mark.parametrize("how", ["returns", "raises", "waits"])
def test_a_process_that_an_action_forks_ends_where_it_leaves_the_action(
    bench: Make, how: str
) -> None:
    """In it, the rest of the program would go on a second time: in lock step the whole cell."""
    children: list[int] = []

    async def forks(ctx: Context) -> Result:
        children.append(os.fork())
        if children == [0] and how == "raises":
            raise SystemExit(3)
        if how == "waits":
            await ctx.sleep(0.02)
        return success()

    b, process = bench(act=forks), os.getpid()
    run = b.begin("act")
    try:
        b.tick(0.1)
    finally:
        if os.getpid() != process:
            os._exit(9)  # it went on
    assert b.ended(run).status == "success"
    assert os.waitpid(children[0], 0)[1] == 0
