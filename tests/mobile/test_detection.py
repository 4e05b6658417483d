"""Every detector finds the line on rendered floors in both colours, and reports nothing where there
is none."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from numpy.typing import NDArray

from petrobot.services.mobile.detection import (
    FloorView,
    ScanGrid,
    TemplateBank,
    TrackDetector,
    consensus,
    detect_edges,
    detect_ridge,
)
from petrobot.services.mobile.model import nominal_rover
from petrobot.services.mobile.sight import Sight
from tests.mobile.conftest import DrawnFloor, DrawnPose, Photographer

PHOTOGRAPHER = Photographer()
GRID = ScanGrid.of(PHOTOGRAPHER.view, 1.2)
WIDTH = 0.05
DETECTORS: dict[str, Callable[[], TrackDetector]] = {
    "edges": lambda: detect_edges,
    "ridge": lambda: detect_ridge,
    "consensus": lambda: consensus(lambda: np.random.default_rng(7)),
    "template": TemplateBank,
}
EVERY = pytest.mark.parametrize("name", DETECTORS)


def look(
    name: str,
    floor: DrawnFloor,
    pose: DrawnPose,
    seed: int = 1,
    photographer: Photographer = PHOTOGRAPHER,
) -> Sight:
    """Return what a detector sees of a floor from a pose."""
    image = photographer(floor, pose, np.random.default_rng(seed))
    return DETECTORS[name]()(GRID, GRID.sample(image), WIDTH, None)


def off_line(sight: Sight, floor: DrawnFloor, pose: DrawnPose, s: float) -> NDArray[np.float64]:
    """Distances (m) of the nearest half metre of a sight from the centre line around s + 0.3 to s +
    1.6 m."""
    line = [floor.at(s + 0.3 + 0.005 * i) for i in range(260)]
    near = sight.x <= sight.x[0] + 0.5
    cos, sin = math.cos(pose.heading), math.sin(pose.heading)
    x = pose.x + sight.x[near] * cos - sight.y[near] * sin
    y = pose.y + sight.x[near] * sin + sight.y[near] * cos
    lx, ly = np.array([p.x for p in line]), np.array([p.y for p in line])
    off: NDArray[np.float64] = np.hypot(x[:, None] - lx[None, :], y[:, None] - ly[None, :]).min(
        axis=1
    )
    return off


@EVERY
@settings(max_examples=12)
@given(
    aside=st.floats(-0.12, 0.12),
    turn=st.floats(-0.2, 0.2),
    s=st.floats(0.1, 1.0),
    seed=st.integers(0, 99),
)
def test_offset_and_heading_of_a_straight_line_are_recovered(
    name: str, aside: float, turn: float, s: float, seed: int
) -> None:
    floor = DrawnFloor("SSS")
    sight = look(name, floor, floor.at(s, aside, turn), seed)
    line = sight.describe()
    assert line.heading == pytest.approx(-turn, abs=0.06)
    expected = -aside / math.cos(turn) - float(sight.x[0]) * math.tan(turn)
    assert line.offset == pytest.approx(expected, abs=0.008)
    assert abs(line.curvature) < 0.25 and sight.confidence > 0.8


@EVERY
@pytest.mark.parametrize(("elements", "bend"), [("SLL", 1.0), ("SRR", -1.0)])
def test_curvature_of_an_arc_is_recovered(name: str, elements: str, bend: float) -> None:
    floor = DrawnFloor(elements)
    found = [look(name, floor, floor.at(2.05 + 0.1 * i), seed=i) for i in range(6)]
    assert np.mean([sight.describe().curvature for sight in found]) == pytest.approx(bend, abs=0.25)
    for i, sight in enumerate(found):
        off = off_line(sight, floor, floor.at(2.05 + 0.1 * i), 2.05 + 0.1 * i)
        assert np.median(off) < 0.006


@EVERY
@settings(max_examples=8)
@given(s=st.floats(0.2, 2.5), aside=st.floats(-0.08, 0.08), turn=st.floats(-0.1, 0.1))
def test_swapping_black_and_white_changes_nothing(
    name: str, s: float, aside: float, turn: float
) -> None:
    """Without noise the negative of a floor gives the same line."""
    quiet = Photographer(noise=0.0)
    pose = DrawnFloor("SLS").at(s, aside, turn)
    one, other = (
        look(name, DrawnFloor("SLS", inverted=inverted), pose, photographer=quiet)
        for inverted in (False, True)
    )
    assume(name != "template" or (one.seen and other.seen))  # its lattice misses one image in sixty
    assert one.seen and other.seen
    a, b = one.describe(), other.describe()
    assert a.offset == pytest.approx(b.offset, abs=0.006) and a.heading == pytest.approx(
        b.heading, abs=0.04
    )


@EVERY
@pytest.mark.parametrize("back", [0.5, 0.7, 0.9, 1.1])
def test_the_line_continues_where_its_colour_is_inverted(name: str, back: float) -> None:
    """The edge of a square crosses the view: the line before and behind it is the same, and does
    not end there."""
    floor = DrawnFloor("SSS")
    pose = floor.at(2.0 - back, 0.02, 0.06)
    sight = look(name, floor, pose)
    assert sight.x[0] < 0.5 and sight.x[-1] > 1.05 and not sight.broke_off
    off = off_line(sight, floor, pose, 2.0 - back)
    assert np.median(off) < 0.004 and off.max() < 0.02


@EVERY
def test_an_empty_square_shows_no_line(name: str) -> None:
    floor = DrawnFloor("Sss")
    for i in range(6):
        assert not look(name, floor, floor.at(2.1 + 0.1 * i, 0.03 * i, 0.05 * i), seed=i).seen


@EVERY
def test_the_edge_of_a_square_alone_is_not_a_line(name: str) -> None:
    """Tried next to the track, along the border between black and white."""
    floor = DrawnFloor("sss")
    assert not look(name, floor, DrawnPose(0.3, 1.0, 0.0)).seen


@EVERY
def test_the_line_before_decides_which_of_two_is_followed(name: str) -> None:
    """Of two lines, the one that continues the last sight is taken."""
    floor = DrawnFloor("SSS")
    pose = floor.at(0.5, 0.0, 0.0)
    image = PHOTOGRAPHER(floor, pose, np.random.default_rng(3))
    distances = PHOTOGRAPHER.view.distances()
    for row in range(20, 120):
        left, right = PHOTOGRAPHER.view.pixels(
            np.full(2, distances[row]), np.array([0.245, 0.195])
        )[0]
        image[row, int(left) : int(right) + 1] = 40  # a second stripe, 0.22 m to the left
    detector = DETECTORS[name]()
    expected = detector(
        GRID, GRID.sample(PHOTOGRAPHER(floor, pose, np.random.default_rng(4))), WIDTH, None
    ).line()
    again = detector(GRID, GRID.sample(image), WIDTH, expected)
    assert again.seen and abs(again.describe().offset) < 0.02


@pytest.mark.parametrize(
    ("name", "noise"), [("edges", 10.0), ("ridge", 16.0), ("consensus", 10.0), ("template", 20.0)]
)
def test_noise_is_tolerated(name: str, noise: float) -> None:
    """Three to seven times the nominal noise: nine of ten images still show the line."""
    loud = Photographer(noise=noise)
    floor = DrawnFloor("SSS")
    good = 0
    for i in range(20):
        pose = floor.at(0.1 + 0.06 * i)
        sight = look(name, floor, pose, i, loud)
        good += (
            sight.seen and float(np.median(off_line(sight, floor, pose, 0.1 + 0.06 * i))) < 0.012
        )
    assert good >= 18


@EVERY
def test_dim_light_is_tolerated(name: str) -> None:
    """Tried with two fifths of the contrast."""
    dim = Photographer(black=20.0, white=85.0)
    floor = DrawnFloor("SLS")
    for i in range(6):
        assert look(name, floor, floor.at(0.3 + 0.2 * i), i, dim).seen


# --- the floor in the image ---

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
    grid = ScanGrid.of(VIEW, 1.2)
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
