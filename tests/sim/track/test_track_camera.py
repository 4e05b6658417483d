"""The rover's camera: geometry, blur, light."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from petrobot.sim.track.camera import Motion, Mount, RoverCamera
from petrobot.sim.track.course import Track
from petrobot.sim.track.floor import Floor
from petrobot.sim.track.laboratory import TrackLight
from petrobot.sim.track.truth import LightTruth, TrackSite

NOMINAL = Mount(0.10, 0.60, 0.663, 0.0, 0.0, 140.0, (79.5, 59.5), 160, 120)
TRACK = Track.of((1, 1), 0, "SSSSS")


@pytest.fixture(scope="module")
def floor() -> Floor:
    painted = Floor()
    painted.paint(TRACK)
    return painted


def camera(noise: float = 0.0, exposure: float = 0.008, mount: Mount = NOMINAL) -> RoverCamera:
    return RoverCamera(mount, exposure, (40.0, 200.0), noise, 0.0)


def take(eye: RoverCamera, floor: Floor, motion: Motion, **light: float) -> Any:
    return eye.take(floor, motion, np.random.default_rng(1), **light)


mounts = st.builds(
    Mount,
    st.floats(0.05, 0.2),
    st.floats(0.5, 0.7),
    st.floats(0.6, 0.75),
    st.floats(-0.05, 0.05),
    st.floats(-0.05, 0.05),
    st.floats(130.0, 150.0),
    st.tuples(st.floats(75.0, 84.0), st.floats(55.0, 64.0)),
    st.just(160),
    st.just(120),
)


@given(st.floats(0.45, 2.2), st.floats(-0.4, 0.4))
@settings(max_examples=60, deadline=None)
def test_points_of_the_floor_project_as_the_contract_says(x: float, y: float) -> None:
    c, s = math.cos(NOMINAL.pitch), math.sin(NOMINAL.pitch)
    right, down = -y, NOMINAL.height * c - (x - NOMINAL.forward) * s
    depth = (x - NOMINAL.forward) * c + NOMINAL.height * s
    u, v = 79.5 + 140.0 * right / depth, 59.5 + 140.0 * down / depth
    assert NOMINAL.project((x, y)) == pytest.approx((u, v), abs=1e-9)


@given(mounts, st.floats(0.0, 159.0), st.floats(0.0, 119.0))
@settings(max_examples=60, deadline=None)
def test_pixels_and_floor_are_inverse(mount: Mount, u: float, v: float) -> None:
    x, y, w = mount.to_floor() @ (u, v, 1.0)
    assert w > 0.0
    assert mount.project((x / w, y / w)) == pytest.approx((u, v), abs=1e-6)


def test_turning_the_camera_moves_the_picture_the_other_way() -> None:
    ahead = np.array((1.0, 0.0))
    u, v = NOMINAL.project(ahead)
    assert (
        replace(NOMINAL, yaw=0.05).project(ahead)[0] > u + 5.0
    )  # turned left: things wander to the right
    assert replace(NOMINAL, pitch=0.7).project(ahead)[1] < v - 4.0  # turned down: things wander up


def test_a_camera_over_the_horizon_is_refused() -> None:
    with pytest.raises(ValueError, match="horizon"):
        replace(NOMINAL, pitch=0.3).to_floor()


@pytest.mark.parametrize("heading", [0.0, 0.4, -1.1, 2.5])
def test_known_points_of_the_floor_are_where_they_should_be(floor: Floor, heading: float) -> None:
    """The corner that four squares share, and the track's edges, to a fraction of a pixel."""
    corner = np.array((6.0, 4.0))
    c, s = math.cos(heading), math.sin(heading)
    for ahead, aside in ((0.7, 0.1), (1.0, -0.2), (1.4, 0.3)):
        x, y = corner - (ahead * c - aside * s, ahead * s + aside * c)
        image = take(camera(), floor, Motion(float(x), float(y), heading, 0.0, 0.0))
        u, v = NOMINAL.project((ahead, aside))
        guess = np.array([[[round(u), round(v)]]], np.float32)
        found = cv2.cornerSubPix(
            image,
            guess,
            (4, 4),
            (-1, -1),
            (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4),
        )
        assert found.ravel() == pytest.approx((u, v), abs=0.25)


def test_the_track_is_as_wide_in_the_picture_as_it_should_be(floor: Floor) -> None:
    image = take(camera(), floor, Motion(4.2, 3.0, 0.0, 0.0, 0.0)).astype(float)
    for row in (70, 90, 110):
        x, _, w = NOMINAL.to_floor() @ (79.5, float(row), 1.0)
        depth = (x / w - NOMINAL.forward) * math.cos(NOMINAL.pitch) + NOMINAL.height * math.sin(
            NOMINAL.pitch
        )
        track, paint = image[row, 60:100], image[row, 20]
        width = np.abs(track - paint).sum() / 160.0
        assert width == pytest.approx(140.0 * 0.05 / depth, rel=0.03)
        centre = np.average(np.arange(60, 100), weights=np.abs(track - paint))
        assert centre == pytest.approx(79.5, abs=0.1)


