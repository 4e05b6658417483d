"""The track: what every track keeps to, its centre line, the nearest point, the colour of the
floor."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from petrobot.sim.track.course import (
    BAR_LENGTH,
    BAR_MARGIN,
    BOARD,
    HALF_WIDTH,
    KINDS,
    SQUARE,
    Element,
    ElementKind,
    Track,
    TrackError,
)
from petrobot.sim.track.floor import COARSE, FINE, ORIGIN, Floor

tracks = st.builds(
    Track.by_seed,
    st.integers(0, 10_000),
    st.integers(8, 24),
    st.integers(0, 2),
    st.sampled_from(["straight", "arcs", "mixed"]),
    st.floats(0.3, 0.7),
)


def angle(a: float) -> float:
    """An angle between -pi and pi."""
    return math.remainder(a, 2.0 * math.pi)


# Every track


@given(tracks)
@settings(max_examples=60, deadline=None)
def test_random_tracks_keep_to_the_rules(track: Track) -> None:
    squares = [element.square for element in track.elements]
    assert len(set(squares)) == len(squares)
    assert all(0 <= i < BOARD and 0 <= j < BOARD for i, j in squares)
    assert all(abs(i - k) + abs(j - m) == 1 for (i, j), (k, m) in pairwise(squares))
    assert track.elements[-1].next_square not in squares
    assert track.elements[0].kind is track.elements[-1].kind is ElementKind.STRAIGHT
    unpainted = [number for number, element in enumerate(track.elements) if not element.painted]
    assert all(b - a >= 3 for a, b in pairwise([-1, *unpainted, len(squares)]))


@given(tracks)
@settings(max_examples=40, deadline=None)
def test_the_centre_line_is_connected_smooth_and_as_long_as_its_elements(track: Track) -> None:
    for before, after in pairwise(track.elements):
        exit_pose, entry = before.at(before.kind.length), after.at(0.0)
        assert (exit_pose.x, exit_pose.y) == pytest.approx((entry.x, entry.y), abs=1e-12)
        assert angle(exit_pose.heading - entry.heading) == pytest.approx(0.0, abs=1e-12)
    s = np.linspace(0.0, track.length, 3000)
    poses = [track.at(each) for each in s.tolist()]
    chords = [math.hypot(b.x - a.x, b.y - a.y) for a, b in pairwise(poses)]
    assert sum(chords) == pytest.approx(track.length, rel=1e-5)
    step = float(s[1])
    bends = [abs(angle(b.heading - a.heading)) / step for a, b in pairwise(poses)]
    assert max(bends) <= 1.0 + 1e-9  # curvature of a radius of 1 m, no kink


@given(st.integers(0, 10_000), st.sampled_from(["straight", "arcs", "mixed"]), st.integers(1, 3))
@settings(max_examples=40, deadline=None)
def test_interruptions_are_of_the_kind_asked_for(seed: int, kinds: str, count: int) -> None:
    track = Track.by_seed(seed, 16, count, kinds)
    replaced = [element for element in track.elements if not element.painted]
    assert len(replaced) == len(track.gaps) == count
    assert all(element.kind in KINDS[kinds] for element in replaced)
    for gap, element in zip(track.gaps, replaced, strict=True):
        resumes = track.at(gap.end)
        assert (gap.x, gap.y) == pytest.approx((resumes.x, resumes.y), abs=1e-9)
        assert gap.end - gap.start == pytest.approx(element.kind.length)


@given(tracks)
@settings(max_examples=20, deadline=None)
def test_a_track_is_read_again_from_its_plain_data(track: Track) -> None:
    again = Track.read(track.plain())
    assert again.elements == track.elements
    assert Track.of(*_parts(track)).gaps == track.gaps


def _parts(track: Track) -> tuple[tuple[int, int], int, str, tuple[int, ...]]:
    plain = track.plain()
    i, j = plain["square"]
    return (i, j), plain["heading"], plain["elements"], tuple(plain["unpainted"])


def test_a_seed_gives_one_track_and_another_seed_another() -> None:
    assert Track.by_seed(11).plain() == Track.by_seed(11).plain()
    assert len({str(Track.by_seed(seed).plain()) for seed in range(20)}) == 20


def test_the_share_of_arcs_is_what_is_asked_for() -> None:
    def arcs(share: float) -> float:
        letters = "".join(
            Track.by_seed(seed, 14, 0, "mixed", share).plain()["elements"] for seed in range(60)
        )
        return 1.0 - letters.count("S") / len(letters)

    assert arcs(0.1) < 0.35 < arcs(0.5) < 0.6 < arcs(1.0)


def test_the_competition_like_track_is_valid_and_has_everything() -> None:
    track = Track.contest()
    kinds = {element.kind for element in track.elements if element.painted}
    assert kinds == {ElementKind.STRAIGHT, ElementKind.LEFT, ElementKind.RIGHT}
    assert {element.kind for element in track.elements if not element.painted} == kinds
    assert track.length > 40.0


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Track.of((0, 0), 0, "LS"), "begin and end with a straight"),
        (lambda: Track.of((0, 0), 0, "SSL"), "begin and end with a straight"),
        (lambda: Track.of((0, 0), 2, "SS"), "leaves the board"),
        (lambda: Track.of((2, 2), 0, "SLLLS"), "uses a square twice"),
        (lambda: Track.of((2, 2), 0, "SSSLSLLS"), "not free"),
        (lambda: Track.of((0, 0), 0, "SSXS"), "'X'"),
        (lambda: Track.of((0, 0), 0, "SSSSSS", (1,)), "interruptions [1]"),
        (lambda: Track.of((0, 1), 0, "SSSSSSS", (2, 4)), "interruptions [2, 4]"),
        (lambda: Track.by_seed(1, 4), "4 elements"),
        (lambda: Track.by_seed(1, 41), "41 elements"),
        (lambda: Track.by_seed(1, 10, -1), "-1 interruptions"),
        (lambda: Track.by_seed(1, 10, 1, "curves"), "'curves'"),
        (lambda: Track.by_seed(1, 10, 1, "arcs", 2.0), "share of arcs"),
        (lambda: Track.by_seed(1, 8, 5), "fewer"),
    ],
)
def test_an_invalid_track_is_refused(make: object, text: str) -> None:
    assert callable(make)
    with pytest.raises(TrackError) as refusal:
        make()
    assert text in str(refusal.value)


# Centre line


@given(tracks, st.floats(0.0, 1.0), st.floats(-0.45, 0.45))
@settings(max_examples=150, deadline=None)
def test_the_nearest_point_of_a_point_aside_is_where_it_came_from(
    track: Track, share: float, offset: float
) -> None:
    s = share * track.length
    x, y, heading = track.at(s)
    near = track.nearest(x - offset * math.sin(heading), y + offset * math.cos(heading))
    assert near.distance == pytest.approx(abs(offset), abs=1e-9)
    assert near.s == pytest.approx(s, abs=1e-6)
    assert near.offset == pytest.approx(offset, abs=1e-9)


@given(tracks, st.floats(-1.0, 17.0), st.floats(-1.0, 17.0))
@settings(max_examples=60, deadline=None)
def test_no_point_of_the_line_is_nearer_than_the_nearest(track: Track, x: float, y: float) -> None:
    near = track.nearest(x, y)
    ends = track.elements[-1].at(SQUARE)
    line = np.array(
        [track.at(s)[:2] for s in np.linspace(0.0, track.length + BAR_MARGIN, 1500).tolist()]
    )
    least = float(np.hypot(line[:, 0] - x, line[:, 1] - y).min())
    assert near.distance <= least + 1e-9
    assert near.distance >= least - 0.02
    assert near.distance <= math.hypot(ends.x - x, ends.y - y) + 1e-9


def test_the_line_continues_straight_before_the_start_and_after_the_end() -> None:
    element = Element(ElementKind.LEFT, (0, 0), 0, 0.0)
    assert element.at(-0.5) == pytest.approx((-0.5, 1.0, 0.0))
    assert element.at(math.pi / 2 + 0.5) == pytest.approx((1.0, 2.5, math.pi / 2))


# Floor


@given(tracks)
@settings(max_examples=20, deadline=None)
def test_the_floor_has_the_track_in_the_opposite_colour(track: Track) -> None:
    for s in np.linspace(0.01, track.length - 0.1, 60).tolist():
        element = track.elements[track.element_at(s)]
        own = (element.square[0] + element.square[1]) % 2 == 0
        x, y, heading = track.at(s)
        aside = np.array(
            [0.0, HALF_WIDTH - 0.002, HALF_WIDTH + 0.002, -HALF_WIDTH + 0.002, -HALF_WIDTH - 0.002]
        )
        seen = track.floor(x - aside * math.sin(heading), y + aside * math.cos(heading)).tolist()
        plain = int(own)
        if abs(s - element.start) < 0.01 or abs(s - element.end) < 0.01:
            continue  # points beside the line may lie in the next square
        mark = 1 - plain if element.painted else plain
        assert seen == [mark, mark, plain, mark, plain]


def test_the_t_stands_on_paint_of_one_colour() -> None:
    track = Track.of((0, 0), 0, "SSSS")
    along = track.length - 0.025
    floor = track.floor
    background = int(floor(along, 1.0 + 0.5 * BAR_LENGTH + 0.01))
    assert int(floor(along, 1.0 + 0.5 * BAR_LENGTH - 0.01)) == 1 - background
    assert int(floor(along, 1.0 - 0.5 * BAR_LENGTH + 0.01)) == 1 - background
    assert int(floor(along - 0.1, 1.0)) == 1 - background
    assert int(floor(along - 0.1, 1.1)) == background
    assert {int(floor(track.length + beyond, 1.0)) for beyond in (0.01, 0.1, 0.24)} == {background}


@pytest.mark.parametrize("seed", [1, 2])
def test_the_floors_pictures_show_the_floor(seed: int) -> None:
    floor, track = Floor(), Track.by_seed(seed)
    floor.paint(Track.contest())
    floor.paint(track)
    rng = np.random.default_rng(seed)
    columns, rows = (
        rng.integers(0, floor.fine.shape[1], 20_000),
        rng.integers(0, floor.fine.shape[0], 20_000),
    )
    truth = track.floor(ORIGIN + (columns + 0.5) * FINE, ORIGIN + (rows + 0.5) * FINE)
    assert np.array_equal(floor.fine[rows, columns] > 127, truth == 1)
    n = round(COARSE / FINE)
    means = floor.fine.reshape(floor.coarse.shape[0], n, floor.coarse.shape[1], n).mean(axis=(1, 3))
    assert np.abs(means - floor.coarse).max() <= 1.0
