"""The designer in a real browser, by role and name: drawing by keyboard, refusals, two editors,
layout, analysis."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from petrobot.coordinator.page.server import Page
from petrobot.coordinator.task.file import load
from tests.page.conftest import browser_missing, toasted
from tests.page.stage import Stage

if browser_missing() and os.environ.get("CI") != "true":
    pytest.skip(browser_missing(), allow_module_level=True)

from playwright.async_api import Browser, expect

from tests.page.steps import (
    Watch,
    designer,
    draw_place,
    element,
    hold_controls,
    late,
    opened,
    select_by_keyboard,
    settled,
)


async def test_drawing_by_keyboard_alone(browser: Browser, page: Page, faults: Watch) -> None:
    """Places, transitions, arcs, names, undo and redo, copy, move and delete work without a mouse,
    and Escape destroys nothing."""
    tab = await designer(browser, page)
    complaints = faults(tab)
    await tab.get_by_role("button", name="New task").press("Enter")
    for kind, name in (
        ("Control place", "jobs"),
        ("Transition", "begin"),
        ("Action place", "work"),
    ):
        await (
            tab.get_by_role("toolbar", name="Drawing tools")
            .get_by_role("button", name=kind)
            .press("Enter")
        )
        await tab.keyboard.press("Enter")
        await tab.keyboard.press("Control+a")
        await tab.keyboard.type(name)
        await tab.keyboard.press("Enter")
        await expect(element(tab, f"^{kind} {name}")).to_be_visible()
    drawing = tab.get_by_role("application", name="Drawing of the task")
    for start, target in (("jobs", "begin"), ("begin", "work")):
        await select_by_keyboard(tab, start)
        await tab.keyboard.press("a")
        await select_by_keyboard(tab, target)
        await tab.keyboard.press("Enter")
        await expect(
            drawing.get_by_role("button", name=f"Arc from {start} to {target}")
        ).to_have_count(1)
    await select_by_keyboard(tab, "work")
    work = element(tab, "^Action place work")
    before = await work.get_attribute("transform")
    assert before
    await tab.keyboard.press("ArrowRight")
    await expect(work).not_to_have_attribute("transform", before)
    await tab.keyboard.press("Control+z")
    await expect(work).to_have_attribute("transform", before)
    await tab.keyboard.press("Control+a")
    await tab.keyboard.press("Control+c")
    await tab.keyboard.press("Control+v")
    await expect(element(tab, "^Action place work_2")).to_be_visible()
    await expect(drawing.get_by_role("button", name="Arc from begin_2 to work_2")).to_have_count(1)
    await tab.keyboard.press("Delete")
    await expect(element(tab, "^Action place work_2")).to_be_hidden()
    await tab.keyboard.press("Control+z")
    await expect(element(tab, "^Action place work_2")).to_be_visible()
    await tab.keyboard.press("Escape")
    await expect(element(tab, "^Action place work_2")).to_be_visible()
    await tab.keyboard.press("?")
    await expect(tab.get_by_role("dialog", name="Keyboard")).to_be_visible()
    assert complaints == []


async def test_a_late_answer_overwrites_nothing(browser: Browser, page: Page, tasks: Path) -> None:
    """A task that arrives late does not replace a drawing started meanwhile; a late answer to a
    save keeps what was drawn meanwhile."""
    tab = await opened(browser, page)
    opening = await late(tab, "**/api/tasks/*", "GET")
    async with tab.expect_request("**/api/tasks/*"):
        await tab.get_by_role("tab", name="Design").click()
    await tab.get_by_role("button", name="New task").click()
    await draw_place(tab, "Control place", "jobs", 0.3, 0.3)
    opening.set()
    await settled(tab)
    await draw_place(tab, "Resource place", "arm_free", 0.5, 0.6)
    drawing = tab.get_by_role("application", name="Drawing of the task")
    await expect(drawing.get_by_role("button", name=re.compile(" place "))).to_have_count(2)

    saving = await late(tab, "**/api/tasks/*", "PUT")
    await tab.get_by_role("button", name="Save").click()
    dialog = tab.get_by_role("dialog", name="Save the task as")
    await dialog.get_by_label("Name").fill("late")
    async with tab.expect_request("**/api/tasks/late"):
        await dialog.get_by_role("button", name="OK").click()
    await draw_place(tab, "Control place", "more", 0.7, 0.3)
    saving.set()
    await toasted(tab, "^Saved$")
    await expect(tab.get_by_label("Task", exact=True)).to_have_value("late")
    await expect(
        tab.get_by_role("status").filter(has_text=re.compile("^not saved$"))
    ).to_be_visible()
    await expect(element(tab, "^Control place more")).to_be_visible()
    assert set(load(tasks / "late.toml").places) == {"jobs", "arm_free"}


async def test_text_typed_while_the_page_loads_stays(browser: Browser, page: Page) -> None:
    """Offers of nodes that arrive late do not rebuild a form in which the user is typing."""
    tab = await opened(browser, page)
    offers = await late(tab, "**/api/offers", "GET")
    await tab.get_by_role("tab", name="Design").click()
    await tab.get_by_role("button", name="New task").click()
    goal = tab.get_by_label("Goal", exact=True)
    await goal.fill("typed")
    async with tab.expect_response("**/api/tasks"):
        offers.set()
    await settled(tab)
    await expect(goal).to_be_focused()
    await tab.keyboard.type(" early")
    await tab.keyboard.press("Enter")
    await expect(goal).to_have_value("typed early")
    await expect(tab.locator(".saved")).to_have_text("not saved")


async def test_an_invalid_drawing_is_explained(browser: Browser, page: Page) -> None:
    """An arc between two places is refused; a missing branch and an action that no node offers are
    marked in the drawing."""
    tab = await designer(browser, page)
    await (
        tab.get_by_role("toolbar", name="Drawing tools")
        .get_by_role("button", name="Arc", exact=True)
        .click()
    )
    await element(tab, "^Action place look").click()
    await element(tab, "^Action place pick").click()
    await toasted(tab, "never two places")
    await tab.keyboard.press("Escape")
    await element(tab, "^Transition pick_failed").click()
    await tab.keyboard.press("Delete")
    findings = tab.get_by_role("region", name="Findings")
    await expect(findings).to_contain_text("fault")
    await findings.get_by_role("button", name=re.compile("^pick")).first.click()
    properties = tab.get_by_role("complementary", name="Properties")
    await expect(properties.get_by_label("Name", exact=True)).to_have_value("pick")
    await tab.get_by_role("button", name="Undo").click()
    await expect(findings).to_contain_text("May run")
    await tab.get_by_role("searchbox", name="Find a place or transition").fill("clear")
    await tab.keyboard.press("Enter")
    await expect(properties.get_by_label("Name", exact=True)).to_have_value(re.compile("clear"))


async def test_two_people_edit_one_task(browser: Browser, page: Page, tasks: Path) -> None:
    """The later save is refused, both versions are shown, and no choice loses anything."""
    ana, ben = await designer(browser, page), await designer(browser, page)
    for tab, goal in ((ana, "from ana"), (ben, "from ben")):
        field = tab.get_by_label("Goal", exact=True)
        await field.fill(goal)
        await field.press("Enter")
        await tab.get_by_role("button", name="Save").click()
        if goal == "from ana":
            await expect(
                tab.get_by_role("status").filter(has_text=re.compile("^saved$"))
            ).to_be_visible()
    conflict = ben.get_by_role("dialog", name="Conflict")
    await expect(conflict).to_contain_text('goal = "from ana"')
    await expect(conflict).to_contain_text('goal = "from ben"')
    assert load(tasks / "pick_and_place.toml").goal == "from ana"
    await conflict.get_by_role("button", name="Replace theirs by mine").click()
    await expect(conflict).to_be_hidden()
    await expect(ben.get_by_role("status").filter(has_text=re.compile("^saved$"))).to_be_visible()
    assert load(tasks / "pick_and_place.toml").goal == "from ben"


async def test_formats_and_layout(
    browser: Browser, page: Page, tasks: Path, tmp_path: Path
) -> None:
    """SVG is self-contained, PNG and PNML can be exported, PNML can be imported, and an automatic
    layout is one step of undo."""
    tab = await designer(browser, page)
    made = {}
    for form in ("SVG", "PNG", "PNML", "TOML"):
        async with tab.expect_download() as waiting:
            await tab.get_by_label("Import and export").select_option(f"Export {form}")
        download = await waiting.value
        made[form] = tmp_path / download.suggested_filename
        await download.save_as(made[form])
    svg = made["SVG"].read_text()
    assert svg.startswith("<svg") and "pick" in svg and "class=" not in svg and "var(--" not in svg
    assert (
        made["PNG"].read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and made["PNG"].stat().st_size > 20_000
    )
    assert made["TOML"].read_text() == (tasks / "pick_and_place.toml").read_text()
    await tab.get_by_label("File to import").set_input_files(made["PNML"])
    await expect(element(tab, "^Control place pick,")).to_be_visible()
    where = (
        "() => [...document.querySelectorAll('.designer .net .element')].map((e) => "
        "e.getAttribute('transform'))"
    )
    before = await tab.evaluate(where)
    await tab.get_by_role("button", name="Layout").click()
    assert await tab.evaluate(where) != before
    await tab.get_by_role("button", name="Undo").click()
    assert await tab.evaluate(where) == before


async def test_the_stochastic_view_opens_beside_the_drawing(
    browser: Browser, page: Page, tasks: Path, shots: Path
) -> None:
    """It is drawn from the saved file, as an image."""
    shipped = Path(__file__).parents[2] / "coordinator" / "tasks" / "catch_ball.toml"
    text = shipped.read_text().replace('"catch_ball"\n', '"timed"\n', 1)
    (tasks / "timed.toml").write_text(text)
    tab = await designer(browser, page)
    await tab.get_by_label("Task", exact=True).select_option("timed")
    await expect(element(tab, "locate_ball,").first).to_be_visible()
    await tab.get_by_label("Import and export").select_option("Show stochastic view")
    dialog = tab.get_by_role("dialog", name="Stochastic view")
    await expect(dialog.get_by_role("img")).to_be_visible()
    wide = "(image) => image.decode().then(() => image.naturalWidth)"
    assert await dialog.get_by_role("img").evaluate(wide) > 1000
    hidden = "(s) => [s.scrollWidth - s.clientWidth, s.scrollHeight - s.clientHeight]"
    assert await dialog.locator(".sheet").evaluate(hidden) == [0, 0]
    await tab.screenshot(path=shots / "stochastic.png")
    await dialog.get_by_role("button", name="Full size").click()
    assert max(await dialog.locator(".sheet").evaluate(hidden)) > 100
    assert await dialog.locator(".sheet").evaluate("(s) => s.scrollTop") == 0
    await dialog.get_by_role("button", name="Full size").click()
    box = await dialog.get_by_role("img").bounding_box()
    assert box is not None
    await dialog.get_by_role("img").click(position={"x": 5, "y": box["height"] * 0.7})
    beneath = "(s) => (s.scrollTop + s.clientHeight / 2) / s.scrollHeight"
    assert await dialog.locator(".sheet").evaluate(beneath) == pytest.approx(0.7, abs=0.05)
    await tab.screenshot(path=shots / "stochastic-full.png")
    await dialog.get_by_role("button", name="Close").click()
    await expect(dialog).to_be_hidden()


async def test_macro_places_open_in_both_views(
    browser: Browser, page: Page, stage: Stage, tasks: Path
) -> None:
    """A sub-net is drawn as one place, shows how many tokens are inside, and opens on demand."""
    text = (tasks / "pick_and_place.toml").read_text()
    inner = (
        '\n[subnets.fetching]\nentry = "inside"\nnormal = "handed"\n'
        '[subnets.fetching.places.inside]\nkind = "control"\nx = 80\ny = 100\n'
        '[subnets.fetching.places.handed]\nkind = "control"\nx = 300\ny = 100\n'
        '[subnets.fetching.transitions.pass_on]\nin = ["inside"]\nout = ["handed"]\nafter = '
        "3600.0\nx = 190\ny = 100\n"
        '\n[places.fetch]\nkind = "macro"\nsubnet = "fetching"\nx = 120\ny = 440\n'
        '[transitions.leave]\nin = ["fetch:normal"]\nout = ["arm_free"]\nx = 200\ny = 380\n'
    )
    (tasks / "nested.toml").write_text(text.replace('out = ["look"]', 'out = ["fetch"]') + inner)
    stage.load(load(tasks / "nested.toml"), (tasks / "nested.toml").read_text())
    tab = await opened(browser, page)
    await hold_controls(tab)
    holder = stage.controls.holder
    assert holder is not None
    assert (await stage.command(holder, "start", {"task": "nested"}))["ok"]
    stage.happen("part_there")
    await expect(element(tab, "^Macro place fetch, 1 token", "Task net")).to_be_visible()
    await element(tab, "^Macro place fetch", "Task net").click()
    await tab.get_by_role("region", name="Selected").get_by_role("button", name="Open").click()
    await expect(element(tab, "^Control place inside, 1 token", "Task net")).to_be_visible()
    await (
        tab.get_by_role("navigation", name="Opened macro places")
        .get_by_role("button", name="pick and place")
        .click()
    )
    await expect(element(tab, "^Macro place fetch", "Task net")).to_be_visible()
    await tab.get_by_role("tab", name="Design").click()
    await tab.get_by_label("Task", exact=True).select_option("nested")
    await settled(tab)
    await element(tab, "^Macro place fetch").click()
    await (
        tab.get_by_role("complementary", name="Properties")
        .get_by_role("button", name="Open")
        .click()
    )
    await expect(element(tab, "^Control place inside")).to_be_visible()


async def test_verdicts_are_shown_next_to_the_drawing(
    browser: Browser, page: Page, shots: Path, faults: Watch
) -> None:
    """The page warns without being asked that a task may stop before its end. A click shows the
    marking and the firings that lead to it."""
    tab = await designer(browser, page)
    complaints = faults(tab)
    analysis = tab.get_by_role("region", name="Analysis")
    await expect(analysis.get_by_role("status")).to_contain_text("no problem found")
    field = tab.get_by_label("Ends when")
    await field.fill("parts == 0 and look == 1")
    await field.press("Enter")
    await expect(analysis.get_by_role("status")).to_contain_text("6 problems found")
    refused = analysis.get_by_role(
        "button", name=re.compile("^Never stuck before its end: does not hold")
    )
    await expect(element(tab, "^Control place parts, 2 tokens")).to_be_visible()
    await refused.click()
    await expect(element(tab, "^Control place parts(, no tokens|, 0 tokens)?$")).to_be_visible()
    await expect(tab.locator(".net .turns").first).to_be_visible()
    await tab.screenshot(path=shots / "verdicts.png")
    await refused.click()
    await expect(element(tab, "^Control place parts, 2 tokens")).to_be_visible()
    assert complaints == []
