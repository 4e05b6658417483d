"""Geometry of the calibrated and of the simulated camera: projection against OpenCV, and the
inverse against the projection."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot.services.vision.optics import Optics, TableView
from petrobot.sim.catching.camera import PinholeCamera
from tests.vision.bench import nominal_optics, true_view


def drawn_optics(cell: dict[str, Any], seed: int) -> Optics:
    """Draw a camera that differs from the nominal one by more than any installation does."""
    rng, nominal = np.random.default_rng(seed), nominal_optics(cell)
    k1, k2, p1, p2 = (
        float(k) for k in np.array(nominal.distortion) + rng.normal(0, [0.03, 0.01, 5e-4, 5e-4])
    )
    return Optics(
        (float(640 + rng.normal(0, 10)), float(640 + rng.normal(0, 10))),
        (float(319.5 + rng.normal(0, 6)), float(239.5 + rng.normal(0, 6))),
        (k1, k2, p1, p2),
        cv2.Rodrigues(rng.normal(0, 0.03, 3))[0] @ nominal.rotation,
        nominal.position + rng.normal(0, 0.05, 3),
    )


def by_opencv(
    points: np.ndarray, rotation: np.ndarray, position: np.ndarray, matrix: Any, distortion: Any
) -> Any:
    """Return the same pixels from cv2.projectPoints."""
    turn = cv2.Rodrigues(rotation)[0]
    pixels = cv2.projectPoints(
        points, turn, -rotation @ position, np.asarray(matrix), np.asarray(distortion)
    )[0]
    return pixels.reshape(-1, 2)


def table_points(rng: np.random.Generator, count: int = 200) -> np.ndarray:
    """Points on and above the table."""
    return rng.uniform([0.6, -0.45, 0.55], [2.25, 0.45, 0.9], (count, 3))


@pytest.mark.parametrize("seed", range(5))
def test_projection_is_opencvs(cell: dict[str, Any], seed: int) -> None:
    optics, points = drawn_optics(cell, seed), table_points(np.random.default_rng(seed))
    (fx, fy), (cx, cy) = optics.focal, optics.centre
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    expected = by_opencv(points, optics.rotation, optics.position, matrix, optics.distortion)
    assert np.abs(optics.project(points) - expected).max() < 1e-9


def test_simulated_projection_is_opencvs(cell: dict[str, Any]) -> None:
    camera = PinholeCamera(cell, true_view(cell), np.random.default_rng(0))
    points = table_points(np.random.default_rng(1))
    matrix = [[camera.focal, 0, camera.cx], [0, camera.focal, camera.cy], [0, 0, 1]]
    expected = by_opencv(points, camera.rotation, camera.position, matrix, camera.distortion)
    assert np.abs(camera.project(points) - expected).max() < 1e-9


@given(
    u=st.floats(0.0, 639.0), v=st.floats(0.0, 479.0), z=st.floats(0.0, 0.9), seed=st.integers(0, 20)
)
def test_to_plane_is_the_inverse_everywhere_in_the_image(
    u: float, v: float, z: float, seed: int
) -> None:
    from tests.vision.bench import read_cell

    optics = drawn_optics(read_cell(), seed)
    x, y = optics.to_plane([u, v], z)
    assert np.abs(optics.project([x, y, z]) - [u, v]).max() < 1e-6


def test_rays_of_the_simulated_camera_are_the_inverse(cell: dict[str, Any]) -> None:
    camera = PinholeCamera(cell, true_view(cell), np.random.default_rng(0))
    points = table_points(np.random.default_rng(2))
    seen = camera.to_camera(points)
    wanted = seen / np.linalg.norm(seen, axis=-1, keepdims=True)
    assert np.abs(camera.rays(camera.project(points)) - wanted).max() < 2e-6  # 1e-3 px


def test_nominal_camera_sees_the_whole_table(cell: dict[str, Any]) -> None:
    view = TableView.of(cell, nominal_optics(cell))
    corners = view.to_pixels([(x, y) for x in (0.62, 2.22) for y in (-0.45, 0.45)])
    assert (corners > 5).all() and (corners < [634, 474]).all()
    rows, columns = view.region
    assert columns.start <= corners[:, 0].min() and columns.stop >= corners[:, 0].max()
    assert rows.start <= corners[:, 1].min() and rows.stop >= corners[:, 1].max()


def test_the_view_gives_the_balls_centre(cell: dict[str, Any]) -> None:
    """A ball's centre is 20 mm above the table: projecting onto the table top instead would be
    wrong by up to 9 mm at its ends."""
    view = TableView.of(cell, nominal_optics(cell))
    pixel = view.optics.project([0.62, 0.0, 0.62])
    assert np.allclose(view.to_table(pixel), [0.62, 0.0], atol=1e-9)
    assert abs(view.optics.to_plane(pixel, 0.60)[0] - 0.62) > 0.008


def test_scale_and_streak(cell: dict[str, Any]) -> None:
    view = TableView.of(cell, nominal_optics(cell))
    across = view.optics.project([[1.42, 0.02, 0.62], [1.42, -0.02, 0.62]])
    assert view.radius_px == pytest.approx(np.ptp(across[:, 1]) / 2, rel=1e-3)
    assert view.streak_px(2.5) == pytest.approx(2.5 * 0.004 * view.radius_px / 0.02)


def test_on_table(cell: dict[str, Any]) -> None:
    view = TableView.of(cell, nominal_optics(cell))
    places = [(0.62, 0.45), (0.61, 0.0), (2.23, 0.0), (1.0, -0.46)]
    assert view.on_table(places).tolist() == [True, False, False, False]
    assert view.on_table(places, margin=0.02).all()
