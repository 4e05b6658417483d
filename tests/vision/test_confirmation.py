"""Which sequences of candidates confirm a rolling ball, and which do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot.services.vision.locating import BallTrack, Confirmation

STICKERS = [(0.87, 0.22), (1.42, 0.36), (1.92, 0.28), (1.42, -0.20)]


def follow(
    confirmation: Confirmation, places: list[list[tuple[float, float]]], step: float = 0.02
) -> list[BallTrack | None]:
    """Feed candidates image by image."""
    return [confirmation.add(k * step, found) for k, found in enumerate(places)]


@given(
    speed=st.floats(0.4, 3.0),
    slope=st.floats(-0.25, 0.25),
    y=st.floats(-0.3, 0.3),
    count=st.integers(3, 7),
    seed=st.integers(0, 1000),
)
def test_a_rolling_ball_is_confirmed_after_the_required_number_of_sightings(
    speed: float, slope: float, y: float, count: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    way = speed * 0.02
    places = [
        [(2.0 - k * way + rng.normal(0, 5e-4), y + slope * k * way + rng.normal(0, 5e-4))]
        for k in range(count + 4)
    ]
    answers = follow(Confirmation(count), places)
    first = next(k for k, track in enumerate(answers) if track is not None)
    assert first >= count - 1
    if speed * 0.02 * (count - 1) > 0.04:
        assert first == count - 1
    track = answers[first]
    assert track is not None
    assert track.residual < 2e-3
    assert len(track.times) == len(track.places) >= count


def test_objects_at_rest_are_never_a_ball() -> None:
    rng = np.random.default_rng(0)
    places = [
        [(x + rng.normal(0, 2e-3), y + rng.normal(0, 2e-3)) for x, y in STICKERS]
        for _ in range(200)
    ]
    assert not any(follow(Confirmation(4), places))


def test_a_ball_among_stickers_is_found() -> None:
    rng = np.random.default_rng(1)
    places = [
        [
            *((x + rng.normal(0, 2e-3), y + rng.normal(0, 2e-3)) for x, y in STICKERS),
            (2.1 - 0.03 * k, 0.1 + 0.001 * k),
        ]
        for k in range(8)
    ]
    track = next(track for track in follow(Confirmation(4), places) if track is not None)
    assert np.abs(track.places[:, 1] - 0.1).max() < 0.01


def test_scattered_candidates_are_not_a_ball() -> None:
    rng = np.random.default_rng(2)
    places = [
        [(float(x), float(y)) for x, y in rng.uniform([0.7, -0.4], [2.1, 0.4], (2, 2))]
        for _ in range(100)
    ]
    assert sum(track is not None for track in follow(Confirmation(5), places)) <= 1


@pytest.mark.parametrize("velocity", [(1.5, 0.0), (0.0, 1.0), (-0.1, 0.0), (-6.0, 0.0)])
def test_an_object_that_does_not_roll_towards_the_edge_is_not_a_ball(
    velocity: tuple[float, float],
) -> None:
    places = [[(1.4 + velocity[0] * 0.02 * k, velocity[1] * 0.02 * k)] for k in range(8)]
    assert not any(follow(Confirmation(4), places))


def test_missed_images_do_not_end_a_track_at_once() -> None:
    places = [[(2.0 - 0.03 * k, 0.0)] if k not in (2, 3) else [] for k in range(7)]
    answers = follow(Confirmation(4), places)
    assert [track is not None for track in answers] == [False] * 5 + [True, True]
    places = [[(2.0 - 0.03 * k, 0.0)] if k < 3 or k > 7 else [] for k in range(11)]
    assert not any(follow(Confirmation(4), places)), "four missed images end it"
