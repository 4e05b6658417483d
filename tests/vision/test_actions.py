"""The camera's actions end to end on rendered images, in lock step: what they find and stream, and
how they fail."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from petrobot.services.action import Cancelled, Result, Status
from petrobot.services.vision import actions
from petrobot.services.vision.camera import Camera
from petrobot.sim.catching.camera import PinholeCamera
from tests.vision.bench import (
    BenchContext,
    BenchPorts,
    CameraBench,
    RolledBall,
    draw_ball,
    run_action,
)

LOCATORS = {
    "background": actions.locate_background,
    "mog2": actions.locate_mog2,
    "hough": actions.locate_hough,
    "threshold": actions.locate_threshold,
    "compensated": actions.locate_compensated,
}
PREDICTORS = {
    "least_squares": actions.predict_least_squares,
    "kalman": actions.predict_kalman,
    "constant_velocity": actions.predict_constant_velocity,
}


def catch(
    context: BenchContext, predictor: str = "least_squares", locator: str = "background"
) -> tuple[Result, Result]:
    """Locate, then track."""
    located = run_action(context.bench, LOCATORS[locator](context))
    assert "ball" in located.values, located
    return located, run_action(
        context.bench, PREDICTORS[predictor](context, ball=located.values["ball"])
    )


def streamed(context: BenchContext) -> list[tuple[float, float, float, list[float]]]:
    """Return for each published set point the time until the ball really leaves (s), the errors of
    its predicted time (s) and position (m), and its values."""
    ball = context.bench.ball
    assert ball is not None
    time, y = ball.leaves()
    leaves = time + context.bench.release
    return [
        (leaves - at, at + v[0] - leaves, v[2] - y, v)
        for at, v in context.published
        if v is not None
    ]


@pytest.mark.parametrize("regime", ["A", "B", "C"])
@pytest.mark.parametrize("locator", ["background", "mog2"])
def test_a_ball_is_located_tracked_and_predicted(
    context: BenchContext, regime: str, locator: str
) -> None:
    bench = context.bench
    bench.ball = draw_ball(np.random.default_rng(ord(regime)), regime)
    located, tracked = catch(context, locator=locator)
    assert located.status is Status.SUCCESS, located
    assert located.values["images"] > 20 and located.values["residual"] < 0.0015
    assert tracked.status is Status.SUCCESS, tracked
    points = streamed(context)
    assert len(points) > 20
    for before, late, off, values in points:
        if before < 0.45:
            assert abs(late) < 0.006 and abs(off) < 0.003
        assert len(values) == 9
        assert values[1] == pytest.approx(0.62) and values[3] == pytest.approx(0.62)
        assert values[4] < 0.0 and values[6] == 0.0
        assert values[7] > 0.0 and values[8] > 0.0
    speed = bench.ball.way(bench.ball.leaves()[0])[1]
    assert np.hypot(points[-1][3][4], points[-1][3][5]) == pytest.approx(speed, abs=0.05)
    assert points[-1][0] < 0.03, "it must stream until the ball leaves the table"
    assert context.published[-1][1] is not None, "it must keep its last prediction valid"
    assert context.device.stopped(), "images end with the run"


@pytest.mark.parametrize("predictor", sorted(PREDICTORS))
def test_every_predictor_tracks_a_slow_ball(context: BenchContext, predictor: str) -> None:
    context.bench.ball = RolledBall((2.12, 0.1), (0.62, -0.15), 1.0)
    _, tracked = catch(context, predictor)
    assert tracked.status in (Status.SUCCESS, Status.FAILURE)
    assert tracked.values["seen"] > 0.9 * tracked.values["images"]
    early = next(point for point in streamed(context) if point[0] < 0.9)
    limits = {"least_squares": 0.012, "kalman": 0.02, "constant_velocity": 0.2}
    assert abs(early[1]) < limits[predictor]
    assert abs(early[2]) < 0.003
    if predictor == "constant_velocity":
        assert abs(early[1]) > 0.015, "this predictor assumes no resistance"


@pytest.mark.parametrize("latency", [0.2, 0.4])
def test_time_to_go_is_right_however_old_the_images_are(
    context: BenchContext, latency: float
) -> None:
    context.bench.latency = latency
    context.bench.ball = draw_ball(np.random.default_rng(8), "A")
    _, tracked = catch(context)
    assert tracked.status is Status.SUCCESS, tracked
    assert max(abs(late) for before, late, _, _ in streamed(context) if before < 0.4) < 0.008


def test_late_images_of_a_fast_ball_are_a_failure_not_an_error(context: BenchContext) -> None:
    context.bench.latency = 0.4
    context.bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 2.4)
    _, tracked = catch(context)
    assert (tracked.status, tracked.cause) == (Status.FAILURE, "late")
    assert "exit" in tracked.values


def test_between_images_the_stream_continues_with_fresh_times(context: BenchContext) -> None:
    """When images are missing for a moment, set points are still sent with a decreasing time to
    go."""
    bench = context.bench
    bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.2)
    located = run_action(bench, actions.locate_background(context))
    whole, bench.dead_from = bench.dead_from, bench.now + 0.5
    action = actions.predict_least_squares(context, ball=located.values["ball"], image_timeout=0.4)

    def revive() -> float:
        bench.dead_from = whole if bench.now > revive_at else bench.dead_from
        return 1.0

    revive_at, bench.light = bench.dead_from + 0.2, lambda time: 1.0
    advance = bench.advance
    bench.advance = lambda: (revive(), advance())[1]  # type: ignore[method-assign]
    tracked = run_action(bench, action)
    assert tracked.status is Status.SUCCESS, tracked
    gaps = np.diff([at for at, _ in context.published])
    assert gaps.max() <= 0.040, "two periods of the stream at most"
    assert max(abs(late) for before, late, _, _ in streamed(context) if before < 0.45) < 0.01


SPECIFIED: dict[str, Any] = {"place_within": 0.015, "time_within": 0.020}


def judged(
    context: BenchContext,
    locator: str = "background",
    predictor: str = "least_squares",
    **asked: Any,
) -> tuple[Result, Result]:
    """Locate and track as `catch_ball` asks for it: the ball itself judges."""
    located = run_action(
        context.bench, LOCATORS[locator](context, within=asked.pop("within", 0.005))
    )
    assert located.status is Status.SUCCESS and located.deferred, located
    tracked = PREDICTORS[predictor](context, ball=located.values["ball"], **(SPECIFIED | asked))
    return located, run_action(context.bench, tracked)


@pytest.mark.parametrize("latency", [0.012, 0.2, 0.4])
@pytest.mark.parametrize("regime", ["A", "B", "C"])
def test_it_is_measured_where_the_ball_left(
    context: BenchContext, regime: str, latency: float
) -> None:
    """Also from images that come after it has left; the stream ends when it leaves all the same."""
    bench = context.bench
    bench.latency = latency
    bench.ball = draw_ball(np.random.default_rng([7, ord(regime)]), regime)
    _, tracked = judged(context)
    after, y = bench.ball.leaves()
    leaves = after + bench.release
    assert bench.now - tracked.values["left"]["ago"] == pytest.approx(leaves, abs=0.004)
    assert tracked.values["left"]["y"] == pytest.approx(y, abs=0.003)
    assert context.verdicts == [("1", Status.SUCCESS, "")]
    assert context.published[-1][1] is None and abs(context.published[-1][0] - leaves) < 0.03
    assert tracked.status is (Status.FAILURE if tracked.cause == "late" else Status.SUCCESS)
    assert context.device.stopped()


@pytest.mark.parametrize("locator", sorted(LOCATORS))
def test_the_tracker_judges_what_was_located(context: BenchContext, locator: str) -> None:
    context.bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.2)
    located, tracked = judged(context, locator)
    for result in (located, tracked):
        assert result.values["count"] == result.values["images"], "what it costs"
    assert context.verdicts == [("1", Status.SUCCESS, "")]


def test_a_ball_located_beside_its_path_is_inaccurate(context: BenchContext) -> None:
    context.bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.2)
    located = run_action(context.bench, actions.locate_background(context, within=0.005))
    ball = dict(located.values["ball"])
    ball["places"] = [[ago, x, y + 0.006] for ago, x, y in ball["places"]]
    run_action(context.bench, actions.predict_kalman(context, ball=ball, **SPECIFIED))
    assert context.verdicts == [("1", Status.FAILURE, "inaccurate")]


def test_a_ball_that_is_not_seen_again_was_not_there(context: BenchContext) -> None:
    bench = context.bench
    bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.2)
    located = run_action(bench, actions.locate_background(context, within=0.005))
    bench.gone_after = bench.now - bench.release
    tracked = actions.predict_kalman(context, ball=located.values["ball"], **SPECIFIED)
    assert run_action(bench, tracked).cause == "ball_lost"
    assert context.verdicts == [("1", Status.FAILURE, "not_there")]


def test_a_dead_camera_judges_nothing(context: BenchContext) -> None:
    bench = context.bench
    bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.2)
    located = run_action(bench, actions.locate_background(context, within=0.005))
    bench.dead_from = bench.now
    tracked = actions.predict_kalman(context, ball=located.values["ball"], **SPECIFIED)
    assert run_action(bench, tracked).cause == "no_image"
    assert context.verdicts == []


def test_a_tracker_meets_the_specification_as_it_is_written(context: BenchContext) -> None:
    """A predictor that ignores rolling is late for a slow ball, by more than 20 ms; how much it may
    be late is what the task says."""
    context.bench.ball = RolledBall((2.12, 0.1), (0.62, -0.15), 0.9)
    _, tracked = judged(context, predictor="constant_velocity", lead=0.8)
    off = tracked.values["time_spread"]
    assert (tracked.status, tracked.cause) == (Status.FAILURE, "off") and off > 0.020
    context.bench.release = context.bench.now + 0.5
    _, tracked = judged(context, predictor="constant_velocity", lead=0.8, time_within=2.0 * off)
    assert tracked.status is Status.SUCCESS


def test_half_a_specification_is_refused(context: BenchContext) -> None:
    with pytest.raises(ValueError, match="both place_within"):
        run_action(context.bench, actions.predict_kalman(context, ball={}, place_within=0.01))


@pytest.mark.parametrize("locator", sorted(LOCATORS))
def test_no_ball_is_an_error_at_the_timeout(context: BenchContext, locator: str) -> None:
    located = run_action(context.bench, LOCATORS[locator](context, timeout=1.0))
    assert (located.status, located.cause) == (Status.ERROR, "no_ball")
    assert context.bench.now == pytest.approx(1.0, abs=0.03)
    assert located.values["images"] >= 45
    assert context.device.stopped()


def test_dead_camera(context: BenchContext) -> None:
    context.bench.dead_from = 0.0
    located = run_action(context.bench, actions.locate_background(context))
    assert (located.status, located.cause) == (Status.ERROR, "no_image")
    assert context.bench.now == pytest.approx(0.8, abs=0.03)
    assert context.device.stopped()


def test_camera_that_dies_while_tracking(context: BenchContext) -> None:
    context.bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 0.8)
    located = run_action(context.bench, actions.locate_background(context))
    context.bench.dead_from = context.bench.now + 0.3
    tracked = run_action(
        context.bench, actions.predict_kalman(context, ball=located.values["ball"])
    )
    assert (tracked.status, tracked.cause) == (Status.ERROR, "no_image")
    assert context.published[-1][1] is None, "it must be withdrawn, as no action publishes it"
    assert context.device.stopped()


@pytest.mark.parametrize("predictor", sorted(PREDICTORS))
def test_lost_ball(context: BenchContext, predictor: str) -> None:
    context.bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.0)
    context.bench.gone_after = 0.6
    _, tracked = catch(context, predictor)
    assert (tracked.status, tracked.cause) == (Status.ERROR, "ball_lost")
    lost = context.bench.now - context.bench.release - 0.6
    assert 0.15 < lost < 0.30
    assert context.published[-1][1] is None
    assert context.device.stopped()


@pytest.mark.parametrize("predictor", sorted(PREDICTORS))
def test_side_exit(context: BenchContext, predictor: str) -> None:
    context.bench.ball = RolledBall((2.12, 0.1), (1.1, 0.5), 1.4)
    _, tracked = catch(context, predictor)
    assert (tracked.status, tracked.cause) == (Status.FAILURE, "side_exit")
    assert tracked.values["exit"]["point"][1] == pytest.approx(0.45, abs=0.01)
    assert context.published[-1][1] is None
    assert context.device.stopped()


def test_a_ball_that_stops_on_the_table(context: BenchContext) -> None:
    context.bench.ball = RolledBall((2.12, 0.0), (0.62, 0.0), 0.34, spin=1.0)
    _, tracked = catch(context)
    assert (tracked.status, tracked.cause) == (Status.FAILURE, "stays")


def test_arm_and_cup_at_the_edge_do_not_lose_the_ball(context: BenchContext) -> None:
    """The cup waits where the ball leaves and hides its last centimetres."""
    bench = context.bench
    bench.ball = RolledBall((2.12, 0.05), (0.62, 0.05), 1.2)
    bench.cup = np.eye(4)
    bench.cup[:3, 3] = [0.60, 0.05, 0.68]
    bench.arm = (np.array([[[0.1, 0.0, 1.1], [0.62, 0.05, 0.95]]]), [0.05])
    _, tracked = catch(context)
    assert tracked.status is Status.SUCCESS, tracked
    assert tracked.values["seen"] < tracked.values["images"]
    assert max(abs(late) for before, late, _, _ in streamed(context) if before < 0.4) < 0.008


def test_a_person_reaching_over_the_table_is_not_a_ball(context: BenchContext) -> None:
    """An arm that sweeps over the table towards the near edge while there is no ball."""
    bench = context.bench
    advance = bench.advance

    def sweep() -> None:
        x = 2.0 - 1.2 * (bench.now % 1.0)
        bench.arm = (np.array([[[x, -0.6, 0.8], [x, 0.1, 0.75]]]), [0.04])
        advance()

    bench.advance = sweep  # type: ignore[method-assign]
    context.device.background.learn(bench.picture())
    located = run_action(bench, actions.locate_background(context, timeout=1.5))
    assert located.cause == "no_ball"


def test_threshold_fails_in_dim_light_and_the_others_do_not(context: BenchContext) -> None:
    bench = context.bench
    bench.light = lambda time: 0.6
    outcomes = {}
    for name, locate in LOCATORS.items():
        bench.ball, bench.release = RolledBall((2.12, 0.1), (0.62, 0.0), 1.3), bench.now + 0.4
        outcomes[name] = run_action(bench, locate(context, timeout=2.5)).status
        run_action(bench, _pause(context, 2.0))
    assert outcomes.pop("threshold") is Status.ERROR
    assert Status.ERROR not in outcomes.values()


def test_beating_lamps_make_the_stored_background_late_and_the_compensated_one_not(
    context: BenchContext,
) -> None:
    """Balls are released at eight phases of a light that varies by 60 % once a second."""
    bench, late = context.bench, dict.fromkeys(("background", "compensated"), 0)
    bench.light = lambda time: 1.0 + 0.6 * float(np.sin(2.0 * np.pi * time))
    for name in late:
        for phase in range(8):
            run_action(bench, _pause(context, 2.0 - bench.now % 1.0 + phase / 8))
            bench.ball, bench.release = RolledBall((2.12, 0.1), (0.62, 0.0), 2.3), bench.now + 0.4
            located = run_action(bench, LOCATORS[name](context, timeout=2.5))
            late[name] += located.status is not Status.SUCCESS
            context.device.end()
    assert late["compensated"] == 0 < late["background"]


async def _pause(context: BenchContext, seconds: float) -> Result:
    await context.sleep(seconds)
    return Result(Status.SUCCESS)


def test_late_and_inaccurate_locations_are_failures_that_still_give_the_ball(
    context: BenchContext,
) -> None:
    context.bench.ball = RolledBall((2.12, 0.1), (0.62, 0.0), 1.3)
    late = run_action(context.bench, actions.locate_background(context, min_ahead=1.49))
    assert (late.status, late.cause) == (Status.FAILURE, "late") and "ball" in late.values
    context.device.end()
    context.bench.ball, context.bench.release = (
        RolledBall((2.12, 0.1), (0.62, 0.0), 1.3),
        context.bench.now + 0.4,
    )
    coarse = run_action(context.bench, actions.locate_mog2(context, max_residual=0.00005))
    assert (coarse.status, coarse.cause) == (
        Status.FAILURE,
        "inaccurate",
    ) and "ball" in coarse.values


def test_background_is_kept_between_runs(context: BenchContext) -> None:
    """A second run finds a ball that is there from its first image on."""
    bench, rng = context.bench, np.random.default_rng(4)
    bench.ball = draw_ball(rng, "A")
    catch(context)
    known = context.device.background.images
    assert known >= 5
    bench.ball, bench.release = draw_ball(rng, "B"), bench.now
    located = run_action(bench, actions.locate_background(context))
    assert located.status is Status.SUCCESS, located
    assert bench.now - bench.release < 0.2


@pytest.mark.parametrize("stage", ["locate", "track"])
def test_cancel_ends_the_images(context: BenchContext, stage: str) -> None:
    context.bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.0)
    action = actions.locate_background(context)
    if stage == "track":
        located = run_action(context.bench, action)
        action = actions.predict_least_squares(context, ball=located.values["ball"])
    with pytest.raises(Cancelled):
        run_action(context.bench, action, cancel_at=context.bench.now + 0.3)
    assert context.device.stopped()
    assert stage == "locate" or context.published[-1][1] is None


def test_tracker_starts_from_ages_when_the_image_is_not_remembered(context: BenchContext) -> None:
    """To another process of the camera, sequence numbers mean nothing, but ages do."""
    context.bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.2)
    located = run_action(context.bench, actions.locate_background(context))
    fresh = Camera({"source": "sim"}, BenchPorts(context.bench))
    fresh.background = context.device.background
    after = BenchContext(context.bench, fresh)
    tracked = run_action(
        context.bench, actions.predict_least_squares(after, ball=located.values["ball"])
    )
    assert tracked.status is Status.SUCCESS, tracked


@pytest.mark.parametrize(
    "ball",
    [
        {},
        {"sequence": 1, "age": 0.1, "sigma": 0.001, "places": []},
        {"sequence": 1, "age": 0.1, "sigma": 0.001, "places": [[0.0, 2.0]]},
        {"sequence": "x", "age": 0.1, "sigma": 0.001, "places": [[0.0, 2.0, 0.0]] * 3},
        {"sequence": 1, "age": None, "sigma": 0.001, "places": [[0.0, 2.0, 0.0]] * 3},
    ],
)
def test_malformed_ball_data_is_refused(context: BenchContext, ball: Mapping[str, Any]) -> None:
    tracked = run_action(context.bench, actions.predict_least_squares(context, ball=ball))
    assert (tracked.status, tracked.cause) == (Status.ERROR, "bad_ball")
    assert not [values for _, values in context.published if values]


@pytest.mark.parametrize(
    ("option", "value"), [("timeot", 1.0), ("timeout", -1.0), ("timeout", "3"), ("rate", True)]
)
def test_bad_options_are_refused_by_name(context: BenchContext, option: str, value: Any) -> None:
    with pytest.raises(ValueError, match=option):
        run_action(context.bench, actions.locate_background(context, **{option: value}))


def test_results_are_plain_data(context: BenchContext) -> None:
    import msgpack

    context.bench.ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.2)
    for result in catch(context):
        assert msgpack.unpackb(msgpack.packb(dict(result.values))) == result.values


def test_images_of_another_size_are_refused(pinhole: PinholeCamera) -> None:
    class Small(CameraBench):
        def picture(self) -> Any:
            return super().picture()[::2, ::2]

    bench = Small(pinhole)
    context = BenchContext(bench, Camera({"source": "sim"}, BenchPorts(bench)))
    located = run_action(bench, actions.locate_background(context))
    assert (located.status, located.cause) == (Status.ERROR, "bad_image")
    assert "320x240" in located.text and "640x480" in located.text


def test_the_same_seed_gives_the_same_stream(pinhole: PinholeCamera) -> None:
    streams = []
    for _ in range(2):
        pinhole.reseed(np.random.default_rng(3))
        bench = CameraBench(pinhole, draw_ball(np.random.default_rng(5), "B"))
        context = BenchContext(bench, Camera({"source": "sim"}, BenchPorts(bench)))
        catch(context)
        streams.append(context.published)
    assert streams[0] == streams[1]
