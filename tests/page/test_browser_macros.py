"""Closed macro places and folded error branches hide parts of the drawing, but activity, tokens and
errors are still visible from outside."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from petrobot.coordinator.page.server import Page
from petrobot.coordinator.task.file import load
from tests.page.conftest import browser_missing
from tests.page.stage import Stage

if browser_missing() and os.environ.get("CI") != "true":
    pytest.skip(browser_missing(), allow_module_level=True)

from playwright.async_api import Browser, Page as Tab, expect

from tests.page.steps import element, hold_controls, opened

NET = "Task net"
BRANCH = ("pick_failed", "put_failed", "cleared", "stuck")


def grouped(text: str, macros: dict[str, tuple[str, ...]]) -> str:
    """Return the task with elements in macro places: {macro place: names of its elements}."""
    for i, (macro, names) in enumerate(macros.items()):
        for name in names:
            text = re.sub(
                rf"(?m)^(\[(?:places|transitions)\.{name}\].*)$", rf'\1\nmacro = "{macro}"', text
            )
        text += f'\n[places.{macro}]\nkind = "macro"\nx = {560 - 120 * i}\ny = 180\n'
    return text


async def running(
    browser: Browser, page: Page, stage: Stage, macros: dict[str, tuple[str, ...]]
) -> Tab:
    """Start the task with these groups; a run of `pick` lasts until the test lets it end in
    error."""
    path = stage.tasks / "grouped.toml"
    path.write_text(
        grouped((stage.tasks / "pick_and_place.toml").read_text(), macros), encoding="utf-8"
    )
    stage.load(load(path), path.read_text())
    stage.kept |= {"pick", "clear"}
    tab = await opened(browser, page)
    await hold_controls(tab)
    assert (await stage.command(str(stage.controls.holder), "start", {"task": "grouped"}))["ok"]
    stage.happen("part_there")
    return tab


@pytest.mark.parametrize(
    "macros",
    [{"handling": ("pick",)}, {"inner": ("pick",), "middle": ("inner",), "handling": ("middle",)}],
    ids=["in a macro place", "three levels deep"],
)
async def test_an_error_that_leaves_a_closed_macro_place(
    browser: Browser, page: Page, stage: Stage, macros: dict[str, tuple[str, ...]]
) -> None:
    """The closed place shows the run; when it fails, the folded branch that starts there shows its
    tokens."""
    tab = await running(browser, page, stage, macros)
    await expect(element(tab, "^Macro place handling, 1 token, running", NET)).to_be_visible()
    await expect(tab.locator(".live .moving [data-run=running]")).to_have_count(1)
    stage.kept.discard("pick")
    badge = tab.locator(".net [data-name=handling] .mark.fold")
    await expect(badge).to_have_class(re.compile("alarm"))
    await expect(badge.locator(".number")).to_have_text("1")
    await expect(
        element(tab, "^Macro place handling, 0 tokens, 1 in an error branch", NET)
    ).to_be_visible()
    await expect(tab.get_by_role("button", name="Error branches: 1")).to_be_visible()
    await badge.click()
    await expect(element(tab, "^Action place clear, 1 token, running", NET)).to_be_visible()
    await expect(tab.get_by_role("button", name="Error branches", exact=True)).to_be_visible()
    stage.kept.discard("clear")
    await expect(element(tab, "^Action place clear, 0 tokens", NET)).to_be_visible()
    await tab.get_by_role("button", name="Error branches", exact=True).click()
    await expect(badge).not_to_have_class(re.compile("alarm"))


@pytest.mark.parametrize("deep", [False, True], ids=["one level", "two levels"])
async def test_an_error_that_stays_in_a_closed_macro_place(
    browser: Browser, page: Page, stage: Stage, shots: Path, deep: bool
) -> None:
    """The error branch is inside: the closed macro place shows it, and so does each macro place
    around it."""
    inside = ("pick", "put", "clear", "picked", "pick_failed", "put_failed")
    macros: dict[str, tuple[str, ...]] = (
        {"handling": inside} if not deep else {"inner": inside, "handling": ("inner",)}
    )
    tab = await running(browser, page, stage, macros)
    await expect(element(tab, "^Macro place handling, 1 token, running", NET)).to_be_visible()
    stage.kept.discard("pick")
    await expect(
        element(tab, "^Macro place handling, 1 token, running, 1 in an error branch", NET)
    ).to_be_visible()
    mark = tab.locator(".net [data-name=handling] .mark.error.alarm")
    await expect(mark.locator(".number")).to_have_text("1")
    await tab.screenshot(path=shots / "macro-error.png")
    await tab.get_by_role("region", name="Running now").get_by_role("listitem").click()
    await expect(element(tab, "^Action place clear, 1 token, running", NET)).to_be_visible()
    stage.kept.discard("clear")
    await (
        tab.get_by_role("navigation", name="Opened macro places")
        .get_by_role("button")
        .first.click()
    )
    await expect(element(tab, "^Macro place handling, 0 tokens$", NET)).to_be_visible()
    await expect(mark).to_have_count(0)


async def test_an_error_elsewhere_shows_inside_an_opened_macro_place(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """In another part of the net the page shows that a token is in an error branch outside this
    view."""
    tab = await running(browser, page, stage, {"looking": ("look",), "handling": ("put",)})
    await tab.locator(".live .net [data-name=looking] .body").dblclick()
    await expect(element(tab, "^Action place look", NET)).to_be_visible()
    stage.kept.discard("pick")
    await expect(tab.get_by_role("button", name="Error branches: 1")).to_be_visible()


async def test_the_history_shows_the_same(browser: Browser, page: Page, stage: Stage) -> None:
    tab = await running(browser, page, stage, {"inner": ("pick",), "handling": ("inner",)})
    stage.kept.discard("pick")
    badge = tab.locator(".live .net [data-name=handling] .mark.fold")
    await expect(badge).to_have_class(re.compile("alarm"))
    await tab.get_by_role("tab", name="History").click()
    await tab.get_by_role("button", name=re.compile("^grouped|pick_and_place-")).first.click()
    shown = tab.locator(".history .net [data-name=handling] .mark.fold")
    await expect(shown).to_have_class(re.compile("alarm"))
    await expect(shown.locator(".number")).to_have_text("1")
