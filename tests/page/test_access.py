"""Attacks on the page's server: each is refused or harmless, and permitted clients are still
served."""

from __future__ import annotations

import asyncio
import contextlib
import io
import re
import resource
import shutil
import socket
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from petrobot.coordinator.operator.port import PROTOCOL
from petrobot.coordinator.page import requests
from petrobot.coordinator.page.access import CONNECTIONS, HEADERS, ConnectionLimit
from petrobot.coordinator.page.server import CLIENTS, KEPT, PAGE_FILES, Page, start_page
from petrobot.coordinator.page.sessions import LARGEST_MESSAGE
from tests.page.stage import Stage
from tests.waiting import beat

pytestmark = pytest.mark.processes

EVIL = "http://evil.example"


def base(page: Page) -> str:
    """Return the server's address without the token."""
    return page.url.partition("/?")[0]


def port_of(page: Page) -> int:
    """Return the server's port."""
    return int(base(page).rpartition(":")[2])


async def ask(
    page: Page, path: str, method: str = "GET", cookie: bool = False, **kwargs: Any
) -> aiohttp.ClientResponse:
    """Send one request without credentials, or with a browser's cookie."""
    async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
        if cookie:
            await http.get(page.url)
        async with http.request(method, base(page) + path, **kwargs) as response:
            await response.read()
            return response


def bearer(page: Page) -> dict[str, str]:
    """Return the header that a script sends."""
    return {"Authorization": f"Bearer {page.token}"}


PATHS = (
    "/",
    "/page/1/index.html",
    "/page/1/js/main.js",
    "/api/tasks",
    "/api/snapshot",
    "/api/live",
    "/api/runs",
    "/nowhere",
)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    "wrong", ["", "?token=", "?token=wrong", "?token=open+sesam", "?token=%00%ff"]
)
async def test_without_the_token_nothing_is_served(page: Page, path: str, wrong: str) -> None:
    """Not even the names of files are revealed."""
    response = await ask(page, path + wrong)
    assert response.status == 401
    assert response.headers["Content-Security-Policy"] == HEADERS["Content-Security-Policy"]


async def test_the_token_is_replaced_by_a_cookie_and_removed_from_the_address(page: Page) -> None:
    """The first visit is answered by a redirect with a cookie that scripts cannot read and that is
    not sent with requests from other sites."""
    first = await ask(page, "/?token=" + page.token, allow_redirects=False)
    assert (first.status, first.headers["Location"]) == (303, "/")
    cookie = first.headers["Set-Cookie"]
    assert all(flag in cookie for flag in ("HttpOnly", "SameSite=Strict", "Path=/"))
    assert page.token not in cookie
    # A page that is open for days still reaches its emergency stop after a broken connection.
    assert "Max-Age" not in cookie and "Expires" not in cookie
    assert (await ask(page, "/", cookie=True)).status == 200


async def test_a_token_in_any_other_address_is_not_accepted(page: Page) -> None:
    """Only the front page accepts it: addresses with secrets end up in logs."""
    assert (await ask(page, "/api/snapshot?token=" + page.token)).status == 401


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:{port}",
        "127.0.0.1",
        "127.0.0.1:1",
        "",
        "localhost.evil:{port}",
    ],
)
async def test_dns_rebinding_is_refused(page: Page, host: str) -> None:
    """A host name that an attacker points at this machine is refused, even if all else is valid."""
    headers = {**bearer(page), "Host": host.format(port=port_of(page))}
    response = await ask(page, "/api/snapshot", headers=headers)
    assert response.status in (400, 421)


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
async def test_requests_to_the_servers_own_names_are_served(page: Page, name: str) -> None:
    """These are the two names of the loopback address."""
    headers = {**bearer(page), "Host": f"{name}:{port_of(page)}"}
    assert (await ask(page, "/api/snapshot", headers=headers)).status == 200


@pytest.mark.parametrize(
    "origin",
    [EVIL, "null", "https://127.0.0.1:{port}", "http://127.0.0.1", "http://127.0.0.1:{port}.evil"],
)
async def test_other_origins_are_refused(page: Page, origin: str) -> None:
    """A page of another origin cannot use the operator's cookie, for WebSocket or POST."""
    headers = {"Origin": origin.format(port=port_of(page))}
    assert (
        await ask(page, "/api/command", "POST", cookie=True, headers=headers, json={})
    ).status == 403
    async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
        await http.get(page.url)
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await http.ws_connect(base(page) + "/api/live", headers=headers)
        assert refused.value.status == 403


