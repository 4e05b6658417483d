"""The context of actions and drivers: commands whose refusal cannot be ignored, the global memory,
and random draws by the mission run's seed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from petrobot import CommandRefused, Context, Driver, Remote, Result, rehearse, success
from petrobot.services.comm.location_file import DirectoryError, parse
from petrobot.services.comm.protocol.messages import SEED
from petrobot.services.node.drivers import make_driver
from petrobot.services.node.lockstep import LockstepPorts
from petrobot.services.node.ports import ProcessPorts
from petrobot.services.worker.context import Draws
from petrobot.services.worker.remote import COMMAND, DeviceCommand, RemoteDriver


class Door(Driver):
    """Opens by `share`; if `stuck`, it accepts no command."""

    period = 0.02

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if body["share"] > 1:
            raise ValueError(f"share: expected at most 1, found {body['share']}")
        self.share = body["share"] + 0.1 * self.ports.random("wind").random()

    def state(self) -> Mapping[str, Any]:
        return {"share": getattr(self, "share", None)}

    def stop(self, now: float) -> None:
        """It is open at once."""

    def stopped(self) -> bool:
        return True


async def open_door(ctx: Context[Remote], *, share: float) -> Result:
    await ctx.command({"share": share})
    return success(share=ctx.device.state["share"])


async def try_door(ctx: Context[Remote], *, share: float) -> Result:
    try:
        await ctx.command({"share": share})
    except CommandRefused as refused:
        return success(refused=str(refused))
    return success()


def door() -> Door:
    return Door({}, None)


class Gate(Door):
    """Opens in half a second."""

    def step(self, now: float) -> None:
        self.time = getattr(self, "time", 0.0) + self.period

    def state(self) -> Mapping[str, Any]:
        return {**super().state(), "open": getattr(self, "time", 0.0) > 0.5}


async def pass_gate(ctx: Context[Remote], *, until: str) -> Result:
    state = await ctx.command({"share": 0.5}, until=until)
    return success("open", **state)


@pytest.mark.parametrize(("until", "least", "most"), [("open", 0.48, 0.6), ("", 0.0, 0.06)])
def test_a_command_waits_until_the_state_says_so(until: str, least: float, most: float) -> None:
    played = rehearse(pass_gate, device=Gate({}, None), until=until)
    assert least <= played.seconds <= most
    assert played.result.values["open"] is bool(until) and played.result.text == "open"


def test_a_command_that_is_refused_does_not_wait_for_the_state() -> None:
    async def act(ctx: Context[Remote]) -> Result:
        await ctx.command({"share": 3}, until="open")
        return success()

    ended = rehearse(act, device=Gate({}, None))
    assert ended.result.cause == "command_refused" and ended.seconds < 0.1


def test_a_command_that_waits_can_be_cancelled() -> None:
    ended = rehearse(pass_gate, device=Gate({}, None), until="open", cancel_after=0.2)
    assert ended.result.cause == "cancelled" and ended.seconds < 0.4


def test_a_state_without_the_awaited_key_is_told_at_once() -> None:
    ended = rehearse(pass_gate, device=Gate({}, None), until="opened")
    assert ended.result.cause == "exception" and ended.seconds < 0.1
    assert (
        "until: the state of the driver has no 'opened'; it has 'share', 'op" in ended.result.text
    )


@pytest.mark.parametrize("value", [True, 3, ["a"], None])
def test_a_value_of_a_success_needs_a_name(value: Any) -> None:
    with pytest.raises(TypeError, match=r"success: expected a text, found .*write success\(name=v"):
        success(value)


def test_an_accepted_command_has_reached_the_driver_when_the_action_continues() -> None:
    """The action then reads a state from after the command."""
    played = rehearse(open_door, device=door(), share=0.5)
    assert played.result.status == "success" and 0.5 <= played.result.values["share"] < 0.6


def test_a_refused_command_cannot_be_ignored() -> None:
    """It ends the action with the driver's message, unless the action catches it."""
    ended = rehearse(open_door, device=door(), share=3).result
    assert (ended.status, ended.cause) == ("error", "command_refused")
    assert ended.text == "share: expected at most 1, found 3"
    caught = rehearse(try_door, device=door(), share=3).result
    assert caught.status == "success" and caught.values == {"refused": ended.text}


def test_a_command_that_no_driver_accepts_is_an_error() -> None:
    """There is no driver that accepts commands, or it accepts none in time."""
    direct = rehearse(open_door, device=object(), share=0).result.text
    assert direct == (
        "the driver of 'action' takes no commands, because it has no `period`: call its methods, "
        "as in ctx.device.read()"
    )
    alone = rehearse(open_door, share=0).result.text
    assert alone.startswith("'action' runs without a device: write device = ")

    class Silent:
        handled, refused = 0, ""
        state: Mapping[str, Any] = {}

        def send(self, body: Mapping[str, Any]) -> int:
            return 1

    played = rehearse(open_door, device=Silent(), share=0)
    assert played.result.cause == "command_refused" and 0.99 < played.seconds < 1.1
    assert played.result.text == "the driver did not take {'share': 0} within 1 s"


