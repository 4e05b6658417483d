"""Task files over HTTP: revisions, conflicts with both versions, findings, other formats, offers
and journals."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import pytest_asyncio

from petrobot.coordinator.analysis.formats import pnml
from petrobot.coordinator.analysis.formats.pnml import parse_pnml
from petrobot.coordinator.cli import run
from petrobot.coordinator.cli.loading import own_tasks
from petrobot.coordinator.learning.estimate import Observation, Tally, TallyKey
from petrobot.coordinator.learning.estimates_file import EstimatesFile
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.session import LearningSetting
from petrobot.coordinator.operator import history as journals
from petrobot.coordinator.operator.prepare import RunRequest, prepare
from petrobot.coordinator.page import edits, task_store as store, task_work as verdicts
from petrobot.coordinator.page.access import HEADERS
from petrobot.coordinator.page.server import Page, start_page
from petrobot.coordinator.page.task_work import as_task_file
from petrobot.coordinator.task import Status
from petrobot.coordinator.task.file import load, loads
from petrobot.services.comm import location_file
from tests.page.stage import Stage
from tests.waiting import until

pytestmark = pytest.mark.processes

TASK = "pick_and_place"
ROOT = Path(__file__).parents[2]

FORBIDDEN = (
    (edits, "parse"),
    (edits, "edited"),
    (store, "edited"),
    (store, "parse"),
    (verdicts, "parse"),
    (verdicts, "loads"),
    (verdicts, "judge_text"),
    (pnml, "parse_pnml"),
    (journals, "read_journal"),
    (journals, "replay"),
    (journals, "loads"),
)
"""Functions that, for a large net or a long journal, take longer than the event loop may block."""


@pytest_asyncio.fixture(loop_scope="session")
async def http(page: Page) -> AsyncIterator[aiohttp.ClientSession]:
    """An HTTP client of a script, with the token."""
    address = page.url.partition("/?")[0]
    headers = {"Authorization": f"Bearer {page.token}"}
    async with aiohttp.ClientSession(address, headers=headers) as session:
        yield session


def test_a_task_beside_its_location_file_is_offered_and_other_files_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`petrobot serve` in the folder of a robot offers its task."""
    monkeypatch.chdir(tmp_path)
    cell = tmp_path / "services.toml"
    node = '[nodes.pc]\nhost = "127.0.0.1"\nport = 7501\n'
    cell.write_text(f'schema = 1\n{node}[actions.a]\nrun = "m:a"\nnode = "pc"\ntask = "go"\n')
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    directory = location_file.load(cell)
    assert own_tasks(directory) == Path("tasks")  # there is no task yet
    (tmp_path / "sort.toml").write_text("schema = 1\n  [task]\n")
    (tmp_path / "short.toml").write_text('task.name = "short"\n')
    assert own_tasks(directory) == tmp_path
    assert store.TaskStore(tmp_path).names() == ["short", "sort"]
    with pytest.raises(store.Conflict):  # it is not offered, and not overwritten either
        store.TaskStore(tmp_path).save_text("services", None, "[task]\n")
    (tmp_path / "tasks").mkdir()
    assert own_tasks(directory) == Path("tasks")


async def opened(http: aiohttp.ClientSession, name: str = TASK) -> dict[str, Any]:
    """Open a task as the designer does."""
    async with http.get(f"/api/tasks/{name}") as answer:
        assert answer.status == 200
        task: dict[str, Any] = await answer.json()
        return task


async def save(http: aiohttp.ClientSession, name: str, **body: Any) -> tuple[int, Any]:
    """Save; return status and answer."""
    async with http.put(f"/api/tasks/{name}", json=body) as answer:
        value = (
            await answer.json()
            if answer.content_type == "application/json"
            else await answer.text()
        )
        return answer.status, value


async def test_open_edit_save(http: aiohttp.ClientSession, tasks: Path) -> None:
    """Editing one deadline in the page changes one line on disk, and the revision."""
    before = (tasks / f"{TASK}.toml").read_text()
    task = await opened(http)
    task["document"]["primitive_tasks"]["pick"]["deadline"] = 7.5
    status, saved = await save(http, TASK, base=task["revision"], document=task["document"])
    assert status == 200 and saved["revision"] != task["revision"]
    after = (tasks / f"{TASK}.toml").read_text()
    assert after == before.replace(
        'alternatives = ["pick"]\ndeadline = 5.0', 'alternatives = ["pick"]\ndeadline = 7.5'
    )
    assert load(tasks / f"{TASK}.toml").primitive_tasks["pick"].deadline == 7.5


