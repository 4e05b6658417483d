"""Automatic drawings are good enough to publish: measured on random nets that were not used in
development."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.coordinator.drawing import render
from petrobot.coordinator.drawing.layout import COLUMN, ROW, WIDEST, Point, lay_out_blocks
from petrobot.coordinator.drawing.routing import ArcPath, Box, LabelBox, place_words, route
from petrobot.coordinator.drawing.scene import (
    DrawnNode,
    Scene,
    expanded,
    scene_of_net,
    scene_of_task,
)
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import load, loads
from tests.drawing.conftest import random_task

pytestmark = pytest.mark.once

SHIPPED = Path(__file__).parents[2] / "coordinator" / "tasks"
SEEDS = range(300, 316)


def crossings(ways: list[ArcPath]) -> int:
    """Count the pairs of arcs that cross, except those that share an end."""
    apart = [
        (a, b)
        for a, b in combinations(ways, 2)
        if {a.arc.source, a.arc.target}.isdisjoint((b.arc.source, b.arc.target))
    ]
    return sum(_cross(np.array(a.points), np.array(b.points)) for a, b in apart)


Array = NDArray[np.float64]


def _side(p: Array, q: Array, r: Array) -> Array:
    """Return on which side of the line from p to q the points r lie."""
    side: Array = (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (
        r[..., 0] - p[..., 0]
    )
    return side


def _cross(a: Array, b: Array) -> bool:
    if (a.min(0) > b.max(0)).any() or (b.min(0) > a.max(0)).any():
        return False
    a0, a1, b0, b1 = a[:-1, None], a[1:, None], b[None, :-1], b[None, 1:]
    over_a = _side(a0, a1, b0) * _side(a0, a1, b1) < 0
    return bool((over_a & (_side(b0, b1, a0) * _side(b0, b1, a1) < 0)).any())


def inside(p: Point, box: Box) -> bool:
    """Return whether a point lies in a box."""
    return box[0] < p[0] < box[2] and box[1] < p[1] < box[3]


def box_of(node: DrawnNode) -> Box:
    """Return the box that a node covers."""
    (x, y), (w, h) = node.at, node.half
    return x - w, y - h, x + w, y + h


def covers(a: Box, b: Box) -> bool:
    """Return whether two boxes overlap."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def through_nodes(scene: Scene, ways: list[ArcPath]) -> Iterator[tuple[ArcPath, str]]:
    """Yield the arcs that cross a node which is not one of their ends."""
    boxes = [(node.name, box_of(node)) for node in scene.nodes.values()]
    for way in ways:
        n = 200 * len(way.controls)
        # an own measure: `points` may miss a bar
        dense = np.array([way.point(i / n) for i in range(n + 1)])
        low, high = dense.min(0), dense.max(0)
        for name, box in boxes:
            if name in (way.arc.source, way.arc.target) or not covers(
                (*low, *high), (box[0] - 1, box[1] - 1, box[2] + 1, box[3] + 1)
            ):
                continue
            within = (dense > np.array(box[:2]) - 1) & (dense < np.array(box[2:]) + 1)
            if within.all(1).any():
                yield way, name


def through_words(words: list[LabelBox], ways: list[ArcPath]) -> int:
    """Count the labels with an arc through their middle, where it disturbs reading."""
    cores = [(w.box[0], w.box[1] + 4, w.box[2], w.box[3] - 4) for w in words]
    return sum(any(inside(p, core) for p in way.points) for core in cores for way in ways)


def drawn(scene: Scene) -> tuple[list[ArcPath], list[LabelBox]]:
    """Return the paths and labels of a scene."""
    ways = route(scene)
    return ways, place_words(scene.nodes, ways)


