"""The driver of the SO-101 and its actions, on simulated servos."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot import Rehearsal, check_driver, rehearse
from petrobot.services.adapters.so101 import actions, bus
from petrobot.services.adapters.so101.arm import CHAIN, JOINTS, STILL, Joint, inverse
from petrobot.services.comm.streams.line import SerialPort
from petrobot.services.joint_chain import rotation_matrix
from petrobot.sim.bus import feetech
from petrobot.sim.bus.feetech import FeetechBus, Servo, so101
from petrobot.sim.bus.lines import PtyLine
from tests.adapters.so101.rig import Rig, SimulatedArm

THERE = {"do": "move", "joints": [0.5, -0.5, 0.5, 0.2, 1.0]}
BACK = {"do": "move", "joints": [-0.5, 0.1, 0.0, 0.3, 0.0]}
DOWN = {"do": "open", "angle": 1.2}
SHUT = {"do": "open", "angle": 0.1}


def test_it_keeps_the_rules_of_drivers() -> None:
    """With `speed`, `workspace` and `dry_run`, as it says in `obeys`."""
    rig = Rig()
    found = check_driver(rig.arm, (THERE, BACK), simulated=True, cable=rig.cable)
    assert (found.faults, found.notes) == ([], [])


def test_its_gripper_keeps_the_rules_of_drivers() -> None:
    """But for the workspace: opening it leaves the tip where it is."""
    rig = Rig()
    found = check_driver(lambda: rig.arm(), (DOWN, SHUT), simulated=True, cable=rig.cable)
    assert found.faults == [] and len(found.notes) == 1 and "workspace" in found.notes[0]


def test_it_keeps_the_rules_on_a_port_that_is_unplugged(tmp_path: Path) -> None:
    """The same with the port that a real arm has, on a pseudo terminal that is closed and opened
    again."""
    rig, path = Rig(), tmp_path / "so101"
    far = [PtyLine(path, rig.bus.receive)]

    class Near(SerialPort):
        """The bus answers at once, as if it were another process."""

        def send(self, data: bytes) -> None:
            super().send(data)
            far[0].poll()

    def cable(plugged: bool) -> None:
        if plugged:
            far[0] = PtyLine(path, rig.bus.receive)
        else:
            far[0].close()

    rig.open = lambda: Near(str(path), 1_000_000)
    found = check_driver(rig.arm, (THERE, BACK), simulated=True, cable=cable)
    far[0].close()
    assert found.faults == [] and found.notes == [], found


# --- movements ----------------------------------------------------------------------------------


def test_all_joints_arrive_together() -> None:
    arm = Rig().arm().ready()
    arm.command(arm.ports.now, THERE)
    arrived: dict[str, float] = {}
    goal = arm.motion.goal or []
    for _ in range(200):
        arm.run(arm.period)
        for joint in arm.arm:
            if joint.aim == goal[arm.arm.index(joint)]:
                arrived.setdefault(joint.name, arm.ports.now)
    assert max(arrived.values()) - min(arrived.values()) <= 3 * arm.period


@pytest.mark.parametrize(
    ("keys", "seconds"), [({}, 1.0), ({"speed": 0.25}, 3.0), ({"acceleration": 1.0}, 2.0)]
)
def test_its_duration_follows_from_speed_and_acceleration(keys: Any, seconds: float) -> None:
    arm = Rig().arm(**keys).ready()
    begin = arm.ports.now
    arm.command(begin, {"do": "move", "joints": [1.0, 0, 0, 0, 0]})
    while arm.joints[0].aim != 1.0 and arm.ports.now < begin + 10.0:
        arm.run(arm.period)
    fastest, rate = arm.top_speed * arm.speed, arm.acceleration
    due = 1.0 / fastest + fastest / rate if fastest**2 / rate < 1.0 else 2 * math.sqrt(1.0 / rate)
    assert arm.ports.now - begin == pytest.approx(due, abs=0.1) and due > 0.8 * seconds


def test_its_gripper_closes_at_the_share_of_its_speed_too() -> None:
    """Also at first, when it stands, as one that touches something does."""
    rig = Rig(so101([0.0] * 5 + [1.0]))
    arm = rig.arm(speed=0.1).ready()
    arm.command(arm.ports.now, {"do": "close", "squeeze": 0.4})
    ways = [rig.bus.servos[6].angle]
    for _ in range(100):
        arm.run(arm.period)
        ways.append(rig.bus.servos[6].angle)
    fastest = max(a - b for a, b in pairwise(ways)) / arm.period
    assert 0.1 < fastest < 0.16


def test_a_load_does_not_keep_it_from_its_goal() -> None:
    rig = Rig()
    arm = rig.arm().ready()
    for number, load in ((2, -0.3), (3, -0.2)):
        rig.bus.servos[number].external = load
    arm.command(arm.ports.now, THERE)
    arm.run(3.0)
    assert arm.state()["at_goal"]
    assert arm.state()["q"] == pytest.approx(THERE["joints"], abs=0.006)


def test_a_load_that_was_too_great_does_not_keep_it_from_its_next_goal() -> None:
    """As of a hand that holds it back and lets it go."""
    rig = Rig()
    arm = rig.arm().ready()
    rig.bus.servos[2].external = -0.65
    arm.command(arm.ports.now, THERE)
    arm.run(3.0)
    assert not arm.state()["at_goal"] and not arm.state()["faults"]
    rig.bus.servos[2].external = 0.0
    arm.run(1.0)
    assert arm.state()["at_goal"]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (
            {"do": "move", "joints": [9, 0, 0, 0, 0]},
            "shoulder_pan: expected -1.920 to 1.920, found 9",
        ),
        ({"do": "move", "joints": [0, 0, 0, 0]}, "joints: expected 5 finite numbers"),
        ({"do": "move", "joints": [0, 0, 0, 0, math.nan]}, "joints: expected 5 finite numbers"),
        ({"do": "move", "joints": [0] * 5, "speed": 2.0}, "speed: expected a share"),
        ({"do": "open", "angle": 3.0}, "gripper: expected -0.175 to 1.745, found 3"),
        ({"do": "close", "squeeze": 0.9}, "squeeze: expected at most 0.5"),
        ({"do": "dance"}, "do: move, open, close, free, calibrate, enable, rest"),
        ({"do": "calibrate"}, "calibration ="),
    ],
)
def test_a_command_outside_its_limits_is_refused(body: Any, words: str) -> None:
    arm = Rig().arm().ready()
    with pytest.raises(ValueError, match=words):
        arm.command(arm.ports.now, body)
    assert arm.stopped()


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"limits": {"elbow": [0.0, 1.0]}}, "no joint 'elbow'"),
        ({"limits": {"gripper": [1.0, 0.0]}}, "limits.gripper"),
        ({"reverse": ["nose"]}, "no joint 'nose'"),
        ({"speed": 0.0}, "speed: expected a number above 0"),
        ({"overload": 1.5}, "overload: expected a number above 0"),
        ({"acceleration": 0.0}, "acceleration: expected a number above 0"),
        ({"on_estop": "fall"}, "on_estop"),
        ({"baud": 9600}, "baud: unknown key; known: port, "),
    ],
)
def test_a_wrong_key_is_refused_with_its_name(keys: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Rig().arm(**keys)


# --- calibration --------------------------------------------------------------------------------


def test_zero_positions_are_calibrated_by_a_command_and_kept(tmp_path: Path) -> None:
    horn = 300.0  # steps by which a servo was mounted wrongly
    rig = Rig(folder=tmp_path)
    rig.bus.servos[2].position += horn
    arm = rig.arm(calibration="arm.toml", reverse=["elbow_flex"], enable=False)
    arm.run(0.3)
    with pytest.raises(ValueError, match="torque is off"):
        arm.command(arm.ports.now, THERE)
    pose = [0.0, 0.2, 0.3, 0.0, 0.0, 0.0]
    for number in (2, 3):
        rig.bus.servos[number].position += (pose[number - 1] / bus.RAD) * (-1) ** (number == 3)
    arm.run(0.3)
    arm.command(arm.ports.now, {"do": "calibrate", "pose": pose})
    assert arm.state()["q"] == pytest.approx(pose[:5], abs=0.002)
    again = rig.arm(calibration="arm.toml", reverse=["elbow_flex"]).ready()
    assert again.state()["q"] == pytest.approx(pose[:5], abs=0.002)
    again.command(again.ports.now, THERE)
    again.run(3.0)
    assert rig.bus.servos[2].angle - horn * bus.RAD == pytest.approx(-0.5, abs=0.01)
    assert rig.bus.servos[3].angle == pytest.approx(-0.5, abs=0.01)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("zero = [1, 2]", r"arm.toml: zero: expected 6 finite numbers, .*; is it an arm's file"),
        ("ids = [1, 2, 3, 4, 5, 6]", r"arm.toml: zero: expected 6 finite numbers"),
        ("nothing", "arm.toml: "),
        ("\xff", "arm.toml: "),
    ],
)
def test_a_wrong_calibration_file_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "arm.toml").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=words):
        Rig(folder=tmp_path).arm(calibration="arm.toml")


def test_without_its_calibration_file_it_does_not_move(tmp_path: Path) -> None:
    arm = Rig(folder=tmp_path).arm(calibration="arm.toml")
    arm.run(0.3)
    assert "uncalibrated" in arm.state()["faults"]
    with pytest.raises(ValueError, match=r"arm\.toml is not there yet"):
        arm.command(arm.ports.now, THERE)


# --- faults -------------------------------------------------------------------------------------


@pytest.mark.parametrize("chained", [False, True])
@pytest.mark.parametrize("lost", [(1,), (3,), (6,), (2, 5), (1, 2, 3, 4, 5)])
def test_a_missing_servo_does_not_hide_the_others(lost: tuple[int, ...], chained: bool) -> None:
    rig = Rig(FeetechBus((Servo(number) for number in range(1, 7)), chained=chained))
    arm = rig.arm().ready()
    arm.command(arm.ports.now, THERE)
    arm.run(0.2)
    for number in lost:
        rig.bus.servos[number].connected = False
    arm.run(1.0)
    names = ", ".join(list(JOINTS)[number - 1] for number in lost)
    assert arm.state()["faults"] == {"missing": f"no answer from {names}"}
    assert (
        not arm.stopped()
        and not arm.state()["at_goal"]
        and arm.hold(arm.ports.now) == "cannot hold"
    )
    heard = [joint for joint in arm.joints if joint.servo not in lost]
    assert all(joint.still >= STILL for joint in heard) and not arm.motion.moving
    with pytest.raises(ValueError, match="no answer from"):
        arm.command(arm.ports.now, BACK)
    where = [servo.angle for servo in rig.bus.servos.values()]
    for number in lost:
        rig.bus.servos[number].connected = True
    arm.run(0.5)
    assert [servo.angle for servo in rig.bus.servos.values()] == pytest.approx(where, abs=0.01)
    # The servos lost their torque with their cable: the arm does not go on by itself.
    assert list(arm.state()["faults"]) == ["power"]
    assert arm.stopped() and not arm.state()["at_goal"]


def test_one_servo_that_is_missing_from_the_start() -> None:
    rig = Rig()
    rig.bus.servos[4].connected = False
    arm = rig.arm()
    arm.run(1.0)
    assert arm.state()["faults"] == {"missing": "no answer from wrist_flex"}
    rig.bus.servos[4].connected = True
    arm.run(0.5)
    assert arm.stopped() and arm.state()["faults"] == {}


@pytest.mark.parametrize("at", [5000.0, -400.0])
def test_a_servo_beyond_its_positions_gets_no_torque(at: float) -> None:
    """It would jump to the nearest position that a goal can have, here by up to 80 degrees."""
    rig = Rig()
    rig.bus.servos[2].position = at
    arm = rig.arm()
    arm.run(1.0)
    assert (
        rig.bus.servos[2].position == at and "shoulder_lift is at" in arm.state()["faults"]["range"]
    )
    rig.bus.servos[2].position = 2048.0
    arm.run(0.1)
    arm.command(arm.ports.now, {"do": "enable"})
    arm.run(0.3)
    assert arm.state()["ready"] and arm.state()["faults"] == {}


def test_two_arms_on_one_bus_get_no_torque() -> None:
    """Both answer under the same ids, so one would jump to the pose of the other."""
    first, second = so101(), so101([0.5] * 6)
    answer = first.receive
    first.receive = lambda data: answer(data) + second.receive(data)  # type: ignore[method-assign]
    arm = Rig(first).arm()
    arm.run(1.0)
    assert "change the id" in arm.state()["faults"]["twice"] and not arm.state()["ready"]
    assert {servo.angle for servo in first.servos.values()} == {0.0}


@pytest.mark.parametrize(("seed", "echo"), [(1, False), (2, True), (3, True)])
def test_noise_and_echoes_do_not_disturb_it(seed: int, echo: bool) -> None:
    chance = random.Random(seed)
    rig = Rig(FeetechBus((Servo(number) for number in range(1, 7)), echo=echo))

    def spoil(answer: bytes) -> bytes:
        at = chance.randrange(len(answer))
        kind = chance.randrange(6)
        if kind == 0:
            return answer[:at]
        if kind == 1:
            return answer[:at] + bytes((answer[at] ^ 1 << chance.randrange(8),)) + answer[at + 1 :]
        return chance.randbytes(chance.randrange(4)) + answer if kind == 2 else answer

    rig.bus.noise = spoil
    arm = rig.arm()
    arm.run(0.5)
    arm.command(arm.ports.now, THERE)
    arm.run(3.0)
    assert arm.state()["at_goal"] and arm.state()["faults"] == {}


def test_a_pulled_cable_is_unknown_and_the_port_is_opened_again() -> None:
    rig = Rig()
    arm = rig.arm().ready()
    arm.command(arm.ports.now, THERE)
    arm.run(0.3)
    rig.cable(False)
    arm.run(10.0)
    assert not arm.stopped() and arm.hold(arm.ports.now) == "cannot hold"
    assert "the cable is pulled" in arm.state()["faults"]["missing"] or "no /dev" in str(
        arm.state()["faults"]
    )
    assert 5 <= rig.opened <= 9  # 0.2, 0.4, ... 3.2 s between two attempts
    with pytest.raises(ValueError, match="no answer from"):
        arm.command(arm.ports.now, BACK)
    where = [servo.angle for servo in rig.bus.servos.values()]
    rig.cable(True)
    arm.run(4.0)
    assert arm.stopped() and arm.state()["faults"] == {} and not arm.state()["at_goal"]
    assert [servo.angle for servo in rig.bus.servos.values()] == pytest.approx(where, abs=0.003)
    arm.command(arm.ports.now, BACK)
    arm.run(3.0)
    assert arm.state()["at_goal"]


def trouble(kind: str) -> Callable[[Servo], None]:
    def happen(servo: Servo) -> None:
        if kind == "heat":
            servo.heat = 66.0
        elif kind == "power":
            servo.write(feetech.TORQUE, b"\0")
        elif kind == "voltage":
            servo.voltage = 3.0
        else:
            servo.high = servo.position + 5.0

    return happen


@pytest.mark.parametrize("kind", ["heat", "power", "voltage", "overload"])
def test_trouble_stops_it_until_a_reset(kind: str) -> None:
    rig = Rig()
    arm = rig.arm().ready()
    servo = rig.bus.servos[3]
    arm.command(arm.ports.now, {"do": "move", "joints": [0, 0, 1.5, 0, 0]})
    arm.run(0.4)
    trouble(kind)(servo)
    arm.run(2.0)
    assert list(arm.state()["faults"]) == [kind] and arm.stopped()
    assert abs(servo.duty) < 0.2  # it gave way
    with pytest.raises(ValueError, match="enable"):
        arm.command(arm.ports.now, BACK)
    servo.heat, servo.voltage, servo.high = 30.0, 7.4, math.inf
    arm.run(0.1)
    arm.command(arm.ports.now, {"do": "enable"})
    arm.run(0.3)
    arm.command(arm.ports.now, BACK)
    arm.run(3.0)
    assert arm.state()["at_goal"]


def test_an_overload_that_its_servo_reports_ends_with_one_reset() -> None:
    """Its torque, written by `enable`, clears it there, but an older answer comes first."""
    arm = (rig := Rig()).arm().ready()
    rig.bus.servos[3].fault = 32
    arm.run(0.1)
    assert list(arm.state()["faults"]) == ["overload"]
    arm.command(arm.ports.now, {"do": "enable"})
    arm.run(0.3)
    assert not arm.state()["faults"] and arm.state()["ready"]


@pytest.mark.parametrize(("on_estop", "falls"), [("hold", False), ("off", True)])
def test_a_quick_stop_holds_or_lets_go(on_estop: str, falls: bool) -> None:
    rig = Rig()
    arm = rig.arm(on_estop=on_estop).ready()
    arm.command(arm.ports.now, THERE)
    arm.run(0.4)
    at = rig.bus.servos[1].angle
    arm.quick_stop(arm.ports.now)
    arm.run(0.5)
    assert abs(rig.bus.servos[1].angle - at) < 0.1 and arm.stopped()
    rig.bus.servos[2].external = -0.3
    at = rig.bus.servos[2].angle
    arm.run(0.5)
    assert (abs(rig.bus.servos[2].angle - at) > 0.2) == falls
    assert arm.state()["torque"] != falls


def test_a_new_driver_continues_without_a_movement() -> None:
    rig = Rig()
    rig.bus.servos[2].external = -0.3
    arm = rig.arm().ready()
    arm.command(arm.ports.now, THERE)
    arm.run(3.0)
    before = rig.bus.servos[2].angle
    again = rig.arm().ready()
    again.run(1.0)
    assert rig.bus.servos[2].angle == pytest.approx(before, abs=0.003)


def test_a_period_takes_a_small_part_of_its_time() -> None:
    arm = Rig().arm().ready()
    arm.command(arm.ports.now, THERE)
    begin = time.process_time()
    for _ in range(100):
        super(SimulatedArm, arm).step(arm.ports.now)
    assert time.process_time() - begin < 100 * arm.period / 4


def test_a_joint_reads_and_writes_steps() -> None:
    joint = Joint("elbow_flex", 3, -1.0, 1.0, sign=-1, zero=2000)
    joint.take(0.0, bus.Reading(0, True, 0, 2100, 0, -0.25, 7.4, 25))
    assert joint.q == pytest.approx(-100 * bus.RAD) and joint.load == 0.25
    assert joint.steps(joint.q) == 2100 and joint.steps(99.0) == 0


# --- actions ------------------------------------------------------------------------------------


def played(action: Any, rig: Rig, **arguments: Any) -> Rehearsal:
    return rehearse(action, device=rig.arm().ready(), **arguments)


def test_move_to_brings_the_tip_there() -> None:
    rig = Rig()
    rig.bus.servos[2].external = -0.2
    result = played(actions.move_to, rig, x=0.25, y=0.05, z=0.03).result
    assert result.status == "success" and result.values["off"] < 0.004


@pytest.mark.parametrize(
    ("action", "arguments", "cause"),
    [
        (actions.move_to, {"x": 0.7, "y": 0.0, "z": 0.0}, "unreachable"),
        (actions.move_joints, {"joints": [0, 9, 0, 0, 0]}, "command_refused"),
        (actions.move_joints, {"joints": [1, 0, 0, 0, 0], "timeout": 0.2}, "late"),
    ],
)
def test_an_action_says_why_it_failed(action: Any, arguments: Any, cause: str) -> None:
    result = played(action, Rig(), **arguments).result
    assert (result.status, result.cause) == ("error", cause)


def test_an_action_ends_when_the_arm_has_a_fault() -> None:
    rig = Rig()
    rig.bus.servos[2].high = 2148.0
    found = played(actions.move_joints, rig, joints=[0, 1, 0, 0, 0])
    assert (found.result.status, found.result.cause) == ("error", "overload")
    assert "shoulder_lift" in found.result.text and found.seconds < 2.0


def test_the_gripper_holds_what_is_there_while_the_arm_moves() -> None:
    rig = Rig(so101([0.0] * 5 + [1.0]))
    rig.bus.servos[6].low = 2048.0 + 200.0
    arm = rig.arm().ready()
    result = rehearse(actions.grasp, device=arm, squeeze=0.3).result
    assert result.status == "success" and result.values["angle"] == pytest.approx(0.307, abs=0.01)
    arm.run(1.0)
    assert rig.bus.servos[6].duty == pytest.approx(-0.3, abs=0.02)
    result = rehearse(actions.move_joints, device=arm, joints=[0.5, 0, 0, 0, 0]).result
    arm.stop(arm.ports.now)
    arm.run(0.5)
    assert result.status == "success" and arm.state()["gripper"]["holding"]
    rig.bus.servos[6].low = -math.inf  # it slips out
    arm.run(0.5)
    assert not arm.state()["gripper"]["holding"]


def test_the_arm_is_reset_and_calibrated_by_actions(tmp_path: Path) -> None:
    rig = Rig(folder=tmp_path)
    arm = rig.arm(calibration="arm.toml", enable=False)
    arm.run(0.3)
    pose = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert rehearse(actions.calibrate, device=arm, pose=pose).result.status == "success"
    assert rehearse(actions.enable, device=arm).result.status == "success"
    assert arm.state()["q"][0] == pytest.approx(0.1, abs=0.002) and arm.state()["torque"]


def test_the_gripper_finds_nothing_and_opens() -> None:
    rig = Rig(so101([0.0] * 5 + [1.0]))
    arm = rig.arm().ready()
    result = rehearse(actions.grasp, device=arm).result
    assert (result.status, result.cause) == ("failure", "empty")
    assert rehearse(actions.release, device=arm, angle=0.8).result.status == "success"
    assert arm.state()["gripper"]["angle"] == pytest.approx(0.8, abs=0.03)


# --- kinematics ---

HALF = math.pi / 2
URDF = [
    ((0.0207909, -0.0230745, 0.0948817), (-math.pi, 0, HALF)),
    ((-0.0303992, -0.0182778, -0.0542), (-HALF, -HALF, 0)),
    ((-0.11257, -0.028, 0), (0, 0, HALF)),
    ((-0.1349, 0.0052, 0), (0, 0, -HALF)),
    ((0, -0.0611, 0.0181), (HALF, 0, math.pi)),
]
"""Origins (m, roll-pitch-yaw) of the joints, each after the one before; all turn about their z."""
TIP = ((-0.0079, -0.000218121, -0.0981274), (HALF, 0, HALF))
angles = st.tuples(*(st.floats(low, high) for low, high in list(JOINTS.values())[:5]))


def matrix(place: Any, turn: Any) -> Any:
    (cr, cp, cy), (sr, sp, sy) = np.cos(turn), np.sin(turn)
    about_x = [[1, 0, 0], [0, cr, -sr], [0, sr, cr]]
    about_y = [[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]
    about_z = [[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]
    whole = np.eye(4)
    whole[:3, :3] = np.array(about_z) @ np.array(about_y) @ np.array(about_x)
    whole[:3, 3] = place
    return whole


@given(angles)
def test_the_tip_is_where_the_urdf_has_it(q: Any) -> None:
    pose = np.eye(4)
    for origin, angle in zip(URDF, q, strict=True):
        pose = pose @ matrix(*origin) @ matrix((0, 0, 0), (0, 0, angle))
    roll_axis = -pose[:3, 2]  # from the wrist to the tip
    x, y, z = (pose @ matrix(*TIP))[:3, 3]
    pan = URDF[0][0]
    expected = -(y - pan[1]), x - pan[0], z  # forward is the URDF's -y
    tip = CHAIN.tool(q)
    assert tip[:3] == pytest.approx(expected, abs=2e-6)
    assert rotation_matrix(tip[3:])[2, 0] == pytest.approx(roll_axis[2], abs=2e-5)


@given(angles)
def test_inverse_gives_angles_that_bring_the_tip_there(q: Any) -> None:
    tip, pitch = CHAIN.point(q), -sum(q[1:4])
    x, y, z = tip
    found = inverse(x, y, z, pitch, q[4])
    assert CHAIN.point(found) == pytest.approx(tip, abs=1e-6) and found[4] == q[4]
    assert math.remainder(-sum(found[1:4]) - pitch, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    for (low, high), angle in zip(JOINTS.values(), found, strict=False):
        assert low <= angle <= high


def test_a_point_in_front_is_reached_with_the_elbow_up() -> None:
    pan, lift, elbow, *_ = inverse(0.2, -0.1, 0.05, -HALF, 0.3)
    assert pan == pytest.approx(math.atan2(0.1, 0.2), abs=0.02)
    # stretched out: the forearm lies 1.288 rad above its direction at zero
    assert -HALF < lift < HALF and elbow > -1.288


@pytest.mark.parametrize(
    ("x", "z", "roll", "words"),
    [
        (0.6, 0.1, 0.0, "no joint positions.* mm and"),
        (0.0, 0.1, 0.0, "no joint positions"),
        (-0.25, 0.05, 0.0, "no joint positions"),
        (0.2, 0.05, 3.0, "roll: expected -2.793 to 2.793 rad"),
    ],
)
def test_what_cannot_be_reached_is_refused_in_words(
    x: float, z: float, roll: float, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        inverse(x, 0.0, z, -HALF, roll)
