"""Predictors against an analytic ball that slides, then rolls with an unknown resistance: accuracy,
stated uncertainty, and balls that leave elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from petrobot.services.vision.prediction import (
    ConstantVelocity,
    ExitWay,
    Kalman,
    LeastSquares,
    PredictedExit,
    Predictor,
    Surface,
)
from tests.vision.bench import RolledBall, draw_ball, read_cell

SURFACE = Surface.of(read_cell())
PREDICTORS: dict[str, Callable[[Surface], Predictor]] = {
    "constant_velocity": ConstantVelocity,
    "least_squares": LeastSquares,
    "kalman": Kalman,
}
NOISE = 0.0003


def watch(
    predictor: Predictor, ball: RolledBall, count: int, rate: float, rng: np.random.Generator
) -> PredictedExit:
    """Return the exit predicted after `count` images, the first within one image of the release."""
    first = float(rng.uniform(0.0, 1.0 / rate))
    for k in range(count):
        t = first + k / rate
        predictor.add(t, *(ball.place(t) + rng.normal(0.0, NOISE, 2)))
    exit_ = predictor.exit()
    assert exit_ is not None
    return exit_


def errors(
    name: str, regime: str, count: int, rate: float, throws: int = 60
) -> tuple[float, float, float]:
    """Return the rms errors of time (s) and position (m) over throws, and the rms of the time error
    divided by its stated sigma."""
    rng, times, places, stated = np.random.default_rng(17), [], [], []
    for _ in range(throws):
        ball = draw_ball(rng, regime)
        exit_ = watch(PREDICTORS[name](SURFACE), ball, count, rate, rng)
        time, y = ball.leaves()
        assert exit_.way is ExitWay.NEAR_EDGE
        times.append(exit_.time - time)
        places.append(exit_.point[1] - y)
        stated.append((exit_.time - time) / exit_.sigma_time)
    rms = [float(np.sqrt(np.mean(np.square(values)))) for values in (times, places, stated)]
    return rms[0], rms[1], rms[2]


@pytest.mark.parametrize(
    ("name", "regime", "count", "rate", "time", "place"),
    [
        # 8 images at 25 Hz
        ("constant_velocity", "A", 8, 25, 0.172, 0.025),
        ("least_squares", "A", 8, 25, 0.028, 0.0026),
        ("kalman", "A", 8, 25, 0.034, 0.0026),
        ("least_squares", "B", 8, 25, 0.004, 0.002),
        ("kalman", "B", 8, 25, 0.006, 0.002),
        ("least_squares", "C", 8, 25, 0.002, 0.0015),
        ("kalman", "C", 8, 25, 0.004, 0.0015),
        # the same at 50 Hz: half the time span
        ("least_squares", "A", 8, 50, 0.036, 0.005),
        ("least_squares", "C", 8, 50, 0.007, 0.0025),
        ("least_squares", "C", 16, 50, 0.002, 0.001),
        ("kalman", "C", 16, 50, 0.003, 0.001),
        ("constant_velocity", "C", 16, 50, 0.008, 0.002),
    ],
)
def test_accuracy(
    name: str, regime: str, count: int, rate: float, time: float, place: float
) -> None:
    time_error, place_error, _ = errors(name, regime, count, rate)
    assert time_error <= time
    assert place_error <= place


@pytest.mark.parametrize("regime", ["A", "B", "C"])
def test_more_effort_is_more_accurate(regime: str) -> None:
    late = {name: errors(name, regime, 12, 50)[0] for name in PREDICTORS}
    assert late["least_squares"] < 0.6 * late["constant_velocity"]
    assert late["least_squares"] <= 1.1 * late["kalman"]


@pytest.mark.parametrize(
    ("name", "least", "most"), [("least_squares", 0.4, 1.4), ("kalman", 0.25, 2.4)]
)
@pytest.mark.parametrize("count", [6, 10, 20])
def test_stated_uncertainty_is_correct(name: str, least: float, most: float, count: int) -> None:
    """A predictor's sigma of the time covers its errors without being much too large, in slow and
    fast regimes."""
    for regime in ("A", "C"):
        assert least <= errors(name, regime, count, 50)[2] <= most


def test_constant_speed_underestimates_its_error() -> None:
    assert errors("constant_velocity", "A", 12, 50)[2] > 5.0


@given(
    speed=st.floats(0.8, 2.5),
    y=st.floats(-0.25, 0.25),
    aim=st.floats(-0.25, 0.25),
    name=st.sampled_from(sorted(PREDICTORS)),
)
@settings(max_examples=60, deadline=None)
def test_exact_places_of_a_purely_rolling_ball_are_enough(
    speed: float, y: float, aim: float, name: str
) -> None:
    ball = RolledBall((2.0, y), (0.62, aim), speed, spin=1.0, rolling=SURFACE.rolling)
    predictor = PREDICTORS[name](SURFACE)
    for k in range(25):
        predictor.add(0.02 * k, *ball.place(0.02 * k))
    exit_ = predictor.exit()
    assert exit_ is not None and exit_.way is ExitWay.NEAR_EDGE
    time, place = ball.leaves()
    slack = (
        0.2 * time**2 * 0.0589 / speed + 0.5 * 0.0589 * time**2 / speed
        if name == "constant_velocity"
        else 0.004
    )
    assert abs(exit_.time - time) < slack + 0.002
    assert exit_.point == pytest.approx([0.62, place], abs=1e-3)
    assert np.hypot(*exit_.velocity) == pytest.approx(
        ball.way(time)[1], abs=0.15 if slack > 0.005 else 0.02
    )
    assert predictor.place(0.5) == pytest.approx(ball.place(0.5), abs=2e-3)
    assert predictor.count == 25


@pytest.mark.parametrize("name", sorted(PREDICTORS))
def test_a_ball_that_leaves_by_the_side(name: str) -> None:
    ball = RolledBall((2.1, 0.1), (1.0, 0.6), 1.5)
    exit_ = watch(PREDICTORS[name](SURFACE), ball, 12, 50, np.random.default_rng(0))
    assert exit_.way is ExitWay.SIDE
    way = (0.45 - 0.1) / ball.heading[1]
    assert exit_.point == pytest.approx([2.1 + way * ball.heading[0], 0.45], abs=0.02)
    assert exit_.time == pytest.approx(ball.arrival(way), abs=0.08)


@pytest.mark.parametrize("name", ["least_squares", "kalman"])
def test_a_ball_that_stops_before_the_edge(name: str) -> None:
    ball = RolledBall((2.1, 0.0), (0.62, 0.0), 0.30, spin=1.0)
    exit_ = watch(PREDICTORS[name](SURFACE), ball, 30, 50, np.random.default_rng(0))
    assert exit_.way is ExitWay.STAYS and exit_.time == float("inf")


@pytest.mark.parametrize("name", sorted(PREDICTORS))
def test_a_ball_that_rolls_away_never_leaves_over_the_near_edge(name: str) -> None:
    predictor = PREDICTORS[name](SURFACE)
    for k in range(10):
        predictor.add(0.02 * k, 1.0 + 0.02 * k, 0.0)
    exit_ = predictor.exit()
    assert exit_ is not None and exit_.way is ExitWay.STAYS


@pytest.mark.parametrize("name", sorted(PREDICTORS))
def test_nothing_is_predicted_from_two_places(name: str) -> None:
    predictor = PREDICTORS[name](SURFACE)
    assert predictor.exit() is None
    predictor.add(0.0, 2.0, 0.0)
    predictor.add(0.02, 1.97, 0.0)
    assert predictor.exit() is None
    assert predictor.place(0.04) == pytest.approx([1.94, 0.0], abs=0.01)


@pytest.mark.parametrize("friction", [0.1, 0.2, 0.4])
def test_sliding_of_unknown_length_is_found(friction: float) -> None:
    """The friction decides how long a ball slides; least squares averages over the possible ends of
    sliding."""
    rng, late = np.random.default_rng(3), []
    for _ in range(40):
        ball = RolledBall(
            (2.12, 0.0),
            (0.62, float(rng.uniform(-0.3, 0.3))),
            float(rng.uniform(1.5, 2.5)),
            0.7,
            0.0589,
            friction,
        )
        exit_ = watch(LeastSquares(SURFACE), ball, 18, 50, rng)
        late.append(exit_.time - ball.leaves()[0])
    assert float(np.sqrt(np.mean(np.square(late)))) < 0.006


def test_a_wrong_known_resistance_biases_only_the_predictor_that_uses_it() -> None:
    """With a resistance 25 % from nominal, a predictor that uses the nominal value is biased; one
    that estimates it is not."""
    ball = RolledBall((2.12, 0.0), (0.62, 0.0), 0.9, spin=1.0, rolling=1.25 * SURFACE.rolling)
    time, errors_of = ball.leaves()[0], {}
    for sigma in (0.0, None):
        rng = np.random.default_rng(4)
        predictor = LeastSquares(SURFACE, rolling_sigma=sigma)
        errors_of[sigma] = abs(watch(predictor, ball, 50, 50, rng).time - time)
    assert errors_of[None] < 0.5 * errors_of[0.0]


@pytest.mark.parametrize("make", [LeastSquares, Kalman])
def test_inaccurate_positions_have_less_weight(make: Callable[[Surface], Predictor]) -> None:
    """Inaccurate positions at the start (from a coarse locator) do not spoil the accurate ones that
    follow."""
    ball = RolledBall((2.12, 0.0), (0.62, 0.1), 1.8)
    spoiled: list[float] = []
    plain: list[float] = []
    for seed in range(20):
        for told, found in ((0.004, spoiled), (None, plain)):
            rng = np.random.default_rng(seed)
            predictor = make(SURFACE)
            for k in range(14):
                sigma = 0.004 if k < 4 else NOISE
                x, y = ball.place(0.02 * k) + rng.normal(0, sigma, 2)
                predictor.add(0.02 * k, x, y, told if k < 4 else None)
            exit_ = predictor.exit()
            assert exit_ is not None
            found.append(exit_.time - ball.leaves()[0])
    assert np.std(spoiled) < 0.75 * np.std(plain)


def test_cost_of_an_observation_does_not_grow() -> None:
    """Least squares keeps sums, not positions."""
    predictor: Any = LeastSquares(SURFACE)
    for k in range(3):
        predictor.add(0.02 * k, 2.0 - 0.02 * k, 0.0)
    size = {
        name: np.size(value)
        for name, value in vars(predictor).items()
        if isinstance(value, np.ndarray)
    }
    for k in range(3, 300):
        predictor.add(0.02 * k, 2.0 - 0.004 * k, 0.0)
    assert size == {
        name: np.size(value)
        for name, value in vars(predictor).items()
        if isinstance(value, np.ndarray)
    }


def test_gap_of_the_surface() -> None:
    gap, way = SURFACE.gap(np.array([1.62, 0.0]), np.array([-1.0, 0.0]))
    assert way is ExitWay.NEAR_EDGE and gap == pytest.approx(1.0)
    gap, way = SURFACE.gap(np.array([1.62, 0.0]), np.array([-0.6, 0.8]))
    assert way is ExitWay.SIDE and gap == pytest.approx(0.45 / 0.8)
    assert SURFACE.gap(np.array([1.62, 0.0]), np.array([1.0, 0.0])) == (float("inf"), ExitWay.STAYS)
