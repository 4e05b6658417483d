"""The first minute of a user on the page: run the drawn task, draw arcs, fill in a form, answer a
dialog."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from itertools import product
from pathlib import Path

import pytest
import pytest_asyncio

from petrobot.coordinator.page.server import Page, start_page
from tests.operator.test_starting import Simulated
from tests.page.conftest import browser_missing, toasted
from tests.page.stage import Stage

if browser_missing() and os.environ.get("CI") != "true":
    pytest.skip(browser_missing(), allow_module_level=True)

from playwright.async_api import Browser, Page as Tab, expect

from tests.page.steps import checked, designer, element, hold_controls, opened, settled

CORNERS = """\
schema = 1
[task]
name = "corners"
final = "p1 > 9"
[places]
p1 = { kind = "control", x = 100, y = 100 }
p2 = { kind = "control", x = 300, y = 300 }
p3 = { kind = "control", x = 500, y = 100 }
[transitions]
t1 = { x = 100, y = 300 }
t2 = { x = 300, y = 100 }
t3 = { x = 500, y = 300 }
"""
NAMES = ("p1", "p2", "p3", "t1", "t2", "t3")


@pytest.fixture
def tasks(tasks: Path) -> Path:
    """The task folder with one more task."""
    (tasks / "corners.toml").write_text(CORNERS, encoding="utf-8")
    return tasks


@pytest_asyncio.fixture(loop_scope="session")
async def cell(tmp_path: Path) -> AsyncIterator[Simulated]:
    """A station that can only simulate."""
    made = Simulated(tmp_path)
    yield made
    await made.station.close()


@pytest_asyncio.fixture(loop_scope="session")
async def own_page(cell: Simulated) -> AsyncIterator[Page]:
    """Its page."""
    made = await start_page(
        cell.station, tasks_folder=cell.folder / "tasks", starts=cell.station.form
    )
    yield made
    await made.close()


async def on_the_desk(browser: Browser, page: Page, task: str) -> Tab:
    """Open a task in the designer."""
    tab = await designer(browser, page)
    await tab.get_by_label("Task", exact=True).select_option(task)
    await expect(tab.locator(".saved")).to_have_text("saved")
    await settled(tab)
    await checked(tab, "")
    return tab


# ---- run


async def test_run_this_task_takes_free_controls(
    browser: Browser, page: Page, stage: Stage
) -> None:
    tab = await designer(browser, page)
    await tab.get_by_role("button", name="Run this task").click()
    await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Running")
    await expect(tab.get_by_role("toolbar", name="Mission")).to_contain_text(
        "You hold the controls"
    )


async def test_a_task_run_from_the_designer_is_shown_whole(
    browser: Browser, own_page: Page, cell: Simulated
) -> None:
    """The live view was hidden when its task was drawn, so it is fitted when it is shown, with
    nothing cut off or under the bar."""
    tab = await opened(browser, own_page)
    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)
    assert (await cell.station.command("ana", "take_controls", {}))["ok"]
    assert (await cell.station.command("ana", "load", {"task": "moving"}))["ok"]
    await tab.get_by_role("tab", name="Live").click()
    await expect(element(tab, "^Control place jobs", "Task net")).to_be_visible()
    fits = (
        "() => { const { view } = petrobot.tabs.Live; return view.view === view.fitted && "
        "view.view.x !== 0; }"
    )
    await tab.wait_for_function(fits)


async def test_run_this_task_says_who_holds_the_controls(
    browser: Browser, page: Page, stage: Stage
) -> None:
    await stage.command("ana", "take_controls", {})
    tab = await designer(browser, page)
    await tab.get_by_role("button", name="Run this task").click()
    await toasted(tab, "ana holds the controls")
    assert stage.controls.holder == "ana"
    assert stage.feed.state["mission"]["state"] == "idle"


# ---- arcs


async def centre(tab: Tab, name: str) -> tuple[float, float]:
    """Return the centre of an element's body."""
    box = await tab.locator(f".designer .net [data-name='{name}'] .body").bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


DRAWN = """() => Object.entries(petrobot.tabs.Design.model.data.transitions).flatMap(([name, t]) =>
  [...(t.in ?? []).map((p) => `${p} > ${name}`), ...(t.out ?? []).map((p) => `${name} > ${p}`)])"""