async def test_a_browser_without_origin_cannot_change_anything(page: Page) -> None:
    """A cookie alone opens no WebSocket and posts nothing: every browser sends its origin with
    these requests."""
    assert (await ask(page, "/api/command", "POST", cookie=True, json={})).status == 403
    assert (
        await ask(page, "/api/live", cookie=True, headers={"Upgrade": "websocket"})
    ).status == 403


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
@pytest.mark.parametrize("path", ["/", "/api/snapshot", "/page/1/js/main.js"])
async def test_requests_caused_by_other_sites_are_refused(page: Page, site: str, path: str) -> None:
    """Links, images and scripts of another site cannot load anything from this server."""
    assert (await ask(page, path, cookie=True, headers={"Sec-Fetch-Site": site})).status == 403


@pytest.mark.parametrize(
    "kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"]
)
async def test_forms_are_refused(page: Page, stage: Stage, kind: str) -> None:
    """A form on another site cannot send JSON, so its body is not even read."""
    headers = {**bearer(page), "Content-Type": kind}
    response = await ask(page, "/api/command", "POST", headers=headers, data=b'{"verb": "estop"}')
    assert response.status == 415
    assert stage.commands == []


@pytest.mark.parametrize(
    "path",
    [
        f"/page/{path}"
        for path in (
            *("../server.py", "1/../../server.py", "%2e%2e/server.py", "1/%2e%2e/server.py"),
            *("1/..%2fserver.py", "1/js/..%2f..%2fserver.py", "1//etc/passwd", "1/%2fetc%2fpasswd"),
            *("/etc/passwd", "1/%00", "1/js", "1/js/", "1/", "1", "js/main.js"),
        )
    ],
)
async def test_files_outside_the_page_are_not_served(page: Page, path: str) -> None:
    """Paths cannot leave the page's folder."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port_of(page))
    head = (
        f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port_of(page)}\r\nAuthorization: Bearer "
        f"{page.token}\r\n"
    )
    writer.write((head + "Connection: close\r\n\r\n").encode())
    answer = await reader.read()
    writer.close()
    assert answer.split()[1] in (b"403", b"404", b"400")


@pytest.mark.parametrize(
    "name", ["..%2f..%2fetc%2fpasswd", ".hidden", "a.b", "a" * 65, "%00", "-x"]
)
async def test_task_names_cannot_leave_their_folder(page: Page, name: str) -> None:
    """A task's name is a name, not a path."""
    assert (await ask(page, f"/api/tasks/{name}", headers=bearer(page))).status in (400, 404)
    body = {"base": None, "document": {"schema": 1}}
    response = await ask(page, f"/api/tasks/{name}", "PUT", headers=bearer(page), json=body)
    assert response.status in (400, 404)


@pytest.mark.parametrize("body", ["{", "[]", "3", '"text"', "[" * 100_000, "{}" * 2_000_000])
async def test_bad_bodies_are_refused(page: Page, body: str) -> None:
    """A body that is not a JSON object, is nested too deep or is too large is refused with one
    clear answer."""
    headers = {**bearer(page), "Content-Type": "application/json"}
    assert (
        await ask(page, "/api/check", "POST", headers=headers, data=io.BytesIO(body.encode()))
    ).status in (400, 413)


async def test_every_answer_carries_the_headers(page: Page) -> None:
    """Pages, data and refusals have a strict content policy, and forbid sniffing, framing,
    referrers and caches, except of files, whose address names their version."""
    assert HEADERS["Cache-Control"] == "no-store"
    for path, headers in (
        ("/", bearer(page)),
        ("/page/1/js/main.js", bearer(page)),
        ("/page/1/js/nothing.js", bearer(page)),
        ("/api/tasks", bearer(page)),
        ("/nowhere", bearer(page)),
        ("/page/1/js/main.js", {}),
        ("/", {}),
    ):
        response = await ask(page, path, headers=headers)
        kept = {"Cache-Control": KEPT} if response.ok and path.startswith("/page/") else {}
        assert {name: response.headers.get(name) for name in HEADERS} == {**HEADERS, **kept}
    policy = HEADERS["Content-Security-Policy"]
    assert (
        "unsafe" not in policy
        and "default-src 'none'" in policy
        and "frame-ancestors 'none'" in policy
    )


