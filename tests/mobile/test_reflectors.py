"""Echoes become reflectors, in spite of missing and false returns, wherever the rover is when they
arrive."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from petrobot.services.mobile.model import nominal_rover
from petrobot.services.mobile.odometry import Pose
from petrobot.services.mobile.reflectors import ReflectorMap, parse_echoes

ROVER = nominal_rover()


def echo(pose: Pose, x: float, y: float) -> tuple[float, float]:
    """Return bearing and slant range of a reflector at (x, y) from a pose."""
    ahead, left = pose.body(x, y)
    ahead -= ROVER.sensor.forward
    above = ROVER.track.reflector_height - ROVER.sensor.height
    return math.atan2(left, ahead), math.sqrt(ahead * ahead + left * left + above * above)


def test_a_reflector_is_placed_while_the_rover_moves_among_misses_and_false_returns() -> None:
    random = np.random.default_rng(4)
    heard = ReflectorMap(ROVER.sensor, ROVER.track.reflector_height)
    for i in range(60):
        pose = Pose(0.02 * i, 0.005 * i, 0.01 * i)
        echoes = []
        if random.random() > 0.4:
            bearing, slant = echo(pose, 2.4, 0.9)
            echoes.append(
                (bearing + float(random.normal(0, 0.005)), slant + float(random.normal(0, 0.02)))
            )
        if random.random() < 0.15:
            echoes.append((float(random.uniform(-1, 1)), float(random.uniform(0.6, 6.0))))
        heard.take(0.04 * i, pose, echoes)
    (found,) = heard.believed(2.4)
    assert math.hypot(found[0] - 2.4, found[1] - 0.9) < 0.03
    assert found[2] > 20 and found[3] < 0.3


def test_lonely_echoes_make_no_reflector_and_old_ones_are_forgotten() -> None:
    heard, pose = ReflectorMap(ROVER.sensor, ROVER.track.reflector_height), Pose(0, 0, 0)
    for i in range(3):
        heard.take(0.04 * i, pose, [echo(pose, 2.0, 0.0)])
    assert heard.believed(0.1) == []
    heard.take(0.2, pose, [echo(pose, 2.0, 0.0)])
    assert len(heard.believed(0.2)) == 1
    heard.take(30.0, pose, [])
    assert heard.believed(30.0) == []


def test_two_reflectors_are_two() -> None:
    heard, pose = ReflectorMap(ROVER.sensor, ROVER.track.reflector_height), Pose(0, 0, 0)
    for i in range(6):
        heard.take(0.04 * i, pose, [echo(pose, 1.0, 1.0), echo(pose, 3.0, -0.5)])
    assert sorted(round(x, 3) for x, *_ in heard.believed(0.2)) == [1.0, 3.0]


def test_frames_of_the_sensor() -> None:
    assert parse_echoes(struct.pack("<hHhH", -1234, 2500, 0, 0)) == [(-0.1234, 2.5)]
    with pytest.raises(ValueError, match="expected 8 bytes"):
        parse_echoes(b"\0\0")


def test_an_echo_nearer_than_the_difference_in_height_is_ignored() -> None:
    heard = ReflectorMap(ROVER.sensor, ROVER.track.reflector_height)
    heard.take(0.0, Pose(0, 0, 0), [(0.0, 0.2)])
    assert heard.echoes == 0
