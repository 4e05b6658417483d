"""Actions of ROS 2 as primitive actions, in simulated time with a fake rosbridge."""

from __future__ import annotations

import math
import runpy
import socket
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from petrobot import Rehearsal, Result, check_driver, rehearse
from petrobot.services.adapters.ros2 import actions
from petrobot.services.adapters.ros2.bridge import Bridge
from petrobot.services.worker.pipe import NewestLink
from tests.adapters.ros2.fake import Fake, Message

HERE = "tests.adapters.ros2.fake:Fake"


class ScriptedLink:
    """A fake server behind a link that the test breaks and restores."""

    def __init__(self, bridge: Bridge) -> None:
        self.fake, self.bridge, self.there = Fake(), bridge, True
        self.up, self.count, self.why = False, 0, "not connected yet"
        self.inbox: list[tuple[str, Any]] = [("up", None)]

    def news(self) -> Iterator[tuple[str, Any]]:
        told = self.fake.step(self.bridge.now)
        if self.there:
            self.inbox += [("message", message) for message in told]
        items, self.inbox = self.inbox, []
        for kind, item in items:
            if kind in ("up", "down"):
                self.up, self.why = kind == "up", str(item)
            yield kind, item

    def send(self, item: Message) -> None:
        if self.there:
            told = self.fake.receive(self.bridge.now, item)
            self.inbox += [("message", message) for message in told]

    def pull(self) -> None:
        self.there, self.inbox = False, [("down", "pulled")]

    def mend(self) -> None:
        self.there = True
        self.inbox.append(("up", None))

    def close(self) -> None:
        """Do nothing."""


def robot(**config: Any) -> tuple[Bridge, ScriptedLink]:
    """A driver, and the link that the test breaks; a rehearsal gives it ports."""
    bridge, link = wired(Ports(), **config)
    bridge.ports = None  # type: ignore[assignment]
    return bridge, link


def play(
    name: str,
    bridge: Bridge | None = None,
    world: Callable[[float], None] | None = None,
    **more: Any,
) -> Rehearsal:
    """Rehearse a goal for the action server of this name."""
    return rehearse(
        actions.goal,
        device=bridge or robot()[0],
        world=world,
        action=name,
        action_type="moveit_msgs/action/MoveGroup",
        **more,
    )


def said(result: Result) -> tuple[str, str, str]:
    return result.status, result.cause, result.executed


@pytest.mark.parametrize(
    ("name", "options", "ended"),
    [
        ("/ok", {}, ("success", "", "yes")),
        ("/nested", {}, ("success", "", "yes")),
        ("/ok", {"expect": {"error_code.val": 1}}, ("success", "", "yes")),
        ("/ok", {"expect": {"error_code.val": [0, 2]}}, ("success", "", "yes")),
        ("/ok", {"expect": {"error_code.val": 7}}, ("failure", "unexpected", "yes")),
        ("/ok", {"values": {"code": "error_code.value"}}, ("error", "bad_result", "yes")),
        ("/aborts", {}, ("error", "aborted", "yes")),
        ("/rejects", {}, ("error", "rejected", "no")),
        ("/absent", {}, ("error", "rejected", "no")),
        ("/nan", {}, ("error", "bad_result", "yes")),
        ("/nan", {"values": {"code": "error_code.val"}}, ("success", "", "yes")),
        ("/wide", {}, ("error", "bad_result", "yes")),
        ("/silent", {"timeout": 1.0}, ("error", "timeout", "unknown")),
        ("/slow", {"timeout": 1.0}, ("error", "timeout", "yes")),
        ("/late", {"timeout": 0.1}, ("error", "timeout", "yes")),
        ("/races", {"timeout": 1.0}, ("success", "", "yes")),
        ("/stubborn", {"timeout": 1.0}, ("error", "timeout", "unknown")),
        ("/ok", {"x": 1.0}, ("error", "bad_goal", "no")),
        ("/ok", {"goal": {"x": math.nan}}, ("error", "bad_goal", "no")),
    ],
)
def test_each_end_of_a_goal_is_one_result(
    name: str, options: dict[str, Any], ended: tuple[str, str, str]
) -> None:
    bridge, link = robot()
    result = play(name, bridge, **options).result
    assert said(result) == ended, result
    if name not in ("/silent", "/stubborn"):
        assert bridge.stopped() and not link.fake.goals


