"""The designer in a real browser on difficult tasks: macro places, unusual files, large nets, nets
of other tools."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from petrobot.coordinator.drawing.layout import COLUMN, WIDEST, lay_out
from petrobot.coordinator.page.edits import edited, parse, plain
from petrobot.coordinator.page.server import Page
from petrobot.coordinator.task.expansion import with_error_branches
from petrobot.coordinator.task.file import load
from tests.drawing.conftest import random_task
from tests.page.conftest import (
    PATIENCE_MS,
    browser_missing,
    errors_of,
    new_window,
    note_toasts,
    toasted,
)
from tests.page.stage import Stage

if browser_missing() and os.environ.get("CI") != "true":
    pytest.skip(browser_missing(), allow_module_level=True)

from playwright.async_api import Browser, Locator, Page as Tab, Route, WebSocketRoute, expect

from tests.page.steps import click_canvas, element, settled
from tests.waiting import until

DRAWING = "Drawing of the task"
SHIPPED = Path(__file__).parents[2] / "coordinator" / "tasks" / "catch_ball.toml"
expect.set_options(timeout=PATIENCE_MS)


async def designing(
    browser: Browser, page: Page, task: str = "pick_and_place"
) -> tuple[Tab, list[str]]:
    """Open the designer with a task; also return the list of errors in its window."""
    tab = await new_window(browser)
    await tab.goto(f"{page.url}#design")
    await settled(tab)
    await expect(tab.get_by_label("Task", exact=True)).to_have_value("pick_and_place")
    await note_toasts(tab)
    if task != "pick_and_place":
        await open_task(tab, task)
    return tab, errors_of(tab)


async def open_task(tab: Tab, task: str) -> None:
    """Choose a task and wait until the designer shows it."""
    async with tab.expect_response(f"**/api/tasks/{task}"):
        await tab.get_by_label("Task", exact=True).select_option(task)
    await settled(tab)
    await expect(tab.get_by_label("Task", exact=True)).to_have_value(task)
    await expect(tab.locator(".saved")).to_have_text("saved")


def properties(tab: Tab) -> Locator:
    """Return the form on the right."""
    return tab.get_by_role("complementary", name="Properties")


async def choose(tab: Tab, *names: str) -> None:
    """Select several elements."""
    for i, name in enumerate(names):
        await element(tab, name).click(modifiers=["Shift"] if i else [])


async def drag(tab: Tab, name: str, dx: float, dy: float) -> None:
    """Drag an element with the mouse (pixels of the window)."""
    box = await element(tab, name).bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await tab.mouse.move(x, y)
    await tab.mouse.down()
    await tab.mouse.move(x + dx, y + dy, steps=7)
    await tab.mouse.up()


async def save(tab: Tab) -> None:
    """Save, and wait for the server's answer to this save, not to an earlier one."""
    async with tab.expect_response(
        lambda answer: answer.request.method == "PUT" and "/api/tasks/" in answer.url
    ):
        await tab.keyboard.press("Control+s")
    await expect(tab.locator(".saved")).to_have_text("saved")


# ---- arranging


async def test_an_opened_task_is_shown_whole(browser: Browser, page: Page, tasks: Path) -> None:
    """On a laptop's screen every element is inside the drawing with its labels and arcs, and every
    field inside the form."""
    shutil.copy(SHIPPED, tasks)
    tab, complaints = await designing(browser, page, "catch_ball")
    beyond = """(drawing) => {
      const all = drawing.getBoundingClientRect();
      return [...drawing.querySelectorAll("[data-name], [data-name] text, path")].filter((one) => {
        const box = one.getBoundingClientRect();
        const beside = box.left < all.left || box.right > all.right;
        return box.width && (beside || box.top < all.top || box.bottom > all.bottom);
      }).map((one) => one.dataset.name ?? one.textContent);
    }"""
    drawing = tab.get_by_role("application", name=DRAWING)
    assert await drawing.locator("[data-name]").count() > 20
    assert await drawing.evaluate(beyond) == []
    assert await properties(tab).evaluate("(form) => form.scrollWidth - form.clientWidth") == 0
    assert complaints == []


async def test_selected_elements_are_aligned(browser: Browser, page: Page, tasks: Path) -> None:
    """Buttons align them in a row, in a column, evenly spaced or on the grid; each is one step of
    undo."""
    path = tasks / "pick_and_place.toml"
    names = ("look", "pick", "put")
    before = {name: (place.x, place.y) for name, place in load(path).places.items()}
    tab, complaints = await designing(browser, page)
    await drag(tab, "^Action place pick", 37, 53)
    await choose(tab, *(f"^Action place {name}" for name in names))

    async def arranged(button: str) -> list[tuple[float, float]]:
        await properties(tab).get_by_role("button", name=button).click()
        await save(tab)
        return [
            (place.x or 0.0, place.y or 0.0) for place in map(load(path).places.__getitem__, names)
        ]

    row = await arranged("Align in a row")
    assert len({y for _, y in row}) == 1 and row[0][1] % 10 == 0
    evenly = await arranged("Space evenly")
    xs = sorted(x for x, _ in evenly)
    assert abs((xs[2] - xs[1]) - (xs[1] - xs[0])) <= 10 and xs[0] != xs[1]
    column = await arranged("Align in a column")
    assert len({x for x, _ in column}) == 1
    for _ in ("column", "evenly", "row", "drag"):
        await tab.keyboard.press("Control+z")
    await save(tab)
    assert {name: (place.x, place.y) for name, place in load(path).places.items()} == before
    assert not complaints


