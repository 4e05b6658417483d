"""Further attacks: names that leave their folder, bodies and frames that are not text, replays,
secrets in headers, and messages that no client may send."""

from __future__ import annotations

import asyncio
import gzip
import io
import json
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import pytest_asyncio

from petrobot.coordinator.operator.port import VERBS
from petrobot.coordinator.page.access import HEADERS
from petrobot.coordinator.page.server import Page, start_page
from tests.operator.test_starting import Simulated
from tests.page.stage import Stage
from tests.page.test_access import ask, base, bearer, port_of
from tests.page.test_protocol import joined

pytestmark = pytest.mark.processes

CLIMBING = [
    "..",
    "../..",
    "..%2f..%2fetc%2fpasswd",
    "%2e%2e%2f%2e%2e",
    "..%5c..%5cwindows",
    "%00",
    "a%00b",
    "%2fetc%2fpasswd",
    "....%2f%2f....",
    "%ff%fe",
    "x" * 5_000,
    "<script>alert(1)</script>",
    "a;cat%20x",
    "~root",
    "C:%5cx",
]


async def raw(page: Page, head: str, body: bytes = b"") -> bytes:
    """Send one request as bytes; return the whole answer."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port_of(page))
    writer.write(head.replace("\n", "\r\n").encode("latin-1") + b"\r\n\r\n" + body)
    async with asyncio.timeout(60):
        answer = await reader.read()
    writer.close()
    return answer


@pytest_asyncio.fixture(loop_scope="session")
async def cell(tmp_path: Path) -> AsyncIterator[tuple[Simulated, Page]]:
    """A station that can start runs, and its page."""
    made = Simulated(tmp_path)
    secret = tmp_path / "secret" / "run.journal"
    secret.parent.mkdir()
    secret.write_text("not for you")
    page = await start_page(
        made.station,
        tasks_folder=tmp_path / "tasks",
        runs=made.runs,
        starts=made.station.form,
    )
    yield made, page
    await page.close()
    await made.station.close()


async def test_names_of_documents_and_journals_stay_in_their_folders(
    cell: tuple[Simulated, Page],
) -> None:
    """No run, task, form or export outside its folder can be read, and nothing is written. All
    names are tried on one station: each station starts processes of its own."""
    made, page = cell
    before = sorted(made.folder.rglob("*"))
    for path in (
        path
        for name in CLIMBING
        for path in (
            f"/api/runs/{name}",
            f"/api/start/{name}",
            f"/api/tasks/{name}",
            f"/api/tasks/{name}/export/toml",
        )
    ):
        head = (
            f"GET {path} HTTP/1.1\nHost: 127.0.0.1:{port_of(page)}\nAuthorization: Bearer "
            f"{page.token}\nConnection: close"
        )
        answer = await raw(page, head)
        assert answer.split()[1] in (b"400", b"404"), (path, answer[:80])
        assert b"not for you" not in answer and b"<script" not in answer.partition(b"\r\n\r\n")[0]
        assert sorted(made.folder.rglob("*")) == before, path


@pytest.mark.parametrize(
    "run",
    ["../secret", "secret", "..", "/", "", "\x00", "../runs/../secret", "x" * 3_000, "\ud800"],
)
async def test_a_start_from_a_run_elsewhere_is_refused(
    cell: tuple[Simulated, Page], run: str
) -> None:
    """`from` may only name a run in this coordinator's folder."""
    made, page = cell
    await ask(
        page,
        "/api/command",
        "POST",
        headers=bearer(page),
        json={"verb": "take_controls", "name": "x"},
    )
    order = {"verb": "start", "name": "x", "data": {"from": {"run": run, "record": 0}}}
    body = io.BytesIO(json.dumps(order).encode())
    headers = {**bearer(page), "Content-Type": "application/json"}
    assert (await ask(page, "/api/command", "POST", headers=headers, data=body)).status == 409
    assert not made.runs.exists()


STRANGE: list[dict[str, Any]] = [
    {"task": "\ud800"},
    {"task": ["moving"]},
    {"task": {"a": 1}},
    {"task": "moving", "mode": "lockstep", "parameters": {"\ud800": "\udfff"}},
    {"task": "moving", "mode": "lockstep", "parameters": {"speed": "\ud800"}},
    {"task": "moving", "mode": "lockstep", "learn": {"file": "\ud800"}},
    {"task": "moving", "mode": "lockstep", "seed": 10**400},
    {"task": "moving", "mode": "lockstep", "runs": {"a": ["b"] * 20_000}},
    {"task": "moving", "mode": "lockstep", **{f"field{i}": i for i in range(2_000)}},
]