def test_values_of_a_result() -> None:
    assert play("/ok").result.values == {"error_code": {"val": 1}, "text": "done"}
    named = play("/ok", values={"code": "error_code.val"}).result
    assert named.values == {"code": 1}
    assert play("/rejects").result.text == "Action goal was rejected"


def test_a_goal_is_built_from_constants_and_the_tasks_arguments() -> None:
    bridge, link = robot()
    fields = {"x": "pose.pose.position.x", "frame": "pose.header.frame_id"}
    play("/ok", bridge, goal={"behavior_tree": "t"}, fields=fields, x=2.5, frame="map")
    sent = link.fake.log[0]
    assert sent["op"] == "send_action_goal" and sent["feedback"] is True
    pose = {"pose": {"position": {"x": 2.5}}, "header": {"frame_id": "map"}}
    assert sent["args"] == {"behavior_tree": "t", "pose": pose}


def test_feedback_is_progress_variables_and_set_points() -> None:
    played = rehearse(
        actions.goal,
        device=robot()[0],
        streams={"gap": 0.05},
        action="/ok",
        action_type="a/action/B",
        remaining="distance",
        to_memory={"robot_state": "state"},
        to_streams={"gap": ["distance"]},
    )
    shares = [share for _, share in played.progress]
    assert len(shares) >= 3 and shares == sorted(shares) and 0 < shares[-1] < 1
    assert played.memory.values()["robot_state"].value == "moving"
    assert {stream for _, stream, _ in played.published} == {"gap"}


@pytest.mark.parametrize("remaining", ["distance", "distance_remaining", "distance.positions"])
def test_feedback_of_another_form_is_progress_without_a_share(remaining: str) -> None:
    """What it has is passed on, and the goal goes on to its end."""
    bridge, link = robot()
    played = rehearse(
        actions.goal,
        device=bridge,
        streams={"gap": 0.05, "age": 0.05},
        action="/other",
        action_type="a/action/B",
        remaining=remaining,
        to_memory={"state": "state", "joint": "joint_names.0"},
        to_streams={"gap": ["distance"], "age": ["distance.positions.0"]},
    )
    assert said(played.result) == ("success", "", "yes"), played.result
    assert len(played.progress) >= 3 and {share for _, share in played.progress} == {0.0}
    assert {name: kept.value for name, kept in played.memory.values().items()} == {"joint": "a"}
    assert {stream for _, stream, _ in played.published} == {"age"}
    assert [m["op"] for m in link.fake.log] == ["send_action_goal"]


def test_a_goal_is_cancelled_when_its_feedback_cannot_be_passed_on() -> None:
    """The run ends in ERROR; without its run the robot must not move on."""
    bridge, link = robot()
    played = play("/slow", bridge, to_memory={"": "distance"})
    assert said(played.result)[:2] == ("error", "exception")
    bridge.step(60.0)
    assert [m["op"] for m in link.fake.log] == ["send_action_goal", "cancel_action_goal"]
    assert bridge.stopped()


@pytest.mark.parametrize("name", ["/slow", "/silent"])
def test_a_cancelled_run_cancels_its_goal(name: str) -> None:
    bridge, link = robot()
    played = play(name, bridge, cancel_after=0.5)
    assert played.result.cause == "cancelled"
    goal, *cancels = [m for m in link.fake.log if m["op"] != "subscribe"]
    assert {m["op"] for m in cancels} == {"cancel_action_goal"}
    assert {m["id"] for m in cancels} == {goal["id"]}
    assert bridge.stopped() is (name == "/slow")


