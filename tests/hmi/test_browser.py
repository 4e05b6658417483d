"""End to end in a real browser, by role and name: draw, run, pause, step, feed tokens, and find out why something failed."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("playwright", reason="Playwright for Python is not installed")

from playwright.async_api import Locator, expect
from playwright.async_api import Page as Tab

from coordinator.hmi.server import Page
from tests.hmi.stage import Stage

if TYPE_CHECKING:
    from playwright.async_api import Browser

Watch = Callable[[Any], list[str]]
SIZE = {"width": 1440, "height": 900}


async def opened(browser: Browser, page: Page, theme: str = "light") -> Tab:
    """A new window on the page, as a new person would open it."""
    context = await browser.new_context(viewport=SIZE, color_scheme=theme, reduced_motion="no-preference")  # type: ignore[arg-type]
    context.set_default_timeout(8_000)
    tab = await context.new_page()
    await tab.goto(page.url)
    await expect(tab.get_by_role("button", name="Emergency stop")).to_be_visible()
    return tab


def element(tab: Tab, name: str, canvas: str = "Drawing of the task") -> Locator:
    """A place or transition of a drawing by its accessible name."""
    return tab.get_by_role("application", name=canvas).get_by_role("button", name=re.compile(name))


async def click_canvas(tab: Tab, x: float, y: float) -> None:
    """Click so far into the drawing, as parts of its width and height."""
    box = await tab.get_by_role("application", name="Drawing of the task").bounding_box()
    assert box is not None
    await tab.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])


async def draw_place(tab: Tab, kind: str, name: str, x: float, y: float) -> None:
    """Put a place on the drawing and give it its name."""
    await tab.get_by_role("toolbar", name="Drawing tools").get_by_role("button", name=kind).click()
    await click_canvas(tab, x, y)
    await rename(tab, name)
    await expect(element(tab, f"^{kind} {name}")).to_be_visible()


async def rename(tab: Tab, name: str) -> None:
    """Give the selected element a name."""
    field = tab.get_by_role("complementary", name="Properties").get_by_label("Name", exact=True)
    await field.fill(name)
    await field.press("Enter")


async def draw_transition(tab: Tab, name: str, x: float, y: float) -> None:
    """Put a transition on the drawing and give it its name."""
    await tab.get_by_role("toolbar", name="Drawing tools").get_by_role("button", name="Transition").click()
    await click_canvas(tab, x, y)
    await rename(tab, name)
    await expect(element(tab, f"^Transition {name}")).to_be_visible()


async def draw_arcs(tab: Tab, *chains: str) -> None:
    """Draw arcs along chains such as `a > t > b`, choosing one element after the other."""
    await tab.get_by_role("toolbar", name="Drawing tools").get_by_role("button", name="Arc", exact=True).click()
    for chain in chains:
        names = [name.strip() for name in chain.split(">")]
        for start, end in pairwise(names):
            for name in (start, end):
                await element(tab, f"^(Action place|Resource place|Control place|Transition) {name}\\b").click()
    await tab.keyboard.press("Escape")


async def choose_task(tab: Tab, place: str, primitive: str) -> None:
    """Associate a primitive task that some node offers with an action place."""
    await element(tab, f"^Action place {place}").click()
    properties = tab.get_by_role("complementary", name="Properties")
    await properties.get_by_label("Primitive task").select_option(primitive)


async def test_a_new_user_draws_runs_and_understands(
    browser: Browser, page: Page, stage: Stage, shots: Path, faults: Watch
) -> None:
    """The whole way without the manual: three actions with an error branch, run, pause, step, a run more, and why it failed."""
    tab = await opened(browser, page)
    complaints = faults(tab)
    await tab.get_by_role("tab", name="Design").click()
    await tab.get_by_role("button", name="New task").click()
    await draw_the_task(tab)
    await expect(tab.get_by_role("region", name="Findings")).to_contain_text("May run")
    await tab.screenshot(path=shots / "designer.png")

    await take_controls(tab)
    await tab.get_by_role("button", name="Run this task").click()
    dialog = tab.get_by_role("dialog", name="Save the task as")
    await dialog.get_by_label("Name").fill("drawn")
    await dialog.get_by_role("button", name="OK").click()
    await expect(tab.get_by_role("tab", name="Live")).to_have_attribute("aria-selected", "true")
    await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Running")
    await run_it_by_hand(tab, stage, shots)
    assert complaints == []


async def take_controls(tab: Tab) -> None:
    """Take the controls on the live view and come back."""
    await tab.get_by_role("tab", name="Live").click()
    await tab.get_by_role("button", name="Take controls").click()
    await expect(tab.get_by_text("You hold the controls").first).to_be_visible()
    await tab.get_by_role("tab", name="Design").click()


async def draw_the_task(tab: Tab) -> None:
    """`looking` for parts, then `picking` and `putting` them; a slip is cleared away."""
    await draw_place(tab, "Control place", "jobs", 0.08, 0.3)
    await draw_transition(tab, "begin", 0.2, 0.3)
    for i, name in enumerate(("looking", "picking", "putting")):
        await draw_place(tab, "Action place", name, 0.32 + 0.26 * i, 0.3)
        await draw_transition(tab, f"{name}_done", 0.45 + 0.26 * i if i < 2 else 0.84, 0.3 if i < 2 else 0.6)
    await draw_place(tab, "Resource place", "arm_free", 0.08, 0.6)
    for place, primitive in (("looking", "look"), ("picking", "pick"), ("putting", "put")):
        await choose_task(tab, place, primitive)
    await draw_arcs(
        tab,
        "jobs > begin > looking > looking_done > picking > picking_done > putting > putting_done > arm_free > begin",
    )
    for place in ("looking", "picking", "putting"):
        await element(tab, f"^Action place {place}").click()
        await tab.get_by_role("button", name="Add error branch").click()
    await draw_arcs(tab, *(f"{place}_error > arm_free" for place in ("looking", "picking", "putting")))
    await element(tab, "^Control place jobs").click()
    properties = tab.get_by_role("complementary", name="Properties")
    await properties.get_by_label("Tokens at the start").fill("2")
    await properties.get_by_label("Tokens at the start").press("Enter")
    await click_canvas(tab, 0.5, 0.93)
    await properties.get_by_label("Ends when").fill("jobs == 0 and arm_free == 1")
    await properties.get_by_label("Ends when").press("Enter")
    await properties.get_by_label("Remaining runs in").select_option("jobs")


async def run_it_by_hand(tab: Tab, stage: Stage, shots: Path) -> None:
    """Pause, step, put a token in, go on, and read the reason of the provoked error."""
    mission = tab.get_by_role("status", name="Mission state")
    toolbar = tab.get_by_role("toolbar", name="Mission")
    await toolbar.get_by_role("button", name="Pause").click()
    await expect(mission).to_contain_text("Paused")
    before = stage.state.firings
    await toolbar.get_by_role("button", name="Step").click()
    await expect(tab.get_by_role("region", name="Last firings").get_by_role("listitem")).to_have_count(before + 1)
    await expect(mission).to_contain_text("Paused")
    assert stage.state.firings == before + 1
    await element(tab, "^Control place jobs", "Task net").click()
    await tab.get_by_role("button", name="Add token").click()
    await expect(element(tab, "^Control place jobs, 2 tokens", "Task net")).to_be_visible()
    await tab.screenshot(path=shots / "paused.png")
    await toolbar.get_by_role("button", name="Resume").click()
    await expect(mission).to_contain_text("Success", timeout=15_000)
    why = tab.get_by_role("region", name="Last firings").get_by_role("listitem").filter(has_text="slipped")
    await expect(why).to_contain_text("pick on arm: the part slipped out of the gripper")
    await why.get_by_role("button").click()
    await expect(tab.get_by_role("region", name="Selected")).to_contain_text("the part slipped out of the gripper")
    await tab.screenshot(path=shots / "why.png")
