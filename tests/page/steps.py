"""Steps of a user on the page in a real browser, by role and name: open it, take the controls,
draw, start."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Literal, Protocol

from playwright.async_api import Browser, Locator, Page as Tab, Route, expect

from petrobot.coordinator.page.server import Page
from tests.page.conftest import PATIENCE_MS, new_window, note_toasts

Watch = Callable[[Tab], list[str]]
expect.set_options(timeout=PATIENCE_MS)


class Address(Protocol):
    """What serves the page."""

    @property
    def url(self) -> str:
        """Its address, with the token."""
        ...


async def opened(browser: Browser, page: Address, theme: Literal["light", "dark"] = "light") -> Tab:
    """Open the page in a new window, as a new user."""
    tab = await new_window(browser, theme)
    await tab.goto(page.url)
    await expect(tab.get_by_role("button", name="Emergency stop")).to_be_visible()
    await note_toasts(tab)
    return tab


async def settled(tab: Tab) -> None:
    """Wait until the designer has opened its task: nothing moves by itself any more."""
    await expect(tab.locator(".designer")).not_to_have_attribute("aria-busy", "true")


async def checked(tab: Tab, said: str = "May run") -> None:
    """Wait until the server's findings are those of the net that is drawn now; before, the page
    shows findings of an earlier drawing."""
    findings = tab.get_by_role("region", name="Findings")
    await expect(findings).not_to_have_attribute("aria-busy", "true")
    await expect(findings).to_contain_text(said)


def element(tab: Tab, name: str, canvas: str = "Drawing of the task") -> Locator:
    """Return a place or transition of a drawing by its accessible name."""
    return tab.get_by_role("application", name=canvas).get_by_role("button", name=re.compile(name))


async def click_canvas(tab: Tab, x: float, y: float) -> None:
    """Click at a position given as fractions of the drawing's width and height."""
    box = await tab.get_by_role("application", name="Drawing of the task").bounding_box()
    assert box is not None
    await tab.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])


async def draw_place(tab: Tab, kind: str, name: str, x: float, y: float) -> None:
    """Draw a place and name it."""
    await tab.get_by_role("toolbar", name="Drawing tools").get_by_role("button", name=kind).click()
    await click_canvas(tab, x, y)
    await rename(tab, name)
    await expect(element(tab, f"^{kind} {name}")).to_be_visible()


async def rename(tab: Tab, name: str) -> None:
    """Rename the selected element."""
    field = tab.get_by_role("complementary", name="Properties").get_by_label("Name", exact=True)
    await field.fill(name)
    await field.press("Enter")


async def draw_transition(tab: Tab, name: str, x: float, y: float) -> None:
    """Draw a transition and name it."""
    await (
        tab.get_by_role("toolbar", name="Drawing tools")
        .get_by_role("button", name="Transition")
        .click()
    )
    await click_canvas(tab, x, y)
    await rename(tab, name)
    await expect(element(tab, f"^Transition {name}")).to_be_visible()


async def draw_arcs(tab: Tab, *chains: str) -> None:
    """Draw arcs along chains such as `a > t > b` by selecting one element after the other."""
    await (
        tab.get_by_role("toolbar", name="Drawing tools")
        .get_by_role("button", name="Arc", exact=True)
        .click()
    )
    for chain in chains:
        names = [name.strip() for name in chain.split(">")]
        for start, end in pairwise(names):
            for name in (start, end):
                await element(
                    tab, f"^(Action place|Resource place|Control place|Transition) {name}\\b"
                ).click()
    await tab.keyboard.press("Escape")


async def choose_task(tab: Tab, place: str, primitive: str) -> None:
    """Associate a primitive task that some node offers with an action place."""
    await element(tab, f"^Action place {place}").click()
    properties = tab.get_by_role("complementary", name="Properties")
    await properties.get_by_label("Primitive task").select_option(primitive)


async def hold_controls(tab: Tab) -> None:
    """Take the controls, and wait until the page holds them."""
    await tab.get_by_role("button", name="Take controls").click()
    await expect(tab.get_by_role("toolbar", name="Mission")).to_contain_text(
        "You hold the controls"
    )


async def take_controls(tab: Tab) -> None:
    """Take the controls on the live view and come back."""
    await tab.get_by_role("tab", name="Live").click()
    await hold_controls(tab)
    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)


async def draw_the_task(tab: Tab) -> None:
    """`looking` for parts, then `picking` and `putting` them; a slip is cleared away."""
    await draw_place(tab, "Control place", "jobs", 0.08, 0.3)
    await draw_transition(tab, "begin", 0.2, 0.3)
    for i, name in enumerate(("looking", "picking", "putting")):
        await draw_place(tab, "Action place", name, 0.32 + 0.26 * i, 0.3)
        await draw_transition(
            tab, f"{name}_done", 0.45 + 0.26 * i if i < 2 else 0.84, 0.3 if i < 2 else 0.6
        )
    await draw_place(tab, "Resource place", "arm_free", 0.08, 0.6)
    for place, primitive in (("looking", "look"), ("picking", "pick"), ("putting", "put")):
        await choose_task(tab, place, primitive)
    await draw_arcs(
        tab,
        "jobs > begin > looking > looking_done > picking > picking_done > putting > "
        "putting_done > arm_free > begin",
    )
    for place in ("looking", "picking", "putting"):
        await element(tab, f"^Action place {place}").click()
        await tab.get_by_role("button", name="Add error branch").click()
    await draw_arcs(
        tab, *(f"{place}_error > arm_free" for place in ("looking", "picking", "putting"))
    )
    await element(tab, "^Control place jobs").click()
    properties = tab.get_by_role("complementary", name="Properties")
    await properties.get_by_label("Tokens at the start").fill("2")
    await properties.get_by_label("Tokens at the start").press("Enter")
    await click_canvas(tab, 0.5, 0.93)
    await properties.get_by_label("Ends when").fill("jobs == 0 and arm_free == 1")
    await properties.get_by_label("Ends when").press("Enter")
    await properties.get_by_label("Remaining runs in").select_option("jobs")


async def start_mission(tab: Tab, task: str = "") -> None:
    """Start, which takes the free controls."""
    await tab.get_by_role("toolbar", name="Mission").get_by_role("button", name="Start").click()
    await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Running")


async def designer(browser: Browser, page: Page) -> Tab:
    """Open the shipped task in the designer."""
    tab = await opened(browser, page)
    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)
    await checked(tab)
    return tab


async def select_by_keyboard(tab: Tab, name: str) -> None:
    """Step through the elements by keyboard until the one with this name is selected."""
    properties = tab.get_by_role("complementary", name="Properties")
    for _ in range(12):
        await tab.keyboard.press("]")
        field = properties.get_by_label("Name", exact=True)
        if await field.count() and await field.input_value() == name:
            return
    raise AssertionError(f"{name} was not reached")


async def late(tab: Tab, pattern: str, method: str) -> asyncio.Event:
    """Delay the server's answers to matching requests until the event is set."""
    arrive = asyncio.Event()

    async def handle(route: Route) -> None:
        if route.request.method != method:
            await route.continue_()
            return
        response = await route.fetch()
        await arrive.wait()
        await route.fulfill(response=response)

    await tab.route(pattern, handle)
    return arrive


@asynccontextmanager
async def pressed(tab: Tab, button: str) -> AsyncIterator[None]:
    """Hold a button down with the mouse for this time."""
    await tab.get_by_role("button", name=button).hover()
    await tab.mouse.down()
    yield
    await tab.mouse.up()