@pytest.mark.parametrize("at", [0.0, 0.02, 0.06, 0.1, 0.14, 0.18, 0.2, 0.22])
def test_a_link_lost_at_any_moment(at: float) -> None:
    """The run ends at once with executed = unknown; its goal is cancelled over the next link."""
    bridge, link = robot()
    pulled = False

    def world(now: float) -> None:
        nonlocal pulled
        if now >= at and not pulled and (at == 0.0 or link.fake.log):
            pulled = True
            link.pull()

    result = play("/slow", bridge, world).result
    if not link.fake.log:
        assert said(result) == ("error", "link_down", "no")
        return
    assert said(result) == ("error", "link_lost", "unknown") and not bridge.stopped()
    assert "(pulled)" in result.text
    link.mend()
    for tick in range(5):
        bridge.step(60.0 + tick)
    assert [m["op"] for m in link.fake.log] == ["send_action_goal", "cancel_action_goal"]
    assert link.fake.log[0]["id"] == link.fake.log[1]["id"]
    assert bridge.stopped() and not link.fake.goals


def test_a_cancelled_lost_goal_does_not_affect_the_next_one() -> None:
    bridge, link = robot()

    def world(now: float) -> None:
        if abs(now - 0.2) < 1e-6:
            link.pull()
        if abs(now - 0.6) < 1e-6:
            link.mend()

    assert play("/slow", bridge, world).result.cause == "link_lost"
    later = rehearse(
        actions.goal,
        device=bridge,
        world=lambda now: link.mend() if abs(now - 0.6) < 1e-6 else None,
        action="/ok",
        action_type="a/action/B",
    )
    assert said(later.result) == ("success", "", "yes")
    assert [m["op"] for m in link.fake.log[1:]] == ["cancel_action_goal", "send_action_goal"]


def test_after_a_server_that_never_answers_it_is_unknown_whether_the_robot_stands() -> None:
    bridge, _ = robot(patience=1.0)
    result = play("/silent", bridge, timeout=0.2).result
    assert result.executed == "unknown" and "look at the robot" in result.text
    assert not bridge.stopped()


@pytest.mark.parametrize(
    ("service", "ended"),
    [("/add", ("success", "", "yes")), ("/fails", ("error", "failed", "yes"))],
)
def test_services(service: str, ended: tuple[str, str, str]) -> None:
    options: dict[str, Any] = {"request": {"a": 1}, "fields": {"b": "b"}, "b": 2}
    played = rehearse(actions.call, device=robot()[0], service=service, **options)
    assert said(played.result) == ended
    assert played.result.values == ({"sum": 3} if service == "/add" else {})
    silent = rehearse(actions.call, device=robot()[0], service="/silent", timeout=0.5)
    assert said(silent.result) == ("error", "timeout", "unknown")


class Ports:
    """Scripted ports of a driver."""

    def __init__(self, files: Mapping[str, str] | None = None) -> None:
        self.now, self.events = 0.0, list[tuple[str, Any]]()
        self.files, self.point = files or {}, Point()

    def raise_event(self, name: str, **data: Any) -> None:
        self.events.append((name, data))

    def file(self, path: str) -> bytes:
        return self.files[path].encode()

    def stream(self, name: str) -> Point:
        return self.point


class Point:
    """The receiving end of a stream."""

    def __init__(self) -> None:
        self.values: tuple[float, ...] | None = None
        self.count = 0

    def take(self, *values: float) -> None:
        self.values, self.count = values or None, self.count + 1


BUTTON = {"topic": "/button", "type": "std_msgs/msg/Bool"}


def shown(bridge: Bridge, *messages: Any, topic: str = "/button") -> None:
    told = [("message", {"op": "publish", "topic": topic, "msg": m}) for m in messages]
    assert isinstance(bridge.link, ScriptedLink)
    bridge.link.inbox += told
    bridge.step(0.0)


def wired(ports: Ports, **config: Any) -> tuple[Bridge, ScriptedLink]:
    bridge = Bridge({"url": HERE, **config}, ports)  # type: ignore[arg-type]
    bridge.link = link = ScriptedLink(bridge)  # type: ignore[assignment]
    return bridge, link


