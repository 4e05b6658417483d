"""The simulated camera's images: geometry, blur, occlusion, light, noise and repeatability."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from petrobot.sim.catching.camera import PinholeCamera
from petrobot.sim.catching.scenery import Chessboard
from tests.vision.bench import true_view


@pytest.fixture(scope="module")
def clean(cell: dict[str, Any]) -> PinholeCamera:
    """Return a camera with uniform light and no noise."""
    view = true_view(cell, noise=0.0, light_gradient=(0.0, 0.0), vignetting=0.0)
    return PinholeCamera(cell, view, np.random.default_rng(0))


def ball_pixels(
    camera: PinholeCamera, ball: Any, velocity: Any = (0, 0, 0)
) -> tuple[np.ndarray, float]:
    """Return centroid (u, v) and area (px) of the pixels that a ball makes brighter by more than
    half its contrast."""
    empty = camera.render(None).astype(float)
    brighter = np.clip(camera.render(ball, velocity) - empty, 0, None)
    weight = np.clip(brighter / 70.0, 0.0, 1.0)
    v, u = np.nonzero(weight)
    values = weight[v, u]
    return np.array([u @ values, v @ values]) / values.sum(), float(values.sum())


@pytest.mark.parametrize(
    "place", [(2.10, 0.24), (1.55, 0.05), (1.42, -0.20), (0.95, 0.33), (0.78, -0.37)]
)
def test_a_ball_is_where_opencv_projects_its_centre(
    clean: PinholeCamera, place: tuple[float, float]
) -> None:
    ball = np.array([*place, 0.62])
    turn, shift = cv2.Rodrigues(clean.rotation)[0], -clean.rotation @ clean.position
    matrix = np.array([[clean.focal, 0, clean.cx], [0, clean.focal, clean.cy], [0, 0, 1]])
    wanted = cv2.projectPoints(ball[None], turn, shift, matrix, clean.distortion)[0].ravel()
    centre, area = ball_pixels(clean, ball)
    assert np.abs(centre - wanted).max() < 0.35  # the shaded side weighs less
    depth = float(clean.to_camera(ball)[2])
    assert area == pytest.approx(np.pi * (0.02 * clean.focal / depth) ** 2, rel=0.12)


def test_a_moving_ball_is_a_streak_around_its_position_at_mid_exposure(
    clean: PinholeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("petrobot.sim.catching.camera.SHADOW_DEPTH", 0.0)
    ball = np.array([1.45, 0.10, 0.62])
    empty = clean.background.astype(float)
    still, moving = (
        np.clip(clean.render(ball, v) - empty, 0, None) for v in ((0, 0, 0), (-2.5, 0, 0))
    )
    assert (
        np.abs(ball_pixels(clean, ball)[0] - ball_pixels(clean, ball, (-2.5, 0, 0))[0]).max() < 0.15
    )
    assert moving.sum() == pytest.approx(still.sum(), rel=0.03), "the same light, spread out"
    way = 2.5 * 0.004 * clean.focal / float(clean.to_camera(ball)[2])
    # Blur adds the variance of a uniform exposure along the path, way^2 / 12.
    grown = spread(moving, 0) - spread(still, 0)
    assert np.sqrt(12.0 * grown) == pytest.approx(way, rel=0.1)
    assert spread(moving, 1) == pytest.approx(spread(still, 1), rel=0.02)


def spread(light: np.ndarray, axis: int) -> float:
    """Return the variance of the light's position along u (axis 0) or v (axis 1), px^2."""
    profile = light.sum(axis=axis) / light.sum()
    at = np.arange(len(profile))
    return float(profile @ at**2 - (profile @ at) ** 2)


def test_the_ball_throws_a_shadow(clean: PinholeCamera) -> None:
    darker = clean.render(None).astype(int) - clean.render([1.42, 0.1, 0.62])
    assert darker.max() > 8
    assert (darker > 4).sum() < 200


def test_no_ball_no_change(clean: PinholeCamera) -> None:
    assert np.array_equal(clean.render(None), clean.background)
    assert np.array_equal(clean.render([1.4, 5.0, 0.62]), clean.background), "a ball out of view"
    assert np.array_equal(clean.render([float("nan")] * 3), clean.background)


def test_arm_hides_the_ball_when_it_is_above(clean: PinholeCamera) -> None:
    ball, arm = [0.80, 0.0, 0.62], np.array([[[0.5, 0.0, 0.9], [1.1, 0.0, 0.9]]])
    hidden = clean.render(ball, arm_points=arm, arm_radii=[0.09])
    alone = clean.render(None, arm_points=arm, arm_radii=[0.09])
    # what is left of the ball under the arm is its shadow's rim at most
    assert (np.abs(hidden.astype(int) - alone) > 30).sum() == 0
    below = np.array([[[0.5, 0.0, 0.55], [1.1, 0.0, 0.55]]])
    seen = clean.render(ball, arm_points=below, arm_radii=[0.03]).astype(int)
    assert (seen - clean.render(None, arm_points=below, arm_radii=[0.03]) > 30).sum() > 80


