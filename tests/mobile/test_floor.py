"""Projection between floor and image, and sampling along scan rows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from petrobot.services.mobile.floor import FloorView, ScanGrid
from petrobot.services.mobile.model import nominal_rover
from tests.mobile.conftest import DrawnFloor, Photographer

VIEW = FloorView(nominal_rover().camera)


@given(st.floats(0.45, 2.0), st.floats(-0.3, 0.3))
def test_a_floor_point_comes_back_from_its_pixel(x: float, y: float) -> None:
    u, v = VIEW.pixels(np.array([x]), np.array([y]))
    back_x, back_y = VIEW.points(u, v)
    assert back_x[0] == pytest.approx(x, abs=1e-9) and back_y[0] == pytest.approx(y, abs=1e-9)


def test_the_image_shows_the_stretch_that_the_contract_says() -> None:
    distances = VIEW.distances()
    assert distances[-1] == pytest.approx(0.425, abs=0.01)
    assert distances[0] == pytest.approx(2.3, abs=0.1)
    assert np.all(np.diff(distances) < 0.0), "rows further up look further ahead"


def test_left_is_left_and_far_is_up() -> None:
    u, v = VIEW.pixels(np.array([0.6, 0.6, 1.2]), np.array([0.1, -0.1, 0.0]))
    assert u[0] < u[1] and v[2] < v[0]


def test_scan_rows_are_about_as_far_apart_as_asked_and_reach_as_far() -> None:
    grid = ScanGrid.of(VIEW, 1.2, spacing=0.03)
    steps = np.diff(grid.x)
    assert grid.x[0] < 0.44 and 1.1 < grid.x[-1] <= 1.2
    assert steps.min() > 0.015 and steps.max() < 0.05


def test_both_ways_of_sampling_agree_where_the_image_shows_the_floor() -> None:
    image = Photographer(noise=0.0)(
        DrawnFloor("SLS"), DrawnFloor("SLS").at(1.0, 0.05, 0.1), np.random.default_rng(0)
    )
    grid = ScanGrid.of(VIEW, 1.2)
    rows = grid.sample(image)
    x, y = np.broadcast_arrays(grid.x[:, None], grid.y[None, :])
    points = VIEW.sample(image, x, y)
    both = grid.seen & ~np.isnan(points)
    assert both.mean() > 0.6
    assert np.abs(rows - points)[both].max() < 1.0


def test_a_point_outside_the_image_gives_nan() -> None:
    image = np.zeros((VIEW.height, VIEW.width), dtype=np.uint8)
    grey = VIEW.sample(image, np.array([0.2, 0.6, 0.6]), np.array([0.0, 2.0, 0.0]))
    assert np.isnan(grey).tolist() == [True, True, False]
