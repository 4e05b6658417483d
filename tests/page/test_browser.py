"""End to end in a real browser, by role and name: draw, run, pause, step, add tokens, and find out
why something failed."""

from __future__ import annotations

import asyncio
import json
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, given, settings
from tools.bench.hmi import SyntheticMission, ticking

from petrobot.coordinator.operator.changes import apply, empty_state
from petrobot.coordinator.operator.net_state import picture
from petrobot.coordinator.page.server import Page, start_page
from petrobot.coordinator.page.sessions import Session
from petrobot.coordinator.run.folder import JOURNAL, RESULT
from petrobot.coordinator.task import Executed, Status
from petrobot.coordinator.task.file import load, loads
from tests.drawing.test_macros import HELD, SHIPPED
from tests.page.conftest import (
    PATIENCE_MS,
    abort,
    browser_missing,
    kept,
    nobody_listens,
    served,
    toasted,
)
from tests.page.stage import Part, Stage
from tests.page.test_changes import changes

if browser_missing() and os.environ.get("CI") != "true":
    pytest.skip(browser_missing(), allow_module_level=True)

from playwright.async_api import Browser, Page as Tab, expect

from tests.page.steps import (
    Watch,
    checked,
    designer,
    draw_the_task,
    element,
    hold_controls,
    opened,
    pressed,
    settled,
    start_mission,
    take_controls,
)
from tests.waiting import until


async def test_a_new_user_draws_runs_and_understands(
    browser: Browser, page: Page, stage: Stage, shots: Path, faults: Watch
) -> None:
    """Without the manual: draw three actions with an error branch, run, pause, step, run once more,
    and find out why it failed."""
    tab = await opened(browser, page)
    complaints = faults(tab)
    await tab.get_by_role("tab", name="Design").click()
    await settled(tab)
    await tab.get_by_role("button", name="New task").click()
    await draw_the_task(tab)
    await checked(tab)
    await tab.screenshot(path=shots / "designer.png")

    await take_controls(tab)
    stage.kept.add("look__edges")
    await tab.get_by_role("button", name="Run this task").click()
    dialog = tab.get_by_role("dialog", name="Save the task as")
    await dialog.get_by_label("Name").fill("drawn")
    await dialog.get_by_role("button", name="OK").click()
    await expect(tab.get_by_role("tab", name="Live")).to_have_attribute("aria-selected", "true")
    await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Running")
    await run_it_by_hand(tab, stage, shots)
    assert complaints == []


async def run_it_by_hand(tab: Tab, stage: Stage, shots: Path) -> None:
    """Pause, step, add a token, continue, and read the reason of the provoked error."""
    mission = tab.get_by_role("status", name="Mission state")
    toolbar = tab.get_by_role("toolbar", name="Mission")
    await toolbar.get_by_role("button", name="Pause").click()
    await expect(mission).to_contain_text("Paused")
    before = stage.state.firings
    stage.kept.clear()
    await toolbar.get_by_role("button", name="Step").click()
    await expect(
        tab.get_by_role("region", name="Last firings").get_by_role("listitem")
    ).to_have_count(before + 1)
    await expect(tab.locator(".pause-note")).to_contain_text("Paused after one firing")
    await expect(mission).to_contain_text("Paused")
    assert stage.state.firings == before + 1
    await element(tab, "^Control place jobs", "Task net").click()
    await tab.get_by_role("button", name="Add token").click()
    await expect(element(tab, "^Control place jobs, 2 tokens", "Task net")).to_be_visible()
    await tab.screenshot(path=shots / "paused.png")
    await toolbar.get_by_role("button", name="Continue").click()
    await expect(mission).to_contain_text("Success")
    why = (
        tab.get_by_role("region", name="Last firings")
        .get_by_role("listitem")
        .filter(has_text="slipped")
    )
    await expect(why).to_contain_text("pick on arm: the part slipped out of the gripper")
    await why.get_by_role("button").click()
    await expect(tab.get_by_role("region", name="Selected")).to_contain_text(
        "the part slipped out of the gripper"
    )
    await tab.screenshot(path=shots / "why.png")