async def test_the_running_task_is_opened_first(browser: Browser, page: Page, tasks: Path) -> None:
    """If the page is loaded with the designer in front, it waits until it knows which task is
    running, however many tasks are listed before it."""
    (tasks / "earlier.toml").write_text((tasks / "pick_and_place.toml").read_text())
    tab = await browser.new_page()
    held: list[Callable[[], None]] = []

    def slowly(socket: WebSocketRoute) -> None:
        server = socket.connect_to_server()
        socket.on_message(server.send)
        server.on_message(lambda message: held.append(lambda: socket.send(message)))

    await tab.route_web_socket("**/api/live", slowly)
    async with tab.expect_response("**/api/offers"):
        await tab.goto(f"{page.url}#Design")
    picker = tab.get_by_label("Task", exact=True)
    await expect(tab.locator(".designer")).to_have_attribute("aria-busy", "true")
    await until(lambda: bool(held))
    await expect(picker).to_have_value("")
    while held:
        held.pop(0)()
    await settled(tab)
    await expect(picker).to_have_value("pick_and_place")


async def test_a_dragged_element_lands_on_the_grid(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """At any zoom, positions are multiples of ten."""
    path = tasks / "pick_and_place.toml"
    tab, complaints = await designing(browser, page)
    await tab.get_by_role("button", name="Zoom in").click()
    old = load(path).places["pick"]
    await drag(tab, "^Action place pick", 37, 53)
    await save(tab)
    new = load(path).places["pick"]
    assert new.x is not None and new.y is not None and (new.x, new.y) != (old.x, old.y)
    assert new.x % 10 == 0 and new.y % 10 == 0
    assert not complaints


# ---- macro places


async def test_a_part_of_the_net_becomes_a_macro_place(
    browser: Browser, page: Page, stage: Stage, tasks: Path
) -> None:
    """Group, open, nest, save, undo and dissolve it; in the live view it is closed and shows the
    sum of its tokens."""
    path = tasks / "pick_and_place.toml"
    before, flat = path.read_text(), load(path).flat.net
    tab, complaints = await designing(browser, page)
    await choose(tab, "^Action place pick", "^Action place put")
    await tab.keyboard.press("Control+g")
    await expect(element(tab, "^Macro place macro, 0 tokens")).to_be_visible()
    await expect(element(tab, "^Action place pick")).to_have_count(0)
    await properties(tab).get_by_label("Name", exact=True).fill("handling")
    await tab.keyboard.press("Enter")
    await expect(element(tab, "^Macro place handling")).to_be_visible()
    await save(tab)
    grouped = load(path)
    assert grouped.places["pick"].macro == grouped.places["put"].macro == "handling"
    assert (
        grouped.transitions["picked"].macro == "handling" and not grouped.transitions["begin"].macro
    )
    assert grouped.flat.net == flat, "grouping must change nothing but the drawing"
    left = iter(path.read_text().splitlines())
    assert all(line in left for line in before.splitlines()), "a line was lost or moved"

    await element(tab, "^Macro place handling").dblclick()
    await expect(element(tab, "^Action place pick,")).to_be_visible()
    await expect(element(tab, "^Action place look")).to_have_count(0)
    await choose(tab, "^Action place pick,")
    await tab.keyboard.press("Control+g")
    await expect(element(tab, "^Macro place macro")).to_be_visible()
    await (
        tab.get_by_role("navigation", name="Opened macro places")
        .get_by_role("button", name="pick and place")
        .click()
    )
    await tab.get_by_role("searchbox", name="Find a place or transition").fill("pick")
    found = tab.get_by_role("option", name=re.compile("^pick ?action in macro"))
    await found.click()
    await expect(properties(tab).get_by_label("Name", exact=True)).to_have_value("pick")
    await save(tab)
    nested = load(path)
    assert (nested.places["pick"].macro, nested.places["macro"].macro) == ("macro", "handling")

    stage.load(nested, path.read_text())
    await tab.get_by_role("tab", name="Live").click()
    await tab.get_by_role("button", name="Take controls").click()
    await expect(tab.get_by_role("toolbar", name="Mission")).to_contain_text(
        "You hold the controls"
    )
    holder = stage.controls.holder
    assert holder is not None
    stage.kept.update({"pick", "put"})
    assert (await stage.command(holder, "start", {"task": "pick_and_place"}))["ok"]
    stage.happen("part_there")
    await expect(element(tab, "^Macro place handling, 1 token", "Task net")).to_be_visible()
    await element(tab, "^Macro place handling", "Task net").dblclick()
    await expect(element(tab, "^Macro place macro, 1 token", "Task net")).to_be_visible()
    await element(tab, "^Macro place macro", "Task net").dblclick()
    await expect(element(tab, "^Action place pick, 1 token", "Task net")).to_be_visible()
    trail = tab.get_by_role("navigation", name="Opened macro places")
    await expect(trail.get_by_role("button")).to_have_text(["pick and place", "handling", "macro"])

    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)
    for _ in range(3):
        await tab.get_by_role("button", name="Undo").click()
    await expect(element(tab, "^Action place pick,")).to_be_visible()
    await save(tab)
    assert path.read_text() == before
    assert complaints == []


