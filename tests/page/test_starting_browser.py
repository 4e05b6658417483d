"""Starting from the page in a real browser, by role and name: options, learning, start from a
recorded point, emergency stop and clearing it."""

from __future__ import annotations

import os
import re
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from petrobot.coordinator.page.server import Page, start_page
from petrobot.coordinator.run.folder import JOURNAL
from petrobot.coordinator.run.journal import read_journal
from tests.operator.conftest import TASK
from tests.operator.test_starting import REMARKED, Simulated
from tests.page.conftest import PATIENCE_MS, browser_missing

if browser_missing() and os.environ.get("CI") != "true":
    pytest.skip(browser_missing(), allow_module_level=True)

from playwright.async_api import Browser, Locator, Page as Tab, expect

from tests.page.steps import Watch, element, opened
from tests.waiting import until

expect.set_options(timeout=PATIENCE_MS)


@pytest_asyncio.fixture(loop_scope="session")
async def cell(tmp_path: Path) -> AsyncIterator[Simulated]:
    """A station that can only simulate."""
    made = Simulated(tmp_path)
    made.tasks.save_text("remarked", None, REMARKED.replace('name = "moving"', 'name = "remarked"'))
    yield made
    await made.station.close()


@pytest_asyncio.fixture(loop_scope="session")
async def page(cell: Simulated) -> AsyncIterator[Page]:
    """Its page."""
    offers, form = cell.station.offers, cell.station.form
    made = await start_page(
        cell.station,
        tasks_folder=cell.folder / "tasks",
        offers=offers,
        runs=cell.runs,
        starts=form,
    )
    yield made
    await made.close()


def mission(tab: Tab) -> Locator:
    """Return the mission in one line."""
    return tab.get_by_role("status", name="Mission state")


async def chosen(tab: Tab, task: str) -> Locator:
    """Open the start form of a task, which takes the free controls: one form, though the button is
    pressed twice while the server is asked."""
    toolbar = tab.get_by_role("toolbar", name="Mission")
    await toolbar.get_by_label("Task to start").select_option(task)
    await toolbar.get_by_role("button", name="Start with").dblclick()
    dialog = tab.get_by_role("dialog", name=f"Start {task}")
    await expect(dialog).to_be_visible()
    return dialog


async def test_every_option_of_the_command_line(
    browser: Browser, page: Page, cell: Simulated, shots: Path, faults: Watch
) -> None:
    """Mode, runs, seed, parameters of each type, and learning. Wrong input is explained in the
    form, which stays open."""
    tab = await opened(browser, page)
    complaints = faults(tab)
    await expect(mission(tab)).to_contain_text("Idle")
    dialog = await chosen(tab, "remarked")
    await expect(dialog.get_by_label("Number of runs")).to_have_value("2")
    await expect(dialog.get_by_label("speed")).to_have_value("0.5")
    await expect(dialog).to_contain_text("m/s")
    await dialog.get_by_label("Where").select_option("simulated, in lock step")
    await dialog.get_by_label("Pace", exact=True).select_option("as fast as possible")
    await dialog.get_by_label("Number of runs").fill("0")
    await dialog.get_by_role("button", name="Start").click()
    await expect(dialog.get_by_role("alert")).to_contain_text("0 is not a whole number from 1")
    await dialog.get_by_label("Number of runs").fill("8")
    await dialog.get_by_label("Seed").fill("77")
    await dialog.get_by_label("speed").fill("0.25")
    await dialog.get_by_label("quiet").check()
    await dialog.get_by_label("batch").fill("<b>B</b>")
    await dialog.get_by_label("Learn which actions are best").check()
    await dialog.get_by_label("Estimates file").fill("../up")
    await dialog.get_by_role("button", name="Start").click()
    await expect(dialog.get_by_role("alert")).to_contain_text("'../up' is not a name")
    await tab.screenshot(path=shots / "start-refused.png")
    await dialog.get_by_label("Estimates file").fill("known")
    await dialog.get_by_label("Selector").select_option("thompson")
    await dialog.get_by_label("Credit").select_option("how its own run ended")
    await dialog.get_by_role("button", name="Start").click()
    await expect(dialog).to_be_hidden()
    await expect(mission(tab)).to_contain_text("Success")
    await expect(mission(tab)).to_contain_text("simulated")
    result = tab.get_by_role("status").filter(has_text="reached its final marking")
    await expect(result).to_have_text(re.compile(r"took\d+(\.\d+)? s"))
    await expect(result.get_by_text("reason")).to_have_count(0)  # it is above, as a sentence
    [folder] = cell.runs.iterdir()
    header = read_journal(folder / JOURNAL).header
    assert (header["mode"], header["runs"], header["seed"]) == ("lockstep", 8, 77)
    assert header["parameters"] == {
        "speed": 0.25,
        "quiet": True,
        "batch": "<b>B</b>",
        "count": 3,
        "regime": "calm",
    }
    assert (
        header["learning"]["selector"] == "thompson"
        and header["learning"]["credit"] == "action"
        and (cell.folder / "estimates" / "known.db").exists()
    )
    await learning_view(tab, shots)
    assert complaints == []


