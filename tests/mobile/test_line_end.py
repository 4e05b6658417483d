"""Interruptions and the T are told apart, and no other place is taken for an end."""

from __future__ import annotations

import math

import numpy as np
import pytest

from petrobot.services.mobile.detection import detect_edges
from petrobot.services.mobile.model import nominal_rover
from petrobot.services.mobile.sight import TrackEnd
from petrobot.services.mobile.watching import FloorWatch, LineWatcher
from tests.mobile.conftest import DrawnFloor, DrawnPose, Photographer

WATCH = FloorWatch.of(nominal_rover())
PHOTOGRAPHER = Photographer()


def drive(
    floor: DrawnFloor, first: float, last: float, step: float = 0.02, seed: int = 5
) -> list[tuple[DrawnPose, TrackEnd, tuple[float, float]]]:
    """Take images every `step` m along the line, weaving a little; return the poses and the end
    that a watcher reports."""
    random = np.random.default_rng(seed)
    watcher, seen = LineWatcher(WATCH, detect_edges), []
    for s in np.arange(first, last, step):
        pose = floor.at(
            float(s), float(random.normal(0.0, 0.008)), float(random.normal(0.0, 0.015))
        )
        end = watcher.look(PHOTOGRAPHER(floor, pose, random)).end
        if end is not None:
            seen.append((pose, end.kind, (end.x, end.y)))
    return seen


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize(
    ("elements", "bar", "length", "kind"),
    [
        ("SSs", False, 4.0, TrackEnd.INTERRUPTION),
        ("SLs", False, 2.0 + math.pi / 2, TrackEnd.INTERRUPTION),
        ("SRl", False, 2.0 + math.pi / 2, TrackEnd.INTERRUPTION),
        ("SS", True, 3.75, TrackEnd.T),
    ],
)
def test_the_end_is_recognised_and_placed(
    elements: str, bar: bool, length: float, kind: TrackEnd, inverted: bool
) -> None:
    floor = DrawnFloor(elements, bar=bar, inverted=inverted)
    seen = drive(floor, length - 1.3, length - 0.4)
    assert len(seen) >= 5 and {k for _, k, _ in seen} == {kind}
    there = floor.at(length)
    for pose, _, (ahead, left) in seen:
        spot = pose.moved(ahead, left)
        assert math.hypot(spot.x - there.x, spot.y - there.y) < 0.05


@pytest.mark.parametrize("elements", ["SSS", "SLRS", "SRLLS"])
def test_a_track_that_continues_has_no_end(elements: str) -> None:
    length = sum(2.0 if e == "S" else math.pi / 2 for e in elements)
    assert drive(DrawnFloor(elements), 0.3, length - 1.6, 0.06) == []


def test_a_single_image_is_not_sufficient() -> None:
    floor = DrawnFloor("SSs")
    watcher, random = LineWatcher(WATCH, detect_edges), np.random.default_rng(0)
    sights = [watcher.look(PHOTOGRAPHER(floor, floor.at(3.2 + 0.02 * i), random)) for i in range(4)]
    assert sights[0].broke_off and [sight.end is None for sight in sights[:3]] == [
        True,
        True,
        False,
    ]


def test_a_line_that_vanishes_is_searched_again_after_three_images() -> None:
    floor, random = DrawnFloor("SSS"), np.random.default_rng(0)
    watcher = LineWatcher(WATCH, detect_edges)
    blank = np.full((120, 160), 90, dtype=np.uint8)
    assert watcher.look(PHOTOGRAPHER(floor, floor.at(0.2), random)).seen
    assert not any(watcher.look(blank).seen for _ in range(3))
    assert watcher.look(PHOTOGRAPHER(floor, floor.at(0.2, 0.2), random)).seen, (
        "20 cm aside of where it was"
    )
    assert watcher.share == pytest.approx(0.4) and watcher.unseen == 0
