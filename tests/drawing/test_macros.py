"""Macro places that group nodes: what a task file may declare, what it changes, how it is drawn."""

from __future__ import annotations

import argparse
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from petrobot.coordinator.cli import CommandError, show
from petrobot.coordinator.drawing import Overlay, draw
from petrobot.coordinator.drawing.scene import scene_of_task, sheet_of
from petrobot.coordinator.operator.net_state import picture
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import TaskFileError, dumps, load, loads

SHIPPED = [
    *sorted(Path("coordinator/tasks").glob("*.toml")),
    *(path for path in sorted(Path("examples").glob("*/*.toml")) if path.stem != "services"),
]

TEXT = """
schema = 1
[task]
name = "m"
final = "done == 1"
[places]
begin = { kind = "control", tokens = 1 }
inner = { kind = "macro", macro = "outer", label = "inner work" }
outer = { kind = "macro" }
a = { kind = "control", macro = "inner" }
b = { kind = "control", macro = "inner", tokens = 1 }
c = { kind = "control", macro = "outer" }
done = { kind = "control" }
use = { kind = "macro", subnet = "sub" }
[transitions]
t1 = { in = ["begin"], out = ["a", "b"] }
t2 = { in = ["a", "b"], out = ["b"], macro = "inner" }
t3 = { in = ["b"], out = ["c"], macro = "outer" }
t4 = { in = ["c"], out = ["done", "use"] }
t5 = { in = ["use:normal"], out = ["done"] }
[subnets.sub]
entry = "x"
normal = "y"
[subnets.sub.places]
g = { kind = "macro" }
x = { kind = "control", macro = "g" }
y = { kind = "control" }
[subnets.sub.transitions]
s = { in = ["x"], out = ["y"] }
"""


def flat_twin() -> Task:
    """Return the same task without groups."""
    lines = [
        line for line in TEXT.splitlines() if not line.startswith(("inner =", "outer =", "g ="))
    ]
    text = "\n".join(lines)
    for macro in ("inner", "outer", "g"):
        text = text.replace(f', macro = "{macro}"', "")
    return loads(text)


def test_grouping_changes_nothing_but_the_drawing() -> None:
    """The ordinary net, and so every analysis and run, equals that of the task without groups."""
    task = loads(TEXT)
    assert task.net == flat_twin().net
    assert loads(dumps(task)) == task
    assert {n: p.macro for n, p in task.flat.places.items()} == {
        "begin": "",
        "a": "inner",
        "b": "inner",
        "c": "outer",
        "done": "",
        "use.x": "use.g",
        "use.y": "use",
    }


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('out = ["done", "use"]', 'out = ["outer"]', "transitions.t4"),
        ('macro = "outer", label', 'macro = "inner", label', "places.inner.macro"),
        ('t1 = { in = ["begin"]', 't1 = { macro = "inner", in = ["begin"]', "transitions.t1.macro"),
        (
            'a = { kind = "control", macro = "inner"',
            'a = { kind = "control", macro = "inne"',
            "places.a.macro",
        ),
        ('macro = "inner", tokens', 'macro = "use", tokens', "places.b.macro"),
        ('outer = { kind = "macro"', 'outer = { kind = "macro", tokens = 1', "places.outer"),
        ('"y" }', '"y" }', ""),
    ],
)
def test_invalid_groups_are_refused(old: str, new: str, key: str) -> None:
    """Each error names its key and a remedy."""
    if not key:
        loads(TEXT)
        return
    assert old in TEXT
    with pytest.raises(TaskFileError) as caught:
        loads(TEXT.replace(old, new))
    assert [f.key for f in caught.value.faults] == [key]
    assert caught.value.faults[0].remedy


def test_a_macro_place_is_drawn_as_one_with_its_tokens_summed() -> None:
    """Arcs to several places inside become one arc; the inside is drawn with its surroundings."""
    task = loads(TEXT)
    scene = scene_of_task(task, True, None, None)
    assert set(scene.nodes) == {"begin", "outer", "done", "use", "t1", "t4", "t5"}
    assert scene.nodes["outer"].tokens == 1
    assert {(a.source, a.target): a.weight for a in scene.arcs}["t1", "outer"] == 2
    opened = scene_of_task(task, True, None, None, "outer")
    assert set(opened.nodes) == {"inner", "c", "t3", "t1", "t4"}
    assert sheet_of(task, "outer", True, None).border == {"t1", "t4"}
    assert set(scene_of_task(task, True, None, None, "use").nodes) == {"g", "y", "s"}
    assert set(scene_of_task(task, True, None, None, "use.g").nodes) == {"x", "s"}
    with pytest.raises(ValueError, match="no macro place 'nowhere'"):
        draw(task, inside="nowhere")