@pytest.mark.parametrize("key", ["a", "i"])
async def test_an_arc_goes_from_where_the_drag_began_to_where_it_ended(
    browser: Browser, page: Page, key: str
) -> None:
    """For every pair of elements, and with every selection before the tool is taken: each element
    is selected once with each beginning and once with each end."""
    tab = await on_the_desk(browser, page, "corners")
    at = {name: await centre(tab, name) for name in NAMES}
    numbers = {name: number for number, name in enumerate(NAMES)}
    tries = [
        (selected, start, end)
        for selected, start, end in product(NAMES, repeat=3)
        if start[0] != end[0] and (key == "a" or start[0] == "p")
        if (numbers[selected] + numbers[start] + numbers[end]) % 3 == 0
    ]
    wrong = []
    for selected, start, end in tries:
        await tab.keyboard.press("v")
        await tab.mouse.click(*at[selected])
        await tab.keyboard.press(key)
        await tab.mouse.move(*at[start])
        await tab.mouse.down()
        await tab.mouse.move(*at[end], steps=3)
        await tab.mouse.up()
        wanted = [f"{'!' if key == 'i' else ''}{start} > {end}"]
        drawn = await tab.evaluate(DRAWN)
        if drawn != wanted:
            wrong.append((selected, wanted, drawn))
        await tab.evaluate("() => { while (petrobot.tabs.Design.model.undo()); }")
    assert wrong == []


async def test_arcs_can_be_drawn_by_selecting_one_element_after_the_other(
    browser: Browser, page: Page
) -> None:
    """From the selected element with a key, or with two clicks; Escape during a drag draws
    nothing."""
    tab = await on_the_desk(browser, page, "corners")
    at = {name: await centre(tab, name) for name in NAMES}
    await tab.mouse.click(*at["p1"])
    await tab.keyboard.press("a")
    await tab.mouse.click(*at["t2"])
    assert await tab.evaluate(DRAWN) == ["p1 > t2"]
    await tab.mouse.click(*at["t1"])
    await tab.mouse.click(*at["p2"])
    assert await tab.evaluate(DRAWN) == ["t1 > p2", "p1 > t2"]
    await tab.mouse.move(*at["p3"])
    await tab.mouse.down()
    await tab.mouse.move(*at["t3"], steps=3)
    await tab.keyboard.press("Escape")
    await tab.mouse.up()
    assert await tab.evaluate(DRAWN) == ["t1 > p2", "p1 > t2"]


# ---- fields


FOCUSED = """() => { const at = document.activeElement;
  return at.getAttribute("aria-label")
    ?? at.closest("label")?.firstChild.textContent
    ?? at.tagName; }"""


async def test_tab_moves_to_the_next_field_after_a_change(browser: Browser, page: Page) -> None:
    """Through a whole form: after any change the next field has the focus, and digits are entered
    as text."""
    tab = await designer(browser, page)
    await element(tab, "^Control place parts").click()
    form = tab.get_by_role("complementary", name="Properties")
    before = await tab.evaluate("() => Object.keys(petrobot.tabs.Design.model.data.places).length")
    await form.get_by_label("Name", exact=True).fill("pieces")
    await tab.keyboard.press("Tab")
    await expect(form.get_by_label("Name", exact=True)).to_have_value("pieces")
    assert await tab.evaluate(FOCUSED) == "Shown as"
    await tab.keyboard.type("12 pieces")
    await tab.keyboard.press("Tab")
    await checked(tab, "")
    assert await tab.evaluate(FOCUSED) == "Kind", (
        "the focus must stay after the check has rebuilt the form"
    )
    await tab.keyboard.press("Tab")
    await tab.keyboard.type("3")
    await tab.keyboard.press("Tab")
    await tab.keyboard.type("14")
    await tab.keyboard.press("Shift+Tab")
    await checked(tab, "")
    assert await tab.evaluate(FOCUSED) == "Tokens at the start"
    place = await tab.evaluate("() => petrobot.tabs.Design.model.data.places.pieces")
    assert (place["label"], place["tokens"], place["capacity"]) == ("12 pieces", 3, 14)
    assert await tab.evaluate("() => petrobot.tabs.Design.tools.tool") == "select"
    assert (
        await tab.evaluate("() => Object.keys(petrobot.tabs.Design.model.data.places).length")
        == before
    )


async def test_a_choice_keeps_the_focus(browser: Browser, page: Page) -> None:
    """Another kind of place has another form. The field keeps the focus if it was changed by
    keyboard."""
    tab = await designer(browser, page)
    await element(tab, "^Control place parts").click()
    kind = tab.get_by_role("complementary", name="Properties").get_by_label("Kind")
    await kind.focus()
    await kind.select_option("resource")
    await checked(tab, "")
    assert await tab.evaluate(FOCUSED) == "Kind"