@pytest.mark.parametrize(
    ("when", "raised"), [({}, [0, 1, 1, 0, 1]), ({"data": 1}, [1, 1]), ({"data": [1, 2]}, [1, 1])]
)
def test_topics_are_external_events(when: dict[str, Any], raised: list[int]) -> None:
    """Without a condition each message raises one; with a condition, each time that it becomes
    true."""
    ports = Ports()
    bridge, link = wired(ports, subscribe={"b": {**BUTTON, "event": "pressed", "when": when}})
    if not when:
        del bridge.subscribe["b"]["when"]
    shown(bridge, *({"data": n} for n in (0, 1, 1, 0, 1)))
    assert ports.events == [("pressed", {"msg": {"data": n}}) for n in raised]
    link.pull()
    link.mend()
    shown(bridge, {"data": 1})  # a latched value comes again with the link: not an edge
    assert len(ports.events) == len(raised) + (not when)


def test_the_button_of_the_example_is_pressed_until_a_run_listens() -> None:
    """A press before the run begins does nothing in it, so each press has to be an edge."""
    example = Path(__file__).parents[3] / "examples" / "ros2" / "simulated.py"
    robot, ports = runpy.run_path(str(example))["Robot"](), Ports()
    when = {"event": "pressed", "when": {"data": True}}
    bridge, _ = wired(ports, subscribe={"b": {**BUTTON, **when}})
    for tenths in range(35):
        shown(bridge, *(message["msg"] for message in robot.step(tenths / 10)))
    assert len(ports.events) == 3


def test_topics_are_values_that_an_action_waits_for() -> None:
    bridge, link = robot(subscribe={"battery": {**BUTTON, "topic": "/battery"}})

    def world(now: float) -> None:
        if abs(now - 0.5) < 1e-6:
            shown(bridge, {"level": 0.9, "cells": [3.9]}, topic="/battery")

    options: dict[str, Any] = {"topic": "battery", "when": {"level": [0.8, 1.0]}}
    waited = rehearse(
        actions.wait_for, device=bridge, world=world, values={"cell": "cells.0"}, **options
    )
    assert waited.result.values == {"cell": 3.9} and waited.seconds == pytest.approx(0.5, abs=0.05)
    link.pull()
    bridge.step(1.0)
    late = rehearse(actions.wait_for, device=bridge, timeout=0.5, **options)
    assert late.result.cause == "timeout"  # what was true before the link broke
    unknown = rehearse(actions.wait_for, device=bridge, topic="batery")
    assert "names ['battery']" in unknown.result.text


@pytest.mark.parametrize("bad", [[], None, {"x": 2**80}, {"x": "y" * 70_000}, {"\ud800": 1}])
def test_a_topic_message_that_cannot_be_used_is_refused(bad: Any) -> None:
    bridge, _ = wired(Ports(), subscribe={"b": BUTTON})
    shown(bridge, {"data": 1}, bad)
    state = bridge.state()
    assert state["refused"] == 1 and state["fault"].startswith("/button: ")
    assert state["topics"]["b"]["msg"] == {"data": 1}


def test_a_topic_message_may_have_numbers_that_are_not_finite() -> None:
    """As that of a battery that does not measure its temperature; rosbridge writes null."""
    low = {"event": "low", "when": {"charge": [0.0, 0.2]}}
    hot = {"event": "hot", "when": {"cells.1": [60.0, 99.0]}}
    bridge, _ = wired(ports := Ports(), subscribe={"a": {**BUTTON, **low}, "b": {**BUTTON, **hot}})
    shown(bridge, message := {"charge": 0.1, "cells": [3.9, None]})
    assert bridge.state()["topics"]["b"]["msg"] == message and not bridge.state()["refused"]
    assert [name for name, _ in ports.events] == ["low"]
    found = rehearse(actions.wait_for, device=bridge, topic="a", values={"charge": "charge"})
    assert found.result.values == {"charge": 0.1}
    found = rehearse(actions.wait_for, device=bridge, topic="a", values={"hot": "cells.1"})
    assert said(found.result) == ("error", "bad_result", "yes")