def test_the_overlay_of_the_inside_is_shown_on_the_macro_place() -> None:
    """Heat and firing numbers go to the macro place that is drawn instead."""
    svg = draw(loads(TEXT), overlay=Overlay(heat={"a": 0.3, "use.x": 0.2}, path=["t1", "t2", "t3"]))
    texts = [e.text for e in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]
    assert "2, 3" in texts and svg.count('class="warm"') == 2


def test_the_page_knows_the_nesting_of_macro_places() -> None:
    """The snapshot lists every macro place and the one around it."""
    made = picture(loads(TEXT))
    around = {p["name"]: p["in_macro"] for p in made["places"] if p["kind"] == "macro"}
    assert around == {"inner": "outer", "outer": "", "use": "", "use.g": "use"}
    assert {t["name"]: t["in_macro"] for t in made["transitions"]}["use.s"] == "use"


def test_the_command_opens_a_macro_place(tmp_path: Path) -> None:
    """`petrobot show --inside` draws the inside; an unknown name is bad input, and the known
    ones are listed."""
    parser = argparse.ArgumentParser()
    show.add_arguments(parser)
    task, out = tmp_path / "m.toml", tmp_path / "m.svg"
    task.write_text(TEXT)
    assert show.run(parser.parse_args([str(task), "--inside", "outer", "--out", str(out)])) == 0
    assert "inner work" in out.read_text() and ">m: outer<" in out.read_text()
    with pytest.raises(
        CommandError, match="no macro place 'nowhere'; it has inner, outer, use"
    ) as caught:
        show.run(parser.parse_args([str(task), "--inside", "nowhere", "--out", str(out)]))
    assert caught.value.exit_code == 2


SHORT = """
schema = 1
[task]
name = "short"
final = "done == 1"
final_error = "lost > 0"
[errors]
to = "lost"
[primitive_tasks.dock]
goal = "It is there"
alternatives = ["dock"]
deadline = 1.0
[places]
begin = { kind = "control", tokens = 1 }
go = { kind = "macro", subnet = "go" }
own = { kind = "action", task = "dock", tries = 2 }
done = { kind = "control" }
lost = { kind = "control" }
[transitions]
start = { in = ["begin"], out = ["go"] }
there = { in = ["go:normal"], out = ["own"] }
good = { in = ["own:normal"], out = ["done"] }
[subnets.go]
entry = "dock"
normal = "docked"
error = "failed"
[subnets.go.errors]
to = "failed"
[subnets.go.places]
dock = { kind = "action", task = "dock", tries = 3 }
docked = { kind = "control" }
failed = { kind = "control" }
[subnets.go.transitions]
end = { in = ["dock:normal"], out = ["docked"] }
"""


@pytest.mark.parametrize(
    ("inside", "branches", "tokens"),
    [
        ("", {("go", "lost"), ("own", "lost")}, {"begin": 1}),
        ("go", {("dock", "failed")}, {}),
    ],
)
def test_short_forms_add_branches_to_the_drawing_and_no_tokens(
    inside: str, branches: set[tuple[str, str]], tokens: dict[str, int]
) -> None:
    """`[errors]` adds error branches, which are drawn as those of the file; `tries` adds tokens,
    which only count and are not drawn."""
    task = loads(SHORT)
    drawn = scene_of_task(task, True, None, None, inside)
    assert {n: node.tokens for n, node in drawn.nodes.items() if node.tokens} == tokens
    came = {arc.target: arc.source for arc in drawn.arcs if arc.kind == "error"}
    assert {(came[a.source], a.target) for a in drawn.arcs if a.source in came} == branches
    folded = scene_of_task(task, False, None, None, inside)
    assert {a.kind for a in folded.arcs}.isdisjoint({"error"})
    assert "lost" not in folded.nodes and "failed" not in folded.nodes
    assert all(folded.nodes[place].hidden == 1 for place, _ in branches)


def test_a_marking_in_words_shows_tries_only_when_they_have_counted() -> None:
    net = loads(SHORT).net
    assert net.describe(net.initial) == "begin"
    used = list(net.initial)
    used[net.place_index["own.left"]], used[net.place_index["own.used"]] = 0, 1
    assert net.describe(tuple(used)) == "begin own.left:0 own.used"