async def learning_view(tab: Tab, shots: Path) -> None:
    """Check the curves of probability and J, the details of each alternative, places coloured by J,
    and a choice fixed by hand."""
    await tab.get_by_role("tab", name="Learning").click()
    panel = tab.get_by_role("tabpanel", name="Learning")
    await expect(
        panel.get_by_role("figure", name="look: probability of each alternative").locator("canvas")
    ).to_be_visible()
    await panel.get_by_label("Curves of").select_option("objective J")
    await expect(
        panel.get_by_role("figure", name="look: J of each alternative").locator("canvas")
    ).to_be_visible()
    await expect(
        panel.get_by_role("figure", name="look: probability of each alternative")
    ).to_have_count(0)
    table = panel.get_by_role("table", name="What is known about the alternatives")
    await expect(table.get_by_role("row", name=re.compile("look at table"))).to_be_attached()
    await expect(table).to_contain_text("lowest J")
    look = element(tab, "^Action place look", "Task net")
    await expect(look).not_to_have_class(re.compile(r"\bhot\b"))
    await panel.get_by_role("button", name="Colour places by J").click()
    await expect(look).to_have_class(re.compile(r"\bhot\b"))
    await tab.screenshot(path=shots / "learning.png")
    await panel.get_by_role("button", name="Colour places by J").click()
    await expect(look).not_to_have_class(re.compile(r"\bhot\b"))


async def test_the_selector_is_overridden_and_frozen_from_the_page(
    browser: Browser, page: Page, cell: Simulated
) -> None:
    """The reason of each choice is shown with the run: chosen by the operator, or best of the
    learned ones."""
    await cell.say("take_controls")
    await cell.simulate(runs=4, learn={"file": "known", "selector": "nikolic_fu"})
    await cell.say("release_controls")
    tab = await opened(browser, page)
    dialog = await chosen(tab, "moving")
    await dialog.get_by_label("Where").select_option("lockstep")
    await dialog.get_by_label("Learn which actions are best").check()
    await expect(dialog.get_by_label("Estimates file")).to_have_value("known")
    await dialog.get_by_label("Frozen").check()
    await dialog.get_by_role("button", name="Cancel").click()
    await element(tab, "^Action place look", "Task net").click()
    await tab.get_by_role("button", name="Set breakpoint").click()
    dialog = await again(tab, "moving")
    await dialog.get_by_label("Where").select_option("lockstep")
    await dialog.get_by_label("Learn which actions are best").check()
    await dialog.get_by_label("Frozen").check()
    await dialog.get_by_role("button", name="Start").click()
    await expect(mission(tab)).to_contain_text("Paused")
    await tab.get_by_label("Alternative for look").select_option("look twice")
    toolbar = tab.get_by_role("toolbar", name="Mission")
    await toolbar.get_by_role("button", name="Step").click()
    await expect(tab.locator(".pause-note")).to_contain_text("Paused after one firing")
    selected = tab.get_by_role("region", name="Selected")
    await tab.get_by_role("button", name="Remove breakpoint").click()
    await toolbar.get_by_role("button", name="Continue").click()
    await expect(mission(tab)).to_contain_text("Success")
    await expect(selected).to_be_visible()
    reasons = {run["why"] for run in cell.state["ended"] if run["place"] == "look"}
    assert "chosen by the operator" in reasons
    await until(lambda: cell.state["result"] is not None)  # It arrives after the status.
    assert cell.state["result"]["learned"]["runs_counted"] == 0


async def again(tab: Tab, task: str) -> Locator:
    """Open the start form again."""
    await (
        tab.get_by_role("toolbar", name="Mission").get_by_role("button", name="Start with").click()
    )
    dialog = tab.get_by_role("dialog", name=f"Start {task}")
    await expect(dialog).to_be_visible()
    return dialog


