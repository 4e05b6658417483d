"""The referee on constructed paths: what counts as left, recovered, finished, stopped."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any

import pytest

from petrobot.sim.track.course import FloorPose, Track
from petrobot.sim.track.referee import MOST_ROWS, TrackReferee

TRACK = Track.of((0, 3), 0, "SSSSSSS", (3,))  # along y = 7 from x = 0; no paint from x = 6 to x = 8
DT, SPEED = 0.02, 0.5


def ride(
    points: Iterable[tuple[float, float]], track: Track = TRACK, stand: float = 1.0
) -> tuple[TrackReferee, float]:
    """Move past points (m) in straight lines at a constant speed, then stand; return referee and
    time."""
    referee, now, at = TrackReferee(track, 1, "straight", 0.0), 0.0, None
    for x, y in points:
        if at is None:
            at = x, y
            referee.watch(now, FloorPose(x, y, 0.0), 0.0)
            continue
        way = math.hypot(x - at[0], y - at[1])
        for k in range(1, max(1, round(way / (SPEED * DT))) + 1):
            share = k / max(1, round(way / (SPEED * DT)))
            now += DT
            referee.watch(
                now, FloorPose(at[0] + share * (x - at[0]), at[1] + share * (y - at[1]), 0.0), SPEED
            )
        at = x, y
    assert at is not None
    for _ in range(round(stand / DT)):
        now += DT
        referee.watch(now, FloorPose(*at, 0.0), 0.0)
    return referee, now


def kinds(score: dict[str, Any]) -> list[str]:
    return [each["kind"] for each in score["penalties"]]


def test_a_clean_run() -> None:
    referee, now = ride([(0.0, 7.0), (13.8, 7.0)], stand=3.0)
    score = referee.score(now)
    assert score["finished"]
    assert score["stopped_at_T"]
    assert score["penalties"] == []
    assert (score["interruptions"], score["recovered"]) == (1, 1)
    assert score["time_s"] == pytest.approx(13.8 / SPEED, abs=0.1)  # standing there does not count
    assert (score["rms_mm"], score["max_mm"]) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert score["length_m"] == pytest.approx(13.75)
    assert score["way_m"] == pytest.approx(13.8, abs=0.02)
    (crossing,) = score["crossings"]
    assert crossing["took_s"] == pytest.approx(2.0 / SPEED, abs=0.05)
    assert crossing["kind"] == "straight"


def test_errors_count_by_distance_on_painted_elements_only() -> None:
    referee, now = ride(
        [(0.0, 7.0), (0.02, 7.01), (6.0, 7.01), (6.5, 7.08), (8.0, 7.02), (13.8, 7.02)]
    )
    score = referee.score(now)
    assert score["rms_mm"] == pytest.approx(math.sqrt((6 * 10**2 + 5.65 * 20**2) / 11.65), rel=0.02)
    assert score["max_mm"] == pytest.approx(20.0, abs=0.5)
    assert score["crossings"][0]["aside_m"] == pytest.approx(0.08, abs=0.003)


def test_standing_at_a_bad_place_does_not_count() -> None:
    quick, now = ride([(0.0, 7.0), (3.0, 7.05)], stand=0.0)
    slow, later = ride([(0.0, 7.0), (3.0, 7.05)], stand=60.0)
    assert quick.score(now)["rms_mm"] == slow.score(later)["rms_mm"]


@pytest.mark.parametrize(
    ("points", "recovered", "penalties"),
    [
        ([(6.0, 7.0), (7.0, 7.4), (8.5, 7.05), (13.8, 7.0)], 1, []),  # a wide way round
        ([(6.0, 7.0), (8.0, 7.5), (8.95, 7.05), (13.8, 7.0)], 1, []),  # just in time
        ([(6.0, 7.0), (8.0, 7.5), (9.1, 7.2), (9.5, 7.0), (13.8, 7.0)], 0, ["interruption_missed"]),
        ([(6.0, 7.0), (7.0, 8.5)], 0, ["interruption_missed"]),  # never found again
        ([(6.0, 7.0), (6.8, 7.0), (5.5, 7.2), (6.8, 7.0), (13.8, 7.0)], 1, []),  # back and on
    ],
)
def test_interruptions(
    points: list[tuple[float, float]], recovered: int, penalties: list[str]
) -> None:
    referee, now = ride([(0.0, 7.0), *points])
    score = referee.score(now)
    assert score["recovered"] == recovered
    assert kinds(score) == penalties


def test_leaving_the_track_counts_once_each_time() -> None:
    referee, now = ride(
        [
            (0.0, 7.0),
            (1.0, 7.0),
            (1.5, 7.5),
            (2.0, 7.5),
            (2.5, 7.0),
            (3.0, 7.0),
            (3.5, 7.4),
            (4.0, 7.0),
            (5.0, 7.0),
        ]
    )
    score = referee.score(now)
    assert kinds(score) == ["track_left", "track_left"]
    assert not score["finished"]
    assert score["penalties"][0]["x"] == pytest.approx(1.3, abs=0.03)
    assert score["max_mm"] <= 300.0


def test_an_interruption_that_is_left_out_is_missed() -> None:
    referee, now = ride([(0.0, 7.0), (4.0, 7.0), (4.0, 8.0), (10.0, 8.0), (10.5, 7.0), (13.8, 7.0)])
    score = referee.score(now)
    assert kinds(score) == ["track_left", "interruption_missed"]
    assert score["recovered"] == 0
    assert score["finished"]


@pytest.mark.parametrize(
    ("end", "finished", "stopped", "penalties"),
    [
        (13.60, False, False, []),  # short of the T
        (13.66, True, True, []),
        (14.04, True, True, []),
        (14.10, True, False, ["not_stopped"]),
        (15.50, True, False, ["not_stopped"]),
    ],
)
def test_where_it_must_stop(
    end: float, finished: bool, stopped: bool, penalties: list[str]
) -> None:
    referee, now = ride([(0.0, 7.0), (end, 7.0)])
    score = referee.score(now)
    assert (score["finished"], score["stopped_at_T"], kinds(score)) == (
        finished,
        stopped,
        penalties,
    )


def test_a_run_scored_while_the_rover_still_moves_has_not_stopped() -> None:
    referee, now = ride([(0.0, 7.0), (13.9, 7.0)], stand=0.2)
    score = referee.score(now)
    assert score["finished"]
    assert kinds(score) == ["not_stopped"]
    assert kinds(referee.score(now)) == ["not_stopped"]  # asking does not add to it
    assert referee.penalties == []


def test_coming_back_after_running_over_the_t_does_not_count_as_stopping() -> None:
    referee, now = ride([(0.0, 7.0), (14.5, 7.0), (13.8, 7.0)])
    score = referee.score(now)
    assert not score["stopped_at_T"]
    assert kinds(score) == ["not_stopped"]


def test_a_rover_that_leaves_the_board_is_stopped_once() -> None:
    referee, now = TrackReferee(TRACK, 1, "straight", 0.0), 0.0
    told = []
    for k in range(1200):
        now += DT
        told.append(referee.watch(now, FloorPose(0.01 * k, 7.0 + 0.01 * k, 0.0), SPEED))
    assert told.count(True) == 1
    score = referee.score(now)
    assert kinds(score) == ["track_left", "left_board"]
    assert score["penalties"][1]["y"] == pytest.approx(17.0, abs=0.02)


def test_the_clock_starts_with_the_first_motion() -> None:
    referee = TrackReferee(TRACK, 1, "straight", 5.0)
    for k in range(500):
        referee.watch(5.0 + k * DT, FloorPose(0.0, 7.0, 0.0), 0.0)
    assert referee.score(15.0)["time_s"] == 0.0
    referee.watch(15.0, FloorPose(0.02, 7.0, 0.0), 0.5)
    assert referee.score(16.0)["time_s"] == pytest.approx(1.0)


def test_the_path_is_thinned_out(rover_bench: Callable[..., Any]) -> None:
    referee, now = ride([(0.0, 7.0), (5.0, 7.0)])
    path = referee.score(now)["path"]
    assert len(path) == pytest.approx(now / 0.2, abs=2)
    assert path[0] == [0.0, 0.0, 7.0, 0.0]
    assert path[-1][1] == pytest.approx(5.0, abs=0.1)


def test_another_part_of_the_track_is_not_a_short_cut() -> None:
    """Where two parts run 2 m apart, crossing over to the later one skips what lies between."""
    track = Track.of((1, 1), 0, "SSSSLLSSSS", (3,))
    referee, now = ride([(2.0, 3.0), (5.0, 3.0), (5.0, 5.0), (3.0, 5.0)], track)
    score = referee.score(now)
    assert kinds(score) == ["track_left", "interruption_missed"]


def test_the_path_of_a_rover_that_stands_for_hours_stays_short() -> None:
    referee = TrackReferee(TRACK, 1, "straight", 0.0)
    for k in range(5 * 3 * 3600):
        referee.watch(0.2 * k, FloorPose(0.0, 7.0, 0.0), 0.0)
    times = [row[0] for row in referee.score(3 * 3600.0)["path"]]
    assert MOST_ROWS / 2 <= len(times) <= MOST_ROWS
    assert times[0] == 0.0 and times[-1] > 3 * 3600 - 10
    gaps = [b - a for a, b in pairwise(times)]
    assert max(gaps) <= 2.0 * min(gaps) + 1e-9
