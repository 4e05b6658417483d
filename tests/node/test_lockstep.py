"""Nodes in a lock-step cell: calls, devices, streams, memory and timers; results do not depend on
which node runs what."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from petrobot import Context, Result, success
from petrobot.services.comm.calls.caller import Caller, Notice
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.location_file import Directory, DirectoryError, parse
from petrobot.services.comm.lockstep.cell import Delays, LockStepCell
from petrobot.services.comm.lockstep.channels import (
    can_body,
    image_body,
    read_can,
    read_images_wanted,
)
from petrobot.services.comm.lockstep.party import TICK, Envelope
from petrobot.services.comm.protocol.messages import (
    LATCHED,
    STOPS,
    Accept,
    Answer,
    Call,
    Command,
    Event,
    Feedback,
    Hello,
    Outcome,
)
from petrobot.services.node.lockstep import LockstepNode
from petrobot.services.scripted import Scripted, ScriptedRun

CELL = """\
schema = 1
[nodes.left]
host = "127.0.0.1"
port = 7401
[nodes.right]
host = "127.0.0.1"
port = 7402
[nodes.world]
host = "127.0.0.1"
port = 7400
sim = "petrobot.sim.catching.laboratory:make_laboratory"
[devices.slide]
node = "left"
driver = "toy_cell.drivers:Slide"
period = 0.004
bus = true
[devices.eye]
node = "right"
driver = "toy_cell.drivers:Eye"
source = "sim"
[streams.points]
to = "slide"
period = 0.02
[timers.beat]
node = "right"
period = 0.04
[services.memory]
node = "right"
[services.sum_service]
node = "right"
run = "toy_cell.actions:add"
[services.slow_service]
node = "right"
run = "toy_cell.actions:slow_service"
[services.secret]
node = "right"
run = "toy_cell.actions:secret"
scope = "local"
[actions]
go = { run = "toy_cell.actions:go", task = "move", device = "slide" }
follow = { run = "toy_cell.actions:follow", task = "move", device = "slide" }
look = { run = "toy_cell.actions:look", task = "see", device = "eye" }
lead = { run = "toy_cell.actions:lead", task = "see", device = "eye" }
add = { run = "toy_cell.actions:add", task = "sum", node = "NODE", compute_time = 0.1 }
nap.run = "toy_cell.actions:nap"
nap.task = "sum"
nap.node = "NODE"
nap.deadline = 1.0
nap.orphan_time = 0.2
relay = { run = "toy_cell.actions:relay", task = "sum", node = "NODE" }
swap = { run = "toy_cell.actions:swap", task = "sum", node = "NODE" }
delegate = { run = "toy_cell.actions:delegate", task = "sum", node = "NODE" }
tell = { run = "toy_cell.actions:tell", task = "sum", node = "NODE" }
"""


def directory(node: str = "left", **replaced: str) -> Directory:
    text = CELL.replace("NODE", node)
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    return parse(text, Path("services.toml"))


class World:
    """A laboratory that answers each frame with one, and sends an image every 20 ms while images
    are wanted."""

    name = "world"

    def __init__(self, places: Directory) -> None:
        self.places = places
        self.frames: list[Frame] = []
        self.out: list[Envelope] = []
        self.rate, self.wish, self.sequence, self.next = 0.0, 0, 0, 0.0

    def receive(self, now: float, envelope: Envelope) -> None:
        if envelope.channel == "can":
            frames = read_can(envelope.body)
            self.frames += frames
            answer = can_body(Frame(frame.id + 1, frame.data) for frame in frames)
            self.send(envelope.source, "can", answer)
        elif envelope.channel == "control":
            wanted = read_images_wanted(envelope.body)
            assert wanted is not None
            (self.rate, self.wish), self.next = wanted, now

    def advance(self, now: float) -> None:
        if self.rate and now >= self.next - 1e-9:
            self.next = now + 1 / self.rate
            pixels = np.full((3, 4), self.sequence, np.uint8)
            self.send("eye", "image", image_body(pixels, 0.003, self.sequence, self.wish))
            self.sequence += 1

    def drain(self) -> Sequence[Envelope]:
        out, self.out = self.out, []
        return out

    def send(self, device: str, channel: str, body: Any) -> None:
        self.out.append(Envelope(self.places.where(device), "world", device, channel, body))


class Coordinator:
    """Makes calls by script, (tick, service, arguments), and records what it receives, with the
    tick."""

    name = "coordinator"

    def __init__(
        self, places: Directory, script: Sequence[tuple[int, str, dict[str, Any]]] = ()
    ) -> None:
        self.places = places
        self.script = list(script)
        self.heard: list[tuple[int, Notice]] = []
        self.tick = 0
        self.made = 0
        hello = Hello(2, 2, "coordinator", self.name, "boot", 1, places.hash)
        self.callers = {
            n: Caller(n, hello, auto_ack=True) for n in places.nodes if not places.nodes[n].sim
        }
        for caller in self.callers.values():
            caller.open(0.0)

    def call(self, service: str, deadline: float | None = None, /, **arguments: Any) -> str:
        self.made += 1
        call = Call(f"c{self.made}", service, arguments, deadline, seed=5)
        self.callers[self.places.where(service)].call(self.tick * TICK, call)
        return call.id

    def receive(self, now: float, envelope: Envelope) -> None:
        self.callers[self.places.party(envelope.source)].receive(now, envelope.body)

    def advance(self, now: float) -> None:
        self.tick = round(now / TICK)
        while self.script and self.script[0][0] <= self.tick:
            _, service, arguments = self.script.pop(0)
            self.call(service, **arguments)
        for caller in self.callers.values():
            caller.advance(now)
            self.heard += [(self.tick, notice) for notice in caller.notices()]

    def drain(self) -> Sequence[Envelope]:
        now = self.tick * TICK
        return [
            Envelope(peer, self.name, getattr(message, "service", peer), "call", message)
            for peer, caller in self.callers.items()
            for message in caller.messages(now)
        ]

    def ended(self, identity: str) -> Any:
        (end,) = [n for _, n in self.heard if isinstance(n, Outcome) and n.id == identity]
        return end


class Bench:
    """A whole cell."""

    def __init__(
        self, places: Directory, script: Sequence[tuple[int, str, dict[str, Any]]] = (), **mock: Any
    ) -> None:
        self.world = World(places)
        self.coordinator = Coordinator(places, script)
        nodes = [n for n in places.nodes.values() if not n.sim]
        self.nodes = {n.name: LockstepNode(places, n.name, substitutes=mock) for n in nodes}
        self.cell = LockStepCell(
            [self.coordinator, self.world, *self.nodes.values()], Delays(places.delays())
        )

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK)):
            self.cell.step()

    def call(
        self, service: str, span: float = 1.0, deadline: float | None = None, /, **arguments: Any
    ) -> Any:
        identity = self.coordinator.call(service, deadline, **arguments)
        self.run(span)
        return self.coordinator.ended(identity)


def test_an_action_on_a_cyclic_device() -> None:
    bench = Bench(directory())
    end = bench.call("go", 1.0, to=0.2)
    assert (end.status, end.values) == ("success", {"position": pytest.approx(0.2)})
    assert end.seconds == pytest.approx(0.2, abs=6 * TICK)
    assert bench.call("go", to=1e6).text == "1000000.0 is beyond the rail; stay within 100 m"
    assert [f.id for f in bench.world.frames[:3]] == [0x181] * 3 and len(bench.world.frames) >= 490


def test_a_device_whose_actions_are_all_scripted_gets_no_driver() -> None:
    """Its driver may need a device that is not here. If one action is not scripted, it is made."""
    absent = directory(**{"drivers:Slide": "drivers:Absent"})
    scripted = Scripted([ScriptedRun()])

    async def wrapped(ctx: Context, **_arguments: Any) -> Result:
        return success()

    with pytest.raises(DirectoryError, match="Absent"):
        Bench(absent, go=scripted)
    with pytest.raises(DirectoryError, match="Absent"):
        Bench(absent, go=wrapped, follow=wrapped)
    bench = Bench(absent, go=scripted, follow=scripted)
    assert bench.call("go", 1.0, to=0.2).status == "success"
    assert bench.call("add", 1.0, a=1, b=2).status == "success"


def test_a_stopped_device_starts_no_run_before_it_is_cleared() -> None:
    """The run is refused before it begins, so none of it was executed; so is the run of a caller
    that missed a stop which is cleared. Devices of other nodes still work."""
    bench = Bench(directory())
    assert bench.call("go", 1.0, to=0.1).status == "success"
    coordinator = bench.coordinator

    def order(number: int, verb: str) -> None:
        now = coordinator.tick * TICK
        coordinator.callers["left"].command(now, Command(f"c/{number}", verb, "slide"))
        bench.run(0.5)

    order(1, "emergency_stop")
    order(2, "clear_emergency")
    missed = bench.call("go", to=0.5)
    assert (missed.cause, missed.executed) == ("emergency_stop", "no")
    assert missed.values == {LATCHED: True, STOPS: 1} and "given and cleared" in missed.text
    assert bench.call("go", to=0.2).status == "success", "its caller knows of the stop by now"
    order(3, "emergency_stop")
    order(4, "lease")
    refused = bench.call("go", to=0.5)
    assert (refused.status, refused.cause, refused.executed) == ("error", "emergency_stop", "no")
    assert bench.call("look", images=1).status == "success"
    assert refused.values == {LATCHED: True, STOPS: 2}
    order(5, "clear_emergency")
    order(6, "lease")
    stopped, cleared = (
        n for _, n in coordinator.heard if isinstance(n, Answer) and n.id in ("c/4", "c/6")
    )
    assert not stopped.ok and "petrobot estop --clear" in stopped.data["text"] and cleared.ok
    moved = bench.call("go", to=0.3)
    assert (moved.status, moved.values["position"]) == ("success", pytest.approx(0.3))


def test_images_come_from_the_laboratory_with_their_age() -> None:
    bench = Bench(directory())
    end = bench.call("look", images=3)
    assert [row[0] for row in end.values["seen"]] == [0, 1, 2]
    assert [row[1] for row in end.values["seen"]] == pytest.approx([0.003] * 3)
    assert [row[2] for row in end.values["seen"]] == [0, 12, 24]
    assert bench.world.rate == 0.0
    assert bench.call("look", images=1).values["seen"][0][0] == 3, (
        "an image of the earlier start came through"
    )


def test_set_points_go_from_one_device_to_another() -> None:
    bench = Bench(directory(), [(5, "lead", {"seconds": 0.6}), (5, "follow", {"seconds": 1.0})])
    bench.run(1.5)
    end = bench.coordinator.ended("c2")
    assert end.values["count"] == 31 and 0.27 < end.values["position"] < 0.3
    assert bench.coordinator.ended("c1").status == "success"
    (event,) = [n for _, n in bench.coordinator.heard if isinstance(n, Event)]
    assert (event.name, event.source, event.run, event.data) == (
        "led",
        "lead",
        "c1",
        {"seconds": 0.6},
    )


def test_services_memory_and_child_calls() -> None:
    bench = Bench(directory())
    end = bench.call("relay", a=4)
    assert (end.values["sum"], end.values["version"]) == (6, 1)
    assert bench.call("slow_service", 1.0, seconds=0.2).seconds == pytest.approx(0.2, abs=TICK)
    assert bench.call("sum_service", a="x").cause == "exception"
    assert (
        bench.call("sum_service", c=1).text == "sum_service: takes no argument 'c'; it takes: a, b"
    )


def test_compare_and_set_loses_no_update() -> None:
    script = [(5, "swap", {"times": 7}), (5, "swap", {"times": 5})]
    bench = Bench(directory(), script)
    bench.run(3.0)
    assert bench.coordinator.ended("c1").status == bench.coordinator.ended("c2").status == "success"
    assert bench.nodes["right"].node.memory.values()["count"].value == 12


def test_watched_variables_are_reported() -> None:
    bench = Bench(directory())
    bench.coordinator.callers["right"].subscribe(0.0, ["memory:sum"])
    bench.call("relay", a=4)
    events = [n for _, n in bench.coordinator.heard if isinstance(n, Event)]
    assert [(e.name, e.data) for e in events] == [
        ("memory:sum", {"name": "sum", "value": 6, "version": 1})
    ]
    assert events[0].number == 1


def test_timers_send_pulses_to_their_listeners() -> None:
    bench = Bench(directory())
    bench.run(0.5)
    assert not [n for _, n in bench.coordinator.heard if isinstance(n, Event)]
    bench.coordinator.callers["right"].subscribe(0.5, ["beat"])
    bench.run(0.5)
    ticks = [t for t, n in bench.coordinator.heard if isinstance(n, Event)]
    assert 11 <= len(ticks) <= 13 and set(np.diff(ticks)) == {10}
    numbers = {n.number for _, n in bench.coordinator.heard if isinstance(n, Event)}
    assert numbers == {0}, "a pulse needs no acknowledgement"


@pytest.mark.parametrize(
    ("service", "arguments", "deadline", "cause", "executed"),
    [
        ("nap", {"seconds": 9.0}, None, "deadline", "yes"),
        ("nap", {"seconds": 9.0}, 0.3, "deadline", "yes"),
        ("nap", {"minutes": 9.0}, None, "bad_arguments", "no"),
        ("delegate", {"service": "nothing"}, None, "", "yes"),
    ],
)
def test_limits(
    service: str, arguments: dict[str, Any], deadline: float | None, cause: str, executed: str
) -> None:
    end = Bench(directory()).call(service, 2.0, deadline, **arguments)
    assert (end.cause, end.executed) == (cause, executed)


@pytest.mark.parametrize(
    ("service", "cause"),
    [
        ("nothing", "unknown_service"),
        ("go", "device_needs_coordinator"),
        ("secret", ""),
        ("sum_service", "bad_arguments"),
    ],
)
def test_what_a_node_may_call(service: str, cause: str) -> None:
    assert Bench(directory()).call("delegate", service=service).values["cause"] == cause


def test_a_local_service_is_refused_to_another_host() -> None:
    far = directory(**{'host = "127.0.0.1"\nport = 7401': 'host = "10.0.0.9"\nport = 7401'})
    end = Bench(far).call("delegate", service="secret")
    assert (
        end.values["cause"] == "local_only"
        and "only serves callers on the host of right" in end.values["text"]
    )


def test_one_run_per_device_and_cancel() -> None:
    bench = Bench(directory())
    first = bench.coordinator.call("go", to=50.0)
    bench.run(0.1)
    assert bench.call("go", 0.1, to=0.0).cause == "busy"
    bench.coordinator.callers["left"].cancel(bench.cell.now, first, "enough")
    bench.run(0.2)
    end = bench.coordinator.ended(first)
    assert (end.status, end.cause, end.executed) == ("error", "cancelled", "yes")
    assert bench.call("go", 1.0, to=0.1).status == "success"


def test_feedback_and_events_reach_the_caller() -> None:
    bench = Bench(directory())
    end = bench.call("tell", name="hello")
    kinds = [type(n) for _, n in bench.coordinator.heard if not isinstance(n, Outcome)]
    assert kinds.count(Accept) == 1 and kinds.count(Feedback) == 1 and kinds.count(Event) == 1
    assert end.values["draw"] == Bench(directory("right")).call("tell", name="x").values["draw"]


def test_a_hold_of_a_run_that_has_ended_does_not_hold_the_next() -> None:
    """The order and the end of the run crossed. Whoever asked releases only active runs."""
    bench = Bench(directory())
    first = bench.coordinator.call("go", to=0.1)
    bench.run(1.0)
    assert bench.coordinator.ended(first).status == "success"
    hold = Command("h", "hold", "slide", {"run": first})
    bench.coordinator.callers["left"].command(bench.cell.now, hold)
    assert bench.call("go", 1.0, to=0.2).status == "success"
    [answer] = [n for _, n in bench.coordinator.heard if isinstance(n, Answer)]
    assert answer.ok and answer.data["answers"] == {}


def test_hold_stops_the_arm_and_its_run_but_not_the_eye() -> None:
    bench = Bench(directory())
    first = bench.coordinator.call("go", to=0.5)
    bench.run(0.2)
    for peer, caller in bench.coordinator.callers.items():
        caller.command(bench.cell.now, Command(f"hold {peer}", "hold"))
    bench.run(3.0)
    answers = {n.id: n for _, n in bench.coordinator.heard if isinstance(n, Answer)}
    assert answers["hold left"].ok and answers["hold left"].data["answers"] == {
        "slide": "held",
        "left": "held",
    }
    assert (
        not answers["hold right"].ok
        and answers["hold right"].data["answers"]["eye"] == "cannot hold"
    )
    bench.coordinator.callers["left"].command(bench.cell.now, Command("s", "status", "slide"))
    bench.run(0.1)
    status = next(n for _, n in bench.coordinator.heard if isinstance(n, Answer) and n.id == "s")
    assert status.data["devices"]["slide"]["runs"] == [first]
    assert 0.15 < status.data["devices"]["slide"]["state"]["position"] < 0.25
    bench.coordinator.callers["left"].command(bench.cell.now, Command("r", "release"))
    bench.run(1.0)
    end = bench.coordinator.ended(first)
    assert end.status == "success" and end.seconds == pytest.approx(0.5, abs=0.05), (
        "the pause counts"
    )


@pytest.mark.parametrize(
    ("verb", "target", "cause"),
    [
        ("dance", "", "unknown_verb"),
        ("hold", "foot", "unknown_device"),
        ("seed", "", "bad_arguments"),
    ],
)
def test_meaningless_commands(verb: str, target: str, cause: str) -> None:
    bench = Bench(directory())
    bench.run(0.05)
    bench.coordinator.callers["left"].command(bench.cell.now, Command("x", verb, target))
    bench.run(0.05)
    (answer,) = [n for _, n in bench.coordinator.heard if isinstance(n, Answer)]
    assert not answer.ok and answer.data["cause"] == cause


def test_stop_stops_device_and_runs() -> None:
    bench = Bench(directory())
    first = bench.coordinator.call("go", to=50.0)
    bench.run(0.1)
    bench.coordinator.callers["left"].command(bench.cell.now, Command("x", "stop"))
    bench.run(0.2)
    assert bench.coordinator.ended(first).cause in ("stopped", "cancelled")
    position = bench.call("go", to=0.0).values["position"]
    assert position == 0.0


def test_an_orphan_is_stopped() -> None:
    bench = Bench(directory())
    first = bench.coordinator.call("nap", seconds=0.9)
    bench.run(0.1)
    bench.nodes["left"].node.callee.link_down(bench.cell.now, "coordinator")
    bench.run(0.4)
    assert bench.nodes["left"].node.callee.running() == {} and first


def test_a_driver_that_refuses_its_keys_is_one_fault() -> None:
    with pytest.raises(
        DirectoryError,
        match=r"devices.slide: toy_cell.drivers:Slide refuses it: is missing 'period'",
    ):
        LockstepNode(directory(**{"period = 0.004\n": ""}), "left")
    with pytest.raises(DirectoryError, match="no stream 'points' leads here"):
        LockstepNode(directory(**{'to = "slide"': 'to = "eye"'}), "left")
    with pytest.raises(
        DirectoryError, match="collections:ChainMap is not a driver: it has no period, state"
    ):
        LockstepNode(directory(**{"toy_cell.drivers:Slide": "collections:ChainMap"}), "left")


# --- placement --------------------------------------------------------------------------------

CALLS: list[tuple[str, dict[str, Any]]] = [
    ("add", {"a": 1}),
    ("nap", {"seconds": 0.05}),
    ("relay", {"a": 2}),
    ("swap", {"times": 2}),
    ("go", {"to": 0.1}),
    ("look", {"images": 2}),
    ("lead", {"seconds": 0.1}),
    ("follow", {"seconds": 0.1}),
    ("sum_service", {"a": 3}),
    ("delegate", {"service": "slow_service"}),
    ("tell", {"name": "n"}),
]


def trace(
    places: Directory, script: Sequence[tuple[int, str, dict[str, Any]]]
) -> list[tuple[Any, ...]]:
    bench = Bench(places, script)
    for caller in bench.coordinator.callers.values():
        caller.subscribe(0.0, ["beat", "memory:sum", "memory:count"])
    bench.run(1.0)
    return trace_of(bench.coordinator)


def trace_of(coordinator: Coordinator) -> list[tuple[Any, ...]]:
    """Return all that a coordinator received, with the tick, without what depends on the
    process."""
    rows: list[tuple[Any, ...]] = []
    for tick, notice in coordinator.heard:
        if isinstance(notice, Outcome):
            o = notice
            values = {k: v for k, v in o.values.items() if k != "pid"}
            rows.append(
                (tick, o.id, o.status, repr(values), o.cause, o.executed, round(o.seconds, 9))
            )
        elif isinstance(notice, Event):
            rows.append(
                (
                    tick,
                    notice.source,
                    notice.name,
                    notice.number,
                    repr(notice.data),
                )
            )
        elif isinstance(notice, Accept | Feedback):
            rows.append((tick, notice.id, type(notice).__name__))
    return sorted(rows, key=repr)


@settings(max_examples=8, deadline=None)
@given(
    calls=st.lists(st.tuples(st.integers(0, 60), st.sampled_from(CALLS)), min_size=2, max_size=8),
    everything_left=st.booleans(),
)
def test_results_do_not_depend_on_placement(
    calls: list[tuple[int, tuple[str, dict[str, Any]]]], everything_left: bool
) -> None:
    script = sorted(((tick, *call) for tick, call in calls), key=lambda row: row[0])
    here = trace(directory("left"), script)
    there = (
        directory("left", **{'node = "right"': 'node = "left"'})
        if everything_left
        else directory("right")
    )
    assert here == trace(there, script)


def test_the_same_run_twice() -> None:
    script = [(10 * n, service, arguments) for n, (service, arguments) in enumerate(CALLS)]
    first = trace(directory(), script)
    assert len([row for row in first if len(row) == 7]) == len(CALLS)
    assert first == trace(directory(), script)


def test_link_delays_hold_for_their_channel() -> None:
    slow = parse(CELL.replace("NODE", "left") + "[links]\nimage = 0.2\n", Path("services.toml"))
    seen = Bench(slow).call("look", 2.0, images=2).values["seen"]
    assert [row[0] for row in seen] == [0, 1]
    quick = Bench(directory())
    quick.call("look", images=2)
    assert list(itertools.chain(seen[0][1:])) == pytest.approx([0.003, 0])
