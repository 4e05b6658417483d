"""Emergency stops and pauses in the worker host of a device: a stop remains after its processes
die, a hold ends with the held runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from petrobot.services.action import Status, success
from petrobot.services.comm.location_file import ActionEntry
from petrobot.services.comm.protocol.messages import Call, Cancel, Command, Executed, Outcome
from petrobot.services.device import Driver, stop_at_once
from petrobot.services.node.inline_host import HOLD, RELEASE, answer_of
from petrobot.services.worker.remote import (
    CLEAR_EMERGENCY,
    EMERGENCY_STOP,
    IN_EMERGENCY,
    CyclicDriver,
    DeviceCommand,
)
from petrobot.services.worker.runner import GRACE, Runner
from tests.node.conftest import Clock, Device
from tests.node.test_worker_host import Bench


class Stopping(Driver):
    """A driver that counts its stops; with `quick` it also has a quick stop."""

    period = 0.004

    def __init__(self) -> None:
        self.did: list[str] = []

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Accept any command."""
        self.did.append(str(body["do"]))

    def stop(self, now: float) -> None:
        """The stop routine."""
        self.did.append("stop")

    def stopped(self) -> bool:
        return True


class QuickStopping(Stopping):
    """One with a quick stop."""

    def quick_stop(self, now: float) -> None:
        """Count a quick stop, which brakes harder than the stop routine."""
        self.did.append("quick stop")


@pytest.mark.parametrize(("driver", "did"), [(Stopping(), "stop"), (QuickStopping(), "quick stop")])
def test_an_emergency_stop_uses_the_drivers_hardest_stop(driver: Stopping, did: str) -> None:
    """Its quick stop if it has one, else its stop routine."""
    stop_at_once(driver, 0.0)
    assert driver.did == [did]


def test_a_stopped_driver_takes_no_command_until_it_is_cleared() -> None:
    """Not even `reset` is accepted; the stop routine always is. Clearing alone does not change the
    device."""
    driver = QuickStopping()
    cyclic = CyclicDriver(driver)
    cyclic.emergency_stop(0.0)
    cyclic.take(0.0, DeviceCommand(1, body={"do": "reset"}))
    assert (cyclic.state().handled, cyclic.state().refused) == (1, IN_EMERGENCY)
    cyclic.take(0.0, DeviceCommand(2, "stop"))
    cyclic.clear_emergency()
    assert driver.did == ["quick stop", "stop"]
    cyclic.take(0.0, DeviceCommand(3, body={"do": "reset"}))
    assert driver.did[-1] == "reset" and not cyclic.state().refused


def orders_to(child: Any) -> list[str]:
    """Return the operator's verbs that a process got."""
    return [item.verb for item in child.commands()]


def test_the_driver_is_stopped_before_its_actions() -> None:
    """The device does not wait for the actions; then each run ends as stopped in an emergency."""
    bench = Bench()
    driver, worker = bench.cyclic()
    bench.begin("r")
    bench.run(0.0)
    bench.place.command(bench.clock.now, Command("e1", EMERGENCY_STOP))
    assert orders_to(driver) == [EMERGENCY_STOP]
    (stop,) = [order for order in worker.orders() if isinstance(order, Cancel)]
    assert stop == Cancel("r", f"{EMERGENCY_STOP}: by command")


def test_a_restarted_driver_is_still_stopped() -> None:
    """Its new process, which would enable its drives, gets the stop at once; after clearing, the
    next one does not."""
    bench = Bench()
    driver, _ = bench.cyclic()
    bench.place.command(bench.clock.now, Command("e1", EMERGENCY_STOP))
    driver.die()
    bench.run(20.0)
    again = bench.children[-1]
    assert again is not driver
    again.ready(0.004)
    assert orders_to(again) == [EMERGENCY_STOP]
    bench.children[-1].ready()
    bench.place.command(bench.clock.now, Command("e2", CLEAR_EMERGENCY))
    again.die()
    bench.run(20.0)
    third = bench.children[-1]
    third.ready(0.004)
    assert third is not again and orders_to(third) == ["stop"]  # whatever the dead one was doing