def test_ball_in_the_cup_is_seen_through_its_mouth(clean: PinholeCamera) -> None:
    cup = np.eye(4)
    cup[:3, 3] = [0.70, 0.1, 0.66]
    empty = clean.render(None, cup_pose=cup).astype(int)
    assert (np.abs(empty - clean.background.astype(int)) > 10).sum() > 300
    inside = clean.render([0.70, 0.1, 0.63], cup_pose=cup).astype(int)
    assert (inside - empty > 60).sum() > 80
    under = clean.render([0.70, 0.1, 0.62 - 0.07], cup_pose=cup).astype(int)
    assert (under - empty > 60).sum() == 0, "the cup hides what is below it"


def test_capsule_ends_are_where_they_project(clean: PinholeCamera) -> None:
    ends = np.array([[[1.0, -0.2, 0.8], [1.3, 0.2, 0.8]]])
    changed = (
        np.abs(clean.render(None, arm_points=ends, arm_radii=[0.04]).astype(int) - clean.background)
        > 5
    )
    for u, v in clean.project(ends[0]):
        assert changed[round(v), round(u)]
    v, u = np.nonzero(changed)
    middle = clean.project(ends[0]).mean(axis=0)
    assert np.hypot(u.mean() - middle[0], v.mean() - middle[1]) < 1.5


def test_light_and_gradient(cell: dict[str, Any], clean: PinholeCamera) -> None:
    assert clean.render(None, light=0.5).mean() == pytest.approx(
        clean.background.mean() / 2, abs=0.6
    )
    view = true_view(cell, noise=0.0, light_gradient=(-0.4, 0.0), vignetting=0.0)
    sloping = PinholeCamera(cell, view, np.random.default_rng(0)).background.astype(float)
    ratio = sloping / np.maximum(clean.background, 1.0)
    assert ratio[:, :20].mean() == pytest.approx(1.2, abs=0.03)
    assert ratio[:, -20:].mean() == pytest.approx(0.8, abs=0.03)


def test_noise_has_its_sigma_and_is_new_in_each_image(cell: dict[str, Any]) -> None:
    camera = PinholeCamera(cell, true_view(cell), np.random.default_rng(3))
    first, second = (camera.render(None).astype(float) - camera.background for _ in range(2))
    assert first.std() == pytest.approx(3.0, abs=0.1)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02


def test_same_generator_same_images(cell: dict[str, Any]) -> None:
    first, second = (
        PinholeCamera(cell, true_view(cell), np.random.default_rng(5)) for _ in range(2)
    )
    for place in (1.9, 1.4):
        assert np.array_equal(
            first.render([place, 0, 0.62], (-1, 0, 0)), second.render([place, 0, 0.62], (-1, 0, 0))
        )
    first.reseed(np.random.default_rng(8))
    second.reseed(np.random.default_rng(9))
    assert not np.array_equal(first.render(None), second.render(None))


def test_unknown_truth_is_refused(cell: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"focal_length.*focal_px"):
        PinholeCamera(cell, {"focal_length": 600.0}, np.random.default_rng(0))


def test_a_table_in_another_pose_is_drawn_there(cell: dict[str, Any], clean: PinholeCamera) -> None:
    view = true_view(cell, noise=0.0, light_gradient=(0.0, 0.0), vignetting=0.0, near_edge=0.70)
    other = PinholeCamera(cell, view, np.random.default_rng(0))
    u, v = (round(c) for c in clean.project([0.66, 0.1, 0.6]))
    assert clean.background[v, u] > other.background[v, u] + 10, "table there, floor here"


def test_board_corners_are_where_they_project(clean: PinholeCamera) -> None:
    board, pose = Chessboard(), np.eye(4)
    pose[:3, 3] = [1.15, -0.15, 0.60]
    picture = clean.render_board(pose, board)
    y, x = np.mgrid[0 : board.rows, 0 : board.columns]
    points = (
        np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1) * board.square + pose[:3, 3]
    )
    wanted = clean.project(points).astype(np.float32)[:, None]
    limit = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 0.001)
    found = cv2.cornerSubPix(picture, wanted.copy(), (5, 5), (-1, -1), limit)
    assert np.abs(found - wanted).mean() < 0.1


def test_the_fast_path_of_noise_gives_the_same_image(cell: dict[str, Any]) -> None:
    """With and without arm, cup and ball in view, the fast path gives every pixel of the slow
    one."""
    rng = np.random.default_rng(4)
    short, long = (PinholeCamera(cell, true_view(cell), np.random.default_rng(7)) for _ in range(2))
    assert short._sound
    long.__dict__["_sound"] = False
    for _ in range(40):
        ball = rng.uniform((0.5, -0.5, 0.60), (2.3, 0.5, 0.75)) if rng.random() < 0.8 else None
        arm, pose = rng.uniform((0.2, -0.5, 0.5), (1.4, 0.5, 1.0), (6, 2, 3)), np.eye(4)
        pose[:3, 3] = rng.uniform((0.5, -0.4, 0.6), (1.3, 0.4, 0.8))
        given = ball, rng.uniform(-2.0, 2.0, 3), arm, np.full(6, 0.05), pose
        assert np.array_equal(short.render(*given), long.render(*given))


def test_a_scene_drawn_in_stripes_equals_one_drawn_at_once(
    cell: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    striped, whole = (
        PinholeCamera(cell, true_view(cell), np.random.default_rng(0)) for _ in range(2)
    )
    striped.warm_up()
    monkeypatch.setattr("petrobot.sim.catching.scenery.STRIPE", whole.height)
    whole.warm_up()
    assert np.array_equal(striped.background, whole.background) and np.array_equal(
        striped._rays, whole._rays
    )