async def test_the_window_of_the_test_before_is_that_of_a_new_user(
    browser: Browser, page: Page, faults: Watch
) -> None:
    """Nothing is left of its drawing, its colours, its routes, its errors or who it was."""
    for _ in range(2):
        tab = await opened(browser, page)
        assert tab is kept.tab and faults(tab) == []
        assert await tab.evaluate("[innerWidth, localStorage['petrobot.theme']]") == [1440, "light"]
        assert await tab.evaluate("[Object.keys(localStorage).length, sessionStorage.length]") == [
            2,
            0,
        ]
        await hold_controls(tab)
        await tab.get_by_role("button", name="Release").click()
        await tab.get_by_role("tab", name="Design").click()
        await settled(tab)
        await expect(tab.locator(".saved")).to_have_text("saved")
        await element(tab, "^Action place pick").click()
        await tab.keyboard.press("Delete")
        await expect(element(tab, "^Action place pick")).to_have_count(0)
        await tab.get_by_role("button", name="Dark colours").click()
        await tab.evaluate("localStorage.other = sessionStorage.other = 'left'")
        await tab.evaluate("console.error('left')")
        await until(lambda: faults(tab) == ["left"])  # noqa: B023
        await tab.route("**/*", lambda route: route.abort())
        await tab.set_viewport_size({"width": 800, "height": 600})
        await tab.context.new_page()
        await kept.empty()
        assert tab.context.pages == [tab] and await tab.context.cookies() == []


async def test_two_operators(browser: Browser, page: Page, stage: Stage) -> None:
    """One holds the controls; the other sees the same, asks for them and gets them, and keeps them
    after a refresh; a duplicate of his tab does not. Every client may press the emergency stop."""
    ana, ben = await opened(browser, page), await opened(browser, page)
    await start_mission(ana)
    await expect(ben.get_by_role("status", name="Mission state")).to_contain_text("Running")
    bens = ben.get_by_role("toolbar", name="Mission")
    await expect(bens).to_contain_text("holds the controls")
    await expect(bens.get_by_role("button", name="Pause")).to_be_disabled()
    await ben.get_by_role("button", name="Ask for controls").click()
    await ana.get_by_role("button", name="Hand over to").click()
    await expect(bens).to_contain_text("You hold the controls")
    await ben.reload()
    await expect(bens).to_contain_text("You hold the controls")
    async with ben.expect_popup() as duplicate:
        await ben.evaluate("open(location.href)")  # with a copy of what the tab has stored
    carl = (await duplicate.value).get_by_role("toolbar", name="Mission")
    await expect(carl).to_contain_text("holds the controls")
    await ana.get_by_role("searchbox", name="Find a place or transition").focus()
    await ana.keyboard.press("F9")
    for tab in (ana, ben):
        await expect(tab.get_by_role("status", name="Mission state")).to_contain_text(
            "Emergency stop"
        )


async def test_manual_interventions_in_the_net(browser: Browser, page: Page, stage: Stage) -> None:
    """Raise an event, stop at a breakpoint, choose an action, force an outgoing transition,
    abort."""
    stage.script["pick"].clear()
    stage.script["pick"].append(Part(0.3))
    stage.kept.update({"look__template", "pick", "put"})
    tab = await opened(browser, page)
    await hold_controls(tab)
    await element(tab, "^Transition picked", "Task net").click()
    await tab.get_by_role("button", name="Set breakpoint").click()
    await expect(tab.get_by_role("button", name="Remove breakpoint")).to_be_visible()
    await tab.get_by_label("Alternative for look").select_option("look__template")
    await tab.get_by_role("toolbar", name="Mission").get_by_role("button", name="Start").click()
    await element(tab, "^Transition begin", "Task net").click()
    await expect(tab.get_by_role("region", name="Selected")).to_contain_text(
        "waits for the event part there"
    )
    await tab.get_by_role("button", name="Raise part there").click()
    running = tab.get_by_role("region", name="Running now")
    await expect(running).to_contain_text("look template")
    await expect(running).to_contain_text("for look: operator")
    stage.kept.remove("look__template")
    await expect(running).to_contain_text("pick")
    await element(tab, "^Action place pick", "Task net").click()
    await tab.get_by_role("button", name="Force picked").click()
    assert stage.commands[-1][1] == "raise_event", "it asks first"
    await tab.get_by_role("button", name="Leave pick by force?").click()
    await expect(running).to_contain_text("put")
    await abort(tab.get_by_role("toolbar", name="Mission"))
    await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Aborted")
    verbs = [verb for _, verb, _ in stage.commands]
    assert verbs == [
        "take_controls",
        "breakpoint",
        "override_selector",
        "start",
        "raise_event",
        "force_exit",
        "abort",
    ]