async def test_a_changed_file_has_a_new_address(
    page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Browsers keep the files of the page for good. After an update, also under a running server,
    they mix no scripts of two versions: all addresses are new."""
    files = tmp_path.resolve() / "static"
    shutil.copytree(PAGE_FILES, files)
    monkeypatch.setattr("petrobot.coordinator.page.server.PAGE_FILES", files)

    async def addresses() -> set[str]:
        async with aiohttp.ClientSession(headers=bearer(page)) as http:
            front = await (await http.get(base(page) + "/")).text()
            found = set(re.findall(r'(?:src|href)="([^"]+)"', front))
            for path in found:
                assert (await http.get(base(page) + path)).status == 200
        return found

    before = await addresses()
    assert await addresses() == before
    with (files / "js" / "state.js").open("a") as file:
        file.write("// another version")
    after = await addresses()
    assert len(after) == len(before) > 4 and not after & before
    (files / "js" / "state.js").rename(files / "js" / "status.js")
    assert not await addresses() & (before | after)


async def test_a_thousand_sockets_do_not_block_the_operator(page: Page) -> None:
    """Connections above the limit are closed at once, silent ones later; a command still gets
    through."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 8192), hard))
    crowd: list[socket.socket] = []
    async with aiohttp.ClientSession(headers=bearer(page)) as http:
        assert (
            await http.get(base(page) + "/api/snapshot")
        ).status == 200  # The operator's connection is open.
        try:
            for _ in range(1_000):
                crowd.append(socket.socket())
                crowd[-1].setblocking(False)
                crowd[-1].connect_ex(("127.0.0.1", port_of(page)))
                await beat(0)
            async with http.post(
                base(page) + "/api/command", json={"verb": "estop", "name": "ana"}
            ) as answer:
                assert answer.status == 200
            assert page.limit.open_connections <= CONNECTIONS
        finally:
            for one in crowd:
                one.close()
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


async def test_an_operator_takes_the_place_of_a_connection_that_asks_for_nothing(
    page: Page,
) -> None:
    """Before, whoever came first kept all places until the time of silent ones was over."""
    page.limit.limit, page.limit.silent = 8, 600.0
    crowd = [socket.create_connection(("127.0.0.1", port_of(page))) for _ in range(100)]
    try:
        async with asyncio.timeout(60), aiohttp.ClientSession(headers=bearer(page)) as http:
            while True:
                with contextlib.suppress(aiohttp.ClientConnectionError):
                    assert (await http.get(base(page) + "/api/snapshot")).status == 200
                    break
    finally:
        for one in crowd:
            one.close()


async def test_silent_connections_are_closed(page: Page) -> None:
    """A request header sent slowly and in part does not keep its connection for ever
    (slow-loris)."""
    page.limit.silent = 0.2
    reader, writer = await asyncio.open_connection("127.0.0.1", port_of(page))
    writer.write(b"GET / HTTP/1.1\r\nHost: 127")
    with contextlib.suppress(ConnectionResetError):  # bytes that came too late for the page
        assert await asyncio.wait_for(reader.read(), 60) == b""
    writer.close()
    assert isinstance(page.limit, ConnectionLimit)


async def test_scripts_use_the_token(page: Page, stage: Stage) -> None:
    """The command line sends commands over plain HTTP with a Bearer token, under its own name."""
    answer = await ask(
        page,
        "/api/command",
        "POST",
        headers=bearer(page),
        json={"verb": "take_controls", "name": "cli"},
    )
    assert answer.status == 200
    assert stage.controls.holder is not None and stage.controls.holder.startswith("cli ")
    refused = await ask(
        page, "/api/command", "POST", headers=bearer(page), json={"verb": "step", "name": "other"}
    )
    assert refused.status == 409


async def test_each_server_draws_its_own_token(stage: Stage, tasks: Any) -> None:
    """Two servers have different tokens, and the cookie of one is not valid for the other."""
    one = await start_page(stage, tasks_folder=tasks)
    two = await start_page(stage, tasks_folder=tasks)
    try:
        assert one.token != two.token and len(one.token) >= 32
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
            await http.get(one.url)
            assert (await http.get(base(one) + "/api/tasks")).status == 200
            assert (await http.get(base(two) + "/api/tasks")).status == 401
    finally:
        await one.close()
        await two.close()


@pytest.mark.parametrize(
    "path",
    ["/", "/page/1/index.html", "/page/1/js/main.js", "/api/tasks", "/api/runs", "/api/check"],
)
async def test_without_the_page_only_the_protocol_is_served(
    stage: Stage, tasks: Any, path: str
) -> None:
    """With `--no-page` no file and no document is served, even with the token; commands still
    work."""
    bare = await start_page(stage, tasks_folder=tasks, page=False)
    try:
        assert (await ask(bare, path, headers=bearer(bare))).status == 404
        assert (await ask(bare, "/api/snapshot", headers=bearer(bare))).status == 200
        assert (await ask(bare, "/api/snapshot")).status == 401
        answer = await ask(
            bare, "/api/command", "POST", headers=bearer(bare), json={"verb": "take_controls"}
        )
        assert answer.status == 200
    finally:
        await bare.close()


@pytest.mark.parametrize("size", [LARGEST_MESSAGE + 1, 8 * LARGEST_MESSAGE])
async def test_an_oversized_message_ends_only_its_own_connection(page: Page, size: int) -> None:
    """The server does not even read all of it; another client is not affected."""
    hello = {"type": "hello", "protocol": PROTOCOL, "name": "ana", "tab": "1"}
    async with (
        aiohttp.ClientSession(headers=bearer(page)) as http,
        http.ws_connect(base(page) + "/api/live") as good,
        http.ws_connect(base(page) + "/api/live") as bad,
    ):
        for socket in (good, bad):
            await socket.send_json(hello)
            assert (await socket.receive_json(timeout=60))["type"] == "snapshot"
        with contextlib.suppress(ConnectionError):
            await bad.send_str("x" * size)
        async with asyncio.timeout(60):
            while not bad.closed:
                await bad.receive()
        assert bad.close_code in (
            aiohttp.WSCloseCode.MESSAGE_TOO_BIG,
            aiohttp.WSCloseCode.ABNORMAL_CLOSURE,
        )
        await good.send_json({"type": "command", "id": 1, "verb": "take_controls"})
        async with asyncio.timeout(60):
            while (await good.receive_json())["type"] != "answer":
                pass


async def test_the_number_of_clients_is_bounded_and_commands_still_arrive(page: Page) -> None:
    """One client more than allowed is refused with a reason. A script's emergency stop still
    works."""
    hello = {"type": "hello", "protocol": PROTOCOL, "name": "ana", "tab": "1"}
    async with aiohttp.ClientSession(
        headers=bearer(page), connector=aiohttp.TCPConnector(limit=0)
    ) as http:
        seats = [await http.ws_connect(base(page) + "/api/live") for _ in range(CLIENTS)]
        for socket in seats:
            await socket.send_json(hello)
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await http.ws_connect(base(page) + "/api/live")
        assert refused.value.status == 503
        async with http.post(
            base(page) + "/api/command", json={"verb": "estop", "name": "ana"}
        ) as answer:
            assert answer.status == 200
        for socket in seats:
            await socket.close()


async def test_a_request_body_that_never_ends_is_abandoned(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A command whose body arrives byte by byte does not keep its handler for ever."""
    monkeypatch.setattr(requests, "BODY_S", 0.2)
    reader, writer = await asyncio.open_connection("127.0.0.1", port_of(page))
    head = (
        f"POST /api/command HTTP/1.1\r\nHost: 127.0.0.1:{port_of(page)}\r\nAuthorization: "
        f"Bearer {page.token}\r\n"
    )
    writer.write((head + "Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{").encode())
    answer = await asyncio.wait_for(reader.readline(), 60)
    assert b"408" in answer
    writer.close()
    await writer.wait_closed()
