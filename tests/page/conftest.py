"""Fixtures: the page of a scripted mission, and a real browser that shows it."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import pytest_asyncio

from petrobot.coordinator.page.server import Page, start_page
from petrobot.coordinator.task import Executed, Status
from petrobot.coordinator.task.file import load
from tests.page.stage import Part, Stage

if TYPE_CHECKING:
    from playwright.async_api import Browser, ConsoleMessage, Locator
    from playwright.async_api import Page as Tab

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
async def served(stage: Stage, tasks: Path, runs: Path) -> AsyncIterator[Page]:
    """Serve the page of a mission on loopback."""
    made = await start_page(
        stage, tasks_folder=tasks, token="open sesame", offers=stage.offers, runs=runs
    )
    yield made
    await made.close()


@pytest_asyncio.fixture(loop_scope="session")
async def stage(tasks: Path, tmp_path: Path) -> AsyncIterator[Stage]:
    """A mission for one test."""
    async with staged(tasks, tmp_path / "runs") as made:
        yield made


@pytest_asyncio.fixture(loop_scope="session")
async def page(stage: Stage, tasks: Path, tmp_path: Path) -> AsyncIterator[Page]:
    """Its page."""
    async with served(stage, tasks, tmp_path / "runs") as made:
        yield made


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
def faults() -> Callable[[Any], list[str]]:
    """Collect the errors of a browser page: script errors, refused content, errors on the
    console."""

    def watch(tab: Any) -> list[str]:
        found: list[str] = []
        tab.on("pageerror", lambda error: found.append(f"script error: {error}"))
        tab.on("console", lambda message: found.append(message.text) if is_fault(message) else None)
        return found

    return watch


def is_fault(message: ConsoleMessage) -> bool:
    """Return whether the message is an error. The answer 422 for a net that cannot be analysed yet,
    which the browser logs, is not."""
    return message.type == "error" and "422" not in message.text


NOTE_TOASTS = """() => {
  window.toasted = [...document.querySelectorAll(".toast")].map((toast) => toast.title);
  const keep = (toast) => window.toasted.push(toast.title);
  const note = (changes) => changes.forEach(({ addedNodes }) => addedNodes.forEach(keep));
  new MutationObserver(note).observe(document.querySelector(".toasts"), { childList: true });
}"""


async def note_toasts(tab: Tab) -> None:
    """Keep the messages that the page shows for only a few seconds: a test that checks once a
    second could miss one."""
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
def nobody_listens(port: int) -> Iterator[None]:
    """Reserve a port that has just been closed, so that no other process gets it; the test may
    listen on it again."""
    with socket.socket() as placeholder:
        placeholder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        placeholder.bind(("127.0.0.1", port))
        yield


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


@pytest_asyncio.fixture(loop_scope="session")
async def browser(_chromium: Browser) -> AsyncIterator[Browser]:
    """The browser. Its windows are closed after each test: one that is left open paints during all
    later tests of this process."""
    yield _chromium
    for context in _chromium.contexts:
        await context.close()