SPEED = {
    "topic": "/cmd_vel",
    "type": "geometry_msgs/msg/Twist",
    "fields": ["linear.x", "angular.z"],
}


def test_set_points_go_to_a_topic_while_an_action_permits() -> None:
    """None are sent before; the set point of rest is sent when they stop coming, at a pause, at a
    stop and at the end."""
    ports = Ports()
    bridge, link = wired(ports, setpoints={"speed": SPEED})
    drive = {"drive": ["speed"]}

    def published() -> list[tuple[float, float]]:
        bridge.step(0.0)
        sent = [m["msg"] for m in link.fake.log if m["op"] == "publish"]
        link.fake.log.clear()
        return [(m["linear"]["x"], m["angular"]["z"]) for m in sent]

    ports.point.take(0.5, 0.1)
    assert published() == []
    bridge.command(0.0, drive)
    assert published() == [(0.5, 0.1)] and not bridge.stopped()
    assert published() == []
    ports.point.take(0.5, 0.1)
    assert published() == [(0.5, 0.1)]
    ports.point.values = None  # stale
    assert published() == [(0.0, 0.0)] and bridge.stopped() and published() == []
    ports.point.take(0.4, math.nan)
    assert published() == []
    for _ in "12":
        ports.point.take(0.4, 0.2)
        assert published() == [(0.4, 0.2)]
        assert bridge.hold(0.0) == "held" and published() == [(0.0, 0.0)]
        ports.point.take(0.4, 0.2)
        assert published() == []
        bridge.release(0.0)
    assert published() == [(0.4, 0.2)]
    bridge.stop(0.0)
    ports.point.take(0.4, 0.2)
    assert published() == [(0.0, 0.0)] and published() == [] and bridge.stopped()
    bridge.command(0.0, drive)
    assert published() == [(0.4, 0.2)]
    link.pull()
    assert published() == [] and not bridge.stopped()
    link.mend()
    ports.point.values = None
    assert published() == [(0.0, 0.0)] and bridge.stopped()


ACTION = "float64[] joints\n---\nint32 code\n---\nfloat64 left\n"


def test_goals_are_checked_against_the_users_file() -> None:
    ports = Ports({"a.action": ACTION})
    config = {"url": HERE, "definitions": {"a/action/B": "a.action"}}
    bridge = Bridge(config, ports)  # type: ignore[arg-type]
    bridge.link = link = ScriptedLink(bridge)  # type: ignore[assignment]
    bridge.ports = None  # type: ignore[assignment]
    for more, wrong in (
        ({"goal": {"joint": [1]}}, "did you mean 'joints'?"),
        ({"goal": {"joints": ["a"]}}, "joints.0: expected float64"),
        ({"values": {"x": "error_code.val"}}, "has no ['error_code'], but: code"),
    ):
        played = rehearse(
            actions.goal, device=bridge, action="/ok", action_type="a/action/B", **more
        )
        assert said(played.result) == ("error", "bad_goal", "no") and wrong in played.result.text
    assert not link.fake.log


@pytest.mark.parametrize(
    ("config", "wrong"),
    [
        ({"subscribe": {"b": {"topic": "/b"}}}, "subscribe.b: is missing ['type']"),
        ({"subscribe": {"b": {**BUTTON, "evnt": "x"}}}, "unknown keys ['evnt']"),
        ({"setpoints": {"s": {**SPEED, "rest": [0.0]}}}, "one value for each of `fields`"),
        ({"urll": "ws://x"}, "did you mean"),
    ],
)
def test_a_wrong_table_is_refused(config: dict[str, Any], wrong: str) -> None:
    with pytest.raises(ValueError) as refused:
        robot(**config)
    assert wrong in str(refused.value)