async def test_a_conflict_is_refused_with_both_versions(
    http: aiohttp.ClientSession, tasks: Path
) -> None:
    """Of two users who edit, the second one's save writes nothing and returns both versions; then
    either may be chosen."""
    first, second = await opened(http), await opened(http)
    first["document"]["task"]["goal"] = "theirs"
    second["document"]["task"]["goal"] = "mine"
    assert (await save(http, TASK, base=first["revision"], document=first["document"]))[0] == 200
    kept = (tasks / f"{TASK}.toml").read_text()
    status, conflict = await save(http, TASK, base=second["revision"], document=second["document"])
    assert status == 409
    assert (tasks / f"{TASK}.toml").read_text() == kept
    assert 'goal = "theirs"' in conflict["theirs"]["text"] and 'goal = "mine"' in conflict["yours"]
    status, _ = await save(http, TASK, base=conflict["theirs"]["revision"], text=conflict["yours"])
    assert status == 200
    assert load(tasks / f"{TASK}.toml").goal == "mine"


async def test_a_new_file_does_not_replace_an_existing_one(http: aiohttp.ClientSession) -> None:
    """Saving under an existing name without having opened that file is a conflict."""
    assert (await save(http, TASK, base=None, document={"schema": 1}))[0] == 409
    status, made = await save(
        http,
        "fresh",
        base=None,
        document={"schema": 1, "task": {"name": "fresh", "final": "false"}},
    )
    assert status == 200 and made["revision"]


async def test_findings_name_their_element(http: aiohttp.ClientSession) -> None:
    """An unsaved document is checked as it would be saved, and every finding has its key and
    remedy."""
    task = await opened(http)
    document = task["document"]
    assert [f for f in task["findings"] if f["severity"] == "error"] == []
    del document["transitions"]["pick_failed"]
    document["primitive_tasks"]["put"]["alternatives"] = ["put", "throw"]
    async with http.post("/api/check", json={"name": TASK, "document": document}) as answer:
        said = await answer.json()
    errors = {f["key"]: f for f in said["findings"] if f["severity"] == "error"}
    assert "places.pick" in errors and errors["places.pick"]["remedy"]
    assert any("throw" in f["text"] for f in said["findings"])
    assert "[transitions.pick_failed]" not in said["text"]


async def test_editing_does_not_touch_the_running_net(
    http: aiohttp.ClientSession, stage: Stage
) -> None:
    """A save during a run changes the file; the active mission keeps the task it was started
    with."""
    await stage.command("ana", "take_controls", {})
    assert (await stage.command("ana", "start", {}))["ok"]
    running = stage.snapshot()["task"]
    task = await opened(http)
    for name in ("put", "placed", "put_failed"):
        task["document"]["places"].pop(name, None)
        task["document"]["transitions"].pop(name, None)
    task["document"]["transitions"]["picked"]["out"] = ["arm_free"]
    assert (await save(http, TASK, base=task["revision"], document=task["document"]))[0] == 200
    assert stage.snapshot()["task"] == running


async def test_a_broken_file_is_listed_with_its_fault(
    http: aiohttp.ClientSession, tasks: Path
) -> None:
    """After a mistake in a text editor the file is listed with its fault; the others can be
    opened."""
    (tasks / "broken.toml").write_text("[places\n")
    async with http.get("/api/tasks/broken") as answer:
        assert answer.status == 422 and "broken.toml" in await answer.text()
    assert (await opened(http))["name"] == TASK


async def test_saving_keeps_the_files_mode_and_leaves_no_temporary_file(
    http: aiohttp.ClientSession, tasks: Path
) -> None:
    """Saves are atomic: no temporary file is left, and the permissions stay as they were."""
    path = tasks / f"{TASK}.toml"
    os.chmod(path, 0o640)  # noqa: PTH101
    task = await opened(http)
    task["document"]["task"]["goal"] = "another"
    assert (await save(http, TASK, base=task["revision"], document=task["document"]))[0] == 200
    assert path.stat().st_mode & 0o777 == 0o640
    assert sorted(p.name for p in tasks.iterdir()) == [path.name]


async def test_offers_list_what_the_nodes_offer(http: aiohttp.ClientSession) -> None:
    """The designer sees which node offers which primitive task."""
    async with http.get("/api/offers") as answer:
        offers = await answer.json()
    assert {"action": "pick", "primitive_task": "pick", "node": "arm"}.items() <= next(
        o for o in offers if o["action"] == "pick"
    ).items()


