"""Fixtures: the page of a scripted mission, and a real browser that shows it."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal
from weakref import WeakKeyDictionary

import pytest
import pytest_asyncio
from msgspec import Struct

from petrobot.coordinator.background import BackgroundProcess
from petrobot.coordinator.page.server import Page, start_page
from petrobot.coordinator.task import Executed, Status
from petrobot.coordinator.task.file import load
from tests.page.stage import Part, Stage

if TYPE_CHECKING:
    from playwright.async_api import Browser, ConsoleMessage, Locator, Page as Tab, ViewportSize

HERE = Path(__file__).parent
HEADLESS_SHELL = Path("/usr/bin/chromium-headless-shell")
"""The same engine without the window around it: a third of the processor time."""
BROWSER = Path(
    os.environ.get("PETROBOT_BROWSER")
    or (HEADLESS_SHELL if HEADLESS_SHELL.exists() else "/usr/bin/chromium")
)
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SIZE: Final[ViewportSize] = {"width": 1440, "height": 900}
PATIENCE_MS = 60_000  # for a condition: with other tests on two slow cores a browser may be late
SLIPPED = Part(0.3, Status.ERROR, "slipped", "the part slipped out of the gripper", Executed.YES)
SCRIPT = {
    "look__edges": [Part(0.3)],
    "look__template": [Part(0.3)],
    "pick": [SLIPPED, Part(0.3)],
    "put": [Part(0.3)],
    "clear": [Part(0.4)],
}
WHERE = {
    "look__edges": "vision",
    "look__template": "vision",
    "pick": "arm",
    "put": "arm",
    "clear": "arm",
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run all tests of the page in one event loop: that of the browser, which they share."""
    for item in items:
        if item.path.parent == HERE and pytest_asyncio.is_async_test(item):
            item.add_marker(pytest.mark.asyncio(loop_scope="session"), append=False)


@pytest.fixture
def tasks(tmp_path: Path) -> Path:
    """A folder with the shipped test task."""
    folder = tmp_path / "tasks"
    shutil.copytree(HERE / "tasks", folder)
    return folder


@asynccontextmanager
async def staged(tasks: Path, runs: Path) -> AsyncIterator[Stage]:
    """A mission that is ready to move parts; nothing has been started."""
    made = Stage(tasks, SCRIPT, WHERE, runs)
    path = tasks / "pick_and_place.toml"
    made.load(load(path))
    yield made
    await made.close()


@asynccontextmanager
async def served(stage: Stage, tasks: Path, runs: Path, port: int = 0) -> AsyncIterator[Page]:
    """Serve the page of a mission on loopback."""
    made = await start_page(
        stage, tasks_folder=tasks, port=port, token="open sesame", offers=stage.offers, runs=runs
    )
    try:
        yield made
    finally:  # or the next page could not have its port
        await made.close()


@pytest_asyncio.fixture(loop_scope="session")
async def stage(tasks: Path, tmp_path: Path) -> AsyncIterator[Stage]:
    """A mission for one test."""
    async with staged(tasks, tmp_path / "runs") as made:
        yield made


@pytest.fixture(scope="session")
def port() -> Iterator[int]:
    """The page's port in all tests of this process: at the same address the browser has its files
    already."""
    with nobody_listens() as number:
        yield number


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def background() -> AsyncIterator[dict[str, BackgroundProcess]]:
    """The processes that check and analyse drawings: what they import takes half a second."""
    made = {name: BackgroundProcess() for name in ("apart", "checks", "analyses")}
    yield made
    for process in made.values():
        await process.close()


@pytest_asyncio.fixture(loop_scope="session")
async def page(
    stage: Stage,
    tasks: Path,
    tmp_path: Path,
    port: int,
    background: dict[str, BackgroundProcess],
    request: pytest.FixtureRequest,
) -> AsyncIterator[Page]:
    """Its page. With a browser it works with the background processes of the test before; one that
    is still at work when the test ends is ended."""
    async with served(stage, tasks, tmp_path / "runs", port) as made:
        state = made._page_state
        own = {n: getattr(state, n) for n in background if "browser" in request.fixturenames}
        for name in own:
            setattr(state, name, background[name])
        yield made
        for process in background.values():
            if process._current is not None:
                await process.close()
        for name, process in own.items():
            setattr(state, name, process)


def browser_missing() -> str:
    """Return why no browser is available for tests; empty if there is one."""
    if not BROWSER.exists():
        return (
            f"no browser at {BROWSER}: install chromium-headless-shell or chromium, or set "
            "PETROBOT_BROWSER"
        )
    if find_spec("playwright") is None:
        return "Playwright for Python is not installed"
    return ""


