"""Drawings: complete, valid, texts do not overlap, error branches are folded."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import pytest
from msgspec.structs import replace

from petrobot.coordinator.drawing import draw
from petrobot.coordinator.drawing.layout import lay_out
from petrobot.coordinator.drawing.routing import LabelBox, place_words, route
from petrobot.coordinator.drawing.scene import scene_of_task
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import load
from tests.drawing.test_quality import unplaced

SHIPPED = Path(__file__).parents[2] / "coordinator" / "tasks"
Tasks = Callable[..., Task]
SVG = "{http://www.w3.org/2000/svg}"


def elements(svg: str, tag: str, style: str) -> list[ElementTree.Element]:
    """Elements of a tag that have a CSS class."""
    return [
        e
        for e in ElementTree.fromstring(svg).iter(SVG + tag)
        if style in e.get("class", "").split()
    ]


def texts(svg: str) -> set[str]:
    """Return all texts."""
    return {e.text or "" for e in ElementTree.fromstring(svg).iter(SVG + "text")}


@pytest.mark.parametrize("errors", [True, False])
@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.toml")), ids=lambda p: p.stem)
def test_shipped_tasks_are_drawn_whole(path: Path, errors: bool) -> None:
    task = load(path)
    svg = draw(task, error_branches=errors)
    hidden = set() if errors else task.error_elements
    root = ElementTree.fromstring(svg)
    assert (
        root.get("role") == "img"
        and root[0].text == task.name
        and "Tokens:" in (root[1].text or "")
    )
    drawn = {g.get("id") for g in root.iter(SVG + "g")}
    assert (set(task.transitions) - hidden) <= drawn and drawn.isdisjoint(hidden)


@pytest.mark.parametrize("errors", [True, False])
@pytest.mark.parametrize("placed", [True, False])
@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.toml")), ids=lambda p: p.stem)
def test_words_cover_neither_nodes_nor_each_other(path: Path, errors: bool, placed: bool) -> None:
    task = load(path) if placed else unplaced(load(path))
    scene = scene_of_task(task, errors, None, None)
    words = place_words(scene.nodes, route(scene))
    assert not [(a.node.name, b.node.name) for a, b in combinations(words, 2) if overlap(a, b)]
    for w in words:
        for node in scene.nodes.values():
            (x, y), (rx, ry) = node.at, node.half
            assert not (
                w.box[0] < x + rx and x - rx < w.box[2] and w.box[1] < y + ry and y - ry < w.box[3]
            )


def overlap(a: LabelBox, b: LabelBox) -> bool:
    """Return whether two text blocks overlap."""
    return (
        a.box[0] < b.box[2] and b.box[0] < a.box[2] and a.box[1] < b.box[3] and b.box[1] < a.box[3]
    )


def test_tokens_are_dots_up_to_four(task: Tasks) -> None:
    svg = draw(task("p=1 q=4 r=5", {"t": {"in": "p q r"}}))
    assert len(elements(svg, "circle", "token")) == 5 and "5" in texts(svg)


def test_marking_replaces_the_initial_tokens(task: Tasks) -> None:
    svg = draw(task("p=1 q", {"t": {"in": "p", "out": "q"}}), marking=(0, 3))
    assert len(elements(svg, "circle", "token")) == 3


def test_kinds_events_weights_and_inhibitors_are_seen(task: Tasks) -> None:
    net = {
        "t": {"in": "p*2 !r", "out": "a", "event": "tick"},
        "u": {"in": "a:normal", "when": "k > 1 and k < 4"},
        "v": {"in": "a:preempt=none", "after": 2.5},
        "w": {"in": "a:going", "event": "seen"},
    }
    svg = draw(task("p=2 a! r~", net, "tick seen<a", {"k": 0}))
    assert {"ext tick", "int seen", "int u", "[k > 1 and k < 4]", "v: after 2.5 s", "2"} <= texts(
        svg
    )
    assert (
        len(elements(svg, "circle", "ring")) == 1 and len(elements(svg, "circle", "control")) == 1
    )
    assert (
        len(elements(svg, "circle", "inhibitor")) == 1
        and len(elements(svg, "path", "preempt")) == 1
    )
    assert len(elements(svg, "path", "going")) == 1


def test_folded_error_branches_leave_a_badge(task: Tasks) -> None:
    net = {
        "n": {"in": "a:normal", "out": "y"},
        "e": {"in": "a:error", "out": "r"},
        "back": {"in": "r", "out": "a"},
    }
    made = task("a!=1 y r", net)
    folded, whole = draw(made), draw(made, error_branches=True)
    assert len(elements(folded, "circle", "badge")) == 1 and not elements(folded, "rect", "error")
    assert len(elements(whole, "rect", "error")) == 2 and not elements(whole, "circle", "badge")
    assert len(elements(whole, "path", "error")) == 4


def test_names_are_escaped(task: Tasks) -> None:
    made = task("p=1", {"t": {"in": "p"}})
    evil = replace(made, name="<script>&", places={"p": replace(made.places["p"], label='"<b>')})
    svg = draw(evil)
    assert "<script>" not in svg and "<b>" not in svg and '"<b>' in texts(svg)


def test_ordinary_net_is_drawn(task: Tasks) -> None:
    svg = draw(task("p=1 q", {"t": {"in": "p", "out": "q"}, "u": {"in": "q !p*2", "out": "p"}}).net)
    assert {"p", "q", "t", "u"} <= texts(svg) and len(elements(svg, "circle", "inhibitor")) == 1


def test_layout_keeps_given_positions_and_fills_in_the_rest() -> None:
    wanted = {"a": (0.0, 0.0), "b": (240.0, 0.0), "t": None, "u": None, "c": (120.0, 210.0)}
    at = lay_out(wanted, [("a", "t"), ("t", "b"), ("b", "u"), ("u", "a")], ["a"]).at
    assert all(at[n] == p for n, p in wanted.items() if p is not None)
    assert len(set(at.values())) == 5


def test_layout_goes_along_the_flow() -> None:
    at = lay_out(
        dict.fromkeys("abcde"), [("a", "b"), ("b", "c"), ("c", "d"), ("d", "a"), ("b", "e")], ["a"]
    ).at
    assert (
        at["a"][0] < at["b"][0] < at["c"][0] < at["d"][0]
        and at["e"][0] == at["c"][0]
        and at["e"] != at["c"]
    )


def test_empty_net_is_drawn(task: Tasks) -> None:
    assert ElementTree.fromstring(draw(task("", {}, final="1 == 1"))).tag == SVG + "svg"