@pytest.mark.parametrize("data", STRANGE)
async def test_strange_orders_are_answered_briefly(
    cell: tuple[Simulated, Page], data: dict[str, Any]
) -> None:
    """A message that is not a command is refused with a short reason, whatever it holds, and
    changes nothing."""
    made, page = cell
    await ask(
        page,
        "/api/command",
        "POST",
        headers=bearer(page),
        json={"verb": "take_controls", "name": "x"},
    )
    headers = {**bearer(page), "Content-Type": "application/json"}
    body = json.dumps({"verb": "start", "name": "x", "data": data}).encode()
    async with (
        aiohttp.ClientSession() as http,
        http.post(base(page) + "/api/command", data=io.BytesIO(body), headers=headers) as answer,
    ):
        assert answer.status == 409, await answer.text()
        told = await answer.json()
    assert told["ok"] is False and 0 < len(told["text"]) < 1_000
    assert not made.runs.exists()


@pytest.mark.parametrize("depth", [10, 900, 5_000, 100_000])
async def test_deep_data_is_refused_or_ignored(page: Page, depth: int) -> None:
    """Data that is nested too deep to be read is refused; the server continues."""
    deep = "[" * depth + "]" * depth
    headers = {**bearer(page), "Content-Type": "application/json"}
    body = io.BytesIO(f'{{"verb": "pause", "name": "x", "data": {{"deep": {deep}}}}}'.encode())
    assert (await ask(page, "/api/command", "POST", headers=headers, data=body)).status in (
        400,
        409,
    )
    async with joined(page) as client:
        await client.until(lambda s: True)
        await client.socket.send_str(
            f'{{"type": "command", "id": 1, "verb": "pause", "data": {{"deep": {deep}}}}}'
        )
        async with asyncio.timeout(60):
            while not client.answers and not client.socket.closed:
                message = await client.socket.receive()
                if (
                    message.type is aiohttp.WSMsgType.TEXT
                    and json.loads(message.data)["type"] == "answer"
                ):
                    break
    assert (await ask(page, "/api/snapshot", headers=bearer(page))).status == 200


async def test_a_compressed_body_is_limited_by_its_expanded_size(page: Page) -> None:
    """A hundred megabytes of zeros, sent as a hundred kilobytes, are refused at the limit that
    holds for every body."""
    bomb = gzip.compress(b'{"a": "' + b" " * 100_000_000 + b'"}', 1)
    headers = {**bearer(page), "Content-Type": "application/json", "Content-Encoding": "gzip"}
    assert (
        await ask(page, "/api/command", "POST", headers=headers, data=io.BytesIO(bomb))
    ).status in (400, 413)


@pytest.mark.parametrize(
    "verb",
    [
        "",
        "__class__",
        "_do_estop",
        "close",
        "command",
        "snapshot",
        "ESTOP",
        "estop ",
        "start\x00",
        "e" * 10_000,
        None,
        3,
    ],
)
async def test_only_the_verbs_of_the_protocol_are_commands(
    page: Page, stage: Stage, verb: Any
) -> None:
    """No other method of the mission can be called by its name."""
    async with joined(page) as client:
        answer = await client.command(verb)
    assert (answer["ok"], answer["code"]) == (False, "unknown_command")
    assert len(answer["text"]) < 200
    assert stage.commands == [] and str(verb) not in VERBS


async def test_a_replayed_command_is_carried_out_once(page: Page, stage: Stage) -> None:
    """The same frame has no further effect, neither on its connection nor, without the controls, on
    another."""
    frame = {
        "type": "command",
        "id": 7,
        "verb": "add_tokens",
        "data": {"place": "parts", "count": 1},
    }
    async with joined(page) as ana, joined(page, "ana", "2") as thief:
        await ana.command("take_controls")
        assert (await ana.command("start"))["ok"]
        for socket in (ana.socket, ana.socket, thief.socket):
            await socket.send_json(frame)
        await thief.until(lambda s: 7 in thief.answers)
        assert thief.answers[7]["code"] == "not_holder"
        async with asyncio.timeout(60):
            while ana.answers.get(7, {}).get("code") != "replayed":
                await ana.hear()
    assert (
        sum(
            verb == "add_tokens" and who.endswith(ana.state["you"][-4:])
            for who, verb, _ in stage.commands
        )
        == 1
    )