def test_random_nets_are_drawn_without_overlaps() -> None:
    """No overlapping nodes, no arc over a node, no label on a label or node; crossings are rare
    (all seeds)."""
    arcs = crossed = struck = 0
    for seed in SEEDS:
        scene = scene_of_net(random_task(np.random.default_rng(seed), 2 + seed % 3), None, None)
        ways, words = drawn(scene)
        boxes = [box_of(n) for n in scene.nodes.values()]
        assert not any(covers(a, b) for a, b in combinations(boxes, 2))
        assert not list(through_nodes(scene, ways))
        assert not any(covers(a.box, b.box) for a, b in combinations(words, 2))
        assert not any(covers(w.box, box) for w in words for box in boxes)
        arcs, crossed, struck = (
            arcs + len(ways),
            crossed + crossings(ways),
            struck + through_words(words, ways),
        )
    assert arcs > 300
    assert crossed <= 0.01 * arcs
    assert struck <= 0.01 * arcs


def unplaced(task: Task) -> Task:
    """Return the task without positions."""
    places = {n: replace(p, x=None, y=None) for n, p in task.places.items()}
    return replace(
        task,
        places=places,
        transitions={n: replace(t, x=None, y=None) for n, t in task.transitions.items()},
    )


@pytest.mark.parametrize("errors", [False, True])
@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.toml")), ids=lambda p: p.stem)
def test_shipped_tasks_are_drawn_well_without_positions(path: Path, errors: bool) -> None:
    """With automatic layout no arc crosses a node, and there are no more crossings than with
    manual positions."""
    task = load(path)
    by_hand = drawn(scene_of_task(task, errors, None, None))
    scene = scene_of_task(unplaced(task), errors, None, None)
    ways, words = drawn(scene)
    assert not list(through_nodes(scene, ways))
    assert crossings(ways) <= crossings(by_hand[0])
    assert through_words(words, ways) <= through_words(by_hand[1], by_hand[0])


def test_a_long_arc_back_runs_through_the_points_of_the_layout() -> None:
    """An arc over several columns runs smoothly through the points of the layout."""
    scene = scene_of_net(random_task(np.random.default_rng(1), 3), None, None)
    ways = route(scene)
    led = [w for w in ways if len(w.controls) > 1]
    assert led
    for way in led:
        steps = np.diff(np.array(way.points), axis=0)
        assert np.hypot(*steps.T).max() < 60
        assert way.points[0] == pytest.approx(way.start) and way.points[-1] == pytest.approx(
            way.end
        )


def chain(length: int, barred: str = "") -> Task:
    """Return a task of so many action places in a row, of which some hold one of two resources. A
    token in one of the places `barred` bars each fourth step."""
    places = [f'p{i} = {{ kind = "action", task = "w" }}' for i in range(length)]
    steps = []
    for i in range(length - 1):
        take, give = ', "arm"' * (i % 4 == 0), ', "arm"' * (i % 4 == 2)
        take += f', "!{barred}"' * (bool(barred) and i % 4 == 3)
        steps.append(f't{i} = {{ in = ["p{i}:normal"{take}], out = ["p{i + 1}"{give}] }}')
    text = "\n".join(
        [
            'schema = 1\n[task]\nname = "chain"\nfinal = "runs == 0"\n[errors]\nto = "stuck"',
            '[primitive_tasks.w]\ngoal = "x"\nalternatives = ["w"]\ndeadline = 1.0\n[places]',
            'runs = { kind = "control", tokens = 2 }\nstuck = {}',
            'arm = { kind = "resource", tokens = 1 }\nbase = { kind = "resource", tokens = 1 }',
            *places,
            '[transitions]\nstart = { in = ["runs", "base"], out = ["p0"] }',
            *steps,
            f'end = {{ in = ["p{length - 1}:normal"], out = ["base"] }}',
        ]
    )
    return loads(text)


