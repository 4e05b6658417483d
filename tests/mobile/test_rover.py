"""The driver on the simulated bus, and the actions that use it: follow, recover, search, stop, and
their faults."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from petrobot.services.comm.canopen.cia402 import DriveFault
from petrobot.services.mobile import driving
from petrobot.services.mobile.odometry import Pose as Odo, turned
from petrobot.services.mobile.paths import arc
from petrobot.services.rehearsal import Rehearsal, rehearse
from tests.mobile.conftest import DrawnFloor, DrawnPose
from tests.mobile.yard import Yard

START = DrawnPose(0.0, 0.0, 0.0)


def play(
    yard: Yard,
    action: Callable[..., Any],
    *,
    happening: Callable[[float], None] | None = None,
    **arguments: Any,
) -> Rehearsal:
    """Rehearse an action in the yard, whose clock continues from one to the next; `happening` is
    called each tick."""
    begun = yard.ports.now

    def world(now: float) -> None:
        if happening is not None:
            happening(now)
        yard.world(begun + now)

    return rehearse(action, device=_Late(yard.rover, begun), world=world, limit=120.0, **arguments)


class _Late:
    """The driver with a clock that began earlier than the rehearsal's."""

    def __init__(self, rover: Any, begun: float) -> None:
        self._rover, self._begun = rover, begun
        self.period = rover.period

    def step(self, now: float) -> None:
        """A cycle."""
        self._rover.step(self._begun + now)

    def command(self, now: float, body: Any) -> None:
        """A command."""
        self._rover.command(self._begun + now, body)

    def stop(self, now: float) -> None:
        """The stop routine."""
        self._rover.stop(self._begun + now)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rover, name)


def enabled(yard: Yard) -> Yard:
    """The yard with its drives enabled."""
    played = play(yard, driving.enable_drives)
    assert played.result.status == "success" and yard.rover.state()["enabled"]
    return yard


def gap_yard(kind: str, *, reflector: bool = True, bar: bool = False) -> tuple[Yard, Any]:
    """A rover that has followed the track to an interruption, and the result of following."""
    floor = DrawnFloor("S" + kind + "SS", bar=bar)
    resumes = floor.at(2.0 + (2.0 if kind == "s" else math.pi / 2))
    yard = enabled(Yard(floor, START, reflectors=[(resumes.x, resumes.y)] if reflector else ()))
    followed = play(yard, driving.follow_feed_forward, speed=0.5).result
    assert followed.status == "success" and followed.values["at_t"] is False
    return yard, followed


def test_the_drives_are_enabled_and_nothing_moves() -> None:
    yard = enabled(Yard(DrawnFloor("SS"), START))
    yard.run(0.5)
    assert yard.rover.stopped() and math.hypot(yard.body.x, yard.body.y) < 0.001


@pytest.mark.parametrize(
    ("action", "bound"), [(driving.follow_feed_forward, 0.02), (driving.follow_pursuit, 0.06)]
)
def test_following_comes_to_the_end_and_stays_on_the_line(
    action: Callable[..., Any], bound: float
) -> None:
    yard = enabled(Yard(DrawnFloor("SLRs"), START))
    result = play(yard, action, speed=0.5).result
    end = DrawnFloor("SLR").end
    assert result.status == "success" and result.values["at_t"] is False
    assert max(yard.errors) < bound
    ahead, aside = yard.beyond(end)
    assert -0.45 < ahead < -0.2 and abs(aside) < bound + 0.06, (
        "it is taken over before the line ends, on an arc"
    )


def test_the_t_is_distinguished_from_an_interruption_and_stopped_at() -> None:
    floor = DrawnFloor("SS", bar=True)
    yard = enabled(Yard(floor, START))
    followed = play(yard, driving.follow_feed_forward).result
    assert followed.status == "success" and followed.values["at_t"] is True
    yard.camera = False  # what lies beyond the T does not matter
    stopped = play(yard, driving.stop_at_t, line_end=followed.values["line_end"]).result
    ahead, aside = yard.beyond(floor.t)
    assert stopped.status == "success" and yard.body.standing
    assert 0.0 < ahead < 0.2 and abs(aside) < 0.03


@pytest.mark.parametrize("kind", ["s", "l", "r"])
def test_homing_on_the_reflector_crosses_every_gap(kind: str) -> None:
    yard, followed = gap_yard(kind)
    result = play(yard, driving.home_on_reflector, line_end=followed.values["line_end"]).result
    assert (result.status, dict(result.values)) == ("success", {"recovered": True})
    yard.errors.clear()
    assert play(yard, driving.follow_feed_forward).result.cause in ("", "unannounced_end")
    assert max(yard.errors) < 0.1 and yard.errors[-1] < 0.02