async def test_the_stochastic_view_is_drawn(http: aiohttp.ClientSession, tasks: Path) -> None:
    """With rates and where they come from; without estimates it says which one is missing."""
    text = (ROOT / "coordinator" / "tasks" / "catch_ball.toml").read_text(encoding="utf-8")
    (tasks / "catch_ball.toml").write_text(text, encoding="utf-8")
    async with http.get("/api/tasks/catch_ball/export/gspn.svg") as answer:
        drawn = await answer.text()
        assert answer.status == 200 and answer.content_type == "image/svg+xml"
    assert "transition timed" in drawn and "declared in the task file" in drawn
    assert "Assumed: two runs never use one device at a time" in drawn
    async with http.get(f"/api/tasks/{TASK}/export/gspn.svg") as answer:
        assert answer.status == 400 and "no stochastic view: " in await answer.text()


async def test_forecasts_take_what_was_learned(stage: Stage, tasks: Path, tmp_path: Path) -> None:
    """The drawing and the analysis name the estimates file that their numbers come from."""
    text = (ROOT / "coordinator" / "tasks" / "catch_ball.toml").read_text(encoding="utf-8")
    (tasks / "catch_ball.toml").write_text(text, encoding="utf-8")
    made = Estimates()
    key = TallyKey("locate_ball", "locate_hough", "")
    made.tallies[key] = Tally().adding(Observation(Status.SUCCESS, 4.0), "t")
    EstimatesFile(tmp_path / "learned.db").add(made, {})
    page = await start_page(stage, tasks_folder=tasks, estimates=tmp_path)
    headers = {"Authorization": f"Bearer {page.token}"}
    try:
        async with aiohttp.ClientSession(page.base, headers=headers) as http:
            async with http.get("/api/tasks/catch_ball/export/gspn.svg") as answer:
                assert "learned.db" in await answer.text()
            document = (await opened(http, "catch_ball"))["document"]
            asked = {"name": "catch_ball", "document": document}
            async with http.post("/api/analyse", json=asked) as answer:
                assert "learned.db" in " ".join((await answer.json())["notes"])
    finally:
        await page.close()


async def test_the_page_of_a_run_takes_what_its_plant_learned(tmp_path: Path) -> None:
    """The page of `petrobot run` takes the file in which the run learns, whatever its name is."""
    task = ROOT / "coordinator" / "tasks" / "catch_ball.toml"
    made, file = Estimates(), tmp_path / "lab.estimates"
    key = TallyKey("locate_ball", "locate_hough", "")
    made.tallies[key] = Tally().adding(Observation(Status.SUCCESS, 4.0), "t")
    for plant in ("simulated", "mock"):
        EstimatesFile(file).add(made, {}, plant=plant)
    request = RunRequest(learning=LearningSetting(file), folder=tmp_path / "runs")
    directory = location_file.load(ROOT / "services.toml")
    session = prepare(request, load(task), task.read_text(encoding="utf-8"), directory)
    try:
        async with run.served(session, argparse.Namespace(page_port=0, no_page=False)):
            assert session.address is not None
            headers = {"Authorization": f"Bearer {session.address.token}"}
            async with (
                aiohttp.ClientSession(session.address.url, headers=headers) as http,
                http.get("/api/tasks/catch_ball/export/gspn.svg") as answer,
            ):
                drawn = await answer.text()
        assert f"numbers as measured in {file} (plant simulated)" in drawn
    finally:
        await session.abandon()


async def test_pnml_is_exported_and_imported(http: aiohttp.ClientSession, tasks: Path) -> None:
    """The ordinary net keeps marking, weights, inhibitors and positions through PNML."""
    async with http.get(f"/api/tasks/{TASK}/export/pnml") as answer:
        text = await answer.text()
        assert 'filename="pick_and_place.pnml"' in answer.headers["Content-Disposition"]
    async with http.post("/api/import", json={"form": "pnml", "text": text}) as answer:
        document = (await answer.json())["document"]
    original = load(tasks / f"{TASK}.toml")
    assert {n: (p["x"], p["y"], p.get("tokens", 0)) for n, p in document["places"].items()} == {
        p.name: (p.x, p.y, p.tokens) for p in original.places.values()
    }
    taken = {n: sorted(t["in"]) for n, t in document["transitions"].items()}
    assert taken["begin"] == ["arm_free", "parts"]


BAD_PNML = (
    "",
    "<pnml/>",
    "<html/>",
    '<!DOCTYPE x [<!ENTITY a "b">]><pnml><net id="n"/></pnml>',
    '<pnml><net id="n"><place id="p"/><place id="q"/><arc id="a" source="p" '
    'target="q"/></net></pnml>',
)