def test_the_page_draws_what_errors_adds_and_no_condition_that_the_file_lacks() -> None:
    """The same as `show --errors`: an exit that `[errors]` adds is drawn, its copies are not."""
    made = {t["name"]: t for t in picture(loads(ADDED_EXITS))["transitions"]}
    drawn = {name for name, t in made.items() if not t["made_from"]}
    written = {"look", "seen", "go_home", "home", "stranded", "fetch.arrived"}
    assert drawn == written | {"fetch.drive.error", "fetch.error", "read.error"}
    assert not any(made[name]["when"] for name in drawn)
    assert made["read.error.1"]["made_from"] == "read.error"
    assert made["seen.1"]["made_from"] == "seen" and made["read.retry"]["made_from"] == "read"


@pytest.mark.parametrize("text", ["ADDED_EXITS", "HELD", *map(str, SHIPPED)])
def test_the_page_draws_the_arcs_and_error_branches_that_show_draws(text: str) -> None:
    """What `holds` takes and gives back is written under the place, in both drawings."""
    task = loads(globals()[text]) if text in globals() else load(Path(text))
    scene, page = scene_of_task(task, True, None, None), picture(task)
    made = {e["name"] for kind in ("places", "transitions") for e in page[kind] if e["made_from"]}
    drawn = {
        (scene.shown.get(a["place"], a["place"]), a["transition"], a["direction"] == "out")
        for a in page["arcs"]
        if not a["made"] and a["place"] not in made and a["transition"] in scene.nodes
    }
    there = {
        (a.target, a.source, True)
        if scene.nodes[a.target].is_place
        else (a.source, a.target, False)
        for a in scene.arcs
    }
    assert drawn == there
    errors = {t["name"] for t in page["transitions"] if t["error"]} & set(scene.nodes)
    exits = {n for n, node in scene.nodes.items() if not node.is_place and "error" in node.style}
    assert errors == exits
    told = {p["name"]: p["in_short"] for p in page["places"] if not p["in_macro"]}
    for name, words in told.items():
        assert name in made or words in scene.nodes[name].lines[-1]


def test_a_macro_place_says_what_is_held_inside() -> None:
    """So a resource without an arc is not a riddle; a parameter has the name of what it stands
    for."""
    task = loads(HELD)
    assert task.in_short(task.places["fetch"]) == "holds arm inside"


HELD = """schema = 1
[task]
name = "held"
final = "jobs == 1"
[errors]
to = "hurt"
[primitive_tasks]
grip = { deadline = 9.0 }
[places]
jobs = { kind = "control", tokens = 1 }
arm = { kind = "resource", tokens = 1 }
grip = { kind = "action", tries = 2, holds = "arm" }
fetch = { kind = "macro", subnet = "go", args = { tool = "arm" } }
hurt = {}
[transitions]
begin = { in = ["jobs"], out = ["grip"] }
gripped = { in = ["grip:normal"], out = ["fetch"] }
fetched = { in = ["fetch:normal"], out = ["jobs"] }
cleared = { in = ["hurt", "arm"], out = ["jobs", "arm"] }
[subnets.go]
entry = "grip"
normal = "there"
error = "failed"
parameters = { tool = "place" }
[subnets.go.places]
grip = { kind = "action", holds = "tool", timeout = 5.0 }
there = {}
failed = {}
[subnets.go.transitions]
gripped = { in = ["grip:normal"], out = ["there"] }
empty = { in = ["grip:normal"], when = "grip.status == 'failure'", out = ["failed"] }
slipped = { in = ["grip:error"], out = ["failed"] }
"""


ADDED_EXITS = """schema = 1
[task]
name = "exits"
final = "hurt == 0"
[errors]
to = "hurt"
[primitive_tasks]
drive = { deadline = 9.0 }
read = { deadline = 3.0 }
park = { deadline = 20.0 }
[places]
fetch = { kind = "macro", subnet = "go" }
read = { kind = "action", tries = 2 }
hurt = {}
park = { kind = "action", tries = 2 }
[transitions]
look = { in = ["fetch:normal"], out = ["read"] }
seen = { in = ["read:normal"] }
go_home = { in = ["hurt"], out = ["park"] }
home = { in = ["park:normal"] }
stranded = { in = ["park:error"] }
[subnets.go]
entry = "drive"
normal = "there"
error = "failed"
[subnets.go.errors]
to = "failed"
[subnets.go.places]
drive = { kind = "action" }
there = {}
failed = {}
[subnets.go.transitions]
arrived = { in = ["drive:normal"], out = ["there"] }
"""