def test_homing_without_a_reflector_fails_and_the_rover_rests() -> None:
    yard, followed = gap_yard("s", reflector=False)
    result = play(yard, driving.home_on_reflector, line_end=followed.values["line_end"]).result
    assert (result.status, result.cause, result.values["recovered"]) == (
        "failure",
        "no_reflector",
        False,
    )
    yard.run(0.6)
    assert yard.rover.stopped()


@pytest.mark.parametrize(("kind", "curvature"), [("s", 0.0), ("l", 1.0), ("r", -1.0)])
def test_dead_reckoning_along_the_right_curve_recovers(kind: str, curvature: float) -> None:
    yard, followed = gap_yard(kind, reflector=False)
    line_end = followed.values["line_end"]
    result = play(yard, driving.dead_reckon, line_end=line_end, curvature=curvature).result
    assert result.status == "success" and result.values["recovered"] is True


def test_dead_reckoning_along_the_wrong_curve_fails_and_a_search_finds_the_track() -> None:
    yard, followed = gap_yard("l", reflector=False)
    line_end = followed.values["line_end"]
    wrong = play(yard, driving.dead_reckon, line_end=line_end).result
    assert (wrong.status, wrong.cause, wrong.values["recovered"]) == ("failure", "no_track", False)
    found = play(yard, driving.search_pattern, line_end=line_end).result
    assert found.status == "success" and found.values["recovered"] is True


@pytest.mark.parametrize("kind", ["s", "l", "r"])
def test_a_search_needs_neither_sensor_nor_guess(kind: str) -> None:
    yard, followed = gap_yard(kind, reflector=False)
    result = play(yard, driving.search_pattern, line_end=followed.values["line_end"]).result
    assert result.status == "success" and result.values["recovered"] is True


@pytest.mark.parametrize("bar", [True, False])
def test_following_judges_the_recovery_that_found_the_line(bar: bool) -> None:
    """A line that is followed to an announced end belongs to the track; one that ceases does
    not."""
    yard, followed = gap_yard("s", bar=bar)
    line_end = followed.values["line_end"]
    result = play(yard, driving.home_on_reflector, line_end=line_end, judged=True).result
    assert result.status == "success" and result.deferred and result.values["run"]
    found = play(yard, driving.follow_feed_forward, recovery="task/1/recover#1")
    assert found.result.values["at_t"] is bar
    verdict = ("success", "") if bar else ("failure", "not_the_track")
    assert [told[1:] for told in found.verdicts] == [("task/1/recover#1", *verdict)]


def test_a_recovery_that_found_nothing_is_final() -> None:
    yard, followed = gap_yard("s", reflector=False)
    line_end = followed.values["line_end"]
    result = play(yard, driving.home_on_reflector, line_end=line_end, judged=True).result
    assert (result.status, result.cause, result.deferred) == ("failure", "no_reflector", False)
    assert result.values["run"] and result.values["recovered"] is False


def blindly_on(yard: Yard, end: Odo, ahead: float) -> None:
    """Drive straight beyond the line's end without looking, and stop."""
    yard.rover.command(yard.ports.now, {"do": "stretch", "look": False})
    yard.rover.command(yard.ports.now, {"do": "plan", "points": arc(end, 0.0, ahead)})
    for _ in range(25):
        yard.rover.command(yard.ports.now, {"do": "follow", "speed": 0.5})
        yard.run(0.2)
    assert yard.body.standing and yard.rover.state()["sights"] == 0


def test_a_rover_that_stands_beyond_the_gap_drives_on_and_not_back() -> None:
    """It is where a first attempt has ended: nearer to the point where the track resumes than a
    search would start."""
    yard, followed = gap_yard("s", reflector=False)
    line_end = Odo(*followed.values["line_end"])
    blindly_on(yard, line_end, 1.3)
    stood = yard.rover.state()["pose"]
    result = play(yard, driving.search_pattern, line_end=list(line_end)).result
    x, y, heading = yard.rover.state()["pose"]
    assert (
        result.status == "success"
        and Odo(*stood).body(x, y)[0] > 0.05
        and abs(turned(heading - stood[2])) < 0.3
    )


def test_a_line_seen_in_passing_is_not_regained_by_turning_away_from_it() -> None:
    """What is seen during a turn on the spot is not followed when it lies behind."""
    yard, followed = gap_yard("s", reflector=False)
    end = Odo(*followed.values["line_end"])
    blindly_on(yard, end, 1.0)
    yard.rover.command(
        yard.ports.now, {"do": "stretch", "gates": [tuple(Odo(*end.floor(2.0, 0.0), end.heading))]}
    )
    yard.run(0.3)
    assert yard.rover.state()["sights"] > 3 and not yard.rover.state()["regained"]
    for _ in range(20):
        yard.rover.command(yard.ports.now, {"do": "turn", "to": end.heading + math.pi})
        yard.run(0.2)
        assert not yard.rover.state()["regained"]