@pytest.mark.parametrize("text", BAD_PNML)
async def test_bad_pnml_is_refused(http: aiohttp.ClientSession, text: str) -> None:
    """A file that is not a place/transition net, or that defines XML entities, is refused with a
    reason."""
    async with http.post("/api/import", json={"form": "pnml", "text": text}) as answer:
        assert answer.status == 400 and "PNML" in await answer.text()


def test_names_of_other_tools_become_valid_names() -> None:
    """Names with spaces, duplicate names and names that begin with a digit become valid and
    distinct."""
    nodes = "".join(
        f'<place id="p{i}"><name><text>{name}</text></name></place>'
        for i, name in enumerate(["a b", "a-b", "1", ""])
    )
    arcs = '<arc id="a" source="p0" target="t"><inscription><text>3</text></inscription></arc>'
    text = f'<pnml><net id="n"><page id="g">{nodes}<transition id="t"/>{arcs}</page></net></pnml>'
    document = as_task_file(parse_pnml(text))
    assert all(f"[places.{name}]" in document for name in ("a_b", "a_b_2", "n1", "p3"))
    assert 'in = ["a_b*3"]' in document
    assert loads(document.replace('final = "false"', 'final = "n1 == 0"')).places["a_b"].tokens == 0


async def finished(stage: Stage) -> None:
    """Run the task to its end."""
    await stage.command("ana", "take_controls", {})
    assert (await stage.command("ana", "start", {}))["ok"]
    over = asyncio.Event()

    def beat(_: float) -> None:
        events = stage.feed.state["events"]
        if not events["part_there"]["armed"] and stage.feed.state["marking"]["arm_free"]:
            stage.happen("part_there")

    stage.on_beat.append(beat)
    stop = stage.subscribe(
        lambda c: over.set() if c["kind"] == "mission" and "reason" in c["mission"] else None
    )
    await asyncio.wait_for(over.wait(), 60)
    stop()


async def test_a_finished_run_can_be_scrubbed(http: aiohttp.ClientSession, stage: Stage) -> None:
    """The journal gives every marking: stepping through its changes ends in the final marking, with
    reasons."""
    await finished(stage)
    async with http.get("/api/runs") as answer:
        runs = await answer.json()
    async with http.get(f"/api/runs/{runs[0]['id']}") as answer:
        run = await answer.json()
    marking = dict(run["initial"])
    for record in run["records"]:
        marking.update(record["marking"])
    assert marking == stage.snapshot()["marking"] and run["fault"] == ""
    wrong = [f for record in run["records"] for f in record["firings"] if f["error"]]
    assert [(f["transition"], f["reason"]["code"], f["action"]) for f in wrong] == [
        ("pick_failed", "slipped", "pick")
    ]
    async with http.get("/api/runs/..%2f..") as answer:
        assert answer.status == 404


async def test_the_page_and_the_journal_agree(http: aiohttp.ClientSession, stage: Stage) -> None:
    """The firings that clients saw live are those that the journal gives afterwards."""
    await finished(stage)
    live = [(f["transition"], f["error"]) for f in stage.snapshot()["firings"]]
    async with http.get("/api/runs") as answer:
        run = (await answer.json())[0]["id"]
    async with http.get(f"/api/runs/{run}") as answer:
        records = (await answer.json())["records"]
    assert [(f["transition"], f["error"]) for r in records for f in r["firings"]] == live


