"""The page never freezes silently: numbers that JSON does not have, messages that it cannot read or
show, connections that fail."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from math import inf, nan
from pathlib import Path

import pytest

from petrobot.coordinator.page.server import Page, start_page
from tests.page.conftest import SIZE, browser_missing, nobody_listens, served
from tests.page.stage import Stage

if browser_missing() and os.environ.get("CI") != "true":
    pytest.skip(browser_missing(), allow_module_level=True)

from playwright.async_api import Browser, Page as Tab, WebSocketRoute, expect

from tests.page.steps import Watch, element, opened, start_mission
from tests.waiting import Limit, beat, until

Mangle = Callable[[str], str | bytes]


DETAILS = ("Camera", "Devices", "Set points", "Learning", "Variables", "Events", "Timeline")


def emit_everything(stage: Stage, bad: float) -> None:
    """Emit every kind of change that has numbers, with a non-finite one in every position."""
    feed = stage.feed
    values = {"setpoint_age": bad, "load": 0.25, "list": [bad, {"deep": [bad]}]}
    feed.emit(
        "device",
        name="arm",
        device={"state": "on", "joints": [0.1, bad], "limits": [[bad, 1.0]], "age": bad}
        | {"values": values},
    )
    feed.emit("variable", name="distance", value={"near": bad, "all": [1, [bad]]})
    feed.emit("variable", name="plain", value=bad)
    feed.emit("setpoint", stream="point", samples=[[0.1, 0.01], [0.2, bad], [0.3, 0.02]])
    curve = {"kind": "curve", "title": "Choice", "x": "runs", "y": "p", "series": ["a"]}
    feed.emit("report", name="c", report={**curve, "columns": [[1, 2, 3], [0.5, bad, 0.7]]})
    known = [
        {"action": a, "probability": bad, "reliability": bad, "cost": bad, "j": bad}
        for a in ("a", "b")
    ]
    feed.emit("selector", name="look", selector={"alternatives": known, "override": None})
    found = [{"kind": "circle", "x": bad, "y": 2, "r": bad, "label": "part"}]
    image = {
        "mime": "image/png",
        "data": "",
        "width": 640,
        "height": 360,
        "age": bad,
        "detections": found,
    }
    feed.emit("image", name="table", image=image)
    feed.emit("node", name="vision", node={"state": "up", "round_trip": bad})
    run = {
        "id": "x#1",
        "place": "look",
        "primitive_task": "look",
        "action": "a",
        "node": "n",
        "why": "",
    }
    feed.emit("run_started", run={**run, "started": bad, "deadline": bad, "progress": bad})
    feed.emit("run_progress", id="x#1", progress=bad)
    event = {
        "scope": "external",
        "memory": "pulse",
        "armed": False,
        "count": 1,
        "last": bad,
        "data": {"v": bad},
    }
    feed.emit("event", name="part_there", event=event)
    feed.emit("result", result={"status": "success", "score": bad, "learned": {"R": [bad]}})
    feed.emit("notice", notice={"level": "info", "text": "done", "at": bad})


@pytest.mark.parametrize("bad", [inf, -inf, nan], ids=["inf", "-inf", "nan"])
async def test_numbers_that_are_not_finite_do_not_break_the_page(
    browser: Browser, page: Page, stage: Stage, faults: Watch, bad: float
) -> None:
    """They arrive as deltas at an open page and in the snapshot of one that is loaded. The page
    shows no value for them, and everything else works."""
    tab = await opened(browser, page)
    complaints = faults(tab)
    emit_everything(stage, bad)
    stage.feed.emit("mission", mission={"state": "running", "reason": "told after it"})
    for parts in (6, 7):
        await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Running")
        for name in DETAILS:
            await tab.get_by_role("tab", name=name, exact=True).click()
        await tab.get_by_role("tab", name="Devices", exact=True).click()
        await expect(tab.get_by_role("tabpanel", name="Devices")).to_contain_text("\N{EN DASH}")
        await expect(tab.get_by_role("tabpanel", name="Devices")).to_contain_text("0.2500")
        await expect(tab.get_by_role("region", name="Selectors")).not_to_contain_text("0 %")
        await expect(tab.get_by_role("alert")).to_be_hidden()
        stage.feed.emit("marking", marking={"parts": parts})
        marked = f"^Control place parts, {parts} tokens"
        await expect(element(tab, marked, "Task net")).to_be_visible()
        assert complaints == []
        await tab.reload()


async def test_history_and_http_carry_no_infinity(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """Answers over HTTP are also readable in a browser."""
    tab = await opened(browser, page)
    stage.feed.emit("result", result={"score": inf, "deep": [{"x": nan}]})
    read = "async () => (await (await fetch('/api/snapshot')).json()).result"
    assert await tab.evaluate(read) == {"score": None, "deep": [{"x": None}]}


async def through_a_proxy(browser: Browser, page: Page, mangle: Mangle) -> tuple[Tab, list[str]]:
    """Open a window whose live messages pass a function that may change them; also return the
    messages."""
    context = await browser.new_context(viewport=SIZE)
    passed: list[str] = []

    def carry(socket: WebSocketRoute) -> None:
        server = socket.connect_to_server()

        def receive(message: str | bytes) -> None:
            passed.append(str(message))
            socket.send(mangle(str(message)))

        server.on_message(receive)

    await context.route_web_socket("**/api/live", carry)
    tab = await context.new_page()
    await tab.goto(page.url)
    await expect(element(tab, "^Control place parts", "Task net")).to_be_visible()
    return tab, passed


def once(alter: Callable[[str], str | bytes]) -> Mangle:
    """Change the next delta and no other message."""
    done: list[bool] = []

    def mangle(message: str) -> str | bytes:
        if done or '"type":"delta"' not in message:
            return message
        done.append(True)
        return alter(message)

    return mangle


ALTERED: dict[str, Callable[[str], str | bytes]] = {
    "cut off": lambda m: m[: len(m) // 2],
    "with Infinity in it": lambda m: m.replace('"time":', '"more":Infinity,"time":'),
    "no object": lambda _: "null",
    "bytes": lambda m: m.encode(),
    "without its changes": lambda m: json.dumps({**json.loads(m), "changes": None}),
    "with a change that cannot be applied": lambda m: json.dumps(
        {**json.loads(m), "changes": [None]}
    ),
}


@pytest.mark.parametrize("how", ALTERED)
async def test_a_message_that_cannot_be_read_is_a_lost_connection(
    browser: Browser, page: Page, stage: Stage, how: str
) -> None:
    """The bar shows it, and the page continues with a new snapshot, so the content of the message
    is not missing."""
    tab, passed = await through_a_proxy(browser, page, once(ALTERED[how]))
    await tab.evaluate(NOTE_BAR)
    stage.feed.emit("marking", marking={"parts": 5})
    await expect(element(tab, "^Control place parts, 5 tokens", "Task net")).to_be_visible()
    await expect(tab.get_by_role("alert")).to_be_hidden()
    assert any("could not show" in said for said in await tab.evaluate("window.barSaid"))
    assert sum('"type":"snapshot"' in message for message in passed) == 2, (
        "the first snapshot and a new one"
    )
    stage.feed.emit("marking", marking={"parts": 4})
    await expect(element(tab, "^Control place parts, 4 tokens", "Task net")).to_be_visible()


NOTE_BAR = """() => {
  const bar = document.querySelector(".lost");
  window.barSaid = [];
  const note = () => window.barSaid.push(bar.hidden ? "" : bar.textContent);
  const all = { subtree: true, childList: true, characterData: true, attributes: true };
  new MutationObserver(note).observe(bar, all);
}"""


async def test_a_page_that_receives_only_what_it_cannot_read_says_so_and_keeps_trying(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """The bar does not flicker: it stays until a message can be read again."""
    broken: list[bool] = []
    tab, passed = await through_a_proxy(browser, page, lambda m: m[:-1] if broken else m)
    broken.append(True)
    stage.feed.emit("marking", marking={"parts": 5})
    bar = tab.get_by_role("alert")
    await expect(bar).to_contain_text("could not show")
    before = len(passed)
    await until(lambda: len(passed) > before + 2)
    await expect(bar).to_contain_text("could not show")
    broken.clear()
    await expect(bar).to_be_hidden()
    await expect(element(tab, "^Control place parts, 5 tokens", "Task net")).to_be_visible()


async def test_an_exception_in_the_page_is_reported_and_followed_by_a_new_connection(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """After an exception in a handler the page does not show an old picture: it reports the fault
    and connects again."""
    tab = await opened(browser, page)
    await start_mission(tab)
    await tab.evaluate(NOTE_BAR)
    await tab.evaluate(
        "() => { const own = petrobot.tabs.Live; const paint = own.paint;"
        " own.paint = () => { own.paint = paint; throw new Error('a fault for the test'); }; }"
    )
    stage.feed.emit("marking", marking={"parts": 9})
    await expect(element(tab, "^Control place parts, 9 tokens", "Task net")).to_be_visible()
    assert any("a fault for the test" in said for said in await tab.evaluate("window.barSaid"))
    await expect(tab.get_by_role("alert")).to_be_hidden()


async def test_missing_changes_are_asked_for_once(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """A delta is missing: however many follow before the snapshot, the page asks for one. The next
    time it asks again."""
    context = await browser.new_context(viewport=SIZE)
    held: list[str | bytes] = []
    asked, dropping = list[str](), list[bool]()

    def carry(socket: WebSocketRoute) -> None:
        server = socket.connect_to_server()

        def receive(message: str | bytes) -> None:
            if dropping and '"type":"delta"' in str(message):
                dropping.pop()
            elif len(asked) == 1 and '"type":"snapshot"' in str(message):
                held.append(message)
            else:
                socket.send(message)

        def send(message: str | bytes) -> None:
            if '"resync"' in str(message):
                asked.append(str(message))
            server.send(message)

        server.on_message(receive)
        socket.on_message(send)

    await context.route_web_socket("**/api/live", carry)
    tab = await context.new_page()
    await tab.goto(page.url)
    await expect(element(tab, "^Control place parts", "Task net")).to_be_visible()
    dropping.append(True)
    limit = Limit("further messages that do not follow the last one")
    while await tab.evaluate("petrobot.link.gaps") <= 3 and limit.left():
        stage.feed.emit("marking", marking={"parts": 7})  # what waits together is one message
        await beat(0.05)
    assert len(asked) == 1
    await until(lambda: bool(held))
    old = json.dumps({**json.loads(held[-1]), "sequence": 0})
    await tab.evaluate("(m) => petrobot.link.receive(petrobot.link.socket, m)", old)
    stage.feed.emit("marking", marking={"parts": 12})
    await expect(element(tab, "^Control place parts, 12 tokens", "Task net")).to_be_visible()
    assert len(asked) == 2


async def test_the_emergency_stop_works_when_messages_cannot_be_read(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """The page cannot read messages, but the coordinator still answers: the button stops."""
    broken: list[bool] = []
    tab, _ = await through_a_proxy(browser, page, lambda m: "?" if broken else m)
    broken.append(True)
    stage.feed.emit("marking", marking={"parts": 5})
    await expect(tab.get_by_role("alert")).to_contain_text("could not show")
    await tab.get_by_role("button", name="Emergency stop").click()
    await expect(tab.locator(".toast", has_text="Emergency stop sent")).to_be_visible()
    assert stage.feed.state["mission"]["state"] == "stopped"


async def test_the_emergency_stop_goes_past_a_connection_that_has_just_died(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """Nothing that the page sends arrives, and it cannot know that yet: the stop arrives."""
    context = await browser.new_context(viewport=SIZE)

    def carry(socket: WebSocketRoute) -> None:
        server = socket.connect_to_server()
        socket.on_message(lambda m: None if '"command"' in str(m) else server.send(m))

    await context.route_web_socket("**/api/live", carry)
    tab = await context.new_page()
    await tab.goto(page.url)
    await expect(element(tab, "^Control place parts", "Task net")).to_be_visible()
    await tab.get_by_role("button", name="Emergency stop").click()
    await expect(tab.locator(".toast", has_text="Emergency stop sent")).to_be_visible()
    assert stage.feed.state["mission"]["state"] == "stopped"
    await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Emergency stop")


async def test_silence_is_a_lost_connection_before_it_is_closed(
    browser: Browser, page: Page
) -> None:
    """Without a network, closing a connection takes long. The page says at once that it is old."""
    tab = await opened(browser, page)
    await expect(element(tab, "^Control place parts", "Task net")).to_be_visible()
    silent = """() => {
      const { link } = petrobot;
      link.socket.close = () => {};
      link.heardAt = performance.now() - 4000;
      link.watch();
      return link.connected;
    }"""
    assert await tab.evaluate(silent) is False
    await expect(tab.get_by_role("alert")).to_be_hidden()  # connected again


async def test_a_page_that_never_connected_says_so(browser: Browser, page: Page) -> None:
    """Its files arrived, but the live connection fails: it shows a bar, not an idle mission, until
    there is a connection."""
    context = await browser.new_context(viewport=SIZE)
    shut = [True]

    def carry(socket: WebSocketRoute) -> None:
        if not shut:
            socket.connect_to_server()

    await context.route_web_socket("**/api/live", carry)
    tab = await context.new_page()
    await tab.goto(page.url)
    await expect(tab.get_by_role("alert")).to_contain_text("Not connected to the coordinator yet")
    shut.clear()
    await expect(tab.get_by_role("alert")).to_be_hidden()


async def test_a_page_whose_script_does_not_arrive_says_so(browser: Browser, page: Page) -> None:
    context = await browser.new_context(viewport=SIZE)
    await context.route("**/js/state.js", lambda route: route.abort())
    tab = await context.new_page()
    await tab.goto(page.url)
    await expect(tab.get_by_role("alert")).to_contain_text("could not start")
    await expect(tab.get_by_role("alert")).to_be_visible()


COLOURS = (
    "(b) => (({ color, backgroundColor: ground }) => ({ color, ground }))(getComputedStyle(b))"
)


async def test_after_a_restart_with_another_key_old_windows_say_what_to_do(
    browser: Browser, stage: Stage, tasks: Path, tmp_path: Path
) -> None:
    """The key is new at each start. An old window says which address to open, and works again once
    that was opened."""
    async with served(stage, tasks, tmp_path / "runs") as first:
        tab = await opened(browser, first)
        port = int(first.url.rpartition(":")[2].partition("/")[0])
    with nobody_listens(port):
        await expect(tab.get_by_role("alert")).to_be_visible()
        again = await start_page(stage, tasks_folder=tasks, port=port)
    try:
        bar = tab.get_by_role("alert")
        await expect(bar).to_contain_text("restarted and has a new key")
        await expect(bar).not_to_contain_text("Trying again")
        await expect(bar.get_by_role("link")).to_be_visible()
        shade = await bar.get_by_role("button", name="Open").evaluate(COLOURS)
        assert shade["color"] != shade["ground"]
        beside = await tab.context.new_page()
        await beside.goto(again.url)
        await expect(bar).to_be_hidden()
    finally:
        await again.close()


async def test_the_new_address_can_be_given_to_the_old_window(
    browser: Browser, stage: Stage, tasks: Path, tmp_path: Path
) -> None:
    async with served(stage, tasks, tmp_path / "runs") as first:
        tab = await opened(browser, first)
        port = int(first.url.rpartition(":")[2].partition("/")[0])
    with nobody_listens(port):
        await expect(tab.get_by_role("alert")).to_be_visible()
        again = await start_page(stage, tasks_folder=tasks, port=port)
    try:
        await tab.get_by_label("Printed address").fill(again.url)
        await tab.get_by_role("button", name="Open", exact=True).click()
        await expect(element(tab, "^Control place parts", "Task net")).to_be_visible()
        await expect(tab.get_by_role("alert")).to_be_hidden()
    finally:
        await again.close()