def test_a_search_without_a_track_gives_up() -> None:
    yard = enabled(Yard(DrawnFloor("Sss"), START))
    followed = play(yard, driving.follow_feed_forward).result
    result = play(yard, driving.search_pattern, line_end=followed.values["line_end"]).result
    assert (result.status, result.cause) == ("failure", "no_track")


def test_the_rover_stops_when_its_stream_ends() -> None:
    yard = enabled(Yard(DrawnFloor("SSS"), START))

    def cut(now: float) -> None:
        yard.camera = now < 2.0

    result = play(yard, driving.follow_feed_forward, happening=cut, patience=1.0).result
    assert (result.status, result.cause) == ("error", "stale_set_point")
    assert yard.body.standing and yard.body.x > 0.2


def test_no_line_at_all_is_an_error() -> None:
    yard = enabled(Yard(DrawnFloor("sss"), START))
    result = play(yard, driving.follow_feed_forward, patience=1.0).result
    assert (result.status, result.cause) == ("error", "no_line")


def test_a_drive_fault_ends_the_run_and_a_reset_clears_it() -> None:
    yard = enabled(Yard(DrawnFloor("SSS"), START))

    def trip(now: float) -> None:
        if abs(now - 1.5) < 0.001:
            yard.bus.bus.trip(0, DriveFault.OVERCURRENT)

    result = play(yard, driving.follow_feed_forward, happening=trip).result
    assert (result.status, result.cause, result.values["wheel"]) == (
        "error",
        "drive_fault",
        "left wheel",
    )
    yard.run(1.0)
    assert yard.body.standing
    enabled(yard)
    assert play(yard, driving.follow_feed_forward).result.values["at_t"] is False, (
        "it resumes where it was"
    )


def test_a_cut_bus_is_an_error_and_comes_back() -> None:
    yard = enabled(Yard(DrawnFloor("SSS"), START))
    yard.bus.cut = True
    yard.run(0.2)
    state = yard.rover.state()
    assert not state["enabled"] and state["faults"][0][0] == "bus"
    yard.bus.cut = False
    yard.run(2.5)
    enabled(yard)


def test_a_cancelled_follower_comes_to_rest() -> None:
    yard = enabled(Yard(DrawnFloor("SSS"), START))
    played = play(yard, driving.follow_feed_forward, cancel_after=2.0)
    assert played.result.cause == "cancelled"
    yard.run(1.2)
    assert yard.rover.stopped() and yard.body.standing


def test_the_rover_stops_when_its_action_stops_sending() -> None:
    yard = enabled(Yard(DrawnFloor("SSSSS"), START))
    yard.rover.command(yard.ports.now, {"do": "follow", "speed": 0.5})
    yard.run(2.5)
    state = yard.rover.state()
    assert (state["mode"], state["reason"]) == ("rest", "silent_action") and yard.body.standing


def test_a_pause_holds_and_then_the_motion_resumes() -> None:
    yard = enabled(Yard(DrawnFloor("SSSSS"), START))
    yard.rover.command(yard.ports.now, {"do": "follow", "speed": 0.5})
    yard.run(0.3)
    assert yard.rover.hold(yard.ports.now) == "held"
    yard.run(2.0)
    stood = yard.body.x
    assert yard.body.standing
    yard.rover.release(yard.ports.now)
    yard.run(0.3)
    assert yard.body.x > stood + 0.005


@pytest.mark.parametrize(
    "body",
    [
        {"do": "fly"},
        {"do": "follow", "speed": 0.0},
        {"do": "follow", "speed": 0.5, "law": "hope"},
        {"do": "turn", "to": math.nan},
        {"do": "plan", "points": [(0.0, math.inf)]},
        {"do": "stretch", "gates": [(0.0, 1.0)]},
    ],
)
def test_bad_commands_are_refused(body: dict[str, Any]) -> None:
    yard = enabled(Yard(DrawnFloor("SS"), START))
    with pytest.raises(ValueError, match=r".+"):
        yard.rover.command(yard.ports.now, body)


def test_commands_are_ignored_before_the_drives_are_enabled() -> None:
    yard = Yard(DrawnFloor("SS"), START)
    with pytest.raises(ValueError, match="not enabled"):
        yard.rover.command(0.0, {"do": "follow", "speed": 0.5})
