"""A served page over the scripted stage, and a real browser in front of it."""

from __future__ import annotations

import os
import shutil
from collections.abc import AsyncIterator, Callable
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


@pytest_asyncio.fixture
async def stage(tasks: Path, tmp_path: Path) -> AsyncIterator[Stage]:
    """A mission that stands ready to move parts; nothing has been started."""
    made = Stage(tasks, SCRIPT, WHERE, tmp_path / "runs")
    path = tasks / "pick_and_place.toml"
    made.load(load(path))
    yield made
    await made.close()


@pytest_asyncio.fixture
async def page(stage: Stage, tasks: Path, tmp_path: Path) -> AsyncIterator[Page]:
    """The page of that mission, served on loopback."""
    history = JournalHistory(tmp_path / "runs")
    made = await start_page(stage, tasks_folder=tasks, token="open sesame", offers=stage.offers, history=history)
    yield made
    await made.close()


@pytest_asyncio.fixture
async def browser() -> AsyncIterator[Browser]:
    """Chromium without a window. Without one the test is skipped by name; where CI=true it fails."""
    missing = None if BROWSER.exists() else f"no browser at {BROWSER}: install chromium or set PETROBOT_BROWSER"
    try:
        from playwright.async_api import async_playwright
    except ImportError:
        missing = "Playwright for Python is not installed"
    if missing:
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(missing)
    async with async_playwright() as driver:
        launched = await driver.chromium.launch(executable_path=str(BROWSER), args=ARGUMENTS)
        yield launched
        await launched.close()


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
