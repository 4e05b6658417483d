"""Extreme contents: names of eighty letters, markup, other alphabets, sixty places, twelve nodes
and hundreds of errors, on a laptop, a wall screen, a phone, and zoomed to twice the size. Nothing
is cut off, nothing overlaps its neighbour, and all of it is shown as text."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from petrobot.coordinator.page.server import Page
from tests.page.conftest import PATIENCE_MS, browser_missing, served, staged
from tests.page.stage import Stage

if browser_missing() and os.environ.get("CI") != "true":
    pytest.skip(browser_missing(), allow_module_level=True)

from playwright.async_api import Browser, Page as Tab, expect

from tests.page.steps import Watch, settled

LONG = ("a_name_that_somebody_wrote_down_without_any_thought_of_screens_or_of_readers_" * 2)[:80]
OTHER = "Überprüfung_der_Zange_für_日本語_und_العربية"
MARKUP = "<img src=x onerror=\"document.title='owned'\"><b>bold</b> &amp; &lt;"
NAMES = (LONG, OTHER, MARKUP)
SIZES = [
    (1280, 720, 1, "light"),
    (1920, 1080, 1, "dark"),
    (640, 360, 2, "light"),
    (640, 360, 2, "dark"),
    (390, 844, 3, "light"),
]


@pytest_asyncio.fixture(loop_scope="session")
async def page(tasks: Path, tmp_path: Path) -> AsyncIterator[Page]:
    """The page of a mission with extreme contents."""
    async with (
        staged(tasks, tmp_path / "runs") as stage,
        served(stage, tasks, tmp_path / "runs") as made,
    ):
        crowd(stage)
        yield made


def crowd(stage: Stage) -> None:
    """Build sixty places, twelve nodes, five hundred error rows and extreme names."""
    drawn = stage.feed.state["task"]
    kinds = ("control", "resource", "action")
    like = {p["kind"]: p for p in drawn["places"]}
    place: dict[str, Any] = {
        "tokens": 0,
        "capacity": None,
        "label": "",
        "in_macro": "",
        "args": {},
        "error": False,
    }
    places = [
        {
            **like.get(kinds[i % 3], like["control"]),
            **place,
            "name": f"p{i}",
            "kind": kinds[i % 3],
            "label": NAMES[i % 3] if i % 4 else "",
        }
        | {
            "x": 80 + i % 10 * 170,
            "y": 80 + i // 10 * 130,
            "primitive_task": "look" if i % 3 == 2 else "",
        }
        for i in range(60)
    ]
    task = {**drawn, "name": LONG, "places": places, "transitions": [], "arcs": []}
    nodes = {
        f"{NAMES[i % 3]} {i}": {"state": ("up", "lost", "connecting")[i % 3], "text": LONG}
        for i in range(12)
    }
    known = {"probability": 0.5, "reliability": 0.9, "cost": 1.25, "j": 0.3}
    selectors = {
        "look": {"alternatives": [{"action": name, **known} for name in NAMES], "override": None}
    }
    mission = {
        **stage.feed.state["mission"],
        "state": "running",
        "id": LONG,
        "mode": "lockstep",
        "from": {"run": LONG, "record": 123456},
    }
    controls = {"holder": f"{OTHER[:24]} 1234", "asking": [f"{LONG[:24]} 5678"]}
    stage.feed.replace(
        task=task, mission=mission, nodes=nodes, selectors=selectors, controls=controls
    )
    reason = {"status": "error", "code": LONG, "text": MARKUP * 5, "executed": "unknown"}
    for i in range(500):
        run = {
            "id": f"p2#{i}",
            "place": "p2",
            "primitive_task": "look",
            "action": NAMES[i % 3],
            "node": NAMES[i % 3],
            "why": LONG,
        }
        stage.feed.emit(
            "run_started",
            time=i / 10,
            run={**run, "started": i / 10, "deadline": 5.0, "progress": 0.3, "state": "running"},
        )
        if i < 495:
            stage.feed.emit(
                "run_ended",
                id=f"p2#{i}",
                status="error",
                ended=i / 10 + 0.08,
                reason=reason,
                cancelled=False,
            )
        firing = {
            "number": i,
            "transition": f"t{i}",
            "at": i / 10,
            "cause": LONG,
            "error": True,
            "run": run["id"],
            "action": LONG,
        }
        stage.feed.emit("fired", firing={**firing, "node": OTHER, "reason": reason})
        stage.feed.emit("variable", name=f"{NAMES[i % 3]}{i % 30}", value=[MARKUP] * 9)
    for name in NAMES:
        values = {"state": LONG, "joints": [0.1, -1.2], "values": {LONG: MARKUP}}
        stage.feed.emit("device", name=name, device=values)
        curve: dict[str, Any] = {
            "kind": "curve",
            "title": name,
            "x": "trial",
            "y": "probability",
            "series": [LONG, OTHER],
        }
        stage.feed.emit(
            "report",
            name=name,
            report={**curve, "columns": [[1, 2, 3], [0.5, 0.6, 0.7], [0.5, 0.4, 0.3]]},
        )
    answers = ("held", "cannot_hold", "stopped", "lost")
    paused = {
        "reason": LONG,
        "at": 3.0,
        "nodes": {node: answers[i % 4] for i, node in enumerate(nodes)},
    }
    stage.feed.emit("paused", paused=paused)
    stage.feed.emit("marking", marking={"p0": 123456, "p2": 1})


OUTSIDE = """(box) => [...document.querySelectorAll(box)].filter((e) => {
  const r = e.getBoundingClientRect();
  return r.width > 0 && r.height > 0 && (r.left < -1 || r.right > innerWidth + 1);
}).map((e) => e.outerHTML.slice(0, 120))"""
OVERLAP = """(box) => {
  const boxed = [...document.querySelectorAll(box)].map((e) => [e, e.getBoundingClientRect()]);
  const all = boxed.filter(([, r]) => r.width > 0 && r.height > 0);
  const found = [];
  for (const [i, [a, p]] of all.entries()) for (const [b, q] of all.slice(i + 1)) {
    if (a.contains(b) || b.contains(a)) continue;
    const wide = Math.min(p.right, q.right) - Math.max(p.left, q.left);
    const tall = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
    if (wide > 2 && tall > 2) found.push([a.textContent.slice(0, 40), b.textContent.slice(0, 40)]);
  }
  return found;
}"""


async def nothing_is_cut(tab: Tab) -> None:
    """Check that no control of header, bars and lists is outside the window or covers another one,
    and that the emergency stop is visible."""
    assert await tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
    for box in (
        ".top button",
        ".operator button, .operator select",
        ".scrub button",
        ".side .card, .side .firing, .run-row",
        ".design-bar > *, .toolbox button, .inspector input",
        "dialog *",
    ):
        assert await tab.evaluate(OUTSIDE, box) == []
    for box in (
        ".top > *",
        ".operator > *",
        ".scrub > *",
        ".tabs > button",
        ".banner > *",
        ".top, dialog",
    ):
        assert await tab.evaluate(OVERLAP, box) == []
    stop = await tab.get_by_role("button", name="Emergency stop").bounding_box()
    size = tab.viewport_size
    assert stop is not None and size is not None
    assert (
        stop["y"] >= 0
        and stop["y"] + stop["height"] <= size["height"]
        and stop["x"] + stop["width"] <= size["width"]
    )


@pytest.mark.parametrize(("width", "height", "zoom", "theme"), SIZES)
async def test_nothing_is_cut(
    browser: Browser,
    page: Page,
    shots: Path,
    faults: Watch,
    width: int,
    height: int,
    zoom: int,
    theme: Any,
) -> None:
    """Check every tab of the page, in light and dark colours, at every size."""
    context = await browser.new_context(
        viewport={"width": width, "height": height}, device_scale_factor=zoom, color_scheme=theme
    )
    context.set_default_timeout(PATIENCE_MS)
    tab = await context.new_page()
    complaints = faults(tab)
    await tab.goto(page.url)
    await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Paused")
    await expect(tab.get_by_role("region", name="Last firings")).to_contain_text("<img src=x")
    await nothing_is_cut(tab)
    for name in ("Devices", "Learning", "Variables", "Timeline"):
        await tab.get_by_role("tab", name=name, exact=True).click()
        await expect(tab.get_by_role("tabpanel", name=name, exact=True)).to_be_visible()
        await nothing_is_cut(tab)
        assert await tab.get_by_role("tabpanel", name=name, exact=True).evaluate(
            "(e) => e.scrollWidth <= e.clientWidth + 1"
        )
    await tab.screenshot(path=shots / f"extremes-{width}-{theme}.png")
    await tab.get_by_role("tab", name="History").click()
    await expect(tab.get_by_role("navigation", name="Runs")).to_be_visible()
    await nothing_is_cut(tab)
    await tab.screenshot(path=shots / f"extremes-history-{width}-{theme}.png")
    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)
    await nothing_is_cut(tab)
    drawing = await tab.get_by_role("application", name="Drawing of the task").bounding_box()
    assert drawing is not None and drawing["width"] > 0.4 * width
    await tab.get_by_role("button", name="Keyboard").click()
    await expect(tab.get_by_role("dialog", name="Keyboard")).to_be_visible()
    await nothing_is_cut(tab)
    assert await tab.title() == "petrobot" and await tab.locator("img[src=x]").count() == 0
    assert complaints == []
    await context.close()