MOVE_GROUP = {"request": {"max_velocity_scaling_factor": 0.8}}
ODOMETRY = {"topic": "/odom", "type": "nav_msgs/msg/Odometry"}


def test_speed_slows_goals_and_set_points() -> None:
    bridge, link = wired(Ports(), speed=0.25, setpoints={"speed": SPEED})
    bridge.ports.point.take(0.8, 0.4)  # type: ignore[attr-defined]
    bridge.step(0.0)
    bridge.command(0.0, {"drive": ["speed"]})
    bridge.step(0.0)
    assert link.fake.log[-1]["msg"] == {"linear": {"x": 0.2}, "angular": {"z": 0.1}}
    bridge.ports = None  # type: ignore[assignment]
    assert play("/ok", bridge, goal=MOVE_GROUP).result.status == "success"
    (sent,) = (m for m in link.fake.log if m["op"] == "send_action_goal")
    assert sent["args"]["request"]["max_velocity_scaling_factor"] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        ({"goal": {"x": 1.0}}, "expected request.max_velocity_scaling_factor"),
        (  # MoveIt takes both for its default
            {"goal": {"request": {"max_velocity_scaling_factor": 0.0}}},
            "scaling_factor: expected a share above 0 and at most 1, found 0",
        ),
        (
            {"goal": {"request": {"max_velocity_scaling_factor": 8.0}}},
            "scaling_factor: expected a share above 0 and at most 1, found 8",
        ),
        ({"goal": MOVE_GROUP, "action_type": "a/action/B"}, 'write speeds = { "a/action/B" ='),
    ],
)
def test_a_goal_of_which_nothing_says_its_speed_is_refused(
    options: dict[str, Any], wrong: str
) -> None:
    bridge, link = robot(speed=0.5)
    options = {"action_type": "moveit_msgs/action/MoveGroup", **options}
    result = rehearse(actions.goal, device=bridge, action="/ok", **options).result
    assert said(result) == ("error", "bad_goal", "no") and wrong in result.text
    assert not link.fake.log
    with pytest.raises(ValueError, match=r"setpoints\.s: nothing says what is slower"):
        robot(speed=0.5, setpoints={"s": {**SPEED, "type": "a/msg/B"}})
    free, _ = robot(speed=0.5, speeds={"a/action/B": []})  # the robot's own limit
    assert (
        rehearse(actions.goal, device=free, action="/ok", action_type="a/action/B").result.status
        == "success"
    )


def test_the_workspace_bounds_goals_and_stops_what_leaves_it() -> None:
    box = {"x": [-1.0, 1.0]}
    with pytest.raises(ValueError, match="nothing tells where the robot is"):
        robot(workspace=box)
    bridge, link = robot(workspace=box, subscribe={"odom": ODOMETRY})
    for spelling in ("nav2_msgs/action/NavigateToPose", "nav2_msgs/NavigateToPose"):
        beyond: dict[str, Any] = {"x": 2.0, "y": 0.0, "action": "/ok", "action_type": spelling}
        out = rehearse(actions.navigate_to_pose, device=bridge, **beyond).result
        assert said(out) == ("error", "bad_goal", "no") and "outside the workspace" in out.text
    assert not [m for m in link.fake.log if m["op"] == "send_action_goal"]

    def world(now: float) -> None:
        if abs(now - 0.5) < 1e-6:
            at = {"position": {"x": 1.2, "y": 0.0, "z": 0.0}}
            shown(bridge, {"pose": {"pose": at}}, topic="/odom")

    goal: dict[str, Any] = {"x": 0.5, "y": 0.0, "action": "/slow", "remaining": "distance"}
    left = rehearse(actions.navigate_to_pose, device=bridge, world=world, **goal)
    assert said(left.result) == ("error", "cancelled", "yes")
    assert "x = 1.200" in left.result.text and left.seconds < 1.5
    assert "x = 1.200" in bridge.state()["left"]