async def test_long_computations_never_run_in_the_coordinators_process(
    http: aiohttp.ClientSession, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They run neither in its event loop nor in one of its threads, which would share the
    interpreter with the active mission."""
    await stage.command("ana", "take_controls", {})
    await stage.command("ana", "start", {"task": TASK})

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("done in the coordinator's own process")

    for module, name in FORBIDDEN:
        monkeypatch.setattr(module, name, forbidden)
    task = await opened(http)
    document = {**task["document"], "task": {**task["document"]["task"], "text": "altered"}}
    drawn = {"name": TASK, "document": document, "desk": "mine"}
    status, saved = await save(http, TASK, base=task["revision"], document=document)
    assert status == 200 and saved["document"]["task"]["text"] == "altered"
    async with http.get(f"/api/tasks/{TASK}/export/pnml") as answer:
        exported = await answer.text()
    for path, body in {
        "/api/check": drawn,
        "/api/analyse": drawn,
        "/api/import": {"form": "pnml", "text": exported},
    }.items():
        async with http.post(path, json=body) as answer:
            assert answer.status == 200, (path, await answer.text())
            assert answer.headers.keys() >= HEADERS.keys(), path
    async with http.get("/api/runs") as answer:
        (run,) = await answer.json()
    async with http.get(f"/api/runs/{run['id']}") as answer:
        assert answer.status == 200 and (await answer.json())["records"]
        assert answer.headers.keys() >= HEADERS.keys()


CELL = """schema = 1
[nodes.pc]
host = "127.0.0.1"
port = 7501
[actions]
look__edges = { run = "hands_of_this_test:look", node = "pc", task = "look" }
look__template = { run = "hands_of_this_test:look", node = "pc", task = "look" }
pick = { run = "hands_of_this_test:pick", node = "pc" }
put = { run = "hands_of_this_test:put", node = "pc" }
clear = { run = "hands_of_this_test:clear", node = "pc" }
"""
HANDS = """import pathlib, threading
here = pathlib.Path(__file__).parent
hangs = (here / "hangs.txt").exists()
(here / "importing.txt").touch()
if hangs:
    threading.Event().wait()
from petrobot import success
async def look(ctx):
    return success()
async def pick(ctx, *, force):
    return success()
async def put(ctx):
    return success()
async def clear(ctx):
    ctx.raise_event("part_there")
    return success()
"""


async def test_the_check_reads_the_code_of_the_cell_and_may_hang_alone(
    stage: Stage, tasks: Path, tmp_path: Path
) -> None:
    """An import that never ends keeps no other work waiting, and a newer drawing ends it. The
    coordinator's process imports nothing."""
    cell, task = tmp_path / "services.toml", "pick_and_place"
    cell.write_text(CELL)
    (tmp_path / "hands_of_this_test.py").write_text(HANDS)
    hangs, importing = tmp_path / "hangs.txt", tmp_path / "importing.txt"
    hangs.touch()
    made = await start_page(stage, tasks_folder=tasks, offers=stage.offers, services=cell)
    headers = {"Authorization": f"Bearer {made.token}"}
    async with aiohttp.ClientSession(made.base, headers=headers) as http, asyncio.timeout(120):
        drawn = {"name": task, "document": (await opened(http))["document"], "desk": "mine"}

        async def post(path: str) -> Any:
            async with http.post(path, json=drawn) as answer:
                return await answer.json()

        older = asyncio.create_task(post("/api/check"))
        await until(importing.exists, "the import")
        assert (await opened(http))["findings"] == []  # by another process
        hangs.unlink()
        found = {f["key"]: f["text"] for f in (await post("/api/check"))["findings"]}
        assert "needs the argument 'force'" in found["places.pick.args"], found
        assert await older == {"superseded": True}
        drawn["document"]["places"]["pick"]["args"] = {"force": 2.0}
        for path in ("/api/check", "/api/analyse"):
            told = (await post(path))["findings"]
            assert {f["severity"] for f in told} <= {"warning", "note"}, told
            assert any("raises the event 'part_there'" in f["text"] for f in told), told
    await made.close()
    assert "hands_of_this_test" not in sys.modules


async def test_an_outdated_drawing_is_answered_without_an_error(
    http: aiohttp.ClientSession,
) -> None:
    """A browser logs each 4xx answer as an error, but to continue drawing is not one."""
    document = (await opened(http))["document"]
    document["places"]["parts"] |= {"tokens": 100_000, "capacity": 100_000}  # a long analysis
    drawn = {"name": TASK, "document": document, "desk": "mine"}

    async def post(path: str) -> tuple[int, Any]:
        async with http.post(path, json=drawn) as answer:
            return answer.status, await answer.json()

    older = asyncio.create_task(post("/api/analyse"))
    async with asyncio.timeout(60):
        while not older.done():
            assert (await post("/api/check"))[0] == 200
    assert await older == (200, {"superseded": True})


def test_the_user_s_own_tasks_come_before_those_of_petrobot(tmp_path: Path) -> None:
    """The designer opens the first task: that of a newcomer's robot, not one that its nodes cannot
    run."""
    for folder, name in (("own", "deliver"), ("own", "track"), ("shipped", "catch")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / f"{name}.toml").write_text("schema = 1\n[task]\n")
    (tmp_path / "shipped" / "track.toml").write_text("schema = 1\n[task]\n")
    listed = store.TaskStore(tmp_path / "own", tmp_path / "shipped").listed()
    assert [entry["name"] for entry in listed] == ["deliver", "track", "catch"]
    assert listed[1] == {"name": "track", "own": True, "shipped": True}
