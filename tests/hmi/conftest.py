"""A served page over the scripted stage, and a real browser in front of it."""

from __future__ import annotations

import os
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import pytest_asyncio

from coordinator.hmi.journals import JournalHistory
from coordinator.hmi.server import Page, start_page
from coordinator.task import Executed, Status
from coordinator.taskfile import load
from tests.hmi.stage import Part, Stage

if TYPE_CHECKING:
    from playwright.async_api import Browser

HERE = Path(__file__).parent
BROWSER = Path(os.environ.get("PETROBOT_BROWSER", "/usr/bin/chromium"))
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SLIPPED = Part(0.3, Status.ERROR, "slipped", "the part slipped out of the gripper", Executed.YES)
SCRIPT = {
    "look__edges": [Part(0.3)],
    "look__template": [Part(0.3)],
    "pick": [SLIPPED, Part(0.3)],
    "put": [Part(0.3)],
    "clear": [Part(0.4)],
}
WHERE = {"look__edges": "vision", "look__template": "vision", "pick": "arm", "put": "arm", "clear": "arm"}


@pytest.fixture
def tasks(tmp_path: Path) -> Path:
    """A folder with the shipped test task."""
    folder = tmp_path / "tasks"
    shutil.copytree(HERE / "tasks", folder)
    return folder


@asynccontextmanager
async def staged(tasks: Path, runs: Path) -> AsyncIterator[Stage]:
    """A mission that stands ready to move parts; nothing has been started."""
    made = Stage(tasks, SCRIPT, WHERE, runs)
    path = tasks / "pick_and_place.toml"
    made.load(load(path))
    yield made
    await made.close()


@asynccontextmanager
async def served(stage: Stage, tasks: Path, runs: Path) -> AsyncIterator[Page]:
    """The page of a mission, on loopback."""
    history = JournalHistory(runs)
    made = await start_page(stage, tasks_folder=tasks, token="open sesame", offers=stage.offers, history=history)
    yield made
    await made.close()


@pytest_asyncio.fixture
async def stage(tasks: Path, tmp_path: Path) -> AsyncIterator[Stage]:
    """A mission for one test."""
    async with staged(tasks, tmp_path / "runs") as made:
        yield made


@pytest_asyncio.fixture
async def page(stage: Stage, tasks: Path, tmp_path: Path) -> AsyncIterator[Page]:
    """Its page."""
    async with served(stage, tasks, tmp_path / "runs") as made:
        yield made


def browser_missing() -> str:
    """Why there is no browser to test with; empty if there is one."""
    if not BROWSER.exists():
        return f"no browser at {BROWSER}: install chromium or set PETROBOT_BROWSER"
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
    """Collect what a browser page complains about: script errors, refused content, error messages on its console."""

    def watch(tab: Any) -> list[str]:
        found: list[str] = []
        tab.on("pageerror", lambda error: found.append(f"script error: {error}"))
        tab.on("console", lambda message: found.append(message.text) if message.type == "error" else None)
        return found

    return watch


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def browser() -> AsyncIterator[Browser]:
    """Chromium without a window, one for all tests of a file."""
    if browser_missing():
        pytest.fail(browser_missing())
    from playwright.async_api import async_playwright

    async with async_playwright() as driver:
        launched = await driver.chromium.launch(executable_path=str(BROWSER), args=ARGUMENTS)
        yield launched
        await launched.close()


@pytest_asyncio.fixture(loop_scope="module")
async def _windows_are_closed(browser: Browser) -> AsyncIterator[None]:
    """No window of one test goes on painting during the next."""
    yield
    for context in browser.contexts:
        await context.close()