def test_in_a_dry_run_nothing_is_sent_but_questions() -> None:
    ports = Ports()
    bridge, link = wired(ports, dry_run=True, setpoints={"speed": SPEED}, subscribe={"b": BUTTON})
    ports.point.take(0.8, 0.4)
    bridge.step(0.0)
    bridge.command(0.0, {"drive": ["speed"]})
    bridge.step(0.0)
    assert not bridge.stopped()  # it would move
    bridge.stop(0.0)
    assert bridge.stopped()
    message = {"topic": "/t", "type": "a/msg/B", "msg": {"x": 1}}
    bridge.command(0.0, {"publish": message})
    bridge.ports = None  # type: ignore[assignment]
    done = play(
        "/aborts", bridge, goal={}, values={"code": "error_code.val"}, expect={"error_code.val": 1}
    ).result
    assert (done.status, done.values) == ("success", {"code": 1})
    called = rehearse(actions.call, device=bridge, service="/no", values={"left": "level"}).result
    assert (called.status, called.values) == ("success", {"left": None})
    assert {m["op"] for m in link.fake.log} == {"subscribe"}


def test_large_messages_do_not_make_the_state_too_large() -> None:
    """It is published in one datagram, which has room for about 200 kB."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    topics = {f"t{n}": {"topic": f"/t{n}", "type": "a/msg/B"} for n in range(5)}
    bridge, _ = wired(Ports(), subscribe=topics)
    for name in topics:
        for size in (1_000, 15_000, 60_000):
            bridge.arrive(0.0, f"/{name}", {"data": "x" * size})
    kept = bridge.state()["topics"]
    assert {len(one["msg"]["data"]) for one in kept.values()} == {15_000}
    assert bridge.refused == 5 and "longer than 20000 characters" in bridge.fault
    link = NewestLink(here)
    assert link.send([bridge.state()])
    link.close()
    there.close()


def test_the_driver_keeps_the_rules() -> None:
    assert check_driver(lambda: wired(Ports())[0], simulated=True).faults == []


@pytest.mark.parametrize(
    ("action", "options", "action_type", "part"),
    [
        (
            actions.navigate_to_pose,
            {"x": 1, "y": 2, "yaw": math.pi},
            "nav2_msgs/action/NavigateToPose",
            ("pose.pose.orientation.z", 1.0),
        ),
        (
            actions.move_group,
            {"joints": {"j1": 1}, "group": "arm"},
            "moveit_msgs/action/MoveGroup",
            ("request.goal_constraints.0.joint_constraints.0.position", 1.0),
        ),
        (
            actions.follow_joint_trajectory,
            {"joints": ["a"], "positions": [[0.5]], "times": [1.25], "expect": {}},
            "control_msgs/action/FollowJointTrajectory",
            ("trajectory.points.0.time_from_start", {"sec": 1, "nanosec": 250_000_000}),
        ),
        (
            actions.follow_joint_trajectory,
            {"joints": ["a"], "positions": [[0.5]], "times": [sum([0.1] * 30)], "expect": {}},
            "control_msgs/action/FollowJointTrajectory",
            ("trajectory.points.0.time_from_start", {"sec": 3, "nanosec": 0}),
        ),
    ],
)
def test_shipped_goals(
    action: Callable[..., Any], options: dict[str, Any], action_type: str, part: tuple[str, Any]
) -> None:
    from petrobot.services.adapters.ros2.messages import pick

    bridge, link = robot()
    options = {"remaining": "distance", **options}
    played = rehearse(action, device=bridge, action="/ok", **options)
    assert played.result.status == "success", played.result
    (sent,) = link.fake.log
    assert sent["action_type"] == action_type and pick(sent["args"], part[0]) == pytest.approx(
        part[1]
    )


def test_a_trajectory_that_does_not_fit_is_not_sent() -> None:
    options: dict[str, Any] = {"joints": ["a", "b"], "positions": [[0.5]], "times": [1.0]}
    played = rehearse(actions.follow_joint_trajectory, device=robot()[0], action="/ok", **options)
    assert said(played.result) == ("error", "bad_goal", "no")
