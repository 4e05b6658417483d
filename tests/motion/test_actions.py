"""The arm's actions on a simulated arm: their results, and the arm's motion meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from petrobot.services.action import CommandRefused, Status
from petrobot.services.comm.canopen.cia402 import DriveFault
from petrobot.services.motion import actions
from petrobot.services.motion.kinematics import Puma
from petrobot.services.motion.limits import CollisionGuard
from petrobot.services.motion.model import nominal_arm, nominal_cell

FALL = math.sqrt(2 * 0.055 / 9.81)


class PredictedBall:
    """A ball that leaves the edge `leaves` seconds from the start, as vision would predict it 50
    times a second from `seen` on.

    Predictions continue until `until` (s after the start, default: when the ball has fallen). The
    ball lies in the cup from its arrival on if it is to be `caught`.
    """

    def __init__(
        self,
        leaves: float = 1.0,
        y: float = 0.15,
        seen: float = 0.2,
        until: float = math.inf,
        caught: bool = True,
        sigma: float = 0.002,
    ) -> None:
        self.leaves, self.y, self.seen, self.until, self.caught, self.sigma = (
            leaves,
            y,
            seen,
            until,
            caught,
            sigma,
        )
        self.begun: float | None = None
        self.speed = 1.4

    def __call__(self, play: Any) -> None:
        if self.begun is None:
            self.begun = play.now
        age = play.now - self.begun
        if self.seen <= age < min(self.until, self.leaves + 0.15) and play.rig.cycle % 5 == 0:
            play.rig.feed(
                [self.leaves - age, 0.62, self.y, 0.62, -self.speed, 0.0, 0.0, self.sigma, 0.01]
            )
        if self.caught and age >= self.leaves + FALL:
            play.rig.drives.ball(True)


@pytest.mark.parametrize("action", [actions.intercept_tilted, actions.intercept_upright])
def test_intercept_is_in_place_before_the_ball(play: Any, action: Callable[..., Any]) -> None:
    result = play.play(action(play), PredictedBall())
    assert result.status is Status.SUCCESS
    assert result.values["slack"] > 0.2
    assert result.values["point"][1] == pytest.approx(0.15, abs=0.002)
    assert play.device.state["mode"] == "follow", "following continues"
    assert play.device.state["in_place"]


def test_intercept_waits_for_a_good_prediction(play: Any) -> None:
    result = play.play(actions.intercept_tilted(play), PredictedBall(sigma=0.03))
    assert result.status is Status.SUCCESS
    assert result.values["slack"] < 0.1


def test_an_interception_that_is_late_is_a_failure_and_keeps_following(play: Any) -> None:
    result = play.play(actions.intercept_tilted(play), PredictedBall(leaves=0.3, y=0.3, seen=0.25))
    assert (result.status, result.cause) == (Status.FAILURE, "late")
    assert play.device.state["mode"] == "follow"


def test_intercept_without_a_ball_reports_it(play: Any) -> None:
    result = play.play(actions.intercept_tilted(play, patience=0.5), None)
    assert (result.status, result.cause) == (Status.ERROR, "no_setpoint")
    play.rig.run(0.1)
    assert play.rig.arm.state()["mode"] == "hold"


def test_intercept_reports_that_vision_died_and_the_arm_holds(play: Any) -> None:
    begun = play.now
    result = play.play(actions.intercept_tilted(play), PredictedBall(leaves=1.5, y=0.3, until=0.3))
    assert (result.status, result.cause) == (Status.ERROR, "no_setpoint")
    assert play.now - begun < 0.3 + 0.06 + 0.05
    play.rig.run(0.3)
    assert play.rig.arm.stopped()
    assert play.rig.arm.state()["stale_executed"] == 0


def test_intercept_of_a_ball_out_of_reach(play: Any) -> None:
    result = play.play(actions.intercept_tilted(play), PredictedBall(y=1.4))
    assert (result.status, result.cause) == (Status.ERROR, "unreachable")


def test_intercept_with_a_faulty_drive(play: Any) -> None:
    ball = PredictedBall()

    def world(play: Any) -> None:
        ball(play)
        if play.now - (ball.begun or 0.0) > 0.3:
            play.rig.drives.trip(2, DriveFault.OVERHEATED)

    result = play.play(actions.intercept_tilted(play), world)
    assert (result.status, result.cause) == (Status.ERROR, "drive_fault")
    assert result.values == {"joint": 2, "code": DriveFault.OVERHEATED}


@pytest.mark.parametrize("action", [actions.intercept_tilted, actions.follow_and_wait])
def test_a_cancelled_run_leaves_the_arm_holding(play: Any, action: Callable[..., Any]) -> None:
    begun = play.now
    assert play.play(action(play), PredictedBall(), cancel=lambda: play.now - begun > 0.4) is None
    play.rig.run(0.3)
    assert play.rig.arm.state()["mode"] == "hold"
    assert play.rig.arm.stopped()


def test_intercept_hands_over_to_the_second_action_of_a_catch(play: Any) -> None:
    ball = PredictedBall()
    assert play.play(actions.intercept_tilted(play), ball).status is Status.SUCCESS
    result = play.play(actions.follow_and_wait(play), ball)
    assert result.status is Status.SUCCESS
    assert play.rig.events == ["ball_caught"]
    assert ball.begun is not None
    assert play.now - ball.begun < 1.0 + FALL + 0.06 + 0.3 + 0.05
    assert play.rig.arm.state()["stale_executed"] == 0
    result = play.play(
        actions.empty_and_home(play),
        lambda play: play.rig.drives.ball(play.rig.arm.state()["mode"] != "move"),
    )
    assert result.status is Status.SUCCESS


def test_a_ball_that_does_not_come_is_missed(play: Any) -> None:
    ball = PredictedBall(caught=False)
    play.play(actions.intercept_tilted(play), ball)
    result = play.play(actions.follow_and_wait(play, margin=0.4), ball)
    assert (result.status, result.cause) == (Status.FAILURE, "missed")
    assert ball.begun is not None
    assert play.now - ball.begun == pytest.approx(1.0 + FALL + 0.4, abs=0.05)


@pytest.mark.parametrize("caught", [True, False])
def test_the_catch_judges_the_interception(play: Any, caught: bool) -> None:
    ball, home = PredictedBall(caught=caught), play.device.state["q"]
    moved = play.play(actions.intercept_tilted(play, judged=True), ball)
    apart = sum(abs(a - b) for a, b in zip(play.device.state["q"], home, strict=True))
    assert apart - 0.01 < moved.values["travel"] < 1.5 * apart
    assert moved.status is Status.SUCCESS and moved.deferred and moved.values["run"] == "test"
    play.play(actions.follow_and_wait(play, moved="move#1"), ball)
    status, cause = (Status.SUCCESS, "") if caught else (Status.FAILURE, "missed")
    assert play.verdicts == [("move#1", status, cause)]


def test_a_catch_that_is_preempted_by_the_ball_judges_too(play: Any) -> None:
    ball = PredictedBall()
    moved = play.play(actions.intercept_tilted(play, judged=True), ball)
    waiting = actions.follow_and_wait(play, moved=moved.values["run"])
    assert play.play(waiting, ball, cancel=lambda: bool(play.rig.events)) is None
    assert play.verdicts == [("test", Status.SUCCESS, "")]


def test_a_catch_that_vision_broke_off_judges_nothing(play: Any) -> None:
    ball = PredictedBall(leaves=2.0, until=0.9)
    play.play(actions.intercept_tilted(play, judged=True), ball)
    assert play.play(actions.follow_and_wait(play, moved="m"), ball).status is Status.ERROR
    assert play.verdicts == []


def test_waiting_while_vision_dies_is_an_error(play: Any) -> None:
    ball = PredictedBall(leaves=2.0, until=0.9)
    assert play.play(actions.intercept_tilted(play), ball).status is Status.SUCCESS
    result = play.play(actions.follow_and_wait(play), ball)
    assert (result.status, result.cause) == (Status.ERROR, "no_setpoint")


def test_waiting_without_set_points_is_an_error(play: Any) -> None:
    result = play.play(actions.follow_and_wait(play, patience=0.3))
    assert (result.status, result.cause) == (Status.ERROR, "no_setpoint")


def test_the_cup_is_turned_over_until_it_is_empty(play: Any) -> None:
    axes: list[float] = []

    def world(play: Any) -> None:
        up = play.rig.arm._guard.place(play.rig.plant.q).axis[2]
        axes.append(up)
        if up < -0.9:
            play.rig.drives.ball(False)

    play.rig.drives.ball(True)
    play.rig.run(0.1)
    play.device.state = play.rig.arm.state()
    result = play.play(actions.empty_and_home(play), world)
    assert result.status is Status.SUCCESS
    assert min(axes) < -0.9
    assert axes[-1] > 0.85


def test_an_empty_cup_is_not_turned_over(play: Any) -> None:
    begun = play.now
    assert play.play(actions.empty_and_home(play)).status is Status.SUCCESS
    assert play.now - begun < 0.1


def test_a_ball_that_sticks_is_an_error(play: Any) -> None:
    play.rig.drives.ball(True)
    play.rig.run(0.1)
    play.device.state = play.rig.arm.state()
    result = play.play(actions.empty_and_home(play, attempts=2))
    assert (result.status, result.cause) == (Status.ERROR, "cup_not_empty")
    assert [body.get("pose") for body in play.device.sent] == ["home", *["empty", "home"] * 2]


def test_reset_and_home_recovers_from_a_fault(play: Any) -> None:
    play.rig.arm.command(play.now, {"do": "move", "pose": "empty"})
    play.rig.run(0.5)
    play.rig.drives.trip(0, DriveFault.OVERCURRENT)
    play.rig.run(0.5)
    result = play.play(actions.reset_and_home(play))
    assert result.status is Status.SUCCESS
    assert play.rig.arm.state()["in_place"]
    assert play.rig.arm.state()["faults"] == []


def test_reset_and_home_gives_the_reason_of_its_failure(play: Any) -> None:
    play.rig.drives.power(False)
    play.rig.run(0.3)
    result = play.play(actions.reset_and_home(play, timeout=2.0))
    assert result.status is Status.ERROR
    assert result.cause in ("drive_fault", "power", "arm_timeout")


def test_an_arm_that_cannot_reach_home_past_the_table_reports_it_and_does_not_touch_it(
    make_rig: Any, make_play: Any
) -> None:
    rig = make_rig(
        start=[math.radians(angle) for angle in (0.0, 90.0, -90.0, 0.0, 0.0, 0.0)]
    ).enable()
    arm = nominal_arm()
    bare = CollisionGuard(Puma.of(arm), arm, nominal_cell(), cup_margin=0.0, arm_margin=0.0)
    play = make_play(rig)
    result = play.play(actions.reset_and_home(play, timeout=5.0, speed=0.7))
    assert (result.status, result.cause) == (Status.ERROR, "arm_timeout")
    assert "table" in result.text
    assert rig.arm.state()["faults"] == []
    assert not any(bare.violation(q) for q in rig.commanded)


def test_a_pose_that_is_not_reached_in_time_is_an_error(play: Any) -> None:
    play.rig.arm.command(play.now, {"do": "move", "pose": "empty"})
    play.rig.run(0.8)
    result = play.play(actions.empty_and_home(play, timeout=0.3, speed=0.3))
    assert (result.status, result.cause) == (Status.ERROR, "arm_timeout")
    assert "home not reached in time: still in progress" in result.text


def test_actions_report_that_the_drives_are_off(make_rig: Any, make_play: Any) -> None:
    rig = make_rig(config={"enable": False})
    rig.run(0.5)
    play = make_play(rig)
    for action in (actions.intercept_tilted(play), actions.empty_and_home(play)):
        with pytest.raises(CommandRefused, match="not enabled"):
            play.play(action)


def test_reset_and_home_turns_a_full_cup_over(play: Any) -> None:
    """Seen after a resumed run: a ball left in the cup by recovery kept the next one from being
    thrown."""
    play.rig.drives.ball(True)
    play.rig.run(0.1)
    play.device.state = play.rig.arm.state()
    play.play(actions.reset_and_home(play, timeout=40.0))
    assert [body.get("pose") for body in play.device.sent if body["do"] == "move"][:3] == [
        "home",
        "empty",
        "home",
    ]