async def test_a_run_starts_from_a_point_of_another(
    browser: Browser, page: Page, cell: Simulated, shots: Path, faults: Watch
) -> None:
    """Move to a moment of a recorded run, choose how its active actions continue, simulate, and
    watch it live. Its journal names the recorded run."""
    await cell.say("take_controls")
    first, _ = await cell.simulate(runs=3)
    await cell.say("release_controls")
    tab = await opened(browser, page, "dark")
    complaints = faults(tab)
    await tab.get_by_role("tab", name="History").click()
    here = tab.get_by_role("toolbar", name="Scrub").get_by_role("button", name="Simulate from here")
    await expect(here).to_be_disabled()
    await tab.get_by_role("tab", name="Live").click()
    await tab.get_by_role("button", name="Take controls").click()
    await tab.get_by_role("tab", name="History").click()
    await (
        tab.get_by_role("navigation", name="Runs")
        .get_by_role("button", name=re.compile(f"^{first}"))
        .click()
    )
    await expect(tab.locator(".history")).not_to_have_attribute("aria-busy", "true")
    await tab.get_by_role("button", name="First record").click()
    await tab.get_by_role("button", name="Next record").click()
    await here.click()
    dialog = tab.get_by_role("dialog", name="Simulate from here")
    await dialog.get_by_label("Run in look").select_option("finished: error")
    await dialog.get_by_label("Pace", exact=True).select_option("as fast as possible")
    await tab.screenshot(path=shots / "simulate-from.png")
    await dialog.get_by_role("button", name="Simulate").click()
    await expect(tab.get_by_role("tab", name="Live")).to_have_attribute("aria-selected", "true")
    await expect(mission(tab)).to_contain_text("from record")
    await expect(mission(tab)).to_contain_text("Success")
    made = cell.state["mission"]["id"]
    source = read_journal(cell.runs / made / JOURNAL).header["from"]
    assert (source["run"], source["going"]) == (first, {"look": "error"})
    await tab.get_by_role("tab", name="History").click()
    await (
        tab.get_by_role("navigation", name="Runs")
        .get_by_role("button", name=re.compile(f"^{made}"))
        .click()
    )
    about = tab.get_by_role("complementary", name="Records").get_by_role("status")
    await expect(about).to_contain_text(f"from {first}")
    await tab.get_by_role("button", name=f"Compare with {first}").click()
    await expect(about).to_contain_text(
        "compared from there on. The runs differ from firing 1 on: unseen here, seen there"
    )
    await tab.get_by_role("button", name="Go there").click()
    await tab.screenshot(path=shots / "compare-from.png")
    assert complaints == []


async def test_the_holder_of_the_controls_clears_the_emergency_stop(
    browser: Browser, page: Page, cell: Simulated, shots: Path, faults: Watch
) -> None:
    """The stop holds until it is cleared, however the run ended, and nothing can start. Clearing
    asks for confirmation; all by keyboard."""
    cell.tasks.save_text(
        "long", None, TASK.replace("[transitions.begin]", "[transitions.begin]\nafter = 3600.0")
    )
    ana, ben = await opened(browser, page), await opened(browser, page)
    complaints = faults(ana)
    dialog = await chosen(ana, "long")
    await dialog.get_by_label("Where").select_option("lockstep")
    await dialog.get_by_role("button", name="Start").press("Enter")
    await expect(mission(ana)).to_contain_text("Running")
    await ben.keyboard.press("F9")
    for tab in (ana, ben):
        await expect(mission(tab)).to_contain_text("Emergency stop")
        await expect(tab.get_by_role("button", name="Start", exact=True)).to_be_hidden()
    await expect(ben.get_by_role("button", name="Clear the stop")).to_be_disabled()
    await expect(ben.get_by_role("button", name="Clear the stop")).to_have_attribute(
        "title", re.compile("holds the controls. Ask for them under Live.")
    )
    await until(lambda: cell.station._going is None)
    await expect(mission(ana)).to_contain_text("Emergency stop")
    clear = ana.get_by_role("button", name="Clear the stop")
    await clear.focus()
    await expect(clear).to_be_focused()
    await ana.keyboard.press("Enter")
    question = ana.get_by_role("dialog", name="Clear the emergency stop?")
    await expect(question).to_contain_text("emergency stop by")
    await ana.screenshot(path=shots / "clear-stop.png")
    await ana.keyboard.press("Escape")
    await expect(question).to_be_hidden()
    await expect(clear).to_be_focused()
    await expect(mission(ana)).to_contain_text("Emergency stop")
    await ana.keyboard.press("Enter")
    await question.get_by_role("button", name="Clear the stop").press("Enter")
    for tab in (ana, ben):
        await expect(mission(tab)).to_contain_text("Idle")
        await expect(tab.get_by_role("button", name="Clear the stop")).to_be_hidden()
    assert complaints == []