@pytest.mark.parametrize("errors", [False, True])
@pytest.mark.parametrize("length", [16, 24, 40])
def test_a_long_net_is_folded(length: int, errors: bool) -> None:
    """It fits the width of a screen, and no node covers another."""
    scene = scene_of_task(chain(length), errors, None, None)
    boxes = [box_of(n) for n in scene.nodes.values()]
    assert not any(covers(a, b) for a, b in combinations(boxes, 2))
    across = [node.at[0] for node in scene.nodes.values()]
    assert max(across) - min(across) <= WIDEST * COLUMN
    down = [node.at[1] for node in scene.nodes.values()]
    assert max(down) - min(down) <= 3 * WIDEST * COLUMN
    for path in route(scene):  # no bar fits between two points that are tested for collisions
        steps = np.diff(np.array(path.points), axis=0)
        assert np.linalg.norm(steps, axis=1).max() < 24.0, path.arc


@pytest.mark.parametrize("length", [36, 40])
def test_no_arc_of_a_folded_net_turns_back(length: int) -> None:
    """Each second band runs to the left; an arc that goes on there has no barbs, and the picture
    shows all of it."""
    scene = scene_of_task(chain(length, "p1"), False, None, None)
    paths = route(scene)
    assert any(len(path.controls) > 2 for path in paths)
    for path in paths:
        steps = np.diff(np.array(path.points), axis=0)
        steps /= np.linalg.norm(steps, axis=1, keepdims=True)
        assert (steps[1:] * steps[:-1]).sum(axis=1).min() > -0.5, path.arc
    found = re.search(r'viewBox="(\S+) (\S+) (\S+) (\S+)"', render(scene))
    assert found is not None
    left, top, width, height = map(float, found.groups())
    whole = left, top, left + width, top + height
    assert all(inside(point, whole) for path in paths for point in path.points)


SORTER = Path(__file__).parents[2] / "examples" / "sorter" / "sort.toml"


def test_tokens_that_a_short_form_adds_are_no_runs() -> None:
    """Two tries are left of the three of `grip`: shown in the expanded net alone."""
    task = load(SORTER)
    folded = scene_of_task(task, True, None, None)
    assert folded.nodes["grip"].tokens == 0 and folded.nodes["parts"].tokens == 5
    whole = scene_of_task(expanded(task), True, None, None)
    assert whole.nodes["grip"].tokens == 0 and whole.nodes["grip.left"].tokens == 2
    assert set(whole.nodes) == {*task.flat.places, *task.flat.transitions}
    plain = load(SORTER.parents[2] / "coordinator" / "tasks" / "catch_ball.toml")
    assert expanded(plain) is plain


def test_what_follows_without_a_branch_is_level() -> None:
    """From the scanned part to the grip; `[errors]` adds branches on the way."""
    nodes = scene_of_task(load(SORTER), False, None, None).nodes
    row = {nodes[name].at[1] for name in ("scanned", "pick", "fetch", "there", "grip")}
    assert len(row) == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_blocks_never_overlap(seed: int) -> None:
    """At random places, some of them nearly equal, some unknown; joined within and at random."""
    rng = np.random.default_rng(seed)
    block_of = {f"n{i}": f"b{rng.integers(9)}" for i in range(60)}
    at = {f"b{i}": (float(rng.integers(5)) * 90, float(rng.integers(5)) * 40) for i in range(7)}
    edges = [(f"n{a}", f"n{b}") for a, b in rng.integers(60, size=(90, 2)).tolist()]
    found = lay_out_blocks(block_of, at, edges).at
    assert set(found) == set(block_of)
    boxes = dict[str, list[float]]()
    for name, (x, y) in found.items():
        left, top, right, bottom = boxes.get(block_of[name], [x, y, x, y])
        boxes[block_of[name]] = [min(x, left), min(y, top), max(x, right), max(y, bottom)]
    for (a, one), (b, other) in combinations(boxes.items(), 2):
        aside = max(other[0] - one[2], one[0] - other[2]) >= COLUMN
        assert aside or max(other[1] - one[3], one[1] - other[3]) >= ROW, (a, b)
