"""The retroreflector sensor: what it sees, how accurately, and its false returns."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from petrobot.sim.track.course import FloorPose
from petrobot.sim.track.drives import look
from petrobot.sim.track.truth import SensorTruth, TrackSite

PERFECT = SensorTruth(
    forward=0.1,
    below=0.3,
    half_angle=1.047,
    range=6.0,
    fan=0.524,
    bearing_offset=0.0,
    range_offset=0.0,
    bearing_noise=0.0,
    range_noise=0.0,
    step=1e-9,
    miss=0.0,
    false=0.0,
    false_range=(0.5, 6.0),
)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@given(
    st.floats(-5.0, 5.0),
    st.floats(-5.0, 5.0),
    st.floats(-3.1, 3.1),
    st.floats(0.55, 5.9),
    st.floats(-1.04, 1.04),
)
@settings(max_examples=80, deadline=None)
def test_bearing_and_range_from_any_pose(
    x: float, y: float, heading: float, level: float, bearing: float
) -> None:
    there = (
        x + 0.1 * math.cos(heading) + level * math.cos(heading + bearing),
        y + 0.1 * math.sin(heading) + level * math.sin(heading + bearing),
    )
    (echo,) = look(PERFECT, FloorPose(x, y, heading), [there], rng())
    assert echo.bearing == pytest.approx(bearing, abs=1e-7)
    assert echo.range == pytest.approx(math.hypot(level, 0.3), abs=1e-9)


@pytest.mark.parametrize(
    ("level", "bearing", "seen"),
    [
        (3.0, 0.0, True),
        (3.0, 1.03, True),
        (3.0, 1.06, False),
        (3.0, -1.03, True),
        (3.0, -1.06, False),
        (3.0, 3.1, False),
        (5.98, 0.0, True),
        (6.0, 0.0, False),
        (0.54, 0.0, True),
        (0.50, 0.0, False),
    ],
)
def test_the_field_of_view_has_limits(level: float, bearing: float, seen: bool) -> None:
    there = (0.1 + level * math.cos(bearing), level * math.sin(bearing))
    assert bool(look(PERFECT, FloorPose(0.0, 0.0, 0.0), [there], rng())) is seen


def test_several_reflectors_answer_the_nearest_first() -> None:
    echoes = look(
        PERFECT, FloorPose(0.0, 0.0, 0.0), [(4.1, 1.0), (2.1, -0.5), (-3.0, 0.0), (5.1, 0.0)], rng()
    )
    assert [round(echo.range, 2) for echo in echoes] == [2.08, 4.13, 5.01]


def test_noise_offsets_and_rounding() -> None:
    truth = replace(
        PERFECT,
        bearing_offset=0.01,
        range_offset=-0.02,
        bearing_noise=0.005,
        range_noise=0.02,
        step=0.0005,
    )
    draws = rng()
    echoes = [look(truth, FloorPose(0.0, 0.0, 0.0), [(3.1, 0.0)], draws)[0] for _ in range(4000)]
    bearings, ranges = np.array([e.bearing for e in echoes]), np.array([e.range for e in echoes])
    assert bearings.mean() == pytest.approx(0.01, abs=5e-4)
    assert bearings.std() == pytest.approx(0.005, rel=0.06)
    assert ranges.mean() == pytest.approx(math.hypot(3.0, 0.3) - 0.02, abs=2e-3)
    assert ranges.std() == pytest.approx(0.02, rel=0.06)
    assert np.abs(bearings / 0.0005 - np.round(bearings / 0.0005)).max() < 1e-6


def test_misses_and_false_returns_have_the_given_rates() -> None:
    draws = rng()
    missing = replace(PERFECT, miss=0.4)
    seen = sum(
        bool(look(missing, FloorPose(0.0, 0.0, 0.0), [(3.1, 0.0)], draws)) for _ in range(4000)
    )
    assert seen / 4000 == pytest.approx(0.6, abs=0.03)
    inventing = replace(PERFECT, false=0.15)
    echoes = [look(inventing, FloorPose(0.0, 0.0, 0.0), [], draws) for _ in range(4000)]
    false = [echo for row in echoes for echo in row]
    assert len(false) / 4000 == pytest.approx(0.15, abs=0.02)
    assert all(abs(echo.bearing) <= 1.047 and 0.5 <= echo.range <= 6.0 for echo in false)


def test_a_blind_sensor_is_worse(track_site: TrackSite) -> None:
    plain, blind = track_site.truth("arcs").sensor, track_site.truth("arcs+blind").sensor
    assert (blind.miss, blind.false) > (plain.miss, plain.false)
    assert blind.below == pytest.approx(0.3)