def test_motion_blurs_edges_across_its_direction_alone(floor: Floor) -> None:
    eye = camera(exposure=0.02)
    at = (5.2, 3.0, 0.0)  # the edge of a square is 0.8 m ahead
    still = take(eye, floor, Motion(*at, 0.0, 0.0)).astype(float)
    driving = take(eye, floor, Motion(*at, 0.5, 0.0)).astype(float)
    turning = take(eye, floor, Motion(*at, 0.0, 1.5)).astype(float)

    def sharpness(image: Any, row: int) -> float:
        return float(np.abs(np.diff(image[row, 60:100])).max())

    assert sharpness(driving, 100) == pytest.approx(
        sharpness(still, 100), rel=0.05
    )  # the track's edges lie along the way
    assert sharpness(turning, 60) < 0.8 * sharpness(still, 60)
    crossing = np.abs(np.diff(still[:, 20])).max(), np.abs(np.diff(driving[:, 20])).max()
    assert crossing[1] < 0.9 * crossing[0]  # the edge of a square lies across it


def test_greys_light_veil_and_noise(floor: Floor) -> None:
    at = Motion(4.2, 3.0, 0.0, 0.0, 0.0)
    plain = take(camera(), floor, at)
    assert (int(plain.min()), int(plain.max())) == (40, 200)
    dim = take(camera(), floor, at, light=0.5)
    assert (int(dim.min()), int(dim.max())) == (20, 100)
    flash = take(camera(), floor, at, light=2.2, veil=60.0)
    assert (int(flash.min()), int(flash.max())) == (148, 255)
    noisy = take(camera(noise=3.0), floor, at).astype(float) - plain
    assert 2.8 < noisy.std() < 3.2
    grained = take(camera(noise=3.0), floor, at, grain=3.0).astype(float) - plain
    assert 8.0 < grained.std() < 9.5


@pytest.mark.parametrize("at", [(4.0, 3.0), (-0.9, 3.0), (16.9, 16.9), (8.0, -0.9)])
@pytest.mark.parametrize("heading", [0.3, 1.9, -2.2])
def test_every_pixel_shows_the_floor_that_it_looks_at(
    floor: Floor, at: tuple[float, float], heading: float
) -> None:
    """Also at the board's rim, and whatever the camera has looked at before: the window on the
    floor goes along."""
    eye = camera()
    take(eye, floor, Motion(5.0, 5.0, 0.0, 0.0, 0.0))
    image = take(eye, floor, Motion(*at, heading, 0.0, 0.0))
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    x, y, w = np.einsum("ij,jkl->ikl", NOMINAL.to_floor(), np.stack([u, v, np.ones_like(u)]))
    x, y = x / w, y / w
    c, s = math.cos(heading), math.sin(heading)
    truth = TRACK.floor(at[0] + c * x - s * y, at[1] + s * x + c * y)
    wrong = (image > 120) != (truth == 1)
    assert wrong.mean() < 0.004  # pixels on edges alone
    assert not cv2.erode(wrong.astype(np.uint8), np.ones((3, 3), np.uint8)).any()


def test_a_newly_painted_floor_is_seen_at_once() -> None:
    floor, eye, at = Floor(), camera(), Motion(4.2, 3.0, 0.0, 0.0, 0.0)
    floor.paint(TRACK)
    before = take(eye, floor, at)
    floor.paint(Track.of((0, 5), 0, "SSSS"))
    after = take(eye, floor, at)
    assert (np.abs(before.astype(int) - after) > 100).mean() > 0.03  # the track is gone


def test_the_same_draws_give_the_same_image(floor: Floor) -> None:
    eye, at = camera(noise=3.0), Motion(4.2, 3.0, 0.1, 0.5, 0.2)
    one, same, other = (eye.take(floor, at, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


# Light


def hall(seed: int = 1, **changes: Any) -> TrackLight:
    nominal = LightTruth(1.0, 0.0, 10.0, 0.0, (0.05, 0.15), 2.0, 50.0, 1.0)
    return TrackLight(replace(nominal, **changes), np.random.default_rng(seed), 3.0)


def test_light_drifts_slowly_around_its_level() -> None:
    drifting = hall(level=0.8, drift=0.25)
    levels = np.array([drifting.at(3.0 + 0.01 * k).level for k in range(1001)])
    assert levels.max() == pytest.approx(1.0, abs=1e-3)
    assert levels.min() == pytest.approx(0.6, abs=1e-3)
    assert np.abs(np.diff(levels)).max() < 0.002
    assert {hall().at(3.0 + k).level for k in range(10)} == {1.0}


def test_flashes_come_as_often_and_last_as_long_as_they_should() -> None:
    flashing = hall(flash_rate=0.5)
    lit = np.array([flashing.at(3.0 + 0.01 * k).veil > 0.0 for k in range(60_000)])
    starts = int((lit[1:] & ~lit[:-1]).sum())
    assert 240 < starts < 340  # 0.5 1/s less the time in flashes themselves, over 600 s
    assert lit.sum() * 0.01 / starts == pytest.approx(0.10, abs=0.015)
    assert all(hall().at(3.0 + 0.1 * k).veil == 0.0 for k in range(1000))


@pytest.mark.parametrize("regime", ["straight", "mixed+miscalibrated"])
def test_the_true_camera_is_near_the_nominal_one(track_site: TrackSite, regime: str) -> None:
    mount = track_site.truth(regime).camera
    aside = 6.0 if "mis" in regime else 3.0
    points = np.array([(0.6, 0.1), (1.0, -0.2), (1.5, 0.2)])
    assert 0.05 < np.abs(mount.project(points) - NOMINAL.project(points)).max() < aside