async def test_a_client_that_left_before_its_answer_is_no_fault(
    page: Page, caplog: pytest.LogCaptureFixture
) -> None:
    """A coordinator that was frozen finds requests whose clients have gone; its log had a traceback
    for each."""
    lines = (
        "GET /api/live HTTP/1.1",
        f"Host: 127.0.0.1:{port_of(page)}",
        f"Authorization: {bearer(page)['Authorization']}",
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==",
    )
    for _ in range(8):
        with socket.create_connection(("127.0.0.1", port_of(page))) as gone:
            gone.sendall("\r\n".join((*lines, "", "")).encode())
    async with joined(page) as ana:
        assert (await ana.command("take_controls"))["ok"], "others are served"
    assert not [entry for entry in caplog.records if entry.exc_info]


async def test_a_name_alone_does_not_identify_a_client(page: Page, stage: Stage) -> None:
    """A client with the holder's name, but without the secret of the holder's tab, does not hold
    the controls."""
    async with joined(page) as ana, joined(page, "ana", "guessed") as thief:
        await ana.command("take_controls")
        assert (await thief.command("start"))["code"] == "not_holder"
        await thief.command("release_controls")
        assert stage.controls.holder == ana.state["you"]


async def test_no_header_gives_the_token_away(page: Page) -> None:
    """No answer lets the browser send a referrer, not even the first redirect; a token in a Referer
    header is not accepted."""
    first = await ask(page, f"/?token={page.token}", allow_redirects=False)
    assert first.headers["Referrer-Policy"] == "no-referrer" and page.token not in str(
        first.headers
    )
    assert first.headers["Location"] == "/"
    headers = {"Referer": f"{base(page)}/?token={page.token}"}
    for path in ("/", "/api/snapshot", "/page/1/js/main.js"):
        assert (await ask(page, path, headers=headers)).status == 401


@pytest.mark.parametrize("method", ["OPTIONS", "TRACE", "PUT", "DELETE", "PATCH", "PROPFIND"])
async def test_no_other_site_may_read_answers(page: Page, method: str) -> None:
    """A preflight request of another origin is refused, and no answer has a header that would let
    it read."""
    headers = {"Origin": "http://evil.example", "Access-Control-Request-Method": "POST"}
    answer = await ask(page, "/api/command", method, cookie=True, headers=headers)
    assert answer.status in (400, 403, 405)
    assert not [name for name in answer.headers if name.lower().startswith("access-control")]
    assert {name: answer.headers.get(name) for name in HEADERS} == HEADERS


@pytest.mark.parametrize(
    "header", ["X-Forwarded-Host", "X-Host", "Forwarded", "X-Original-URL", "X-Rewrite-URL"]
)
async def test_no_header_replaces_the_host_header(page: Page, header: str) -> None:
    """Headers that proxies set change neither which requests the server answers nor what it
    answers."""
    good = f"127.0.0.1:{port_of(page)}"
    headers = {**bearer(page), "Host": "evil.example", header: good}
    assert (await ask(page, "/api/snapshot", headers=headers)).status == 421
    assert (
        await ask(page, "/nowhere", headers={**bearer(page), header: "/api/snapshot"})
    ).status == 404


@pytest.mark.parametrize(
    "lines",
    [
        "Content-Length: 3\nTransfer-Encoding: chunked",
        "Content-Length: 3\nContent-Length: 4",
        "Content-Length: -1",
        "Content-Length: 1e3",
        "Transfer-Encoding: chunked\nTransfer-Encoding: identity",
        f"X-Long: {'a' * 100_000}",
        "X-Bad\x01: a",
        " folded: a",
    ],
)
async def test_ambiguous_requests_are_refused(page: Page, stage: Stage, lines: str) -> None:
    """A request that two servers would read differently (request smuggling) is not read at all."""
    head = (
        f"POST /api/command HTTP/1.1\nHost: 127.0.0.1:{port_of(page)}\nAuthorization: "
        f"Bearer {page.token}\n"
    )
    head += f"Content-Type: application/json\nConnection: close\n{lines}"
    answer = await raw(page, head, b'0\r\n\r\n{"verb": "estop"}')
    assert not answer or answer.split()[1] in (b"400", b"411", b"413", b"431")
    assert stage.commands == []


@pytest.mark.parametrize("pass_as", ["query", "body", "cookie", "basic", "lower"])
async def test_the_token_is_accepted_only_as_bearer(page: Page, pass_as: str) -> None:
    """It is not accepted anywhere else; the cookie holds a value derived from it."""
    headers = {
        "cookie": {"Cookie": f"petrobot_{port_of(page)}={page.token}"},
        "basic": {"Authorization": f"Basic {page.token}"},
        "lower": {"Authorization": f"bearer {page.token}"},
    }.get(pass_as, {})
    path = f"/api/command?token={page.token}" if pass_as == "query" else "/api/command"
    answer = await ask(
        page, path, "POST", headers=headers, json={"verb": "estop", "token": page.token}
    )
    assert answer.status == 401