@pytest.fixture
def shots() -> Path:
    """Where screenshots go: PETROBOT_SCREENSHOTS, else reports/screenshots here."""
    folder = Path(os.environ.get("PETROBOT_SCREENSHOTS", "reports/screenshots"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture
def faults() -> Callable[[Tab], list[str]]:
    """Collect the errors of a browser page."""
    return errors_of


_errors: WeakKeyDictionary[Tab, list[str]] = WeakKeyDictionary()


def errors_of(tab: Tab) -> list[str]:
    """Return the list of a window's errors, which grows: script errors, refused content, errors on
    the console."""
    if tab not in _errors:
        found = _errors[tab] = []
        tab.on("pageerror", lambda error: found.append(f"script error: {error}"))
        tab.on("console", lambda message: found.append(message.text) if is_fault(message) else None)
    return _errors[tab]


def is_fault(message: ConsoleMessage) -> bool:
    """Return whether the message is an error. The answer 422 for a net that cannot be analysed yet,
    which the browser logs, is not."""
    return message.type == "error" and "422" not in message.text


NOTE_TOASTS = """() => {
  const script = document.querySelector("script[type=module]").src;
  window.own = (path) => import(new URL(path, script));  // a module that the page itself has loaded
  window.toasted = [...document.querySelectorAll(".toast")].map((toast) => toast.title);
  const keep = (toast) => window.toasted.push(toast.title);
  const note = (changes) => changes.forEach(({ addedNodes }) => addedNodes.forEach(keep));
  new MutationObserver(note).observe(document.querySelector(".toasts"), { childList: true });
}"""


async def note_toasts(tab: Tab) -> None:
    """Keep the messages that the page shows for only a few seconds: a test that checks once a
    second could miss one. `own` imports a module of the page."""
    await tab.evaluate(NOTE_TOASTS)


async def toasted(tab: Tab, pattern: str) -> None:
    """Wait until the page has shown such a message since `note_toasts`."""
    script = "(pattern) => window.toasted.some((said) => new RegExp(pattern).test(said))"
    await tab.wait_for_function(script, arg=pattern)


PRESS_TWICE = (
    "(button) => { button.click(); const asked = button.textContent; "
    "button.click(); return asked; }"
)


async def abort(toolbar: Locator) -> None:
    """Press Abort, and press it again to confirm: in one step, as the page accepts the confirmation
    for only three seconds."""
    from playwright.async_api import expect

    button = toolbar.get_by_role("button", name="Abort")
    await expect(button).to_be_enabled()
    assert await button.evaluate(PRESS_TWICE) == "Abort the mission?"


@contextmanager
def nobody_listens(port: int = 0) -> Iterator[int]:
    """Reserve a port that has just been closed, or any free one, so that no other process gets it;
    the test may listen on it."""
    with socket.socket() as placeholder:
        placeholder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        placeholder.bind(("127.0.0.1", port))
        yield int(placeholder.getsockname()[1])


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def _chromium() -> AsyncIterator[Browser]:
    """Headless Chromium, one for all tests."""
    if browser_missing():
        pytest.fail(browser_missing())
    from playwright.async_api import async_playwright

    async with async_playwright() as driver:
        launched = await driver.chromium.launch(executable_path=str(BROWSER), args=ARGUMENTS)
        yield launched
        await launched.close()


class KeptWindow(Struct):
    """A window that stays open for the next test: most of what a new one costs is its process."""

    tab: Tab | None = None
    taken: bool = False

    async def empty(self) -> None:
        """Make it a new user's again: leave the page for an empty one of its origin, and forget
        what the page has stored there."""
        if self.tab is None or not self.taken or self.tab.is_closed():
            return
        context = self.tab.context
        await self.tab.unroute_all()
        for other in context.pages:
            if other is not self.tab:
                await other.close()
        async with self.tab.expect_navigation(url="blob:**"):
            await self.tab.evaluate("location.replace(URL.createObjectURL(new Blob()))")
        await self.tab.evaluate("localStorage.clear(); sessionStorage.clear()")
        await context.clear_cookies()
        await self.tab.mouse.move(0, 0)
        errors_of(self.tab).clear()
        self.taken = False


kept = KeptWindow()


async def new_window(browser: Browser, theme: Literal["light", "dark"] = "light") -> Tab:
    """Return an empty window of a new user: the kept one, or another one if the test has it."""
    if kept.tab is not None and not kept.taken:
        kept.taken = True
        await kept.tab.set_viewport_size(SIZE)
        await kept.tab.emulate_media(color_scheme=theme, reduced_motion="no-preference")
        return kept.tab
    context = await browser.new_context(
        viewport=SIZE, color_scheme=theme, reduced_motion="no-preference"
    )
    context.set_default_timeout(PATIENCE_MS)
    tab = await context.new_page()
    errors_of(tab)
    if kept.tab is None:
        kept.tab, kept.taken = tab, True
    return tab


@pytest_asyncio.fixture(loop_scope="session")
async def browser(_chromium: Browser, request: pytest.FixtureRequest) -> AsyncIterator[Browser]:
    """The browser. Its windows are closed after each test: one that is left open paints during all
    later tests of this process. One is kept, empty, unless the test has failed."""
    failed = request.session.testsfailed
    yield _chromium
    try:
        if request.session.testsfailed == failed:
            await kept.empty()
    finally:
        if kept.taken:
            kept.tab, kept.taken = None, False
        for context in _chromium.contexts:
            if kept.tab is None or context is not kept.tab.context:
                await context.close()