async def test_macro_places_by_keyboard_and_their_rules(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """Open and draw in an empty macro place; arcs may lead to places inside; elements outside stay
    outside; it is deleted as a whole."""
    tab, complaints = await designing(browser, page)
    await tab.get_by_role("button", name="New task").press("Enter")
    await tab.get_by_role("application", name=DRAWING).focus()
    await tab.keyboard.press("t")
    await tab.keyboard.press("Enter")
    await tab.keyboard.press("4")
    await tab.keyboard.press("Enter")
    await expect(element(tab, "^Macro place macro")).to_be_visible()
    await tab.keyboard.press("o")
    for key in "23":
        await tab.keyboard.press(key)
        await tab.keyboard.press("Enter")
    await expect(element(tab, "^Control place control")).to_be_visible()
    await tab.keyboard.press("Escape")
    await (
        tab.get_by_role("navigation", name="Opened macro places")
        .get_by_role("button")
        .first.press("Enter")
    )
    await expect(element(tab, "^Macro place macro, 1 token")).to_be_visible()
    await tab.get_by_role("application", name=DRAWING).focus()
    await tab.keyboard.press("]")
    await tab.keyboard.press("a")
    await tab.keyboard.press("]")
    await tab.keyboard.press("Enter")
    dialog = tab.get_by_role("dialog", name="Which place inside macro?")
    await dialog.get_by_label("Place").select_option("control")
    await dialog.get_by_role("button", name="OK").press("Enter")
    await expect(element(tab, "^Arc from transition to macro")).to_have_count(1)
    await element(tab, "^Macro place macro").press("o")
    await expect(element(tab, "^Arc from transition to control")).to_have_count(1)
    await expect(
        element(tab, "^Transition transition")
    ).to_be_visible()  # drawn next to it, as its surroundings
    await tab.keyboard.press("Backspace")
    await element(tab, "^Macro place macro").click()
    await tab.keyboard.press("Delete")
    await expect(element(tab, " place ")).to_have_count(0)
    await tab.get_by_role("button", name="Undo").click()
    await expect(element(tab, "^Macro place macro, 1 token")).to_be_visible()
    await element(tab, "^Macro place macro").click()
    await tab.keyboard.press("Control+c")
    await tab.keyboard.press("Control+v")
    await expect(element(tab, "^Macro place macro_2, 1 token")).to_be_visible()
    await tab.keyboard.press("Control+Shift+g")
    await expect(element(tab, "^Control place control_2")).to_be_visible()
    await expect(element(tab, "^Macro place macro_2")).to_have_count(0)
    assert complaints == []


async def test_what_the_nodes_offer_now_can_be_chosen(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """A node that joins during drawing adds its primitive tasks and arguments; one that leaves
    causes a finding."""
    tab, complaints = await designing(browser, page)
    await element(tab, "^Action place put").click()
    choice = properties(tab).get_by_label("Primitive task")
    await expect(choice.get_by_role("option", name=re.compile("weigh"))).to_have_count(0)
    stage.where["weigh"] = "scale"
    stage.feed.emit("node", name="scale", node={"state": "up", "round_trip": 0.001})
    await expect(choice.get_by_role("option", name="weigh (on scale)")).to_have_count(1)
    await choice.select_option("weigh")
    await expect(properties(tab)).to_contain_text("weigh")
    del stage.where["weigh"]
    stage.feed.emit("node", name="scale", node={"state": "lost"})
    await expect(tab.get_by_role("region", name="Findings")).to_contain_text("weigh")
    await expect(properties(tab)).to_contain_text("no node offers it")
    assert complaints == []


# ---- files written by people
# ------------------------------------------------------------------------------------------

ODD = """# a file that has seen several editors\r
schema = 1   # the only one\r
\r
[places]\r
belt = { kind = "control", tokens = 2 } # inline\r
"größe" = { kind = "resource", label = 'a "quoted" name' }\r
\r
[transitions.take]   # before its places and events\r
\tin = [\r
    "belt", # one part\r
\t  "größe", ]\r
out = ["grip"]\r
event = "part_there"\r
\r
[task]\r
name = 'odd'\r
final = \"\"\"belt == 0\"\"\"\r
\r
[events.part_there]\r
scope = "external"\r
[places.grip]\r
kind = "action"\r
task = "pick"   # offered by the arm's node\r
[transitions."done"]\r
in = ["grip:normal"]\r
out = ["größe"]\r
[transitions.failed]\r
in = ["grip:error"]\r
out = ["größe", "belt"]\r
[primitive_tasks.pick]\r
goal = "the part is in the gripper"\r
alternatives = ["pick"]\r
deadline = 5.0 # s"""


async def test_an_unusual_file_keeps_every_byte_that_was_not_edited(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """With CR LF, inline tables, arrays on several lines, unicode, quotes and no positions, a file
    saved without an edit is unchanged."""
    path = tasks / "odd.toml"
    path.write_bytes(ODD.encode())
    tab, complaints = await designing(browser, page, "odd")
    await expect(element(tab, "^Resource place a .quoted. name")).to_be_visible()
    await save(tab)
    await toasted(tab, "^Saved$")
    assert path.read_bytes() == ODD.encode()
    await element(tab, "^Action place grip").click()
    await tab.keyboard.press("ArrowRight")
    await expect(tab.locator(".saved")).to_have_text("not saved")
    await save(tab)
    moved = path.read_bytes().decode()
    assert "\n" not in moved.replace("\r\n", "")
    left = iter(moved.split("\r\n"))
    assert all(line in left for line in ODD.split("\r\n")), "a line was lost or moved"
    assert len(moved.split("\r\n")) == len(ODD.split("\r\n")) + 2
    await tab.get_by_role("button", name="Undo").click()  # also across the save
    await save(tab)
    assert path.read_bytes() == ODD.encode()
    assert complaints == []


async def test_a_broken_file_leaves_what_is_open(browser: Browser, page: Page, tasks: Path) -> None:
    """A file that is not TOML is refused with its line. The open task and its unsaved edit stay."""
    (tasks / "broken.toml").write_text('[task]\nname = "x\n')
    tab, _ = await designing(browser, page)
    await tab.get_by_label("Task", exact=True).select_option("broken")
    await toasted(tab, "broken.toml: not TOML.*line 2")
    await expect(tab.get_by_label("Task", exact=True)).to_have_value("pick_and_place")
    await expect(element(tab, "^Action place pick,")).to_be_visible()


def long_task(places: int) -> str:
    """A ring of action places without positions, each with an error branch."""
    lines = ['schema = 1\n[task]\nname = "long"\nfinal = "p0 == 5"\n']
    lines += ['[primitive_tasks.pick]\ngoal = "g"\nalternatives = ["pick"]\ndeadline = 9\n']
    lines += ['[places.p0]\nkind = "control"\ntokens = 1\n[places.stuck]\nkind = "control"\n']
    lines += [f'[places.p{i}]\nkind = "action"\ntask = "pick"\n' for i in range(1, places - 1)]
    last = places - 2
    for i in range(last + 1):
        source = f"p{i}:normal" if i else "p0"
        lines.append(
            f'[transitions.t{i}]\nin = ["{source}"]\nout = ["p{i + 1 if i < last else 0}"]\n'
        )
        if i:
            lines.append(f'[transitions.e{i}]\nin = ["p{i}:error"]\nout = ["stuck"]\n')
    return "".join(lines)


async def test_a_hundred_and_twenty_places_without_positions(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """They are laid out without overlap, found by search, shown in the minimap, folded and
    unfolded, and undone as one step."""
    (tasks / "long.toml").write_text(long_task(120))
    tab, complaints = await designing(browser, page, "long")
    await expect(element(tab, "^Action place ")).to_have_count(118)
    overlaps = """() => {
      const all = [...petrobot.tabs.Design.view.elements.values()];
      const near = (a, b) => Math.abs(a.x - b.x) < 44 && Math.abs(a.y - b.y) < 44;
      return all.filter((a, i) => all.some((b, j) => j > i && near(a, b))).length;
    }"""
    assert await tab.evaluate(overlaps) == 0
    await tab.get_by_role("button", name="Zoom in").first.click(click_count=6)
    await expect(tab.locator(".designer .minimap")).to_be_visible()
    await tab.get_by_role("searchbox", name="Find a place or transition").fill("p77")
    await tab.keyboard.press("Enter")
    await expect(properties(tab).get_by_label("Name", exact=True)).to_have_value("p77")
    await expect(element(tab, "^Action place p77,")).to_be_in_viewport()
    await expect(tab.locator(".designer .hits li")).to_have_count(0)  # they would cover it
    await tab.get_by_role("button", name="Error branches").click()
    await expect(element(tab, "^Transition e5$")).to_be_hidden()
    await tab.get_by_role("button", name="Error branches").click()
    await tab.get_by_role("button", name="Layout", exact=True).click()
    await expect(tab.locator(".saved")).to_have_text("not saved")
    assert await tab.evaluate(overlaps) == 0
    await tab.get_by_role("button", name="Undo").click()
    await expect(tab.locator(".saved")).to_have_text("saved")
    assert complaints == []


async def test_the_page_has_the_same_layout_as_the_command_line(
    browser: Browser, page: Page
) -> None:
    """The two implementations of the layout, in Python and in the page, give random nets the same
    positions; also long ones, which are folded, with resources beside their layers."""
    tab, _ = await designing(browser, page)
    script = """async ([names, edges, sources, aside]) => {
      const { layered } = await own("layers.js");
      return layered(names, edges, sources, aside);
    }"""
    for names, edges, sources, aside in [*map(short_net, range(12)), *map(long_net, range(6))]:
        laid = lay_out(dict.fromkeys(names), edges, sources, aside)
        there = await tab.evaluate(script, [names, edges, sources, aside])
        assert there.keys() == laid.at.keys()
        assert [there[n] for n in names] == [pytest.approx(laid.at[n]) for n in names]
        across = {x for x, _ in laid.at.values()}
        assert bool(aside) <= (max(across) - min(across) <= WIDEST * COLUMN)


Drawn = tuple[list[str], list[tuple[str, str]], list[str], list[str]]
"""Names, edges, sources and the nodes beside the layers of a net."""


def short_net(seed: int) -> Drawn:
    net = random_task(np.random.default_rng(seed), 3)
    steps = zip(net.transitions, net.consume, net.produce, strict=True)
    edges = [
        edge
        for t, takes, gives in steps
        for edge in (
            *((net.places[p], t) for p, _ in takes),
            *((t, net.places[p]) for p, _ in gives),
        )
    ]
    sources = [p for p, n in zip(net.places, net.initial, strict=True) if n]
    return [*net.places, *net.transitions], edges, sources, []


def long_net(seed: int) -> Drawn:
    """Return a chain of 34 to 84 nodes with arcs over many of them, and two resources."""
    random = np.random.default_rng(seed)
    chain = [f"n{i}" for i in range(34 + 10 * seed)]
    edges = list(pairwise(chain))
    for a, b in random.integers(len(chain), size=(8, 2)).tolist():
        edges.append((chain[a], chain[b]))
    for i in random.integers(len(chain), size=6).tolist():
        edges.append((chain[i], "arm") if i % 2 else ("base", chain[i]))
    return [*chain, "arm", "base"], edges, ["n0", "arm", "base"], ["arm", "base"]


ERRORS = """
[places.given_up]
kind = "control"
x = 560
y = 480

[errors]
to = "given_up"
"""


async def test_error_branches_of_the_table_errors_are_drawn(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """What `[errors]` makes is drawn and folded as any error branch, near its neighbours.
    It is chosen and explained, but not moved or deleted, until another branch is drawn there."""
    path = tasks / "gives_up.toml"
    text = (tasks / "pick_and_place.toml").read_text()
    for name in ("not_seen", "put_failed", "stuck"):
        text = re.sub(rf"\[transitions\.{name}\]\n([^\n]+\n)+", "", text)
    path.write_text(text + ERRORS)
    task = with_error_branches(load(path))
    made = {t.name for t in task.transitions.values() if t.expanded_from}
    assert made == {"look.error", "put.error", "clear.error"}
    tab, complaints = await designing(browser, page, "gives_up")
    names = "[...document.querySelectorAll('.designer .element.transition')]"
    drawn = await tab.evaluate(f"{names}.map((node) => node.dataset.name)")
    assert {*drawn} == {*task.transitions}
    one = element(tab, "^Transition put[.]error")
    await expect(one).to_have_attribute("data-error", "")
    place, branch = (
        await element(tab, "^Action place put,").bounding_box(),
        await one.bounding_box(),
    )
    assert place and branch and abs(branch["y"] - place["y"]) < 320
    await tab.get_by_role("button", name="Error branches").click()
    await expect(one).to_be_hidden()
    await tab.get_by_role("button", name="Error branches").click()
    await one.click()
    await expect(properties(tab)).to_contain_text("made by the table errors")
    await drag(tab, "^Transition put[.]error", 80, 40)
    await tab.keyboard.press("Delete")
    await toasted(tab, "made by the table errors")
    await expect(one).to_be_visible()
    for arc in ("Arc (error) from put to put.error", "Arc from put.error to given_up"):
        await tab.get_by_role("button", name=arc).focus()
        await tab.keyboard.press("Enter")
        await tab.keyboard.press("Delete")
    await tab.keyboard.press("a")
    await choose(tab, "^Action place put,", "^Transition put[.]error")
    await tab.keyboard.press("Escape")
    await tab.keyboard.press("a")
    await drag(tab, "^Transition put[.]error", 0, 150)  # to free ground: nothing is left there
    await tab.keyboard.press("Escape")
    await expect(tab.locator(".saved")).to_have_text("saved")
    await choose(tab, "^Action place put,")
    await properties(tab).get_by_role("button", name="Add error branch").click()
    await expect(element(tab, "^Transition put_error")).to_be_visible()
    await expect(one).to_have_count(0)
    await click_canvas(tab, 0.5, 0.02)
    await properties(tab).get_by_label("Errors without a branch").select_option("")
    await expect(element(tab, "^Transition look[.]error")).to_have_count(0)
    await save(tab)
    assert "[errors]" not in path.read_text()
    assert complaints == []


COVERED = (Path(__file__).parent / "covered_words.js").read_text(encoding="utf-8")


async def test_labels_on_the_page_cover_nothing(browser: Browser, page: Page, tasks: Path) -> None:
    """Measured in the browser on random nets laid out by the page: no label covers a label or an
    element, and few arcs cross labels."""
    nets = {f"random_{seed}": random_task(np.random.default_rng(seed), 3) for seed in range(40, 45)}
    for name, net in nets.items():
        arcs = [
            f"in = {[net.places[p] for p, _ in net.consume[t]]}\nout = "
            f"{[net.places[p] for p, _ in net.produce[t]]}\n"
            for t in range(len(net.transitions))
        ]
        text = 'schema = 1\n[task]\nname = "random"\nfinal = "false"\n'
        text += "".join(
            f'[places.{p}]\nkind = "control"\ntokens = {n}\n'
            for p, n in zip(net.places, net.initial, strict=True)
        )
        text += "".join(
            f"[transitions.{t}]\n{a}" for t, a in zip(net.transitions, arcs, strict=True)
        )
        (tasks / f"{name}.toml").write_text(text)
    tab, _ = await designing(browser, page)
    total: Counter[str] = Counter()
    for name, net in nets.items():
        await open_task(tab, name)
        await expect(element(tab, "^Transition ")).to_have_count(len(net.transitions))
        total.update(await tab.evaluate(COVERED))
    assert total["words"] > 80
    assert (
        total["words_on_words"] == total["words_on_elements"] == total["elements_on_elements"] == 0
    ), total
    assert total["struck"] <= 0.1 * total["words"], total


async def test_a_label_leaves_room_for_those_that_are_put_later(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """The condition of `held` has room only above it. The names beside it, which were put before,
    covered it, and one another."""
    shipped = files("petrobot.coordinator") / "tasks" / "pick_and_place.toml"
    (tasks / "shipped.toml").write_text(shipped.read_text(encoding="utf-8"), encoding="utf-8")
    tab, _ = await designing(browser, page, "shipped")
    await tab.get_by_role("button", name="Error branches").click()
    boxes = [
        await tab.locator(f".designer [data-name='{name}'] {part}").bounding_box()
        for name, part in (("verify_grasp", ".label"), ("held", ".sub"), ("in_hand", ".label"))
    ]
    for one, other in pairwise(boxes):
        assert one is not None and other is not None
        apart = one["x"] + one["width"] < other["x"] or abs(one["y"] - other["y"]) > other["height"]
        assert apart, (one, other)


# ---- while something else happens
# -------------------------------------------------------------------------------------


async def test_elements_pasted_into_another_task_keep_their_meaning(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """A pasted action place brings its primitive task, its event and the arcs between the copied
    elements."""
    tab, complaints = await designing(browser, page)
    await choose(tab, "^Action place look", "^Transition begin", "^Control place parts")
    await tab.keyboard.press("Control+c")
    await tab.get_by_role("button", name="New task").click()
    await tab.get_by_role("application", name=DRAWING).focus()
    await tab.keyboard.press("Control+v")
    await expect(element(tab, "^Arc from parts to begin")).to_have_count(1)
    await expect(element(tab, "^Arc from begin to look")).to_have_count(1)
    await tab.keyboard.press("Control+s")
    await tab.get_by_role("dialog", name="Save the task as").get_by_label("Name").fill("pasted")
    await tab.keyboard.press("Enter")
    await expect(tab.locator(".saved")).to_have_text("saved")
    text = (tasks / "pasted.toml").read_text()
    assert "[primitive_tasks.look]" in text and "[events.part_there]" in text
    assert complaints == []


async def test_elements_deleted_while_they_are_dragged(browser: Browser, page: Page) -> None:
    """An element that is deleted, undone or renamed during a drag does not come back and breaks
    nothing."""
    tab, complaints = await designing(browser, page)
    box = await element(tab, "^Action place put").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + 20
    await tab.mouse.move(x, y)
    await tab.mouse.down()
    await tab.mouse.move(x + 60, y + 40, steps=4)
    await tab.keyboard.press("Delete")
    await tab.mouse.move(x + 120, y + 80, steps=4)
    await tab.mouse.up()
    await expect(element(tab, "^Action place put")).to_have_count(0)
    await tab.get_by_role("button", name="Undo").click()
    await expect(element(tab, "^Action place put")).to_be_visible()
    await expect(tab.get_by_role("region", name="Findings")).not_to_have_attribute(
        "aria-busy", "true"
    )
    after = await element(tab, "^Action place put").bounding_box()
    assert after is not None and abs(after["x"] - box["x"]) < 1 and abs(after["y"] - box["y"]) < 1
    await expect(tab.locator(".saved")).to_have_text("saved")
    assert complaints == []


async def test_two_saves_at_once(browser: Browser, page: Page, tasks: Path) -> None:
    """If two users save at the same moment, one is refused and sees both versions, and no file is
    half written."""
    (ana, _), (ben, _) = await designing(browser, page), await designing(browser, page)
    for tab, goal in ((ana, "from ana"), (ben, "from ben")):
        await tab.get_by_label("Goal", exact=True).fill(goal)  # saved while the field has the focus
    await asyncio.gather(ana.keyboard.press("Control+s"), ben.keyboard.press("Control+s"))
    either = ana.get_by_role("dialog", name="Conflict").or_(
        ana.locator(".saved", has_text=re.compile("^saved$"))
    )
    await expect(either).to_be_visible()
    won, lost = (
        (ben, ana) if await ana.get_by_role("dialog", name="Conflict").count() else (ana, ben)
    )
    conflict = lost.get_by_role("dialog", name="Conflict")
    await expect(conflict).to_contain_text('goal = "from ana"')
    await expect(conflict).to_contain_text('goal = "from ben"')
    await expect(won.locator(".saved")).to_have_text("saved")
    kept = load(tasks / "pick_and_place.toml").goal
    await conflict.get_by_role("button", name="Discard mine, load theirs").click()
    await expect(lost.get_by_label("Goal", exact=True)).to_have_value(kept)


async def test_variables_and_events_of_a_condition_can_be_declared(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """Create a variable and a latched event on the page; a condition on them is checked while it is
    typed; all of it can be undone."""
    tab, complaints = await designing(browser, page)
    form = properties(tab)
    await form.get_by_label("New variable", exact=True).fill("seen")
    await form.get_by_role("button", name="Add variable").click()
    await form.get_by_label("New event", exact=True).fill("door_open")
    await form.get_by_role("button", name="Add event", exact=True).click()
    await form.get_by_label("How door open is remembered").select_option("latched")
    await element(tab, "^Transition picked").click()
    await form.get_by_label("Condition").fill("seen and unknown")
    await form.get_by_label("Condition").press("Enter")
    await expect(form).to_contain_text("unknown")
    await form.get_by_label("Condition").fill("seen or not seen")
    await form.get_by_label("Condition").press("Enter")
    await expect(tab.get_by_role("region", name="Findings")).to_contain_text("May run")
    await save(tab)
    task = load(tasks / "pick_and_place.toml")
    assert task.variables["seen"].initial is False and task.events["door_open"].memory == "latched"
    for _ in range(5):
        await tab.get_by_role("button", name="Undo").click()
    await expect(tab.get_by_role("button", name="Undo")).to_be_disabled()
    assert complaints == []


@pytest.mark.parametrize(
    ("typed", "initial"), [('""', ""), ("", None), ("12", "12"), ('"', '"'), ("a b", "a b")]
)
async def test_the_initial_text_of_a_variable(
    browser: Browser, page: Page, tasks: Path, typed: str, initial: str | None
) -> None:
    """An empty text is written with quotes; an empty field means that there is none."""
    tab, complaints = await designing(browser, page)
    form = properties(tab)
    await form.get_by_label("New variable", exact=True).fill("code")
    await form.get_by_role("button", name="Add variable").click()
    await form.get_by_label("Type of code").select_option("str")
    field = form.get_by_label("Initial value of code")
    await field.fill(typed)
    await field.press("Enter")
    await save(tab)
    assert load(tasks / "pick_and_place.toml").variables["code"].initial == initial
    shown = await field.input_value()
    await field.fill(shown + " ")
    await field.fill(shown)
    await field.press("Enter")
    await expect(tab.locator(".saved")).to_have_text("saved")
    assert complaints == []


EDITS = (Path(__file__).parent / "random_edits.js").read_text(encoding="utf-8")


async def test_every_edit_can_be_undone_and_redone(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """Random edits of every kind: each is undone exactly and redone, and the saved file has the
    same content."""
    tab, _ = await designing(browser, page)
    document = plain(parse((tasks / "pick_and_place.toml").read_text()))
    for seed in range(1, 13):
        made = await tab.evaluate(EDITS, [seed * 7919, 120, document])
        assert made["wrong"] == [] and made["steps"] > 40
        text = edited((tasks / "pick_and_place.toml").read_text(), made["final"])
        kept = plain(parse(text))
        assert {k: v for k, v in kept.items() if v} == {k: v for k, v in made["final"].items() if v}


# ---- other tools' nets
# ------------------------------------------------------------------------------------------------

PIPE = """<?xml version="1.0" encoding="ISO-8859-1"?><pnml><net id="Net-One" type="P/T net">
<token id="Default" red="0"/>
<place id="P0"><graphics><position x="105.0" y="90.0"/></graphics><name><value>P0</value></name>
<initialMarking><value>Default,2</value></initialMarking><capacity><value>0</value></capacity>
</place>
<place id="P1"><graphics><position x="330.0" y="90.0"/></graphics><name><value>P1</value></name>
<initialMarking><value>Default,0</value></initialMarking><capacity><value>3</value></capacity>
</place>
<transition id="T0"><graphics><position x="210.0" y="90.0"/></graphics><name><value>T0</value>
</name>
<rate><value>1.0</value></rate><priority><value>1</value></priority></transition>
<arc id="a" source="P0" target="T0"><inscription><value>Default,1</value></inscription>
<type value="normal"/></arc>
<arc id="b" source="T0" target="P1"><inscription><value>Default,2</value></inscription>
<type value="normal"/></arc>
<arc id="c" source="P1" target="T0"><inscription><value>Default,1</value></inscription>
<type value="inhibitor"/></arc>
</net></pnml>"""
PM4PY = """<?xml version='1.0' encoding='UTF-8'?><pnml>
<net id="imdf" type="http://www.pnml.org/version-2009/grammar/pnmlcoremodel"><name>
<text>im df "zoo"</text></name><page id="n0">
<place id="source"><name><text>source</text></name><initialMarking><text>1</text></initialMarking>
</place>
<place id="sink"><name><text>sink</text></name></place>
<transition id="4b1c-77"><name><text>register request</text></name></transition>
<transition id="8c-1"><name><text>8c-1</text></name>
<toolspecific tool="ProM" version="6.4" activity="$invisible$"/></transition>
<arc id="140" source="source" target="4b1c-77"/><arc id="141" source="4b1c-77" target="sink"/>
<arc id="142" source="sink" target="8c-1"/></page>
<finalmarkings><marking><place idref="sink"><text>1</text></place></marking></finalmarkings></net>
</pnml>"""


@pytest.mark.parametrize(
    ("text", "places", "transitions"), [(PIPE, 2, 1), (PM4PY, 2, 2)], ids=["pipe", "pm4py"]
)
async def test_a_net_of_another_tool_is_imported_and_exported(
    browser: Browser,
    page: Page,
    tasks: Path,
    tmp_path: Path,
    text: str,
    places: int,
    transitions: int,
) -> None:
    """Imported, saved, exported and imported again, it has the same places, transitions, arcs,
    marking and weights.

    The test makes the import slow and does not wait for it: Ctrl+S must save the imported net, not
    the one shown before.
    """
    (tmp_path / "net.pnml").write_text(text)
    tab, complaints = await designing(browser, page)
    asked = asyncio.Event()

    async def slowly(route: Route) -> None:
        await asked.wait()
        await route.continue_()

    await tab.route("**/api/import", slowly)
    for name in ("first", "second"):
        asked.clear()
        await tab.get_by_label("File to import").set_input_files(tmp_path / "net.pnml")
        await tab.keyboard.press("Control+s")
        asked.set()
        await tab.get_by_role("dialog", name="Save the task as").get_by_label("Name").fill(name)
        await expect(element(tab, "^Control place ")).to_have_count(places)
        await expect(element(tab, "^Transition ")).to_have_count(transitions)
        await tab.keyboard.press("Enter")
        await expect(tab.locator(".saved")).to_have_text("saved")
        async with tab.expect_download() as waiting:
            await tab.get_by_label("Import and export").select_option("Export PNML")
        await (await waiting.value).save_as(tmp_path / "net.pnml")
    first, second = (load(tasks / f"{name}.toml") for name in ("first", "second"))
    assert first.net == second.net
    assert {n: (p.x, p.y) for n, p in first.places.items() if p.x is not None} == {
        n: (p.x, p.y)
        for n, p in second.places.items()
        if n in first.places and first.places[n].x is not None
    }
    assert complaints == []


LONG = 45
"""Places of a net whose names cannot all be read at once."""
HOLDING = """schema = 1
[task]
name = "long"
[places.jobs]
tokens = 1
[places.cell]
kind = "resource"
tokens = 1
"""


async def test_a_long_net_begins_where_it_can_be_read_and_shows_what_is_held(
    browser: Browser, page: Page, tasks: Path
) -> None:
    """The view begins at the token, with readable names, and the whole net is one key away. What a
    place holds is written under it, as under Live, instead of the arcs that `holds` makes."""
    held = "".join(f'[places.p{i}]\nholds = "cell"\n' for i in range(LONG))
    chain = ["jobs", *(f"p{i}" for i in range(LONG)), "jobs"]
    steps = [
        f'[transitions.t{i}]\nin = ["{a}"]\nout = ["{b}"]\n'
        for i, (a, b) in enumerate(pairwise(chain))
    ]
    (tasks / "long.toml").write_text(HOLDING + held + "".join(steps))
    tab, complaints = await designing(browser, page, "long")
    zoom = "() => petrobot.tabs.Design.view.view.zoom"
    assert await tab.evaluate(zoom) >= 0.6
    await expect(element(tab, "^Plain place jobs, 1 token")).to_be_in_viewport(ratio=1.0)
    await expect(tab.locator(".designer [data-arc*='|cell|']")).to_have_count(0)
    await expect(tab.locator(".designer .place .sub").get_by_text("holds cell")).to_have_count(LONG)
    await tab.keyboard.press("0")
    assert await tab.evaluate(zoom) < 0.5
    assert complaints == []