async def counts(ctx: Context) -> Result:
    first = await ctx.get("n", default=7)
    missing = await ctx.get_versioned("n", 7)
    version = await ctx.put("n", first + 1)
    value, now = await ctx.get_versioned("n")
    late = await ctx.compare_and_set("n", 0, 99)
    swapped = await ctx.compare_and_set("n", now, value + 1)
    none = await ctx.put("none", None)
    return success(
        first=first,
        missing=list(missing),
        version=version,
        late=late,
        swapped=swapped,
        value=await ctx.get("n"),
        none=[none, await ctx.get("none", default=5)],
    )


def test_the_global_memory_has_defaults_and_versions() -> None:
    assert rehearse(counts).result.values == {
        "first": 7,
        "missing": [7, 0],
        "version": 1,
        "late": False,
        "swapped": True,
        "value": 9,
        "none": [1, None],  # a variable that was set to None differs from one that was never set
    }


def test_a_drivers_draws_depend_on_the_seed() -> None:
    shares = [rehearse(open_door, device=door(), share=0, seed=s).result.values for s in (3, 4, 3)]
    assert shares[0] == shares[2] != shares[1]


def test_draws_begin_again_with_another_seed() -> None:
    draws = Draws("arm")
    with pytest.raises(ValueError, match="made before the seed is known; draw where it is needed"):
        draws.random("wind")
    seen = []
    for seed in (3, 3, 4, 3):
        draws.reseed(seed)
        seen.append(draws.random("wind").random())
    assert len(set(seen[:3])) == 3  # the same seed again continues
    assert seen[3] == seen[0]
    other = Draws("hand", 3)
    assert other.random("wind").random() not in seen


class Hasty(Driver):
    """Draws in its constructor."""

    def __init__(self, config: Mapping[str, Any], ports: Any) -> None:
        super().__init__(config, ports)
        self.start = ports.random("start").random()


def test_a_driver_that_draws_in_its_constructor_is_refused(tmp_path: Path) -> None:
    """Every seed would give the same draw, and a campaign would run copies."""
    text = (
        'schema = 1\n[nodes.pc]\nhost = "127.0.0.1"\nport = 7501\n'
        '[devices.door]\nnode = "pc"\ndriver = "tests.node.test_context:Hasty"\n'
    )
    directory = parse(text, tmp_path / "services.toml")
    entry = directory.devices["door"]
    ports = LockstepPorts(directory, entry, lambda: 0.0, lambda envelope: None)
    with pytest.raises(DirectoryError, match=r"random\('start'\): a driver is made before"):
        make_driver(directory, entry, ports)


def test_a_driver_in_another_process_gets_each_new_seed() -> None:
    """It gets each seed once, between the commands, and the message is not counted as a command."""
    posted: list[DeviceCommand] = []
    remote = RemoteDriver(posted.append, lambda: 0.0)
    remote.reseed(3)
    assert remote.send({}) == 1
    remote.reseed(3)
    remote.reseed(4)
    assert remote.send({}) == 2
    assert [(c.number, c.verb, c.body) for c in posted] == [
        (0, SEED, {"seed": 3}),
        (1, COMMAND, {}),
        (1, SEED, {"seed": 4}),
        (2, COMMAND, {}),
    ]

    def gone(command: DeviceCommand) -> None:
        raise ConnectionError

    # a new process of the driver gets the seed at its start
    RemoteDriver(gone, lambda: 0.0).reseed(3)


def test_a_stream_is_open_before_its_driver_asks_for_it() -> None:
    """Senders learn the address once, from the ready process; a driver may ask in its first step.
    It holds no name: a sender looked it up at each attempt to connect, in the loop of its action,
    which stood still for as long."""
    text = """
schema = 1
nodes.pc = { host = "localhost", port = 7501 }
nodes.desk = { host = "127.0.0.1", port = 7502 }
devices.cart = { node = "pc", driver = "m:Cart" }
devices.lamp = { node = "desk", driver = "m:Lamp" }
streams.speed = { to = "cart", period = 0.05 }
streams.place = { to = "lamp", period = 0.05 }
"""
    directory = parse(text, Path("services.toml"))
    cart = directory.devices["cart"]
    tickets = {"speed": "cart.one", "place": "lamp.two"}
    ports = ProcessPorts(directory, cart, lambda: 0.0, tickets)
    opened = ports.stream_addresses()
    assert list(opened) == ["speed"] and opened["speed"][0] == "127.0.0.1"
    assert ports.stream("speed").values is None and ports.stream_addresses() == opened
    assert ports._receiver is not None
    for sock in ports._receiver.sockets():
        sock.close()
    alone = ProcessPorts(directory, cart, lambda: 0.0, {})  # as `petrobot test driver` makes it
    assert alone.stream("speed").values is None and alone.stream_addresses() == {}
