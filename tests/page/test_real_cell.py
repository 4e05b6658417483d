"""`petrobot serve` as its own process with node processes, used only through the page: draw, run,
intervene, look at the history."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import pytest_asyncio
from msgspec import Struct

from tests.page.conftest import abort, browser_missing, toasted

if browser_missing() and os.environ.get("CI") != "true":
    pytest.skip(browser_missing(), allow_module_level=True)

from playwright.async_api import Browser, Page as Tab, expect

from tests.page.steps import Watch, checked, draw_the_task, element, hold_controls, opened, settled
from tests.ports import free_ports

ROOT = Path(__file__).parents[2]
SERVICES = """\
schema = 1
[nodes.vision]
host = "127.0.0.1"
port = {0}
[nodes.arm]
host = "127.0.0.1"
port = {1}
[actions.look_at_table]
run = "tests.operator.toys:move"
task = "look"
node = "vision"
[actions.pick_part]
run = "tests.operator.toys:move"
task = "pick"
node = "arm"
[actions.put_part]
run = "tests.operator.toys:move"
task = "put"
node = "arm"
"""
SCRIPT = """\
schema = 1
[[actions.look_at_table]]
seconds = 8.0 # until it is paused; a task that is drawn has a deadline of 10 s
[[actions.look_at_table]]
seconds = 0.3
[[actions.look_at_table]]
seconds = 0.3
[[actions.pick_part]]
status = "error"
cause = "slipped"
text = "the part slipped out of the gripper"
seconds = 0.3
[[actions.pick_part]]
seconds = 0.3
"""


class Served(Struct):
    """A permanent coordinator, as a process."""

    process: asyncio.subprocess.Process
    url: str
    folder: Path

    async def end(self) -> int:
        """Press Ctrl-C; return the exit code."""
        if self.process.returncode is None:
            self.process.send_signal(signal.SIGINT)
        async with asyncio.timeout(120):
            return await self.process.wait()


@asynccontextmanager
async def serving(folder: Path) -> AsyncIterator[Served]:
    """Run `petrobot serve --up --mock` in its own folder."""
    (folder / "services.toml").write_text(SERVICES.format(*free_ports(2)), encoding="utf-8")
    (folder / "script.toml").write_text(SCRIPT, encoding="utf-8")
    command = [
        "-c",
        "import sys; from petrobot.coordinator.cli import main; sys.exit(main())",
        "serve",
        "--up",
    ]
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, *command, "--mock", "script.toml"),
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    async with asyncio.timeout(120):
        line = (await process.stdout.readline()).decode()
    served = Served(process, line.removeprefix("page: ").strip(), folder)
    try:
        yield served
    finally:
        await served.end()


@pytest_asyncio.fixture(loop_scope="session")
async def served(tmp_path: Path) -> AsyncIterator[Served]:
    """A cell with two idle nodes."""
    async with serving(tmp_path) as made:
        yield made


async def test_a_new_user_draws_a_task_and_runs_it_on_the_cell(
    browser: Browser, served: Served, shots: Path, faults: Watch
) -> None:
    """All on real nodes: draw, start, pause, step, run once more, find out why it failed, start
    again, look at the history, quit."""
    tab = await opened(browser, served)
    complaints = faults(tab)
    await expect(tab.get_by_role("region", name="Nodes")).to_contain_text("2 of 2 up")
    await hold_controls(tab)
    await tab.screenshot(path=shots / "serve-idle.png")
    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)
    await tab.get_by_role("button", name="New task").click()
    await draw_the_task(tab)
    await checked(tab)
    await tab.get_by_role("button", name="Run this task").click()
    dialog = tab.get_by_role("dialog", name="Save the task as")
    await dialog.get_by_label("Name").fill("drawn")
    await dialog.get_by_role("button", name="OK").click()
    await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Running")
    assert (served.folder / "tasks" / "drawn.toml").exists()
    await lead_by_hand(tab, shots)
    await start_again(tab, shots)
    await look_back(tab, shots)
    assert complaints == []
    assert await served.end() == 0
    await expect(tab.get_by_role("alert")).to_contain_text("has shut down normally")
    await tab.screenshot(path=shots / "serve-goodbye.png")


async def lead_by_hand(tab: Tab, shots: Path) -> None:
    """Pause while the camera looks, step, add a token, continue, read why the first pick failed."""
    mission = tab.get_by_role("status", name="Mission state")
    toolbar = tab.get_by_role("toolbar", name="Mission")
    fired = tab.get_by_role("region", name="Last firings").get_by_role("listitem")
    await expect(tab.get_by_role("region", name="Running now")).to_contain_text("look at table")
    await toolbar.get_by_role("button", name="Pause").click()
    await expect(mission).to_contain_text("Paused")
    await expect(fired).to_have_count(1)
    await element(tab, "^Control place jobs", "Task net").click()
    await tab.get_by_role("button", name="Add token").click()
    await expect(element(tab, "^Control place jobs, 2 tokens", "Task net")).to_be_visible()
    await tab.screenshot(path=shots / "serve-paused.png")
    await toolbar.get_by_role("button", name="Step").click()
    await expect(fired).to_have_count(2)
    await expect(tab.locator(".pause-note")).to_contain_text("Paused after one firing")
    await toolbar.get_by_role("button", name="Continue").click()
    await expect(mission).to_contain_text("Success")
    why = fired.filter(has_text="slipped").first
    await expect(why).to_contain_text("pick part on arm: the part slipped out of the gripper")
    await why.get_by_role("button").click()
    await expect(tab.get_by_role("region", name="Selected")).to_contain_text(
        "the part slipped out of the gripper"
    )
    await tab.screenshot(path=shots / "serve-why.png")


async def start_again(tab: Tab, shots: Path) -> None:
    """Choose the task in the bar and start it again after setting a breakpoint; the shipped tasks
    are listed."""
    toolbar = tab.get_by_role("toolbar", name="Mission")
    mission = tab.get_by_role("status", name="Mission state")
    await expect(
        toolbar.get_by_label("Task to start").locator("option", has_text="(shipped)").first
    ).to_be_attached()
    await toolbar.get_by_label("Task to start").select_option("")
    await toolbar.get_by_label("Task to start").select_option("drawn")
    await expect(mission).to_contain_text("Idle")
    await element(tab, "^Transition begin", "Task net").click()
    await tab.get_by_role("button", name="Set breakpoint").click()
    await toolbar.get_by_role("button", name="Start", exact=True).click()
    await expect(mission).to_contain_text("Paused")
    await abort(toolbar)
    await expect(mission).to_contain_text("Aborted")


async def look_back(tab: Tab, shots: Path) -> None:
    """Both runs are in the history; the first one holds the error."""
    await tab.get_by_role("tab", name="History").click()
    runs = tab.get_by_role("navigation", name="Runs").get_by_role(
        "button", name=re.compile("^drawn-")
    )
    await expect(runs).to_have_count(2)
    await runs.last.click()
    await tab.get_by_role("button", name="Previous error").click()
    await expect(tab.get_by_role("complementary", name="Records")).to_contain_text(
        "slipped out of the gripper"
    )
    await tab.screenshot(path=shots / "serve-history.png")


async def test_the_page_explains_why_a_task_cannot_start(
    browser: Browser, served: Served, shots: Path
) -> None:
    """A shipped task for which this cell has no nodes is listed and drawn, and its start is refused
    with the reason; the user may edit a copy."""
    tab = await opened(browser, served, "dark")
    await tab.get_by_role("button", name="Take controls").click()
    toolbar = tab.get_by_role("toolbar", name="Mission")
    await toolbar.get_by_label("Task to start").select_option("catch_ball")
    await expect(element(tab, "^Action place locate_ball", "Task net")).to_be_visible()
    await toolbar.get_by_role("button", name="Start", exact=True).click()
    await toasted(tab, "catch_ball may not run.*no node offers")
    await tab.screenshot(path=shots / "serve-refused.png")
    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)
    await expect(tab.get_by_text("shipped, saving makes your copy")).to_be_visible()
    await tab.get_by_label("Goal", exact=True).fill("mine")
    await tab.get_by_label("Goal", exact=True).press("Enter")
    await tab.get_by_role("button", name="Save").click()
    await expect(tab.get_by_label("Task", exact=True).locator("option:checked")).to_have_text(
        "catch ball (my copy)"
    )
    assert 'goal = "mine"' in (served.folder / "tasks" / "catch_ball.toml").read_text(
        encoding="utf-8"
    )