def test_a_hold_ends_with_the_runs_that_it_held() -> None:
    """When the last one ends (for example by a cancel), the device is released, and the next run
    has its full time."""
    bench = Bench()
    driver, worker = bench.cyclic()
    bench.begin("one")
    bench.run(0.0)
    bench.place.command(bench.clock.now, Command("h1", "hold"))
    driver.say(answer_of("h1", "held", {}))
    assert HOLD in worker.orders()
    bench.run(5.0)
    worker.say(Outcome("one", Status.ERROR, {}, "cancelled", "", Executed.YES, 5.0))
    assert orders_to(driver) == ["hold", "release"]
    assert worker.orders()[-1] == RELEASE
    bench.begin("two")
    assert not [r for r in bench.run(0.9) if isinstance(r, Outcome) and r.id == "two"]


def test_a_hold_without_runs_stays_until_it_is_released() -> None:
    """No run ends that would release it."""
    bench = Bench()
    driver, _ = bench.cyclic()
    bench.place.command(bench.clock.now, Command("h1", "hold"))
    driver.say(answer_of("h1", "held", {}))
    bench.run(5.0)
    assert orders_to(driver) == ["hold"]
    bench.place.command(bench.clock.now, Command("r1", "release"))
    assert orders_to(driver) == ["hold", "release"]


def test_a_cancelled_run_of_a_held_device_calls_its_stop_routine() -> None:
    """A held device seems to stand still; released without a stop, it would continue without its
    run."""
    clock = Clock()
    device = Device(clock, halting=0.0)

    async def move(ctx: Any) -> Any:
        await ctx.sleep(60.0)

    entries = {"move": ActionEntry("move", "tests:none", "task", "here", "it")}
    for held, stops in ((False, 0), (True, 1)):
        runner = Runner(
            entries, clock=clock, device=device, substitutes={"move": move}, virtual=True
        )
        device.stops.clear()
        runner.take(clock.now, Call("r", "move", {}, None, seed=1))
        runner.advance(clock.now)
        if held:
            runner.take(clock.now, HOLD)
        runner.take(clock.now, Cancel("r", "cancelled: enough"))
        clock.now += GRACE + 0.01
        runner.advance(clock.now)
        runner.advance(clock.now)
        assert len(device.stops) == stops
        (end,) = [report for report in runner.reports() if isinstance(report, Outcome)]
        assert end.cause == "cancelled"


def test_a_held_run_does_not_grow_older() -> None:
    """Its clock, its waits and its deadline are paused: an action that reads `ctx.now` is not late
    after a pause."""
    clock = Clock()
    seen: list[float] = []

    async def patient(ctx: Any) -> Any:
        until = ctx.now + 1.0
        while ctx.now < until:
            await ctx.sleep(0.1)
            seen.append(ctx.now)
        return success(left=until - ctx.now)

    entries = {"patient": ActionEntry("patient", "tests:none", "task", "here")}
    runner = Runner(entries, clock=clock, substitutes={"patient": patient}, virtual=True)
    runner.take(clock.now, Call("r", "patient", {}, 2.0, seed=1))

    def go_on(seconds: float) -> list[Any]:
        until, told = clock.now + seconds, []
        while clock.now < until - 1e-9:
            runner.advance(clock.now)
            told += runner.reports()
            clock.now += 0.004
        return told

    assert go_on(0.55) == []
    runner.take(clock.now, HOLD)
    assert go_on(30.0) == []
    runner.take(clock.now, RELEASE)
    (end,) = go_on(0.7)
    assert isinstance(end, Outcome) and end.status is Status.SUCCESS
    assert end.seconds == pytest.approx(1.0, abs=0.15) and seen[-1] < 1.2