# ---- dialogs


async def test_the_safe_answer_has_the_focus(browser: Browser, page: Page, tasks: Path) -> None:
    """Pressing Enter at once must neither overwrite another user's work nor discard one's own."""
    tab = await on_the_desk(browser, page, "corners")
    theirs = CORNERS.replace("x = 500, y = 300", "x = 510, y = 310")
    await element(tab, "^Control place p1").click()
    await tab.keyboard.press("ArrowRight")
    (tasks / "corners.toml").write_text(theirs, encoding="utf-8")
    await tab.keyboard.press("Control+s")
    await expect(tab.get_by_role("dialog", name="Conflict")).to_be_visible()
    await expect(tab.get_by_role("button", name="Keep editing")).to_be_focused()
    await tab.keyboard.press("Enter")
    await expect(tab.get_by_role("dialog")).to_have_count(0)
    assert (tasks / "corners.toml").read_text(encoding="utf-8") == theirs
    await tab.get_by_role("button", name="New task").click()
    await expect(tab.get_by_role("dialog", name="Leave without saving?")).to_be_visible()
    await expect(tab.get_by_role("button", name="Stay")).to_be_focused()
    await tab.keyboard.press("Enter")
    await expect(tab.get_by_label("Task", exact=True)).to_have_value("corners")


async def test_an_emergency_stop_is_not_cleared_by_enter(
    browser: Browser, own_page: Page, cell: Simulated
) -> None:
    tab = await opened(browser, own_page)
    await hold_controls(tab)
    cell.station.feed.emit(
        "mission", mission={"state": "stopped", "reason": "emergency stop by ana"}
    )
    await tab.get_by_role("button", name="Clear the stop").click()
    dialog = tab.get_by_role("dialog", name="Clear the emergency stop?")
    await expect(dialog.get_by_role("button", name="Cancel")).to_be_focused()


# ---- files that are edited outside
# ----------------------------------------------------------------------------------------


def altered(cell: Simulated) -> str:
    """Write the task file as another program would."""
    path = cell.folder / "tasks" / "moving.toml"
    text = path.read_text(encoding="utf-8").replace("tokens = 2", "tokens = 1")
    path.write_text(text, encoding="utf-8")
    return text


async def test_a_loaded_task_that_was_changed_outside_is_shown_before_it_runs(
    browser: Browser, own_page: Page, cell: Simulated
) -> None:
    """Start runs the task that is shown, or says that it has changed and shows the new one."""
    tab = await opened(browser, own_page)
    await hold_controls(tab)
    toolbar = tab.get_by_role("toolbar", name="Mission")
    await toolbar.get_by_label("Task to start").select_option("moving")
    await expect(element(tab, "^Control place jobs, 2 tokens", "Task net")).to_be_visible()
    altered(cell)
    await toolbar.get_by_role("button", name="Start", exact=True).click()
    await toasted(tab, "changed by another program")
    await expect(element(tab, "^Control place jobs, 1 token", "Task net")).to_be_visible()
    assert not list(cell.runs.glob("*")), "nothing has run"
    answer = await cell.station.command(
        cell.station.controls.holder or "", "start", {"mode": "lockstep", "pace": 0}
    )
    assert answer["ok"], "the task that is shown now may be started"


async def test_run_this_task_never_runs_a_changed_file_unseen(
    browser: Browser, own_page: Page, cell: Simulated
) -> None:
    """The designer says that another program changed its file, refuses to run it unseen, and loads
    it on request."""
    tab = await opened(browser, own_page)
    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)
    await checked(tab)
    text = altered(cell)
    await tab.get_by_role("button", name="Run this task").click()
    await toasted(tab, "changed by another program")
    assert not list(cell.runs.glob("*")), "nothing has run"
    await expect(tab.locator(".saved")).to_contain_text("changed by another program")
    await tab.get_by_role("button", name="Load it").click()
    await expect(element(tab, "^Control place jobs, 1 token")).to_be_visible()
    await expect(tab.locator(".saved")).to_have_text("saved")
    assert (cell.folder / "tasks" / "moving.toml").read_text(encoding="utf-8") == text


async def test_a_change_by_another_program_is_noticed_at_once(
    browser: Browser, own_page: Page, cell: Simulated
) -> None:
    tab = await opened(browser, own_page)
    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)
    await checked(tab)
    altered(cell)
    await expect(tab.locator(".saved")).to_contain_text("changed by another program")
    await tab.get_by_role("button", name="Load it").click()
    await expect(element(tab, "^Control place jobs, 1 token")).to_be_visible()