async def test_a_transition_at_its_breakpoint_says_that_it_can_fire(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """Its run has ended as its arc wants, so it waits for nothing but the operator."""
    stage.script["pick"].clear()
    stage.script["pick"].append(Part(0.3))
    stage.kept.add("pick")
    tab = await opened(browser, page)
    await hold_controls(tab)
    selected = tab.get_by_role("region", name="Selected")
    await tab.get_by_role("toolbar", name="Mission").get_by_role("button", name="Start").click()
    await element(tab, "^Transition begin", "Task net").click()
    await tab.get_by_role("button", name="Raise part there").click()
    await element(tab, "^Transition picked", "Task net").click()
    await expect(tab.get_by_role("region", name="Running now")).to_contain_text("pick")
    await expect(selected).to_contain_text("waits for the end of the run in pick")
    await tab.get_by_role("button", name="Set breakpoint").click()
    await expect(tab.get_by_role("button", name="Remove breakpoint")).to_be_visible()
    stage.kept.remove("pick")
    await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Paused")
    await expect(selected).to_contain_text("can fire")


async def test_states_and_times_on_the_page_are_those_of_now(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """The list of runs follows the active run, and long times are in minutes, also between two
    messages; they are not read out each second."""
    tab = await opened(browser, page)
    await tab.get_by_role("tab", name="History").click()
    runs = tab.get_by_role("navigation", name="Runs")
    own = runs.get_by_role("button", name="This run, as seen here")
    stage.feed.emit("mission", time=100.0, mission={"state": "running"})
    await expect(own).to_contain_text("running")
    stage.feed.emit("mission", time=130.0, mission={"state": "success"})
    await expect(own).to_contain_text("success")
    banner = tab.get_by_role("status", name="Mission state")
    await expect(banner.locator("[aria-live=off]")).to_have_text("2:10 min")
    await tab.evaluate("petrobot.tick()")
    await expect(banner.locator("[aria-live=off]")).to_have_text("2:10 min")
    assert stage.runs_folder is not None
    folder = stage.runs_folder / "just over"
    folder.mkdir(parents=True)
    (folder / JOURNAL).touch()
    (folder / RESULT).write_text('{"status": "success", "sim_s": 12.5}', encoding="utf-8")
    await expect(runs).not_to_contain_text("just over")
    stage.feed.emit("result", result={"status": "success"})
    await expect(runs).to_contain_text("12.5 s")


async def test_what_a_short_form_adds_has_a_name_for_people(browser: Browser, page: Page) -> None:
    """On every tab a copy of a transition is called as it is, and a retry by its place."""
    tab = await opened(browser, page)
    task = {
        "places": [{"name": "grip", "label": ""}, {"name": "grip.left", "label": ""}],
        "transitions": [
            {"name": "has_it", "label": "", "made_from": ""},
            {"name": "has_it.1", "label": "", "made_from": "has_it"},
            {"name": "grip.retry", "label": "", "made_from": "grip"},
        ],
    }
    script = """async (task) => {
      const { labelsOf } = await own("sheet.js");
      return Object.fromEntries(labelsOf(task));
    }"""
    labels = await tab.evaluate(script, task)
    assert labels["has_it"] == labels["has_it.1"] == "has it"
    assert labels["grip.retry"] == "grip: retry"


async def test_live_and_design_draw_the_same_net(browser: Browser, page: Page) -> None:
    """The same elements at the same places with the same words, and the same arcs: the one from the
    flat net of a run, the other from the file."""
    tab = await opened(browser, page)
    script = """async ([picture, file]) => {
      const { sheetOf } = await own("sheet.js");
      const { drawn } = await own("design/drawn.js");
      const { placed } = await own("layout.js");
      const seen = (e) => [e.name, [e.x, e.y, e.sub, Boolean(e.error)]];
      const joins = (a) => [a.direction, a.place, a.end ?? "", a.transition, a.weight].join(" ");
      const told = ({ places, transitions, arcs }) => [
        Object.fromEntries([...places, ...transitions].map(seen)),
        arcs.map(joins).sort(),
      ];
      return [told(sheetOf(picture, "")), told(placed(drawn(file, file, "")))];
    }"""
    for text in (HELD, *(path.read_text() for path in SHIPPED)):
        task = json.loads(json.dumps(picture(loads(text))))
        live, design = await tab.evaluate(script, [task, tomllib.loads(text)])
        assert live == design, task["name"]


TICKS = """() => {
  const observer = new MutationObserver(() => {});
  const all = { attributes: true, characterData: true, childList: true, subtree: true };
  observer.observe(document, all);
  for (let tick = 0; tick < 20; tick += 1) petrobot.tick();
  return observer.takeRecords().map((m) => m.attributeName ?? m.target.nodeName);
}"""
BEAT = """() => {
  const { now } = performance;
  performance.now = () => 800;
  petrobot.tick();
  performance.now = now;
  return document.documentElement.dataset.beat;
}"""
SHADE = "getComputedStyle(document.querySelector('.banner .state'), '::before').opacity"


async def test_a_page_at_which_nothing_happens_is_not_drawn_again(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """It stays open for days. Its ticks change nothing while the state is the same, and what blinks
    is no endless animation, for which a browser draws sixty times a second. Nothing blinks for
    people who want no motion."""
    tab = await opened(browser, page)
    await expect(tab.get_by_role("button", name="Take controls")).to_be_visible()
    await tab.evaluate(TICKS)
    assert set(await tab.evaluate(TICKS)) <= {"data-beat"}
    stage.kept.add("clear")
    await start_mission(tab)
    stage.happen("part_there")
    await expect(tab.locator(".net [data-name=pick] .mark.alarm")).to_be_visible()
    for shade in ("0.3", "1", "0.3"):
        await tab.wait_for_function(f"() => {SHADE} === '{shade}'")
    endless = "document.getAnimations().filter((a) => a.effect.getTiming().iterations > 9).length"
    assert await tab.evaluate(endless) == 0
    assert await tab.evaluate(BEAT) == "off"
    await tab.emulate_media(reduced_motion="reduce")
    assert await tab.evaluate(BEAT) == "on"


async def test_firings_of_another_run_are_not_taken_for_those_shown(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """Each run counts its firings from 1. A window that slept sees the next run's at once."""
    tab = await opened(browser, page)
    firings = tab.get_by_role("region", name="Last firings")
    about = {"number": 1, "at": 0.5, "error": False, "cause": "event"}
    stage.feed.emit("fired", firing={**about, "transition": "begin"})
    await expect(firings).to_contain_text("begin")
    parts = {key: stage.feed.state[key] for key in ("task", "marking", "nodes", "events")}
    mission = {**stage.feed.state["mission"], "id": "the next run"}
    stage.feed.replace(**parts, mission=mission, firings=[{**about, "transition": "placed"}])
    await expect(firings).to_contain_text("placed")
    await expect(firings).not_to_contain_text("begin")


async def test_an_open_list_of_alternatives_stays_usable_while_a_run_learns(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """Probabilities change under an open list; a refused choice is not shown as if it had been
    accepted."""
    tab = await opened(browser, page)
    await hold_controls(tab)
    choose = tab.get_by_label("Alternative for look")
    await choose.focus()
    held = await choose.element_handle()
    known = stage.feed.state["selectors"]["look"]
    for share in (0.25, 0.75):
        alternatives = [
            {**known["alternatives"][0], "probability": share},
            *known["alternatives"][1:],
        ]
        stage.feed.emit(
            "selector",
            time=stage.clock,
            name="look",
            selector={**known, "alternatives": alternatives},
        )
        await expect(tab.locator(".selector", has=choose)).to_contain_text(
            f"{round(100 * share)} %"
        )
    assert held is not None
    assert await held.evaluate("(list) => list === document.activeElement")

    async def refuse(who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        return {"ok": False, "code": "refused", "text": "not while it is frozen"}

    stage.__dict__["_override_selector"] = refuse
    await choose.select_option("look__template")
    await expect(tab.get_by_text("not while it is frozen")).to_be_visible()
    await expect(choose).to_have_value("")


async def test_a_folded_error_branch_turns_red(
    browser: Browser, page: Page, stage: Stage, shots: Path
) -> None:
    """Error branches are hidden behind a badge until a token enters one; a click shows them."""
    stage.kept.add("clear")
    tab = await opened(browser, page, "dark")
    await expect(element(tab, "^Action place clear", "Task net")).to_be_hidden()
    await start_mission(tab)
    stage.happen("part_there")
    badge = tab.locator(".net [data-name=pick] .mark.fold")
    await expect(badge).to_have_class(re.compile("alarm"))
    await tab.screenshot(path=shots / "dark.png")
    await badge.click()
    await expect(element(tab, "^Action place clear, 1 token", "Task net")).to_be_visible()
    await tab.get_by_role("button", name="Error branches").click()
    await expect(element(tab, "^Action place clear", "Task net")).to_be_hidden()


EVIL = "<img src=x onerror=\"document.title='owned'\"><script>document.title='owned'</script>"


async def test_markup_in_names_and_reasons_is_shown_as_text(
    browser: Browser, page: Page, stage: Stage, faults: Watch
) -> None:
    """The page shows every name from a node, a task file or another operator as text."""
    text = (stage.tasks / "pick_and_place.toml").read_text()
    quoted = EVIL.replace('"', '\\"')
    (stage.tasks / "evil.toml").write_text(
        text.replace("x = 560\ny = 180", f'label = "{quoted}"\nx = 560\ny = 180').replace(
            "The part lies", quoted
        )
    )
    stage.script["pick"] = type(stage.script["pick"])(
        [Part(0.2, Status.ERROR, "evil", EVIL, Executed.NO), Part(0.2)]
    )
    stage.where["pick"] = EVIL
    tab = await opened(browser, page)
    complaints = faults(tab)
    await hold_controls(tab)
    for operator in ("ana", EVIL):
        await stage.command(operator, "ask_controls", {})
    holder = stage.controls.holder
    assert holder is not None
    assert (await stage.command(holder, "start", {"task": "evil"}))["ok"]
    stage.happen("part_there")
    stage.feed.emit("variable", name=EVIL, value=EVIL)
    stage.feed.emit("notice", notice={"level": "error", "text": EVIL})
    await expect(tab.get_by_role("region", name="Last firings")).to_contain_text(
        "<img src=x onerror="
    )
    await tab.get_by_role("tab", name="Variables").click()
    await expect(tab.get_by_role("tabpanel", name="Variables")).to_contain_text("<script>")
    await tab.get_by_role("tab", name="Design").click()
    await tab.get_by_label("Task", exact=True).select_option("evil")
    await expect(tab.locator(".designer .net .label", has_text="<img src=x")).to_have_count(1)
    await settled(tab)
    assert await tab.title() == "petrobot"
    assert await tab.locator("img[src=x]").count() == 0
    assert await tab.locator("body script").count() == 0
    assert complaints == []


async def test_a_lost_connection_is_shown(
    browser: Browser, stage: Stage, tasks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When the coordinator disappears without a message, the page shows it at once. It catches up
    when the coordinator is back."""

    async def vanish(session: Session) -> None:
        """Close without a goodbye message."""

    monkeypatch.setattr(Session, "leave", vanish)
    async with served(stage, tasks, tmp_path / "runs") as first:
        tab = await opened(browser, first)
        port = int(first.url.rpartition(":")[2].partition("/")[0])
        await expect(tab.get_by_role("button", name="Take controls")).to_be_visible()
    with nobody_listens(port):
        await expect(tab.get_by_role("alert")).to_contain_text("Connection to the coordinator lost")
        stage.feed.emit("marking", marking={"parts": 7})
        again = await start_page(stage, tasks_folder=tasks, port=port, token="open sesame")
    try:
        await expect(tab.get_by_role("alert")).to_be_hidden()
        await expect(element(tab, "^Control place parts, 7 tokens", "Task net")).to_be_visible()
    finally:
        await again.close()


async def labels_are_clear_of_each_other(tab: Tab) -> None:
    """Check that labels of detections are inside their image and do not cover each other."""
    picture = await tab.get_by_role("img", name="Image of table").bounding_box()
    labels = await tab.locator(".detection-label").all()
    boxes = [box for label in labels if (box := await label.bounding_box())]
    assert picture is not None and len(boxes) == 3
    for box in boxes:
        assert (
            box["x"] >= picture["x"] - 1
            and box["x"] + box["width"] <= picture["x"] + picture["width"] + 1
        )
    for i, a in enumerate(boxes):
        for b in boxes[i + 1 :]:
            beside = a["x"] + a["width"] <= b["x"] + 1 or b["x"] + b["width"] <= a["x"] + 1
            above = a["y"] + a["height"] <= b["y"] + 1 or b["y"] + b["height"] <= a["y"] + 1
            assert beside or above


async def test_the_detail_views(
    browser: Browser, page: Page, stage: Stage, shots: Path, faults: Watch
) -> None:
    """Camera with detections, devices, set-point latency, learning curves, events, variables; also
    on a wall screen."""
    tab = await opened(browser, page, "dark")
    complaints = faults(tab)
    await start_mission(tab)
    pixel = (
        "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNkYPhfDwAChwGA60e6kgAAAABJRU5Er"
        "kJggg=="
    )
    seen = [
        {"kind": "circle", "x": 300, "y": 200, "r": 20, "label": "part"},
        {"kind": "path", "points": [[0, 0], [9, 9]]},
        {"kind": "circle", "x": 628, "y": 180, "r": 10, "label": "ball"},
        {"kind": "point", "role": "predicted", "x": 634, "y": 186, "label": "predicted exit"},
    ]
    image = {
        "mime": "image/png",
        "data": pixel,
        "width": 640,
        "height": 360,
        "age": 0.02,
        "detections": seen,
    }
    stage.feed.emit("image", name="table", image=image)
    stage.feed.emit(
        "device",
        name="arm",
        device={"state": "enabled", "joints": [0.1, -1.2, 0.5], "values": {"load": 0.3}},
    )
    stage.feed.emit(
        "setpoint", stream="point", samples=[[i / 10, 0.01 + i / 1e4] for i in range(60)]
    )
    curve = {"kind": "curve", "title": "Choice", "x": "runs", "y": "p", "series": ["a", "b"]}
    stage.feed.emit(
        "report",
        name="c",
        report={**curve, "columns": [[1, 2, 3], [0.5, 0.6, 0.7], [0.5, 0.4, 0.3]]},
    )
    await tab.get_by_role("tab", name="Camera").click()
    await expect(tab.get_by_role("img", name="Image of table")).to_be_visible()
    await expect(tab.get_by_role("tabpanel", name="Camera")).to_contain_text("20 ms old")
    await labels_are_clear_of_each_other(tab)
    await tab.screenshot(path=shots / "camera.png")
    await tab.get_by_role("tab", name="Devices").click()
    await expect(tab.get_by_role("tabpanel", name="Devices")).to_contain_text("enabled")
    await tab.get_by_role("tab", name="Set points").click()
    await expect(
        tab.get_by_role("figure", name="Age of the newest set point").locator("canvas")
    ).to_be_visible()
    await tab.get_by_role("tab", name="Learning").click()
    await expect(tab.get_by_role("figure", name="Choice").locator("canvas")).to_be_visible()
    await tab.get_by_role("tab", name="Events").click()
    await expect(tab.get_by_role("tabpanel", name="Events")).to_contain_text("part there")
    await tab.get_by_role("tab", name="Timeline").click()
    await tab.get_by_role("button", name="Wall screen").click()
    await tab.screenshot(path=shots / "wall.png")
    await tab.get_by_role("button", name="Light colours").click()
    assert await tab.evaluate("document.documentElement.dataset.theme") == "light"
    assert complaints == []


def mission_of(stage: Stage) -> tuple[str, str]:
    """Return the name and state of the mission."""
    mission = stage.feed.state["mission"]
    return mission["id"], mission["state"]


async def test_history(
    browser: Browser, page: Page, stage: Stage, shots: Path, faults: Watch
) -> None:
    """Scrub a finished run forwards and backwards, jump to its error, compare it with another,
    start one from a point."""
    tab = await opened(browser, page)
    complaints = faults(tab)
    stage.on_beat.append(
        lambda _: (
            None
            if stage.feed.state["events"]["part_there"]["armed"]
            else stage.happen("part_there")
        )
    )
    await hold_controls(tab)
    for run in ("pick_and_place-2", "pick_and_place-3"):
        await tab.get_by_role("toolbar", name="Mission").get_by_role("button", name="Start").click()
        await until(lambda run=run: mission_of(stage) == (run, "success"))  # type: ignore[misc]
        await expect(tab.locator("html")).to_have_attribute(
            "data-sequence", str(stage.feed.state["sequence"])
        )
        await expect(tab.get_by_role("status", name="Mission state")).to_contain_text("Success")
    await tab.get_by_role("tab", name="History").click()
    runs = tab.get_by_role("navigation", name="Runs")
    await runs.get_by_role("button", name="pick_and_place-2", exact=False).first.click()
    await expect(runs.get_by_role("button", name="Compare with pick_and_place-2")).to_be_disabled()
    scrub = tab.get_by_role("toolbar", name="Scrub")
    await scrub.get_by_role("button", name="First record").click()
    net = "Net at this record"
    await expect(element(tab, "^Control place parts, 2 tokens", net)).to_be_visible()
    await scrub.get_by_role("button", name="Next error").click()
    current = tab.get_by_role("complementary", name="Records").locator("[aria-current=true]")
    await expect(current).to_contain_text("slipped")
    await scrub.get_by_role("button", name="Previous record").click()
    await expect(current).not_to_contain_text("slipped")
    await scrub.get_by_role("button", name="Last record").click()
    await expect(element(tab, "^Control place parts, 0 tokens", net)).to_be_visible()
    await runs.get_by_role("button", name="Compare with pick_and_place-3").click()
    await expect(tab.get_by_role("status").filter(has_text="differ from firing 3")).to_contain_text(
        "pick failed here"
    )
    await scrub.get_by_role("button", name="Previous error").click()
    await tab.screenshot(path=shots / "history.png")
    said = "(text) => own('toast.js').then((m) => m.toast('error', text))"
    await tab.evaluate(said, "Refused: another run is active")
    toast, bar = await tab.locator(".toast").last.bounding_box(), await scrub.bounding_box()
    assert toast is not None and bar is not None
    assert toast["y"] + toast["height"] <= bar["y"], "a message covers no button of the records"
    await scrub.get_by_role("button", name="Simulate from here").click()
    dialog = tab.get_by_role("dialog", name="Simulate from here")
    await dialog.get_by_label("Run in clear").select_option("error")
    await dialog.get_by_role("button", name="Simulate").click()
    await expect(tab.get_by_role("tab", name="Live")).to_have_attribute("aria-selected", "true")
    _, verb, data = stage.commands[-1]
    assert (verb, data["mode"], data["from"]["run"]) == ("start", "lockstep", "pick_and_place-2")
    assert data["from"]["going"] == {"clear": "error"} and data["from"]["record"] > 0
    assert complaints == []


async def test_a_click_is_not_lost_when_updates_arrive_during_it(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """Offers, findings and tokens arrive between press and release: the form under the pointer
    waits with its update, and the click counts."""
    tab = await designer(browser, page)
    await element(tab, "^Transition pick_failed").click()
    await tab.keyboard.press("Delete")
    await checked(tab, "fault")
    await element(tab, "^Action place pick").click()
    async with pressed(tab, "Add error branch"), tab.expect_response("**/api/check"):
        stage.feed.emit("node", name="scale", node={"state": "up", "round_trip": 0.001})
    await expect(element(tab, "^Transition pick_error")).to_be_visible()

    await tab.get_by_role("tab", name="Live").click()
    await hold_controls(tab)
    await element(tab, "^Control place parts", "Task net").click()
    selected = tab.get_by_role("region", name="Selected")
    async with pressed(tab, "Set breakpoint"):
        stage.feed.emit("marking", marking={"parts": 1})
        await expect(element(tab, "^Control place parts, 1 token", "Task net")).to_be_visible()
        await tab.evaluate("petrobot.tabs.Live.paintText()")
    await until(lambda: "parts" in stage.state.breakpoints)
    await expect(selected.get_by_role("button", name="Remove breakpoint")).to_be_visible()
    await expect(selected).to_contain_text("1 of")


async def test_the_clock_of_a_run_stands_still_while_it_is_held(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """As its deadline does; that of a run which cannot be held goes on, as its deadline does, and
    so does the mission's clock. A page that connects later shows the same."""
    tab = await opened(browser, page)
    run: dict[str, Any] = {"place": "look", "primitive_task": "look", "action": "a", "why": ""}
    run |= {"node": "vision", "started": 0.0, "deadline": 20.0, "progress": 0.1}
    held = {"id": "x#1", "state": "held", "held_since": 9.0, "held_for": 2.0}
    free = {"id": "x#2", "state": "running", "held_since": None, "held_for": 2.5}
    paused = {"reason": "by ana", "at": 9.0, "nodes": {"vision": "held"}}
    for which in (held, free):
        stage.feed.emit("run_started", time=11.4, run={**run, **which})
    stage.feed.emit("paused", time=11.4, paused=paused)
    stage.feed.emit("mission", time=11.4, mission={"state": "running"})
    ticked = r"(1[2-9]|[2-9]\d|\d{3,})\.\d s"
    for window in (tab, await opened(browser, page)):
        cards = window.get_by_role("region", name="Running now").get_by_role("listitem")
        await expect(cards.filter(has_text="running")).to_contain_text(re.compile(rf"{ticked} of"))
        await expect(cards.filter(has_text="held")).to_contain_text("7.00 s of 20.0 s")
        state = window.get_by_role("status", name="Mission state")
        await expect(state).to_contain_text(re.compile(rf"Paused.*{ticked}"))


async def test_the_browser_applies_changes_as_the_server_does(browser: Browser, page: Page) -> None:
    """The two implementations of the rules, in Python and in the page, reach the same state on
    random sequences of changes."""
    tab = await opened(browser, page)
    script = """async ([state, changes]) => {
      const { apply } = await own("state.js");
      for (const change of changes) apply(state, change);
      return state;
    }"""
    for made in some_changes():
        here = empty_state()
        for change in made:
            apply(here, {k: v for k, v in change.items() if k not in ("sequence", "time")})
        assert await tab.evaluate(script, [empty_state(), made]) == here


def some_changes() -> list[list[dict[str, Any]]]:
    """Return thirty sequences of changes, the same in each run of the test."""
    found: list[list[dict[str, Any]]] = []

    @settings(max_examples=30, database=None, derandomize=True, phases=[Phase.generate])
    @given(changes())
    def collect(made: list[dict[str, Any]]) -> None:
        found.append(made)

    collect()
    return found


async def test_fifty_updates_a_second_leave_no_gap(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """A hundred nodes send updates all the time: every number arrives, in merged deltas, and the
    page ends with the newest state."""
    tab = await opened(browser, page)
    mission = SyntheticMission(100)
    stage.feed.replace(**{k: v for k, v in mission.snapshot().items() if k != "sequence"})
    await expect(element(tab, "^Transition step_49", "Task net")).to_be_visible()
    mission.feed = stage.feed
    await ticking(mission, 2.0)
    async with asyncio.timeout(PATIENCE_MS / 1000):
        while (
            await tab.evaluate("petrobot.link.deltas") <= 10
        ):  # A slow browser receives them in a few large deltas.
            await ticking(mission, 0.5)
    last = str(stage.feed.state["sequence"])
    await expect(tab.locator("html")).to_have_attribute("data-sequence", last)
    assert await tab.evaluate("petrobot.link.gaps") == 0


async def test_the_emergency_stop_can_be_pressed_in_every_dialog(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """In every dialog the emergency stop can be pressed, and Escape closes the dialog without an
    answer."""
    tab = await designer(browser, page)
    await tab.get_by_role("button", name="Keyboard").click()
    dialog = tab.get_by_role("dialog", name="Keyboard")
    await expect(dialog).to_be_visible()
    await tab.get_by_role("button", name="Emergency stop").click()
    await tab.keyboard.press("F9")
    await toasted(tab, "Emergency stop sent")
    await dialog.get_by_role("button", name="Close").focus()
    await tab.keyboard.press("Escape")
    await expect(dialog).to_be_hidden()
    await until(lambda: len(stage.commands) > 1)
    assert [verb for _, verb, _ in stage.commands] == ["estop", "estop"]


async def test_values_are_shown_where_they_are_used(
    browser: Browser, page: Page, stage: Stage, tasks: Path
) -> None:
    """A transition shows what its condition reads, a place the values of its arguments, and the
    list of variables has one line for each place's last run."""
    text = (tasks / "pick_and_place.toml").read_text()
    condition = "when = \"bin == 'left' and look.status == 'success'\"\n"
    text = text.replace('out = ["put"]\n', f'out = ["put"]\n{condition}')
    text = text.replace('task = "put"\n', 'task = "put"\nargs = { to = { var = "bin" } }\n')
    path = tasks / "binned.toml"
    path.write_text(text + '\n[variables]\nbin = { type = "str" }\n')
    tab = await opened(browser, page)
    stage.load(load(path))
    selected = tab.get_by_role("region", name="Selected")
    await element(tab, "^Transition picked", "Task net").click()
    stage.feed.emit("variable", time=1.0, name="look.status", value="success")
    stage.feed.emit("variable", time=1.0, name="bin", value="left")
    await expect(selected).to_contain_text("bin = left, look.status = success")
    await element(tab, "^Action place put", "Task net").click()
    await expect(selected).to_contain_text("to = $bin (now left)")
    for name, value in (("pick.status", "error"), ("pick.reason", "slipped")):
        stage.feed.emit("variable", time=1.0, name=name, value=value)
    await tab.get_by_role("tab", name="Variables").click()
    shown = tab.get_by_role("tabpanel", name="Variables")
    await expect(shown.get_by_role("row")).to_have_text(
        [
            "binleft",
            "last run of lookstatus success",
            "last run of pickstatus error, reason slipped",
        ]
    )


async def test_a_small_window_shows_what_a_pause_did_and_a_stop_in_one_row(
    browser: Browser, page: Page, stage: Stage
) -> None:
    """In a window of 1280 x 720 the answers to a pause could be read only two words at a time, and
    the button that clears a stop made the row of buttons twice as high. Messages leave Find free,
    and a command that waits says so: without it, the button looked dead."""
    answering = asyncio.Event()
    pause = stage._pause

    async def slow_pause(who: str, data: Any) -> dict[str, Any]:
        answer = await pause(who, data)
        await answering.wait()
        return answer

    stage.__dict__["_pause"] = slow_pause
    tab = await opened(browser, page)
    await tab.set_viewport_size({"width": 1280, "height": 720})
    await start_mission(tab)
    toolbar = tab.get_by_role("toolbar", name="Mission")
    step = toolbar.get_by_role("button", name="Step")
    before, row = await step.bounding_box(), await toolbar.bounding_box()
    await toolbar.get_by_role("button", name="Pause").click()
    message = tab.locator(".toast", has_text="Pause: waiting for the coordinator's answer")
    await expect(message).to_be_visible()
    finder = tab.get_by_label("Find a place or transition").first
    box, find = await message.bounding_box(), await finder.bounding_box()
    assert box is not None and find is not None and box["x"] > find["x"] + find["width"]
    answering.set()
    await expect(message).to_have_count(0)
    note = tab.locator(".pause-note")
    await expect(note).to_contain_text("Paused")
    assert await note.evaluate("(note) => note.scrollHeight <= note.clientHeight + 1")
    assert await step.bounding_box() == before, "no button moves"
    await tab.keyboard.press("F9")
    await expect(toolbar.get_by_role("button", name="Clear the stop")).to_be_visible()
    assert await toolbar.bounding_box() == row


async def test_a_new_task_shows_nothing_of_the_one_before(browser: Browser, page: Page) -> None:
    """The overview in the corner still showed the net that was open before."""
    tab = await designer(browser, page)
    overview = tab.locator(".designer .minimap")
    for _ in range(4):
        await tab.locator(".designer").get_by_role("button", name="Zoom in").click()
    await expect(overview).to_be_visible()
    await tab.get_by_role("button", name="New task").click()
    await settled(tab)
    await expect(overview).to_be_hidden()
