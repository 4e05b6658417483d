"""Finding parts in images of the simulated camera, whose installation errors the finders do not
know."""

from __future__ import annotations

import math

import pytest

from petrobot.services.picking.model import cell_named
from petrobot.services.picking.seeing import (
    FINDERS,
    confirmed,
    easiest,
    find_by_contours,
    find_by_templates,
    is_empty,
)
from tests.sim.picking.bench import scene

SEEDS = range(40, 52)
NEAR = 0.008
"""Tolerance of a position (m): installation errors, and half a finger's play."""


def rate(name: str, regime: str) -> float:
    """Return the share of parts of all seeds that are found at their positions."""
    cell, hit, count = cell_named(), 0, 0
    for seed in SEEDS:
        parts, image = scene(seed, regime)
        found = FINDERS[name](image, cell)
        count += len(parts)
        hit += sum(
            any(math.hypot(f.x - part.x, f.y - part.y) < NEAR for f in found) for part in parts
        )
    return hit / count


@pytest.mark.parametrize(
    ("name", "regime", "least", "most"),
    [
        ("contours", "plain", 0.85, 1.0),
        ("templates", "plain", 0.95, 1.0),
        ("contours", "plain+dim", 0.0, 0.7),  # too little contrast
        ("templates", "plain+dim", 0.95, 1.0),
    ],
)
def test_what_each_finder_sees_in_which_light(
    name: str, regime: str, least: float, most: float
) -> None:
    assert least <= rate(name, regime) <= most


@pytest.mark.parametrize("find", [find_by_contours, find_by_templates])
def test_an_empty_table_shows_nothing(find: object) -> None:
    _, image = scene(1)
    image = image.copy()
    image[60:240, 140:500] = 150
    assert callable(find) and find(image, cell_named()) == []


def test_the_direction_of_a_long_part_is_found() -> None:
    cell, seen = cell_named(), 0
    for seed in range(30):
        parts, image = scene(seed)
        for bar in (part for part in parts if part.kind == "bar" and part.grey > 150.0):
            for find in FINDERS.values():
                near = [
                    f
                    for f in find(image, cell)
                    if f.kind == "bar" and math.hypot(f.x - bar.x, f.y - bar.y) < NEAR
                ]
                away = [abs(math.remainder(f.turn - bar.turn, math.pi)) for f in near]
                assert all(angle < math.radians(10.0) for angle in away)
                seen += len(near)
    assert seen >= 6


def test_a_part_must_be_in_most_images_and_the_freest_one_is_taken() -> None:
    parts, image = scene(3)
    found = find_by_templates(image, cell_named())
    assert len(found) == len(parts)
    assert confirmed([found, found[1:]]) == found[1:]
    free = easiest(found)
    room = {f: min(math.dist(f[1:3], o[1:3]) for o in found if o is not f) for f in found}
    assert room[free] > min(room.values())


def test_a_tray_is_empty_until_something_lies_in_it() -> None:
    cell = cell_named()
    _, image = scene(1)
    assert is_empty(image, cell, "boxes") and is_empty(image, cell, "rounds")
    image = image.copy()
    u, v = cell.eye.pixel(*cell.trays["boxes"].slots[0], 0.02)
    image[round(v) - 12 : round(v) + 12, round(u) - 12 : round(u) + 12] = 230
    assert not is_empty(image, cell, "boxes") and is_empty(image, cell, "rounds")
